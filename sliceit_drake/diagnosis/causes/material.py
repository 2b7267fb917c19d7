"""Causes in the food's material: rates, skin, core, the law of the draw."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.foods.effects import Core, Relaxation, Skin
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan, Values
from sliceit_drake.prediction.series import ForceSeries, SliceFacts

__all__ = [
    "CoreRatio",
    "SkinToughness",
    "SlicePushLaw",
    "ToughnessBySpeed",
    "Viscoelasticity",
    "tougher",
]


BRANCHES = {"fast": 0.03, "medium": 0.3, "slow": 3.0}
"""Relaxation times, s."""
RESTING = 2e-4
"""Speed below which a knife rests, m/s."""
RECOVERY = 5e-4
"""Travel over which a force that faded comes back, metres."""


class Viscoelasticity(Cause):
    """Food that relaxes: the bulk's modulus (a Prony series), and what a resting edge stands on.

    `share_*`: of the modulus that fades with each time, in the finite elements. `rest_*`: of the
    force at a stop that fades with each time while the knife rests in the food, and comes back over
    `RECOVERY` of travel: around an edge at rest the food flows, where one that moves always meets
    fresh food. A decade apart, branches together follow a power law of time within a few per cent,
    which one alone does not.
    """

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
        old = model.effects.relaxation
        shares = {time: values[f"share_{speed}"] for speed, time in BRANCHES.items()}
        added = {time: share for time, share in shares.items() if share != 0.0}
        if not added:
            return model
        relaxation = Relaxation([*old.shares, *added.values()], [*old.times, *added])
        return model.derive(effects=dc.replace(model.effects, relaxation=relaxation))

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """Less what has faded while the knife rests."""
        shares = {time: values[f"rest_{speed}"] for speed, time in BRANCHES.items()}
        if not any(shares.values()):
            return series.wrench
        food = series.parts["edge"] + series.parts["normal"] + series.parts["friction"]
        faded = np.zeros(len(food))
        held = dict.fromkeys(shares, 0.0)
        speed, period = series.speed, series.period
        for k in range(len(food)):
            resting = series.in_contact[k] and speed[k] < RESTING
            for time in held:
                if resting:
                    held[time] += (1.0 - held[time]) * (1.0 - np.exp(-period / time))
                else:
                    held[time] *= float(np.exp(-speed[k] * period / RECOVERY))
            faded[k] = sum(share * held[time] for time, share in shares.items())
        return np.asarray(series.wrench - faded[:, None] * food)


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

    All that parts there is tougher, by the edge or ahead of it. The skin of `effects.skin` is cut
    by the edge alone.
    """

    name = "skin"
    family = "material"
    parameters = (CauseParameter("toughness", "J/m", 0.5, low=0.0, high=20.0),)
    scan = Scan("thickness", "m", (5e-4, 1.2e-3, 3e-3))
    absorbed_by = ("effects.skin.toughness",)
    signature = "peaks at entry and exit; none where the food is skinned"
    experiment = "skinned"

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """Tougher points near the outside; in all by `toughness` times the outline."""
        if facts.peeled:
            return model
        outline = float(model.tables.skin(values["thickness"]).sum()) * model.tables.spacing
        shape = np.exp(-model.point_distance / values["thickness"])
        return tougher(model, shape, values["toughness"] * outline)

    def extension(self, model: CuttingModel, values: Values) -> CuttingModel:
        """More skin; its thickness takes the place of the model's."""
        skin = Skin(model.effects.skin.toughness + values["toughness"], values["thickness"])
        return model.derive(effects=dc.replace(model.effects, skin=skin))


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
        half = 0.5 * min(facts.height, facts.width)
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
            "exponent", "", 0.25, low=-0.5, high=2.0, adds_to="effects.slice_push.exponent"
        ),
        CauseParameter("pull", "", 0.15, low=-1.0, high=1.0),
    )
    signature = "nothing without a draw, grows with the draw; along the edge unlike down"
    experiment = "draw"

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """With more or less of the edge's force along itself."""
        edge = series.R[:, :, 0]
        along = np.einsum("nc,nc->n", series.parts["edge"][:, 3:], edge)
        out = series.wrench.copy()
        out[:, 3:] += values["pull"] * along[:, None] * edge
        return out


def tougher(model: CuttingModel, shape: np.ndarray, work: float) -> CuttingModel:
    """A cut that takes more work.

    Args:
        model: The cut.
        shape: How the excess of the toughness is distributed over the cut points [P].
        work: To cut through it all, more than before, J: whatever the mesh makes of the shape.
    """
    old = model.point_scales
    excess = work * shape / float(model.tables.area @ shape)
    toughness = old.toughness + excess / model.material.toughness
    return model.derive(point_scales=dc.replace(old, toughness=toughness))
