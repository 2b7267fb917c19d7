"""Fits the upper half of each measured curve, and asks whether the lower half lies in the band.

Each of calibration/records is fitted down to half of the food's height, with the shipped setup on
a coarse mesh and from three starts. The band of the lower half (calibration/bands.py) is then
compared with what was measured there. Prints a table; with --output it also draws the curves.
"""

import argparse
import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.bands import ForceBand, force_band
from sliceit_drake.calibration.first_fit import fit_from_starts
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.calibration.structure import coarse_predictor
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from studies.figures import BLUE, ORANGE, new_figure, tidy

__all__ = ["HalfDepth", "add_arguments", "half_depth", "run"]

FOODS = ("cucumber", "tomato", "potato")
DRAWS = 32
"""Slices of each band."""


@dc.dataclass
class HalfDepth:
    """A band from the upper half of a record.

    Attributes:
        depth, measured: Of the entries [M], metres and N.
        lower: Those that were not fitted [M].
        fitted: Force of the fit [M], N.
        band: Of all entries.
    """

    depth: np.ndarray
    measured: np.ndarray
    lower: np.ndarray
    fitted: np.ndarray
    band: ForceBand

    def row(self) -> list[str]:
        """Error of the fit in both halves, share of the lower half within the band of 90 %, and
        the band's width over the force there."""
        low, high = self.band.interval()
        inside = (low <= self.measured) & (self.measured <= high)
        error = self.fitted - self.measured
        rms = [float(np.sqrt(np.mean(error[half] ** 2))) for half in (~self.lower, self.lower)]
        width = np.mean((high - low)[self.lower]) / np.mean(self.measured[self.lower])
        return [f"{rms[0]:.2f}", f"{rms[1]:.2f}", f"{100.0 * inside[self.lower].mean():.0f} %"] + [
            f"{width:.2f}"
        ]


def half_depth(predictor: Predictor) -> HalfDepth:
    """Fits what lies above half of the food's height."""
    lower = predictor.depth > 0.5 * predictor.targets[0].facts.height
    upper = predictor.holding_out(lower)
    unit = fit_from_starts(upper)
    (row,) = predictor.predict([unit])
    fitted = np.concatenate([p.predicted.ravel() for p in row])
    band = force_band(upper, unit, DRAWS)
    return HalfDepth(predictor.depth, predictor.measured, lower, fitted, band)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the study's arguments."""
    parser.add_argument("--foods", nargs="+", default=FOODS, choices=FOODS, help="default: all")
    parser.add_argument("--workers", type=int, default=2, help="processors (default 2)")
    parser.add_argument("--output", type=Path, metavar="PNG", help="draw the curves")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    names = ["food", "upper half [N]", "lower half [N]", "of it in the band", "width / force"]
    print("| " + " | ".join(names) + " |\n" + "|---" * len(names) + "|")
    results = {}
    for name in options.foods:
        record: SliceRecord = load_record(resource_path(f"calibration/records/{name}.csv"))
        # An oscillation that is fitted to half a record says nothing of the rest.
        setup = dc.replace(load_setup(name), oscillation=None)
        results[name] = half_depth(coarse_predictor(setup, [record], options.workers))
        print("| " + " | ".join([name, *results[name].row()]) + " |", flush=True)
    if options.output is not None:
        _draw(results, options.output)
    return 0


def _draw(results: dict[str, HalfDepth], file: Path) -> None:
    figure = new_figure(10.0, 3.4)
    for axes, (name, result) in zip(
        np.atleast_1d(figure.subplots(1, len(results))), results.items(), strict=True
    ):
        low, high = result.band.interval()
        depth = 1e3 * result.depth
        axes.fill_between(depth, low, high, color=ORANGE, alpha=0.25, lw=0, label="90 % band")
        axes.plot(depth, result.fitted, color=ORANGE, label="fitted to the upper half")
        axes.plot(depth, result.measured, color=BLUE, label="measured")
        axes.axvline(depth[result.lower].min(), color="0.5", lw=0.8)
        axes.set(xlabel="depth [mm]", ylabel="force [N]")
        tidy(axes, name)
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(file, dpi=150)
