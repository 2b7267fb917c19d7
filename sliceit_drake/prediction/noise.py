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
import functools

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded, solveh_banded
from scipy.optimize import minimize

__all__ = [
    "EvenNoise",
    "MarkovCovariance",
    "NoiseModel",
    "NoiseProblem",
    "SeriesGroup",
    "group_series",
]

MIN_SHARE = 1e-4
"""Least standard deviation of a series, relative to the root mean square measurement of all."""
SPREAD_PRIOR, TIME_PRIOR = 2.0, 1.5
"""Standard deviations of weak priors on logarithms: of the standard deviations about the residuals'
own, and of the correlation time about the middle between step and duration."""
MIN_SCALE, FIRST_SCALE, LARGEST_SCALE = 1e-3, 0.1, 1.0
FLAT = 1e-6
"""Precision of parameters without a prior, relative to what the data say of them."""
DRAWS = 48
STEP = 0.05
KEPT = 64


@dc.dataclass(frozen=True)
class SeriesGroup:
    """One channel of the records of one condition, one record after the other.

    Attributes:
        rows: Entries that are used, in the row of all measurements [n].
        gap: Time from each to the next [n - 1], s; infinite where a record begins.
    """

    rows: np.ndarray
    gap: np.ndarray


@dc.dataclass(frozen=True)
class EvenNoise:
    """Noise that is independent from entry to entry, with one variance, N^2: least squares."""

    variance: float

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """The inverse covariance times columns [M, k]."""
        return columns / self.variance


@dc.dataclass
class NoiseModel:
    """Covariance of the residuals.

    Attributes:
        groups: Of all records; the entries of a group share the numbers below.
        ar: Standard deviation of the autoregressive part of each group [G], N.
        tau: Its correlation time [G], s.
        white: Standard deviation of the white part [G], N.
        record_scale: Relative standard deviation of the prediction from record to record; None
            where no condition was repeated, so that it is unknown.
        scales: Change of the residuals by each record's scale [M, records]; [M, 0] if unknown.
    """

    groups: list[SeriesGroup]
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
        for group, V in zip(self.groups, self._covariances(), strict=True):
            out[group.rows] = V.solve(columns[group.rows])
        return out

    def _covariances(self) -> list["MarkovCovariance"]:
        numbers = zip(self.groups, self.ar, self.tau, self.white, strict=True)
        return [MarkovCovariance(group.gap, *own) for group, *own in numbers]

    @property
    def effective_samples(self) -> float:
        """Number of independent samples that would tell a constant as well, all series together.

        Of each group var * 1' V^-1 1 with the variance var of a sample.
        """
        total = 0.0
        for group, V in zip(self.groups, self._covariances(), strict=True):
            total += V.variance * float(V.solve(np.ones((len(group.rows), 1))).sum())
        return total

    @property
    def evened(self) -> EvenNoise:
        """Independent noise that would leave a constant as uncertain."""
        variance = (self.ar**2 + self.white**2) @ [len(g.rows) for g in self.groups]
        return EvenNoise(float(variance) / self.effective_samples)


class MarkovCovariance:
    """ar^2 exp(-|dt|/tau) + diag(white^2); entries an infinite gap apart are independent.

    The inverse T of the first part is tridiagonal (Markov), so that with W = diag(white),
    V^-1 = W^-1 (I + W T W)^-1 W T costs as much as there are samples.

    Args:
        gap: Times between entries [n - 1], s.
        ar: Standard deviation of the correlated part.
        tau: Its correlation time, s.
        white: Standard deviation of the rest, of all entries or of each [n]; positive.
    """

    def __init__(self, gap: np.ndarray, ar: float, tau: float, white: float | np.ndarray) -> None:
        rho, n = np.exp(-gap / tau), len(gap) + 1
        gain = 1.0 / np.maximum(1.0 - rho**2, 1e-12)
        # Each sample given the one before it.
        diagonal = np.zeros(n)
        diagonal[0] = 1.0
        diagonal[1:] += gain
        diagonal[:-1] += rho**2 * gain
        self._band = np.vstack([np.concatenate([[0.0], -rho * gain]), diagonal]) / ar**2
        # log det T^-1 from the innovations.
        self._log_det_first = 2.0 * n * np.log(ar) - np.log(gain).sum()
        self._white = np.broadcast_to(np.asarray(white, float), (n,))
        self.variance = ar**2 + float((self._white**2).mean())
        self._shifted = self._band * self._white**2
        self._shifted[0, 1:] = self._band[0, 1:] * self._white[1:] * self._white[:-1]
        self._shifted[1] += 1.0

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """V^-1 times columns [n, k]."""
        white = self._white[:, None]
        out = self._band[1][:, None] * columns
        off = self._band[0, 1:, None]
        out[:-1] += off * columns[1:]
        out[1:] += off * columns[:-1]
        return np.asarray(solveh_banded(self._shifted, white * out, check_finite=False) / white)

    def product(self, columns: np.ndarray) -> np.ndarray:
        """V times columns [n, k]."""
        first = solveh_banded(self._band, columns, check_finite=False)
        return np.asarray(first + self._white[:, None] ** 2 * columns)

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


def group_series(
    used: np.ndarray,
    time: np.ndarray,
    record_of: np.ndarray,
    channels: list[int],
    conditions: list[str],
) -> list[SeriesGroup]:
    """Lists the series of all records by condition and channel.

    Replicates share the numbers of a channel; records of different conditions do not, because what
    the model lacks depends on the speed.

    Args:
        used: Mask of the entries that count [M].
        time: Of each entry in its record [M], s.
        record_of: Record of each entry [M]; entries of a record are in a row, channels innermost.
        channels: Number of channels of each record.
        conditions: Of each record; "" is none.
    """
    groups: dict[tuple[str, int], list[np.ndarray]] = {}
    for record, (count, condition) in enumerate(zip(channels, conditions, strict=True)):
        rows = np.flatnonzero(record_of == record)
        for channel in range(count):
            own = rows[channel::count]
            own = own[used[own]]
            if own.size:
                groups.setdefault((condition or f"record {record}", channel), []).append(own)
    out = []
    for members in groups.values():
        rows = np.concatenate(members)
        gap = np.diff(time[rows])
        gap[np.cumsum([len(m) for m in members])[:-1] - 1] = np.inf
        out.append(SeriesGroup(rows, gap))
    return out


class NoiseProblem:
    """Fits the noise, with the parameters integrated out of the linear problem.

    What is fitted are logarithms x: three a group, and that of the scale where cuts were repeated.

    Args:
        groups: From `group_series`.
        residuals: [M], N.
        jacobian: By the parameters [M, d].
        nuisance: By numbers without a prior [M, q].
        scales: By the scale of each record [M, records]; [M, 0] where no cut was repeated, so that
            their variation does not show.
        prior_mean: Of the parameters, from the place of linearisation [d].
        prior_variance: Of each parameter.
        level: Root mean square of the measurement, N.
    """

    def __init__(
        self,
        groups: list[SeriesGroup],
        residuals: np.ndarray,
        jacobian: np.ndarray,
        nuisance: np.ndarray,
        scales: np.ndarray,
        prior_mean: np.ndarray,
        prior_variance: float,
        level: float,
    ) -> None:
        self._groups, self._scales = groups, scales
        self._d, self._q = jacobian.shape[1], nuisance.shape[1]
        columns = np.column_stack([residuals, jacobian, nuisance, scales])
        self._columns = [columns[g.rows] for g in groups]
        self._prior_mean, self._prior_precision = prior_mean, 1.0 / prior_variance
        least = MIN_SHARE * level
        rough = [float(np.sqrt(np.mean(residuals[g.rows] ** 2))) for g in groups]
        self._spread = np.maximum(rough, 2.0 * least)
        known = [g.gap[np.isfinite(g.gap)] for g in groups]
        step = np.array([np.median(gap) if gap.size else 1.0 for gap in known])
        # Of the records of a group together; only the order of magnitude matters.
        duration = np.array([max(gap.sum(), 3.0 * s) for gap, s in zip(known, step, strict=True)])
        self._middle = np.sqrt(step * duration)
        first, bounds = [], []
        for g in range(len(groups)):
            spread = (float(np.log(least)), float(np.log(10.0 * self._spread[g])))
            first += [0.9 * self._spread[g], self._middle[g], 0.3 * self._spread[g]]
            bounds += [spread, (np.log(step[g] / 3.0), np.log(2.0 * duration[g])), spread]
        self._replicated = scales.shape[1] > 0
        if self._replicated:
            first.append(FIRST_SCALE)
            bounds.append((np.log(MIN_SCALE), np.log(LARGEST_SCALE)))
        self._first, self._bounds = np.log(first), np.array(bounds)
        self._piece = functools.lru_cache(KEPT * len(groups))(self._new_piece)

    def fit(self, start: NoiseModel | None = None) -> NoiseModel:
        """The noise of largest marginal likelihood.

        Args:
            start: A noise model of the same groups that is nearly right.
        """
        self._numbers = minimize(
            self._objective,
            self._first if start is None else self._numbers_of(start),
            method="L-BFGS-B",
            bounds=self._bounds,
            options={"maxiter": 60, "ftol": 1e-6},
        ).x
        ar, tau, white = np.exp(self._numbers[: 3 * len(self._groups)]).reshape(-1, 3).T
        scale = float(np.exp(self._numbers[-1])) if self._replicated else None
        return NoiseModel(self._groups, ar, tau, white, scale, self._scales)

    @property
    def cost(self) -> float:
        """-2 log of the marginal likelihood of what was fitted, but for a constant."""
        return self._objective(self._numbers)

    def covariance(self) -> np.ndarray:
        """Covariance of the parameters [d, d], if the noise were exactly what was fitted."""
        return self._estimate(self._numbers)[0]

    def _numbers_of(self, model: NoiseModel) -> np.ndarray:
        x = np.column_stack([model.ar, model.tau, model.white]).ravel()
        if model.record_scale is not None:
            x = np.append(x, model.record_scale)
        return np.clip(np.log(x), self._bounds[:, 0], self._bounds[:, 1])

    def _new_piece(self, group: int, numbers: tuple[float, ...]) -> tuple[np.ndarray, float]:
        """B' V^-1 B of a group's columns B, and log det V."""
        V = MarkovCovariance(self._groups[group].gap, *np.exp(numbers))
        B = self._columns[group]
        return B.T @ V.solve(B), V.log_det()

    def _system(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Precision A and right side b of all unknowns, rest of the cost, log det of the prior."""
        gram, log_det = np.zeros(()), 0.0
        for g in range(len(self._groups)):
            piece, own = self._piece(g, tuple(x[3 * g : 3 * g + 3].tolist()))
            gram, log_det = gram + piece, log_det + own
        G = np.asarray(gram)
        A, b = G[1:, 1:].copy(), -G[1:, 0]
        precision = np.zeros(len(A))
        precision[: self._d] = self._prior_precision
        size = np.diag(A)[self._d : self._d + self._q]
        precision[self._d : self._d + self._q] = np.where(size > 0.0, FLAT * size, 1.0)
        log_prior = 0.0
        if self._replicated:
            precision[self._d + self._q :] = np.exp(-2.0 * x[-1])
            log_prior = -2.0 * x[-1] * self._scales.shape[1]
        A[np.diag_indices(len(A))] += precision
        b[: self._d] += self._prior_precision * self._prior_mean
        rest = G[0, 0] + self._prior_precision * float(self._prior_mean @ self._prior_mean)
        return A, b, rest + log_det, log_prior

    def _objective(self, x: np.ndarray) -> float:
        """-2 log of likelihood times weak priors."""
        A, b, rest, log_prior = self._system(x)
        factor = np.linalg.cholesky(A)
        y = np.linalg.solve(factor, b)
        value = rest - log_prior + 2.0 * np.log(np.diag(factor)).sum() - float(y @ y)
        ar, tau, white = x[: 3 * len(self._groups)].reshape(-1, 3).T
        value += (((ar - np.log(self._spread)) / SPREAD_PRIOR) ** 2).sum()
        value += (((white - np.log(self._spread)) / SPREAD_PRIOR) ** 2).sum()
        value += (((tau - np.log(self._middle)) / TIME_PRIOR) ** 2).sum()
        if self._replicated:
            # Keeps the scale from zero, where few records put it by chance (Chung et al. 2013).
            value -= 2.0 * x[-1]
        return float(value)

    def _estimate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Covariance [d, d] and shift [d] of the parameters for this noise."""
        A, b, _, _ = self._system(x)
        covariance = np.linalg.inv(A)
        return covariance[: self._d, : self._d], (covariance @ b)[: self._d]

    def averaged_covariance(self) -> np.ndarray:
        """Covariance of the parameters [d, d], averaged over the uncertainty of what was fitted.

        The average is over samples of a normal approximation in the logarithms of its numbers.
        """
        sets = self._draws()
        pairs = [self._estimate(s) for s in sets]
        shifts = np.array([shift for _, shift in pairs])
        within = np.mean([covariance for covariance, _ in pairs], axis=0)
        center = self._estimate(self._numbers)[1]
        return np.asarray(within + (shifts - center).T @ (shifts - center) / DRAWS)

    def covariance_of_least_squares(self, variance: float) -> np.ndarray:
        """Covariance [d, d] of the fit that takes all entries for independent, of one variance.

        Its weights are not those of the noise, so that its covariance is A^-1 B A^-1, where B is
        what the noise does to the gradient (the sandwich of Huber 1967 and White 1980), averaged
        over the uncertainty of what was fitted. Where the entries say nothing the prior is left.
        """
        d, q = self._d, self._q
        columns = np.concatenate(self._columns)
        J, N, F = np.split(columns[:, 1:], [d, d + q], axis=1)
        if q:
            J = J - N @ np.linalg.lstsq(N, J, rcond=None)[0]
        ends = np.cumsum([len(c) for c in self._columns])[:-1]
        scaled = F.T @ J
        prior = self._prior_precision * np.eye(d)
        inverse = np.linalg.inv(J.T @ J / variance + prior)
        B = np.zeros((d, d))
        for x in self._draws():
            numbers = np.exp(x[: 3 * len(self._groups)].reshape(-1, 3))
            for group, part, own in zip(self._groups, np.split(J, ends), numbers, strict=True):
                B += part.T @ MarkovCovariance(group.gap, *own).product(part)
            if self._replicated:
                B += np.exp(2.0 * x[-1]) * scaled.T @ scaled
        return np.asarray(inverse @ (B / DRAWS / variance**2 + prior) @ inverse)

    def _draws(self) -> np.ndarray:
        """Draws of what was fitted [DRAWS, numbers], with its uncertainty."""
        x = self._numbers
        blocks = [list(range(3 * g, 3 * g + 3)) for g in range(len(self._groups))]
        if self._replicated:
            blocks.append([len(x) - 1])
        rng = np.random.default_rng(0)
        sets = np.tile(x, (DRAWS, 1))
        for block in blocks:
            sets[:, block] += self._scatter(x, block, rng)
        return np.asarray(np.clip(sets, self._bounds[:, 0], self._bounds[:, 1]))

    def _scatter(self, x: np.ndarray, block: list[int], rng: np.random.Generator) -> np.ndarray:
        """Draws of some numbers about their best [DRAWS, block], by the objective's curvature."""
        n = len(block)
        steps = np.zeros((n, len(x)))
        steps[np.arange(n), block] = STEP
        middle = self._objective(x)
        H = np.zeros((n, n))
        for i in range(n):
            up, down = self._objective(x + steps[i]), self._objective(x - steps[i])
            H[i, i] = (up - 2.0 * middle + down) / STEP**2
            for j in range(i):
                corners = [
                    self._objective(x + a * steps[i] + b * steps[j])
                    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
                ]
                mixed = (corners[0] - corners[1] - corners[2] + corners[3]) / (4.0 * STEP**2)
                H[i, j] = H[j, i] = mixed
        # The objective is -2 log likelihood. Where it is flat or bent down, the priors' width.
        values, vectors = np.linalg.eigh(0.5 * H)
        spread = 1.0 / np.sqrt(np.maximum(values, 1.0 / SPREAD_PRIOR**2))
        return np.asarray((rng.normal(size=(DRAWS, n)) * spread) @ vectors.T)
