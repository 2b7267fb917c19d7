"""Causes between knife and food: adhesion, static friction, a blunt and a dulling edge."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.foods.effects import Bluntness
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.diagnosis.causes.material import tougher
from sliceit_drake.prediction.series import SliceFacts

__all__ = ["BluntEdge", "Dulling", "FlankAdhesion", "StaticFriction"]

DULLED = 10.0
"""Slices after which a dulling edge has its `growth`."""
DULLED_DEPTH = 2e-3
"""Over which its excess falls to 1/e, metres."""


class StaticFriction(Cause):
    """Friction that is higher at rest than sliding, by a share (Stribeck)."""

    name = "static_friction"
    family = "knife and contact"
    parameters = (CauseParameter("share", "", 0.5, low=0.0, high=5.0),)
    scan = Scan("speed", "m/s", (3e-3, 1e-2, 3e-2))
    absorbed_by = ("material.static_friction",)
    signature = "as friction, less the faster the knife; flips its sign on withdrawal"
    experiment = "second_pass"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Higher friction at rest."""
        old = model.material
        rest = max(old.static_friction, old.friction) + values["share"] * old.friction
        if values["share"] == 0.0:
            return model
        material = dc.replace(old, static_friction=rest, stribeck_velocity=values["speed"])
        return model.derive(material=material)


class FlankAdhesion(Cause):
    """Food that sticks to the flanks: a shear stress, and one that grows with a power of the speed,
    in proportion or as its root."""

    name = "adhesion"
    family = "knife and contact"
    parameters = (
        CauseParameter("stress", "Pa", 400.0, low=0.0, high=1e5, adds_to="effects.adhesion.stress"),
        CauseParameter(
            "viscosity", "Pa s/m", 1.5e4, low=0.0, high=1e6, adds_to="effects.adhesion.viscosity"
        ),
    )
    scan = Scan("exponent", "", (0.5, 1.0))
    signature = "as friction without pressure; pulls at the end of a withdrawal, more the faster"
    experiment = "retract"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """More adhesion."""
        model = super().model(model, values, facts)
        # At its null nothing may change, and the null has no exponent.
        if values["viscosity"] != 0.0:
            model = with_parameters(model, {"effects.adhesion.exponent": values["exponent"]})
        return model


class BluntEdge(Cause):
    """An edge that needs more to begin a cut."""

    name = "bluntness"
    family = "knife and contact"
    parameters = (CauseParameter("initiation", "J/m2", 250.0, low=0.0, high=1e4),)
    scan = Scan("depth", "m", (1e-3, 2e-3, 4e-3))
    absorbed_by = ("effects.bluntness.initiation",)
    signature = "raises the first peak, the plateau hardly; with skin or without, less in a draw"
    experiment = "skinned"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Tougher points near the surface."""
        return _harder_to_begin(model, values["initiation"], values["depth"])

    def extension(self, model: CuttingModel, values: Values) -> CuttingModel:
        """More to begin with; the depth over which it falls takes the place of the model's."""
        return _blunter(model, values["initiation"], values["depth"])


class Dulling(Cause):
    """An edge that grows blunt with the slices since it was sharpened, as a power of them."""

    name = "dulling"
    family = "knife and contact"
    by_slice = True
    parameters = (CauseParameter("growth", "J/m2", 250.0, low=0.0, high=1e4),)
    scan = Scan("exponent", "", (0.5, 1.0))
    absorbed_by = ("effects.bluntness.dulling",)
    signature = "the first peak grows from slice to slice, and is back when the knife is sharpened"
    experiment = "repeats"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Tougher points near the surface, by the number of slices."""
        grown = values["growth"] * (facts.knife_slices / DULLED) ** values["exponent"]
        return _harder_to_begin(model, grown, DULLED_DEPTH)

    def extension(self, model: CuttingModel, values: Values) -> CuttingModel:
        """An edge after `DULLED` slices."""
        return _blunter(model, values["growth"], DULLED_DEPTH)


def _harder_to_begin(model: CuttingModel, initiation: float, depth: float) -> CuttingModel:
    """Tougher points near the top, where the edge begins: all that parts there is harder, and not
    what the edge alone does below each place of the outside, as in `effects.bluntness`."""
    tables = model.tables
    grid = np.linspace(-tables.reach, tables.reach, tables.width.shape[1])
    depths = model.top - model.split.points[:, 2]
    below = np.maximum(depths[:, None] + grid, 0.0)
    work = float((np.exp(-below / depth) * tables.width).sum()) * tables.spacing
    shape = np.exp(-np.maximum(depths, 0.0) / depth)
    return tougher(model, shape, initiation * work)


def _blunter(model: CuttingModel, excess: float, depth: float) -> CuttingModel:
    blunt = Bluntness(model.effects.bluntness.grown + excess, depth)
    return model.derive(effects=dc.replace(model.effects, bluntness=blunt))
