"""Readings that cannot be true stop the robot: each fault put into a stream of states."""

import math

import numpy as np
import pytest
from arm_at_start import BOARD, LENGTH, START, X_TK, X_WB
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from test_safety import at_height

from sliceit_drake.hardware.checks import check_kinematics, check_unzeroed
from sliceit_drake.hardware.client import PLAYING, RobotState
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics, flange_pose, singular_margin
from sliceit_drake.hardware.hardware_config import HardwareConfig, SafetyLimits
from sliceit_drake.hardware.safety import SafetyLayer

PERIOD = 0.002
PAYLOAD = (1.2, 0.0, 0.0, 0.06)
KINEMATICS = EdgeKinematics(X_WB, X_TK, LENGTH)
FOOD_TOP = BOARD + 0.048
"""2 mm under the edge at the start."""


def rotation(q):
    return np.array(flange_pose(q)[:9]).reshape(3, 3).T


def robot_state(time, q, force, qd=0.0):
    """What an honest robot shows: the force of the environment, in the base's axes [3], N."""
    raw = rotation(q).T @ (np.array(force) + [0.0, 0.0, -PAYLOAD[0] * 9.81]) + [2.0, -1.0, 3.0]
    pose = [*flange_pose(q)[9:], *Rotation.from_matrix(rotation(q)).as_rotvec()]
    return RobotState(
        time, list(q), [qd] * 6, [*force, 0.0, 0.0, 0.0], PLAYING, 1, PAYLOAD, list(q),
        [*raw, 0.0, 0.0, 0.0], pose, 1.0, 7,
    )  # fmt: skip


def slice_down(
    fault=lambda state, k: state, cycles=400, food_top=None, delay=0, stiffness=1.5e3, noise=0.01
):
    """Moves the edge down at 40 mm/s into a spring 5 mm below; the stop, and how many cycles."""
    rng = np.random.default_rng(0)
    layer = SafetyLayer(SafetyLimits(), KINEMATICS, BOARD - 0.02, START, PERIOD, food_top)
    heights = 0.05 - np.cumsum(np.minimum(0.04, 0.5 * PERIOD * np.arange(cycles))) * PERIOD
    slope = (at_height(START, 0.05)[1] - at_height(START, 0.04)[1]) / 0.01
    path = [[START[0], START[1] + slope * (z - 0.05), *START[2:]] for z in heights]
    for k, q in enumerate(path):
        depth = max(0.0, 0.045 - heights[k])
        force = np.array([0.0, 0.0, stiffness * depth]) + rng.normal(scale=noise, size=3)
        now = robot_state(1.0 + PERIOD * k, q, force)
        now = fault(now._replace(target_q=path[max(0, k - delay)]), k)
        if k == 0:
            stop = layer.arm(now)
        else:
            stop = layer.step(now, path[min(k + 1, cycles - 1)], now.time).stop
        if stop is not None:
            return stop, k
    return None, cycles


FROM = 150
"""The cycle of a fault: in contact, 20 N to come."""


def test_an_honest_robot_is_not_stopped():
    assert slice_down(food_top=FOOD_TOP) == (None, 400)
    assert slice_down(delay=15) == (None, 400), "a servo's own target trails"


def frozen(name):
    held = {}

    def fault(state, k):
        if k < FROM:
            return state
        return state._replace(**{name: held.setdefault(name, getattr(state, name))})

    return fault


def changed(**changes):
    def fault(state, k):
        if k < FROM:
            return state
        return state._replace(**{n: change(getattr(state, n)) for n, change in changes.items()})

    return fault


@pytest.mark.parametrize(
    ("limit", "fault", "within"),
    [
        ("force_age", frozen("wrench"), 12),
        ("force_age", frozen("raw_wrench"), 12),
        ("force_age", changed(wrench=lambda w: [0.0] * 6), 1),
        ("force_rate", changed(wrench=lambda w: [-x for x in w]), 1),
        ("raw_force", changed(wrench=lambda w: [0.4 * x for x in w]), 40),
        ("force_rate", changed(wrench=lambda w: [w[0], w[1], w[2] - 20.0, *w[3:]]), 1),
        ("measurement", frozen("q"), 30),
        ("measurement", changed(raw_wrench=lambda w: None), 1),
        ("measurement", changed(tcp_pose=lambda w: None), 1),
        ("measured_speed", changed(qd=lambda v: [0.0, 3.0, 0.0, 0.0, 0.0, 0.0]), 1),
        ("speed_scaling", changed(speed=lambda s: 0.3), 1),
        ("speed_scaling", changed(speed=lambda s: math.nan), 1),
        ("robot_mode", changed(robot_mode=lambda m: 5), 1),
        ("kinematics", changed(tcp_pose=lambda p: [*p[:2], p[2] + 0.01, *p[3:]]), 1),
        ("kinematics", changed(tcp_pose=lambda p: [*p[:3], p[3] + 0.05, *p[4:]]), 1),
        ("read_back", changed(target_q=lambda q: [q[0], q[1] + 0.01, *q[2:]]), 1),
        ("read_back", changed(target_q=lambda q: [q[0] + 0.001, *q[1:]]), 1),
        ("read_back", changed(target_q=lambda q: [math.nan] * 6), 1),
    ],
)
def test_a_reading_that_cannot_be_true_stops_the_robot(limit, fault, within):
    stop, k = slice_down(fault)
    assert stop is not None and stop.limit == limit, stop
    assert k - FROM <= within
    assert stop.sends == (limit != "robot_mode"), "it brakes where it still can"


def test_a_sign_that_flips_in_the_air_is_found_by_the_raw_force_in_contact():
    stop, k = slice_down(
        lambda state, k: state._replace(wrench=[-x for x in state.wrench]) if k > 50 else state
    )
    assert stop is not None and stop.limit == "raw_force"
    assert stop.value < 8.0, "of twice the force"


def test_commands_that_arrive_late_are_read_back():
    stop, _ = slice_down(delay=60)
    assert stop is not None and stop.limit == "read_back"


def test_a_food_that_is_not_felt_stops_the_knife_a_few_millimetres_in_it():
    # No sensor has to fail: noise alone, as in a broken cable, is no contact.
    stop, _ = slice_down(food_top=FOOD_TOP, stiffness=0.0)
    assert stop is not None and stop.limit == "felt_force"
    assert "5." in stop.detail and "in the food" in stop.detail
    assert slice_down(food_top=None, stiffness=0.0) == (None, 400)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.3])
def test_a_sensor_that_dies_in_the_food_but_for_its_noise_is_found(noise):
    rng = np.random.default_rng(1)

    def dies(state, k):
        if k < FROM:
            return state
        force = rng.normal(scale=noise, size=3)
        dead = robot_state(state.time, state.q, force)
        return state._replace(wrench=dead.wrench, raw_wrench=dead.raw_wrench)

    # The food is where its force begins.
    food = {"food_top": BOARD + 0.045, "noise": noise, "cycles": 550}
    stop, _ = slice_down(dies, stiffness=1e3, **food)
    assert stop is not None and stop.limit == "felt_force", stop
    never, _ = slice_down(stiffness=0.0, **food)
    assert never is not None and never.limit == "felt_force", never
    assert slice_down(stiffness=1e3, **food) == (None, 550)


def test_a_breach_of_force_counts_as_one_only_where_the_sensor_can_be_believed():
    """After `force` and `torque` a retreat is offered, which trusts the sensor."""
    stop, _ = slice_down(stiffness=6e3)
    assert stop is not None and stop.limit == "force"
    jump, _ = slice_down(changed(wrench=lambda w: [*w[:2], w[2] + 60.0, *w[3:]]))
    assert jump is not None and jump.limit == "force_rate" and "allowed 50" in jump.detail
    # The torque of a wire that shows other numbers, at once; the raw force says otherwise.
    other = changed(wrench=lambda w: [w[0], w[1], w[2] + 9.0, 11.0, *w[4:]])
    torque, k = slice_down(other)
    assert torque is not None and torque.limit == "raw_force" and k == FROM


def level(height):
    """Joint positions with the whole edge at this height over the board, m."""

    def turned(angle):
        return [START[0], START[1] + angle, START[2], START[3] - angle, *START[4:]]

    def missed(angle):
        return KINEMATICS.edge(turned(angle)).heel[2] - BOARD - height

    return turned(float(brentq(missed, 0.0, 0.3)))


def test_what_is_measured_keeps_the_limits_of_what_is_commanded():
    layer = SafetyLayer(SafetyLimits(tracking_error=0.5), KINEMATICS, BOARD, START, PERIOD)
    low = level(-0.0004)
    assert layer.arm(robot_state(1.0, low, (0.0, 0.0, 1.0))) is None
    # The measured arm goes down slowly by itself, while the command stays.
    for k in range(1, 400):
        q = level(-0.0004 - 2e-5 * k)
        honest = robot_state(1.0 + PERIOD * k, q, (0.0, 0.0, 1.0 + 1e-6 * k))
        stop = layer.step(honest._replace(target_q=low), low, honest.time).stop
        if stop is not None:
            break
    assert stop.limit == "board_depth" and "the measured arm" in stop.detail
    assert BOARD - stop.value == pytest.approx(0.0025, abs=5e-5)


def test_a_command_from_the_future_does_not_switch_off_the_limit_of_its_age():
    layer = SafetyLayer(SafetyLimits(), KINEMATICS, BOARD, START, PERIOD)
    assert layer.arm(robot_state(1.0, START, (0.0, 0.0, 1.0))) is None
    stop = layer.step(robot_state(1.002, START, (0.0, 0.0, 1.1)), START, 2.0).stop
    assert stop.limit == "command_age" and "ahead" in stop.detail


@pytest.mark.parametrize("joint", [2, 4])
def test_nothing_goes_out_near_a_singularity(joint):
    q = list(START)
    q[joint] = 0.05
    assert singular_margin(q) == pytest.approx(math.sin(0.05))
    limits = SafetyLimits(joint_window=10.0, workspace_lower=[-3.0] * 3, workspace_upper=[3.0] * 3)
    layer = SafetyLayer(limits, KINEMATICS, BOARD - 3.0, START, PERIOD)
    assert layer.arm(robot_state(1.0, q, (0.0, 0.0, 1.0))).limit == "singular_margin"


def test_a_contact_is_seen_before_zeroing_hides_it():
    config = HardwareConfig(payload=1.2, payload_cog=[0.0, 0.0, 0.06])
    free, pressed = (robot_state(1.0, START, (0.0, 0.0, force)) for force in (0.5, 40.0))
    assert check_unzeroed([free] * 3, KINEMATICS, config, 3).passed
    check = check_unzeroed([pressed] * 3, KINEMATICS, config, 3)
    assert not check.passed and "37.07 N" in check.found and "touch" in check.fix
    assert not check_unzeroed([free] * 2, KINEMATICS, config, 3).passed
    no_raw = pressed._replace(raw_wrench=None)
    assert not check_unzeroed([no_raw] * 3, KINEMATICS, config, 3).passed


def test_the_robots_own_pose_has_to_agree_with_ours():
    config, state = HardwareConfig(), robot_state(1.0, START, (0.0, 0.0, 1.0))
    assert check_kinematics(state, config).passed
    for off, passed in ((0.004, True), (0.006, False), (math.nan, False)):
        pose = [state.tcp_pose[0] + off, *state.tcp_pose[1:]]
        check = check_kinematics(state._replace(tcp_pose=pose), config)
        assert check.passed == passed
    assert "flange" in check.found
