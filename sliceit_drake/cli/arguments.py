"""The arguments that several commands share: a scenario, a protocol, a Dask cluster."""

import argparse
import math
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliceit_drake.cluster import connected
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.resources import file_or_resource, named_yaml, shipped_names

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = [
    "DIAGNOSIS_REFINEMENT",
    "ONE_CUT",
    "SEEDS",
    "WORKERS",
    "add_cluster_arguments",
    "add_output_folder",
    "add_overrides",
    "add_protocol_argument",
    "add_scenario_arguments",
    "check_name",
    "check_numbers",
    "cluster_of",
    "find_file",
    "output_of",
    "output_path",
    "protocol_file",
    "scenario_of",
]

SCENARIO = "scenarios/cucumber.yaml"
"""What is simulated where nothing else is said."""
ONE_CUT = "scenarios/cucumber_measured.yaml"
"""A station that cuts once."""
PROTOCOL = "calibration/protocols/rich.yaml"
DASK = "dask"
SEEDS = (0, math.inf)
DIAGNOSIS_REFINEMENT = 0.75
"""Elements along an edge for changes of the force, relative to the food's mesh."""
WORKERS = (1, 10_000)


def add_scenario_arguments(parser: argparse.ArgumentParser, default: str = SCENARIO) -> None:
    """Adds SCENARIO and --set."""
    shipped = ", ".join(shipped_names("scenarios"))
    parser.add_argument(
        "scenario",
        nargs="?",
        default=default,
        metavar="SCENARIO",
        help=f"YAML file, or the name of one that ships with the package: {shipped}; default "
        f"{default}",
    )
    add_overrides(parser, "--set", "food.material.toughness=400")


def add_overrides(parser: argparse.ArgumentParser, option: str, example: str) -> None:
    """Adds an option that replaces fields of a file; `example` is of a path, for the help."""
    path, _, value = example.partition("=")
    names = path.split(".")
    as_yaml = "".join(f"{{{name}: " for name in names) + value + "}" * len(names)
    parser.add_argument(
        option,
        metavar="FIELD=VALUE",
        action="append",
        help=f"what replaces fields of the file: {example}, several separated by commas; or as "
        f"YAML, '{as_yaml}'; may be given again",
    )


def scenario_of(options: argparse.Namespace) -> "Scenario":
    """Loads the scenario that the options name; refused where it is missing or invalid."""
    from sliceit_drake.diagrams.scenario import load_scenario

    return load_scenario(options.scenario, options.set)


def add_output_folder(
    parser: argparse.ArgumentParser, text: str, *, required: bool = False
) -> None:
    """Adds --output DIR, a folder, which a file of that name refuses; `text` is for the help."""
    parser.add_argument("--output", metavar="DIR", type=output_path, required=required, help=text)
    parser.set_defaults(output_is_folder=True)


def output_path(text: str) -> Path:
    """The path of --output; an empty one, as of a variable that is not set, is refused."""
    if not text:
        raise argparse.ArgumentTypeError("is empty: give a path, or leave it out")
    return Path(os.path.expanduser(text))


def add_protocol_argument(parser: argparse.ArgumentParser, kind: str = "a protocol") -> None:
    """Adds PROTOCOL; `kind` is what it may be, for the help."""
    parser.add_argument(
        "protocol",
        nargs="?",
        default=PROTOCOL,
        metavar="PROTOCOL",
        help=f"YAML of {kind}, or the name of one that ships; default {PROTOCOL}",
    )


def protocol_file(options: argparse.Namespace) -> Path:
    """The file that PROTOCOL names; refused where there is none."""
    return find_file(options.protocol, "protocol", PROTOCOL)


def find_file(name: str, kind: str, example: str) -> Path:
    """The file that a user names: where they are, or one that ships, by its path or its name.

    Raises:
        ConfigurationError: There is no such `kind` of file; `example` is one that ships.
    """
    folder = str(Path(example).parent)
    file = file_or_resource(name) or named_yaml(name, folder)
    if file is None or not file.is_file():
        shipped = ", ".join(shipped_names(folder))
        raise ConfigurationError(
            f"there is no such {kind}, neither here nor in the package",
            source=name,
            fix=f"Give a YAML file, or one of {shipped}; {example} is one to start from.",
        )
    return file


def check_numbers(options: argparse.Namespace, **ranges: tuple[float, float]) -> None:
    """Refuses numbers of options that are out of their range; None is not given.

    Args:
        options: Of a command.
        ranges: Least and greatest value, by the option's name in `options`.

    Raises:
        ConfigurationError: Naming option and range.
    """
    for name, (least, most) in ranges.items():
        values = getattr(options, name)
        for value in values if isinstance(values, list) else [values]:
            if value is not None and not least <= value <= most:
                span = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
                field = f"--{name.replace('_', '-')}"
                raise ConfigurationError(f"is {value:g}", field=field, fix=f"Give {span}.")


def output_of(options: argparse.Namespace, name: str, suffix: str = "") -> Path:
    """The folder of --output, or else one in output/ of a name, such as a scenario's.

    Raises:
        ConfigurationError: The name is none that a folder can have.
    """
    if options.output is not None:
        return options.output
    check_name(name, "the folder of the results", "Give --output, or a name")
    return Path("output") / f"{name}{suffix}"


def check_name(name: str, what: str, fix: str) -> None:
    """Refuses a name that leads to another folder, or that none can have.

    Args:
        name: As a file has it.
        what: What it would be the name of.
        fix: What to do; words about the name follow.

    Raises:
        ConfigurationError: It has a slash or what cannot be printed, is empty, or is dots alone.
    """
    if name in ("", ".", "..") or Path(name).name != name or not name.isprintable():
        raise ConfigurationError(
            f"{name!r} is no name for {what}",
            field="name",
            fix=f"{fix} of letters and digits, such as cucumber_2.",
        )


def add_cluster_arguments(parser: argparse.ArgumentParser, here: str, work: str) -> None:
    """Adds --backend and --scheduler.

    Args:
        parser: Parser of the command.
        here: What the work is done by without a cluster: "threads" or "processes".
        work: What is spread, as "slices are simulated".
    """
    parser.add_argument(
        "--backend",
        choices=(here, DASK),
        default=here,
        help=f"where {work}: {here} of this machine (the default), or the workers of a Dask"
        " cluster",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of the cluster, as tcp://192.168.0.5:8786"
    )


def cluster_of(
    options: argparse.Namespace, connect: Callable[[str], AbstractContextManager] = connected
) -> AbstractContextManager[Any]:
    """The cluster that the options name, for a with statement; None without one.

    Args:
        options: With those of `add_cluster_arguments`.
        connect: What makes it of the scheduler's address.

    Raises:
        ConfigurationError: One of the two options is given without the other.
    """
    if (options.backend == DASK) != (options.scheduler is not None):
        raise ConfigurationError(
            "is given without --backend dask" if options.scheduler else "is not given",
            field="--scheduler",
            fix="Give both: --backend dask --scheduler tcp://HOST:8786.",
        )
    return connect(options.scheduler) if options.backend == DASK else nullcontext()
