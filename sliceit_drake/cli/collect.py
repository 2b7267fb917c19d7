"""Cut the slices of a protocol, in random order, with the arm under compliance control, and write a
record of each: constant speeds, holds, withdrawals, air, replicates, as the protocol says
(calibration/protocols; `sliceit record --help`).

Without --host the station is simulated: arm, controller, sensor and finite elements, each slice's
material deviating as the protocol's `variation` says. With --host it is a UR5e: before each slice
you are told what to put under the knife, and asked for the word that moves the robot, as by
`sliceit hardware`. With --move-to-start, which most protocols need from the second slice on, the
knife goes to the slice's start first, after the word "move", so that the food can be put there.
With --touch the bare knife finds the board's height once, before the first of the slices.

--emulator-pendant PORT is for `sliceit emulate`: its food is renewed before each slice through that
port (30099), deviating as in the simulated station. The words are asked for nevertheless.

The records are what the wrist sensor and the joints show, so they hold the tool's inertia and what
the sensor adds, which those of `sliceit record` (prescribed motions, no arm) do not.

Writes slice_000.csv, slice_000.yaml, ... to DIR, and on a robot a folder of outputs for each. What
is there already is not cut again: start the command once more to go on.

Examples
  sliceit collect calibration/protocols/poor.yaml --output records/arm
  sliceit collect --host 192.168.1.10 --robot my_ur5e.yaml --move-to-start --output records/real
"""

import argparse
import contextlib
import functools
import math
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    ONE_CUT,
    SEEDS,
    add_output_folder,
    add_protocol_argument,
    check_numbers,
    output_of,
    protocol_file,
)
from sliceit_drake.cli.hardware import add_robot_arguments, robot_of
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.hardware.client import is_loopback
from sliceit_drake.output_folder import check_folder

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["add_arguments", "run"]

PREPARATION = 120.0
"""Wall time that an emulator may take to prepare a food, s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_protocol_argument(parser)
    parser.add_argument(
        "--station",
        default=ONE_CUT,
        metavar="SCENARIO",
        help=f"whose robot, controller, sensor and numerics are used (default {ONE_CUT})",
    )
    add_robot_arguments(parser)
    add_output_folder(parser, "folder of the records; default output/NAME")
    parser.add_argument(
        "--seed", type=int, default=0, help="of the order and the simulated variation (default 0)"
    )
    parser.add_argument("--first", type=int, metavar="N", help="only the first N slices")
    parser.add_argument(
        "--touch", action="store_true", help="find the board's height before the first slice"
    )
    parser.add_argument(
        "--emulator-pendant",
        type=int,
        metavar="PORT",
        help="of the emulator at --host, to put fresh food there before each slice",
    )
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    _check(options)
    check_numbers(options, seed=SEEDS, first=(1, math.inf))
    robot = robot_of(options) if options.host else None

    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.robot_run.collection import Collection
    from sliceit_drake.stand_in.protocol import load_protocol

    protocol = load_protocol(str(protocol_file(options)))
    station = load_scenario(options.station)
    options.output = directory = output_of(options, protocol.name)
    check_folder(directory, "--output")
    port, put_fresh_food = options.emulator_pendant, None
    if port is not None:
        put_fresh_food = functools.partial(_put_fresh_food, options.host, port)
    collection = Collection(
        protocol,
        station,
        directory,
        options.seed,
        robot,
        move_to_start=options.move_to_start,
        touch=options.touch,
        put_fresh_food=put_fresh_food,
    )
    return 0 if collection.cut(options.first) else 1


def _check(options: argparse.Namespace) -> None:
    """Refuses options that do not fit together.

    Raises:
        ConfigurationError: Naming option and fix.
    """
    if options.emulator_pendant is not None and not is_loopback(options.host or ""):
        raise ConfigurationError(
            "is of an emulated controller on this machine",
            field="--emulator-pendant",
            fix="Give its address with --host; with a robot leave this out.",
        )
    for name in ("touch", "move_to_start", "dry_run"):
        if getattr(options, name) and not options.host:
            raise ConfigurationError(
                "is for a robot",
                field=f"--{name.replace('_', '-')}",
                fix="Give its address with --host, or leave this out.",
            )


def _put_fresh_food(host: str, port: int, scenario: "Scenario") -> None:
    """Renews the food under the knife of an emulated robot.

    Raises:
        ConfigurationError: No emulator answers there, or it refuses.
    """
    from sliceit_drake.emulator.process import EmulatorError, PendantClient

    try:
        with contextlib.closing(PendantClient(host, PREPARATION, port)) as pendant:
            pendant.put_fresh_food(dump_yaml(scenario))
    except (OSError, EmulatorError) as error:
        raise ConfigurationError(
            f"{host}:{port} puts no fresh food there: {error}",
            field="--emulator-pendant",
            fix="Give the own port of a running `sliceit emulate`, 30099.",
        ) from error
    print("The emulator has put it there.")
