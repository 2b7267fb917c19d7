"""Emulate the controller of a UR5e on the loopback interface: RTDE (port 30004), dashboard (29999),
script upload (30003, 30001, 30002) and the register protocol of ur_rtde's control script. Behind it
the scenario's arm, knife and food are simulated, as by `sliceit simulate`.

The emulator is the clock. One cycle is 2 ms of controller time; --pace says how much controller
time passes per wall time. With --lockstep a cycle waits for the client's servoJ instead: the same
run every time, on any machine.

Port 30099 takes lines of JSON, as {"inject": "silence:0.1", "at": 2.5}, {"status": true},
{"fresh_food": true} (uncut food under the knife) or {"stop": true}. --inject does the same
from the start. Times are the controller's.
"""

import argparse
import gc
import signal
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import add_scenario_arguments, scenario_of
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.emulator.fault_table import faults_as_text
from sliceit_drake.hardware.client import is_loopback
from sliceit_drake.interruption import handle_signals

if TYPE_CHECKING:
    from sliceit_drake.emulator.controller import ControllerConfig
    from sliceit_drake.emulator.robot_model import RobotModel

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    parser.description = f"{__doc__}What can be injected:\n{faults_as_text()}\n"
    add_scenario_arguments(parser)
    parser.add_argument(
        "--address",
        default="127.0.0.1",
        help="where to listen (default 127.0.0.1); 127.0.0.2 and so on for more emulators",
    )
    parser.add_argument(
        "--open-to-the-network",
        action="store_true",
        help="allow an --address that others can reach; nothing asks who they are",
    )
    parser.add_argument(
        "--pace", type=float, default=1.0, metavar="X", help="times real time (default 1)"
    )
    parser.add_argument(
        "--lockstep", action="store_true", help="while a client servos, wait for its commands"
    )
    parser.add_argument(
        "--arm-alone",
        action="store_true",
        help="no scenario: an arm without dynamics that touches nothing",
    )
    parser.add_argument(
        "--inject",
        action="append",
        default=[],
        metavar="FAULT[@TIME]",
        help="as protective_stop@2.5; may be given several times",
    )
    parser.add_argument(
        "--version",
        default="5.11.1.108318",
        metavar="A.B.C.D",
        help="software that the controller reports (default 5.11.1.108318)",
    )
    parser.add_argument("--end-with-stdin", action="store_true", help=argparse.SUPPRESS)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from sliceit_drake.emulator.controller import ControllerConfig
    from sliceit_drake.emulator.emulator import ControllerClock, Emulator

    if not is_loopback(options.address) and not options.open_to_the_network:
        raise ConfigurationError(
            f"{options.address} is no loopback address: others may reach the emulator there, and "
            "nothing asks who they are",
            field="--address",
            fix="Give 127.0.0.1, or add --open-to-the-network.",
        )
    clock = ControllerClock(pace=options.pace, lockstep=options.lockstep)
    config = ControllerConfig(version=_version(options.version))
    robot = _robot(options, config)
    try:
        emulator = Emulator(robot, options.address, clock, config)
    except OSError as error:
        raise ConfigurationError(str(error), field="--address") from None
    try:
        for text in options.inject:
            fault, _, at = text.partition("@")
            try:
                time = float(at) if at else None
            except ValueError:
                raise ValueError(f"{at!r} is no time. Write {fault}@2.5.") from None
            emulator.faults.inject(fault, time)
    except ValueError as error:
        emulator.close()
        raise ConfigurationError(str(error), field="--inject") from None
    came: list[int] = []

    def ask(number: int, _: object) -> None:
        came.append(number)
        emulator.stop()

    if options.end_with_stdin:
        threading.Thread(target=_stop_with_stdin, args=(emulator.stop,), daemon=True).start()
    how = "in lockstep with servoJ" if options.lockstep else f"at {options.pace:g} x real time"
    # Walking through all imported modules for garbage would make a cycle late.
    gc.collect()
    gc.freeze()
    # Ctrl-C as an exception may come where Python drops it, in a destructor: it would go on.
    with handle_signals((signal.SIGINT, signal.SIGTERM), ask):
        print(f"Emulated UR5e at {options.address}, {how}. Ctrl-C ends it.", flush=True)
        emulator.run()
    if signal.SIGINT in came:
        raise KeyboardInterrupt
    return 0


def _robot(options: argparse.Namespace, config: "ControllerConfig") -> "RobotModel":
    """The arm that the options name; its tool's payload goes into `config`."""
    if options.arm_alone:
        from sliceit_drake.emulator.robot_model import KinematicRobot

        return KinematicRobot()
    from sliceit_drake.emulator.station_robot import StationRobot

    print("Preparing (the first run on a machine compiles the kernels, about 10 s)", flush=True)
    robot = StationRobot(scenario_of(options))
    config.payload, config.payload_cog = robot.payload, robot.payload_cog
    config.is_zeroed = robot.is_zeroed
    return robot


def _version(text: str) -> tuple[int, ...]:
    try:
        parts = tuple(int(part) for part in text.split("."))
    except ValueError:
        parts = ()
    if len(parts) != 4 or min(parts) < 0:
        raise ConfigurationError(
            f"{text!r} is no software version", field="--version", fix="Write 5.11.1.108318."
        )
    return parts


def _stop_with_stdin(stop: Callable[[], None]) -> None:
    """Ends the emulator when the process that started it has gone."""
    sys.stdin.buffer.read()
    stop()
