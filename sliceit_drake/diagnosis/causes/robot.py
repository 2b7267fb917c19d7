"""Causes in what the robot carries and how it moves."""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity
from sliceit_drake.diagnosis.evidence.searches import strongest_frequencies
from sliceit_drake.prediction.series import ForceSeries, SliceFacts

__all__ = ["StickSlip", "ToolWeight", "Vibration"]

REST = 2e-3
"""Speed below which drives do not shake, m/s."""


class ToolWeight(Cause):
    """Weight and inertia of a part of the tool that nothing takes off the readings."""

    name = "tool_weight"
    family = "robot"
    parameters = (
        CauseParameter("mass", "kg", 0.15, low=-5.0, high=5.0, adds_to="bench.tool.mass"),
        CauseParameter("moment", "kg m", 0.01, low=-1.0, high=1.0, adds_to="bench.tool.moment"),
    )
    signature = "there in the air; goes with acceleration and the tool's orientation"
    experiment = "air"


class Vibration(Cause):
    """Drives that shake the sensor while they move, at one frequency, in any phase."""

    name = "vibration"
    family = "robot"
    parameters = tuple(
        CauseParameter(f"{wave}_{axis}", "N", 0.3) for axis in "xyz" for wave in ("cosine", "sine")
    )
    scan = Scan("frequency", "Hz", (5.0, 10.0, 20.0, 40.0))
    per_record = True
    searched = 10.0
    signature = "waves locked to time, also in the air, none at rest"
    experiment = "air"

    range = (3.0, 80.0)
    """Frequencies at which it is looked for, Hz."""

    def adapted(self, records: Sequence[RecordSensitivity]) -> Cause:
        """At the frequencies at which the residuals of all records are strongest."""
        series = []
        for r in records:
            moving = np.gradient(r.path, r.time) > REST
            series.append((r.time[moving], r.residual[moving][:, r.forces]))
        return _at(self, strongest_frequencies(series, *self.range))

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the waves."""
        angle = 2.0 * np.pi * values["frequency"] * (series.time - series.time[0])
        moving = np.tanh(series.speed / REST)
        out = series.wrench.copy()
        for k, axis in enumerate("xyz"):
            wave = values[f"cosine_{axis}"] * np.cos(angle) + values[f"sine_{axis}"] * np.sin(angle)
            out[:, 3 + k] += moving * wave
        return out


class StickSlip(Cause):
    """Food that sticks and slips on the flanks: waves with the path of the knife in it, of any
    form (three harmonics)."""

    name = "stick_slip"
    family = "knife and contact"
    parameters = tuple(
        CauseParameter(f"{wave}_{n}", "N", 0.3 / n)
        for n in (1, 2, 3)
        for wave in ("cosine", "sine")
    )
    scan = Scan("pitch", "m", (5e-4, 1e-3, 2e-3))
    per_record = True
    searched = 10.0
    signature = "waves locked to the path, so that their frequency goes with the speed; not in air"
    experiment = "speeds"

    range = (3e-4, 4e-3)
    """Pitches at which it is looked for, metres."""

    def adapted(self, records: Sequence[RecordSensitivity]) -> Cause:
        """At the pitches at which the residuals of all records are strongest."""
        series = []
        for r in records:
            cutting = r.in_contact & (r.depth > 0.0) & (np.gradient(r.path, r.time) > REST)
            vertical = [k for k, name in enumerate(r.channels) if name in ("force_z", "force_norm")]
            # Against the motion, as below.
            down = np.sign(np.gradient(r.depth))[:, None]
            series.append((r.path[cutting], (down * r.residual[:, vertical])[cutting]))
        found = strongest_frequencies(series, 1.0 / self.range[1], 1.0 / self.range[0])
        return _at(self, tuple(1.0 / f for f in found))

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the waves, against the motion."""
        path = np.cumsum(series.speed) * series.period
        angle = 2.0 * np.pi * path / values["pitch"]
        wave = np.zeros(len(angle))
        for n in (1, 2, 3):
            wave += values[f"cosine_{n}"] * np.cos(n * angle)
            wave += values[f"sine_{n}"] * np.sin(n * angle)
        flank = np.abs(series.parts["normal"][:, 3:]).max(1) + np.abs(
            series.parts["friction"][:, 3:]
        ).max(1)
        sliding = (flank > 0.0) & (series.depth > 0.0) & (series.speed > 1e-6)
        out = series.wrench.copy()
        out[:, 5] += np.where(sliding, -np.sign(series.v[:, 2]) * wave, 0.0)
        return out


def _at(cause: Cause, values: tuple[float, ...]) -> Cause:
    """The cause with these values of its scan; as it is if there are none."""
    if not values or cause.scan is None:
        return cause
    out = copy.copy(cause)
    out.scan = dc.replace(cause.scan, values=values)
    return out
