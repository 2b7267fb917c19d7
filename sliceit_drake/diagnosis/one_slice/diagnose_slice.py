"""What a single record shows: a description of that slice, and never a diagnosis.

The unit of replication is the record. With one of them nobody can know how slices vary, so that
whatever is found here may be that slice's own. What can be done is done: the simulation is fitted
to the slice; what is left is taken for an autocorrelated process within the slice, and each cause
is asked how much of it it explains (generalised least squares, with the largest gain over all
causes calibrated by a parametric bootstrap), and how well blocks of depth are predicted that were
left out. Projected sensitivities say which causes such a motion cannot tell apart.
"""

import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.diagnose import BASE, Progress, setup_of_food
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.experiments.identifiability import SHIFT, Evidence, identifiability
from sliceit_drake.diagnosis.one_slice.slice_evidence import (
    LEVEL,
    CauseInSlice,
    SliceEvidence,
    slice_evidence,
)
from sliceit_drake.diagnosis.one_slice.slice_fit import OWN, depth_blocks, fit_slice
from sliceit_drake.diagnosis.one_slice.slice_result import MIN_GAIN, OneSlice
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.registry import open_causes
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["diagnose_slice", "setup_of_slice"]

CONFIRMED = 3
"""Most causes that are fitted by simulation."""
REFINED = 1.5
"""Elements along an edge of the mesh of the prediction, relative to that of its changes."""
END = 0.02
"""Last stretch of a record without a say in the evidence, s: the simulated knife comes to rest when
the record is over, and causes that go with speed or acceleration would be told by that."""


def setup_of_slice(food: CalibratedFood, refinement: float = 1.0) -> CalibrationSetup:
    """What is fitted to one slice: all that its calibration fitted, and `BASE`.

    A cause that the calibration has in the food already gets no second chance: it is free.
    """
    known = food.distribution
    parameters = [
        ParameterRange(name, low, high, "log" if log else "linear")
        for name, low, high, log in zip(known.names, known.low, known.high, known.log, strict=True)
    ]
    names = {p.name for p in parameters}
    parameters += [p for p in BASE if p.name not in names]
    return setup_of_food(food, refinement, parameters)


def diagnose_slice(
    setup: CalibrationSetup,
    record: SliceRecord,
    extra: Sequence[Cause] = (),
    cache: Path | None = None,
    replicates: int = 200,
    seed: int = 0,
    workers: Workers = None,
    progress: Progress | None = None,
    remarks: Sequence[str] = (),
) -> OneSlice:
    """Describes what one slice shows of the differences between food and simulation.

    Args:
        setup: Food, knife and board; its parameters are fitted to the slice.
        record: The slice.
        extra: Causes of the user's, beside the built-in ones.
        cache: Folder for simulations.
        replicates, seed: Of the bootstrap.
        workers: What simulates.
        progress: See `diagnose.Progress`.
        remarks: What is known already that a reader must know.

    Raises:
        ConfigurationError: The record cannot be compared.
        CuttingError: The slice breaks down at the calibrated values.
    """
    show = progress or (lambda *_: None)
    causes = open_causes([p.name for p in setup.parameters], extra)
    by_name = {c.name: c for c in causes}
    stages = 2 + CONFIRMED
    show("fits", 0, stages)
    predictor = SlicePredictor(setup, [record], cache=cache, workers=workers)
    (target,) = predictor.targets
    block = depth_blocks(target.depth, target.depth > 0.0)
    fit = fit_slice(predictor, block)
    show("fits", 1, stages)
    found = sensitivities(
        setup,
        [record],
        causes,
        point=fit.point,
        finer=REFINED,
        cache=cache,
        workers=workers,
        progress=lambda done, total: show("simulations", done, total),
    )
    whole = found.records[0]
    kept = whole.time < whole.time[-1] - END
    found = _rows(found, kept)
    precision = np.array([1.0 / u.spread**2 for u in fit.unknowns])
    own = [k for k, u in enumerate(fit.unknowns) if u.kind == "own"]
    evidence = slice_evidence(
        found, fit.jacobian[kept], precision, block[kept], replicates, seed, own
    )
    angles = identifiability(Evidence(_all_free(found)), causes, [0])
    result = OneSlice(
        record=whole,
        evidence=evidence,
        fit=fit,
        fits={},
        block=block,
        angles=angles,
        causes=by_name,
        remarks=[*remarks, *found.warnings],
        elements=found.elements,
    )
    show("fits", 2, stages)
    for done, c in enumerate(_promising(evidence), 3):
        _confirm(result, c, predictor, by_name[c.name])
        show("fits", done, stages)
    show("fits", stages, stages)
    for c in evidence.causes:
        alike = angles.equivalence_class(c.name)[1:]
        c.others = [*alike, *(name for name in c.others if name not in alike)]
    return result


def _rows(found: Sensitivities, kept: np.ndarray) -> Sensitivities:
    """The same with some rows of its one record."""
    (record,) = found.records
    series = {f.name: getattr(record, f.name) for f in dc.fields(record)}
    cut = {n: v[kept] for n, v in series.items() if isinstance(v, np.ndarray)}
    return Sensitivities(found.columns, [dc.replace(record, **cut)], found.warnings, found.elements)


def _promising(evidence: SliceEvidence) -> list[CauseInSlice]:
    """Causes that are worth a fit by simulation."""
    likely = [c for c in evidence.causes if c.p_value <= LEVEL]
    found = [c for c in evidence.causes if c.held_out <= (1.0 - MIN_GAIN) * evidence.held_out]
    found = sorted(found, key=lambda c: c.held_out)
    return [*likely, *(c for c in found if c not in likely)][:CONFIRMED]


def _confirm(
    result: OneSlice, evidence: CauseInSlice, predictor: SlicePredictor, cause: Cause
) -> None:
    """Fits a cause by simulation, and writes into its evidence what that shows."""
    fit = result.fit
    start = {u.name: float(x) for u, x in zip(fit.unknowns, fit.theta, strict=True)}
    own = fit_slice(predictor, result.block, cause, evidence.scan, start)
    result.fits[evidence.name] = own
    evidence.fitted = result.error(own.predicted)
    evidence.confirmed = result.error(own.held_out)
    evidence.values = own.values("cause")
    rows = [result.block == k for k in np.unique(result.block)]
    squares = np.array(
        [[r.sum() * result.error(f.held_out, r) ** 2 for r in rows] for f in (fit, own)]
    )
    evidence.blocks_better = int((squares[1] < squares[0]).sum())
    rest = np.arange(len(rows)) != np.argmax(squares[0] - squares[1])
    evidence.without_best = float(np.sqrt(squares[1, rest].sum() / squares[0, rest].sum()))


def _all_free(found: Sensitivities) -> Sensitivities:
    """The same with what is the record's own as free as what all share, and what slices differ in
    left out: in one slice it is the same as a shift of a base parameter."""
    keep, columns = [], []
    for k, c in enumerate(found.columns):
        if c.kind != "record":
            columns.append(c)
        elif c.name in OWN:
            # A shift that is plausible for a base parameter counts as one of this for height.
            size = c.size * SHIFT / OWN[c.name][1]
            columns.append(Column("base", f"own.{c.name}", size=size, unit=c.unit))
        else:
            continue
        keep.append(k)
    (record,) = found.records
    one = dc.replace(record, columns=record.columns[:, :, keep], even=record.even[:, :, keep])
    return Sensitivities(columns, [one], found.warnings, found.elements)
