"""The record of a run: a table at the exchange rate, from a log of the station's outputs."""

import dataclasses as dc
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    Multiplexer,
    VectorLogSink,
)

from sliceit_drake.diagrams.station import SlicingStation
from sliceit_drake.systems.cutting_system import ENERGY_NAMES, LEDGER_NAMES, CuttingSystem
from sliceit_drake.systems.recorder import RowRecorder

__all__ = ["Record", "Recorder", "add_recorder"]

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
        values: One row an exchange [n, columns], SI units.
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


class Recorder:
    """Handle of the log in a diagram."""

    def __init__(self, log: VectorLogSink, columns: list[str], typed: RowRecorder) -> None:
        self._log = log
        self._columns = columns
        self._typed = typed

    def record(self, root_context: Context) -> Record:
        """What has been logged so far in the context of the diagram."""
        log = self._log.FindLog(root_context)
        data = log.data().T
        vectors, rows = data[:, : len(self._columns)], data[:, len(self._columns) :]
        values = np.column_stack([log.sample_times(), vectors, self._typed.table(rows)])
        return Record(["time", *self._columns, *self._typed.columns], values)


def add_recorder(
    builder: DiagramBuilder, station: SlicingStation, sources: Mapping[str, OutputPort]
) -> Recorder:
    """Logs the station's outputs and commands once per exchange.

    Args:
        builder: Builder of the diagram that holds the station.
        station: The station.
        sources: Output ports that drive the station's inputs, by input name, target_pose at least;
            for the other commands the configured constants are recorded.
    """
    vectors = {
        "joint_positions": [f"q_{i}" for i in range(1, 7)],
        "joint_velocities": [f"qd_{i}" for i in range(1, 7)],
        "joint_positions_command": [f"q_command_{i}" for i in range(1, 7)],
        "cut_progress": ["cut_progress"],
        **_COMMANDS,
    }
    if isinstance(station.cutting, CuttingSystem):
        parts = [f"{part}_f_{a}" for part in ("edge", "flank", "friction") for a in "xyz"]
        vectors["force_components"] = parts
        vectors["ledger"] = [f"energy_{name}" for name in LEDGER_NAMES]
        vectors["energy"] = [f"energy_{name}" for name in ENERGY_NAMES]
        vectors["coupling_work_error"] = ["coupling_work_error"]
    typed = builder.AddNamedSystem(
        "record_typed",
        RowRecorder(
            poses=["knife_pose", "commanded_pose", "target_pose"],
            velocities=["knife_velocity"],
            wrenches=["food_wrench", "board_wrench", "sensor_wrench"],
        ),
    )
    for i in range(typed.num_input_ports()):
        port = typed.get_input_port(i)
        name = port.get_name()
        source = sources["target_pose"] if name == "target_pose" else station.GetOutputPort(name)
        builder.Connect(source, port)

    row = builder.AddNamedSystem(
        "record_row", Multiplexer([*(len(columns) for columns in vectors.values()), typed.size])
    )
    for i, name in enumerate(vectors):
        builder.Connect(_vector_source(builder, station, sources, name), row.get_input_port(i))
    builder.Connect(typed.get_output_port(), row.get_input_port(len(vectors)))
    log = LogVectorOutput(
        row.get_output_port(), builder, publish_period=station.scenario.exchange_period
    )
    log.set_name("record")
    columns = [column for group in vectors.values() for column in group]
    return Recorder(log, columns, typed)


def _vector_source(
    builder: DiagramBuilder, station: SlicingStation, sources: Mapping[str, OutputPort], name: str
) -> OutputPort:
    """Where a recorded vector comes from: the station, a command source, or the configuration."""
    if name not in _COMMANDS:
        return station.GetOutputPort(name)
    if name in sources:
        return sources[name]
    constant = np.atleast_1d(np.asarray(getattr(station.scenario.controller, name), float))
    return builder.AddNamedSystem(
        f"configured_{name}", ConstantVectorSource(constant)
    ).get_output_port()
