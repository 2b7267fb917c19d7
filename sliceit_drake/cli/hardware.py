"""Run a scenario on a UR5e, through RTDE, with the same controller and plan as `sliceit simulate`.

THIS SOFTWARE IS NOT A SAFETY FUNCTION, and no physical robot has run it yet. Read
docs/how_to/hardware.md first. Stay out of the arm's reach, with the emergency stop in your hand.

In this order: connects; checks the robot, the plan and the start; zeroes the force sensor; shows
the plan; waits until you type the word "slice"; runs; stops the program on the robot. At the first
limit that is broken it stops for good and says why. With --dry-run it does all of this but move:
it watches the robot's data for a second instead.

A slice needs the board's height: from the robot's file, from --board-height, or by --touch. With
--touch the bare knife first goes down from the start, slowly, after you typed the word "touch",
until it meets the board, and back up. A height that is not the expected one ends the program.
--move-to-start and --touch move the arm without it, too, and expect the scenario's height.

Writes to DIR what `sliceit simulate` writes, and
  robot.csv          what came from the robot and what was sent, in every cycle
  retreat.csv        the same of a retreat
  slice.csv, .yaml   the slice record, for `sliceit records` and `sliceit diagnose`
What earlier runs wrote there is moved to DIR/earlier, DIR/earlier_2 and so on.

--robot names the file with your robot's payload, board height and limits. Copy hardware/ur5e.yaml.
"""

import argparse
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    add_output_folder,
    add_overrides,
    add_scenario_arguments,
    find_file,
    output_of,
    scenario_of,
)
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.hardware.client import is_loopback

if TYPE_CHECKING:
    from sliceit_drake.diagrams.run import Run
    from sliceit_drake.robot_run.operated_robot import OperatedRobot

__all__ = ["add_arguments", "add_robot_arguments", "robot_of", "run"]

DEFAULT_ROBOT = "hardware/ur5e.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_scenario_arguments(parser)
    add_robot_arguments(parser)
    add_output_folder(parser, "default: output/NAME_robot")
    parser.add_argument("--duration", metavar="S", type=float, help="default: the motion's")
    parser.add_argument("--no-replay", action="store_true", help="do not write replay.html")
    parser.add_argument(
        "--touch", action="store_true", help="first find the board's height with the knife"
    )
    parser.add_argument(
        "--commission",
        action="store_true",
        help="walk through the first steps with a robot, from a push by hand to the first cut",
    )


def add_robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what says which robot, and how far to go with it."""
    parser.add_argument("--host", help="address of the robot")
    parser.add_argument(
        "--robot",
        metavar="FILE",
        default=DEFAULT_ROBOT,
        help=f"YAML with your robot (default {DEFAULT_ROBOT})",
    )
    add_overrides(parser, "--set-robot", "limits.force=40")
    parser.add_argument(
        "--pace",
        type=float,
        default=1.0,
        metavar="X",
        help="of an emulated controller, as given to `sliceit emulate`",
    )
    parser.add_argument(
        "--board-height",
        metavar="M",
        type=float,
        help="of the board's surface in the world, instead of the robot's file",
    )
    parser.add_argument("--dry-run", action="store_true", help="all but moving")
    parser.add_argument(
        "--move-to-start",
        action="store_true",
        help='first move the joints straight to the start, after you typed "move"; of '
        "obstacles on the way only board, table and holder are looked for",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    if options.commission and options.dry_run:
        raise ConfigurationError(
            "does not go with --commission, whose steps move the robot",
            field="--dry-run",
            fix="Make the dry run first, by itself, and then walk.",
        )
    scenario = scenario_of(options)
    suffix = "_commissioning" if options.commission else "_robot"
    directory = output_of(options, scenario.name, suffix)
    robot = robot_of(options)
    if options.commission:
        from sliceit_drake.robot_run.commissioning import Commissioning

        return 0 if Commissioning(robot, scenario, directory).walk() else 1

    from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
    from sliceit_drake.records.slice_record import write_record

    def keep(ended: "Run") -> None:
        write_record(slice_record_of(ended, "UR5e through RTDE."), directory / "slice")

    made = robot.run(
        scenario,
        directory,
        move_to_start=options.move_to_start,
        touch=options.touch,
        duration=options.duration,
        draws=not options.no_replay,
        keep=keep,
    )
    if made is None:
        return 1
    if options.dry_run:
        return 1 if made.stopped else 0
    print(f"Results in {directory}/: {', '.join(sorted(p.name for p in directory.iterdir()))}")
    return 1 if made.stopped else 0


def robot_of(options: argparse.Namespace) -> "OperatedRobot":
    """The robot that the options name, with its file.

    Raises:
        ConfigurationError: The file is missing or wrong, or there is no address.
    """
    from sliceit_drake.configuration import validate
    from sliceit_drake.hardware.hardware_config import load_hardware_config

    if not options.host:
        raise ConfigurationError(
            "is missing", field="--host", fix="Give the address of the robot, as on its pendant."
        )
    if options.pace != 1.0 and (not is_loopback(options.host) or not 0.0 < options.pace <= 10.0):
        raise ConfigurationError(
            f"{options.pace:g} is for an emulated controller on this machine",
            field="--pace",
            fix="Leave it out: a robot's clock has the pace 1.",
        )
    file = find_file(options.robot, "robot file", DEFAULT_ROBOT)
    config = load_hardware_config(file, options.set_robot)
    if options.board_height is not None:
        config.board_height = options.board_height
        validate(config, "robot")

    from sliceit_drake.robot_run.operated_robot import OperatedRobot

    return OperatedRobot(options.host, config, options.pace, options.dry_run)
