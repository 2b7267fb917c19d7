"""How far the force depends on the food's sub-step, and what the step costs.

Presses, draws and holds in three foods at two speeds with steps of 1e-5 to 1e-3 s: scaled masses
against true ones where the cut is fast, against the finest step where it is slow; then the cucumber
scenario in the station. Takes some minutes, --quick ten seconds. docs/results/stepping.md explains
what comes out.
"""

import argparse
import copy
import csv
import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.resources import resource_path
from studies.figures import BLUE, GREEN, ORANGE, PURPLE, RED, new_figure, save_figure
from studies.pages import publish, table
from studies.physics import stepping as study
from studies.physics.stepping import StepCost, StepResult

__all__ = [
    "StationStep",
    "add_arguments",
    "held_half_way",
    "plot_stepping",
    "run",
    "sliced_food",
    "station_steps",
    "station_table",
    "write_stepping",
]


FOODS = ("cucumber_measured", "potato_sequence", "tomato_sequence")
STATION_STEPS = (5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output",
        metavar="FOLDER",
        type=Path,
        help="also write stepping.md, stepping.csv and stepping.png there",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="cucumber at 100 mm/s against scaled masses at 1e-4 s, without the station",
    )
    parser.add_argument(
        "--coarse",
        action="store_true",
        help="steps from 5e-5 s against scaled masses at that step, a sixth of the time",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenarios = [
        load_scenario(resource_path(f"scenarios/{name}.yaml"))
        for name in (FOODS[:1] if options.quick else FOODS)
    ]
    foods = [sliced_food(scenario) for scenario in scenarios]
    steps = study.STEPS[3 if options.quick else 2 if options.coarse else 0 :]
    cases = study.stepping_cases(foods, (0.1,) if options.quick else (0.02, 0.1))
    if options.quick or options.coarse:
        cases = [dc.replace(case, true_masses=False) for case in cases]
    with _bar("cuts") as bar:
        results = study.stepping_study(cases, steps, progress=_mover(bar))
    with _bar("costs") as bar:
        costs = study.step_costs(foods, steps, progress=_mover(bar))
    tables = [
        study.error_table(results),
        study.largest_table(results),
        study.inertia_table(results),
        study.hold_table(results),
        study.mass_table(results),
        study.cost_table(costs),
    ]
    stations: list[tuple[str, list[StationStep]]] = []
    if not options.quick:
        cut = scenarios[0]
        for name, scenario in (
            (cut.name, cut),
            (f"{cut.name}, held half way", held_half_way(cut)),
        ):
            with _bar(f"station, {name}") as bar:
                stations.append((name, station_steps(scenario, STATION_STEPS, _mover(bar))))
        tables.append(station_table(stations))
    folder = options.output
    measured = {"costs": costs, "stations": dict(stations)}
    publish("\n\n".join(tables), folder and folder / "stepping.md", measured)
    if folder is not None:
        write_stepping(results, costs, folder / "stepping.csv")
        plot_stepping(results, costs, folder / "stepping.png")
    return 0


def _bar(name: str) -> "tqdm[None]":
    return tqdm(total=100.0, desc=name, bar_format="{l_bar}{bar}| {elapsed}<{remaining}")


def _mover(bar: "tqdm[None]") -> Callable[[float], None]:
    return lambda share: (bar.update(100.0 * share - bar.n), None)[1]


@dc.dataclass
class StationStep:
    """A scenario in the station at one sub-step of the food, compared with the finest.

    Attributes:
        time_step: s.
        force_error: RMS of the difference of the food's force over RMS of the force.
        largest_difference: Of the force in one coupling step over its peak.
        path_error: Largest distance between the knife's paths, metres.
        energy_ratio: Largest kinetic over internal energy of the food.
        real_time_factor: Simulated over wall time.
        stopped: Why the run broke off, or None; it is compared as far as it went.
    """

    time_step: float
    force_error: float
    largest_difference: float
    path_error: float
    energy_ratio: float
    real_time_factor: float
    stopped: str | None


def sliced_food(scenario: Scenario) -> tuple[Food, Knife, Numerics]:
    """What a scenario cuts: its food, or the middle one of its slices.

    Raises:
        ConfigurationError: The food is not one of finite elements.
    """
    food = scenario.food
    if not isinstance(food, Food):
        raise ConfigurationError(
            "has no finite elements", field="scenario.food", fix="Give a !Food."
        )
    if scenario.sequence is not None:
        food = scenario.sequence.foods(food)[scenario.sequence.count // 2]
    return food, scenario.knife, scenario.numerics


def held_half_way(scenario: Scenario) -> Scenario:
    """A copy of a scenario whose first segment, a straight one, stops and rests at 60 % of its way.

    Raises:
        ConfigurationError: The motion does not begin with a !ConstantSpeed over a distance.
    """
    scenario = copy.deepcopy(scenario)
    first, *rest = scenario.motion.segments
    if not isinstance(first, ConstantSpeed) or first.distance is None:
        raise ConfigurationError(
            "does not begin with a straight motion over a distance",
            field="scenario.motion.segments[0]",
            fix="Give a !ConstantSpeed with a distance.",
        )
    parts = [dc.replace(first, distance=share * first.distance) for share in (0.6, 0.4)]
    scenario.motion = MotionPlan([parts[0], Hold(0.3), parts[1], *rest])
    return scenario


def station_steps(
    scenario: Scenario, steps: Sequence[float], progress: Callable[[float], None] | None = None
) -> list[StationStep]:
    """Runs a scenario with the arm at several sub-steps.

    Args:
        scenario: A cut.
        steps: s, finest first: the reference.
        progress: Called after each run with the fraction of all sub-steps done.

    Raises:
        ConfigurationError: The reference broke off.
    """
    results: list[StationStep] = []
    share, work = 0.0, sum(1.0 / step for step in steps)
    for step in steps:
        case = copy.deepcopy(scenario)
        case.measurement = None
        case.numerics.time_step = step
        run = prepare_run(case)
        run.advance()
        if run.stopped and not results:
            raise ConfigurationError(
                f"the run with a step of {step:g} s, the reference, broke off: {run.stopped}",
                field="scenario",
                fix="Give a scenario that `sliceit simulate` runs to its end.",
            )
        record = run.record()
        force, path = record.vector("food_wrench_f"), record.vector("knife_pose_p")
        if not results:
            true_force, true_path = force, path
        done = len(force)
        difference = np.linalg.norm(force - true_force[:done], axis=1)
        norm = np.linalg.norm(true_force, axis=1)
        results.append(
            StationStep(
                time_step=step,
                force_error=float(np.linalg.norm(difference) / np.linalg.norm(norm[:done])),
                largest_difference=float(difference.max() / norm.max()),
                path_error=float(np.linalg.norm(path - true_path[:done], axis=1).max()),
                energy_ratio=float(record["energy_largest_energy_ratio"].max()),
                real_time_factor=float(record["time"][-1] / run.wall_time),
                stopped=run.stopped,
            )
        )
        share += 1.0 / step / work
        if progress is not None:
            progress(share)
    return results


def station_table(cases: Sequence[tuple[str, Sequence[StationStep]]]) -> str:
    """Results of `station_steps` by name as a table for people."""
    return table(
        "in the station | step [s] | RMS error [%] | largest difference [% of peak]"
        " | path error [um] | largest kinetic/internal energy [%] | x real time | ran to the end",
        (
            (name, f"{s.time_step:g}", f"{100 * s.force_error:.2f}")
            + (f"{100 * s.largest_difference:.1f}", f"{1e6 * s.path_error:.1f}")
            + (f"{100 * s.energy_ratio:.3f}", f"{s.real_time_factor:.2f}", s.stopped or "yes")
            for name, steps in cases
            for s in steps
        ),
    )


def write_stepping(results: Sequence[StepResult], costs: Sequence[StepCost], file: Path) -> None:
    """Writes a row for each run as CSV, SI units; a cost only where it was timed."""
    cost = {(c.food, c.time_step): c for c in costs}
    fields = (
        "time_step scaled reference refusal rms_error largest_difference peak energy_ratio "
        "mass_ratio force_drop creep"
    ).split()
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(
            ["case", *fields, "elements", "all_elements", "wall_per_simulated", "substep_wall"]
        )
        for r in results:
            timed = cost.get((r.case.food.name, r.time_step)) if r.scaled else None
            writer.writerow(
                [r.case.label]
                + [getattr(r, name) for name in fields]
                + list(r.elements)
                + ([timed.seconds, timed.substep] if timed else ["", ""])
            )


def plot_stepping(results: Sequence[StepResult], costs: Sequence[StepCost], file: Path) -> None:
    """Draws the error over the cost of a simulated second, a panel for each food, scaled masses."""
    from matplotlib.ticker import NullFormatter

    cost = {(c.food, c.time_step): c.seconds for c in costs}
    foods = list(dict.fromkeys(r.case.food.name for r in results))
    speeds = sorted({r.case.press_speed for r in results})
    # Okabe and Ito's palette by motion, marker and line by speed.
    colours = {"press": BLUE, "press and retract": ORANGE, "draw": GREEN}
    colours |= {"hold after a sudden stop": RED, "hold after a ramp": PURPLE}
    styles = dict(zip(speeds, (("--", "o"), ("-", "s")), strict=False))
    figure = new_figure(4.0 * len(foods), 4.6)
    panels = figure.subplots(1, len(foods), sharey=True, squeeze=False)[0]
    for axes, food in zip(panels, foods, strict=True):
        of_food = [r for r in results if r.case.food.name == food and r.scaled]
        cases = list({id(r.case): r.case for r in of_food}.values())
        for case in cases:
            shown = [r for r in of_food if r.case is case and r.rms_error > 0.0]
            x = [cost[food, r.time_step] for r in shown]
            y = [100.0 * r.rms_error for r in shown]
            colour = colours[case.motion_name]
            line, marker = styles[case.press_speed]
            label = f"{case.motion_name}, {1e3 * case.press_speed:g} mm/s"
            axes.loglog(x, y, line, color=colour, lw=1.2)
            for r, a, b in zip(shown, x, y, strict=True):
                inside = "white" if r.too_much_inertia else colour
                axes.plot(a, b, marker, color=colour, mfc=inside, ms=5)
            axes.plot([], [], line, marker=marker, color=colour, label=label)
        axes.axhline(2.0, color="0.3", lw=1.0, ls=":")
        axes.text(0.02, 2.1, "2 %", transform=axes.get_yaxis_transform(), fontsize=8)
        for step in sorted({r.time_step for r in of_food if r.rms_error > 0.0}):
            axes.annotate(
                f"{step:g} s",
                (cost[food, step], 0.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, 4),
                textcoords="offset points",
                rotation=90,
                ha="center",
                va="bottom",
                fontsize=7,
                color="0.35",
            )
        axes.set_title(food)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(bottom=1e-3)
        axes.set_xlabel("wall time per simulated second [s]")
        axes.grid(alpha=0.25, which="major")
    panels[0].set_ylabel("RMS error of the force [%]")
    figure.suptitle(
        "Error of the force against cost, scaled masses; hollow: kinetic energy over 5 %, refused"
    )
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    save_figure(figure, file, 150)
