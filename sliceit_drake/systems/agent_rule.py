"""A motion by rule through the agent's own actions, from what the agent observes alone."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import quantity

__all__ = ["AgentRule"]

LANDING = 0.01
"""Height over the board within which the level falls, metres."""


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
    landing: float = quantity(0.3, "", low=0.01, high=1.0)
    """Fraction of the level that is left at the board."""
    correction: float = quantity(0.5, "", low=0.0, high=2.0)
    """Most by which a network changes each of its actions."""

    def action(self, height: float, force: float, place: float, way: float) -> np.ndarray:
        """The action [6].

        Args:
            height: Height of the edge over the board, m.
            force: Felt force, N.
            place: Target along the edge, over the farthest draw.
            way: Action of the draw before.
        """
        level = self.level * min(1.0, self.landing + max(height, 0.0) / LANDING)
        push = self.gain * (1.0 - force / level)
        stiffness = [1.0, 0.0]
        action = [*stiffness, self.softness + push, 0.0, self.draw(place, way), push]
        return np.clip(action, -1.0, 1.0)

    def draw(self, place: float, way: float) -> float:
        """The action of the draw: on as before, back from the reach; see `action`."""
        if self.reach == 0.0:
            return 0.0
        on = 1.0 if way >= 0.0 else -1.0
        return -on if on * place >= self.reach else on
