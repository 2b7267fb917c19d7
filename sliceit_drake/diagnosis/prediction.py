"""Predicts slices at a point: base parameters, how slices differ, causes at values."""

import copy
import dataclasses as dc
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cutting.bench_errors import ArmErrors, BenchErrors
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.parameters import get_parameter, with_parameters
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.prediction.clock import Clock
from sliceit_drake.prediction.record_target import Meshing, RecordTarget, make_targets
from sliceit_drake.prediction.series import ForceSeries
from sliceit_drake.prediction.simulator import Job, JobResult, Simulator, Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "RECORD_EFFECTS",
    "ActiveCause",
    "Point",
    "RecordEffect",
    "SlicePredictor",
    "changes_at",
]


@dc.dataclass(frozen=True)
class RecordEffect:
    """What differs from slice to slice.

    Attributes:
        name, unit: The unit is "" for the logarithm of a factor.
        size: Plausible standard deviation, and the step of the derivative.
        parameter: Of the cut that it multiplies; "" for none.
    """

    name: str
    unit: str
    size: float
    parameter: str = ""


RECORD_EFFECTS = (
    RecordEffect("toughness", "", 0.05, "material.toughness"),
    RecordEffect("stiffness", "", 0.05, "material.youngs_modulus"),
    RecordEffect("friction", "", 0.05, "material.friction"),
    RecordEffect("height", "m", 3e-4),
)
"""Logarithms of factors on toughness, modulus and friction of the slice; by how much it is taller
(where heights are only known from the force: by how much its knife is lower)."""
SPEED = RecordEffect("speed", "", 0.05)
"""Logarithm of a factor on the speed, of a record whose speed is not known."""


@dc.dataclass(frozen=True)
class ActiveCause:
    """A cause at values, by name, of its parameters and, if it has one, of its scan."""

    cause: Cause
    values: Mapping[str, float]


@dc.dataclass(frozen=True)
class Point:
    """Where slices are predicted.

    Attributes:
        values: Base parameters by dotted name; those of the setup's food otherwise.
        records: Values of `RECORD_EFFECTS` by the record's name; 0 otherwise.
        causes: What acts beside the base model, in the order in which it acts.
        rigid: Whether the arm is taken not to give.
        meshing: How finely; the predictor's first by default.
        only: Records to predict, by number; all by default.
    """

    values: Mapping[str, float] = dc.field(default_factory=dict)
    records: Mapping[str, Mapping[str, float]] = dc.field(default_factory=dict)
    causes: tuple[ActiveCause, ...] = ()
    rigid: bool = False
    meshing: Meshing | None = None
    only: tuple[int, ...] | None = None


class SlicePredictor:
    """Predicts records at points. Equal slices are simulated once.

    Args:
        setup: Food at its calibrated values, knife, board, bench, base parameters.
        records: What is predicted.
        meshings: How finely; the first is the default of a point.
        clock: How time is divided.
        cache: Folder in which finished simulations are kept, in `slices`.
        workers: What simulates.

    Raises:
        ConfigurationError: A record cannot be compared, naming file and field.
    """

    def __init__(
        self,
        setup: CalibrationSetup,
        records: Sequence[SliceRecord],
        meshings: Sequence[Meshing] = (Meshing(),),
        clock: Clock | None = None,
        cache: Path | None = None,
        workers: Workers = None,
    ) -> None:
        self.setup, self.clock = setup, clock or Clock()
        self.meshings = tuple(meshings)
        self.targets = make_targets(setup, records, self.meshings, self.clock)
        runs = None if cache is None else cache / "slices"
        self.board = dc.replace(setup.board, height=0.0)
        self.simulator = Simulator(self.clock, self.board, runs, workers)
        self._boards: dict[bytes, np.ndarray] = {}

    def of(self, setup: CalibrationSetup) -> "SlicePredictor":
        """What predicts the same records by another food or bench, sharing what was simulated."""
        other = copy.copy(self)
        other.setup, records = setup, [target.record for target in self.targets]
        other.targets = make_targets(setup, records, self.meshings, self.clock)
        return other

    def record_effects(self, target: RecordTarget) -> tuple[RecordEffect, ...]:
        """What may differ in a record from others like it."""
        if not target.facts.food:
            return ()
        return RECORD_EFFECTS + ((SPEED,) if target.speed_unknown else ())

    @property
    def model_with_food(self) -> CuttingModel | None:
        """The cut of the first record with food, at the setup's values; None without one."""
        return next((t.models[self.meshings[0]] for t in self.targets if t.models), None)

    def predict(
        self, points: Sequence[Point], progress: Callable[[int, int], None] | None = None
    ) -> list[list[ForceSeries | None]]:
        """Predicts all records, or those that a point names, at points.

        Returns:
            For each point a series a record, not finite if it broke down; None if it is not named.
        """
        return [
            [
                None if simulated is None else self._series(point, target, simulated)
                for target, simulated in zip(self.targets, row, strict=True)
            ]
            for point, row in zip(points, self.simulate(points, progress), strict=True)
        ]

    def series(self, point: Point, number: int) -> ForceSeries:
        """Predicts one record at a point."""
        series = self.predict([dc.replace(point, only=(number,))])[0][number]
        assert series is not None
        return series

    def simulate(
        self, points: Sequence[Point], progress: Callable[[int, int], None] | None = None
    ) -> "list[list[_Slice | None]]":
        """Simulates what `predict` will need, so that points can be predicted one by one."""
        plan = [
            [
                self._slice(point, k) if point.only is None or k in point.only else None
                for k in range(len(self.targets))
            ]
            for point in points
        ]
        some = [s for row in plan for s in row if s is not None and s.job is not None]
        results = self.simulator.run([s.job for s in some if s.job is not None], progress)
        for simulated, result in zip(some, results, strict=True):
            simulated.result = result
        return plan

    def bench(self, point: Point) -> BenchErrors:
        """What the bench does otherwise at a point."""
        bench = self.setup.bench
        for active in point.causes:
            bench = active.cause.bench(bench, active.values)
        return dc.replace(bench, arm=ArmErrors()) if point.rigid else bench

    def model(self, point: Point, target: RecordTarget) -> CuttingModel:
        """The cut of a record at a point."""
        model = target.models[point.meshing or self.meshings[0]]
        model = with_parameters(model, dict(point.values)) if point.values else model
        own = point.records.get(target.facts.name, {})
        factors = {
            e.parameter: get_parameter(model, e.parameter) * float(np.exp(own[e.name]))
            for e in RECORD_EFFECTS
            if e.parameter and own.get(e.name)
        }
        model = with_parameters(model, factors) if factors else model
        for active in point.causes:
            model = active.cause.model(model, active.values, active.cause.visible(target.facts))
        bench = self.bench(point)
        given = {"arm": bench.arm.compliance, "holder": bench.mounting.compliance}
        more = {f"effects.compliance.{name}": x for name, x in given.items() if x}
        if more:
            more = {name: float(get_parameter(model, name)) + x for name, x in more.items()}
            model = with_parameters(model, more)
        return target.as_cut(model)

    def _slice(self, point: Point, number: int) -> "_Slice":
        """What must be simulated."""
        target = self.targets[number]
        own = point.records.get(target.facts.name, {})
        R, p = target.R, target.p
        speed, height = own.get("speed", 0.0), own.get("height", 0.0)
        lower = height if target.height_unknown else 0.0
        if speed or lower:
            p = target.moved(lower, float(np.exp(speed)))
        for k, active in enumerate(point.causes):
            values, force = active.values, None
            if active.cause.uses_force:
                before = dc.replace(point, causes=point.causes[:k])
                force = self.series(before, number).wrench[:, 3:]
            R, p = active.cause.motion(
                R, p, target.grid, values, active.cause.visible(target.facts), force
            )
        bench = self.bench(point)
        p = p - np.array([0.0, 0.0, bench.board.height]) if bench.board.height else p
        if bench.arm != ArmErrors():
            parts = self.series(dc.replace(point, rigid=True), number).parts
            pressed = np.sum([parts[name][:, 5] for name in parts if name != "weight"], axis=0)
            rise = bench.arm.rise(p[:, 2], self.clock.period, pressed, target.facts.food)
            p = p + rise[:, None] * [0.0, 0.0, 1.0]
        if target.stretches is None:
            return _Slice(None, R, p, Effects())
        at_food = p
        if height and not target.height_unknown:
            # It lies on the board: what is half as high is higher by half of that.
            higher = height * np.maximum(p[:, 2] / target.facts.height, 0.0)
            at_food = p - higher[:, None] * [0.0, 0.0, 1.0]
        # A knife whose record is over rests.
        ends = np.minimum(target.stretches.ends, len(p) - 1)
        model, name = self.model(point, target), target.facts.name
        effects, cut = model.effects, model
        if effects.changes_force:
            cut = copy.copy(model)
            cut.effects = effects.of_cut()
        job = Job(cut, R[ends], at_food[ends], target.stretches, name)
        return _Slice(job, R, p, effects)

    def _series(self, point: Point, target: RecordTarget, simulated: "_Slice") -> ForceSeries:
        R, p, result = simulated.R, simulated.p, simulated.result
        rise = target.rise(result)
        if rise.any():
            p = p + rise[:, None] * [0.0, 0.0, 1.0]
        key = R.tobytes() + p.tobytes()
        if key not in self._boards:
            self._boards[key] = target.board(self.board, R, p)
        series = target.series(result, self._boards[key], simulated.effects)
        series.wrench = self.shown(series, target, point)
        return series

    def shown(self, series: ForceSeries, target: RecordTarget, point: Point) -> np.ndarray:
        """The wrench of a series of a record as it would be measured at a point [N, 6]."""
        bench, facts, seen = self.bench(point), target.facts, copy.copy(series)
        seen.wrench = bench.shown(seen.parts, seen.R, seen.v, seen.time, facts.tared)
        for active in point.causes:
            seen.wrench = active.cause.wrench(seen, active.values, active.cause.visible(facts))
        return seen.wrench


def changes_at(
    point: Point,
    predictor: SlicePredictor,
    progress: Callable[[int, int], None] | None = None,
) -> list[np.ndarray | None]:
    """What a point changes the prediction of each record by [m, c], N and Nm; None where its slice
    breaks down."""
    out: list[np.ndarray | None] = []
    null, moved = predictor.predict([Point(), point], progress)
    for target, *ends in zip(predictor.targets, null, moved, strict=True):
        wrenches = [series.wrench for series in ends if series is not None]
        seen = target.compare(np.stack(wrenches, axis=2))
        change = seen[:, :, 1] - seen[:, :, 0]
        out.append(change if np.isfinite(change).all() else None)
    return out


@dc.dataclass
class _Slice:
    """A job, none without food; the poses of the knife over the board at the grid; the effects of
    the food; its result."""

    job: Job | None
    R: np.ndarray
    p: np.ndarray
    effects: Effects
    result: JobResult | None = None
