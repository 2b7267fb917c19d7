"""Entry point of `sliceit`: parses the command line and turns bad input into a message."""

import argparse
import errno
import importlib
import os
import signal
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

from sliceit_drake.interruption import handle_signals
from sliceit_drake.output_folder import check_output

__all__ = ["main", "make_parser", "run_program"]

COMMANDS = {
    "run a slice": {
        "simulate": "run a scenario and write record, summary, figure and replay",
        "hardware": "run a scenario on a UR5e: checks, plan, your word, motion, record",
        "emulate": "emulate a UR5e's controller that ur_rtde talks to, with the scenario behind it",
        "collect": "cut the slices of a protocol on a station, simulated or real, and record them",
    },
    "records and foods": {
        "record": "cut slices in a world with hidden effects and write their records",
        "records": "check slice records, or make them from other formats",
        "calibrate": "find a food's parameters, with their uncertainty, from slice records",
        "diagnose": "show what the simulation gets wrong in records, and name the cause",
    },
    "motions and policies": {
        "train": "train a slicing policy",
        "evaluate": "let trained policies cut slices in unseen worlds",
        "optimize-motion": "find the press and draw with the least force",
    },
    "look at it": {
        "diagram": "draw the systems of a scenario, or print its port contract",
        "export": "write a run as a series for ParaView",
    },
}
"""What each command does, by group. A command is a module of this package with `add_arguments` and
`run`, which returns the exit status; its docstring is the text of `--help`."""

BAD_INPUT = 2
INTERRUPTED = 130
WIDTH = 88

REFUSED = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.ENOSPC,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
}
"""Errors by which a disk refuses, rather than a program fails."""


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole program."""
    parser = argparse.ArgumentParser(
        prog="sliceit",
        usage="sliceit [-h] COMMAND ...",
        description="Simulate a robot that slices food, in Drake.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(
        prog="sliceit", metavar="COMMAND", required=True, help=argparse.SUPPRESS
    )
    lines = []
    for title, group in COMMANDS.items():
        lines += [f"{title}:"]
        for name, line in group.items():
            command = importlib.import_module(f"sliceit_drake.cli.{name.replace('-', '_')}")
            command_parser = commands.add_parser(
                name,
                description=command.__doc__,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            command.add_arguments(command_parser)
            command_parser.set_defaults(run=command.run)
            lines += textwrap.wrap(
                line, WIDTH, initial_indent=f"  {name:17}", subsequent_indent=19 * " "
            )
        lines.append("")
    lines.append("`sliceit COMMAND --help` explains a command. SI units everywhere.")
    parser.epilog = "\n".join(lines)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `sliceit`.

    Args:
        arguments: Command line without the program's name; None for that of the process.

    Returns:
        0 on success, 1 if a run stopped early, 2 for bad input, 130 for Ctrl-C outside a run (and
        for SIGTERM or SIGHUP).
    """
    return run_program(make_parser(), arguments)


def run_program(parser: argparse.ArgumentParser, arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and runs the command; bad input becomes a message.

    Args and Returns: as `main`.
    """
    # The arrays are small; threads of the linear algebra library would only wait beside the run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options = parser.parse_args(arguments)
    # `nohup` has one ignored, for a reason.
    ending = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.SIG_DFL
    ]
    try:
        with handle_signals(ending, signal.default_int_handler):
            if isinstance(getattr(options, "output", None), Path):
                check_output(options.output)
            return options.run(options)
    except KeyboardInterrupt:
        goes_on = getattr(options, "resumes", False) and options.output is not None
        hint = (
            f". What is done is in {options.output}; the same command goes on." if goes_on else ""
        )
        print(f"{parser.prog}: interrupted{hint}", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if isinstance(error, OSError) and error.errno in REFUSED:
            print(f"{parser.prog}: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        elif _is_bad_input(error):
            print(f"{parser.prog}: {error}", file=sys.stderr)
        else:
            raise
        return BAD_INPUT


def _is_bad_input(error: Exception) -> bool:
    """Whether an error tells a user what to change; anything else is a fault of ours."""
    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.cutting.mesh.tetrahedra import MeshError
    from sliceit_drake.cutting.model import TimeStepError
    from sliceit_drake.cutting.solver import CuttingError
    from sliceit_drake.hardware.client import RobotUnavailableError

    return isinstance(
        error,
        ConfigurationError | MeshError | TimeStepError | CuttingError | RobotUnavailableError,
    )


if __name__ == "__main__":
    sys.exit(main())
