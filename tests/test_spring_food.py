"""The spring-only baseline: statics, energy, calibration, ODE's parameters, and its station."""

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from station_contract import check_station_ports

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.foods.spring_food import SpringFood, calibrate_spring
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.spring_cutter import SpringCutter

PERIOD = 0.002
FOOD = SpringFood(height=0.03, stiffness=500.0, damping=2.0, mass=0.01, time_step=1e-3)
DOWN = RotationMatrix(np.diag([1.0, -1.0, -1.0]))


class Press:
    """A button under a knife whose edge is at height(t), x off the button's axis."""

    def __init__(self, height, food: SpringFood = FOOD, x: float = 0.0, tilt: float = 0.0) -> None:
        R_WK = RotationMatrix.MakeYRotation(tilt) @ DOWN
        self.pose = lambda t: RigidTransform(R_WK, [x, 0.0, height(t)])
        source = KnifeSource(self.pose)
        builder = DiagramBuilder()
        builder.AddSystem(source)
        self.cutter = builder.AddSystem(SpringCutter(food, Knife(), RigidTransform(), PERIOD))
        for name in ("knife_pose", "knife_velocity"):
            builder.Connect(source.GetOutputPort(name), self.cutter.GetInputPort(name))
        self.simulator = Simulator(builder.Build())

    @property
    def context(self) -> Context:
        return self.cutter.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def run(self, duration: float) -> np.ndarray:
        """Rows of end time, moment [3], force [3], compression, rate of each coupling step."""
        rows = []
        for k in range(1, round(duration / PERIOD) + 1):
            self.simulator.AdvanceTo(k * PERIOD)
            # Updates at k * PERIOD itself run when time passes it.
            self.simulator.AdvancePendingEvents()
            wrench = self.cutter.GetOutputPort("food_wrench_vector").Eval(self.context)
            button = self.cutter.GetOutputPort("compression").Eval(self.context)
            rows.append([k * PERIOD, *wrench, *button])
        return np.array(rows)


class KnifeSource(LeafSystem):
    def __init__(self, pose) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "knife_pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, out: out.set_value(pose(context.get_time())),
        )
        self.DeclareAbstractOutputPort(
            "knife_velocity",
            lambda: AbstractValue.Make(SpatialVelocity.Zero()),
            lambda context, out: out.set_value(SpatialVelocity.Zero()),
        )


def down_and_up(depth: float, speed: float, start: float = 0.03):
    turn = depth / speed
    return lambda t: start - speed * min(t, max(2.0 * turn - t, 0.0))


@pytest.mark.parametrize("depth", [0.004, 0.03])
def test_a_button_at_rest_pushes_with_stiffness_times_compression(depth):
    rows = Press(lambda t: 0.03 - min(0.1 * t, depth)).run(0.1 + depth / 0.1)
    np.testing.assert_allclose(rows[-1, 1:7], [0, 0, 0, 0, 0, 500.0 * depth], atol=1e-9)


def test_a_knife_above_the_button_feels_nothing():
    rows = Press(lambda t: 0.0301 + 0.01 * np.sin(20.0 * t) ** 2).run(0.3)
    assert not rows[:, 1:].any()


def test_a_knife_below_the_board_feels_full_compression_and_no_more():
    rows = Press(lambda t: 0.03 - min(0.1 * t, 0.032)).run(0.5)
    assert rows[-1, 6] == pytest.approx(15.0, rel=1e-9)


def test_a_moving_button_adds_its_damping():
    rows = Press(lambda t: 0.03 - 0.1 * t).run(0.2)
    steady = rows[10:]
    # Mean over a coupling step of two backward steps, at 1/2 and all of it.
    mean = 0.1 * (steady[:, 0] - PERIOD) + 0.1 * 0.75 * PERIOD
    np.testing.assert_allclose(steady[:, 6], 500.0 * mean + 2.0 * 0.1, rtol=1e-9)


def test_work_of_a_press_and_release_is_what_the_damper_dissipates():
    food = dc.replace(FOOD, time_step=1e-5, damping=20.0)
    depth, speed = 0.02, 0.05
    rows = Press(down_and_up(depth, speed), food).run(2.0 * depth / speed + 0.2)
    heights = np.array([down_and_up(depth, speed)(t) for t in [0.0, *rows[:, 0]]])
    work = -float((rows[:, 6] * np.diff(heights)).sum())
    # While it carries the knife the button moves at the knife's speed; the little that is left
    # when the knife leaves it behind, k x = c v, is dissipated as well, x (k x) / 2.
    left = food.damping * speed / food.stiffness
    dissipated = food.damping * speed**2 * (2.0 * depth / speed - left / speed)
    dissipated += 0.5 * food.stiffness * left**2 + 0.5 * food.mass * speed**2
    assert work == pytest.approx(dissipated, rel=0.01)
    assert work > 0.03


def test_the_knife_is_never_pulled_back_and_the_button_follows_at_its_own_pace():
    food = dc.replace(FOOD, damping=50.0)  # Returns with a time constant of 0.1 s.
    depth = 0.02
    rows = Press(lambda t: 0.03 - depth if t < 0.1 else 0.05, food).run(0.5)
    assert (rows[:, 6] >= 0.0).all()
    free = rows[:, 0] > 0.1 + PERIOD
    assert not rows[free, 6].any()
    tau = food.damping / food.stiffness
    # The edge leaves during the coupling step that ends at 0.1 s.
    expected = depth * np.exp(-(rows[free, 0] - 0.1 + PERIOD) / tau)
    np.testing.assert_allclose(rows[free, 7], expected, rtol=0.03)


@pytest.mark.parametrize("stiffness", [1e2, 1e6])
def test_any_stiffness_is_stable(stiffness):
    food = dc.replace(FOOD, stiffness=stiffness, damping=0.0, mass=1e-4, time_step=0.02)
    rows = Press(down_and_up(0.01, 0.05), food).run(0.6)
    assert rows[:, 6].max() == pytest.approx(stiffness * 0.01, rel=0.05)
    np.testing.assert_allclose(rows[-1, 6:], 0.0, atol=1e-6)


def test_force_acts_where_the_edge_is_on_the_button():
    rows = Press(lambda t: 0.03 - min(0.1 * t, 0.01), x=0.04).run(0.3)
    # The button is 40 mm behind Ko: moment -0.04 x F about Wy of the force up is +0.04 F.
    np.testing.assert_allclose(rows[-1, 1:4], [0.0, 0.04 * 5.0, 0.0], atol=1e-9)
    assert not Press(lambda t: 0.02, x=0.1).run(0.1)[:, 1:].any()
    tilted = Press(lambda t: 0.03, x=0.04, tilt=-0.1).run(0.3)
    assert tilted[-1, 6] == pytest.approx(500.0 * 0.04 * np.tan(0.1), rel=1e-6)


# ODE's parameters -------------------------------------------------------------------------------


def test_one_step_of_a_free_button_is_that_of_odes_soft_constraint():
    food = dc.replace(FOOD, time_step=PERIOD)
    press = Press(lambda t: 1.0, food)
    press.simulator.Initialize()
    x, v, h, m = 0.012, -0.3, PERIOD, food.mass
    press.context.SetDiscreteState(press.cutter._button, [x, v])
    press.simulator.AdvanceTo(PERIOD)
    press.simulator.AdvancePendingEvents()
    # ODE: (J M^-1 J' + CFM / h) f = (-ERP x / h - J v) / h, with J = 1.
    force = ((-food.erp() * x / h - v) / h) / (1.0 / m + food.cfm() / h)
    rate = v + h * force / m
    button = press.cutter.GetOutputPort("compression").Eval(press.context)
    np.testing.assert_allclose(button, [x + h * rate, rate], rtol=1e-12)


def test_stiffness_and_damping_survive_the_way_through_erp_and_cfm():
    assert FOOD.erp() == pytest.approx(0.2) and FOOD.cfm() == pytest.approx(0.4)
    again = SpringFood(time_step=FOOD.time_step).with_erp_cfm(FOOD.erp(), FOOD.cfm())
    assert again.stiffness == pytest.approx(FOOD.stiffness, rel=1e-12)
    assert again.damping == pytest.approx(FOOD.damping, rel=1e-12)
    with pytest.raises(ConfigurationError, match=r"erp.*not within \(0, 1\]"):
        FOOD.with_erp_cfm(1.2, 0.4)


def test_noise_on_erp_scales_the_stiffness_in_the_context_alone():
    press = Press(lambda t: 0.02, dc.replace(FOOD, erp_noise=0.3))
    press.run(0.02)
    rng, drawn = np.random.default_rng(3), []
    for _ in range(500):
        press.cutter.randomize_context(press.context, rng)
        drawn.append(press.cutter.spring(press.context))
    stiffness, damping = np.array(drawn).T
    assert 350.0 <= stiffness.min() < 360.0 and 640.0 < stiffness.max() <= 650.0
    np.testing.assert_allclose(stiffness * FOOD.time_step + damping, 2.5, rtol=1e-12)
    assert not press.cutter.GetOutputPort("compression").Eval(press.context).any()
    fresh = Press(lambda t: 0.02).context
    assert press.cutter.spring(press.cutter.CreateDefaultContext()) == (500.0, 2.0)
    assert fresh.get_numeric_parameter(0).value().tolist() == [500.0, 2.0]


def test_noise_that_takes_erp_beyond_one_is_refused():
    with pytest.raises(ConfigurationError, match=r"food.erp_noise.*at most 0.25"):
        validate(dc.replace(FOOD, damping=0.125, erp_noise=0.3), "food")


# Calibration ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("food", "height"), [("cucumber", 0.027), ("tomato", 0.048)])
def test_full_compression_gives_the_largest_measured_force(food, height):
    profile = load_force_profile(
        resource_path(f"calibration/measured/sliceit_real_{food}_force.csv")
    )
    spring = calibrate_spring(profile.force, height)
    rows = Press(lambda t: height * (1.0 - min(t, 1.0)), spring).run(1.1)
    assert rows[-1, 6] == pytest.approx(profile.force.max(), rel=0.01)
    assert spring.erp() == pytest.approx(0.2)


def test_the_shipped_scenario_holds_the_calibrated_spring():
    scenario = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    assert isinstance(scenario.food, SpringFood) and scenario.measurement is not None
    profile = load_force_profile(resource_path(scenario.measurement.file))
    spring = calibrate_spring(profile.force, scenario.food.height)
    assert scenario.food.stiffness == pytest.approx(spring.stiffness, rel=1e-6)
    assert scenario.food.damping == pytest.approx(spring.damping, rel=1e-6)


def test_a_profile_without_force_is_refused():
    with pytest.raises(ConfigurationError, match="largest force is 0.0 N"):
        calibrate_spring([0.0, 0.0], 0.027)


# The station ------------------------------------------------------------------------------------


def spring_scenario():
    scenario = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    scenario.motion = MotionPlan(
        [ConstantSpeed(distance=0.0372, speed=0.05, acceleration=1.0), Hold(duration=0.15)]
    )
    return scenario


@pytest.mark.parametrize("food", ["spring", "analytic"])
def test_stations_without_elements_keep_the_port_contract_and_complete_a_slice(food):
    scenario = spring_scenario()
    if food == "analytic":
        scenario.food, scenario.measurement = AnalyticFood(), None
    check_station_ports(MakeStation(scenario))
    run = prepare_run(scenario)
    run.advance()
    record = run.record()
    assert run.stopped is None
    assert record["cut_progress"][-1] > 0.98
    assert record["food_wrench_f_z"].max() > 8.0


def test_the_food_sees_the_plant_at_the_instants_of_the_coupling_step():
    scenario = spring_scenario()
    scenario.motion = MotionPlan([ConstantSpeed(distance=0.0368, speed=0.02, acceleration=1.0)])
    run = prepare_run(scenario)
    run.advance(duration=1.2)
    record = run.record()
    # Row k's force was computed from the knife's pose one coupling step before it.
    depth = (scenario.board.height + scenario.food.height - record["knife_pose_p_z"])[:-1]
    force = record["food_wrench_f_z"][1:]
    steady = (record["time"][1:] > 0.7) & (record["time"][1:] < 1.2)
    residual = (force - scenario.food.stiffness * depth)[steady]
    # One plant step of 20 um more or less would make 0.08 N.
    assert np.abs(residual - np.median(residual)).max() < 0.01
