"""A cutting system in twenty lines: force against depth. The example for writing one's own."""

import dataclasses as dc
from typing import TypeGuard

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, State

from sliceit_drake.configuration import quantity
from sliceit_drake.systems.knife_force import CuttingSetup, KnifeForceSystem

__all__ = ["AnalyticCutter", "AnalyticFood", "is_no_food", "no_food"]


@dc.dataclass
class AnalyticFood:
    """A cylinder that resists with toughness times the width at the edge (Atkins, pressing).

    Below that force it is a spring, so that a knife may rest on it.
    """

    diameter: float = quantity(0.027, "m", low=5e-3, high=0.3)
    """Diameter."""
    toughness: float = quantity(350.0, "J/m2", low=0.0, high=1e5)
    """Energy per cut area."""
    stiffness: float = quantity(5e3, "N/m", low=1.0, high=1e7)
    """Force over indentation, as a vegetable's."""

    @property
    def height(self) -> float:
        """Height of the top over the board, metres."""
        return self.diameter

    def make_cutting(self, setup: CuttingSetup) -> "AnalyticCutter":
        """The system that this food is in a station."""
        return AnalyticCutter(self, setup.X_WF().translation()[2], setup.exchange_period)


def no_food(height: float) -> AnalyticFood:
    """What stands for no food: it has a top at `height`, m, and offers no resistance."""
    return AnalyticFood(diameter=height, toughness=0.0)


def is_no_food(food: object) -> TypeGuard[AnalyticFood]:
    """Whether a food is one that offers no resistance."""
    return isinstance(food, AnalyticFood) and food.toughness == 0.0


class AnalyticCutter(KnifeForceSystem):
    """Vertical force toughness * width(depth) once the knife cuts; see `KnifeForceSystem`.

    The food's surface under the edge is the state: the knife indents it elastically and takes it
    along when the force reaches that of cutting.
    """

    def __init__(self, food: AnalyticFood, board_height: float, exchange_period: float) -> None:
        super().__init__(exchange_period)
        self._food = food
        self._board_height = board_height
        self._surface = self.DeclareDiscreteState(1)

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        self._set(state, self._surface, [X_WK.translation()[2]])

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        diameter = self._food.diameter
        z = X_WK.translation()[2]
        height = np.clip(z - self._board_height, 0.0, diameter)
        cutting = self._food.toughness * 2.0 * np.sqrt(height * (diameter - height))
        k, surface = self._food.stiffness, context.get_discrete_state(self._surface).value()[0]
        force = np.clip(k * (surface - z), 0.0, cutting)
        self._set(state, self._surface, [min(surface, z + force / k)])
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, force]), 1.0 - height / diameter
