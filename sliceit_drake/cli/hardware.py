"""`sliceit hardware`: run a scenario on a UR5e."""

import argparse
import logging
import sys
import termios
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.scenario_argument import add_scenario_arguments, find_file, scenario_of

if TYPE_CHECKING:
    from sliceit_drake.diagrams.run import Run
    from sliceit_drake.diagrams.scenario import Scenario
    from sliceit_drake.hardware.checks import Check
    from sliceit_drake.hardware.client import RobotClient
    from sliceit_drake.hardware.hardware_config import HardwareConfig
    from sliceit_drake.hardware.rtde_link import RobotLink
    from sliceit_drake.robot_run.hardware_run import HardwareRun

__all__ = [
    "add_parser",
    "add_robot_arguments",
    "ask",
    "checked_run",
    "is_loopback",
    "move_confirmed",
    "plan_text",
    "robot_config",
    "run_confirmed",
    "touch_board",
    "touch_confirmed",
]

DEFAULT_ROBOT = "hardware/ur5e.yaml"
WORD = "slice"
MOVE_WORD = "move"
TOUCH_WORD = "touch"
WATCHED = 1.0

DESCRIPTION = """\
Run a scenario on a UR5e, through RTDE, with the same controller and plan as `sliceit simulate`.

THIS SOFTWARE IS NOT A SAFETY FUNCTION, and no physical robot has run it yet. Read docs/hardware.md
first. Stay out of the arm's reach, with the emergency stop in your hand.

In this order: connects; checks the robot, the plan and the start; zeroes the force sensor; shows
the plan; waits until you type the word "slice"; runs; stops the program on the robot. At the first
limit that is broken it stops for good and says why. With --dry-run it does all of this but move:
it watches the robot's data for a second instead.

The board's height must be known: from the robot's file, from --board-height, or by --touch. With
--touch the bare knife first goes down from the start, slowly, after you typed the word "touch",
until it meets the board, and back up. A height that is not the expected one ends the program.

Writes to DIR what `sliceit simulate` writes, and
  robot.csv          what came from the robot and what was sent, in every cycle
  slice.csv, .yaml   the slice record, for `sliceit records` and `sliceit diagnose`

--robot names the file with your robot's payload, board height and limits. Copy hardware/ur5e.yaml.
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "hardware",
        help="run a scenario on a UR5e: checks, plan, your word, motion, record",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario_arguments(parser)
    add_robot_arguments(parser)
    parser.add_argument(
        "--output", metavar="DIR", type=Path, default=None, help="default: output/NAME_robot"
    )
    parser.add_argument("--duration", metavar="S", type=float, help="default: the motion's")
    parser.add_argument("--no-replay", action="store_true", help="do not write replay.html")
    parser.add_argument(
        "--touch", action="store_true", help="first find the board's height with the knife"
    )
    parser.set_defaults(run=_run)


def add_robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what says which robot, and how far to go with it."""
    parser.add_argument("--host", help="address of the robot")
    parser.add_argument(
        "--robot",
        metavar="FILE",
        default=DEFAULT_ROBOT,
        help=f"YAML with your robot (default {DEFAULT_ROBOT})",
    )
    parser.add_argument(
        "--set-robot", metavar="YAML", help="fields that replace those of the robot's file"
    )
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
        help='first move the joints straight to the start, after you typed "move"; nothing looks '
        "for obstacles on the way",
    )


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    logging.getLogger("drake").setLevel(logging.WARNING)
    scenario = scenario_of(options)
    config = robot_config(options)

    from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
    from sliceit_drake.records.slice_record import write_record

    directory = options.output or Path("output") / f"{scenario.name}_robot"
    made = run_confirmed(options, scenario, config, directory)
    if made is None:
        return 1
    if options.dry_run:
        return 0
    write_record(slice_record_of(made, "UR5e through RTDE."), directory / "slice")
    print(f"Results in {directory}/: {', '.join(sorted(p.name for p in directory.iterdir()))}")
    return 1 if made.stopped else 0


def run_confirmed(
    options: argparse.Namespace, scenario: "Scenario", config: "HardwareConfig", directory: Path
) -> "Run | None":
    """Connects, checks, asks for the word, runs, and writes the outputs.

    Returns:
        The run; None if the robot was not ready or the operator did not confirm.
    """
    from sliceit_drake.diagrams.live_view import make_meshcat
    from sliceit_drake.robot_run.hardware_run import prepare_hardware_run

    if options.move_to_start and not options.dry_run:
        if not move_confirmed(options, scenario, config):
            return None
    if getattr(options, "touch", False) and not options.dry_run:
        if not touch_confirmed(options, scenario, config):
            return None
    with _connected(options, config) as client:
        is_drawn = not (getattr(options, "no_replay", True) or options.dry_run)
        meshcat = make_meshcat() if is_drawn else None
        hardware = prepare_hardware_run(scenario, config, client, options.pace, meshcat)
        return checked_run(options, hardware, directory)


def touch_confirmed(
    options: argparse.Namespace, scenario: "Scenario", config: "HardwareConfig"
) -> bool:
    """Connects and finds the board, see `touch_board`; the program on the robot is stopped then."""
    with _connected(options, config) as client:
        return touch_board(options, scenario, config, client)


def move_confirmed(
    options: argparse.Namespace, scenario: "Scenario", config: "HardwareConfig"
) -> bool:
    """Connects, checks the robot, and moves it to the start after the operator's word.

    Returns:
        False if the robot was not ready or did not move, or the operator did not confirm.
    """
    from sliceit_drake.robot_run.hardware_run import prepare_hardware_run
    from sliceit_drake.robot_run.move_to_start import MoveToStart

    with _connected(options, config) as client:
        hardware = prepare_hardware_run(scenario, config, client, options.pace)
        if not _report("Robot", hardware.check_facts()):
            return False
        move = MoveToStart(hardware)
        if not _report("Move to the start", move.checks()):
            return False
        print(
            f"\nMOVE: the joints turn straight to {hardware.twin.start_joints.round(4).tolist()}; "
            f"the knife moves at up to {1e3 * move.knife_speed:.0f} mm/s, and nothing looks for "
            "obstacles but the board. Stand back.\n"
        )
        if not ask(MOVE_WORD, options):
            return False
        problem = move.execute()
        if problem is not None:
            print(f"STOPPED on the way to the start: {problem}")
        return problem is None


def touch_board(
    options: argparse.Namespace,
    scenario: "Scenario",
    config: "HardwareConfig",
    client: "RobotClient",
) -> bool:
    """Finds the board after checks and the operator's word; `config` then has the height found.

    Returns:
        False if the robot was not ready, the operator did not confirm, or there was no board.

    Raises:
        ConfigurationError: The board is not where it is expected.
    """
    from sliceit_drake.hardware.guarded_touch import TouchError
    from sliceit_drake.robot_run.board_touch import BoardTouch, check_height
    from sliceit_drake.robot_run.hardware_run import prepare_hardware_run

    field = "scenario.board.height" if config.board_height is None else "board_height"
    if config.board_height is None:
        config.board_height = scenario.board.height
    hardware = prepare_hardware_run(scenario, config, client, options.pace)
    touch = BoardTouch(hardware)
    if not _report("Robot and touch", [*hardware.check_facts(), *touch.checks()]):
        return False
    if not _report("Start", hardware.check_at_start()):
        return False
    print(
        f"\nTOUCH: the knife goes straight down by up to {1e3 * touch.depth:.1f} mm at "
        f"{1e3 * config.touch.speed:g} mm/s, until it meets {config.touch.force:g} N, and back up. "
        f"It looks for the board between the start and {touch.expected - config.touch.below:.4f} "
        "m. Take the food away: the knife would take it for the board.\n"
    )
    if not ask(TOUCH_WORD, options):
        return False
    try:
        found = touch.execute()
    except TouchError as error:
        print(f"STOPPED: {error}")
        print(_stopped_text(touch.link))
        return False
    print(
        f"The board is at {found.height:.4f} m (+- {1e3 * found.uncertainty:.2f} mm), expected at "
        f"{touch.expected:.4f}. It is as stiff as {1e-3 * found.stiffness:.0f} N/mm, with the arm; "
        f"the force rose to {found.peak_force:.1f} N."
    )
    check_height(found, touch.expected, config.touch.tolerance, field)
    config.board_height = found.height
    print("This run takes the height that was found.\n")
    return True


def checked_run(
    options: argparse.Namespace, hardware: "HardwareRun", directory: Path
) -> "Run | None":
    """The same with a robot that is connected already."""
    if not _report("Robot and plan", hardware.check_before()):
        return None
    duration = _run_duration(options, hardware)
    if not _report("Start", hardware.check_at_start()):
        return None
    print(plan_text(hardware, duration))
    if options.dry_run:
        made = hardware.execute(min(WATCHED, duration), moves=False)
        assert hardware.link is not None
        timing = ", ".join(f"{k} {v:.4g}" for k, v in hardware.link.timing().items())
        print(f"Dry run: nothing was sent to the joints. {timing}")
        return made
    return _slice(hardware, duration, directory) if ask(WORD, options) else None


def _run_duration(options: argparse.Namespace, hardware: "HardwareRun") -> float:
    """How long to run, s.

    Raises:
        ConfigurationError: The option is no part of the motion: the knife would stay where it is.
    """
    from sliceit_drake.configuration import ConfigurationError

    longest, duration = hardware.motion.duration, getattr(options, "duration", None)
    if duration is None:
        return longest
    if not 0.0 < duration <= longest + 1e-9:
        raise ConfigurationError(
            f"{duration:g} s is not within the motion",
            field="--duration",
            fix=f"Give up to {longest:g}, or leave it out.",
        )
    return duration


def _stopped_text(link: "RobotLink | None") -> str:
    """What an operator must know about the robot after a stop."""
    if link is None or link.stop_error is None:
        return "The robot's program is stopped. Find the cause before you start again."
    return (
        f"THE ROBOT DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED ({link.stop_error}). Use the "
        "emergency stop before you go near it."
    )


def _slice(hardware: "HardwareRun", duration: float, directory: Path) -> "Run":
    """Runs, writes and reports."""
    from tqdm import tqdm

    from sliceit_drake.robot_run.hardware_run import write_hardware_outputs

    with tqdm(
        total=duration,
        desc=hardware.scenario.name,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s",
    ) as bar:

        def show(time: float, wall: float) -> None:
            bar.update(time - bar.n)

        made = hardware.execute(duration, show)
    summary = write_hardware_outputs(hardware, directory)
    if made.stopped:
        print(f"STOPPED: {made.stopped}")
        print(_stopped_text(hardware.link))
    robot = summary["robot"]
    print(
        f"Peak force {summary['peak_force_N']:.1f} N; {robot['cycles']:.0f} cycles, "
        f"{robot['missed_cycles']:.0f} missed, lateness {1e3 * robot['lateness_99_s']:.2f} ms "
        f"(99 %), {1e3 * robot['lateness_max_s']:.2f} ms at most"
    )
    return made


def robot_config(options: argparse.Namespace) -> "HardwareConfig":
    """The robot's file.

    Raises:
        ConfigurationError: It is missing or wrong, or there is no address.
    """
    from sliceit_drake.configuration import ConfigurationError, validate
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
    return config


def is_loopback(host: str) -> bool:
    """Whether an address is of this machine, as an emulated controller's is."""
    return host == "localhost" or host.startswith("127.")


@contextmanager
def _connected(options: argparse.Namespace, config: "HardwareConfig") -> "Iterator[RobotClient]":
    """A client in control of the robot; at the end the robot's program is stopped, however it ends.

    A terminal that is closed, and a polite kill, end it as Ctrl-C does.
    """
    from sliceit_drake.hardware.interruption import catch_signals

    with catch_signals():
        client = _connect(options, config)
        try:
            yield client
        finally:
            client.close()


def _connect(options: argparse.Namespace, config: "HardwareConfig") -> "RobotClient":
    """Connects to the robot and takes control.

    Raises:
        RobotUnavailableError: It does not answer, or refuses.
    """
    from sliceit_drake.hardware.ur_client import UrClient

    print(f"Connecting to {options.host}", flush=True)
    return UrClient(options.host, config.lookahead_time, config.gain, pace=options.pace)


def ask(word: str, options: argparse.Namespace) -> bool:
    """Whether the operator types the word; Enter alone, an end of input or Ctrl-C do not.

    What was typed before the question does not count, and a robot is not moved by a pipe.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    elif not is_loopback(getattr(options, "host", None) or ""):
        print(f'The word "{word}" must be typed at a terminal. Nothing was moved.')
        return False
    try:
        answer = input(f'Type "{word}" to go on, anything else to leave: ')
    except EOFError:
        answer = ""
    if answer.strip() == word:
        return True
    print("Not confirmed. Nothing was moved.")
    return False


def plan_text(hardware: "HardwareRun", duration: float) -> str:
    """What is about to happen, for the operator to read."""
    from sliceit_drake.hardware.hardware_config import differing

    scenario, plan, limits = hardware.scenario, hardware.plan, hardware.config.limits
    board = scenario.board.height
    changed = differing(hardware.config)
    phases = ", ".join(
        f"{label} {end - begin:.2f} s" for label, begin, end in hardware.motion.phases
    )
    policy = scenario.policy
    if policy is not None:
        phases = f"{policy.describe()}; up to there"
    lines = [
        "",
        f"PLAN: {scenario.name}, {duration:.2f} s: {phases}",
        f"  knife up to {1e3 * plan.fastest:.0f} mm/s; edge between "
        f"{1e3 * (plan.lowest - board):+.2f} and {1e3 * (plan.edge_high[2] - board):+.1f} mm over "
        f"the board at {board:.4f} m",
        f"  stops at {limits.force:g} N, {limits.torque:g} Nm, {limits.knife_speed:g} m/s of the "
        f"knife, {1e3 * limits.board_depth:g} mm below the board, {limits.tracking_error:g} rad "
        "off the target",
        f"  settings that differ from the defaults: {'; '.join(changed) if changed else 'none'}",
        "",
    ]
    return "\n".join(lines)


def _report(title: str, checks: "Sequence[Check]") -> bool:
    """Prints checks; whether all passed."""
    print(f"{title}:")
    for check in checks:
        print(f"  {check}")
    failed = [check.name for check in checks if not check.passed]
    if failed:
        print(f"Not ready: {', '.join(failed)}. Nothing was moved.")
    return not failed
