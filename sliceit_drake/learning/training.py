"""A training: its run with checkpoints, and what it leaves."""

import contextlib
import copy
import dataclasses as dc
import functools
import json
import multiprocessing
import os
import pickle
import time as clock
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import binom
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.workers import children_without_interrupts, start_worker
from sliceit_drake.learning.environment import SlicingEnv
from sliceit_drake.learning.fixed_slices import cut_fixed_slices
from sliceit_drake.learning.model_card import model_card
from sliceit_drake.learning.network import HistoryExtractor, export_policy
from sliceit_drake.learning.reward import HEIGHT, REACH, RewardConfig
from sliceit_drake.learning.sac import OverlapVecEnv, PrioritizedSAC
from sliceit_drake.learning.task import TaskConfig, check_task
from sliceit_drake.learning.training_config import CONFIGURATION, POLICY, TrainingConfig
from sliceit_drake.systems.agent import ERROR, observation_names

__all__ = ["CHECKPOINT", "Outcome", "make_model", "train", "value_limit"]

CHECKPOINT, EPISODES, VALIDATION = "checkpoint.pt", "episodes.jsonl", "validation.jsonl"
MODEL, CARD = "model.zip", "README.md"
VALIDATION_SEED = 1_000_000
"""Of the first validation slice: episodes of a training follow from its own seed."""
GUARD_SHARE, SURE = 1e-3, 0.05
"""Fraction of the episodes that guards of the simulation may end, and how improbable their number
has to be at that fraction for a training to fail."""


@dc.dataclass
class Outcome:
    """What a training came to.

    Attributes:
        steps: Decisions taken, those before a resumption included.
        episodes: Slices begun and ended, likewise.
        wall_time: Wall time of this run, s.
        guard_errors: Episodes that guards ended, by kind.
        ends: Episodes by how they ended.
        best_return: Greatest mean discounted return over the validation slices, of the policy that
            is exported; None where there was no validation, and it is the last.
        best_steps: When that was.
        failed: Why the result cannot be used, or None.
    """

    steps: int
    episodes: int
    wall_time: float
    guard_errors: dict[str, int]
    ends: dict[str, int]
    best_return: float | None
    best_steps: int
    failed: str | None = None


def train(
    config: TrainingConfig,
    output: Path,
    progress: Callable[[int, str], None] | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Trains, or goes on where the checkpoint in `output` is.

    A run that goes on gives the same numbers as one that was never interrupted.

    Args:
        config: Training; of a run that goes on, that which it was begun with.
        output: Folder for checkpoint, training.yaml, TensorBoard, policy.onnx, model.zip (for
            `stable_baselines3.SAC.load`), README.md (the policy's card), and a line for each
            slice in episodes.jsonl and for each validation in validation.jsonl. A return is what
            is trained: discounted, the potential's part included.
        progress: Called with the steps so far and a line about the last episodes.
        is_stopped: Asked at each decision whether to end with a checkpoint there.

    Raises:
        ConfigurationError: `output` has a checkpoint of another configuration.
        RuntimeError: The process of an environment ended.
    """
    output.mkdir(parents=True, exist_ok=True)
    described = json.dumps(dc.asdict(config), sort_keys=True)
    saved = _load(output / CHECKPOINT, described)
    dump_yaml(config, output / CONFIGURATION)
    # An error in the environment's process would come out as a broken pipe.
    check_task(config.task)
    torch.set_num_threads(1)
    with children_without_interrupts():
        make = functools.partial(_environment, config.task)
        processes = SubprocVecEnv([make] * config.environments, "forkserver")
    environments = OverlapVecEnv(processes, None if saved is None else saved["environments"])
    try:
        model = make_model(config, environments)
        model.set_logger(configure(str(output), ["tensorboard"]))
        environments.meanwhile = model.update
        callback = _Watch(config, output, described, progress, is_stopped)
        if saved is not None:
            model.set_training_state(saved["model"])
            if config.task.reward.schedule != "constant":
                environments.set_attr("progress", model.num_timesteps / config.steps)
            callback.restore(saved["watch"])
        # What was logged after the checkpoint is dropped.
        for name, count in ((EPISODES, callback.episodes), (VALIDATION, callback.validations)):
            if (log := output / name).exists():
                kept = log.read_text(encoding="utf-8").splitlines(keepends=True)[:count]
                log.write_text("".join(kept), encoding="utf-8")
        begin = clock.perf_counter()
        remaining = config.steps - model.num_timesteps
        with contextlib.suppress(_Stopped):
            if remaining > 0:
                model.learn(remaining, callback, reset_num_timesteps=False)
        if not callback.was_stopped:
            callback.validate()
        outcome = callback.outcome(clock.perf_counter() - begin)
        if not callback.was_stopped:
            if callback.best_actor is not None:
                model.actor.load_state_dict(callback.best_actor)
            export_policy(model.actor, config.task.agent, output / POLICY)
            # Half as large; the checkpoint has them.
            for optimizer in (model.actor.optimizer, model.critic.optimizer):
                optimizer.state.clear()
            # For `stable_baselines3.SAC.load`, which knows nothing of these.
            model.save(output / MODEL, exclude=["value_limit", "running"])
            steps = outcome.steps if callback.best is None else callback.best_steps
            card = model_card(config, steps, outcome.ends, callback.best)
            (output / CARD).write_text(card, encoding="utf-8")
        summary = json.dumps(dc.asdict(outcome), indent=2) + "\n"
        (output / "summary.json").write_text(summary, encoding="utf-8")
        return outcome
    except (EOFError, ConnectionError) as error:
        raise RuntimeError(
            "The process of an environment ended; if by an error, that is printed above. The same "
            f"command goes on from the last checkpoint in {output}."
        ) from error
    finally:
        # A process that has ended cannot be told to end.
        with contextlib.suppress(EOFError, ConnectionError):
            environments.close()


def make_model(config: TrainingConfig, environments: OverlapVecEnv) -> PrioritizedSAC:
    """The algorithm of a training, before its first step."""
    agent = config.task.agent
    model = PrioritizedSAC(
        "MlpPolicy",
        environments,
        learning_rate=config.learning_rate,
        # The last step of several environments can go beyond.
        buffer_size=config.steps + config.environments - 1,
        learning_starts=config.warm_up,
        batch_size=config.batch,
        tau=config.tau,
        gamma=config.task.reward.discount,
        ent_coef=f"auto_{config.entropy:.9g}",
        updates=config.updates,
        value_limit=value_limit(config.task.reward),
        beta_steps=config.steps,
        train_freq=1,
        # Updates are made while the environments simulate.
        gradient_steps=0,
        replay_buffer_kwargs={"alpha": config.priority},
        policy_kwargs={
            "optimizer_kwargs": {"fused": True},
            "net_arch": list(config.layers),
            "features_extractor_class": HistoryExtractor,
            "features_extractor_kwargs": {
                "history": agent.history,
                "blind": not config.history,
            },
        },
        seed=config.seed,
        device="cpu",
    )
    model.replay_buffer.seed(config.seed)
    if agent.rule is not None:
        # What corrects a rule begins with no correction.
        with torch.no_grad():
            model.actor.mu.weight.zero_()
            model.actor.mu.bias.zero_()
    return model


def value_limit(reward: RewardConfig) -> Callable[[torch.Tensor], torch.Tensor]:
    """A bound on values: from observations [batch, n] to the most still to be earned [batch, 1].

    It is the reward of the goal less the potential, which ends at zero: all other terms only cost.
    """
    names = observation_names(1)
    height, at_goal = names.index("error_z"), names.index("at_goal")

    def limit(observations: torch.Tensor) -> torch.Tensor:
        held = observations[:, at_goal].clamp(max=1.0)
        way = (REACH - (observations[:, height] * ERROR[1]).clamp(0.0, REACH)) / HEIGHT
        return (reward.goal - reward.hold * held - reward.way * way)[:, None]

    return limit


def _environment(task: TaskConfig) -> SlicingEnv:
    if multiprocessing.parent_process() is not None:
        start_worker()
    return SlicingEnv(task)


def _load(file: Path, described: str) -> dict[str, Any] | None:
    if not file.exists():
        return None
    try:
        # Tensors and plain values alone: a file from elsewhere must not run what it holds.
        saved = torch.load(file, weights_only=True)
        if not isinstance(saved, dict) or "config" not in saved:
            raise pickle.UnpicklingError("it has no settings")
        if saved["config"] == described:
            return saved
        problem = "is of a training with other settings"
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        reason = str(error).splitlines() or ["it ends too early"]
        problem = f"is no checkpoint of this version ({reason[0]})"
    raise ConfigurationError(
        problem, field="output", source=str(file), fix="Give another folder, or delete it."
    )


class _Watch(BaseCallback):
    """Logs episodes, validates, counts guards, keeps checkpoints."""

    def __init__(
        self,
        config: TrainingConfig,
        output: Path,
        described: str,
        progress: Callable[[int, str], None] | None,
        is_stopped: Callable[[], bool],
    ) -> None:
        super().__init__()
        self._config, self._output, self._described = config, output, described
        self._progress, self._is_stopped = progress, is_stopped
        self.episodes, self.was_stopped = 0, False
        self._saved_at = 0
        self._ends: Counter[str] = Counter()
        self._guards: Counter[str] = Counter()
        self._sums: list[Counter] = [Counter() for _ in range(config.environments)]
        self._validation: SlicingEnv | None = None
        self.validations, self._validated_at = 0, config.warm_up
        self.best_steps = 0
        self.best: dict[str, float] | None = None
        self.best_actor: dict[str, torch.Tensor] | None = None

    def restore(self, state: dict[str, Any]) -> None:
        self.episodes, self._saved_at = state["episodes"], state["steps"]
        self._ends, self._guards = Counter(state["ends"]), Counter(state["guards"])
        self.validations, self._validated_at = state["validations"]
        self._sums = [Counter(sums) for sums in state["sums"]]
        self.best_steps, self.best, self.best_actor = state["best"]

    def outcome(self, wall_time: float) -> Outcome:
        guarded = sum(self._guards.values())
        failed = None
        if guarded and binom.sf(guarded - 1, self.episodes, GUARD_SHARE) < SURE:
            failed = (
                f"guards of the simulation ended {guarded} of {self.episodes} episodes "
                f"({dict(self._guards)}), more than {100 * GUARD_SHARE:g} %"
            )
        return Outcome(
            self.num_timesteps,
            self.episodes,
            wall_time,
            dict(self._guards),
            dict(self._ends),
            None if self.best is None else self.best["return"],
            self.best_steps,
            failed,
        )

    def _on_step(self) -> bool:
        each = (self.locals[name] for name in ("infos", "rewards", "dones"))
        for sums, info, reward, done in zip(self._sums, *each, strict=True):
            terms = {f"reward_{name}": value for name, value in info["reward_terms"].items()}
            worth = self._config.task.reward.discount ** sums["length"] * float(reward)
            sums.update({"return": worth, "length": 1.0, "force": info["force"], **terms})
            sums["peak"] = max(sums["peak"], info["force"])
            if done:
                self._finish_episode(info, sums)
                sums.clear()
        if self._config.task.reward.schedule != "constant":
            self.training_env.set_attr("progress", self.num_timesteps / self._config.steps)
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._validated_at >= self._config.validation_interval:
            self.validate()
        # Only here the last transitions are in the buffer.
        self.was_stopped = self._is_stopped()
        if (
            self.was_stopped
            or self.num_timesteps - self._saved_at >= self._config.checkpoint_interval
        ):
            self._save()
        if self.was_stopped:
            raise _Stopped

    def validate(self) -> None:
        """Validates the policy once in a place of the training, and keeps the best."""
        if self.num_timesteps <= self._validated_at:
            return
        if self._validation is None:
            self._validation = SlicingEnv(self._config.task)
        slices = self._config.validation_slices
        found = cut_fixed_slices(self._decide, self._validation, slices, VALIDATION_SEED)
        self.validations, self._validated_at = self.validations + 1, self.num_timesteps
        with (self._output / VALIDATION).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"steps": self.num_timesteps, **found}) + "\n")
        for name, value in found.items():
            self.logger.record(f"validation/{name}", value)
        self.logger.dump(self.num_timesteps)
        if self.best is None or found["return"] > self.best["return"]:
            self.best, self.best_steps = found, self.num_timesteps
            self.best_actor = copy.deepcopy(self.model.actor.state_dict())

    def _save(self) -> None:
        self._saved_at = self.num_timesteps
        assert isinstance(self.model, PrioritizedSAC)
        state = {
            "config": self._described,
            "model": self.model.training_state(),
            "environments": self.training_env.env_method("moment"),
            "watch": {
                "episodes": self.episodes,
                "steps": self.num_timesteps,
                "ends": dict(self._ends),
                "guards": dict(self._guards),
                "validations": (self.validations, self._validated_at),
                "sums": [dict(sums) for sums in self._sums],
                "best": (self.best_steps, self.best, self.best_actor),
            },
        }
        # Whole or not at all.
        part = self._output / f"{CHECKPOINT}.part"
        torch.save(state, part)
        os.replace(part, self._output / CHECKPOINT)

    def _decide(self, observation: np.ndarray) -> np.ndarray:
        action, _ = self.model.predict(observation, deterministic=True)
        return action

    def _finish_episode(self, info: dict[str, Any], sums: Counter) -> None:
        self.episodes += 1
        self._ends[info["end"]] += 1
        if "guard_error" in info:
            self._guards[info["guard_error"]] += 1
        length = sums["length"]
        row = {
            "steps": self.num_timesteps,
            "end": info["end"],
            "length": int(length),
            "return": sums["return"],
            "force": sums["force"] / length,
            "peak": sums["peak"],
            "cut_progress": info["cut_progress"],
            **{k: v / length for k, v in sums.items() if k.startswith("reward_")},
        }
        if "guard_message" in info:
            row["guard"] = info["guard_message"]
        with (self._output / EPISODES).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        for name, value in row.items():
            if isinstance(value, int | float):
                self.logger.record(f"episode/{name}", value)
        self.logger.record("guards/episodes", sum(self._guards.values()))
        self.logger.dump(self.num_timesteps)
        if self._progress is not None:
            self._progress(self.num_timesteps, f"return {row['return']:.1f}, {row['end']}")


class _Stopped(Exception):
    """Ends `learn` at a checkpoint."""
