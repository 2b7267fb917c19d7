"""Slices in a row: the next food is taken when the knife is ready, and each slice is a slice."""

import re

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.foods.shapes import Ellipsoid, Remainder
from sliceit_drake.cutting.simulate import COMPLETE
from sliceit_drake.diagrams.outputs.sequence_report import slice_reports
from sliceit_drake.diagrams.plant.surroundings import FINGERTIPS, HoldingArm
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.diagrams.sequence import SliceSequence
from sliceit_drake.resources import resource_path

SMALL = """
food: {shape: !Cylinder {diameter: 0.016, length: 0.05, rings: 2}}
start: {clearance: 0.002}
numerics: {time_step: 2.0e-4}
sequence: {count: 2, slice_layers: 1, layers: [0.004, 0.012], slice_speed: 0.08, push: 0.0}
"""


def scenario(**sequence) -> Scenario:
    small = load_scenario(resource_path("scenarios/cucumber_sequence.yaml"), SMALL)
    for name, value in sequence.items():
        setattr(small.sequence, name, value)
    return small


def run_of(indexing: str):
    run = prepare_run(scenario(indexing=indexing))
    run.advance()
    assert run.stopped is None
    return run, run.record()


@pytest.fixture(scope="module")
def by_knife():
    return run_of("knife")


@pytest.fixture(scope="module")
def by_food():
    return run_of("food")


@pytest.fixture(params=["knife", "food"])
def indexed(request):
    return request.getfixturevalue(f"by_{request.param}")


def test_every_slice_is_cut_off_and_the_last_food_is_reached(indexed):
    run, record = indexed
    assert record["food_index"][-1] == run.scenario.sequence.count - 1
    assert (np.diff(record["food_index"]) >= 0.0).all()
    reports = slice_reports(record, run.station.cutting.section_areas())
    assert [report.cut_share for report in reports] == pytest.approx([1.0, 1.0], abs=1e-3)
    # The next food is uncut and gives no force when it is taken.
    taken = int(np.argmax(record["food_index"] == 1))
    assert record["cut_progress"][taken - 1] > COMPLETE and record["cut_progress"][taken] < 1e-12
    assert np.abs(record.vector("food_wrench_f")[taken]).max() < 1e-3


def test_slices_of_a_uniform_body_have_the_same_force(indexed):
    run, record = indexed
    heights = np.linspace(0.002, 0.015, 40)
    profiles = []
    for k in (0, 1):
        rows = np.flatnonzero(record["food_index"] == k)
        rows = rows[: int(np.argmin(record["knife_pose_p_z"][rows])) + 1]
        height = record["knife_pose_p_z"][rows] - run.scenario.board.height
        force = np.linalg.norm(record.vector("food_wrench_f")[rows], axis=1)
        profiles.append(np.interp(heights, height[::-1], force[::-1]))
    assert profiles[0].max() > 3.0
    np.testing.assert_allclose(profiles[1], profiles[0], atol=0.02 * profiles[0].max())


def test_knife_stays_in_the_cut_plane_while_it_is_in_the_food(indexed):
    run, record = indexed
    index = record["food_index"].astype(int)
    planes = np.array([X.translation() for X in run.station.cutting.food_poses])
    axis = run.scenario.X_WF().rotation().matrix()[:, 1]
    offset = (record.vector("knife_pose_p") - planes[index]) @ axis
    tops = np.array([solver.model.top for solver in run.station.cutting.solvers])
    inside = record["knife_pose_p_z"] - run.scenario.board.height < tops[index]
    assert inside.any() and np.abs(offset[inside]).max() < 2e-4
    travel = np.ptp(record.vector("knife_pose_p") @ axis)
    expected = run.scenario.sequence.thickness if run.scenario.sequence.indexing == "knife" else 0.0
    assert travel == pytest.approx(expected, abs=5e-4)


def test_the_energy_balance_runs_on_over_the_slices_and_closes(by_knife):
    run, record = by_knife
    models = [solver.model for solver in run.station.cutting.solvers]
    reports = slice_reports(record, run.station.cutting.section_areas())
    work = [report.work_of_cutting_J for report in reports]
    assert record["energy_work"][-1] == pytest.approx(sum(work))
    assert min(work) > 0.9 * models[0].material.toughness * models[0].section_area
    summary = run.station.cutting.summary(record)
    assert abs(summary["energy_imbalance_J"]) < 0.01 * sum(work)
    ratios = [report.least_volume_ratio for report in reports]
    assert summary["least_volume_ratio"] == min(ratios) and max(ratios) < 0.99
    assert abs(record["coupling_work_error"][-1]) < 0.02 * sum(work)


def test_a_sequence_repeats_bit_for_bit_and_its_clone_goes_on_identically(by_knife):
    _, record = by_knife
    diagram = ScenarioDiagram(scenario())
    station, cutting = diagram.station, diagram.station.cutting

    def food(simulator: Simulator) -> np.ndarray:
        context = cutting.GetMyContextFromRoot(simulator.get_context())
        return np.concatenate([[cutting.food_index(context)], cutting.food_state(context)])

    original, other = Simulator(diagram), Simulator(diagram)
    for simulator in (original, other):
        diagram.SetStart(simulator.get_mutable_context())
        simulator.Initialize()
    # Half way between two coupling steps no update is due.
    end = float(record["time"][int(np.argmax(record["food_index"] == 1))]) + 0.001
    original.AdvanceTo(end - 0.05)
    copy = Simulator(diagram, original.get_context().Clone())
    copy.Initialize(InitializeParams(suppress_initialization_events=True))
    # The other context stays in the first slice while the first two go on to the second.
    other.AdvanceTo(0.101)
    assert food(original)[0] == 0
    for time in end + np.arange(0.0, 0.25, 0.05):
        original.AdvanceTo(time)
        other.AdvanceTo(0.151 + time - end)
        copy.AdvanceTo(time)
    assert food(original)[0] == 1 and food(other)[0] == 0
    np.testing.assert_array_equal(food(copy), food(original))
    # A row of the record holds what was so until its time.
    following = int(np.searchsorted(record["time"], original.get_context().get_time()))
    context = station.GetMyContextFromRoot(original.get_context())
    work = station.GetOutputPort("balance").Eval(context)[0]
    assert work == record["energy_work"][following] > 0.0


class Shallow(SliceSequence):
    """Turns back 3 mm over the board."""

    def motion(self, tops, clearance):
        return super().motion(tops, clearance - 0.003)


@pytest.mark.parametrize("push", [0.0, 0.012])
def test_a_slice_that_is_not_cut_off_stops_the_run(push):
    shallow = scenario(push=push)
    shallow.sequence = Shallow(**vars(shallow.sequence))
    run = prepare_run(shallow)
    run.advance()
    assert re.search(r"the cut of slice 1 has parted \d\d\.\d\d % of its section", run.stopped)
    assert run.record()["food_index"].max() == 0


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        ("sequence: {count: 0}", "scenario.sequence.count"),
        ("sequence: {count: 8}", "scenario.sequence.count"),
        ("sequence: {thickness: 0.0006}", "scenario.sequence.thickness"),
        ("food: {held_sides: both}", "scenario.food.held_sides"),
        ("food: {cut_point: [0.0, 0.01, 0.0]}", "scenario.food.cut_point"),
        ("start: {clearance: 0.0}", "scenario.start.clearance"),
        ("motion: {segments: [!Hold {}]}", "scenario.motion"),
        ("measurement: {file: a.csv}", "scenario.measurement"),
        ("food: {shape: !Ellipsoid {}}", "scenario.sequence.trim"),
        ("food: !AnalyticFood {}", "scenario.food"),
    ],
)
def test_what_cannot_be_sliced_is_refused_by_name(tmp_path, overrides, field):
    file = tmp_path / "small.yaml"
    dump_yaml(scenario(), file)
    with pytest.raises(ConfigurationError) as raised:
        load_scenario(file, overrides)
    assert field in str(raised.value)


def test_slices_of_an_ellipsoid_add_up_to_it():
    body = Ellipsoid(diameters=[0.04, 0.08, 0.03], refinements=3)
    ends = np.linspace(-0.03, 0.03, 13)
    volume = sum(body.between(ends[k : k + 2], 1.0).volumes().sum() for k in range(12))
    a, b, c = 0.5 * np.array(body.diameters)
    exact = np.pi * a * c * (0.06 - 2.0 * 0.03**3 / (3.0 * b * b))
    # Straight sides between the layers cut in.
    assert volume == pytest.approx(exact, rel=5e-3) and volume < exact


def test_remainder_has_its_next_cut_at_y_0_and_all_of_the_body_behind_it():
    body = Ellipsoid(refinements=2)
    mesh = Remainder(body, position=-0.005, thickness=0.004).mesh()
    mesh.check()
    y = mesh.vertices[:, 1]
    assert y.min() == pytest.approx(-0.004) and (y == 0.0).any()
    assert y.max() == pytest.approx(body.reach + 0.005)
    assert mesh.volumes().min() > 0.0


def test_holding_arm_grips_the_food_and_adds_no_joints_to_the_plant():
    held = scenario()
    held.holder = "arm"
    station = ScenarioDiagram(held).station
    assert station.plant.num_velocities() == 6
    X_WF, grip = held.X_WF(), np.array([0.0, 0.02, 0.008])
    arm = HoldingArm(X_WF, grip)
    context = arm.plant.CreateDefaultContext()
    arm.plant.SetPositions(context, arm.joints)
    X_FG = X_WF.inverse() @ arm.plant.EvalBodyPoseInWorld(
        context, arm.plant.GetBodyByName("gripper")
    )
    np.testing.assert_allclose(X_FG.multiply([0.0, 0.0, FINGERTIPS]), grip, atol=1e-4)
    # Finger to finger is along Fx, and the hand leans away from the knife.
    np.testing.assert_allclose(X_FG.rotation().matrix()[:, 1], [1.0, 0.0, 0.0], atol=1e-4)
    assert X_FG.translation()[1] > grip[1] + 0.05
    with pytest.raises(ConfigurationError, match=r"scenario\.holder.*cannot grip"):
        HoldingArm(X_WF, np.array([0.0, 0.0, 1.5]))
