"""Measured force profiles, and the curves of other simulators in the same files."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.records.force_profile import ForceProfile, load_force_profile
from sliceit_drake.tables import read_columns

__all__ = ["SimulatedProfile", "load_simulated_profile"]

COLUMNS = {"DiSECt": "F_disect_calibrated_N", "spring": "F_gazebo_N"}


@dc.dataclass(frozen=True)
class SimulatedProfile(ForceProfile):
    """A measured force, and what others simulated of it.

    Attributes:
        references: Force curves [N] of other simulators at the same times, N, by name.
    """

    references: dict[str, np.ndarray]


def load_simulated_profile(file: str | Path) -> SimulatedProfile:
    """Reads a profile with the curves of `COLUMNS` beside it.

    Raises:
        ConfigurationError: As `load_force_profile`.
    """
    measured = load_force_profile(file)
    columns = read_columns(file, tuple(COLUMNS.values()))
    references = {name: columns[column] for name, column in COLUMNS.items()}
    return SimulatedProfile(measured.time, measured.force, measured.is_read, references)
