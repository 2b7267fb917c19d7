"""Moves the joints straight to the start of a run, watched, and never faster than the limits."""

import time as clock

import numpy as np

from sliceit_drake.diagrams.hardware_station import make_clearance, make_edge_kinematics
from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.client import RobotUnavailableError
from sliceit_drake.hardware.readings import ReadingCheck
from sliceit_drake.hardware.safety import robot_fault
from sliceit_drake.interruption import raise_if_interrupted
from sliceit_drake.robot_run.hardware_run import HardwareRun

__all__ = ["MoveToStart"]

SPEED = 0.3
"""Greatest speed of the fastest joint, rad/s."""
ACCELERATION = 0.5
"""Acceleration of the fastest joint, rad/s2."""
SAMPLES = 200
WATCHDOG = 10.0
"""Inputs a second below which the controller stops the motion, Hz."""
POLL = 5e-3
NO_DATA = 0.1
"""Controller time without data after which the motion is stopped, s."""
SETTLING = 2.0
AT_REST = 1e-3
ARRIVED = 1e-3
"""Distance of each joint from the start, rad: less than a short motion begins with."""


class MoveToStart:
    """The way from where the arm is to the start of a run: a line in joint space.

    Looked for are board, table and holder as the scenario has them, and the arm itself: nothing
    else. The edge may not go below the board, nor lower than it is at the beginning, if that is
    below it already.

    Args:
        hardware: Whose robot, start and limits are used.

    Attributes:
        begin: Where the arm is.
        speed: Speed of the fastest joint, rad/s.
        knife_speed: Speed of the faster end of the edge then, m/s.
        lowest: Least height of the edge on the way, m.
        floor: Least height that is allowed, m.
    """

    def __init__(self, hardware: HardwareRun) -> None:
        self.hardware, self.begin = hardware, hardware.client.read()
        limits = hardware.config.limits
        kinematics = make_edge_kinematics(hardware.twin)
        q = np.array(self.begin.q)
        turn = self._turn = hardware.twin.start_joints - q
        shares = np.linspace(0.0, 1.0, SAMPLES)
        ends = np.array([kinematics.edge((q + s * turn).tolist())[:2] for s in shares])
        self.lowest = float(ends[:, :, 2].min())
        board = hardware.scenario.board.height
        self.floor = min(board - limits.board_depth, float(ends[0, :, 2].min()) - 1e-4)
        # Way of the knife's faster end for each radian of the fastest joint.
        way = np.linalg.norm(np.diff(ends, axis=0), axis=2).max() * (SAMPLES - 1)
        largest = float(np.abs(turn).max())
        ratio = float(way) / largest if largest > 0.0 else 0.0
        self.speed = min(SPEED, *limits.joint_speed)
        if ratio > 0.0:
            self.speed = min(self.speed, limits.knife_speed / ratio)
        self.knife_speed = ratio * self.speed

    def checks(self) -> list[Check]:
        """What must be true of the way."""
        hardware, limits = self.hardware, self.hardware.config.limits
        board = hardware.scenario.board.height
        q, end = np.array(self.begin.q), np.array(hardware.twin.start_joints)
        room = min(
            float(np.min([np.array(limits.joint_upper) - x, x - np.array(limits.joint_lower)]))
            for x in (q, end)
        )
        turn = self._turn
        clearance, near = make_clearance(hardware.twin), None
        # Where it is nearer already, as on a board that lies lower, it may go away.
        begin = clearance.nearest(q.tolist(), limits.clearance)
        least = limits.clearance if begin is None else begin[0] - 1e-4
        for share in np.linspace(0.0, 1.0, SAMPLES):
            near = near or clearance.nearest((q + share * turn).tolist(), least)
        return [
            Check(
                "clearance on the way",
                near is None,
                f"at least {1e3 * least:g} mm"
                if near is None
                else f"{near[1]} {1e3 * near[0]:.1f} mm apart, wanted {1e3 * least:g}",
                "Move the arm to the start, or over it, by hand.",
            ),
            Check(
                "way to the start",
                self.lowest >= self.floor,
                f"edge down to {1e3 * (self.lowest - board):+.1f} mm over the board, knife up to "
                f"{1e3 * self.knife_speed:.0f} mm/s",
                "Move the arm to the start, or over it, by hand.",
            ),
            Check(
                "joints on the way",
                room >= 0.0 and bool((np.abs(turn) < np.pi).all()),
                f"turn by {np.abs(turn).max():.3f} rad, allowed {np.pi:.3f}; {room:.3f} rad from a "
                "limit",
                "Turn them back by hand, and look at the cables.",
            ),
        ]

    def execute(self) -> str | None:
        """Moves, with the controller's watchdog set, and stops the robot's program at the end.

        It stops at the first fault of robot or link, at the limit of force, and when the caller is
        interrupted.

        Returns:
            Why the arm is not at the start; None if it is.

        Raises:
            RobotUnavailableError: The robot does not say that it has stopped.
        """
        client, hardware = self.hardware.client, self.hardware
        try:
            if not client.set_watchdog(WATCHDOG):
                return "the controller did not accept the watchdog"
            now = client.read().q
            if max(abs(a - b) for a, b in zip(now, self.begin.q, strict=True)) > 1e-2:
                return "somebody has moved the arm since the way was checked"
            start = hardware.twin.start_joints.tolist()
            if not client.start_move(start, self.speed, ACCELERATION):
                return "the robot did not take the motion"
            return self._watch(start)
        finally:
            try:
                client.stop()
            except RuntimeError as error:
                raise RobotUnavailableError(
                    f"The robot did not confirm that its program is stopped ({error}). Use the "
                    "emergency stop before you go near it."
                ) from error

    def _watch(self, start: list[float]) -> str | None:
        """Follows the motion; why it has to be stopped, or None when it is done."""
        hardware, client, pace = self.hardware, self.hardware.client, self.hardware.pace
        limits = hardware.config.limits
        duration = float(np.abs(self._turn).max()) / self.speed + self.speed / ACCELERATION
        deadline = clock.perf_counter() + (1.5 * duration + SETTLING) / pace
        state, arrival = client.read(), clock.perf_counter()
        # The same readings are believed as in a run.
        kinematics, floor = make_edge_kinematics(hardware.twin), self.floor - limits.measured_margin
        readings = ReadingCheck(limits, kinematics, None, state)
        while True:
            raise_if_interrupted()
            client.kick()
            newer, now = client.read(), clock.perf_counter()
            doubt = None
            if newer.time != state.time:
                state, arrival = newer, now
                doubt = readings.doubt(state)
            if now - arrival > NO_DATA / pace or not client.is_connected():
                return "no data from the robot"
            fault = robot_fault(state)
            if fault is not None:
                return str(fault)
            force = float(np.linalg.norm(state.wrench[:3]))
            if not force <= limits.force:
                return f"the tool meets a force: {force:.3g} N, allowed {limits.force:g}"
            torque = float(np.linalg.norm(state.wrench[3:]))
            if not torque <= limits.torque:
                return f"the tool meets a torque: {torque:.3g} Nm, allowed {limits.torque:g}"
            if doubt is not None:
                return f"{doubt.limit}: {doubt.detail}"
            most = limits.measured_speed * self.speed + AT_REST
            # Written so that a NaN fails, as above.
            if not all(abs(speed) <= most for speed in state.qd):
                return f"a joint moves faster than {most:.3g} rad/s: {state.qd}"
            heel, tip, _ = kinematics.edge(state.q)
            lowest = min(heel[2], tip[2])
            if not lowest >= floor:
                return f"the edge is {1e3 * (floor - lowest):.1f} mm too low"
            off = max(abs(a - b) for a, b in zip(state.q, start, strict=True))
            if off < ARRIVED and max(map(abs, state.qd)) < AT_REST:
                return None
            if now > deadline:
                return f"it takes too long; a joint is {off:.3f} rad off the start"
            clock.sleep(POLL)
