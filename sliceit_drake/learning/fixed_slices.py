"""What a policy is worth on fixed slices of a training's task."""

import numpy as np

from sliceit_drake.learning.environment import SlicingEnv
from sliceit_drake.systems.agent import Decide

__all__ = ["cut_fixed_slices"]


def cut_fixed_slices(decide: Decide, env: SlicingEnv, slices: int, seed: int) -> dict[str, float]:
    """Lets a policy cut fixed slices.

    Args:
        decide: The policy.
        env: Of the training's task.
        slices: How many, of the task's foods in turn.
        seed: Of the first; those of the others follow.

    Returns:
        Means over the slices: return (discounted, as it is trained), length in decisions, force
        (mean, N), peak (N), and the fraction that reached the goal.
    """
    foods, discount = env.task.foods, env.task.reward.discount
    env.progress, rows = 1.0, []
    for k in range(slices):
        food = foods[k % len(foods)]
        observation, _ = env.reset(seed=seed + k, options={"food": food})
        rewards, forces, done = [], [], False
        while not done:
            observation, reward, terminated, truncated, info = env.step(decide(observation))
            rewards.append(reward)
            forces.append(info["force"])
            done = terminated or truncated
        worth = float(np.array(rewards) @ discount ** np.arange(len(rewards)))
        rows.append((worth, len(rewards), np.mean(forces), max(forces), info["is_success"]))
    names = ("return", "length", "force", "peak", "goal")
    return dict(zip(names, np.mean(np.array(rows, float), axis=0).tolist(), strict=True))
