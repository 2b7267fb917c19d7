"""Memory over an hour of slices.

One process cuts with one station of the cucumber, in a new context each time, and on a prescribed
motion with one solver; what it holds of memory is read after each. Then it builds stations and
drops them. It ends with status 1 if the memory of the last half of the slices grows by more than
`GROWTH` an hour.
"""

import argparse
import gc
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from tqdm import tqdm

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.motion import Motion, MotionPlan, PressAndDraw
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.resources import resource_path
from studies.pages import publish, render_and_store

__all__ = ["add_arguments", "run"]

GROWTH = 10.0
"""Allowed, MB an hour."""
STATION_SECONDS = 0.8
"""Duration of a station's run, into the food."""
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


def station_slices(scenario: Scenario) -> Callable[[], None]:
    """Cuts into the food with one station, in a new context, whenever it is called."""
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)

    def cut() -> None:
        context = diagram.CreateDefaultContext()
        diagram.SetStart(context)
        simulator.reset_context(context)
        simulator.Initialize()
        simulator.AdvanceTo(STATION_SECONDS)

    return cut


def prescribed_slices(scenario: Scenario) -> Callable[[], object]:
    """Cuts on a prescribed motion with one solver, whenever it is called."""
    assert isinstance(scenario.food, Food)
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics, 0.5)
    start = start_pose(model, 2e-3)
    motion = Motion(MotionPlan([PressAndDraw(0.05, 2e-3 + model.top)]), start)
    solver = CuttingSolver(model, scenario.exchange_period)
    return lambda: simulate_slice(solver, motion)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--minutes", type=float, default=60.0, help="that it takes (default 60)")
    parser.add_argument("--output", metavar="FILE", type=Path, help="page to write")
    parser.add_argument(
        "--set", metavar="YAML", dest="overrides", help="fields of the scenario to replace"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"), options.overrides)
    cut, cut_with_arm = prescribed_slices(scenario), station_slices(scenario)
    rows: list[tuple[float, float]] = []
    count = slices = 0
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
    ScenarioDiagram(scenario)
    before = memory()
    for _ in range(BUILT):
        ScenarioDiagram(scenario)
    built = (memory() - before) / BUILT
    values = dict(
        command=options.command,
        station=count,
        prescribed=slices,
        minutes=60.0 * hours[-1],
        held=(held[0], held[len(held) // 2], held[-1]),
        slope=slope,
        allowed=GROWTH,
        left=built,
        built=BUILT,
        python=f"{sys.version_info.major}.{sys.version_info.minor}",
        pydrake=version("drake"),
    )
    results = {"hours": hours, "held_MB": held, "growth_MB_an_hour": slope, "left_MB": built}
    publish(render_and_store("endurance", options.output, values, results), options.output)
    return 0 if slope <= GROWTH else 1
