"""Entry point of `sliceit`: parses the command line and turns bad input into a message."""

import argparse
import os
import sys
import textwrap
from collections.abc import Sequence

from sliceit_drake.cli import (
    calibrate,
    collect,
    diagnose,
    diagram,
    emulate,
    evaluate,
    export,
    hardware,
    optimize_motion,
    record,
    records,
    score,
    simulate,
    study,
    train,
)

__all__ = ["main", "make_parser"]

GROUPS = {
    "run a slice": (simulate, hardware, emulate, collect),
    "records and foods": (record, records, calibrate, diagnose),
    "motions and policies": (train, evaluate, optimize_motion),
    "look at it": (diagram, export),
    "study the simulation": (study, score),
}
BAD_INPUT = 2
INTERRUPTED = 130
WIDTH = 88


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
    for title, group in GROUPS.items():
        lines += [f"{title}:"]
        for command in group:
            command.add_parser(commands)
            # argparse has no public way to read a command's help back, nor to group commands.
            added = commands._choices_actions[-1]
            lines += textwrap.wrap(
                added.help or "",
                WIDTH,
                initial_indent=f"  {added.dest:17}",
                subsequent_indent=19 * " ",
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
        0 on success, 1 if a run stopped early, 2 for bad input, 130 for Ctrl-C outside a run.
    """
    # The arrays are small; threads of the linear algebra library would only wait beside the run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options = make_parser().parse_args(arguments)
    try:
        return options.run(options)
    except KeyboardInterrupt:
        print("sliceit: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if not _is_bad_input(error):
            raise
        print(f"sliceit: {error}", file=sys.stderr)
        return BAD_INPUT


def _is_bad_input(error: Exception) -> bool:
    """Whether an error tells a user what to change; anything else is a fault of ours."""
    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.cutting.mesh import MeshError
    from sliceit_drake.cutting.model import TimeStepError
    from sliceit_drake.cutting.solver import CuttingError
    from sliceit_drake.hardware.client import RobotUnavailableError

    return isinstance(
        error,
        ConfigurationError | MeshError | TimeStepError | CuttingError | RobotUnavailableError,
    )


if __name__ == "__main__":
    sys.exit(main())
