"""Steps and meshes: what is stable, what is refused, how far the force is from converged."""

import dataclasses as dc

import numpy as np
import pytest
import warp as wp

from sliceit_drake.cutting.discretization import estimate_discretization_error
from sliceit_drake.cutting.foods.effects import Effects, Skin
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.inertia import Factors
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import SOFTEST, CuttingModel, Numerics, TimeStepError
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.cutting.workspace import Workspace
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


@pytest.mark.parametrize("damping_time", [0.0, 4e-6, 2e-4])
@pytest.mark.parametrize("held_sides", ["both", "plus"])
def test_shorter_steps_have_the_same_masses_on_the_way_and_from_the_start(held_sides, damping_time):
    material = dc.replace(SMALL.material, damping_time=damping_time)
    food = dc.replace(SMALL, material=material, held_sides=held_sides)
    coarse = make_food_model(food, Knife(), Numerics())
    for step in (5e-4, 1.25e-4, 3.125e-5):
        direct = coarse.derive(numerics=Numerics(time_step=step)).inertia.matrix
        assert (coarse.with_step(step).inertia.matrix != direct).nnz == 0


class AsOnAGpu(Workspace):
    """Solves with a thread for each row, as on a GPU."""

    def _factors(self, model: CuttingModel) -> Factors:
        return model.inertia.inverted

    def solve(self, b: wp.array, y: wp.array) -> None:
        self.launch(self.kernels.multiply, b.shape, [self.inertia, b, y])


@pytest.mark.parametrize("workspace", [Workspace, AsOnAGpu])
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 5e-6), ("float64", 1e-13)])
@pytest.mark.parametrize("refinement", [0.5, 1.5])
def test_accelerations_solve_the_mass_matrix(precision, tolerance, refinement, workspace):
    model = make_food_model(SMALL, Knife(), Numerics(precision=precision), refinement)
    # The smallest is all inverted.
    assert (len(model.inertia.factors.inverse_pivot) == 0) == (refinement < 1.0)
    ws = workspace([model], 2e-3)
    ws.capture()
    force = np.zeros((1, len(model.moving) + 1, 4))
    force[..., :3] = np.random.default_rng(1).normal(size=(*force.shape[:2], 3))
    ws.write(ws.forces[0].resultant, force)
    ws.launch_part("solve", 0)
    found = ws.read(ws.forces[0].acceleration)[0]
    exact = np.linalg.solve(model.inertia.matrix.toarray(), force[0])
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=tolerance * np.abs(exact).max())


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
    advised = Numerics(edge_spread=float(warning.split("edge_spread: ")[1].rstrip(".")))
    assert make_food_model(dc.replace(SMALL, material=material), Knife(), advised).warnings == ()


def test_a_plate_that_an_edge_presses_onto_the_board_is_warned_of():
    material = Material(youngs_modulus=1e5, toughness=350.0, strength=1e4)
    layers = [0.0, 0.003, 0.013, 0.05]
    thick, thin = (
        Food(shape=Box([0.06, 0.12, height], [8, rows], layers), material=material)
        for height, rows in ((0.03, 8), (0.005, 2))
    )
    (softness,) = make_food_model(thick, Knife(), Numerics()).warnings
    assert "edge_spread" in softness
    for spread in (0.0, 0.01):
        (warning,) = make_food_model(thin, Knife(), Numerics(edge_spread=spread)).warnings
        assert "E is 3.5 mm in a section that is 5 mm high" in warning


def test_a_food_that_may_come_apart_under_its_skin_is_warned_of():
    shape = Box([0.06, 0.12, 0.03], [8, 8], [0.0, 0.003, 0.013, 0.05])
    for load, warned in ((70.0, False), (90.0, True)):
        material = Material(1e6, toughness=40.0, strength=100.0 / 0.03)
        effects = Effects(skin=Skin(1e-3 * load, 1e-3))
        food = Food(shape=shape, material=material, effects=effects)
        texts = make_food_model(food, Knife(), Numerics()).warnings
        assert ["holds 90 N/m, 0.9 times" in text for text in texts] == [True] * warned
