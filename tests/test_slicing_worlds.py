"""Worlds that a trained agent is evaluated in: the food of measured curves, and the slices."""

import dataclasses as dc
import functools
import typing

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan, Pose, Retract
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.agent_station import AgentStation
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.stand_in import slicing_worlds
from sliceit_drake.stand_in.curve_cutter import CurveCutter, CurveFood, food_curve
from sliceit_drake.stand_in.curve_laws import measured_curve
from sliceit_drake.stand_in.curve_world import CurveWorld
from sliceit_drake.stand_in.effect import Series
from sliceit_drake.stand_in.protocol import Condition, Protocol, Specimen
from sliceit_drake.stand_in.slicing_worlds import (
    SLICING_FOODS,
    CurvesWorld,
    StandInWorld,
    paper_slices,
)
from sliceit_drake.systems.agent import AgentConfig

PERIOD = 0.002
DIAMETER = 0.027
CLEARANCE = 3e-3
WORLDS = (StandInWorld(), CurvesWorld())
X_WF = RigidTransform(RollPitchYaw(0.0, 0.0, 0.5 * np.pi), [0.03, -0.5, 0.05])
"""A food that is turned and not at the origin."""

PATHS = {
    "press": [ConstantSpeed(distance=0.024, speed=0.02)],
    "hold_and_again": [
        ConstantSpeed(distance=0.012, speed=0.02),
        Hold(1.0),
        ConstantSpeed(distance=0.01, speed=0.05),
    ],
    "open_cut": [
        ConstantSpeed(distance=0.018, speed=0.02),
        Retract(distance=0.01, speed=0.05),
        ConstantSpeed(distance=0.023, speed=0.02),
    ],
    "draw": [ConstantSpeed(direction=[1.0, 0.0, 1.0], distance=0.036, speed=0.028)],
}


class Knife(LeafSystem):
    """A knife on a prescribed motion in F, its poses in W."""

    def __init__(self, pose) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "knife_pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, out: out.set_value(X_WF @ pose(context.get_time())),
        )
        self.DeclareAbstractOutputPort(
            "knife_velocity",
            lambda: AbstractValue.Make(SpatialVelocity.Zero()),
            lambda context, out: out.set_value(SpatialVelocity.Zero()),
        )


class Bench:
    """A `CurveCutter` under a knife with pose(t) in F."""

    def __init__(self, pose, food: CurveFood) -> None:
        builder = DiagramBuilder()
        source = builder.AddSystem(Knife(pose))
        self.cutter = builder.AddSystem(CurveCutter(food, X_WF, PERIOD))
        for name in ("knife_pose", "knife_velocity"):
            builder.Connect(source.GetOutputPort(name), self.cutter.GetInputPort(name))
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)

    @property
    def context(self) -> Context:
        return self.cutter.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def run(self, duration: float) -> np.ndarray:
        """Moment and force in F, force of the edge in F, progress, after each coupling step [N,
        10]."""
        self.simulator.Initialize()
        R_FW, rows = X_WF.rotation().matrix().T, []
        for k in range(1, round(duration / PERIOD) + 1):
            self.simulator.AdvanceTo(k * PERIOD)
            self.simulator.AdvancePendingEvents()
            rows.append(self.row(self.cutter, self.context, R_FW))
        return np.array(rows)

    @staticmethod
    def row(cutter: CurveCutter, context: Context, R_FW: np.ndarray) -> list[float]:
        wrench = cutter.GetOutputPort("food_wrench_vector").Eval(context)
        edge = cutter.GetOutputPort("force_components").Eval(context)[:3]
        progress = cutter.GetOutputPort("cut_progress").Eval(context)
        return [*(R_FW @ wrench[:3]), *(R_FW @ wrench[3:]), *(R_FW @ edge), *progress]


def specimen(segments: list, offset: float = 0.0) -> Specimen:
    condition = Condition(motion=MotionPlan(segments), clearance=CLEARANCE, offset=offset)
    return Specimen(0, condition, toughness=1.2, friction=0.7)


def world_series(cut: Specimen) -> Series:
    protocol = Protocol(
        food=Food(shape=Cylinder(diameter=DIAMETER)),
        exchange_period=PERIOD,
        conditions=[cut.condition],
    )
    return CurveWorld(protocol).cut(cut, [], np.random.default_rng(0))


def bench_of(cut: Specimen, **food) -> tuple[Bench, Motion]:
    start = Pose(
        np.diag([1.0, -1.0, -1.0]),
        np.array([cut.condition.offset, 0.0, DIAMETER + CLEARANCE]),
    )
    motion = Motion(cut.condition.motion, start)

    def pose(t: float) -> RigidTransform:
        X = motion.pose(t)
        return RigidTransform(RotationMatrix(X.R), X.p)

    food = {"toughness": cut.toughness, "friction": cut.friction} | food
    return Bench(pose, CurveFood("cucumber", DIAMETER, DIAMETER, **food)), motion


# The food of measured curves


@pytest.mark.parametrize("name", PATHS)
def test_on_a_prescribed_path_the_forces_are_those_of_the_world_of_curves(name):
    cut = specimen(PATHS[name], offset=4e-3)
    series = world_series(cut)
    bench, motion = bench_of(cut)
    found = bench.run(motion.duration)
    food = series.edge + series.normal + series.friction
    count = min(len(found), len(food))
    for part in (slice(0, 3), slice(3, 6)):
        there = food[:count, part]
        difference = np.sqrt(np.mean((found[:count, part] - there) ** 2))
        assert difference < 0.02 * np.sqrt(np.mean(there**2))


def test_drawing_turns_and_lowers_the_edges_force_as_atkins_says():
    press = bench_of(specimen(PATHS["press"]))[0].run(1.0)
    # The same speed down and 0.5 to 3 times that along the edge.
    for xi in (0.5, 1.0, 3.0):
        path = [
            ConstantSpeed(
                direction=[xi, 0.0, 1.0],
                distance=0.02 * np.hypot(1.0, xi),
                speed=0.02 * np.hypot(1.0, xi),
            )
        ]
        drawn = bench_of(specimen(path))[0].run(0.9)
        at = slice(400, 440)
        vertical, along = drawn[at, 8].sum(), -drawn[at, 6].sum()
        assert along / vertical == pytest.approx(xi, rel=0.01)
        # Speed acts as well, by its power.
        whole = press[at, 8].sum() * np.hypot(1.0, xi) ** 0.07
        assert vertical == pytest.approx(whole / (1.0 + xi**2), rel=0.02)


def test_a_knife_that_is_only_drawn_meets_no_force_upwards_from_the_edge():
    path = [
        ConstantSpeed(distance=0.015, speed=0.02),
        ConstantSpeed(direction=[1.0, 0.0, 0.0], distance=2e-3, speed=0.02),
    ]
    found = bench_of(specimen(path))[0].run(0.84)
    assert found[370, 8] > 3.0
    assert abs(found[-1, 8]) < 1e-2 * found[370, 8]


def test_a_draw_that_turns_round_turns_the_force_over_the_travel_that_finite_elements_need():
    # From 20 mm/s one way, slowly down, to the same the other way.
    there = ConstantSpeed(direction=[1.0, 0.0, 0.5], distance=0.0224, speed=0.0224)
    back = ConstantSpeed(direction=[-1.0, 0.0, 0.2], distance=3e-3, speed=0.0204)
    path = [there, back]
    bench, motion = bench_of(specimen(path, offset=-0.01))
    along = bench.run(motion.duration)[:, 3]
    calibrated = load_calibrated_food("cucumber")
    food = calibrated.apply_to(calibrated.food)
    numerics = Numerics()
    model = make_food_model(food, calibrated.knife, numerics)
    start = start_pose(model, CLEARANCE, offset=-0.01)
    elements = simulate_slice(CuttingSolver(model, PERIOD), Motion(MotionPlan(path), start))
    turn = round(there.distance / there.speed / PERIOD)

    def travel(force: np.ndarray) -> float:
        force = force[turn - 1 :] / force[turn - 1]
        assert force[-1] < -0.3
        return float(np.argmax(force < 0.0)) * PERIOD * back.speed

    assert travel(along) == pytest.approx(travel(elements.food_wrench[:, 3]), rel=0.5)


def test_in_an_open_cut_the_edge_meets_nothing_and_no_cut_is_lost():
    bench, motion = bench_of(specimen(PATHS["open_cut"]))
    found = bench.run(motion.duration)
    progress = found[:, 9]
    assert np.all(np.diff(progress) >= 0.0)
    # Up by 10 mm from 0.9 s to 1.1 s, and down again to 1.6 s.
    opened = slice(480, 760)
    assert np.abs(found[opened, 6:9]).max() == 0.0
    assert np.ptp(progress[opened]) == 0.0
    assert progress[-1] == 1.0 and found[-1, 8] == 0.0


def test_a_tilted_edge_is_in_the_food_where_the_food_is():
    def tilted(x: float):
        # Ko is x from the food's middle along an edge that falls by 0.1 rad.
        along = np.array([np.cos(0.1), 0.0, -np.sin(0.1)])
        R = RotationMatrix.MakeYRotation(0.1) @ RotationMatrix(np.diag([1.0, -1.0, -1.0]))

        def pose(t: float) -> RigidTransform:
            # 5 um more, so that contact falls between two coupling steps.
            middle = np.array([0.0, 0.0, DIAMETER + CLEARANCE + 5e-6 - 0.02 * t])
            return RigidTransform(R, middle + x * along)

        return pose

    food = CurveFood("cucumber", DIAMETER, DIAMETER)
    near, far = (Bench(tilted(x), food).run(0.8) for x in (0.0, 0.03))
    np.testing.assert_allclose(far[:, 3:], near[:, 3:], atol=1e-9)
    assert far[-1, 1] - near[-1, 1] == pytest.approx(
        0.03 * (np.cos(0.1) * near[-1, 5] + np.sin(0.1) * near[-1, 3]), rel=1e-6
    )


def test_two_contexts_do_not_disturb_each_other():
    bench, _ = bench_of(specimen(PATHS["press"]), toughness_spread=0.3)
    alone = bench_of(specimen(PATHS["press"]))[0].run(0.6)[:, :6]
    other = Simulator(bench.diagram)
    context = bench.cutter.GetMyMutableContextFromRoot(other.get_mutable_context())
    bench.cutter.randomize_context(context, np.random.default_rng(4))
    R_FW, rows = X_WF.rotation().matrix().T, ([], [])
    for simulator in (bench.simulator, other):
        simulator.Initialize()
    for k in range(1, 301):
        for simulator, into in zip((bench.simulator, other), rows, strict=True):
            simulator.AdvanceTo(k * PERIOD)
            simulator.AdvancePendingEvents()
            mine = bench.cutter.GetMyContextFromRoot(simulator.get_context())
            into.append(Bench.row(bench.cutter, mine, R_FW)[:6])
    first, second = np.array(rows[0]), np.array(rows[1])
    np.testing.assert_array_equal(first, alone)
    assert not np.allclose(second[-1], first[-1], rtol=0.01)


def test_a_random_slice_is_uncut_and_follows_from_the_numbers_drawn():
    bench, _ = bench_of(
        specimen(PATHS["press"]),
        toughness_spread=0.1,
        friction_spread=0.1,
        height_spread=0.02,
    )
    bench.run(0.6)
    context = bench.context
    assert bench.cutter.GetOutputPort("cut_progress").Eval(context)[0] > 0.1
    drawn = []
    for seed in (1, 2, 1):
        bench.cutter.randomize_context(context, np.random.default_rng(seed))
        drawn.append(context.get_numeric_parameter(0).value().copy())
        assert bench.cutter.GetOutputPort("cut_progress").Eval(context)[0] == 0.0
        assert not bench.cutter.GetOutputPort("food_wrench_vector").Eval(context).any()
    np.testing.assert_array_equal(drawn[0], drawn[2])
    assert np.all(drawn[0] != drawn[1])
    assert np.all(np.abs(np.log(drawn[0] / [1.2, 0.7, DIAMETER])) < [0.4, 0.4, 0.08])


def test_the_carrot_borrows_the_potatos_curve_within_the_published_forces():
    carrot, potato = food_curve("carrot"), measured_curve("potato")
    ratio = carrot.force / potato.force
    assert np.ptp(ratio) < 1e-12 * ratio[0]
    assert 47.9 < carrot.force.max() < 67.6
    with pytest.raises(ConfigurationError, match="no measured curve"):
        measured_curve("carrot")


# Worlds


def test_the_counts_are_those_of_the_paper():
    assert {food: paper_slices(food) for food in SLICING_FOODS} == {
        "cucumber": 15,
        "tomato": 5,
        "potato": 10,
        "carrot": 5,
    }
    with pytest.raises(ConfigurationError, match="onion"):
        paper_slices("onion")


@pytest.mark.parametrize("world", WORLDS, ids=["stand_in", "curves"])
def test_a_slice_follows_from_seed_food_and_index(world):
    for food in SLICING_FOODS:
        first, again = (world.scenario(food, 2) for _ in range(2))
        assert first == again
        validate(first.scenario, "scenario")
        assert first.food != world.scenario(food, 3).food
        assert first.scenario.sensor != world.scenario(food, 3).scenario.sensor
        assert first.food != dc.replace(world, seed=1).scenario(food, 2).food
    draws = [world.rng("tomato", k).random() for k in (0, 0, 1)]
    assert draws[0] == draws[1] != draws[2]
    with pytest.raises(ConfigurationError, match="slice"):
        world.scenario("tomato", -1)


@pytest.mark.parametrize("world", WORLDS, ids=["stand_in", "curves"])
def test_start_sensor_and_board_are_not_those_of_a_training(world):
    scenarios = [world.scenario("potato", k)[0] for k in range(10)]
    starts = np.array([[s.start.offset, s.start.clearance - 0.01] for s in scenarios])
    assert 3e-4 < np.abs(starts).mean() < 2e-3
    for scenario in scenarios:
        assert scenario.sensor.force_noise > 0.0 and scenario.sensor.delay > 0.0
        assert np.any(scenario.sensor.force_bias)
        assert scenario.controller.mode == "parallel"
    default = scenarios[0].robot.plant_time_step
    for stiffness, steps in ((3e3, 1.0), (3e4, 1.0), (3e5, 3.5)):
        scenario, cutting = world.scenario("potato", 0, stiffness)
        assert scenario.board.stiffness == stiffness
        assert default / scenario.robot.plant_time_step == pytest.approx(steps)
    MakeStation(scenario, cutting=cutting)


def test_the_stand_in_hides_effects_and_shifts_what_was_calibrated(monkeypatch):
    load = functools.cache(load_calibrated_food)
    monkeypatch.setattr(slicing_worlds, "load_calibrated_food", load)
    for name in SLICING_FOODS:
        calibrated = load(name).food
        ratios = []
        for k in range(400):
            food = StandInWorld().scenario(name, k)[0].food
            effects, material = food.effects, calibrated.material
            assert effects.toughness_rate.exponent > 0.0 and effects.adhesion.stress > 0.0
            assert effects.relaxation.shares[0] > 0.0 and effects.bluntness.initiation > 0.0
            assert effects.core == calibrated.effects.core
            assert food.shape.rings > calibrated.shape.rings
            ratios.append(
                [
                    food.material.toughness / material.toughness,
                    food.material.youngs_modulus / material.youngs_modulus,
                    food.material.friction / material.friction,
                    food.shape.diameter / calibrated.shape.diameter,
                ]
            )
        logs = np.log(ratios)
        assert np.exp(logs.mean(0)) == pytest.approx([1.15, 1.1, 0.8, 1.0], rel=0.02)
        assert logs.std(0) == pytest.approx([0.1, 0.1, 0.1, 0.02], rel=0.15)


def sliced(world, food: str, act, slice: int = 0) -> dict[str, typing.Any]:
    """A slice cut by the actions act(k) of an agent."""
    scenario, cutting = world.scenario(food, slice)
    station = MakeStation(scenario, cutting=cutting)
    descent = float(station.start_pose.translation()[2]) - scenario.board.height
    agent = AgentStation(station, dc.replace(AgentConfig(), descent=descent))
    simulator = Simulator(agent)
    agent.begin(simulator, world.rng(food, slice))
    context, force, message = simulator.get_context(), 0.0, ""
    for k in range(1, 100):
        agent.GetInputPort("action").FixValue(simulator.get_mutable_context(), act(k))
        message = simulator.AdvanceTo(0.05 * k).message()
        force = max(force, float(agent.GetOutputPort("food_wrench_vector").Eval(context)[5]))
        if message or agent.GetOutputPort("at_goal").Eval(context)[0] >= 2:
            break
    progress = float(agent.GetOutputPort("cut_progress").Eval(context)[0])
    time = context.get_time()
    return {"progress": progress, "force": force, "time": time, "message": message}


def press(k: int) -> np.ndarray:
    return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def saw(k: int) -> np.ndarray:
    return np.array([1.0, 0.0, -1.0, -1.0, 1.0 if k // 6 % 2 else -1.0, 0.4])


def test_a_pressing_agent_cuts_the_food_of_a_curve_on_the_station():
    cut = sliced(CurvesWorld(), "cucumber", press)
    assert cut["progress"] > 0.999 and cut["time"] < 4.0
    assert 8.0 < cut["force"] < 25.0


def test_a_draw_that_turns_round_in_a_carrot_does_not_shake_the_robot():
    # A force that turned round within 0.1 mm did, from 4 s on.
    cut = sliced(CurvesWorld(), "carrot", saw, slice=2)
    assert cut["message"] == "" and cut["progress"] > 0.9


def test_a_pressing_agent_cuts_the_stand_in_on_the_station():
    # Coarser than it is: the world itself is cut whole in docs and evaluation.
    cut = sliced(StandInWorld(refinement=0.75, time_step=2.5e-4), "cucumber", press)
    assert cut["progress"] > 0.999 and cut["time"] < 4.0
    assert 8.0 < cut["force"] < 30.0


def test_a_start_that_the_solver_loses_is_found_all_the_same():
    # SNOPT ends hundreds of millimetres away from them.
    scenario, cutting = CurvesWorld().scenario("cucumber", 0)
    station = MakeStation(scenario, cutting=cutting)
    for turn, along, down in (
        (0.005879094860128468, 0.008603410581129239, 0.007952523063621039),
        (-0.008087904811918664, -0.00754025177348717, -0.01874598279749657),
        (0.005273756148038711, 0.006891598029259418, 0.006392419986859136),
    ):
        shift = RigidTransform(RotationMatrix.MakeYRotation(turn), [along, 0.0, down])
        X_WK = station.start_pose @ shift
        joints = solve_start_joints(station.plant, station.robot.knife, X_WK, station.start_joints)
        context = station.plant.CreateDefaultContext()
        station.plant.SetPositions(context, joints)
        found = station.plant.EvalBodyPoseInWorld(context, station.robot.knife)
        assert found.IsNearlyEqualTo(X_WK, 1e-6)
        assert np.abs(joints - station.start_joints).max() < 0.3
