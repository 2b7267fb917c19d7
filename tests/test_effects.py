"""Effects beyond the base model: nulls change nothing, and each has its own signature."""

import dataclasses as dc
import functools

import numpy as np
import pytest
from held_reaction import held_reaction
from scipy.optimize import curve_fit

from sliceit_drake.configuration import ConfigurationError, load_yaml, validate
from sliceit_drake.cutting.batch import BatchSlice, simulate_batch
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.effects import (
    Adhesion,
    Bluntness,
    Centre,
    Compliance,
    Core,
    Edge,
    Effects,
    Relaxation,
    Skin,
    SlicePush,
    Slip,
    ToughnessRate,
    Underside,
)
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Retract
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

PERIOD = 2e-3
STEP = 2e-4
SPEED = 0.02
TOUGHNESS = 300.0
WIDTH, HEIGHT = 0.024, 0.02
CLEARANCE = 5e-4
LOSSES = ("edge", "opening", "friction", "board_friction", "blade")


@functools.cache
def bar(razor: bool = True, friction: float = 0.0) -> CuttingModel:
    """A bar of constant width; a razor does not wedge the cut open ahead of its edge."""
    food = Food(
        shape=Box(size=[WIDTH, 0.1, HEIGHT], divisions=[4, 5], layers=[0.0, 0.004, 0.012]),
        material=Material(youngs_modulus=2e6, toughness=TOUGHNESS, friction=friction),
    )
    knife = Knife(length=0.4, spine_thickness=4e-4 if razor else 3e-3)
    return make_food_model(food, knife, Numerics(time_step=STEP))


def press(depth: float, draw_ratio: float = 0.0, speed: float = SPEED) -> ConstantSpeed:
    """Down to a depth; `speed` is that of the press."""
    slope = np.hypot(1.0, draw_ratio)
    return ConstantSpeed(
        direction=[draw_ratio, 0.0, 1.0],
        distance=(depth + CLEARANCE) * slope,
        speed=speed * slope,
    )


def motion(model: CuttingModel, *segments) -> Motion:
    return Motion(MotionPlan(list(segments)), start_pose(model, CLEARANCE))


def simulate(model: CuttingModel, effects: Effects, *segments, **rest) -> SliceResult:
    solver = CuttingSolver(model.derive(effects=effects), PERIOD)
    return simulate_slice(solver, motion(model, *segments), **rest)


def depth_of(result: SliceResult | BatchSlice, top: float = HEIGHT) -> np.ndarray:
    return top - result.position[:, 2]


def steady(result: SliceResult | BatchSlice) -> np.ndarray:
    depth = depth_of(result)
    return (depth > 0.35 * HEIGHT) & (depth < 0.7 * HEIGHT)


NULLS = {
    "edge": Effects(edge=Edge(1.0)),
    "toughness_rate": Effects(toughness_rate=ToughnessRate(0.0, 0.3)),
    "relaxation": Effects(relaxation=Relaxation([0.0, 0.0], [0.01, 3.0])),
    "skin": Effects(skin=Skin(0.0, 2e-3)),
    "core": Effects(core=Core(2e-3, 5e-4, offset=[1e-3, -1e-3])),
    "centre": Effects(centre=Centre(2e-3, 5e-4, offset=[0.0, 1e-3])),
    "underside": Effects(underside=Underside(5e-3, 5e-4)),
    "bluntness": Effects(bluntness=Bluntness(0.0, 7e-3, 0.0, 2.0, 100)),
    "a sharpened knife": Effects(bluntness=Bluntness(dulling=200.0, dulling_exponent=0.5)),
    "adhesion": Effects(adhesion=Adhesion(0.0, 0.0)),
    "slice_push": Effects(slice_push=SlicePush(1.0)),
    "compliance": Effects(compliance=Compliance(0.0, 0.0)),
    "slip": Effects(slip=Slip(None, 0.1)),
}


def test_a_group_at_its_null_changes_nothing():
    model = bar(razor=False, friction=0.1).derive(numerics=Numerics())
    path = motion(model, press(3e-3, 0.5), Hold(duration=0.02), Retract(distance=2e-3))
    models = [model, *(model.derive(effects=effects) for effects in NULLS.values())]
    base, *others = simulate_batch(models, [path], PERIOD)
    assert base.food_wrench[:, 5].max() > 1.0
    for name, other in zip(NULLS, others, strict=True):
        assert np.array_equal(other.food_wrench, base.food_wrench), name
        assert np.array_equal(other.position, base.position), name


@pytest.mark.parametrize("speed", [0.01, 0.04])
def test_toughness_grows_with_a_power_of_the_speed_and_drops_at_once_when_the_edge_stops(speed):
    exponent = 0.2
    rate = Effects(toughness_rate=ToughnessRate(exponent, SPEED))
    # At constant steps, whose inertia keeps the food from swinging back with the edge at rest.
    model = bar().derive(numerics=Numerics(time_step=STEP, step_by_need=False))
    result = simulate(model, rate, press(0.012, speed=speed), Hold(duration=0.1))
    force = result.edge[:, 2]
    plateau = TOUGHNESS * WIDTH * (speed / SPEED) ** exponent
    assert force[steady(result)][:-50].mean() == pytest.approx(plateau, rel=0.02)
    stop = int(np.ceil((0.012 + CLEARANCE) / speed / PERIOD - 1e-9))
    at_rest = TOUGHNESS * WIDTH * 1e-3**exponent
    # What rings may unload the edge further; nothing decays towards the force at rest.
    assert force[stop] == pytest.approx(at_rest, rel=0.05)
    assert force[stop:].max() < 1.02 * at_rest


def test_a_relaxing_bulk_keeps_what_does_not_relax_and_has_its_time():
    share, time = 0.4, 0.15
    # Indented, not cut; what carries beside the bulk is much stiffer (edge) or softer (board).
    model = bar().derive(
        material=Material(youngs_modulus=2e6, toughness=2e4, strength=1e8, friction=0.0),
        numerics=Numerics(time_step=STEP, board_stiffness=0.01),
    )
    segments = press(4e-4), Hold(duration=0.8)
    elastic = simulate(model, Effects(), *segments).food_wrench[:, 5]
    relaxation = Effects(relaxation=Relaxation([share], [time]))
    relaxing = simulate(model, relaxation, *segments).food_wrench[:, 5]
    held = slice(-round(0.75 / PERIOD), None)
    t = np.arange(len(relaxing[held])) * PERIOD
    (rest, decay, fitted), _ = curve_fit(
        lambda t, a, b, tau: a + b * np.exp(-t / tau), t, relaxing[held], [5.0, 5.0, 0.3]
    )
    stiff = elastic[held].mean()
    assert elastic[held].std() < 0.02 * stiff
    assert fitted == pytest.approx(time, rel=0.05)
    assert rest / stiff == pytest.approx(1.0 - share, rel=0.02)
    assert decay > 0.2 * stiff


def test_what_holds_relaxing_food_takes_the_force_of_the_knife():
    model = bar().derive(
        effects=Effects(relaxation=Relaxation([0.5], [0.02])),
        numerics=Numerics(time_step=STEP, board_stiffness=0.01),
    )
    solver = CuttingSolver(model, PERIOD)
    result = simulate_slice(solver, motion(model, press(8e-3), Hold(duration=0.4)))
    held = held_reaction(solver, result.state, result.pose)[2]
    weight = -model.weight.sum(0)[2]
    assert held == pytest.approx(result.food_wrench[-1, 5] + weight, rel=0.05)


@pytest.mark.parametrize("shape", ["bar", "cylinder"])
def test_a_skin_takes_its_toughness_times_the_outline_at_entry_and_exit(shape):
    toughness = 0.1
    # Stiff: at its exit the edge also does the work of what has given under it.
    model = bar()
    model = model.derive(material=dc.replace(model.material, youngs_modulus=2e7))
    top, length = HEIGHT, 2.0 * (WIDTH + HEIGHT)
    if shape == "cylinder":
        top, sides = 0.02, 24
        food = Food(
            shape=Cylinder(diameter=top, rings=4, layers=[0.0, 0.004, 0.012]),
            material=Material(youngs_modulus=2e6, toughness=TOUGHNESS, friction=0.0),
        )
        model = make_food_model(food, model.knife, model.numerics)
        length = top * sides * np.sin(np.pi / sides)
    base, skinned = (
        simulate(model, Effects(skin=skin), press(top + 3e-4)) for skin in (Skin(), Skin(toughness))
    )
    work = (skinned.balance.edge + skinned.balance.opening) - (
        base.balance.edge + base.balance.opening
    )
    assert work == pytest.approx(toughness * length, rel=0.02)
    extra = (skinned.edge - base.edge)[:, 2]
    depth = depth_of(base, top)
    entry, exit_ = depth < 0.15 * top, depth > 0.85 * top
    # Halfway down only two sides are cut, along themselves.
    middle = (depth > 0.3 * top) & (depth < 0.7 * top)
    assert extra[middle].mean() == pytest.approx(2.0 * toughness, rel=0.15)
    assert extra[entry].max() > 5.0 * extra[middle].mean()
    assert extra[exit_].max() > 5.0 * extra[middle].mean()


def test_a_level_skin_asks_for_its_force_over_its_thickness():
    toughness, thickness = 0.1, 5e-4
    result = simulate(bar(), Effects(skin=Skin(toughness, thickness)), press(3e-3))
    expected = TOUGHNESS * WIDTH + toughness * WIDTH / thickness + 2.0 * toughness
    assert result.edge[:, 2].max() == pytest.approx(expected, rel=0.03)


def test_a_core_changes_the_force_where_the_edge_is_in_it():
    # Half an element of rind, so that the points beside it have the mean.
    base, other = (
        simulate(bar(), Effects(core=core), press(0.015))
        for core in (Core(), Core(rind=3e-3, transition=1e-4, toughness_ratio=0.5))
    )
    ratio = other.edge[:, 2] / np.maximum(base.edge[:, 2], 0.1)
    depth = depth_of(base)
    core = (WIDTH - 6e-3) / WIDTH
    inside = (depth > 9e-3) & (depth < 11.5e-3)
    assert ratio[inside].mean() == pytest.approx(1.0 - 0.5 * core, rel=0.03)
    outside = (depth > 3e-4) & (depth < 6e-4)
    assert ratio[outside].mean() > 0.93


def test_a_centre_changes_the_force_on_top_of_the_core_around_it():
    core = Core(rind=3e-3, transition=1e-4, toughness_ratio=0.5)
    base, other = (
        simulate(bar(), Effects(core=core, centre=centre), press(0.015))
        for centre in (Centre(), Centre(distance=3e-3, transition=1e-4, toughness_ratio=2.0))
    )
    homogeneous = simulate(bar(), Effects(), press(0.015))
    depth = depth_of(base)
    inside = (depth > 9e-3) & (depth < 11.5e-3)
    # Where the centre is as large as the core, one undoes the other.
    relative = other.edge[inside, 2].mean() / homogeneous.edge[inside, 2].mean()
    assert relative == pytest.approx(1.0, rel=0.03)
    assert base.edge[inside, 2].mean() < 0.8 * other.edge[inside, 2].mean()


def test_a_core_off_the_middle_is_tough_and_stiff_where_it_lies():
    food = Food(shape=Cylinder(diameter=0.04, length=0.08, rings=6))
    around, ratio, offset = 0.012, 3.0, np.array([0.004, -0.006])
    food.effects.core = Core(around, 1e-4, ratio, ratio, offset=offset.tolist())
    food.effects.centre = Centre(around, 1e-4, 2.0, offset=(-offset).tolist())
    model = make_food_model(food, Knife(), Numerics())

    def inside(places: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """1 in a circle around what was the middle, 0 beyond it, NaN at its border."""
        r = np.hypot(*(places[:, [0, 2]] - [0.0, 0.02] - offset).T)
        core = 0.02 - around
        return np.select([r < 0.93 * core, r > 1.03 * core], [1.0, 0.0], np.nan)

    points, elements = model.split.points, model.nodes[model.tetrahedra].mean(1)
    factors = (1.0 + (ratio - 1.0) * inside(points, offset)) * (1.0 + inside(points, -offset))
    known = ~np.isnan(factors)
    assert set(factors[known]) >= {1.0, ratio, 2.0}
    toughness = model.toughness / food.material.toughness
    np.testing.assert_allclose(toughness[known], factors[known], rtol=1e-3)
    stiffer = 1.0 + (ratio - 1.0) * inside(elements, offset)
    known = ~np.isnan(stiffer)
    assert set(stiffer[known]) == {1.0, ratio}
    found = model.element_volume / model.stiff_volume
    np.testing.assert_allclose(found[known], stiffer[known], rtol=1e-3)


def test_an_underside_changes_the_force_where_the_edge_is_in_it_and_nowhere_above():
    height, ratio = 5e-3, 0.4
    bottom = Effects(underside=Underside(height, 1e-4, ratio))
    base, other = (simulate(bar(), e, press(HEIGHT - 1e-3)) for e in (Effects(), bottom))
    depth = depth_of(base)
    below = (depth > HEIGHT - height + 1.5e-3) & (depth < HEIGHT - 1.5e-3)
    above = (depth > 2e-3) & (depth < HEIGHT - height - 2e-3)
    for rows, expected in ((below, ratio), (above, 1.0)):
        found = other.edge[rows, 2].mean() / base.edge[rows, 2].mean()
        assert found == pytest.approx(expected, rel=0.05)


def test_what_lies_outside_of_the_section_is_no_core():
    # Behind a cut near the end of an ellipsoid it is thicker than at the cut.
    food = Food(
        shape=Ellipsoid([0.04, 0.06, 0.04], refinements=2),
        cut_point=[0.0, -0.022, 0.0],
        held_sides="plus",
        hold_distance=0.02,
        effects=Effects(core=Core(1e-3, 1e-4, stiffness_ratio=3.0)),
    )
    model = make_food_model(food, Knife(), Numerics())
    radius = 0.02 * np.sqrt(1.0 - (0.022 / 0.03) ** 2)
    centroids = model.nodes[model.tetrahedra].mean(1)
    outside = np.hypot(centroids[:, 0], centroids[:, 2] - 0.02) > radius
    assert outside.any() and not outside.all()
    stiffer = model.element_volume / model.stiff_volume
    np.testing.assert_allclose(stiffer[outside], 1.0, rtol=1e-6)
    assert (stiffer[~outside] > 2.9).any()


def test_the_force_meets_a_core_above_the_middle_earlier():
    up = HEIGHT / 5  # A row of elements: the core is interpolated between cut points.
    base, middle, above = (
        simulate(bar(), Effects(core=Core(5e-3, 1e-4, 0.4, offset=[0.0, offset])), press(0.012))
        if offset is not None
        else simulate(bar(), Effects(), press(0.012))
        for offset in (None, 0.0, up)
    )

    def ratio(other: SliceResult, depth: float) -> float:
        """Force over that without a core, around a depth."""
        near = np.abs(depth_of(other) - depth) < 1e-3
        return float((other.edge[near, 2] / base.edge[near, 2]).mean())

    assert ratio(middle, 0.01) == pytest.approx(ratio(above, 0.01 - up), rel=0.03)
    assert ratio(middle, 0.01 - up) - ratio(middle, 0.01) > 0.15


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        (Effects(core=Core(rind=3e-3, offset=[3e-3, 1e-3])), r"core\.offset.*rind leaves 0\.003 m"),
        (Effects(centre=Centre(offset=[0.0, -0.02])), r"centre\.offset.*at most 0\.018 m"),
    ],
)
def test_an_inner_part_that_is_moved_out_of_the_food_is_refused(effects, words):
    with pytest.raises(ConfigurationError, match=words):
        validate(effects, "food.effects")


def test_a_blunt_edge_asks_for_more_where_it_enters_and_a_draw_relieves_it():
    initiation, reach = 600.0, 1.5e-3
    blunt = Effects(bluntness=Bluntness(initiation, reach))
    extra = {}
    for ratio in (0.0, 3.0):
        base, other = (
            simulate(bar(), effects, press(0.014, ratio)) for effects in (Effects(), blunt)
        )
        extra[ratio] = (other.edge - base.edge)[:, 2]
        assert other.balance.edge - base.balance.edge == pytest.approx(
            initiation * WIDTH * reach, rel=0.03
        )
        late = steady(base)
        assert other.edge[late, 2].mean() == pytest.approx(base.edge[late, 2].mean(), rel=0.02)
    assert extra[0.0].max() > 0.5 * initiation * WIDTH
    assert extra[3.0].max() < 0.15 * extra[0.0].max()


def test_the_entry_force_grows_with_the_slices_since_sharpening():
    models = [
        bar().derive(effects=Effects(bluntness=Bluntness(dulling=50.0, slices=n)))
        for n in (0, 1, 4, 16)
    ]
    cuts = simulate_batch(models, [motion(bar(), press(3e-3))], PERIOD)
    entry = [cut.food_wrench[:, 5].max() for cut in cuts]
    assert entry[0] == pytest.approx(TOUGHNESS * WIDTH, rel=0.05)
    assert np.diff(entry).min() > 0.3


def withdrawal(adhesion: Adhesion, speed: float = SPEED) -> tuple[np.ndarray, np.ndarray]:
    """Friction of the flanks and total force on the way out at 8 to 10 mm, per flank area, Pa."""
    model = bar(razor=False)
    up = Retract(distance=4e-3, speed=speed)
    result = simulate(model, Effects(adhesion=adhesion), press(0.012), up)
    depth = depth_of(result)
    out = (result.time > (0.012 + CLEARANCE) / SPEED) & (depth > 8.5e-3) & (depth < 1e-2)
    area = 2.0 * WIDTH * depth[out]
    return result.friction[out, 2] / area, result.food_wrench[out, 5]


def test_only_what_adheres_pulls_the_knife_back_and_the_viscous_part_goes_with_the_speed():
    nothing, total = withdrawal(Adhesion())
    assert np.abs(nothing).max() == 0.0
    assert total.min() > 0.0
    shear, total = withdrawal(Adhesion(stress=8000.0))
    assert -shear.mean() == pytest.approx(8000.0, rel=0.05)
    assert total.max() < 0.0
    slow, fast = (
        -withdrawal(Adhesion(stress=2000.0, viscosity=5e4), v)[0].mean() for v in (0.01, 0.03)
    )
    assert slow == pytest.approx(2000.0 + 5e4 * 0.01, rel=0.05)
    assert fast - slow == pytest.approx(5e4 * 0.02, rel=0.05)


def test_what_adheres_grows_with_the_root_of_the_speed_where_its_exponent_is_a_half():
    """By the formula of `Adhesion`; the slope at rest is finite."""
    adhesion = Adhesion(viscosity=3e5, exponent=0.5)
    for speed in (0.005, 0.02, 0.08):
        expected = 3e5 * speed * ((speed / 0.02) ** 2 + 0.01) ** -0.25
        assert -withdrawal(adhesion, speed)[0].mean() == pytest.approx(expected, rel=0.05)
    assert adhesion.steepest == pytest.approx(0.01**-0.25)


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.5])
@pytest.mark.parametrize("ratio", [0.0, 1.0, 3.0])
def test_the_force_of_a_draw_has_the_exponent(exponent, ratio):
    result = simulate(bar(), Effects(slice_push=SlicePush(exponent)), press(0.014, ratio))
    force = result.edge[steady(result)].mean(0)
    expected = TOUGHNESS * WIDTH / (1.0 + ratio**2) ** exponent
    assert force[2] == pytest.approx(expected, rel=0.02)
    assert -force[0] == pytest.approx(ratio * expected, rel=0.02, abs=0.01 * expected)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0])
def test_an_edge_on_its_way_out_cuts_nothing_whatever_the_exponent(exponent):
    result = simulate(
        bar(),
        Effects(slice_push=SlicePush(exponent)),
        press(4e-3),
        Retract(distance=3e-3, speed=SPEED),
    )
    out = depth_of(result) < 4e-3 - 4e-4
    out &= result.time > (4e-3 + CLEARANCE) / SPEED
    assert np.abs(result.edge[out]).max() == 0.0


def test_a_board_rises_at_its_height_with_its_stiffness_and_gives_back_what_it_took():
    segments = press(HEIGHT + 5e-4), Retract(distance=3e-3, speed=SPEED)
    board = Board(height=0.0, stiffness=4e4, dissipation=0.0)
    boards = (board, dc.replace(board, height=3e-4), dc.replace(board, stiffness=8e4))
    low, high, stiff = (simulate(bar(), Effects(), *segments, board=b) for b in boards)
    deepest = int(low.position[:, 2].argmin())
    z = low.position[:, 2]
    for result, height, stiffness in ((low, 0.0, 4e4), (high, 3e-4, 4e4), (stiff, 0.0, 8e4)):
        force = result.board_wrench[:, 5]
        np.testing.assert_allclose(force, stiffness * np.maximum(height - z, 0.0), atol=1e-9)
        down = np.interp(1e-4, -z[:deepest], force[:deepest])
        up = np.interp(-1e-4, z[deepest:], force[deepest:])
        assert up == pytest.approx(down, rel=1e-6)


ARMS = [2e-5, 2e-4]


@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_gives_in_proportion_to_the_force_and_stretches_the_depth(arm):
    model = bar(razor=False, friction=0.2)
    segments = press(0.012), Hold(duration=0.1)
    rigid = simulate(model, Effects(), *segments)
    result = simulate(model, Effects(compliance=Compliance(arm=arm)), *segments)
    force = result.food_wrench[:, 5]
    given = result.position[:, 2] - rigid.position[:, 2]
    np.testing.assert_allclose(given, arm * force, atol=2e-4 * arm * force.max())
    # The same force at the same true depth, and none of the chatter of a coupling that is late.
    pressing = result.time < (0.012 + CLEARANCE) / SPEED
    at_depth = np.interp(
        depth_of(result), depth_of(rigid)[pressing], rigid.food_wrench[pressing, 5]
    )
    late = pressing & (depth_of(result) > 2e-3)
    np.testing.assert_allclose(force[late], at_depth[late], rtol=0.03)
    assert force[-20:].std() < 1e-3 * force[-1]


def test_an_arm_shares_the_force_of_the_board():
    arm, board = 1e-4, Board(height=0.0, stiffness=1e5, dissipation=0.0)
    segments = press(HEIGHT + 1e-3), Hold(duration=0.02)
    result = simulate(bar(), Effects(compliance=Compliance(arm=arm)), *segments, board=board)
    total = result.food_wrench[-1, 5] + result.board_wrench[-1, 5]
    assert result.board_wrench[-1, 5] > 3.0
    assert result.position[-1, 2] + 1e-3 == pytest.approx(arm * total, rel=1e-3)


def test_a_food_that_slips_drops_the_lateral_force_and_jumps():
    resistance, remaining, holder = 2.0, 0.5, 1e-4
    ratio = 2.0
    results = {
        name: simulate(
            bar(), Effects(compliance=Compliance(holder=holder), slip=slip), press(0.014, ratio)
        )
        for name, slip in {"holds": Slip(), "slips": Slip(resistance, remaining)}.items()
    }
    holds, slips = results["holds"], results["slips"]
    draw = {name: -result.food_wrench[:, 3] for name, result in results.items()}
    assert draw["holds"].max() > 1.3 * resistance
    assert draw["slips"].max() < 1.05 * resistance
    # Within one coupling step, more than any other change.
    drops = -np.diff(draw["slips"])
    assert drops.max() > 0.8 * (1.0 - remaining) * resistance
    assert -np.diff(draw["holds"]).min() < 0.5 * drops.max()
    # The food has moved by more than its holder's stretch, and friction has taken energy.
    moved = {name: r.position[-1, 0] - r.pose.p[0] for name, r in results.items()}
    assert moved["holds"] == pytest.approx(holder * draw["holds"][-1], rel=1e-3)
    slid = moved["slips"] - holder * draw["slips"][-1]
    assert slid > 2e-3
    for result in (holds, slips):
        steps = np.diff(np.vstack([result.position[0], result.position]), axis=0)
        given = -float((result.food_wrench[:, 3:] * steps).sum())
        stored = 0.5 * holder * float(result.food_wrench[-1, 3]) ** 2
        lost = given - result.balance.work - stored
        expected = remaining * resistance * slid if result is slips else 0.0
        assert lost == pytest.approx(expected, rel=0.25, abs=2e-4)


ALL = Effects(
    toughness_rate=ToughnessRate(0.1),
    relaxation=Relaxation([0.2, 0.1], [0.02, 0.06]),
    skin=Skin(0.1),
    core=Core(4e-3, 1e-3, 0.7, 0.8),
    centre=Centre(5e-3, 1e-3, 1.3),
    underside=Underside(5e-3, 1e-3, 0.6),
    bluntness=Bluntness(100.0, 2e-3, 10.0, 1.0, 5),
    adhesion=Adhesion(500.0, 1e4),
    slice_push=SlicePush(0.8),
    compliance=Compliance(2e-5, 2e-5),
    slip=Slip(3.0),
)


def test_with_all_effects_on_the_energy_balance_closes_and_no_loss_is_negative():
    model = bar(razor=False, friction=0.1).derive(effects=ALL)
    solver = CuttingSolver(model.with_step(2.5e-4), PERIOD)
    losses = []
    run = solver.driver.run

    def recorded(*arguments):
        for launch, steps in run(*arguments):
            losses.append([getattr(steps[0].balance, name) for name in LOSSES])
            yield launch, steps

    solver.driver.run = recorded  # type: ignore[method-assign]
    path = motion(
        model,
        press(0.01, 1.0),
        Hold(duration=0.04),
        Retract(distance=0.015, speed=0.05),
        Hold(duration=0.3),
    )
    result = simulate_slice(solver, path)
    balance = result.balance
    assert abs(balance.residual(result.energies)) < 0.01 * balance.work
    assert np.min(losses) > -1e-6 * np.sum(losses)
    # At rest and relaxed: the bulk has lost what it did not give back.
    assert balance.damping(result.energies) > 0.0


SHOWN = {
    "toughness_rate": Effects(toughness_rate=ToughnessRate(0.1)),
    "relaxation": Effects(relaxation=Relaxation([0.6], [0.15])),
    "skin": Effects(skin=Skin(0.2)),
    "core": Effects(core=Core(3e-3, 1e-4, 0.8)),
    "centre": Effects(centre=Centre(4e-3, 1e-3, 1.2)),
    "bluntness": Effects(bluntness=Bluntness(600.0)),
    "adhesion": Effects(adhesion=Adhesion(6000.0, 1e5)),
    "slice_push": Effects(slice_push=SlicePush(1.5)),
    "arm": Effects(compliance=Compliance(arm=5e-5)),
    "holder": Effects(compliance=Compliance(holder=5e-5)),
    "slip": Effects(compliance=Compliance(holder=5e-5), slip=Slip(1.5)),
}
EXPERIMENTS = {
    "hold": {"relaxation"},
    "withdrawal": {"adhesion"},
    "speed": {"toughness_rate", "adhesion"},
    "draw": {"slice_push", "adhesion", "slip"},
}


@pytest.fixture(scope="module")
def experiments() -> dict[str, dict[str, float]]:
    """One number from each experiment, for the base and each group."""
    model = bar(razor=False).derive(numerics=Numerics())
    models = [model, *(model.derive(effects=effects) for effects in SHOWN.values())]
    # What rings where the edge's force drops all at once must be settled early in the hold.
    models[1] = models[1].derive(numerics=bar().numerics)
    up = Retract(distance=3e-3, speed=SPEED)
    paths = {
        "slow": motion(model, press(0.0125, speed=0.01)),
        "held": motion(model, press(0.0125), Hold(duration=0.3), up),
        "drawn": motion(model, press(0.0125, 1.0, SPEED / np.sqrt(2.0))),
    }
    cuts = {name: simulate_batch(models, [path], PERIOD) for name, path in paths.items()}
    stop = round((0.0125 + CLEARANCE) / SPEED / PERIOD)
    held = round(0.3 / PERIOD)
    out: dict[str, dict[str, float]] = {name: {} for name in EXPERIMENTS}
    for k, name in enumerate(["base", *SHOWN]):
        assert all(cut[k].failure is None for cut in cuts.values())
        force = cuts["held"][k].food_wrench[:, 5]

        def plateau(cut: BatchSlice) -> float:
            depth = depth_of(cut)
            return float(cut.food_wrench[(depth > 9e-3) & (depth < 0.0115), 5].mean())

        held_cut = cuts["held"][k]
        pressed = plateau(
            dc.replace(
                held_cut,
                position=held_cut.position[:stop],
                food_wrench=held_cut.food_wrench[:stop],
            )
        )
        out["hold"][name] = (force[stop + held - 1] - force[stop + held // 3]) / pressed
        out["withdrawal"][name] = min(force[stop + held + 20 :].min(), 0.0)
        out["speed"][name] = plateau(cuts["slow"][k]) / pressed
        out["draw"][name] = plateau(cuts["drawn"][k]) / pressed
    return out


@pytest.mark.parametrize("group", SHOWN)
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_a_group_answers_to_its_experiments_and_to_no_other(experiments, experiment, group):
    values = experiments[experiment]
    change = abs(values[group] - values["base"])
    if group in EXPERIMENTS[experiment]:
        assert change > 0.03
    else:
        assert change < 0.015


WRONG = {
    "{toughness_rate: {exponent: 2}}": "toughness_rate.exponent",
    "{relaxation: {shares: [0.5], times: []}}": "relaxation.times",
    "{relaxation: {shares: [0.6, 0.5], times: [1, 2]}}": "relaxation.shares",
    "{relaxation: {shares: [-0.1], times: [1]}}": "relaxation.shares",
    "{relaxation: {shares: [0.1], times: [0]}}": "relaxation.times",
    "{relaxation: {shares: [.nan], times: [1]}}": "relaxation.shares",
    "{skin: {toughness: -1}}": "skin.toughness",
    "{skin: {thickness: 0.3}}": "skin.thickness",
    "{core: {toughness_ratio: 0}}": "core.toughness_ratio",
    "{core: {transition: 0}}": "core.transition",
    "{bluntness: {slices: 1.5}}": "bluntness.slices",
    "{bluntness: {depth: 0}}": "bluntness.depth",
    "{adhesion: {stress: -5}}": "adhesion.stress",
    "{slice_push: {exponent: -0.1}}": "slice_push.exponent",
    "{compliance: {arm: 20}}": "compliance.arm",
    "{slip: {resistance: 5}}": "slip.resistance",
    "{slip: {remaining: 1.5}, compliance: {holder: 1e-5}}": "slip.remaining",
    "{skins: {toughness: 1}}": "skins",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_value_is_refused_with_its_field_and_a_fix(text):
    with pytest.raises(ConfigurationError) as error:
        load_yaml(Effects, None, overrides_text=text)
    assert (error.value.field or "").removeprefix("effects.").startswith(WRONG[text])
    assert error.value.fix


PLAIN = [0.0, 0.004, 0.01]
FINER = [0.0, 0.0028, 0.0064, 0.012]


def punctured(rings=6, layers=PLAIN, speed=0.02, load=800.0) -> float:
    """Greatest force on a round food, before its skin gives way, N."""
    food = Food(
        shape=Cylinder(diameter=0.048, length=0.05, rings=rings, layers=layers),
        material=Material(youngs_modulus=1e6, toughness=400.0, friction=0.0, damping_time=1e-3),
        effects=Effects(skin=Skin(5e-4 * load, 5e-4)),
        held_sides="none",
    )
    model = make_food_model(food, Knife(), Numerics(time_step=5e-4))
    press = ConstantSpeed(distance=5e-3, speed=speed, acceleration=None)
    start = start_pose(model, 5e-4)
    force = simulate_slice(CuttingSolver(model, PERIOD), Motion(MotionPlan([press]), start))
    force = force.food_wrench[:, 5]
    before = force.argmax()
    # It snaps: the edge goes through the skin along all that it presses on.
    assert force[before + 1 :].min() < 0.75 * force[before]
    return force[before]


def test_a_round_food_gives_way_under_its_skin_until_the_line_load_of_its_puncture():
    force = punctured()
    # Of any mesh and knife speed. The blade presses on more of a skin that holds more.
    assert punctured(layers=FINER) == pytest.approx(force, rel=0.07)
    assert punctured(speed=0.06) == pytest.approx(force, rel=0.07)
    assert punctured(load=1200.0) > 1.5 * force


def test_each_end_of_a_piece_of_skin_carries_half_of_it():
    food = Food(shape=Cylinder(diameter=0.048, length=0.05, rings=6, layers=PLAIN))
    tables = make_food_model(food, Knife(), Numerics()).tables
    assert Skin(0.4, 5e-4).line_load == pytest.approx(800.0)
    perimeter = 36 * 0.048 * np.sin(np.pi / 36)
    assert 0.5 * tables.outline.sum() == pytest.approx(perimeter, rel=5e-3)
    lower = 0.5 * (tables.outline * tables.lower).sum()
    assert lower == pytest.approx(0.5 * perimeter, rel=0.1)


@pytest.mark.parametrize("modulus", [5e5, 2e6])
@pytest.mark.parametrize("divisions", [[4, 5], [8, 5]])
@pytest.mark.parametrize("step", [2.5e-4, 5e-4])
def test_a_level_skin_is_punctured_at_its_line_load_times_its_length(modulus, divisions, step):
    skin, toughness = Skin(0.1, 5e-4), 10.0
    food = Food(
        shape=Box(size=[WIDTH, 0.1, HEIGHT], divisions=divisions, layers=[0.0, 0.004, 0.012]),
        material=Material(modulus, toughness=toughness, friction=0.0, damping_time=1e-3),
        effects=Effects(skin=skin),
    )
    model = make_food_model(food, bar().knife, Numerics(time_step=step))
    force = simulate_slice(CuttingSolver(model, PERIOD), motion(model, press(3e-3))).edge[:, 2]
    # Below it the edge goes on through flesh and the skin of both sides.
    inside = toughness * WIDTH + 2.0 * skin.toughness
    assert force.max() == pytest.approx(skin.line_load * WIDTH + inside, rel=0.025)
    assert force[-1] == pytest.approx(inside, rel=0.1)


@pytest.mark.parametrize("layers", [PLAIN, FINER])
def test_a_skin_holds_its_line_load_along_the_edge_that_has_entered_it(layers):
    skin = Skin(0.4, 5e-4)
    food = Food(
        shape=Cylinder(diameter=0.048, length=0.05, rings=6, layers=layers),
        material=Material(1e6, toughness=10.0, friction=0.0, damping_time=1e-3),
        effects=Effects(skin=skin),
    )
    model = make_food_model(food, Knife(), Numerics(time_step=5e-4))
    solver = CuttingSolver(model, PERIOD)
    result = simulate_slice(solver, motion(model, press(1.5e-3)))
    tables = model.tables
    entered = solver.field(result.state, "skin_depth").ravel()[: len(tables.area)]
    along = np.linspace(0.0, 1.0, 501)
    # Both ends of a piece hold half of it.
    beside = entered[tables.beside][..., None]
    between = beside + (entered[:, None, None] - beside) * along
    inside = (between > 0.0) & (between < skin.thickness)
    length = 0.5 * (tables.outline * (1.0 - tables.lower) * inside.mean(2)).sum()
    assert 4e-3 < length < 0.02
    assert result.edge[-1, 2] == pytest.approx(skin.line_load * length, rel=0.02)


def test_a_skin_that_snaps_dissipates_its_toughness_times_the_outline():
    balances = []
    for skin in (Skin(), Skin(0.4, 5e-4)):
        food = Food(
            shape=Cylinder(diameter=0.048, length=0.05, rings=6, layers=PLAIN),
            material=Material(1e6, toughness=400.0, friction=0.0, damping_time=1e-3),
            effects=Effects(skin=skin),
        )
        model = make_food_model(food, Knife(), Numerics(time_step=5e-4))
        result = simulate_slice(CuttingSolver(model, PERIOD), motion(model, press(0.05)))
        balances.append(result.balance.edge + result.balance.opening)
    work = skin.toughness * 0.5 * model.tables.outline.sum()
    assert balances[1] - balances[0] == pytest.approx(work, rel=0.02)


def test_a_soft_food_with_a_skin_is_punctured_on_any_mesh_where_its_wall_is_stiff():
    shapes = [
        Cylinder(diameter=0.048, length=0.05, rings=rings, layers=layers)
        for rings, layers in ((4, [0.0, 0.004, 0.01]), (6, [0.0, 0.002, 0.006, 0.012]))
    ]
    wall = Core(rind=6e-3, stiffness_ratio=0.15)
    for shape in shapes:
        models = [
            make_food_model(
                Food(
                    shape=shape,
                    material=Material(
                        youngs_modulus=E, toughness=200.0, damping_time=1e-3, friction=0.1
                    ),
                    effects=Effects(skin=Skin(0.4, 5e-4), core=core),
                    held_sides="none",
                ),
                Knife(),
                Numerics(board_friction=0.6),
            )
            for E, core in ((2.5e5, Core()), (8e5, wall))
        ]
        assert ["folds around the edge" in " ".join(m.warnings) for m in models] == [True, False]
        press = ConstantSpeed(distance=1.2e-2, speed=0.02, acceleration=None)
        motion = Motion(MotionPlan([press]), start_pose(models[1], 5e-4))
        result = simulate_slice(CuttingSolver(models[1], PERIOD), motion)
        assert result.food_wrench[:, 5].max() > result.food_wrench[-1, 5] + 2.0
        assert result.energies.least_volume_ratio > 0.5
