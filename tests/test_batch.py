"""Many slices in one call are the slices one by one."""

import types

import numpy as np
import pytest

from sliceit_drake.cutting.batch import BatchSlice, cut_together, simulate_batch
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import Driver, Launch
from sliceit_drake.cutting.foods.effects import Compliance, Effects, Relaxation
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.inertia import Inertia
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan, PressAndDraw
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

PERIOD = 2e-3
BOARD = Board(height=1e-3, stiffness=1e4)


@pytest.fixture(scope="module")
def models() -> list[CuttingModel]:
    food = Food(shape=Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3]), material=Material(friction=0.1))
    base = make_food_model(food, Knife(), Numerics())
    return [
        base,
        with_parameters(base, {"material.youngs_modulus": 1.5e6, "material.friction": 0.3}),
        base.derive(effects=Effects(relaxation=Relaxation([0.3], [0.05]))),
        base.derive(effects=Effects(compliance=Compliance(arm=1e-5))),
    ]


@pytest.fixture(scope="module")
def motions(models) -> list[Motion]:
    start = start_pose(models[0], 1e-3)
    press = MotionPlan([ConstantSpeed(distance=0.028, speed=0.1)])
    draw = MotionPlan([PressAndDraw(press_speed=0.05, distance=0.01, draw_ratio=1.0)])
    return [Motion(plan, start) for plan in (press, draw, press, press)]


@pytest.fixture(scope="module")
def one_by_one(models, motions) -> list[np.ndarray]:
    out = []
    for model, motion in zip(models, motions, strict=True):
        result = simulate_slice(CuttingSolver(model, PERIOD), motion, BOARD)
        out.append(np.hstack([result.position, result.food_wrench, result.board_wrench]))
    return out


def table(result: BatchSlice) -> np.ndarray:
    return np.hstack([result.position, result.food_wrench, result.board_wrench])


@pytest.mark.parametrize("workers", [1, 3])
def test_each_slice_of_a_batch_is_the_slice_alone(models, motions, one_by_one, workers):
    done = []
    results = simulate_batch(models, motions, PERIOD, BOARD, workers, done.append)
    for result, alone in zip(results, one_by_one, strict=True):
        np.testing.assert_array_equal(table(result), alone)
        assert result.failure is None
    assert results[0].board_wrench[:, 5].max() > 1.0
    assert done == sorted(done) and done[-1] == len(models)


def test_cuts_side_by_side_are_the_cuts_alone(models, motions, one_by_one):
    # As on a GPU; the second motion is shorter.
    results = cut_together(Driver(PERIOD), models[:2], motions[:2], BOARD)
    for result, alone in zip(results, one_by_one, strict=False):
        np.testing.assert_array_equal(table(result), alone)


@pytest.mark.parametrize(("speed", "together"), [(0.02, 25), (0.045, 10), (0.1, 5), (0.11, 1)])
def test_a_slice_is_the_same_however_many_coupling_steps_are_launched_at_once(
    models, speed, together
):
    plan = MotionPlan([ConstantSpeed(distance=0.02, speed=speed, acceleration=None)])
    path = KnifePath(models[2], Motion(plan, start_pose(models[2], 1e-3)), PERIOD)
    alone = [Launch(k, 1) for k in range(path.coupling_steps)]
    launched = [list(Driver(PERIOD).run([path], each, BOARD)) for each in (alone, None)]
    one_by_one, at_once = [
        np.concatenate([step.wrenches for _, (step,) in run]) for run in launched
    ]
    np.testing.assert_array_equal(at_once, one_by_one)
    for run in launched:
        np.testing.assert_array_equal(run[-1][1][0].state, launched[0][-1][1][0].state)
    assert max(launch.coupling_steps for launch, _ in launched[1]) == together
    firsts = [launch.first for launch, _ in launched[1]]
    counts = [launch.coupling_steps for launch, _ in launched[1]]
    np.testing.assert_array_equal(np.cumsum([0, *counts[:-1]]), firsts)
    assert sum(counts) == path.coupling_steps


def test_a_slice_that_breaks_down_is_reported_and_disturbs_no_other(models, motions, one_by_one):
    def light(step: float) -> types.SimpleNamespace:
        return types.SimpleNamespace(
            inertia=Inertia(models[0].with_step(step).inertia.matrix * 1e-3)
        )

    # Thirty times the critical step.
    broken = models[0].derive(inertia_of=types.SimpleNamespace(with_step=light))
    results = simulate_batch([broken, models[0]], motions[:1], PERIOD, BOARD)
    assert results[0].failure is not None
    assert "not finite" in results[0].failure
    assert np.isnan(results[0].food_wrench[-1]).all()
    np.testing.assert_array_equal(table(results[1]), one_by_one[0])
    together = cut_together(Driver(PERIOD), [broken, models[0]], [motions[0]] * 2, BOARD)
    assert together[0].failure == results[0].failure
    np.testing.assert_array_equal(table(together[1]), one_by_one[0])


def test_numbers_of_models_and_motions_must_agree(models, motions):
    with pytest.raises(ValueError, match="4 models and 2 motions"):
        simulate_batch(models, motions[:2], PERIOD)


def test_a_workspace_refuses_cuts_of_another_mesh(models):
    other = make_food_model(Food(shape=Cylinder(rings=3)), Knife(), Numerics())
    with pytest.raises(ValueError, match="derived from one model"):
        Driver(PERIOD).workspace([models[0], other])
