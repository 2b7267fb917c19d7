"""A cut beside the middle of the food, and oblique, is where the record of it says."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.motion import ConstantSpeed, MotionPlan
from sliceit_drake.diagnosis.diagnose import setup_of_food
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.experiments.planned_record import experiment_of_record, planned_slice
from sliceit_drake.diagrams.planned_scenario import scenario_of_slice
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Placement
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import Condition, Protocol
from sliceit_drake.stand_in.session import Session
from studies.hidden_effects.quiet import without_noise


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    food = Food(
        shape=Box(size=[0.03, 0.06, 0.02]), cut_point=[4e-3, 8e-3, 0.0], cut_normal=[-0.2, 0.98, 0]
    )
    press = MotionPlan([ConstantSpeed(speed=0.02, distance=0.012, label="slice")])
    return without_noise(
        Protocol(
            food=food,
            placement=Placement(position=[0.5, 0.1], yaw=0.4),
            conditions=[Condition(motion=press, replicates=1, offset=5e-3)],
        )
    )


def test_the_prediction_finds_the_cut_where_the_record_says_that_it_was(protocol):
    record = Session(protocol, settings=FiniteElementSettings(refinement=0.5)).record(0)
    setup = setup_of_food(CalibratedFood(food=protocol.food, knife=protocol.knife), 0.5)
    (found,) = sensitivities(setup, [record], [], finer=None, workers=1).records
    inside = found.depth > 4e-3
    assert np.abs(found.measured[inside]).max() > 3.0
    off = np.sqrt((found.residual[inside] ** 2).mean() / (found.measured[inside] ** 2).mean())
    assert off < 0.05
    moved = dc.replace(record, position=record.position + [0.0, 0.0, 2e-3])
    (high,) = sensitivities(setup, [moved], [], finer=None, workers=1).records
    assert np.abs(high.residual).max() > 4.0 * np.abs(found.residual).max()


def test_a_record_is_cut_again_at_the_same_place(protocol):
    record = Session(protocol, settings=FiniteElementSettings(refinement=0.5)).record(0)
    setup = setup_of_food(CalibratedFood(food=protocol.food, knife=protocol.knife), 0.5)
    experiment = experiment_of_record(record, setup)
    assert experiment.offset == pytest.approx(5e-3, abs=1e-4)
    scenario = scenario_of_slice(planned_slice(experiment, setup, record))
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    start = scenario.X_WF().multiply(start_pose(model, 0.0, experiment.offset).p)
    np.testing.assert_allclose(start[:2], record.position[0, :2], atol=2e-4)
    prepare_run(scenario)
