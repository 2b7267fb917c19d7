"""How far the force is from that of an infinitely fine mesh, estimated from coarser ones."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import Motion
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

__all__ = ["DiscretizationError", "estimate_discretization_error"]


REFINEMENT = 0.5
"""Elements along an edge of the coarse mesh, relative to the given one."""
ORDER = 1.5
"""Order of convergence that is assumed."""


@dc.dataclass
class DiscretizationError:
    """Estimated error of the force from mesh and step.

    Attributes:
        relative_rms: Root mean square over the contact samples, relative to that of the force.
        order: Order of convergence that is assumed.
        elements: Elements of the coarse and of the given mesh.
    """

    relative_rms: float
    order: float
    elements: list[int]


def estimate_discretization_error(
    food: Food,
    knife: Knife,
    numerics: Numerics,
    exchange_period: float,
    motion: Motion,
) -> DiscretizationError:
    """Richardson's estimate from the given mesh and a coarser one, on a prescribed motion.

    The error is the difference over `REFINEMENT`^-`ORDER` - 1. The order lies between that of
    flanks and bonds, whose stiffness goes with E/h (first), and that of the bulk (second). For the
    measured cucumber this gives 2.4 %, and meshes up to three times as fine give 3 %
    (docs/results/verification.md). The step's error is not in it (docs/results/stepping.md).

    Args:
        food, knife, numerics, exchange_period: The cut.
        motion: Poses X_FK of the knife.

    Raises:
        MeshError, CuttingError: The food cannot be meshed or cut at the coarser refinement.
    """

    def force(scale: float) -> tuple[SliceResult, int]:
        model = make_food_model(food, knife, numerics, scale)
        result = simulate_slice(CuttingSolver(model, exchange_period), motion)
        return result, model.element_count

    coarse, coarse_count = force(REFINEMENT)
    given, count = force(1.0)
    norms = [np.linalg.norm(r.food_wrench[:, 3:], axis=1) for r in (coarse, given)]
    contact = norms[1] > 0.05
    if not contact.any():
        return DiscretizationError(0.0, ORDER, [coarse_count, count])
    difference = np.sqrt(np.mean((norms[0] - norms[1])[contact] ** 2))
    scale = np.sqrt(np.mean(norms[1][contact] ** 2))
    error = float(difference / scale / (REFINEMENT**-ORDER - 1.0))
    return DiscretizationError(error, ORDER, [coarse_count, count])
