"""`sliceit collect`: cut the slices of a protocol on a station, and write their records."""

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.hardware import add_robot_arguments, robot_config, run_confirmed
from sliceit_drake.cli.scenario_argument import add_protocol_argument, find_file, protocol_file

if TYPE_CHECKING:
    from sliceit_drake.diagrams.run import Run
    from sliceit_drake.diagrams.scenario import Scenario
    from sliceit_drake.stand_in.protocol import Specimen

__all__ = ["add_parser"]

STATION = "scenarios/cucumber.yaml"

DESCRIPTION = """\
Cut the slices of a protocol, in random order, with the arm under compliance control, and write a
record of each: constant speeds, holds, withdrawals, air, replicates, as the protocol says
(calibration/protocols; `sliceit record --help`).

Without --host the station is simulated: arm, controller, sensor and finite elements, each slice's
material deviating as the protocol's `variation` says. With --host it is a UR5e: before each slice
you are told what to put under the knife, and asked for the word that moves the robot, as by
`sliceit hardware`.

The records are what the wrist sensor and the joints show, so they hold the tool's inertia and what
the sensor adds, which those of `sliceit record` (prescribed motions, no arm) do not.

Writes slice_000.csv, slice_000.yaml, ... to DIR, and on a robot a folder of outputs for each. What
is there already is not cut again: start the command once more to go on.

Examples
  sliceit collect calibration/protocols/poor.yaml --output records/arm
  sliceit collect --host 192.168.1.10 --robot my_ur5e.yaml --output records/real
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "collect",
        help="cut the slices of a protocol on a station, simulated or real, and record them",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_protocol_argument(parser)
    parser.add_argument(
        "--station",
        default=STATION,
        metavar="SCENARIO",
        help=f"whose robot, controller, sensor and numerics are used (default {STATION})",
    )
    add_robot_arguments(parser)
    parser.add_argument(
        "--output", metavar="DIR", type=Path, help="folder of the records; default output/NAME"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the order and the simulated variation (default 0)"
    )
    parser.add_argument("--first", type=int, metavar="N", help="only the first N slices")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    import numpy as np
    import warp

    warp.config.log_level = warp.LOG_ERROR
    logging.getLogger("drake").setLevel(logging.WARNING)

    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.stand_in.protocol import load_protocol, schedule
    from sliceit_drake.stand_in.session import is_recorded
    from sliceit_drake.stand_in.station_cuts import scenario_of_cut

    protocol = load_protocol(str(protocol_file(options)))
    station = load_scenario(find_file(options.station, "scenario", STATION))
    directory = options.output or Path("output") / protocol.name
    directory.mkdir(parents=True, exist_ok=True)
    specimens = schedule(protocol, np.random.default_rng([options.seed, 0]))[: options.first]
    for specimen in specimens:
        if is_recorded(specimen, directory):
            continue
        scenario = scenario_of_cut(protocol, specimen, station)
        print(f"Slice {specimen.index + 1} of {len(specimens)}: {specimen.condition.label}")
        if options.host:
            made = _cut_on_robot(options, scenario, specimen, directory)
        else:
            made = _cut_simulated(scenario)
        if made is None:
            return 1
        _write(made, specimen, directory, bool(options.host))
        if made.stopped:
            print(f"Stopped: {made.stopped}. Its record is kept. Start again to go on.")
            return 1
    print(f"{len(specimens)} records in {directory}/")
    return 0


def _cut_simulated(scenario: "Scenario") -> "Run":
    from sliceit_drake.diagrams.run import prepare_run, simulate

    made = prepare_run(scenario)
    simulate(made)
    return made


def _cut_on_robot(
    options: argparse.Namespace, scenario: "Scenario", specimen: "Specimen", directory: Path
) -> "Run | None":
    """The run; None if the robot was not ready or the operator did not confirm."""
    from sliceit_drake.records.metadata import slice_name

    condition = specimen.condition
    what = "nothing, the bare board" if condition.without_food else "a fresh piece of food"
    extra = [" peeled"] * condition.peeled
    extra += [f" scaled by {condition.width_scale:g} in width"] * (condition.width_scale != 1.0)
    extra += [f" with {condition.weight:g} kg hung on the knife"] * (condition.weight > 0.0)
    print(f"Put under the knife: {what}{','.join(extra)}. Stand back.")
    config = robot_config(options)
    return run_confirmed(options, scenario, config, directory / slice_name(specimen.index))


def _write(made: "Run", specimen: "Specimen", directory: Path, is_real: bool) -> None:
    from sliceit_drake.diagrams.run_record import slice_record_of
    from sliceit_drake.records.metadata import slice_name
    from sliceit_drake.records.slice_record import write_record

    provenance = "UR5e through RTDE." if is_real else "Simulated station, sliceit collect."
    record = slice_record_of(
        made, provenance, index=specimen.index, condition=specimen.condition.label
    )
    # A slice that ended early does not count as cut.
    name = slice_name(specimen.index) + ("_stopped" if made.stopped else "")
    write_record(record, directory / name)
