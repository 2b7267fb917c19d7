"""Records from ROS bags that the same library wrote: all formats, frames and what is refused."""

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
from example_slices import example_slice, wrist_motion
from scipy.spatial.transform import Rotation

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.emulator.kinematics import forward
from sliceit_drake.hardware.edge_kinematics import flange_pose
from sliceit_drake.records.importers import pose_matrix
from sliceit_drake.records.rosbag import import_rosbag
from sliceit_drake.records.slice_record import SliceRecord, velocities
from sliceit_drake.records.validation import load_record

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

X_TK = pose_matrix([0.01, -0.02, 0.15], [0.1, -0.3, 0.4])
X_WB = pose_matrix([0.5, -0.4, 0.02], [0.0, 0.0, 2.1])
BEGIN = 1_700_000_000_123_456_789
KINDS = ("PoseStamped", "TransformStamped", "JointState")


def swung_slice() -> SliceRecord:
    record = example_slice().between(0.0, 1.0)
    p, R, v, w = wrist_motion(record.time)
    torque = np.cross([0.02, 0.01, 0.0], record.force)
    return dc.replace(record, position=p, rotation=R, velocity=v, angular_velocity=w, torque=torque)


def jointed_slice() -> tuple[SliceRecord, np.ndarray]:
    """A slice of a UR5e that moves all joints, and these [n, 6]."""
    record = example_slice().between(0.0, 1.0)
    q = np.array([0.3, -1.2, 1.6, -1.9, -1.5, 0.4]) + np.outer(
        0.2 * np.sin(2.0 * record.time), [1.0, 0.5, -0.8, 0.6, -0.4, 1.0]
    )
    X = X_WB @ np.array([forward(row) for row in q]) @ X_TK
    v, w = velocities(record.time, X[:, :3, 3], X[:, :3, :3])
    moved = dc.replace(record, position=X[:, :3, 3], rotation=X[:, :3, :3], velocity=v)
    return dc.replace(moved, angular_velocity=w, torque=np.zeros((len(q), 3))), q


class Messages:
    """Makes a slice's messages: what a driver publishes of a robot with X_TK and X_WB."""

    def __init__(self, record: SliceRecord, store: Stores, joints: np.ndarray | None = None):
        self.types = get_typestore(store)
        self.record, self.joints, self.is1 = record, joints, store == Stores.ROS1_NOETIC
        X_WK = np.tile(np.eye(4), (len(record), 1, 1))
        X_WK[:, :3, :3], X_WK[:, :3, 3] = record.rotation, record.position
        self.X_BT = np.linalg.inv(X_WB) @ X_WK @ np.linalg.inv(X_TK)

    def _make(self, name: str, *fields):
        return self.types.types[name](*fields)

    def header(self, k: int, frame: str):
        stamp = BEGIN + round(1e9 * self.record.time[k])
        time = self._make("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        first = (k,) if self.is1 else ()
        return self._make("std_msgs/msg/Header", *first, time, frame)

    def vector(self, values, name: str = "Vector3"):
        return self._make(f"geometry_msgs/msg/{name}", *map(float, values))

    def wrench(self, k: int, frame: str):
        """In the frame of the tool or in the base's axes about Ko."""
        force, torque = self.record.force[k], self.record.torque[k]
        if frame == "tool0":
            R_WT = X_WB[:3, :3] @ self.X_BT[k, :3, :3]
            torque = torque + np.cross(R_WT @ X_TK[:3, 3], force)
            force, torque = force @ R_WT, torque @ R_WT
        else:
            force, torque = force @ X_WB[:3, :3], torque @ X_WB[:3, :3]
        both = self._make("geometry_msgs/msg/Wrench", self.vector(force), self.vector(torque))
        return self._make("geometry_msgs/msg/WrenchStamped", self.header(k, frame), both)

    def motion(self, k: int, kind: str):
        if kind == "JointState":
            order = [2, 1, 0, 3, 4, 5]  # The alphabet's, as drivers have it.
            names = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
            given = [f"ur_{names[i]}_joint" for i in order]
            none = np.zeros(0)
            fields = (self.header(k, ""), given, self.joints[k][order], none, none)
            return self._make("sensor_msgs/msg/JointState", *fields)
        turn = Rotation.from_matrix(self.X_BT[k, :3, :3]).as_quat()
        turn = self.vector(turn if k % 2 else -turn, "Quaternion")  # Both are the same turn.
        p, header = self.X_BT[k, :3, 3], self.header(k, "base")
        if kind == "PoseStamped":
            pose = self._make("geometry_msgs/msg/Pose", self.vector(p, "Point"), turn)
            return self._make("geometry_msgs/msg/PoseStamped", header, pose)
        transform = self._make("geometry_msgs/msg/Transform", self.vector(p), turn)
        return self._make("geometry_msgs/msg/TransformStamped", header, "tool0", transform)


def write_bag(
    file: Path,
    messages: Messages,
    kind: str,
    frame: str = "tool0",
    left_out: tuple[float, float] = (9.0, 9.0),
    spoil=lambda k, message: message,
) -> Path:
    """Writes a wrench at 500 Hz and a motion at 125 Hz, in the format that the name tells."""
    if messages.is1:
        writer, encode = Writer1(file), messages.types.serialize_ros1
        folder = file
    else:
        plugin = StoragePlugin.MCAP if file.suffix == ".mcap" else StoragePlugin.SQLITE3
        folder = file.with_suffix("")
        writer = Writer2(folder, version=9, storage_plugin=plugin)
        encode = messages.types.serialize_cdr
    with writer as bag:

        def connect(topic: str, sort: str):
            return bag.add_connection(topic, sort, typestore=messages.types), sort

        group = "sensor" if kind == "JointState" else "geometry"
        force, force_type = connect("/wrench", "geometry_msgs/msg/WrenchStamped")
        motion, motion_type = connect("/motion", f"{group}_msgs/msg/{kind}")
        for k, t in enumerate(messages.record.time):
            received = BEGIN + round(1e9 * t) + 3_000_000
            if k % 4 == 0 and not left_out[0] < t < left_out[1]:
                message = spoil(k, messages.motion(k, kind))
                bag.write(motion, received, encode(message, motion_type))
            # Some come twice.
            for _ in range(2 if k % 50 == 7 else 1):
                bag.write(force, received, encode(messages.wrench(k, frame), force_type))
    return folder


def assert_same(record: SliceRecord, truth: SliceRecord, rows: slice, torque: bool = True) -> None:
    # A motion of up to 1.3 m/s2 and 5.4 rad/s2, known each 8 ms.
    np.testing.assert_allclose(record.time, truth.time[rows] - truth.time[rows][0], atol=1e-9)
    np.testing.assert_allclose(record.position, truth.position[rows], atol=3e-5)
    np.testing.assert_allclose(record.rotation, truth.rotation[rows], atol=1e-4)
    np.testing.assert_allclose(record.velocity[2:-2], truth.velocity[rows][2:-2], atol=0.02)
    np.testing.assert_allclose(record.force, truth.force[rows], atol=3e-3)
    if torque:
        np.testing.assert_allclose(record.torque, truth.torque[rows], atol=1e-3)


@pytest.mark.parametrize(
    ("name", "store", "kind", "frame"),
    [
        ("a.bag", Stores.ROS1_NOETIC, "TransformStamped", "tool0"),
        ("a.mcap", Stores.ROS2_HUMBLE, "PoseStamped", "base"),
        ("a.db3", Stores.ROS2_JAZZY, "JointState", "tool0"),
    ],
)
def test_a_bag_has_the_knife_and_its_wrench_in_the_world(tmp_path, name, store, kind, frame):
    truth, joints = jointed_slice() if kind == "JointState" else (swung_slice(), None)
    bag = write_bag(tmp_path / name, Messages(truth, store, joints), kind, frame)
    record = import_rosbag(
        bag, truth.metadata, "/wrench", "/motion", X_TK, X_WB, forward=flange_pose
    )
    assert_same(record, truth, slice(0, len(record)))
    # The motion's last message is 3 rows before the wrench's.
    assert len(record) == len(truth) - (len(truth) - 1) % 4
    (step,) = record.metadata.processing
    assert step.numbers["repeated_stamps"] == 10 and "8 ms" in step.note
    assert step.numbers["start"] == pytest.approx(1e-9 * BEGIN, abs=1e-6)
    if joints is not None:
        np.testing.assert_allclose(record.joints, joints[: len(record)], atol=1e-4)


def test_a_wrench_in_the_sensors_frame_is_placed_by_the_facts(tmp_path):
    truth = swung_slice()
    bag = write_bag(tmp_path / "a.mcap", Messages(truth, Stores.ROS2_HUMBLE), "PoseStamped")
    facts = truth.metadata
    X_KT = np.linalg.inv(X_TK)
    facts.wrench.frame, facts.wrench.point, facts.wrench.sign = "S", "So", "by_knife"
    facts.sensor.position = X_KT[:3, 3].tolist()
    facts.sensor.rotation = Rotation.from_matrix(X_KT[:3, :3]).as_euler("xyz").tolist()
    record = import_rosbag(bag, facts, "/wrench", "/motion", X_TK, X_WB)
    np.testing.assert_allclose(record.force, -truth.force[: len(record)], atol=3e-3)
    np.testing.assert_allclose(record.torque, -truth.torque[: len(record)], atol=1e-3)
    facts.wrench.frame = "W"
    with pytest.raises(ConfigurationError, match="'tool0'.*without a name in 'base'") as error:
        import_rosbag(bag, facts, "/wrench", "/motion", X_TK, X_WB)
    assert "--tool-frame tool0" in error.value.fix
    record = import_rosbag(bag, facts, "/wrench", "/motion", X_TK, X_WB, tool_frame="tool0")
    np.testing.assert_allclose(record.force, -truth.force[: len(record)], atol=3e-3)


def test_the_command_cuts_a_slice_out_of_a_bag(tmp_path, capsys):
    truth = swung_slice()
    bag = write_bag(tmp_path / "a.mcap", Messages(truth, Stores.ROS2_HUMBLE), "TransformStamped")
    (file,) = bag.glob("*.mcap")
    dump_yaml(truth.metadata, tmp_path / "facts.yaml")
    pose = [str(v) for v in (0.01, -0.02, 0.15, 0.1, -0.3, 0.4)]
    base = [str(v) for v in (0.5, -0.4, 0.02, 0.0, 0.0, 2.1)]
    command = ["records", "import", "rosbag", str(file), "--metadata", str(tmp_path / "facts.yaml")]
    command += ["--tcp-to-knife", *pose, "--world-to-base", *base, "--output", str(tmp_path)]
    assert main([*command, "--topics", "/wrench", "/tcp"]) == 2
    said = capsys.readouterr().err
    assert "no topic '/tcp'" in said and "/motion (TransformStamped, 126 messages)" in said
    assert main([*command, "--topics", "/motion", "/motion"]) == 2
    assert "/motion is of TransformStamped, not WrenchStamped" in capsys.readouterr().err
    assert main(command) == 2
    assert "--topics: is not given" in capsys.readouterr().err
    part = ["--between", "0.2", "0.6", "--name", "part", "--clock", "received"]
    main([*command, "--topics", "/wrench", "/motion", *part])
    assert "201 rows, 0.4 s" in capsys.readouterr().out
    assert_same(load_record(tmp_path / "part.csv"), truth, slice(100, 301))


def test_a_gap_in_time_is_named_and_not_bridged(tmp_path):
    truth = swung_slice()
    messages = Messages(truth, Stores.ROS2_HUMBLE)
    bag = write_bag(tmp_path / "a.mcap", messages, "TransformStamped", left_out=(0.401, 0.599))
    with pytest.raises(ConfigurationError, match="/motion has no message for 0.2 s, from 0.400 to"):
        import_rosbag(bag, truth.metadata, "/wrench", "/motion", X_TK, X_WB)
    record = import_rosbag(
        bag, truth.metadata, "/wrench", "/motion", X_TK, X_WB, between=(0.0, 0.3)
    )
    assert_same(record, truth, slice(0, 151))


def test_what_spoils_a_bag_is_named(tmp_path):
    truth = swung_slice()
    messages = Messages(truth, Stores.ROS2_HUMBLE)

    def other_frame(k, message):
        if k == 200:
            message.header.frame_id = "camera"
        return message

    def backwards(k, message):
        if k == 200:
            message.header.stamp.sec -= 1
        return message

    def unstamped(k, message):
        message.header.stamp.sec = message.header.stamp.nanosec = 0
        return message

    def no_turn(k, message):
        message.transform.rotation.w = 0.0
        return message

    for k, (spoil, said) in enumerate(
        [
            (other_frame, "different frames: 'base', 'camera', 'tool0'"),
            (backwards, "goes back by 0.992 s, 0.392 s after"),
            (unstamped, "have no stamps"),
            (no_turn, "length is not 1"),
        ]
    ):
        bag = write_bag(tmp_path / f"{k}.mcap", messages, "TransformStamped", spoil=spoil)
        with pytest.raises(ConfigurationError, match=said):
            import_rosbag(bag, truth.metadata, "/wrench", "/motion", X_TK, X_WB)
    (tmp_path / "no.bag").write_text("time,force\n")
    with pytest.raises(ConfigurationError, match="cannot be read as a bag"):
        import_rosbag(tmp_path / "no.bag", truth.metadata, "/wrench", "/motion", X_TK)
    with pytest.raises(ConfigurationError, match="'wall' is no clock"):
        import_rosbag(bag, truth.metadata, "/wrench", "/motion", X_TK, clock="wall")
