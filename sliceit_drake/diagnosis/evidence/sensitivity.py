"""How each cause would change the prediction of slice records.

In short:

    setup = load_setup("cucumber.yaml")         # food at its calibrated values, base parameters
    found = sensitivities(setup, records, open_causes([p.name for p in setup.parameters]),
                          cache=Path("cache"), progress=lambda done, of: ...)
    for record in found.records:                # one a record, all its rows, air included
        record.measured, record.predicted       # [m, c], channels record.channels: force_x, ...
        record.columns                          # [m, c, K], change of the prediction
    for k, column in enumerate(found.columns):  # what column k is
        column.kind                             # base, record, numerical or cause
        column.name, column.parameter, column.scan, column.size

A column is the change of the prediction when the parameter goes from its null (or the point) by
`size`: for one that can go both ways (f(+size) - f(-size)) / 2, with the even part
(f(+size) + f(-size)) / 2 - f(0) in `even`, which a linear model does not have: their sum is the
change by plus `size` alone. A coefficient of 1 is a parameter of `size`.

- base: a base parameter, in all records at once; on a log scale `size` is of the logarithm.
- record: what differs from slice to slice (`prediction.RECORD_EFFECTS`); `size` is its plausible
  standard deviation, and each record has a coefficient of its own.
- numerical: `step` and `mesh`, the change from half the step to the step, and from a finer mesh to
  the mesh of the sensitivities. The prediction itself is that of the finer mesh.
- cause: a cause's parameter at a value of its scan. Where `per_record` is set, each record has a
  coefficient of its own.

`SlicePredictor.predict` gives finite changes and several causes at once, for a refit.
"""

import dataclasses as dc
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.content_store import ContentStore, content_key, source_key
from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import MESH, Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.prediction.clock import Clock
from sliceit_drake.prediction.record_target import Meshing, RecordTarget
from sliceit_drake.prediction.series import ForceSeries
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "FINER",
    "LINEAR_STEP",
    "LOG_STEP",
    "Progress",
    "sensitivities",
]

Progress = Callable[[int, int], None]
"""Called with the number of simulated slices, and of those that must be."""

FINER = 1.5
"""Elements along an edge of the mesh of the prediction, relative to that of its changes."""
LOG_STEP = 0.05
"""Change of the logarithm of a base parameter."""
LINEAR_STEP = 0.02
"""Change of one on a linear scale, relative to its range."""

STORED = ("in_contact", "predicted", "columns", "even")
"""Arrays of a record that take simulations."""


def _cause_columns(cause: Cause) -> list[tuple[Column, dict[str, float], dict[str, float] | None]]:
    """Columns of a cause, with the values at plus its size, and at minus where that may be."""
    out = []
    for value in cause.scan.values if cause.scan else (None,):
        at = cause.nulls()
        if cause.scan is not None and value is not None:
            at[cause.scan.name] = value
        for p in cause.parameters:
            sign = -1.0 if p.one_sided and p.null == p.high else 1.0
            up = at | {p.name: p.null + sign * p.size}
            down = None if p.one_sided else at | {p.name: p.null - p.size}
            column = Column(
                "cause",
                cause.name,
                p.name,
                value,
                sign * p.size,
                p.unit,
                p.one_sided,
                cause.per_record,
                cause.searched,
            )
            out.append((column, up, down))
    return out


def sensitivities(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    causes: Sequence[Cause],
    point: Point | None = None,
    meshing: Meshing | None = None,
    finer: float | None = FINER,
    clock: Clock | None = None,
    cache: Path | None = None,
    workers: Workers = None,
    progress: Progress | None = None,
) -> Sensitivities:
    """Computes sensitivities at a point.

    Args:
        setup: Food at its calibrated values, knife, board, base parameters.
        records: Slice records.
        causes: What may be wrong.
        point: Where; the setup's values without any cause by default.
        meshing: How finely the food is computed; the setup's refinement and a step of 0.5 ms by
            default.
        finer: Elements along an edge of the mesh of the prediction itself, relative to that of its
            changes; None for the same mesh, and no column `mesh`.
        clock: How time is divided.
        cache: Folder for finished simulations and sensitivities, found again by their content;
            some 6 MB a record.
        workers: What simulates.
        progress: Called with the number of simulated slices, and of those that must be.

    Raises:
        ConfigurationError: A record cannot be compared, naming file and field.
        CuttingError: The prediction itself broke down.
    """
    point, meshing, clock = point or Point(), meshing or Meshing(), clock or Clock()
    meshings = [meshing, dc.replace(meshing, time_step=0.5 * meshing.time_step)]
    if finer is not None:
        meshings.append(dc.replace(meshing, refinement=finer * meshing.refinement))
    runs = None if cache is None else cache / "slices"
    predictor = SlicePredictor(setup, records, meshings, clock, runs, workers)
    store = None if cache is None else ContentStore(cache / "sensitivities")

    def computed(some: Sequence[Cause], alone: bool, show: Progress | None) -> Sensitivities:
        kept = None
        if store is not None and not any(cause.adapts for cause in some):
            common = _common_key(setup, some, point, alone, meshing, finer, clock)
            if common is not None:
                by_slice = any(c.by_slice for c in (*some, *(a.cause for a in point.causes)))
                kept = _RecordStore(store, common, point, by_slice)
        return _Computation(predictor, point, some, alone).result(kept, show)

    # What replicates share is computed once for all of them.
    found = computed([c for c in causes if not (c.by_slice or c.adapts)], False, progress)
    for some in (
        [c for c in causes if c.by_slice and not c.adapts],
        [c.adapted(found.records) for c in causes if c.adapts],
    ):
        if some:
            found.append(computed(some, True, None))
    return found


class _Computation:
    """Sensitivities of one set of records.

    Args:
        predictor: Of the records.
        point: Where.
        causes: What may be wrong.
        alone: Whether there are to be columns of the causes alone.
    """

    def __init__(
        self,
        predictor: SlicePredictor,
        point: Point,
        causes: Sequence[Cause],
        alone: bool = False,
    ) -> None:
        self.predictor, self.point = predictor, point
        self.columns: list[Column] = []
        self.ends: list[tuple[Point, Point | None, float]] = []
        """Points at plus and minus the size of each column, and a factor on the change."""
        self.shown: list[tuple[int, Cause, dict[str, float], dict[str, float] | None]] = []
        """Columns that follow from the prediction without a simulation."""
        if not alone:
            for parameter in predictor.setup.parameters:
                self._add_base(parameter)
            effects = {e.name: e for t in predictor.targets for e in predictor.record_effects(t)}
            for effect in effects.values():
                column = Column(
                    "record", effect.name, size=effect.size, unit=effect.unit, per_record=True
                )
                up, down = (self._record_point(effect.name, s * effect.size) for s in (1.0, -1.0))
                self._add(column, up, down)
            for name, finer in zip(("step", "mesh"), predictor.meshings[1:], strict=False):
                self._add(Column("numerical", name), dc.replace(point, meshing=finer), None, -1.0)
        for cause in causes:
            for column, up_values, down_values in _cause_columns(cause):
                if not cause.simulates:
                    self.shown.append((len(self.columns), cause, up_values, down_values))
                    self._add(column, point, None)
                    continue
                other = None if down_values is None else self._cause_point(cause, down_values)
                self._add(column, self._cause_point(cause, up_values), other)

    def _add(self, column: Column, up: Point, down: Point | None, factor: float = 1.0) -> None:
        self.columns.append(column)
        self.ends.append((up, down, factor))

    def _add_base(self, parameter: ParameterRange) -> None:
        name = parameter.name
        start = self.point.values.get(name)
        if start is None:
            models = next((t.models for t in self.predictor.targets if t.models), None)
            if models is None:
                return
            start = float(get_parameter(models[self.predictor.meshings[0]], name))
        if parameter.scale == "log":
            size, high = LOG_STEP, start * float(np.exp(LOG_STEP))
            low = start * float(np.exp(-LOG_STEP))
        else:
            size = LINEAR_STEP * (parameter.high - parameter.low)
            high, low = start + size, start - size
        up, down = (
            dc.replace(self.point, values={**self.point.values, name: v}) for v in (high, low)
        )
        self._add(Column("base", name, size=size), up, down)

    def _record_point(self, effect: str, change: float) -> Point:
        own = {
            t.facts.name: dict(self.point.records.get(t.facts.name, {}))
            for t in self.predictor.targets
        }
        for values in own.values():
            values[effect] = values.get(effect, 0.0) + change
        return dc.replace(self.point, records=own)

    def _cause_point(self, cause: Cause, values: dict[str, float]) -> Point:
        return dc.replace(self.point, causes=(*self.point.causes, ActiveCause(cause, values)))

    def result(self, store: "_RecordStore | None", progress: Progress | None) -> Sensitivities:
        """All columns of all records; those that are known are not computed again."""
        predictor = self.predictor
        targets = predictor.targets
        warnings: list[str] = []
        known = [store.load(t, len(self.columns)) if store else None for t in targets]
        missing = tuple(k for k, found in enumerate(known) if found is None)
        if missing:
            points = [self.point, *(p for ends in self.ends for p in ends[:2] if p is not None)]
            points = [dc.replace(p, only=missing) for p in points]
            # First, because causes may ask for its force.
            predictor.simulate(points[:1])
            predictor.simulate(points, progress)
        records = []
        for number, found in enumerate(known):
            if found is None and store is not None:
                # A replicate may just have been computed.
                found = store.load(targets[number], len(self.columns))
            if found is None:
                found = self._record(number)
                if store is not None:
                    store.save(targets[number], *found)
            records.append(found[0])
            warnings += [f"{label}: {found[0].name} broke down" for label in found[1]]
        first = predictor.meshings[0]
        counts = [t.models[first].element_count for t in targets if t.models]
        return Sensitivities(self.columns, records, warnings, max(counts, default=0))

    def _record(self, number: int) -> tuple[RecordSensitivity, list[str]]:
        """A record, and labels of the columns whose slices broke down."""
        failed: list[str] = []
        target = self.predictor.targets[number]
        base = self._series(self.point, number)
        shown = {k: (cause, up, down) for k, cause, up, down in self.shown}
        wrenches, of = [base.wrench], []
        for k, (up, down, _) in enumerate(self.ends):
            if k in shown:
                cause, *values = shown[k]
                moved = [
                    cause.wrench(base, v, cause.visible(target.facts))
                    for v in values
                    if v is not None
                ]
            else:
                moved = [self._series(p, number).wrench for p in (up, down) if p is not None]
            of.append(range(len(wrenches), len(wrenches) + len(moved)))
            wrenches += moved
        # All at once: the filters of the record are made anew in each call.
        seen = target.compare(np.stack(wrenches, axis=2))
        predicted, changes = seen[:, :, 0], seen - seen[:, :, :1]
        if not np.isfinite(predicted).all():
            raise CuttingError(
                f"{target.facts.name}: the prediction broke down at the calibrated values"
            )
        record = _empty(target, target.at_rows(base.in_contact), predicted, len(self.columns))
        for k, (members, (_, _, factor)) in enumerate(zip(of, self.ends, strict=True)):
            change = changes[:, :, members.start : members.stop]
            if not np.isfinite(change).all():
                failed.append(self.columns[k].label)
            elif len(members) == 1:
                record.columns[:, :, k] = factor * change[:, :, 0]
                if self.columns[k] == MESH:
                    record.predicted = predicted + change[:, :, 0]
            else:
                record.columns[:, :, k] = 0.5 * factor * (change[:, :, 0] - change[:, :, 1])
                record.even[:, :, k] = 0.5 * factor * (change[:, :, 0] + change[:, :, 1])
        return record, failed

    def _series(self, point: Point, number: int) -> ForceSeries:
        (row,) = self.predictor.predict([dc.replace(point, only=(number,))])
        series = row[number]
        assert series is not None
        return series


def _empty(
    target: RecordTarget, in_contact: np.ndarray, predicted: np.ndarray, columns: int
) -> RecordSensitivity:
    facts = target.facts
    moved = np.linalg.norm(np.diff(target.p, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(moved)])
    return RecordSensitivity(
        name=facts.name,
        condition=facts.condition,
        slice_index=facts.slice_index,
        knife_slices=facts.knife_slices,
        speed=facts.speed,
        draw_ratio=facts.draw_ratio,
        channels=target.channels,
        time=target.time,
        phase=target.phase,
        depth=target.depth,
        path=np.interp(target.time, target.grid, way),
        in_contact=in_contact,
        compared=target.compared,
        measured=target.measured,
        predicted=predicted,
        columns=np.zeros((*predicted.shape, columns), np.float32),
        even=np.zeros((*predicted.shape, columns), np.float32),
    )


class _RecordStore:
    """Predictions of records and their changes that were computed before.

    What was measured does not matter: another cut along the same path is found at once.

    Args:
        store: Where they are.
        common: Key of all that does not differ between records.
        point: Where records are predicted.
        by_slice: Whether it matters which slice of the session a record is.
    """

    def __init__(self, store: ContentStore, common: str, point: Point, by_slice: bool) -> None:
        self._store, self._common, self._point = store, common, point
        self._by_slice = by_slice

    def _key(self, target: RecordTarget) -> str:
        metadata = dc.replace(target.record.metadata, name="", condition="")
        facts = dc.replace(target.facts, name="", condition="")
        if not self._by_slice:
            metadata = dc.replace(metadata, slice_index=0, knife_slices=None)
            facts = dc.replace(facts, slice_index=0, knife_slices=0)
        own = [dict(a.values) for a in self._point.causes]
        at = (self._point.records.get(target.facts.name), own)
        path = (target.time, target.grid, target.R, target.p)
        return content_key(self._common, metadata, facts, target.channels, at, *path)

    def load(
        self, target: RecordTarget, columns: int
    ) -> tuple[RecordSensitivity, list[str]] | None:
        arrays = self._store.load(self._key(target))
        if arrays is None:
            return None
        record = _empty(target, arrays["in_contact"], arrays["predicted"], columns)
        record.columns, record.even = arrays["columns"], arrays["even"]
        return record, arrays["failed"].tolist()

    def save(self, target: RecordTarget, record: RecordSensitivity, failed: list[str]) -> None:
        arrays = {name: getattr(record, name) for name in STORED}
        self._store.save(self._key(target), arrays | {"failed": np.array(failed, np.str_)})


def _common_key(
    setup: CalibrationSetup, causes: Sequence[Cause], point: Point, *options: object
) -> str | None:
    """Key of all that results depend on beside the record; None where the source of a cause cannot
    be read."""
    everything = [*causes, *(active.cause for active in point.causes)]
    try:
        code = source_key(__file__, *(inspect.getfile(type(cause)) for cause in everything))
    except (TypeError, OSError):
        return None
    facts = [(c.name, c.parameters, c.scan, c.per_record, vars(c)) for c in everything]
    active = [a.cause.name for a in point.causes]
    return content_key(code, facts, setup, point.values, active, point.meshing, options)
