"""Soft actor-critic with prioritised replay, as a Stable-Baselines3 algorithm.

Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018); the update is that of
Stable-Baselines3, with importance weights in the critics' loss, for which it has no hook, and less
work for the same numbers: critics frozen in the actor's step, densities written out.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch.nn import functional

from sliceit_drake.learning.replay import PrioritizedReplayBuffer

__all__ = ["OverlapVecEnv", "PrioritizedSAC"]

TRACE = 0.01
"""Weight of the newest update in the running means that are logged."""


class OverlapVecEnv(VecEnvWrapper):
    """Environments whose processes simulate while this one learns.

    The newest transitions are one step late. Nothing depends on which of the two is the faster.

    Args:
        venv: Environments in processes of their own.
        moments: Moments of `SlicingEnv` at which the first reset begins, one for each environment;
            None to begin slices.

    Attributes:
        meanwhile: Called in every step after the actions have been sent.
    """

    def __init__(self, venv: VecEnv, moments: Sequence[dict[str, Any]] | None = None) -> None:
        super().__init__(venv)
        self.meanwhile: Callable[[], None] | None = None
        self._moments = moments

    def reset(self) -> Any:
        observations = self.venv.reset()
        if self._moments is None:
            return observations
        moments, self._moments = self._moments, None
        returned = [
            self.env_method("return_to", moment, indices=k) for k, moment in enumerate(moments)
        ]
        return np.concatenate(returned)

    def step_wait(self) -> Any:
        if self.meanwhile is not None:
            self.meanwhile()
        return self.venv.step_wait()


class PrioritizedSAC(SAC):
    """SAC whose replay buffer is a `PrioritizedReplayBuffer`.

    Args:
        updates: Updates for each decision.
        beta_steps: Steps in which the power of the importance weights grows linearly to 1 from that
            of the replay buffer; None to leave it as it is.
        value_limit: Bound on values, from observations [batch, n] to [batch, 1]; None for none.
            Where an episode can linger, an overestimated value feeds on itself, and fades only with
            the discount.
    """

    replay_buffer: PrioritizedReplayBuffer

    def __init__(
        self,
        *arguments: Any,
        updates: int = 1,
        beta_steps: int | None = None,
        value_limit: Callable[[torch.Tensor], torch.Tensor] | None = None,
        **options: Any,
    ) -> None:
        self.updates, self.beta_steps, self.value_limit = updates, beta_steps, value_limit
        self.running: dict[str, float] = {}
        super().__init__(*arguments, replay_buffer_class=PrioritizedReplayBuffer, **options)
        self.beta_begin = self.replay_buffer.beta

    def update(self) -> None:
        """Makes the updates of a decision of each environment, once the warm-up is over."""
        if self.num_timesteps > self.learning_starts:
            self.train(self.updates * self.n_envs, self.batch_size)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self.beta_steps is not None:
            done = min(self.num_timesteps / self.beta_steps, 1.0)
            self.replay_buffer.set_beta(self.beta_begin + done * (1.0 - self.beta_begin))
        self.policy.set_training_mode(True)
        for _ in range(gradient_steps):
            self._train_batch(batch_size)
        for name, value in self.running.items():
            self.logger.record(f"train/{name}", value)

    def _train_batch(self, batch_size: int) -> None:
        batch, places, weights = self.replay_buffer.sample_prioritized(batch_size)
        action, log_density = self._act(batch.observations)
        alpha = self._entropy_step(log_density)
        with torch.no_grad():
            following, following_density = self._act(batch.next_observations)
            value = torch.cat(self.critic_target(batch.next_observations, following), dim=1)
            value = value.min(dim=1, keepdim=True).values - alpha * following_density
            if self.value_limit is not None:
                value = torch.minimum(value, self.value_limit(batch.next_observations))
            target = batch.rewards + (1.0 - batch.dones) * self.gamma * value
        values = self.critic(batch.observations, batch.actions)
        errors = [value - target for value in values]
        critic_loss = 0.5 * sum((weights * error**2).mean() for error in errors)
        self.critic.optimizer.zero_grad(set_to_none=True)
        critic_loss.backward()
        self.critic.optimizer.step()
        sizes = torch.cat(errors, dim=1).detach().abs().mean(dim=1)
        self.replay_buffer.update(places, sizes.numpy())

        for parameter in self.critic.parameters():
            parameter.requires_grad_(False)
        worth = torch.cat(self.critic(batch.observations, action), dim=1)
        actor_loss = (alpha * log_density - worth.min(dim=1, keepdim=True).values).mean()
        self.actor.optimizer.zero_grad(set_to_none=True)
        actor_loss.backward()
        self.actor.optimizer.step()
        for parameter in self.critic.parameters():
            parameter.requires_grad_(True)

        with torch.no_grad():
            targets = list(self.critic_target.parameters())
            torch._foreach_lerp_(targets, list(self.critic.parameters()), self.tau)
        for name, value in (
            ("actor_loss", actor_loss),
            ("critic_loss", critic_loss),
            ("ent_coef", alpha),
            ("entropy", -log_density.mean()),
            ("value", worth.mean()),
        ):
            before = self.running.get(name, value.item())
            self.running[name] = before + TRACE * (value.item() - before)

    def _act(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A random action [batch, 6] and the logarithm of its density [batch, 1]."""
        mean, log_deviation, _ = self.actor.get_action_dist_params(observations)
        normal = torch.randn_like(mean)
        free = mean + log_deviation.exp() * normal
        density = -0.5 * normal**2 - log_deviation - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(u)^2), without loss where tanh is near 1.
        density = density - 2.0 * (math.log(2.0) - free - functional.softplus(-2.0 * free))
        return torch.tanh(free), density.sum(dim=1, keepdim=True)

    def _entropy_step(self, log_density: torch.Tensor) -> torch.Tensor:
        if self.ent_coef_optimizer is None:
            return self.ent_coef_tensor
        alpha = self.log_ent_coef.detach().exp()
        loss = -(self.log_ent_coef * (log_density.detach() + self.target_entropy)).mean()
        self.ent_coef_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.ent_coef_optimizer.step()
        return alpha

    def training_state(self) -> dict[str, Any]:
        """All that is needed to go on as if nothing had happened, but for the environments.

        It holds tensors and plain values only, for `torch.load(..., weights_only=True)`.
        """
        numpy = np.random.get_state(legacy=False)
        return {
            "parameters": self.get_parameters(),
            "log_ent_coef": None if self.ent_coef_optimizer is None else self.log_ent_coef.detach(),
            "replay": self.replay_buffer.state(),
            "num_timesteps": self.num_timesteps,
            "running": dict(self.running),
            "torch": torch.get_rng_state(),
            "numpy": numpy
            | {"state": {k: np.asarray(v).tolist() for k, v in numpy["state"].items()}},
            "actions": self.action_space.np_random.bit_generator.state,
        }

    def set_training_state(self, state: dict[str, Any]) -> None:
        """Takes what `training_state` gave."""
        self.set_parameters(state["parameters"])
        if state["log_ent_coef"] is not None:
            self.log_ent_coef.data.copy_(state["log_ent_coef"])
        self.replay_buffer.set_state(state["replay"])
        self.num_timesteps, self.running = state["num_timesteps"], dict(state["running"])
        torch.set_rng_state(state["torch"])
        np.random.set_state(state["numpy"])
        self.action_space.np_random.bit_generator.state = state["actions"]
