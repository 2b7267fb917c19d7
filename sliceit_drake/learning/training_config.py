"""The settings of a training, and the folder that it leaves; without what trains."""

import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.learning.task import TaskConfig
from sliceit_drake.overrides import Overrides, load_overridden

__all__ = ["CONFIGURATION", "POLICY", "TrainingConfig", "load_policy_folder", "load_training"]

CONFIGURATION, POLICY = "training.yaml", "policy.onnx"


@dc.dataclass
class TrainingConfig:
    """A training: its task, its algorithm and its length."""

    task: TaskConfig = dc.field(default_factory=TaskConfig)
    steps: int = quantity(15_000, "", low=1, high=10**9)
    """Decisions of the training."""
    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of everything random."""
    learning_rate: float = quantity(3e-4, "", low=1e-7, high=1.0)
    """Learning rate of all networks."""
    updates: int = quantity(1, "", low=1, high=100)
    """Updates for each decision."""
    batch: int = quantity(256, "", low=1, high=10**6)
    """Transitions in an update."""
    warm_up: int = quantity(1000, "", low=1, high=10**9)
    """Random decisions at the start."""
    entropy: float = quantity(0.03, "", low=1e-6, high=10.0)
    """Weight of the entropy at the start, from which it adapts. At Stable-Baselines3's 1 lingering
    is worth more than the goal at first, and is overestimated long after."""
    tau: float = quantity(0.01, "", low=0.0, high=1.0)
    """Weight of the newest in the targets' moving average."""
    layers: list[int] = dc.field(default_factory=lambda: [128, 128])
    """Widths of the fully connected layers behind the joined features."""
    priority: float = quantity(0.6, "", low=0.0, high=1.0)
    """Power of the priorities; 0 replays uniformly."""
    history: bool = True
    """Whether the network sees the force/torque history."""
    environments: int = quantity(1, "", low=1, high=64)
    """Environments side by side, each a process. Another number gives another policy."""
    validation_interval: int = quantity(2000, "", low=1, high=10**9)
    """Decisions between validations, after the warm-up; one more ends a training."""
    validation_slices: int = quantity(6, "", low=1, high=1000)
    """Fixed slices of a validation, the foods in turn. The policy with the greatest mean return is
    exported."""
    checkpoint_interval: int = quantity(5000, "", low=1, high=10**9)
    """Decisions between checkpoints."""


def load_training(file: str | Path | None, overrides: Overrides = None) -> TrainingConfig:
    """Reads and validates a training; None for the defaults.

    Args:
        file: YAML of `TrainingConfig` fields.
        overrides: What replaces them, see `Overrides`.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    config: TrainingConfig = load_overridden(TrainingConfig, file, overrides)
    return config


def load_policy_folder(folder: Path) -> TrainingConfig:
    """The training of a folder that has a policy.

    Raises:
        ConfigurationError: There is no training, or it has not written a policy.
    """
    if not (folder / POLICY).is_file():
        raise ConfigurationError(
            f"there is no {POLICY}",
            field="POLICY",
            source=str(folder),
            fix="Give the --output of a `sliceit train` that came to its end.",
        )
    return load_training(folder / CONFIGURATION)
