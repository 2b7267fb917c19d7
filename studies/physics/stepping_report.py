"""How far the force depends on the food's sub-step, and what the step costs.

Presses, draws, turns and holds in five foods at 5 to 100 mm/s, with constant steps of 2e-5 to 2e-3
s and with steps by need: against true masses where the cut is fast, against the finest step where
it is slow; some with an effect that is sensitive to the step; then the station. Takes 5 to 40
minutes, --quick half a minute. docs/results/stepping.md explains what comes out.
"""

import argparse
import copy
import csv
import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.effects import Compliance, Effects, Relaxation, Skin
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.cutting_system import CuttingSystem
from studies.figures import BLUE, GREEN, ORANGE, RED, new_figure, save_figure
from studies.pages import publish, render_and_store, table
from studies.physics import stepping as study
from studies.physics.stepping import StepCost, SteppingCase, StepResult

__all__ = [
    "StationStep",
    "add_arguments",
    "effect_cases",
    "held_half_way",
    "plot_stepping",
    "run",
    "sliced_food",
    "station_steps",
    "station_table",
    "write_stepping",
]


FOODS = ("cucumber_measured", "potato_sequence", "tomato_sequence")
HELD_OUT = ("carrot_sequence", "apple")
"""Foods on which no constant of the rule was chosen."""
STATION_STEPS = (6.25e-5, 2.5e-4, 5e-4, 1e-3)
NOISE = (0.0, 2e-6, 5e-6, 1e-5)  # Of a measured path, metres.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output",
        metavar="FOLDER",
        type=Path,
        help="also write stepping.md, data, stepping.csv and figures/stepping.png there",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="cucumber at 100 mm/s against its step of 2.5e-4 s, without effects and station",
    )
    parser.add_argument(
        "--foods",
        metavar="SCENARIO",
        nargs="+",
        help="those of these scenarios alone, without effects and station (a minute each)",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenarios = [
        load_scenario(resource_path(f"scenarios/{name}.yaml"))
        for name in (options.foods or (FOODS[:1] if options.quick else FOODS))
    ]
    foods = [sliced_food(scenario) for scenario in scenarios]
    steps = study.STEPS[2 if options.quick else 0 :]
    few = options.quick or options.foods
    others = []
    for name in () if few else HELD_OUT:
        food, knife, numerics = sliced_food(load_scenario(resource_path(f"scenarios/{name}.yaml")))
        others.append((dc.replace(food, name=f"{food.name} (held out)"), knife, numerics))
    cases = study.stepping_cases(foods + others, (0.1,) if options.quick else (0.02, 0.1))
    if options.quick:
        cases = [dc.replace(case, true_masses=False) for case in cases]
    elif not few:
        cases += effect_cases(foods)
    with _bar("cuts") as bar:
        results = study.stepping_study(cases, steps, progress=_mover(bar))
    with _bar("costs") as bar:
        costs = study.step_costs(foods, steps, progress=_mover(bar))
    tables = {
        "errors": study.error_table(results),
        "largest": study.largest_table(results),
        "turned": study.turned_table(results),
        "need": study.need_table(results),
        "energies": study.inertia_table(results),
        "holds": study.hold_table(results),
        "costs": study.cost_table(costs),
    }
    folder = options.output
    page = folder and folder / "stepping.md"
    if few:
        publish("\n\n".join(tables.values()), page)
    else:
        tables["aims"] = study.aims_table(results, [food.name for food, *_ in foods + others])
        tables["slices"] = study.inertia_by_step_table(foods)
        stations = []
        policy = load_scenario(resource_path("scenarios/cucumber_policy.yaml"))
        cut = scenarios[0]
        for name, scenario in (
            (cut.name, cut),
            (f"{cut.name}, held half way", held_half_way(cut)),
            (policy.name, policy),
        ):
            with _bar(f"station, {name}") as bar:
                stations.append((name, station_steps(scenario, STATION_STEPS, _mover(bar))))
        tables["stations"] = station_table(stations)
        measured = {"costs": costs, "stations": dict(stations)}
        publish(render_and_store("stepping", page, tables, measured), page)
    if folder is not None:
        write_stepping(results, costs, folder / "stepping.csv")
        (folder / "figures").mkdir(exist_ok=True)
        plot_stepping(results, costs, folder / "figures" / "stepping.png")
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
        finer: Fraction of coupling steps with more than the fewest sub-steps, by amplitude of the
            white noise on a path that the rule is given, metres.
        energy_ratio: Largest kinetic over internal energy of the food.
        real_time_factor: Simulated over wall time.
        stopped: Why the run broke off, or None; it is compared as far as it went.
    """

    time_step: float
    force_error: float
    largest_difference: float
    path_error: float
    finer: dict[float, float]
    energy_ratio: float
    real_time_factor: float
    stopped: str | None


def effect_cases(foods: Sequence[tuple[Food, Knife, Numerics]]) -> list[SteppingCase]:
    """Cuts with effects that could be sensitive to the step.

    A cucumber that relaxes, one with a skin, and one under an arm that gives.
    """
    cucumber, knife, numerics = foods[0]
    relaxes = Effects(relaxation=Relaxation(shares=[0.3, 0.2], times=[0.02, 0.5]))
    gives = Effects(compliance=Compliance(arm=3e-5))
    skin = Effects(skin=Skin(toughness=0.3))
    relaxing = dc.replace(cucumber, name="cucumber that relaxes", effects=relaxes)
    under_arm = dc.replace(cucumber, name="cucumber, arm that gives", effects=gives)
    skinned = dc.replace(cucumber, name="cucumber with skin", effects=skin)
    hold = SteppingCase(relaxing, knife, numerics, press_speed=0.02, depth=0.4, hold=0.15)
    turn = SteppingCase(
        under_arm, knife, numerics, press_speed=0.1, depth=0.6, retract=study.RETRACT
    )
    press = SteppingCase(skinned, knife, numerics, press_speed=0.1)
    return [
        hold,
        dc.replace(hold, press_speed=0.1),
        dc.replace(turn, food=relaxing),
        dc.replace(press, press_speed=0.02),
        press,
        SteppingCase(under_arm, knife, numerics, press_speed=0.1),
        turn,
    ]


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
        scenario: A cut by hand-set motion or policy, of one slice.
        steps: Longest ones, s, finest first: the reference.
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
                finer=_finer(run.station.cutting, record),
                energy_ratio=float(record["energy_largest_energy_ratio"].max()),
                real_time_factor=float(record["time"][-1] / run.wall_time),
                stopped=run.stopped,
            )
        )
        share += 1.0 / step / work
        if progress is not None:
            progress(share)
    return results


def _finer(cutting: CuttingSystem, record: Record) -> dict[float, float]:
    """See `StationStep.finer`."""
    model, X_WF = cutting.solvers[0].model, cutting.food_poses[0]
    R_FW = X_WF.rotation().matrix().T
    w, *xyz = record.vector("knife_pose_quat", "wxyz").T
    R_WK = Rotation.from_quat(np.column_stack([*xyz, w])).as_matrix()
    R_CK = model.X_FC_rotation.T @ R_FW @ R_WK
    p_CK = model.to_cut_frame((record.vector("knife_pose_p") - X_WF.translation()) @ R_FW.T)
    noise = np.random.default_rng(1).normal(size=p_CK.shape)
    finer = {}
    for size in NOISE:
        numbers = study.planned_substeps(model, R_CK, p_CK + size * noise)
        finer[size] = float((numbers > study.EXCHANGE / model.numerics.time_step + 0.5).mean())
    return finer


def station_table(cases: Sequence[tuple[str, Sequence[StationStep]]]) -> str:
    """Results of `station_steps` by name as a table for people."""
    return table(
        "in the station | step [s] | RMS error [%] | largest difference [% of peak]"
        " | path error [um] | largest kinetic/internal energy [%]"
        " | more sub-steps than the fewest, "
        f"path measured with noise of {', '.join(f'{1e6 * size:g}' for size in NOISE)} um [%]"
        " | x real time | ran to the end",
        (
            (name, f"{s.time_step:g}", f"{100 * s.force_error:.2f}")
            + (f"{100 * s.largest_difference:.1f}", f"{1e6 * s.path_error:.1f}")
            + (f"{100 * s.energy_ratio:.3f}",)
            + (", ".join(f"{100 * share:.0f}" for share in s.finer.values()),)
            + (f"{s.real_time_factor:.2f}", s.stopped or "yes")
            for name, steps in cases
            for s in steps
        ),
    )


def write_stepping(results: Sequence[StepResult], costs: Sequence[StepCost], file: Path) -> None:
    """Writes a row for each run as CSV, SI units; a cost only where it was timed."""
    cost = {(c.food, c.column): c for c in costs}
    fields = (
        "time_step scaled by_need reference refusal rms_error largest_difference peak energy_ratio "
        "substeps finer by_event force_drop creep"
    ).split()
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["case", *fields, "elements", "all_elements", "wall_per_simulated"])
        for r in results:
            timed = cost.get((r.case.food.name, r.column)) if r.scaled else None
            writer.writerow(
                [r.case.label]
                + [getattr(r, name) for name in fields]
                + list(r.elements)
                + [timed.seconds if timed else ""]
            )


def plot_stepping(results: Sequence[StepResult], costs: Sequence[StepCost], file: Path) -> None:
    """Draws the error over the sub-steps that a simulated second takes, a panel for each food.

    Lines are constant steps, filled markers steps by need.
    """
    from matplotlib.ticker import NullFormatter

    foods = list(dict.fromkeys(c.food for c in costs))
    speeds = sorted({r.case.press_speed for r in results if r.case.food.name in foods})
    shown_speeds = (speeds[0], speeds[-1]) if len(speeds) < 3 else (0.02, 0.1)
    # Okabe and Ito's palette by motion, marker and line by speed; ramps are in the tables.
    colours = {"press": BLUE, "press and retract": ORANGE, "draw": GREEN}
    colours["hold after a sudden stop"] = RED
    styles = dict(zip(shown_speeds, (("--", "o"), ("-", "s")), strict=False))
    figure = new_figure(max(7.0, 4.0 * len(foods)), 4.6)
    panels = figure.subplots(1, len(foods), sharey=True, squeeze=False)[0]
    for axes, food in zip(panels, foods, strict=True):
        of_food = [r for r in results if r.case.food.name == food and r.scaled]
        for case in list({id(r.case): r.case for r in of_food}.values()):
            if case.acceleration or case.press_speed not in styles:
                continue
            colour = colours[case.motion_name]
            line, marker = styles[case.press_speed]
            of_case = [r for r in of_food if r.case is case and r.rms_error > 0.0]
            for by_need in (False, True):
                shown = [r for r in of_case if r.by_need is by_need]
                x = [r.substeps / study.EXCHANGE for r in shown]
                y = [100.0 * r.rms_error for r in shown]
                if by_need:
                    axes.loglog(x, y, marker, color=colour, ms=8, mec="black", zorder=3)
                else:
                    axes.loglog(x, y, line, marker=marker, color=colour, lw=1.0, ms=3.5)
            label = f"{case.motion_name}, {1e3 * case.press_speed:g} mm/s"
            axes.plot([], [], line, marker=marker, color=colour, label=label)
        axes.axhline(1.0, color="0.3", lw=1.0, ls=":")
        axes.text(0.93, 1.06, "1 %", transform=axes.get_yaxis_transform(), fontsize=8)
        axes.set_title(food)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("sub-steps per simulated second")
        axes.grid(alpha=0.25, which="major")
    panels[0].set_ylabel("RMS error of the force [%]")
    figure.suptitle("Error of the force: constant sub-steps (lines), by need (large markers)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    save_figure(figure, file, 150)
