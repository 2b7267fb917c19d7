"""What a station needs of its food: where the knife starts, how it moves, what is held and cut.

A food of a user's own is any object with the members of `CuttableFood`.
"""

import dataclasses as dc
import functools
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import numpy as np
from pydrake.geometry import SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform, RotationMatrix

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.discretization import DiscretizationError, estimate_discretization_error
from sliceit_drake.cutting.foods.food import Food, make_food_geometry, start_pose
from sliceit_drake.cutting.foods.spring_food import SpringFood
from sliceit_drake.cutting.mesh.cut_geometry import CutGeometry
from sliceit_drake.cutting.model import prepare_cut
from sliceit_drake.cutting.motion import Motion, MotionPlan
from sliceit_drake.cutting.simulate import COMPLETE
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.plant.knife_body import blade_surface
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.systems.cutting_system import COUPLED_EVENT, CuttingSystem
from sliceit_drake.systems.food_look import look_of
from sliceit_drake.systems.knife_force import KnifeForceSystem
from sliceit_drake.systems.loose_slices import LooseSlices, SliceBody
from sliceit_drake.systems.spring_cutter import SpringCutter

__all__ = [
    "CuttableFood",
    "HeldFood",
    "OwnCutting",
    "PreparedFood",
    "food_to_cut",
    "motion_of",
    "prepare_food",
]


class CuttableFood(Protocol):
    """A food that a station can cut."""

    @property
    def height(self) -> float:
        """Height of the top over the board, metres."""
        ...

    def make_cutting(self, scenario: Scenario, /) -> KnifeForceSystem:
        """The system that the food is in a station: a new one at each call."""
        ...


OwnCutting: TypeAlias = KnifeForceSystem | Callable[[Scenario], KnifeForceSystem] | CuttableFood
"""A cutting system of a user's own, what makes it, or a food that does."""


@dc.dataclass
class HeldFood:
    """A food in a holder.

    Attributes:
        width, height: Of the food along Fx and Fz, metres.
        distance: Of the holder from the origin of F along Fy, metres.
    """

    width: float
    height: float
    distance: float


@dc.dataclass
class PreparedFood:
    """A scenario's food in a station.

    Attributes:
        start_pose: X_WK at the start.
        motion_plan: The scenario's segments, those of its sequence, or the bounds of its policy.
        make_cutting: Makes the cutting system; nothing of it is built before.
        held: Where a holder holds the food, or None.
        estimate_error: Estimates the error of its discretisation on the prescribed motion; None for
            a food that is not discretised.
        make_slices: Makes the slices that come off; None where none does.
    """

    start_pose: RigidTransform
    motion_plan: MotionPlan
    make_cutting: Callable[[], KnifeForceSystem]
    held: HeldFood | None = None
    estimate_error: Callable[[], DiscretizationError] | None = None
    make_slices: Callable[[CuttingSystem], LooseSlices] | None = None


def food_to_cut(scenario: Scenario, cutting: OwnCutting | None) -> PreparedFood:
    """The scenario's food, or what is put in its place; see `MakeStation`.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The food cannot be cut so.
    """
    if cutting is None:
        return prepare_food(scenario.food, scenario)
    if not (callable(cutting) or isinstance(cutting, KnifeForceSystem)):
        return prepare_food(cutting, scenario)
    food = prepare_food(scenario.food, scenario)
    own = functools.partial(_own_system, cutting, scenario)
    return dc.replace(food, make_cutting=own, estimate_error=None, make_slices=None)


def _own_system(
    cutting: KnifeForceSystem | Callable[[Scenario], KnifeForceSystem], scenario: Scenario
) -> KnifeForceSystem:
    system = cutting(scenario) if callable(cutting) else cutting
    if not isinstance(system, KnifeForceSystem):
        raise _not_to_be_cut(system)
    if abs(system.exchange_period - scenario.exchange_period) > 1e-12:
        raise ConfigurationError(
            f"is {scenario.exchange_period:g} s, and that of the cutting system that was put in "
            f"{system.exchange_period:g} s",
            field="scenario.exchange_period",
            fix="Make the cutting system with the period of the scenario.",
        )
    return system


def motion_of(scenario: Scenario, top: float) -> MotionPlan:
    """The scenario's segments; where it gives none, those of one cut through the food.

    Args:
        scenario: Without policy and sequence.
        top: Height of the food at the cut, metres.
    """
    food = scenario.food
    clamps = isinstance(food, Food) and food.held_sides == "both"
    return scenario.motion.or_cut_through(scenario.start.clearance + top, clamps)


@functools.singledispatch
def prepare_food(food: Any, scenario: Scenario) -> PreparedFood:
    """Prepares a food for the station of a scenario.

    Args:
        food: The scenario's, or a `CuttableFood` in its place.
        scenario: Where and how it is cut.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The food cannot be cut so.
    """
    if not (hasattr(food, "height") and hasattr(food, "make_cutting")):
        raise _not_to_be_cut(food)
    return _on_the_board(food.height, lambda: food.make_cutting(scenario), scenario)


def _not_to_be_cut(given: object) -> ConfigurationError:
    return ConfigurationError(
        f"is {type(given).__name__}, which a station cannot cut",
        field="cutting",
        fix="Give a subclass of KnifeForceSystem, a function that makes one of a scenario, or a "
        "food with height and make_cutting.",
    )


@prepare_food.register
def _(food: SpringFood, scenario: Scenario) -> PreparedFood:
    def make_cutting() -> KnifeForceSystem:
        return SpringCutter(food, scenario.knife, scenario.X_WF(), scenario.exchange_period)

    return _on_the_board(food.height, make_cutting, scenario)


def _on_the_board(
    height: float, make_cutting: Callable[[], KnifeForceSystem], scenario: Scenario
) -> PreparedFood:
    start = scenario.start
    down = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
    X_FK = RigidTransform(down, [start.offset, 0.0, height + start.clearance])
    if scenario.policy is None:
        plan = motion_of(scenario, height)
    else:
        plan = scenario.policy.envelope()
    return PreparedFood(scenario.X_WF() @ X_FK, plan, make_cutting)


@prepare_food.register
def _(food: Food, scenario: Scenario) -> PreparedFood:
    sequence, start, numerics = scenario.sequence, scenario.start, scenario.numerics
    foods = sequence.foods(food) if sequence else [food]
    cuts = [make_food_geometry(each) for each in foods]
    _check_blade(cuts, scenario)
    poses = sequence.poses(food, scenario.X_WF()) if sequence else [scenario.X_WF()]
    pose = start_pose(cuts[0], start.clearance, start.offset)
    if scenario.policy is not None:
        plan = scenario.policy.envelope()
    elif sequence is not None:
        plan = sequence.motion([cut.top for cut in cuts], start.clearance)
    else:
        plan = motion_of(scenario, cuts[0].top)

    def make_cutting() -> KnifeForceSystem:
        models = [
            prepare_cut(cut, each.material, scenario.knife, numerics, each.effects)
            for cut, each in zip(cuts, foods, strict=True)
        ]
        solvers = [CuttingSolver(m, scenario.exchange_period, COUPLED_EVENT) for m in models]
        in_sequence = sequence is not None
        return CuttingSystem(solvers, poses, in_sequence=in_sequence, look=look_of(food.name))

    def estimate_error() -> DiscretizationError:
        """That of the middle slice, which stands for all."""
        middle = len(foods) // 2
        cut = cuts[middle]
        if sequence is not None:
            one = sequence.motion([cut.top], start.clearance)
        else:
            one = plan
        motion = Motion(one, start_pose(cut, start.clearance, start.offset))
        return estimate_discretization_error(
            foods[middle], scenario.knife, numerics, scenario.exchange_period, motion
        )

    return PreparedFood(
        poses[0] @ RigidTransform(RotationMatrix(pose.R), pose.p),
        plan,
        make_cutting,
        _held(food, scenario, cuts[0]),
        estimate_error,
        functools.partial(_loose_slices, scenario)
        if food.held_sides in ("minus", "plus")
        else None,
    )


def _loose_slices(scenario: Scenario, cutting: CuttingSystem) -> LooseSlices:
    sequence = scenario.sequence
    slices, rest = [], None
    for solver, surface, X_WF in zip(
        cutting.solvers, cutting.surfaces, cutting.food_poses, strict=True
    ):
        model = solver.model
        p_F = surface.positions(model, model.nodes)
        halves = [
            TriangleSurfaceMesh([SurfaceTriangle(*t) for t in triangles.tolist()], p_F[corners])
            for corners, triangles in surface.halves
        ]
        rest = halves[1 - model.free_side]
        slices.append(SliceBody(halves[model.free_side], model.material, X_WF))
    return LooseSlices(
        slices,
        rest,
        blade_surface(scenario.knife),
        scenario.board,
        scenario.X_WF(),
        scenario.numerics.board_friction,
        sequence.thickness if sequence is not None and sequence.indexing == "food" else 0.0,
        scenario.exchange_period,
        COMPLETE,
    )


def _check_blade(cuts: list[CutGeometry], scenario: Scenario) -> None:
    """Refuses a blade that is not as high as the food."""
    blade = scenario.knife.tip_height + scenario.knife.height
    highest = max(cut.top - cut.bottom for cut in cuts)
    if highest > blade:
        raise ConfigurationError(
            f"the blade is {1e3 * blade:.3g} mm high and the food {1e3 * highest:.3g} mm: spine "
            "and gripper would go into the food",
            field="scenario.knife.height",
            fix="Take a higher knife (those of calibration/knives by `knife_name`), or a smaller "
            "food.",
        )


def _held(food: Food, scenario: Scenario, cut: CutGeometry) -> HeldFood | None:
    """Where the food is held, in a sequence behind the last cut."""
    if food.held_sides not in ("both", "plus"):
        return None
    distance = food.hold_distance + 0.005
    if scenario.sequence is not None:
        distance += scenario.sequence.positions(food)[-1]
    size = np.ptp(cut.split.vertex_position @ cut.X_FC_rotation.T, axis=0)
    return HeldFood(float(size[0]), float(size[2]), distance)
