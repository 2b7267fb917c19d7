"""Tunes an agent's rule by differential evolution, on what a training is for.

A candidate cuts fixed slices of the training's task, and is worth its mean discounted return.
Candidates are kept in --output: the same command goes on where it was stopped.
"""

import argparse
import dataclasses as dc
import json
from pathlib import Path

import numpy as np
from scipy.optimize import differential_evolution
from tqdm import tqdm

from sliceit_drake.learning.environment import SlicingEnv
from sliceit_drake.learning.fixed_slices import cut_fixed_slices
from sliceit_drake.learning.task import TaskConfig
from sliceit_drake.systems.agent_rule import AgentRule
from sliceit_drake.systems.exported_network import load_network
from studies.learning.rules import fast

__all__ = ["BOUNDS", "add_arguments", "run"]

BOUNDS = {
    "level": (10.0, 45.0),
    "gain": (0.3, 3.0),
    "reach": (0.3, 0.95),
    "softness": (-1.0, 1.0),
    "landing": (0.03, 1.0),
}
START = AgentRule(30.0)
MEMBERS = 12
"""Candidates of a generation."""
SLICES, SEED = 9, 2_000_000
"""Slices of a candidate, and the seed of the first: none that a training cuts or is chosen by."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--generations", type=int, default=5, help="after the first; 5")
    parser.add_argument("--seed", type=int, default=0, help="of the search; 0")
    parser.add_argument(
        "--output", metavar="FILE", type=Path, required=True, help=".jsonl, a line a candidate"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    known: dict[tuple[float, ...], dict[str, float]] = {}
    if options.output.exists():
        for line in options.output.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            known[tuple(row.pop("rule"))] = row
    options.output.parent.mkdir(parents=True, exist_ok=True)
    rule, task = AgentRule(), TaskConfig()
    task.agent = dc.replace(fast(task.agent), rule=rule)
    env = SlicingEnv(task)
    bar = tqdm(total=MEMBERS * (options.generations + 1), desc="candidates")

    def cost(values: np.ndarray) -> float:
        key = tuple(float(f"{value:.4g}") for value in values)
        if key not in known:
            # All stations of the environment have this rule. To build them takes longer.
            for name, value in zip(BOUNDS, key, strict=True):
                setattr(rule, name, value)
            known[key] = cut_fixed_slices(load_network(task.agent), env, SLICES, SEED)
            with options.output.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"rule": key, **known[key]}) + "\n")
        bar.update()
        return -known[key]["return"]

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
    values = [float(f"{value:.4g}") for value in found.x]
    print(f"return {-found.fun:.2f}, of the start {-cost(np.array(start)):.2f}")
    print(AgentRule(*values))
    return 0
