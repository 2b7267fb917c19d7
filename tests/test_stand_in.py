"""The stand-in: signatures of its effects, its two worlds, and records that give nothing away."""

import ast
import dataclasses as dc
import functools
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    MotionPlan,
    PressAndDraw,
    Retract,
    Waypoints,
)
from sliceit_drake.records.slice_record import SliceRecord, read_table
from sliceit_drake.records.validation import check_table, load_record, load_records
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect import Effect, Series
from sliceit_drake.stand_in.effect_registry import EFFECTS, make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import (
    Condition,
    Protocol,
    Variation,
    load_protocol,
    protocol_of_scenario,
    schedule,
)
from sliceit_drake.stand_in.sensor_model import SensorModel, measured
from sliceit_drake.stand_in.session import WORLDS, Session, record_session

PACKAGE = Path(__file__).resolve().parent.parent / "sliceit_drake"
COARSE = FiniteElementSettings(refinement=0.5, time_step=5e-4, travel=1.2e-4)
IDEAL = SensorModel(
    rate=500.0,
    force_noise=0.0,
    torque_noise=0.0,
    force_bias=0.0,
    torque_bias=0.0,
    force_drift=0.0,
    torque_drift=0.0,
    delay=0.0,
    cutoff_frequency=0.0,
    force_resolution=0.0,
    torque_resolution=0.0,
)
SAME = Variation(toughness=0.0, stiffness=0.0, friction=0.0, height=0.0)


def wrench(record: SliceRecord) -> np.ndarray:
    """Torque about Ko and force on the knife in W [n, 6]; Nm, N."""
    assert record.force is not None and record.torque is not None
    return np.column_stack([record.torque, record.force])


def push(speed: float) -> list:
    """Down to the middle, held, on to 2 mm over the board, withdrawn, once more, withdrawn."""
    return [
        Hold(0.1, label="air"),
        ConstantSpeed(speed=speed, distance=0.016, label="slice"),
        Hold(0.5, label="hold"),
        ConstantSpeed(speed=speed, distance=0.011, label="through"),
        Retract(speed=0.05, distance=0.027, label="retract"),
        ConstantSpeed(speed=speed, distance=0.025, label="second_pass"),
        Retract(speed=0.05, distance=0.025, label="retract"),
        Hold(0.1, label="air"),
    ]


def draw(ratio: float) -> list:
    return [
        PressAndDraw(press_speed=0.02, distance=0.025, draw_ratio=ratio, label="slice"),
        Hold(0.1, label="hold"),
    ]


MOTIONS = {
    "push": push(0.02),
    "slow": push(0.006),
    "fast": push(0.06),
    "draw": draw(1.0),
    "far_draw": draw(1.0),
    "air": [
        Hold(0.2, label="air"),
        Waypoints(times=[0.4, 0.8], positions=[[0, 0, 0.0]] * 2, rotations=[[0.4, 0, 0.0]] * 2),
    ],
    "board": [
        ConstantSpeed(speed=0.02, distance=0.0035, label="board_press"),
        Retract(speed=0.02, distance=0.0035, label="retract"),
    ],
    "weight": [Hold(0.3, label="weight")],
}


def bench(motion: str, **condition: object) -> Protocol:
    """Twenty equal slices, ideally measured."""
    special = {
        "air": {"clearance": 0.06},
        "board": {"clearance": -0.024, "without_food": True},
        "weight": {"clearance": 0.06, "without_food": True, "weight": 1.5},
        "draw": {"offset": -0.012},
        "far_draw": {"offset": 0.02},
    }.get(motion, {})
    one = Condition(
        label=motion,
        motion=MotionPlan(MOTIONS[motion]),
        replicates=20,
        clearance=2e-3,
        **{},
    )
    one = dc.replace(one, **special, **condition)
    return Protocol(conditions=[one], sensor=IDEAL, variation=SAME)


@functools.cache
def series(
    effect: str = "",
    motion: str = "push",
    index: int = 0,
    world: str = WORLDS[0],
    **condition: bool,
) -> Series:
    """A slice with one hidden effect, or none."""
    hidden = [make_effect(effect)] if effect else []
    return Session(bench(motion, **condition), hidden, world, 1, COARSE).series(index)[0]


@functools.cache
def measured_force(effect: str = "", motion: str = "push", index: int = 0) -> np.ndarray:
    """What the sensor shows of it, in W [n, 3]."""
    hidden = [make_effect(effect)] if effect else []
    return Session(bench(motion), hidden, WORLDS[0], 1, COARSE).record(index).force


def during(s: Series, *labels: str) -> np.ndarray:
    return np.isin(s.phase, labels)


def added(effect: str, motion: str = "push", world: str = WORLDS[0], index: int = 0) -> np.ndarray:
    """The vertical force that an effect adds [n]."""
    with_it, without = series(effect, motion, index, world), series("", motion, index, world)
    return with_it.force[:, 2] - without.force[:, 2]


class EveryExchange(Effect):
    every_coupling_step = True


# Null sizes


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_of_no_size_changes_nothing(name, world):
    plan = [
        PressAndDraw(press_speed=0.03, distance=0.012, draw_ratio=0.5, label="slice"),
        Hold(0.1, label="hold"),
        Retract(speed=0.05, distance=0.01, label="retract"),
    ]
    protocol = bench("push")
    protocol.conditions[0].motion = MotionPlan(plan)
    # A slip that does not move and one that cannot be are the same; so is a dull edge's first cut.
    hidden = [EFFECTS[name](0.0)]
    plain = [EveryExchange()] if hidden[0].every_coupling_step else []
    forces = [
        wrench(Session(protocol, effects, world, 1, COARSE).record(3))
        for effects in (hidden, plain)
    ]
    np.testing.assert_allclose(forces[0], forces[1], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_of_its_typical_size_shows_somewhere_in_the_full_protocol(name):
    motions = {"board_law": "board", "sensor_drift": "air", "tool_weight": "air"}
    motion = motions.get(name, "draw")
    change = measured_force(name, motion, 9) - measured_force("", motion, 9)
    assert np.abs(change).max() > 0.1


# Signatures


@pytest.mark.parametrize("world", WORLDS)
def test_a_viscoelastic_bulk_fades_by_a_power_of_time_in_a_hold_and_keeps_the_plateau(world):
    with_it, without = series("bulk_relaxation:0.1", world=world), series(world=world)
    hold = np.flatnonzero(during(without, "hold"))
    share = with_it.edge[hold, 5] / without.edge[hold, 5]
    t = without.time[hold] - without.time[hold[0]]
    slope = np.diff(np.log(share[[20, -1]])) / np.diff(np.log(0.02 + t[[20, -1]]))
    assert slope == pytest.approx(-0.1, rel=0.05)
    cutting = during(without, "slice") & (without.depth > 5e-3)
    change = with_it.edge[cutting, 5] / without.edge[cutting, 5]
    np.testing.assert_allclose(change, 1.0, atol=1e-6)


def test_flanks_press_less_on_a_slow_cut_of_a_viscoelastic_bulk():
    shares = []
    for motion in ("slow", "fast"):
        with_it, without = series("bulk_relaxation:0.1", motion), series("", motion)
        at = during(without, "slice") & (without.depth > 12e-3)
        shares.append(with_it.normal[at, 5].sum() / without.normal[at, 5].sum())
    assert shares[0] < shares[1] - 0.05 < 0.95


@pytest.mark.parametrize("world", WORLDS)
def test_a_rate_dependent_toughness_grows_with_the_logarithm_of_speed_and_holds_without_decay(
    world,
):
    shares = []
    for motion in ("slow", "push", "fast"):
        with_it, without = (series(e, motion, world=world) for e in ("rate_toughness:0.1", ""))
        at = during(without, "slice") & (without.depth > 8e-3)
        shares.append(with_it.edge[at, 5].sum() / without.edge[at, 5].sum())
    expected = 1.0 + 0.1 * np.log([0.3, 1.0, 3.0])
    np.testing.assert_allclose(shares, expected, rtol=0.02)
    change = added("rate_toughness:0.1", world=world)[during(series(), "hold")]
    assert np.ptp(change[20:]) < 0.15 * abs(change[20])


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("effect", ["flank_friction", "flank_adhesion"])
def test_what_rubs_on_the_flanks_turns_its_sign_on_withdrawal_and_is_there_in_an_open_cut(
    effect, world
):
    change, s = added(effect, world=world), series(world=world)
    buried = s.depth > 10e-3
    assert change[during(s, "through") & buried].min() > 0.2
    assert change[during(s, "second_pass") & buried & (s.depth < 20e-3)].min() > 0.1
    leaving = during(s, "retract") & buried & (s.depth < 23e-3)
    assert change[leaving].max() < -0.1
    assert np.abs(change[during(s, "air")]).max() < 1e-6


@pytest.mark.parametrize("world", WORLDS)
def test_what_sticks_to_the_flanks_pulls_where_the_food_is(world):
    """Far along the blade its moment is that of a force in the middle of the section."""
    with_it, without = (series(e, "far_draw", world=world) for e in ("flank_adhesion:400", ""))
    change = with_it.other - without.other
    at = during(with_it, "slice") & (with_it.depth > 21e-3)
    p_middle = (
        with_it.p_true[at]
        + np.cross(change[at, 3:], change[at, :3])
        / np.einsum("nc,nc->n", change[at, 3:], change[at, 3:])[:, None]
    )
    # The point of the line of action that is nearest to Ko; the line runs through the food.
    direction = change[at, 3:] / np.linalg.norm(change[at, 3:], axis=1)[:, None]
    middle = np.array([0.0, 0.0, 0.5 * with_it.slice.height])
    off = np.cross(middle - p_middle, direction)
    assert with_it.p_true[at, 0].min() > 0.03
    assert np.linalg.norm(off, axis=1).max() < 3e-3


def test_adhesion_halves_when_a_knife_at_the_reference_speed_stops():
    change, s = added("flank_adhesion:400"), series()
    hold = np.flatnonzero(during(s, "hold"))
    assert change[hold[-1]] == pytest.approx(400.0 * s.flank[hold[-1]], rel=0.01)
    assert change[hold[0] - 2] == pytest.approx(800.0 * s.flank[hold[0] - 2], rel=0.05)


@pytest.mark.parametrize("world", WORLDS)
def test_another_toughness_scales_the_plateau_and_leaves_the_open_cut(world):
    with_it, without = series("toughness:0.2", world=world), series(world=world)
    at = during(without, "slice") & (without.depth > 6e-3)
    ratio = with_it.edge[at, 5].sum() / without.edge[at, 5].sum()
    assert ratio == pytest.approx(1.2, rel=0.03)
    again = during(without, "second_pass") & (without.depth < 20e-3)
    change = added("toughness:0.2", world=world)[again]
    assert np.abs(change).max() < 0.06 * np.abs(without.force[:, 2]).max()


@pytest.mark.parametrize("world", WORLDS)
def test_a_skin_takes_its_energy_per_length_of_outline_and_nothing_where_it_is_peeled(world):
    with_it, without = series("skin:0.5", world=world), series(world=world)
    at = during(without, "slice", "through")
    work = ((with_it.edge - without.edge)[at, 5] * without.press[at]).sum() * without.period
    # The last 2 mm over the board are not cut.
    d, left = 0.027, 2e-3
    outline = np.pi * d - 2.0 * d * np.arcsin(np.sqrt(left / d))
    assert work == pytest.approx(0.5 * outline, rel=0.12)
    peeled, bare = (series(e, world=world, peeled=True) for e in ("skin:0.5", ""))
    np.testing.assert_array_equal(peeled.force, bare.force)


@pytest.mark.parametrize("world", WORLDS)
def test_a_blunt_edge_raises_the_beginning_and_less_so_in_a_draw(world):
    change, s = added("blunt_edge", world=world), series(world=world)
    at = during(s, "slice") & (s.depth > 0.0)
    depth, change = s.depth[at], change[at]
    assert change[depth < 5e-3].sum() > 3.0 * change[depth > 8e-3].sum()
    drawn, plain = series("blunt_edge", "draw", 0, world), series("", "draw", 0, world)
    shares = [
        (a.edge[:, 5].sum() - b.edge[:, 5].sum()) / b.edge[:, 5].sum()
        for a, b in ((drawn, plain), (series("blunt_edge", world=world), s))
    ]
    assert 0.0 < shares[0] < 0.9 * shares[1]


def test_a_dulling_edge_cuts_the_first_slice_sharp_and_each_later_one_worse():
    work = [added("dulling_edge", index=k).sum() for k in (0, 6, 12, 19)]
    assert work[0] == 0.0
    assert work[1] > 0.0
    assert np.diff(work).min() > 0.0
    assert work[3] - work[2] < work[2] - work[1] < work[1]


@pytest.mark.parametrize("world", WORLDS)
def test_another_slice_push_law_shows_in_a_draw_alone_and_breaks_the_ratio_of_the_forces(world):
    np.testing.assert_array_equal(added("slice_push_law", world=world), 0.0)
    ratios = []
    for effect in ("", "slice_push_law"):
        s = series(effect, "draw", 0, world)
        at = during(s, "slice") & (s.depth > 10e-3)
        ratios.append(-s.edge[at, 3].sum() / s.edge[at, 5].sum())
    assert ratios[0] == pytest.approx(1.0, rel=0.05)
    assert ratios[1] < 0.9 * ratios[0]
    assert added("slice_push_law", "draw", world).sum() > 0.0


@pytest.mark.parametrize("world", WORLDS)
def test_a_section_of_another_shape_takes_from_above_and_adds_below_at_any_speed(world):
    for motion in ("slow", "push"):
        change, s = added("section_shape", motion, world), series("", motion, 0, world)
        cutting = during(s, "slice", "through")
        assert change[cutting & (s.depth > 3e-3) & (s.depth < 9e-3)].mean() < -0.05
        assert change[cutting & (s.depth > 18e-3) & (s.depth < 23e-3)].mean() > 0.05


@pytest.mark.parametrize("world", WORLDS)
def test_a_core_shows_in_the_middle_of_the_depth(world):
    change, s = added("core", world=world), series(world=world)
    cutting = during(s, "slice", "through")
    middle = change[cutting & (np.abs(s.depth - 13.5e-3) < 2e-3)].mean()
    outside = change[cutting & (s.depth > 1e-3) & (s.depth < 3e-3)].mean()
    assert middle < 2.0 * outside < 0.0 and middle < -0.5


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("effect", ["board_height", "board_law"])
def test_another_board_shows_on_the_board_alone_and_gives_back_what_it_took(effect, world):
    change, s = added(effect, "board", world), series("", "board", 0, world)
    down, up = during(s, "board_press"), during(s, "retract")
    assert np.abs(change[s.p[:, 2] > 3e-4]).max() < 1e-9
    assert change[down].max() > 0.5
    # Dissipation, 1 s/m at 20 mm/s, takes a few per cent of that.
    z, way_down, way_up = s.p[:, 2], np.flatnonzero(down), np.flatnonzero(up)
    at = -2e-4
    taken = np.interp(at, z[way_down][::-1], change[way_down][::-1])
    assert np.interp(at, z[way_up], change[way_up]) == pytest.approx(taken, rel=0.12)


@pytest.mark.parametrize("world", WORLDS)
def test_an_arm_gives_in_proportion_to_the_force_and_its_encoders_do_not_see_it(world):
    s, rigid = series("arm_compliance:4e-5", world=world), series(world=world)
    np.testing.assert_array_equal(s.p, rigid.p)
    hold = np.flatnonzero(during(s, "hold"))
    given = s.p_true[hold, 2] - s.p[hold, 2]
    # Two thirds at once (0.03 s), the rest in 0.6 s.
    late = given[-1] / s.force[hold[-1], 2] / 4e-5
    assert 2.0 / 3.0 < late < 1.0
    assert np.abs(s.p_true - s.p)[during(s, "air")][:40].max() < 1e-9
    assert not np.any(rigid.p_true - rigid.p)


def test_a_soft_arm_does_not_chatter_on_a_stiff_contact():
    soft = series("arm_compliance:1.5e-4")
    resting = during(soft, "hold")
    force = soft.force[resting, 2]
    assert np.abs(np.diff(force[25:])).max() < 0.1
    assert force[25] > force[-1] > 0.5 * force[25]


def test_a_holder_gives_along_the_edge_and_only_in_a_draw():
    np.testing.assert_allclose(added("holder_compliance")[during(series(), "slice")], 0.0, atol=0.1)
    s = series("holder_compliance:1e-4", "draw")
    assert np.isfinite(s.force).all()
    assert np.abs(s.force - series("", "draw").force)[:, 0].max() > 0.05


@pytest.mark.parametrize("world", WORLDS)
def test_food_slips_in_most_slices_each_at_a_depth_of_its_own_with_a_lateral_knock(world):
    depths = []
    for index in range(5):
        s, plain = series("food_slip", "push", index, world), series(world=world)
        jump = np.abs(s.other[:, 4])
        if jump.max() > 0.0:
            k = int(np.argmax(jump > 0.0))
            depths.append(s.depth[k])
            assert s.force[k : k + 15, 2].min() < plain.force[k, 2] - 0.5
    assert 2 <= len(depths) <= 5
    assert np.ptp(depths) > 1e-3


def test_a_gain_scales_every_channel_and_nothing_else():
    for motion in ("push", "weight"):
        plain, scaled = measured_force("", motion), measured_force("sensor_gain:0.1", motion)
        np.testing.assert_allclose(scaled, 1.1 * plain, atol=1e-9)


def test_a_known_weight_is_what_the_sensor_shows():
    np.testing.assert_allclose(measured_force("", "weight"), [[0, 0, -1.5 * 9.81]] * 150, atol=1e-9)


def test_a_drifting_zero_is_there_in_the_air_and_grows():
    force = np.linalg.norm(measured_force("sensor_drift:0.5", "air"), axis=1)
    assert force[0] == pytest.approx(0.5, rel=0.02)
    assert np.diff(force).min() > 0.0


def test_a_tilted_sensor_shows_a_lateral_force_in_proportion_to_the_vertical_one():
    plain, tilted = measured_force("", "push"), measured_force("sensor_tilt:0.1", "push")
    pressed = np.abs(plain[:, 2]) > 2.0
    lateral = np.linalg.norm((tilted - plain)[pressed, :2], axis=1)
    np.testing.assert_allclose(lateral / np.abs(plain[pressed, 2]), np.sin(0.1), rtol=0.03)


def test_a_late_sensor_is_behind_by_its_delay_where_the_force_rises_steadily():
    t = 2e-3 * np.arange(400)
    wrench = np.outer(t, np.ones(6))
    late = make_effect("sensor_delay:0.015").measure(series(), wrench)
    assert (wrench - late)[-1, 5] == pytest.approx(0.015, rel=1e-3)
    change = measured_force("sensor_delay") - measured_force()
    s = series()
    rising = during(s, "slice") & (s.depth > 1e-3) & (s.depth < 4e-3)
    assert change[rising, 2].max() < 0.0
    leaving = during(s, "retract") & (s.depth < 20e-3) & (s.depth > 15e-3)
    assert change[leaving, 2].mean() < 0.0  # The pull fades on the way out.


def test_a_weight_that_is_not_taken_off_shows_as_the_tool_turns():
    force = measured_force("tool_weight:0.4", "air")
    np.testing.assert_allclose(force[:90], 0.0, atol=1e-9)
    turned = series("", "air").R[-1]
    weight = np.array([0.0, 0.0, -0.4 * 9.81])
    # In the sensor's axes its weight turned from where it was zeroed.
    upright = series("", "air").R[0]
    expected = turned @ (turned.T @ weight - upright.T @ weight)
    yaw = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(force[-1], yaw @ expected, atol=1e-6)


@pytest.mark.parametrize(
    ("effect", "ratio"), [("drive_vibration", 1.0), ("stick_slip", 0.006 / 0.02)]
)
def test_drives_shake_at_their_frequency_and_stick_slip_at_the_speeds(effect, ratio):
    frequencies = []
    for motion in ("slow", "push"):
        change = (measured_force(effect, motion) - measured_force("", motion))[:, 2]
        s = series("", motion)
        at = during(s, "slice") & (s.depth > 2e-3)
        spectrum = np.abs(np.fft.rfft(change[at] - change[at].mean()))
        frequencies.append(np.fft.rfftfreq(at.sum(), 2e-3)[spectrum.argmax()])
    assert frequencies[0] / frequencies[1] == pytest.approx(ratio, rel=0.1)


def test_a_magnetic_board_pulls_by_height_alone_even_where_there_is_no_food():
    change, s = added("magnetic_board", "board"), series("", "board")
    np.testing.assert_allclose(change, -2.5 / (1 + np.maximum(s.p[:, 2], 0) / 0.012) ** 2)


def test_juice_takes_friction_from_the_second_pass():
    s = series()
    again = during(s, "second_pass") & (s.depth > 15e-3)
    plain, wet = s.friction[again, 5].sum(), series("juice_film").friction[again, 5].sum()
    assert wet < 0.5 * plain


def test_a_serrated_edge_shows_by_where_along_itself_it_cuts():
    np.testing.assert_array_equal(added("serrated_edge"), 0.0)
    change, s = series("serrated_edge", "draw").edge - series("", "draw").edge, series("", "draw")
    at = during(s, "slice") & (s.depth > 5e-3)
    share = np.linalg.norm(change[at, 3:], axis=1) / np.linalg.norm(s.edge[at, 3:], axis=1)
    assert share.max() > 0.25 and share.min() < 0.05


def test_a_warm_wrist_leans_by_the_square_of_the_slices_number():
    most = [
        np.abs((series("warm_wrist", index=k).force - series(index=k).force)[:, 1]).max()
        for k in (0, 6, 12)
    ]
    assert most[0] == 0.0
    assert most[2] / most[1] == pytest.approx(4.0, rel=1e-6)


# Worlds


def imports(module: str) -> set[str]:
    tree = ast.parse((PACKAGE / "stand_in" / f"{module}.py").read_text(encoding="utf-8"))
    return {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


FINITE_ELEMENTS = (
    *("batch", "cut_surface", "elements", "cut_geometry", "gradient", "precision", "tetrahedra"),
    *("model", "mounting", "nodes", "parameters", "points", "sensitivity"),
    *("simulate", "solver", "split", "surface", "workspace", "material", "effects"),
)


@pytest.mark.parametrize(
    "module", ["curve_world", "curve_laws", "curve_cutter", "world", "effect", "sensor_model"]
)
def test_the_world_of_curves_has_no_import_of_the_finite_elements(module):
    found = {name.rpartition(".")[2] for name in imports(module) if ".cutting." in name}
    assert not found & set(FINITE_ELEMENTS)


def test_the_world_of_curves_runs_without_mesh_model_and_solver(monkeypatch):
    from sliceit_drake.cutting import model, solver
    from sliceit_drake.cutting.foods import food
    from sliceit_drake.cutting.mesh import tetrahedra

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the finite elements were used")

    monkeypatch.setattr(solver.CuttingSolver, "__init__", refuse)
    monkeypatch.setattr(model.CuttingModel, "__init__", refuse)
    monkeypatch.setattr(tetrahedra.TetrahedralMesh, "__init__", refuse)
    monkeypatch.setattr(food.Cylinder, "mesh", refuse)
    record = Session(bench("push"), [make_effect("skin")], "curves", 1).record(0)
    assert record.force[:, 2].max() > 5.0


def test_effects_are_coded_without_the_parameter_groups_of_the_simulator():
    modules = [file.stem for file in (PACKAGE / "stand_in").glob("*_effects.py")]
    assert len(modules) >= 4
    for module in modules:
        assert not [name for name in imports(module) if ".cutting" in name]
    # Elsewhere they are looked at only to refuse a food that has them.
    users = [
        file.stem
        for file in (PACKAGE / "stand_in").glob("*.py")
        if "sliceit_drake.cutting.foods.effects" in imports(file.stem)
    ]
    assert users == ["protocol"]


def test_a_food_with_effects_of_the_simulator_is_refused():
    protocol = bench("push")
    protocol.food.effects.skin.toughness = 1.0
    with pytest.raises(ConfigurationError, match="food.effects"):
        protocol.check("protocol")


def test_a_sensor_whose_readings_fall_between_coupling_steps_is_refused():
    protocol = bench("push")
    for rate, nearest in ((300.0, "250"), (800.0, "500")):
        protocol.sensor = dc.replace(IDEAL, rate=rate)
        with pytest.raises(ConfigurationError, match=rf"sensor.rate.*{nearest}"):
            protocol.check("protocol")


def test_coupling_steps_computed_as_one_give_the_force_of_each_for_itself():
    def force(effects: list[Effect]) -> np.ndarray:
        return Session(bench("slow"), effects, WORLDS[0], 1, COARSE).series(0)[0].force[:, 2]

    together, alone = force([]), force([EveryExchange()])
    assert np.sqrt(np.mean((together - alone) ** 2)) < 0.01 * np.abs(alone).max()


def test_the_curve_is_given_back_on_the_motion_that_it_was_recorded_on():
    s = series("", "push", 0, "curves")
    at = during(s, "slice")
    share = np.interp(0.012 / 0.027, s.depth[at] / 0.027, s.force[at, 2])
    curve = np.genfromtxt(
        resource_path("calibration/measured/sliceit_real_cucumber_force.csv"),
        delimiter=",",
        names=True,
    )
    force, time = curve["F_ground_truth_N"], curve["time_s"]
    first = int(np.argmax(force > 0.3))
    t = time[first] + 0.012 / 0.027 * (time[-1] - time[first])
    assert share == pytest.approx(np.interp(t, time, force), abs=0.1)


@pytest.mark.parametrize("world", WORLDS)
def test_a_draw_in_either_world_turns_the_edges_force_by_its_ratio(world):
    s = series("", "draw", 0, world)
    at = during(s, "slice") & (s.depth > 10e-3) & (s.depth < 20e-3)
    assert -s.edge[at, 3].sum() / s.edge[at, 5].sum() == pytest.approx(1.0, rel=0.05)


# Sessions


def test_a_schedule_varies_slices_as_told_and_cuts_all_replicates():
    protocol = load_protocol(str(resource_path("calibration/protocols/rich.yaml")))
    protocol.variation = Variation(toughness=0.1, height=1e-3, correlation=0.0)
    protocol.conditions[0].replicates = 2000
    slices = schedule(protocol, np.random.default_rng(0))
    labels = [s.condition.label for s in slices]
    assert labels.count("press_slow") == 2000 and labels.count("draw_3") == 3
    assert [s.index for s in slices] == list(range(len(slices)))
    assert np.std(np.log([s.toughness for s in slices])) == pytest.approx(0.1, rel=0.1)
    assert np.std([s.height for s in slices]) == pytest.approx(1e-3, rel=0.1)
    other = schedule(protocol, np.random.default_rng(1))
    assert [s.condition.label for s in other] != labels


def test_a_tougher_slice_of_higher_food_cuts_harder_and_earlier():
    protocol = bench("push")
    protocol.variation = Variation(toughness=0.2, stiffness=0.0, friction=0.0, height=1e-3)
    session = Session(protocol, [], WORLDS[0], 5, COARSE)
    plain, contact = series(), []
    for index in (0, 1):
        s = session.series(index)[0]
        contact.append(s.p[np.argmax(s.force[:, 2] > 0.05), 2])
        at, there = (during(x, "slice") & (np.abs(x.depth - 0.01) < 2e-3) for x in (s, plain))
        ratio = s.edge[at, 5].mean() / plain.edge[there, 5].mean()
        assert ratio == pytest.approx(session.specimens[index].toughness, rel=0.04)
    first, second = session.specimens[:2]
    assert contact[0] - contact[1] == pytest.approx(first.height - second.height, abs=2e-4)


@pytest.mark.parametrize("world", WORLDS)
def test_a_taller_slice_lies_on_the_board_as_well(world):
    session = Session(bench("push"), [], world, 1, COARSE)
    session.specimens[0] = dc.replace(session.specimens[0], height=1e-3)
    taller, plain = session.series(0)[0], series(world=world)
    inside = during(plain, "slice", "through") & (plain.depth > 0.0)
    share = plain.p_true[inside, 2] / plain.slice.height
    assert share[0] > 0.95 and share[-1] < 0.1
    farther = (taller.depth - plain.depth)[inside]
    np.testing.assert_allclose(farther, 1e-3 * share, atol=3e-5)


def test_noise_is_correlated_in_time_and_has_its_standard_deviation():
    sensor = dc.replace(IDEAL, force_noise=0.2, correlated_share=0.5, correlation_time=0.05)
    _, readings = measured(np.zeros((40000, 6)), 2e-3, sensor, np.random.default_rng(2))
    force = readings[:, 3:]
    assert force.std() == pytest.approx(0.2, rel=0.05)
    lag = (force[10:] * force[:-10]).mean() / force.var()
    assert lag == pytest.approx(0.5 * np.exp(-0.02 / 0.05), rel=0.15)
    assert not readings[:, :3].any()


def test_a_sensor_delays_rounds_and_saturates():
    sensor = dc.replace(IDEAL, rate=100.0, delay=0.006, force_resolution=0.5, force_range=3.0)
    wrench = np.outer(2e-3 * np.arange(1000), np.full(6, 10.0))
    rows, readings = measured(wrench, 2e-3, sensor, np.random.default_rng(0))
    assert np.diff(rows).tolist() == [5] * (len(rows) - 1)
    assert readings[20, 0] == pytest.approx(wrench[rows[20], 0] - 0.06)
    np.testing.assert_allclose(readings[:, 3:] % 0.5, 0.0)
    assert readings[:, 3:].max() == 3.0


def small(path: Path, replicates: int = 3) -> Protocol:
    """A protocol of short cuts, with noise and variation, also as a file."""
    plan = [Hold(0.1, label="air"), ConstantSpeed(speed=0.06, distance=0.02, label="slice")]
    one = Condition(label="press", motion=MotionPlan(plan), replicates=replicates)
    other = Condition(label="draw", motion=MotionPlan(draw(1.0)), replicates=2, offset=-0.012)
    protocol = Protocol(name="small", conditions=[one, other])
    dump_yaml(protocol, path)
    return protocol


@pytest.mark.parametrize("world", WORLDS)
def test_a_session_repeats_from_its_seed_and_no_other(tmp_path, world):
    protocol = small(tmp_path / "small.yaml")
    first, again, other = (Session(protocol, (), world, seed, COARSE) for seed in (7, 7, 8))
    # A slice does not depend on those made before it.
    for index in (2, 0):
        np.testing.assert_array_equal(wrench(first.record(index)), wrench(again.record(index)))
    again.record(1)
    np.testing.assert_array_equal(wrench(first.record(3)), wrench(again.record(3)))
    assert not np.array_equal(wrench(first.record(0))[:40], wrench(other.record(0))[:40])


def test_noise_of_a_slice_does_not_depend_on_what_is_hidden(tmp_path):
    protocol = small(tmp_path / "small.yaml")
    plain, hidden = (
        Session(protocol, effects, "curves", 7).record(0) for effects in ([], [make_effect("skin")])
    )
    air = plain.phase("air")
    np.testing.assert_array_equal(wrench(plain)[air], wrench(hidden)[air])
    assert not np.array_equal(wrench(plain), wrench(hidden))


def test_records_of_both_worlds_are_valid_and_tell_neither_world_nor_effect_nor_seed(tmp_path):
    protocol = small(tmp_path / "small.yaml")
    seed = 918273645
    cases = {"a": ("finite_elements", ["skin:0.7"]), "b": ("curves", []), "c": ("curves", ["skin"])}
    texts = {}
    for folder, (world, effects) in cases.items():
        files = record_session(protocol, tmp_path / folder, effects, world, seed, 1, COARSE)
        assert [file.name for file in files] == [f"slice_{k:03d}.csv" for k in range(5)]
        for file in files:
            assert [f for f in check_table(read_table(file)) if f.severity == "error"] == []
            record = load_record(file)
            assert record.force[:, 2].max() > 3.0
            assert record.metadata.condition in ("press", "draw")
        there = sorted(path.name for path in (tmp_path / folder).iterdir())
        texts[folder] = [
            (tmp_path / folder / name).read_text() for name in there if name.endswith(".yaml")
        ]
        for text in (*there, *texts[folder]):
            for hint in (str(seed), "skin", "curve", "finite", "element", "effect", "seed"):
                assert hint not in text.lower()
        assert len(there) == 10
    # All that is not measured is the same, whatever was hidden, in whatever world.
    assert texts["a"] == texts["b"] == texts["c"]
    order = [record.metadata.slice_index for record in load_records(tmp_path / "a")]
    assert order == list(range(5))


def test_a_session_that_was_stopped_goes_on_where_it_was(tmp_path):
    protocol = small(tmp_path / "small.yaml")
    whole = record_session(protocol, tmp_path / "whole", [], "curves", 3)
    part = record_session(protocol, tmp_path / "part", [], "curves", 3)
    (tmp_path / "part" / "slice_002.yaml").unlink()
    (tmp_path / "part" / "slice_004.csv").unlink()
    (tmp_path / "part" / "slice_004.yaml").unlink()
    kept = part[1].stat().st_mtime_ns
    seen = []
    record_session(
        protocol, tmp_path / "part", [], "curves", 3, progress=lambda done, n: seen.append(done)
    )
    assert seen == [3, 4, 5]
    assert part[1].stat().st_mtime_ns == kept
    for a, b in zip(whole, part, strict=True):
        assert a.read_text() == b.read_text()
    with pytest.raises(ConfigurationError, match="seed"):
        record_session(protocol, tmp_path / "part", [], "curves")
    wrong = dc.replace(protocol, conditions=protocol.conditions[:1])
    with pytest.raises(ConfigurationError, match="another folder"):
        record_session(wrong, tmp_path / "part", [], "curves", 3)


USER_EFFECT = '''
from sliceit_drake.stand_in.effect import Effect, Series

class Brine(Effect):
    """Pulls by how much is cut."""

    unit = "N"

    def respond(self, series: Series) -> None:
        series.other[:, 5] -= self.size * series.cut
'''


def test_the_command_hides_an_effect_from_a_users_file_in_two_processes(tmp_path, capsys):
    small(tmp_path / "small.yaml", replicates=2)
    (tmp_path / "brine.py").write_text(USER_EFFECT)
    arguments = ["record", str(tmp_path / "small.yaml"), "--world", "curves", "--seed", "4"]
    hidden, plain = tmp_path / "hidden", tmp_path / "plain"
    effect = ["--effect", f"{tmp_path / 'brine.py'}:2.0"]
    assert main([*arguments, *effect, "--output", str(hidden), "--workers", "2"]) == 0
    assert main([*arguments, "--output", str(plain), "--workers", "1"]) == 0
    assert "4 records" in capsys.readouterr().out
    for a, b in zip(load_records(hidden), load_records(plain), strict=True):
        change = a.force[:, 2] - b.force[:, 2]
        assert change[-1] < -0.5
        assert np.abs(change[a.phase("air")]).max(initial=0.0) == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--effect", "no_such_thing"], "is no effect"),
        (["--effect", "skin:much"], "no number"),
        (["--effect", "sensor_delay:-0.01"], "no meaning"),
        (["--effect", "toughness:nan"], "no meaning"),
        (["--effect", "missing.py"], "no such file"),
        (["--world", "moon"], "is no world"),
        (["--refinement", "9"], "refinement"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, capsys, arguments, message):
    small(tmp_path / "small.yaml")
    output = ["--output", str(tmp_path / "out"), "--seed", "1"]
    assert main(["record", str(tmp_path / "small.yaml"), *output, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_the_command_lists_the_effects(capsys):
    assert main(["record", "--list-effects"]) == 0
    table = capsys.readouterr().out.strip()
    assert all(f"`{name}`" in table for name in EFFECTS)
    assert table in (PACKAGE.parent / "docs/explanation/stand_in.md").read_text(encoding="utf-8")


def test_a_scenario_is_recorded_as_its_one_cut():
    from sliceit_drake.diagrams.scenario import load_scenario

    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    protocol = protocol_of_scenario(scenario, 2)
    record = Session(protocol, [], WORLDS[0], 0, COARSE).record(1)
    assert record.metadata.condition == "cucumber_measured"
    assert {p.label for p in record.metadata.motion.phases} == {"slice", "hold", "retract", "other"}
    assert record.metadata.motion.speed == pytest.approx(0.02)
    for name, field in (
        ("cucumber_sequence", "sequence"),
        ("cucumber_policy", "policy"),
        ("cucumber_spring", "food"),
    ):
        with pytest.raises(ConfigurationError, match=f"scenario.{field}: has no single cut"):
            protocol_of_scenario(load_scenario(name))


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("held", ["plus", "both"])
def test_a_scenario_without_a_motion_is_cut_through_as_it_is_simulated(world, held):
    from sliceit_drake.diagrams.prepared_food import prepare_food
    from sliceit_drake.diagrams.scenario import Scenario, load_scenario

    scenario = load_scenario(
        Scenario(),
        f"food.name=cucumber, food.held_sides={held}, start.clearance=0.003,"
        "food.shape=!Cylinder {diameter: 0.04, length: 0.05, layers: [0.0, 0.004, 0.012]}",
    )
    protocol = dc.replace(protocol_of_scenario(scenario), sensor=IDEAL, variation=SAME)
    record = Session(protocol, [], world, 0, COARSE).record(0)
    assert record.position[:, 2].min() == pytest.approx(protocol.board.height - 2e-4, abs=1e-5)
    simulated = prepare_food(scenario.food, scenario).motion_plan.segments
    assert {s.label for s in simulated} <= {p.label for p in record.metadata.motion.phases}
    assert (record.position[-1, 2] > protocol.board.height + 0.03) == (held == "plus")


@pytest.mark.parametrize(("name", "count"), [("poor", 6), ("rich", 18), ("full", 30)])
def test_shipped_protocols_are_cut_as_they_say(name, count):
    protocol = load_protocol(str(resource_path(f"calibration/protocols/{name}.yaml")))
    sessions = [Session(protocol, [], world, 0, COARSE) for world in WORLDS]
    assert len(sessions[0]) == count
    labels = [specimen.condition.label for specimen in sessions[0].specimens]
    # The richer protocols hold the poorer ones, which are run once.
    for label in sorted(set(labels)) if name != "rich" else []:
        records = [session.record(labels.index(label)) for session in sessions]
        a, b = records
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        assert a.metadata == b.metadata
        assert "other" not in {phase.label for phase in a.metadata.motion.phases}
        contact = max(np.abs(r.force[:, 2]).max() for r in records)
        assert contact < 1.0 if label == "air" else contact > 5.0
