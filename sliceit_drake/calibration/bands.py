"""Bands of predicted force: what parameters, noise and the simulation's own error leave open.

A record's force is the simulated one, plus what the parameters may change of it, plus what the
simulation gets wrong by itself (`prediction.discrepancy`), plus noise. All are normal, and their
sizes are those of the records that were fitted. Where nothing was fitted, deeper or at another
speed, parameters and discrepancy are what they were before. Height and speed of a record that was
not fitted are as far from those that were as these are apart.
"""

import dataclasses as dc

import numpy as np
from scipy.special import ndtri

from sliceit_drake.calibration.gauss_newton import PRIOR_CENTER, PRIOR_VARIANCE
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.prediction.discrepancy import (
    PHASES,
    USUAL_SHARE,
    Covariates,
    Discrepancy,
    Sizes,
    motion_shapes,
)
from sliceit_drake.prediction.noise import EvenNoise

__all__ = ["ForceBand", "force_band", "independent"]

WIDER = 1.5
"""Spread of the drawn places over that of the linear problem."""
ROUNDS = 3
"""Alternations of the noise and the sizes of the discrepancy."""
LEAST = 1e-3
"""Least standard deviation of the noise, relative to the root mean square force."""


@dc.dataclass
class ForceBand:
    """Predicted force of records, as normal distributions.

    Attributes:
        mean: Of each entry of the predictor's `measured` [M], N.
        deviation: Standard deviation of a measurement [M], N, noise included.
    """

    mean: np.ndarray
    deviation: np.ndarray

    def interval(self, level: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the band that holds each measurement with a probability `level`, each [M], N."""
        reach = float(ndtri(0.5 + level / 2.0)) * self.deviation
        return self.mean - reach, self.mean + reach


def independent(model: Predictor, residuals: np.ndarray) -> EvenNoise:
    """Independent noise that tells as little as residuals [M], N, whose neighbours are alike."""
    variance = float(np.mean(residuals[model.used] ** 2))
    return EvenNoise(variance * _shared(residuals, model.used, model.record_of))


def force_band(model: Predictor, unit: np.ndarray, draws: int = 0) -> ForceBand:
    """The band of all entries, from those that `model` uses.

    Args:
        model: Of the records; entries that it does not use are predicted from the others.
        unit: The fit to those that it uses [d].
        draws: Slices at places that the parameters may have, as far as the entries tell, weighed by
            how probable these make them; 0 to take the force for linear about the fit, which it is
            where there are entries.

    Raises:
        CuttingError: A slice breaks down near the fit.
    """
    residuals, J = model.jacobian(unit)
    used = model.used
    Z, phase, channel, factors, usual = _shapes(model)
    r, d = -residuals, J.shape[1]
    columns = np.column_stack([Z, J, r])
    z = Z.shape[1]
    level = float(np.sqrt(np.mean(model.measured[used] ** 2)))
    variance = float(np.mean(r[used] ** 2))
    center, prior = np.full(d, PRIOR_CENTER), np.full(d, 1.0 / PRIOR_VARIANCE)
    conditions = _conditions(model)
    problem = Discrepancy(
        range(z), channel, phase, range(z, z + d + 1), [factors[k] for k, _ in conditions], usual
    )
    rest = r
    for _ in range(ROUNDS):
        # Neighbours share their error: they tell as much as fewer rows would.
        weight = 1.0 / independent(model, rest).variance
        grams = [weight * columns[rows & used].T @ columns[rows & used] for _, rows in conditions]
        sizes, _ = problem.fit(grams, range(d), prior)
        coefficients = _Coefficients(problem, sizes, conditions, Z, J)
        mean, _ = coefficients.posterior(r, used, weight, unit, center, prior)
        rest = r - coefficients.columns @ mean
        variance = max(float(np.mean(rest[used] ** 2)), (LEAST * level) ** 2)
    weight = 1.0 / independent(model, rest).variance
    mean, covariance = coefficients.posterior(r, used, weight, unit, center, prior)
    center, prior = _like_the_fitted(model, unit + mean[:d], np.diag(covariance)[:d])
    mean, covariance = coefficients.posterior(r, used, weight, unit, center, prior)
    if draws:
        normal = mean[:d], covariance[:d, :d]
        C = coefficients.columns[:, d:]
        forces, spread = _drawn(model, unit, draws, normal, C, weight, center, prior)
        return ForceBand(forces, np.sqrt(spread + variance))
    A = coefficients.columns
    spread = np.einsum("ij,jk,ik->i", A, covariance, A)
    return ForceBand(model.measured - r + A @ mean, np.sqrt(np.maximum(spread, 0.0) + variance))


def _like_the_fitted(
    model: Predictor, unit: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres and precisions of the places before the data, each [d].

    They are those of uniform ranges, but for height and speed of a record that has no entry in use:
    if two records or more have, these tell where another one is, and how uncertainly.

    Args:
        unit, variance: Of the places after the data [d].
    """
    center = np.full(len(unit), PRIOR_CENTER)
    precision = np.full(len(unit), 1.0 / PRIOR_VARIANCE)
    fitted = {model.targets[k].record.name for k in np.unique(model.record_of[model.used])}
    owners: dict[str, list[tuple[int, bool]]] = {}
    for k, p in enumerate(model.parameters):
        if not p.shared:
            kind, name = p.name.split(":", 1)
            owners.setdefault(kind, []).append((k, name in fitted))
    for own in owners.values():
        known, other = ([k for k, is_known in own if is_known == w] for w in (True, False))
        if len(known) > 1:
            apart = np.var(unit[known], ddof=1) * (1.0 + 1.0 / len(known))
            center[other] = unit[known].mean()
            spread = float(apart + variance[known].mean())
            precision[other] = 1.0 / min(spread, PRIOR_VARIANCE)
    return center, precision


def _drawn(
    model: Predictor,
    unit: np.ndarray,
    draws: int,
    normal: tuple[np.ndarray, np.ndarray],
    C: np.ndarray,
    weight: float,
    center: np.ndarray,
    precision: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the entries [M] without noise, from slices at drawn places.

    Args:
        normal: Mean and covariance of the places from `unit`, as the linear problem has them.
        C: By which the discrepancy's coefficients change the entries [M, n].
        weight: One over the variance of the entries that are used.
        center, precision: Of the places before the data [d].
    """
    rng, used = np.random.default_rng(0), model.used
    values, vectors = np.linalg.eigh(WIDER**2 * normal[1])
    steps = rng.normal(size=(draws, len(unit)))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    places = np.clip(unit + normal[0] + steps @ root.T, 0.0, 1.0)
    rows = model.predict(list(places))
    forces = np.array([np.concatenate([p.predicted.ravel() for p in row]) for row in rows])
    cut = np.isfinite(forces).all(1)
    forces, places, steps = forces[cut], places[cut], steps[cut]
    rest = model.measured - forces
    inner = np.linalg.inv(np.eye(C.shape[1]) + weight * C[used].T @ C[used])
    found = weight * rest[:, used] @ C[used] @ inner
    fit = weight * ((rest[:, used] ** 2).sum(1) - ((rest[:, used] @ C[used]) * found).sum(1))
    prior = (places - center) ** 2 @ precision
    logs = -0.5 * (fit + prior - (steps**2).sum(1))
    shares = _shares(logs)
    means = forces + found @ C.T
    mean = shares @ means
    within = np.einsum("ij,jk,ik->i", C, inner, C)
    return mean, shares @ (means - mean) ** 2 + within


def _shares(logs: np.ndarray) -> np.ndarray:
    """Weights from logarithms, flattened until they are worth a quarter of the draws: few draws
    would take the best of them for certain."""
    for power in np.geomspace(1.0, 1e-3, 40):
        shares = np.exp(power * (logs - logs.max()))
        shares = shares / shares.sum()
        if 1.0 / (shares**2).sum() >= 0.25 * len(logs):
            break
    return np.asarray(shares)


class _Coefficients:
    """Those of parameters and of the discrepancy's parts: u, v, w, and each condition's own.

    Attributes:
        columns: By which each entry changes [M, n].
        parameters: How many of the columns, the first, are theirs.
    """

    def __init__(
        self,
        problem: Discrepancy,
        sizes: Sizes,
        conditions: list[tuple[int, np.ndarray]],
        Z: np.ndarray,
        J: np.ndarray,
    ) -> None:
        deviations = sizes.deviations(problem.channel, problem.phase)
        parts = np.zeros((3, *Z.shape))
        own = []
        for (_, rows), factors in zip(conditions, problem.factors, strict=True):
            parts[:, rows] = factors[:, None, None] * deviations[:3, None] * Z[rows]
            own.append(np.where(rows[:, None], deviations[3] * Z, 0.0))
        self.columns = np.column_stack([J, *parts, *own])
        self.parameters = J.shape[1]

    def posterior(
        self,
        r: np.ndarray,
        used: np.ndarray,
        weight: float,
        unit: np.ndarray,
        center: np.ndarray,
        precision: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean [n] and covariance [n, n] of the coefficients after the entries that are used; the
        parameters' places have `center` and `precision` before them [d]."""
        A, rest = self.columns[used], self.columns.shape[1] - self.parameters
        before = np.append(center - unit, np.zeros(rest))
        precisions = np.append(precision, np.ones(rest))
        covariance = np.linalg.inv(weight * A.T @ A + np.diag(precisions))
        return covariance @ (weight * A.T @ r[used] + precisions * before), covariance


def _shared(rest: np.ndarray, used: np.ndarray, record_of: np.ndarray) -> float:
    """How alike neighbours' errors are: the sum of their autocorrelation up to its first zero."""
    factors = []
    for record in np.unique(record_of[used]):
        x = rest[used & (record_of == record)]
        x = x - x.mean()
        n = len(x)
        spectrum = np.abs(np.fft.rfft(x, 2 * n)) ** 2
        correlation = np.fft.irfft(spectrum)[:n] / max(float(x @ x), 1e-300)
        first = int(np.argmax(correlation < 0.0)) or n
        factors.append(1.0 + 2.0 * float(correlation[1:first].sum()))
    return max(1.0, float(np.mean(factors)))


def _conditions(model: Predictor) -> list[tuple[int, np.ndarray]]:
    """Of each condition its first record and the mask of its entries [M]."""
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(model.conditions):
        groups.setdefault(name or f"record {k}", []).append(k)
    return [(own[0], np.isin(model.record_of, own)) for own in groups.values()]


def _shapes(
    model: Predictor,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Covariates], np.ndarray]:
    """Of the discrepancy: shapes at the entries [M, z], phase and channel of each [z], covariates
    of the records, and usual size in each channel, N."""
    reach = max(float(t.depth.max()) for t in model.targets)
    channels = model.targets[0].measured.shape[1]
    blocks, covariates = [], []
    phase = np.zeros(0, int)
    for target in model.targets:
        time, depth, path = target.time, target.depth, target.path
        values, phase = motion_shapes(time, depth, path, depth > 0.0, reach, target.facts.height)
        covariates.append(Covariates.of(time, depth, path))
        # Entries go by row, then by channel.
        blocks.append(np.einsum("mn,cd->mcdn", values, np.eye(channels)))
    n = len(phase)
    Z = np.concatenate([b.reshape(-1, channels * n) for b in blocks])
    in_use = np.tile(phase != PHASES.index("any"), channels)
    size = USUAL_SHARE * float(np.sqrt(np.mean(model.measured[model.used] ** 2)))
    return (
        Z[:, in_use],
        np.tile(phase, channels)[in_use],
        np.repeat(np.arange(channels), n)[in_use],
        covariates,
        np.full(channels, size),
    )
