"""How the arm follows joint targets, against the two parameters of servoj.

Moves the arm by a ramp and by a step for several of both and prints lag and overshoot.
"""

import argparse
import dataclasses as dc
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial, Trajectory
from tqdm import tqdm

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.plant.robot_plant import (
    RobotConfig,
    add_plant,
    add_robot,
    connect_arm_controller,
)
from sliceit_drake.systems.servo import JOINTS, ServoConfig
from studies.pages import publish, table

__all__ = ["ServoCase", "add_arguments", "damping_ratio", "run", "servo_study", "servo_table"]

LOOKAHEAD_TIMES, GAINS = (0.03, 0.1, 0.2), (100.0, 300.0, 2000.0)
SPEED = 0.1  # Of the ramp, rad/s.
STEP = 0.01  # rad; larger ones meet the torque limits at high gains.
DURATION = 6.0  # s; the least damped case needs most of it.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    configs = [
        ServoConfig(lookahead_time=time, gain=gain) for time in LOOKAHEAD_TIMES for gain in GAINS
    ]
    with tqdm(total=2 * len(configs), desc="runs") as bar:
        cases = servo_study(configs, lambda done, _: bar.update(done - bar.n))
    publish(servo_table(cases), options.output, cases)
    return 0


@dc.dataclass
class ServoCase:
    """The response of the arm's joints in the plant, the worst of the six.

    Attributes:
        config: Parameters of the servo.
        ramp_lag: Time by which the joints trail a ramp of 0.1 rad/s, s.
        arm_lag: The part of it by which they trail the servo's own motion, s.
        rise_time: Time after a step of 0.01 rad until 90 % of it, s.
        overshoot: Part of the step by which they pass it.
        settling_time: Time until they stay within 2 % of the step, s.
    """

    config: ServoConfig
    ramp_lag: float
    arm_lag: float
    rise_time: float
    overshoot: float
    settling_time: float


def servo_study(
    configs: Sequence[ServoConfig], progress: Callable[[int, int], None] | None = None
) -> list[ServoCase]:
    """Moves the arm without food, by a ramp and by a step of all joints, from its start posture.

    Args:
        configs: The servos.
        progress: Called with the runs done and their number after each; there are two a servo.

    Returns:
        What was measured, in the order of `configs`.
    """
    start = np.array(RobotConfig().joint_positions)
    ramp = PiecewisePolynomial.FirstOrderHold(
        [0.0, DURATION], np.stack([start, start + SPEED * DURATION], axis=1)
    )
    step = PiecewisePolynomial(start + STEP)
    cases = []
    for k, config in enumerate(configs):
        times, q, q_servo = _respond(config, ramp)
        if progress is not None:
            progress(2 * k + 1, 2 * len(configs))
        ramp_lag = np.abs(times[-1] - (q[-1] - start) / SPEED).max()
        arm_lag = np.abs((q_servo[-1] - q[-1]) / SPEED).max()
        times, q, _ = _respond(config, step)
        if progress is not None:
            progress(2 * k + 2, 2 * len(configs))
        response = (q - start) / STEP
        late = times[(np.abs(response - 1.0) > 0.02).any(axis=1)][-1]
        cases.append(
            ServoCase(
                config=config,
                ramp_lag=float(ramp_lag),
                arm_lag=float(arm_lag),
                rise_time=float(times[np.argmax(response > 0.9, axis=0)].max()),
                overshoot=float(max(response.max() - 1.0, 0.0)),
                settling_time=float(late),
            )
        )
    return cases


def damping_ratio(config: ServoConfig) -> float:
    """Damping of the response; a step overshoots below 1 (5.8 % at the defaults)."""
    return 0.5 * config.lookahead_time * math.sqrt(config.gain)


def servo_table(cases: Sequence[ServoCase]) -> str:
    """The cases as a Markdown table."""
    return table(
        "lookahead [s] | gain [1/s2] | damping ratio | lag behind a ramp [ms]"
        " | of it the arm's [ms] | step: 90 % after [ms] | overshoot [%] | within 2 % after [ms]",
        (
            (f"{case.config.lookahead_time:g}", f"{case.config.gain:g}")
            + (f"{damping_ratio(case.config):.2f}", f"{1e3 * case.ramp_lag:.1f}")
            + (f"{1e3 * case.arm_lag:.1f}", f"{1e3 * case.rise_time:.0f}")
            + (f"{1e2 * case.overshoot:.1f}", f"{1e3 * case.settling_time:.0f}")
            for case in cases
        ),
    )


def _respond(config: ServoConfig, targets: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [N], joint positions in the plant and those that the servo asked for [N, 6]."""
    robot_config = RobotConfig(servo=config)
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, robot_config)
    robot = add_robot(plant, robot_config, Knife(), Board())
    plant.Finalize()
    controller = connect_arm_controller(builder, plant, robot, robot_config)
    source = builder.AddSystem(TrajectorySource(targets))
    builder.Connect(source.get_output_port(), controller.GetInputPort("joint_positions_command"))
    period = robot_config.plant_time_step
    logs = [
        LogVectorOutput(port, builder, period)
        for port in (
            plant.get_state_output_port(robot.arm),
            controller.GetOutputPort("desired_state"),
        )
    ]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(DURATION)
    actual, asked = (log.FindLog(simulator.get_context()) for log in logs)
    return actual.sample_times(), actual.data()[:JOINTS].T, asked.data()[:JOINTS].T
