"""Fresh food under the knife of an emulated robot that goes on running, as between two cuts."""

import dataclasses as dc
import json
import socket

import numpy as np
import pytest
from emulator_bench import Bench

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Retract
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.emulator.pendant import PENDANT_PORT
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.emulator.station_robot import StationRobot
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.plan_check import plan_joints
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.servo import ServoConfig

DOWN_AND_UP = MotionPlan(
    [
        ConstantSpeed(distance=0.015, speed=0.05, acceleration=2.0),
        Retract(distance=0.015, speed=0.05, acceleration=2.0),
        Hold(duration=0.2),
    ]
)
SERVO = ServoConfig()


def analytic_scenario(**food):
    scenario = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    scenario.food = AnalyticFood(**food)
    scenario.start.clearance = 0.004
    scenario.motion = DOWN_AND_UP
    return scenario


@pytest.fixture(scope="module")
def path():
    """Joint targets of each cycle [n, 6]."""
    plan = plan_joints(MakeStation(analytic_scenario()))
    time = np.arange(0.0, plan.time[-1], CYCLE)
    return np.column_stack([np.interp(time, plan.time, q) for q in plan.q.T])


def mean_force(robot, path):
    """Along the flange's axis, N; the tool's inertia has no mean from rest to rest."""
    return abs(np.mean([robot.step(q, SERVO).wrench[2] for q in path]))


def test_the_same_food_again_resists_as_at_first_and_the_arm_feels_nothing_of_it(path):
    robot = StationRobot(analytic_scenario())
    first = mean_force(robot, path)
    assert first > 1.0
    assert mean_force(robot, path) < 0.5 * first, "the cut is open"
    before = robot.state
    robot.put_fresh_food()
    assert np.array_equal(robot.state.positions, before.positions)
    assert np.array_equal(robot.state.wrench, before.wrench), "the sensor's zero stays"
    after = robot.step(path[-1], SERVO)
    assert np.abs(after.positions - before.positions).max() < 1e-6
    assert mean_force(robot, path) == pytest.approx(first, rel=1e-3)


def test_another_food_and_bare_board_take_its_place(path):
    robot = StationRobot(analytic_scenario())
    first = mean_force(robot, path)
    robot.put_fresh_food(analytic_scenario(toughness=700.0))
    assert mean_force(robot, path) > 1.8 * first
    robot.put_fresh_food(analytic_scenario(toughness=0.0))
    assert mean_force(robot, path) < 0.01 * first
    robot.put_fresh_food()
    assert mean_force(robot, path) < 0.01 * first, "the same again is the one put there last"


def test_the_board_stays_as_stiff_as_it_was():
    scenario = analytic_scenario(toughness=0.0)
    scenario.motion = MotionPlan([ConstantSpeed(distance=0.0312, speed=0.05, acceleration=2.0)])
    plan = plan_joints(MakeStation(scenario))
    time = np.arange(0.0, plan.time[-1] + 0.1, CYCLE)
    down = np.column_stack([np.interp(time, plan.time, q) for q in plan.q.T])
    robot = StationRobot(scenario)
    first = mean_force(robot, down)
    mean_force(robot, down[::-1])
    mean_force(robot, down[:1].repeat(50, axis=0))
    robot.put_fresh_food()
    assert first > 0.5
    assert mean_force(robot, down) == pytest.approx(first, rel=1e-2)


def test_it_does_not_fit_under_a_knife_in_its_place_nor_change_the_knife(path):
    robot = StationRobot(analytic_scenario())
    lowest = len(path) // 3
    for q in path[:lowest]:
        state = robot.step(q, SERVO)
    with pytest.raises(ConfigurationError, match=r"knife is \d.* mm below the top .*Lift it"):
        robot.put_fresh_food()
    other = analytic_scenario()
    other.knife = dc.replace(other.knife, length=0.2)
    with pytest.raises(ConfigurationError, match="knife: is another"):
        robot.put_fresh_food(other)
    assert robot.state is state
    # Where nothing is put there is room.
    robot.put_fresh_food(analytic_scenario(toughness=0.0))


def pendant_of(bench):
    """A function that sends a request to the emulator's own port and returns the answer."""
    connection = socket.create_connection((bench.address, PENDANT_PORT), 5.0)
    bench.serve()

    def answer(request):
        connection.sendall(json.dumps(request).encode() + b"\n")
        bench.serve()
        return json.loads(connection.recv(65536))

    return answer


class Larder:
    """An arm that notes which food it is given."""

    def __init__(self, robot):
        self._robot, self.foods = robot, []

    def __getattr__(self, name):
        return getattr(self._robot, name)

    def put_fresh_food(self, scenario=None):
        self.foods.append(scenario)


def test_the_pendant_puts_food_there_only_while_nothing_can_move():
    with Bench() as bench:
        larder = bench.controller.robot = Larder(bench.controller.robot)
        answer = pendant_of(bench)
        assert answer({"fresh_food": True}) == {"ok": True}
        assert larder.foods == [None]
        text = dump_yaml(analytic_scenario(toughness=123.0))
        assert answer({"fresh_food": text}) == {"ok": True}
        assert larder.foods[1].food == AnalyticFood(toughness=123.0)
        assert [text for _, text in bench.controller.log] == ["fresh food"] * 2
        for request, said in (
            ({"fresh_food": "{food: {shape: 3}}"}, "shape"),
            ({"fresh_food": 3}, "true or a scenario"),
            ({"food": True}, "one of inject, status, trace, fresh_food, stop"),
        ):
            refused = answer(request)
            assert not refused["ok"] and said in refused["error"]
        bench.controller.start_program(Endless(), "test")
        refused = answer({"fresh_food": True})
        assert not refused["ok"] and "the program is PLAYING" in refused["error"]
        bench.controller.stop_program("test")
        larder.state.velocities = np.full(6, 0.1)
        assert "0.1 rad/s" in answer({"fresh_food": True})["error"]
        assert len(larder.foods) == 2


def test_an_arm_alone_has_no_food():
    with Bench() as bench:
        refused = pendant_of(bench)({"fresh_food": True})
    assert "Start the emulator with a scenario" in refused["error"]


class Endless:
    def step(self):
        return True
