"""`sliceit study`: studies whose tables the documentation quotes."""

import argparse
import itertools
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

CONTROL = """\
How stiff a contact compliance control bears.

Computes the linear loop's limit over error scale x gain and servo lag, simulates the station on
both sides of it, and runs the station over the SliceIt! agent's whole box of gains on food and
board. Takes a few minutes. docs/control.md explains what comes out.
"""
LAGS = (0.0, 0.005, 0.02, 0.03, 0.05)
# Mode, servo lag [s] and error scale x gain of the station's runs.
CONTROL_CHECKS = (
    *(("compliance", 0.005, gain) for gain in (0.003, 0.025)),
    *(("compliance", 0.02, gain) for gain in (0.025, 0.1)),
    *(("compliance", 0.03, gain) for gain in (0.003, 0.1)),
    ("compliance", 0.05, 0.1),
    *(("parallel", 0.005, gain) for gain in (0.003, 0.02)),
    *(("parallel", 0.02, gain) for gain in (0.03, 0.06)),
    *(("parallel", 0.03, gain) for gain in (0.01, 0.1)),
    ("motion", 0.03, 200.0),
)
FACTORS = (0.01, 0.03, 0.1, 0.3, 1.0)
TRACKING = ((0.03, "ideal"), (0.005, "arm"), (0.03, "arm"), (0.03, "servo"))
BOX_FACTORS, INTERIOR = (0.1, 1.0), 8


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
    control = studies.add_parser(
        "control",
        help="stability of compliance control against contact stiffness",
        description=CONTROL,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    control.add_argument(
        "--output", metavar="FOLDER", type=Path, help="also write control.png and control.md there"
    )
    control.set_defaults(run=run_control)


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


def run_control(options: argparse.Namespace) -> int:
    """Runs the study of compliance control in contact."""
    import numpy as np
    from tqdm import tqdm

    from sliceit_drake.diagrams import control_study as study
    from sliceit_drake.diagrams.agent_gains import agent_box

    gains = np.geomspace(1e-4, 1.0, 33)
    cases = [(mode, lag) for mode in ("compliance", "parallel") for lag in LAGS]
    limits = {
        (mode, lag): study.stability_limits(mode, gains, lag) for mode, lag in tqdm(cases, "map")
    }
    checks = list(
        tqdm(study.check_on_station(CONTROL_CHECKS), "station", total=2 * len(CONTROL_CHECKS))
    )
    rows = [
        study.factor_row(factor, lag, tracking)
        for factor, (lag, tracking) in tqdm(list(itertools.product(FACTORS, TRACKING)), "factors")
    ]
    box = list(itertools.product(BOX_FACTORS, ("food", "board"), agent_box(INTERIOR)))
    runs = [
        study.run_in_contact(point, factor, contact)
        for factor, contact, point in tqdm(box, "agent's box")
    ]
    tables = [study.check_table(checks), study.factor_table(rows), study.box_table(runs)]
    text = "\n\n".join(tables) + "\n"
    print(text)
    if options.output is not None:
        study.plot_stability_map(gains, limits, checks, options.output / "control.png")
        (options.output / "control.md").write_text(text, encoding="utf-8")
    return 0
