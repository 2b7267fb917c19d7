"""Measured force over time of one slice."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.tables import read_columns, require_increasing

__all__ = ["ForceProfile", "load_force_profile"]


@dc.dataclass(frozen=True)
class ForceProfile:
    """Force while a knife goes through a food (calibration/measured/README.md).

    Attributes:
        time: Float array [N], s, increasing.
        force: Measured force, float array [N], N.
        is_read: Bool array [N]: the measured curve was read there, not interpolated over a gap.
    """

    time: np.ndarray
    force: np.ndarray
    is_read: np.ndarray


def load_force_profile(file: str | Path) -> ForceProfile:
    """Reads a force profile from a CSV file.

    Args:
        file: CSV file with the columns time_s, F_ground_truth_N and gt_from_drawn_dash (0 or 1).

    Raises:
        ConfigurationError: If the file is missing, lacks a column, has a cell that is not a finite
            number, times that do not increase or a mark other than 0 and 1.
    """
    columns = read_columns(file, ("time_s", "F_ground_truth_N", "gt_from_drawn_dash"))
    require_increasing(columns["time_s"], file, "time_s")
    mark = columns["gt_from_drawn_dash"]
    wrong = np.flatnonzero((mark != 0.0) & (mark != 1.0))
    if wrong.size:
        raise ConfigurationError(
            f"row {wrong[0] + 1} has {mark[wrong[0]]:g}",
            source=str(file),
            field="gt_from_drawn_dash",
            fix="Write 1 where the curve was read and 0 where it was interpolated.",
        )
    return ForceProfile(
        time=columns["time_s"],
        force=columns["F_ground_truth_N"],
        is_read=mark == 1.0,
    )
