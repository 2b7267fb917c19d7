"""The servo: its lag behind a ramp, its response to a step, its start."""

import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.systems.servo import JOINTS, Servo, ServoConfig, ServoLaw
from studies.robot.servo import damping_ratio, servo_study

PERIOD = 1e-3
START = np.array([0.4, -1.2, 1.5, -1.8, -1.6, 0.3])


def respond(config: ServoConfig, targets: PiecewisePolynomial, duration: float, period=PERIOD):
    """Returns times [N], positions, velocities and accelerations [N, 6] asked by the servo."""
    builder = DiagramBuilder()
    servo = builder.AddNamedSystem("servo", Servo(config, period, START))
    source = builder.AddSystem(TrajectorySource(targets))
    builder.Connect(source.get_output_port(), servo.GetInputPort("joint_positions_command"))
    state = LogVectorOutput(servo.GetOutputPort("desired_state"), builder, period)
    acceleration = LogVectorOutput(servo.GetOutputPort("desired_acceleration"), builder, period)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(duration)
    log = state.FindLog(simulator.get_context())
    a = acceleration.FindLog(simulator.get_context()).data().T
    return log.sample_times(), log.data()[:JOINTS].T, log.data()[JOINTS:].T, a


def ramp(speed: float, duration: float) -> PiecewisePolynomial:
    return PiecewisePolynomial.FirstOrderHold(
        [0.0, duration], np.stack([START, START + speed * duration], axis=1)
    )


def step(size: float, duration: float) -> PiecewisePolynomial:
    return PiecewisePolynomial.ZeroOrderHold(
        [0.0, 2 * duration], np.tile((START + size)[:, None], 2)
    )


@pytest.mark.parametrize(
    "config",
    [
        ServoConfig(),
        ServoConfig(gain=300.0, lookahead_time=0.1),
        ServoConfig(gain=4e4, lookahead_time=0.01),
        ServoConfig(delay=0.006),
    ],
)
@pytest.mark.parametrize("period", [1e-3, 1e-4])
def test_it_trails_a_ramp_by_its_stated_lag_within_a_step(config, period):
    speed, duration = 0.7, 1.0
    times, q, v, a = respond(config, ramp(speed, duration), duration, period)
    lag = times[-1] - (q[-1] - START) / speed
    assert lag == pytest.approx(np.full(JOINTS, config.lag), abs=period)
    # The targets are a staircase, whose ripple a stiff servo passes on.
    np.testing.assert_allclose(v[-1], speed, rtol=5e-3)
    np.testing.assert_allclose(a[-1], 0.0, atol=1e-2)


def test_a_step_overshoots_as_its_damping_ratio_says_and_settles():
    config = ServoConfig()
    times, q, _, _ = respond(config, step(0.01, 0.6), 0.6)
    zeta = damping_ratio(config)
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert overshoot == pytest.approx(0.058, abs=5e-4)
    response = (q - START) / 0.01
    np.testing.assert_allclose(response.max(axis=0) - 1.0, overshoot, rtol=1e-3)
    late = np.abs(response - 1.0).max(axis=1) > 0.02
    assert times[late][-1] == pytest.approx(0.135, abs=0.002)


def test_a_step_does_not_overshoot_when_damped_critically():
    config = ServoConfig(gain=4 / 0.03**2)
    assert damping_ratio(config) == pytest.approx(1.0)
    _, q, _, _ = respond(config, step(0.01, 0.6), 0.6)
    assert ((q - START) / 0.01).max() <= 1.0


def test_between_targets_it_follows_the_exact_solution_at_any_period():
    config = ServoConfig()
    _, coarse, _, _ = respond(config, step(0.01, 0.2), 0.2, period=4e-3)
    times, fine, _, _ = respond(config, step(0.01, 0.2), 0.2, period=1e-3)
    np.testing.assert_allclose(coarse[1:], fine[4::4], atol=1e-12)
    omega, zeta = math.sqrt(config.gain), damping_ratio(config)
    damped = omega * math.sqrt(1 - zeta**2)
    phase = damped * times
    decay = np.exp(-zeta * omega * times)
    exact = 1 - decay * (np.cos(phase) + zeta * omega / damped * np.sin(phase))
    np.testing.assert_allclose((fine[:, 0] - START[0]) / 0.01, exact, atol=1e-9)


def test_its_acceleration_carries_the_velocity_to_the_next_step():
    _, _, v, a = respond(ServoConfig(delay=0.003), step(0.01, 0.2), 0.2)
    np.testing.assert_allclose(v[:-1] + PERIOD * a[:-1], v[1:], atol=1e-12)


def test_a_delay_moves_the_response_in_time_and_changes_nothing_else():
    _, prompt, _, _ = respond(ServoConfig(), step(0.01, 0.3), 0.3)
    _, late, _, _ = respond(ServoConfig(delay=0.006), step(0.01, 0.3), 0.3)
    np.testing.assert_allclose(late[6:], prompt[:-6], atol=1e-12)
    np.testing.assert_allclose(late[:6], np.tile(START, (6, 1)), atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.006])
def test_the_law_alone_at_the_controllers_cycle_is_the_servo_at_the_plants_step(delay):
    cycle, config = 2e-3, ServoConfig(lookahead_time=0.05, gain=700.0, delay=delay)
    rng = np.random.default_rng(0)
    goals = START + 0.01 * np.cumsum(rng.standard_normal((100, JOINTS)), axis=0)
    breaks = cycle * np.arange(101)
    held = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([goals, goals[-1:]]).T)
    # Half a step late, so that no rounding decides which target a cycle has.
    held.shiftRight(-0.5 * PERIOD)
    _, q, v, _ = respond(config, held, 0.199)
    law = ServoLaw(config, cycle)
    state = law.state_at_rest(START)
    for k, goal in enumerate(goals):
        np.testing.assert_allclose(state[0], q[2 * k], atol=1e-12)
        np.testing.assert_allclose(state[1], v[2 * k], atol=1e-10)
        state = law.step(state, goal)


@pytest.mark.parametrize(("lookahead", "gain"), [(0.03, 100.0), (0.2, 100.0), (0.2, 2000.0)])
def test_at_the_ends_of_the_real_commands_ranges_lag_and_overshoot_are_as_stated(lookahead, gain):
    config = ServoConfig(lookahead_time=lookahead, gain=gain)
    _, q, _, _ = respond(config, ramp(0.5, 4.0), 4.0)
    assert 4.0 - (q[-1, 0] - START[0]) / 0.5 == pytest.approx(lookahead, abs=PERIOD)
    _, q, _, _ = respond(config, step(0.01, 4.0), 4.0)
    zeta = damping_ratio(config)
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2)) if zeta < 1 else 0.0
    assert ((q - START) / 0.01).max() - 1.0 == pytest.approx(overshoot, abs=1e-3)


@pytest.mark.parametrize("delay", [0.0, 0.004])
def test_it_stays_at_rest_where_it_is_put(delay):
    servo = Servo(ServoConfig(delay=delay), PERIOD, START)
    context = servo.CreateDefaultContext()
    port = servo.GetInputPort("joint_positions_command")
    for positions in (START, START + 0.2):
        port.FixValue(context, positions)
        servo.set_positions(context, positions)
        simulator = Simulator(servo, context.Clone())
        simulator.AdvanceTo(0.05)
        state = servo.GetOutputPort("desired_state").Eval(simulator.get_context())
        np.testing.assert_allclose(state, np.concatenate([positions, np.zeros(JOINTS)]), atol=1e-12)


def test_a_delay_between_steps_is_refused():
    with pytest.raises(ConfigurationError, match=r"servo.delay: 0.0025 s .* 0.001 s. Write 0.00"):
        Servo(ServoConfig(delay=0.0025), PERIOD, START)


def test_a_lookahead_in_milliseconds_is_recognised():
    with pytest.raises(ConfigurationError, match=r"servo.lookahead_time: 30 s .*Write 0.03"):
        validate(ServoConfig(lookahead_time=30.0), "servo")


def test_the_arm_in_the_plant_adds_no_lag_and_no_overshoot_to_the_servo():
    (case,) = servo_study([ServoConfig()])
    assert case.ramp_lag == pytest.approx(0.03, abs=PERIOD)
    assert case.arm_lag < 1e-4
    assert case.overshoot == pytest.approx(0.058, abs=2e-3)
    assert case.rise_time == pytest.approx(0.058, abs=2e-3)
    assert case.settling_time == pytest.approx(0.136, abs=3e-3)
