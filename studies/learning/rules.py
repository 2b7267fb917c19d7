"""Motions by rule, through the agent's own actions, from what the agent observes alone."""

import dataclasses as dc

import numpy as np

from sliceit_drake.systems.agent import (
    ACTIONS,
    ERROR,
    WRENCH,
    AgentConfig,
    Decide,
    observation_names,
)

__all__ = ["TUNED", "Rule", "uniform", "with_draw"]

DRAW = ACTIONS.index("draw")
HISTORY = AgentConfig().history
NAMES = observation_names(HISTORY)
HEIGHT, PLACE, LAST = (NAMES.index(name) for name in ("error_z", "target_x", "last_draw"))
READINGS = 4
"""Newest readings whose mean is the felt force: 40 ms."""
LANDING = 0.01
"""Height over the board within which the level falls, metres."""


@dc.dataclass(frozen=True)
class Rule:
    """Draws to and fro as fast as the agent may, and presses so that the felt force stays level.

    Attributes:
        level: Force that it keeps to, N.
        gain: Of press and softness on the relative error of the force.
        reach: Fraction of the farthest draw at which it turns round; 0 for no draw.
        softness: Gain downwards, within its range from -1 to 1, where the force is at its level.
        landing: Fraction of the level that is left at the board.
    """

    level: float
    gain: float = 1.0
    reach: float = 0.9
    softness: float = -1.0
    landing: float = 0.3

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action [6]; it has no memory but what is observed."""
        height = max(ERROR[1] * observation[HEIGHT], 0.0)
        readings = observation[-3 * HISTORY :].reshape(HISTORY, 3)[-READINGS:]
        felt = float(np.linalg.norm((readings * WRENCH).mean(axis=0)[:2]))
        level = self.level * min(1.0, self.landing + height / LANDING)
        push = self.gain * (1.0 - felt / level)
        draw = self.draw(observation) if self.reach > 0.0 else 0.0
        stiffness = [1.0, 0.0]
        return np.clip([*stiffness, self.softness + push, 0.0, draw, push], -1.0, 1.0)

    def draw(self, observation: np.ndarray) -> float:
        """The action of the draw: on as before, back from the reach."""
        way = 1.0 if observation[LAST] >= 0.0 else -1.0
        return -way if way * observation[PLACE] >= self.reach else way


def with_draw(decide: Decide, rule: Rule | None) -> Decide:
    """A policy whose draws are a rule's; None for no draws."""

    def replaced(observation: np.ndarray) -> np.ndarray:
        action = np.array(decide(observation), float)
        action[DRAW] = rule.draw(observation) if rule is not None else 0.0
        return action

    return replaced


def uniform(rng: np.random.Generator) -> Decide:
    """Uniformly random actions."""
    return lambda _: rng.uniform(-1.0, 1.0, len(ACTIONS))


TUNED = Rule(level=21.1329, gain=0.307394, reach=0.857313, softness=-0.932829, landing=0.75669)
"""What `python -m studies tune_rule` found."""
