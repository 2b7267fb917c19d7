"""Where residuals jump in one slice and not in others, and where they have a period.

For causes that look at the residuals first.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, replicates
from sliceit_drake.tables import interpolated

__all__ = ["largest_jump", "strongest_frequencies", "unlike_others"]

BEFORE = 2.0
"""Time before a jump that tells what was there, in times of fading."""


def largest_jump(time: np.ndarray, values: np.ndarray, inside: np.ndarray, fading: float) -> float:
    """Moment of the jump that fades away which explains most of some values.

    Around each moment a straight line is fitted with and without the jump.

    Args:
        time: Even times [m], s.
        values: [m, c].
        inside: Whether the jump may be there [m].
        fading: In which it falls to 1/e, s.

    Returns:
        The moment, s.
    """
    step = float(np.median(np.diff(time)))
    before, after = round(BEFORE * fading / step), round(2.0 * BEFORE * fading / step)
    t = step * np.arange(-before, after + 1)
    line = np.linalg.qr(np.column_stack([np.ones(len(t)), t]))[0]
    jump = np.where(t >= 0.0, np.exp(-np.maximum(t, 0.0) / fading), 0.0)
    jump = jump - line @ (line.T @ jump)
    jump /= np.linalg.norm(jump)
    score = np.zeros(len(time))
    for column in values.T:
        if len(column) > len(t):
            score[before : len(column) - after] += np.correlate(column, jump, mode="valid") ** 2
    score[~inside] = -1.0
    return float(time[int(score.argmax())])


def unlike_others(records: Sequence[RecordSensitivity]) -> list[np.ndarray]:
    """Residuals less the median of the records of their condition, each [m, c].

    The median of three does not see what is in one of them. With fewer nothing is taken off.
    """
    out = [record.residual for record in records]
    for members in replicates(records).values():
        if len(members) < 3:
            continue
        first = records[members[0]]
        since = first.time - first.time[0]
        own = {k: records[k].time - records[k].time[0] for k in members}
        seen = [interpolated(since, own[k], records[k].residual) for k in members]
        common = np.median(seen, axis=0)
        for k in members:
            out[k] = out[k] - interpolated(own[k], since, common)
    return out


BINS = 8
"""Places of the coordinate in the shortest period."""
FINENESS = 8
"""Frequencies in the resolution of the longest series: an eighth of it moves the phase at the ends
by an eighth of a period."""
COUNT = 3
"""Frequencies that are looked for."""
SMOOTH = 25
"""Rows over whose running mean values are looked at."""
FLOOR_BINS = 401
"""Frequencies over whose median the spectrum is what it would be without a period."""


def strongest_frequencies(
    series: Sequence[tuple[np.ndarray, np.ndarray]], low: float, high: float
) -> tuple[float, ...]:
    """Frequencies at which series have most power against their neighbourhood in the spectrum.

    The power of all series is summed: the phase of each is its own.

    Args:
        series: Of each a coordinate that does not decrease [m], such as time, and values [m, c].
        low, high: Range of the frequencies, 1 over the coordinate's unit.

    Returns:
        At most `COUNT` frequencies, the strongest first.
    """
    step = 1.0 / (BINS * high)
    spans = [float(u[-1] - u[0]) for u, values in series if len(values) > SMOOTH]
    if not spans:
        return ()
    size = 1 << int(np.ceil(np.log2(FINENESS * max(spans) / step + 2.0)))
    power = np.zeros(size // 2 + 1)
    for u, values in series:
        if len(values) <= SMOOTH:
            continue
        rest = values - uniform_filter1d(values, SMOOTH, axis=0)
        place = np.rint((u - u[0]) / step).astype(int)
        for column in rest.T:
            on_grid = np.bincount(place, column, minlength=size)
            power += np.abs(np.fft.rfft(on_grid)) ** 2 / max(float(column @ column), 1e-30)
    frequency = np.fft.rfftfreq(size, step)
    over_floor = power / np.maximum(median_filter(power, FLOOR_BINS), 1e-30)
    over_floor[(frequency < low) | (frequency > high)] = 0.0
    apart = max(1, round(2.0 / (np.median(spans) * frequency[1])))
    found: list[float] = []
    while len(found) < COUNT and over_floor.max() > 0.0:
        k = int(over_floor.argmax())
        found.append(float(frequency[k]))
        over_floor[max(0, k - apart) : k + apart + 1] = 0.0
    return tuple(found)
