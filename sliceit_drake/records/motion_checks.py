"""Checks of the motion in a slice record: units, jumps, gaps, velocities, board, edge down."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.findings import Findings, runs
from sliceit_drake.records.slice_record import SliceRecord, SliceTable

__all__ = ["check_motion"]

REACH = 5.0
"""Positions beyond this are not those of an arm's knife, m."""
FASTEST = 2.0
"""Above this speed between two rows the pose has jumped, m/s."""
FASTEST_TURN = 20.0
"""Above this rate between two rows the orientation has jumped, rad/s."""
JOINT_LIMIT = 7.0
"""Beyond this a joint angle is not in radians: joints turn by +-2 pi at most, rad."""
THOUSAND = (250.0, 4000.0)
"""Ratios that a factor of 1000 in a unit explains, and a wrong nominal speed does not."""
BELOW_BOARD = 0.02
"""An edge this far below the board's surface is not pressing into it, m."""


def check_motion(table: SliceTable, record: SliceRecord, findings: Findings) -> None:
    """Adds to the findings what is wrong with the motion, of a table and its record in W."""
    _check_units(record, findings)
    if record.joints is not None:
        _check_joints(record.joints, findings)
    if findings.has("millimetres", "milliseconds"):
        return  # All that follows compares metres and seconds.
    _check_jumps(record, findings)
    _check_sampling(record, findings)
    _check_velocities(table, record, findings)
    _check_upright(record, findings)
    board = record.metadata.board_height
    if board is not None and "p_WK_z" not in record.metadata.unknown:
        low = record.position[:, 2] < board - BELOW_BOARD
        for first, last in runs(low)[:1]:
            depth = 1e3 * (board - record.position[low, 2].min())
            text = f"the edge is up to {depth:.0f} mm below the board at {board:g} m"
            findings.add("below board", "p_WK_z", text, (first, last))


def _check_units(record: SliceRecord, findings: Findings) -> None:
    motion, rate = record.metadata.motion, record.metadata.sensor.rate
    period = float(np.median(np.diff(record.time)))
    slow_clock = rate is not None and THOUSAND[0] < period * rate < THOUSAND[1]
    # Speed over nominal speed while slicing; without phases, of the rows that move most.
    ratio = None
    if motion.speed is not None:
        nominal = motion.speed * np.hypot(1.0, motion.draw_ratio or 0.0)
        speed = np.linalg.norm(np.gradient(record.position, record.time, axis=0), axis=1)
        cut = record.phase("slice")
        measured = np.median(speed[cut]) if cut.any() else np.percentile(speed, 75.0)
        ratio = float(measured / nominal)
    far = np.abs(record.position)
    row, axis = np.unravel_index(int(far.argmax()), far.shape)
    is_far = bool(far[row, axis] > REACH)
    is_fast = ratio is not None and THOUSAND[0] < ratio < THOUSAND[1] and not slow_clock
    if is_far or is_fast:
        what = f"{record.position[row, axis]:.4g} m is beyond any arm's reach"
        if not is_far:
            what = f"the knife moves at {ratio:.0f} times the nominal {motion.speed:g} m/s"
        rows = (int(row), int(row)) if is_far else None
        findings.add("millimetres", fmt.POSITION[axis], what, rows)
    slow = ratio is not None and THOUSAND[0] < 1.0 / max(ratio, 1e-12) < THOUSAND[1]
    if slow_clock or (slow and not is_far):
        what = f"the rows are {period:.4g} s apart"
        if slow_clock and rate is not None:
            what += f", expected {1.0 / rate:.4g} s from sensor.rate"
        elif motion.speed is not None and ratio is not None:
            what += f" and the knife moves at {ratio * motion.speed:.2g} m/s"
            what += f", expected {motion.speed:g} m/s from motion.speed"
        findings.add("milliseconds", fmt.TIME, what)


def _check_joints(joints: np.ndarray, findings: Findings) -> None:
    row, axis = np.unravel_index(int(np.abs(joints).argmax()), joints.shape)
    if abs(joints[row, axis]) > JOINT_LIMIT:
        text = f"{joints[row, axis]:.4g} rad is more than one turn"
        findings.add("degrees", fmt.JOINTS[axis], text, (int(row), int(row)))


def _check_jumps(record: SliceRecord, findings: Findings) -> None:
    step = np.diff(record.time)
    speed = np.linalg.norm(np.diff(record.position, axis=0), axis=1) / step
    turn = record.rotation[1:] @ record.rotation[:-1].transpose(0, 2, 1)
    cosine = 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0)
    rate = np.arccos(np.clip(cosine, -1.0, 1.0)) / step
    for name, values, limit, unit in (
        (fmt.POSITION[0], speed, FASTEST, "m/s"),
        (fmt.QUATERNION[0], rate, FASTEST_TURN, "rad/s"),
    ):
        k = int(values.argmax())
        if values[k] > limit:
            text = f"the pose jumps: {values[k]:.3g} {unit} between two rows, expected at most"
            text += f" {limit:g} {unit} ({int((values > limit).sum())} such steps)"
            findings.add("jump", name, text, (k, k + 1))


def _check_upright(record: SliceRecord, findings: Findings) -> None:
    """A knife whose edge points up in most rows of the slice is placed wrongly on the tool."""
    cut = record.cut_rows
    up = np.flatnonzero(cut & (record.rotation[:, 2, 2] >= 0.0))
    if 2 * len(up) > cut.sum():
        text = "the knife is upside down: z of K does not point down while slicing"
        findings.add("upside down", fmt.QUATERNION[0], text, (int(up[0]), int(up[-1])))


def _check_sampling(record: SliceRecord, findings: Findings) -> None:
    step = np.diff(record.time)
    usual = float(np.median(step))
    k = int(step.argmax())
    if step[k] > max(6.0 * usual, 0.02):
        text = f"{step[k]:.3g} s without a row, where rows are {usual:.3g} s apart"
        findings.add("dropout", fmt.TIME, text, (k, k + 1))


def _check_velocities(table: SliceTable, record: SliceRecord, findings: Findings) -> None:
    """Integrals of the velocity columns against the poses: noise of a difference does not count."""
    _, turn_rate = fmt.velocities(record.time, record.position, record.rotation)
    turned = cumulative_trapezoid(turn_rate, record.time, axis=0)
    for names, values, moved, floor, unit in (
        (fmt.VELOCITY, record.velocity, record.position[1:] - record.position[0], 2e-3, "m"),
        (fmt.ANGULAR_VELOCITY, record.angular_velocity, turned, 0.02, "rad"),
    ):
        if not table.has(names):
            continue
        travelled = cumulative_trapezoid(values, record.time, axis=0)
        error = np.linalg.norm(travelled - moved, axis=1)
        k = int(error.argmax())
        span = float(np.ptp(moved, axis=0).max())
        if error[k] > floor + 0.1 * span:
            text = f"the velocities add up to a motion that is {error[k]:.3g} {unit} from the poses"
            text += f" after {record.time[k + 1] - record.time[0]:.3g} s"
            findings.add("velocity", names[0], text)
