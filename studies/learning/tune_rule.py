"""Tunes the rule of `fronts` in the training simulator, by differential evolution.

Each candidate cuts the calibrated foods of the training, a slice each, within the limits of the
agent's draws. What is least is the mean of log(F sqrt(T)), F the median force and T the time; a
slice that stays unfinished counts as ten times as bad. Candidates are kept in --output: the same
command goes on where it was stopped.
"""

import argparse
import dataclasses as dc
import json
import math
from pathlib import Path

import numpy as np
from scipy.optimize import differential_evolution
from tqdm import tqdm

from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.learning.evaluation import SliceMetrics, cut_slice
from sliceit_drake.learning.task import TaskConfig, station_scenario
from sliceit_drake.systems.agent_rule import AgentRule
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig
from studies.learning.rules import nothing

__all__ = ["add_arguments", "run", "worth"]

BOUNDS = {
    "level": (4.0, 25.0),
    "gain": (0.3, 3.0),
    "reach": (0.3, 0.95),
    "softness": (-1.0, 1.0),
    "landing": (0.1, 1.0),
}
START = AgentRule(9.0)
MEMBERS = 12
"""Candidates of a generation."""


def worth(metrics: SliceMetrics) -> float:
    """log(F sqrt(T)) of a slice, N and s: less is better."""
    good = math.log(max(metrics.median_force, 0.1)) + 0.5 * math.log(metrics.duration)
    return good if metrics.completed else good + math.log(10.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--generations", type=int, default=2, help="after the first; 2")
    parser.add_argument("--seed", type=int, default=0, help="of the search; 0")
    parser.add_argument(
        "--output", metavar="FILE", type=Path, required=True, help=".jsonl, a line a candidate"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    known: dict[tuple[float, ...], float] = {}
    if options.output.exists():
        for line in options.output.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            known[tuple(row["rule"])] = row["worth"]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    # Without noise a candidate is worth the same each time.
    task = TaskConfig(sensor=WrenchSensorConfig())
    foods = {name: load_calibrated_food(name) for name in task.foods}
    bar = tqdm(total=MEMBERS * (options.generations + 1), desc="candidates")

    def cost(values: np.ndarray) -> float:
        key = tuple(float(f"{value:.6g}") for value in values)
        if key not in known:
            agent = dc.replace(task.agent, rule=AgentRule(*key))
            slices = [
                cut_slice(station_scenario(task, food, name), agent, nothing).metrics
                for name, food in foods.items()
            ]
            known[key] = float(np.mean([worth(each) for each in slices]))
            row = {"rule": key, "worth": known[key], "slices": list(map(dc.asdict, slices))}
            with options.output.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        bar.update()
        return known[key]

    start = [getattr(START, name) for name in BOUNDS]
    rng = np.random.default_rng(options.seed)
    low, high = np.array(list(BOUNDS.values())).T
    members = np.vstack([start, rng.uniform(low, high, (MEMBERS - 1, len(start)))])
    found = differential_evolution(
        cost,
        list(BOUNDS.values()),
        init=members,
        maxiter=options.generations,
        tol=0.0,
        polish=False,
        rng=rng,
    )
    bar.close()
    begin = cost(np.array(start))
    values = [float(f"{value:.6g}") for value in found.x]
    print(f"F sqrt(T) {math.exp(found.fun - begin):.3f} of the start's: {AgentRule(*values)}")
    return 0
