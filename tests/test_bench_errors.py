"""What a bench does otherwise: a station shows the same as the functions over whole series."""

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.bench_errors import (
    ArmErrors,
    BenchErrors,
    BoardErrors,
    SensorErrors,
    ToolErrors,
)
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Retract
from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.giving_mount import GivingMount

DIAMETER = 0.010
SENSOR = SensorErrors(
    gain=[0.1, 0.0, -0.05],
    tilt=[0.03, -0.06],
    force_bias=[0.2, -0.3, 0.5],
    force_drift_rate=[0.0, 0.0, 0.4],
    delay=0.012,
    delay_stages=3,
)


def scenario() -> Scenario:
    """Cuts an analytic food down to the board, presses a little further and withdraws."""
    out = load_scenario("cucumber_measured")
    out.food, out.measurement = AnalyticFood(diameter=DIAMETER), None
    out.start.clearance = 0.002
    out.motion = MotionPlan(
        [
            ConstantSpeed(distance=DIAMETER + 0.003, speed=0.05, acceleration=2.0),
            Hold(duration=0.05),
            Retract(distance=0.006, speed=0.05, acceleration=1.0),
        ]
    )
    return out


def cut(bench: BenchErrors | None = None, toughness: float = 350.0) -> tuple[Run, SliceRecord]:
    own = scenario()
    own.food.toughness = toughness
    own.bench = bench or BenchErrors()
    run = prepare_run(own)
    run.advance()
    return run, slice_record_of(run, "a test")


@pytest.fixture(scope="module")
def plain() -> tuple[Run, SliceRecord]:
    return cut()


def wrench_of(record: SliceRecord) -> np.ndarray:
    """Moment about Ko and force in K [n, 6]."""
    both = np.stack([record.torque, record.force], axis=1)
    return (both @ record.rotation).reshape(-1, 6)


def test_a_station_shows_what_the_function_of_the_sensor_gives(plain):
    _, record = cut(BenchErrors(sensor=SENSOR))
    # At the first row there is no reading yet.
    ideal = wrench_of(plain[1])[1:]
    expected = SENSOR.readings(ideal, record.time[1:])
    assert np.abs(expected - ideal).max(0)[3:].min() > 0.3
    # The sensor's drift counts from the first reading on, too.
    assert wrench_of(record)[1:] == pytest.approx(expected, abs=5e-3)


def test_a_part_of_the_tool_shows_by_its_inertia_where_the_sensor_was_tared(plain):
    tool = ToolErrors(mass=0.4, moment=-0.02)
    _, record = cut(BenchErrors(tool=tool))
    added = wrench_of(record) - wrench_of(plain[1])
    period = float(record.time[2] - record.time[1])
    expected = tool.wrench(record.rotation, record.velocity, period, tared=True)
    expected = (expected.reshape(-1, 2, 3) @ record.rotation).reshape(-1, 6)
    begins = slice(2, 60)
    assert np.abs(expected[begins, 5]).max() > 0.15
    assert added[begins, 5] == pytest.approx(expected[begins, 5], abs=0.01)


def test_a_board_that_lies_higher_is_met_earlier_by_the_same_motion(plain):
    height = 8e-4
    run, record = cut(BenchErrors(board=BoardErrors(height=height)))
    assert record.metadata.board_height == plain[1].metadata.board_height
    assert record.position[0] == pytest.approx(plain[1].position[0], abs=1e-6)
    for name in ("board_wrench_f_z", "food_wrench_f_z"):
        met = [
            each.position[np.argmax(r.record()[name] > 1.0), 2]
            for r, each in ((run, record), plain)
        ]
        assert met[0] - met[1] == pytest.approx(height, abs=1.5e-4), name


def test_a_softer_board_holds_the_same_press_with_less_force(plain):
    run, _ = cut(BenchErrors(board=BoardErrors(stiffness=-0.4)))
    peaks = [r.record()["board_wrench_f_z"].max() for r in (run, plain[0])]
    assert 0.6 * peaks[1] < peaks[0] < 0.85 * peaks[1]


def test_an_arm_that_gives_takes_its_share_of_an_indentation_unseen_by_encoders():
    """Springs in a row: a food that is not cut, and the arm."""
    compliance, slopes = 5e-5, []
    for bench in (BenchErrors(), BenchErrors(arm=ArmErrors(compliance=compliance))):
        run, record = cut(bench, toughness=1e5)
        depth = run.scenario.board.height + DIAMETER - record.position[:, 2]
        force = run.record()["food_wrench_f_z"]
        rising = (force > 3.0) & (force < 20.0) & (np.gradient(depth) > 0.0)
        slopes.append(np.polyfit(depth[rising], force[rising], 1)[0])
    assert slopes[0] == pytest.approx(5e3, rel=0.02)
    assert slopes[1] == pytest.approx(5e3 / (1.0 + compliance * 5e3), rel=0.03)


def test_an_arm_that_gives_takes_its_share_of_the_press_on_the_board(plain):
    run, _ = cut(BenchErrors(arm=ArmErrors(compliance=5e-5)))
    less, press = (r.record()["board_wrench_f_z"].max() for r in (run, plain[0]))
    assert 0.3 * press < less < 0.7 * press


class Spring(LeafSystem):
    """Pushes the knife up by `stiffness` times its depth below 0, as held over a coupling step."""

    def __init__(self, stiffness: float) -> None:
        super().__init__()
        pose = self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareStateOutputPort("wrench", self.DeclareDiscreteState(6))

        def update(context, state):
            depth = -pose.Eval(context).translation()[2]
            force = stiffness * max(depth, 0.0)
            held = state.get_mutable_discrete_state().get_mutable_value(0)
            held[:] = [0.0, 0.0, 0.0, 0.0, 0.0, force]

        self.DeclarePeriodicUnrestrictedUpdateEvent(2e-3, 0.0, update)


@pytest.mark.parametrize("stiffness", [5e3, 1e6])
def test_what_gives_holds_the_force_of_a_stiff_contact_and_creeps_on(stiffness):
    """A knife held 1 mm deep, in what answers up to fifty times as stiffly as the arm."""
    arm = ArmErrors(compliance=5e-5, creep=1e-4, creep_time=0.05)
    builder = DiagramBuilder()
    mount = builder.AddSystem(GivingMount(BenchErrors(arm=arm), 2e-3))
    spring = builder.AddSystem(Spring(stiffness))
    pose = builder.AddSystem(ConstantValueSource(Value(RigidTransform([0.0, 0.0, -1e-3]))))
    builder.Connect(pose.get_output_port(), mount.GetInputPort("knife_pose"))
    builder.Connect(spring.get_output_port(), mount.GetInputPort("food_wrench_vector"))
    builder.Connect(mount.get_output_port(), spring.get_input_port())
    simulator = Simulator(builder.Build())
    forces = []
    for k in range(400):
        simulator.AdvanceTo(2e-3 * (k + 0.5))
        context = spring.GetMyContextFromRoot(simulator.get_context())
        forces.append(spring.get_output_port().Eval(context)[5])
    force = np.array(forces)
    at_once = stiffness * 1e-3 / (1.0 + arm.compliance * stiffness)
    assert force[-1] == pytest.approx(
        stiffness * 1e-3 / (1.0 + (arm.compliance + arm.creep) * stiffness), rel=1e-3
    )
    assert at_once * 0.7 < force[5] < at_once * 1.3
    assert np.abs(np.diff(force[50:])).max() < 0.02 * at_once


def test_the_bench_of_a_calibrated_food_reaches_the_station(tmp_path):
    bench = BenchErrors(sensor=SENSOR, board=BoardErrors(exponent=0.1))
    dump_yaml(CalibratedFood(bench=bench), tmp_path / "extended.yaml")
    assert load_calibrated_food(tmp_path / "extended.yaml").bench == bench
    given = f"calibration={tmp_path / 'extended.yaml'}"
    loaded = load_scenario("cucumber", given)
    assert loaded.bench == bench
    # It is said what a station does not follow.
    (said,) = loaded.not_simulated()
    assert "bench.board.exponent" in said
    changed = load_scenario("cucumber", [given, "bench.sensor.delay=0.0"])
    assert changed.bench.sensor == dc.replace(SENSOR, delay=0.0)


def test_a_tool_that_is_lighter_than_nothing_is_refused():
    with pytest.raises(ConfigurationError, match="can carry") as error:
        load_scenario("cucumber", "{bench: {tool: {mass: -0.2}}}")
    assert error.value.field == "scenario.bench.tool"
