"""Coulomb friction on the flanks: it holds below the limit, slips above, and opposes the motion."""

import numpy as np
import pytest

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Pose, Retract
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from studies.physics.contact_convergence import contact_force

FRICTION = 0.2


@pytest.fixture(scope="module")
def pressed():
    """A knife 15 mm deep in a bar that has no toughness, so that only the flanks act."""
    food = Food(
        shape=Box(size=[0.02, 0.1, 0.03], divisions=[4, 6], layers=[0.0, 0.004, 0.012]),
        material=Material(toughness=0.0, friction=FRICTION),
    )
    model = make_food_model(food, Knife(length=0.3), Numerics())
    solver = CuttingSolver(model, 2e-3)
    plan = MotionPlan(
        [ConstantSpeed(distance=0.0155, speed=0.02, acceleration=0.5), Hold(duration=0.4)]
    )
    result = simulate_slice(solver, Motion(plan, start_pose(model, clearance=5e-4)))
    return solver, result


def settle(solver, state, pose, coupling_steps):
    """Mean force on the knife over the last ten of some coupling steps at rest, and the state."""
    forces = []
    for _ in range(coupling_steps):
        step = solver.coupling_step(state, pose, pose)
        state = step.state
        forces.append(step.wrenches[0, 2, 3:])
    return np.mean(forces[-10:], axis=0), state


def displaced(pose, metres):
    return Pose(pose.R, pose.p + np.array([metres, 0.0, 0.0]))


def drag(solver, state, pose, distance, coupling_steps=25):
    """Draws the knife along its edge and lets the food settle."""
    for k in range(coupling_steps):
        a, b = (
            displaced(pose, distance * k / coupling_steps),
            displaced(pose, distance * (k + 1) / coupling_steps),
        )
        state = solver.coupling_step(state, a, b).state
    return settle(solver, state, displaced(pose, distance), 150)


def slip_force(solver, result):
    """Friction along the edge when it slides fully."""
    force, _ = drag(solver, result.state, result.pose, 2e-3)
    return abs(force[0])


def test_sliding_friction_is_mu_times_the_normal_force(pressed):
    solver, result = pressed
    state, pose = result.state, result.pose
    for k in range(100):
        a, b = displaced(pose, 4e-5 * k), displaced(pose, 4e-5 * (k + 1))
        step = solver.coupling_step(state, a, b)
        state = step.state
    # Both flanks press with the lateral fraction of the wedge's force; take the mean from its
    # vertical component: N = F_z / sin(half angle), for both together.
    knife = solver.model.knife
    slope = 0.5 * (knife.spine_thickness - knife.edge_thickness) / knife.height
    _, pressure, friction = step.wrenches[0]
    normal = pressure[5] * np.hypot(1.0, slope) / slope
    assert abs(friction[3]) == pytest.approx(FRICTION * normal, rel=0.05)


def test_below_the_slip_load_a_hold_does_not_creep(pressed):
    solver, result = pressed
    limit = slip_force(solver, result)
    # A draw that loads the anchors to about 0.9 of the limit.
    low, high = 0.0, 2e-3
    for _ in range(12):
        middle = 0.5 * (low + high)
        force, state = drag(solver, result.state, result.pose, middle)
        low, high = (middle, high) if abs(force[0]) < 0.9 * limit else (low, middle)
    force, state = drag(solver, result.state, result.pose, low)
    assert 0.8 * limit < abs(force[0]) < 0.95 * limit

    pose = displaced(result.pose, low)

    def mean_positions(state, coupling_steps=50):
        """Mean over a tenth of a second, so that what still rings does not count as creep."""
        positions = []
        for _ in range(coupling_steps):
            state = solver.coupling_step(state, pose, pose).state
            positions.append(solver.positions(state).astype(float))
        return np.mean(positions, axis=0), state

    duration = 0.5
    before, state = mean_positions(state)
    later, state = settle(solver, state, pose, round(duration / solver.exchange_period) - 50)
    after, state = mean_positions(state)
    assert np.abs(after - before).max() / duration < 1e-6
    assert later == pytest.approx(force, rel=1e-2, abs=1e-2 * limit)


def test_friction_turns_with_the_motion(pressed):
    solver, result = pressed
    model = solver.model
    plan = MotionPlan(
        [
            ConstantSpeed(distance=0.0155, speed=0.02, acceleration=0.5),
            Retract(distance=0.012, speed=0.02, acceleration=0.5),
        ]
    )
    whole = simulate_slice(solver, Motion(plan, start_pose(model, clearance=5e-4)))
    turn = 0.0155 / 0.02
    down = whole.friction[(whole.time > 0.6 * turn) & (whole.time < 0.9 * turn), 2]
    up = whole.friction[(whole.time > 1.3 * turn) & (whole.time < 1.6 * turn), 2]
    assert down.min() > 0.0
    assert up.max() < 0.0


def slow_friction(static_friction, step):
    """Friction over normal force of a knife that slides in at 2 mm/s."""
    material = Material(
        toughness=0.0,
        friction=FRICTION,
        static_friction=static_friction,
        stribeck_velocity=0.01,
    )
    shape = Box(size=[0.02, 0.1, 0.03], divisions=[4, 6], layers=[0.0, 0.006, 0.012])
    food = Food(shape=shape, material=material)
    model = make_food_model(food, Knife(length=0.3), Numerics(time_step=step))
    plan = MotionPlan([ConstantSpeed(distance=0.0025, speed=2e-3)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    result = simulate_slice(CuttingSolver(model, 2e-3), motion)
    deep = result.position[:, 2] < 0.03 - 1e-3
    return result.friction[deep, 2].mean() / result.normal[deep, 2].mean()


@pytest.mark.parametrize("step", [1e-3, 2.5e-4, 5e-5])
def test_static_friction_does_not_depend_on_the_sub_step(step):
    ratio = slow_friction(2.0 * FRICTION, step) / slow_friction(0.0, 1e-3)
    assert ratio == pytest.approx(1.0 + np.exp(-0.2), rel=0.02)


@pytest.mark.parametrize("held", ["both", "plus"])
def test_force_converges_with_the_contact_and_with_the_mesh(held):
    shape = Cylinder(rings=3, layers=[0.0, 0.004, 0.012])
    material = Material(youngs_modulus=6e5, toughness=240.0, friction=0.3)
    food = Food(shape=shape, material=material, held_sides=held)
    default = contact_force(food)
    assert default.friction > 0.2 * default.total
    stiffer, finer = contact_force(food, stiffness=4.0), contact_force(food, refinement=2.0)
    assert stiffer.total == pytest.approx(default.total, rel=0.02)
    # The mesh is coarser than the default one, which is within 2 % (docs/results/contact.md).
    assert finer.total == pytest.approx(default.total, rel=0.04)
