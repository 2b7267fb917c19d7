"""Compare policies trained with the cutting simulator with those trained with a spring.

EVALUATION is what `sliceit evaluate` wrote for policies of both kinds; all must have cut the same
slices. Ratios are cutting over spring, of means over policies and slices; the intervals (95 %) come
from a bootstrap of policies and slices. Writes to --output slicing_results.md, its ratios as
slicing_results.json, figures/slicing_forces.png, and with --policies
figures/slicing_two_slices.png, for which two slices of the stand-in's cucumber are cut anew. With
--ours corrected, ours are those that correct a rule, and corrected_results and corrected_forces are
written.
"""

import argparse
import collections
import dataclasses as dc
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.learning.evaluation import SliceTrace
from sliceit_drake.learning.unseen_worlds import Case, trace
from studies.figures import new_figure, save_figure
from studies.learning.ratio import Ratio, bootstrap_ratio
from studies.pages import publish, render

__all__ = [
    "PAPER",
    "WHOSE",
    "Comparison",
    "add_arguments",
    "claim",
    "compare",
    "comparison_page",
    "interval",
    "plot_boxes",
    "plot_two_slices",
    "run",
    "share",
]

METRICS = ("median_force", "peak_force", "board_peak", "duration")
TITLES = ("median force", "peak force", "peak force on the board", "duration")
PAPER = {"cucumber": 0.61, "tomato": 0.68, "potato": 0.67, "carrot": 0.77}
"""Ratios of the contact force in the SliceIt! paper's figure: dual simulation over spring only."""
OURS, BASELINE = "cutting", "spring"
CORRECTED, EQUAL = "corrected", "corrected_spring"
"""Kinds of policies: ours that correct a rule, and those of the spring that have all else equal."""
COLOURS = {OURS: "#1b7a5a", BASELINE: "#b5532a"}
NAMES = {OURS: "cutting simulator", BASELINE: "spring only"}
WHOSE = {
    "cutting": ("slicing", "policies that were trained in the cutting simulator"),
    CORRECTED: (
        "corrected",
        "policies that correct a rule with draws of up to 150 mm/s "
        "([learning.md](../explanation/learning.md#a-rule-and-what-corrects-it))",
    ),
}
"""By the first word of our policies' names: that of the files, and what they are."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("evaluations", nargs="+", metavar="EVALUATION", type=Path, help=".jsonl")
    parser.add_argument(
        "--ours", choices=WHOSE, default=OURS, help="first word of our policies' names"
    )
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where page and figures go"
    )
    parser.add_argument(
        "--policies",
        nargs=2,
        metavar=("OURS", "BASELINE"),
        help="folders of two trainings, for the figure of the force over time",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    try:
        texts = [file.read_text(encoding="utf-8") for file in options.evaluations]
        rows = [json.loads(line) for text in texts for line in text.splitlines()]
        found = compare(rows, options.ours)
        equal = compare(rows, options.ours, EQUAL)
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(
            f"cannot be compared ({error})",
            source=", ".join(map(str, options.evaluations)),
            fix="Give what `sliceit evaluate` wrote for policies of both simulators.",
        ) from error
    if not found:
        raise ConfigurationError(
            "has no slices that policies of both simulators cut",
            source=", ".join(map(str, options.evaluations)),
            fix="Evaluate policies of `sliceit train --simulator cutting` and `spring`.",
        )
    figures = options.output / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    stem, _ = WHOSE[options.ours]
    page = options.output / f"{stem}_results.md"
    publish(comparison_page(found, options.ours, equal), page, [_facts(each) for each in found])
    boards = sorted({each.board_stiffness for each in found})
    usual = boards[len(boards) // 2]
    plot_boxes(
        [each for each in found if each.board_stiffness == usual], figures / f"{stem}_forces.png"
    )
    if options.policies:
        plot_two_slices(_two_slices(options.policies), figures / "slicing_two_slices.png")
    return 0


@dc.dataclass
class Comparison:
    """Both kinds of policies on one food, in one world, on one board.

    Attributes:
        world, food: Where.
        board_stiffness: N/m.
        values: By simulator and metric: a number for each policy and slice [policies, slices].
        completed: Likewise by simulator: whether the slice was completed.
        ratios: By metric, cutting over spring.
        strict: Of the median force, if each slice that a policy of the cutting simulator left
            unfinished met as much as the worst of the baseline's.
    """

    world: str
    food: str
    board_stiffness: float
    values: dict[str, dict[str, np.ndarray]]
    completed: dict[str, np.ndarray]
    ratios: dict[str, Ratio]
    strict: Ratio


def compare(
    rows: Sequence[Mapping], ours: str = OURS, baseline: str = BASELINE
) -> list[Comparison]:
    """Compares what `sliceit evaluate` wrote, where both kinds of policies cut the same slices.

    The comparisons are in the order of worlds, boards and foods, those of the paper first.

    Args:
        rows: Its lines.
        ours, baseline: Kinds of policies, see `_kind`; others are left out.

    Raises:
        ValueError: A policy did not cut all slices that others did.
    """
    groups: dict[tuple, dict] = {}
    for row in rows:
        if _kind(row) not in (ours, baseline):
            continue
        key = (row["world"], row["food"], row["board_stiffness"], row["seed"])
        group = groups.setdefault(key, collections.defaultdict(dict))
        group[row["simulator"], row["policy"]][row["slice"]] = row
    found = []
    for (world, food, board, _), policies in groups.items():
        if {kind for kind, _ in policies} != {OURS, BASELINE}:
            continue
        slices = sorted({k for cut in policies.values() for k in cut})
        for (_, policy), cut in policies.items():
            if missing := [k for k in slices if k not in cut]:
                raise ValueError(f"{policy} did not cut slices {missing} of {food} in {world}.")
        values = {
            kind: {
                metric: np.array(
                    [
                        [cut[k][metric] for k in slices]
                        for (simulator, _), cut in sorted(policies.items())
                        if simulator == kind
                    ],
                    float,
                )
                for metric in (*METRICS, "completed")
            }
            for kind in (OURS, BASELINE)
        }
        # A seed for each comparison, so that none depends on the order of the others.
        rng = np.random.default_rng([*map(ord, world + food), round(board)])
        ratios = {
            metric: bootstrap_ratio(values[OURS][metric], values[BASELINE][metric], rng)
            for metric in METRICS
        }
        completed = {kind: values[kind].pop("completed") > 0.5 for kind in values}
        force = {kind: values[kind]["median_force"] for kind in values}
        counted = np.where(completed[OURS], force[OURS], force[BASELINE].max())
        strict = bootstrap_ratio(counted, force[BASELINE], rng)
        found.append(Comparison(world, food, board, values, completed, ratios, strict))
    order = [*PAPER, *sorted({each.food for each in found} - set(PAPER))]
    return sorted(found, key=lambda e: (e.world, e.board_stiffness, order.index(e.food)))


def _kind(row: Mapping) -> str:
    """The simulator of a policy; of one whose name says that it corrects a rule, as in `WHOSE`."""
    if not Path(row["policy"]).name.startswith(CORRECTED):
        return str(row["simulator"])
    return CORRECTED if row["simulator"] == OURS else EQUAL


def claim(found: Sequence[Comparison]) -> list[list[str]]:
    """Where the paper's claim holds, for each board: world, board in kN/m, foods on which it holds,
    foods on which it is not shown, and the slices that ours and the baseline completed.

    The ratio's interval has to end below 1, and that of the strict one too: who gives a slice up
    shall not gain by it.
    """
    rows = []
    for world, board in dict.fromkeys((each.world, each.board_stiffness) for each in found):
        here = [e for e in found if (e.world, e.board_stiffness) == (world, board)]
        holds = [e.food for e in here if max(e.ratios["median_force"].high, e.strict.high) < 1.0]
        fails = [e.food for e in here if e.food not in holds]
        done = [
            f"{100 * np.mean([e.completed[kind].mean() for e in here]):.0f} %"
            for kind in (OURS, BASELINE)
        ]
        foods = (", ".join(each) or "none" for each in (holds, fails))
        rows.append([world, f"{1e-3 * board:g}", *foods, *done])
    return rows


def _facts(comparison: Comparison) -> dict[str, Any]:
    """World, board and food; ratios with intervals; fraction of slices completed by each kind."""
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


def _rounded(ratio: Ratio) -> list[float]:
    return [round(value, 4) for value in (ratio.value, ratio.low, ratio.high)]


def _two_slices(policies: Sequence[str]) -> dict[str, list[SliceTrace]]:
    return {
        kind: [trace(Case(folder, "stand_in", "cucumber", k, 3e4, 0)) for k in (0, 1)]
        for kind, folder in zip(("cutting", "spring"), policies, strict=True)
    }


def comparison_page(
    found: Sequence[Comparison], whose: str = OURS, equal: Sequence[Comparison] = ()
) -> str:
    """The page; the paper's ratio stands beside the foods that it cut; `whose` as `ours` of
    `compare`; `equal` with a baseline that differs in its simulator alone."""
    rows = []
    for each in found:
        ours, baseline = each.values[OURS], each.values[BASELINE]
        shape = ours[METRICS[0]].shape
        cells = [
            each.world,
            f"{each.board_stiffness:.0e}".replace("e+0", "e"),
            each.food,
            f"{shape[0]} and {len(baseline[METRICS[0]])}, {shape[1]}",
            f"{share(each.completed[OURS])}, {share(each.completed[BASELINE])}",
        ]
        for metric in METRICS:
            unit = "s" if metric == "duration" else "N"
            means = f"{ours[metric].mean():.1f} {unit}, {baseline[metric].mean():.1f} {unit}"
            cells += [means, interval(each.ratios[metric])]
        paper = f"{PAPER[each.food]:.2f}" if each.food in PAPER else ""
        rows.append([*cells, interval(each.strict), paper])
    stem, what = WHOSE[whose]
    return render(
        "slicing_results",
        claim=claim(found),
        less=[f"{e.food} ({e.world})" for e in equal if e.ratios["median_force"].high < 1.0],
        titles=TITLES,
        rows=rows,
        stem=stem,
        what=what,
        equal=[
            [e.world, e.food, f"{share(e.completed[OURS])}, {share(e.completed[BASELINE])}"]
            + [interval(e.ratios[metric]) for metric in METRICS]
            for e in equal
        ],
    )


def interval(ratio: Ratio) -> str:
    """A ratio as it stands in a table."""
    return f"**{ratio.value:.2f}** ({ratio.low:.2f} to {ratio.high:.2f})"


def share(completed: np.ndarray) -> str:
    """How many slices were completed, as it stands in a table."""
    return f"{int(completed.sum())} of {completed.size}"


def plot_boxes(found: Sequence[Comparison], file: Path) -> None:
    """Box plots of the median contact force of slices by food and world, as the paper's figure.

    Args:
        found: Of one board stiffness.
        file: .png.
    """
    worlds = list(dict.fromkeys(each.world for each in found))
    figure = new_figure(max(9.0, 3.9 * len(worlds)), 3.6)
    axes = figure.subplots(1, len(worlds), sharey=True, squeeze=False)[0]
    for axis, world in zip(axes, worlds, strict=True):
        here = [each for each in found if each.world == world]
        for shift, kind in ((-0.18, OURS), (0.18, BASELINE)):
            boxes = axis.boxplot(
                [each.values[kind]["median_force"].ravel() for each in here],
                positions=np.arange(len(here)) + shift,
                widths=0.3,
                patch_artist=True,
                medianprops={"color": "black"},
                flierprops={"markersize": 3},
            )
            for patch in boxes["boxes"]:
                patch.set_facecolor(COLOURS[kind])
                patch.set_alpha(0.75)
            boxes["boxes"][0].set_label(f"trained with {NAMES[kind]}")
        axis.set_xticks(range(len(here)), [each.food for each in here])
        axis.set_title(world.replace("_", "-"))
        axis.grid(axis="y", alpha=0.3)
    axes[0].set_ylabel("median contact force of a slice [N]")
    axes[0].set_ylim(bottom=0.0)
    axes[0].legend(loc="upper left", fontsize=8)
    save_figure(figure, file, 110)


def plot_two_slices(traces: Mapping[str, Sequence[SliceTrace]], file: Path) -> None:
    """Vertical force over slices of cucumber, the board's contact shaded, as the paper's figure.

    Args:
        traces: By simulator: slices.
        file: .png.
    """
    count = max(len(slices) for slices in traces.values())
    figure = new_figure(9.0, 3.4)
    axes = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    for kind, slices in traces.items():
        for axis, cut in zip(axes, slices, strict=False):
            normal = cut.food[:, 2] + cut.board[:, 2]
            axis.plot(cut.time, normal, color=COLOURS[kind], label=NAMES[kind])
            touching = np.linalg.norm(cut.board, axis=1) > 0.1
            low, high = (0.0, 0.5) if kind == OURS else (0.5, 1.0)
            axis.fill_between(
                cut.time,
                low,
                high,
                where=touching,
                transform=axis.get_xaxis_transform(),
                color=COLOURS[kind],
                alpha=0.12,
                linewidth=0.0,
            )
    for k, axis in enumerate(axes):
        axis.set_title(f"cucumber, slice {k + 1}")
        axis.set_xlabel("time [s]")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("normal force on the knife [N]")
    axes[0].legend(fontsize=8, title="trained with (shaded: on the board)", title_fontsize=8)
    save_figure(figure, file, 110)
