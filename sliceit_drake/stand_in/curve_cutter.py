"""A food of a station by the laws of measured curves; it shares no code with the finite elements.

Nor does it with the spring: force, speed, draw, hold and flanks are those of `curve_laws`. The
board, the arm, weight and inertia are the plant's.

The carrot has no measured curve. It takes the shape of the potato's, scaled so that its largest
force is the middle of the published 47.9 to 67.6 N (source: calibration/foods/carrot.yaml).
"""

import dataclasses as dc
import functools

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from sliceit_drake.configuration import choice, quantity
from sliceit_drake.stand_in.curve_laws import (
    CutState,
    EllipticSection,
    FoodCurve,
    food_forces,
    measured_curve,
)
from sliceit_drake.systems.knife_force import CuttingSetup, KnifeForceSystem

__all__ = ["CurveCutter", "CurveFood", "edge_over_middle", "food_curve"]

BORROWED = {"carrot": ("potato", 0.5 * (47.9 + 67.6))}
"""Foods without a curve: whose shape they take, and the largest force, N."""
STILL_SPEED = 1e-4
"""Below which a knife that a controller holds is at rest, m/s."""
YIELDING = 4e-4
"""Travel over which the forces turn round with the motion, metres: that by which the food yields
along the edge. Where a draw turns round, the force of the calibrated foods' finite elements is zero
after 0.17 to 0.33 mm (0.28 mm here; tests/test_slicing_worlds.py repeats the cucumber's) and turned
after 0.5 to 0.9 mm; the paper's foods were pressed alone. At a quarter of it a carrot would be as
stiff as 400 kN/m, four boards, and shake with the robot, which learns of the force 2 ms late."""


@functools.cache
def food_curve(name: str) -> FoodCurve:
    """The measured curve of a food, or the one that it borrows.

    Raises:
        ConfigurationError: There is neither.
    """
    if name not in BORROWED:
        return measured_curve(name)
    other, largest = BORROWED[name]
    curve = measured_curve(other)
    return curve.scaled(largest / float(curve.force.max()))


def edge_over_middle(p_FK: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the edge is over the middle of the food, in F, metres.

    Args:
        p_FK: Place of Ko [3].
        along: Direction of the edge [3].

    Returns:
        Place of Ko, with the height of that point [3]; from Ko to that point [3].
    """
    arm = -p_FK[0] / along[0] * along
    return p_FK + [0.0, 0.0, arm[2]], arm


@dc.dataclass
class CurveFood:
    """A food with an elliptic section on the board, and how its slices differ.

    The spreads are of logarithms and act in `CurveCutter.randomize_context` alone.
    """

    curve: str = choice("cucumber", ("cucumber", "tomato", "potato", "carrot"))
    """Whose curve it has."""
    width: float = quantity(0.027, "m", low=5e-3, high=0.3)
    """Along the edge."""
    height: float = quantity(0.027, "m", low=5e-3, high=0.3)
    """From the board to the top."""
    toughness: float = quantity(1.0, "", low=0.0, high=10.0)
    """Factor on the edge's force."""
    friction: float = quantity(1.0, "", low=0.0, high=10.0)
    """Factor on the flanks' friction."""
    toughness_spread: float = quantity(0.0, "", low=0.0, high=0.5)
    """From slice to slice."""
    friction_spread: float = quantity(0.0, "", low=0.0, high=0.5)
    """From slice to slice."""
    height_spread: float = quantity(0.0, "", low=0.0, high=0.1)
    """From slice to slice."""

    def make_cutting(self, setup: CuttingSetup) -> "CurveCutter":
        """The system that this food is in a station."""
        return CurveCutter(self, setup.X_WF(), setup.exchange_period)


_section = functools.lru_cache(maxsize=64)(EllipticSection)


class CurveCutter(KnifeForceSystem):
    """The knife in a food of a measured curve; see `KnifeForceSystem` and `curve_laws`.

    Speed and draw are those of the knife's path between two coupling steps, with the edge's
    direction smoothed over `YIELDING`: a controlled knife shakes, and a food yields. The depth is
    that of the edge at the middle of the food, where the food pushes it; the flanks are pushed half
    way up to the food's top. `cut_progress` is the fraction of the section that the edge has
    passed.

    Further output port:
        force_components: Forces on the knife by edge, flank pressure, friction [9], N, in W.

    Parameters:
        0: Factors on toughness and friction, and the height of the food, m [3].

    Args:
        food: The food.
        X_WF: Pose of the food frame: the food stands at its origin, the edge is along Fx.
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(self, food: CurveFood, X_WF: RigidTransform, exchange_period: float) -> None:
        super().__init__(exchange_period)
        self.food = food
        self._curve = food_curve(food.curve)
        self._R_WF, self._p_WF = X_WF.rotation().matrix(), X_WF.translation()
        self._cut = self.DeclareDiscreteState(CutState.SIZE)
        self._components = self.DeclareDiscreteState(9)
        self._slice = self.DeclareNumericParameter(
            BasicVector([food.toughness, food.friction, food.height])
        )
        self.DeclareStateOutputPort("force_components", self._components)

    def SetSlice(self, context: Context, toughness: float, friction: float, height: float) -> None:
        """Puts an uncut slice into the context.

        Args:
            context: This system's.
            toughness, friction: Factors.
            height: Height of the food, metres.
        """
        values = [toughness, friction, height]
        context.get_mutable_numeric_parameter(self._slice).SetFromVector(values)
        # `start` takes the knife's place from its pose.
        context.SetDiscreteState(self._cut, CutState(np.zeros(3)).vector())
        self.set_to_zero(context, self._components)

    def randomize_context(self, context: Context, rng: np.random.Generator) -> None:
        """Puts an uncut slice, drawn by the food's spreads, into the context."""
        food = self.food
        spreads = [food.toughness_spread, food.friction_spread, food.height_spread]
        factors = np.exp(np.array(spreads) * rng.normal(size=3))
        self.SetSlice(context, *(factors * [food.toughness, food.friction, food.height]))

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        place, _, _ = self._place(X_WK)
        self._set(state, self._cut, CutState(place).vector())

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        toughness, friction, height = context.get_numeric_parameter(self._slice).value().tolist()
        section = _section(self.food.width, height)
        cut = CutState.of_vector(context.get_discrete_state(self._cut).value())
        period = self.exchange_period
        place, along, arm = self._place(X_WK)
        cut.advance(period, along, place, height, still=STILL_SPEED * period, turn=YIELDING)
        curve = self._curve.scaled(toughness)
        forces = food_forces(cut, curve, section)
        forces[2] *= friction
        raised = arm + np.array([0.0, 0.0, 0.5 * max(cut.depth, 0.0)])
        moment = np.cross(arm, forces[0]) + np.cross(raised, forces[1] + forces[2])
        self._set(state, self._cut, cut.vector())
        self._set(state, self._components, (forces @ self._R_WF.T).ravel())
        wrench = np.concatenate([self._R_WF @ moment, self._R_WF @ forces.sum(0)])
        return wrench, section.above(cut.deepest)

    def _place(self, X_WK: RigidTransform) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the edge is over the middle of the food, in F, metres.

        Returns:
            Place of Ko, with the height of that point [3]; direction of the edge [3]; from Ko to
            that point [3].
        """
        p_FK = self._R_WF.T @ (X_WK.translation() - self._p_WF)
        along = self._R_WF.T @ X_WK.rotation().matrix()[:, 0]
        place, arm = edge_over_middle(p_FK, along)
        return place, along, arm
