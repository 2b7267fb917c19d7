"""Causes in the food's material: rates, skin, core, the law of the draw."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.foods.effects import Core
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.prediction.series import SliceFacts

__all__ = ["CoreRatio", "SkinToughness", "SlicePushLaw", "ToughnessBySpeed", "Viscoelasticity"]


BRANCHES = {"fast": 0.03, "medium": 0.3, "slow": 3.0}
"""Relaxation times, s."""


class Viscoelasticity(Cause):
    """Food that relaxes: the bulk's modulus (`share_*`, `effects.Relaxation`), and what a resting
    edge stands on (`rest_*`, `effects.Resting`)."""

    name = "viscoelasticity"
    family = "material"
    parameters = tuple(
        CauseParameter(f"{kind}_{speed}", "", 0.1, low=0.0, high=0.33)
        for kind in ("share", "rest")
        for speed in BRANCHES
    )
    signature = "decays in a hold; grows with the logarithm of the speed"
    experiment = "hold"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Further branches."""
        old = model.effects
        relaxing: dict[float, float] = {}
        fading: dict[float, float] = {}
        for speed, time in BRANCHES.items():
            for kind, added in (("share", relaxing), ("rest", fading)):
                if values[f"{kind}_{speed}"] != 0.0:
                    added[time] = values[f"{kind}_{speed}"]
        if not (relaxing or fading):
            return model
        effects = dc.replace(
            old, relaxation=old.relaxation.joined(relaxing), resting=old.resting.joined(fading)
        )
        return model.derive(effects=effects)


class ToughnessBySpeed(Cause):
    """Toughness that goes with a power of the edge's speed."""

    name = "toughness_rate"
    family = "material"
    parameters = (
        CauseParameter(
            "exponent", "", 0.08, low=-0.5, high=0.5, adds_to="effects.toughness_rate.exponent"
        ),
    )
    signature = "scales the whole plateau with the speed; ceases at once when the edge stops"
    experiment = "speeds"


class SkinToughness(Cause):
    """Food that is tougher towards the outside, by exp(-distance / thickness); where not peeled.

    All that parts there is tougher; the skin of `effects.skin` is cut by the edge alone.
    """

    name = "skin"
    family = "material"
    parameters = (
        CauseParameter(
            "toughness", "J/m", 0.5, low=0.0, high=20.0, adds_to="effects.outside.toughness"
        ),
    )
    scan = Scan("thickness", "m", (5e-4, 1.2e-3, 3e-3), "effects.outside.thickness")
    absorbed_by = ("effects.skin.toughness",)
    signature = "peaks at entry and exit; none where the food is skinned"
    experiment = "skinned"


class CoreRatio(Cause):
    """A core that is less tough than the rind by a share, and half as much softer."""

    name = "core"
    family = "material"
    parameters = (CauseParameter("weakening", "", 0.3, low=-2.0, high=0.9),)
    scan = Scan("rind", "", (0.15, 0.3, 0.5))
    signature = "locked to depth, at any speed; another shape than the section's width"
    experiment = "repeats"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Another core; the rind is given as a fraction of half the section's size."""
        half = 0.5 * min(model.top - model.bottom, float(np.ptp(model.span)))
        weakening, old = values["weakening"], model.effects.core
        core = Core(
            rind=values["rind"] * half,
            transition=0.4 * half,
            toughness_ratio=old.toughness_ratio * (1.0 - weakening),
            stiffness_ratio=old.stiffness_ratio * (1.0 - 0.5 * weakening),
        )
        return model.derive(effects=dc.replace(model.effects, core=core))


class SlicePushLaw(Cause):
    """A draw that helps more or less than work per area says, (1 + xi^2)^-(1 + exponent), and an
    edge that pulls along itself by a share more or less than xi times the press."""

    name = "slice_push_law"
    family = "material"
    parameters = (
        CauseParameter(
            "exponent", "", 0.25, low=-1.0, high=2.0, adds_to="effects.slice_push.exponent"
        ),
        CauseParameter("pull", "", 0.15, low=-1.0, high=1.0, adds_to="effects.slice_push.pull"),
    )
    signature = "nothing without a draw, grows with the draw; along the edge unlike down"
    experiment = "draw"
