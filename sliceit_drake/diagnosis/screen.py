"""Which causes the residuals support: likelihood ratios, calibrated by a bootstrap of records."""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np

from sliceit_drake.diagnosis.linear import LinearProblem, integrate_out, scaled_inverse

__all__ = ["CauseEvidence", "Screening", "screen"]

FLAT = 1e8
"""Variance of a coefficient of which nothing is known, in the column's size."""
CORRECTION_VARIANCE = 1e4
"""Of the nonparametric correction, N^2."""


@dc.dataclass
class CauseEvidence:
    """What the records say of one cause.

    Attributes:
        name: Of the cause.
        gain: Twice the gain in log-likelihood by the cause, at the best value of its scan.
        expected, deviation: Mean and standard deviation of `gain` where nothing is wrong.
        limit: Its 95 % quantile there.
        scan: The best value of the scan, or None.
        parameters: Names of its parameters.
        coefficients: Of its columns, in their sizes; mean over the records where each has its own.
        errors: Standard errors of the coefficients.
        sizes: Of the columns: a coefficient times its size is the parameter's distance from null.
        units: Of the parameters.
        per_record: Whether each record has coefficients of its own.
    """

    name: str
    gain: float
    expected: float
    deviation: float
    limit: float
    scan: float | None
    parameters: list[str]
    coefficients: list[float]
    errors: list[float]
    sizes: list[float]
    units: list[str]
    per_record: bool

    @property
    def score(self) -> float:
        """Gain beyond what chance gives in 95 % of cases."""
        return self.gain - self.limit

    @property
    def deviations(self) -> float:
        """Gain beyond its mean under the null, in its standard deviations there."""
        return (self.gain - self.expected) / max(self.deviation, 1e-9)


@dc.dataclass
class Screening:
    """Evidence for all causes.

    Attributes:
        causes: By decreasing score.
        p_value: Of the largest gain over all causes, in standard deviations, under the null.
        misfit: Gain by the nonparametric correction of each condition: all that could be gained.
        expected_misfit: Its mean where nothing is wrong.
        misfit_p_value: Of `misfit`.
        angles: Between the projected sensitivities of causes [n, n], degrees, in the order of
            `names`; for several parameters and scans the least.
        visible: Norm of each cause's projected sensitivity at its plausible size, in noise.
        names: Of the causes.
        projected: Gram matrix of all columns and y beside what is free in any case.
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

    def evidence(self, name: str) -> CauseEvidence:
        """Of one cause."""
        return next(c for c in self.causes if c.name == name)

    def angle_to(self, problem: LinearProblem, effect: CauseEvidence, other: str) -> float:
        """Between the effect of a cause as it was found and all that another can do, degrees.

        A cause with several numbers explains more than one with few, so that this is not the same
        both ways.
        """
        G = self.projected
        own = problem.found.index("cause", effect.name, effect.scan)
        e = np.array(effect.coefficients)
        norm = float(e @ G[np.ix_(own, own)] @ e)
        best = 0.0
        for scan in problem.found.scans(other):
            columns = problem.found.index("cause", other, scan)
            b = G[np.ix_(columns, own)] @ e
            best = max(best, float(b @ scaled_inverse(G[np.ix_(columns, columns)], 1e-8) @ b))
        return float(np.degrees(np.arccos(np.sqrt(min(best / max(norm, 1e-12), 1.0)))))


class _Statistics:
    """Gains of all causes from Gram matrices, given what is assumed already."""

    def __init__(self, problem: LinearProblem, assumed: Sequence[tuple[str, float | None]]) -> None:
        self.problem = problem
        found = problem.found
        self.prior = problem.prior()
        self.null = [*problem.base, *problem.numerical, *problem.spline, *problem.usual]
        self.own_extra: list[int] = []
        for name, scan in assumed:
            columns = found.index("cause", name, scan)
            if found.columns[columns[0]].per_record:
                self.own_extra += columns
            else:
                self.null += columns
        skipped = {name for name, _ in assumed}
        self.names = [name for name in found.causes if name not in skipped]
        self.options: list[tuple[str, float | None, list[int]]] = [
            (name, scan, found.index("cause", name, scan))
            for name in self.names
            for scan in found.scans(name)
        ]
        self.per_record = {
            name: any(found.columns[k].per_record for k in found.index("cause", name))
            for name in self.names
        }

    def reduced(self, gram: np.ndarray) -> np.ndarray:
        """Without what is each record's own."""
        own, variance = self.problem.own_prior()
        variance = np.concatenate([variance, np.full(len(self.own_extra), FLAT)])
        own = [*own, *self.own_extra]
        return np.array([integrate_out(G, own, variance) for G in gram])

    def project(self, total: np.ndarray) -> np.ndarray:
        """What is left of a summed Gram matrix beside the null's columns."""
        null = self.null
        inverse = scaled_inverse(total[np.ix_(null, null)] + np.diag(self.prior[null]))
        return np.asarray(total - total[:, null] @ inverse @ total[null])

    def gains(self, gram: np.ndarray) -> tuple[dict[str, tuple[float, float | None]], np.ndarray]:
        """Of each cause the largest gain and its scan; and the projected Gram matrix."""
        y = self.problem.size
        reduced = self.reduced(gram)
        projected = self.project(reduced.sum(0))
        out: dict[str, tuple[float, float | None]] = {}
        for name, scan, columns in self.options:
            if self.per_record[name]:
                inner = np.array(
                    [integrate_out(G, columns, np.full(len(columns), FLAT)) for G in reduced]
                )
                gain = float(projected[y, y] - self.project(inner.sum(0))[y, y])
            else:
                gain = self._bounded_gain(projected, columns)[0]
            if name not in out or gain > out[name][0]:
                out[name] = gain, scan
        return out, projected

    def _bounded_gain(
        self, projected: np.ndarray, columns: list[int]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Gain, coefficients and their errors, within the bounds of one-sided parameters."""
        y = self.problem.size
        kinds = self.problem.found.columns
        A, b = projected[np.ix_(columns, columns)], projected[columns, y]
        visible = np.diag(A) > 1e-9
        best = (0.0, np.zeros(len(columns)), np.full(len(columns), np.inf))
        # So few parameters that every set of active ones is tried.
        for bits in range(1, 2 ** len(columns)):
            active = [k for k in range(len(columns)) if bits >> k & 1 and visible[k]]
            if not active:
                continue
            inverse = np.linalg.pinv(A[np.ix_(active, active)], rcond=1e-10, hermitian=True)
            g = inverse @ b[active]
            if any(kinds[columns[k]].one_sided and x < 0.0 for k, x in zip(active, g, strict=True)):
                continue
            gain = float(b[active] @ g)
            if gain > best[0]:
                value, error = np.zeros(len(columns)), np.full(len(columns), np.inf)
                value[active] = g
                error[active] = np.sqrt(np.maximum(np.diag(inverse), 0.0))
                best = gain, value, error
        return best

    def misfit(self, gram: np.ndarray, projected: np.ndarray) -> float:
        """Gain by a correction of each condition."""
        y = self.problem.size
        reduced = self.reduced(gram)
        correction = self.problem.correction
        variance = np.full(len(correction), CORRECTION_VARIANCE)
        total = np.zeros_like(reduced[0])
        for members in self.problem.conditions.values():
            total += integrate_out(reduced[members].sum(0), correction, variance)
        return float(projected[y, y] - self.project(total)[y, y])

    def coefficients(
        self, gram: np.ndarray, projected: np.ndarray, columns: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of a cause's columns; where each record has its own their mean and its standard error."""
        kinds = self.problem.found.columns
        if not kinds[columns[0]].per_record:
            _, value, error = self._bounded_gain(projected, columns)
            return value, error
        y = self.problem.size
        own = []
        for G in self.reduced(gram):
            A, b = G[np.ix_(columns, columns)], G[columns, y]
            if np.diag(A).min() > 1e-9:
                own.append(np.linalg.lstsq(A, b, rcond=1e-9)[0])
        if not own:
            return np.zeros(len(columns)), np.full(len(columns), np.inf)
        spread = np.std(own, axis=0, ddof=1) if len(own) > 1 else np.full(len(columns), np.inf)
        return np.mean(own, axis=0), spread / np.sqrt(len(own))


def screen(
    problem: LinearProblem,
    replicates: int = 200,
    seed: int = 0,
    assumed: Sequence[tuple[str, float | None]] = (),
    progress: Callable[[int], None] | None = None,
) -> Screening:
    """Tests all causes against the records.

    The gains' distribution where nothing is wrong is that of records drawn anew: what differs from
    slice to slice is drawn for each record, its standard deviation itself from what its estimate
    leaves open, and noise is added; the discretisation's error is drawn once for all.

    Args:
        problem: The records' moments.
        replicates: Of the bootstrap.
        seed: Of the bootstrap.
        assumed: Causes, each at a value of its scan, that are part of the model already.
        progress: Called with the replicates done.
    """
    statistics = _Statistics(problem, assumed)
    gram = problem.moments.gram
    gains, projected = statistics.gains(gram)
    misfit = statistics.misfit(gram, projected)
    rng = np.random.default_rng(seed)
    draw = _Bootstrap(problem, rng)
    null_gains: dict[str, list[float]] = {name: [] for name in statistics.names}
    null_misfits = []
    for k in range(replicates):
        sample = draw()
        own, inside = statistics.gains(sample)
        for name, (gain, _) in own.items():
            null_gains[name].append(gain)
        null_misfits.append(statistics.misfit(sample, inside))
        if progress is not None:
            progress(k + 1)
    evidence = []
    for name in statistics.names:
        gain, scan = gains[name]
        columns = problem.found.index("cause", name, scan)
        value, error = statistics.coefficients(gram, projected, columns)
        kinds = [problem.found.columns[c] for c in columns]
        null = np.array(null_gains[name])
        evidence.append(
            CauseEvidence(
                name=name,
                gain=gain,
                expected=float(null.mean()),
                deviation=float(null.std()),
                limit=float(np.quantile(null, 0.95)),
                scan=scan,
                parameters=[c.parameter for c in kinds],
                coefficients=value.tolist(),
                errors=error.tolist(),
                sizes=[c.size for c in kinds],
                units=[c.unit for c in kinds],
                per_record=statistics.per_record[name],
            )
        )
    means = np.array([[e.expected] for e in evidence])
    spreads = np.array([[max(e.deviation, 1e-9)] for e in evidence])
    null = (np.array([null_gains[e.name] for e in evidence]) - means) / spreads
    largest = max(e.deviations for e in evidence)
    p = (1.0 + (null.max(0) >= largest).sum()) / (replicates + 1.0)
    p_misfit = (1.0 + (np.array(null_misfits) >= misfit).sum()) / (replicates + 1.0)
    angles, visible = _angles(statistics, projected)
    return Screening(
        causes=sorted(evidence, key=lambda e: -e.score),
        p_value=float(p),
        misfit=misfit,
        expected_misfit=float(np.mean(null_misfits)),
        misfit_p_value=float(p_misfit),
        angles=angles,
        visible=visible,
        names=statistics.names,
        projected=projected,
    )


class _Bootstrap:
    """Gram matrices of records in which nothing is wrong."""

    def __init__(self, problem: LinearProblem, rng: np.random.Generator) -> None:
        self.problem, self.rng = problem, rng
        gram = problem.moments.gram[:, :-1, :-1]
        values, vectors = np.linalg.eigh(gram)
        values = np.where(values > 1e-12 * values.max(1, keepdims=True), values, 0.0)
        self.roots = vectors * np.sqrt(values)[:, None, :]
        inverse = np.where(values > 0.0, 1.0 / np.sqrt(np.where(values > 0.0, values, 1.0)), 0.0)
        self.whitening = vectors * inverse[:, None, :]

    def __call__(self) -> np.ndarray:
        problem, rng = self.problem, self.rng
        gram = problem.moments.gram.copy()
        count, y = len(gram), problem.size
        samples = max(problem.variation_samples, 1)
        spread = problem.variation * np.sqrt(
            samples / np.maximum(rng.chisquare(samples, len(problem.own)), 0.1 * samples)
        )
        shared = np.zeros(y)
        shared[problem.numerical] = rng.normal(size=len(problem.numerical))
        shared[problem.spline] = problem.discretisation * rng.normal(size=len(problem.spline))
        for k, deviation in problem.usual.items():
            shared[k] = deviation * rng.normal()
        for r in range(count):
            coefficients = shared.copy()
            coefficients[problem.own] = spread * rng.normal(size=len(problem.own))
            for k, deviation in problem.usual_own.items():
                coefficients[k] += deviation * rng.normal()
            b = gram[r, :-1, :-1] @ coefficients + self.roots[r] @ rng.normal(size=y)
            gram[r, y, :-1] = gram[r, :-1, y] = b
            # Of the square of y only the part that the columns reach matters.
            gram[r, y, y] = float(((self.whitening[r].T @ b) ** 2).sum())
        return gram


def _angles(statistics: _Statistics, projected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least angles between causes [n, n], degrees, and norms of their sensitivities [n]."""
    names = statistics.names
    groups = {
        name: [c for n, _, cs in statistics.options if n == name for c in cs] for name in names
    }
    norm = np.sqrt(np.maximum(np.diag(projected), 1e-12))
    cosine = np.abs(projected) / np.outer(norm, norm)
    # What the null's columns take away entirely has no direction.
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
