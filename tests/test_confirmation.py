"""A named cause is simulated, and its value found there: derivatives at its null may mislead."""

import numpy as np
import pytest
from curve_simulation import HELD, TIME, CurveSimulation, curve_record

from sliceit_drake.diagnosis.causes.material import ToughnessBySpeed
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.confirm import confirm
from sliceit_drake.diagnosis.evidence.linear import LinearProblem

SPEEDS = {"slow": -0.5, "fast": 0.5}
"""Decimal logarithms."""
COLUMN = Column("cause", "toughness_rate", "exponent", size=0.08, low=-0.5, high=0.5)


def force(condition: str, exponent: float) -> np.ndarray:
    """More for a faster knife; at rest it falls with an exponent above 0, and soon no further."""
    moving = 12.0 * (1.0 + 2.3 * SPEEDS[condition] * exponent)
    held = 12.0 - 5.0 * (1.0 - np.exp(-40.0 * max(exponent, 0.0)))
    depth = np.minimum(TIME / 0.3, 1.0)
    return np.where(HELD, held, moving) * depth


@pytest.mark.parametrize("exponent", [0.01, 0.02, 0.05])
def test_a_value_is_found_where_derivatives_at_null_are_of_a_bend(exponent):
    records = [curve_record(force, COLUMN, c, k, exponent) for c in SPEEDS for k in range(3)]
    problem = LinearProblem(Sensitivities([COLUMN], records))
    cause = ToughnessBySpeed()
    first = {"exponent": 2.0 * exponent}
    found = confirm(problem, CurveSimulation(records, force), [(cause, first)])
    assert found.holds
    assert found.values["toughness_rate"]["exponent"] == pytest.approx(exponent, rel=0.2)
