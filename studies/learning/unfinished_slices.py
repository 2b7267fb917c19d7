"""Why slices stay unfinished.

Cuts again each slice of `sliceit evaluate` that was not completed on one board, and says what the
knife and the policy did in its last seconds.
"""

import argparse
import dataclasses as dc
import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.learning.unseen_worlds import Case, trace
from sliceit_drake.systems.agent import ACTIONS, AgentConfig
from studies.marked_page import Place

__all__ = ["PLACE", "add_arguments", "run"]

PLACE = Place("unfinished_slices")
LAST = 5.0
"""How long before the end is looked at, s."""


def row(case: Case) -> list[str]:
    """A slice's line of the table."""
    cut = trace(case)
    count = round(LAST / AgentConfig().period)
    height, actions = 1e3 * cut.height[-count:], cut.actions[-count:]
    press = actions[:, [ACTIONS.index("press"), ACTIONS.index("p_z")]].mean(axis=0)
    draw = actions[:, ACTIONS.index("draw")]
    force = (cut.food + cut.board)[cut.time > cut.time[-1] - LAST]
    along = np.hypot(force[:, 0], force[:, 1]).mean()
    return [
        Path(case.policy).name,
        case.world.replace("_", "-"),
        f"{case.food} {case.slice + 1}",
        f"{cut.metrics.end}, {cut.time[-1]:.1f} s",
        f"{100 * cut.metrics.cut:.1f} %",
        f"{height.min():.2f} to {height.max():.2f} mm",
        f"{draw.min():+.2f} to {draw.max():+.2f}",
        f"{press[0]:+.2f}, {press[1]:+.2f}",
        f"{along:.0f} N, {force[:, 2].mean():.0f} N",
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("evaluation", type=Path, help="what `sliceit evaluate` wrote")
    parser.add_argument("--board-stiffness", type=float, default=3e4, help="N/m; 3e4")
    PLACE.add_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    names = [field.name for field in dc.fields(Case)]
    rows = [
        json.loads(line) for line in options.evaluation.read_text(encoding="utf-8").splitlines()
    ]
    of_board = [r for r in rows if r["board_stiffness"] == options.board_stiffness]
    cases = [Case(**{name: r[name] for name in names}) for r in of_board if not r["completed"]]
    PLACE.publish(
        options.output,
        rows=list(map(row, tqdm(cases, desc="slices"))),
        slices=len(of_board),
        board=options.board_stiffness / 1e3,
        last=LAST,
        command=options.command,
    )
    return 0
