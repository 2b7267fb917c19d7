"""Effects in what is measured: sensor, its mounting, what moves with the tool."""

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.stand_in.effect import Effect, Series, SliceTruth
from sliceit_drake.stand_in.world import GRAVITY

__all__ = [
    "DriveVibration",
    "SensorDelay",
    "SensorDrift",
    "SensorGain",
    "SensorTilt",
    "StickSlip",
    "ToolWeight",
]


class SensorDrift(Effect):
    """A zero that is off by `size` and wanders off by as much again in 20 s, as something warms."""

    cause = "sensor's zero"
    unit = "N"
    typical = 0.5
    warming = 20.0

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        wander = -np.expm1(-series.time / self.warming) / -np.expm1(-1.0)
        out = wrench.copy()
        out[:, 3:] += self.size * np.outer(1.0 + wander, [0.4, -0.3, -0.87])
        return out


class SensorGain(Effect):
    """A gain that is off by the share `size`, in all channels."""

    cause = "sensor's gain"
    typical = 0.08

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        return wrench * (1.0 + self.size)


class SensorTilt(Effect):
    """A sensor that sits turned by `size` about an axis between Kx and Ky."""

    cause = "sensor's tilt"
    unit = "rad"
    typical = 0.08

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        axis = np.array([0.8, 0.6, 0.0])
        K = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
        R = np.eye(3) + np.sin(self.size) * K + (1.0 - np.cos(self.size)) * K @ K
        return np.concatenate([wrench[:, :3] @ R.T, wrench[:, 3:] @ R.T], axis=1)


class SensorDelay(Effect):
    """Readings that come late by `size`, the mean delay of four equal filters in a row."""

    cause = "delay"
    unit = "s"
    typical = 0.015
    least = 0.0
    stages = 4

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        out = wrench
        if self.size == 0.0:
            return out
        # A filter y += (x - y) / (n + 1) is n coupling steps late.
        keep = self.size / self.stages / series.period
        keep = keep / (1.0 + keep)
        for _ in range(self.stages):
            start = keep * out[:1]
            out, _state = lfilter([1.0 - keep], [1.0, -keep], out, axis=0, zi=start)
        return np.asarray(out)


class ToolWeight(Effect):
    """A part of the tool of mass `size`, `lever` away from Ko, that nothing takes off the readings.

    They were zeroed at the start, so what shows is how its weight turns, and its inertia.
    """

    cause = "tool's weight"
    unit = "kg"
    typical = 0.3
    lever = -0.08

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        acceleration = np.gradient(series.v, series.period, axis=0)
        acceleration[:, 2] += GRAVITY
        force = -self.size * np.einsum("nji,nj->ni", series.R, acceleration)
        force -= force[:1]
        arm = np.array([0.0, 0.0, self.lever])
        return wrench + np.concatenate([np.cross(arm, force), force], axis=1)


class DriveVibration(Effect):
    """The arm's drives shake the sensor with `size` at `frequency`, while it moves."""

    cause = "vibration"
    unit = "N"
    typical = 0.5
    frequency = 31.0

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 3)

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        moving = np.tanh(np.linalg.norm(series.v, axis=1) / 2e-3)
        angle = 2.0 * np.pi * self.frequency * series.time[:, None] + self._phase
        out = wrench.copy()
        out[:, 3:] += self.size * moving[:, None] * np.sin(angle) * [0.3, 0.5, 1.0]
        return out


class StickSlip(Effect):
    """A saw-tooth of `size` in the press: a tooth for each `pitch` of the knife's path in food."""

    cause = "vibration"
    unit = "N"
    typical = 0.6
    pitch = 8e-4

    def respond(self, series: Series) -> None:
        path = np.cumsum(np.linalg.norm(series.v, axis=1)) * series.period
        tooth = np.mod(path / self.pitch, 1.0) - 0.5
        sliding = (series.flank > 0.0) & (np.linalg.norm(series.v, axis=1) > 1e-6)
        series.other[:, 5] += self.size * np.where(sliding, tooth * np.sign(series.press), 0.0)
