"""Record slices on a bench that stands in for a real one, on prescribed knife motions.

PROTOCOL lists what is cut: food, knife, board, sensor, and conditions with their motions and
replicates. Shipped are, in calibration/protocols,
  poor   one speed, push only, 6 slices
  rich   three speeds, holds, withdrawals, second passes, draws, air: 18 slices
  full   rich, and the bare board, a known weight, peeled and narrow food: 30 slices
A scenario as `sliceit simulate` takes it will do: its food, knife, board and motion, cut
--replicates times.

Writes NAME.csv and NAME.yaml for each slice to DIR. Slices differ as the protocol's `variation`
says, and the sensor adds noise, bias, drift and delay. A run that was stopped goes on if it is
started again with the same --seed. What is written tells neither world nor effects nor seed.

Worlds
  finite_elements   the finite elements, finer than a diagnosis uses, with effects beside them
  curves            measured curves with laws of speed, draw and board; no finite elements

Effects, as NAME, NAME:SIZE, FILE.py or FILE.py:SIZE; several --effect act together. A file holds a
class of your own: `sliceit_drake.stand_in.effect` shows one. --list-effects shows those there are.

Examples
  sliceit record --output records/null --seed 1
  sliceit record full --effect arm_compliance:5e-5 --output records/a
  sliceit record scenarios/cucumber_measured.yaml --replicates 6 --world curves --output records/b
  sliceit record --output records/c --seed 1 --backend dask --scheduler tcp://192.168.0.5:8786
The workers of a cluster need no shared disk, but a FILE.py of yours at its place on each of them.
"""

import argparse
import functools
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import (
    SEEDS,
    WORKERS,
    add_cluster_arguments,
    add_output_folder,
    add_protocol_argument,
    check_numbers,
    cluster_of,
    output_of,
    protocol_file,
)
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.output_folder import check_output
from sliceit_drake.resources import shipped_names

if TYPE_CHECKING:
    from sliceit_drake.stand_in.protocol import Protocol

__all__ = ["add_arguments", "run"]

PROTOCOLS = "calibration/protocols"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    add_protocol_argument(parser, "a protocol or a scenario")
    add_output_folder(parser, "folder of the records; default output/NAME")
    parser.add_argument(
        "--world", default="finite_elements", help="finite_elements (the default) or curves"
    )
    parser.add_argument(
        "--effect", metavar="NAME[:SIZE]", action="append", default=[], help="what is hidden"
    )
    parser.add_argument(
        "--list-effects", action="store_true", help="list the effects with their sizes, and end"
    )
    parser.add_argument(
        "--seed", type=int, help="makes a run repeatable; by default one that nobody knows"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    add_cluster_arguments(parser, "processes", "slices are cut")
    parser.add_argument(
        "--replicates", type=int, default=6, help="slices of a scenario's one cut (default 6)"
    )
    parser.add_argument(
        "--refinement", type=float, help="finite elements along an edge, against the food's mesh"
    )
    parser.add_argument("--time-step", type=float, metavar="S", help="their sub-step")


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    if options.list_effects:
        from sliceit_drake.stand_in.effect_registry import effects_as_markdown

        print(effects_as_markdown())
        return 0
    check_numbers(options, seed=SEEDS, workers=WORKERS, replicates=(1, 1000))
    protocol = _protocol(options)
    options.output = directory = output_of(options, protocol.name)
    check_output(directory)
    options.resumes = options.seed is not None

    from sliceit_drake.configuration import validate
    from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
    from sliceit_drake.stand_in.session import record_session

    given = {name: getattr(options, name) for name in ("refinement", "time_step")}
    settings = FiniteElementSettings(**{k: v for k, v in given.items() if v is not None})
    validate(settings, "settings")
    with cluster_of(options) as client, StageBars(unit="slice") as bars:
        files = record_session(
            protocol,
            directory,
            options.effect,
            options.world,
            options.seed,
            options.workers,
            settings,
            functools.partial(bars.show, protocol.name),
            client,
        )
    print(f"{len(files)} records in {directory}/")
    return 0


def _protocol(options: argparse.Namespace) -> "Protocol":
    from sliceit_drake.cutting.foods.effects import Effects
    from sliceit_drake.cutting.foods.food import Food
    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.diagrams.scenario_file import scenario_file, top_fields
    from sliceit_drake.stand_in.protocol import load_protocol, protocol_of_scenario

    protocols = shipped_names(PROTOCOLS)
    try:
        is_shipped = options.protocol in protocols
        file = protocol_file(options) if is_shipped else scenario_file(options.protocol)
    except ConfigurationError as error:
        fix = f"{error.fix} Or give a protocol: {', '.join(protocols)}, or a file of yours."
        raise ConfigurationError(error.problem, source=error.source, fix=fix) from None
    if "conditions" in top_fields(file):
        return load_protocol(str(file))
    scenario = load_scenario(file)
    if isinstance(scenario.food, Food) and scenario.food.effects != Effects():
        print("The food's effects are left out: this world has its own, named by --effect")
    return protocol_of_scenario(scenario, options.replicates)
