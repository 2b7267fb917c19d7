"""A food calibrated to a bench's records, and how wrong the simulation then is by itself.

The structural misfit of a draw is the root mean square of what is left between noise-free nominal
records and the calibrated simulation, over that of the force, while the edge is in the food.

    python -m studies bench_misfit --laws slice_push --draws 2
"""

import argparse
import copy
import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import make_food_model
from sliceit_drake.cutting.parameters import get_parameter, with_parameters
from sliceit_drake.diagnosis.diagnose import BASE, setup_of_food
from sliceit_drake.diagnosis.prediction import Point, SlicePredictor
from sliceit_drake.prediction.record_set import one_of_each
from sliceit_drake.records.slice_record import SliceRecord
from studies.benches.draw import LAWS, PARTS, Draw, seed_of
from studies.pages import percent, publish, table

__all__ = ["Misfit", "add_arguments", "calibrated", "food_records", "misfit_of", "run"]

STEP = 0.1
"""Of the logarithms of the base parameters, for the first derivatives."""
LARGEST = 0.7
"""Greatest change of one in a step."""
STEPS = 7
BINS = 12
"""Of depth."""


@dc.dataclass(frozen=True)
class Misfit:
    """What a calibrated simulation gets wrong in noise-free nominal records.

    Attributes:
        whole: RMS of the residual over that of the force, in contact.
        depth, speed, draw, phase: RMS over the same force of the part of the vertical residual that
            goes with it: means over depth in a press; their differences between presses, and
            between the press and draws, of the same depth; means over the phases of the press.
        channels: RMS of the residual in contact along x, y, z, N [3], and of the torque about y
            where the records have it, Nm.
    """

    whole: float
    depth: float
    speed: float
    draw: float
    phase: float
    channels: list[float]


def food_records(records: Sequence[SliceRecord]) -> list[SliceRecord]:
    """The first record of each condition that cuts."""
    return one_of_each([record for record in records if record.phase("slice").any()])


class _Fit:
    """Residuals of records as a function of the base parameters' logarithms."""

    def __init__(self, food: CalibratedFood, records: Sequence[SliceRecord]) -> None:
        self.food = food
        self.setup = setup_of_food(food)
        self.predictor = SlicePredictor(self.setup, records, workers=1)
        self.targets = self.predictor.targets
        model = make_food_model(food.food, self.setup.knife, self.setup.numerics)
        self.start = np.log([float(get_parameter(model, p.name)) for p in BASE])
        self.bounds = np.log([[p.low, p.high] for p in BASE]).T

    def residuals(self, logs: np.ndarray) -> list[np.ndarray]:
        """Measured less predicted of each record [m, c]; not finite where a slice breaks down."""
        values = {p.name: float(v) for p, v in zip(BASE, np.exp(logs), strict=True)}
        out = []
        for target, series in zip(
            self.targets, self.predictor.predict([Point(values=values)])[0], strict=True
        ):
            assert series is not None
            out.append(target.measured - target.compare(series.wrench))
        return out

    def stacked(self, logs: np.ndarray) -> np.ndarray:
        """Of all forces in contact, in a row."""
        parts = zip(self.targets, self.residuals(logs), strict=True)
        return np.concatenate([r[t.depth > 0.0, :3].ravel() for t, r in parts])

    def with_values(self, logs: np.ndarray) -> CalibratedFood:
        """The food at the values."""
        food = copy.deepcopy(self.food)
        model = make_food_model(food.food, self.setup.knife, self.setup.numerics)
        values = {p.name: float(v) for p, v in zip(BASE, np.exp(logs), strict=True)}
        food.food.material = with_parameters(model, values).material
        return food

    def solved(self) -> np.ndarray:
        """Logarithms of least squares: Gauss-Newton, derivatives kept up by Broyden (1965)."""
        at, r = self.start, self.stacked(self.start)
        columns = [(self.stacked(at + STEP * e) - r) / STEP for e in np.eye(len(at))]
        J, damping = np.array(columns).T, 1e-3
        for _ in range(STEPS):
            H = J.T @ J
            move = -np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ r)
            move = np.clip(at + np.clip(move, -LARGEST, LARGEST), *self.bounds) - at
            if np.abs(move).max() < 0.01:
                break
            new = self.stacked(at + move)
            if not np.isfinite(new).all():
                damping = max(10.0 * damping, 1.0)
                continue
            J = J + np.outer(new - r - J @ move, move) / float(move @ move)
            if new @ new < r @ r:
                at, r, damping = at + move, new, 0.3 * damping
            else:
                damping = max(10.0 * damping, 0.1)
        return at


def calibrated(food: CalibratedFood, records: Sequence[SliceRecord]) -> CalibratedFood:
    """A food with the base parameters that fit records best.

    Args:
        food: To begin with.
        records: Of cuts; see `food_records`.
    """
    fit = _Fit(food, records)
    return fit.with_values(fit.solved())


def misfit_of(draw: Draw) -> tuple[Misfit, CalibratedFood]:
    """The structural misfit of a draw, and the food that was calibrated for it.

    Raises:
        CuttingError: A cut broke down.
    """
    fit = _Fit(draw.model, food_records(draw.quiet()))
    logs = fit.solved()
    residuals = fit.residuals(logs)
    inside = [t.depth > 0.0 for t in fit.targets]
    forces = np.concatenate([t.measured[i, :3] for t, i in zip(fit.targets, inside, strict=True)])
    size = float(np.sqrt((forces**2).sum(1).mean()))
    left = np.concatenate([r[i] for r, i in zip(residuals, inside, strict=True)])
    means = [
        _by_depth(t.depth[t.phase == "slice"], r[t.phase == "slice", 2], t.facts.height)
        for t, r in zip(fit.targets, residuals, strict=True)
    ]
    # Three presses, of which the second has the speed of the draws.
    speed = np.array(means[:3]) - np.mean(means[:3], axis=0)
    draws = np.array(means[3:]) - means[1]
    middle = fit.targets[1]
    phases = [
        residuals[1][inside[1] & (middle.phase == name), 2].mean()
        for name in ("slice", "hold", "retract", "second_pass")
    ]
    return (
        Misfit(
            whole=float(np.sqrt((left[:, :3] ** 2).sum(1).mean())) / size,
            depth=_rms(np.array(means[1])) / size,
            speed=_rms(speed) / size,
            draw=_rms(draws) / size,
            phase=_rms(np.array(phases)) / size,
            channels=np.sqrt((left**2).mean(0)).tolist(),
        ),
        fit.with_values(logs),
    )


def _by_depth(depth: np.ndarray, values: np.ndarray, height: float) -> np.ndarray:
    """Means of values in `BINS` bins of the depth [BINS]."""
    at = np.floor(BINS * depth / height).astype(int)
    return np.array([values[at == k].mean() if (at == k).any() else 0.0 for k in range(BINS)])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--commit", default="0", help="hash that seeds follow from (default 0)")
    parser.add_argument(
        "--part", choices=PARTS, default="training", help="whose draws (default training)"
    )
    parser.add_argument("--laws", nargs="+", default=list(LAWS), metavar="LAW", help="default: all")
    parser.add_argument("--draws", type=int, default=3, help="of each law (default 3)")
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    rows, found = [], {}
    for law in options.laws:
        for number in range(options.draws):
            draw = Draw(law, seed_of(options.commit, options.part, law, number))
            misfit, food = misfit_of(draw)
            found[f"{law} {number}"] = misfit
            shares = (getattr(misfit, f.name) for f in dc.fields(misfit)[:5])
            material = food.food.material
            values = f"{material.toughness:.0f}, {material.youngs_modulus / 1e6:.2f}"
            rows.append((law, number, *map(percent, shares), f"{values}, {material.friction:.2f}"))
            print(*rows[-1], flush=True)
    head = "law | draw | misfit | with depth | speed | draw ratio | phase | R [J/m2], E [MPa], mu"
    publish(table(head, rows, " rrrrrr"), options.output, found)
    return 0
