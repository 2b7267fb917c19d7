"""Rows of a series that stand out from those before and after, as after a fault of a cable."""

import numpy as np
from scipy.ndimage import median_filter

__all__ = ["without_spikes"]

USUAL_STEPS, STEPS_AROUND = 1.7, 2.7
"""By how many of the differences over one or two rows, of the whole series and around it, a row may
be away from its neighbours: together 8 standard deviations of white noise."""
LEAST_SPIKE = 0.01
"""Least spike, in the 95 % quantile of the largest column's magnitude."""


def without_spikes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A series in which single rows, or two, that stand out from their neighbours are replaced.

    Such a row counts as in Student's t distribution with one degree of freedom (Lange, Little and
    Taylor 1989): it takes the running median of five rows, about which it has the standard
    deviation by which it was away, so that its weight falls with the square of that. All others
    stay as they are, bit for bit. Steps and ramps are no spikes.

    Args:
        values: Components of one quantity [n, c].

    Returns:
        The series [n, c], and the standard deviation by which it is doubted [n, c], mostly 0.
    """
    middle = median_filter(values, (5, 1), mode="nearest")
    away = np.abs(values - middle)
    before = values[np.maximum(np.arange(len(values)) - np.array([[1], [2]]), 0)]
    steps = np.abs(values - before).max(0)
    limit = USUAL_STEPS * np.quantile(steps, 0.75, axis=0)
    limit = limit + STEPS_AROUND * median_filter(steps, (11, 1), mode="nearest")
    least = LEAST_SPIKE * np.quantile(np.abs(values), 0.95, axis=0).max()
    spike = away > np.maximum(limit, least)
    return np.where(spike, middle, values), np.where(spike, away, 0.0)
