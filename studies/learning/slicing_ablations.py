"""What of the agent matters: trains variants and lets them cut.

Each variant is `sliceit train` with one thing changed, on the same seed, then `sliceit evaluate` in
the world of measured curves. Both go on where they were stopped; finished variants are not trained
again, and a folder can hold a training that was made elsewhere. One seed: only great differences
count.
"""

import argparse
import collections
import json
from pathlib import Path

import numpy as np

from sliceit_drake.cli.main import main as sliceit
from studies.marked_page import Place

__all__ = ["PLACE", "add_arguments", "run"]

VARIANTS = {
    "as it is": "{}",
    "no force history": "{history: false}",
    "no randomisation": "{task: {randomization: {foods: none, height: [0.0, 0.0], offset: 0.0, "
    "tilt: 0.0, stations: 1, board: [1.0, 1.0], force_bias: 0.0, moment_bias: 0.0, "
    "delay: [0.0, 0.0], servo_delay: [0.0, 0.0]}}}",
    "uniform replay": "{priority: 0.0}",
    "action mapping of the authors' code": "{task: {agent: {mapping: upper}}}",
    "draws up to 150 mm/s, not 40": "{task: {agent: {draw_increment: 7.5e-3}}}",
    "uniform noise, not the posterior": "{task: {randomization: {foods: uniform}}}",
    "two environments side by side": "{environments: 2}",
    "two environments, 60,000 decisions": "{environments: 2}",
}
STEPS = {"two environments, 60,000 decisions": 60_000}
"""Decisions of a training that is not as long as the others."""
PLACE = Place("slicing_ablations")
LAST = 20
"""Slices at the end of a training whose return is given."""


def slug(variant: str) -> str:
    """Name of a variant's folder."""
    return "".join(c if c.isalnum() else "_" for c in variant)


def returns(folder: Path) -> np.ndarray:
    """Returns of a training's last slices."""
    lines = (folder / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    return np.array([json.loads(line)["return"] for line in lines[-LAST:]])


def row(variant: str, folder: Path, cuts: list[dict]) -> list[str]:
    """A variant's line of the table."""
    by_food = collections.defaultdict(list)
    for cut in cuts:
        by_food[cut["food"]].append(cut)
    cells = [variant, f"{returns(folder).mean():.1f}"]
    cells.append(f"{sum(cut['completed'] for cut in cuts)} of {len(cuts)}")
    for food in ("cucumber", "tomato", "potato", "carrot"):
        forces = [cut["median_force"] for cut in by_food[food]]
        cells.append(f"{np.mean(forces):.1f} N" if forces else "-")
    cells.append(f"{np.mean([cut['board_peak'] for cut in by_food['cucumber']]):.1f} N")
    return cells


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--folder", type=Path, required=True, help="where trainings are kept")
    parser.add_argument("--steps", type=int, default=15_000, help="of most trainings; 15000")
    parser.add_argument("--seed", type=int, default=0, help="of all of them; 0")
    parser.add_argument("--slices", type=int, default=5, help="of each food; 5")
    PLACE.add_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    evaluation = options.folder / "evaluation.jsonl"
    folders = {variant: options.folder / slug(variant) for variant in VARIANTS}
    for variant, settings in VARIANTS.items():
        folder = folders[variant]
        if not (folder / "policy.onnx").exists():
            print(f"{variant}:")
            steps = STEPS.get(variant, options.steps)
            given = ["--steps", str(steps), "--seed", str(options.seed)]
            code = sliceit(["train", "--output", str(folder), "--set", settings, *given])
            if code != 0:
                return code
    given = ["--slices", str(options.slices), "--world", "curves", "--output", str(evaluation)]
    code = sliceit(["evaluate", *map(str, folders.values()), *given])
    if code != 0:
        return code
    cuts = [json.loads(line) for line in evaluation.read_text(encoding="utf-8").splitlines()]
    PLACE.publish(
        options.output,
        rows=[
            row(variant, folder, [c for c in cuts if c["policy"] == str(folder)])
            for variant, folder in folders.items()
        ],
        steps=options.steps,
        slices=options.slices,
        seed=options.seed,
        command=options.command,
    )
    return 0
