"""The record of a run: a table at the exchange rate, from a log of the station's outputs."""

import dataclasses as dc
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, VectorLogSink

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

    def __init__(self, log: VectorLogSink, columns: list[str]) -> None:
        self._log = log
        self._columns = columns

    def record(self, root_context: Context) -> Record:
        """What has been logged so far in the context of the diagram."""
        log = self._log.FindLog(root_context)
        values = np.column_stack([log.sample_times(), log.data().T])
        return Record(["time", *self._columns], values)


def add_recorder(
    builder: DiagramBuilder, station: SlicingStation, sources: dict[str, object] | None = None
) -> Recorder:
    """Logs the station's outputs and commands once per exchange.

    Args:
        builder: Builder of the diagram that holds the station.
        station: The station.
        sources: Output ports that drive the station's command inputs, by input name; for the others
            the configured constants are recorded.
    """
    sources = sources or {}
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
    row = builder.AddNamedSystem(
        "record_row",
        RowRecorder(
            vectors,
            poses=["knife_pose", "commanded_pose", "target_pose"],
            velocities=["knife_velocity"],
            wrenches=["food_wrench", "board_wrench", "sensor_wrench"],
        ),
    )
    config = station.scenario.controller
    for name in [*vectors, "knife_pose", "commanded_pose", "knife_velocity"] + [
        "food_wrench",
        "board_wrench",
        "sensor_wrench",
    ]:
        if name in _COMMANDS:
            source = sources.get(name)
            if source is None:
                constant = np.atleast_1d(np.asarray(getattr(config, name), float))
                source = builder.AddNamedSystem(
                    f"configured_{name}", ConstantVectorSource(constant)
                ).get_output_port()
        else:
            source = station.GetOutputPort(name)
        builder.Connect(source, row.GetInputPort(name))
    builder.Connect(sources["target_pose"], row.GetInputPort("target_pose"))
    log = LogVectorOutput(
        row.GetOutputPort("row"), builder, publish_period=station.scenario.exchange_period
    )
    log.set_name("record")
    return Recorder(log, row.columns)
