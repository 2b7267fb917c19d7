"""What the viewer shows, and that showing it changes nothing."""

import base64
import dataclasses as dc
import re
import sys

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from sliceit_drake.cutting.mesh.surface import SKIN
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.live_view import (
    FASTEST,
    SPEED,
    STOP,
    LiveControls,
    make_meshcat,
    viewing_instructions,
    wait_for_browser,
)
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.simulated_station import FRAMES_PER_SECOND, REPLAY_SIZE
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.food_look import INTACT, LOOKS, damage_colours
from sliceit_drake.systems.frame_visualizer import FrameVisualizer
from sliceit_drake.systems.wrench_visualizer import (
    NEWTON_METRES_PER_METRE,
    NEWTONS_PER_METRE,
    WrenchVisualizer,
)

SMALL_FOOD = "{food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}}"


class FakeMeshcat:
    """Keeps the last transform and properties of each path, and when they were set."""

    def __init__(self) -> None:
        self.transforms: dict[str, RigidTransform] = {}
        self.properties: dict[tuple[str, str], object] = {}
        self.times: set[float] = set()
        self.meshes: dict[str, np.ndarray] = {}

    def SetObject(self, path, shape, rgba):
        pass

    def Delete(self, path):
        pass

    def SetTriangleMesh(self, path, vertices, faces, rgba):
        pass

    def SetTriangleColorMesh(self, path, vertices, faces, colours):
        self.meshes[path] = colours.T

    def SetTransform(self, path, X, time_in_recording=None):
        self.transforms[path] = X
        self.times.add(time_in_recording)

    def SetProperty(self, path, name, value, time_in_recording=None):
        self.properties[path, name] = value
        self.times.add(time_in_recording)


def fast_slice() -> Scenario:
    """From just above the food onto the board in a third of a second."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"), SMALL_FOOD)
    scenario.start.clearance = 0.001
    slice_ = ConstantSpeed(distance=0.031, speed=0.1, acceleration=5.0)
    scenario.motion = MotionPlan([slice_, Hold(duration=0.08)])
    return scenario


@pytest.fixture(scope="module")
def watched() -> tuple[Run, Meshcat]:
    meshcat = make_meshcat()
    run = prepare_run(fast_slice(), meshcat)
    run.controls = LiveControls(meshcat)
    meshcat.SetSliderValue(SPEED, FASTEST)
    run.advance()
    assert run.stopped is None
    return run, meshcat


@pytest.mark.parametrize(
    "vector", [[1, 0, 0], [0, 0, 3], [0, 0, -2], [-0.3, 0.5, 0.2], [1e-9, 0, -1], [2, -1, -5]]
)
def test_arrow_turns_its_axis_to_the_vector(vector):
    drawn = draw_wrenches(RigidTransform(), RigidTransform(), food=(np.zeros(3), vector))
    R = drawn.transforms["/wrench/food/force"].rotation()
    np.testing.assert_allclose(R.matrix() @ R.matrix().T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R.matrix()) == pytest.approx(1.0)
    axis = np.array(vector) / np.linalg.norm(vector)
    np.testing.assert_allclose(R @ np.array([0.0, 0.0, 1.0]), axis, atol=1e-8)


def draw_wrenches(X_WK: RigidTransform, X_KS: RigidTransform, **wrenches) -> FakeMeshcat:
    meshcat = FakeMeshcat()
    system = WrenchVisualizer(meshcat, X_KS, 0.1)
    context = system.CreateDefaultContext()
    context.SetTime(0.7)
    system.GetInputPort("knife_pose").FixValue(context, X_WK)
    for name in ("food", "board", "sensor"):
        m, f = wrenches.get(name, (np.zeros(3), np.zeros(3)))
        system.GetInputPort(f"{name}_wrench").FixValue(context, SpatialForce(m, f))
    meshcat.times.clear()
    system.ForcedPublish(context)
    return meshcat


def arrow_tip(meshcat: FakeMeshcat, path: str) -> np.ndarray:
    """Where the first head ends, from the transforms and properties alone."""
    return meshcat.transforms[path] @ np.array(meshcat.properties[f"{path}/head_0", "position"])


@pytest.mark.parametrize("size", [0.5, 15.0])
def test_force_and_moment_arrows_end_at_the_scaled_vector(size):
    X_WK = RigidTransform(RotationMatrix.MakeXRotation(2.0), [0.1, -0.5, 0.08])
    f, m = size * np.array([2.0, -1.0, 4.0]), 0.1 * size * np.array([-1.0, 3.0, 1.0])
    meshcat = draw_wrenches(X_WK, RigidTransform(), food=(m, f))
    p = X_WK.translation()
    f, m = f / NEWTONS_PER_METRE, m / NEWTON_METRES_PER_METRE
    np.testing.assert_allclose(arrow_tip(meshcat, "/wrench/food/force"), p + f, atol=1e-12)
    np.testing.assert_allclose(arrow_tip(meshcat, "/wrench/food/moment"), p + m, atol=1e-12)
    # The shaft runs from the point to where the head begins.
    middle = meshcat.properties["/wrench/food/force/shaft", "position"][2]
    length = meshcat.properties["/wrench/food/force/shaft", "scale"][2]
    assert middle == pytest.approx(0.5 * length)
    assert 0.0 < length < np.linalg.norm(f)
    # All that changes is in the recording.
    assert meshcat.times == {0.7}


def test_sensor_arrow_stands_at_the_sensor_and_is_turned_from_its_frame_to_the_world():
    X_WK = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 0.1])
    X_KS = RigidTransform([0.0, 0.02, -0.2])
    meshcat = draw_wrenches(X_WK, X_KS, sensor=(np.zeros(3), np.array([0.0, 0.0, -10.0])))
    tip = arrow_tip(meshcat, "/wrench/sensor/force")
    np.testing.assert_allclose(tip, [0.0, -0.02, 0.3 + 10.0 / NEWTONS_PER_METRE], atol=1e-12)


def test_arrows_without_a_force_are_hidden():
    f = np.array([0.0, 0.0, 5.0])
    meshcat = draw_wrenches(RigidTransform(), RigidTransform(), food=(np.zeros(3), f))
    assert meshcat.properties["/wrench/food/force", "visible"]
    for path in ("food/moment", "board/force", "board/moment", "sensor/force", "sensor/moment"):
        assert not meshcat.properties[f"/wrench/{path}", "visible"]


def test_frames_follow_the_knife():
    meshcat, X_KS = FakeMeshcat(), RigidTransform([0.0, 0.02, -0.2])
    X_WF = RigidTransform([0.3, 0.0, 0.05])
    view = np.array([1.0, 1.0, 0.0])
    carried = {"K": (RigidTransform(), 0.03), "S": (X_KS, 0.03)}
    system = FrameVisualizer(meshcat, {"F": (X_WF, 0.03)}, carried, RigidTransform(), view, 0.1)
    context = system.CreateDefaultContext()
    X_WK = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.1, 0.2, 0.3])
    system.GetInputPort("knife_pose").FixValue(context, X_WK)
    system.ForcedPublish(context)
    assert meshcat.transforms["/frames/K"].IsExactlyEqualTo(X_WK)
    assert meshcat.transforms["/frames/S"].IsNearlyEqualTo(X_WK @ X_KS, 1e-12)
    assert meshcat.transforms["/frames/F"].IsExactlyEqualTo(X_WF)


def test_damage_colours_brighten_from_intact_to_cut():
    for look in LOOKS.values():
        cut = look.face(np.full(41, 0.4))
        colours = damage_colours(np.linspace(0.0, 1.0, 41), cut)
        np.testing.assert_allclose(colours[0], INTACT)
        np.testing.assert_allclose(colours[-1], cut[-1])
        luminance = colours @ np.array([0.2126, 0.7152, 0.0722])
        # No flesh is darker than what is half cut; a tomato's is hardly brighter.
        assert (np.diff(luminance) > -0.002).all()


def test_cut_faces_show_where_the_edge_has_been_and_the_skin_stays_as_it_is():
    run = prepare_run(fast_slice())
    cutting = run.station.cutting
    assert isinstance(cutting, CuttingSystem)
    run.advance(0.22)
    context = cutting.GetMyContextFromRoot(run.simulator.get_context())
    surface, model = cutting.surfaces[0], cutting.solver(context).model
    damage = cutting.GetOutputPort("surface_damage").Eval(context)
    cut = surface.is_cut_face
    assert (damage[~cut] == 0.0).all()
    # Where the points lay at rest: cut above the edge, intact below by more than their hats reach.
    height = model.split.points[surface.cut_point[cut], 2]
    X_WK = run.station.GetOutputPort("knife_pose").Eval(
        run.station.GetMyContextFromRoot(run.simulator.get_context())
    )
    edge = X_WK.translation()[2] - run.scenario.board.height
    reach = model.tables.reach
    assert damage[cut][height > edge + reach].min() > 0.99
    assert damage[cut][height < edge - reach].max() < 0.01
    # Area-weighted it is what the station calls progress, for nothing opens ahead of the edge.
    minus = cut & (surface.side == 0)
    order = surface.cut_point[minus]
    assert np.array_equal(np.sort(order), np.arange(len(model.tables.area)))
    progress = cutting.GetOutputPort("cut_progress").Eval(context)[0]
    assert damage[minus] @ model.tables.area[order] / model.section_area == pytest.approx(
        progress, abs=1e-3
    )
    # What opening has spent counts too, and what it left the edge spends.
    passed, none = np.full(len(model.tables.area), -model.tables.reach), np.zeros(1)
    opened = surface.damage(model, passed, none + 0.25)
    np.testing.assert_allclose(opened[cut], 0.25, atol=1e-6)
    np.testing.assert_allclose(surface.damage(model, -passed, none + 0.25)[cut], 1.0, atol=1e-6)


def test_each_half_is_drawn_with_its_damage_and_skin_colours():
    meshcat = make_meshcat()
    run = prepare_run(fast_slice(), meshcat)
    fake = FakeMeshcat()
    visualizer = run.station.food_visualizer
    assert visualizer is not None
    visualizer._meshcat = fake
    run.advance(0.2)
    colours = fake.meshes["/drake/food/minus/frame_0006"]
    corners, _ = run.station.cutting.surfaces[0].halves[0]
    surface = run.station.cutting.surfaces[0]
    is_cut, is_skin = surface.is_cut_face[corners], surface.cut_point[corners] == SKIN
    assert len(colours) == len(corners)
    cucumber = LOOKS["cucumber"]
    np.testing.assert_array_equal(colours[is_skin], np.tile(cucumber.skin, (is_skin.sum(), 1)))
    # The flat end shows the flesh, with its ring at the rim.
    is_end = ~is_cut & ~is_skin
    assert {cucumber.ring, cucumber.core} <= {tuple(c.round(9)) for c in colours[is_end]}
    assert np.ptp(colours[is_cut], axis=0).max() > 0.3
    # Live, only the newest frame of each half is seen.
    assert fake.properties["/drake/food/plus/frame_0005", "visible"] is False
    assert ("/drake/food/plus/frame_0006", "visible") not in fake.properties


def test_a_long_run_is_drawn_with_fewer_frames_in_about_as_many_bytes():
    scenario = fast_slice()
    stations = {}
    for hold in (0.1, 100.0, 200.0):
        scenario.motion = MotionPlan([Hold(hold)])
        stations[hold] = MakeStation(scenario)
    assert stations[0.1].frame_period == 1.0 / FRAMES_PER_SECOND
    size = stations[0.1].cutting.frame_size()
    for hold in (100.0, 200.0):
        assert 0.5 * REPLAY_SIZE < size * hold / stations[hold].frame_period < REPLAY_SIZE


def test_halves_are_all_of_the_surface():
    surface = prepare_run(fast_slice()).station.cutting.surfaces[0]
    (minus, of_minus), (plus, of_plus) = surface.halves
    assert np.array_equal(np.sort(np.concatenate([minus, plus])), np.arange(len(surface.ends)))
    found = np.concatenate([minus[of_minus], plus[of_plus]])
    assert {tuple(t) for t in found} == {tuple(t) for t in surface.triangles}


def test_tree_has_arrows_frames_and_halves_by_name(watched):
    _, meshcat = watched
    arrows = [f"/wrench/{a}/{b}" for a in ("food", "board", "sensor") for b in ("force", "moment")]
    frames = [f"/frames/{letter}" for letter in "WBSKF"]
    halves = ["/drake/food/minus/frame_0000", "/drake/food/plus/frame_0000"]
    for path in (*arrows, *frames, *halves):
        assert meshcat.HasPath(path), path


def test_replay_animates_the_arrows(watched):
    _, meshcat = watched
    meshcat.PublishRecording()
    messages = re.findall(r"base64,([A-Za-z0-9+/=]+)", meshcat.StaticHtml())
    (animation,) = (m for m in map(base64.b64decode, messages) if b"set_animation" in m)
    for path in (b"/wrench/food/force", b"/wrench/food/force/shaft", b"/frames/K", b"/frames/S"):
        assert path in animation, path
    assert b".scale" in animation


def test_a_run_with_a_viewer_gives_the_same_record_to_the_bit(watched):
    run, _ = watched
    with_viewer = run.record()
    without = prepare_run(fast_slice())
    without.advance()
    record = without.record()
    assert list(record.columns) == list(with_viewer.columns)
    for name in record.columns:
        np.testing.assert_array_equal(record[name], with_viewer[name], err_msg=name)
    # It had everything in it that the viewer reads.
    assert record["food_wrench_f_z"].max() > 1.0
    assert record["board_wrench_f_z"].max() > 0.1
    assert record["cut_progress"][-1] > 0.99


def test_slider_sets_the_rate_of_a_running_simulator():
    meshcat = make_meshcat()
    controls = LiveControls(meshcat)
    simulator = Simulator(LeafSystem())
    simulator.Initialize()
    assert controls.apply(simulator)
    assert simulator.get_target_realtime_rate() == 1.0
    meshcat.SetSliderValue(SPEED, 0.3)
    simulator.AdvanceTo(0.01)
    assert simulator.get_num_steps_taken() > 0
    assert controls.apply(simulator)
    assert simulator.get_target_realtime_rate() == pytest.approx(0.3)
    # The new rate counts from now; otherwise it would be held to what went before.
    assert simulator.get_num_steps_taken() == 0
    meshcat.SetSliderValue(SPEED, FASTEST)
    controls.apply(simulator)
    assert simulator.get_target_realtime_rate() == 0.0
    assert meshcat.GetButtonNames() == [STOP]


def test_stop_in_the_viewer_ends_a_run_and_says_so():
    class Stopped:
        def apply(self, simulator):
            return simulator.get_context().get_time() < 0.03

    run = prepare_run(fast_slice())
    run.controls = Stopped()
    run.advance()
    assert run.stopped == "stopped in the viewer"
    assert run.record()["time"][-1] == pytest.approx(0.04)


def test_waiting_for_a_browser_gives_up():
    assert not wait_for_browser(make_meshcat(), 0.1)


@pytest.mark.parametrize(
    ("environment", "platform", "words", "absent"),
    [
        ({"DISPLAY": ":0"}, "linux", ["Open http://localhost:7001"], ["ssh"]),
        ({}, "darwin", ["Open http://localhost:7001"], ["ssh"]),
        (
            {},
            "linux",
            ["no display", "ssh -N -L 7001:localhost:7001 USER@HOST", "replay.html"],
            [],
        ),
        (
            {"SSH_CONNECTION": "10.0.0.2 50000 10.0.0.7 22"},
            "linux",
            ["ssh -N -L 7001:localhost:7001 ", "@10.0.0.7\n", "http://localhost:7001"],
            ["-p"],
        ),
        (
            {"SSH_CONNECTION": "10.0.0.2 50000 10.0.0.7 2222", "DISPLAY": "localhost:10.0"},
            "linux",
            ["7001:localhost:7001 -p 2222 "],
            [],
        ),
    ],
)
def test_instructions_say_how_to_see_the_viewer(environment, platform, words, absent, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    text = viewing_instructions(7001)
    assert all(word in text for word in words)
    assert not any(word in text for word in absent)


def test_a_run_plots_itself_and_says_whose_parameters_it_had(watched):
    run, _ = watched
    figure = run.plot()
    over_time, over_depth, _ = figure.axes
    assert over_time.get_xlabel() == "time [s]" and "depth" in over_depth.get_xlabel()
    force = run.record().vector("food_wrench_f") + run.record().vector("board_wrench_f")
    np.testing.assert_array_equal(over_time.lines[1].get_ydata(), force[:, 2])
    assert figure._supxlabel.get_text().startswith("Parameters set by hand: E = 2.6e+06 Pa")
    calibrated = dc.replace(run.scenario, calibration="potato")
    text = dc.replace(run, scenario=calibrated).plot()._supxlabel.get_text()
    assert text.startswith("Parameters of the food potato: ")


def test_a_station_built_by_hand_looks_at_the_knife_too():
    meshcat = make_meshcat()
    assert not meshcat.HasPath("/Background/<object>")
    MakeStation(fast_slice(), meshcat)
    assert meshcat.HasPath("/Background/<object>")
