"""How noisy a record is within itself, estimated from what replicates do not share.

Records of one condition were nominally the same cut: what is wrong with the model is wrong in all
of them alike, and drops out of their differences. What is left there is the sensor's noise and the
food's unevenness (and what slices differ in as a whole, which is projected out before).
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, replicates
from sliceit_drake.prediction.noise import MarkovCovariance
from sliceit_drake.tables import interpolated

__all__ = ["ChannelNoise", "differences", "estimate_noise"]

LAGS = 40
MIN_ROWS = 60
FLOOR = 1e-3
"""Least standard deviation, in N and Nm."""


@dc.dataclass(frozen=True)
class ChannelNoise:
    """Noise of one channel: ar^2 exp(-|dt| / tau) + white^2 for equal times.

    Attributes:
        ar: Standard deviation of the correlated part, N or Nm.
        tau: Its correlation time, s.
        white: Standard deviation of the rest.
    """

    ar: float
    tau: float
    white: float

    @property
    def deviation(self) -> float:
        """Standard deviation of a sample."""
        return float(np.hypot(self.ar, self.white))

    def solve(
        self, time: np.ndarray, columns: np.ndarray, model_error: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """The inverse covariance at increasing times [m], s, times columns [m, k]; `model_error` is
        the standard deviation of what the model is unsure of at each row [m]."""
        white = np.hypot(self.white, model_error)
        return MarkovCovariance(np.diff(time), self.ar, self.tau, white).solve(columns)


def estimate_noise(
    records: Sequence[RecordSensitivity], own: Sequence[int]
) -> tuple[tuple[ChannelNoise, ...], bool]:
    """Noise of each channel, pooled over the records.

    Args:
        records: With the same channels.
        own: Columns that differ from record to record; they are projected out of the differences.

    Returns:
        The noise of each channel, and whether it is from replicates: where no condition has two
        records it is from the air phases and from what is rough in the residuals.
    """
    groups = [g for g in replicates(records).values() if len(g) > 1]
    series: list[tuple[np.ndarray, np.ndarray, float]] = []
    for members in groups:
        series += _deviations([records[k] for k in members], own)
    repeated = bool(series)
    if not repeated:
        series = [_roughness(r) for r in records]
    channels = len(records[0].channels)
    return tuple(_channel(series, c) for c in range(channels)), repeated


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


def _deviations(
    members: list[RecordSensitivity], own: Sequence[int]
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Times, differences less what columns take of them [m, c], and a factor on their variance."""
    n = len(members)
    out = []
    for grid, rest, column in differences(members, own):
        flat = column.reshape(-1, len(own))
        flat = flat[:, np.linalg.norm(flat, axis=0) > 1e-9]
        if flat.shape[1]:
            fitted, *_ = np.linalg.lstsq(flat, rest.ravel(), rcond=1e-6)
            rest = rest - (flat @ fitted).reshape(rest.shape)
        out.append((grid, rest, n / (n - 1.0)))
    return out


def _roughness(record: RecordSensitivity) -> tuple[np.ndarray, np.ndarray, float]:
    """The residual less its running mean over a tenth of a second."""
    step = float(np.median(np.diff(record.time)))
    width = max(3, 2 * round(0.05 / step) + 1)
    kernel = np.ones(width) / width
    smooth = np.column_stack([np.convolve(c, kernel, mode="same") for c in record.residual.T])
    inside = slice(width, len(record.time) - width)
    rest = (record.residual - smooth)[inside]
    return record.time[inside], rest, 1.0 / (1.0 - 1.0 / width)


def _channel(series: list[tuple[np.ndarray, np.ndarray, float]], c: int) -> ChannelNoise:
    """Fits the autocovariance of a channel."""
    step = float(np.median(np.concatenate([np.diff(t) for t, _, _ in series])))
    sums, counts = np.zeros(LAGS), np.zeros(LAGS)
    for _, rest, factor in series:
        x = rest[:, c]
        for lag in range(min(LAGS, len(x) - 1)):
            products = x[lag:] * x[: len(x) - lag]
            sums[lag] += factor * products.sum()
            counts[lag] += len(products)
    used = counts > 0
    covariance = sums[used] / counts[used]
    lags = np.arange(LAGS)[used] * step
    total = max(float(covariance[0]), FLOOR**2)

    def misfit(x: np.ndarray) -> np.ndarray:
        share, log_tau = x
        model = share * np.exp(-lags / np.exp(log_tau))
        model[0] = 1.0
        return model - covariance / total

    start = np.array([np.clip(covariance[1] / total, 0.05, 0.95) if len(lags) > 1 else 0.5, -3.5])
    fit = least_squares(misfit, start, bounds=([0.0, np.log(step)], [0.99, np.log(10.0)]))
    share, tau = float(fit.x[0]), float(np.exp(fit.x[1]))
    ar = max(np.sqrt(share * total), 0.1 * FLOOR)
    white = max(np.sqrt((1.0 - share) * total), 0.1 * np.sqrt(total))
    return ChannelNoise(float(ar), tau, float(white))
