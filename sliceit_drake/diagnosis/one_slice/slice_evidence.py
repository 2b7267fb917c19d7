"""What one slice says of each cause: gains, their calibration, and what is predicted of depth.

Generalised least squares of one record, the noise taken from that record alone.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.evidence.linear import USUAL, scaled_inverse
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.experiments.identifiability import ANGLE
from sliceit_drake.prediction.noise import MarkovCovariance

__all__ = [
    "LEVEL",
    "CauseInSlice",
    "HeldOutDepth",
    "SliceEvidence",
    "SliceProblem",
    "estimate_slice_noise",
    "slice_evidence",
]

LEVEL = 0.05
"""Greatest p-value, over all causes, of one that the slice supports."""
MIN_SPREAD = 0.5
"""Least standard deviation of a gain where nothing is wrong. A cause that hardly shows has next to
none, which would turn a small gain into many standard deviations."""
_Option = tuple[str, float | None, list[int]]
"""Cause, value of its scan, and numbers of its columns there."""


@dc.dataclass
class CauseInSlice:
    """What one slice says of one cause.

    Attributes:
        name: Of the cause.
        scan: Best value of its scan, or None.
        gain: Twice the gain in log-likelihood.
        p_value: Of a gain as large, relative to its spread, by any cause where nothing is wrong.
        shows: Standard deviations by which its plausible size would stand out of what is left.
        held_out: Error on left-out depth with it, linear, N; each block chooses its scan anew.
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


def estimate_slice_noise(
    time: np.ndarray, rest: np.ndarray, X: np.ndarray, precision: np.ndarray
) -> ChannelNoise:
    """Restricted maximum likelihood of an autocorrelated process in one series.

    What the simulation gets wrong is in it, too, as long as no cause takes it: evidence against it
    is evidence against a model error without a shape of its own.

    Args:
        time: Of the rows [m], s.
        rest: Measured less predicted [m].
        X: Columns that are fitted beside [m, n].
        precision: Of their coefficients before the data [n].
    """
    gap = np.diff(time)
    scale = max(float(rest.std()), 1e-3)
    # A column that does nothing here has no say in the likelihood.
    used = np.abs(X).max(0) > 1e-9
    X, prior = X[:, used], precision[used]

    def objective(x: np.ndarray) -> float:
        ar, tau, white = np.exp(x)
        V = MarkovCovariance(gap, ar, tau, white)
        XV = V.solve(X)
        A = X.T @ XV + np.diag(prior)
        b = XV.T @ rest
        _, log_det = np.linalg.slogdet(A)
        square = float(rest @ V.solve(rest[:, None])[:, 0] - b @ scaled_inverse(A) @ b)
        return V.log_det() + float(log_det) + square

    step, span = float(np.median(gap)), float(time[-1] - time[0])
    bounds = [
        (np.log(0.02 * scale), np.log(20.0 * scale)),
        (np.log(step), np.log(0.5 * span)),
        (np.log(0.01 * scale), np.log(3.0 * scale)),
    ]
    fits = [
        minimize(objective, np.log([scale, tau, 0.1 * scale]), method="L-BFGS-B", bounds=bounds)
        for tau in (5.0 * step, 0.05 * span)
    ]
    ar, tau, white = np.exp(min(fits, key=lambda f: f.fun).x).tolist()
    return ChannelNoise(ar, tau, white)


class SliceProblem:
    """Generalised least squares of one record: what the free columns leave of causes and of y."""

    def __init__(
        self,
        found: Sensitivities,
        X: np.ndarray,
        precision: np.ndarray,
        noise: tuple[ChannelNoise, ...],
    ) -> None:
        self.found, self.X, self.precision, self.noise = found, X, precision, noise
        (self.record,) = found.records
        self.C = self.record.columns.astype(float)
        self.XV = self._weighted(X)
        self.CV = self._weighted(self.C)
        self.inverse = scaled_inverse(_product(X, self.XV) + np.diag(precision))
        self.cross = _product(X, self.CV)
        # Of all columns with each other, beside the free ones.
        self.gram = _product(self.C, self.CV) - self.cross.T @ self.inverse @ self.cross
        gap = np.diff(self.record.time)
        self._draws = [MarkovCovariance(gap, n.ar, n.tau, n.white) for n in noise]

    def _weighted(self, columns: np.ndarray) -> np.ndarray:
        time = self.record.time
        return np.stack([n.solve(time, columns[:, c]) for c, n in enumerate(self.noise)], axis=1)

    def with_y(self, y: np.ndarray) -> np.ndarray:
        """Scalar products of all columns with a residual [m, c], beside the free ones [K]."""
        b = np.tensordot(self.CV, y, ((0, 1), (0, 1)))
        return np.asarray(
            b - self.cross.T @ (self.inverse @ np.tensordot(self.XV, y, ((0, 1), (0, 1))))
        )

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """A residual where nothing is wrong [m, c]: the process, and what is free or known but for
        a spread as it may be."""
        y = np.column_stack([V.sample(rng) for V in self._draws])
        deviation = 1.0 / np.sqrt(self.precision)
        return np.asarray(y + self.X @ (deviation * rng.normal(size=len(deviation))))


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.tensordot(a, b, ((0, 1), (0, 1))))


def _bounded_gain(
    problem: SliceProblem, columns: list[int], b: np.ndarray
) -> tuple[float, np.ndarray]:
    """Gain by columns from their products, and their coefficients; no one-sided one is negative."""
    A = problem.gram[np.ix_(columns, columns)]
    one_sided = [problem.found.columns[k].one_sided for k in columns]
    n = len(b)
    full = (1 << n) - 1
    best, at = 0.0, np.zeros(n)
    for bits in range(1, full + 1) if any(one_sided) else [full]:
        active = [k for k in range(n) if bits >> k & 1 and A[k, k] > 1e-9]
        if not active:
            continue
        g = scaled_inverse(A[np.ix_(active, active)], 1e-8) @ b[active]
        if all(x >= 0.0 or not one_sided[k] for k, x in zip(active, g, strict=True)):
            gain = float(b[active] @ g)
            if gain > best:
                best, at = gain, np.zeros(n)
                at[active] = g
    return best, at


class HeldOutDepth:
    """Errors on blocks of depth that were left out, each predicted from the others, by ordinary
    least squares: what counts is newtons, wherever they are."""

    def __init__(self, problem: SliceProblem, block: np.ndarray, own: Sequence[int]) -> None:
        self.problem, self.block, self.own = problem, block, list(own)
        self.scale = max(float(np.sqrt(np.mean(problem.record.residual**2))), 1e-6)

    def error(self, options: Sequence[list[int]]) -> float:
        """RMS over all left-out rows, N; the rest chooses between the options of a cause."""
        record = self.problem.record
        left = np.zeros_like(record.residual)
        for k in np.unique(self.block):
            rows = self.block == k
            trials = [self._predicted(columns, rows) for columns in options]
            left[rows] = min(trials, key=lambda t: t[0])[1]
        return float(np.sqrt((left[:, record.forces] ** 2).sum(1).mean()))

    def _predicted(self, columns: list[int], rows: np.ndarray) -> tuple[float, np.ndarray]:
        """Squares on the other rows, and what is left on these."""
        problem = self.problem
        X = np.concatenate([problem.X, problem.C[:, :, columns]], axis=2)
        precision = np.concatenate([problem.precision, np.full(len(columns), 1e-6)])
        low = [0.0 if problem.found.columns[k].one_sided else -np.inf for k in columns]
        bound = np.concatenate([np.full(problem.X.shape[2], -np.inf), low])
        theta = self._solve(X, precision, bound, np.ones(len(rows), bool), None)
        theta = self._solve(X, precision, bound, ~rows, theta)
        rest = problem.record.residual - X @ theta
        return float((rest[~rows] ** 2).sum()), rest[rows]

    def _solve(
        self,
        X: np.ndarray,
        precision: np.ndarray,
        bound: np.ndarray,
        rows: np.ndarray,
        fixed: np.ndarray | None,
    ) -> np.ndarray:
        y = self.problem.record.residual[rows].ravel()
        A = X[rows].reshape(len(y), -1)
        held = self.own if fixed is not None else []
        out = np.zeros(X.shape[2])
        if fixed is not None:
            out[held] = fixed[held]
        active = [k for k in range(X.shape[2]) if k not in held]
        while True:
            part = A[:, active]
            G = part.T @ part / self.scale**2 + np.diag(precision[active])
            own = scaled_inverse(G) @ (part.T @ (y - A[:, held] @ out[held]) / self.scale**2)
            wrong = [k for k, x in zip(active, own, strict=True) if x < bound[k]]
            if not wrong:
                out[active] = own
                return out
            active = [k for k in active if k not in wrong]


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
        replicates, seed: Of the bootstrap.
        own: Numbers of the unknowns that stay as fitted when depth is left out.
    """
    (record,) = found.records
    known = _known(found)
    X = np.concatenate([free, record.columns[:, :, list(known)].astype(float)], axis=2)
    precision = np.concatenate([precision, list(known.values())])
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


def _known(found: Sensitivities) -> dict[int, float]:
    """Columns whose coefficient is known but for a plausible spread, and their precision."""
    usual = {
        k: (c.size / USUAL[c.name, c.parameter][0]) ** 2
        for k, c in enumerate(found.columns)
        if (c.name, c.parameter) in USUAL
    }
    return dict.fromkeys(found.index("numerical"), 1.0) | usual


def _best_gains(
    problem: SliceProblem, options: Sequence[_Option], y: np.ndarray
) -> dict[str, tuple[float, float | None]]:
    """Largest gain of each cause, and the value of its scan."""
    b = problem.with_y(y)
    out: dict[str, tuple[float, float | None]] = {}
    for name, scan, columns in options:
        gain, _ = _bounded_gain(problem, columns, b[columns])
        if name not in out or gain > out[name][0]:
            out[name] = gain, scan
    return out


def _same_effect(
    problem: SliceProblem, options: Sequence[_Option], found: CauseInSlice
) -> list[str]:
    """Causes that can do what one was found to do to within `ANGLE`, at a value of their scan."""
    own = problem.found.of_causes([(found.name, found.scan)])
    _, e = _bounded_gain(problem, own, problem.with_y(problem.record.residual)[own])
    square = float(e @ problem.gram[np.ix_(own, own)] @ e)
    least = square * np.cos(np.radians(ANGLE)) ** 2
    out = []
    for name, _, columns in options:
        if name == found.name or name in out or square <= 0.0:
            continue
        explained, _ = _bounded_gain(problem, columns, problem.gram[np.ix_(columns, own)] @ e)
        if explained >= least:
            out.append(name)
    return out
