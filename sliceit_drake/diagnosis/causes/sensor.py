"""Causes in the wrench sensor and its mounting. They act on predicted wrenches alone."""

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.prediction.series import ForceSeries, SliceFacts

__all__ = ["SensorDelay", "SensorGain", "SensorTilt", "SensorZero"]


class SensorZero(Cause):
    """A zero that is off, and drifts, the same in all records, in the knife's axes."""

    name = "sensor_zero"
    family = "sensor"
    parameters = (
        *(CauseParameter(f"bias_{a}", "N", 0.3) for a in "xyz"),
        *(CauseParameter(f"drift_{a}", "N/s", 0.03) for a in "xyz"),
    )
    signature = "there without contact; independent of depth and speed"
    experiment = "air"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the zero added."""
        bias, drift = (np.array([values[f"{k}_{a}"] for a in "xyz"]) for k in ("bias", "drift"))
        out = series.wrench.copy()
        since = (series.time - series.time[0])[:, None]
        out[:, 3:] += series.in_food(bias + since * drift)
        return out


class SensorGain(Cause):
    """A gain that is off by a share, in all channels."""

    name = "sensor_gain"
    family = "sensor"
    parameters = (CauseParameter("gain", "", 0.08, low=-0.9, high=5.0),)
    signature = "scales everything, a known weight too"
    experiment = "weight"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """Scaled."""
        return series.wrench * (1.0 + values["gain"])


class SensorTilt(Cause):
    """A sensor that sits turned about Kx and Ky: forces of one axis show on another."""

    name = "sensor_tilt"
    family = "sensor"
    parameters = (
        CauseParameter("about_x", "rad", 0.06, low=-0.5, high=0.5),
        CauseParameter("about_y", "rad", 0.06, low=-0.5, high=0.5),
    )
    signature = "sideways forces in proportion to the press; turns with the tool"
    experiment = "weight"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """Turned."""
        turn = series.in_food(np.array([values["about_x"], values["about_y"], 0.0]))
        angle = float(np.hypot(values["about_x"], values["about_y"]))
        if angle == 0.0:
            return series.wrench
        out = series.wrench.copy()
        axis = turn / angle
        for part in (slice(0, 3), slice(3, 6)):
            v = series.wrench[:, part]
            along = axis * (axis * v).sum(1, keepdims=True)
            out[:, part] = along + np.cos(angle) * (v - along) + np.sin(angle) * np.cross(axis, v)
        return out


class SensorDelay(Cause):
    """Readings that come late: equal low-pass filters in a row, or a shift in time."""

    name = "sensor_delay"
    family = "sensor"
    parameters = (CauseParameter("delay", "s", 0.01, low=0.0, high=0.2),)
    scan = Scan("stages", "", (1.0, 4.0))
    signature = "minus the delay times the rate of the force; in depth it goes with the speed"
    experiment = "retract"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """Delayed; a filter y += (x - y) / (n + 1) is n rows late."""
        stages = round(values["stages"])
        rows = values["delay"] / stages / series.period
        keep = rows / (1.0 + rows)
        out = series.wrench
        for _ in range(stages if values["delay"] > 0.0 else 0):
            out, _ = lfilter([1.0 - keep], [1.0, -keep], out, axis=0, zi=keep * out[:1])
        return np.asarray(out)
