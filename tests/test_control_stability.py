"""Compliance control in contact: the linear loop is the station; unstable contact has a name."""

import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.agent_gains import ERROR_FACTOR, AgentGains
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.diagrams.stability import ContactLoop, check_contact_margin
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig
from sliceit_drake.systems.contact_monitor import (
    UNSTABLE_GAINS,
    ContactMonitor,
    ContactMonitorConfig,
)
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig
from studies.robot.control import (
    VERTICAL,
    agent_box,
    factor_row,
    factor_table,
    run_in_contact,
    stability_limits,
    station_growth,
    study_scenario,
    with_lag,
)
from studies.robot.stiffness_limit import directional_stiffness, stiffness_limit

CONTROL_DOC = Path(__file__).parents[1] / "docs/explanation/control.md"
SMALL_FOOD = "food: {shape: !Cylinder {rings: 3, layers: [0.0, 0.004, 0.012]}}, "


# Clamped on both sides and four times as stiff as a cucumber.
STIFF_FOOD = "food: {material: {youngs_modulus: 1.0e+7}}, "


def cucumber(overrides: str = "", food: str = SMALL_FOOD) -> Scenario:
    scenario = load_scenario(
        resource_path("scenarios/cucumber_measured.yaml"), f"{{{food}{overrides}}}"
    )
    scenario.measurement = None
    return scenario


@pytest.mark.parametrize(
    ("mode", "lag", "gain"),
    [("compliance", 0.005, 0.025), ("parallel", 0.02, 0.05)],
)
def test_station_is_stable_up_to_the_limit_of_the_linear_loop_and_not_beyond(mode, lag, gain):
    (limit,) = stability_limits(mode, [gain], lag)
    scenario = with_lag(study_scenario(mode, gain), lag)
    assert station_growth(scenario, 0.9 * limit, duration=1.0) < 1.0
    assert station_growth(scenario, 1.1 * limit, duration=1.0) > 1.0


def test_a_late_slow_sensor_lowers_the_limit_as_the_loop_says():
    scenario = study_scenario("compliance", 0.1)
    station = MakeStation(scenario)
    ideal = stiffness_limit(ContactLoop(station), VERTICAL)
    scenario.sensor = WrenchSensorConfig(delay=0.003, sample_period=0.004, cutoff_frequency=100.0)
    limit = stiffness_limit(ContactLoop(station), VERTICAL)
    assert limit < 0.75 * ideal
    assert station_growth(scenario, 0.9 * limit, duration=1.0) < 1.0
    assert station_growth(scenario, 1.1 * limit, duration=1.0) > 1.0


def test_growth_of_the_station_is_that_of_the_loops_least_stable_mode():
    scenario = study_scenario("compliance", 0.1)
    loop = ContactLoop(MakeStation(scenario))
    stiffness = 1.15 * stiffness_limit(loop, VERTICAL)
    mode = loop.least_stable_mode(directional_stiffness(VERTICAL, stiffness))
    assert station_growth(scenario, stiffness, 1.0) == pytest.approx(mode.growth, abs=3e-4)


def test_rigid_arm_without_lag_has_the_limit_of_one_axis_by_hand():
    scenario = study_scenario("compliance", 0.025)
    loop = ContactLoop(MakeStation(scenario), tracking="ideal")
    g, spring = loop.virtual_mobility[2, 2], scenario.controller.stiffness[2]
    h, damping = 0.02, 0.9

    def growth(stiffness: float) -> float:
        # Position, virtual velocity, position a coupling step ago, whose force the sensor reports.
        push = -damping * h * g * 0.025
        A = [[1.0, h, 0.0], [push * spring, damping, push * stiffness], [1.0, 0.0, 0.0]]
        return float(np.abs(np.linalg.eigvals(A)).max())

    grid = np.geomspace(1e3, 1e5, 2000)
    by_hand = grid[np.argmax([growth(k) > 1.0 for k in grid])]
    # The loop has the other five axes, which the vertical pulls along.
    assert stiffness_limit(loop, VERTICAL) == pytest.approx(by_hand, rel=0.03)


def test_default_cut_has_a_margin_far_above_two():
    margin = check_contact_margin(MakeStation(cucumber()))
    assert margin.food is not None
    assert margin.food >= 10.0
    assert margin.board >= 10.0
    # Sideways the slab clamps the blade, whose bending (20 kN/m) gives way.
    assert 1e4 < margin.stiffness[1] < 2e4


def test_a_clamped_blade_that_cannot_bend_is_refused():
    scenario = cucumber("knife: {lateral_stiffness: 1.0e+8}", food=STIFF_FOOD)
    with pytest.raises(ConfigurationError, match=r"knife\.lateral_stiffness") as refused:
        prepare_run(scenario)
    assert "exchange_period" in str(refused.value)


def test_that_blade_would_shake_and_the_run_ends_by_name(monkeypatch):
    scenario = cucumber("knife: {lateral_stiffness: 1.0e+8}", food=STIFF_FOOD)
    scenario.exchange_period = 4e-3
    scenario.motion = MotionPlan(
        [ConstantSpeed(distance=0.0345, speed=0.1, acceleration=2.0), Hold(duration=0.2)]
    )
    monkeypatch.setattr("sliceit_drake.diagrams.stability.MIN_MARGIN", 0.0)
    run = prepare_run(scenario)
    assert run.contact_margin.food < 1.0
    run.advance()
    assert run.stopped is not None
    assert UNSTABLE_GAINS in run.stopped
    assert run.simulator.get_context().get_time() < run.motion.duration
    station = run.station.GetMyContextFromRoot(run.simulator.get_context())
    assert run.station.GetOutputPort("unstable_gains").Eval(station)[0] == 1.0


def test_landing_on_the_board_and_resting_on_food_raise_no_alarm():
    scenario = Scenario(food=AnalyticFood())
    scenario.controller = ComplianceControllerConfig(mode="motion", p_gains=[200.0] * 6)
    scenario.controller.error_scale = 1.0
    scenario.motion = MotionPlan(
        [
            ConstantSpeed(distance=0.025, speed=0.1, acceleration=2.0),
            Hold(duration=0.1),
            ConstantSpeed(distance=0.013, speed=0.1, acceleration=2.0),
            Hold(duration=0.2),
        ]
    )
    run = prepare_run(scenario)
    run.advance()
    assert run.stopped is None
    assert run.record()["board_wrench_f_z"].max() > 10.0


class Wrench(LeafSystem):
    """A force along x given as a function of time."""

    def __init__(self, force):
        super().__init__()
        self._force = force
        self.DeclareVectorOutputPort("wrench", 6, self._calc, {self.time_ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        f = float(self._force(context.get_time()))
        output.SetFromVector([0.0, 0.0, 0.0, f, 0.0, 0.0])


def alarm_time(force, **sensor) -> float | None:
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    source = builder.AddSystem(Wrench(force))
    config = WrenchSensorConfig(**sensor)
    monitor = builder.AddSystem(ContactMonitor(ContactMonitorConfig(), 0.002, config))
    builder.Connect(source.get_output_port(), monitor.get_input_port())
    simulator = Simulator(builder.Build())
    status = simulator.AdvanceTo(2.0)
    if status.reason() != SimulatorStatus.ReturnReason.kReachedTerminationCondition:
        return None
    assert UNSTABLE_GAINS in status.message()
    return simulator.get_context().get_time()


def test_monitor_tells_lasting_oscillation_from_what_dies_out():
    noise = np.random.default_rng(0).normal(0.0, 3.5, 2000)
    cases = {
        "growing": lambda t: 0.5 * np.exp(5.0 * t) * np.sin(2 * np.pi * 12 * t),
        "limit cycle": lambda t: 10.0 * np.sin(2 * np.pi * 40 * t),
    }
    for name, force in cases.items():
        assert alarm_time(force) is not None, name
    harmless = {
        "impact": lambda t: 120.0 * np.exp(-8.0 * t) * np.sin(2 * np.pi * 25 * t),
        "cutting": lambda t: 20.0 * np.sin(np.pi * t / 2.0) + 0.5 * np.sin(2 * np.pi * 30 * t),
        "slow": lambda t: 30.0 * np.sin(2 * np.pi * 2.0 * t),
    }
    for name, force in harmless.items():
        assert alarm_time(force) is None, name
    assert alarm_time(lambda t: noise[round(t / 0.002)], force_noise=3.5) is None


def test_explosive_growth_is_caught_within_a_few_swings():
    time = alarm_time(lambda t: np.exp(80.0 * t) * np.sin(2 * np.pi * 50 * t))
    assert time is not None
    assert np.exp(80.0 * time) < 1000.0


# Middle, lowest, highest and a random point; `python -m studies control` runs all corners.
POINTS = [AgentGains(), *(agent_box(1)[k] for k in (0, 31, 32))]


@pytest.mark.parametrize("contact", ["food", "board"])
def test_agents_box_keeps_the_force_bounded(contact):
    for gains in POINTS:
        run = run_in_contact(gains, ERROR_FACTOR, contact, duration=0.12)
        assert run.stopped is None, gains
        assert run.peak < 50.0


@pytest.mark.parametrize("contact", ["food", "board"])
def test_gains_without_the_factor_end_by_name_or_stay_bounded(contact):
    runs = [run_in_contact(gains, 1.0, contact, duration=0.15) for gains in (POINTS[0], POINTS[2])]
    assert any(run.stopped is not None for run in runs)
    for run in runs:
        assert run.peak < 200.0


def test_numbers_of_the_control_doc_are_those_of_the_loop():
    text = CONTROL_DOC.read_text()
    for factor in (0.01, ERROR_FACTOR):
        row = factor_table([factor_row(factor, 0.03)]).splitlines()[-1]
        assert row in text, row
    (said,) = re.findall(r"factor on the error scale is \*\*([\d.]+)\*\*", text)
    assert float(said) == ERROR_FACTOR
