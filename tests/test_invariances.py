"""What no law of the cut may change: scale, place, side, sense; and what must balance."""

import copy
import dataclasses as dc
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting import knife as knife_module
from sliceit_drake.cutting.coupling_steps import EnergyBalance
from sliceit_drake.cutting.foods.effects import (
    Adhesion,
    Bluntness,
    Core,
    Effects,
    Skin,
    ToughnessRate,
)
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Tapered
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import GRAVITY, CuttingModel, Numerics, prepare_cut
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan, Pose, PressAndDraw
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

UP = np.array([0.0, 0.0, 1.0])
PERIOD = 2e-3
CLEARANCE = 5e-4
DRAW = 0.6
KNIFE = Knife(length=0.2)


def lopsided() -> Food:
    """A food without any symmetry, cut askew and held on one side."""
    return Food(
        shape=Tapered([0.018, 0.024], 0.08, 2, [0.0, 0.004, 0.009, 0.016]),
        material=Material(youngs_modulus=1e6, toughness=300.0, friction=0.15),
        cut_point=[0.0, 1e-3, 0.0],
        cut_normal=[0.2, 1.0, 0.1],
        held_sides="minus",
    )


def cut_through(
    model: CuttingModel,
    draw_ratio: float = DRAW,
    speed: float = 0.02,
    acceleration: float | None = 0.5,
    clearance: float = CLEARANCE,
    period: float = PERIOD,
) -> SliceResult:
    """Draws a knife through a food to the board."""
    way = model.top - model.bottom + 2.0 * clearance
    segment = PressAndDraw(speed, way, draw_ratio, acceleration=acceleration)
    motion = Motion(MotionPlan([segment]), start_pose(model, clearance))
    return simulate_slice(CuttingSolver(model, period), motion)


def image(food: Food, Q: np.ndarray, shift: np.ndarray) -> tuple[CuttingModel, float]:
    """The cut of a food that is turned or mirrored by Q and moved with the board, and the sense of
    Cx there."""
    mesh, plane = food.mesh(), food.plane()
    tetrahedra = mesh.tetrahedra if np.linalg.det(Q) > 0.0 else mesh.tetrahedra[:, [0, 2, 1, 3]]
    normal = Q @ plane.normal
    there = CutPlane(Q @ plane.point + shift, normal * np.sign(normal[1]), UP)
    moved = TetrahedralMesh(mesh.vertices @ Q.T + shift, tetrahedra)
    geometry = make_cut_geometry(moved, there, food.held(mesh), board_height=shift[2])
    sense = float((Q @ plane.rotation()[:, 0]) @ there.rotation()[:, 0])
    return prepare_cut(geometry, food.material, KNIFE, Numerics()), sense


@pytest.fixture(scope="module")
def as_it_stands() -> SliceResult:
    return cut_through(image(lopsided(), np.eye(3), np.zeros(3))[0])


@pytest.mark.parametrize(
    ("Q", "shift"),
    [
        (Rotation.from_euler("z", 0.7).as_matrix(), np.zeros(3)),
        (np.eye(3), np.array([0.3, -0.2, 0.15])),
        (np.diag([-1.0, 1.0, 1.0]), np.zeros(3)),
        (np.diag([1.0, -1.0, 1.0]), np.zeros(3)),
    ],
    ids=["turned", "moved", "mirrored along the edge", "mirrored in the cut"],
)
def test_the_image_of_a_cut_has_the_image_of_its_wrench(Q, shift, as_it_stands):
    model, sense = image(lopsided(), Q, shift)
    there = cut_through(model, sense * DRAW)
    moment, force = as_it_stands.food_wrench[:, :3], as_it_stands.food_wrench[:, 3:]
    assert np.abs(force).max(0).min() > 2.0
    # Rounding of single precision; 2e-5 at most was measured.
    for found, expected in (
        (there.food_wrench[:, 3:], force @ Q.T),
        (there.food_wrench[:, :3], np.linalg.det(Q) * moment @ Q.T),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def scaled(value: Any, units: dict[str, float]) -> Any:
    """A configuration with every quantity times the factor of its unit."""
    if not dc.is_dataclass(value):
        return value
    value = copy.deepcopy(value)
    for field in dc.fields(value):
        old = getattr(value, field.name)
        for rule in field.metadata.values():
            if hasattr(rule, "unit") and rule.unit and old is not None:
                new = units[rule.unit] * np.array(old)
                setattr(value, field.name, new.tolist())
        if dc.is_dataclass(old):
            setattr(value, field.name, scaled(old, units))
    return value


@pytest.mark.parametrize(("length", "stress"), [(1.0, 5.0), (2.0, 3.0)])
def test_forces_scale_with_length_and_modulus(length, stress, monkeypatch):
    food = lopsided()
    food.effects = Effects(
        toughness_rate=ToughnessRate(0.1),
        skin=Skin(0.2, 1e-3),
        core=Core(rind=4e-3, toughness_ratio=0.7, stiffness_ratio=0.8, offset=[1e-3, 1e-3]),
        bluntness=Bluntness(200.0),
        adhesion=Adhesion(200.0, 1e3, exponent=0.6),
    )
    steel = knife_module.STEEL_DENSITY

    def wrench(length: float, stress: float) -> np.ndarray:
        # So that weight scales as the other forces do, and inertia.
        time, density = length**0.5, stress / length
        units = {
            "m": length,
            "s": time,
            "m/s": length / time,
            "Pa": stress,
            "kg/m3": density,
            "J/m2": stress * length,
            "J/m": stress * length**2,
            "N/m": stress * length,
            "m/N": 1.0 / (stress * length),
            "Pa s/m": stress * time / length,
            "E/h": 1.0,
        }
        monkeypatch.setattr(knife_module, "STEEL_DENSITY", density * steel)
        # How sub-steps follow the knife's motion is given in lengths and times.
        numerics = scaled(Numerics(time_step=2.5e-4, step_by_need=False), units)
        model = make_food_model(scaled(food, units), scaled(KNIFE, units), numerics)
        result = cut_through(
            model,
            speed=0.02 * length / time,
            acceleration=0.5 * length / time**2,
            clearance=CLEARANCE * length,
            period=PERIOD * time,
        )
        return result.food_wrench / (stress * length**2 * np.array([length] * 3 + [1.0] * 3))

    force, expected = wrench(length, stress)[:, 3:], wrench(1.0, 1.0)[:, 3:]
    # Only `LEAST_SPREAD` of the front is a length that no one gives.
    error = np.sqrt(np.mean((force - expected) ** 2) / np.mean(expected**2))
    assert error < (5e-4 if length != 1.0 else 1e-4)


@pytest.mark.parametrize("tilt", [0.15, -0.3])
def test_a_tilted_edge_presses_through_a_box_with_the_force_and_work_of_a_level_one(tilt):
    width, height, toughness = 0.024, 0.030, 300.0
    food = Food(
        shape=Box([width, 0.05, height], [4, 5], [0.0, 0.004, 0.012]),
        material=Material(youngs_modulus=2e6, toughness=toughness, friction=0.0),
    )
    # Too thin to wedge the cut open.
    model = make_food_model(food, Knife(length=0.4, spine_thickness=4e-4), Numerics())
    turn = Rotation.from_euler("y", tilt).as_matrix()
    rise = 0.5 * width * abs(np.tan(tilt))
    down = ConstantSpeed(direction=turn[2].tolist(), distance=height + 2.0 * rise + 2e-3)
    level = start_pose(model, CLEARANCE)
    start = Pose(level.R @ turn, level.p + rise * UP)
    result = simulate_slice(CuttingSolver(model, PERIOD), Motion(MotionPlan([down]), start))
    z = result.position[:, 2]
    inside = (z - rise > 0.25 * height) & (z + rise < 0.8 * height)
    force = result.edge[inside].mean(0) / (toughness * width)
    assert np.count_nonzero(inside) > 200
    np.testing.assert_allclose(force, UP, atol=0.01)
    assert result.balance.edge == pytest.approx(toughness * width * height, rel=2e-3)


def test_a_food_without_rates_is_cut_with_one_force_at_any_speed():
    model = make_food_model(lopsided(), KNIFE, Numerics())
    depth = np.linspace(CLEARANCE, model.top - model.bottom, 200)

    def force(speed: float) -> np.ndarray:
        result = cut_through(model, speed=speed, acceleration=None)
        below = result.position[0, 2] - result.position[:, 2]
        return np.array([np.interp(depth, below, row) for row in result.food_wrench[:, 3:].T])

    slow, fast = force(0.005), force(0.02)
    # The error of the sub-steps; 0.3 % was measured.
    assert np.sqrt(np.mean((fast - slow) ** 2) / np.mean(slow**2)) < 0.006


def free_body() -> CuttingModel:
    """A food that neither a holder nor a board touches, with its true masses."""
    food = dc.replace(lopsided(), held_sides="none")
    mesh = food.mesh()
    geometry = make_cut_geometry(mesh, food.plane(), food.held(mesh), board_height=None)
    numerics = Numerics(time_step=1e-5, mass_scaling=False)
    return prepare_cut(geometry, food.material, KNIFE, numerics)


def in_cut_frame(model: CuttingModel, X: Pose) -> Pose:
    return Pose(model.X_FC_rotation.T @ X.R, model.to_cut_frame(X.p))


def test_food_that_nothing_holds_falls_freely_and_weight_does_the_work_of_the_fall():
    model, steps = free_body(), 20
    solver = CuttingSolver(model, PERIOD)
    knife = in_cut_frame(model, start_pose(model, 0.05))
    state, balance = solver.initial_state(), EnergyBalance()
    for _ in range(steps):
        step = solver.coupling_step(state, knife, knife)
        state, balance = step.state, balance + step.balance
    mass, time = model.true_mass, steps * PERIOD
    fallen = (model.nodes - solver.positions(state)) @ model.up
    # Semi-implicit Euler falls by half a sub-step's way too far.
    np.testing.assert_allclose(fallen, 0.5 * GRAVITY * time**2, rtol=1e-3)
    assert balance.gravity == pytest.approx(GRAVITY * float(mass @ fallen), rel=1e-5)
    energies = solver.energies(state, knife)
    assert energies.kinetic == pytest.approx(balance.gravity, rel=1e-3)
    assert abs(balance.residual(energies)) < 1e-3 * balance.gravity


def test_what_the_knife_feels_is_what_the_momentum_of_a_free_food_gains():
    model = free_body()
    sub_step = model.numerics.time_step
    mass, weight = model.inertia.matrix.diagonal(), model.weight[model.moving]
    plan = MotionPlan([PressAndDraw(1.0, 0.01, DRAW)])
    motion = Motion(plan, start_pose(model, 1e-4))
    solver = CuttingSolver(model, sub_step)
    state, lacks, forces, moments = solver.initial_state(), [], [], []

    def motions(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return solver.velocities(state)[model.moving], solver.field(state, "blade")[1]

    for k in range(300):
        X, Y = (in_cut_frame(model, motion.pose(t * sub_step)) for t in (k, k + 1))
        step = solver.coupling_step(state, X, Y)
        (v, blade), (new_v, new_blade) = motions(state), motions(step.state)
        gained = mass[:-1, None] * (new_v - v) / sub_step - weight
        arm = solver.positions(state)[model.moving]
        state = step.state
        lack = gained.sum(0) + step.wrench[3:]
        lack[1] += np.sign(X.R[1, 1]) * mass[-1] * (new_blade - blade) / sub_step
        force = step.wrench[3:]
        turned = np.cross(arm, gained).sum(0) + step.wrench[:3] + np.cross(X.p, force)
        lacks.append([*lack, turned[1]])
        forces.append(force)
        moments.append((step.wrench[:3] + np.cross(X.p, force))[1])
    lacks, force = np.abs(lacks).max(0), np.abs(forces).max()
    assert step.cut > 0.02 and force > 3.0
    # Rounding of velocities over a sub-step; the blade's spring is that of the sub-step's end.
    assert lacks[[0, 2]].max() < 1e-4 * force
    assert lacks[1] < 1e-3 * force
    assert lacks[3] < 2e-3 * np.abs(moments).max()
