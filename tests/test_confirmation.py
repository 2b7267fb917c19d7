"""A named cause is simulated, and its value found there: derivatives at its null may mislead."""

from types import SimpleNamespace

import numpy as np
import pytest

from sliceit_drake.diagnosis.causes.material import ToughnessBySpeed
from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.confirm import confirm
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.prediction import Point

NOISE = 0.1
TIME = np.arange(0.0, 3.0, 0.005)
HELD = TIME > 2.0
SPEEDS = {"slow": -0.5, "fast": 0.5}
"""Decimal logarithms."""
COLUMN = Column("cause", "toughness_rate", "exponent", size=0.08, low=-0.5, high=0.5)


def force(condition: str, exponent: float) -> np.ndarray:
    """More for a faster knife; at rest it falls with an exponent above 0, and soon no further."""
    moving = 12.0 * (1.0 + 2.3 * SPEEDS[condition] * exponent)
    held = 12.0 - 5.0 * (1.0 - np.exp(-40.0 * max(exponent, 0.0)))
    depth = np.minimum(TIME / 0.3, 1.0)
    return np.where(HELD, held, moving) * depth


def record(condition: str, number: int, exponent: float) -> RecordSensitivity:
    noise = NOISE * np.random.default_rng([7, number]).normal(size=len(TIME))
    zero, high, low = (force(condition, e) for e in (0.0, COLUMN.size, -COLUMN.size))
    depth = np.where(HELD, 0.02, 0.01 * TIME)
    return RecordSensitivity(
        name=f"{condition}_{number}",
        condition=condition,
        channels=("force_z",),
        time=TIME,
        phase=np.where(HELD, "hold", "slice"),
        depth=depth,
        path=depth,
        in_contact=np.ones(len(TIME), bool),
        measured=(force(condition, exponent) + noise)[:, None],
        predicted=zero[:, None],
        columns=(0.5 * (high - low))[:, None, None],
        even=(0.5 * (high + low) - zero)[:, None, None],
    )


class Simulation:
    """The force itself in place of a simulator's."""

    model_with_food = object()

    def __init__(self, records: list[RecordSensitivity]) -> None:
        self.conditions = [r.condition for r in records]
        self.targets = [SimpleNamespace(compare=lambda w: w[:, :1]) for _ in records]

    def predict(self, points: list[Point], _: object) -> list[list[SimpleNamespace]]:
        (point,) = points
        (active,) = point.causes
        forces = [force(c, active.values["exponent"]) for c in self.conditions]
        return [[SimpleNamespace(wrench=np.repeat(f[:, None], 6, axis=1)) for f in forces]]


@pytest.mark.parametrize("exponent", [0.01, 0.02, 0.05])
def test_a_value_is_found_where_derivatives_at_null_are_of_a_bend(exponent):
    records = [record(c, k, exponent) for c in SPEEDS for k in range(3)]
    problem = LinearProblem(Sensitivities([COLUMN], records))
    cause = ToughnessBySpeed()
    first = {"exponent": 2.0 * exponent}
    found = confirm(problem, Simulation(records), [(cause, first)])
    assert found.holds
    assert found.values["toughness_rate"]["exponent"] == pytest.approx(exponent, rel=0.2)
