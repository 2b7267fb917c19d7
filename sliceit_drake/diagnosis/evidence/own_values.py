"""Records seen from their own height, toughness, modulus and friction instead of the mean slice's.

Where the force bends sharply in depth, as where the last of the food is cut just above the board,
slices that lie some tenths of a millimetre higher or lower do not average to the mean slice: to
first order in each slice's height alone their mean is a smoother bend, as of a softer board. And
where the knife enters, a slice that lies half a millimetre lower is not what twice a quarter does.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity
from sliceit_drake.diagnosis.evidence.held_out import own_coefficients
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.sensitivity import Progress
from sliceit_drake.diagnosis.prediction import Point, SlicePredictor, changes_at
from sliceit_drake.prediction.discrepancy import PHASES, motion_phases
from sliceit_drake.tables import interpolated

__all__ = ["HEIGHT", "at_own_values", "centred_own", "farther_in"]

HEIGHT = "height"
"""Of what is a record's own, what moves the place at which the knife meets a part of the food."""
STEEP = 20.0
"""Greatest way of the knife over the depth that it goes by there."""
PASSES = 2
"""Times that own values are found, each where the records were simulated the time before."""


def at_own_values(
    problem: LinearProblem,
    predictor: SlicePredictor | None = None,
    progress: Progress | None = None,
) -> LinearProblem:
    """A problem with the columns of each record's own at their values.

    A change c b + e b^2 is linearised at the b that fits the record best, less the mean over all
    records, which may be another cause's doing; where an error is known or learnt, less the mean of
    the record's condition, which is part of that. For what e does where that mean is the slices'
    own, there is a numerical column of each. Beyond the step of the derivative e b^2 goes on in a
    straight line, as it does past a sharp bend. What is known of a kind of cut goes by the place in
    the slice.

    Args:
        problem: The sensitivities where no record differs from the others.
        predictor: What simulates the records at their own values, which are then found once more
            (`PASSES`); without one, and where a slice breaks down there, the change is that of
            second order.
        progress: Called with the number of simulated slices, and of those that must be.
    """
    found, own = problem.found, problem.own
    added = [Column("numerical", f"mean_{found.columns[k].name}") for k in own]
    sizes = {found.columns[k].name: found.columns[k].size for k in own}
    height = next((i for i, k in enumerate(own) if found.columns[k].name == HEIGHT), None)
    again = problem
    for done in range(1 if predictor is None else PASSES):
        values = centred_own(again)
        changes: list[np.ndarray | None] = [None] * len(values)
        if predictor is not None:
            changes = _simulated(predictor, sizes, values, _of_all(progress, done))
        records = [
            _moved(record, own, b, change)
            for record, b, change in zip(found.records, values, changes, strict=True)
        ]
        if height is not None and found.known_from:
            size, k = sizes[HEIGHT], own[height]
            records = [
                _with_known_there(record, k, size, float(b[height]))
                for record, b in zip(records, values, strict=True)
            ]
        here = dc.replace(found, columns=[*found.columns, *added], records=records)
        again = LinearProblem(here, may_be_uneven=problem.may_be_uneven)
    return again


def centred_own(problem: LinearProblem) -> np.ndarray:
    """Coefficients of what is each record's own [R, n], less their mean: over all records, or where
    an error is known or learnt over the record's condition."""
    values = own_coefficients(problem)
    groups = problem.conditions.values() if problem.may_be_uneven else [range(len(values))]
    for members in map(list, groups):
        values[members] -= values[members].mean(0)
    return values


def farther_in(record: RecordSensitivity, taller: float) -> np.ndarray:
    """How much farther the knife is on its first way through a slice that is taller [m], metres: as
    much as it is `taller`, metres, at its top, where it goes straight down, and nothing at the
    board, on which it lies."""
    going, _ = motion_phases(record.time, record.depth, record.path)
    above = np.arange(len(going)) < int(np.argmax(record.depth > 0.0))
    down = np.gradient(record.depth, record.time)
    steep = np.gradient(record.path, record.time) / np.maximum(down, 1e-9)
    first = (down > 0.0) & (above | (going == PHASES.index("in")))
    share = np.maximum(1.0 - record.depth / record.height, 0.0)
    return np.where(first, taller * share * np.minimum(steep, STEEP), 0.0)


def _known_of_taller(record: RecordSensitivity, taller: float) -> np.ndarray:
    """What is known of a record where its slice is taller [m, c]."""
    assert record.known is not None
    farther = farther_in(record, taller)
    moved = np.append(True, np.diff(record.path) > 0.0)
    there = interpolated(record.path + farther, record.path[moved], record.known[moved])
    return np.where(farther[:, None] != 0.0, there, record.known)


def _with_known_there(
    record: RecordSensitivity, k: int, size: float, b: float
) -> RecordSensitivity:
    """A record in which what is known goes by the place in its slice, to first order about b sizes
    by which this is taller, the number of column k."""
    if record.known is None or not record.cut:
        return record
    here, up, down = (_known_of_taller(record, s * size) for s in (b, b + 1.0, b - 1.0))
    tangent, columns = 0.5 * (up - down), record.columns.copy()
    columns[:, :, k] += tangent
    bent = here - record.known - b * tangent
    return dc.replace(
        record, predicted=record.predicted + bent, columns=columns, bent=record.bent + bent
    )


def _of_all(progress: Progress | None, before: int) -> Progress | None:
    """Progress over all `PASSES`, after some."""
    if progress is None:
        return None
    return lambda done, total: progress(before * total + done, PASSES * total)


def _simulated(
    predictor: SlicePredictor,
    sizes: dict[str, float],
    values: np.ndarray,
    progress: Progress | None,
) -> list[np.ndarray | None]:
    """What the own values [R, n] change the prediction by, of each record [m, c]; None where its
    slice breaks down."""
    own = {
        target.facts.name: {
            name: b * size for (name, size), b in zip(sizes.items(), row.tolist(), strict=True)
        }
        for target, row in zip(predictor.targets, values, strict=True)
    }
    return changes_at(Point(records=own), predictor, progress)


def _moved(
    record: RecordSensitivity, own: list[int], b: np.ndarray, change: np.ndarray | None
) -> RecordSensitivity:
    even = record.even[:, :, own].astype(float)
    inside = np.clip(b, -1.0, 1.0)
    columns = record.columns.astype(float)
    columns[:, :, own] += 2.0 * even * inside
    # The tangent at b, where the change is e b^2 within the step and e (2 |b| - 1) beyond it.
    bent = -(even * inside**2).sum(2) if change is None else change - columns[:, :, own] @ b
    return dc.replace(
        record,
        predicted=record.predicted + bent,
        columns=np.concatenate([columns, even], axis=2),
        even=np.concatenate([record.even, np.zeros_like(record.even[:, :, own])], axis=2),
        bent=bent,
    )
