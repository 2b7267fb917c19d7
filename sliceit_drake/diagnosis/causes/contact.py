"""Causes between knife and food: adhesion, static friction, a blunt and a dulling edge."""

import dataclasses as dc

from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.prediction.series import SliceFacts

__all__ = ["BluntEdge", "Dulling", "FlankAdhesion", "StaticFriction"]


class StaticFriction(Cause):
    """Friction that is higher at rest than sliding, by a share (Stribeck)."""

    name = "static_friction"
    family = "knife and contact"
    parameters = (CauseParameter("share", "", 0.5, low=0.0, high=20.0),)
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
    parameters = (
        CauseParameter(
            "initiation", "J/m2", 250.0, low=0.0, high=1e4, adds_to="effects.entry.initiation"
        ),
    )
    scan = Scan("depth", "m", (1e-3, 2e-3, 4e-3), "effects.entry.depth")
    absorbed_by = ("effects.bluntness.initiation",)
    signature = "raises the first peak, the plateau hardly; with skin or without, less in a draw"
    experiment = "skinned"


class Dulling(Cause):
    """An edge that grows blunt with the slices since it was sharpened, as a power of them."""

    name = "dulling"
    family = "knife and contact"
    by_slice = True
    parameters = (
        CauseParameter("growth", "J/m2", 250.0, low=0.0, high=1e4, adds_to="effects.entry.dulling"),
    )
    scan = Scan("exponent", "", (0.5, 1.0), "effects.entry.dulling_exponent")
    absorbed_by = ("effects.bluntness.dulling",)
    signature = "the first peak grows from slice to slice, and is back when the knife is sharpened"
    experiment = "repeats"
