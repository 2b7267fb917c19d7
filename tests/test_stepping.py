"""Inertia that is added for longer sub-steps, and sub-steps that the knife's motion asks for."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse import kron

from sliceit_drake.cutting.batch import cut_together
from sliceit_drake.cutting.coupling_steps import CouplingSteps
from sliceit_drake.cutting.driver import Driver, Launch
from sliceit_drake.cutting.foods.effects import Compliance, Effects, Skin
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.inertia import Inertia, assemble
from sliceit_drake.cutting.kernels.layouts import Planned
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Pose, Retract
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.cutting.stepping import CALM, FINEST, STEPPING, Stepping
from sliceit_drake.cutting.workspace import Workspace

PERIOD = 2e-3
UP = np.diag([1.0, -1.0, -1.0])


def cut(held_sides: str = "both", effects: Effects | None = None, **numerics) -> CuttingModel:
    food = Food(
        shape=Cylinder(rings=3, layers=[0.0, 0.004, 0.012]),
        material=Material(toughness=400.0, friction=0.1),
        held_sides=held_sides,
        effects=effects or Effects(),
    )
    return make_food_model(food, Knife(), Numerics(**numerics))


def down_and_back(model: CuttingModel, speed: float, acceleration: float | None = None) -> Motion:
    segments = [
        ConstantSpeed(distance=0.012, speed=speed, acceleration=acceleration),
        Retract(distance=0.004, speed=speed, acceleration=acceleration),
    ]
    return Motion(MotionPlan(segments), start_pose(model, clearance=5e-4))


def force(model: CuttingModel, motion: Motion) -> tuple[np.ndarray, SliceResult]:
    result = simulate_slice(CuttingSolver(model, PERIOD), motion)
    return result.food_wrench[:, 3:], result


def test_the_factors_solve_the_mass_matrix_on_the_device():
    model = cut(precision="float64")
    ws = Workspace([model], PERIOD)
    count = len(model.moving) + 1
    b = np.random.default_rng(0).normal(size=(count, 3))
    ws.write(ws.forces[0].resultant, np.hstack([b, np.zeros((count, 1))])[None])
    ws.launch_part("solve", 0)
    y = ws.read(ws.forces[0].acceleration)[0, :, :3]
    np.testing.assert_allclose(model.inertia.matrix @ y, b, atol=1e-9)


def test_where_the_factors_have_entries_depends_on_the_mesh_alone():
    model = cut()
    still = model.derive(
        material=Material(youngs_modulus=2e5, toughness=10.0),
        numerics=Numerics(time_step=1e-5, flank_length=0.1, bond_stiffness=0.01),
    )
    for name in ("lower_start", "lower_index", "upper_start", "upper_index"):
        some = (getattr(each.inertia.factors, name) for each in (model, still))
        np.testing.assert_array_equal(*some)


def test_entries_that_cancel_keep_their_place_in_the_factors():
    def matrix(coupling: float) -> Inertia:
        blocks = [np.array([[[2.0, c], [c, 2.0]]]) for c in (0.5, coupling)]
        four = [(np.array([[0, 1]]), b) for b in blocks] + [(np.array([[1, 2]]), blocks[0])]
        return Inertia(assemble(np.arange(3), four, np.ones(3)))

    one, other = matrix(-0.5), matrix(0.1)
    assert one.matrix.nnz == other.matrix.nnz
    shapes = [[part.shape for part in vars(each.factors).values()] for each in (one, other)]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize("step", [2.5e-4, 1e-3])
def test_no_frequency_of_the_food_at_rest_is_beyond_what_the_step_follows(step):
    model = cut(time_step=step, precision="float64", board_friction=0.0)
    exact = CuttingSolver(model.derive(numerics=numerics_of(model, 1e-9)), 1e-9)
    far = Pose(UP, np.array([0.0, 0.0, 1.0]))
    rest, size = exact.initial_state(), 1e-9

    def forces(state: np.ndarray) -> np.ndarray:
        new = exact.coupling_step(state, far, far).state
        change = (exact.velocities(new) - exact.velocities(state))[model.moving]
        return (exact.model.inertia.of_nodes @ change / 1e-9).ravel()

    columns = []
    for node in model.moving:
        for axis in range(3):
            moved = [rest.copy(), rest.copy()]
            for state, shift in zip(moved, (size, -size), strict=True):
                exact.positions(state)[node, axis] += shift
            columns.append((forces(moved[1]) - forces(moved[0])) / (2.0 * size))
    stiffness = np.array(columns)
    stiffness = 0.5 * (stiffness + stiffness.T)
    inertia = kron(model.inertia.of_nodes, np.eye(3)).toarray()
    highest = eigh(stiffness, inertia, eigvals_only=True, subset_by_index=[len(inertia) - 1] * 2)
    damping = 1.0 + 2.0 * model.numerics.numerical_damping
    stable = 4.0 / (damping * step**2)
    assert 0.2 * stable < float(highest[0]) < stable


def numerics_of(model: CuttingModel, step: float) -> Numerics:
    numerics = Numerics(**vars(model.numerics))
    numerics.time_step, numerics.mass_scaling = step, False
    return numerics


def test_a_translation_away_from_the_cut_keeps_its_true_mass_and_a_rotation_does_not():
    model = cut(held_sides="none")
    contact = np.unique(model.point_nodes)
    free = ~np.isin(model.moving, contact) & (model.board_area[model.moving] == 0.0)
    assert free.any()
    stepped, true = model.inertia.of_nodes @ np.ones(len(free)), model.true_mass[model.moving]
    np.testing.assert_allclose(stepped[free], true[free], rtol=1e-6)
    # Turned about the axis of the cylinder.
    turn = model.nodes[model.moving][:, 2]
    assert turn @ model.inertia.of_nodes @ turn > 2.0 * (true @ turn**2)


@pytest.mark.parametrize(("speed", "acceleration"), [(0.02, None), (0.1, None), (0.1, 2.0)])
def test_a_knife_that_turns_round_feels_the_force_of_small_steps(speed, acceleration):
    model = cut(time_step=1e-3)
    motion = down_and_back(model, speed, acceleration)
    reference, _ = force(cut(time_step=4e-5), motion)

    def errors(model: CuttingModel) -> tuple[float, float]:
        difference = np.linalg.norm(force(model, motion)[0] - reference, axis=1)
        size = np.linalg.norm(reference, axis=1)
        rms = float(np.linalg.norm(difference) / np.linalg.norm(size))
        return rms, float(difference.max() / size.max())

    rms, largest = errors(model)
    assert rms < 0.015
    assert largest < 0.1
    assert errors(cut(time_step=1e-3, step_by_need=False))[1] > 0.1


def test_steady_motion_takes_the_longest_steps_and_a_turn_short_ones_for_a_while():
    model = cut(time_step=1e-3)
    path = KnifePath(model, down_and_back(model, 0.02), PERIOD)
    rule = Stepping.of(model, 2)
    numbers, _ = rule.plan(np.zeros(STEPPING), path.R_CK, path.p_CK, PERIOD)
    turn = int(path.p_CK[:, 2].argmin())
    # It meets the food at once, and then goes on.
    assert 2 < max(numbers[: turn // 2])
    assert set(numbers[turn // 2 : turn]) == {2}
    assert numbers[turn] >= 8
    longer = np.flatnonzero(np.diff(numbers[turn:]) < 0)
    assert np.diff(longer).min() > CALM
    assert numbers[-1] == 2


def test_a_steady_draw_takes_the_longest_steps_that_its_way_allows():
    model = cut(time_step=1e-3)
    p = np.array([0.0, 0.0, model.top + 2e-4]) + np.outer(np.arange(60), [2e-4, 0.0, -2e-4])
    R = np.tile(UP, (len(p), 1, 1))
    numbers, _ = Stepping.of(model, 2).plan(np.zeros(STEPPING), R, p, PERIOD)
    assert max(numbers) > 8
    assert set(numbers[30:]) == {8}


@pytest.mark.parametrize("damping_time", [3e-3, 1e-2])
def test_food_with_much_damping_that_is_held_on_both_sides_is_calm_at_short_steps(damping_time):
    model = cut()
    model = model.derive(material=dc.replace(model.material, damping_time=damping_time))
    path = KnifePath(model, press(model), PERIOD)
    short = np.full(path.coupling_steps, FINEST)
    wrenches = [
        np.array([step.wrench[3:] for step in taken(model, numbers)])
        for numbers in (short, short // 4)
    ]
    difference = np.linalg.norm(wrenches[0] - wrenches[1])
    assert difference < 2e-3 * np.linalg.norm(wrenches[0])


def test_in_differences_the_added_inertia_follows_the_modulus():
    """Its force errs in proportion, so that the force scales with the food as it should."""
    name, size = "material.youngs_modulus", 0.02

    def change(model: CuttingModel, fixed: bool) -> np.ndarray:
        ends = []
        for sign in (1.0, -1.0):
            values = {name: model.material.youngs_modulus * np.exp(sign * size)}
            moved = with_parameters(model, values, model if fixed else None)
            ends.append(forces(taken(moved)))
        return (ends[0] - ends[1]) / (2.0 * size)

    true = change(cut(time_step=1e-4, step_by_need=False, precision="float64"), True)
    follows, fixed = (change(cut(precision="float64"), each) for each in (False, True))
    assert np.linalg.norm(follows - true) < 0.04 * np.linalg.norm(true)
    assert np.linalg.norm(fixed - follows) > 0.08 * np.linalg.norm(true)


def test_kinetic_energy_is_that_of_the_sub_steps_that_were_taken():
    by_need, constant = cut(time_step=1e-3), cut(time_step=2.5e-4, step_by_need=False)
    kinetic = []
    for model in (by_need, constant):
        solver = CuttingSolver(model, PERIOD)
        path = KnifePath(model, down_and_back(model, 0.1), PERIOD)
        state = solver.initial_state()
        by_step = []
        for k in range(60):
            state = solver.coupling_step(state, path.pose(k), path.pose(k + 1)).state
            by_step.append(solver.energies(state, path.pose(k + 1)).kinetic)
        # Once sub-steps of 1 ms have become as short as the others.
        kinetic.append(np.mean(by_step[20:]))
    assert kinetic[0] == pytest.approx(kinetic[1], rel=0.1)
    assert kinetic[0] > 0.0


def test_steps_are_the_same_however_many_are_planned_at_once():
    model = cut(time_step=1e-3)
    path = KnifePath(model, down_and_back(model, 0.1, 1.0), PERIOD)
    rule = Stepping.of(model, 2)
    numbers, _ = rule.plan(np.zeros(STEPPING), path.R_CK, path.p_CK, PERIOD)
    state, one_by_one = np.zeros(STEPPING, np.float32), []
    for k in range(path.coupling_steps):
        at = slice(k, k + 2)
        (number,), (after,) = rule.plan(state, path.R_CK[at], path.p_CK[at], PERIOD)
        state[:] = after
        one_by_one.append(number)
    assert len(set(numbers)) > 1
    assert numbers == one_by_one


def test_changing_steps_again_and_again_feeds_no_vibration():
    model = cut(time_step=1e-3)
    solver = CuttingSolver(model, PERIOD)
    rng = np.random.default_rng(3)
    state, p = solver.initial_state(), np.array([0.0, 0.0, model.top + 5e-4])
    R = model.X_FC_rotation.T @ start_pose(model, 0.0).R
    largest, numbers = 0.0, set()
    for _ in range(400):
        # At most times the speed stays, so that steps get longer again.
        if rng.random() < 0.05:
            speed = rng.choice([-0.1, 0.02, 0.1, 0.15])
        else:
            speed = 0.0 if p[2] < model.bottom + 0.005 else 0.01
        after = p - [0.0, 0.0, speed * PERIOD]
        step = solver.coupling_step(state, Pose(R, p), Pose(R, after))
        state, p = step.state, after
        numbers.add(round(PERIOD / float(solver.field(state, "stepping")[Planned.SUB_STEP])))
        largest = max(largest, solver.energies(state, Pose(R, p)).kinetic)
    assert len(numbers) > 3
    pose = Pose(R, p)
    # The added inertia lets food and blade ring sideways for long: their energy halves in 100 ms.
    for _ in range(200):
        state = solver.coupling_step(state, pose, pose).state
    energies = solver.energies(state, pose)
    assert energies.least_volume_ratio > 0.3
    assert largest < 0.01
    assert energies.kinetic < 1e-3 * largest


def test_a_hold_of_ten_seconds_neither_creeps_nor_swings():
    model = cut(time_step=1e-3)
    segments = [ConstantSpeed(distance=0.012, speed=0.05), Hold(duration=10.0)]
    motion = Motion(MotionPlan(segments), start_pose(model, clearance=5e-4))
    vertical = force(model, motion)[0][:, 2]
    held = vertical[-round(9.9 / PERIOD) :]
    assert held[0] > 5.0
    assert np.ptp(held) < 2e-3 * held[0]


# It gives way when the knife is 3 mm deep.
SKIN = Skin(toughness=0.55)


def press(model: CuttingModel) -> Motion:
    return Motion(MotionPlan([ConstantSpeed(distance=0.006, speed=0.02)]), start_pose(model, 5e-4))


def taken(model: CuttingModel, substeps: Sequence[int] | None = None) -> list[CouplingSteps]:
    """The coupling steps of a press one by one."""
    path = KnifePath(model, press(model), PERIOD)
    launches = [Launch(k, 1) for k in range(path.coupling_steps)]
    given = None if substeps is None else [np.array(substeps)]
    run = Driver(PERIOD).run([path], launches, substeps=given)
    return [step for _, (step,) in run]


def forces(steps: list[CouplingSteps]) -> np.ndarray:
    return np.array([step.wrench[3:] for step in steps])


@pytest.fixture(scope="module")
def snap() -> list[CouplingSteps]:
    return taken(cut(effects=Effects(skin=SKIN)))


def test_a_skin_that_gives_way_is_cut_with_short_steps_until_the_food_is_calm(snap):
    skinned = Effects(skin=SKIN)
    plain, model = cut(), cut(effects=skinned)
    path = KnifePath(model, press(model), PERIOD)
    planned, _ = Stepping.of(model, 2).plan(np.zeros(STEPPING), path.R_CK, path.p_CK, PERIOD)
    numbers = np.array([step.substeps for step in snap])
    # The knife's motion alone decides without the skin, and with it until it gives way.
    assert [step.substeps for step in taken(plain)] == planned
    event = int((numbers >= 16).argmax())
    assert event > 40
    assert max(numbers[:event]) == max(planned)
    # Under the skin the food gives along the whole edge, which two sub-steps follow too roughly.
    assert numbers[event - 5 : event].tolist() == [4] * 5
    assert numbers.max() <= FINEST
    assert numbers[-1] <= 4
    true = forces(taken(cut(effects=skinned, time_step=1e-4, step_by_need=False)))
    constant = forces(taken(cut(effects=skinned, step_by_need=False)))
    by_need, without = (np.linalg.norm(f - true) for f in (forces(snap), constant))
    assert by_need < 0.06 * np.linalg.norm(true)
    assert by_need < 0.4 * without


def test_a_discarded_attempt_is_in_no_book_and_its_kinetic_energy_in_no_check():
    model = cut(effects=Effects(skin=SKIN))
    result = simulate_slice(CuttingSolver(model, PERIOD), press(model), check_period=PERIOD)
    assert abs(result.balance.residual(result.energies)) < 5e-3 * result.balance.work
    assert result.energy_ratio < 0.05
    constant = cut(effects=Effects(skin=SKIN), step_by_need=False)
    # More than what is accepted, 5 %.
    with pytest.raises(CuttingError, match="kinetic energy is .* more than 5 %"):
        simulate_slice(CuttingSolver(constant, PERIOD), press(constant), check_period=PERIOD)


def test_a_snap_is_the_same_in_the_station_and_side_by_side_with_other_cuts(snap):
    model = cut(effects=Effects(skin=SKIN))
    solver = CuttingSolver(model, PERIOD)
    path, state = KnifePath(model, press(model), PERIOD), None
    for k, expected in enumerate(snap):
        state = solver.initial_state() if state is None else state
        step = solver.coupling_step(state, path.pose(k), path.pose(k + 1))
        np.testing.assert_array_equal(step.state, expected.state)
        assert step.substeps == expected.substeps
        state = step.state
    tougher = model.derive(effects=Effects(skin=Skin(toughness=0.6)))
    alone, other = (cut_together(Driver(PERIOD), [m], [press(m)])[0] for m in (model, tougher))
    both = cut_together(Driver(PERIOD), [model, tougher], [press(model)] * 2)
    for one, beside in zip((alone, other), both, strict=True):
        np.testing.assert_array_equal(one.food_wrench, beside.food_wrench)
    there = alone.food_wrench[:, 3:] @ model.X_FC_rotation
    np.testing.assert_allclose(there, forces(snap), rtol=1e-9, atol=1e-9)


def test_given_steps_are_taken_whatever_the_food_does(snap):
    numbers = [step.substeps for step in snap]
    again = taken(cut(effects=Effects(skin=SKIN)), numbers)
    np.testing.assert_array_equal(forces(again), forces(snap))
    firmer = taken(cut(effects=Effects(skin=Skin(toughness=1.1))), numbers)
    assert [step.substeps for step in firmer] == numbers


def test_an_arm_that_gives_holds_the_force_of_the_steps_that_are_repeated():
    effects = Effects(skin=SKIN, compliance=Compliance(arm=2e-5))
    model = cut(effects=effects)
    path = KnifePath(model, press(model), PERIOD)
    numbers, rises = [], []
    commands = path.p_FK[:, 2].copy()
    for launch, (step,) in Driver(PERIOD).run([path]):
        numbers.append(step.substeps)
        rise = path.p_FK[launch.first + 1, 2] - commands[launch.first + 1]
        force = (model.X_FC_rotation @ step.wrench[3:])[2]
        rises.append((rise, 2e-5 * force))
    assert max(numbers) >= 16
    rise, held = np.array(rises).T
    close = np.abs(rise - held) < 2e-4 * 2e-5 * np.maximum(1.0, held / 2e-5)
    # Where the force jumps there is no balance, but a displacement at which it jumps.
    assert close.mean() > 0.95
