"""Random foods, planes, knives and motions: what comes of them is a cut or a reason.

A slice is drawn from wide ranges of what people cut and how, cut on a prescribed motion, and judged
by what any slice must keep: finite forces, a cut that never closes, an edge that is paid for what
it cuts, losses that give nothing back, energies that balance. Every fourth slice is cut twice more:
mirrored, and with a quarter of the sub-step. A slice may be refused, or stopped by a guard, with
its reason; anything else is unexplained. Takes four seconds a slice and processor. Ends with status
1 if a slice is unexplained.
"""

import argparse
import collections
import dataclasses as dc
import math
import re
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.effects import Core, Effects, Skin
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, HalfCylinder, Tapered
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh
from sliceit_drake.cutting.model import CuttingModel, Numerics, TimeStepError, prepare_cut
from sliceit_drake.cutting.motion import Hold, Motion, MotionPlan, PressAndDraw, Retract, Segment
from sliceit_drake.cutting.simulate import COMPLETE, SliceResult, simulate_slice
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
"""Multiple of the greatest force over modulus and width, the way that a food gives before it parts:
as much may be left at the board, into which the edge presses it."""
CHECKED = 5
"""One slice in so many is cut twice more."""
FINE_STEP = 5e-5
"""Longest sub-step of the one, s."""
SHORTEST_STEP = 3e-5
"""Shortest sub-step that a guard's advice is followed with, s."""
STEP_ERROR, MIRROR_ERROR = 0.05, 0.01
"""Most that the force may differ from that with the fine step, and from that of the mirrored slice:
root of the mean square over that of the force."""
SHAPES = ("cylinder", "half cylinder", "tapered", "box", "plate", "ellipsoid")
STEPS, MIRROR = "force against sub-steps of 0.05 ms", "force against the mirrored slice"
MEASURES = {
    "energy balance, of the knife's work": IMBALANCE,
    "work of edge and opening less than R A of what is cut": Numerics().work_error,
    STEPS: STEP_ERROR,
    MIRROR: MIRROR_ERROR,
}
"""What is measured of a slice that is cut, and its limit."""


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
        kind: Name of the shape.
        food, knife, numerics: As in a scenario.
        speed: Of the press, m/s.
        draw_ratio: Draw over press speed.
        acceleration: Of the press's ramps, m/s^2; None for none.
        amplitude, frequency: Of sawing along the edge, metres and Hz.
        hold: At the board, s.
    """

    kind: str
    food: Food
    knife: Knife
    numerics: Numerics
    speed: float
    draw_ratio: float
    acceleration: float | None
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
        errors: Of a cut, by `MEASURES`.
        let_go: Which of its `errors` are until the knife goes up, because what food does that is
            dragged up and let go is not the same twice.
        advised: What came of another sub-step or `edge_spread`, where that was advised.
    """

    kind: str
    reason: str
    shape: str
    peak: float = math.nan
    errors: dict[str, float] = dc.field(default_factory=dict)
    advised: str = ""
    let_go: list[str] = dc.field(default_factory=list)


def draw_slice(rng: np.random.Generator) -> RandomSlice:
    """Draws a slice: modulus 50 kPa to 10 MPa, toughness 20 to 800 J/m2, speed 5 to 100 mm/s."""

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def scales(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def sometimes(chance: float) -> bool:
        return bool(rng.random() < chance)

    layers = [0.0, 3e-3, 7e-3, 13e-3]
    kind = str(rng.choice(SHAPES))
    length, rings = between(0.06, 0.15), int(rng.integers(2, 4))
    wide, high = between(0.015, 0.06), between(0.015, 0.05)
    shape: Cylinder | HalfCylinder | Tapered | Box | Ellipsoid
    if kind == "cylinder":
        shape = Cylinder(max(0.02, wide), length, rings, layers)
    elif kind == "half cylinder":
        shape = HalfCylinder(0.5 * max(0.02, wide), length, rings + 1, layers)
    elif kind == "tapered":
        ends = [max(0.02, wide), between(0.4, 1.0) * max(0.02, wide)]
        shape = Tapered(ends, length, rings, layers)
    elif kind == "box":
        shape = Box([wide, length, high], rng.integers(4, 8, 2).tolist(), layers)
    elif kind == "plate":
        size = [between(0.03, 0.08), length, between(0.005, 0.012)]
        shape = Box(size, [int(rng.integers(8, 14)), int(rng.integers(2, 4))], layers)
    else:
        shape = Ellipsoid([between(0.04, 0.07) for _ in range(3)], 2)
    lean, turn = between(-0.35, 0.35), between(-0.5, 0.5)
    is_oblique = sometimes(0.5)
    effects = Effects()
    if sometimes(0.25):
        effects.skin = Skin(scales(0.03, 0.5), scales(3e-4, 2e-3))
    if sometimes(0.25):
        rind, (a, b) = between(2e-3, 8e-3), rng.uniform(-0.5, 0.5, 2)
        ratios = scales(0.3, 2.0), scales(0.3, 2.0)
        effects.core = Core(rind, between(5e-4, 2e-3), *ratios, [rind * a, rind * b])
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
        effects=effects,
        cut_point=[0.0, between(-0.01, 0.01), 0.0],
        cut_normal=normal if is_oblique else [0.0, 1.0, 0.0],
        held_sides=str(rng.choice(["both", "minus", "plus", "none"])),
        hold_distance=between(0.008, 0.02),
        hold_distance_minus=between(0.008, 0.02) if sometimes(0.5) else None,
    )
    knife = Knife(
        spine_thickness=scales(8e-4, 4e-3),
        edge_thickness=scales(3e-5, 3e-4),
        height=between(0.025, 0.08),
        length=between(0.12, 0.30),
    )
    return RandomSlice(
        kind,
        food,
        knife,
        Numerics(),
        speed=scales(5e-3, 0.1),
        draw_ratio=float(rng.choice([0.0, between(-2.0, 2.0)])),
        acceleration=scales(0.2, 5.0) if sometimes(0.75) else None,
        hold=between(0.0, 0.1),
        amplitude=float(rng.choice([0.0, scales(1e-3, 1e-2)])),
        frequency=scales(1.0, 5.0),
    )


def cut_drawn(seed: int, index: int) -> Outcome:
    """Draws and cuts one slice of a study; the same for the same numbers."""
    case = draw_slice(np.random.default_rng([seed, index]))
    return cut_random_slice(case, twice_more=index % CHECKED == 0)


def cut_random_slice(case: RandomSlice, twice_more: bool = False) -> Outcome:
    """Cuts a slice and judges it; as `twice_more`, also mirrored and with short sub-steps."""
    try:
        model = _prepared(case)
        solver, result = _cut(case, model)
    except (ConfigurationError, MeshError, TimeStepError) as error:
        return Outcome("refused", str(error), case.kind)
    except CuttingError as error:
        return _stopped(case, model, str(error))
    except Exception as error:  # What nobody foresaw is what is looked for.
        return Outcome("unexplained", f"{type(error).__name__}: {error}", case.kind)
    wrong, errors = _wrong(result, model, solver)
    force = result.food_wrench[:, 3:]
    let_go = []
    for name, compared in ((STEPS, _with_short_steps), (MIRROR, _mirrored)):
        if twice_more and not wrong:
            errors[name], wrong, left_out = compared(case, force)
            let_go += [name] if left_out and not wrong else []
            wrong = wrong and f"{name}: {wrong}"
    if warned := wrong and [each for each in model.warnings if "the edge" in each]:
        return _stopped(case, model, f"{warned[0]} Here {wrong}")
    peak = float(np.linalg.norm(force, axis=1).max())
    kind = "unexplained" if wrong else "cut"
    return Outcome(kind, wrong, case.kind, peak, errors, let_go=let_go)


def _with_short_steps(case: RandomSlice, force: np.ndarray) -> tuple[float, str, bool]:
    """How far a slice's force [n, 3] is off that with short sub-steps, what is wrong with that, and
    whether food that was let go is left out of it.

    Where it is too far off, sub-steps half as short tell whether it, or the one that it is compared
    with, is off, or neither: food that the blade drags up and lets go does not do the same again.
    """
    limit = MEASURES[STEPS]
    references: list[np.ndarray | str] = []
    for step in (FINE_STEP, 0.5 * FINE_STEP):
        finer = dc.replace(case, numerics=dc.replace(case.numerics, time_step=step))
        references.append(_force(finer))
        error, wrong = _apart(force, references[-1], limit)
        if not wrong:
            return error, "", False
    one, other = references
    if not _apart(one, other, limit)[1]:
        return error, wrong, False
    return *_apart(force, _force(finer, rise=False), limit), True


def _mirrored(case: RandomSlice, force: np.ndarray) -> tuple[float, str, bool]:
    """As `_with_short_steps`, of the mirrored slice, which differs by rounding alone."""
    limit = MEASURES[MIRROR]
    error, wrong = _apart(force, _force(case, mirrored=True), limit)
    if not wrong:
        return error, "", False
    return *_apart(force, _force(case, mirrored=True, rise=False), limit), True


def _force(case: RandomSlice, mirrored: bool = False, rise: bool = True) -> np.ndarray | str:
    """Force of the food on the knife [n, 3], N, of a mirrored slice mirrored back, or why there is
    none; if not `rise`, until the knife goes up."""
    try:
        _, result = _cut(case, _prepared(case, mirrored), rise)
    except CuttingError as error:
        return str(error)
    return np.asarray(result.food_wrench[:, 3:] * ([1.0, -1.0, 1.0] if mirrored else 1.0))


def _apart(force: np.ndarray | str, other: np.ndarray | str, limit: float) -> tuple[float, str]:
    """Root of the mean square of the difference of two forces over that of the first, as far as the
    shorter goes; and what is wrong with it, if it passes a limit or a slice has none."""
    for each in (force, other):
        if isinstance(each, str):
            return math.nan, each
    assert not isinstance(force, str) and not isinstance(other, str)
    count = min(len(force), len(other))
    error = float(np.linalg.norm(other[:count] - force[:count]) / np.linalg.norm(force[:count]))
    return error, f"{100 * error:.1f} % RMS apart" if error > limit else ""


def _prepared(case: RandomSlice, mirrored: bool = False) -> CuttingModel:
    """The cut of a slice, or of its image in the plane y = 0."""
    food, knife, numerics = case.food, case.knife, case.numerics
    for part in (food, knife, numerics):
        validate(part, type(part).__name__.lower())
    if not mirrored:
        return make_food_model(food, knife, numerics)
    mesh, plane = food.mesh(), food.plane()
    image = TetrahedralMesh(mesh.vertices * [1.0, -1.0, 1.0], mesh.tetrahedra[:, [0, 2, 1, 3]])
    # The normal still points to greater y, so that the edge's direction stays.
    there = CutPlane(plane.point * [1.0, -1.0, 1.0], plane.normal * [-1.0, 1.0, -1.0], plane.up)
    geometry = make_cut_geometry(image, there, food.held(mesh))
    return prepare_cut(geometry, food.material, knife, numerics, food.effects)


def _cut(
    case: RandomSlice, model: CuttingModel, rise: bool = True
) -> tuple[CuttingSolver, SliceResult]:
    start = start_pose(model, CLEARANCE)
    distance = -start.p[2] / start.R[2, 2] + OVERTRAVEL
    segments: list[Segment] = [
        PressAndDraw(
            case.speed, distance, case.draw_ratio, case.amplitude, case.frequency, case.acceleration
        ),
        *([Hold(case.hold)] if case.hold > 0.01 else []),
        *([Retract(0.5 * distance, 0.1, acceleration=2.0)] if rise else []),
    ]
    solver = CuttingSolver(model, EXCHANGE_PERIOD)
    motion = Motion(MotionPlan(segments), start)
    return solver, simulate_slice(solver, motion, Board(height=0.0))


def _stopped(case: RandomSlice, model: CuttingModel, reason: str) -> Outcome:
    """What a guard has stopped: whether it was warned of, and what the guard's advice is worth."""
    by_edge = "is inverted" in reason and "blade is lower" not in reason
    if by_edge and not any("the edge" in each for each in model.warnings):
        return Outcome("unexplained", f"no warning, and {reason}", case.kind)
    here = re.search(r"the sub-step here, (\S+) s", reason)
    step = 0.25 * (float(here[1]) if here else case.numerics.time_step)
    spread = model.wide_spread if "numerics.edge_spread" in reason else 0.0
    if spread > case.numerics.edge_spread:
        numerics = dc.replace(case.numerics, edge_spread=spread)
    elif "smaller numerics.time_step" in reason and step >= SHORTEST_STEP:
        numerics = dc.replace(case.numerics, time_step=step)
    else:
        return Outcome("stopped", reason, case.kind)
    after = cut_random_slice(dc.replace(case, numerics=numerics))
    if after.kind == "unexplained":
        return dc.replace(after, reason=f"as the guard advised, {after.reason}")
    return Outcome("stopped", reason, case.kind, advised=after.advised or after.kind)


def _wrong(
    result: SliceResult, model: CuttingModel, solver: CuttingSolver
) -> tuple[str, dict[str, float]]:
    """What no slice may do, or nothing; and the first two of its `MEASURES`."""
    balance, peak = result.balance, float(np.linalg.norm(result.food_wrench[:, 3:], axis=1).max())
    soft = peak / (model.material.youngs_modulus * model.section_area)
    rows = np.column_stack([result.food_wrench, result.board_wrench, result.cut])
    if not np.isfinite(rows).all():
        return f"a force is not finite at {result.time[~np.isfinite(rows).all(1)][0]:.4g} s", {}
    if np.diff(result.cut).min() < -1e-6:
        return "the cut closes", {}
    if result.cut[-1] < 1.0 - max(LEFT, YIELDS * soft):
        return f"the knife went to the board and {100 * result.cut[-1]:.1f} % are cut", {}
    losses = {
        name: getattr(balance, name)
        for name in ("edge", "opening", "friction", "board_friction", "blade")
    }
    losses["damping"] = balance.damping(result.energies)
    for name, loss in losses.items():
        # Rounding of single precision.
        if loss < -1e-4 * balance.work:
            return f"{name} gives energy: {loss:.3g} J", {}
    due, through = _work_of_cutting(model, solver, result.state)
    owed = (due - balance.edge - balance.opening) / through
    lack = abs(balance.residual(result.energies)) / max(abs(balance.work), 1e-6)
    errors = dict(zip(MEASURES, (lack, owed), strict=False))
    if result.cut[-1] < COMPLETE:
        del errors["work of edge and opening less than R A of what is cut"]
    # On what is left the edge does up to twice the work.
    if owed > model.numerics.work_error + 2.0 * (1.0 - result.cut[-1]):
        return f"edge and opening do {100 * owed:.1f} % less than toughness times the area", errors
    if lack > IMBALANCE:
        return f"the energy balance lacks {100 * lack:.1f} % of the knife's work", errors
    return "", errors


def _work_of_cutting(
    model: CuttingModel, solver: CuttingSolver, state: np.ndarray
) -> tuple[float, float]:
    """Toughness times area of what is cut and of the whole section, their skin included, J."""
    tables, skin = model.tables, model.effects.skin
    depth, entered = (
        solver.field(state, name)[: len(model.toughness)] for name in ("edge_depth", "skin_depth")
    )
    grid = np.linspace(-tables.reach, tables.reach, tables.fraction.shape[1])
    work = (model.toughness * tables.area)[:, None] * tables.fraction
    done = sum(float(np.interp(s, grid, row)) for s, row in zip(depth, work, strict=True))
    outline = 0.5 * skin.toughness * tables.outline
    through = np.clip(entered[:, None] / skin.thickness + tables.lower, 0.0, 1.0)
    return done + float((outline * through).sum()), float(work[:, -1].sum() + outline.sum())


def page_values(outcomes: list[Outcome], seed: int, command: str) -> dict[str, object]:
    """What the page of a study shows."""
    shapes = [shape for shape in SHAPES if shape in {outcome.shape for outcome in outcomes}]
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
    measured = []
    for name, limit in MEASURES.items():
        found = [100 * o.errors[name] for o in outcomes if o.kind == "cut" and name in o.errors]
        if found:
            sizes = (f"{each:.2g} %" for each in np.quantile(found, [0.5, 0.95, 1.0]))
            measured.append((name, len(found), *sizes, f"{100 * limit:g} %"))
    advised = [outcome.advised for outcome in outcomes if outcome.advised]
    return dict(
        command=command,
        slices=len(outcomes),
        seed=seed,
        measured=measured,
        checked=CHECKED,
        advised=len(advised),
        helped=advised.count("cut"),
        let_go=sum(bool(outcome.let_go) for outcome in outcomes),
        kinds=KINDS,
        rows=[(shape, *(counts[shape, kind] for kind in KINDS)) for shape in shapes]
        + [("all", *(sum(counts[shape, kind] for shape in shapes) for kind in KINDS))],
        peaks=np.quantile(peaks, [0.05, 0.5, 0.95]) if peaks else None,
        reasons={kind: found for kind, found in reasons.items() if found},
    )


def _gist(reason: str) -> str:
    """A reason without its numbers."""
    return "".join(c for c in reason if c.isalpha() or c == " ").split("is")[0][:60]
