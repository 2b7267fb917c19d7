"""Records from other formats: a robot's recording, a force alone, a table in memory.

Each importer takes the facts that the file does not have as a `SliceMetadata`, and returns a
record whose `processing` says what was done. None of them checks the result:
`validation.check_record` does.
"""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.findings import MIN_ROWS
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.records.force_table import find_contact, one_slice, read_force_table
from sliceit_drake.records.metadata import Phase, ProcessingStep, SliceMetadata
from sliceit_drake.records.phases import phases_from_motion
from sliceit_drake.records.preprocessing import MIN_AIR_ROWS, tare
from sliceit_drake.records.slice_record import (
    SliceRecord,
    SliceTable,
    record_from_table,
    velocities,
)
from sliceit_drake.records.spikes import without_spikes
from sliceit_drake.tables import read_columns, read_rows, require_increasing

__all__ = [
    "import_force",
    "import_frame",
    "import_profile",
    "import_ur_rtde",
    "imported_facts",
    "pose_matrix",
]

COMPONENTS = ("norm", "vertical", "components")

THROUGH = 5e-3
"""Way below the board's surface that a knife of a nominal motion may seem to go, m."""
CLEARANCE = 1e-3
"""Height of the edge above the food at the start of a nominal motion, m."""


def pose_matrix(position: list[float], roll_pitch_yaw: list[float]) -> np.ndarray:
    """Pose X_AB [4, 4] from p_AB, m, and roll, pitch, yaw of B about A's fixed axes, rad."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix()
    X[:3, 3] = position
    return X


def import_ur_rtde(
    file: str | Path, metadata: SliceMetadata, X_TK: np.ndarray, X_WB: np.ndarray | None = None
) -> SliceRecord:
    """Reads what ur_rtde's `RTDEReceiveInterface.startFileRecording` wrote.

    The file has `timestamp`, and vectors as columns actual_TCP_pose_0 .. _5 (position and rotation
    vector of the tool frame T in the robot's base B), actual_TCP_speed_0 .. _5 and
    actual_TCP_force_0 .. _5 (force on the tool and torque about To, both in B), actual_q_0 .. _5
    (left out if not recorded). Numbers have six decimals. The library writes at the pace of the
    computer, not of the controller: rows that repeat a time are dropped. Time starts at 0.

    Args:
        metadata: Facts. `wrench.frame` and `wrench.point` do not matter, the format fixes them;
            `wrench.sign` should be on_knife, which the controller reports. Phases, if given, count
            from the first row; if not, they are labelled from the motion where the food is placed.
        X_TK: Pose of the knife in the tool frame that the controller was set to [4, 4].
        X_WB: Pose of the robot's base in W [4, 4]; None if B is W.

    Raises:
        ConfigurationError: If the file cannot be read, or lacks a column.
    """
    vectors = {
        name: [f"actual_{name}_{i}" for i in range(6)]
        for name in ("TCP_pose", "TCP_speed", "TCP_force", "q")
    }
    header = next((cells for _, cells in read_rows(file)), [])
    if any(name not in header for name in vectors["q"]):
        del vectors["q"]
    columns = read_columns(file, ["timestamp", *(name for v in vectors.values() for name in v)])
    stamp = columns["timestamp"]
    fresh = np.concatenate([[True], np.diff(stamp) != 0.0])
    series = {
        name: np.column_stack([columns[column][fresh] for column in names])
        for name, names in vectors.items()
    }
    time = stamp[fresh] - stamp[0]
    X_WB = np.eye(4) if X_WB is None else X_WB
    R_WB = X_WB[:3, :3]
    R_WT = R_WB @ Rotation.from_rotvec(series["TCP_pose"][:, 3:]).as_matrix()
    p_WT = X_WB[:3, 3] + series["TCP_pose"][:, :3] @ R_WB.T
    p_TK_W = R_WT @ X_TK[:3, 3]
    w = series["TCP_speed"][:, 3:] @ R_WB.T
    force = series["TCP_force"][:, :3] @ R_WB.T
    torque = series["TCP_force"][:, 3:] @ R_WB.T - np.cross(p_TK_W, force)
    if metadata.wrench.sign == "by_knife":
        force, torque = -force, -torque
    facts = imported_facts(metadata, file)
    note = "from actual_TCP_force in the base about the tool centre point, to W about Ko"
    numbers = {"start": float(stamp[0]), "repeated_rows": float((~fresh).sum())}
    facts.processing = [ProcessingStep("import_ur_rtde", numbers, note)]
    facts.wrench.sign, facts.wrench.frame, facts.wrench.point = "on_knife", "W", "Ko"
    position = p_WT + p_TK_W
    if not facts.motion.phases:
        facts.motion.phases = phases_from_motion(facts, time, position[:, 2])
    return SliceRecord(
        metadata=facts,
        time=time,
        position=position,
        rotation=R_WT @ X_TK[:3, :3],
        velocity=series["TCP_speed"][:, :3] @ R_WB.T + np.cross(w, p_TK_W),
        angular_velocity=w,
        force=force,
        torque=torque,
        joints=series.get("q"),
        file=str(file),
    )


def import_profile(
    file: str | Path, metadata: SliceMetadata, *, contact: float | None = None
) -> SliceRecord:
    """Reads a force profile that was digitised from a figure (calibration/measured/README.md).

    Rows where no line was drawn are left out. The motion is nominal: see `import_force`.

    Args:
        metadata, contact: As `import_force`.

    Raises:
        ConfigurationError: As `load_force_profile`, and as `import_force`.
    """
    profile = load_force_profile(file)
    read = profile.is_read
    step = ProcessingStep(
        "import_profile",
        {"rows_between_dashes": float((~read).sum())},
        "rows where no dash is drawn are left out; the motion is nominal",
    )
    return _nominal_record(
        file, metadata, step, profile.time[read], {"force_norm": profile.force[read]}, contact
    )


def import_force(
    file: str | Path,
    metadata: SliceMetadata,
    *,
    component: str = "norm",
    contact: float | None = None,
    columns: Sequence[str] = (),
    units: Sequence[str] = (),
    between: Sequence[float] | None = None,
) -> SliceRecord:
    """Reads time and force from a table of any lab (`records.force_table`).

    The motion is nominal: straight down at `motion.speed` (with `motion.draw_ratio` along Fx) from
    1 mm above the food, `food.position` and `food.yaw` taken as 0 where not given. The height is
    thereby known up to a constant, and listed under `unknown`. Without a speed, the knife is taken
    to cross the food from the contact to the last row, and the speed is listed there too. What the
    sensor shows in the air is taken off, but from a norm.

    Args:
        metadata: Facts, `food.size` among them.
        component: "norm" if the force is the norm of the force; "vertical" if it is the vertical
            component, positive upwards for `wrench.sign` on_knife; "components" for all three, in
            `wrench.frame`.
        contact: Time at which the force rises, s, which ends the air phase; None to take the
            phases of `metadata`, or without these to find it.
        columns, units: See `read_force_table`, which also says when times count from the first row:
            `contact`, `between` and the phases of `metadata` then do too.
        between: First and last time of the slice in the file, s.

    Raises:
        ConfigurationError: If the file is not such a table, the component none, a fact is
            missing, or there is no slice or there are several.
    """
    if component not in COMPONENTS:
        raise ConfigurationError(
            f"{component!r} is no component of a force",
            field="component",
            fix=f"Give one of {', '.join(COMPONENTS)}.",
        )
    table = read_force_table(file, columns, units)
    wanted = 3 if component == "components" else 1
    if table.force.shape[1] != wanted:
        raise ConfigurationError(
            f"= {component} goes with {wanted} columns of force, and there are "
            f"{table.force.shape[1]}",
            source=str(file),
            field="--component",
            fix="Give --component components and four --columns, or another component and two.",
        )
    first, last = between or (table.time[0], table.time[-1])
    rows = (table.time >= first) & (table.time <= last)
    time, force = table.time[rows], table.force[rows]
    if rows.sum() < MIN_ROWS:
        raise ConfigurationError(
            f"{first:g} to {last:g} s holds {rows.sum()} rows of the table, which has "
            f"{table.time[0]:g} to {table.time[-1]:g} s",
            source=str(file),
            field="--between",
            fix="Give first and last time of the slice, in seconds of the table"
            + (" after its first row." if table.start else "."),
        )
    # The component that changes most, with its sign; a fault of the cable is no slice.
    clean, _ = without_spikes(force)
    most = clean[:, np.ptp(clean, axis=0).argmax()]
    one_slice(time, most, str(file))
    facts = copy.deepcopy(metadata)
    if contact is None and not facts.motion.phases:
        contact = find_contact(time, most, str(file))
    if facts.motion.speed is None and facts.food.size is not None:
        begins = time[0] if contact is None else contact
        facts.motion.speed = facts.food.size[2] / float(time[-1] - begins)
        facts.unknown = [*(n for n in facts.unknown if n != "motion.speed"), "motion.speed"]
    _check_way(facts, time, contact, str(file))
    if facts.sensor.rate is None and "sensor.rate" not in facts.unknown:
        facts.sensor.rate = float(f"{1.0 / np.median(np.diff(time)):.4g}")
    step = ProcessingStep("import_force", {}, "the motion is nominal")
    if None in table.units:
        step.note += "; the table names no unit of time or of force: s and N are taken"
    if table.start:
        step.numbers["start"] = table.start
    if component == "norm":
        return _nominal_record(file, facts, step, time, {"force_norm": force[:, 0]}, contact)
    if component == "vertical":
        sign = -1.0 if facts.wrench.sign == "by_knife" else 1.0
        known = {"force_vertical": sign * force[:, 0]}
        record = _nominal_record(file, facts, step, time, known, contact)
    else:
        as_given = _nominal_record(file, facts, step, time, {"force": force}, contact).table()
        as_given.metadata.wrench.sign = facts.wrench.sign
        as_given.metadata.wrench.frame = facts.wrench.frame
        record = record_from_table(as_given)
    in_air = record.first_phase("air").sum() >= MIN_AIR_ROWS
    return tare(record) if in_air and facts.wrench.tared != "yes" else record


def import_frame(
    frame: Any, metadata: SliceMetadata, columns: Mapping[str, str] | None = None
) -> SliceRecord:
    """Takes a record from a pandas DataFrame, or anything with columns that have `to_numpy`.

    Args:
        frame: The table; columns that a record does not know are ignored.
        metadata: Facts; the wrench is converted by `wrench` as on reading a file.
        columns: Name in the frame for a column of the record, where they differ, such as
            ``{"time": "t", "force_z": "Fz"}``.

    Returns:
        The record, with `metadata.name` as its file.

    Raises:
        ConfigurationError: If a column that `columns` names is not there or holds no numbers, or
            the record lacks time, pose or force.
    """
    facts = copy.deepcopy(metadata)
    facts.processing = [ProcessingStep("import_frame")]
    table = facts.name or "table"
    there = {str(name): name for name in frame.columns}
    source = {name: name for name in fmt.COLUMNS if name in there} | dict(columns or {})
    values = {}
    for name, other in source.items():
        if name not in fmt.COLUMNS or other not in there:
            wrong, known = (other, there) if name in fmt.COLUMNS else (name, fmt.COLUMNS)
            fix = f"There are: {', '.join(known)}."
            raise ConfigurationError(
                f"there is no column {wrong!r}", source=table, field=name, fix=fix
            )
        try:
            values[name] = np.asarray(frame[there[other]].to_numpy(), float)
        except (TypeError, ValueError) as error:
            fix = "Convert it to floats in SI units."
            raise ConfigurationError(
                f"holds no numbers ({error})", source=table, field=other, fix=fix
            ) from error
    has_force = set(fmt.FORCE) <= set(values) or {fmt.FORCE_NORM, fmt.FORCE_VERTICAL} & set(values)
    for name in (fmt.TIME, *fmt.POSITION, *fmt.QUATERNION, *(() if has_force else fmt.FORCE)):
        if name not in values:
            fix = f'Name it in columns, as {{"{name}": "..."}}. There are: {", ".join(there)}.'
            raise ConfigurationError("the column is missing", source=table, field=name, fix=fix)
    require_increasing(values[fmt.TIME], table, source[fmt.TIME])
    lines = np.arange(2, len(values[fmt.TIME]) + 2)
    return record_from_table(SliceTable(facts, values, table, lines))


def imported_facts(metadata: SliceMetadata, file: str | Path) -> SliceMetadata:
    """A copy of the facts, named after the file if they have no name."""
    facts = copy.deepcopy(metadata)
    facts.name = facts.name or Path(file).stem
    return facts


def _check_way(facts: SliceMetadata, time: np.ndarray, contact: float | None, file: str) -> None:
    """Refuses a nominal knife that goes through the board."""
    if facts.motion.speed is None or facts.food.size is None:
        return
    duration = float(time[-1] - (time[0] if contact is None else contact))
    found = contact is not None or facts.motion.phases
    way, height = facts.motion.speed * duration, facts.food.size[2]
    if way > height + THROUGH:
        raise ConfigurationError(
            f"{facts.motion.speed:.3g} m/s brings the knife {1e3 * way:.0f} mm down in the "
            f"{duration:.3g} s from the {'contact' if found else 'first'} to the last row, and the "
            f"food is {1e3 * height:.0f} mm high",
            source=file,
            field="motion.speed",
            fix=("" if found else "If the knife begins in the air, give --contact S. ")
            + "Correct speed or size; if the knife stops or goes back, end the record there by "
            "--between START END.",
        )


def _nominal_record(
    file: str | Path,
    metadata: SliceMetadata,
    step: ProcessingStep,
    time: np.ndarray,
    force: dict[str, np.ndarray],
    contact: float | None,
) -> SliceRecord:
    """A record whose motion is what the knife was told to do."""
    facts = imported_facts(metadata, file)
    motion, food = facts.motion, facts.food
    if motion.speed is None or food.size is None:
        raise ConfigurationError(
            "is not given, but the motion of the knife is nominal",
            source=facts.name,
            field="motion.speed" if motion.speed is None else "food.size",
            fix="Give the speed of the press, and the extent of the food along Fx, Fy, Fz.",
        )
    require_increasing(time, file, "time")
    facts.processing = [step]
    if food.position is None:
        # The world is the food's: nothing else is placed in it.
        food.position, food.yaw, facts.board_height = [0.0, 0.0, 0.0], 0.0, 0.0
    if "p_WK_z" not in facts.unknown:
        facts.unknown.append("p_WK_z")
    R_WF = Rotation.from_euler("z", food.yaw or 0.0).as_matrix()
    depth = motion.speed * (time - time[0]) - CLEARANCE
    p_FK = np.outer(depth, [motion.draw_ratio or 0.0, 0.0, -1.0]) + [0.0, 0.0, food.size[2]]
    position = np.array(food.position or [0.0, 0.0, 0.0]) + p_FK @ R_WF.T
    # The edge points down, Kx along Fx.
    rotation = np.broadcast_to(R_WF @ np.diag([1.0, -1.0, -1.0]), (len(time), 3, 3)).copy()
    if contact is not None:
        if not time[0] < contact < time[-1]:
            raise ConfigurationError(
                f"{contact:g} s is not within the record, {time[0]:g} to {time[-1]:g} s",
                field="contact",
                fix="Give the time at which the force rises.",
            )
        motion.phases = [
            Phase("air", float(time[0]), contact),
            Phase("slice", contact, float(time[-1])),
        ]
    elif not motion.phases:
        motion.phases = [Phase("slice", float(time[0]), float(time[-1]))]
    facts.wrench.sign, facts.wrench.frame, facts.wrench.point = "on_knife", "W", "Ko"
    v, w = velocities(time, position, rotation)
    return SliceRecord(
        metadata=facts,
        time=time,
        position=position,
        rotation=rotation,
        velocity=v,
        angular_velocity=w,
        file=str(file),
        **force,
    )
