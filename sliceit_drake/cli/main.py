"""Entry point of `sliceit`: parses the command line and turns bad input into a message."""

import argparse
import contextlib
import difflib
import errno
import importlib
import importlib.metadata
import os
import re
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from sliceit_drake.interruption import handle_signals
from sliceit_drake.resources import shipped_names

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
        "doctor": "check this machine, and say what to install",
    },
}
"""What each command does, by group. A command is a module of this package with `add_arguments` and
`run`, which returns the exit status; its docstring is the text of `--help`."""

PROGRAM = "sliceit"
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


class _Parser(argparse.ArgumentParser):
    """A parser that says which name is meant where one is not known."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._known_options: list[str] = []
        super().__init__(*args, **settings)

    def add_argument(self, *args: Any, **settings: Any) -> argparse.Action:
        """Also remembers the option's names."""
        action = super().add_argument(*args, **settings)
        self._known_options += action.option_strings
        return action

    def error(self, message: str) -> NoReturn:
        """Ends the program with usage and message, and what may be meant."""
        if choice := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            given, names = choice[1], re.split(", ", choice[2].replace("'", ""))
        elif unknown := re.search(r"unrecognized arguments: (\S+)", message):
            given, names = unknown[1].split("=")[0], self._known_options
        else:
            given, names = "", []
        if self.prog == PROGRAM and (
            given in shipped_names("scenarios") or given.endswith((".yaml", ".yml"))
        ):
            message = f'{message}. Did you mean "{PROGRAM} simulate {given}"?'
        elif close := difflib.get_close_matches(given, names, n=1):
            message = f'{message}. Did you mean "{close[0]}"?'
        super().error(message)


class _Output:
    """Standard output that outlives its reader: results are written though `head` has left."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Writes text, to nowhere once nobody reads."""
        with self._for_nobody():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Passes on what was written."""
        with self._for_nobody():
            self._stream.flush()

    @contextlib.contextmanager
    def _for_nobody(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())


class _Versions(argparse.Action):
    """Prints the versions of the package and of what it stands on, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        for name in ("sliceit_drake", "drake", "warp-lang", "numpy"):
            print(f"{name} {importlib.metadata.version(name)}")
        parser.exit()


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole program."""
    parser = _Parser(
        prog=PROGRAM,
        usage="sliceit [-h] [--version] [--verbose] COMMAND ...",
        description="Simulate a robot that slices food, in Drake.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action=_Versions, nargs=0, help="versions of it and of Drake, Warp and NumPy"
    )
    parser.add_argument("--verbose", action="store_true", help="let Warp say what it compiles")
    commands = parser.add_subparsers(
        prog=PROGRAM, metavar="COMMAND", required=True, help=argparse.SUPPRESS
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
            command_parser.set_defaults(run=command.run, parser=command_parser)
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
    try:
        return run_program(make_parser(), arguments)
    except KeyboardInterrupt:
        return _interrupted(PROGRAM)


def run_program(parser: argparse.ArgumentParser, arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and runs the command; bad input becomes a message.

    Args and Returns: as `main`.
    """
    # The arrays are small; threads of the linear algebra library would only wait beside the run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        hint = ". Write FIELD=VALUE without spaces" if "=" in vars(options).values() else ""
        # The command's own parser shows its usage.
        command = getattr(options, "parser", parser)
        command.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    # `nohup` has one ignored, for a reason.
    ending = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.SIG_DFL
    ]
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")
    # With a robot a reader that leaves ends the motion.
    survives = sys.stdout is not None and not getattr(options, "host", None)
    output: Any = _Output(sys.stdout) if survives else sys.stdout
    try:
        with (
            contextlib.redirect_stdout(output),
            handle_signals(ending, signal.default_int_handler),
        ):
            from sliceit_drake.cutting.warp_start import VERBOSE
            from sliceit_drake.output_folder import check_output

            if getattr(options, "verbose", False):
                os.environ[VERBOSE] = "1"
            if isinstance(getattr(options, "output", None), Path):
                is_folder = getattr(options, "output_is_folder", False)
                check_output(options.output, is_folder=is_folder)
            status = options.run(options)
            if output is not None:
                output.flush()
            return status
    except KeyboardInterrupt:
        return _interrupted(parser.prog, options)
    except Exception as error:
        if _is_interrupt(error):
            return _interrupted(parser.prog, options)
        if isinstance(error, OSError) and error.errno in REFUSED:
            print(f"{parser.prog}: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        elif _is_bad_input(error):
            print(f"{parser.prog}: {error}", file=sys.stderr)
        else:
            raise
        return BAD_INPUT


def _interrupted(program: str, options: argparse.Namespace | None = None) -> int:
    """Says how to go on after Ctrl-C."""
    output = getattr(options, "output", None)
    if getattr(options, "resumes", False) and output is not None and output.exists():
        hint = f"What is done is in {output}; the same command goes on."
    else:
        hint = "The same command starts again."
    print(f"{program}: interrupted. {hint}", file=sys.stderr)
    return INTERRUPTED


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: compiled modules report it as a failed import."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


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
    from sliceit_drake.cli import ended

    sys.exit(ended(main()))
