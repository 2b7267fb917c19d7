"""Bands of predicted force: what parameters, noise and the simulation's own error leave open.

A record's force is the simulated one, plus what the parameters may change of it, plus what the
simulation gets wrong by itself (`prediction.discrepancy`), plus what slices differ by, plus the
sensor's zero, plus noise.
All are normal, and their sizes are those of the records that were fitted. Where nothing was fitted,
deeper or at another speed, parameters and discrepancy are what they were before. Height and speed
of a record that was not fitted are as far from those that were as these are apart.

What the simulation gets wrong is a part of the force that it predicts, in each channel: a press
tells how wrong it is, but nothing of the force along the edge, which only a draw has. Slices differ
by a factor, and records by the zero that is left in each channel, as their air shows. Noise is what
is left, in each channel and phase of the motion.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from sliceit_drake.calibration.gauss_newton import PRIOR_CENTER, PRIOR_VARIANCE
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.prediction.discrepancy import (
    PHASES,
    USUAL_SHARE,
    Covariates,
    Discrepancy,
    Sizes,
    motion_phases,
    motion_shapes,
)
from sliceit_drake.prediction.noise import EvenNoise

__all__ = ["ForceBand", "force_band", "independent"]

WIDER = 1.5
"""Spread of the drawn places over that of the linear problem."""
BISECTIONS = 40
"""Of an end of a band."""
ROUNDS = 3
"""Alternations of the noise and the sizes of the discrepancy."""
LEAST = 1e-3
"""Least standard deviation of the noise, relative to the root mean square force."""
USUAL = 0.9
"""Share of what is left that tells the noise, and of zeros that are within what few tell."""
APART = 0.1
"""Standard deviation of the factors by which slices differ before any data: vegetables are so."""
KNOWN = 3
"""Degrees of freedom of that standard deviation: so many more slices would tell as much."""
AIR = 6
"""Least rows in the air that tell a record's zero."""
UNSEEN = (0.0, 0.1, 0.3)
"""Least sizes of the discrepancy's shared parts: what a decade of the speed and a draw change of
the force, as a part of it, where no record tells."""


@dc.dataclass
class ForceBand:
    """Predicted force of records, as normal distributions about slices that may be the right one.

    Attributes:
        means: Of each slice, and each entry of the predictor's `measured` [D, M], N.
        deviation: Standard deviation of a measurement about it [M], N, noise included.
        shares: Probabilities of the slices [D].
    """

    means: np.ndarray
    deviation: np.ndarray
    shares: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean of each measurement [M], N."""
        return np.asarray(self.shares @ self.means)

    def interval(self, level: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the band that holds each measurement with a probability `level`, each [M], N.

        As much lies below the band as above it.
        """
        low, high = (self._quantile(0.5 + side * level / 2.0) for side in (-1.0, 1.0))
        return low, high

    def _quantile(self, probability: float) -> np.ndarray:
        """Force that a measurement stays below with a probability [M], N."""
        reach = float(ndtri(probability)) * self.deviation
        low, high = self.means.min(0) + reach, self.means.max(0) + reach
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            below = self.shares @ ndtr((middle - self.means) / self.deviation) < probability
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)


def independent(model: Predictor, residuals: np.ndarray) -> EvenNoise:
    """Independent noise that tells as little as residuals [M], N, whose neighbours are alike."""
    variance = float(np.mean(residuals[model.used] ** 2))
    return EvenNoise(variance * _shared(model, residuals))


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
    used, d = model.used, J.shape[1]
    force, r = model.measured + residuals, -residuals
    conditions, groups = _conditions(model), _groups(model)
    known = [c for c in conditions if (c.rows & used).any()]
    own = np.column_stack([_slices(model, force, r, known), _zeros(model, r)])
    Z, phase = _shapes(model, force)
    z, n = Z.shape[1], d + own.shape[1]
    columns = np.column_stack([Z, J, own, r])
    total = n + (3 + len(conditions)) * z
    center, precision = np.zeros(total), np.ones(total)
    center[:d], precision[:d] = PRIOR_CENTER - unit, 1.0 / PRIOR_VARIANCE
    problem = Discrepancy(
        range(z),
        np.zeros(z, int),
        phase,
        range(z, z + n + 1),
        [c.covariates for c in known],
        np.array([USUAL_SHARE]),
    )
    rest = r
    for _ in range(ROUNDS):
        weight = _weight(model, rest, groups)
        grams = []
        for rows in (c.rows & used for c in known):
            grams.append((weight[rows, None] * columns[rows]).T @ columns[rows])
        sizes, _ = problem.fit(grams, range(n), precision[:n])
        A = np.column_stack([J, own, _parts(problem, sizes, conditions, Z)])
        mean, _ = _posterior(A[used], r[used], weight[used], center, precision)
        rest = r - A @ mean
    weight, variance = _weight(model, rest, groups), _variance(model, rest, groups)
    mean, covariance = _posterior(A[used], r[used], weight[used], center, precision)
    middle, precision[:d] = _like_the_fitted(model, unit + mean[:d], np.diag(covariance)[:d])
    center[:d] = middle - unit
    mean, covariance = _posterior(A[used], r[used], weight[used], center, precision)
    if draws:
        normal = mean[:d], covariance[:d, :d]
        means, spread, shares = _drawn(
            model, unit, draws, normal, A[:, d:], weight[used], middle, precision[:d]
        )
        return ForceBand(means, np.sqrt(spread + variance), shares)
    spread = np.einsum("ij,jk,ik->i", A, covariance, A)
    deviation = np.sqrt(np.maximum(spread, 0.0) + variance)
    return ForceBand((force + A @ mean)[None], deviation, np.ones(1))


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
    weight: np.ndarray,
    center: np.ndarray,
    precision: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries [D, M] of slices at drawn places, variance without noise about each [M], and shares
    [D].

    Args:
        normal: Mean and covariance of the places from `unit`, as the linear problem has them.
        C: By which the other coefficients change the entries [M, n].
        weight: One over the variance of each entry that is used.
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
    rest = (model.measured - forces)[:, used]
    weighted = weight[:, None] * C[used]
    inner = np.linalg.inv(np.eye(C.shape[1]) + weighted.T @ C[used])
    seen = rest @ weighted
    found = seen @ inner
    fit = rest**2 @ weight - (seen * found).sum(1)
    prior = (places - center) ** 2 @ precision
    logs = -0.5 * (fit + prior - (steps**2).sum(1))
    shares = _shares(logs)
    within = np.einsum("ij,jk,ik->i", C, inner, C)
    return forces + found @ C.T, within, shares


def _shares(logs: np.ndarray) -> np.ndarray:
    """Weights from logarithms, flattened until they are worth a quarter of the draws: few draws
    would take the best of them for certain."""
    for power in np.geomspace(1.0, 1e-3, 40):
        shares = np.exp(power * (logs - logs.max()))
        shares = shares / shares.sum()
        if 1.0 / (shares**2).sum() >= 0.25 * len(logs):
            break
    return np.asarray(shares)


@dc.dataclass(frozen=True)
class _Condition:
    """Records that were cut alike: mask of their entries [M], and covariates of the first."""

    rows: np.ndarray
    covariates: Covariates


def _conditions(model: Predictor) -> list[_Condition]:
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(model.conditions):
        groups.setdefault(name or f"record {k}", []).append(k)
    out = []
    for own in groups.values():
        first = model.targets[own[0]]
        covariates = Covariates.of(first.time, first.depth, first.path)
        out.append(_Condition(np.isin(model.record_of, own), covariates))
    return out


def _channel(model: Predictor) -> np.ndarray:
    """Number of the channel of each entry [M]: entries go by row, then by channel."""
    return np.arange(model.measured.size) % model.targets[0].measured.shape[1]


def _groups(model: Predictor) -> np.ndarray:
    """Number of the channel and phase of each entry [M], that of the air first."""
    channels = model.targets[0].measured.shape[1]
    phases = [motion_phases(t.time, t.depth, t.path)[0] + 1 for t in model.targets]
    return channels * np.repeat(np.concatenate(phases), channels) + _channel(model)


def _shapes(model: Predictor, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shapes of the discrepancy at the entries [M, z], N, in parts of the root mean square of each
    record's predicted force in each channel [M], and the phase of each [z]."""
    reach = max(float(t.depth.max()) for t in model.targets)
    blocks, phase = [], np.zeros(0, int)
    for k, t in enumerate(model.targets):
        height = t.facts.height
        values, phase = motion_shapes(t.time, t.depth, t.path, t.depth > 0.0, reach, height)
        own = force[model.record_of == k].reshape(t.measured.shape)
        inside = t.depth > 0.0
        level = np.sqrt((own[inside] ** 2).sum(0) / max(int(inside.sum()), 1))
        blocks.append(np.einsum("mn,cd->mcdn", values, np.diag(level)))
    channels, n = blocks[0].shape[2:]
    Z = np.concatenate([b.reshape(-1, channels * n) for b in blocks])
    in_use = np.tile(phase != PHASES.index("any"), channels)
    return Z[:, in_use], np.tile(phase, channels)[in_use]


def _slices(
    model: Predictor, force: np.ndarray, r: np.ndarray, known: Sequence[_Condition]
) -> np.ndarray:
    """By which a factor on each record's predicted force changes the entries [M, records], in
    standard deviations of what slices of one condition differ by.

    Args:
        force: Predicted [M], N.
        r: Measured less predicted force [M], N.
        known: Conditions that were fitted.
    """
    square, degrees = KNOWN * APART**2, KNOWN
    for rows in (c.rows & model.used for c in known):
        records = [rows & (model.record_of == k) for k in np.unique(model.record_of[rows])]
        factors = [
            force[own] @ r[own] / max(float(force[own] @ force[own]), 1e-300) for own in records
        ]
        square += float(np.sum((factors - np.mean(factors)) ** 2))
        degrees += len(records) - 1
    apart = np.sqrt(square / degrees)
    return apart * force[:, None] * (model.record_of[:, None] == np.arange(len(model.targets)))


def _zeros(model: Predictor, r: np.ndarray) -> np.ndarray:
    """By which a zero in each channel of each record changes the entries [M, channels * records],
    in standard deviations of the zeros that the air shows.

    Args:
        model: Entries that it uses show zeros.
        r: Measured less predicted force [M], N.
    """
    channel, records = _channel(model), range(len(model.targets))
    air = model.used & (model.depth <= 0.0)
    columns = []
    for c in np.unique(channel):
        shown = [r[air & (channel == c) & (model.record_of == k)] for k in records]
        # Less what the mean of so many rows of noise is away from zero by itself.
        squares = [x.mean() ** 2 - x.var(ddof=1) / len(x) for x in shown if len(x) >= AIR]
        size = 0.0
        if squares:
            # Few records hardly tell it: nine of ten others are as near as Student's t says.
            few = stdtrit(len(squares), 0.5 + USUAL / 2.0) / ndtri(0.5 + USUAL / 2.0)
            size = few * np.sqrt(max(0.0, float(np.mean(squares))))
        columns += [size * ((channel == c) & (model.record_of == k)) for k in records]
    return np.column_stack(columns)


def _parts(
    problem: Discrepancy, sizes: Sizes, conditions: Sequence[_Condition], Z: np.ndarray
) -> np.ndarray:
    """By which the discrepancy's coefficients, the shared ones, those of speed and draw and each
    condition's own, change the entries [M, n]."""
    deviations = sizes.deviations(problem.channel, problem.phase)
    told = np.any([np.abs(f) > 0.0 for f in problem.factors], axis=0)
    unseen = np.where(told, 0.0, UNSEEN)[:, None] * deviations[0] / np.exp(sizes.channel)
    deviations[:3] = np.maximum(deviations[:3], unseen)
    parts, own = np.zeros((3, *Z.shape)), []
    for c in conditions:
        factors = problem.factor(c.covariates)
        parts[:, c.rows] = factors[:, None, None] * deviations[:3, None] * Z[c.rows]
        own.append(np.where(c.rows[:, None], deviations[3] * Z, 0.0))
    return np.column_stack([*parts, *own])


def _posterior(
    A: np.ndarray, r: np.ndarray, weight: np.ndarray, center: np.ndarray, precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [n] and covariance [n, n] of the coefficients of columns A [m, n] after residuals [m],
    with these centres and precisions before them [n]."""
    weighted = weight[:, None] * A
    covariance = np.linalg.inv(weighted.T @ A + np.diag(precision))
    return covariance @ (weighted.T @ r + precision * center), covariance


def _variance(model: Predictor, rest: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Variance of what is left [M], N^2, in its channel and phase, or where that was not measured
    in its channel: that of a normal distribution of which nine of ten are as near. What stands out
    for a few rows, as the board does, is not the noise of all."""
    channel, level = _channel(model), np.mean(model.measured[model.used] ** 2)
    out = np.zeros(len(rest))
    for of in (channel, groups):
        for number in np.unique(of[model.used]):
            near = np.quantile(np.abs(rest[model.used & (of == number)]), USUAL)
            out[of == number] = (near / ndtri(0.5 + USUAL / 2.0)) ** 2
    return np.maximum(out, LEAST**2 * level)


def _weight(model: Predictor, rest: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """What each entry tells [M], 1/N^2: neighbours share their error, and tell as much as fewer
    entries would. Where little force is, little is left, but the mesh errs there as elsewhere: no
    entry tells more than in the mean."""
    variance = np.maximum(_variance(model, rest, groups), np.mean(rest[model.used] ** 2))
    return 1.0 / (_shared(model, rest) * variance)


def _shared(model: Predictor, rest: np.ndarray) -> float:
    """How alike neighbours' errors are: the sum of their autocorrelation up to its first zero, of
    all channels of all records."""
    series, channel = [], _channel(model)
    for record in np.unique(model.record_of[model.used]):
        for c in np.unique(channel):
            x = rest[model.used & (model.record_of == record) & (channel == c)]
            series.append(x - x.mean())
    longest = max(map(len, series))
    spectra = [np.abs(np.fft.rfft(x, 2 * longest)) ** 2 for x in series]
    covariance = np.fft.irfft(np.sum(spectra, axis=0))[:longest]
    correlation = covariance / max(float(covariance[0]), 1e-300)
    first = int(np.argmax(correlation < 0.0)) or longest
    return max(1.0, 1.0 + 2.0 * float(correlation[1:first].sum()))
