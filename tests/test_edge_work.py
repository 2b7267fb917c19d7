"""The edge pays the toughness for the area that it cuts, evenly, whatever the food does."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.foods.effects import Effects, Skin
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Motion,
    MotionPlan,
    PressAndDraw,
    Retract,
    Segment,
)
from sliceit_drake.cutting.simulate import SliceResult, check_energies, simulate_slice
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver

TOUGHNESS = 300.0
WIDTH, HEIGHT = 0.024, 0.030
COARSE = ([5, 6], [0.0, 0.004, 0.012])
FINE = ([9, 11], [0.0, 0.0025, 0.0055, 0.012])


def cut_box(
    segments: list[Segment],
    mesh: tuple[list[int], list[float]] = COARSE,
    offset: float = 0.0,
    held: str = "both",
    numerics: Numerics | None = None,
    **material: float,
) -> SliceResult:
    """Cuts a box with a blade that is too thin to wedge it open, without flank friction."""
    divisions, layers = mesh
    values = {"youngs_modulus": 2e6, "toughness": TOUGHNESS, "friction": 0.0} | material
    food = Food(
        shape=Box([WIDTH, 0.1, HEIGHT], divisions, layers),
        material=Material(**values),
        held_sides=held,
    )
    knife = Knife(length=0.4, spine_thickness=4e-4)
    model = make_food_model(food, knife, numerics or Numerics())
    motion = Motion(MotionPlan(segments), start_pose(model, 5e-4, offset))
    return simulate_slice(CuttingSolver(model, 2e-3), motion)


def press(draw_ratio: float = 0.0, depth: float = HEIGHT + 4e-3) -> list[Segment]:
    return [
        ConstantSpeed(
            direction=[draw_ratio, 0.0, 1.0],
            duration=depth / 0.02,
            acceleration=None,
            speed=0.02 * np.hypot(1.0, draw_ratio),
        )
    ]


def within(result: SliceResult, low: float, high: float) -> np.ndarray:
    """Rows in which the edge is between two fractions of the height deep."""
    depth = 1.0 - result.position[:, 2] / HEIGHT
    return (depth > low) & (depth < high)


@pytest.mark.parametrize(
    ("modulus", "toughness", "mesh", "ripple"),
    [
        # Where flanks open rows of 5 mm of a stiff food, 1.2 % are left at any step.
        (1e7, 300.0, COARSE, 0.0125),
        (2e5, 300.0, COARSE, 0.01),
        (1e5, 300.0, COARSE, 0.01),
        (2e5, 100.0, FINE, 0.01),
    ],
)
def test_the_force_has_no_sawtooth_at_the_rows_of_elements(modulus, toughness, mesh, ripple):
    result = cut_box(press(), mesh, youngs_modulus=modulus, toughness=toughness)
    rows = within(result, 0.4, 0.85)
    depth, force = result.position[rows, 2], result.edge[rows, 2]
    trend = np.polyval(np.polyfit(depth, force, 3), depth)
    assert np.abs(force - trend).max() < ripple * force.mean()
    area = WIDTH * HEIGHT
    assert result.balance.edge == pytest.approx(toughness * area, rel=0.01)


@pytest.mark.parametrize(("modulus", "spread"), [(6e4, 0.01), (1e5, 0.006)])
def test_an_edge_that_is_spread_neither_jumps_nor_inverts_soft_food(modulus, spread):
    def ripple(result: SliceResult) -> float:
        rows = within(result, 0.4, 0.85)
        depth, force = result.position[rows, 2], result.edge[rows, 2]
        trend = np.polyval(np.polyfit(depth, force, 3), depth)
        return float(np.abs(force - trend).max() / force.mean())

    soft = {"youngs_modulus": modulus, "toughness": 450.0}
    numerics = Numerics(edge_spread=spread)
    whole = cut_box(press(depth=HEIGHT + 8e-3), numerics=numerics, **soft)
    assert ripple(whole) < 0.01
    assert whole.balance.edge == pytest.approx(450.0 * WIDTH * HEIGHT, rel=0.015)
    # About where the edge breaks through the surface, and the food is deformed most.
    dented = cut_box(press(depth=0.4 * HEIGHT), numerics=numerics, **soft)
    assert dented.energies.least_volume_ratio > 0.5


@pytest.mark.parametrize("step", [2.5e-4, 1e-3])
def test_food_under_a_skin_does_not_vibrate_with_the_edge(step):
    food = Food(
        shape=Cylinder(rings=3, layers=[0.0, 0.004, 0.012]),
        material=Material(toughness=400.0, friction=0.1),
        effects=Effects(skin=Skin(1.0)),
    )
    model = make_food_model(food, Knife(), Numerics(time_step=step, step_by_need=False))
    motion = Motion(MotionPlan(press(depth=1.4e-3)), start_pose(model, 5e-4))
    # Each sub-step's force, without what the first touch of the flanks rings.
    force = simulate_slice(CuttingSolver(model, step), motion).food_wrench[:, 5]
    force = force[force > 6.0]
    assert force[-1] > 10.0
    assert np.diff(force, 2).std() < 0.1 * np.diff(force).mean()


@pytest.mark.parametrize("draw_ratio", [0.7, 1.0])
def test_food_that_slides_with_the_knife_is_cut_for_its_toughness(draw_ratio):
    result = cut_box(
        press(draw_ratio),
        offset=-0.5 * draw_ratio * HEIGHT,
        held="none",
        numerics=Numerics(time_step=2e-4, direction_length=2e-5),
    )
    # It slides as fast as leaves the edge a force along it that friction on the board bears.
    friction, full = Numerics().board_friction, TOUGHNESS * WIDTH
    rows = within(result, 0.3, 0.7)
    assert result.edge[rows, 2].mean() == pytest.approx(full / (1 + friction**2), rel=0.03)
    assert -result.edge[rows, 0].mean() == pytest.approx(0.3 * full / (1 + friction**2), rel=0.1)
    assert result.balance.edge == pytest.approx(TOUGHNESS * WIDTH * HEIGHT, rel=0.02)


@pytest.mark.parametrize(("modulus", "xi"), [(1e7, 5.0), (2e6, 2.0)])
def test_sawing_of_a_small_amplitude_has_the_force_and_the_work_of_its_slice_push_ratio(
    modulus, xi
):
    amplitude, speed = 3e-4, 5e-3
    frequency = xi * speed / (2.0 * np.pi * amplitude)
    saw = PressAndDraw(speed, HEIGHT + 2e-3, amplitude=amplitude, frequency=frequency)
    # By default the direction follows more slowly, for a knife on an arm that gives.
    result = cut_box([saw], youngs_modulus=modulus, numerics=Numerics(direction_length=2e-5))
    by_default = cut_box([saw], youngs_modulus=modulus)
    phase = np.linspace(0.0, np.pi, 2001)
    exact = TOUGHNESS * WIDTH * (1.0 / (1.0 + (xi * np.cos(phase)) ** 2)).mean()
    force = result.edge[within(result, 0.25, 0.75), 2].mean()
    assert force == pytest.approx(exact, rel=0.05)
    for each in (result, by_default):
        assert each.balance.edge == pytest.approx(TOUGHNESS * WIDTH * HEIGHT, rel=0.02)


@pytest.mark.parametrize(("gives", "xi"), [(1.5e-3, 5.0), (5e-4, 5.0), (5e-4, 2.0)])
def test_soft_food_that_is_sawn_by_less_than_it_gives_is_cut_as_by_a_press(gives, xi):
    amplitude, speed, modulus = 3e-4, 5e-3, 2e5
    frequency = xi * speed / (2.0 * np.pi * amplitude)
    saw = PressAndDraw(speed, HEIGHT + 6e-3, amplitude=amplitude, frequency=frequency)
    soft = {"youngs_modulus": modulus, "toughness": gives * modulus}
    result = cut_box([saw], numerics=Numerics(edge_spread=2.0 * gives), **soft)
    force = result.edge[within(result, 0.35, 0.85), 2].mean()
    assert force == pytest.approx(gives * modulus * WIDTH, rel=0.05)
    assert result.balance.edge == pytest.approx(gives * modulus * WIDTH * HEIGHT, rel=0.02)
    with pytest.raises(CuttingError, match=r"less work .* give numerics\.edge_spread"):
        cut_box([saw], **soft)


def test_how_much_work_the_edge_may_owe_is_for_the_user_to_say():
    saw = PressAndDraw(5e-3, HEIGHT + 6e-3, amplitude=3e-4, frequency=5.3)
    soft = {"youngs_modulus": 2e5, "toughness": 100.0}
    with pytest.raises(CuttingError, match="less work"):
        cut_box([saw], **soft)
    result = cut_box([saw], numerics=Numerics(work_error=0.5), **soft)
    due = 100.0 * WIDTH * HEIGHT
    owed = 1.0 - (result.balance.edge + result.balance.opening) / due
    assert 0.02 < owed < 0.5
    with pytest.raises(CuttingError, match="less work"):
        cut_box([saw], numerics=Numerics(work_error=0.9 * owed), **soft)


@pytest.mark.parametrize("xi", [1.0, 3.0])
def test_a_draw_through_soft_food_follows_atkins_and_is_calm(xi):
    spread = Numerics(edge_spread=1e-3)
    soft = {"youngs_modulus": 2e5, "toughness": 100.0}
    result = cut_box(press(xi), offset=-0.5 * xi * HEIGHT, numerics=spread, **soft)
    force = result.edge[within(result, 0.4, 0.8), 2]
    assert force.mean() == pytest.approx(100.0 * WIDTH / (1.0 + xi**2), rel=0.05)
    assert force.std() < 0.03 * force.mean()


def test_coming_back_to_the_bottom_of_a_cut_costs_nothing():
    down = ConstantSpeed(distance=0.015, speed=0.02, acceleration=0.5)
    chop = [
        Retract(distance=0.004, speed=0.04, acceleration=0.5),
        ConstantSpeed(distance=0.004, speed=0.04, acceleration=0.5),
    ]
    once, often = cut_box([down]), cut_box([down, *(10 * chop)])
    assert often.balance.edge == pytest.approx(once.balance.edge, rel=0.01)


def test_an_edge_makes_up_for_what_it_owes_within_a_flat_plate():
    toughness, sides = 100.0, [0.06, 0.1, 0.008]
    food = Food(
        shape=Box(sides, [10, 3], [0.0, 0.003, 0.007, 0.013]),
        material=Material(youngs_modulus=2e5, toughness=toughness, friction=0.0),
    )
    model = make_food_model(food, Knife(length=0.4, spine_thickness=4e-4), Numerics())
    motion = Motion(MotionPlan(press(depth=0.012)), start_pose(model, 5e-4))
    result = simulate_slice(CuttingSolver(model, 2e-3), motion)
    assert result.cut[-1] > 0.9999
    assert result.balance.edge == pytest.approx(toughness * sides[0] * sides[2], rel=0.009)


def test_a_section_that_is_cut_for_too_little_work_is_refused():
    result = cut_box(press())
    food = Food(shape=Box([WIDTH, 0.1, HEIGHT], *COARSE), material=Material(toughness=TOUGHNESS))
    model = make_food_model(food, Knife(), Numerics())
    area = float(model.tables.area.sum())
    check_energies(result.energies, result.balance.edge, model, 1.0, 1.0)
    poor = dc.replace(result.energies, debt=0.021 * TOUGHNESS * area)
    check_energies(poor, result.balance.edge, model, 1.0, 0.9)
    with pytest.raises(CuttingError, match=r"2\.1 % less work .* Hold the food"):
        check_energies(poor, result.balance.edge, model, 1.0, 1.0)
    poorer = dc.replace(poor, debt=0.2 * TOUGHNESS * area)
    check_energies(poorer, result.balance.edge, model, 1.0, 0.9)
    with pytest.raises(CuttingError, match=r"95 % of the section .* more than it can make up"):
        check_energies(poorer, result.balance.edge, model, 1.0, 0.95)


def test_food_that_moves_fast_with_its_true_mass_is_not_refused():
    result = cut_box(press())
    food = Food(shape=Box([WIDTH, 0.1, HEIGHT], *COARSE), material=Material(toughness=TOUGHNESS))
    model = make_food_model(food, Knife(), Numerics())
    assert 0.0 < result.energies.added < result.energies.kinetic
    internal = result.energies.elastic + result.energies.interface + result.balance.edge
    fast = dc.replace(result.energies, kinetic=0.2 * internal, added=0.04 * internal, sub_step=5e-4)
    assert check_energies(fast, result.balance.edge, model, 1.0, 1.0) == pytest.approx(0.2)
    heavy = dc.replace(fast, added=0.06 * internal)
    with pytest.raises(
        CuttingError, match=r"is 6\.0 % of the .* than the sub-step here, 0\.0005 s"
    ):
        check_energies(heavy, result.balance.edge, model, 1.0, 1.0)


def test_a_round_food_that_a_draw_rolls_is_refused():
    food = Food(
        shape=Cylinder(diameter=0.04, length=0.08, rings=2, layers=[0.0, 0.004, 0.012]),
        material=Material(youngs_modulus=5e5, toughness=100.0, friction=0.3),
    )
    draw = MotionPlan([PressAndDraw(0.04, 0.045, 1.5, acceleration=0.5)])
    numerics = Numerics(time_step=1e-4)
    held = make_food_model(food, Knife(length=0.3), numerics)
    motion = Motion(draw, start_pose(held, 2e-3))
    assert simulate_slice(CuttingSolver(held, 2e-3), motion).cut[-1] > 0.999
    free = make_food_model(dc.replace(food, held_sides="none"), Knife(length=0.3), numerics)
    with pytest.raises(CuttingError, match=r"turned by -?\d\d\.?\d? degrees .* Hold the food"):
        simulate_slice(CuttingSolver(free, 2e-3), motion)
