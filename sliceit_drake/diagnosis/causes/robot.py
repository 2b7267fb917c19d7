"""Causes in what the robot carries and how it moves."""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, replicates
from sliceit_drake.diagnosis.evidence.searches import strongest_frequencies
from sliceit_drake.prediction.series import ForceSeries, SliceFacts

__all__ = ["StickSlip", "ToolWeight", "Vibration"]

REST = 2e-3
"""Speed below which drives do not shake, m/s."""
NEAR = 1.0
"""By how much a frequency may be off, Hz."""


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
    """Drives that shake the sensor while they move, in any phase: at one frequency, or at one of
    each condition's own, as where it goes with the speed."""

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

    def __init__(self) -> None:
        self._own: dict[str, float] = {}

    def adapted(self, records: Sequence[RecordSensitivity]) -> Cause:
        """At the frequencies at which the residuals of all records are strongest, and, as a last
        value of the scan, at that of each condition; the value is then their mean."""
        own: dict[str, float] = {}
        for members in replicates(records).values():
            found = _of_drives([records[k] for k in members], records, *self.range)
            own |= {records[k].name: f for f in found[:1] for k in members}
        mean = (float(np.mean([*own.values()])),) if own else ()
        out = Vibration()
        out._own = own
        return _at(out, _of_drives(records, records, *self.range) + mean)

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the waves."""
        assert self.scan is not None
        frequency = values["frequency"]
        if self._own and frequency == self.scan.values[-1]:
            frequency = self._own.get(facts.name, frequency)
        angle = 2.0 * np.pi * frequency * (series.time - series.time[0])
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


def _of_drives(
    records: Sequence[RecordSensitivity],
    resting: Sequence[RecordSensitivity],
    low: float,
    high: float,
) -> tuple[float, ...]:
    """Frequencies at which the residuals of records are strongest in motion and have less than half
    of that amplitude at rest, in any of `resting`: the mains hum at rest as well."""
    moving, at_rest = _parts(records, True), _parts(resting, False)
    # What rests for longer resolves a frequency better than what moved when it was found.
    near = np.linspace(-NEAR, NEAR, 41)
    return tuple(
        f
        for f in strongest_frequencies(moving, low, high)
        if max(_square(at_rest, f + away) for away in near) < 0.25 * _square(moving, f)
    )


def _parts(
    records: Sequence[RecordSensitivity], moves: bool
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times [m] and residuals of the forces [m, c] of each record while it moves, or rests."""
    out = []
    for r in records:
        rows = (np.gradient(r.path, r.time) > REST) == moves
        out.append((r.time[rows], r.residual[rows][:, r.forces]))
    return out


def _square(parts: Sequence[tuple[np.ndarray, np.ndarray]], frequency: float) -> float:
    """Mean square of the waves of a frequency."""
    power = rows = 0.0
    for time, values in parts:
        if len(time):
            wave = np.exp(2j * np.pi * frequency * time)
            power += float((np.abs(wave @ (values - values.mean(0))) ** 2).sum())
            rows += len(time) ** 2
    return power / max(rows, 1.0)


def _at(cause: Cause, values: tuple[float, ...]) -> Cause:
    """The cause with these values of its scan; as it is if there are none."""
    if not values or cause.scan is None:
        return cause
    out = copy.copy(cause)
    out.scan = dc.replace(cause.scan, values=values)
    return out
