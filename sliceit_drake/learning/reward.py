"""The reward of SliceIt!, term by term.

Beltran-Hernandez et al., SliceIt! (2024), and its code; where the two differ the code is followed:
as printed the force term rewards force. The force term is ours unless its shape is `sigmoid`:
theirs does not tell forces over 12 N apart, and its sum over a slice is least where the slice is
quickest, at whatever force. By the square half of the force for twice the time costs half.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, quantity

__all__ = [
    "HEIGHT",
    "REACH",
    "TERMS",
    "RewardConfig",
    "failed_potential",
    "reward_potential",
    "reward_terms",
    "reward_weights",
]

TERMS = ("distance", "force", "jerk", "step")
HEIGHT = 0.06
"""Scale of the height over the board, metres."""
REACH = 0.1
"""Height over the board above which no way counts, metres: a default workspace ends there."""
WIDTH, FLOOR = 0.25, 0.1
"""Width of the Gaussians by which a schedule moves weight, as a fraction of the training, and their
least value."""


@dc.dataclass
class RewardConfig:
    """Weights of the terms, and what an episode's end gives."""

    weights: list[float] = quantity([0.25, 8.0, 1.0, 0.25], "", low=0.0, size=4)
    """Weights of distance, force, jerk and step; only their ratios count. SliceIt! has all
    equal."""
    schedule: str = choice("constant", ("constant", "gaussian"))
    """gaussian: the weight moves from distance to force to jerk during the training."""
    force_shape: str = choice("square", ("square", "sigmoid"))
    """Shape of the force term: the square of force over scale, at most 1, or SliceIt!'s."""
    force_scale: float = quantity(40.0, "N", low=0.01, high=1e3)
    """Scale of the force term. A sigmoid is half at three times as much; 2 in SliceIt!."""
    goal: float = quantity(15.0, "", low=0.0)
    """Reward for a slice that is done; 100 in SliceIt!."""
    way: float = quantity(15.0, "", low=0.0)
    """Part of `reward_potential` for 60 mm of way down; not in SliceIt!."""
    hold: float = quantity(5.0, "", low=0.0)
    """Part of `reward_potential` for the decisions at the goal."""
    discount: float = quantity(0.99, "", low=0.0, high=1.0)
    """Discount of a decision; of the potential too, so that it changes no policy's worth."""
    collision: float = quantity(-15.0, "", high=0.0)
    """Reward for a force over the limit, leaving the workspace, or a failure; -100 in SliceIt!."""

    def check(self, where: str) -> None:
        if sum(self.weights) <= 0.0:
            raise ConfigurationError(
                "are all zero", field=f"{where}.weights", fix="Give one above zero."
            )


def reward_terms(
    config: RewardConfig, height: float, force: np.ndarray, jerk: np.ndarray
) -> np.ndarray:
    """Distance, force, jerk and step, each from -1 to 0 [4].

    Args:
        config: Shape and scale of the force term.
        height: Height of the edge over its final pose, metres.
        force: Mean of the readings seen, along Kx and Kz [2], N.
        jerk: Scaled as it is observed [3].
    """
    share = float(np.linalg.norm(force)) / config.force_scale
    square = config.force_shape == "square"
    return np.array(
        [
            -np.tanh(5.0 * abs(height) / HEIGHT),
            -min(share**2, 1.0) if square else -1.0 / (1.0 + np.exp(3.0 - share)),
            -min(float(np.linalg.norm(jerk)), 1.0),
            -1.0,
        ]
    )


def reward_potential(config: RewardConfig, height: float, at_goal: float) -> float:
    """The potential of a slice that goes on: what it has come to, from zero at `REACH`.

    A decision's reward has ``discount * potential after - potential before`` added to it. No policy
    becomes better by that than another (Ng, Harada and Russell, "Policy invariance under reward
    transformations", 1999), but each decision sees at once what it brings: where only the end
    pays, and time costs little, agents learned to put the end off. As the potential is nowhere
    below zero, a decision that changes nothing is paid nothing and costs ``(1 - discount) *
    potential``.

    That theorem wants a potential of zero at every end. The goal's is; that of a failure is
    `failed_potential`.

    Args:
        config: Its `way` and `hold`.
        height: Height of the edge over the board, metres.
        at_goal: Fraction of the decisions at the goal that end a slice.
    """
    share = (REACH - min(max(height, 0.0), REACH)) / HEIGHT
    return config.way * share + config.hold * min(at_goal, 1.0)


def failed_potential(config: RewardConfig, height: float, at_goal: float) -> float:
    """The potential, zero or less, where a limit or a failure ends a slice.

    It costs what was still to be earned, besides `RewardConfig.collision`: else an agent that fails
    early saves steps.
    """
    whole = reward_potential(config, 0.0, 1.0)
    return reward_potential(config, height, at_goal) - whole


def reward_weights(config: RewardConfig, progress: float = 0.0) -> np.ndarray:
    """Weights of the terms [4], which sum to 1, at a fraction `progress` of the training."""
    weights = np.array(config.weights)
    if config.schedule == "gaussian":
        away = progress - np.array([0.0, 0.5, 1.0])
        bell = np.exp(-0.5 * (away / WIDTH) ** 2)
        weights[:3] *= np.where(away < 0.0, np.maximum(bell, FLOOR), 1.0)
    return weights / weights.sum()
