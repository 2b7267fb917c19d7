"""Where the residual of one slice jumps, and of others like it does not."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, at_times, replicates

__all__ = ["largest_jump", "unlike_others"]

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
        common = np.median([at_times(records[k].residual, own[k], since) for k in members], axis=0)
        for k in members:
            out[k] = out[k] - at_times(common, since, own[k])
    return out
