"""The scenario argument that several commands share."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["add_scenario_arguments", "scenario_of"]

DEFAULT = "scenarios/cucumber.yaml"


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds SCENARIO and --set."""
    from sliceit_drake.resources import resource_path

    shipped = ", ".join(sorted(file.stem for file in resource_path("scenarios").glob("*.yaml")))
    parser.add_argument(
        "scenario",
        nargs="?",
        default=DEFAULT,
        metavar="SCENARIO",
        help=f"YAML file, or one that ships with the package, as {DEFAULT} (the default); there "
        f"are {shipped}",
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
    import warp

    # Its greeting and its regret that there is no GPU would stand between the user and the result.
    warp.config.log_level = warp.LOG_ERROR

    from sliceit_drake.configuration import ConfigurationError
    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.resources import resource_path

    file = Path(options.scenario)
    if not file.exists():
        try:
            file = resource_path(options.scenario)
        except (FileNotFoundError, ValueError):
            raise ConfigurationError(
                "there is no such scenario, neither here nor in the package",
                source=options.scenario,
                fix=f"Give a YAML file; {DEFAULT} is one to start from.",
            ) from None
    return load_scenario(file, options.set)
