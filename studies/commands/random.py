"""`python -m studies random`: the page docs/random_slices.md."""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from studies.physics.random_slices import Outcome

__all__ = ["add_random_study"]

DESCRIPTION = """\
Random foods, planes, knives and motions: what comes of them is a cut or a reason.

Cuts slices drawn from wide ranges, on prescribed motions, and judges each by what any slice must
keep. Takes two seconds a slice and processor. Ends with status 1 if a slice is unexplained.
"""


def add_random_study(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "random",
        help="random foods, planes, knives and motions",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--count", metavar="N", type=int, default=200, help="slices; default: 200")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="default: 0")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; default: 2")
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help="write random_slices.md there"
    )
    parser.set_defaults(run=_run_random)


def _run_random(options: argparse.Namespace) -> int:
    """Runs the study."""
    from tqdm import tqdm

    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.cutting.workers import worker_processes
    from studies.physics.random_slices import random_slices_page

    if options.count < 1 or options.workers < 1:
        raise ConfigurationError("is below 1", field="--count or --workers", fix="Give 1 or more.")
    outcomes: list[Outcome] = []
    interrupted = False
    try:
        with worker_processes(options.workers, "forkserver") as pool:
            seeds = [options.seed] * options.count
            results = pool.map(_cut, seeds, range(options.count))
            outcomes.extend(tqdm(results, total=options.count, desc="slices"))
    except KeyboardInterrupt:
        if not outcomes:
            raise
        interrupted = True  # What was asked for has no page then.
    page = random_slices_page(outcomes, options.seed, shlex.join(["sliceit", *sys.argv[1:]]))
    print(page)
    if options.output is not None and not interrupted:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "random_slices.md").write_text(page, encoding="utf-8")
    if interrupted:
        print(f"Interrupted: this is of the first {len(outcomes)} of {options.count} slices.")
        return 130
    return 1 if any(outcome.kind == "unexplained" for outcome in outcomes) else 0


def _cut(seed: int, index: int) -> "Outcome":
    from studies.physics.random_slices import cut_drawn

    return cut_drawn(seed, index)
