"""Records from ROS bags: ROS 1 .bag, ROS 2 folders, .db3 and .mcap, through the library rosbags.

The force comes from a topic of WrenchStamped, the motion from one of PoseStamped, TransformStamped
or JointState. ROS is in SI units, as records are. No ROS is needed.
"""

import dataclasses as dc
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.importers import imported_facts
from sliceit_drake.records.metadata import ProcessingStep, SliceMetadata
from sliceit_drake.records.phases import phases_from_motion
from sliceit_drake.records.slice_record import SliceRecord, SliceTable, record_from_table
from sliceit_drake.tables import interpolated

__all__ = ["import_rosbag"]

WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
JOINTS = "sensor_msgs/msg/JointState"
MOTIONS = (POSE, TRANSFORM, JOINTS)

JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Joints in Universal Robots' descriptions, from the base on; a prefix may stand before each."""
FLANGE = "tool0"
"""The frame whose pose follows from the joints."""
CLOCKS = ("header", "received")

LARGEST_GAP = 0.1
"""Time without a message over which a motion or a force is not interpolated, s."""
Forward = Callable[[Sequence[float]], Sequence[float]]

Wrong = Callable[..., ConfigurationError]
"""Makes errors that name the file."""


def import_rosbag(
    file: str | Path,
    metadata: SliceMetadata,
    wrench: str,
    motion: str,
    X_TK: np.ndarray,
    X_WB: np.ndarray | None = None,
    *,
    forward: Forward | None = None,
    tool_frame: str | None = None,
    between: tuple[float, float] | None = None,
    clock: str = "header",
) -> SliceRecord:
    """Reads one slice from a bag.

    Rows are those of the wrench, which is thereby not interpolated; the poses between two messages
    of the motion follow linearly and by the shortest turn. Only times that both topics cover are
    kept. Messages with the stamp of the one before are dropped.

    A wrench in the tool frame T, or in the base's axes (the frame that poses are in), is converted
    from there. For any other frame `metadata` says what it is: `wrench.frame` and `.point`,
    `sensor.position` and `.rotation`.

    Args:
        file: A .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.
        metadata: Facts; `wrench.sign` among them. Phases, if given, count from the first row; if
            not, they are labelled from the motion where the food is placed.
        wrench, motion: Topics.
        X_TK: Pose of the knife in the frame T of the motion [4, 4]; with joints the flange, tool0.
        X_WB: Pose of the frame that poses are in, in W [4, 4]; with joints that is Universal
            Robots' "base", which is turned by pi about z against "base_link". None if it is W.
        forward: Pose of the flange in the base from six joint angles, rad: the columns of its
            rotation one after the other, and its position, m [12]. Needed for joints alone.
        tool_frame: Name of T, where the motion's messages do not say it.
        between: Begin and end of the slice in the bag, s from its first wrench; None for all.
        clock: "header" for the messages' stamps, "received" for the times at which they were
            recorded, which have the network's delay in them.

    Raises:
        ConfigurationError: The file is no bag, the clock none; a topic is missing, of another type
            or has a gap; the frames do not fit together.
    """
    if clock not in CLOCKS:
        raise ConfigurationError(
            f"{clock!r} is no clock", field="--clock", fix=f"Give one of {', '.join(CLOCKS)}."
        )
    wrong = functools.partial(ConfigurationError, source=str(file))
    series = _read(Path(file), wrench, motion, clock, wrong)
    force, moving = series[wrench], series[motion]
    if between is not None:
        force = force.between(*between)
        moving = moving.between(between[0] - LARGEST_GAP, between[1] + LARGEST_GAP)
    for part, topic in ((force, wrench), (moving, motion)):
        _check_gaps(part, topic, wrong)
    kept = (force.time >= moving.time[0]) & (force.time <= moving.time[-1])
    if kept.sum() < 2:
        raise wrong(
            f"{wrench} runs from {force.time[0]:.3f} to {force.time[-1]:.3f} s, {motion} from "
            f"{moving.time[0]:.3f} to {moving.time[-1]:.3f} s",
            fix="Both must cover the slice, on one clock; --clock received ignores their stamps.",
        )
    time, values = force.time[kept], force.values[kept]
    joints, R_BT, p_BT = _poses(moving, time, forward, wrong, motion)
    X_WB = np.eye(4) if X_WB is None else X_WB
    R_WB = X_WB[:3, :3]
    R_WT, p_WT = R_WB @ R_BT, X_WB[:3, 3] + p_BT @ R_WB.T
    R_WK, p_TK_W = R_WT @ X_TK[:3, :3], R_WT @ X_TK[:3, 3]
    facts = imported_facts(metadata, file)
    names = (tool_frame or moving.child, moving.frame)
    placed = _place_wrench(facts, force.frame, names, values, R_WT, R_WB, p_TK_W, wrong)
    facts.processing = [
        ProcessingStep(
            "import_rosbag",
            {
                "start": 1e-9 * force.origin + float(time[0]),
                "repeated_stamps": float(force.repeated + moving.repeated),
            },
            f"{wrench} in {force.frame!r}, {motion} interpolated from a mean interval of "
            f"{1e3 * np.diff(moving.time).mean():.3g} ms",
        )
    ]
    position = p_WT + p_TK_W
    time = time - time[0]
    if not facts.motion.phases:
        facts.motion.phases = phases_from_motion(facts, time, position[:, 2])
    quaternion = Rotation.from_matrix(R_WK).as_quat(scalar_first=True)
    columns = {fmt.TIME: time} | fmt.columns_of(
        {
            fmt.POSITION: position,
            fmt.QUATERNION: quaternion,
            fmt.FORCE: placed[:, :3],
            fmt.TORQUE: placed[:, 3:],
            fmt.JOINTS: joints,
        }
    )
    lines = np.arange(2, len(time) + 2)
    return record_from_table(SliceTable(facts, columns, str(file), lines))


@dc.dataclass
class _Series:
    """Messages of a topic.

    Attributes:
        kind: Type of the messages.
        origin: Origin of the time, ns; for both topics that of the first wrench.
        time: Increasing times [n], s.
        values: Force and torque [n, 6]; position and quaternion, w last [n, 7]; joints [n, 6].
        frame: header.frame_id of all.
        child: child_frame_id, or the flange for joints; None if there is none.
        repeated: Messages that were dropped.
    """

    kind: str
    origin: int
    time: np.ndarray
    values: np.ndarray
    frame: str
    child: str | None
    repeated: int

    def between(self, begin: float, end: float) -> "_Series":
        # Stamps are whole nanoseconds.
        kept = (self.time >= begin - 1e-9) & (self.time <= end + 1e-9)
        return dc.replace(self, time=self.time[kept], values=self.values[kept])


def _read(file: Path, wrench: str, motion: str, clock: str, wrong: Wrong) -> dict[str, _Series]:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    if not file.exists():
        raise wrong("there is no such file", fix="Check the path.")
    found: dict[str, _Series] = {}
    try:
        # Bags of early ROS 2 do not say what their types are.
        with AnyReader([file], default_typestore=get_typestore(Stores.LATEST)) as bag:
            there = {c.topic: c for c in bag.connections}
            for topic, kinds in ((wrench, (WRENCH,)), (motion, MOTIONS)):
                if topic not in there or there[topic].msgtype not in kinds:
                    raise _no_topic(wrong, topic, kinds, there)
                kind = there[topic].msgtype
                rows = [
                    (received, bag.deserialize(raw, kind))
                    for connection, received, raw in bag.messages([there[topic]])
                ]
                origin = found[wrench].origin if found else None
                found[topic] = _series(rows, kind, clock, origin, wrong, topic)
    except AnyReaderError as error:
        raise wrong(
            f"cannot be read as a bag ({error})",
            fix="Give a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.",
        ) from error
    return found


def _no_topic(
    wrong: Wrong, topic: str, kinds: Sequence[str], there: dict[str, Any]
) -> ConfigurationError:
    listed = ", ".join(
        f"{name} ({c.msgtype.split('/')[-1]}, {c.msgcount} messages)"
        for name, c in sorted(there.items())
    )
    wanted = " or ".join(_short(kinds))
    problem = f"there is no topic {topic!r}"
    if topic in there:
        problem = f"{topic} is of {there[topic].msgtype.split('/')[-1]}, not {wanted}"
    return wrong(
        problem,
        field="--topics",
        fix=f"Give the topics of a WrenchStamped and of a {' or '.join(_short(MOTIONS))}. "
        f"There are: {listed or 'none'}.",
    )


def _short(kinds: Sequence[str]) -> list[str]:
    return [kind.split("/")[-1] for kind in kinds]


def _series(
    rows: list[tuple[int, Any]], kind: str, clock: str, origin: int | None, wrong: Wrong, topic: str
) -> _Series:
    """A topic's messages as arrays."""
    if len(rows) < 2:
        raise wrong(f"{topic} has {len(rows)} messages", fix="Give a longer bag.")
    frames = {m.header.frame_id for _, m in rows}
    children = {m.child_frame_id for _, m in rows} if kind == TRANSFORM else {None}
    if len(frames) > 1 or len(children) > 1:
        names = ", ".join(repr(name) for name in sorted(map(str, frames | children - {None})))
        raise wrong(
            f"{topic} has messages in different frames: {names}",
            fix="Record a topic that keeps to one frame, and one of one tool.",
        )
    if clock == "header":
        stamps = [10**9 * m.header.stamp.sec + m.header.stamp.nanosec for _, m in rows]
        if not any(stamps):
            raise wrong(
                f"the messages of {topic} have no stamps",
                field="--clock",
                fix="Give --clock received, if the delays of the network do not matter.",
            )
    else:
        stamps = [received for received, _ in rows]
    origin = stamps[0] if origin is None else origin
    time = 1e-9 * (np.array(stamps, np.int64) - origin)
    step = np.diff(time)
    if (step < 0.0).any():
        k = int(np.argmax(step < 0.0))
        raise wrong(
            f"the time of {topic} goes back by {-step[k]:.3g} s, {time[k] - time[0]:.3f} s after "
            "its first message",
            fix="The clock was set, or two nodes publish it: record again, or try --clock received",
        )
    fresh = np.concatenate([[True], step > 0.0])
    values = _values([m for _, m in rows], kind, wrong, topic)
    child = FLANGE if kind == JOINTS else next(iter(children))
    return _Series(
        kind, origin, time[fresh], values[fresh], next(iter(frames)), child, int((~fresh).sum())
    )


def _values(messages: list[Any], kind: str, wrong: Wrong, topic: str) -> np.ndarray:
    if kind == JOINTS:
        return np.array([_joints(m, wrong, topic) for m in messages])
    if kind == WRENCH:
        parts = [(m.wrench.force, m.wrench.torque) for m in messages]
        return np.array([[v for p in pair for v in (p.x, p.y, p.z)] for pair in parts])
    if kind == POSE:
        poses = [(m.pose.position, m.pose.orientation) for m in messages]
    else:
        poses = [(m.transform.translation, m.transform.rotation) for m in messages]
    return np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w] for p, q in poses])


def _joints(message: Any, wrong: Wrong, topic: str) -> list[float]:
    """Angles from the base on; a message has them in any order, drivers in that of the alphabet."""
    angles = []
    for name in JOINT_NAMES:
        places = [k for k, given in enumerate(message.name) if given.endswith(name)]
        if len(places) != 1:
            raise wrong(
                f"{topic} names {len(places)} joints {name}: {', '.join(message.name)}",
                fix="Record the joint states of one UR5e alone, or a topic of its tool's pose.",
            )
        angles.append(float(message.position[places[0]]))
    return angles


def _check_gaps(part: _Series, topic: str, wrong: Wrong) -> None:
    if len(part.time) < 2:
        raise wrong(
            f"{topic} has no messages there",
            field="--between",
            fix="Give seconds from the first wrench.",
        )
    step = np.diff(part.time)
    k = int(step.argmax())
    if step[k] > LARGEST_GAP:
        raise wrong(
            f"{topic} has no message for {step[k]:.3g} s, from {part.time[k]:.3f} to "
            f"{part.time[k + 1]:.3f} s after the first wrench",
            field="--between",
            fix=f"Give a part without a gap longer than {LARGEST_GAP:g} s, or record again.",
        )


def _poses(
    moving: _Series, time: np.ndarray, forward: Forward | None, wrong: Wrong, topic: str
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
    """Joints [n, 6] or None, R_BT [n, 3, 3] and p_BT [n, 3] at times."""
    if moving.kind == JOINTS:
        if forward is None:
            raise wrong(f"{topic} has joint angles, for which no kinematics is given")
        joints = interpolated(time, moving.time, moving.values)
        rows = np.array([forward(q) for q in joints.tolist()])
        return joints, rows[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1), rows[:, 9:]
    length = np.linalg.norm(moving.values[:, 3:], axis=1)
    if (np.abs(length - 1.0) > 1e-3).any():
        raise wrong(
            f"{topic} has quaternions whose length is not 1, as {length[0]:.3g}",
            fix="Its publisher leaves the orientation out; record one that has it.",
        )
    p = interpolated(time, moving.time, moving.values[:, :3])
    turn = Slerp(moving.time, Rotation.from_quat(moving.values[:, 3:]))
    return None, turn(time).as_matrix(), p


def _place_wrench(
    facts: SliceMetadata,
    frame: str,
    names: tuple[str | None, str],
    values: np.ndarray,
    R_WT: np.ndarray,
    R_WB: np.ndarray,
    p_TK_W: np.ndarray,
    wrong: Wrong,
) -> np.ndarray:
    """The wrench [n, 6] in the axes and about the point that `facts.wrench` says afterwards."""
    tool, base = names
    force, torque = values[:, :3], values[:, 3:]
    stated = frame.removeprefix("/")
    if tool is not None and stated == tool.removeprefix("/"):
        facts.wrench.frame, facts.wrench.point = "W", "Ko"
        force, torque = (np.einsum("nij,nj->ni", R_WT, v) for v in (force, torque))
        return np.hstack([force, torque - np.cross(p_TK_W, force)])
    if facts.wrench.frame != "W":
        return values
    if base and stated == base.removeprefix("/"):
        return np.hstack([force @ R_WB.T, torque @ R_WB.T])
    moving = repr(tool) if tool else "a frame without a name"
    raise wrong(
        f"the wrench is in the frame {frame!r}, the motion is that of {moving} in {base!r}",
        field="--tool-frame",
        fix=f"Give --tool-frame {frame or 'NAME'} if the wrench is in the frame that moves; if it "
        "is in the sensor's, give wrench.frame: S, wrench.point: So, sensor.position and "
        "sensor.rotation in --metadata.",
    )
