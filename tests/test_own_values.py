"""Slices that differ are each seen from their own height, not from the mean slice's."""

import dataclasses as dc
from types import SimpleNamespace

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.own_values import at_own_values
from sliceit_drake.diagnosis.known_error import mean_error
from sliceit_drake.diagnosis.prediction import Point

HEIGHT = 3e-4
DEVIATION = 0.1
COLUMNS = [
    Column("base", "material.toughness", size=0.05),
    Column("record", "height", size=HEIGHT, unit="m", per_record=True),
]


def bend(depth: np.ndarray, height: float = 0.0) -> np.ndarray:
    """A force that falls, and rises where the board is touched at 20 mm less the food's height."""
    way = depth - 0.02 + height
    return 12.0 - 400.0 * depth + 1.5 * np.logaddexp(0.0, way / 2e-4)


def record(number: int, height: float, rng: np.random.Generator) -> RecordSensitivity:
    depth = np.linspace(0.0, 0.021, 500)
    force, high, low = (bend(depth, h) for h in (0.0, HEIGHT, -HEIGHT))
    column = np.stack([force, 0.5 * (high - low)], axis=1)
    even = np.stack([np.zeros_like(force), 0.5 * (high + low) - force], axis=1)
    measured = bend(depth, height) + DEVIATION * rng.normal(size=len(depth))
    return RecordSensitivity(
        name=f"slice_{number}",
        condition="press",
        channels=("force_z",),
        time=depth / 0.02,
        phase=np.full(len(depth), "slice"),
        depth=depth,
        path=depth,
        in_contact=np.ones(len(depth), bool),
        measured=measured[:, None],
        predicted=force[:, None],
        columns=column[:, None, :],
        even=even[:, None, :],
    )


def session(heights: list[float]) -> LinearProblem:
    rng = np.random.default_rng(4)
    records = [record(k, h, rng) for k, h in enumerate(heights)]
    return LinearProblem(Sensitivities(COLUMNS, records))


def left(problem: LinearProblem) -> float:
    """What a fit of each record's own leaves at the bend, in the mean over records, over its
    standard error."""
    own = problem.own
    rest = []
    for r in problem.found.records:
        X = r.columns[:, 0, own]
        y = r.residual[:, 0]
        rest.append(y - X @ np.linalg.lstsq(X, y, rcond=None)[0])
    bent = (r.depth > 0.0195) & (r.depth < 0.0205)
    mean = np.mean(rest, axis=0)[bent]
    return float(np.sqrt((mean**2).mean()) / (DEVIATION / np.sqrt(len(rest))))


def test_a_bend_that_lies_higher_in_some_slices_is_not_taken_for_a_softer_one():
    first = session([-4e-4, 3e-4, -2e-4, 4e-4, -3e-4, 2e-4])
    again = at_own_values(first)
    assert left(first) > 4.0
    assert left(again) < 2.0


def test_slices_that_are_alike_stay_as_they_are():
    first = session([0.0] * 6)
    again = at_own_values(first)
    for a, b in zip(first.found.records, again.found.records, strict=True):
        assert b.bent is not None and np.abs(b.bent).max() < 0.1 * DEVIATION
        np.testing.assert_array_equal(a.columns[:, :, 0], b.columns[:, :, 0])
        np.testing.assert_allclose(a.predicted, b.predicted - b.bent)


def test_what_is_beyond_the_first_order_stays_in_other_predictions_and_counts_for_less():
    problem = at_own_values(session([-4e-4, 4e-4, 2e-4]))
    found = problem.found.records
    raised = problem.predicting([r.predicted - r.bent + 1.0 for r in found])
    for old, new in zip(found, raised.found.records, strict=True):
        np.testing.assert_allclose(new.predicted, old.predicted + 1.0)
    plain = dc.replace(found[0], bent=None)
    more = problem.model_error(found[0]) ** 2 - problem.model_error(plain) ** 2
    np.testing.assert_allclose(more, 0.25 * found[0].bent ** 2, atol=1e-12)


class Simulation:
    """The force itself in place of a simulator's."""

    def __init__(self, problem: LinearProblem) -> None:
        self.targets = [
            SimpleNamespace(facts=SimpleNamespace(name=r.name), compare=lambda w: w[:, :1])
            for r in problem.found.records
        ]
        self.depth = problem.found.records[0].depth

    def predict(self, points: list[Point], _: object) -> list[list[SimpleNamespace]]:
        return [
            [self.series(point, target.facts.name) for target in self.targets] for point in points
        ]

    def series(self, point: Point, name: str) -> SimpleNamespace:
        force = bend(self.depth, point.records.get(name, {}).get("height", 0.0))
        return SimpleNamespace(wrench=np.repeat(force[:, None], 6, axis=1))


def test_slices_far_from_the_mean_are_simulated_where_they_are():
    first = session([-9e-4, 1.1e-3, -3e-4, 8e-4, -9e-4, 2e-4])
    again = at_own_values(first, Simulation(first))
    assert left(at_own_values(first)) > 4.0
    assert left(again) < 2.0


def test_a_slice_that_breaks_down_at_its_own_values_is_seen_to_second_order():
    first = session([-4e-4, 4e-4, 2e-4])

    class BreaksDown(Simulation):
        def series(self, point: Point, name: str) -> SimpleNamespace:
            found = super().series(point, name)
            found.wrench *= np.nan if point.records else 1.0
            return found

    found = at_own_values(first, BreaksDown(first))
    assert np.isfinite(found.moments.gram).all()
    assert left(found) < 2.0


def entry(depth: np.ndarray) -> np.ndarray:
    """What a simulation gets wrong where the knife enters, N, by the depth in the slice."""
    return -2.0 * np.exp(-(((depth - 1e-3) / 4e-4) ** 2))


def of_a_wrong_entry() -> list[RecordSensitivity]:
    rng, records = np.random.default_rng(5), []
    for k, height in enumerate([-4e-4, 3e-4, -2e-4, 4e-4, -3e-4, 2e-4]):
        r = record(k, height, rng)
        there = entry(r.depth + height * (1.0 - r.depth / 0.02))[:, None]
        records.append(dc.replace(r, height=0.02, measured=r.measured + there))
    return records


def test_what_is_learnt_of_slices_of_several_heights_is_not_smeared():
    """Cuts that end over the board: only what the simulation gets wrong shows the heights."""
    records = []
    for r in of_a_wrong_entry():
        rows = {n: v[r.depth < 0.019] for n, v in vars(r).items() if isinstance(v, np.ndarray)}
        records.append(dc.replace(r, **rows))
    known = mean_error(Sensitivities(COLUMNS, records))
    (values,) = np.array(known.cuts[0].values)
    depth = (np.arange(len(values)) - 1) * known.step
    assert known.slices == 6
    # The mean at equal places of the knife is wrong by 0.55 N.
    assert np.abs(values - entry(depth))[depth > 0.0].max() < 0.35


def test_what_is_known_goes_by_the_place_in_a_slice_that_is_taller():
    records = []
    for r in of_a_wrong_entry():
        known = entry(r.depth)[:, None]
        records.append(dc.replace(r, known=known, predicted=r.predicted + known))
    first = LinearProblem(Sensitivities(COLUMNS, records, known_from=6))
    again = at_own_values(first)

    def left_at_entry(problem: LinearProblem) -> float:
        rest = []
        for r in problem.found.records:
            X, y = r.columns[:, 0, problem.own], r.residual[:, 0]
            left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
            rest.append(left[r.depth < 2e-3])
        return float(np.std(rest)) / DEVIATION

    assert left_at_entry(first) > 3.0
    assert left_at_entry(again) < 1.3
