"""Energy balance of a cut: what the knife puts in is stored or goes somewhere."""

import numpy as np
import pytest

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    Motion,
    MotionPlan,
    Pose,
    PressAndDraw,
    Retract,
)
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from studies.disect.contact_sums import contact_forces

SHAPE = Cylinder(rings=3, layers=[0.0, 0.004, 0.012])
LOSSES = ("edge", "opening", "friction", "board_friction", "blade")

PRESS = [ConstantSpeed(distance=0.0275, speed=0.02, acceleration=None)]
MOTIONS = {
    "press": PRESS,
    "press, hold, retract": [
        *PRESS,
        Hold(duration=0.1),
        Retract(distance=0.04, speed=0.05, acceleration=0.5),
    ],
    "draw to and fro": [
        PressAndDraw(distance=0.0275, press_speed=0.02, amplitude=0.01, frequency=2.0)
    ],
    "two passes": [
        ConstantSpeed(distance=0.015, speed=0.03, acceleration=0.5),
        Retract(distance=0.01, speed=0.03, acceleration=0.5),
        ConstantSpeed(distance=0.0225, speed=0.03, acceleration=0.5),
    ],
}


def run(segments, exchange_period=2e-3, **material):
    food = Food(shape=SHAPE, material=Material(**{"toughness": 400.0, "friction": 0.1} | material))
    numerics = Numerics(time_step=min(Numerics().time_step, exchange_period))
    solver = CuttingSolver(model := make_food_model(food, Knife(), numerics), exchange_period)
    motion = Motion(MotionPlan(list(segments)), start_pose(model, clearance=5e-4))
    return model, solver, motion


@pytest.mark.parametrize("name", MOTIONS)
def test_the_energy_balance_closes(name):
    model, solver, motion = run(MOTIONS[name])
    result = simulate_slice(solver, motion)
    assert abs(result.balance.residual(result.energies)) < 0.01 * result.balance.work


def test_knife_work_less_everything_else_is_toughness_times_area():
    model, solver, motion = run(PRESS)
    result = simulate_slice(solver, motion)
    balance, energies = result.balance, result.energies
    # The knife's work from forces and path alone.
    moved = np.diff(np.vstack([motion.pose(0.0).p, result.position]), axis=0)
    work = -float((result.food_wrench[:, 3:] * moved).sum())
    stored = energies.elastic + energies.interface + energies.kinetic
    elsewhere = balance.opening + balance.friction + balance.board_friction + balance.blade
    net = work + balance.gravity - stored - elsewhere - balance.damping(energies)
    assert net == pytest.approx(400.0 * model.section_area, rel=0.03)


@pytest.mark.parametrize("name", ["press, hold, retract", "draw to and fro"])
def test_no_mechanism_gives_energy_back_in_any_sub_step(name):
    _, solver, motion = run(MOTIONS[name], exchange_period=2.5e-4, static_friction=0.15)
    model, T = solver.model, solver.exchange_period
    R = model.X_FC_rotation

    def pose(t):
        X = motion.pose(t)
        return X._replace(R=R.T @ X.R, p=model.to_cut_frame(X.p))

    state, last = solver.initial_state(), pose(0.0)
    losses = []
    for k in range(round(motion.duration / T)):
        now = pose((k + 1) * T)
        step = solver.coupling_step(state, last, now)
        state, last = step.state, now
        losses.append([getattr(step.balance, name) for name in LOSSES])
    losses = np.array(losses)
    # Below zero only by the rounding of single precision.
    assert losses.min() > -1e-7 * losses.sum()
    assert losses[:, 0].sum() == pytest.approx(400.0 * model.section_area, rel=0.03)
    assert losses[:, 2].sum() > 0.01 * losses[:, 0].sum()


def test_a_second_pass_through_the_open_cut_does_no_work_of_cutting():
    _, solver, motion = run(
        [
            ConstantSpeed(distance=0.0275, speed=0.03, acceleration=0.5),
            Retract(distance=0.03, speed=0.05, acceleration=0.5),
            ConstantSpeed(distance=0.03, speed=0.03, acceleration=0.5),
        ],
        friction=0.0,
    )
    result = simulate_slice(solver, motion)
    again = (result.time > 1.75) & (result.position[:, 2] > 0.003)
    assert np.count_nonzero(again) > 100
    assert np.abs(result.edge[again, 2]).max() < 0.02 * result.edge[:, 2].max()


@pytest.fixture(scope="module")
def parted():
    """A bar cut through, the knife back up in the cut: only the flanks act, on each half alone."""
    food = Food(shape=Box([0.02, 0.04, 0.015], [4, 4], [0.0, 0.004]), held_sides="minus")
    model = make_food_model(food, Knife(), Numerics(precision="float64"))
    solver = CuttingSolver(model, Numerics().time_step)
    start = start_pose(model, clearance=-0.010)
    pose = Pose(model.X_FC_rotation.T @ start.R, model.to_cut_frame(start.p))
    state = solver.initial_state()
    solver.field(state, "edge_depth")[:] = model.tables.reach
    solver.field(state, "cohesive_damage")[:] = 1.0

    def at(shift):
        """Forces on the knife [P, 2, 3] and energy with the half that is cut off moved [3]."""
        moved = state.copy()
        x = solver.field(moved, "x").reshape(-1, 3)
        x[np.unique(model.point_nodes[:, 2:])] += shift
        return contact_forces(solver, moved, pose, pose), solver.energies(moved, pose).interface

    return at


@pytest.mark.parametrize("end", [(0.0, 0.0, 0.004), (0.0, 3e-4, 0.008)])
def test_what_a_half_takes_from_the_flanks_is_their_energy_wherever_it_goes(parted, end):
    path = np.linspace(np.zeros(3), end, 41)
    forces, energies = zip(*map(parted, path), strict=True)
    on_half = -np.array(forces)[:, :, 1].sum(1)
    work = float((0.5 * (on_half[1:] + on_half[:-1]) * np.diff(path, axis=0)).sum())
    assert np.ptp(energies) > 5e-4
    assert energies[0] - energies[-1] == pytest.approx(work, rel=1e-3)


def test_a_half_that_goes_away_leaves_the_flank_on_the_other_as_it_was(parted):
    (both, _), (one, _) = parted(np.zeros(3)), parted(np.array([0.0, 0.05, 0.03]))
    assert np.linalg.norm(both[:, 1], axis=1).max() > 0.1
    assert np.linalg.norm(one[:, 1], axis=1).max() == 0.0
    np.testing.assert_allclose(one[:, 0], both[:, 0], rtol=1e-9, atol=1e-9)
