"""Steps and meshes: what is stable, what is refused, how far the force is from converged."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.discretization import estimate_discretization_error
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import SOFTEST, Numerics, TimeStepError
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path

SMALL = Food(
    shape=Cylinder(rings=3, layers=[0.0, 0.004, 0.012]),
    material=Material(toughness=400.0, friction=0.05),
)


def force(food, numerics, refinement=1.0, speed=0.02, distance=0.027):
    """Norm of the food's force over a press cut, and the result."""
    model = make_food_model(food, Knife(), numerics, refinement)
    plan = MotionPlan([ConstantSpeed(distance=distance, speed=speed, acceleration=None)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    result = simulate_slice(CuttingSolver(model, 2e-3), motion)
    return np.linalg.norm(result.food_wrench[:, 3:], axis=1), result


def relative_rms(a, b):
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))


def test_halving_the_default_step_changes_the_force_by_less_than_two_percent():
    default = Numerics().time_step
    whole, _ = force(SMALL, Numerics())
    half, _ = force(SMALL, Numerics(time_step=0.5 * default))
    assert 0.0 < relative_rms(whole, half) < 0.02


def test_scaled_masses_give_the_force_of_the_true_ones():
    # A short cut: true masses need steps of about 1e-5 s.
    scaled, _ = force(SMALL, Numerics(), distance=0.006)
    model = make_food_model(SMALL, Knife(), Numerics())
    step = 2e-3 / np.ceil(2e-3 / (0.99 * model.critical_time_step))
    true, result = force(SMALL, Numerics(time_step=step, mass_scaling=False), distance=0.006)
    assert step < 3e-5
    assert result.energy_ratio < 1e-4
    assert relative_rms(scaled, true) < 0.02


def test_a_step_beyond_the_limit_is_refused_with_the_limit():
    limit = make_food_model(SMALL, Knife(), Numerics()).critical_time_step
    with pytest.raises(TimeStepError, match=r"numerics\.time_step.*stability limit.*Give at most"):
        make_food_model(SMALL, Knife(), Numerics(time_step=1.01 * limit, mass_scaling=False))
    make_food_model(SMALL, Knife(), Numerics(time_step=0.99 * limit, mass_scaling=False))


def test_double_precision_agrees_with_single():
    single, _ = force(SMALL, Numerics(), distance=0.01)
    double, _ = force(SMALL, Numerics(precision="float64"), distance=0.01)
    assert 0.0 < relative_rms(single, double) < 1e-3


@pytest.fixture(scope="module")
def cucumber():
    return load_scenario(resource_path("scenarios/cucumber_measured.yaml"))


def test_estimated_error_of_the_default_mesh_is_at_most_three_percent_and_honest(cucumber):
    model = make_food_model(cucumber.food, cucumber.knife, cucumber.numerics)
    plan = MotionPlan([ConstantSpeed(distance=0.027, speed=0.02, acceleration=None)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    estimate = estimate_discretization_error(
        cucumber.food, cucumber.knife, cucumber.numerics, 2e-3, motion
    )
    assert 0.0 < estimate.relative_rms <= 0.03

    default, _ = force(cucumber.food, cucumber.numerics)
    fine, _ = force(cucumber.food, cucumber.numerics, refinement=2.0)
    assert relative_rms(default, fine) <= 0.03
    # Neither rosy nor scaremongering.
    assert (
        relative_rms(default, fine) / 3.0
        < estimate.relative_rms
        < 3.0 * relative_rms(default, fine)
    )


def test_a_food_too_soft_for_its_mesh_is_warned_of():
    h = make_food_model(SMALL, Knife(), Numerics()).element_size
    warnings = {}
    for softness in (0.9 * SOFTEST, 1.1 * SOFTEST):
        material = dc.replace(SMALL.material, youngs_modulus=400.0 / (softness * h), strength=1e4)
        warnings[softness > SOFTEST] = make_food_model(
            dc.replace(SMALL, material=material), Knife(), Numerics()
        ).warnings
    assert warnings[False] == ()
    (warning,) = warnings[True]
    assert f"toughness in the food over E h is {1.1 * SOFTEST:.2g}" in warning
