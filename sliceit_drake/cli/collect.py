"""`sliceit collect`: cut the slices of a protocol on a station, and write their records."""

import argparse
import copy
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.hardware import (
    add_robot_arguments,
    is_loopback,
    move_confirmed,
    robot_config,
    run_confirmed,
    touch_confirmed,
)
from sliceit_drake.cli.scenario_argument import add_protocol_argument, protocol_file
from sliceit_drake.output_folder import check_folder

if TYPE_CHECKING:
    from sliceit_drake.diagrams.run import Run
    from sliceit_drake.diagrams.scenario import Scenario
    from sliceit_drake.hardware.hardware_config import HardwareConfig
    from sliceit_drake.stand_in.protocol import Specimen

__all__ = ["add_parser"]

STATION = "scenarios/cucumber.yaml"
PREPARATION = 120.0
"""Wall time that an emulator may take to prepare a food, s."""

DESCRIPTION = """\
Cut the slices of a protocol, in random order, with the arm under compliance control, and write a
record of each: constant speeds, holds, withdrawals, air, replicates, as the protocol says
(calibration/protocols; `sliceit record --help`).

Without --host the station is simulated: arm, controller, sensor and finite elements, each slice's
material deviating as the protocol's `variation` says. With --host it is a UR5e: before each slice
you are told what to put under the knife, and asked for the word that moves the robot, as by
`sliceit hardware`. With --move-to-start, which most protocols need from the second slice on, the
knife goes to the slice's start first, after the word "move", so that the food can be put there.
With --touch the bare knife finds the board's height once, before the first of the slices.

--emulator-pendant PORT is for `sliceit emulate`: its food is renewed before each slice through that
port (30099), deviating as in the simulated station. The words are asked for nevertheless.

The records are what the wrist sensor and the joints show, so they hold the tool's inertia and what
the sensor adds, which those of `sliceit record` (prescribed motions, no arm) do not.

Writes slice_000.csv, slice_000.yaml, ... to DIR, and on a robot a folder of outputs for each. What
is there already is not cut again: start the command once more to go on.

Examples
  sliceit collect calibration/protocols/poor.yaml --output records/arm
  sliceit collect --host 192.168.1.10 --robot my_ur5e.yaml --move-to-start --output records/real
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
    parser.add_argument(
        "--touch", action="store_true", help="find the board's height before the first slice"
    )
    parser.add_argument(
        "--emulator-pendant",
        type=int,
        metavar="PORT",
        help="of the emulator at --host, to put fresh food there before each slice",
    )
    parser.set_defaults(run=_run, resumes=True)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    import numpy as np

    logging.getLogger("drake").setLevel(logging.WARNING)

    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.stand_in.protocol import load_protocol, schedule
    from sliceit_drake.stand_in.session import is_recorded
    from sliceit_drake.stand_in.station_cuts import scenario_of_cut

    config = _checked_config(options)
    protocol = load_protocol(str(protocol_file(options)))
    station = load_scenario(options.station)
    options.output = directory = options.output or Path("output") / protocol.name
    check_folder(directory, "--output")
    specimens = schedule(protocol, np.random.default_rng([options.seed, 0]))[: options.first]
    left = [specimen for specimen in specimens if not is_recorded(specimen, directory)]
    if config is not None and options.touch and left and not options.dry_run:
        scenario = scenario_of_cut(protocol, left[0], station)
        if not _touch(options, scenario, config):
            return 1
    for specimen in left:
        scenario = scenario_of_cut(protocol, specimen, station)
        print(f"Slice {specimen.index + 1} of {len(specimens)}: {specimen.condition.label}")
        if config is not None:
            made = _cut_on_robot(options, scenario, config, specimen, directory)
        else:
            made = _cut_simulated(scenario)
        if made is None:
            return 1
        if options.dry_run:
            return 0
        _write(made, specimen, directory, config is not None)
        if made.stopped:
            print(f"Stopped: {made.stopped}. Its record is kept. Start again to go on.")
            return 1
    print(f"{len(specimens)} records in {directory}/")
    return 0


def _cut_simulated(scenario: "Scenario") -> "Run":
    from sliceit_drake.diagrams.run import prepare_run

    made = prepare_run(scenario)
    made.advance()
    return made


def _checked_config(options: argparse.Namespace) -> "HardwareConfig | None":
    """The robot's file; None without a robot.

    Raises:
        ConfigurationError: It is missing or wrong, or an option does not fit.
    """
    from sliceit_drake.configuration import ConfigurationError

    if options.emulator_pendant is not None and not is_loopback(options.host or ""):
        raise ConfigurationError(
            "is of an emulated controller on this machine",
            field="--emulator-pendant",
            fix="Give its address with --host; with a robot leave this out.",
        )
    if options.host:
        return robot_config(options)
    for name in ("touch", "move_to_start", "dry_run"):
        if getattr(options, name):
            raise ConfigurationError(
                "is for a robot",
                field=f"--{name.replace('_', '-')}",
                fix="Give its address with --host, or leave this out.",
            )
    return None


def _touch(options: argparse.Namespace, scenario: "Scenario", config: "HardwareConfig") -> bool:
    """Finds the board's height on the bare board; `config` then has it."""
    from sliceit_drake.systems.analytic_cutter import AnalyticFood

    if options.move_to_start and not move_confirmed(options, copy.deepcopy(scenario), config):
        return False
    print("First the knife looks for the board. Take everything off it. Stand back.")
    if options.emulator_pendant is not None:
        bare = copy.deepcopy(scenario)
        bare.food = AnalyticFood(toughness=0.0)
        _put_fresh_food(options, bare)
    return touch_confirmed(options, scenario, config)


def _cut_on_robot(
    options: argparse.Namespace,
    scenario: "Scenario",
    config: "HardwareConfig",
    specimen: "Specimen",
    directory: Path,
) -> "Run | None":
    """The run; None if the robot was not ready or the operator did not confirm."""
    from sliceit_drake.records.metadata import slice_name

    # Away from the last slice, before somebody reaches there.
    if options.move_to_start and not options.dry_run:
        if not move_confirmed(options, copy.deepcopy(scenario), config):
            return None
    condition = specimen.condition
    what = "nothing, the bare board" if condition.without_food else "a fresh piece of food"
    extra = [" peeled"] * condition.peeled
    extra += [f" scaled by {condition.width_scale:g} in width"] * (condition.width_scale != 1.0)
    extra += [f" with {condition.weight:g} kg hung on the knife"] * (condition.weight > 0.0)
    print(f"Put under the knife: {what}{','.join(extra)}. Stand back.")
    if options.emulator_pendant is not None and not options.dry_run:
        _put_fresh_food(options, scenario)
    there = argparse.Namespace(**vars(options) | {"move_to_start": False, "touch": False})
    return run_confirmed(there, scenario, config, directory / slice_name(specimen.index))


def _put_fresh_food(options: argparse.Namespace, scenario: "Scenario") -> None:
    """Renews the food under the knife of an emulated robot.

    Raises:
        ConfigurationError: No emulator answers there, or it refuses.
    """
    from sliceit_drake.configuration import ConfigurationError, dump_yaml
    from sliceit_drake.emulator.process import EmulatorError, PendantClient

    port = options.emulator_pendant
    try:
        pendant = PendantClient(options.host, PREPARATION, port)
        try:
            pendant.put_fresh_food(dump_yaml(scenario))
        finally:
            pendant.close()
    except (OSError, EmulatorError) as error:
        raise ConfigurationError(
            f"{options.host}:{port} puts no fresh food there: {error}",
            field="--emulator-pendant",
            fix="Give the own port of a running `sliceit emulate`, 30099.",
        ) from error
    print("The emulator has put it there.")


def _write(made: "Run", specimen: "Specimen", directory: Path, is_real: bool) -> None:
    from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
    from sliceit_drake.records.metadata import slice_name
    from sliceit_drake.records.slice_record import write_record

    provenance = "UR5e through RTDE." if is_real else "Simulated station, sliceit collect."
    record = slice_record_of(
        made, provenance, index=specimen.index, condition=specimen.condition.label
    )
    # A slice that ended early does not count as cut.
    name = slice_name(specimen.index) + ("_stopped" if made.stopped else "")
    write_record(record, directory / name)
