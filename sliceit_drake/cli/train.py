"""Train a slicing policy: SAC with prioritised replay, a temporal convolution over the wrench.

The agent of SliceIt! decides at 20 Hz how compliant the knife is and where its target lies, on
calibrated foods that differ from slice to slice (docs/explanation/learning.md). --simulator spring
trains the baseline of the paper, for which food is a spring, on the same task.

Writes to --output:
  policy.onnx       the policy; a scenario runs it as "policy: !AgentConfig {network: policy.onnx}"
  model.zip         the same, for Stable-Baselines3's SAC.load
  README.md         what it is, what it is worth, how it is run
  training.yaml     all settings
  episodes.jsonl    what each episode came to
  events.*          for TensorBoard
  summary.json      ends of episodes, guards of the simulation that ended any
  checkpoint.pt     all that is needed to go on; the same command goes on from it

Ctrl-C ends the training with a checkpoint.
Ends with status 1 if guards of the simulation ended so many episodes that more than 0.1 % would be
the rule (at a level of 5 %: 2 of 300).
"""

import argparse
import signal
import sys
import threading

from sliceit_drake.cli.arguments import add_output_folder, add_overrides
from sliceit_drake.cli.extras import needs_extra
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.interruption import handle_signals

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.add_argument(
        "config",
        nargs="?",
        metavar="TRAINING",
        help="YAML of a training; default: the settings of the package's study",
    )
    add_output_folder(parser, "where all is written", required=True)
    parser.add_argument(
        "--simulator", choices=("cutting", "spring"), help="in the place of task.simulator"
    )
    parser.add_argument("--steps", metavar="N", type=int, help="decisions, in the place of steps")
    parser.add_argument("--seed", metavar="N", type=int, help="in the place of seed")
    add_overrides(parser, "--set", "task.foods=[potato]")


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    with needs_extra("learn"):
        from sliceit_drake.learning.training import train
        from sliceit_drake.learning.training_config import load_training

    given = {"task.simulator": options.simulator, "steps": options.steps, "seed": options.seed}
    replaced = [f"{path}={value}" for path, value in given.items() if value is not None]
    config = load_training(options.config, [*(options.set or ()), *replaced])
    with StageBars() as bars:

        def show(steps: int, remark: str) -> None:
            bars.show("decisions", steps, config.steps, remark)

        asked = threading.Event()

        def ask(*_: object) -> None:
            if asked.is_set():
                raise KeyboardInterrupt
            asked.set()
            print("\nStopping with a checkpoint; Ctrl-C again stops at once", file=sys.stderr)

        try:
            with handle_signals((signal.SIGINT, signal.SIGTERM), ask):
                outcome = train(config, options.output, show, is_stopped=asked.is_set)
        except (KeyboardInterrupt, RuntimeError) as error:
            # A kill that reaches all processes ends the environment's as well.
            if isinstance(error, RuntimeError) and not asked.is_set():
                raise
            print(f"Stopped. The same command goes on from the last checkpoint in {options.output}")
            return 130
    if asked.is_set() and outcome.steps < config.steps:
        print(f"Stopped after {outcome.steps} decisions; the same command goes on from there.")
        return 130
    print(
        f"{outcome.steps} decisions in {outcome.episodes} slices; how they ended: "
        + ", ".join(f"{kind} {count}" for kind, count in sorted(outcome.ends.items()))
    )
    if outcome.failed is not None:
        print(f"Failed: {outcome.failed}")
        return 1
    print(f"Policy: {options.output / 'policy.onnx'}")
    return 0
