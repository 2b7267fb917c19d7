"""Records seen from their own height, toughness, modulus and friction instead of the mean slice's.

Where the force bends sharply in depth, as where the last of the food is cut just above the board,
slices that lie some tenths of a millimetre higher or lower do not average to the mean slice: to
first order in each slice's height alone their mean is a smoother bend, as of a softer board.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.held_out import own_coefficients
from sliceit_drake.diagnosis.evidence.linear import LinearProblem

__all__ = ["at_own_values"]


def at_own_values(problem: LinearProblem) -> Sensitivities:
    """The sensitivities of a problem, with the columns of each record's own at their values.

    To second order in them: a change c b + e b^2 is linearised at the b that fits the record best,
    less the mean over all records, which may be another cause's doing. For what e does where that
    mean is the slices' own, there is a numerical column of each. Beyond the step of the derivative
    e b^2 goes on in a straight line, as it does past a sharp bend.
    """
    found, own = problem.found, problem.own
    values = own_coefficients(problem)
    values -= values.mean(0)
    records = [_moved(record, own, b) for record, b in zip(found.records, values, strict=True)]
    added = [Column("numerical", f"mean_{found.columns[k].name}") for k in own]
    return dc.replace(found, columns=[*found.columns, *added], records=records)


def _moved(record: RecordSensitivity, own: list[int], b: np.ndarray) -> RecordSensitivity:
    even = record.even[:, :, own].astype(float)
    inside = np.clip(b, -1.0, 1.0)
    columns = record.columns.astype(float)
    columns[:, :, own] += 2.0 * even * inside
    # The tangent at b, where the change is e b^2 within the step and e (2 |b| - 1) beyond it.
    bent = -(even * inside**2).sum(2)
    return dc.replace(
        record,
        predicted=record.predicted + bent,
        columns=np.concatenate([columns, even], axis=2),
        even=np.concatenate([record.even, np.zeros_like(record.even[:, :, own])], axis=2),
        bent=bent,
    )
