"""Which causes the residuals support, beside what the simulation gets wrong by itself.

All causes compete with a discrepancy (`prediction.discrepancy`) by restricted likelihood. A cause's
numbers are normal before the data with a standard deviation of `linear.PLAUSIBLE` of its sizes, so
that the likelihoods of causes with few numbers and with many can be compared. Let A be the Gram
matrix of a cause's columns and b their products with the measurement, weighted with the inverse of
the covariance of all that is random and with what is fitted in any case projected out. With Q the
precision before the data, twice the gain in log-likelihood at given sizes of the discrepancy is

    b' (A + Q)^-1 b - log det (A + Q) + log det Q.

For the causes with most of it the sizes of the discrepancy are estimated anew with the cause in the
model: what a large cause does is then no longer taken for the simulation's own error. What chance
gives is seen from measurements that are drawn of the model without the cause, by a simulation as
wrong as this one; how well the sizes of the discrepancy and the variation of slices are known is
part of the draw.
"""

import dataclasses as dc
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan, Column
from sliceit_drake.diagnosis.evidence.effect_size import (
    OwnError,
    size_by_record,
    standardised_size,
)
from sliceit_drake.diagnosis.evidence.linear import (
    PLAUSIBLE,
    LinearProblem,
    angle_to,
    beside,
    fit_shared,
    fitted_covariance,
)
from sliceit_drake.prediction.discrepancy import Sizes

__all__ = ["CauseEvidence", "Screening", "gain_alone", "screen"]

MIN_DEVIATION = 0.5
"""Least standard deviation of a gain by chance: a gain of next to nothing proves no cause."""
PRESENT = 5.0
"""Gain for each number of a cause from which on it shows in a record."""
ESTIMATED = 3
"""Causes that gain most, and that are largest, with which sizes are estimated anew."""
FARTHEST = 1.5
"""Greatest change of the logarithm of a size in a draw."""


@dc.dataclass
class CauseEvidence:
    """What the records say of one cause.

    Attributes:
        name: Of the cause.
        gain: Twice the gain in log-likelihood by the cause, at the best value of its scan.
        expected, deviation: Mean and standard deviation of `gain` where nothing is wrong but what
            the simulation gets wrong by itself.
        limit: Its 95 % quantile there.
        scan: The best value of the scan, or None.
        columns: Of its parameters there: a coefficient times the size of its column is the
            parameter's distance from null.
        coefficients: Of the columns, in their sizes; mean over the records where each has its own.
        errors: Standard errors of the coefficients.
        by_record: These [R, n]; empty where they are shared.
        presence: Share of the records that could show it in which it does; 1 where all share it.
        sizes: Of the discrepancy beside it.
        size: `effect_size.standardised_size`; 0 where it gains no more than by chance.
        share: Of the mean square where it acts, that it explains.
    """

    name: str
    gain: float
    expected: float
    deviation: float
    limit: float
    scan: float | None
    columns: list[Column]
    coefficients: list[float]
    errors: list[float]
    by_record: list[list[float]] = dc.field(default_factory=list)
    presence: float = 1.0
    sizes: Sizes | None = None
    size: float = 0.0
    share: float = 0.0

    @property
    def cause(self) -> CauseAtScan:
        """The cause at the best value of its scan."""
        return self.name, self.scan

    @property
    def per_record(self) -> bool:
        """Whether each record has coefficients of its own."""
        return self.columns[0].per_record

    @property
    def score(self) -> float:
        """Gain beyond what chance gives in 95 % of cases."""
        return self.gain - self.limit

    @property
    def deviations(self) -> float:
        """Gain beyond its mean by chance, in its standard deviations there."""
        return (self.gain - self.expected) / max(self.deviation, MIN_DEVIATION)


@dc.dataclass
class Screening:
    """Evidence for all causes.

    Attributes:
        causes: By decreasing score.
        p_value: Of the largest gain over all causes, in standard deviations by chance.
        largest: Largest gains over all causes in the draws, in those deviations [replicates].
        angles: Between the projected sensitivities of causes [n, n], degrees, in the order of
            `names`; for several parameters and scans the least.
        visible: Norm of each cause's projected sensitivity at its plausible size, in noise.
        names: Of the causes.
        projected: Gram matrix of all columns and y beside what is free in any case.
        assumed: Causes that are part of the model already.
    """

    causes: list[CauseEvidence]
    p_value: float
    largest: np.ndarray
    angles: np.ndarray
    visible: np.ndarray
    names: list[str]
    projected: np.ndarray
    assumed: Sequence[CauseAtScan]

    def evidence(self, name: str) -> CauseEvidence:
        """Evidence of one cause."""
        return next(c for c in self.causes if c.name == name)

    def angle_to(self, problem: LinearProblem, effect: CauseEvidence, other: str) -> float:
        """Between the effect of a cause as it was found and all that another can do, degrees.

        It is not the same both ways: a cause with several numbers explains more than one with few.
        """
        found = problem.found
        sets = [found.index("cause", other, scan) for scan in found.scans(other)]
        own = found.of_causes([effect.cause])
        return angle_to(self.projected, own, np.array(effect.coefficients), sets)


class _Statistics:
    """Gains of all causes at given sizes of the discrepancy; `projected` is A of the module's
    formula, of all columns and y [K + 1, K + 1]."""

    def __init__(self, problem: LinearProblem, assumed: Sequence[CauseAtScan]) -> None:
        self.problem, found = problem, problem.found
        self.taken = found.of_causes(assumed)
        self.options: dict[CauseAtScan, list[int]] = {
            (name, scan): found.index("cause", name, scan)
            for name in found.causes
            for scan in found.scans(name)
            if all(name != n for n, _ in assumed)
        }
        self.names = list(dict.fromkeys(name for name, _ in self.options))
        self.model = problem.with_causes(self.taken)
        self.sizes, self.value = problem.fitted_sizes(self.taken)
        self.weighted = problem.weighted(self.model, self.sizes)
        T, F = self.weighted.total, self.model.shared
        self.combined = np.eye(len(T))
        self.combined[F] -= fitted_covariance(T, F, self.model.prior) @ T[F]
        self.projected = beside(T, F, self.model.prior)

    def best(
        self, products: np.ndarray, columns: list[int], projected: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
        """Gains of measurements by a cause within the bounds of its numbers [n], the number of the
        set of its columns that gains most [n], and the sets."""
        kinds = [self.problem.found.columns[k] for k in columns]
        projected = self.projected if projected is None else projected
        A, b = projected[np.ix_(columns, columns)], products
        visible = np.diag(A) > 1e-9
        best, which = np.full(len(b), -1e3), np.zeros(len(b), int)
        sets: list[list[int]] = [[]]
        seen = [i for i in range(len(columns)) if visible[i]]
        free = [i for i in seen if not kinds[i].one_sided]
        bounded = [i for i in seen if kinds[i].one_sided]
        for count in range(len(bounded) + 1):
            for some in itertools.combinations(bounded, count):
                active = [*free, *some]
                if not active:
                    continue
                inner = A[np.ix_(active, active)] + np.eye(len(active)) / PLAUSIBLE**2
                g = np.linalg.solve(inner, b[:, active].T).T
                gain = (b[:, active] * g).sum(1) - np.linalg.slogdet(inner * PLAUSIBLE**2)[1]
                inside = (g[:, len(free) :] >= 0.0).all(1)
                better = (gain > best) & inside
                best, which = np.where(better, gain, best), np.where(better, len(sets), which)
                sets.append(active)
        return best, which, sets

    def best_at(self, sizes: Sizes, columns: list[int]) -> list[int]:
        """Those of a cause's columns that gain most at other sizes of the discrepancy."""
        total = self.problem.weighted(self.model, sizes).total
        projected = beside(total, self.model.shared, self.model.prior)
        _, (which,), sets = self.best(projected[-1:, columns], columns, projected)
        return [columns[i] for i in sets[which]]

    def own_gain(self, columns: list[int]) -> float:
        """Gain of a cause with numbers of its own in each record."""
        problem = self.problem
        if problem.found.columns[columns[0]].alone:
            return float(self.own_fits(columns)[2].sum())
        model = problem.with_causes([*self.taken, *columns])
        grams = problem.by_condition(model)
        prior = model.prior[model.shared]
        value, _ = problem.discrepancy.likelihood(grams, self.sizes, model.shared, prior)
        return 2.0 * (value - 0.5 * problem.own_log_det(model) - self.value)

    def own_fits(self, columns: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients of columns for each record by itself [R, n], what they explain there [R],
        and their gains [R]; 0 where a record knows nothing of them."""
        alone = self.problem.found.columns[columns[0]].alone
        reduced = (self.problem.apart if alone else self.problem).reduced(self.model)
        out = np.zeros((len(reduced), len(columns)))
        explained, gains = np.zeros((2, len(reduced)))
        for r, A in enumerate(reduced):
            inner, b = A[np.ix_(columns, columns)], A[columns, -1]
            if np.diag(inner).min() > 1e-9:
                inner = inner + np.eye(len(columns)) / PLAUSIBLE**2
                out[r] = np.linalg.solve(inner, b)
                explained[r] = float(out[r] @ b)
                gains[r] = explained[r] - np.linalg.slogdet(inner * PLAUSIBLE**2)[1]
        return out, explained, gains


class _Chance:
    """Products of a measurement in which nothing is wrong but what was fitted."""

    def __init__(self, statistics: _Statistics, rng: np.random.Generator) -> None:
        self.statistics, self.rng = statistics, rng
        problem, W = statistics.problem, statistics.weighted
        found = problem.found
        columns = [k for k, c in enumerate(found.columns) if c.kind == "cause" and not c.per_record]
        self.columns = columns
        M = statistics.combined[:, columns]
        of_sizes = W.products(M)
        self.of_sizes = np.concatenate(of_sizes)
        reduced = problem.reduced(statistics.model)
        root = problem.variation[:, None]
        of_own = []
        for condition, members in enumerate(problem.conditions.values()):
            for r in members:
                rows = reduced[r][problem.own]
                of_own.append(root * W.products_of_record(rows, condition, M))
        self.of_own = np.concatenate(of_own) if problem.own else np.zeros((0, len(columns)))
        self.records = sum(len(m) for m in problem.conditions.values())
        A = statistics.projected[np.ix_(columns, columns)]
        rest = A - self.of_sizes.T @ self.of_sizes - self.of_own.T @ self.of_own
        values, vectors = np.linalg.eigh(0.5 * (rest + rest.T))
        self.root = vectors * np.sqrt(np.maximum(values, 0.0))
        self.covariance = problem.uncertainty(statistics.taken)

    def __call__(self, number: int) -> np.ndarray:
        """Draws some [number, K]."""
        problem, rng = self.statistics.problem, self.rng
        D, sizes = problem.discrepancy, self.statistics.sizes
        samples = max(problem.variation_samples, 1)
        out = np.zeros((number, len(problem.found.columns)))
        moves = rng.multivariate_normal(np.zeros(len(sizes.flat)), self.covariance, number)
        now = sizes.deviations(D.channel, D.phase)
        for k, move in enumerate(np.clip(moves, -FARTHEST, FARTHEST)):
            ratio = Sizes.of(sizes.flat + move).deviations(D.channel, D.phase) / now
            wide = np.concatenate([ratio[:3].ravel(), np.tile(ratio[3], len(D.factors))])
            chi = rng.chisquare(samples, len(problem.own))
            spread = np.tile(np.sqrt(samples / np.maximum(chi, 0.1 * samples)), self.records)
            b = self.root @ rng.normal(size=len(self.columns))
            b += self.of_sizes.T @ (wide * rng.normal(size=len(wide)))
            b += self.of_own.T @ (spread * rng.normal(size=len(spread)))
            out[k, self.columns] = b
        return out

    def own_gains(self, columns: list[int], number: int) -> np.ndarray:
        """Gains by columns that each record has coefficients of [number]."""
        out = np.zeros(number)
        for A in self.statistics.problem.reduced(self.statistics.model):
            values, vectors = np.linalg.eigh(A[np.ix_(columns, columns)])
            known = np.maximum(values, 0.0)
            squares = self.rng.chisquare(1.0, (number, len(known))) * known
            out += (squares / (known + 1.0 / PLAUSIBLE**2)).sum(1)
            out -= np.log1p(PLAUSIBLE**2 * known).sum()
        return out


def screen(
    problem: LinearProblem,
    replicates: int = 200,
    seed: int = 0,
    assumed: Sequence[CauseAtScan] = (),
    progress: Callable[[int], None] | None = None,
) -> Screening:
    """Tests all causes against the records.

    Args:
        problem: The records' moments.
        replicates, seed: Of the draws of what chance gives.
        assumed: Causes, each at a value of its scan, that are part of the model already.
        progress: Called with a number of replicates each time that these are done.
    """
    statistics = _Statistics(problem, assumed)
    found, measured = problem.found, statistics.projected[-1:, :]
    chance = _Chance(statistics, np.random.default_rng(seed))
    drawn = chance(replicates)
    chosen: dict[str, tuple[float, float | None, list[int], list[int]]] = {}
    by_chance: dict[str, np.ndarray] = {}
    for (name, scan), columns in statistics.options.items():
        if found.columns[columns[0]].per_record:
            touched = [bool(r.columns[:, :, columns].any()) for r in found.records]
            searched = found.columns[columns[0]].searched * sum(touched)
            gain, active = statistics.own_gain(columns), columns
            of_chance = chance.own_gains(columns, replicates) + searched
        else:
            gains, which, sets = statistics.best(measured[:, columns], columns)
            gain, active = float(gains[0]), [columns[i] for i in sets[which[0]]]
            of_chance = statistics.best(drawn[:, columns], columns)[0]
        of_chance = np.maximum(of_chance, 0.0)
        by_chance[name] = np.maximum(by_chance.get(name, 0.0), of_chance)
        if name not in chosen or gain > chosen[name][0]:
            chosen[name] = gain, scan, columns, active
    if progress is not None:
        progress(replicates)
    causes = [_evidence(statistics, name, *one, by_chance[name]) for name, one in chosen.items()]
    shared = [e for e in causes if e.score > 0.0 and not e.per_record]
    by_gain = sorted(shared, key=lambda e: -e.gain)[:ESTIMATED]
    by_size = sorted(shared, key=lambda e: -e.size)[:ESTIMATED]
    for e in by_gain + [e for e in by_size if e not in by_gain]:
        _, scan, columns, active = chosen[e.name]
        anew, value = problem.fitted_sizes([*statistics.taken, *active], statistics.sizes)
        if len(active) < len(columns):
            # What a number does beside the others may have been taken for the own error.
            more = statistics.best_at(anew, columns)
            with_more = problem.fitted_sizes([*statistics.taken, *more], anew)
            if with_more[1] > value:
                active, (anew, value) = more, with_more
        gain = max(e.gain, 2.0 * (value - statistics.value))
        again = _evidence(statistics, e.name, gain, scan, columns, active, by_chance[e.name], anew)
        causes[causes.index(e)] = again
    means = np.array([[e.expected] for e in causes])
    spreads = np.array([[max(e.deviation, MIN_DEVIATION)] for e in causes])
    largest = ((np.array([by_chance[e.name] for e in causes]) - means) / spreads).max(0)
    most = max(e.deviations for e in causes)
    angles, visible = _angles(statistics)
    return Screening(
        causes=sorted(causes, key=lambda e: -e.score),
        p_value=float((1.0 + (largest >= most).sum()) / (replicates + 1.0)),
        largest=largest,
        angles=angles,
        visible=visible,
        names=statistics.names,
        projected=statistics.projected,
        assumed=assumed,
    )


def gain_alone(problem: LinearProblem, cause: CauseAtScan) -> float:
    """Twice the gain in log-likelihood by a cause with no other in the model."""
    statistics = _Statistics(problem, ())
    columns = statistics.options[cause]
    if problem.found.columns[columns[0]].per_record:
        return statistics.own_gain(columns)
    return float(statistics.best(statistics.projected[-1:, columns], columns)[0][0])


def _evidence(
    statistics: _Statistics,
    name: str,
    gain: float,
    scan: float | None,
    columns: list[int],
    active: list[int],
    by_chance: np.ndarray,
    sizes: Sizes | None = None,
) -> CauseEvidence:
    """Evidence for a cause at the best value of its scan, from its columns, those of them that are
    within their bounds, gains where nothing is wrong, and sizes of the discrepancy beside it (those
    without it by default)."""
    problem, sizes = statistics.problem, sizes or statistics.sizes
    kinds = [problem.found.columns[k] for k in columns]
    fits, presence = np.zeros((0, 0)), 1.0
    shown = np.zeros(0, bool)
    value, error = np.zeros(len(columns)), np.full(len(columns), np.inf)
    if kinds[0].per_record:
        fits, own_gains, _ = statistics.own_fits(columns)
        shown = own_gains > kinds[0].searched + PRESENT * len(columns)
        presence = float(shown.sum() / max((own_gains > 0.0).sum(), 1))
        own = fits[np.abs(fits).max(1) > 0.0]
        if len(own):
            value, error = own.mean(0), own.std(0) / np.sqrt(len(own))
    elif active:
        model = problem.with_causes([*statistics.taken, *active])
        theta, covariance = fit_shared(problem.weighted(model, sizes).total, model)
        at = [columns.index(k) for k in active]
        value[at] = theta[-len(active) :]
        error[at] = np.sqrt(np.diag(covariance))[-len(active) :]
    out = CauseEvidence(
        name=name,
        gain=max(gain, 0.0),
        expected=float(by_chance.mean()),
        deviation=float(by_chance.std()),
        limit=float(np.quantile(by_chance, 0.95)),
        scan=scan,
        columns=kinds,
        coefficients=value.tolist(),
        errors=error.tolist(),
        by_record=fits.tolist(),
        presence=presence,
        sizes=sizes,
    )
    if out.score > 0.0:
        if out.per_record:
            fits = fits * shown[:, None]
            beside_it = problem.with_noise_beside(columns, fits)
            out.size = left = size_by_record(beside_it, columns, fits)
        else:
            wrong = OwnError(problem, problem.with_causes([*statistics.taken, *active]), sizes)
            taken = statistics.taken
            out.size = standardised_size(problem, columns, value, wrong, beside=taken)
            left = standardised_size(problem, columns, value, wrong, found=True, beside=taken)
        out.share = left**2 / (1.0 + left**2)
    return out


def _angles(statistics: _Statistics) -> tuple[np.ndarray, np.ndarray]:
    """Least angles between causes [n, n], degrees, and norms of their sensitivities [n]."""
    names, projected = statistics.names, statistics.projected
    groups = {
        name: [c for (n, _), cs in statistics.options.items() if n == name for c in cs]
        for name in names
    }
    norm = np.sqrt(np.maximum(np.diag(projected), 1e-12))
    cosine = np.abs(projected) / np.outer(norm, norm)
    # What the baseline takes away entirely has no direction.
    seen = np.diag(projected) > 1e-6
    angles = np.full((len(names), len(names)), 90.0)
    visible = np.zeros(len(names))
    for i, one in enumerate(names):
        rows = [c for c in groups[one] if seen[c]]
        visible[i] = max((norm[c] for c in rows), default=0.0)
        for j, other in enumerate(names):
            columns = [c for c in groups[other] if seen[c]]
            if rows and columns:
                largest = min(float(cosine[np.ix_(rows, columns)].max()), 1.0)
                angles[i, j] = np.degrees(np.arccos(largest))
    return angles, visible
