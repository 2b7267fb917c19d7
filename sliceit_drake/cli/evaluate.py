"""`sliceit evaluate`: lets policies cut slices in worlds that no training has seen."""

import argparse
from pathlib import Path

__all__ = ["add_parser"]

DESCRIPTION = """\
Let trained policies cut slices, and measure contact force, duration and completion.

Each POLICY is a folder that `sliceit train` wrote. Worlds, none of which a training sees:
  stand_in   finite elements on a finer mesh, effects that no training has, a noisy, late sensor
  curves     measured force-depth curves with laws of speed and draw; no code of either simulator
Slices are the paper's unless --slices is given: cucumber 15, tomato 5, potato 10, carrot 5. All
policies cut the same slices. Everything here is simulated.

Writes a line for each slice to --output, a .jsonl file, and goes on where it is.
`python -m studies slicing` compares the policies of both simulators.
"""
WORLDS = ("stand_in", "curves")
FOODS = ("cucumber", "tomato", "potato", "carrot")


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "evaluate",
        help="let trained policies cut slices in unseen worlds",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "policies", nargs="+", metavar="POLICY", type=Path, help="folder of a training"
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
        "--output", metavar="FILE", type=Path, required=True, help=".jsonl file of slices"
    )
    parser.set_defaults(run=_run, resumes=True)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from tqdm import tqdm

    from sliceit_drake.cli.extras import needs_extra

    with needs_extra("learn"):
        from sliceit_drake.learning.unseen_worlds import cases_of, evaluate, results_table

    cases = cases_of(
        options.policies,
        options.world,
        options.foods,
        options.board_stiffness,
        options.seed,
        options.slices,
    )
    with tqdm(total=len(cases), desc="slices") as bar:
        evaluate(cases, options.output, options.workers, lambda done: bar.update(done - bar.n))
    print(results_table(options.output, cases))
    return 0
