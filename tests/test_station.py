"""The simulated station: contract, energy balance, measured curve, repeatability."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from station_contract import check_station_ports

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Retract
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.ports import STATION_PORTS, ports_as_markdown
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.knife_force import KnifeForceSystem

# World height of the edge at the start over an analytic food: board, diameter, clearance.
START_HEIGHT = 0.05 + 0.027 + 0.010

SMALL_FOOD = "{food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}}"


def cucumber(overrides: str = SMALL_FOOD) -> Scenario:
    return load_scenario(resource_path("scenarios/cucumber_measured.yaml"), overrides)


@pytest.fixture(scope="module")
def cut() -> tuple[Run, Record]:
    run = prepare_run(cucumber())
    run.advance()
    assert run.stopped is None
    return run, run.record()


@pytest.mark.parametrize("food", ["finite elements", "analytic"])
def test_station_keeps_the_port_contract(food):
    scenario = cucumber()
    if food == "analytic":
        scenario.food = AnalyticFood()
    check_station_ports(MakeStation(scenario))


def test_contract_check_names_what_is_missing():
    from pydrake.systems.primitives import ConstantVectorSource

    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.zeros(5)))
    builder.ExportOutput(source.get_output_port(), "joint_positions")
    with pytest.raises(ValueError, match="joint_positions is not a vector of 6") as raised:
        check_station_ports(builder.Build())
    assert "no input port target_pose" in str(raised.value)


def test_printed_contract_lists_every_port():
    text = ports_as_markdown()
    assert all(f"| {port.name} |" in text for port in STATION_PORTS)


def test_knife_cuts_through_and_returns_at_the_commanded_speed(cut):
    run, record = cut
    assert record["cut_progress"][-1] > 0.999
    cutting = (record["cut_progress"] > 0.05) & (record["cut_progress"] < 0.9)
    assert record["knife_velocity_v_z"][cutting].mean() == pytest.approx(-0.02, rel=0.02)
    lifted = record["knife_pose_p_z"][-1] - record["knife_pose_p_z"].min()
    assert lifted == pytest.approx(0.05, abs=0.003)
    lateral = record.vector("knife_pose_p") - record.vector("target_pose_p")
    assert np.abs(lateral[:, :2]).max() < 1e-3


def test_knife_work_in_the_log_less_every_other_mechanism_is_toughness_times_area(cut):
    run, record = cut
    model = run.station.cutting.solver(
        run.station.cutting.GetMyContextFromRoot(run.simulator.get_context())
    ).model
    # Work from the logged wrench and poses alone, not from the food's own energy balance. Row k's
    # wrench is the mean over the coupling step that ends at its time.
    moved = np.diff(record.vector("knife_pose_p"), axis=0)
    force = record.vector("food_wrench_f")[1:]
    work = -float((force * moved).sum())
    damping = -record["energy_internal"][-1] - record["energy_elastic"][-1]
    stored = sum(record[f"energy_{name}"][-1] for name in ("elastic", "interface", "kinetic"))
    other = sum(
        record[f"energy_{name}"][-1] for name in ("opening", "friction", "board_friction", "blade")
    )
    through = run.scenario.food.material.toughness * model.section_area
    assert work + record["energy_gravity"][-1] - stored - other - damping == pytest.approx(
        through, rel=0.03
    )


def test_sensor_shows_food_and_board_while_the_knife_moves_steadily(cut):
    _, record = cut
    steady = (record["cut_progress"] > 0.1) & (record["cut_progress"] < 0.9)
    on_knife = record.vector("food_wrench_f") + record.vector("board_wrench_f")
    sensed = np.linalg.norm(record.vector("sensor_wrench_f"), axis=1)
    true = np.linalg.norm(on_knife, axis=1)
    assert np.median(np.abs(sensed - true)[steady]) < 0.02 * true[steady].max()


def test_coupling_work_error_stays_below_two_percent_of_the_cutting_work(cut):
    _, record = cut
    assert np.abs(record["coupling_work_error"]).max() < 0.02 * record["energy_work"].max()


def test_two_runs_of_one_scenario_agree_bit_for_bit():
    values = []
    for _ in range(2):
        run = prepare_run(cucumber())
        run.advance(duration=0.75)
        values.append(run.record().values)
    assert values[0][:, 1:].any()
    np.testing.assert_array_equal(values[0], values[1])


def test_analytic_food_gives_toughness_times_width():
    scenario = cucumber()
    scenario.food = AnalyticFood(diameter=0.027, toughness=300.0)
    scenario.measurement = None
    scenario.motion = MotionPlan([ConstantSpeed(distance=0.03, speed=0.05, acceleration=1.0)])
    run = prepare_run(scenario)
    run.advance()
    record = run.record()
    height = record["knife_pose_p_z"] - scenario.board.height
    inside = (height > 0.003) & (height < 0.024)
    width = 2.0 * np.sqrt(np.clip(height * (0.027 - height), 0.0, None))
    # The wrench is held over the coupling step after the pose that it was computed from.
    np.testing.assert_allclose(
        record["food_wrench_f_z"][inside], 300.0 * width[inside], rtol=0.0, atol=0.1
    )


class Spring(KnifeForceSystem):
    """A user's cutting system: a spring below the start."""

    def advance(self, context, state, X_WK):
        depth = max(0.0, START_HEIGHT - 0.005 - X_WK.translation()[2])
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2000.0 * depth]), 0.0


def test_station_takes_a_cutting_system_of_the_users_own():
    scenario = cucumber()
    scenario.food = AnalyticFood()
    builder = DiagramBuilder()
    station = builder.AddNamedSystem(
        "station",
        MakeStation(scenario, cutting=Spring(scenario.exchange_period)),
    )
    check_station_ports(station)
    assert station.start_pose.translation()[2] == pytest.approx(START_HEIGHT)
    builder.ExportInput(station.GetInputPort("target_pose"), "target_pose")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    station.SetStart(context)
    target = RigidTransform([0.0, 0.0, -0.010]) @ station.start_pose
    diagram.GetInputPort("target_pose").FixValue(context, target)
    simulator.AdvanceTo(1.5)
    force = station.GetOutputPort("food_wrench").Eval(station.GetMyContextFromRoot(context))
    height = station.GetOutputPort("knife_pose").Eval(station.GetMyContextFromRoot(context))
    depth = START_HEIGHT - 0.005 - height.translation()[2]
    assert depth > 0.003
    assert force.translational()[2] == pytest.approx(2000.0 * depth, rel=1e-2)


def test_knife_that_presses_on_the_bare_board_feels_the_boards_stiffness():
    scenario = cucumber()
    scenario.food = AnalyticFood(toughness=0.0)
    scenario.measurement = None
    scenario.board.stiffness = 2e4
    scenario.motion = MotionPlan(
        [
            ConstantSpeed(distance=0.038, speed=0.05, acceleration=1.0),
            Hold(duration=0.8),
            Retract(distance=0.01, speed=0.05, acceleration=1.0),
        ]
    )
    run = prepare_run(scenario)
    run.advance(duration=1.5)
    record = run.record()
    penetration = scenario.board.height - record["knife_pose_p_z"][-1]
    assert penetration > 1e-5
    assert record["board_wrench_f_z"][-1] == pytest.approx(2e4 * penetration, rel=0.02)


def test_unreachable_food_is_refused_with_its_place():
    scenario = cucumber()
    scenario.placement.position = [1.5, -1.5]
    with pytest.raises(ConfigurationError, match=r"scenario\.placement.*cannot put the knife"):
        MakeStation(scenario)


def test_a_food_that_is_higher_than_the_blade_is_refused():
    scenario = cucumber()
    scenario.knife.height = 0.02
    with pytest.raises(ConfigurationError, match=r"scenario\.knife\.height.*20 mm.*food 27"):
        MakeStation(scenario)


@pytest.mark.parametrize("group", ["compliance: {arm: 1.0e-5}", "slip: {remaining: 0.2}"])
def test_a_station_refuses_effects_that_are_for_a_prescribed_motion(group):
    with pytest.raises(ConfigurationError, match="prescribed motion") as error:
        load_scenario(
            resource_path("scenarios/cucumber_measured.yaml"), f"{{food: {{effects: {{{group}}}}}}}"
        )
    assert "food.effects." in (error.value.field or "")
