"""Causes in board, holder, arm and geometry."""

import dataclasses as dc
from collections.abc import Mapping

import numpy as np

from sliceit_drake.cutting.model import CuttingModel, PointScales
from sliceit_drake.diagnosis.cause import Cause, CauseParameter, ForceSeries, Scan, SliceFacts

__all__ = [
    "ArmCompliance",
    "BoardHeight",
    "BoardLaw",
    "FoodSlip",
    "HolderCompliance",
    "SectionShape",
]

BOARD_FORCE = 5.0
"""Force at which an exponent of the board changes nothing, N."""


class BoardHeight(Cause):
    """Board and food that lie higher than was measured."""

    name = "board_height"
    family = "board, holder, geometry"
    row = 13
    parameters = (CauseParameter("height", "m", 2e-4, low=-5e-3, high=5e-3),)
    signature = "everything earlier in depth by the same, the last rise at the board most of all"
    experiment = "board_press"

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Mapping[str, float],
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower relative to the food's frame."""
        return R, p - np.array([0.0, 0.0, values["height"]])


class BoardLaw(Cause):
    """A board that is stiffer by a share, or stiffens as it gives."""

    name = "board_stiffness"
    family = "board, holder, geometry"
    row = 13
    parameters = (
        CauseParameter("share", "", 0.3, low=-0.9, high=10.0),
        CauseParameter("exponent", "", 0.3, low=-0.5, high=1.0),
    )
    signature = "only where the board is touched; the same on the way back"
    experiment = "board_press"

    def wrench(
        self, series: ForceSeries, values: Mapping[str, float], facts: SliceFacts
    ) -> np.ndarray:
        """With the board's part F (1 + share) (|F| / 5 N)^exponent."""
        board = series.parts["board"]
        force = np.abs(board[:, 5:])
        grown = np.where(force > 0.0, force / BOARD_FORCE, 1.0) ** values["exponent"]
        return series.wrench + board * ((1.0 + values["share"]) * grown - 1.0)


class ArmCompliance(Cause):
    """An arm that gives under the press, unseen by its encoders."""

    name = "arm_compliance"
    family = "robot"
    row = 14
    parameters = (CauseParameter("compliance", "m/N", 4e-5, low=0.0, high=1e-3),)
    uses_force = True
    absorbed_by = ("effects.compliance.arm",)
    signature = "depth stretched in proportion to the force; at once, without a decay"
    experiment = "board_press"

    def model(
        self, model: CuttingModel, values: Mapping[str, float], facts: SliceFacts
    ) -> CuttingModel:
        """A softer arm."""
        old = model.effects.compliance
        softer = dc.replace(old, arm=old.arm + values["compliance"])
        return model.derive(effects=dc.replace(model.effects, compliance=softer))

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Mapping[str, float],
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """On the bare board in balance with its spring; over food the cut finds the balance."""
        if facts.food or force is None:
            return R, p
        pressed = np.concatenate([[0.0], np.maximum(force[:, 2], 0.0)])
        deep = np.maximum(-p[:, 2], 1e-9)
        stiffness = np.where(p[:, 2] < 0.0, pressed / deep, 0.0)
        given = values["compliance"] * stiffness
        rise = np.where(p[:, 2] < 0.0, deep * given / (1.0 + given), 0.0)
        return R, p + rise[:, None] * [0.0, 0.0, 1.0]


class HolderCompliance(Cause):
    """A holder of the food that gives along the edge."""

    name = "holder_compliance"
    family = "board, holder, geometry"
    row = 14
    parameters = (CauseParameter("compliance", "m/N", 4e-5, low=0.0, high=1e-3),)
    absorbed_by = ("effects.compliance.holder",)
    signature = "the force along the edge of a draw comes later, and ends later"
    experiment = "draw"

    def model(
        self, model: CuttingModel, values: Mapping[str, float], facts: SliceFacts
    ) -> CuttingModel:
        """A softer holder."""
        old = model.effects.compliance
        softer = dc.replace(old, holder=old.holder + values["compliance"])
        return model.derive(effects=dc.replace(model.effects, compliance=softer))


class FoodSlip(Cause):
    """Food that slips along the edge at some depth, another in each slice, and knocks the blade."""

    name = "slip"
    family = "board, holder, geometry"
    row = 15
    parameters = (
        CauseParameter("distance", "m", 2e-3, low=-0.02, high=0.02),
        CauseParameter("knock", "N", 1.0),
    )
    scan = Scan("depth", "", (0.3, 0.45, 0.6, 0.75, 0.9), by_record=True)
    per_record = True
    signature = "an abrupt drop at no certain depth, with a jump sideways; does not repeat"
    experiment = "repeats"

    duration = 0.02
    fading = 0.05

    def _since(self, t: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        """Time since the slip [N], s; 0 before."""
        down = np.diff(depth, append=depth[-1]) > 0.0
        past = np.flatnonzero((depth > values["depth"]) & down)
        return np.maximum(t - t[past[0]], 0.0) if past.size else np.zeros(len(t))

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Mapping[str, float],
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Back along the edge, relative to food that has slipped."""
        if facts.height <= 0.0 or values["distance"] == 0.0:
            return R, p
        since = self._since(t, 1.0 - p[:, 2] / facts.height, values)
        done = -np.expm1(-since / self.duration)
        return R, p - values["distance"] * done[:, None] * [1.0, 0.0, 0.0]

    def wrench(
        self, series: ForceSeries, values: Mapping[str, float], facts: SliceFacts
    ) -> np.ndarray:
        """With the knock."""
        if facts.height <= 0.0 or values["knock"] == 0.0:
            return series.wrench
        since = self._since(series.time, series.depth / facts.height, values)
        out = series.wrench.copy()
        out[:, 4] += values["knock"] * np.where(since > 0.0, np.exp(-since / self.fading), 0.0)
        return out


class SectionShape(Cause):
    """A section of another shape than was measured: wider below, or wider in the middle."""

    name = "section_shape"
    family = "board, holder, geometry"
    row = 11
    parameters = (
        CauseParameter("taper", "", 0.1, low=-0.5, high=0.5),
        CauseParameter("belly", "", 0.1, low=-0.5, high=0.5),
    )
    signature = "locked to depth, at any speed and draw; multiplies cutting and friction alike"
    experiment = "skinned"

    def model(
        self, model: CuttingModel, values: Mapping[str, float], facts: SliceFacts
    ) -> CuttingModel:
        """Cut points that stand for more or less of the section, by their height."""
        if values["taper"] == 0.0 and values["belly"] == 0.0:
            return model
        height = model.split.points[:, 2] - model.bottom
        up = np.clip(2.0 * height / (model.top - model.bottom) - 1.0, -1.0, 1.0)
        width = 1.0 - values["taper"] * up + values["belly"] * (0.5 - up**2)
        old = model.point_scales
        scales = PointScales(
            old.toughness * width, old.friction.copy(), old.flank_stiffness * width
        )
        return model.derive(point_scales=scales)
