"""Memory over an hour of slices.

    python studies/robot/endurance.py --minutes 60 --output docs/endurance.md

One process cuts with one station of the cucumber, in a new context each time, and on a prescribed
motion with one solver; what it holds of memory is read after each. Then it builds stations and
drops them. It ends with status 1 if the memory of the last half of the slices grows by more than
`GROWTH` an hour.
"""

import argparse
import gc
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from tqdm import tqdm

from sliceit_drake.cutting.foods.food import make_food_model, start_pose
from sliceit_drake.cutting.motion import Motion, MotionPlan, PressAndDraw
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import MakeScenarioDiagram
from sliceit_drake.resources import resource_path

GROWTH = 10.0
"""Allowed, MB an hour."""
STATION_SECONDS = 0.8
"""Of a station's run: into the food."""
BUILT = 10
"""Stations that are built and dropped."""


def memory() -> float:
    """What this process holds, MB."""
    gc.collect()
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024.0
    raise RuntimeError("/proc/self/status has no VmRSS: this needs Linux.")


def growth(hours: np.ndarray, held: np.ndarray) -> float:
    """Slope of the second half, MB an hour."""
    late = hours >= 0.5 * hours[-1]
    return float(np.polyfit(hours[late], held[late], 1)[0]) if late.sum() > 1 else 0.0


def station_slices(scenario: Scenario):
    """Cuts into the food with one station, in a new context, whenever it is called."""
    diagram = MakeScenarioDiagram(scenario)
    simulator = Simulator(diagram)

    def cut() -> None:
        context = diagram.CreateDefaultContext()
        diagram.SetStart(context)
        simulator.reset_context(context)
        simulator.Initialize()
        simulator.AdvanceTo(STATION_SECONDS)

    return cut


def prescribed_slices(scenario: Scenario):
    """Cuts on a prescribed motion with one solver, whenever it is called."""
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics, 0.5)
    start = start_pose(model, 2e-3)
    motion = Motion(MotionPlan([PressAndDraw(0.05, 2e-3 + model.top)]), start)
    solver = CuttingSolver(model, scenario.exchange_period)
    return lambda: simulate_slice(solver, motion)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark; returns the status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--output", type=Path, help="page to write")
    parser.add_argument("--set", dest="overrides", help="fields of the scenario to replace")
    options = parser.parse_args(arguments)
    scenario = load_scenario(resource_path("scenarios/cucumber.yaml"), options.overrides)
    cut, cut_with_arm = prescribed_slices(scenario), station_slices(scenario)
    rows, count, slices = [], 0, 0
    begin = time.monotonic()
    with tqdm(total=options.minutes, desc="minutes", bar_format="{l_bar}{bar}| {n:.1f}") as bar:
        while (minutes := (time.monotonic() - begin) / 60.0) < options.minutes or not rows:
            bar.update(minutes - bar.n)
            cut_with_arm()
            count += 1
            for _ in range(5):
                cut()
                slices += 1
            rows.append(((time.monotonic() - begin) / 3600.0, memory()))
    hours, held = np.array(rows).T
    slope = growth(hours, held)
    MakeScenarioDiagram(scenario)
    before = memory()
    for _ in range(BUILT):
        MakeScenarioDiagram(scenario)
    built = (memory() - before) / BUILT
    command = shlex.join(["python", "studies/robot/endurance.py", *(arguments or sys.argv[1:])])
    page = "\n".join(
        [
            "# Memory over an hour of slices",
            "",
            f"    {command}",
            "",
            f"{count} slices with one station and {slices} on a prescribed motion, in one process, "
            f"in {60.0 * hours[-1]:.1f} minutes. It held {held[0]:.0f} MB after the first, "
            f"{held[len(held) // 2]:.0f} MB half-way and {held[-1]:.0f} MB at the end: "
            f"{slope:+.1f} MB an hour over the second half (allowed: {GROWTH:g}).",
            "",
            f"A station that is built and dropped leaves {built:.1f} MB behind (mean of {BUILT}; "
            f"Python {sys.version_info.major}.{sys.version_info.minor}, pydrake "
            f"{version('drake')}): pydrake does not free systems written in Python (issues 22515 "
            "and 24162 of Drake). So build a station once and give it new contexts, as the "
            "learning environment does, or let processes end, as `sliceit evaluate` does.",
            "",
        ]
    )
    print(page)
    if options.output is not None:
        options.output.write_text(page, encoding="utf-8")
    return 0 if slope <= GROWTH else 1


if __name__ == "__main__":
    sys.exit(main())
