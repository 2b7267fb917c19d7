"""Model of a wrench sensor, on a whole series of true wrenches at once."""

import dataclasses as dc
import math

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.configuration import quantity
from sliceit_drake.tables import interpolated

__all__ = ["SensorModel", "measured"]


@dc.dataclass
class SensorModel:
    """A sensor's imperfections. Bias and drift differ from slice to slice; their spread is given.

    The defaults are a good six-axis sensor at a robot's wrist, tared before each slice.
    """

    rate: float = quantity(250.0, "Hz", low=1.0, high=1e4)
    """Readings a second."""
    force_noise: float = quantity(0.05, "N", low=0.0, high=50.0)
    """Standard deviation."""
    torque_noise: float = quantity(0.004, "Nm", low=0.0, high=5.0)
    """Standard deviation."""
    correlated_share: float = quantity(0.5, "", low=0.0, high=1.0)
    """Fraction of the noise's variance that is correlated in time."""
    correlation_time: float = quantity(0.03, "s", low=1e-4, high=100.0)
    """Time in which that falls to 1/e."""
    force_bias: float = quantity(0.05, "N", low=0.0, high=50.0)
    """Spread of what taring leaves, each axis."""
    torque_bias: float = quantity(0.003, "Nm", low=0.0, high=5.0)
    """Spread of what taring leaves, each axis."""
    force_drift: float = quantity(0.01, "N/s^0.5", low=0.0, high=10.0)
    """Random walk: its spread after 1 s."""
    torque_drift: float = quantity(5e-4, "Nm/s^0.5", low=0.0, high=1.0)
    """Random walk: its spread after 1 s."""
    delay: float = quantity(0.002, "s", low=0.0, high=0.2)
    """Time that a reading is late."""
    cutoff_frequency: float = quantity(80.0, "Hz", low=0.0, high=1e4)
    """First-order low-pass filter; 0 for none."""
    force_resolution: float = quantity(0.01, "N", low=0.0, high=10.0)
    """Step of the shown forces; 0 for none."""
    torque_resolution: float = quantity(5e-4, "Nm", low=0.0, high=1.0)
    """Step of the shown torques; 0 for none."""
    force_range: float = quantity(150.0, "N", low=0.1, high=1e5)
    """Forces saturate there."""
    torque_range: float = quantity(15.0, "Nm", low=1e-3, high=1e4)
    """Torques saturate there."""


def measured(
    wrench: np.ndarray, period: float, sensor: SensorModel, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Readings of a sensor.

    Args:
        wrench: True moment and force in the sensor's axes, mean over each period [N, 6].
        period: Time between two rows, s.
        sensor: The sensor; its readings are a whole number of periods apart.
        rng: Random numbers for bias, drift and noise.

    Returns:
        The rows at which there is a reading [M], and the readings [M, 6].
    """
    count = len(wrench)
    noise = _six(sensor.torque_noise, sensor.force_noise)
    offset = rng.normal(0.0, 1.0, 6) * _six(sensor.torque_bias, sensor.force_bias)
    steps = rng.normal(0.0, math.sqrt(period), (count, 6))
    walk = np.cumsum(steps, axis=0) * _six(sensor.torque_drift, sensor.force_drift)
    shown = wrench + offset + walk
    if sensor.cutoff_frequency > 0.0:
        keep = math.exp(-2.0 * math.pi * sensor.cutoff_frequency * period)
        shown, _state = lfilter([1.0 - keep], [1.0, -keep], shown, axis=0, zi=keep * shown[:1])
    if sensor.delay > 0.0:
        late = np.arange(count) - sensor.delay / period
        shown = interpolated(late, np.arange(count), shown)
    # Between the readings the correlated part goes on; only its readings are drawn.
    rows = np.arange(0, count, round(1.0 / (sensor.rate * period)))
    spacing = (rows[1] - rows[0]) * period if len(rows) > 1 else period
    keep = math.exp(-spacing / sensor.correlation_time)
    white, wander = rng.normal(size=(2, len(rows), 6))
    wander[1:] *= math.sqrt(1.0 - keep * keep)
    wander = lfilter([1.0], [1.0, -keep], wander, axis=0)
    share = math.sqrt(sensor.correlated_share)
    both = math.sqrt(1.0 - sensor.correlated_share) * white + share * wander
    readings = shown[rows] + noise * both
    resolution = _six(sensor.torque_resolution, sensor.force_resolution)
    coarse = resolution > 0.0
    readings[:, coarse] = np.round(readings[:, coarse] / resolution[coarse]) * resolution[coarse]
    limit = _six(sensor.torque_range, sensor.force_range)
    return rows, np.clip(readings, -limit, limit)


def _six(torque: float, force: float) -> np.ndarray:
    return np.repeat([torque, force], 3)
