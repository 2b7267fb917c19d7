"""Records seen from their own height, toughness, modulus and friction instead of the mean slice's.

Where the force bends sharply in depth, as where the last of the food is cut just above the board,
slices that lie some tenths of a millimetre higher or lower do not average to the mean slice: to
first order in each slice's height alone their mean is a smoother bend, as of a softer board.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.diagnosis.held_out import own_coefficients
from sliceit_drake.diagnosis.linear import LinearProblem
from sliceit_drake.diagnosis.sensitivity import RecordSensitivity, Sensitivities

__all__ = ["at_own_values"]


def at_own_values(problem: LinearProblem) -> Sensitivities:
    """The sensitivities of a problem with the columns of each record's own at their values.

    To second order in them: a change c b + e b^2 is linearised at the b that fits the record best.

    Args:
        problem: About the mean slice.
    """
    own = problem.own
    records = [
        _moved(record, own, b)
        for record, b in zip(problem.found.records, own_coefficients(problem, own), strict=True)
    ]
    return dc.replace(problem.found, records=records)


def _moved(record: RecordSensitivity, own: list[int], b: np.ndarray) -> RecordSensitivity:
    even = record.even[:, :, own].astype(float)
    columns = record.columns.astype(float)
    columns[:, :, own] += 2.0 * even * b
    bent = -(even * b**2).sum(2)
    return dc.replace(record, predicted=record.predicted + bent, columns=columns, bent=bent)
