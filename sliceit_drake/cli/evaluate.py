"""Let trained policies cut slices, and measure contact force, duration and completion.

Each POLICY is a folder that `sliceit train` wrote. Worlds, none of which a training sees:
  stand_in   finite elements on a finer mesh, effects that no training has, a noisy, late sensor
  curves     measured force-depth curves with laws of speed and draw; no code of either simulator
Slices are the paper's unless --slices is given: cucumber 15, tomato 5, potato 10, carrot 5. All
policies cut the same slices. Everything here is simulated.

Writes a line for each slice to --output, a .jsonl file, and goes on where it is.
`python -m studies slicing` compares the policies of both simulators.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import SEEDS, WORKERS, check_numbers, output_path
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.resources import here_or_shipped

if TYPE_CHECKING:
    from sliceit_drake.learning.unseen_worlds import Case

__all__ = ["add_arguments", "cut_and_print", "run"]

WORLDS = ("stand_in", "curves")
FOODS = ("cucumber", "tomato", "potato", "carrot")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.add_argument(
        "policies",
        nargs="+",
        metavar="POLICY",
        type=here_or_shipped,
        help="folder of a training",
    )
    parser.add_argument(
        "--world", nargs="+", choices=WORLDS, default=list(WORLDS), help="default: both"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=FOODS, default=list(FOODS), help="default: all"
    )
    parser.add_argument("--slices", metavar="N", type=int, help="of each food")
    parser.add_argument(
        "--board-stiffness",
        nargs="+",
        metavar="K",
        type=float,
        default=[3e4],
        help="N/m; several to vary it; default: 30000",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the slices; 0")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; 2")
    parser.add_argument(
        "--output", metavar="FILE", type=output_path, required=True, help=".jsonl file of slices"
    )
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    check_numbers(options, slices=(1, math.inf), seed=SEEDS, workers=WORKERS)
    check_numbers(options, board_stiffness=(1e2, 1e8))
    from sliceit_drake.learning.unseen_worlds import cases_of

    cases = cases_of(
        options.policies,
        options.world,
        options.foods,
        options.board_stiffness,
        options.seed,
        options.slices,
    )
    cut_and_print(cases, options.output, options.workers)
    return 0


def cut_and_print(
    cases: "Sequence[Case]",
    output: Path,
    workers: int,
    cut_case: "Callable[[Case], dict] | None" = None,
) -> None:
    """Cuts slices with a bar, and prints their table; see `unseen_worlds.evaluate`."""
    from sliceit_drake.learning.unseen_worlds import evaluate, results_table

    with StageBars() as bars:
        evaluate(
            cases, output, workers, lambda done: bars.show("slices", done, len(cases)), cut_case
        )
    print(results_table(output, cases))
