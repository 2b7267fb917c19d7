"""The straight motion to the start: slow enough, watched, and stopped by all that stops a run."""

import contextlib
import dataclasses as dc
import os
import signal
import time as clock

import numpy as np
import pytest
from fake_robot import FakeRobot
from fake_station import CONFIG, PACE, spring_scenario

from sliceit_drake.diagrams.hardware_station import make_edge_kinematics
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.client import RobotUnavailableError
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.interruption import catch_signals
from sliceit_drake.robot_run.hardware_run import prepare_hardware_run
from sliceit_drake.robot_run.move_to_start import MoveToStart


@pytest.fixture(scope="module")
def start():
    return MakeStation(spring_scenario()).start_joints


@pytest.fixture
def robot(start):
    """Some way above the start, and to the side of it."""
    robot = FakeRobot((start + [0.1, -0.15, 0.0, 0.0, 0.0, 0.1]).tolist(), PACE)
    yield robot
    robot.close()


def move_of(robot, **changes):
    config = HardwareConfig(**(CONFIG | changes))
    return MoveToStart(prepare_hardware_run(spring_scenario(), config, robot, PACE))


def place(robot, q):
    """Puts the arm somewhere, and holds it there."""
    robot.frozen = True
    robot.wait(0.01)
    robot.q = q.tolist()


def failed(checks):
    return [check.name for check in checks if not check.passed]


def test_it_arrives_with_the_watchdog_set_and_stops_the_program(robot, start):
    move = move_of(robot)
    assert failed(move.checks()) == []
    assert move.execute() is None
    assert np.abs(robot.q - start).max() < 0.01
    assert robot.log[:2] == ["watchdog", "move"] and robot.log[-1] == "stop"
    assert robot.log.count("kick") > 10


def test_a_short_way_is_gone_to_its_end(robot, start):
    place(robot, start + 0.005)
    robot.target, robot._state = robot.q, robot._law.state_at_rest(robot.q)
    robot.frozen = False
    assert move_of(robot).execute() is None
    assert np.abs(robot.q - start).max() < 1.1e-3


@pytest.mark.parametrize("most", [0.15, 0.05])
def test_the_knife_keeps_its_limit_of_speed_on_the_way(most, robot, start):
    limits = dc.replace(CONFIG["limits"], knife_speed=most)
    move = move_of(robot, limits=limits)
    kinematics = make_edge_kinematics(move.hardware.twin)
    # A fifth of a second of the way at that speed.
    way = start - robot.q
    share = 0.2 * move.speed / np.abs(way).max()
    for at in np.linspace(0.0, 1.0 - share, 20):
        ends = [kinematics.edge((robot.q + s * way).tolist())[:2] for s in (at, at + share)]
        assert np.linalg.norm(np.diff(ends, axis=0), axis=2).max() / 0.2 <= most * (1 + 1e-3)
    assert move.knife_speed <= most * (1 + 1e-9)


def test_a_way_through_the_board_or_of_half_a_turn_is_refused(robot, start):
    # The elbow bends through: high at both ends, low between them.
    place(robot, start + [0.0, 0.9, 0.9, 0.3, 0.0, 0.0])
    move = move_of(robot)
    assert failed(move.checks()) == ["clearance on the way", "way to the start"]
    assert move.lowest < move.floor < 0.05
    # From under the expected board it may go up.
    place(robot, start + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    assert failed(move_of(robot).checks()) == []
    place(robot, start + [0.0, -0.15, 0.0, 0.0, 0.0, -3.3])
    assert failed(move_of(robot).checks()) == ["joints on the way"]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"bits": 1 << 2}, "protective stop"),
        ({"runtime": 1}, "program is stopped"),
        ({"frozen": True}, "no data"),
        ({"connected": False}, "no data"),
        ({"wrench": [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]}, "meets a force: 60 N, allowed 50"),
        ({"wrench": [np.nan] * 6}, "meets a force"),
        ({"wrench": [0.0, 0.0, 0.0, 0.0, 11.0, 0.0]}, "meets a torque: 11 Nm, allowed 10"),
        ({"wrench": [0.0, 0.0, 30.0, 0.0, 0.0, 0.0]}, "force_rate: the force jumps by 30 N"),
        ({"_noise": 0.0}, "force_age: all force readings are exactly 0"),
    ],
    ids=lambda value: str(next(iter(value))) if isinstance(value, dict) else None,
)
def test_a_fault_on_the_way_stops_it(fault, said, robot, start):
    move = move_of(robot)

    def fail():
        for name, value in fault.items():
            setattr(robot, name, value)

    robot.later(0.2, fail)
    assert said in move.execute()
    assert robot.stopped.is_set()
    robot.frozen = False
    robot.wait(0.2)
    assert np.abs(robot.q - start).max() > 0.05, "it went on"


@pytest.mark.parametrize("shown", [2.0, np.nan])
def test_a_joint_that_is_shown_too_fast_stops_the_motion(shown, robot):
    move, read = move_of(robot), robot.read
    robot.read = lambda: read()._replace(qd=[0.0, shown, 0.0, 0.0, 0.0, 0.0])
    assert "a joint moves faster" in move.execute()
    assert robot.stopped.is_set()


def test_an_arm_that_is_shown_below_the_board_stops_the_motion(robot, start):
    move, read = move_of(robot), robot.read
    low = (start + [0.0, 0.9, 0.0, 0.0, 0.0, 0.0]).tolist()
    robot.read = lambda: read()._replace(q=low if "move" in robot.log else robot.q)
    assert "mm too low" in move.execute()
    assert robot.stopped.is_set()


def test_an_operator_who_interrupts_it_stops_the_arm(robot, start):
    move, kicks = move_of(robot), []

    def interrupted():
        kicks.append(1)
        if len(kicks) > 20:
            raise KeyboardInterrupt

    robot.kick = interrupted
    with pytest.raises(KeyboardInterrupt):
        move.execute()
    assert robot.stopped.is_set()
    assert np.abs(robot.q - start).max() > 0.05


def test_it_does_not_begin_from_elsewhere_nor_without_the_watchdog(robot):
    move = move_of(robot)
    robot.set_watchdog = lambda frequency: False
    assert "watchdog" in move.execute()
    del robot.set_watchdog
    place(robot, np.array(robot.q) + 0.02)
    assert "moved the arm" in move.execute()
    assert "move" not in robot.log and robot.log[-1] == "stop"


def test_a_robot_that_does_not_say_it_has_stopped_is_named(robot):
    def stop():
        raise RuntimeError("it still plays")

    robot.stop = stop
    with pytest.raises(RobotUnavailableError, match="it still plays.*emergency stop"):
        move_of(robot).execute()


def test_an_interrupt_that_is_dropped_where_it_is_raised_still_stops_the_motion(robot, start):
    move, read = move_of(robot), robot.read

    def read_interrupted():
        if "move" in robot.log:
            # As Python does in a destructor or a callback.
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
                clock.sleep(0.01)
            robot.read = read
        return read()

    robot.read = read_interrupted
    with catch_signals(), pytest.raises(KeyboardInterrupt):
        move.execute()
    assert robot.log[-1] == "stop"
    assert np.abs(robot.q - start).max() > 0.05


def test_signals_are_handled_as_before_once_nothing_moves():
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with contextlib.suppress(KeyboardInterrupt), catch_signals():
        os.kill(os.getpid(), signal.SIGTERM)
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before
