"""Prioritised replay for Stable-Baselines3, on torchrl's sum tree."""

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

__all__ = ["PrioritizedReplayBuffer", "PrioritizedSamples"]

TREES = ("_sum_tree", "_min_tree")
"""Trees of priorities in a sampler's state."""


class PrioritizedSamples(NamedTuple):
    """A batch.

    Attributes:
        transitions: As Stable-Baselines3 has them.
        places: In the buffer [batch].
        weights: Importance weights [batch, 1], the greatest of a batch 1.
    """

    transitions: ReplayBufferSamples
    places: np.ndarray
    weights: torch.Tensor


class _Filled:
    """What the sampler asks of a storage: how much of it is filled."""

    ndim = 1

    def __init__(self) -> None:
        self.size = 0

    def __len__(self) -> int:
        return self.size


class PrioritizedReplayBuffer(ReplayBuffer):
    """Transitions drawn in proportion to a power of their last error.

    Schaul et al., "Prioritized Experience Replay" (2016), proportional variant. Weights are divided
    by the greatest of their batch: by that of the whole buffer a single transition with a small
    error would make all others' steps small.

    Transitions of several environments are kept in a row, one after the other.

    Args:
        alpha: Power of the priority; 0 draws uniformly.
        beta: Power of the importance weights at the start; `set_beta` raises it.
        floor: Added to each error.
        n_envs: Environments whose transitions are added together.
    """

    def __init__(
        self,
        *arguments: Any,
        alpha: float = 0.6,
        beta: float = 0.4,
        floor: float = 0.01,
        n_envs: int = 1,
        **options: Any,
    ) -> None:
        super().__init__(*arguments, n_envs=1, **options)
        self._environments = n_envs
        self._filled = _Filled()
        self._sampler = PrioritizedSampler(self.buffer_size, alpha=alpha, beta=beta, eps=floor)
        self._generator = torch.Generator().manual_seed(0)
        # torchrl's own buffers hand their generator to a sampler so; it has no other way.
        self._sampler._rng = self._generator

    def seed(self, seed: int) -> None:
        """Seeds the draws."""
        self._generator.manual_seed(seed)

    @property
    def beta(self) -> float:
        """Power of the importance weights."""
        return self._sampler.beta

    def set_beta(self, beta: float) -> None:
        """Sets the power of the importance weights."""
        self._sampler.beta = beta

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Keeps a transition of each environment [n_envs, ...]."""
        for k in range(self._environments):
            one, place = slice(k, k + 1), torch.tensor([self.pos])
            super().add(obs[one], next_obs[one], action[one], reward[one], done[one], infos[one])
            self._filled.size = self.buffer_size if self.full else self.pos
            # With the greatest priority so far, so that each is seen once.
            self._sampler.extend(place)
            self._sampler.mark_update(place, storage=self._filled)

    def sample_prioritized(self, batch_size: int) -> PrioritizedSamples:
        """Draws a batch."""
        found, info = self._sampler.sample(self._filled, batch_size)
        places = np.asarray(found if not isinstance(found, tuple) else found[0])
        weights = torch.as_tensor(info["priority_weight"]).float().reshape(-1, 1)
        return PrioritizedSamples(self._get_samples(places), places, weights / weights.max())

    def update(self, places: np.ndarray, errors: np.ndarray) -> None:
        """Takes the errors [batch] of transitions for their priorities."""
        self._sampler.update_priority(
            torch.as_tensor(places),
            # The tree is of single precision and takes no other.
            torch.as_tensor(np.abs(errors), dtype=torch.float32),
            storage=self._filled,
        )

    def state(self) -> dict[str, Any]:
        """All that is needed to go on as if nothing had happened: tensors and plain values."""
        size = self._filled.size
        names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
        sampler = self._sampler.state_dict()
        for tree in TREES:
            sampler[tree] = torch.as_tensor(sampler[tree][torch.arange(size)])
        return {
            "arrays": {name: torch.tensor(getattr(self, name)[:size]) for name in names},
            "size": size,
            "pos": self.pos,
            "full": self.full,
            "sampler": sampler,
            "generator": self._generator.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Takes what `state` gave."""
        size = self._filled.size = state["size"]
        for name, values in state["arrays"].items():
            getattr(self, name)[:size] = values.numpy()
        self.pos, self.full = state["pos"], state["full"]
        # The inner nodes of a tree follow from its leaves.
        empty = PrioritizedSampler(self.buffer_size, alpha=1.0, beta=1.0).state_dict()
        for tree in TREES:
            empty[tree][torch.arange(size)] = state["sampler"][tree]
        trees = {tree: empty[tree] for tree in TREES}
        self._sampler.load_state_dict(state["sampler"] | trees)
        self._generator.set_state(state["generator"])
