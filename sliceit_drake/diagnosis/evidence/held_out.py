"""What a named cause is worth: error on records that were left out, before and after."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.linear import LinearProblem

__all__ = ["HeldOutGain", "fitted_changes", "held_out_gain", "held_out_share", "own_coefficients"]

BOOTSTRAP = 1000
MIN_REDUCIBLE = 0.02
"""Least of the mean square that is called reducible, against the noise."""
FLAT = 1e4
"""Variance of a coefficient of which nothing is known, in the column's size."""


@dc.dataclass
class HeldOutGain:
    """Errors of the force on records that were left out, in contact, but for where it jumps.

    Each record in turn is predicted from a fit to the others; what is its own (its toughness, its
    height) is taken from itself, in all fits alike.

    Attributes:
        before: Root mean square error with the base parameters alone, N.
        after: With the causes as well, N.
        floor: Of the noise, N.
        by_record: Error of each record before and after [R, 2], N.
        share: Of what is above the floor in the mean square, that the causes remove.
        interval: 90 % interval of the share, from records drawn anew.
    """

    before: float
    after: float
    floor: float
    by_record: np.ndarray
    share: float
    interval: tuple[float, float]


def held_out_gain(
    problem: LinearProblem,
    causes: Sequence[CauseAtScan],
    seed: int = 0,
    simulated: LinearProblem | None = None,
) -> HeldOutGain:
    """Leaves out each record in turn, with and without causes.

    Args:
        problem: The records' moments.
        causes: Names and values of the scan.
        seed: For the interval.
        simulated: The moments with the causes in the simulation (`confirm`), from which they are
            fitted; by default from where they are absent.
    """
    squares = _both(problem, causes, simulated)
    counts = problem.moments.force_rows
    rng = np.random.default_rng(seed)
    touched = np.flatnonzero(counts > 0)
    noise = _noise(problem)
    shares = []
    for _ in range(BOOTSTRAP):
        pick = rng.choice(touched, len(touched))
        shares.append(_share(squares[:, pick].sum(1) / counts[pick].sum(), noise))
    mean = squares.sum(1) / max(counts.sum(), 1)
    low, high = np.quantile(shares, [0.05, 0.95]).tolist()
    return HeldOutGain(
        before=float(np.sqrt(mean[0])),
        after=float(np.sqrt(mean[1])),
        floor=float(np.sqrt(noise)),
        by_record=np.sqrt(squares / np.maximum(counts, 1)).T,
        share=_share(mean, noise),
        interval=(low, high),
    )


def held_out_share(problem: LinearProblem, causes: Sequence[CauseAtScan]) -> float:
    """Fraction of the held-out mean square above the noise floor that causes remove."""
    total = max(int(problem.moments.force_rows.sum()), 1)
    return _share(_both(problem, causes).sum(1) / total, _noise(problem))


def _both(
    problem: LinearProblem,
    causes: Sequence[CauseAtScan],
    simulated: LinearProblem | None = None,
) -> np.ndarray:
    """Squared errors of the records without and with causes [2, R], N^2."""
    named = problem.found.of_causes(causes)
    without = _errors(problem, (), named)
    return np.array([without, _errors(simulated or problem, causes, named)])


def _noise(problem: LinearProblem) -> float:
    return float(sum(problem.noise[k].deviation ** 2 for k in problem.forces))


def _share(mean: np.ndarray, noise: float) -> float:
    # Where nothing is above the noise there is nothing to remove a fraction of.
    return float((mean[0] - mean[1]) / max(mean[0] - noise, MIN_REDUCIBLE * noise))


def fitted_changes(problem: LinearProblem, causes: Sequence[CauseAtScan]) -> list[np.ndarray]:
    """Change of each record's prediction by causes and all that is refitted with them [m, c]."""
    linear = _Linear(problem, causes)
    theta = linear.shared(linear.reduced.sum(0))
    out = []
    for r, record in enumerate(problem.found.records):
        shared = record.columns[:, :, linear.columns] @ theta
        out.append(shared + record.columns[:, :, linear.own] @ linear.of_own(r, theta))
    return out


def own_coefficients(problem: LinearProblem) -> np.ndarray:
    """Coefficients of what is each record's own (`LinearProblem.own`), where no cause is at work
    [R, n], in the columns' sizes."""
    linear = _Linear(problem, ())
    theta = linear.shared(linear.reduced.sum(0))
    records = range(len(problem.found.records))
    return np.array([linear.of_own(r, theta)[: len(problem.own)] for r in records])


def _errors(
    problem: LinearProblem, causes: Sequence[CauseAtScan], not_usual: Sequence[int]
) -> np.ndarray:
    """Sum of squared force errors in contact of each record when it is left out [R], N^2; of the
    columns `not_usual` nothing is taken for usual."""
    linear = _Linear(problem, causes, not_usual)
    total = linear.reduced.sum(0)
    out = np.zeros(len(linear.reduced))
    for r, H in enumerate(problem.moments.force_gram):
        theta = linear.shared(total - linear.reduced[r])
        left = np.zeros(len(H))
        left[-1] = 1.0
        left[linear.columns] -= theta
        left[linear.own] -= linear.of_own(r, theta)
        out[r] = max(float(left @ H @ left), 0.0)
    return out


class _Linear:
    """Generalised least squares of what records share, and of what is their own."""

    def __init__(
        self,
        problem: LinearProblem,
        causes: Sequence[CauseAtScan],
        not_usual: Sequence[int] = (),
    ) -> None:
        found = problem.found
        columns = found.of_causes(causes)
        shared = [k for k in columns if not found.columns[k].per_record]
        self.problem, self.flat = problem, shared
        mine = {*columns, *not_usual}
        usual = [k for k in problem.usual if k not in mine]
        self.columns = [*problem.base, *problem.numerical, *usual, *shared]
        free = {k: FLAT for k in columns if k not in shared}
        self.own, self.variance = problem.own_prior(tuple(mine), free)
        self.reduced = problem.reduced(self.own, self.variance)

    def shared(self, total: np.ndarray) -> np.ndarray:
        """Coefficients of the shared columns from a sum of reduced Gram matrices."""
        return self.problem.fit_shared(total, self.columns, self.flat)[0]

    def of_own(self, r: int, theta: np.ndarray) -> np.ndarray:
        """Coefficients of what is a record's own, from itself."""
        G, own = self.problem.moments.gram[r], self.own
        inner = G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(self.variance, 1e-12))
        rest = G[own, self.problem.size] - G[np.ix_(own, self.columns)] @ theta
        return np.asarray(np.linalg.solve(inner, rest))
