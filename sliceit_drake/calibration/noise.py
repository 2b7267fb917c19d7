"""How residuals of slice records scatter: autocorrelated in time, and from slice to slice.

The residuals of one record and channel are a first-order autoregressive process in time plus white
noise: covariance ar^2 exp(-|dt|/tau) + white^2 at equal times. Each record's prediction moreover
has a random scale of its own, with relative standard deviation `record_scale`: slices of the same
food differ. Samples of a record are therefore far from independent, and more samples of one record
do not tell what other slices would give.

The numbers are those of the largest marginal likelihood (restricted maximum likelihood: Patterson
and Thompson 1971), in which what the parameters can absorb of the noise is accounted for.
"""

import dataclasses as dc

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded, solveh_banded
from scipy.optimize import minimize

__all__ = ["NoiseModel", "NoiseFit", "Series", "fit_noise", "list_series"]

LEAST_SHARE = 1e-4
"""Least standard deviation of a series, relative to the root mean square measurement of all."""
SPREAD_PRIOR, TIME_PRIOR = 2.0, 1.5
"""Standard deviations of weak priors on logarithms: of the standard deviations about the residuals'
own, and of the correlation time about the middle between step and duration."""
LEAST_SCALE, LARGEST_SCALE = 1e-3, 1.0
FLAT = 1e-6
"""Precision of parameters without a prior, relative to what the data say of them."""
DRAWS = 48
STEP = 0.05


@dc.dataclass(frozen=True)
class Series:
    """One channel of one record.

    Attributes:
        rows: Its entries that are used, in the row of all measurements [n].
        time: Of them [n], s, increasing.
        record: Index of the record.
        group: Series of one group share their numbers.
    """

    rows: np.ndarray
    time: np.ndarray
    record: int
    group: int


@dc.dataclass
class NoiseModel:
    """Covariance of the residuals.

    Attributes:
        series: Of all records.
        ar: Standard deviation of the autoregressive part of each group [G], N.
        tau: Its correlation time [G], s.
        white: Standard deviation of the white part [G], N.
        record_scale: Relative standard deviation of the prediction from record to record; None
            where no condition was repeated, so that it is unknown.
        scales: Change of the residuals by each record's scale [M, records]; [M, 0] if unknown.
    """

    series: list[Series]
    ar: np.ndarray
    tau: np.ndarray
    white: np.ndarray
    record_scale: float | None
    scales: np.ndarray

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """The inverse covariance times columns [M, k]; entries that are not used become zero."""
        out = self._solve_within(columns)
        if self.record_scale is None:
            return out
        F = self.scales
        PF = self._solve_within(F)
        inner = np.eye(F.shape[1]) / self.record_scale**2 + F.T @ PF
        return np.asarray(out - PF @ np.linalg.solve(inner, PF.T @ columns))

    def _solve_within(self, columns: np.ndarray) -> np.ndarray:
        out = np.zeros_like(columns)
        for s in self.series:
            ar, tau, white = self.ar[s.group], self.tau[s.group], self.white[s.group]
            out[s.rows] = _Covariance(s.time, ar, tau, white).solve(columns[s.rows])
        return out

    @property
    def effective_samples(self) -> float:
        """Number of independent samples that would tell a constant as well, all series together.

        Of each series var * 1' V^-1 1 with the variance var of a sample.
        """
        total = 0.0
        for s in self.series:
            ar, tau, white = self.ar[s.group], self.tau[s.group], self.white[s.group]
            one = np.ones((len(s.rows), 1))
            total += (ar**2 + white**2) * float(
                _Covariance(s.time, ar, tau, white).solve(one).sum()
            )
        return total

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """A sample of the noise [size]; entries that are not used are zero."""
        out = np.zeros(size)
        for s in self.series:
            ar, tau, white = self.ar[s.group], self.tau[s.group], self.white[s.group]
            out[s.rows] = _Covariance(s.time, ar, tau, white).sample(rng)
        if self.record_scale is not None:
            out += self.scales @ rng.normal(0.0, self.record_scale, self.scales.shape[1])
        return out


class _Covariance:
    """ar^2 exp(-|dt|/tau) + white^2 I at increasing times.

    The inverse T of the first part is tridiagonal (Markov), so that with V = T^-1 + w I,
    V^-1 = T (I + w T)^-1 costs as much as there are samples.
    """

    def __init__(self, time: np.ndarray, ar: float, tau: float, white: float) -> None:
        rho = np.exp(-np.diff(time) / tau)
        gain = 1.0 / np.maximum(1.0 - rho**2, 1e-12)
        # Each sample given the one before it.
        diagonal = np.zeros(len(time))
        diagonal[0] = 1.0
        diagonal[1:] += gain
        diagonal[:-1] += rho**2 * gain
        self._band = np.vstack([np.concatenate([[0.0], -rho * gain]), diagonal]) / ar**2
        # log det T^-1 from the innovations.
        self._log_det_first = 2.0 * len(time) * np.log(ar) - np.log(gain).sum()
        self._white = white
        self._shifted = white**2 * self._band
        self._shifted[1] += 1.0

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """V^-1 times columns [n, k]."""
        inner = solveh_banded(self._shifted, columns, check_finite=False)
        # T (I + w T)^-1 = (I - (I + w T)^-1) / w loses digits where w is small.
        out = self._band[1][:, None] * inner
        off = self._band[0, 1:, None]
        out[:-1] += off * inner[1:]
        out[1:] += off * inner[:-1]
        return np.asarray(out)

    def log_det(self) -> float:
        """log det V."""
        factor = cholesky_banded(self._shifted, check_finite=False)
        return float(self._log_det_first + 2.0 * np.log(factor[1]).sum())

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """A sample [n]."""
        n = self._band.shape[1]
        factor = cholesky_banded(self._band, check_finite=False)
        first = solve_banded((0, 1), factor, rng.normal(size=n), check_finite=False)
        return np.asarray(first + self._white * rng.normal(size=n))


def list_series(
    used: np.ndarray,
    time: np.ndarray,
    record_of: np.ndarray,
    channels: list[int],
    conditions: list[str],
) -> tuple[list[Series], int]:
    """Lists the series of all records, and the number of groups.

    Replicates share the numbers of a channel; records of different conditions do not, because what
    the model lacks depends on the speed.

    Args:
        used: Mask of the entries that count [M].
        time: Of each entry in its record [M], s.
        record_of: Record of each entry [M]; entries of a record are in a row, channels innermost.
        channels: Number of channels of each record.
        conditions: Of each record; "" is none.
    """
    groups: dict[tuple[str, int], int] = {}
    out = []
    for record, (count, condition) in enumerate(zip(channels, conditions, strict=True)):
        rows = np.flatnonzero(record_of == record)
        for channel in range(count):
            own = rows[channel::count]
            own = own[used[own]]
            if own.size == 0:
                continue
            key = (condition or f"record {record}", channel)
            group = groups.setdefault(key, len(groups))
            out.append(Series(own, time[own], record, group))
    return out, len(groups)


@dc.dataclass
class NoiseFit:
    """A noise model with the parameters' estimate that belongs to it.

    Attributes:
        model: The noise model.
        shift: From the place of linearisation to the estimate [d].
        covariance: Of the estimate if the noise model were known [d, d].
        inflated: With what is not known of the noise model itself [d, d].
    """

    model: NoiseModel
    shift: np.ndarray
    covariance: np.ndarray
    inflated: np.ndarray


def fit_noise(
    series: list[Series],
    residuals: np.ndarray,
    jacobian: np.ndarray,
    nuisance: np.ndarray,
    prediction: np.ndarray,
    prior_mean: np.ndarray,
    prior_variance: float,
    level: float,
    replicated: bool,
) -> NoiseFit:
    """Fits the noise, with the parameters integrated out of the linear problem.

    The parameters' uncertainty then is averaged over what is not known of the noise (samples of a
    normal approximation in the logarithms of its numbers).

    Args:
        series: From `list_series`.
        residuals: [M], N.
        jacobian: By the parameters [M, d].
        nuisance: By numbers without a prior [M, q].
        prediction: [M], N: the change by a record's scale.
        prior_mean: Of the parameters, from the place of linearisation [d].
        prior_variance: Of each parameter.
        level: Root mean square of the measurement, N.
        replicated: Whether records have a condition in common, so that their variation shows.
    """
    problem = _Problem(
        series, residuals, jacobian, nuisance, prediction, prior_mean, prior_variance, level
    )
    start, bounds = problem.start(replicated)
    found = minimize(
        problem.objective, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60}
    )
    x = found.x
    covariance, shift = problem.estimate(x)
    inflated = problem.averaged(x, np.array(bounds))
    return NoiseFit(problem.model(x), shift, covariance, inflated)


class _Problem:
    """Marginal likelihood of the noise's numbers x: three logarithms a group, that of the scale."""

    def __init__(
        self,
        series: list[Series],
        residuals: np.ndarray,
        jacobian: np.ndarray,
        nuisance: np.ndarray,
        prediction: np.ndarray,
        prior_mean: np.ndarray,
        prior_variance: float,
        level: float,
    ) -> None:
        self.series = series
        self.groups = 1 + max(s.group for s in series)
        self.d, self.q = jacobian.shape[1], nuisance.shape[1]
        records = sorted({s.record for s in series})
        self.scales = np.zeros((len(residuals), len(records)))
        for s in series:
            self.scales[s.rows, records.index(s.record)] = prediction[s.rows]
        columns = np.column_stack([residuals, jacobian, nuisance, self.scales])
        self.columns = [columns[s.rows] for s in series]
        self.prior_mean, self.prior_precision = prior_mean, 1.0 / prior_variance
        self.least = LEAST_SHARE * level
        rough = [np.concatenate([residuals[s.rows] for s in self._of(g)]) for g in self._all()]
        self.spread = np.array(
            [max(float(np.sqrt(np.mean(r**2))), 2.0 * self.least) for r in rough]
        )
        self.step = np.array(
            [np.median(np.concatenate([np.diff(s.time) for s in self._of(g)])) for g in self._all()]
        )
        self.duration = np.array([max(np.ptp(s.time) for s in self._of(g)) for g in self._all()])
        self.middle = np.sqrt(self.step * self.duration)
        self._pieces: dict[tuple, tuple[np.ndarray, float]] = {}

    def _all(self) -> range:
        return range(self.groups)

    def _of(self, group: int) -> list[Series]:
        return [s for s in self.series if s.group == group]

    def start(self, replicated: bool) -> tuple[np.ndarray, list[tuple[float, float]]]:
        """First values and bounds; a last one for the records' scale if they are replicated."""
        x, bounds = [], []
        for g in self._all():
            spread = (float(np.log(self.least)), float(np.log(10.0 * self.spread[g])))
            x += [
                np.log(0.9 * self.spread[g]),
                np.log(self.middle[g]),
                np.log(0.3 * self.spread[g]),
            ]
            time = (float(np.log(self.step[g] / 3.0)), float(np.log(2.0 * self.duration[g])))
            bounds += [spread, time, spread]
        if replicated:
            x.append(np.log(0.1))
            bounds.append((float(np.log(LEAST_SCALE)), float(np.log(LARGEST_SCALE))))
        return np.array(x), bounds

    def model(self, x: np.ndarray) -> NoiseModel:
        ar, tau, white = np.exp(x[: 3 * self.groups]).reshape(-1, 3).T
        scale = float(np.exp(x[-1])) if self._replicated(x) else None
        scales = self.scales if scale is not None else np.zeros((len(self.scales), 0))
        return NoiseModel(self.series, ar, tau, white, scale, scales)

    def _replicated(self, x: np.ndarray) -> bool:
        return len(x) > 3 * self.groups

    def _piece(self, group: int, numbers: tuple[float, ...]) -> tuple[np.ndarray, float]:
        """B' V^-1 B of a group's columns B, and log det V."""
        key = (group, numbers)
        if key not in self._pieces:
            ar, tau, white = np.exp(numbers)
            gram, log_det = np.zeros((self.columns[0].shape[1],) * 2), 0.0
            for s, B in zip(self.series, self.columns, strict=True):
                if s.group == group:
                    V = _Covariance(s.time, ar, tau, white)
                    gram += B.T @ V.solve(B)
                    log_det += V.log_det()
            if len(self._pieces) > 64 * self.groups:
                self._pieces.clear()
            self._pieces[key] = gram, log_det
        return self._pieces[key]

    def _system(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Precision A and right side b of all unknowns, rest of the cost, log det of the prior."""
        gram, log_det = np.zeros(()), 0.0
        for g in self._all():
            piece, own = self._piece(g, tuple(x[3 * g : 3 * g + 3].tolist()))
            gram, log_det = gram + piece, log_det + own
        G = np.asarray(gram)
        keep = np.arange(1, len(G) if self._replicated(x) else 1 + self.d + self.q)
        A, b = G[np.ix_(keep, keep)].copy(), -G[keep, 0]
        precision = np.zeros(len(keep))
        precision[: self.d] = self.prior_precision
        size = np.diag(A)[self.d : self.d + self.q]
        precision[self.d : self.d + self.q] = np.where(size > 0.0, FLAT * size, 1.0)
        log_prior = 0.0
        if self._replicated(x):
            precision[self.d + self.q :] = np.exp(-2.0 * x[-1])
            log_prior = -2.0 * x[-1] * self.scales.shape[1]
        A[np.diag_indices(len(A))] += precision
        b[: self.d] += self.prior_precision * self.prior_mean
        rest = G[0, 0] + self.prior_precision * float(self.prior_mean @ self.prior_mean)
        return A, b, rest + log_det, log_prior

    def objective(self, x: np.ndarray) -> float:
        """-2 log of likelihood times weak priors."""
        A, b, rest, log_prior = self._system(x)
        factor = np.linalg.cholesky(A)
        y = np.linalg.solve(factor, b)
        value = rest - log_prior + 2.0 * np.log(np.diag(factor)).sum() - float(y @ y)
        ar, tau, white = x[: 3 * self.groups].reshape(-1, 3).T
        value += (((ar - np.log(self.spread)) / SPREAD_PRIOR) ** 2).sum()
        value += (((white - np.log(self.spread)) / SPREAD_PRIOR) ** 2).sum()
        value += (((tau - np.log(self.middle)) / TIME_PRIOR) ** 2).sum()
        if self._replicated(x):
            # Keeps the scale from zero, where few records put it by chance (Chung et al. 2013).
            value -= 2.0 * x[-1]
        return float(value)

    def estimate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Covariance [d, d] and shift [d] of the parameters for this noise."""
        A, b, _, _ = self._system(x)
        covariance = np.linalg.inv(A)
        return covariance[: self.d, : self.d], (covariance @ b)[: self.d]

    def averaged(self, x: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Covariance [d, d] averaged over the noise's own uncertainty."""
        blocks = [list(range(3 * g, 3 * g + 3)) for g in self._all()]
        if self._replicated(x):
            blocks.append([len(x) - 1])
        rng = np.random.default_rng(0)
        sets = np.tile(x, (DRAWS, 1))
        for block in blocks:
            sets[:, block] += self._scatter(x, block, rng)
        sets = np.clip(sets, bounds[:, 0], bounds[:, 1])
        pairs = [self.estimate(s) for s in sets]
        shifts = np.array([shift for _, shift in pairs])
        within = np.mean([covariance for covariance, _ in pairs], axis=0)
        center = self.estimate(x)[1]
        return np.asarray(within + (shifts - center).T @ (shifts - center) / DRAWS)

    def _scatter(self, x: np.ndarray, block: list[int], rng: np.random.Generator) -> np.ndarray:
        """Draws of some numbers about their best [DRAWS, block], by the objective's curvature."""
        n = len(block)
        steps = np.zeros((n, len(x)))
        steps[np.arange(n), block] = STEP
        middle = self.objective(x)
        H = np.zeros((n, n))
        for i in range(n):
            up, down = self.objective(x + steps[i]), self.objective(x - steps[i])
            H[i, i] = (up - 2.0 * middle + down) / STEP**2
            for j in range(i):
                corners = [
                    self.objective(x + a * steps[i] + b * steps[j])
                    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
                ]
                mixed = (corners[0] - corners[1] - corners[2] + corners[3]) / (4.0 * STEP**2)
                H[i, j] = H[j, i] = mixed
        # The objective is -2 log likelihood. Where it is flat or bent down, the priors' width.
        values, vectors = np.linalg.eigh(0.5 * H)
        spread = 1.0 / np.sqrt(np.maximum(values, 1.0 / SPREAD_PRIOR**2))
        return np.asarray((rng.normal(size=(DRAWS, n)) * spread) @ vectors.T)
