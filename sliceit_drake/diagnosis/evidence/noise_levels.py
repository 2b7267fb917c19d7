"""How noisy a record is within itself, estimated from what replicates do not share.

Records of one condition were nominally the same cut: what is wrong with the model is wrong in all
of them alike, and drops out of their differences. What is left there is the sensor's noise and the
food's unevenness (and what slices differ in as a whole, which is projected out before). In the air
there is the sensor's noise alone, beside which shows what a food's unevenness would hide.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, replicates
from sliceit_drake.prediction.noise import MarkovCovariance
from sliceit_drake.tables import interpolated

__all__ = ["ChannelNoise", "differences", "estimate_noise", "in_air"]

Series = tuple[np.ndarray, np.ndarray, float]
"""Times [m], s, values [m, c], NaN where they do not count, and a factor on their variance."""

LAGS = 40
MIN_ROWS = 300
"""Rows in the air, and as many in the food, from which each has a noise of its own."""
FLOOR = 1e-3
"""Least standard deviation, in N and Nm."""
LONGEST = 10.0
"""Greatest correlation time, s."""
STAYS = 0.5
"""Readings come in steps where less than this share of them differs from the one before."""


@dc.dataclass(frozen=True)
class ChannelNoise:
    """Noise of one channel: ar^2 exp(-|dt| / tau) + white^2 for equal times.

    Attributes:
        ar: Standard deviation of the correlated part, N or Nm.
        tau: Its correlation time, s.
        white: Standard deviation of the rest.
        air: Noise in the air, independent of that in the food; None for the same.
        stays: Rows for which a reading in steps stays: it is rounded once for all of them.
    """

    ar: float
    tau: float
    white: float
    air: "ChannelNoise | None" = None
    stays: float = 0.0

    @property
    def deviation(self) -> float:
        """Standard deviation of a sample in the food."""
        return float(np.hypot(self.ar, self.white))

    def deviations(self, near: np.ndarray) -> np.ndarray:
        """Standard deviation of samples, by whether the knife is near the food [m]."""
        return np.where(near, self.deviation, (self.air or self).deviation)

    def solve(
        self,
        time: np.ndarray,
        columns: np.ndarray,
        model_error: np.ndarray | float = 0.0,
        near: np.ndarray | None = None,
    ) -> np.ndarray:
        """The inverse covariance times columns.

        Args:
            time: Increasing [m], s.
            columns: [m, k].
            model_error: Standard deviation of what the model is unsure of at each row [m].
            near: Whether the knife is near the food [m]; None for all rows.
        """
        out = np.empty(columns.shape)
        for rows, covariance in self._parts(time, model_error, near):
            out[rows] = covariance.solve(columns[rows])
        return out

    def log_det(
        self, time: np.ndarray, model_error: np.ndarray, near: np.ndarray | None = None
    ) -> float:
        """Logarithm of the determinant of the covariance; arguments as in `solve`."""
        parts = self._parts(time, model_error, near)
        return float(sum(covariance.log_det() for _, covariance in parts))

    def _parts(
        self, time: np.ndarray, model_error: np.ndarray | float, near: np.ndarray | None
    ) -> list[tuple[np.ndarray, MarkovCovariance]]:
        """Masks of rows that are independent of others, and their covariance."""
        error = np.broadcast_to(model_error, time.shape)
        parts = [(np.ones(len(time), bool), self)]
        if self.air is not None and near is not None:
            parts = [(near, self), (~near, self.air)]
        out = []
        for rows, noise in parts:
            if rows.any():
                # Jumps from step to step are as usual as what is rounded is large.
                white = np.hypot(
                    np.hypot(noise.white, noise.ar * np.sqrt(noise.stays)), error[rows]
                )
                covariance = MarkovCovariance(np.diff(time[rows]), noise.ar, noise.tau, white)
                out.append((rows, covariance))
        return out


def estimate_noise(
    records: Sequence[RecordSensitivity],
    own: Sequence[int],
    zero: Sequence[int] = (),
    shapes: Sequence[np.ndarray] | None = None,
) -> tuple[tuple[ChannelNoise, ...], bool]:
    """Noise of each channel, pooled over the records.

    Args:
        records: With the same channels.
        own: Columns that differ from record to record; they are projected out of the differences.
        zero: Those of the sensor's zero, which differ too; they are projected out of what is in the
            air.
        shapes: Of each record what slices may differ by in each channel [m, n]: it is projected out
            of the differences as well.

    Returns:
        The noise of each channel, and whether it is from replicates: where no condition has two
        records it is from the air phases and from what is rough in the residuals.
    """
    whole: list[Series] = []
    in_food: list[Series] = []
    airborne: list[Series] = []
    for members in replicates(records).values():
        if len(members) == 1:
            continue
        alike, factor = [records[k] for k in members], len(members) / (len(members) - 1.0)
        air = in_air(alike)
        for grid, rest, columns in differences(alike, own):
            rest, weight = _beside(rest, columns), factor
            if shapes is not None:
                rest, share = _smooth_left_out(rest, shapes[members[0]][: len(grid)])
                weight = factor / share
            whole.append((grid, rest, weight))
            in_food.append((grid, np.where(air, np.nan, rest), weight))
        for grid, rest, columns in differences(alike, zero) if air.any() else ():
            known = np.full_like(rest, np.nan)
            known[air[:, 0]] = _beside(rest[air[:, 0]], columns[air[:, 0]])
            airborne.append((grid, known, factor))
    channels = range(len(records[0].channels))
    steps = _resolution(records)
    if min(map(_rows, (in_food, airborne))) >= MIN_ROWS:
        parts = [
            (_channel(in_food, c, steps[c]), _channel(airborne, c, steps[c])) for c in channels
        ]
        return tuple(dc.replace(of_food, air=of_air) for of_food, of_air in parts), True
    series = whole or [_roughness(r) for r in records]
    return tuple(_channel(series, c, steps[c]) for c in channels), bool(whole)


def differences(
    members: Sequence[RecordSensitivity], own: Sequence[int]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What replicates do not share: each one's residual less their mean.

    Replicates whose rows are not at the same times are interpolated to those of the first.

    Returns:
        Of each the times since its start [m], the difference [m, c], the columns `own` [m, c, k].
    """
    count = min(len(r.time) for r in members)
    since = np.array([r.time[:count] - r.time[0] for r in members])
    grid = since[0]
    aligned = np.abs(since - grid).max() <= 0.25 * float(np.median(np.diff(grid)))
    values, columns = [], []
    for r in members:
        if aligned:
            values.append(r.residual[:count])
            columns.append(r.columns[:count][:, :, own])
        else:
            values.append(interpolated(grid, r.time - r.time[0], r.residual))
            columns.append(interpolated(grid, r.time - r.time[0], r.columns[:, :, own]))
    mean = np.mean(values, axis=0)
    return [(grid, v - mean, c) for v, c in zip(values, columns, strict=True)]


def _rows(series: Sequence[Series]) -> int:
    """Number of rows that count."""
    return sum(int(np.isfinite(values[:, 0]).sum()) for _, values, _ in series)


def in_air(members: Sequence[RecordSensitivity]) -> np.ndarray:
    """Whether no replicate is near its food, at the rows of `differences` [m, 1]."""
    count = min(len(r.time) for r in members)
    grid = members[0].time[:count] - members[0].time[0]
    inside = [np.interp(grid, r.time - r.time[0], r.near.astype(float)) for r in members]
    return np.asarray(np.max(inside, axis=0) == 0.0)[:, None]


def _beside(rest: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Values [m, c] less what columns [m, c, k] take of them."""
    flat = columns.reshape(len(rest) * rest.shape[1], -1)
    flat = flat[:, np.linalg.norm(flat, axis=0) > 1e-9]
    if not flat.shape[1]:
        return rest
    fitted, *_ = np.linalg.lstsq(flat, rest.ravel(), rcond=1e-6)
    return np.asarray(rest - (flat @ fitted).reshape(rest.shape))


def _smooth_left_out(rest: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, float]:
    """Values [m, c] less what shapes [m, n] take of each channel, and the share of their degrees of
    freedom that this leaves."""
    values, vectors = np.linalg.eigh(shapes.T @ shapes)
    kept = values > 1e-6 * max(float(values[-1]), 1e-12)
    basis = shapes @ (vectors[:, kept] / np.sqrt(values[kept]))
    rows = max(int(shapes.any(1).sum()), 1)
    return rest - basis @ (basis.T @ rest), 1.0 - min(kept.sum() / rows, 0.9)


def _roughness(record: RecordSensitivity) -> Series:
    """The residual less its running mean over a tenth of a second."""
    step = float(np.median(np.diff(record.time)))
    width = max(3, 2 * round(0.05 / step) + 1)
    kernel = np.ones(width) / width
    smooth = np.column_stack([np.convolve(c, kernel, mode="same") for c in record.residual.T])
    inside = slice(width, len(record.time) - width)
    rest = (record.residual - smooth)[inside]
    return record.time[inside], rest, 1.0 / (1.0 - 1.0 / width)


def _resolution(records: Sequence[RecordSensitivity]) -> list[tuple[float, float]]:
    """Step in which each channel's readings come, the same for all forces, 0 where they do not; and
    the rows for which they stay."""
    changes = [np.abs(np.diff(r.measured, axis=0)) for r in records]
    out = []
    for c in range(len(records[0].channels)):
        alike = records[0].forces if c in records[0].forces else [c]
        values = np.concatenate([change[:, alike].ravel() for change in changes])
        moved = values[values > 1e-9]
        in_steps = 0 < len(moved) < STAYS * len(values)
        own = np.concatenate([change[:, c] for change in changes])
        stays = len(own) / (len(records) + np.count_nonzero(own > 1e-9))
        out.append((float(np.quantile(moved, 0.1)) if in_steps else 0.0, float(stays)))
    return out


def _channel(series: list[Series], c: int, steps: tuple[float, float]) -> ChannelNoise:
    """Fits the autocovariance of a channel whose readings come in steps; see `_resolution`."""
    step = float(np.median(np.concatenate([np.diff(t) for t, _, _ in series])))
    sums, counts = np.zeros(LAGS), np.zeros(LAGS)
    for _, rest, factor in series:
        x = rest[:, c]
        for lag in range(min(LAGS, len(x) - 1)):
            products = x[lag:] * x[: len(x) - lag]
            known = np.isfinite(products)
            sums[lag] += factor * products[known].sum()
            counts[lag] += known.sum()
    used = counts > 0
    covariance = sums[used] / counts[used]
    rounding = steps[0] / np.sqrt(12.0)
    if covariance[0] < rounding**2:
        # Replicates are rounded alike, and stay so for as long as the force is steady.
        return ChannelNoise(float(rounding), LONGEST, float(0.1 * rounding), stays=steps[1])
    lags = np.arange(LAGS)[used] * step
    total = max(float(covariance[0]), FLOOR**2)

    def misfit(x: np.ndarray) -> np.ndarray:
        share, log_tau = x
        model = share * np.exp(-lags / np.exp(log_tau))
        model[0] = 1.0
        return model - covariance / total

    start = np.array([np.clip(covariance[1] / total, 0.05, 0.95) if len(lags) > 1 else 0.5, -3.5])
    fit = least_squares(misfit, start, bounds=([0.0, np.log(step)], [0.99, np.log(LONGEST)]))
    share, tau = float(fit.x[0]), float(np.exp(fit.x[1]))
    ar = max(np.sqrt(share * total), 0.1 * FLOOR)
    white = max(np.sqrt((1.0 - share) * total), 0.1 * np.sqrt(total))
    return ChannelNoise(float(ar), tau, float(white))
