"""Whole cuts against finer ones, and where the knife's work goes; docs/results/verification.md."""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import brentq

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

__all__ = ["CutBudget", "Refinement", "cut_budget", "refine_mesh", "refine_step"]

PERIOD = 2e-3
"""Length of a coupling step, s."""


@dc.dataclass
class Refinement:
    """Force of one cut at several sizes of mesh or step.

    Attributes:
        size: Relative mesh size, or longest sub-step in s; the last is the reference.
        elements: That are computed.
        error: RMS difference of the force's norm from the reference, over its RMS; without the
            reference.
        order: Observed between each size and that before: the p of an error C (h^p - h_ref^p); None
            where there is none, as the error does not fall like a power.
        estimate: Error of the default, extrapolated to size zero with the order observed from it to
            the next size, or 1 if there is none.
    """

    size: list[float]
    elements: list[int]
    error: list[float]
    order: list[float | None]
    estimate: float


def refine_mesh(
    food: Food,
    depth: float,
    refinements: Sequence[float],
    progress: Callable[[], None] | None = None,
) -> Refinement:
    """A press cut with refined meshes, the step refined alike.

    At a constant step a finer mesh needs heavier masses, whose inertia hides its convergence.

    Args:
        food: To cut.
        depth: Below its top, metres.
        refinements: Elements along an edge and steps, relative to the default of 1; the last is
            the reference.
        progress: Called after each cut.
    """
    cuts = [
        _press(food, depth, Numerics(time_step=Numerics().time_step / r), r, progress)
        for r in refinements
    ]
    return _refinement([1.0 / r for r in refinements], cuts, refinements.index(1.0))


def refine_step(
    food: Food,
    depth: float,
    divisors: Sequence[int],
    progress: Callable[[], None] | None = None,
) -> Refinement:
    """A press cut with smaller longest sub-steps, masses scaled to each.

    Args:
        food: To cut.
        depth: Below its top, metres.
        divisors: Of the default step; 1 is among them, and the last is the reference.
        progress: Called after each cut.
    """
    steps = [Numerics().time_step / n for n in divisors]
    cuts = [_press(food, depth, Numerics(time_step=dt), 1.0, progress) for dt in steps]
    return _refinement(steps, cuts, divisors.index(1))


def _press(
    food: Food,
    depth: float,
    numerics: Numerics,
    refinement: float,
    progress: Callable[[], None] | None,
) -> tuple[int, np.ndarray]:
    """Number of elements and norm of the food's force [n]."""
    model = make_food_model(food, Knife(), numerics, refinement)
    plan = MotionPlan([ConstantSpeed(distance=depth + 5e-4, speed=0.02)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    result = simulate_slice(CuttingSolver(model, PERIOD), motion)
    if progress is not None:
        progress()
    return model.element_count, np.linalg.norm(result.food_wrench[:, 3:], axis=1)


def _refinement(size: list[float], cuts: list[tuple[int, np.ndarray]], default: int) -> Refinement:
    reference = cuts[-1][1]
    scale = float(np.sqrt(np.mean(reference**2)))
    error = [float(np.sqrt(np.mean((f - reference) ** 2))) / scale for _, f in cuts[:-1]]
    order = [
        _order(size[k], size[k + 1], size[-1], error[k] / error[k + 1])
        for k in range(len(error) - 1)
    ]
    share = 1.0 - (size[-1] / size[default]) ** (order[default] or 1.0)
    return Refinement(size, [n for n, _ in cuts], error, order, error[default] / share)


def _order(coarse: float, fine: float, reference: float, ratio: float) -> float | None:
    """p with (coarse^p - reference^p) / (fine^p - reference^p) = ratio, if there is one."""

    def excess(p: float) -> float:
        a, b = (coarse / reference) ** p - 1.0, (fine / reference) ** p - 1.0
        return a / b - ratio

    low, high = 0.05, 6.0
    if excess(low) * excess(high) > 0.0:
        return None
    return float(brentq(excess, low, high))


@dc.dataclass
class CutBudget:
    """Where the work of a cut goes, J.

    Attributes:
        work: Of the knife on the food.
        gravity: Of the food's weight.
        edge, opening, friction, board_friction, blade, damping: Dissipated.
        stored: At the end: elastic, in bonds and contacts, kinetic.
        imbalance: Work in less all that it went into, over the work.
        cut: Fraction of the section that the edge passed.
        area: Of the section, m^2.
        energy_ratio: Largest kinetic over internal energy.
        elements: That are computed.
    """

    work: float
    gravity: float
    edge: float
    opening: float
    friction: float
    board_friction: float
    blade: float
    damping: float
    stored: float
    imbalance: float
    cut: float
    area: float
    energy_ratio: float
    elements: int


def cut_budget(result: SliceResult, area: float, elements: int) -> CutBudget:
    """The energy balance of a cut through a section of some area, m^2."""
    balance, energies = result.balance, result.energies
    return CutBudget(
        work=balance.work,
        gravity=balance.gravity,
        edge=balance.edge,
        opening=balance.opening,
        friction=balance.friction,
        board_friction=balance.board_friction,
        blade=balance.blade,
        damping=balance.damping(energies),
        stored=energies.elastic + energies.interface + energies.kinetic,
        imbalance=balance.residual(energies) / balance.work,
        cut=float(result.cut[-1]),
        area=area,
        energy_ratio=result.energy_ratio,
        elements=elements,
    )
