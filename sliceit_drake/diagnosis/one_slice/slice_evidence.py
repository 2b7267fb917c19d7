"""What one slice says of each cause: gains, their calibration, and what is predicted of depth."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.evidence.linear import USUAL
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.experiments.identifiability import ANGLE
from sliceit_drake.diagnosis.one_slice.depth_held_out import HeldOutDepth
from sliceit_drake.diagnosis.one_slice.slice_problem import (
    SliceProblem,
    bounded_gain,
    estimate_slice_noise,
)

__all__ = ["LEVEL", "CauseInSlice", "SliceEvidence", "slice_evidence"]

LEVEL = 0.05
"""Greatest p-value, over all causes, of one that the slice supports."""
MIN_SPREAD = 0.5
"""Least standard deviation of a gain where nothing is wrong. A cause that hardly shows has next to
none, which would turn a small gain into many standard deviations."""


@dc.dataclass
class CauseInSlice:
    """What one slice says of one cause.

    Attributes:
        name: Of the cause.
        scan: Best value of its scan, or None.
        gain: Twice the gain in log-likelihood.
        p_value: Of a gain as large, relative to its spread, by any cause where nothing is wrong.
        shows: Standard deviations by which its plausible size would stand out of what is left.
        held_out: Error on left-out depth with it by the linear prediction, N; each block chooses
            its scan anew.
        confirmed: The same by simulation, N; None where that was not done.
        fitted: Error of the fit by simulation, N; None where that was not done.
        blocks_better: Of the left-out blocks, those that it predicts better, by simulation.
        without_best: Error with it over that without on all left-out blocks but the one where it
            gains most, by simulation: what rests on one block may be its accident.
        values: Fitted by simulation, by name.
        others: Causes and shifts that this motion cannot tell it from.
    """

    name: str
    scan: float | None
    gain: float
    p_value: float
    shows: float
    held_out: float
    confirmed: float | None = None
    fitted: float | None = None
    blocks_better: int = 0
    without_best: float = 1.0
    values: dict[str, float] = dc.field(default_factory=dict)
    others: list[str] = dc.field(default_factory=list)


@dc.dataclass
class SliceEvidence:
    """Evidence of all causes in one slice, by the linear problem.

    Attributes:
        causes: By increasing p-value.
        held_out: Error on left-out depth without any cause, by the linear prediction, N.
        noise: Of what is left in the slice, by channel.
    """

    causes: list[CauseInSlice]
    held_out: float
    noise: tuple[ChannelNoise, ...]


def slice_evidence(
    found: Sensitivities,
    free: np.ndarray,
    precision: np.ndarray,
    block: np.ndarray,
    replicates: int = 200,
    seed: int = 0,
    own: Sequence[int] = (),
) -> SliceEvidence:
    """Evidence of all causes in one record.

    Args:
        found: Sensitivities of the record at the fit.
        free: Change of the prediction by each unknown of the fit [m, c, n].
        precision: Of these unknowns before the data [n].
        block: Number of each row's block of depth [m].
        replicates: Of the bootstrap.
        seed: Of the bootstrap.
        own: Numbers of the unknowns that stay as fitted when depth is left out.
    """
    (record,) = found.records
    known, weights = _known(found)
    X = np.concatenate([free, record.columns[:, :, known].astype(float)], axis=2)
    precision = np.concatenate([precision, weights])
    noise = tuple(
        estimate_slice_noise(record.time, record.residual[:, c], X[:, c], precision)
        for c in range(len(record.channels))
    )
    problem = SliceProblem(found, X, precision, noise)
    options = [(n, s, found.index("cause", n, s)) for n in found.causes for s in found.scans(n)]
    rng = np.random.default_rng(seed)
    best = _best_gains(problem, options, record.residual)
    by_chance = []
    for _ in range(replicates):
        gains = _best_gains(problem, options, problem.sample(rng))
        by_chance.append([gains[name][0] for name in found.causes])
    draws = np.array(by_chance)
    mean, spread = draws.mean(0), np.maximum(draws.std(0), MIN_SPREAD)
    largest = ((draws - mean) / spread).max(1)
    held_out = HeldOutDepth(problem, block, own)
    causes = []
    for k, name in enumerate(found.causes):
        gain, scan = best[name]
        score = (gain - mean[k]) / spread[k]
        p = (1.0 + float((largest >= score).sum())) / (replicates + 1.0)
        error = held_out.error([c for n, _, c in options if n == name])
        own_columns = found.index("cause", name)
        shows = float(np.sqrt(max(0.0, np.diag(problem.gram)[own_columns].max())))
        causes.append(CauseInSlice(name, scan, gain, p, shows, error))
    for c in causes:
        if c.p_value <= LEVEL:
            c.others = _same_effect(problem, options, c)
    causes.sort(key=lambda c: (c.p_value, c.held_out))
    return SliceEvidence(causes, held_out.error([[]]), noise)


def _known(found: Sensitivities) -> tuple[list[int], np.ndarray]:
    """Columns whose coefficient is known but for a plausible spread, and their precision."""
    columns, precision = list(found.index("numerical")), [1.0] * len(found.index("numerical"))
    for k, c in enumerate(found.columns):
        for cause, scan, parameter, deviation, _ in USUAL:
            if (c.name, c.scan, c.parameter) == (cause, scan, parameter):
                columns.append(k)
                precision.append((c.size / deviation) ** 2)
    return columns, np.array(precision)


def _best_gains(
    problem: SliceProblem, options: Sequence[tuple[str, float | None, list[int]]], y: np.ndarray
) -> dict[str, tuple[float, float | None]]:
    """Largest gain of each cause, and the value of its scan."""
    b, kinds = problem.with_y(y), problem.found.columns
    out: dict[str, tuple[float, float | None]] = {}
    for name, scan, columns in options:
        A = problem.gram[np.ix_(columns, columns)]
        gain, _ = bounded_gain(A, b[columns], [kinds[k].one_sided for k in columns])
        if name not in out or gain > out[name][0]:
            out[name] = gain, scan
    return out


def _same_effect(
    problem: SliceProblem,
    options: Sequence[tuple[str, float | None, list[int]]],
    found: CauseInSlice,
) -> list[str]:
    """Causes that can do what one was found to do to within `ANGLE`, at a value of their scan."""
    kinds = problem.found.columns
    b = problem.with_y(problem.record.residual)
    own = next(c for n, s, c in options if (n, s) == (found.name, found.scan))
    _, e = bounded_gain(problem.gram[np.ix_(own, own)], b[own], [kinds[k].one_sided for k in own])
    square = float(e @ problem.gram[np.ix_(own, own)] @ e)
    least = square * np.cos(np.radians(ANGLE)) ** 2
    out = []
    for name, _, columns in options:
        if name == found.name or name in out or square <= 0.0:
            continue
        explained, _ = bounded_gain(
            problem.gram[np.ix_(columns, columns)],
            problem.gram[np.ix_(columns, own)] @ e,
            [kinds[k].one_sided for k in columns],
        )
        if explained >= least:
            out.append(name)
    return out
