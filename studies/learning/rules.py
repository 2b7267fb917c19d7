"""What policies are set beside, through the agent's own actions."""

import dataclasses as dc

import numpy as np

from sliceit_drake.systems.agent import ACTIONS, AgentConfig, Decide, observation_names
from sliceit_drake.systems.agent_rule import AgentRule

__all__ = ["TUNED", "fast", "uniform", "with_draw"]

DRAW = ACTIONS.index("draw")
NAMES = observation_names(AgentConfig().history)
PLACE, LAST = NAMES.index("target_x"), NAMES.index("last_draw")


def fast(agent: AgentConfig) -> AgentConfig:
    """An agent that may draw at 150 mm/s, the limit of the optimised motions, and press as the
    trainings do that correct a rule with such draws."""
    return dc.replace(agent, draw_increment=7.5e-3, press_increment=6e-3)


def with_draw(decide: Decide, rule: AgentRule | None) -> Decide:
    """A policy whose draws are a rule's; None for no draws."""

    def replaced(observation: np.ndarray) -> np.ndarray:
        action = np.array(decide(observation), float)
        place, way = observation[[PLACE, LAST]]
        action[DRAW] = rule.draw(place, way) if rule is not None else 0.0
        return action

    return replaced


def uniform(rng: np.random.Generator) -> Decide:
    """Uniformly random actions."""
    return lambda _: rng.uniform(-1.0, 1.0, len(ACTIONS))


TUNED = AgentRule(level=23.43, gain=2.992, reach=0.9375, softness=0.3711, landing=0.6609)
"""What `python -m studies tune_rule --generations 1` found, drawing at 150 mm/s, before the
rule pressed on where food holds the knife near the board."""
