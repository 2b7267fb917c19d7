"""Force against time: what policies are worth beside rules and chance.

Policies of both simulators, the same with draws by rule and without draws, rules that draw and
press (`AgentRule`), straight presses and random actions cut the same slices of a
world that no training has seen, through the same actions. Slices are kept in --slices-file: the
same command goes on where it was stopped. Writes learning_fronts.md and
figures/learning_fronts.png to --output.
"""

import argparse
import dataclasses as dc
import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from tqdm import tqdm

from sliceit_drake.learning.evaluation import cut_slice
from sliceit_drake.learning.training_config import POLICY, load_policy_folder
from sliceit_drake.learning.unseen_worlds import WORLDS, Case, evaluate
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.slicing_worlds import SLICING_FOODS
from sliceit_drake.systems.agent import AgentConfig, Decide
from sliceit_drake.systems.agent_rule import AgentRule
from sliceit_drake.systems.exported_network import load_network
from studies.figures import BLUE, GREEN, ORANGE, PURPLE, RED, new_figure, save_figure, tidy
from studies.learning.rules import TUNED, fast, uniform, with_draw
from studies.learning.tune_rule import BOUNDS
from studies.pages import publish, render_and_store

__all__ = [
    "KINDS",
    "add_arguments",
    "cells",
    "comparisons",
    "cut",
    "interval",
    "over_rule",
    "run",
    "split",
    "strategies",
    "summarise",
]

SEEDS = range(5)
METRICS = {"median_force": "median force", "peak_force": "peak", "board_peak": "board"}
NUMBERS = (*METRICS, "duration")
COMPARED = ("cutting", "spring", "spring, draw by rule", "random", "tuned rule", "corrected")
"""What is set beside the rule in the short table."""
LEVELS = {
    "press": (20.0, 30.0, 45.0),
    "rule": (6.0, 9.0, 14.0, 20.0, 30.0),
    "fast rule": (6.0, 9.0, 14.0, 20.0, 30.0, 45.0),
}
"""Forces that presses and rules keep to, N: each is a point of a front."""
SLIGHT = 1.0
"""What forces below are compared as, N: some rules hardly touch the board."""
TIMES, FORCES = (2, 3, 5, 10, 20), (2, 5, 10, 20, 50)
"""Marks of the figure's axes, s and N."""
KINDS = {
    "random": ("random actions", "0.45", "x"),
    "press": ("straight press", "0.2", "v"),
    "rule": ("rule, 40 mm/s", GREEN, "o"),
    "fast rule": ("rule, 150 mm/s", PURPLE, "o"),
    "tuned rule": ("tuned rule, 150 mm/s", PURPLE, "*"),
    "corrected": ("our corrections of a rule, 150 mm/s", BLUE, "P"),
    "spring": ("spring policies", RED, "s"),
    "spring, draw by rule": ("spring policies, draw by rule", ORANGE, "s"),
    "spring, no draw": ("spring policies, no draw", RED, "^"),
    "cutting": ("our policies", BLUE, "D"),
    "cutting, no draw": ("our policies, no draw", BLUE, "^"),
}
"""Name, colour and mark of each kind of strategy."""


def strategies() -> list[str]:
    """Names of all that cuts: a kind, and its force, N, or its seed."""
    names = [f"random {seed}" for seed in SEEDS]
    names += [f"{kind} {level:g}" for kind, levels in LEVELS.items() for level in levels]
    names += ["tuned rule 0"]
    kinds = ("spring", "spring, draw by rule", "spring, no draw", "cutting", "cutting, no draw")
    policies = [f"{kind} {seed}" for kind in kinds for seed in SEEDS]
    corrected = resource_path("models/policies").glob("corrected_*")
    return names + policies + sorted(path.name.replace("_", " ") for path in corrected)


def split(name: str) -> tuple[str, float]:
    """Kind of a strategy, and its force or seed."""
    kind, _, number = name.rpartition(" ")
    return kind, float(number)


def decider(case: Case) -> tuple[AgentConfig, Decide]:
    """What cuts a slice."""
    kind, number = split(case.policy)
    agent, rule = AgentConfig(), AgentRule(number)
    if kind == "random":
        text = f"{case.food}{case.slice}".encode()
        return agent, uniform(np.random.default_rng([int(number), case.seed, *text]))
    if kind == "press":
        agent.rule = dc.replace(rule, reach=0.0, softness=1.0, landing=1.0, approach=0.0)
    elif kind == "tuned rule":
        agent.rule = TUNED
    elif kind in ("rule", "fast rule"):
        agent.rule = rule
    if agent.rule is not None:
        if kind in ("fast rule", "tuned rule"):
            agent = fast(agent)
        return agent, load_network(agent)
    simulator, _, other = kind.partition(", ")
    folder = resource_path(f"models/policies/{simulator}_{int(number)}")
    # All end their slices alike, whatever the policy was trained with.
    agent = dc.replace(
        load_policy_folder(folder).task.agent,
        network=str(folder / POLICY),
        goal_lost=agent.goal_lost,
    )
    decide = load_network(agent)
    if other:
        decide = with_draw(decide, rule if other == "draw by rule" else None)
    return agent, decide


def cut(case: Case) -> dict:
    """Cuts one slice; returns its row."""
    scenario, cutting = WORLDS[case.world](case.seed).scenario(
        case.food, case.slice, case.board_stiffness
    )
    agent, decide = decider(case)
    return dc.asdict(case) | dc.asdict(cut_slice(scenario, agent, decide, cutting).metrics)


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean of numbers above zero and its 95 % interval by Student's t; of one number, itself."""
    mean = float(values.mean())
    if len(values) == 1:
        return mean, mean, mean
    half = float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))
    return mean, max(mean - half, 0.0), mean + half


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A point for each food, and kind or, of rules and presses, force.

    The mean over a strategy's slices is one number, so that policies are the unit of the intervals.
    `over_rule` has for each policy the median force over that of the rule with the same draws of 40
    mm/s in the same time; only of those that finish all slices, in a time that the rule has.
    """
    groups: dict[tuple, dict[str, list[dict]]] = {}
    for row in rows:
        kind, number = split(row["policy"])
        key = (row["food"], kind, number if kind in LEVELS else None)
        groups.setdefault(key, {}).setdefault(row["policy"], []).append(row)
    means = {
        key: [
            {name: float(np.mean([row[name] for row in each])) for name in (*NUMBERS, "completed")}
            for each in policies.values()
        ]
        for key, policies in groups.items()
    }
    points = []
    for (food, kind, level), policies in means.items():
        slices = [row for each in groups[food, kind, level].values() for row in each]
        rule = [m[0] for k, m in means.items() if k[:2] == (food, "rule")]
        points.append(
            {"food": food, "kind": kind, "level": level, "policies": len(policies)}
            | {"slices": len(slices), "completed": sum(row["completed"] for row in slices)}
            | {name: interval(np.array([each[name] for each in policies])) for name in NUMBERS}
            | {"over_rule": over_rule(policies, rule, "median_force")}
            | {"board_over_rule": over_rule(policies, rule, "board_peak")}
        )
    foods, kinds = list(SLICING_FOODS), list(KINDS)
    return sorted(
        points,
        key=lambda p: (foods.index(p["food"]), kinds.index(p["kind"]), p["level"] or 0.0),
    )


def over_rule(
    policies: Sequence[dict[str, float]], rule: Sequence[dict[str, float]], metric: str
) -> list[float]:
    """Forces over a rule's in the same time, between whose points it is interpolated.

    It is interpolated in logarithms. What leaves slices unfinished has no time.

    Args:
        policies: Means of what is compared.
        rule: Means of the rule at each of its forces.
        metric: Which force.
    """
    done = sorted((p["duration"], p[metric]) for p in rule if p["completed"] == 1.0)
    if not done:
        return []
    times, forces = np.maximum(np.array(done), [0.0, SLIGHT]).T
    return [
        max(each[metric], SLIGHT)
        / float(np.exp(np.interp(np.log(each["duration"]), np.log(times), np.log(forces))))
        for each in policies
        if each["completed"] == 1.0 and times[0] <= each["duration"] <= times[-1]
    ]


def ratio(found: Sequence[float]) -> str:
    """Ratios at equal time as they stand in a table."""
    if not found:
        return "-"
    mean, low, high = interval(np.array(found))
    return (
        f"{mean:.2f} ({low:.2f} to {high:.2f}; {len(found)})" if len(found) > 1 else f"{mean:.2f}"
    )


def comparisons(points: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Force over the rule's at equal time of some kinds, a line a food."""
    lines = []
    for food in dict.fromkeys(p["food"] for p in points):
        here = [p for p in points if p["food"] == food]
        found = {p["kind"]: p["over_rule"] for p in here if p["kind"] != "fast rule"}
        fast = [value for p in here if p["kind"] == "fast rule" for value in p["over_rule"]]
        faster = f"{min(fast):.2f} to {max(fast):.2f}" if fast else "-"
        board = next(p["board_over_rule"] for p in here if p["kind"] == "cutting")
        lines.append([food, *(ratio(found[kind]) for kind in COMPARED), faster, ratio(board)])
    return lines


def cells(point: dict[str, Any]) -> list[str]:
    """A point's line of the table."""

    def shown(metric: str, unit: str) -> str:
        mean, low, high = point[metric]
        bounds = f" ({low:.1f} to {high:.1f})" if point["policies"] > 1 else ""
        return f"{mean:.1f} {unit}{bounds}"

    name = KINDS[point["kind"]][0]
    return [
        point["food"],
        f"{name}, {point['level']:g} N" if point["level"] else name,
        f"{point['completed']} of {point['slices']}",
        shown("duration", "s"),
        *(shown(metric, "N") for metric in METRICS),
        "" if point["kind"] == "rule" else ratio(point["over_rule"]),
    ]


def plot(points: Sequence[dict[str, Any]], file: Path) -> None:
    """Force against time by food, a row for each metric; hollow where slices stay unfinished."""
    foods = [food for food in SLICING_FOODS if any(p["food"] == food for p in points)]
    figure = new_figure(3.2 * len(foods), 8.2)
    axes = figure.subplots(len(METRICS), len(foods), sharex="col", sharey="row", squeeze=False)
    for (row, metric), (column, food) in product(enumerate(METRICS), enumerate(foods)):
        axis = axes[row, column]
        for kind, (name, colour, mark) in KINDS.items():
            here = [p for p in points if p["food"] == food and p["kind"] == kind]
            if not here:
                continue
            times, forces = (np.array([p[m] for p in here]) for m in ("duration", metric))
            done = np.array([p["completed"] == p["slices"] for p in here])
            if kind in LEVELS:
                axis.plot(times[done, 0], forces[done, 0], color=colour, linewidth=0.8, alpha=0.6)
            elif here[0]["policies"] > 1:
                axis.errorbar(
                    times[:, 0],
                    forces[:, 0],
                    yerr=np.abs(forces[:, 1:] - forces[:, :1]).T,
                    xerr=np.abs(times[:, 1:] - times[:, :1]).T,
                    color=colour,
                    linewidth=0.8,
                    alpha=0.5,
                    fmt="none",
                )
            for which, fill in ((done, colour), (~done, "white")):
                axis.scatter(
                    times[which, 0],
                    forces[which, 0],
                    s=70 if mark == "*" else 30,
                    marker=mark,
                    facecolors=fill if mark != "x" else colour,
                    edgecolors=None if mark == "x" else colour,
                    linewidths=1.2,
                    zorder=3,
                )
            axis.scatter([], [], s=30, marker=mark, color=colour, label=name)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlim(1.3, 32.0)
        axis.set_ylim(2.0, 75.0)
        axis.set_xticks(TIMES, list(map(str, TIMES)))
        axis.minorticks_off()
        tidy(axis, food if row == 0 else "")
        axes[-1, column].set_xlabel("time [s]")
    for row, title in enumerate(METRICS.values()):
        axes[row, 0].set_ylabel(f"{title} [N]")
        axes[row, 0].set_yticks(FORCES, list(map(str, FORCES)))
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8
    )
    save_figure(figure, file, 110)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--slices-file", metavar="FILE", type=Path, required=True, help=".jsonl, a line a slice"
    )
    parser.add_argument("--world", choices=list(WORLDS), default="curves", help="curves")
    parser.add_argument("--slices", type=int, default=3, help="of each food; 3")
    parser.add_argument("--seed", type=int, default=7, help="of the world's slices; 7")
    parser.add_argument("--workers", type=int, default=1, help="processes; 1")
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="where the page goes")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    cases = [
        Case(name, options.world, food, k, 3e4, options.seed)
        for k, name, food in product(range(options.slices), strategies(), SLICING_FOODS)
    ]
    with tqdm(total=len(cases), desc="slices") as bar:

        def count(done: int) -> None:
            bar.update(done - bar.n)

        evaluate(cases, options.slices_file, options.workers, count, cut)
    rows = map(json.loads, options.slices_file.read_text(encoding="utf-8").splitlines())
    wanted = {dc.astuple(case) for case in cases}
    names = [field.name for field in dc.fields(Case)]
    points = summarise([row for row in rows if tuple(row[name] for name in names) in wanted])
    page = options.output / "learning_fronts.md" if options.output else None
    if options.output:
        plot(points, options.output / "figures" / "learning_fronts.png")
    text = render_and_store(
        "learning_fronts",
        page,
        {
            "rows": list(map(cells, points)),
            "compared": comparisons(points),
            "names": [KINDS[kind][0] for kind in COMPARED],
            "policies": len(SEEDS),
            "world": options.world.replace("_", "-"),
            "slices": options.slices,
            "seed": options.seed,
            "tuned": f"({', '.join(f'{name}={getattr(TUNED, name)}' for name in BOUNDS)})",
            "command": options.command,
        },
        points,
    )
    publish(text, page)
    return 0
