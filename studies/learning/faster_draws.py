"""What faster draws bring: python studies/learning/faster_draws.py EVALUATION FASTER [--output FILE].

EVALUATION is what `sliceit evaluate` wrote for policies of both simulators, FASTER the same for
policies that were trained alike but may move the target faster along the edge. Both have to hold
the same slices; what only one of them holds is left out.

--output puts the table into a Markdown file, between the lines
  <!-- faster_draws -->
  <!-- end of faster_draws -->
"""

import argparse
import json
import shlex
import sys
from pathlib import Path

import numpy as np

from sliceit_drake.learning.metrics import bootstrap_ratio
from studies.learning.comparison import PAPER, Comparison, compare, interval, share
from studies.marked_page import Place

PLACE = Place("faster_draws")
METRIC = "median_force"


def read(file: Path) -> dict[tuple[str, str, float], Comparison]:
    """The comparisons of an evaluation by world, food and board."""
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(e.world, e.food, e.board_stiffness): e for e in compare(rows)}


def row(slow: Comparison, fast: Comparison) -> str:
    """A food's line of the table.

    Raises:
        ValueError: The slices differ.
    """
    ours, faster = slow.values["cutting"][METRIC], fast.values["cutting"][METRIC]
    if ours.shape[1] != faster.shape[1]:
        raise ValueError(f"{ours.shape[1]} and {faster.shape[1]} slices of {slow.food}")
    gain = bootstrap_ratio(faster, ours, np.random.default_rng([*map(ord, slow.world + slow.food)]))
    boards = [each.ratios["board_peak"].value for each in (slow, fast)]
    forces = [each.values["spring"][METRIC].mean() for each in (slow, fast)]
    cells = [
        slow.world.replace("_", "-"),
        slow.food,
        f"{ours.mean():.1f} N, {faster.mean():.1f} N",
        interval(gain),
        f"{forces[0]:.1f} N, {forces[1]:.1f} N",
        f"{slow.ratios[METRIC].value:.2f}, {interval(fast.ratios[METRIC])}",
        f"{PAPER[slow.food]:.2f}" if slow.food in PAPER else "",
        f"{boards[0]:.2f}, {boards[1]:.2f}",
        share(fast.completed["cutting"]),
    ]
    return "| " + " | ".join(cells) + " |"


def table(evaluation: Path, faster: Path, command: str) -> list[str]:
    """The table's lines.

    Args:
        evaluation, faster: What `sliceit evaluate` wrote.
        command: That made it.
    """
    slow, fast = read(evaluation), read(faster)
    policies = [
        {
            kind: len(next(iter(found.values())).values[kind][METRIC])
            for kind in ("cutting", "spring")
        }
        for found in (slow, fast)
    ]
    return [
        "| world | food | ours: as it is, faster | ratio | baseline: as it is, faster "
        "| ours over baseline: as it is, faster | paper's | board's peak likewise "
        "| ours completed, faster |",
        "|---|---|---|---|---|---|---|---|---|",
        *(row(slow[key], each) for key, each in fast.items() if key in slow),
        "",
        f"Means of the slices' median force over {policies[0]['cutting']} and "
        f"{policies[0]['spring']} policies as they are, {policies[1]['cutting']} and "
        f"{policies[1]['spring']} with faster draws; intervals of 95 %. "
        f"`{command}`",
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("evaluation", type=Path, help="of the policies as they are")
    parser.add_argument("faster", type=Path, help="of those with faster draws")
    parser.add_argument("--output", type=Path, help="Markdown file with the two lines")
    options = parser.parse_args()
    PLACE.check(options.output)
    command = shlex.join(["python", "studies/learning/faster_draws.py", *sys.argv[1:]])
    PLACE.show(options.output, table(options.evaluation, options.faster, command))
    return 0


if __name__ == "__main__":
    sys.exit(main())
