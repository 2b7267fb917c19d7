"""Records from other formats: a robot's recording, a force alone, a table in memory.

Each importer takes the facts that the file does not have as a `SliceMetadata`, and returns a
record whose `processing` says what was done. None of them checks the result:
`validation.check_record` does.
"""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.records.metadata import Phase, ProcessingStep, SliceMetadata
from sliceit_drake.records.phases import phases_from_motion
from sliceit_drake.records.slice_record import (
    SliceRecord,
    SliceTable,
    record_from_table,
    velocities,
)
from sliceit_drake.tables import read_columns, read_rows, require_increasing

__all__ = [
    "import_force",
    "import_frame",
    "import_profile",
    "import_ur_rtde",
    "imported_facts",
    "pose_matrix",
]

COMPONENTS = ("norm", "vertical")

CLEARANCE = 1e-3
"""Height of the edge above the food at the start of a nominal motion, m."""


def pose_matrix(position: list[float], roll_pitch_yaw: list[float]) -> np.ndarray:
    """Pose X_AB [4, 4] from p_AB, m, and roll, pitch, yaw of B about A's fixed axes, rad."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix()
    X[:3, 3] = position
    return X


def import_ur_rtde(
    file: str | Path,
    metadata: SliceMetadata,
    X_TK: np.ndarray,
    X_WB: np.ndarray | None = None,
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
    header = _header(file)
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
) -> SliceRecord:
    """Reads a CSV file with two columns, time in s and force in N, under any names or none.

    The motion is nominal: straight down at `motion.speed` (with `motion.draw_ratio` along Fx) from
    1 mm above the food, `food.position` and `food.yaw` taken as 0 where not given. The height is
    thereby known up to a constant, and listed under `unknown`.

    Args:
        metadata: Facts, `motion.speed` and `food.size` among them.
        component: "norm" if the force is the norm of the force; "vertical" if it is the vertical
            component, positive upwards for `wrench.sign` on_knife.
        contact: Time at which the force rises, s, which ends the air phase; None to take the
            phases of `metadata`.

    Raises:
        ConfigurationError: If the file is not such a table, the component none, or a fact is
            missing.
    """
    if component not in COMPONENTS:
        raise ConfigurationError(
            f"{component!r} is no component of a force",
            field="component",
            fix=f"Give one of {', '.join(COMPONENTS)}.",
        )
    time, force = _two_columns(file)
    step = ProcessingStep("import_force", {}, "the motion is nominal")
    if component == "norm":
        return _nominal_record(file, metadata, step, time, {"force_norm": force}, contact)
    sign = -1.0 if metadata.wrench.sign == "by_knife" else 1.0
    vertical = np.outer(sign * force, [0.0, 0.0, 1.0])
    step.note += "; the horizontal force is not measured"
    return _nominal_record(file, metadata, step, time, {"force": vertical}, contact)


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
    has_force = set(fmt.FORCE) <= set(values) or fmt.FORCE_NORM in values
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


def _header(file: str | Path) -> list[str]:
    rows = read_rows(file)
    return rows[0][1] if rows else []


def _two_columns(file: str | Path) -> tuple[np.ndarray, np.ndarray]:
    header = _header(file)
    if len(header) != 2:
        raise ConfigurationError(
            f"the first row has {len(header)} cells",
            source=f"{file}, line 1",
            fix="Give two columns, time in s and force in N, separated by a comma.",
        )
    try:
        float(header[0])
    except ValueError:
        columns = read_columns(file, header)
        return columns[header[0]], columns[header[1]]
    try:
        table = np.loadtxt(file, delimiter=",", ndmin=2, encoding="utf-8")
    except ValueError as error:
        raise ConfigurationError(
            f"the table holds something else than numbers ({error})",
            source=str(file),
            fix="Give two columns, time in s and force in N, separated by a comma.",
        ) from error
    return table[:, 0], table[:, 1]


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
    facts.wrench.sign, facts.wrench.frame, facts.wrench.point = "on_knife", "W", "Ko"
    v, w = velocities(time, position, rotation)
    return SliceRecord(
        metadata=facts,
        time=time,
        position=position,
        rotation=rotation,
        velocity=v,
        angular_velocity=w,
        force=force.get("force"),
        force_norm=force.get("force_norm"),
        file=str(file),
    )
