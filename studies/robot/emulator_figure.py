"""Draws a slice over the network on the emulated controller beside the simulated one.

The scenario cucumber_measured is simulated, and then cut at a tenth of real time by the hardware
station, which talks to the emulator by ur_rtde. Emulator and client wait for each other (lockstep).
Needs the extra "hardware".
"""

import argparse
from contextlib import closing

import numpy as np

from sliceit_drake.diagrams.run import simulate
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.emulator.process import EmulatorProcess
from sliceit_drake.hardware.hardware_config import load_hardware_config
from sliceit_drake.hardware.ur_client import UrClient
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.hardware_run import prepare_hardware_run
from studies.figures import BLUE, ORANGE, add_figure_argument, new_figure, save_figure, tidy

__all__ = ["add_arguments", "run"]

PACE = 0.1
"""Controller seconds in a second."""
CLIENT_PACE = 0.02
PATIENT = """{serial: "", watchdog: 10.0,
  limits: {state_age: 0.04, command_age: 0.04, joint_step: 0.04}}"""
"""What a robot's file may not be on a shared machine, which stands at times."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    add_figure_argument(parser, "emulator")
    parser.add_argument(
        "--address", default="127.0.0.9", help="of the emulator (default 127.0.0.9)"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study; status 1 where the robot was not ready or stopped."""
    file = resource_path("scenarios/cucumber_measured.yaml")
    simulated = simulate(file, replay=False).record()
    config = load_hardware_config(resource_path("hardware/emulated.yaml"), PATIENT)
    with EmulatorProcess(file, options.address, PACE, lockstep=True):
        client = UrClient(options.address, config.lookahead_time, config.gain, pace=CLIENT_PACE)
        with closing(client):
            hardware = prepare_hardware_run(load_scenario(file), config, client, CLIENT_PACE)
            failed = [
                check
                for check in hardware.check_before() + hardware.check_at_start()
                if not check.passed
            ]
            if failed:
                print(f"not drawn: {failed}")
                return 1
            made = hardware.execute()
    if made.stopped:
        print(f"not drawn: {made.stopped}")
        return 1
    robot = made.record()
    figure = new_figure(9.0, 4.6)
    height, force, apart = figure.subplots(3, 1, sharex=True, height_ratios=(2, 3, 1.4))
    for record, label, style in (
        (simulated, "sliceit simulate", {"color": BLUE, "lw": 4.0, "alpha": 0.45}),
        (robot, "sliceit hardware on the emulator", {"color": "black", "lw": 1.2}),
    ):
        height.plot(record["time"], 1e3 * record["knife_pose_p_z"], label=label, **style)
        force.plot(record["time"], record["sensor_wrench_f_z"], **style)
    both = robot["time"] <= simulated["time"][-1]
    expected = np.interp(robot["time"], simulated["time"], simulated["sensor_wrench_f_z"])
    difference = (robot["sensor_wrench_f_z"] - expected)[both]
    apart.plot(robot["time"][both], 1e3 * difference, color=ORANGE, lw=1.0)
    height.set_ylabel("height of the\nedge [mm]")
    force.set_ylabel("sensor force,\nflange z [N]")
    apart.set(ylabel="difference\n[mN]", xlabel="controller time [s]")
    height.legend(frameon=False, fontsize=8)
    for axes in (height, force, apart):
        tidy(axes)
    save_figure(figure, options.output, dpi=100)
    rms = float(np.sqrt(np.mean(difference**2)))
    print(f"{1e3 * rms:.3g} mN RMS apart, peak {np.abs(robot['sensor_wrench_f_z']).max():.2f} N")
    return 0
