"""`python -m studies slicing`: policies of the cutting simulator against those of the spring."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sliceit_drake.learning.evaluation import SliceTrace
    from sliceit_drake.learning.metrics import Ratio
    from studies.learning.comparison import Comparison

__all__ = ["add_slicing"]

DESCRIPTION = """\
Compare policies trained with the cutting simulator with those trained with a spring.

EVALUATION is what `sliceit evaluate` wrote for policies of both kinds; all must have cut the same
slices. Ratios are cutting over spring, of means over policies and slices; the intervals (95 %) come
from a bootstrap of policies and slices. Writes to --output slicing_results.md, its ratios as
slicing_results.json, figures/slicing_forces.png, and with --policies
figures/slicing_two_slices.png, for which two slices of the stand-in's cucumber are cut anew.
"""


def add_slicing(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the study."""
    parser = studies.add_parser(
        "slicing",
        help="policies of both simulators in unseen worlds",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("evaluation", metavar="EVALUATION", type=Path, help=".jsonl")
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where page and figures go"
    )
    parser.add_argument(
        "--policies",
        nargs=2,
        metavar=("OURS", "BASELINE"),
        help="folders of two trainings, for the figure of the force over time",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.cli.extras import needs_extra
    from sliceit_drake.configuration import ConfigurationError

    with needs_extra("learn"):
        from studies.learning.comparison import compare, plot_boxes, plot_two_slices

    try:
        lines = options.evaluation.read_text(encoding="utf-8").splitlines()
        rows = [json.loads(line) for line in lines]
        found = compare(rows)
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(
            f"cannot be compared ({error})",
            source=str(options.evaluation),
            fix="Give what `sliceit evaluate` wrote for policies of both simulators.",
        ) from error
    if not found:
        raise ConfigurationError(
            "has no slices that policies of both simulators cut",
            source=str(options.evaluation),
            fix="Evaluate policies of `sliceit train --simulator cutting` and `spring`.",
        )
    figures = options.output / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    page = _page(found)
    (options.output / "slicing_results.md").write_text(page, encoding="utf-8")
    facts = json.dumps([_facts(each) for each in found], indent=1) + "\n"
    (options.output / "slicing_results.json").write_text(facts, encoding="utf-8")
    boards = sorted({each.board_stiffness for each in found})
    usual = boards[len(boards) // 2]
    plot_boxes(
        [each for each in found if each.board_stiffness == usual], figures / "slicing_forces.png"
    )
    if options.policies:
        plot_two_slices(_two_slices(options.policies), figures / "slicing_two_slices.png")
    print(page)
    return 0


def _facts(comparison: "Comparison") -> dict:
    """World, board and food; ratios with intervals; share of slices completed by each kind."""
    return {
        "world": comparison.world,
        "food": comparison.food,
        "board_stiffness": comparison.board_stiffness,
        "ratios": {metric: _rounded(ratio) for metric, ratio in comparison.ratios.items()},
        "strict_ratio": _rounded(comparison.strict),
        "completed": {
            kind: round(float(done.mean()), 4) for kind, done in comparison.completed.items()
        },
    }


def _rounded(ratio: "Ratio") -> list[float]:
    return [round(value, 4) for value in (ratio.value, ratio.low, ratio.high)]


def _two_slices(policies: Sequence[str]) -> "dict[str, list[SliceTrace]]":
    from sliceit_drake.cli.evaluate import Case, trace

    return {
        kind: [trace(Case(folder, "stand_in", "cucumber", k, 3e4, 0)) for k in (0, 1)]
        for kind, folder in zip(("cutting", "spring"), policies, strict=True)
    }


def _page(found: "Sequence[Comparison]") -> str:
    from studies.learning.comparison import claim, comparison_page

    return "\n".join(
        [
            "# Slicing with policies of both simulators",
            "",
            "Everything here is simulated, in worlds that no training has seen"
            " ([learning.md](learning.md) says what they are). Written by `python -m studies slicing`.",
            "",
            *claim(found),
            "",
            comparison_page(found),
            "",
            "Means over policies and slices; in brackets the 95 % interval of the ratio, cutting"
            " simulator over spring. The strict ratio counts each slice that a policy of ours left"
            " unfinished as if it had met as much as the worst of the baseline's. The paper's ratio"
            " is that of its box plot, on a robot.",
            "",
            "![Median contact force of slices by food and world](figures/slicing_forces.png)",
            "",
        ]
    )
