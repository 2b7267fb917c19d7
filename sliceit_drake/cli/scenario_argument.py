"""The arguments that several commands share: a scenario, a protocol."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = [
    "add_protocol_argument",
    "add_scenario_arguments",
    "find_file",
    "here_or_shipped",
    "protocol_file",
    "scenario_of",
]

DEFAULT = "scenarios/cucumber.yaml"
PROTOCOL = "calibration/protocols/rich.yaml"


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds SCENARIO and --set."""
    from sliceit_drake.resources import resource_path

    shipped = ", ".join(sorted(file.stem for file in resource_path("scenarios").glob("*.yaml")))
    parser.add_argument(
        "scenario",
        nargs="?",
        default=DEFAULT,
        metavar="SCENARIO",
        help=f"YAML file, or the name of one that ships with the package: {shipped}; default "
        f"{DEFAULT}",
    )
    parser.add_argument(
        "--set",
        metavar="YAML",
        default=None,
        help="fields that replace those of the file, as '{food: {material: {toughness: 400}}}'",
    )


def scenario_of(options: argparse.Namespace) -> "Scenario":
    """Loads the scenario that the options name.

    Raises:
        ConfigurationError: It is missing or invalid.
    """
    from sliceit_drake.diagrams.scenario import load_scenario

    return load_scenario(options.scenario, options.set)


def add_protocol_argument(parser: argparse.ArgumentParser, kind: str = "a protocol") -> None:
    """Adds PROTOCOL.

    Args:
        parser: Parser of the command.
        kind: What it may be, for the help.
    """
    parser.add_argument(
        "protocol",
        nargs="?",
        default=PROTOCOL,
        metavar="PROTOCOL",
        help=f"YAML of {kind}; default {PROTOCOL}",
    )


def protocol_file(options: argparse.Namespace) -> Path:
    """The file that PROTOCOL names.

    Raises:
        ConfigurationError: There is none.
    """
    return find_file(options.protocol, "protocol", PROTOCOL)


def find_file(name: str, kind: str, example: str) -> Path:
    """The file that a user names: where they are, or one that ships with the package.

    Args:
        name: What they wrote.
        kind: What it is, for the error.
        example: One that ships, for the error.

    Raises:
        ConfigurationError: There is none.
    """
    from sliceit_drake.configuration import ConfigurationError

    file = here_or_shipped(Path(name))
    if file.exists():
        return file
    raise ConfigurationError(
        f"there is no such {kind}, neither here nor in the package",
        source=name,
        fix=f"Give a YAML file; {example} is one to start from.",
    )


def here_or_shipped(path: Path) -> Path:
    """A file or folder where the user is, or the one of that name that ships with the package.

    Args:
        path: What they wrote; it is returned as it is where neither is there.
    """
    from sliceit_drake.resources import resource_path

    if path.exists():
        return path
    try:
        return resource_path(path.as_posix())
    except (FileNotFoundError, ValueError):
        return path
