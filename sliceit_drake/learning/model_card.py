"""The card of a trained policy: what it is, what it is worth, how it is run."""

import dataclasses as dc
from collections.abc import Mapping

from sliceit_drake.configuration import dump_yaml
from sliceit_drake.learning.training_config import POLICY, TrainingConfig
from sliceit_drake.systems.agent import AgentConfig

__all__ = ["model_card"]

TRAINERS = {"cutting": "the cutting simulator", "spring": "a spring in the place of food"}


def model_card(
    config: TrainingConfig, steps: int, ends: Mapping[str, int], found: Mapping[str, float] | None
) -> str:
    """The card, in Markdown.

    Args:
        config: Training.
        steps: Decisions after which the policy was kept.
        ends: Slices of the training by how they ended.
        found: What its validation found, see `cut_fixed_slices`; None where there was none.
    """
    task, default = config.task, AgentConfig()
    agent = dc.replace(
        task.agent, network=POLICY, descent=default.descent, duration=default.duration
    )
    scenario = dump_yaml(agent, defaults=default)
    ended = ", ".join(f"{end} {count}" for end, count in sorted(ends.items()))
    lines = [
        "# Slicing policy",
        "",
        f"An agent that slices {', '.join(task.foods)}, trained for {config.steps} decisions with "
        f"{TRAINERS[task.simulator]} (seed {config.seed}); kept is what it had learned after "
        f"{steps}. `training.yaml` has all settings. All is simulated: no robot has run it.",
        "",
        f"The {sum(ends.values())} slices of the training ended so: {ended}.",
        "",
    ]
    if found is not None:
        lines += [
            f"On {config.validation_slices} fixed slices of the training's task, without "
            "randomness:",
            "",
            "| reached the goal | time | mean force | peak force | discounted return |",
            "|---|---|---|---|---|",
            f"| {100 * found['goal']:.0f} % | {found['length'] * task.agent.period:.2f} s "
            f"| {found['force']:.1f} N | {found['peak']:.1f} N | {found['return']:.2f} |",
            "",
        ]
    lines += [
        "A scenario whose controller is in parallel mode runs it, with the height of its start "
        "over the board as `descent`:",
        "",
        "    policy: !AgentConfig",
        *(f"      {line}" for line in scenario.splitlines()),
        "",
        "`sliceit evaluate` lets it cut slices that no training has seen. Foods, boards, sensors "
        "and speeds beyond the ranges of `training.yaml` are untried.",
        "",
    ]
    return "\n".join(lines)
