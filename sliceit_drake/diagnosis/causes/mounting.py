"""Causes in board, holder, arm and geometry."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.cutting.model import CuttingModel, PointScales
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
BOARD_FORCE = 5.0
"""Force at which an exponent of the board changes nothing, N."""


class BoardHeight(Cause):
    """Board and food that lie higher than was measured."""

    name = "board_height"
    family = "board, holder, geometry"
    parameters = (CauseParameter("height", "m", 2e-4, low=-5e-3, high=5e-3),)
    signature = "everything earlier in depth by the same, the last rise at the board most of all"
    experiment = "board_press"

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Values,
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower relative to the food's frame."""
        return R, p - np.array([0.0, 0.0, values["height"]])


class BoardLaw(Cause):
    """A board that is stiffer by a share, or stiffens as it gives."""

    name = "board_stiffness"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter("share", "", 0.3, low=-0.9, high=10.0),
        CauseParameter("exponent", "", 0.3, low=-0.5, high=1.0),
    )
    signature = "only where the board is touched; the same on the way back"
    experiment = "board_press"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With the board's part F (1 + share) (|F| / 5 N)^exponent."""
        board = series.parts["board"]
        force = np.abs(board[:, 5:])
        grown = np.where(force > 0.0, force / BOARD_FORCE, 1.0) ** values["exponent"]
        return series.wrench + board * ((1.0 + values["share"]) * grown - 1.0)


class ArmCompliance(Cause):
    """An arm that gives under the press, unseen by its encoders: at once, and more with time."""

    name = "arm_compliance"
    family = "robot"
    parameters = (
        CauseParameter(
            "compliance", "m/N", 1e-5, low=0.0, high=1e-3, adds_to="effects.compliance.arm"
        ),
        CauseParameter("creep", "m/N", 5e-6, low=0.0, high=1e-3),
    )
    scan = Scan("time", "s", (0.1, 0.5))
    uses_force = True
    signature = "depth stretched in proportion to the force"
    experiment = "board_press"

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Values,
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Higher by what creeps, and on the bare board by all that gives; over food the cut finds
        the balance of what gives at once."""
        assert force is not None
        pressed = np.concatenate([[0.0], np.maximum(force[:, 2], 0.0)])
        # On the board the force falls as the arm gives, in food next to nothing.
        deep = np.maximum(-p[:, 2], 1e-9)
        stiffness = np.where(p[:, 2] < 0.0, pressed / deep, 0.0)
        creep = values["creep"] * pressed / (1.0 + values["creep"] * stiffness)
        keep = np.exp(-float(t[1] - t[0]) / values["time"])
        rise = lfilter([1.0 - keep], [1.0, -keep], creep)
        if not facts.food:
            given = values["compliance"] * stiffness
            rise = rise + np.where(p[:, 2] < 0.0, deep * given / (1.0 + given), 0.0)
        return R, p + rise[:, None] * [0.0, 0.0, 1.0]


class HolderCompliance(Cause):
    """A holder of the food that gives along the edge."""

    name = "holder_compliance"
    family = "board, holder, geometry"
    parameters = (
        CauseParameter(
            "compliance", "m/N", 4e-5, low=0.0, high=1e-3, adds_to="effects.compliance.holder"
        ),
    )
    signature = "the force along the edge of a draw comes later, and ends later"
    experiment = "draw"


class FoodSlip(Cause):
    """Food that slips at some moment, another in each slice: the force jumps, and comes back."""

    name = "slip"
    family = "board, holder, geometry"
    parameters = tuple(CauseParameter(f"knock_{a}", "N", 1.0) for a in "xyz")
    scan = Scan("fading", "s", (0.02, 0.05, 0.12))
    per_record = True
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
        CauseParameter("taper", "", 0.1, low=-0.5, high=0.5),
        CauseParameter("belly", "", 0.1, low=-0.5, high=0.5),
    )
    signature = "locked to depth, at any speed and draw; multiplies cutting and friction alike"
    experiment = "skinned"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Cut points that stand for more or less of the section, by their height."""
        if values["taper"] == 0.0 and values["belly"] == 0.0:
            return model
        height = model.split.points[:, 2] - model.bottom
        up = np.clip(2.0 * height / (model.top - model.bottom) - 1.0, -1.0, 1.0)
        width = 1.0 - values["taper"] * up + values["belly"] * (0.5 - up**2)
        old = model.point_scales
        scales = PointScales(old.toughness * width, old.friction, old.flank_stiffness * width)
        return model.derive(point_scales=scales)
