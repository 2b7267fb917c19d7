"""The safety layer: whatever is asked for, nothing goes out that breaks a limit."""

import dataclasses as dc
import math
import os

import numpy as np
import pytest
from arm_at_start import BOARD, LENGTH, START, X_TK, X_WB, chain_pose
from scipy.optimize import brentq

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.hardware.client import PLAYING, RobotState
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import SafetyLimits, load_hardware_config, loosened
from sliceit_drake.hardware.safety import LatchedError, SafetyLayer

PERIOD = 0.002
COMMANDS = int(os.environ.get("SLICEIT_HOSTILE_COMMANDS", "100000"))


def make_layer(**changes):
    limits = dc.replace(SafetyLimits(), **changes)
    return SafetyLayer(limits, EdgeKinematics(X_WB, X_TK, LENGTH), BOARD, START, PERIOD)


def state(time, q, wrench=(0.0,) * 6, qd=(0.0,) * 6, runtime=PLAYING, bits=1):
    # No two readings of a sensor are the same.
    wrench = [x + 1e-9 * math.sin(1e4 * time + 1.0) for x in wrench]
    return RobotState(time, list(q), list(qd), wrench, runtime, bits)


def at_height(q, height):
    """Joint positions as `q`, but of joint 2, with the edge's middle this high over the board."""
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)

    def missed(shoulder):
        edge = kinematics.edge([q[0], shoulder, *q[2:]])
        return 0.5 * (edge.heel[2] + edge.tip[2]) - BOARD - height

    return [q[0], float(brentq(missed, q[1] - 0.3, q[1] + 0.3)), *q[2:]]


def test_the_edge_is_where_the_controllers_chain_has_it():
    rng = np.random.default_rng(0)
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    for q in [START, *rng.uniform(-np.pi, np.pi, (50, 6))]:
        X_WK, edge = chain_pose(q), kinematics.edge(q)
        assert np.allclose(edge.heel, X_WK @ np.array([-0.5 * LENGTH, 0, 0]), atol=1e-9)
        assert np.allclose(edge.tip, X_WK @ np.array([0.5 * LENGTH, 0, 0]), atol=1e-9)
        assert edge.down == pytest.approx(-X_WK.rotation().matrix()[2, 2], abs=1e-9)


class Wire:
    """What went out, judged without the layer's own arithmetic."""

    def __init__(self, limits, q, time):
        self.limits, self.q, self.v, self.time = limits, np.array(q), np.zeros(6), time
        self.kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
        self.edge = self._ends(self.q)
        self.count = 0

    def _ends(self, q):
        edge = self.kinematics.edge(q.tolist())
        return np.array([edge.heel, edge.tip])

    def send(self, q, time):
        q, limits, dt = np.array(q), self.limits, time - self.time
        change = q - self.q
        v = change / dt
        edge = self._ends(q)
        slack = 1.0 + 1e-6
        assert np.isfinite(q).all()
        assert (q >= limits.joint_lower).all() and (q <= limits.joint_upper).all()
        assert np.abs(q - START).max() <= limits.joint_window
        assert np.abs(change).max() <= limits.joint_step * slack
        assert (np.abs(v) <= np.array(limits.joint_speed) * slack).all()
        rate = np.abs(v - self.v) / dt
        assert (rate <= np.array(limits.joint_acceleration) * slack + 1e-9).all()
        assert np.linalg.norm(edge - self.edge, axis=1).max() / dt <= limits.knife_speed * slack
        assert (edge >= limits.workspace_lower).all() and (edge <= limits.workspace_upper).all()
        assert edge[:, 2].min() >= BOARD - limits.board_depth
        assert self.kinematics.edge(q.tolist()).down >= math.cos(limits.tilt)
        self.q, self.v, self.edge, self.time = q, v, edge, time
        self.count += 1


def hostile(rng, q, v):
    """A command of one of many bad kinds, or a plausible one, after target q at velocity v."""
    kind = rng.integers(12)
    if kind < 6:  # Wanders, at the edge of what is allowed.
        a = rng.uniform(-1.0, 1.0, 6) * rng.choice([5.0, 9.99, 10.5])
        return q + PERIOD * (v + PERIOD * a)
    if kind == 6:
        return q + rng.normal(size=6) * 10.0 ** rng.uniform(-6, 3)
    if kind == 7:
        bad = q.copy()
        bad[rng.integers(6)] = rng.choice([np.nan, np.inf, -np.inf, 1e308])
        return bad
    if kind == 8:
        return q[: rng.integers(6)] if rng.random() < 0.5 else np.append(q, 0.0)
    if kind == 9:
        return rng.uniform(-10.0, 10.0, 6)
    if kind == 10:
        return q + PERIOD * v * rng.uniform(0.9, 1.1)
    return None


def attack(seed, commands):
    """Sends hostile commands, run after run; returns how many went out, and why runs stopped."""
    rng = np.random.default_rng(seed)
    done, sent, reasons = 0, 0, {}
    while done < commands:
        layer = make_layer()
        time, q = 1.0, np.array(START)
        q = q + rng.uniform(-0.02, 0.02, 6)
        if rng.random() < 0.5:
            q = np.array(at_height(q.tolist(), rng.uniform(0.01, 0.02)))
        assert layer.arm(state(time, q)) is None
        wire = Wire(layer.limits, q, time)
        persists = rng.random() < 0.7  # A plausible attacker gets far before it strikes.
        push = rng.uniform(-1.0, 1.0, 6) * 9.9
        push *= rng.random(6) < rng.choice([0.3, 1.0])
        fastest = 10.0 ** rng.uniform(-1.5, -0.3)
        stopped, actual, stop_time, answered = None, q, 0.0, time
        while stopped is None or time < stop_time:
            time += PERIOD * int(rng.choice([1, 1, 1, 1, 1, 2, 4]))
            if persists and rng.random() < 0.995:
                dt = time - wire.time
                v = np.clip(wire.v + dt * push, -fastest, fastest)
                command = wire.q + dt * v
            else:
                command = hostile(rng, wire.q, wire.v)
            actual = actual + 0.5 * (wire.q - actual)
            answered = time - PERIOD if command is not None else answered
            decision = layer.step(state(time, actual), command, answered)
            done += 1
            if decision.q is not None:
                wire.send(decision.q, time)
                sent += 1
            if stopped is None and decision.stop is not None:
                stopped, stop_time = decision.stop, time + 0.06
                name = stopped.limit
                reasons[name] = reasons.get(name, 0) + 1
                if stopped.sends:
                    assert decision.q is not None, "the stop goes out in the cycle that sees it"
            if stopped is not None:
                assert decision.stop is not None, "it resumed by itself"
        if decision.q is not None:
            assert np.abs(wire.v).max() < 1e-12, "it did not come to rest"
    return sent, reasons


def test_no_hostile_command_makes_anything_go_out_of_limits():
    sent, reasons = attack(0, COMMANDS)
    assert sent > 0.2 * COMMANDS
    # All kinds of limits that a command can break were met.
    expected = {"joint_step", "joint_speed", "joint_acceleration", "command", "knife_speed"}
    expected |= {"board_depth", "command_age"}
    assert expected <= set(reasons), reasons


def test_commands_that_come_a_cycle_late_neither_stall_the_arm_nor_stop_it():
    layer, q, v = make_layer(), np.array(START), np.zeros(6)
    layer.arm(state(1.0, q))
    wire, rng = Wire(layer.limits, q, 1.0), np.random.default_rng(0)
    command, speeds = q.copy(), []
    for k in range(1, 400):
        time = 1.0 + k * PERIOD
        v[1] = -min(0.2, 2.0 * PERIOD * k)
        before, command = command, command + PERIOD * v
        late = rng.random() < 0.3
        # A late cycle still has the command that answers the measurement before.
        chosen, answered = (before, time - PERIOD) if late else (command, time)
        decision = layer.step(state(time, wire.q), chosen, answered)
        assert decision.stop is None
        wire.send(decision.q, time)
        speeds.append(wire.v[1])
    assert np.abs(np.array(speeds[200:]) + 0.2).max() < 0.01
    assert np.abs(wire.q - command).max() < 1e-6


def test_an_encoders_noise_does_not_stop_it():
    layer, rng = make_layer(), np.random.default_rng(0)
    layer.arm(state(1.0, START))
    wire = Wire(layer.limits, START, 1.0)
    for k in range(1, 1000):
        time = 1.0 + k * PERIOD
        q = START + rng.normal(size=6) * 2e-5
        decision = layer.step(state(time, q), q, time)
        assert decision.stop is None
        wire.send(decision.q, time)
        assert np.abs(wire.q - q).max() < 5e-4


def test_one_target_goes_out_in_a_cycle_however_many_commands_come():
    layer, now = make_layer(), state(1.002, START)
    layer.arm(state(1.0, START))
    assert layer.step(now, None, 1.0).q is None
    first = [START[0] + 1e-5, *START[1:]]
    assert layer.step(now, first, 1.002).q == first
    second = [START[0] + 2e-5, *START[1:]]
    assert layer.step(now, second, 1.002) == (None, None)
    layer.latch("end", "done", sends=True)
    assert layer.step(now, second, 1.002).q is None, "the braking target is for the next cycle"
    assert layer.step(state(1.004, START), second, 1.002).q is not None


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("force_rate", {"wrench": [0, 0, 51.0, 0, 0, 0]}),
        ("torque", {"wrench": [0, 0, 0, 0, 10.1, 0]}),
        ("measurement", {"wrench": [0, 0, math.nan, 0, 0, 0]}),
        ("measurement", {"q": [math.inf, *START[1:]]}),
        ("measurement", {"q": START[:5]}),
        ("tracking_error", {"q": [START[0] + 0.021, *START[1:]]}),
        ("safety_status", {"bits": 1 << 2 | 1 << 10}),
        ("safety_status", {"bits": 0}),
        ("program", {"runtime": 1}),
        ("program", {"runtime": 4}),
        ("state_age", {"time": 1.0}),
        ("state_age", {"time": 0.5}),
        ("state_age", {"time": 1.0121}),
        ("state_age", {"time": math.nan}),
    ],
)
def test_what_the_robot_reports_stops_in_the_same_cycle(reason, changes):
    layer = make_layer()
    layer.arm(state(1.0, START))
    arguments = {"time": 1.002, "q": START} | changes
    decision = layer.step(state(**arguments), START, 1.0)
    assert decision.stop is not None and decision.stop.limit == reason
    # After a fault of the robot or the link nothing goes out any more.
    assert (decision.q is not None) == (
        reason in ("force_rate", "torque", "measurement", "tracking_error")
    )


def test_a_stop_in_motion_brakes_within_limits_and_holds():
    layer, time, q = make_layer(), 1.0, np.array(START)
    layer.arm(state(time, q))
    wire, v = Wire(layer.limits, q, time), 0.0
    while v < 0.2:
        v, time = v + 9.0 * PERIOD, time + PERIOD
        q = q + [v * PERIOD, 0, 0, 0, 0, 0]
        assert layer.step(state(time, q), q, time).stop is None
        wire.send(q, time)
    way, cycles = q[0], 0
    while np.abs(wire.v).max() > 1e-12 or cycles == 0:
        time += PERIOD
        cycles += 1
        wire.send(layer.step(state(time, wire.q), np.full(6, np.nan), time).q, time)
    assert cycles * PERIOD <= v / 10.0 + 2.0 * PERIOD
    assert wire.q[0] - way <= v**2 / 20.0
    held = wire.q
    for _ in range(100):
        time += PERIOD
        assert (layer.step(state(time, held), START, time).q == held).all()


def test_nothing_ends_a_stop_but_a_new_layer():
    layer = make_layer()
    layer.arm(state(1.0, START))
    layer.latch("link", "the wire was cut")
    for k in range(1, 200):
        assert layer.step(state(1.0 + k * PERIOD, START), START, 1.0 + k * PERIOD).q is None
    with pytest.raises(LatchedError):
        layer.arm(state(2.0, START))
    moved = [START[0] + 0.3, *START[1:]]
    layer = make_layer()
    assert layer.arm(state(2.0, moved)) is None
    # It goes on from where the arm is, not from where it was.
    assert layer.step(state(2.002, moved), moved, 2.0).q == moved


def test_a_second_fault_keeps_the_first_reason_but_ends_the_sending():
    layer = make_layer()
    layer.arm(state(1.0, START))
    assert layer.step(state(1.002, START), [0.0] * 6, 1.0).q is not None
    decision = layer.step(state(1.004, START, runtime=1), START, 1.002)
    assert decision.q is None and decision.stop.limit == "joint_step"


def test_after_a_silence_it_stays_stopped_though_data_come_again():
    layer = make_layer()
    layer.arm(state(1.0, START))
    assert layer.step(state(2.0, START), START, 2.0).stop.limit == "state_age"
    assert layer.step(state(2.002, START), START, 2.002).q is None


def test_it_starts_only_at_rest_within_limits_and_on_a_running_program():
    assert make_layer().arm(state(1.0, START, qd=[0, 0.1, 0, 0, 0, 0])).limit == "at rest"
    assert make_layer().arm(state(1.0, START, runtime=1)).limit == "program"
    far = [START[0] + 1.1, *START[1:]]
    assert make_layer().arm(state(1.0, far)).limit == "joint_upper"
    layer = make_layer()
    assert layer.step(state(1.0, START), START, 1.0).stop.limit == "not armed"


def test_the_tip_must_stay_above_the_board_as_well_as_the_middle():
    level = at_height(START, 0.01)
    assert make_layer().arm(state(1.0, level)) is None
    tilted = at_height([*START[:3], START[3] + 0.35, *START[4:]], 0.01)
    assert make_layer().arm(state(1.0, tilted)).limit == "board_depth"


def limits_of(text, folder):
    """Limits as a robot's file gives them."""
    file = folder / "robot.yaml"
    file.write_text(f"limits: {{{text}}}\n")
    return load_hardware_config(file).limits


def test_limits_change_only_by_name(tmp_path):
    limits = limits_of("force: 80.0", tmp_path)
    assert limits == dc.replace(SafetyLimits(), force=80.0)
    assert loosened(limits) == ["force: 80.0"]
    assert loosened(SafetyLimits()) == []
    with pytest.raises(ConfigurationError, match="force"):
        limits_of("forse: 80.0", tmp_path)
    with pytest.raises(ConfigurationError, match="less than a stop needs"):
        limits_of("joint_step: 0.001", tmp_path)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -7.0, 1e6])
def test_a_limit_that_nothing_breaks_is_refused(value, tmp_path):
    for field in dc.fields(SafetyLimits):
        default = getattr(SafetyLimits(), field.name)
        wrong = value
        if isinstance(default, list):
            wrong = [*default[:-1], value]
        with pytest.raises(ConfigurationError, match=field.name):
            make_layer(**{field.name: wrong})
        text = f"{field.name}: {wrong}".replace("nan", ".nan").replace("inf", ".inf")
        with pytest.raises(ConfigurationError, match=field.name):
            limits_of(text, tmp_path)


@pytest.mark.parametrize(
    ("start", "board"),
    [(START, math.nan), (START, math.inf), ([*START[:5], math.nan], BOARD), (START[:5], BOARD)],
)
def test_no_layer_is_made_around_what_is_not_known(start, board):
    with pytest.raises(ConfigurationError, match="not known"):
        SafetyLayer(SafetyLimits(), EdgeKinematics(X_WB, X_TK, LENGTH), board, start, PERIOD)


@pytest.mark.parametrize("now", [None, (1.2, 0.0, 0.0), (1.2, 0.0, math.nan, 0.06)])
def test_a_payload_that_is_not_known_any_more_stops_the_robot(now):
    layer = make_layer()
    known = state(0.0, START)._replace(payload=(1.2, 0.0, 0.0, 0.06))
    assert layer.arm(known) is None
    decision = layer.step(known._replace(time=0.002, payload=now), START, 0.002)
    assert decision.stop.limit == "payload"


def test_bodies_that_would_come_near_each_other_stop_it_while_the_arm_can_still_stop():
    def nearest(q, within):
        distance = 0.02 - 0.8 * (q[0] - START[0])
        return (distance, "knife and holder") if distance < within else None

    limits = SafetyLimits()
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    layer = SafetyLayer(limits, kinematics, BOARD, START, PERIOD, nearest=nearest)
    time, q, v = 1.0, np.array(START), 0.0
    layer.arm(state(time, q))
    stop = None
    while stop is None:
        v, time = min(0.15, v + 9.0 * PERIOD), time + PERIOD
        q = q + [v * PERIOD, 0, 0, 0, 0, 0]
        stop = layer.step(state(time, q), q, time).stop
    assert stop.limit == "clearance" and "knife and holder" in stop.detail
    sent = q
    while not layer.is_still:
        time += PERIOD
        sent = layer.step(state(time, sent), None, time).q
    assert nearest(sent, 1.0)[0] >= limits.clearance
    assert nearest(sent, 1.0)[0] < limits.clearance + 2e-3, "it goes as far as it may"


def test_a_measured_arm_that_touches_stops_it_though_its_targets_keep_away():
    def nearest(q, within):
        distance = 0.02 - 2.0 * (q[0] - START[0])
        return (distance, "knife and holder") if distance < within else None

    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    layer = SafetyLayer(SafetyLimits(), kinematics, BOARD, START, PERIOD, nearest=nearest)
    layer.arm(state(1.0, START))
    # Slowly enough for the limits of measured speed.
    for k, off in enumerate(np.linspace(0.0, 0.0105, 22), 1):
        measured = [START[0] + off, *START[1:]]
        stop = layer.step(state(1.0 + PERIOD * k, measured), START, 1.0 + PERIOD * k).stop
        assert (stop is not None) == (off > 0.0099), (off, stop)
    assert stop.limit == "clearance" and "knife and holder" in stop.detail
