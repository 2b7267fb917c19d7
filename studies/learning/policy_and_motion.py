"""Trained policies beside motions that were optimised without learning.

For each food a press and draw is optimised on the calibrated model, without noise, in as much time
as a policy took, and cut by a stiff position controller; the policy decides by what it feels. Both
cut the same slices of the stand-in world, whose foods differ from the calibrated ones. Metrics are
those of `sliceit evaluate`. The motion is the best of two searches, from `STARTS` places each: by
the gradient (`sliceit optimize-motion`, at most 30 iterations from each) and by CMA-ES (Hansen
2016; `GENERATIONS` of `POPULATION` slices from each). As a control, as many motions as CMA-ES tries
are drawn at random.
"""

import argparse
import copy
import dataclasses as dc
import itertools
from pathlib import Path

import numpy as np
from cmaes import CMA
from tqdm import tqdm

from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.motion import Hold, MotionPlan, PressAndDraw
from sliceit_drake.cutting.motion_optimization import (
    MotionLimits,
    mean_force_alone,
    optimize_motion,
    places,
)
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.learning.evaluation import SliceMetrics, cut_slice, slice_metrics
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.slicing_worlds import SLICING_FOODS, StandInWorld
from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig
from sliceit_drake.systems.exported_network import load_network
from studies.marked_page import Place

__all__ = ["PLACE", "add_arguments", "drawn", "evolve", "run"]

PLACE = Place("policy_and_motion")
STIFF = "scenarios/cucumber_measured.yaml"
"""Whose controller tracks the motion."""
BELOW = 2e-4
"""How far below the board's top the motion aims, m."""


STARTS, GENERATIONS, POPULATION = 5, 10, 7


def evolve(adjoint: SliceAdjoint, limits: MotionLimits) -> tuple[float, PressAndDraw]:
    """Least mean force that CMA-ES finds from several places, N, and its motion."""
    best = (np.inf, limits.motion(adjoint.model, np.full(3, 0.5)))
    for seed, start in enumerate(places(STARTS)):
        search = CMA(
            start, 0.2, bounds=np.array([[0.0, 1.0]] * 3), seed=seed, population_size=POPULATION
        )
        for _ in range(GENERATIONS):
            tried = []
            for shares in (search.ask() for _ in range(POPULATION)):
                motion = limits.motion(adjoint.model, shares)
                force = mean_force_alone(adjoint, motion)
                best = min(best, (force, motion), key=lambda each: each[0])
                tried.append((shares, force))
            search.tell(tried)
    return best


def drawn(adjoint: SliceAdjoint, limits: MotionLimits) -> float:
    """Least mean force of as many motions at random, N."""
    shares = np.random.default_rng(0).random((STARTS * GENERATIONS * POPULATION, 3))
    return min(mean_force_alone(adjoint, limits.motion(adjoint.model, each)) for each in shares)


def optimum(food: str, duration: float) -> tuple[PressAndDraw, list[float]]:
    """The best motion for a calibrated food in a time, s; least force of each search, N."""
    calibrated = load_calibrated_food(food)
    scenario = StandInWorld().scenario(food, 0)[0]
    model = make_food_model(calibrated.held(), calibrated.knife, scenario.numerics)
    limits = MotionLimits(duration=duration)
    period = scenario.exchange_period
    found = optimize_motion(model, limits, period=period, starts=STARTS)
    adjoint = SliceAdjoint(model, period)
    force, motion = evolve(adjoint, limits)
    motion = motion if force < found.force else found.motion
    motion = dc.replace(motion, acceleration=limits.draw_acceleration)
    return motion, [found.force, force, drawn(adjoint, limits)]


def cut_by_motion(
    scenario: Scenario, motion: PressAndDraw, stiff: ComplianceControllerConfig
) -> SliceMetrics:
    """One slice by a motion from the start to the board."""
    scenario.controller = stiff
    assert isinstance(scenario.food, Food) and isinstance(scenario.food.shape, Cylinder)
    height = scenario.food.shape.diameter + scenario.start.clearance
    down = dc.replace(motion, distance=height + BELOW)
    scenario.motion = MotionPlan([down, Hold(0.3)])
    run = prepare_run(scenario)
    run.advance()
    record = run.record()

    def force(name: str) -> np.ndarray:
        return np.column_stack([record[f"{name}_wrench_f_{axis}"] for axis in "xyz"])

    end = "goal" if not run.stopped else "guard"
    return slice_metrics(record["time"], force("food"), force("board"), record["cut_progress"], end)


def row(kind: str, found: list[SliceMetrics]) -> list[str]:
    """Means over slices."""
    done = sum(each.completed for each in found)
    means = [
        f"{np.mean([getattr(each, name) for each in found]):.1f} {unit}"
        for name, unit in (
            ("median_force", "N"),
            ("peak_force", "N"),
            ("board_peak", "N"),
            ("duration", "s"),
        )
    ]
    return [kind, f"{done} of {len(found)}", *means]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "policies", nargs="+", metavar="POLICY", type=Path, help="folder of a training"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=SLICING_FOODS, default=list(SLICING_FOODS), help="all"
    )
    parser.add_argument("--slices", type=int, default=3, help="of each food; 3")
    PLACE.add_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    PLACE.check(options.output)
    from sliceit_drake.learning.training_config import POLICY, load_policy_folder

    stiff = load_scenario(resource_path(STIFF)).controller
    agents = {}
    for policy in options.policies:
        agent = load_policy_folder(policy).task.agent
        agents[policy.name] = dc.replace(agent, network=str(policy / POLICY))
    rows, found = [], []
    with tqdm(total=len(options.foods) * len(agents), desc="motions") as bar:
        for food, (name, agent) in itertools.product(options.foods, agents.items()):
            scenarios = [StandInWorld().scenario(food, k)[0] for k in range(options.slices)]
            decide = load_network(agent)
            cut = [cut_slice(copy.deepcopy(each), agent, decide).metrics for each in scenarios]
            # Without what it takes to come to the food and to wait for the goal.
            duration = float(np.median([each.duration for each in cut])) - 0.7
            motion, forces = optimum(food, max(duration, 1.0))
            found.append((food, name, *(f"{force:.2f} N" for force in forces)))
            planned = [cut_by_motion(each, motion, stiff) for each in scenarios]
            what = (
                f"motion: {1e3 * motion.press_speed:.0f} mm/s down, {1e3 * motion.amplitude:.0f} mm"
                f" at {motion.frequency:.1f} Hz"
            )
            rows += [[food, *row(name, cut)], ["", *row(what, planned)]]
            bar.update()
    PLACE.publish(
        options.output,
        rows=rows,
        found=found,
        starts=STARTS,
        command=options.command,
        slices=options.slices,
    )
    return 0
