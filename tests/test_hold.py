"""A knife at rest in the food, and food at rest on the board: nothing moves, nothing relaxes."""

import numpy as np
import pytest

from sliceit_drake.cutting.coupling_steps import CouplingSteps
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Pose, Retract
from sliceit_drake.cutting.solver import CuttingSolver

PERIOD = 2e-3
SHAPE = Cylinder(rings=3, layers=[0.0, 0.004, 0.012])


def follow(
    segments: list, food: Food, time_step: float, **numerics
) -> tuple[CuttingSolver, list[CouplingSteps], np.ndarray, list[Pose]]:
    """The coupling steps along a path, the positions of the nodes after each, and the poses in
    C."""
    model = make_food_model(food, Knife(), Numerics(time_step=time_step, **numerics))
    solver = CuttingSolver(model, PERIOD)
    motion = Motion(MotionPlan(segments), start_pose(model, clearance=5e-4))
    R = model.X_FC_rotation.T
    times = PERIOD * np.arange(round(motion.duration / PERIOD) + 1)
    poses = [Pose(R @ X.R, model.to_cut_frame(X.p)) for X in map(motion.pose, times)]
    state = solver.initial_state()
    coupling_steps, positions = [], []
    for start, end in zip(poses[:-1], poses[1:], strict=True):
        coupling_steps.append(solver.coupling_step(state, start, end))
        state = coupling_steps[-1].state
        positions.append(solver.positions(state).astype(float))
    return solver, coupling_steps, np.array(positions), poses


@pytest.mark.parametrize("friction", [0.0, 0.1])
@pytest.mark.parametrize("time_step", [2e-4, 5e-5])
def test_a_hold_after_a_press_neither_creeps_nor_relaxes(friction, time_step):
    food = Food(shape=SHAPE)
    food.material.friction = friction
    hold = 0.5
    press = ConstantSpeed(distance=0.012, speed=0.02)
    # In double precision: single rounds to a vibration of 1e-9 of the elastic energy.
    solver, coupling_steps, positions, poses = follow(
        [press, Hold(duration=hold)], food, time_step, precision="float64"
    )

    vertical = np.array([step.wrench[5] for step in coupling_steps])
    resting = round(hold / PERIOD)
    at_stop, late, end = vertical[-resting], vertical[-resting // 2], vertical[-1]
    assert at_stop > 5.0
    assert late == pytest.approx(at_stop, rel=0.01)
    assert end == pytest.approx(late, rel=1e-3)
    creep = np.abs(positions[-1] - positions[-resting // 2]).max() / (0.5 * hold)
    assert creep < 1e-6

    # Nothing feeds a vibration: what rings at the sudden stop dies away.
    held = coupling_steps[-resting:]
    kinetic = np.array([solver.energies(step.state, poses[-1]).kinetic for step in held])
    by_50_ms = kinetic.reshape(-1, 25).max(axis=1)
    assert by_50_ms[-1] < 1e-4 * by_50_ms[0]
    assert (np.diff(by_50_ms) < 0.0).all()


def test_halves_that_are_not_held_come_to_rest_on_the_board_with_their_weight():
    segments = [
        ConstantSpeed(distance=0.0278, speed=0.02, acceleration=0.5),
        Retract(distance=0.03, speed=0.05, acceleration=0.5),
        Hold(duration=1.0),
    ]
    food = Food(shape=SHAPE, held_sides="none")
    solver, coupling_steps, positions, _ = follow(segments, food, 2e-4)
    weight = -solver.model.weight[solver.model.moving].sum(0)[2]
    on_board = np.mean([step.board_force[2] for step in coupling_steps[-100:]])
    assert coupling_steps[-1].cut == pytest.approx(1.0, abs=0.01)
    assert weight == pytest.approx(950.0 * 9.81 * np.pi * 0.0135**2 * 0.12, rel=1e-3)
    assert on_board == pytest.approx(weight, rel=0.03)
    # The halves stand apart, neither sunk into the board nor lifted off it; they may roll.
    rise = positions[-1, :, 2] - positions[0, :, 2]
    side = solver.model.split.node_side[solver.model.computed]
    assert max(abs(rise[side == half].mean()) for half in (0, 1)) < 5e-4
    nodes = solver.model.point_nodes
    gap = positions[-1, nodes[:, 2], 1] - positions[-1, nodes[:, 0], 1]
    assert gap.mean() > 0.0


def test_the_force_on_the_way_out_pulls_the_knife_back_and_ends_outside():
    segments = [
        ConstantSpeed(distance=0.015, speed=0.02, acceleration=0.5),
        Retract(distance=0.02, speed=0.02, acceleration=0.5),
        Hold(duration=0.05),
    ]
    _, coupling_steps, _, poses = follow(segments, Food(shape=SHAPE), 5e-4)
    height = np.array([pose.p[2] for pose in poses[1:]])
    vertical = np.array([step.wrench[5] for step in coupling_steps])
    edge = np.array([step.wrenches[0, 0, 5] for step in coupling_steps])
    deepest = int(height.argmin())
    inside = np.arange(len(height)) > deepest
    inside &= (height > height.min() + 1e-3) & (height < height.min() + 8e-3)
    assert vertical[inside].max() < 0.0
    assert np.abs(edge[inside]).max() == 0.0
    assert np.abs(vertical[-5:]).max() == 0.0


def test_a_sudden_stop_from_high_speed_gives_the_force_of_small_steps():
    segments = [ConstantSpeed(distance=0.012, speed=0.1), Hold(duration=0.06)]
    held = round(0.06 / PERIOD)

    def force(time_step: float, **numerics) -> np.ndarray:
        _, coupling_steps, _, _ = follow(segments, Food(shape=SHAPE), time_step, **numerics)
        return np.array([step.wrench[5] for step in coupling_steps[-held:]])

    reference = force(5e-5)

    def error(time_step: float, **numerics) -> float:
        difference = force(time_step, **numerics) - reference
        return float(np.sqrt(np.mean(difference**2)) / reference.mean())

    assert error(1e-3) < 0.01 < error(1e-3, step_by_need=False)


@pytest.mark.parametrize(
    ("held_sides", "poisson_ratio", "damping_time"),
    [("none", 0.45, 4e-6), ("plus", 0.48, 4e-6), ("plus", 0.37, 1e-3), ("none", 0.37, 1e-3)],
)
def test_a_food_with_a_free_half_rests_at_the_longest_step(held_sides, poisson_ratio, damping_time):
    # A free part may dilate as a whole, which no other part of the food resists.
    food = Food(shape=SHAPE, held_sides=held_sides, hold_distance=0.03)
    food.material.youngs_modulus = 6e5
    food.material.poisson_ratio, food.material.damping_time = poisson_ratio, damping_time
    solver, coupling_steps, _, poses = follow([Hold(duration=0.3)], food, 1e-3)
    kinetic = [solver.energies(coupling_steps[k].state, poses[0]).kinetic for k in (4, 9, 99, 149)]
    assert 0.0 < kinetic[-1] < 0.2 * max(kinetic[:2])
