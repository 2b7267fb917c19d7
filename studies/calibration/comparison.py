"""Calibrate the three foods that the paper measured, and compare with its two simulators.

Runs `sliceit calibrate` on calibration/records for each food and writes to FOLDER the table
(calibration.md), the figure (calibration.png), and a folder for each food with what `calibrate`
leaves. A run that was killed goes on where it was. docs/explanation/calibration.md explains what
comes out.
"""

import argparse
import dataclasses as dc
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from sliceit_drake.calibration.bands import ForceBand, force_band
from sliceit_drake.calibration.calibrate import (
    CalibrationOptions,
    calibrate,
    depth_blocks,
    values_of,
)
from sliceit_drake.calibration.per_point import fit_points
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.result import Calibration
from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.cli.progress import StageBars
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from studies.figures import new_figure, save_figure
from studies.pages import percent, publish, table
from studies.simulated_profiles import SimulatedProfile, load_simulated_profile

__all__ = [
    "FoodComparison",
    "Row",
    "add_arguments",
    "compare",
    "comparison_tables",
    "left_out_band",
    "plot_comparisons",
    "run",
]

FOODS = ("cucumber", "tomato", "potato")
BLOCKS = 5
"""Of depth, for the bands of what was left out."""
LARGEST_SHIFT = 0.4
"""In time, that other simulators' curves get, s."""
NAMES = {"DiSECt": "authors' calibrated DiSECt", "spring": "authors' spring"}
COLOURS = {"DiSECt": "#2563eb", "spring": "#16a34a", "ours": "#c2410c"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where the results go"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=FOODS, default=list(FOODS), help="default: all"
    )
    parser.add_argument("--trials", type=int, default=500, help="of the search (default 500)")
    parser.add_argument("--steps", type=int, default=100, help="of Adam (default 100)")
    parser.add_argument("--starts", type=int, default=2, help="places refined (default 2)")
    parser.add_argument(
        "--polish",
        nargs="+",
        choices=FOODS,
        default=[],
        help="foods that are polished as they ship, in place of a search (default: none)",
    )
    parser.add_argument(
        "--blocks", type=int, default=5, help="blocks of depth held out (default 5; 0: none)"
    )
    parser.add_argument(
        "--block-length", type=float, metavar="METRES", help="as of sliceit calibrate"
    )
    parser.add_argument(
        "--point-steps",
        type=int,
        default=100,
        help="of Adam on a toughness for each cut point (default 100; 0: none)",
    )
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="default: all processors"
    )


def _points_rms(result: Calibration, steps: int) -> float:
    """Error with a toughness for each cut point, N."""
    with StageBars() as bars:
        points = fit_points(
            result.predictor,
            result.unit,
            steps,
            lambda done, error: bars.show_error("each point", done, steps, error),
        )
    return points.rms


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    comparisons = []
    for food in options.foods:
        record = load_record(resource_path(f"calibration/records/{food}.csv"))
        profile = load_simulated_profile(
            resource_path(f"calibration/measured/sliceit_real_{food}_force.csv")
        )
        folder = options.output / food
        begin = time.monotonic()
        settings = CalibrationOptions(
            trials=options.trials,
            steps=options.steps,
            starts=options.starts,
            workers=options.workers,
            blocks=options.blocks,
            block_length=options.block_length,
            start=values_of(load_calibrated_food(food)) if food in options.polish else None,
        )
        with StageBars(f"{food}: ") as bars:
            result = calibrate(
                load_setup(food), [record], folder, settings, progress=bars.show_error
            )
        minutes = (time.monotonic() - begin) / 60.0
        command = (
            f"python -m studies calibration --foods {food} --trials {options.trials} --steps "
            f"{options.steps} --starts {options.starts} --blocks {options.blocks}"
            + (f" --block-length {options.block_length:g}" if options.block_length else "")
            + (f" --polish {food}" if food in options.polish else "")
        )
        result.save(folder, command)
        comparison = compare(result, profile, minutes)
        if options.point_steps:
            comparison.per_point_rms = _points_rms(result, options.point_steps)
        comparisons.append(comparison)
        for line in result.posterior.remarks():
            print(f"{food}: {line}")
    results = [
        {"food": c.food, "minutes": c.minutes, "per_point_rms": c.per_point_rms, "rows": c.rows}
        for c in comparisons
    ]
    publish(comparison_tables(comparisons), options.output / "calibration.md", results)
    plot_comparisons(comparisons, options.output / "calibration.png")
    return 0


@dc.dataclass
class Row:
    """One simulator on one food.

    Attributes:
        name: Of the simulator.
        time, force: Its curve at the compared samples [m], s and N, after the best shift.
        shift: In time that was granted to it, s.
        rms: Root mean square error, N.
        peak: Largest force, N.
        work: Integral of the force over the nominal depth, J.
    """

    name: str
    time: np.ndarray
    force: np.ndarray
    shift: float
    rms: float
    peak: float
    work: float


@dc.dataclass
class FoodComparison:
    """All simulators on one food.

    Attributes:
        food: Its name.
        time, measured: The record [m], s and N.
        rows: Of the simulators; the last is ours.
        calibration: Ours.
        left_out: Band of ours, of each block of depth from the others.
        minutes: What it took.
        per_point_rms: Error with a toughness for each cut point besides, N; None if not fitted.
    """

    food: str
    time: np.ndarray
    measured: np.ndarray
    rows: list[Row]
    calibration: Calibration
    left_out: ForceBand
    minutes: float
    per_point_rms: float | None = None


def compare(calibration: Calibration, profile: SimulatedProfile, minutes: float) -> FoodComparison:
    """Compares on the samples that the calibration was fitted to.

    The other simulators' curves get the time shift that brings them nearest; ours has its own
    height, speed and time among its parameters.
    """
    (target,), (prediction,) = calibration.predictor.targets, calibration.predictions
    time, measured = target.time, target.measured[:, 0]
    speed = float(target.record.metadata.motion.speed or 0.0)
    rows = []
    for name, reference in profile.references.items():
        shift = _best_shift(time, measured, profile.time, reference)
        force = np.interp(time - shift, profile.time, reference)
        rows.append(_row(name, time, force, measured, shift, speed))
    ours = prediction.predicted[:, 0]
    rows.append(_row("ours", time, ours, measured, 0.0, speed))
    name = calibration.predictor.setup.food.name
    left_out = left_out_band(calibration.predictor, calibration.unit)
    return FoodComparison(name, time, measured, rows, calibration, left_out, minutes)


def left_out_band(model: Predictor, unit: np.ndarray, blocks: int = BLOCKS) -> ForceBand:
    """The band of each block of depth from the entries of the others, with the force taken for
    linear about the fit to all [d]."""
    block = depth_blocks(model, blocks)
    mean, deviation = np.zeros(len(block)), np.zeros(len(block))
    for k in range(blocks):
        band = force_band(model.holding_out(block == k), unit)
        mean[block == k] = band.mean[block == k]
        deviation[block == k] = band.deviation[block == k]
    return ForceBand(mean[None], deviation, np.ones(1))


def _best_shift(
    time: np.ndarray, measured: np.ndarray, reference_time: np.ndarray, reference: np.ndarray
) -> float:
    def square(shift: float) -> float:
        force = np.interp(time - shift, reference_time, reference)
        return float(np.mean((force - measured) ** 2))

    grid = np.linspace(-LARGEST_SHIFT, LARGEST_SHIFT, 161)
    best = float(grid[int(np.argmin([square(s) for s in grid]))])
    step = grid[1] - grid[0]
    fit = minimize_scalar(square, bounds=(best - step, best + step), method="bounded")
    return float(fit.x)


def _row(
    name: str,
    time: np.ndarray,
    force: np.ndarray,
    measured: np.ndarray,
    shift: float,
    speed: float,
) -> Row:
    rms = float(np.sqrt(np.mean((force - measured) ** 2)))
    work = float(np.trapezoid(force, time)) * speed
    return Row(name, time, force, shift, rms, float(force.max()), work)


def comparison_tables(comparisons: Sequence[FoodComparison]) -> str:
    """The comparison as Markdown."""
    rows, costs, bands = [], [], []
    for c in comparisons:
        k = c.calibration
        target = k.predictor.targets[0]
        speed = target.record.metadata.motion.speed or 0.0
        work = float(np.trapezoid(c.measured, c.time)) * speed
        rows.append((c.food, "measured", "", f"{c.measured.max():.1f}", f"{work:.3f}", "", "", ""))
        for row in c.rows:
            name, shift = NAMES.get(row.name, row.name), f"{1e3 * row.shift:.0f}"
            count = held = ""
            if row.name == "ours":
                name, shift = "**ours**", "fitted"
                count = str(len(k.unit) + 3 * (k.predictor.setup.oscillation is not None))
                held = f"{k.held_out_rms:.2f}" if k.held_out_rms is not None else ""
            rows.append(
                (c.food, name, f"{row.rms:.2f}", f"{row.peak:.1f}", f"{row.work:.3f}", shift)
                + (count, held)
            )
        for what, band in (("fitted", k.band), ("left out", c.left_out)):
            low, high = band.interval()
            inside = float(np.mean((low <= c.measured) & (c.measured <= high)))
            wide = float(np.mean(high - low))
            share = wide / float(np.mean(np.abs(c.measured)))
            bands.append((c.food, what, percent(inside), f"{wide:.2f}", f"{share:.2f}"))
        half = 0.5 * next(r.rms for r in c.rows if r.name == "DiSECt")
        points = "" if c.per_point_rms is None else f"{c.per_point_rms:.2f}"
        costs.append(
            (c.food, f"{k.rms / half:.2f}", f"{k.search_rms:.3f}", f"{k.refined_rms:.3f}")
            + (f"{k.rms:.3f}", f"{c.minutes:.1f}", points, str(len(target.model.point_nodes)))
        )
    curves = table(
        "food | simulator | RMS error [N] | peak [N] | work [J] | time shift [ms]"
        " | free parameters | held-out RMS [N]",
        rows,
    )
    cost = table(
        "food | ours / half of DiSECt's | search [N] | after Adam [N] | polished [N] | minutes"
        " | a toughness for each cut point [N] | cut points",
        costs,
    )
    shares = table("food | depth is | in the 90 % band | its width [N] | width / force", bands)
    return f"{curves}\n\n{shares}\n\n{cost}"


def plot_comparisons(comparisons: Sequence[FoodComparison], file: Path) -> None:
    """Measured and simulated curves of all foods, with what ours leaves."""
    figure = new_figure(4.6 * len(comparisons), 4.6)
    axes = figure.subplots(
        2,
        len(comparisons),
        squeeze=False,
        sharex="col",
        gridspec_kw={"height_ratios": (3, 1)},
    )
    for column, c in enumerate(comparisons):
        upper, lower = axes[0, column], axes[1, column]
        upper.plot(c.time, c.measured, color="#111827", lw=1.8, label="measured")
        shades = (
            (c.left_out, 0.12, "ours, 90 % band of depth that was left out"),
            (c.calibration.band, 0.25, "ours, 90 % band"),
        )
        for shown, alpha, name in shades:
            upper.fill_between(
                c.time, *shown.interval(), color=COLOURS["ours"], alpha=alpha, lw=0, label=name
            )
        for row in c.rows:
            style = "-" if row.name == "ours" else "--"
            label = "ours" if row.name == "ours" else NAMES.get(row.name, row.name)
            colour = COLOURS.get(row.name)
            upper.plot(
                c.time, row.force, style, color=colour, lw=1.1, label=f"{label}, {row.rms:.2f} N"
            )
            if row.name != "spring":
                lower.plot(c.time, row.force - c.measured, style, color=colour, lw=1.0)
        # Where the last block is left out its height is free, and the band goes into the board.
        peak = max(c.measured.max(), *(row.force.max() for row in c.rows))
        upper.set(title=c.food, ylim=(-0.15 * peak, 1.4 * peak))
        upper.legend(frameon=False, fontsize=7)
        lower.set_xlabel("time [s]")
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
    axes[0, 0].set_ylabel("force [N]")
    axes[1, 0].set_ylabel("error [N]")
    save_figure(figure, file, 150)
