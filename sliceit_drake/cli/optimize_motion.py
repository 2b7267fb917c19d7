"""Find the press and draw that cut a scenario's food with the least force, without learning.

The knife presses at constant speed and draws to and fro by a sinusoid. Speed, amplitude and
frequency are moved along the gradient of the mean force over the depth, which the cutting
simulator's adjoint gives, by Scipy's SLSQP, under the limits below; the food stays on the edge.
No robot is simulated: run what comes out by `sliceit simulate`.

Writes to --output:
  scenario.yaml   the scenario with the motion that was found
  summary.json    motion, mean forces, limits that it touches
"""

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    ONE_CUT,
    add_output_folder,
    add_scenario_arguments,
    check_numbers,
    scenario_of,
)
from sliceit_drake.cli.progress import StageBars

if TYPE_CHECKING:
    from sliceit_drake.cutting.motion import PressAndDraw
    from sliceit_drake.cutting.motion_optimization import MotionLimits, Optimum
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_scenario_arguments(parser, ONE_CUT)
    add_output_folder(parser, "where both files go", required=True)
    for name, unit, default, text in (
        ("duration", "S", 3.0, "longest time of the cut, s"),
        ("draw-speed", "V", 0.15, "greatest speed along the edge, m/s"),
        ("draw-acceleration", "A", 2.0, "greatest acceleration along the edge, m/s2"),
        ("margin", "M", 0.01, "of the edge that stays beyond the food at each end, m"),
    ):
        parser.add_argument(
            f"--{name}", metavar=unit, type=float, default=default, help=f"{text}; {default:g}"
        )
    parser.add_argument(
        "--iterations", metavar="N", type=int, default=30, help="most of the optimiser; 30"
    )
    parser.add_argument(
        "--starts",
        metavar="N",
        type=int,
        default=3,
        help="places from which it begins, for it stops in local minima; 3",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    import dataclasses as dc
    import json

    from sliceit_drake.configuration import dump_yaml
    from sliceit_drake.cutting.motion_optimization import MotionLimits

    check_numbers(options, iterations=(1, math.inf), starts=(1, math.inf))
    limits = MotionLimits(
        duration=options.duration,
        draw_speed=options.draw_speed,
        draw_acceleration=options.draw_acceleration,
        margin=options.margin,
    )
    with StageBars(unit="slice") as bars:

        def show(count: int, force: float, motion: "PressAndDraw") -> None:
            bars.show("slices", count, None, f"{force:.2f} N")

        scenario, found = _optimized(scenario_of(options), limits, options, show)
    motion = found.motion
    options.output.mkdir(parents=True, exist_ok=True)
    dump_yaml(scenario, options.output / "scenario.yaml")
    text = json.dumps(dc.asdict(found), indent=2) + "\n"
    (options.output / "summary.json").write_text(text, encoding="utf-8")
    print(
        f"press {1e3 * motion.press_speed:.1f} mm/s, draw {1e3 * motion.amplitude:.1f} mm at "
        f"{motion.frequency:.2f} Hz: {found.force:.2f} N in the mean over the depth; pressed as "
        f"fast without a draw {found.press_force:.2f} N, at the start {found.start_force:.2f} N"
    )
    forces = ", ".join(f"{force:.2f}" for force in found.by_start)
    print(f"from each start: {forces} N")
    print(f"limits that it touches: {', '.join(found.active) or 'none'}")
    print(f"sliceit simulate {options.output / 'scenario.yaml'} --output FOLDER")
    return 0


def _optimized(
    scenario: "Scenario",
    limits: "MotionLimits",
    options: argparse.Namespace,
    progress: "Callable[[int, float, PressAndDraw], None]",
) -> "tuple[Scenario, Optimum]":
    """A scenario with the best press and draw, a hold and a retraction, for a robot to run."""
    import dataclasses as dc

    from sliceit_drake.configuration import ConfigurationError, validate
    from sliceit_drake.cutting.foods.food import Food, make_food_model
    from sliceit_drake.cutting.motion import Hold, MotionPlan, Retract
    from sliceit_drake.cutting.motion_optimization import optimize_motion

    if not isinstance(scenario.food, Food) or scenario.sequence is not None:
        raise ConfigurationError(
            "has no single cut of finite elements",
            field="scenario.food",
            fix="Give a scenario such as scenarios/cucumber_measured.yaml.",
        )
    validate(limits, "limits")
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    found = optimize_motion(
        model,
        limits,
        period=scenario.exchange_period,
        iterations=options.iterations,
        starts=options.starts,
        progress=progress,
    )
    # A robot starts and stops; and the edge starts above the food.
    down = scenario.start.clearance + model.top - model.bottom
    slicing = dc.replace(found.motion, distance=down + 2e-4, acceleration=limits.draw_acceleration)
    retract = Retract(down + 0.01, 0.05, 0.5, label="retract")
    plan = MotionPlan([slicing, Hold(0.1, label="hold"), retract])
    # The measured curve is of another motion.
    return dc.replace(scenario, policy=None, motion=plan, measurement=None), found
