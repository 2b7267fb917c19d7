"""Records whose force is a known function of numbers of a cause, and that function in place of a
simulator: what is seen by derivatives, and what by simulation."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity
from sliceit_drake.diagnosis.prediction import Point

NOISE = 0.1
TIME = np.arange(0.0, 3.0, 0.005)
HELD = TIME > 2.0

Force = Callable[..., np.ndarray]
"""Of a condition and the values of the cause's numbers, at `TIME`."""


def curve_record(
    force: Force, column: Column, condition: str, number: int, hidden: float
) -> RecordSensitivity:
    """A record with noise, and the derivative of its force over the column's size at null."""
    noise = NOISE * np.random.default_rng([7, number]).normal(size=len(TIME))
    zero, high, low = (force(condition, e) for e in (0.0, column.size, -column.size))
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
        measured=(force(condition, hidden) + noise)[:, None],
        predicted=zero[:, None],
        columns=(0.5 * (high - low))[:, None, None],
        even=(0.5 * (high + low) - zero)[:, None, None],
    )


class CurveSimulation:
    """Predicts a force at the values of a cause's numbers."""

    model_with_food = object()

    def __init__(
        self,
        records: Sequence[RecordSensitivity],
        force: Force,
        numbers: Sequence[str] = ("exponent",),
    ) -> None:
        self.conditions = [r.condition for r in records]
        self.force, self.numbers = force, numbers
        self.targets = [SimpleNamespace(compare=lambda w: w[:, :1]) for _ in records]
        self.points: list[Point] = []

    def predict(self, points: Sequence[Point], _: object) -> list[list[SimpleNamespace]]:
        """Wrenches of all records at points, each component the force."""
        self.points += points
        rows = []
        for point in points:
            values = [sum(a.values.get(name, 0.0) for a in point.causes) for name in self.numbers]
            forces = [self.force(c, *values) for c in self.conditions]
            rows.append([SimpleNamespace(wrench=np.repeat(f[:, None], 6, axis=1)) for f in forces])
        return rows
