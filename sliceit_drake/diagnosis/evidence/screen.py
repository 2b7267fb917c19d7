"""Which causes the residuals support: likelihood ratios, calibrated by a bootstrap of records.

Let X_r be the columns of record r, y_r its residual, N_r the covariance of its noise. All that is
needed of a record is its Gram matrix

    G_r = [X_r y_r]' N_r^-1 [X_r y_r],

of a measurement its *products* with the columns, X_r' N_r^-1 y_r: n measurements are given by their
products [n, R, K], those at hand by the last column of G_r. Two steps lead to a gain:

1. Coefficients that are each record's own (columns E, normal, of variance V) are integrated out:
   *reduced* A_r = G_r - G_r[:, E] (G_r[E, E] + V^-1)^-1 G_r[E, :], and so the products.
2. The *baseline*, what all records share and what is fitted in any case (columns F, of precision P
   before the data), is projected out of A, the sum of A_r over the records:
   *projected* A - A[:, F] (A[F, F] + P)^-1 A[F, :], and so the products.

The *gain* of a cause with columns C is the likelihood-ratio statistic, twice the gain in
log-likelihood by its coefficients: b' A[C, C]^-1 b, with b the projected products at C. What it is
*by chance* is seen from measurements that are drawn where nothing is wrong.

The *null* of a parameter is the value at which its cause is absent.
"""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan, Column
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, scaled_inverse

__all__ = ["CauseEvidence", "Screening", "screen"]

FLAT = 1e8
"""Variance of a coefficient of which nothing is known, in the column's size."""
CORRECTION_VARIANCE = 1e4
"""Prior variance of the nonparametric correction, N^2."""
UNUSUAL = 0.98
"""Quantile of the gain beyond the usual from which on what a sensor has a little of is a cause."""
MIN_DEVIATION = 0.5
"""Least standard deviation of a gain by chance: a cause that never gains by chance is not proved by
a gain of next to nothing."""
PRESENT = 5.0
"""Gain for each number of a cause from which on it shows in a record."""
JITTER = 1e-9
"""Added to the diagonal of Gram matrices of unit columns, some of which are the same."""
BATCH = 100
"""Replicates of the bootstrap that are computed in one go."""


@dc.dataclass
class CauseEvidence:
    """What the records say of one cause.

    Attributes:
        name: Of the cause.
        gain: Twice the gain in log-likelihood by the cause, at the best value of its scan. Of a
            cause that every sensor has a little of (`linear.USUAL`) the gain beyond that; where
            that is not to be had by chance, all that it gains.
        expected, deviation: Mean and standard deviation of `gain` where nothing is wrong.
        limit: Its 95 % quantile there.
        scan: The best value of the scan, or None.
        columns: Of its parameters there: a coefficient times the size of its column is the
            parameter's distance from null.
        coefficients: Of the columns, in their sizes; mean over the records where each has its own.
        errors: Standard errors of the coefficients.
        by_record: These [R, n]; empty where they are shared.
        presence: Fraction of the records that it could show in in which it does; 1 where
            coefficients are shared.
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
        misfit: Gain by the nonparametric correction of each condition: all that could be gained.
        expected_misfit: Its mean where nothing is wrong.
        misfit_p_value: Of `misfit`.
        angles: Between the projected sensitivities of causes [n, n], degrees, in the order of
            `names`; for several parameters and scans the least.
        visible: Norm of each cause's projected sensitivity at its plausible size, in noise.
        names: Of the causes.
        projected: Gram matrix of all columns and y beside what is free in any case.
        assumed: Causes that are part of the model already.
    """

    causes: list[CauseEvidence]
    p_value: float
    misfit: float
    expected_misfit: float
    misfit_p_value: float
    angles: np.ndarray
    visible: np.ndarray
    names: list[str]
    projected: np.ndarray
    assumed: Sequence[CauseAtScan] = ()

    def evidence(self, name: str) -> CauseEvidence:
        """Evidence of one cause."""
        return next(c for c in self.causes if c.name == name)

    def angle_to(self, problem: LinearProblem, effect: CauseEvidence, other: str) -> float:
        """Between the effect of a cause as it was found and all that another can do, degrees.

        A cause with several numbers explains more than one with few, so that this is not the same
        both ways.
        """
        G = self.projected
        own = problem.found.of_causes([effect.cause])
        e = np.array(effect.coefficients)
        norm = float(e @ G[np.ix_(own, own)] @ e)
        best = 0.0
        for scan in problem.found.scans(other):
            columns = problem.found.index("cause", other, scan)
            b = G[np.ix_(columns, own)] @ e
            best = max(best, float(b @ scaled_inverse(G[np.ix_(columns, columns)], 1e-8) @ b))
        return float(np.degrees(np.arccos(np.sqrt(min(best / max(norm, 1e-12), 1.0)))))


class _Statistics:
    """Gains of all causes, given what is assumed already.

    The columns are the same whatever was measured, so that all that is solved is solved once and
    many measurements [n] are tested in one go. Gains are differences, so that a measurement's
    square is not needed, only its products.

    Attributes:
        baseline, own: Numbers of the columns F and E of the module's formulas.
        free: Those of E that belong to causes that are assumed, and their variance.
        options: Of each cause and value of its scan the numbers of its columns.
        reduced: A_r of each record [K, K].
        projected: A beside the baseline [K, K].
    """

    def __init__(self, problem: LinearProblem, assumed: Sequence[CauseAtScan]) -> None:
        self.problem = problem
        found = problem.found
        self.prior = problem.prior()
        taken = found.of_causes(assumed)
        shared = [k for k in taken if not found.columns[k].per_record]
        self.baseline = [*problem.baseline, *shared]
        self.free = {k: FLAT for k in taken if k not in shared}
        # At another value of its scan an assumed cause may still add something.
        self.options: list[tuple[str, float | None, list[int]]] = [
            (name, scan, found.index("cause", name, scan))
            for name in found.causes
            for scan in found.scans(name)
            if (name, scan) not in assumed
        ]
        self.names = list(dict.fromkeys(name for name, _, _ in self.options))
        self.per_record = {n: found.columns[c[0]].per_record for n, _, c in self.options}
        self.own, variance = problem.own_prior(free=self.free)
        K = problem.size
        self.reduced, self.own_weights = [], []
        for G in problem.moments.gram:
            A, weights, _ = _integrated(G[:K, :K], self.own, variance)
            self.reduced.append(A)
            self.own_weights.append(weights)
        total = np.sum(self.reduced, axis=0)
        self.baseline_covariance = self.covariance_of_baseline(total)
        self.baseline_weights = total[:, self.baseline] @ self.baseline_covariance
        self.projected = total - self.baseline_weights @ total[self.baseline]
        each = [[r] for r in range(len(self.reduced))]
        self._eliminated = {
            columns[0]: _Eliminated(self, each, columns, FLAT)
            for name, _, columns in self.options
            if self.per_record[name]
        }
        conditions = list(problem.conditions.values())
        self._corrected = _Eliminated(self, conditions, problem.correction, CORRECTION_VARIANCE)

    def covariance_of_baseline(self, total: np.ndarray) -> np.ndarray:
        """(A[F, F] + P)^-1 of a summed Gram matrix [F, F]."""
        F = self.baseline
        return scaled_inverse(total[np.ix_(F, F)] + np.diag(self.prior[F]))

    def reduce(self, products: np.ndarray) -> np.ndarray:
        """Products with what is each record's own integrated out [n, R, K]."""
        own = products[:, :, self.own]
        out = products.copy()
        for r, weights in enumerate(self.own_weights):
            out[:, r] -= own[:, r] @ weights.T
        return out

    def project(self, reduced: np.ndarray) -> np.ndarray:
        """Sum over the records of reduced products with the baseline projected out [n, K]."""
        total = reduced.sum(1)
        return np.asarray(total - total[:, self.baseline] @ self.baseline_weights.T)

    def gains(self, products: np.ndarray) -> tuple[dict[CauseAtScan, np.ndarray], np.ndarray]:
        """Gains of the causes at each value of their scans [n], and by a correction of each
        condition [n]."""
        reduced = self.reduce(products)
        projected = self.project(reduced)
        of_baseline = _squares(reduced.sum(1)[:, self.baseline], self.baseline_covariance)
        out = {}
        for name, scan, columns in self.options:
            if self.per_record[name]:
                out[name, scan] = self._eliminated[columns[0]].gain(reduced) - of_baseline
            else:
                out[name, scan] = self._bounded(projected, columns)[0]
        return out, self._corrected.gain(reduced) - of_baseline

    def _bounded(
        self, projected: np.ndarray, columns: list[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gains [n], coefficients and their errors [n, c], within the bounds of one-sided
        parameters."""
        kinds = [self.problem.found.columns[k] for k in columns]
        A, b = self.projected[np.ix_(columns, columns)], projected[:, columns]
        visible = np.diag(A) > 1e-9
        best = np.zeros(len(b))
        values, errors = np.zeros(b.shape), np.full(b.shape, np.inf)
        # So few parameters that every set of active ones is tried.
        for bits in range(1, 2 ** len(columns)):
            active = [k for k in range(len(columns)) if bits >> k & 1 and visible[k]]
            if not active:
                continue
            inverse = np.linalg.pinv(A[np.ix_(active, active)], rcond=1e-10, hermitian=True)
            g = b[:, active] @ inverse
            bounded = [i for i, k in enumerate(active) if kinds[k].one_sided]
            gain = (b[:, active] * g).sum(1)
            better = (gain > best) & (g[:, bounded] >= 0.0).all(1)
            best = np.where(better, gain, best)
            value, error = np.zeros(b.shape), np.full(b.shape, np.inf)
            value[:, active] = g
            error[:, active] = np.sqrt(np.maximum(np.diag(inverse), 0.0))
            values[better], errors[better] = value[better], error[better]
        return best, values, errors

    def gain_with_usual(self, products: np.ndarray, columns: list[int]) -> float:
        """Gain of a cause for one measurement [1, R, K] against a model without what is usual of
        it; 0 for one of which nothing is usual."""
        problem = self.problem
        mine = set(columns)
        if not mine & {*problem.usual, *problem.usual_own}:
            return 0.0
        own, variance = problem.own_prior(columns, self.free)
        baseline = [k for k in self.baseline if k not in mine]
        prior = self.prior.copy()
        prior[columns] = 0.0
        K = problem.size
        total, left = np.zeros((K, K)), np.zeros(K)
        for G, measured in zip(problem.moments.gram, products[0], strict=True):
            A, weights, _ = _integrated(G[:K, :K], own, variance)
            total = total + A
            left = left + measured - weights @ measured[own]
        gains = []
        for chosen in (baseline, [*baseline, *columns]):
            inner = total[np.ix_(chosen, chosen)] + np.diag(prior[chosen])
            seen = left[chosen]
            gains.append(float(seen @ scaled_inverse(inner) @ seen))
        return gains[1] - gains[0]

    def coefficients(
        self, products: np.ndarray, columns: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of a cause's columns for one measurement [1, R, K], and their errors. Where
        each record has its own, their mean and its standard error."""
        reduced = self.reduce(products)
        kinds = self.problem.found.columns
        if not kinds[columns[0]].per_record:
            _, value, error = self._bounded(self.project(reduced), columns)
            return value[0], error[0]
        own = self.own_fits(products, columns)[0]
        own = own[np.abs(own).max(1) > 0.0]
        if not len(own):
            return np.zeros(len(columns)), np.full(len(columns), np.inf)
        spread = np.std(own, axis=0, ddof=1) if len(own) > 1 else np.full(len(columns), np.inf)
        return np.mean(own, axis=0), spread / np.sqrt(len(own))

    def own_fits(self, products: np.ndarray, columns: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of columns for each record by itself [R, n], and what they gain there [R];
        0 where a record knows nothing of them."""
        out, gains = np.zeros((products.shape[1], len(columns))), np.zeros(products.shape[1])
        for r, (A, b) in enumerate(zip(self.reduced, self.reduce(products)[0], strict=True)):
            inner = A[np.ix_(columns, columns)]
            if np.diag(inner).min() > 1e-9:
                out[r] = np.linalg.lstsq(inner, b[columns], rcond=1e-9)[0]
                gains[r] = float(out[r] @ b[columns])
        return out, gains


class _Eliminated:
    """Columns of which each group of records has coefficients of its own, integrated out."""

    def __init__(
        self,
        statistics: _Statistics,
        groups: Sequence[Sequence[int]],
        columns: list[int],
        variance: float,
    ) -> None:
        self.groups, self.columns, self.baseline = groups, columns, statistics.baseline
        self.weights, self.inverses = [], []
        total = np.zeros_like(statistics.projected)
        for members in groups:
            A = np.sum([statistics.reduced[r] for r in members], axis=0)
            A, weight, inverse = _integrated(A, columns, np.full(len(columns), variance))
            total += A
            self.weights.append(weight)
            self.inverses.append(inverse)
        self.covariance = statistics.covariance_of_baseline(total)

    def gain(self, reduced: np.ndarray) -> np.ndarray:
        """By these columns and the baseline together [n]."""
        gain, total = np.zeros(len(reduced)), np.zeros((len(reduced), reduced.shape[2]))
        for members, weight, inverse in zip(self.groups, self.weights, self.inverses, strict=True):
            b = reduced[:, members].sum(1)
            gain += _squares(b[:, self.columns], inverse)
            total += b - b[:, self.columns] @ weight.T
        return gain + _squares(total[:, self.baseline], self.covariance)


def _squares(b: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """b' inverse b of each row [n]."""
    return np.asarray(np.einsum("nk,nk->n", b @ inverse, b))


def _integrated(
    A: np.ndarray, own: list[int], variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A Gram matrix without normal coefficients of these columns, the weights [K, c] with which
    their products are taken from the others', and the inverse [c, c]."""
    inner = A[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12))
    inverse = scaled_inverse(inner, 1e-15)
    weights = A[:, own] @ inverse
    return A - weights @ A[own], weights, inverse


def screen(
    problem: LinearProblem,
    replicates: int = 200,
    seed: int = 0,
    assumed: Sequence[CauseAtScan] = (),
    progress: Callable[[int], None] | None = None,
) -> Screening:
    """Tests all causes against the records.

    The gains' distribution where nothing is wrong is that of records drawn anew: what differs from
    slice to slice is drawn for each record, its standard deviation itself from what its estimate
    leaves open, and noise is added; the discretisation's error is drawn once for all.

    Args:
        problem: The records' moments.
        replicates, seed: Of the bootstrap.
        assumed: Causes, each at a value of its scan, that are part of the model already.
        progress: Called with a number of replicates each time that these are done.
    """
    statistics = _Statistics(problem, assumed)
    K = problem.size
    measured = problem.moments.gram[None, :, :K, K]
    gains, misfit = statistics.gains(measured)
    draw = _Bootstrap(problem, np.random.default_rng(seed))
    chance_gains: dict[str, list[float]] = {name: [] for name in statistics.names}
    chance_misfits: list[float] = []
    while len(chance_misfits) < replicates:
        count = min(BATCH, replicates - len(chance_misfits))
        own, of_correction = statistics.gains(draw(count))
        for name in statistics.names:
            largest = np.max([gain for at, gain in own.items() if at[0] == name], axis=0)
            chance_gains[name] += largest.tolist()
        chance_misfits += of_correction.tolist()
        if progress is not None:
            progress(count)
    evidence = []
    for name in statistics.names:
        _, scan = best = max((at for at in gains if at[0] == name), key=lambda at: gains[at][0])
        columns = problem.found.of_causes([best])
        kinds = [problem.found.columns[c] for c in columns]
        value, error = statistics.coefficients(measured, columns)
        fits, presence = np.zeros((0, 0)), 1.0
        if statistics.per_record[name]:
            fits, own_gains = statistics.own_fits(measured, columns)
            shown = own_gains > kinds[0].searched + PRESENT * len(columns)
            presence = float(shown.sum() / max((own_gains > 0.0).sum(), 1))
        # By a cause that looked for itself in records where there is nothing.
        touched = [bool(r.columns[:, :, columns].any()) for r in problem.found.records]
        searched = kinds[0].searched * sum(touched)
        chance_gains[name] = [g + searched for g in chance_gains[name]]
        by_chance = np.array(chance_gains[name])
        evidence.append(
            CauseEvidence(
                name=name,
                gain=float(gains[best][0]),
                expected=float(by_chance.mean()),
                deviation=float(by_chance.std()),
                limit=float(np.quantile(by_chance, 0.95)),
                scan=scan,
                columns=kinds,
                coefficients=value.tolist(),
                errors=error.tolist(),
                by_record=fits.tolist(),
                presence=presence,
            )
        )
    means = np.array([[e.expected] for e in evidence])
    spreads = np.array([[max(e.deviation, MIN_DEVIATION)] for e in evidence])
    by_chance = (np.array([chance_gains[e.name] for e in evidence]) - means) / spreads
    most = max(e.deviations for e in evidence)
    p = (1.0 + (by_chance.max(0) >= most).sum()) / (replicates + 1.0)
    for e in evidence:
        if e.gain > float(np.quantile(chance_gains[e.name], UNUSUAL)):
            columns = problem.found.of_causes([e.cause])
            e.gain = max(e.gain, statistics.gain_with_usual(measured, columns))
    p_misfit = (1.0 + (np.array(chance_misfits) >= misfit[0]).sum()) / (replicates + 1.0)
    angles, visible = _angles(statistics)
    return Screening(
        causes=sorted(evidence, key=lambda e: -e.score),
        p_value=float(p),
        misfit=float(misfit[0]),
        expected_misfit=float(np.mean(chance_misfits)),
        misfit_p_value=float(p_misfit),
        angles=angles,
        visible=visible,
        names=statistics.names,
        projected=statistics.projected,
        assumed=assumed,
    )


class _Bootstrap:
    """Measurements in which nothing is wrong, by their products with the columns."""

    def __init__(self, problem: LinearProblem, rng: np.random.Generator) -> None:
        self.problem, self.rng = problem, rng
        K = problem.size
        self.gram = problem.moments.gram[:, :K, :K]
        scale = np.sqrt(np.maximum(np.diagonal(self.gram, axis1=1, axis2=2), 1e-30))
        unit = self.gram / scale[:, :, None] / scale[:, None, :] + JITTER * np.eye(K)
        self.roots = scale[:, :, None] * np.linalg.cholesky(unit)

    def __call__(self, number: int) -> np.ndarray:
        """Draws some [number, R, K]."""
        problem, rng = self.problem, self.rng
        count, K = len(self.gram), problem.size
        samples = max(problem.variation_samples, 1)
        chi = rng.chisquare(samples, (number, 1, len(problem.own)))
        spread = problem.variation * np.sqrt(samples / np.maximum(chi, 0.1 * samples))
        shared = np.zeros((number, 1, K))
        for columns, deviation in (
            (problem.numerical, 1.0),
            (problem.spline, problem.discretisation),
            (list(problem.usual), np.array(list(problem.usual.values()))),
        ):
            shared[:, 0, columns] = deviation * rng.normal(size=(number, len(columns)))
        coefficients = np.repeat(shared, count, axis=1)
        coefficients[:, :, problem.own] = spread * rng.normal(
            size=(number, count, len(problem.own))
        )
        for k, deviation in problem.usual_own.items():
            coefficients[:, :, k] += deviation * rng.normal(size=(number, count))
        noise = rng.normal(size=(number, count, K))
        out = np.empty((number, count, K))
        for r in range(count):
            out[:, r] = coefficients[:, r] @ self.gram[r] + noise[:, r] @ self.roots[r].T
        return out


def _angles(statistics: _Statistics) -> tuple[np.ndarray, np.ndarray]:
    """Least angles between causes [n, n], degrees, and norms of their sensitivities [n]."""
    names, projected = statistics.names, statistics.projected
    groups = {
        name: [c for n, _, cs in statistics.options if n == name for c in cs] for name in names
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
