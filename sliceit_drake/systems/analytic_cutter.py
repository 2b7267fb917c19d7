"""A cutting system in twenty lines: force against depth. The example for writing one's own."""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, State

from sliceit_drake.configuration import quantity
from sliceit_drake.systems.knife_force import KnifeForceSystem

__all__ = ["AnalyticCutter", "AnalyticFood"]


@dc.dataclass
class AnalyticFood:
    """A cylinder that resists with toughness times the width at the edge (Atkins, pressing)."""

    diameter: float = quantity(0.027, "m", low=5e-3, high=0.3, doc="Diameter.")
    toughness: float = quantity(350.0, "J/m2", low=0.0, high=1e5, doc="Energy per cut area.")


class AnalyticCutter(KnifeForceSystem):
    """Vertical force toughness * width(depth) while the knife goes down; see `KnifeForceSystem`."""

    def __init__(
        self, food: AnalyticFood, board_height: float, knife_body: BodyIndex, exchange_period: float
    ) -> None:
        super().__init__(knife_body, exchange_period)
        self._food = food
        self._board_height = board_height

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform, V_WK: SpatialVelocity
    ) -> tuple[np.ndarray, float]:
        diameter = self._food.diameter
        height = np.clip(X_WK.translation()[2] - self._board_height, 0.0, diameter)
        width = 2.0 * np.sqrt(height * (diameter - height))
        descending = V_WK.translational()[2] < 0.0
        force = self._food.toughness * width if descending else 0.0
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, force]), 1.0 - height / diameter
