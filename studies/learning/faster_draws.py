"""What faster draws bring.

EVALUATION is what `sliceit evaluate` wrote for policies of both simulators, FASTER the same for
policies that were trained alike but may move the target faster along the edge. Both have to hold
the same slices; what only one of them holds is left out.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from studies.learning.comparison import PAPER, Comparison, compare, interval, share
from studies.learning.ratio import bootstrap_ratio
from studies.marked_page import Place
from studies.pages import table

__all__ = ["PLACE", "add_arguments", "draws_table", "run"]

PLACE = Place("faster_draws")
METRIC = "median_force"


def read(file: Path) -> dict[tuple[str, str, float], Comparison]:
    """The comparisons of an evaluation by world, food and board."""
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(e.world, e.food, e.board_stiffness): e for e in compare(rows)}


def row(slow: Comparison, fast: Comparison) -> list[str]:
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
    return [
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


def draws_table(evaluation: Path, faster: Path, command: str) -> list[str]:
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
        table(
            "world | food | force, ours: default, faster draws | ratio of the two"
            " | force, baseline: default, faster draws | ours over baseline: default, faster draws"
            " | ours over baseline in the paper"
            " | peak on the board, ours over baseline: default, faster draws"
            " | completed by ours with faster draws",
            (row(slow[key], each) for key, each in fast.items() if key in slow),
        ),
        "",
        "Forces are means of the median force over all slices, of "
        f"{policies[0]['cutting']} and {policies[0]['spring']} policies with the default draws, and"
        f" of {policies[1]['cutting']} and {policies[1]['spring']} with faster draws. Intervals are"
        f" of 95 %. `{command}`",
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("evaluation", type=Path, help="of the policies as they are")
    parser.add_argument("faster", type=Path, help="of those with faster draws")
    PLACE.add_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    lines = draws_table(options.evaluation, options.faster, options.command)
    PLACE.show(options.output, "\n".join(lines))
    return 0
