"""Causes in what the robot carries and how it moves. They act on predicted wrenches alone."""

from collections.abc import Mapping

import numpy as np

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, ForceSeries, Scan, SliceFacts

__all__ = ["StickSlip", "ToolWeight", "Vibration"]

GRAVITY = 9.81
AXES = ("x", "y", "z")
REST = 2e-3
"""Speed below which drives do not shake, m/s."""


class ToolWeight(Cause):
    """Weight and inertia of a part of the tool that nothing takes off the readings."""

    name = "tool_weight"
    family = "robot"
    row = 20
    parameters = (
        CauseParameter("mass", "kg", 0.15, low=-5.0, high=5.0),
        CauseParameter("moment", "kg m", 0.01, low=-1.0, high=1.0),
    )
    signature = "there in the air; goes with acceleration and the tool's orientation"
    experiment = "air"

    def wrench(
        self, series: ForceSeries, values: Mapping[str, float], facts: SliceFacts
    ) -> np.ndarray:
        """With what a mass on Kz adds, `moment` its mass times its place there from Ko.

        A sensor that was zeroed at the start does not show what was there then.
        """
        acceleration = np.gradient(series.v, series.period, axis=0)
        acceleration[:, 2] += GRAVITY
        down = series.in_food(np.array([0.0, 0.0, 1.0]))
        added = np.concatenate(
            [
                -values["moment"] * np.cross(down, acceleration),
                -values["mass"] * acceleration,
            ],
            axis=1,
        )
        if facts.tared:
            first = np.concatenate(
                [series.in_knife(added[:, :3])[:1], series.in_knife(added[:, 3:])[:1]], axis=1
            )[0]
            added -= np.concatenate([series.in_food(first[:3]), series.in_food(first[3:])], axis=1)
        return series.wrench + added


class Vibration(Cause):
    """Drives that shake the sensor while they move, at one frequency, in any phase."""

    name = "vibration"
    family = "robot"
    row = 21
    parameters = tuple(
        CauseParameter(f"{wave}_{axis}", "N", 0.3) for axis in AXES for wave in ("cosine", "sine")
    )
    scan = Scan("frequency", "Hz", (3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0))
    per_record = True
    signature = "waves locked to time, also in the air, none at rest"
    experiment = "air"

    def wrench(
        self, series: ForceSeries, values: Mapping[str, float], facts: SliceFacts
    ) -> np.ndarray:
        """With the waves."""
        angle = 2.0 * np.pi * values["frequency"] * (series.time - series.time[0])
        moving = np.tanh(series.speed / REST)
        out = series.wrench.copy()
        for k, axis in enumerate(AXES):
            wave = values[f"cosine_{axis}"] * np.cos(angle) + values[f"sine_{axis}"] * np.sin(angle)
            out[:, 3 + k] += moving * wave
        return out


class StickSlip(Cause):
    """Food that sticks and slips on the flanks: waves with the path of the knife in it."""

    name = "stick_slip"
    family = "knife and contact"
    row = 21
    parameters = (CauseParameter("cosine", "N", 0.3), CauseParameter("sine", "N", 0.3))
    scan = Scan("pitch", "m", (4e-4, 5.5e-4, 8e-4, 1.1e-3, 1.6e-3, 2.2e-3, 3.2e-3))
    per_record = True
    signature = "waves locked to the path, so that their frequency goes with the speed; not in air"
    experiment = "speeds"

    def wrench(
        self, series: ForceSeries, values: Mapping[str, float], facts: SliceFacts
    ) -> np.ndarray:
        """With the waves, against the motion."""
        path = np.cumsum(series.speed) * series.period
        angle = 2.0 * np.pi * path / values["pitch"]
        wave = values["cosine"] * np.cos(angle) + values["sine"] * np.sin(angle)
        flank = np.abs(series.parts["normal"][:, 3:]).max(1) + np.abs(
            series.parts["friction"][:, 3:]
        ).max(1)
        sliding = (flank > 0.0) & (series.depth > 0.0) & (series.speed > 1e-6)
        out = series.wrench.copy()
        out[:, 5] += np.where(sliding, -np.sign(series.v[:, 2]) * wave, 0.0)
        return out
