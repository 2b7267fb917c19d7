"""Random foods, planes, knives and motions: what comes of them is a cut or a reason.

A slice is drawn from wide ranges of what people cut and how, cut on a prescribed motion, and judged
by what any slice must keep: finite forces, a cut that never closes, energy balance of energy that
balance. A slice may be refused, or stopped by a guard, with its reason; anything else is
unexplained. Takes two seconds a slice and processor. Ends with status 1 if a slice is unexplained.
"""

import argparse
import collections
import dataclasses as dc
import math
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, Tapered
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from sliceit_drake.cutting.model import CuttingModel, Numerics, TimeStepError
from sliceit_drake.cutting.motion import Hold, Motion, MotionPlan, PressAndDraw, Retract, Segment
from sliceit_drake.cutting.simulate import COMPLETE, DEBT_LIMIT, SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.cutting.workers import worker_processes
from studies.pages import publish, render_and_store

__all__ = [
    "Outcome",
    "RandomSlice",
    "add_arguments",
    "cut_drawn",
    "cut_random_slice",
    "draw_slice",
    "page_values",
    "run",
]

EXCHANGE_PERIOD = 2e-3
CLEARANCE = 2e-3
OVERTRAVEL = 5e-4
"""Travel of the edge into the board, metres: under the blade a soft food sinks into it."""
KINDS = ("cut", "refused", "stopped", "unexplained")
IMBALANCE = 0.02
"""Greatest work that the energy balance may lack, over the work of the knife."""
LEFT = 0.01
"""Fraction of the section that the last elements may keep."""
YIELDS = 2.0
"""Multiple of toughness over modulus, the way that a food gives before it parts: as much may be
left at the board, into which the edge presses it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--count", metavar="N", type=int, default=200, help="slices; default: 200")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="default: 0")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; default: 2")
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help="write random_slices.md there"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    if options.count < 1 or options.workers < 1:
        raise ConfigurationError("is below 1", field="--count or --workers", fix="Give 1 or more.")
    outcomes: list[Outcome] = []
    interrupted = False
    try:
        with worker_processes(options.workers, "forkserver") as pool:
            seeds = [options.seed] * options.count
            cuts = pool.map(cut_drawn, seeds, range(options.count))
            outcomes.extend(tqdm(cuts, total=options.count, desc="slices"))
    except KeyboardInterrupt:
        if not outcomes:
            raise
        interrupted = True  # What was asked for has no page then.
    values = page_values(outcomes, options.seed, options.command)
    page = None if interrupted or options.output is None else options.output / "random_slices.md"
    publish(render_and_store("random_slices", page, values, outcomes), page)
    if interrupted:
        print(f"Interrupted: this is of the first {len(outcomes)} of {options.count} slices.")
        return 130
    return 1 if any(outcome.kind == "unexplained" for outcome in outcomes) else 0


@dc.dataclass
class RandomSlice:
    """A food, a knife and what is done with it.

    Attributes:
        food, knife, numerics: As in a scenario.
        speed: Of the press, m/s.
        draw_ratio: Draw over press speed.
        amplitude, frequency: Of sawing along the edge, metres and Hz.
        hold: At the board, s.
    """

    food: Food
    knife: Knife
    numerics: Numerics
    speed: float
    draw_ratio: float
    hold: float
    amplitude: float = 0.0
    frequency: float = 1.0


@dc.dataclass
class Outcome:
    """What came of a slice.

    Attributes:
        kind: cut, refused, stopped or unexplained.
        reason: Of the last three.
        shape: Of the food.
        peak: Greatest force of the food, N; of a cut.
    """

    kind: str
    reason: str
    shape: str
    peak: float = math.nan


def draw_slice(rng: np.random.Generator) -> RandomSlice:
    """Draws a slice: modulus 50 kPa to 10 MPa, toughness 20 to 800 J/m2, speed 5 to 100 mm/s."""

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def scales(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    layers = [0.0, 3e-3, 7e-3, 13e-3]
    kind = int(rng.integers(4))
    shape: Cylinder | Tapered | Box | Ellipsoid
    if kind == 3:
        wide = between(0.02, 0.05)
        ends = [wide, between(0.4, 1.0) * wide]
        shape = Tapered(ends, between(0.06, 0.15), int(rng.integers(2, 4)), layers)
    elif kind == 0:
        shape = Cylinder(between(0.02, 0.06), between(0.06, 0.15), int(rng.integers(2, 4)), layers)
    elif kind == 1:
        size = [between(0.015, 0.05), between(0.06, 0.15), between(0.015, 0.05)]
        shape = Box(size, rng.integers(4, 8, 2).tolist(), layers)
    else:
        shape = Ellipsoid([between(0.04, 0.07) for _ in range(3)], 2)
    lean, turn = between(-0.35, 0.35), between(-0.5, 0.5)
    is_oblique = rng.random() < 0.5
    normal = [
        math.sin(turn) * math.cos(lean),
        math.cos(turn) * math.cos(lean),
        math.sin(lean),
    ]
    food = Food(
        name="random",
        shape=shape,
        material=Material(
            youngs_modulus=scales(5e4, 1e7),
            poisson_ratio=between(0.2, 0.47),
            density=between(400.0, 1200.0),
            toughness=scales(20.0, 800.0),
            strength=scales(5e4, 2e6),
            friction=(friction := between(0.0, 0.6)),
            static_friction=float(rng.choice([0.0, 1.5])) * friction,
        ),
        cut_point=[0.0, between(-0.01, 0.01), 0.0],
        cut_normal=normal if is_oblique else [0.0, 1.0, 0.0],
        held_sides=str(rng.choice(["both", "minus", "plus", "none"])),
        hold_distance=between(0.008, 0.015),
    )
    knife = Knife(
        spine_thickness=scales(8e-4, 4e-3),
        edge_thickness=scales(3e-5, 3e-4),
        height=between(0.025, 0.08),
        length=between(0.12, 0.30),
    )
    return RandomSlice(
        food,
        knife,
        Numerics(),
        speed=scales(5e-3, 0.1),
        draw_ratio=float(rng.choice([0.0, between(-2.0, 2.0)])),
        hold=between(0.0, 0.1),
        amplitude=float(rng.choice([0.0, scales(1e-3, 1e-2)])),
        frequency=scales(1.0, 5.0),
    )


def cut_drawn(seed: int, index: int) -> Outcome:
    """Draws and cuts one slice of a study; the same for the same numbers."""
    return cut_random_slice(draw_slice(np.random.default_rng([seed, index])))


def cut_random_slice(case: RandomSlice) -> Outcome:
    """Cuts a slice and judges it."""
    shape = type(case.food.shape).__name__.lower()
    try:
        for part in (case.food, case.knife, case.numerics):
            validate(part, type(part).__name__.lower())
        model = make_food_model(case.food, case.knife, case.numerics)
        start = start_pose(model, CLEARANCE)
        distance = -start.p[2] / start.R[2, 2] + OVERTRAVEL
        segments: list[Segment] = [
            PressAndDraw(
                case.speed,
                distance,
                case.draw_ratio,
                case.amplitude,
                case.frequency,
                acceleration=2.0,
            ),
            *([Hold(case.hold)] if case.hold > 0.01 else []),
            Retract(0.5 * distance, 0.1, acceleration=2.0),
        ]
        solver = CuttingSolver(model, EXCHANGE_PERIOD)
        result = simulate_slice(solver, Motion(MotionPlan(segments), start), Board(height=0.0))
    except (ConfigurationError, MeshError, TimeStepError) as error:
        return Outcome("refused", str(error), shape)
    except CuttingError as error:
        return Outcome("stopped", str(error), shape)
    except Exception as error:  # What nobody foresaw is what is looked for.
        return Outcome("unexplained", f"{type(error).__name__}: {error}", shape)
    wrong = _wrong(result, model)
    peak = float(np.linalg.norm(result.food_wrench[:, 3:], axis=1).max())
    return Outcome("unexplained" if wrong else "cut", wrong, shape, peak)


def _wrong(result: SliceResult, model: CuttingModel) -> str:
    """What no slice may do, or nothing."""
    material, height = model.material, model.top - model.bottom
    left = max(LEFT, YIELDS * material.toughness / (material.youngs_modulus * height))
    rows = np.column_stack([result.food_wrench, result.board_wrench, result.cut])
    if not np.isfinite(rows).all():
        return f"a force is not finite at {result.time[~np.isfinite(rows).all(1)][0]:.4g} s"
    if np.diff(result.cut).min() < -1e-6:
        return "the cut closes"
    if result.cut[-1] < 1.0 - left:
        return f"the knife went to the board and {100 * result.cut[-1]:.1f} % are cut"
    balance = result.balance
    for name in ("edge", "opening", "friction", "board_friction"):
        if getattr(balance, name) < -1e-9:
            return f"{name} gives energy: {getattr(balance, name):.3g} J"
    paid = (balance.edge + balance.opening) / model.work_through
    if result.cut[-1] >= COMPLETE and paid < 1.0 - DEBT_LIMIT:
        return f"edge and opening do {100 * paid:.1f} % of the toughness times the area"
    lack = abs(balance.residual(result.energies)) / max(abs(balance.work), 1e-6)
    if lack > IMBALANCE:
        return f"the energy balance lacks {100 * lack:.1f} % of the knife's work"
    return ""


def page_values(outcomes: list[Outcome], seed: int, command: str) -> dict[str, object]:
    """What the page of a study shows."""
    shapes = sorted({outcome.shape for outcome in outcomes})
    counts = collections.Counter((o.shape, o.kind) for o in outcomes)
    peaks = [o.peak for o in outcomes if o.kind == "cut"]
    reasons = {}
    for kind in KINDS[1:]:
        groups: dict[str, list[str]] = {}
        for outcome in outcomes:
            if outcome.kind == kind:
                groups.setdefault(_gist(outcome.reason), []).append(outcome.reason)
        most = sorted(groups.values(), key=len, reverse=True)
        reasons[kind] = [(len(group), group[0].replace("|", "/")) for group in most]
    return dict(
        command=command,
        slices=len(outcomes),
        seed=seed,
        imbalance=100 * IMBALANCE,
        kinds=KINDS,
        rows=[(shape, *(counts[shape, kind] for kind in KINDS)) for shape in shapes]
        + [("all", *(sum(counts[shape, kind] for shape in shapes) for kind in KINDS))],
        peaks=np.quantile(peaks, [0.05, 0.5, 0.95]) if peaks else None,
        reasons={kind: found for kind, found in reasons.items() if found},
    )


def _gist(reason: str) -> str:
    """A reason without its numbers."""
    return "".join(c for c in reason if c.isalpha() or c == " ").split("is")[0][:60]
