"""What a named cause is worth: error on records that were left out, before and after."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.effect_size import OwnError
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, fit_shared
from sliceit_drake.prediction.discrepancy import Sizes

__all__ = [
    "HeldOutGain",
    "fitted_changes",
    "foretells",
    "held_out_gain",
    "held_out_share",
    "own_coefficients",
]

BOOTSTRAP = 1000
MIN_REDUCIBLE = 0.02
"""Least of the mean square that is called reducible, against the noise."""


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
        simulated: The moments as the extended food predicts them, at values that were fitted to all
            records; by default causes are fitted from where they are absent.
    """
    named = problem.found.of_causes(causes)
    fitted = simulated is not None
    without = _errors(problem, (), named)
    squares = np.array([without, _errors(simulated or problem, causes, named, fitted=fitted)])
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


def foretells(
    problem: LinearProblem,
    cause: CauseAtScan,
    beside: Sequence[CauseAtScan],
    wrong: OwnError,
) -> bool:
    """Whether records that were left out may be predicted better with a cause than without, and
    those without contact no worse: in the air there is no law that could be wrong.

    All rows and channels count, each over its noise and what the simulation gets wrong there: a
    cause in the air is judged in the air, and one where the force is small where it is small.

    Args:
        problem: The records.
        cause: That all records share.
        beside: Causes that are in the model before as well.
        wrong: What the simulation gets wrong beside all of them.

    Returns:
        Whether the 95 % quantile of the gain is positive, and over records without contact no
        loss of more than one for each of the cause's numbers.
    """
    grams, named = wrong.over_scales(), problem.found.of_causes([*beside, cause])
    before = _errors(problem, beside, named, problem.sizes, grams=grams)
    gains = before - _errors(problem, [*beside, cause], named, wrong.sizes, grams=grams)
    in_air = np.array([not record.in_contact.any() for record in problem.found.records])

    def may_gain(gains: np.ndarray) -> float:
        drawn = np.random.default_rng(0).choice(gains, (BOOTSTRAP, len(gains)))
        return float(np.quantile(drawn.sum(1), 0.95))

    if in_air.any() and may_gain(gains[in_air]) < -len(problem.found.of_causes([cause])):
        return False
    return may_gain(gains) > 0.0


def held_out_share(problem: LinearProblem, causes: Sequence[CauseAtScan]) -> float:
    """Fraction of the held-out mean square above the noise floor that causes remove."""
    total = max(int(problem.moments.force_rows.sum()), 1)
    named = problem.found.of_causes(causes)
    squares = np.array([_errors(problem, (), named), _errors(problem, causes, named)])
    return _share(squares.sum(1) / total, _noise(problem))


def _noise(problem: LinearProblem) -> float:
    return float(sum(problem.differences[k].deviation ** 2 for k in problem.forces))


def _share(mean: np.ndarray, noise: float) -> float:
    # Where nothing is above the noise there is nothing to remove a fraction of.
    return float((mean[0] - mean[1]) / max(mean[0] - noise, MIN_REDUCIBLE * noise))


def fitted_changes(problem: LinearProblem, causes: Sequence[CauseAtScan]) -> list[np.ndarray]:
    """Change of each record's prediction by causes and all that is refitted with them [m, c]."""
    linear = _Linear(problem, causes)
    theta = linear.shared()
    out = []
    for r, record in enumerate(problem.found.records):
        shared = record.columns[:, :, linear.columns] @ theta
        out.append(shared + record.columns[:, :, linear.own] @ linear.of_own(r, theta))
    return out


def own_coefficients(problem: LinearProblem) -> np.ndarray:
    """Coefficients of `LinearProblem.own` without causes [R, n], in the columns' sizes."""
    linear = _Linear(problem, ())
    theta = linear.shared()
    records = range(len(problem.found.records))
    return np.array([linear.of_own(r, theta)[: len(problem.own)] for r in records])


def _errors(
    problem: LinearProblem,
    causes: Sequence[CauseAtScan],
    not_usual: Sequence[int],
    sizes: Sizes | None = None,
    fitted: bool = False,
    grams: np.ndarray | None = None,
) -> np.ndarray:
    """Sum of squared errors of each record when it is left out [R].

    Args:
        problem: The records' moments.
        causes: That are fitted with the base parameters.
        not_usual: Columns of which nothing is taken for usual: a file foretells none of it.
        sizes: Of the discrepancy.
        fitted: Whether the prediction has the values of all records: then only what these values
            owe to the record is taken out of it.
        grams: Gram matrices of what is squared; by default of the force in contact, N^2.
    """
    linear = _Linear(problem, causes, not_usual, sizes)
    whole = linear.shared()
    inside = [*problem.base, *problem.found.of_causes(causes)]
    whole[~np.isin(linear.columns, inside)] = 0.0
    out = np.zeros(len(problem.found.records))
    for r, H in enumerate(problem.moments.force_gram if grams is None else grams):
        theta = linear.shared(r) - fitted * whole
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
        sizes: Sizes | None = None,
    ) -> None:
        self.problem, self.sizes = problem, sizes
        self.model = problem.with_causes(problem.found.of_causes(causes), not_usual)
        # How uneven it is nobody predicts.
        d = int(np.sum(np.array(self.model.own) < len(problem.found.columns)))
        self.columns, self.own = self.model.shared, self.model.own[:d]
        self.variance = self.model.variance[:d]

    def shared(self, without: int | None = None) -> np.ndarray:
        """Coefficients of the shared columns from all records, or all but one."""
        if self.sizes is None:
            reduced = self.problem.reduced(self.model)
            total = reduced.sum(0) - (0.0 if without is None else reduced[without])
        else:
            total = self.problem.weighted(self.model, self.sizes, without).total
        return fit_shared(total, self.model)[0]

    def of_own(self, r: int, theta: np.ndarray) -> np.ndarray:
        """Coefficients of what is a record's own, from itself."""
        G, own = self.problem.moments.gram[r], self.own
        inner = G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(self.variance, 1e-12))
        rest = G[own, self.problem.size] - G[np.ix_(own, self.columns)] @ theta
        return np.asarray(np.linalg.solve(inner, rest))
