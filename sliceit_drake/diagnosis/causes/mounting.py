"""Causes in board, holder, arm and geometry."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity
from sliceit_drake.diagnosis.evidence.searches import largest_jump, unlike_others
from sliceit_drake.prediction.series import ForceSeries, SliceFacts

__all__ = [
    "ArmCompliance",
    "BoardHeight",
    "BoardLaw",
    "FoodSlip",
    "HolderCompliance",
    "SectionShape",
]

CALM = 0.3
"""Jump of the prediction itself near which none is looked for, N."""


class BoardHeight(Cause):
    """Board and food that lie higher than was measured."""

    name = "board_height"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter("height", "m", 2e-4, low=-5e-3, high=5e-3, adds_to="bench.board.height"),
    )
    signature = "everything earlier in depth by the same, the last rise at the board most of all"
    experiment = "board_press"


class BoardLaw(Cause):
    """A board that is stiffer by a share, or stiffens as it gives."""

    name = "board_stiffness"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter("share", "", 0.3, low=-0.9, high=10.0, adds_to="bench.board.stiffness"),
        CauseParameter("exponent", "", 0.3, low=-0.5, high=1.0, adds_to="bench.board.exponent"),
    )
    signature = "only where the board is touched; the same on the way back"
    experiment = "board_press"


class ArmCompliance(Cause):
    """An arm that gives under the press, unseen by its encoders: at once, and more with time."""

    name = "arm_compliance"
    family = "robot"
    parameters = (
        CauseParameter(
            "compliance", "m/N", 1e-5, low=0.0, high=1e-3, adds_to="bench.arm.compliance"
        ),
        CauseParameter("creep", "m/N", 5e-6, low=0.0, high=1e-3, adds_to="bench.arm.creep"),
    )
    scan = Scan("time", "s", (0.1, 0.5), "bench.arm.creep_time")
    absorbed_by = ("effects.compliance.arm",)
    signature = "depth stretched in proportion to the force"
    experiment = "board_press"


class HolderCompliance(Cause):
    """A holder of the food that gives along the edge."""

    name = "holder_compliance"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter(
            "compliance", "m/N", 4e-5, low=0.0, high=1e-3, adds_to="bench.mounting.compliance"
        ),
    )
    absorbed_by = ("effects.compliance.holder",)
    signature = "the force along the edge of a draw comes later, and ends later"
    experiment = "draw"


class FoodSlip(Cause):
    """Food that slips at some moment, another in each slice: the force jumps, and comes back."""

    name = "slip"
    family = "board, holder, geometry"
    parameters = tuple(CauseParameter(f"knock_{a}", "N", 1.0) for a in "xyz")
    scan = Scan("fading", "s", (0.02, 0.05, 0.12))
    per_record = alone = True
    searched = 45.0
    signature = "an abrupt change at no certain depth, sideways above all; does not repeat"
    experiment = "repeats"

    def __init__(self) -> None:
        self._moments: dict[str, float] = {}

    def adapted(self, records: Sequence[RecordSensitivity]) -> Cause:
        """At the moment of each record at which the residual jumps most, less what its condition
        has in common: what repeats is no slip."""
        assert self.scan is not None
        out = FoodSlip()
        for r, rest in zip(records, unlike_others(records), strict=True):
            calm = (r.kinks()[:, r.forces] < CALM).all(1)
            inside = r.in_contact & (r.depth > 0.0) & calm
            if inside.any():
                moment = largest_jump(r.time, rest[:, r.forces], inside, self.scan.values[1])
                out._moments[r.name] = moment
        return out

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the knock."""
        moment = self._moments.get(facts.name)
        if moment is None:
            return series.wrench
        since = series.time - moment
        fading = np.where(since >= 0.0, np.exp(-np.maximum(since, 0.0) / values["fading"]), 0.0)
        out = series.wrench.copy()
        for k, axis in enumerate("xyz"):
            out[:, 3 + k] += values[f"knock_{axis}"] * fading
        return out


class SectionShape(Cause):
    """A section of another shape than was measured: wider below, or wider in the middle."""

    name = "section_shape"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter("taper", "", 0.1, low=-0.5, high=0.5, adds_to="effects.section.taper"),
        CauseParameter("belly", "", 0.1, low=-0.5, high=0.5, adds_to="effects.section.belly"),
    )
    signature = "locked to depth, at any speed and draw; multiplies cutting and friction alike"
    experiment = "skinned"
