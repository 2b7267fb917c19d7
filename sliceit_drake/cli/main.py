"""Entry point of `sliceit`: parses the command line and turns bad input into a message."""

import argparse
import os
import sys
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

__all__ = ["main"]

COMMANDS = (
    simulate,
    export,
    emulate,
    hardware,
    collect,
    diagram,
    record,
    records,
    calibrate,
    diagnose,
    optimize_motion,
    train,
    evaluate,
    study,
    score,
)
BAD_INPUT = 2
INTERRUPTED = 130


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole program."""
    parser = argparse.ArgumentParser(
        prog="sliceit",
        description="Simulate a robot that slices food, in Drake.",
        epilog="`sliceit COMMAND --help` explains a command. SI units everywhere.",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
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
