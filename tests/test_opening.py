"""The bonds of the uncut surface: one toughness, spent by opening, by the edge, or by both."""

import re

import numpy as np
import pytest

from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingSolver

TOUGHNESS = 50.0
FAR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))


def bar(strength, toughness=TOUGHNESS, **numerics):
    food = Food(
        shape=Box(size=[0.02, 0.03, 0.02], divisions=[2, 2], layers=[0.0, 0.005]),
        material=Material(youngs_modulus=5e6, toughness=toughness, strength=strength),
        hold_distance=0.004,
    )
    model = make_food_model(food, Knife(), Numerics(**numerics))
    return model, CuttingSolver(model, 2e-3)


def pull_apart(model, solver, state, distance, coupling_steps=400):
    """Moves the held plus side away from the cut: what opening dissipates, and the state."""
    held = np.ones(len(model.nodes), bool)
    held[model.moving] = False
    plus = held & (model.split.node_side[model.computed] == 1)
    lost = 0.0
    for _ in range(coupling_steps):
        x = solver.field(state, "x").reshape(-1, 3)
        x[plus, 1] += distance / coupling_steps
        step = solver.coupling_step(state, FAR, FAR)
        state = step.state
        lost += step.balance.opening
    return lost, state


@pytest.mark.parametrize("strength", [5e4, 2e5])
def test_pulling_the_halves_apart_costs_toughness_times_area_whatever_the_strength(strength):
    model, solver = bar(strength)
    lost, state = pull_apart(model, solver, solver.initial_state(), distance=8e-3)
    assert np.all(solver.field(state, "cohesive_damage") == 1.0)
    assert lost == pytest.approx(TOUGHNESS * model.section_area, rel=1e-3)


def test_a_strength_that_the_mesh_cannot_hold_is_lowered_and_said():
    within, _ = bar(strength=2e5)
    assert within.strength == within.material.strength and within.warnings == ()
    beyond, _ = bar(strength=5e6)
    assert 2e5 < beyond.strength < beyond.material.strength == 5e6
    (warning,) = beyond.warnings
    assert "material.strength" in warning and f"part at {beyond.strength:.4g} Pa" in warning
    # Both of the fixes that it names are.
    strength, stiffness = re.search(
        r"strength: (\S+), .*bond_stiffness: (\S+) and", warning
    ).groups()
    assert bar(strength=float(strength))[0].warnings == ()
    mended, _ = bar(strength=5e6, bond_stiffness=1.01 * float(stiffness))
    assert mended.warnings == () and mended.strength == 5e6


def test_faces_that_are_not_pulled_to_their_strength_lose_nothing():
    model, solver = bar(strength=2e5)
    stretch = 0.5 * 2e5 / 5e6 * 0.01
    lost, state = pull_apart(
        model, solver, solver.initial_state(), distance=stretch, coupling_steps=100
    )
    assert lost == 0.0
    assert np.all(solver.field(state, "cohesive_damage") == 0.0)


def test_edge_and_opening_share_one_toughness():
    model, solver = bar(strength=5e4)
    state = solver.initial_state()
    R = np.diag([1.0, -1.0, -1.0])

    def at(z):
        return Pose(R, np.array([0.0, 0.0, z]))

    by_edge = by_opening = 0.0
    top, middle = model.top + 1e-4, 0.5 * (model.top + model.bottom)
    heights = np.linspace(top, middle, 300)
    for a, b in zip(heights[:-1], heights[1:], strict=True):
        step = solver.coupling_step(state, at(a), at(b))
        state = step.state
        by_edge += step.balance.edge
        by_opening += step.balance.opening
    half = 0.5 * TOUGHNESS * model.section_area
    assert by_edge + by_opening == pytest.approx(half, rel=0.25)
    opened, state = pull_apart(model, solver, state, distance=8e-3)
    total = by_edge + by_opening + opened
    assert total == pytest.approx(TOUGHNESS * model.section_area, rel=0.03)


def test_a_food_without_toughness_has_no_bonds():
    model, solver = bar(strength=2e5, toughness=0.0)
    lost, state = pull_apart(
        model, solver, solver.initial_state(), distance=1e-3, coupling_steps=100
    )
    assert lost == 0.0
    points = solver.positions(state)[model.point_nodes]
    gap = points[:, 2:].mean(1)[:, 1] - points[:, :2].mean(1)[:, 1]
    assert gap.min() > 0.9e-3
