"""`python -m studies`: studies whose tables the documentation quotes."""

import argparse
import dataclasses as dc
import itertools
from pathlib import Path

from sliceit_drake.cli.scenario_argument import add_scenario_arguments, scenario_of
from studies.commands.calibration import add_calibration_study
from studies.commands.coverage import add_coverage
from studies.commands.disect import add_disect_study
from studies.commands.hidden import add_hidden_study
from studies.commands.identifiability import add_identifiability
from studies.commands.random import add_random_study
from studies.commands.real import add_real_study
from studies.commands.slicing import add_slicing
from studies.commands.verification import add_verification

__all__ = ["add_studies"]

COUPLING = """\
Run a scenario at several exchange periods and plant steps and print the difference from the finest.

Force and path errors are RMS while the food is cut; the path's is relative to the tracking error.
"""
# Exchange period and plant step, s; the last is the reference.
COMBINATIONS = (
    (4e-3, 1e-3),
    (2e-3, 1e-3),
    (2e-3, 2.5e-4),
    (1e-3, 1e-3),
    (5e-4, 5e-4),
    (2.5e-4, 2.5e-4),
)

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

STEPPING = """\
How far the force depends on the food's sub-step, and what the step costs.

Presses, draws and holds in three foods at two speeds with steps of 1e-5 to 1e-3 s: scaled masses
against true ones where the cut is fast, against the finest step where it is slow; then the cucumber
scenario in the station. Takes some minutes, --quick ten seconds. docs/stepping.md explains
what comes out.
"""
STEPPING_FOODS = ("cucumber", "potato_sequence", "tomato_sequence")
STATION_STEPS = (5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3)


def add_studies(studies: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the studies."""
    coupling = studies.add_parser(
        "coupling",
        help="error against exchange period and plant step",
        description=COUPLING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario_arguments(coupling)
    coupling.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")
    coupling.set_defaults(run=_run_coupling)
    servo = studies.add_parser(
        "servo",
        help="lag and step response of the arm against servoj's parameters",
        description=SERVO,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    servo.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")
    servo.set_defaults(run=_run_servo)
    control = studies.add_parser(
        "control",
        help="stability of compliance control against contact stiffness",
        description=CONTROL,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    control.add_argument(
        "--output", metavar="FOLDER", type=Path, help="also write control.png and control.md there"
    )
    control.set_defaults(run=_run_control)
    stepping = studies.add_parser(
        "stepping",
        help="error of the force against sub-step and cost",
        description=STEPPING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stepping.add_argument(
        "--output",
        metavar="FOLDER",
        type=Path,
        help="also write stepping.md, stepping.csv and stepping.png there",
    )
    stepping.add_argument(
        "--quick",
        action="store_true",
        help="cucumber at 100 mm/s against scaled masses at 1e-4 s, without the station",
    )
    stepping.add_argument(
        "--coarse",
        action="store_true",
        help="steps from 5e-5 s against scaled masses at that step, a sixth of the time",
    )
    stepping.set_defaults(run=_run_stepping)
    add_verification(studies)
    add_coverage(studies)
    add_slicing(studies)
    add_random_study(studies)
    add_calibration_study(studies)
    add_identifiability(studies)
    add_real_study(studies)
    add_hidden_study(studies)
    add_disect_study(studies)


def _run_coupling(options: argparse.Namespace) -> int:
    """Runs the study of the coupling."""
    scenario = scenario_of(options)

    from tqdm import tqdm

    from studies.robot.coupling import coupling_study, coupling_table

    with tqdm(total=len(COMBINATIONS), desc="runs") as bar:
        cases = coupling_study(scenario, COMBINATIONS, lambda done, _: bar.update(done - bar.n))
    table = coupling_table(cases)
    print(table)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(table + "\n", encoding="utf-8")
    return 0


def _run_servo(options: argparse.Namespace) -> int:
    """Runs the study of the servo."""
    from tqdm import tqdm

    from sliceit_drake.systems.servo import ServoConfig
    from studies.robot.servo import servo_study, servo_table

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


def _run_control(options: argparse.Namespace) -> int:
    """Runs the study of compliance control in contact."""
    import numpy as np
    from tqdm import tqdm

    from sliceit_drake.diagrams.agent_gains import agent_box
    from studies.robot import control as study

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


def _run_stepping(options: argparse.Namespace) -> int:
    """Runs the study of the sub-step."""
    from collections.abc import Callable

    from tqdm import tqdm

    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.resources import resource_path
    from studies.physics import stepping as study
    from studies.physics import stepping_report as report

    def progress(bar: "tqdm[None]") -> Callable[[float], None]:
        return lambda share: (bar.update(100.0 * share - bar.n), None)[1]

    def bar(name: str) -> "tqdm[None]":
        return tqdm(total=100.0, desc=name, bar_format="{l_bar}{bar}| {elapsed}<{remaining}")

    scenarios = [
        load_scenario(resource_path(f"scenarios/{name}.yaml"))
        for name in (STEPPING_FOODS[:1] if options.quick else STEPPING_FOODS)
    ]
    foods = [report.sliced_food(scenario) for scenario in scenarios]
    steps = study.STEPS[3 if options.quick else 2 if options.coarse else 0 :]
    cases = study.stepping_cases(foods, (0.1,) if options.quick else (0.02, 0.1))
    if options.quick or options.coarse:
        cases = [dc.replace(case, true_masses=False) for case in cases]
    with bar("cuts") as running:
        results = study.stepping_study(cases, steps, progress=progress(running))
    with bar("costs") as running:
        costs = study.step_costs(foods, steps, progress=progress(running))
    tables = [
        study.error_table(results),
        study.largest_table(results),
        study.inertia_table(results),
        study.hold_table(results),
        study.mass_table(results),
        study.cost_table(costs),
    ]
    if not options.quick:
        cut = scenarios[0]
        stations = []
        for name, scenario in (
            (cut.name, cut),
            (f"{cut.name}, held half way", report.held_half_way(cut)),
        ):
            with bar(f"station, {name}") as running:
                stations.append(
                    (name, report.station_steps(scenario, STATION_STEPS, progress(running)))
                )
        tables.append(report.station_table(stations))
    text = "\n\n".join(tables) + "\n"
    print(text)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "stepping.md").write_text(text, encoding="utf-8")
        report.write_stepping(results, costs, options.output / "stepping.csv")
        report.plot_stepping(results, costs, options.output / "stepping.png")
    return 0
