"""`sliceit study`: studies whose tables the documentation quotes."""

import argparse
from pathlib import Path

from sliceit_drake.cli.scenario_argument import add_scenario_arguments, scenario_of

__all__ = ["add_parser"]

COUPLING = """\
Run a scenario at several exchange periods and plant steps and print the difference from the finest.

Force and path errors are RMS while the food is cut; the path's is relative to the tracking error.
"""
# Exchange period and plant step, s; the last is the reference.
COMBINATIONS = ((4e-3, 1e-3), (2e-3, 1e-3), (1e-3, 1e-3), (5e-4, 5e-4), (2.5e-4, 2.5e-4))

SERVO = """\
Move the arm by a ramp and by a step for several parameters of servoj and print lag and overshoot.
"""
LOOKAHEAD_TIMES, GAINS = (0.03, 0.1, 0.2), (100.0, 300.0, 2000.0)


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser("study", help="run a study of the simulation itself")
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    coupling = studies.add_parser(
        "coupling",
        help="error against exchange period and plant step",
        description=COUPLING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario_arguments(coupling)
    coupling.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")
    coupling.set_defaults(run=run_coupling)
    servo = studies.add_parser(
        "servo",
        help="lag and step response of the arm against servoj's parameters",
        description=SERVO,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    servo.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")
    servo.set_defaults(run=run_servo)


def run_coupling(options: argparse.Namespace) -> int:
    """Runs the study of the coupling."""
    scenario = scenario_of(options)

    from tqdm import tqdm

    from sliceit_drake.diagrams.coupling_study import coupling_study, coupling_table

    with tqdm(total=len(COMBINATIONS), desc="runs") as bar:
        cases = coupling_study(scenario, COMBINATIONS, lambda done, _: bar.update(done - bar.n))
    table = coupling_table(cases)
    print(table)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(table + "\n", encoding="utf-8")
    return 0


def run_servo(options: argparse.Namespace) -> int:
    """Runs the study of the servo."""
    from tqdm import tqdm

    from sliceit_drake.diagrams.servo_study import servo_study, servo_table
    from sliceit_drake.systems.servo import ServoConfig

    configs = [
        ServoConfig(lookahead_time=time, gain=gain) for time in LOOKAHEAD_TIMES for gain in GAINS
    ]
    with tqdm(total=2 * len(configs), desc="runs") as bar:
        cases = servo_study(configs, lambda done, _: bar.update(done - bar.n))
    table = servo_table(cases)
    print(table)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(table + "\n", encoding="utf-8")
    return 0
