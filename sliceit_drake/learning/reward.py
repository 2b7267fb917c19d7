"""The reward of SliceIt!, term by term.

Beltran-Hernandez et al., SliceIt! (2024), and its code; where the two differ the code is followed:
as printed the force term rewards force. The force term is ours unless its shape is `sigmoid`:
theirs does not tell forces over 12 N apart, and its sum over a slice is least where the slice is
quickest, at whatever force. By the square half of the force for twice the time costs half.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, quantity

__all__ = ["TERMS", "RewardConfig", "reward_progress", "reward_terms", "reward_weights"]

TERMS = ("distance", "force", "jerk", "step")
HEIGHT = 0.06
"""Scale of the height over the board, metres."""
WIDTH, FLOOR = 0.25, 0.1
"""Of the Gaussians by which a schedule moves weight, as shares of the training, and their least."""


@dc.dataclass
class RewardConfig:
    """Weights of the terms, and what an episode's end gives."""

    weights: list[float] = quantity(
        [0.25, 8.0, 1.0, 0.25],
        "",
        low=0.0,
        size=4,
        doc="Of distance, force, jerk and step; only their ratios count. SliceIt! has all equal.",
    )
    schedule: str = choice(
        "constant",
        ("constant", "gaussian"),
        doc="gaussian: the weight moves from distance to force to jerk during the training.",
    )
    force_shape: str = choice(
        "square",
        ("square", "sigmoid"),
        doc="Of the force term: the square of force over scale, at most 1, or SliceIt!'s.",
    )
    force_scale: float = quantity(
        40.0,
        "N",
        low=0.01,
        high=1e3,
        doc="Of the force term. A sigmoid's is half at three times as much; 2 in SliceIt!.",
    )
    goal: float = quantity(10.0, "", low=0.0, doc="For a slice that is done; 100 in SliceIt!.")
    way: float = quantity(
        15.0,
        "",
        low=0.0,
        doc="For 60 mm of way down to the board, as it is made, and taken back where the knife "
        "rises; not in SliceIt!.",
    )
    hold: float = quantity(
        10.0,
        "",
        low=0.0,
        doc="For the decisions at the goal that end a slice, likewise; not in SliceIt!.",
    )
    collision: float = quantity(
        -30.0,
        "",
        high=0.0,
        doc="For a force over the limit, leaving the workspace, or a failure; -100 in SliceIt!.",
    )

    def most(self) -> float:
        """No slice from less than 90 mm over the board gives more."""
        return self.goal + self.hold + 1.5 * self.way

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
        height: Of the edge over its final pose, metres.
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


def reward_progress(config: RewardConfig, height: float, at_goal: float) -> float:
    """How far a slice has come; what it grows by in a decision is part of the reward.

    A slice that is done gets the same in all, however it came there (Ng, Harada and Russell,
    "Policy invariance under reward transformations", 1999), but sees at once what each decision
    brings: where only the end pays, and time costs little, agents learn to put the end off.

    Args:
        config: Its `way` and `hold`.
        height: Of the edge over the board, metres.
        at_goal: Share of the decisions at the goal that end a slice.
    """
    return config.hold * min(at_goal, 1.0) - config.way * max(height, 0.0) / HEIGHT


def reward_weights(config: RewardConfig, progress: float = 0.0) -> np.ndarray:
    """Weights of the terms [4], which sum to 1.

    Args:
        config: Weights and schedule.
        progress: Share of the training that is done.
    """
    weights = np.array(config.weights)
    if config.schedule == "gaussian":
        away = progress - np.array([0.0, 0.5, 1.0])
        bell = np.exp(-0.5 * (away / WIDTH) ** 2)
        weights[:3] *= np.where(away < 0.0, np.maximum(bell, FLOOR), 1.0)
    return weights / weights.sum()
