"""The scenario of a planned slice, which a station simulates, a stand-in cuts and a robot runs."""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.cutting.foods.effects import Compliance, Slip
from sliceit_drake.cutting.planned_slice import PlannedSlice
from sliceit_drake.diagrams.scenario import Placement, Preparation, Scenario, Start
from sliceit_drake.systems.analytic_cutter import no_food

__all__ = ["scenario_of_slice"]

REACH = (0.3, 0.7)
"""Distances from the base at which the arm cuts, metres."""
GAINS = 200.0
"""Gains of the controller in motion mode, as in scenarios/cucumber_measured.yaml."""


def scenario_of_slice(plan: PlannedSlice) -> Scenario:
    """The scenario of a slice.

    A slice at a place out of the arm's reach, as of records with an origin of their own, is cut
    where scenarios cut by default.
    """
    scenario = Scenario(name=plan.name, knife=plan.knife, board=dc.replace(plan.board))
    if plan.position is not None and _in_reach(plan.position, scenario):
        scenario.placement = Placement(position=plan.position[:2], yaw=plan.yaw)
        scenario.board.height = plan.position[2]
    scenario.controller.mode = "motion"
    scenario.controller.error_scale = 1.0
    scenario.controller.p_gains = [GAINS] * 6
    if plan.food is None:
        # Of no toughness, it is a height to start from and no force.
        scenario.food = no_food(plan.height)
    else:
        scenario.food = copy.deepcopy(plan.food)
        # An arm and a holder that give belong to the station, not to the food.
        scenario.food.effects = dc.replace(
            scenario.food.effects, compliance=Compliance(), slip=Slip()
        )
    scenario.start = Start(clearance=plan.clearance, offset=plan.offset)
    scenario.motion = copy.deepcopy(plan.motion)
    scenario.preparation = Preparation(
        peeled=plan.peeled, weight=plan.weight, knife_slices=plan.knife_slices
    )
    return scenario


def _in_reach(position: Sequence[float], scenario: Scenario) -> bool:
    """Whether the station's arm reaches a place."""
    away = np.array(position) - scenario.robot.base_position
    low, high = REACH
    return bool(low <= np.hypot(*away[:2]) <= high and abs(away[2]) <= low)
