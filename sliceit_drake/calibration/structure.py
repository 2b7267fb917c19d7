"""Which effects a food's curve asks for: nested comparison on depth that was left out.

It begins with a food that has none of them and takes, one after the other, the element that
predicts left-out depth best, as long as that gains `GAIN`. Fits stop in the minimum that is next,
and an element may belong to another one: all minima that were found go on to the next comparison.
At the end the setup's own food is compared on the setup's mesh: its elements may be nothing one by
one, and a thin skin is nothing on a coarse mesh.
Which elements are worth a fit from which minimum is told by a slice with each switched on, added to
the linear problem there. All else is computed on a coarse mesh: it is to choose, not to calibrate.
"""

import dataclasses as dc
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.calibrate import blocked_error, depth_blocks, fingerprint
from sliceit_drake.calibration.gauss_newton import (
    PRIOR_CENTER,
    PRIOR_VARIANCE,
    Linearisation,
    gauss_newton,
    linear_step,
    linearise,
    residuals_at,
)
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.configuration import dump_yaml, load_yaml
from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.foods.food import start_pose
from sliceit_drake.cutting.motion import Motion, MotionPlan, PressAndDraw
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.clock import EXCHANGE_PERIOD
from sliceit_drake.prediction.record_target import RecordTarget
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "Puncture",
    "StructureChoice",
    "choice_in",
    "choose_structure",
    "coarse_predictor",
    "find_puncture",
    "first_starts",
    "puncture_lines",
]

COARSE = 0.5
"""Elements along an edge, relative to those of the setup."""
STEPS, STEPS_OF_PLAIN = 5, 25
"""Most steps of each fit, and of the plain food's best: what that one has not come to yet would be
taken for the gain of an element."""
BLOCKS = 5
"""Of depth that are left out in turn."""
FITTED, OF_ONE = 5, 2
"""Most fits before an element is taken, and most of one element: those that promise most."""
FAR = 3.0
"""Error over that of the best minimum above which another one is given up."""
MUCH = 0.5
"""Share of the error on the records below which left-out depth is asked by fits, if it refuses."""
GAIN = 0.05
"""Part of the error on left-out depth by which an element must lower it."""
ALIKE = 0.1
"""Part of the error within which two structures fit alike."""
APART = 0.1
"""Part of the greatest force by which two predictions differ."""
DROP, WITHIN = 0.12, 2e-3
"""Part of a force, and depth in metres over which it falls, of a puncture."""
NOISES = 8.0
"""Standard deviations of the noise by which it falls at least: those of a thousand rows span 7."""
DEEPEST = 0.6
"""Part of the food's height above which a skin is punctured, or a wall."""
OFF = {
    "effects.skin.toughness": 0.0,
    "effects.bluntness.initiation": 0.0,
    "effects.core.toughness_ratio": 1.0,
    "effects.compliance.arm": 0.0,
}
"""Values that switch elements off."""


@dc.dataclass(frozen=True)
class Puncture:
    """A sudden fall of the force where the edge breaks through.

    Attributes:
        depth: Of the edge when it begins, metres.
        force: Before it, N.
        drop: By which it falls, N.
    """

    depth: float
    force: float
    drop: float


@dc.dataclass(frozen=True)
class _Element:
    """A part of a food's structure: its parameters, values of these from which fits begin, the
    element without which it is nothing, and the held sides in place of the setup's, if any."""

    name: str
    ranges: tuple[ParameterRange, ...]
    starts: tuple[tuple[float, ...], ...]
    needs: str = ""
    held_sides: str = ""


@dc.dataclass
class _Fitted:
    """A structure, fitted: its setup, as fine as the user's; values of all parameters; RMS error on
    the records and on left-out depth, N; the coarse predictor, and the fit's linear problem."""

    setup: CalibrationSetup
    values: dict[str, float]
    rms: float
    left_out: float
    predictor: Predictor
    at: Linearisation


@dc.dataclass
class StructureChoice:
    """What a curve asks for.

    Attributes:
        setup: With the elements that were taken.
        values: Of its parameters, a start for the calibration.
        taken: Names of the elements.
        lines: What was compared, and why each element was taken or left.
        warnings: Where structures fit alike and predict differently.
    """

    setup: CalibrationSetup
    values: dict[str, float]
    taken: list[str]
    lines: list[str]
    warnings: list[str]


Progress = Callable[[int, int, float], None]
"""Called with structures that are fitted, those in all, and the best error on the records, N."""


def choice_in(
    directory: Path,
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    workers: int | None = None,
    progress: Progress | None = None,
) -> StructureChoice:
    """The choice that a folder holds of the same setup and records, else a new one, written there
    as `structure.json` and `setup.yaml`.

    Args and Raises: as `choose_structure`.
    """
    notes, problem = directory / "structure.json", fingerprint(setup, records)
    if notes.exists():
        known = json.loads(notes.read_text(encoding="utf-8"))
        if known.pop("problem") == problem:
            return StructureChoice(load_yaml(CalibrationSetup, directory / "setup.yaml"), **known)
    choice = choose_structure(setup, records, workers, progress)
    directory.mkdir(parents=True, exist_ok=True)
    # A run may be killed at any line: notes that are there are whole, and of the setup beside.
    notes.unlink(missing_ok=True)
    dump_yaml(choice.setup, directory / "setup.yaml")
    content = {n: getattr(choice, n) for n in ("values", "taken", "lines", "warnings")}
    text = json.dumps({"problem": problem} | content, indent=2) + "\n"
    part = directory / "structure.json.part"
    part.write_text(text, encoding="utf-8")
    os.replace(part, notes)
    return choice


def find_puncture(target: RecordTarget) -> Puncture | None:
    """The first sudden fall of a record's force in the upper part of the food, if any."""
    force = np.linalg.norm(target.measured[:, :3], axis=1)
    depth, height = target.depth, target.facts.height
    inside = np.flatnonzero((depth > 0.0) & np.append(np.diff(depth) > 0.0, False))
    # Of neighbours, that differ by the noise of both; 1.48 medians are a standard deviation.
    least = NOISES * 1.48 / np.sqrt(2.0) * float(np.median(np.abs(np.diff(force))))
    found = None
    for k in inside[force[inside] > 0.2 * force.max()]:
        after = (depth > depth[k]) & (depth <= depth[k] + WITHIN) & (np.arange(len(depth)) > k)
        if depth[k] > DEEPEST * height or not after.any():
            continue
        if found is not None and depth[k] > found.depth + WITHIN:
            break
        lowest = int(np.flatnonzero(after)[force[after].argmin()])
        drop = float(force[k] - force[lowest])
        goes_on = depth[-1] > depth[k] + 2.0 * WITHIN
        if drop > max(DROP * force[k], least) and goes_on and (found is None or drop > found.drop):
            found = Puncture(float(depth[k]), float(force[k]), drop)
    return found


def puncture_lines(setup: CalibrationSetup, targets: Sequence[RecordTarget]) -> list[str]:
    """A sentence on the first record whose force falls as where a skin is punctured, if any."""
    found = next((p for p in map(find_puncture, targets) if p is not None), None)
    if found is None:
        return []
    known = any(r.name == "effects.skin.toughness" for r in setup.parameters)
    none = "" if known or setup.food.effects.skin.toughness > 0.0 else "; the setup has no skin"
    return [
        f"The force falls by {found.drop:.3g} of {found.force:.3g} N at a depth of "
        f"{1e3 * found.depth:.3g} mm, as where a skin is punctured{none}"
    ]


def choose_structure(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    workers: int | None = None,
    progress: Progress | None = None,
) -> StructureChoice:
    """Compares structures on the records, from the plainest to the one that is asked for.

    Args:
        setup: Food and ranges; ranges of elements that it lacks are usual ones.
        records: Of one food.
        workers: Threads.

    Raises:
        ConfigurationError: A record cannot be predicted.
        CuttingError: Nothing that was tried can be cut.
    """
    search = _Search(setup, records, workers, progress)
    while search.takes_another():
        pass
    search.say_what_is_left()
    search.compare_with_given()
    found = search.current
    return StructureChoice(found.setup, found.values, search.taken, search.lines, search.warnings)


class _Search:
    """What a nested comparison has found so far; arguments as `choose_structure`.

    Attributes:
        current: The best structure.
        taken: Names of its elements.
        lines, warnings: As in `StructureChoice`.
    """

    def __init__(
        self,
        setup: CalibrationSetup,
        records: Sequence[SliceRecord],
        workers: int | None,
        progress: Progress | None,
    ) -> None:
        self._setup, self._records, self._workers = setup, records, workers
        self._progress = progress
        plain = _without_elements(setup)
        first = coarse_predictor(plain, records, workers)
        height = max(t.facts.height for t in first.targets)
        free = all(r.metadata.food.support == "unknown" for r in records)
        self._elements = _elements(setup, height, free)
        self._minima = _best_first([_fit(first, plain, start) for start in first_starts(first)])
        if not self._minima:
            raise CuttingError("no start of the plainest structure could be cut; widen the ranges")
        best = self._minima[0]
        self.current = _fit(first, plain, best.values, STEPS_OF_PLAIN) or best
        self._minima[0] = self.current
        self.taken: list[str] = []
        self.warnings: list[str] = []
        self.lines = puncture_lines(setup, first.targets)
        self.lines.append(
            f"Plain food: {self.current.rms:.3f} N on the records, {self.current.left_out:.3f} N "
            "on left-out depth"
        )
        self._promised: dict[str, float] = {}
        self._last: dict[str, _Fitted] = {}
        self._done, self._in_all = 1, 1 + FITTED
        self._show(self.current.rms)

    def _show(self, best: float) -> None:
        if self._progress is not None:
            self._progress(self._done, max(self._in_all, self._done), best)

    def takes_another(self) -> bool:
        """Takes the element that predicts left-out depth best, if that gains enough."""
        fits = self._fits()
        by_name = {name: _best_first(own) for name, own in fits.items()}
        found = self._last = {name: own[0] for name, own in by_name.items() if own}
        gains = {n: 1.0 - f.left_out / self.current.left_out for n, f in found.items()}
        best = max(gains, key=lambda n: gains[n], default=None)
        if best is None or gains[best] < GAIN:
            return False
        for other, fit in found.items():
            if other != best and fit.left_out < (1.0 + ALIKE) * found[best].left_out:
                self.warnings += _alike(best, found[best], other, fit)
        change = _change(self.current, found[best])
        self.lines.append(f"{best}: taken. {change}{_layer(best, found[best].values)}")
        self.current, self._minima = found[best], by_name[best]
        self.taken.append(best)
        self._in_all = self._done + FITTED
        return len(self.taken) < len(self._elements)

    def _fits(self) -> dict[str, list[_Fitted | None]]:
        """Fits of the elements that promise most, from the best of what was found, by name."""
        trials: list[_Trial] = []
        for element in self._elements:
            if element.name in self.taken or (element.needs and element.needs not in self.taken):
                continue
            wider = _with_element(self.current.setup, element)
            predictor = coarse_predictor(wider, self._records, self._workers)
            own = _trials(element, wider, predictor, self._minima)
            self._promised[element.name] = max([t.promise for t in own], default=0.0)
            trials += own[:OF_ONE]
        trials.sort(key=lambda t: -t.promise)
        fits: dict[str, list[_Fitted | None]] = {}
        best = self.current.rms
        for trial in [t for t in trials[:FITTED] if t.promise > 0.5 * GAIN]:
            fit = _fit(trial.predictor, trial.setup, trial.start)
            fits.setdefault(trial.element.name, []).append(fit)
            best = best if fit is None else min(best, fit.rms)
            self._done += 1
            self._show(best)
        return fits

    def say_what_is_left(self) -> None:
        """Adds a line on each element that was not taken."""
        for element in self._elements:
            name = element.name
            if name in self.taken:
                continue
            if name in self._last:
                why = _change(self.current, self._last[name])
                self.lines.append(f"{name}: left. {why}")
            elif element.needs and element.needs not in self.taken:
                self.lines.append(f"{name}: left, without {element.needs} it is nothing")
            else:
                promise = 100.0 * max(self._promised[name], 0.0)
                self.lines.append(
                    f"{name}: left. A slice with it promises {promise:.0f} % on left-out depth"
                )

    def compare_with_given(self) -> None:
        """Takes the setup's own food instead, if on the setup's mesh that predicts left-out depth
        better by `GAIN` or more."""
        given = _elements_of(self._setup, self._elements)
        if not given or set(given) == set(self.taken):
            return
        named = f"The setup's own food, with {' and '.join(given)}"
        setup, values = self.current.setup, self.current.values
        fine = _fit(coarse_predictor(setup, self._records, self._workers, 1.0), setup, values)
        whole = _as_given(self._setup, self._records, self._workers)
        if fine is not None and whole is not None and _disagrees(fine, whole):
            fine, whole = _refitted(fine), _refitted(whole)
        if whole is None:
            self.lines.append(f"{named}: left, its slices break down")
        elif fine is not None and whole.left_out > (1.0 - GAIN) * fine.left_out:
            self.lines.append(f"{named}: left. {_change(fine, whole)}")
        else:
            change = "" if fine is None else f" On the setup's mesh: {_change(fine, whole)}"
            self.lines.append(f"{named}: taken instead.{change}")
            self.current, self.taken, self.warnings = whole, given, []


def _elements_of(setup: CalibrationSetup, elements: Sequence[_Element]) -> list[str]:
    """Names of the elements that the food of a setup has."""
    varied = {r.name for r in setup.parameters}
    known = {name.split(".")[1] for name in varied if name.startswith("effects.")}
    for name, off in OFF.items():
        _, group, field = name.split(".")
        if getattr(getattr(setup.food.effects, group), field) != off:
            known.add(group)
    return [
        e.name
        for e in elements
        if not e.needs and e.ranges and e.ranges[0].name.split(".")[1] in known
    ]


def _as_given(
    setup: CalibrationSetup, records: Sequence[SliceRecord], workers: int | None
) -> _Fitted | None:
    """The setup as it is, fitted on its mesh; None where its slices break down."""
    predictor = coarse_predictor(setup, records, workers, 1.0)
    return _fit(predictor, setup, first_starts(predictor)[0])


def _disagrees(before: _Fitted, after: _Fitted) -> bool:
    """Whether records ask for a structure that the error on left-out depth refuses."""
    return after.left_out > (1.0 - GAIN) * before.left_out and after.rms < MUCH * before.rms


def _refitted(fit: _Fitted) -> _Fitted:
    """With the error on left-out depth of fits to the rest, in place of linear ones, which say
    anything of a block in which a slice snaps."""
    try:
        return dc.replace(fit, left_out=blocked_error(fit.predictor, fit.at.unit, BLOCKS).rms)
    except CuttingError:
        return fit


def _change(before: _Fitted, after: _Fitted) -> str:
    return (
        f"Left-out depth {before.left_out:.3f} to {after.left_out:.3f} N, on the records "
        f"{before.rms:.3f} to {after.rms:.3f} N"
    )


def _layer(taken: str, values: Mapping[str, float]) -> str:
    """What a core says of the layer around it: a thick skin is such a layer."""
    if taken != "core":
        return ""
    ratio, rind = (values[f"effects.core.{name}"] for name in ("toughness_ratio", "rind"))
    what = ", as a rind or a thick skin is" if ratio < 1.0 else ""
    return (
        f". The outer {1e3 * rind:.2g} mm are {1.0 / ratio:.2g} times as tough as the inside{what}"
    )


def _elements(setup: CalibrationSetup, height: float, free: bool) -> list[_Element]:
    """What may be taken; ranges are the setup's where it has them."""
    known = {r.name: r for r in setup.parameters}

    def ranged(name: str, low: float, high: float, scale: str = "log") -> ParameterRange:
        return known.get(name) or ParameterRange(name, low, high, scale, "usual")

    out = [
        _Element(
            "skin", (ranged("effects.skin.toughness", 1e-2, 10.0),), ((0.05,), (0.5,), (3.0,))
        ),
        _Element(
            "puncture",
            (ranged("effects.skin.thickness", 1e-4, 3e-3),),
            ((2e-4,), (2e-3,)),
            needs="skin",
        ),
        _Element(
            "blunt edge", (ranged("effects.bluntness.initiation", 10.0, 1e4),), ((100.0,), (1e3,))
        ),
        _Element(
            "core",
            (
                ranged("effects.core.toughness_ratio", 0.05, 5.0),
                ranged("effects.core.rind", 0.05 * height, 0.45 * height, "linear"),
            ),
            ((0.6, 0.2 * height), (1.6, 0.3 * height)),
        ),
        _Element("compliance", (ranged("effects.compliance.arm", 1e-6, 1e-3),), ((1e-5,), (2e-4,))),
    ]
    if free and setup.food.held_sides == "both":
        out.append(_Element("support on one side", (), ((),), held_sides="plus"))
    return out


def _without_elements(setup: CalibrationSetup) -> CalibrationSetup:
    """A setup whose food has none of the elements; ranges of the rest stay."""
    effects = setup.food.effects
    for name, value in OFF.items():
        _, group, field = name.split(".")
        effects = dc.replace(
            effects, **{group: dc.replace(getattr(effects, group), **{field: value})}
        )
    names = {r.name for e in _elements(setup, 1.0, False) for r in e.ranges}
    names |= {"effects.core.transition"}
    return dc.replace(
        setup,
        food=dc.replace(setup.food, effects=effects),
        parameters=[r for r in setup.parameters if r.name not in names],
    )


def _with_element(setup: CalibrationSetup, element: _Element) -> CalibrationSetup:
    food = setup.food
    if element.held_sides:
        food = dc.replace(food, held_sides=element.held_sides)
    return dc.replace(setup, food=food, parameters=[*setup.parameters, *element.ranges])


def _named(element: _Element, values: tuple[float, ...]) -> dict[str, float]:
    return {r.name: v for r, v in zip(element.ranges, values, strict=True)}


def coarse_predictor(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    workers: int | None,
    refinement: float = COARSE,
) -> Predictor:
    """Of records on a mesh that is coarser than the setup's, with the sub-step of the search."""
    coarse = dc.replace(setup, refinement=refinement * setup.refinement)
    return Predictor(coarse, records, setup.search_time_step, workers=workers)


def first_starts(predictor: Predictor) -> list[dict[str, float]]:
    """Values of the plain food from which fits begin: the setup's, with a toughness that the work
    of the curve is spent on, and places a quarter and three quarters into the ranges."""
    usual = {p.name: p.start for p in predictor.parameters}
    target = predictor.targets[0]
    way = np.clip(np.diff(target.depth, prepend=target.depth[0]), 0.0, None)
    work = float((np.linalg.norm(target.measured[:, :3], axis=1) * way).sum())
    area = max(target.facts.width * target.facts.height, 1e-9)
    starts = [usual | {"material.toughness": 0.7 * work / area}]
    for friction, modulus in ((0.25, 0.25), (0.5, 0.75)):
        at = {"material.friction": friction, "material.youngs_modulus": modulus}
        values = {p.name: p.value(at[p.name]) for p in predictor.parameters if p.name in at}
        starts.append(starts[0] | values)
    return starts


def _fit(
    predictor: Predictor, setup: CalibrationSetup, start: Mapping[str, float], steps: int = STEPS
) -> _Fitted | None:
    """The fit from a start, by name; None where slices break down."""
    try:
        fit = gauss_newton(predictor, predictor.places(start), steps=steps, tolerance=1e-3)
        at = fit.linearisation
        if not np.array_equal(at.unit, fit.unit):
            at = linearise(predictor, fit.unit)
    except CuttingError:
        return None
    rms = float(np.sqrt(np.mean(at.residuals[predictor.used] ** 2)))
    values = predictor.values(at.unit)
    return _Fitted(setup, values, rms, _left_out(predictor, at), predictor, at)


def _best_first(fits: Sequence[_Fitted | None]) -> list[_Fitted]:
    """Those that could be cut and are not far behind the best."""
    known = sorted([f for f in fits if f is not None], key=lambda f: f.rms)
    return [f for f in known if f.rms < FAR * known[0].rms]


@dc.dataclass
class _Trial:
    """A fit that may be worth while: the element that is added, setup and predictor with it, values
    to start from, and the part of the best error on left-out depth that it takes off in the linear
    problem."""

    element: _Element
    setup: CalibrationSetup
    predictor: Predictor
    start: dict[str, float]
    promise: float


def _trials(
    element: _Element, setup: CalibrationSetup, predictor: Predictor, minima: Sequence[_Fitted]
) -> list[_Trial]:
    """What an element promises from each minimum and start, best first: a slice in which it is
    switched on gives its derivative. A record's height and speed move with it: without the element
    they are where they make up for it."""
    before = min(_left_out(m.predictor, m.at, own=True) for m in minima)
    pairs = [(m, m.values | _named(element, s)) for m in minima for s in element.starts]
    units = [predictor.places(s) for _, s in pairs]
    out = []
    for (minimum, start), residuals in zip(pairs, residuals_at(predictor, units), strict=True):
        if np.isfinite(residuals).all():
            at = minimum.at
            wider = dc.replace(
                at,
                unit=np.append(at.unit, 0.0),
                jacobian=np.column_stack([at.jacobian, residuals - at.residuals]),
            )
            error = _left_out(minimum.predictor, wider, own=True)
            out.append(_Trial(element, setup, predictor, start, 1.0 - error / before))
    return sorted(out, key=lambda t: -t.promise)


def _left_out(model: Predictor, at: Linearisation, own: bool = False) -> float:
    """Root mean square error on blocks of depth, each predicted by a fit without it, N.

    The fits are linear, about the fit to all; what is a record's own stays unless `own` is set.
    """
    block, free = depth_blocks(model, BLOCKS), np.array([own or p.shared for p in model.parameters])
    free = np.append(free, np.full(len(at.unit) - len(free), True))
    variance = float(np.mean(at.residuals[model.used] ** 2))
    total = 0.0
    for k in range(BLOCKS):
        rest = (block != k) & model.used
        J, r = at.jacobian[rest], at.residuals[rest]
        H = J.T @ J + variance / PRIOR_VARIANCE * np.eye(len(at.unit))
        g = J.T @ r + variance / PRIOR_VARIANCE * (at.unit - PRIOR_CENTER)
        move = linear_step(H, g, at.unit, 0.0, free)
        held = (block == k) & model.used
        total += float(((at.residuals[held] + at.jacobian[held] @ move) ** 2).sum())
    return float(np.sqrt(total / model.used.sum()))


def _alike(name: str, one: _Fitted, other_name: str, other: _Fitted) -> list[str]:
    """A warning where two structures that fit alike predict another cut differently."""
    forces = [f for f in map(_other_cut, (one, other)) if f is not None]
    if len(forces) < 2:
        return []
    n = min(len(f) for f in forces)
    apart = float(np.sqrt(np.mean((forces[0][:n] - forces[1][:n]) ** 2)))
    greatest = float(max(f.max() for f in forces))
    if apart < APART * greatest:
        return []
    return [
        f"{name} and {other_name} fit alike ({one.left_out:.3f} and {other.left_out:.3f} N on "
        f"left-out depth), but a cut with as much draw as press they predict {apart:.2g} N apart, "
        f"of {greatest:.3g} N: record such a cut"
    ]


def _other_cut(fitted: _Fitted) -> np.ndarray | None:
    """Vertical force of a cut that draws as much as it presses [N], N; None if it breaks down."""
    target = fitted.predictor.targets[0]
    model = fitted.predictor.model(target, fitted.values)
    way = 0.95 * float(model.top - model.bottom)
    plan = MotionPlan([PressAndDraw(distance=way, draw_ratio=1.0)])
    (cut,) = simulate_batch([model], [Motion(plan, start_pose(model, 0.0))], EXCHANGE_PERIOD)
    return None if cut.failure else np.asarray(cut.food_wrench[:, 5])
