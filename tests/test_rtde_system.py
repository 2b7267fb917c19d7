"""The link's thread and the Drake system of the robot, on a fake robot."""

import threading
import time as clock

import numpy as np
import pytest
from arm_at_start import BOARD, LENGTH, START, X_TK, X_WB, chain_pose
from fake_robot import FakeRobot

from sliceit_drake.hardware.client import RobotUnavailableError
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.hardware.rtde_system import RtdeSystem
from sliceit_drake.hardware.safety import SafetyLayer

PACE = 0.2
# Half a second on the wall: a busy machine shall not break a limit that a test is not about.
AGE = 0.1
LIMITS = SafetyLimits(state_age=AGE, command_age=AGE, joint_step=0.1)


@pytest.fixture
def robot():
    robot = FakeRobot(START, PACE)
    yield robot
    robot.close()


def make_link(robot):
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    safety = SafetyLayer(LIMITS, kinematics, BOARD, START)
    return RobotLink(robot, safety, pace=PACE)


def stream(link, seconds, speed=0.1):
    """Turns joint 1 at `speed`, rad/s, for controller seconds or until a stop."""
    status = link.latest()
    q, v, begin = list(status.state.q), 0.0, status.state.time
    while status.stop is None and status.state.time < begin + seconds:
        newer = link.wait(status, 2.0 * AGE / PACE)
        if newer is None:
            break
        v = min(speed, v + 5.0 * newer.period)
        q[0] += v * newer.period
        link.put(q, newer.state.time)
        status = newer
    return link.latest()


def wait_for_stop(link, seconds=10.0):
    status, deadline = link.latest(), clock.perf_counter() + seconds
    while status.stop is None and clock.perf_counter() < deadline:
        status = link.wait(status, 0.05) or status
    return status.stop


def test_the_watchdog_is_set_before_the_first_target_and_the_arm_follows(robot):
    link = make_link(robot)
    link.start()
    robot.wait(0.01)
    assert robot.sent == [] and robot.log == []
    assert link.arm() is None
    status = stream(link, 0.3)
    assert status.stop is None
    assert robot.log[0] == "watchdog" and robot.watchdog == 50.0
    assert robot.sent[-1][1][0] - START[0] == pytest.approx(0.1 * 0.3, abs=0.004)
    stop = link.finish("done")
    assert (stop.limit, stop.detail) == ("end", "done")
    assert robot.stopped.wait(10.0)
    # At the end it brakes: the last targets slow down, 10 rad/s2 at most.
    times = np.array([t for t, _ in robot.sent])
    moves = np.array([q[0] for _, q in robot.sent])
    v = np.diff(moves) / np.diff(times)
    assert v[-1] == 0.0 and v.max() > 0.09
    assert np.abs(np.diff(v) / np.diff(times)[1:]).max() <= 10.0 * (1 + 1e-6)


@pytest.mark.parametrize(
    ("fault", "limit", "goes_on"),
    [
        ({"bits": 1 << 2 | 1 << 10}, "safety_status", False),
        ({"runtime": 4}, "program", False),
        ({"runtime": 1}, "program", False),
        ({"frozen": True}, "state_age", False),
        ({"time": 0.0}, "state_age", False),
        ({"time": 105.0}, "state_age", False),
        ({"connected": False}, "link", False),
        ({"accepts": False}, "link", False),
        ({"call_time": 1.0}, "link", False),
        ({"wrench": [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]}, "force_rate", True),
        ({"wrench": [np.nan] * 6}, "measurement", True),
        ({"payload": (2.0, 0.0, 0.0, 0.06)}, "payload", True),
    ],
    ids=lambda value: str(next(iter(value))) if isinstance(value, dict) else str(value),
)
def test_each_fault_stops_the_robot_for_good(robot, fault, limit, goes_on):
    link = make_link(robot)
    link.start()
    assert link.arm() is None
    stream(link, 0.05)
    healthy = {name: getattr(robot, name) for name in fault}
    for name, value in fault.items():
        setattr(robot, name, value)
    begin = robot.time
    stream(link, 0.1)
    stop = wait_for_stop(link)
    assert stop is not None and stop.limit == limit
    if not goes_on:
        assert robot.stopped.wait(10.0), "the program on the robot was not stopped"
    sent = len(robot.sent)
    # Everything is well again: it must not resume.
    for name, value in healthy.items():
        setattr(robot, name, value if name != "time" else robot.time)
    for _ in range(20):
        link.put(robot.q, robot.time)
        robot.wait(0.004)
    assert link.latest().stop == stop or not link.latest().stop.sends
    if not goes_on:
        assert len(robot.sent) <= sent + 1
    else:
        positions = [q for t, q in robot.sent if t > begin + 0.03]
        assert positions and all(q == positions[0] for q in positions), "it did not hold"
    link.finish("test over")


@pytest.mark.parametrize("time", [np.nan, np.inf])
def test_a_clock_that_shows_no_time_stops_the_robot_in_plain_words(robot, time):
    link = make_link(robot)
    link.start()
    assert link.arm() is None
    stream(link, 0.05)
    robot.time = time
    assert robot.stopped.wait(10.0), "the program on the robot was not stopped"
    stop = link.finish("test over")
    assert (stop.limit, stop.sends) == ("link", False)
    assert stop.detail == f"the controller's clock shows {time}: no time"


def test_a_diagram_that_comes_late_stops_the_robot(robot):
    link = make_link(robot)
    link.start()
    link.arm()
    stream(link, 0.05)
    stop = wait_for_stop(link)
    assert stop.limit == "command_age" and stop.value > AGE
    link.finish("test over")


def test_a_hold_that_nobody_ends_stops_the_robots_program(robot, monkeypatch):
    monkeypatch.setattr("sliceit_drake.hardware.rtde_link.HOLD_TIME", 0.05)
    link, told = make_link(robot), []
    link.abandoned = told.append
    link.start()
    link.arm()
    stream(link, 0.05)
    # As in a policy that never returns: `finish` is not called.
    assert robot.stopped.wait(20.0), "the arm is held for ever"
    robot.wait(0.02)
    sent = len(robot.sent)
    robot.wait(0.05)
    assert len(robot.sent) == sent and robot.log.count("stop") == 1
    assert [stop.limit for stop in told] == ["command_age"]
    stop = link.finish("test over")
    assert (stop.limit, stop.sends) == ("command_age", False)


def test_nothing_is_late_before_the_first_command(robot):
    link = make_link(robot)
    link.start()
    link.arm()
    robot.wait(2.0 * AGE)
    assert link.latest().stop is None and robot.sent == []
    assert robot.log.count("kick") > 10, "the watchdog would have stopped the program"
    link.finish("test over")


@pytest.mark.parametrize(
    ("error", "said"),
    [(RuntimeError("no answer"), "no answer"), (OSError("pipe"), "pipe"), (KeyError(), "KeyError")],
)
def test_a_robot_that_could_not_be_stopped_is_told_whatever_the_client_raises(robot, error, said):
    def broken():
        raise error

    link = make_link(robot)
    link.start()
    robot.stop = broken
    link.finish("test over")
    assert link.stop_error == said


def test_an_error_in_the_client_is_a_stop_with_its_text(robot):
    link = make_link(robot)
    link.start()
    link.arm()

    def broken(q):
        raise RuntimeError("End of file")

    robot.servo = broken
    stream(link, 0.02)
    assert "End of file" in wait_for_stop(link).detail
    assert robot.stopped.wait(10.0)
    link.finish("test over")


def test_a_robot_that_sends_nothing_is_named_at_the_start(robot, monkeypatch):
    monkeypatch.setattr("sliceit_drake.hardware.rtde_link.FIRST_DATA", 0.1)
    robot.frozen = True
    with pytest.raises(RobotUnavailableError, match="sends no data"):
        make_link(robot).start()


def test_neither_side_of_the_coupling_step_waits(robot):
    link = make_link(robot)
    link.start()
    link.arm()
    inside, go_on, servo = threading.Event(), threading.Event(), robot.servo

    def stuck(q):
        inside.set()
        go_on.wait(60.0)
        return servo(q)

    robot.servo = stuck
    link.put(START, robot.time)
    assert inside.wait(10.0)

    def coupling_step():
        for _ in range(100):
            link.latest()
            link.put(START, 0.0)

    other = threading.Thread(target=coupling_step, daemon=True)
    other.start()
    other.join(20.0)
    waited = other.is_alive()
    go_on.set()
    assert not waited, "a coupling step waited for the thread"
    link.finish("test over")


def test_the_system_shows_the_wrench_at_the_flange_in_its_axes(robot):
    link = make_link(robot)
    system = RtdeSystem(link, PACE)
    context = system.CreateDefaultContext()
    robot.wrench = [1.0, -2.0, 12.0, 0.1, 0.2, 0.3]
    status = link.start()
    robot.wait(0.004)
    assert system.receive(context) is None
    shown = system.GetOutputPort("sensor_wrench").Eval(context)
    R_BK = chain_pose(START).rotation()  # The knife has the flange's axes.
    assert np.allclose(R_BK @ shown.translational(), robot.wrench[:3])
    assert np.allclose(R_BK @ shown.rotational(), robot.wrench[3:])
    vector = system.GetOutputPort("sensor_wrench_vector").Eval(context)
    assert np.allclose(vector, shown.get_coeffs())
    assert np.allclose(system.GetOutputPort("joint_positions").Eval(context), status.state.q)
    assert system.GetOutputPort("period").Eval(context)[0] == pytest.approx(0.002)
    link.finish("test over")


def test_age_grows_while_no_state_comes_and_the_reason_is_told(robot):
    link = make_link(robot)
    system = RtdeSystem(link, PACE)
    context = system.CreateDefaultContext()
    link.start()
    link.arm()
    stream(link, 0.02)
    robot.frozen = True
    stop = wait_for_stop(link)
    assert system.receive(context) == stop
    ages = []
    for _ in range(2):
        ages.append(system.GetOutputPort("age").Eval(context)[0])
        clock.sleep(0.05)
    assert ages[1] - ages[0] == pytest.approx(0.05 * PACE, rel=0.5)
    assert system.GetOutputPort("latched").Eval(context)[0] == 1.0
    assert "clock stands" in system.GetOutputPort("stop_reason").Eval(context)
    link.finish("test over")
