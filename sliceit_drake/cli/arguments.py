"""The arguments that several commands share: a scenario, a protocol, a Dask cluster."""

import argparse
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliceit_drake.cluster import connected
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.resources import file_or_resource, shipped_names

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = [
    "ONE_CUT",
    "add_cluster_arguments",
    "add_output_folder",
    "add_overrides",
    "add_protocol_argument",
    "add_scenario_arguments",
    "cluster_of",
    "find_file",
    "protocol_file",
    "scenario_of",
]

SCENARIO = "scenarios/cucumber.yaml"
"""What is simulated where nothing else is said."""
ONE_CUT = "scenarios/cucumber_measured.yaml"
"""A station that cuts once."""
PROTOCOL = "calibration/protocols/rich.yaml"
DASK = "dask"


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds SCENARIO and --set."""
    shipped = ", ".join(shipped_names("scenarios"))
    parser.add_argument(
        "scenario",
        nargs="?",
        default=SCENARIO,
        metavar="SCENARIO",
        help=f"YAML file, or the name of one that ships with the package: {shipped}; default "
        f"{SCENARIO}",
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
    parser.add_argument("--output", metavar="DIR", type=Path, required=required, help=text)
    parser.set_defaults(output_is_folder=True)


def add_protocol_argument(parser: argparse.ArgumentParser, kind: str = "a protocol") -> None:
    """Adds PROTOCOL; `kind` is what it may be, for the help."""
    parser.add_argument(
        "protocol",
        nargs="?",
        default=PROTOCOL,
        metavar="PROTOCOL",
        help=f"YAML of {kind}; default {PROTOCOL}",
    )


def protocol_file(options: argparse.Namespace) -> Path:
    """The file that PROTOCOL names; refused where there is none."""
    return find_file(options.protocol, "protocol", PROTOCOL)


def find_file(name: str, kind: str, example: str) -> Path:
    """The file that a user names: where they are, or one that ships with the package.

    Raises:
        ConfigurationError: There is no such `kind` of file; `example` is one that ships.
    """
    file = file_or_resource(name)
    if file is None:
        raise ConfigurationError(
            f"there is no such {kind}, neither here nor in the package",
            source=name,
            fix=f"Give a YAML file; {example} is one to start from.",
        )
    return file


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
