"""Where residuals have a period, in time or along the path of the knife."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

__all__ = ["strongest_frequencies"]

BINS = 8
"""Places of the coordinate in the shortest period."""
FINENESS = 8
"""Frequencies in the resolution of the longest series: an eighth of it moves the phase at the ends
by an eighth of a period."""
FLOOR_BINS = 401
"""Frequencies over whose median the spectrum is what it would be without a period."""


def strongest_frequencies(
    series: Sequence[tuple[np.ndarray, np.ndarray]],
    low: float,
    high: float,
    count: int = 3,
    smooth: int = 25,
) -> tuple[float, ...]:
    """Frequencies at which series have most power against their neighbourhood in the spectrum.

    The power of all series is summed: the phase of each is its own.

    Args:
        series: Of each a coordinate [m], such as time or path, that does not decrease, and values
            [m, c].
        low, high: Range of the frequencies, 1 over the coordinate's unit.
        count: How many.
        smooth: Rows over whose running mean values are looked at.

    Returns:
        At most `count` frequencies, the strongest first.
    """
    step = 1.0 / (BINS * high)
    spans = [float(u[-1] - u[0]) for u, values in series if len(values) > smooth]
    if not spans:
        return ()
    size = 1 << int(np.ceil(np.log2(FINENESS * max(spans) / step + 2.0)))
    power = np.zeros(size // 2 + 1)
    for u, values in series:
        if len(values) <= smooth:
            continue
        rest = values - uniform_filter1d(values, smooth, axis=0)
        place = np.rint((u - u[0]) / step).astype(int)
        for column in rest.T:
            on_grid = np.bincount(place, column, minlength=size)
            power += np.abs(np.fft.rfft(on_grid)) ** 2 / max(float(column @ column), 1e-30)
    frequency = np.fft.rfftfreq(size, step)
    over_floor = power / np.maximum(median_filter(power, FLOOR_BINS), 1e-30)
    over_floor[(frequency < low) | (frequency > high)] = 0.0
    apart = max(1, round(2.0 / (np.median(spans) * frequency[1])))
    found: list[float] = []
    while len(found) < count and over_floor.max() > 0.0:
        k = int(over_floor.argmax())
        found.append(float(frequency[k]))
        over_floor[max(0, k - apart) : k + apart + 1] = 0.0
    return tuple(found)
