"""How each cause would change the prediction of slice records.

A column is the change of the prediction when the parameter goes from its null (or the point) by
`size`: for one that can go both ways (f(+size) - f(-size)) / 2, with the even part
(f(+size) + f(-size)) / 2 - f(0) in `even`, which a linear model does not have: their sum is the
change by plus `size` alone. A coefficient of 1 is a parameter of `size`.

- base: a base parameter, in all records at once; on a log scale `size` is of the logarithm.
- record: what differs from slice to slice (`prediction.RECORD_EFFECTS`); `size` is its plausible
  standard deviation, and each record has a coefficient of its own.
- numerical: `step` and `mesh`, the change from half the step to the step, and from a finer mesh to
  the mesh of the sensitivities. The prediction itself is that of the finer mesh.
- cause: a cause's parameter at a value of its scan; with `per_record` one for each record.

`SlicePredictor.predict` gives finite changes and several causes at once, for a refit.
"""

import dataclasses as dc
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.content_store import ContentStore, content_key, source_key
from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import (
    MESH,
    STEP,
    Column,
    RecordSensitivity,
    Sensitivities,
)
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.prediction.record_target import Meshing, RecordTarget
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["FINER", "LINEAR_STEP", "LOG_STEP", "Progress", "sensitivities"]

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


@dc.dataclass(frozen=True)
class _Change:
    """What the prediction changes by in a column, times a factor: between points at plus its size
    and, where that may be, at minus; whether slices must be simulated for it."""

    column: Column
    ends: tuple[Point, ...]
    factor: float = 1.0
    simulates: bool = True


def _model_changes(predictor: SlicePredictor, point: Point) -> list[_Change]:
    """Base parameters, what differs from slice to slice, and the discretisation."""
    out = []
    for parameter in predictor.setup.parameters:
        name = parameter.name
        start = point.values.get(name)
        if start is None:
            if predictor.model_with_food is None:
                continue
            start = float(get_parameter(predictor.model_with_food, name))
        if parameter.scale == "log":
            size = LOG_STEP
            ends = start * float(np.exp(size)), start * float(np.exp(-size))
        else:
            size = LINEAR_STEP * (parameter.high - parameter.low)
            ends = start + size, start - size
        points = tuple(dc.replace(point, values={**point.values, name: v}) for v in ends)
        out.append(_Change(Column("base", name, size=size), points))
    targets = predictor.targets
    effects = [e for t in targets for e in predictor.record_effects(t)]
    for effect in dict.fromkeys(effects):
        column = Column("record", effect.name, size=effect.size, unit=effect.unit, per_record=True)
        moved = []
        for change in (effect.size, -effect.size):
            records = {t.facts.name: dict(point.records.get(t.facts.name, {})) for t in targets}
            for own in records.values():
                own[effect.name] = own.get(effect.name, 0.0) + change
            moved.append(dc.replace(point, records=records))
        out.append(_Change(column, tuple(moved)))
    for column, finer in zip((STEP, MESH), predictor.meshings[1:], strict=False):
        out.append(_Change(column, (dc.replace(point, meshing=finer),), -1.0))
    return out


def _cause_changes(cause: Cause, point: Point) -> list[_Change]:
    """Each parameter of a cause by its size, at each value of its scan."""
    out = []
    for value in cause.scan.values if cause.scan else (None,):
        for p in cause.parameters:
            steps = (p.step,) if p.one_sided else (p.step, -p.step)
            values = tuple(cause.nulls(value) | {p.name: p.null + step} for step in steps)
            traits = p.step, p.unit, p.one_sided, cause.per_record, cause.searched
            within = p.low - p.null, p.high - p.null
            column = Column("cause", cause.name, p.name, value, *traits, cause.alone, *within)
            ends = tuple(
                dc.replace(point, causes=(*point.causes, ActiveCause(cause, v))) for v in values
            )
            out.append(_Change(column, ends, simulates=cause.simulates))
    return out


def sensitivities(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    causes: Sequence[Cause],
    point: Point | None = None,
    finer: float | None = FINER,
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
        finer: Elements along an edge of the mesh of the prediction itself, relative to that of its
            changes; None for the same mesh, and no column `mesh`.
        cache: Folder for finished simulations and sensitivities, some 6 MB a record.
        workers: What simulates.
        progress: Called with the number of simulated slices, and of those that must be.

    Raises:
        ConfigurationError: A record cannot be compared, naming file and field.
        CuttingError: The prediction itself broke down.
    """
    point, meshing = point or Point(), Meshing()
    meshings = [meshing, dc.replace(meshing, time_step=0.5 * meshing.time_step)]
    if finer is not None:
        meshings.append(dc.replace(meshing, refinement=finer * meshing.refinement))
    predictor = SlicePredictor(setup, records, meshings, cache=cache, workers=workers)
    store = ContentStore(None if cache is None else cache / "sensitivities")

    def computed(
        changes: list[_Change], some: Sequence[Cause], show: Progress | None
    ) -> Sensitivities:
        common = None
        if cache is not None:
            common = _common_key(setup, some, point, not changes, finer)
        by_slice = setup.food.effects.entry.dulling > 0.0
        by_slice |= any(c.by_slice for c in (*some, *(a.cause for a in point.causes)))
        by_name = any(cause.adapts for cause in some)
        changes = changes + [change for cause in some for change in _cause_changes(cause, point)]
        computation = _Computation(predictor, point, changes, store, common, by_slice, by_name)
        return computation.result(show)

    # What replicates share is computed once for all of them.
    shared = [c for c in causes if not (c.by_slice or c.adapts)]
    found = computed(_model_changes(predictor, point), shared, progress)
    for some in (
        [c for c in causes if c.by_slice and not c.adapts],
        [c.adapted(found.records) for c in causes if c.adapts],
    ):
        if some:
            found.append(computed([], some, None))
    return found


@dc.dataclass
class _Computation:
    """Some columns of one set of records; records that are known are not computed again.

    What was measured does not matter, but to causes that adapt: another cut along the same path is
    found at once. `common` is the key of all that does not differ between records, None where
    nothing is kept; `by_slice` says whether it matters which slice of the session a record is, and
    `by_name` which record.
    """

    predictor: SlicePredictor
    point: Point
    changes: list[_Change]
    store: ContentStore
    common: str | None
    by_slice: bool
    by_name: bool

    def result(self, progress: Progress | None) -> Sensitivities:
        """All columns of all records."""
        targets = self.predictor.targets
        known = [self._load(target) for target in targets]
        missing = tuple(k for k, found in enumerate(known) if found is None)
        if missing:
            changed = (change.ends for change in self.changes if change.simulates)
            points = [self.point, *(p for ends in changed for p in ends)]
            points = [dc.replace(p, only=missing) for p in points]
            # First, because causes may ask for its force.
            self.predictor.simulate(points[:1])
            self.predictor.simulate(points, progress)
        records, warnings = [], []
        for number, (target, found) in enumerate(zip(targets, known, strict=True)):
            # A replicate may just have been computed.
            record, failed = found or self._load(target) or self._computed(number)
            records.append(record)
            warnings += [f"{label}: {record.name} broke down" for label in failed]
        first = self.predictor.meshings[0]
        counts = [t.models[first].element_count for t in targets if t.models]
        columns = [change.column for change in self.changes]
        return Sensitivities(columns, records, warnings, max(counts, default=0))

    def _computed(self, number: int) -> tuple[RecordSensitivity, list[str]]:
        """A record, and labels of the columns whose slices broke down."""
        failed: list[str] = []
        target = self.predictor.targets[number]
        base = self.predictor.series(self.point, number)
        wrenches, places = [base.wrench], []
        for change in self.changes:
            if change.simulates:
                moved = [self.predictor.series(p, number).wrench for p in change.ends]
            else:
                moved = [self.predictor.shown(base, target, p) for p in change.ends]
            places.append(slice(len(wrenches), len(wrenches) + len(moved)))
            wrenches += moved
        # All at once: the filters of the record are made anew in each call.
        seen = target.compare(np.stack(wrenches, axis=2))
        predicted, differences = seen[:, :, 0], seen - seen[:, :, :1]
        if not np.isfinite(predicted).all():
            raise CuttingError(
                f"{target.facts.name}: the prediction broke down at the calibrated values"
            )
        record = self._empty(target, target.at_rows(base.in_contact), predicted)
        for k, (place, change) in enumerate(zip(places, self.changes, strict=True)):
            moved = differences[:, :, place]
            up, down = moved[:, :, 0], moved[:, :, -1]
            if not np.isfinite(moved).all():
                failed.append(change.column.label)
            elif moved.shape[2] == 1:
                record.columns[:, :, k] = change.factor * up
                if change.column == MESH:
                    record.predicted = predicted + up
            else:
                record.columns[:, :, k] = 0.5 * change.factor * (up - down)
                record.even[:, :, k] = 0.5 * change.factor * (up + down)
        if self.common is not None:
            arrays = {name: getattr(record, name) for name in STORED}
            self.store.save(self._key(target), arrays | {"failed": np.array(failed, np.str_)})
        return record, failed

    def _load(self, target: RecordTarget) -> tuple[RecordSensitivity, list[str]] | None:
        arrays = None if self.common is None else self.store.load(self._key(target))
        if arrays is None:
            return None
        record = self._empty(target, arrays["in_contact"], arrays["predicted"])
        record.columns, record.even = arrays["columns"], arrays["even"]
        return record, arrays["failed"].tolist()

    def _key(self, target: RecordTarget) -> str:
        name = target.facts.name if self.by_name else ""
        metadata = dc.replace(target.record.metadata, name=name, condition="")
        facts = dc.replace(target.facts, name=name, condition="")
        if not self.by_slice:
            metadata = dc.replace(metadata, slice_index=0, knife_slices=None)
            facts = dc.replace(facts, slice_index=0, knife_slices=0)
        own = [dict(a.values) for a in self.point.causes]
        at = (self.point.records.get(target.facts.name), own)
        path = (target.time, target.grid, target.R, target.p)
        return content_key(self.common, metadata, facts, target.channels, at, *path)

    def _empty(
        self, target: RecordTarget, in_contact: np.ndarray, predicted: np.ndarray
    ) -> RecordSensitivity:
        nothing = np.zeros((*predicted.shape, len(self.changes)), np.float32)
        return RecordSensitivity(
            name=target.facts.name,
            condition=target.facts.condition,
            channels=target.channels,
            time=target.time,
            phase=target.phase,
            depth=target.depth,
            path=target.path,
            in_contact=in_contact,
            measured=target.measured,
            doubt=target.doubt,
            predicted=predicted,
            columns=nothing,
            even=np.zeros_like(nothing),
            height=target.facts.height,
            slice_index=target.facts.slice_index,
        )


def _common_key(
    setup: CalibrationSetup, causes: Sequence[Cause], point: Point, *options: object
) -> str | None:
    """Key of all that matters beside the record; None where a cause's source cannot be read."""
    everything = [*causes, *(active.cause for active in point.causes)]
    try:
        code = source_key(__file__, *(inspect.getfile(type(cause)) for cause in everything))
    except (TypeError, OSError):
        return None
    facts = [(c.name, c.parameters, c.scan, c.per_record, vars(c)) for c in everything]
    active = [a.cause.name for a in point.causes]
    return content_key(code, facts, setup, point.values, active, point.meshing, options)
