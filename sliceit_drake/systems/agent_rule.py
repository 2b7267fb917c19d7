"""A motion by rule through the agent's own actions, from what the agent observes alone."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import quantity

__all__ = ["PROGRESS", "AgentRule"]

LANDING = 4e-3
"""Height over the board within which level and draw fall, metres. A draw tilts the knife as it
turns round: the edge goes up and down by a millimetre, and near the board would hit it."""
CREEP = 5e-3
"""Speed downwards at which it may always be, m/s."""
STUCK, SETTLED = 0.6, 2e-4
"""Least fraction of the level where the knife creeps and is this high over the board, m: some foods
hold it by more than is left of the level there."""
PROGRESS = 5e-4
"""Way down that ends a wait, m."""
BRAKE = 200.0
"""Of the press on what is more than the speed that it may have, s/m."""


@dc.dataclass
class AgentRule:
    """Draws to and fro as fast as the agent may, and presses so that the felt force stays level."""

    level: float = quantity(9.0, "N", low=0.1, high=1e3)
    """Force that it keeps to."""
    gain: float = quantity(1.0, "", low=0.0, high=100.0)
    """Of press and softness on the relative error of the force."""
    reach: float = quantity(0.9, "", low=0.0, high=1.0)
    """Fraction of the farthest draw at which it turns round; 0 for no draw."""
    softness: float = quantity(-1.0, "", low=-1.0, high=1.0)
    """Gain downwards, within its range from -1 to 1, where the force is at its level."""
    landing: float = quantity(0.2, "", low=0.01, high=1.0)
    """Fraction of the level that is left at the board."""
    calm: float = quantity(0.1, "", low=0.0, high=1.0)
    """Fraction of the draw that is left there."""
    approach: float = quantity(0.1, "s", low=0.0, high=10.0)
    """Least time to the board at the speed that it has; 0 for no limit."""
    correction: float = quantity(0.5, "", low=0.0, high=2.0)
    """Most by which a network changes each of its actions."""
    patience: float = quantity(0.0, "s", low=0.0, high=100.0)
    """Time without way down in which the level grows by its own value; 0 for never. Food that asks
    for more than the level would hold the knife for ever."""

    def action(
        self,
        height: float,
        speed: float,
        force: float,
        place: float,
        way: float,
        waited: float = 0.0,
    ) -> np.ndarray:
        """The action [6].

        Args:
            height: Height of the edge over the board, m.
            speed: At which that falls, m/s.
            force: Felt force, N.
            place: Target along the edge, over the farthest draw.
            way: Action of the draw before.
            waited: Time since it last came lower than ever by `PROGRESS`, s.
        """
        height, level = max(height, 0.0), self.level
        if self.patience > 0.0 and height > SETTLED:
            level *= 1.0 + waited / self.patience
        near = height / LANDING
        left = min(1.0, self.landing + near)
        if speed < CREEP and height > SETTLED:
            left = max(left, STUCK)
        push = self.gain * (1.0 - force / (level * left))
        softness, draw = self.softness + push, self.draw(place, way) * min(1.0, self.calm + near)
        if self.approach > 0.0:
            push -= BRAKE * max(speed - CREEP - height / self.approach, 0.0)
        stiffness = [1.0, 0.0]
        action = [*stiffness, softness, 0.0, draw, push]
        return np.clip(action, -1.0, 1.0)

    def draw(self, place: float, way: float) -> float:
        """The action of the draw: on as before, back from the reach; see `action`."""
        if self.reach == 0.0:
            return 0.0
        on = 1.0 if way >= 0.0 else -1.0
        return -on if on * place >= self.reach else on
