"""A scenario whose motion is the press and draw with the least force."""

import dataclasses as dc
from collections.abc import Callable

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.motion import Hold, MotionPlan, PressAndDraw, Retract
from sliceit_drake.cutting.motion_optimization import MotionLimits, Optimum, optimize_motion
from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["optimize_scenario"]


def optimize_scenario(
    scenario: Scenario,
    limits: MotionLimits,
    iterations: int = 30,
    starts: int = 3,
    progress: Callable[[int, float, PressAndDraw], None] | None = None,
) -> tuple[Scenario, Optimum]:
    """Replaces a scenario's motion or policy by the best press and draw, for a robot to run.

    Args:
        scenario: A single cut of finite elements.
        limits, iterations, starts, progress: See `optimize_motion`.

    Returns:
        The scenario with the motion, a hold and a retraction; and the optimum.

    Raises:
        ConfigurationError: The scenario has no such cut, or no motion keeps the limits.
        CuttingError: A slice breaks down.
    """
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
        iterations=iterations,
        starts=starts,
        progress=progress,
    )
    # A robot starts and stops; and the edge starts above the food.
    down = scenario.start.clearance + model.top - model.bottom
    slicing = dc.replace(found.motion, distance=down + 2e-4, acceleration=limits.draw_acceleration)
    retract = Retract(down + 0.01, 0.05, 0.5, label="retract")
    plan = MotionPlan([slicing, Hold(0.1, label="hold"), retract])
    # The measured curve is of another motion.
    return dc.replace(scenario, policy=None, motion=plan, measurement=None), found
