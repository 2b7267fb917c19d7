"""Slices that are off fall as rigid bodies, on the board and on each other."""

import dataclasses as dc
import json

import numpy as np
import pytest
from pydrake.geometry import SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import sliceit_drake.diagrams.run as run_module
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import GRAVITY
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Retract
from sliceit_drake.diagrams import simulated_station
from sliceit_drake.diagrams.live_view import make_meshcat
from sliceit_drake.diagrams.outputs import animation
from sliceit_drake.diagrams.plant.knife_body import blade_surface
from sliceit_drake.diagrams.prepared_food import food_to_cut
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.simulated_station import FRAMES_PER_SECOND
from sliceit_drake.systems.loose_slices import LooseSlices, SliceBody

PERIOD = 2e-3
FAR = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.5, 0.5])


def box(width: float, thickness: float, height: float) -> TriangleSurfaceMesh:
    """A block on the plane z = 0, centred on the z axis, `thickness` along y, metres."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    corners *= [width, thickness, height]
    hull = ConvexHull(corners)
    triangles = []
    for (a, b, c), plane in zip(hull.simplices, hull.equations, strict=True):
        normal = np.cross(corners[b] - corners[a], corners[c] - corners[a])
        triangles.append(SurfaceTriangle(*((a, b, c) if normal @ plane[:3] > 0.0 else (a, c, b))))
    return TriangleSurfaceMesh(triangles, corners)


def one_slice(
    surface: TriangleSurfaceMesh,
    friction: float,
    period: float = PERIOD,
    youngs_modulus: float = 2.6e6,
) -> LooseSlices:
    body = SliceBody(surface, Material(youngs_modulus=youngs_modulus), RigidTransform())
    board = Board(height=0.0)
    blade = blade_surface(Knife())
    return LooseSlices([body], None, blade, board, RigidTransform(), friction, 0.0, period, 0.999)


def let_go(slices: LooseSlices, X_WS: RigidTransform, progress: float = 1.0) -> Simulator:
    """A simulator in which the only slice is off at `X_WS` from the start, the knife far away."""
    simulator = Simulator(slices)
    context = simulator.get_mutable_context()
    for name, value in {
        "knife_pose": FAR,
        "knife_velocity": SpatialVelocity.Zero(),
        "cut_progress": [progress],
        "food_index": [0.0],
        "slice_pose": X_WS,
        "slice_velocity": SpatialVelocity.Zero(),
    }.items():
        slices.GetInputPort(name).FixValue(context, value)
    simulator.Initialize()
    return simulator


def tipped(angle: float, thickness: float) -> RigidTransform:
    """A block that stands on its lower edge at y = -thickness / 2, turned about it."""
    edge = RigidTransform([0.0, -0.5 * thickness, 0.0])
    return edge @ RigidTransform(RotationMatrix.MakeXRotation(angle), [0, 0, 0]) @ edge.inverse()


def test_a_block_topples_as_a_pendulum_upside_down_more_exactly_with_shorter_steps():
    thickness, height = 0.009, 0.027
    balance = np.arctan2(thickness, height)
    start, end = balance + np.radians(4.0), np.radians(60.0)
    radius = 0.5 * np.hypot(thickness, height)
    # About the edge a block has (t^2 + h^2) / 3 = 4 r^2 / 3 of inertia a mass.
    found = solve_ivp(
        lambda _, x: [x[1], 0.75 * GRAVITY / radius * np.sin(x[0] - balance)],
        (0.0, 1.0),
        [start, 0.0],
        events=lambda _, x: x[0] - end,
        rtol=1e-9,
    )
    expected = found.t_events[0][0]
    errors = []
    for period in (2e-3, 5e-4):
        slices = one_slice(box(0.027, thickness, height), 2.0, period, youngs_modulus=1e9)
        simulator = let_go(slices, tipped(start, thickness))
        context = simulator.get_context()
        angle = before = start
        while angle < end:
            simulator.AdvanceTo(context.get_time() + period)
            R = slices.pose(context, 0).rotation().matrix()
            before, angle = angle, np.arctan2(R[2, 1], R[1, 1])
            assert context.get_time() < 1.0
        time = context.get_time() - period * (angle - end) / (angle - before)
        errors.append(abs(time / expected - 1.0))
    assert errors[0] < 0.04
    assert errors[1] < 0.01


def test_a_block_tipped_less_than_its_balance_comes_back_and_stands():
    slices = one_slice(box(0.027, 0.009, 0.027), friction=0.5)
    simulator = let_go(slices, tipped(np.radians(10.0), 0.009))
    simulator.AdvanceTo(1.0)
    X_WS = slices.pose(simulator.get_context(), 0)
    assert X_WS.rotation().matrix()[2, 2] > 0.9999
    assert abs(X_WS.translation()[2]) < 1e-4


def test_a_slice_that_rests_is_not_moved_any_more_and_one_in_the_air_falls():
    slices = one_slice(box(0.027, 0.009, 0.027), friction=0.5)
    simulator = let_go(slices, RigidTransform([0.0, 0.0, 0.02]))
    context = simulator.get_context()
    simulator.AdvanceTo(0.05)
    fallen = 0.02 - slices.pose(context, 0).translation()[2]
    assert fallen == pytest.approx(0.5 * GRAVITY * 0.05**2, rel=0.1)
    simulator.AdvanceTo(1.0)
    rested = slices.pose(context, 0).GetAsMatrix34()
    simulator.AdvanceTo(1.5)
    np.testing.assert_array_equal(slices.pose(context, 0).GetAsMatrix34(), rested)


def test_a_slice_at_rest_is_held_until_one_that_moves_comes_near():
    surface, blade = box(0.03, 0.03, 0.01), blade_surface(Knife())
    bodies = [
        SliceBody(surface, Material(youngs_modulus=2.6e6), RigidTransform([0.0, y, 0.0]))
        for y in (0.0, -0.5)
    ]
    board = Board(height=0.0)
    slices = LooseSlices(bodies, None, blade, board, RigidTransform(), 0.5, 0.0, PERIOD, 0.999)
    simulator = let_go(slices, RigidTransform([0.0, 0.0, 0.001]))
    context = simulator.get_mutable_context()
    simulator.AdvanceTo(0.6)
    assert not slices.GetOutputPort("slices").Eval(context)[8:14].any()
    rested = slices.pose(context, 0).GetAsMatrix34()
    slices.GetInputPort("food_index").FixValue(context, [1.0])
    # The second falls beside the first, and slides against it.
    slices.GetInputPort("slice_pose").FixValue(context, RigidTransform([0.0, 0.04, 0.003]))
    push = SpatialVelocity(np.zeros(3), np.array([0.0, -0.7, 0.0]))
    slices.GetInputPort("slice_velocity").FixValue(context, push)
    simulator.AdvanceTo(0.604)
    np.testing.assert_array_equal(slices.pose(context, 0).GetAsMatrix34(), rested)
    assert slices.pose(context, 1).translation()[1] < 0.04
    simulator.AdvanceTo(1.2)
    first, second = (slices.pose(context, k).translation()[1] for k in range(2))
    assert first < -1e-3
    assert second - first > 0.0295


@pytest.mark.parametrize(("friction", "of_the_blade"), [(0.3, 0.9), (0.0, 0.0), (0.0, 0.3)])
def test_any_pair_of_frictions_can_be_simulated(friction, of_the_blade):
    body = SliceBody(box(0.03, 0.01, 0.03), Material(friction=of_the_blade), RigidTransform())
    blade, board = blade_surface(Knife()), Board(height=0.0)
    slices = LooseSlices([body], None, blade, board, RigidTransform(), friction, 0.0, PERIOD, 0.999)
    simulator = let_go(slices, RigidTransform([0.0, 0.0, 0.01]))
    simulator.AdvanceTo(0.2)
    assert abs(slices.pose(simulator.get_context(), 0).translation()[2]) < 5e-4


def test_two_contexts_of_one_system_do_not_disturb_each_other():
    slices = one_slice(box(0.027, 0.009, 0.027), friction=0.5)
    places = [tipped(np.radians(25.0), 0.009), RigidTransform([0.01, 0.02, 0.03])]
    alone = []
    for X_WS in places:
        simulator = let_go(slices, X_WS)
        simulator.AdvanceTo(0.1)
        alone.append(slices.pose(simulator.get_context(), 0).GetAsMatrix34())
    together = [let_go(slices, X_WS) for X_WS in places]
    for step in range(1, 51):
        for simulator in together:
            simulator.AdvanceTo(step * PERIOD)
    for simulator, expected in zip(together, alone, strict=True):
        found = slices.pose(simulator.get_context(), 0).GetAsMatrix34()
        np.testing.assert_array_equal(found, expected)


def test_before_it_is_cut_through_a_slice_stays():
    slices = one_slice(box(0.027, 0.009, 0.027), friction=0.5)
    simulator = let_go(slices, RigidTransform([0.0, 0.0, 0.1]), progress=0.99)
    simulator.AdvanceTo(0.1)
    assert not slices.is_off(simulator.get_context()).any()


def sequence(count: int = 2) -> Scenario:
    scenario = load_scenario("carrot_sequence")
    scenario.food = Food(
        shape=Cylinder(diameter=0.027, length=0.1, rings=3), held_sides="plus", hold_distance=0.0119
    )
    assert scenario.sequence is not None
    scenario.sequence.count, scenario.sequence.thickness = count, 0.009
    scenario.sequence.slice_speed, scenario.sequence.push = 0.08, 0.015
    return scenario


@pytest.fixture(scope="module")
def run() -> Run:
    run = prepare_run(sequence(), animation=True)
    run.advance()
    assert run.stopped is None
    return run


def corners_in_world(run: Run) -> list[np.ndarray]:
    """Corners [3, V] of each slice in W at the end of a run, as they came off."""
    assert run.film is not None
    parts = {part.name: part for part in run.film.frames[-1].parts}
    names = sorted(name for name in parts if name.startswith("slice"))
    return [parts[n].X_WP.multiply(parts[n].mesh.points.T) for n in names]


def test_slices_topple_and_come_to_lie_on_the_board(run):
    slices = run.station.slices
    context = slices.GetMyContextFromRoot(run.simulator.get_context())
    assert slices.is_off(context).all()
    first, second = (slices.pose(context, k).rotation().matrix()[:, 1] for k in range(2))
    # The axis of the first points up; the second leans on it.
    assert abs(first[2]) > 0.999
    assert abs(second[2]) > 0.5
    for corners in corners_in_world(run):
        assert corners[2].min() > run.scenario.board.height - 5e-4


def test_slices_do_not_go_through_each_other(run):
    """The gap along the axis of the first, which lies flat, where the second is over it."""
    first, second = corners_in_world(run)
    top = first[2].max()
    middle = first[:2].mean(1)
    over = np.linalg.norm(second[:2] - middle[:, None], axis=0) < 0.011
    assert over.any()
    assert second[2, over].min() > top - 7e-4


def test_a_slice_is_handed_over_with_the_mass_of_the_finite_elements(run):
    cutting, slices = run.station.cutting, run.station.slices
    model = cutting.solvers[0].model
    mine = model.split.node_side[model.computed] == 0
    plant = slices._plant
    mass = plant.GetBodyByName("slice_1").default_mass()
    assert mass == pytest.approx(model.true_mass[mine].sum(), rel=1e-9)


def test_the_record_is_the_same_to_the_bit_and_the_slices_too(run):
    again = prepare_run(sequence())
    again.advance()
    np.testing.assert_array_equal(again.record().values, run.record().values)
    found, expected = (
        each.station.slices.GetOutputPort("slices").Eval(
            each.station.slices.GetMyContextFromRoot(each.simulator.get_context())
        )
        for each in (again, run)
    )
    np.testing.assert_array_equal(found, expected)


def test_a_viewer_shows_a_slice_from_the_time_it_is_off():
    meshcat = make_meshcat()
    run = prepare_run(sequence(1), meshcat)
    run.advance(0.3)
    assert not meshcat.HasPath("/drake/food/slice_01")
    assert meshcat.HasPath("/drake/food/minus/frame_0003")
    run.advance()
    assert meshcat.HasPath("/drake/food/slice_01")
    # The finite elements' copy of it is not drawn any more, the other half is.
    last = round(run.motion.duration * FRAMES_PER_SECOND) - 2
    assert not meshcat.HasPath(f"/drake/food/minus/frame_{last:04d}")
    assert meshcat.HasPath(f"/drake/food/plus/frame_{last:04d}")


def single_cut(held_sides: str, cut_normal: list[float]) -> Scenario:
    """A cut 9 mm from the free end, after which the knife comes up again."""
    food = Food(
        shape=Cylinder(diameter=0.027, length=0.05, rings=3),
        held_sides=held_sides,
        cut_point=[0.0, {"plus": -0.016, "minus": 0.016, "both": 0.0}[held_sides], 0.0],
        cut_normal=cut_normal,
    )
    down = ConstantSpeed(0.08, distance=0.0372, acceleration=2.0)
    plan = MotionPlan([down, Hold(0.2), Retract(0.05, 0.2, 2.0), Hold(0.2)])
    return load_scenario(Scenario(food=food, motion=plan))


@pytest.fixture(scope="module", params=[("plus", [0.0, 1.0, 0.0]), ("minus", [0.3, 1.0, 0.0])])
def cut_once(request) -> Run:
    run = prepare_run(single_cut(*request.param), animation=True)
    run.advance()
    assert run.stopped is None
    return run


def test_what_a_single_cut_takes_off_goes_through_neither_board_nor_blade_nor_the_rest(cut_once):
    station, held = cut_once.station, cut_once.scenario.food.held_sides
    assert cut_once.film is not None
    frames = cut_once.film.frames
    assert {part.name for part in frames[0].parts} == {"minus", "plus"}
    assert {part.name for part in frames[-1].parts} == {"slice_01", held}
    blade = ConvexHull(np.array(blade_surface(cut_once.scenario.knife).vertices())).equations
    context = station.plant.CreateDefaultContext()
    for frame in frames:
        parts = {part.name: part for part in frame.parts}
        if "slice_01" not in parts:
            continue
        p_W = parts["slice_01"].X_WP.multiply(parts["slice_01"].mesh.points.T)
        assert p_W[2].min() > cut_once.scenario.board.height - 5e-4
        station.plant.SetPositions(context, frame.joints)
        X_WK = station.plant.EvalBodyPoseInWorld(context, station.robot.knife)
        rest = ConvexHull(parts[held].mesh.points).equations
        for planes, p in ((blade, X_WK.inverse().multiply(p_W)), (rest, p_W)):
            assert (planes[:, :3] @ p + planes[:, 3:]).max(0).min() > -5e-4


def test_no_record_of_a_single_cut_depends_on_what_it_takes_off(cut_once, monkeypatch):
    def without(*given):
        return dc.replace(food_to_cut(*given), make_slices=None)

    monkeypatch.setattr(simulated_station, "food_to_cut", without)
    other = prepare_run(cut_once.scenario)
    assert other.station.slices is None
    other.advance()
    np.testing.assert_array_equal(other.record().values, cut_once.record().values)


@pytest.mark.parametrize("held_sides", ["both", "none"])
def test_a_food_held_on_both_sides_or_none_has_nothing_that_comes_off(held_sides):
    scenario = single_cut("both", [0.0, 1.0, 0.0])
    scenario.food.held_sides = held_sides
    assert prepare_run(scenario).station.slices is None


def test_rigid_motion_finds_a_rigid_motion_again():
    model = prepare_run(sequence(1)).station.cutting.solvers[0].model
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    p, w, v = np.array([0.01, 0.02, -0.03]), np.array([1.0, -2.0, 0.5]), np.array([0.1, 0.2, 0.3])
    now = model.nodes @ R.T + p
    found = model.rigid_motion(now, v + np.cross(w, now))
    for value, expected in zip(found, (R, p, w, v), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-9)


def test_an_animation_is_written_with_the_force_below_it(run, tmp_path):
    if not animation.can_draw():
        pytest.skip(animation.NEEDED)
    from PIL import Image

    summary = run.save(tmp_path, replay=False)
    assert summary["animation"] == "slice.gif"
    with Image.open(tmp_path / "slice.gif") as film:
        assert film.n_frames == len(run.film.frames) > 20
        pictures = []
        for k in range(film.n_frames):
            film.seek(k)
            pictures.append(np.asarray(film.convert("RGB"), float))
    scene, strip = slice(0, -animation.STRIP), slice(-animation.STRIP, None)
    assert np.abs(pictures[-1][scene] - pictures[0][scene]).mean() > 3.0
    # The blue of the curve grows to the right as the run goes on.
    blue = [(p[strip, :, 2] - p[strip, :, 0] > 80.0).any(0) for p in pictures]
    ends = [np.flatnonzero(columns).max() for columns in blue if columns.any()]
    assert ends == sorted(ends)
    assert ends[-1] > 1.5 * ends[0]


def test_ctrl_c_while_the_animation_is_drawn_leaves_the_figure_with_its_picture(
    run, tmp_path, monkeypatch
):
    if not animation.can_draw():
        pytest.skip(animation.NEEDED)
    from PIL import Image

    def interrupt(drawn, of):
        assert (drawn, of) == (1, len(run.film.frames))
        raise KeyboardInterrupt

    monkeypatch.setattr(run.station, "estimate_error", None)
    with pytest.raises(KeyboardInterrupt):
        run.save(tmp_path, replay=False, drawing=interrupt)
    assert not (tmp_path / "slice.gif").exists()
    run.plot().savefig(tmp_path / "whole.png", dpi=150)
    left, whole = (np.asarray(Image.open(tmp_path / f"{n}.png")) for n in ("force", "whole"))
    np.testing.assert_array_equal(left, whole)


def test_without_a_library_that_draws_all_else_is_written_and_the_packages_are_named(
    run, tmp_path, monkeypatch
):
    monkeypatch.setattr(animation, "TRIAL", "raise SystemExit(1)")
    assert not animation.can_draw.__wrapped__()
    monkeypatch.setattr(run_module, "can_draw", lambda: False)
    run.save(tmp_path, replay=False)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert "libegl1" in summary["animation"]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"record.csv", "force.png", "summary.json", "scenario.yaml"}
