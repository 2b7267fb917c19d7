"""A run that was saved, simulated once more from its scenario to see what it did not keep."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.outputs.paraview import FoodFrames
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.tables import read_columns

__all__ = ["RunAgain", "run_again"]

AGREES = 1e-6
"""Difference of the force from the record's up to which the run is the same, N, or as a fraction of
a peak above 1 N: the record is printed with eight digits."""


@dc.dataclass(frozen=True)
class RunAgain:
    """A run that was repeated.

    Attributes:
        frames: Shapes of the food.
        difference: Greatest difference of the food's vertical force from the record, N.
        agrees: Whether the run is that of the record.
    """

    frames: FoodFrames
    difference: float
    agrees: bool


def run_again(
    folder: Path, fps: float, progress: Callable[[float, float], None] | None = None
) -> RunAgain:
    """Simulates the scenario of a saved run for as long as its record is.

    Args:
        folder: Folder of the run, with scenario.yaml and record.csv.
        fps: Frames a second.
        progress: Called with the simulated time and the duration, s.

    Raises:
        ConfigurationError: The folder is not of a run, or the scenario cannot start.
    """
    for name in ("scenario.yaml", "record.csv"):
        if not (folder / name).is_file():
            raise ConfigurationError(
                f"there is no {name}",
                source=str(folder),
                fix="Give the folder that `sliceit simulate --output FOLDER` wrote.",
            )
    kept = read_columns(folder / "record.csv", ["time", "food_wrench_f_z"])
    run = prepare_run(load_scenario(folder / "scenario.yaml"))
    frames, duration = FoodFrames(run, fps), float(kept["time"][-1])

    def show(time: float, _: float) -> None:
        if progress is not None:
            progress(time, duration)

    run.advance(duration, show)
    force = run.record()["food_wrench_f_z"]
    count = min(len(force), len(kept["time"]))
    difference = float(np.abs(force[:count] - kept["food_wrench_f_z"][:count]).max())
    return RunAgain(frames, difference, difference <= AGREES * max(1.0, float(np.abs(force).max())))
