"""The record of a run: a table at the coupling step rate, from a log of the station's vectors.

Logging runs at every coupling step, so it takes only vectors that exist anyway, without a line of
Python; poses and velocities follow afterwards from the joints by forward kinematics.
"""

import dataclasses as dc
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import (
    LogVectorOutput,
    Multiplexer,
    VectorLogSink,
)
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.motion import Motion
from sliceit_drake.diagrams.station_interface import Station

__all__ = ["Record", "Recorder", "add_recorder"]

_AXES = ("x", "y", "z")
_SIX = ("x", "y", "z", "rx", "ry", "rz")
_COMMANDS = {
    "stiffness": [f"stiffness_{a}" for a in _SIX],
    "p_gains": [f"p_gain_{a}" for a in _SIX],
    "d_gains": [f"d_gain_{a}" for a in _SIX],
    "selection": [f"selection_{a}" for a in _SIX],
    "error_scale": ["error_scale"],
}


@dc.dataclass
class Record:
    """A table of a run.

    Attributes:
        columns: Column names, `time` first.
        values: One row a coupling step [n, columns], SI units.
    """

    columns: list[str]
    values: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        """A column [n]."""
        return self.values[:, self.columns.index(name)]

    def vector(self, prefix: str, axes: str = "xyz") -> np.ndarray:
        """Columns prefix_x, prefix_y, ... [n, len(axes)]."""
        return np.column_stack([self[f"{prefix}_{a}"] for a in axes])

    def write_csv(self, file: Path) -> None:
        """Writes the table with a header row."""
        np.savetxt(
            file, self.values, fmt="%.8g", delimiter=",", header=",".join(self.columns), comments=""
        )


@dc.dataclass
class Recorder:
    """Handle of the log in a diagram.

    Attributes:
        log: The log.
        logged: Names of its rows.
        configured: What is the same in all rows, by name.
        columns: All names, in the order in which a record has them.
        station: What is logged.
        motion: What the knife shall do.
    """

    log: VectorLogSink
    logged: list[str]
    configured: dict[str, float]
    columns: list[str]
    station: Station
    motion: Motion

    def record(self, root_context: Context) -> Record:
        """What has been logged so far in the context of the diagram."""
        log = self.log.FindLog(root_context)
        time = np.array(log.sample_times())
        constant = np.tile(list(self.configured.values()), (len(time), 1))
        raw = Record(
            ["time", *self.logged, *self.configured],
            np.column_stack([time, log.data().T, constant]),
        )
        columns, parts = ["time"], [time[:, None]]

        def add(names: list[str], values: np.ndarray) -> None:
            columns.extend(names)
            parts.append(values)

        kept = [name for name in self.columns if not name.startswith("_")]
        add(kept, np.column_stack([raw[name] for name in kept]))
        joints = raw.vector("q", "123456")
        commands = raw.vector("q_command", "123456")
        add(_pose_columns("knife_pose"), self._knife_poses(joints))
        add(_pose_columns("commanded_pose"), self._knife_poses(commands))
        if _pose_columns("target_pose")[0] not in self.columns:
            R, p, _, _ = self.motion.sample(time)
            if "_target_x" in self.columns:
                R = np.repeat(R[:1], len(time), axis=0)
                p = p[0] + raw.vector("_target", "xz") @ R[0][:, [0, 2]].T
            add(_pose_columns("target_pose"), np.column_stack([p, _quaternions(R)]))
        names = [f"knife_velocity_{part}_{a}" for part in ("v", "w") for a in _AXES]
        add(names, self._knife_velocities(joints, raw.vector("qd", "123456")))
        for name in ("food_wrench", "board_wrench", "sensor_wrench"):
            names = [f"{name}_{part}_{a}" for part in ("f", "m") for a in _AXES]
            add(names, np.column_stack([raw[f"_{column}"] for column in names]))
        return Record(columns, np.concatenate(parts, axis=1))

    def _knife_poses(self, joints: np.ndarray) -> np.ndarray:
        """Position and quaternion of the knife in W [n, 7] at joint positions [n, 6]."""
        plant, context = self.station.plant, self.station.plant.CreateDefaultContext()
        X = np.empty((len(joints), 3, 4))
        for k, q in enumerate(joints):
            plant.SetPositions(context, q)
            X[k] = plant.EvalBodyPoseInWorld(context, self.station.robot.knife).GetAsMatrix34()
        return np.column_stack([X[:, :, 3], _quaternions(X[:, :, :3])])

    def _knife_velocities(self, joints: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Velocity of Ko and angular velocity in W [n, 6] at joint positions and rates [n, 6]."""
        plant, context = self.station.plant, self.station.plant.CreateDefaultContext()
        V = np.empty((len(joints), 6))
        for k, (q, qd) in enumerate(zip(joints, rates, strict=True)):
            plant.SetPositionsAndVelocities(context, np.concatenate([q, qd]))
            velocity = plant.EvalBodySpatialVelocityInWorld(context, self.station.robot.knife)
            V[k, :3], V[k, 3:] = velocity.translational(), velocity.rotational()
        return V


def _pose_columns(name: str) -> list[str]:
    return [f"{name}_p_{a}" for a in _AXES] + [f"{name}_quat_{a}" for a in "wxyz"]


def _quaternions(R: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True)


def _wrench_columns(name: str) -> list[str]:
    """Drake's order: moment, force. The underscore keeps them out of the table."""
    return [f"_{name}_{part}_{a}" for part in ("m", "f") for a in _AXES]


class _PoseRow(LeafSystem):
    """A pose as a vector: position and quaternion [7]."""

    def __init__(self) -> None:
        super().__init__()
        self._pose = self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareVectorOutputPort("row", 7, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        X = self._pose.Eval(context)
        q = _quaternions(X.rotation().matrix()[None])[0]
        output.SetFromVector(np.concatenate([X.translation(), q]))


def add_recorder(
    builder: DiagramBuilder,
    station: Station,
    motion: Motion,
    sources: Mapping[str, OutputPort],
) -> Recorder:
    """Logs the station's outputs and commands once per coupling step.

    Args:
        builder: Builder of the diagram that holds the station.
        station: The station.
        motion: What drives its target pose.
        sources: Output ports that drive the station's vector inputs, by input name; the others are
            recorded as configured. And where a policy moves the target either
            "target_offset", its place along Kx and Kz of the start, or its "target_pose".
    """
    sources = dict(sources)
    vectors = {
        "joint_positions": [f"q_{i}" for i in range(1, 7)],
        "joint_velocities": [f"qd_{i}" for i in range(1, 7)],
        "joint_positions_command": [f"q_command_{i}" for i in range(1, 7)],
        "cut_progress": ["cut_progress"],
        "food_wrench_vector": _wrench_columns("food_wrench"),
        "board_wrench_vector": _wrench_columns("board_wrench"),
        "sensor_wrench_vector": _wrench_columns("sensor_wrench"),
        **_COMMANDS,
    }
    if "target_offset" in sources:
        vectors["target_offset"] = ["_target_x", "_target_z"]
    elif "target_pose" in sources:
        target = builder.AddNamedSystem("target_pose_row", _PoseRow())
        builder.Connect(sources["target_pose"], target.get_input_port())
        sources["target_pose_row"] = target.get_output_port()
        vectors["target_pose_row"] = _pose_columns("target_pose")
    vectors |= {name: list(columns) for name, columns in station.cutting.recorded().items()}
    commands = _COMMANDS.keys() - sources.keys()
    configured = {
        column: value
        for name in vectors
        if name in commands
        for column, value in zip(
            vectors[name], np.atleast_1d(getattr(station.scenario.controller, name)), strict=True
        )
    }
    # A port costs more than its numbers do, so one stands for those whose numbers it has.
    kept = station.cutting_columns()
    ports = {
        name: columns
        for name, columns in vectors.items()
        if name not in commands and not set(columns) <= set(kept)
    }
    if kept:
        ports["cutting_state"] = kept
    row = builder.AddNamedSystem(
        "record_row", Multiplexer([len(columns) for columns in ports.values()])
    )
    for i, name in enumerate(ports):
        source = sources[name] if name in sources else station.GetOutputPort(name)
        builder.Connect(source, row.get_input_port(i))
    log = LogVectorOutput(
        row.get_output_port(), builder, publish_period=station.scenario.exchange_period
    )
    log.set_name("record")
    logged = [column for group in ports.values() for column in group]
    columns = [column for group in vectors.values() for column in group]
    return Recorder(log, logged, configured, columns, station, motion)
