"""What a food's file knows of its simulation's error, and slices of an uneven food.

The sensitivities are given shapes: no slice is simulated.
"""

import dataclasses as dc
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_records import NOISE, VARIATION
from test_diagnosis import problem

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.foods.known_error import KnownError, KnownErrorOfCut
from sliceit_drake.diagnosis.diagnose import _with_known
from sliceit_drake.diagnosis.evidence.columns import (
    MESH,
    Column,
    RecordSensitivity,
    Sensitivities,
)
from sliceit_drake.diagnosis.evidence.confirm import predicted_at
from sliceit_drake.diagnosis.evidence.effect_size import OwnError
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.own_values import centred_own
from sliceit_drake.diagnosis.evidence.screen import screen
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule
from sliceit_drake.diagnosis.known_error import (
    RESTING,
    known_of,
    way_of,
    with_known_error,
)
from sliceit_drake.diagnosis.prediction import Point
from sliceit_drake.prediction.discrepancy import Covariates, motion_shapes

STEP = 5e-4


def record() -> RecordSensitivity:
    """A press with a rest of 0.8 s in its middle, 2 mm of it in the air."""
    return problem(1).found.records[0]


def known(speed: float, slices: int = 6) -> KnownError:
    """One channel: 1 N for each centimetre of the way."""
    values = [100.0 * STEP * (k - 1) for k in range(80)]
    cut = KnownErrorOfCut(speed, 0.0, [values])
    return KnownError(channels=["force_z"], step=STEP, cuts=[cut], slices=slices)


def own_speed(record: RecordSensitivity) -> float:
    return float(10.0 ** Covariates.of(record.time, record.depth, record.path).speed)


def test_what_is_known_goes_along_the_way_and_is_of_cuts_of_one_kind():
    r = record()
    way = way_of(r)
    moving = np.abs(np.gradient(r.depth, r.time)) > 1e-4
    assert way[np.argmax(r.depth > 0.0)] == 0.0
    assert way[-1] == pytest.approx(0.02 + RESTING * 0.8, rel=0.05)
    assert np.diff(way)[~moving[1:]].min() > 0.0
    there = known_of(known(1.05 * own_speed(r)), r)
    inside = way > -STEP
    np.testing.assert_allclose(there[inside, 0], 100.0 * way[inside], atol=1e-9)
    assert not there[way < -2.0 * STEP].any()
    # Of a cut of another speed nothing is known, nor of a channel that was not measured then.
    assert known_of(known(1.3 * own_speed(r)), r) is None
    found = Sensitivities(problem(1).found.columns, [r])
    assert with_known_error(found, known(1.3 * own_speed(r))) is None
    assert not known_of(known(own_speed(r)), dc.replace(r, channels=("force_x",))).any()


def test_what_is_known_on_one_mesh_is_not_put_to_another():
    found = Sensitivities(problem(1).found.columns, [record()])
    given = dc.replace(known(own_speed(record())), refinement=0.75)
    used, remarks = _with_known(found, given, [], 0.75)
    assert used.known_from == 6 and not remarks
    same, (remark,) = _with_known(found, given, [], 1.0)
    assert same is found and "a mesh of refinement 0.75, and this is 1" in remark


def test_what_is_known_is_no_own_error_and_stays_where_slices_are_predicted_anew():
    found = problem(5).found
    speeds = {own_speed(r) for r in found.records}
    given = known(min(speeds))
    given.cuts = [dc.replace(given.cuts[0], speed=speed) for speed in speeds]
    wrong = Sensitivities(
        found.columns,
        [dc.replace(r, measured=r.measured + known_of(given, r)) for r in found.records],
    )
    less = LinearProblem(with_known_error(wrong, given))
    plain = LinearProblem(found)
    # But for rows in which what is known bends, as where the knife stops: they count for less.
    squares, others = less.moments.gram[:, -1, -1], plain.moments.gram[:, -1, -1]
    np.testing.assert_allclose(squares, others, rtol=0.03)
    again = less.predicting([r.predicted for r in wrong.records])
    np.testing.assert_allclose(again.moments.gram, less.moments.gram, rtol=1e-9)


def test_a_file_keeps_what_is_known_and_refuses_what_is_no_table(tmp_path):
    given = CalibratedFood(known_error=known(0.02))
    dump_yaml(given, tmp_path / "food.yaml")
    assert load_calibrated_food(tmp_path / "food.yaml").known_error == given.known_error
    cut = given.known_error.cuts[0]
    for values in ([], [[]], [[1.0], [2.0]]):
        bad = dc.replace(given.known_error, cuts=[cut, dc.replace(cut, values=values)])
        dump_yaml(dc.replace(given, known_error=bad), tmp_path / "bad.yaml")
        with pytest.raises(ConfigurationError, match=r"known_error\.cuts\[1\]\.values") as error:
            load_calibrated_food(tmp_path / "bad.yaml")
        assert "Calibrate again" in str(error.value) and "bad.yaml" in str(error.value)


def slices(seed: int, texture: float, replicates: int = 4, known_from: int = 0) -> LinearProblem:
    """Slices that differ by a smooth function of the depth, in no column, of `texture`, N."""
    found = problem(seed, replicates=replicates).found
    rng = np.random.default_rng(seed)
    records = []
    for r in found.records:
        s = motion_shapes(r.time, r.depth, r.path, r.in_contact, r.depth.max(), r.height)[0]
        wave = s[:, 2:6] @ rng.normal(size=4)
        records.append(dc.replace(r, measured=r.measured + texture * wave[:, None]))
    sensitivities = Sensitivities(found.columns, records, known_from=known_from)
    return LinearProblem(sensitivities, may_be_uneven=True)


def test_an_uneven_food_is_neither_noise_nor_an_error_of_the_simulation():
    even, rough = slices(11, 0.0), slices(11, 1.0)
    # Where the noise explains the differences, nothing else does.
    assert not even.uneven.any()
    assert rough.noise[0].deviation == pytest.approx(NOISE, rel=0.35)
    assert rough.differences[0].deviation > 2.5 * rough.noise[0].deviation
    # The means of four slices differ from condition to condition by half of what slices do.
    left = OwnError.beside(rough, []).values
    assert np.sqrt(np.mean(np.concatenate(left) ** 2)) < 0.3
    assert rough.variation[0] == pytest.approx(VARIATION / 0.05, rel=1.0)


def test_slices_from_which_an_error_is_known_differ_as_well():
    alone, twice = slices(11, 1.0), slices(11, 1.0, known_from=12)
    # But for what a finer mesh would change, which is part of what is known.
    assert alone.mesh is not None and twice.mesh is None and not twice.numerical
    np.testing.assert_allclose(twice.uneven, np.sqrt(2.0) * alone.uneven, rtol=1e-3)
    np.testing.assert_allclose(twice.variation, np.sqrt(2.0) * alone.variation, rtol=1e-3)


def test_a_sensor_is_as_late_as_it_was_in_the_records_that_an_error_is_known_from():
    found = problem(3).found
    late = Column("cause", "sensor_delay", "delay", size=0.01)
    records = [
        dc.replace(r, columns=np.concatenate([r.columns, 0.1 * r.columns[:, :, :1]], axis=2))
        for r in found.records
    ]
    alone, then = (
        LinearProblem(Sensitivities([*found.columns, late], records, known_from=n)) for n in (0, 9)
    )
    (usual,), (less,) = alone.usual.values(), then.usual.values()
    assert usual == pytest.approx(0.1) and less == pytest.approx(0.01)
    # Where next to nothing is usual, more size is asked for.
    rule, e = DecisionRule(), screen(alone, 20).evidence("sensor_delay")
    assert rule.least_size(alone, e) == rule.size_usual < rule.size_known
    assert rule.least_size(then, e) == rule.size_known


def test_a_simulation_is_wrong_by_a_tenth_beyond_what_is_known():
    found = problem(3).found
    alone, then = (LinearProblem(dc.replace(found, known_from=n)) for n in (0, 9))
    away = then.discrepancy.prior.flat - alone.discrepancy.prior.flat
    channels = len(found.records[0].channels)
    np.testing.assert_allclose(away, [np.log(0.1)] * channels + [0.0] * (len(away) - channels))


def test_slices_are_uneven_where_they_are_cut_and_not_on_the_bare_board():
    found = slices(11, 1.0).found
    first = found.records[0]
    moved = np.ptp(first.depth) * np.linspace(-1.0, -0.1, len(first.time))
    board = dc.replace(
        first, condition="board", depth=np.where(first.depth > 0.0, 1e-4, moved), height=0.0
    )
    both = Sensitivities(found.columns, [*found.records, board, board])
    problem_of_both = LinearProblem(both, may_be_uneven=True)
    at = list(problem_of_both.conditions).index("board")
    assert problem_of_both.uneven.any() and not problem_of_both.levels[at].any()
    model = problem_of_both.with_causes()
    z = np.count_nonzero(problem_of_both.uneven)
    assert not problem_of_both._own_variance(model, len(both.records) - 1)[-z:].any()
    assert problem_of_both._own_variance(model, 0)[-z:].all()


def test_slices_differ_about_the_mean_of_their_condition_where_an_error_is_known_or_learnt():
    found = problem(7, replicates=4).found
    toughness = found.index("record")
    # What the simulation gets wrong of one condition is no property of its slices.
    records = [
        dc.replace(r, measured=r.measured + 3.0 * k * r.columns[:, :, toughness[0]])
        for k, r in zip([0] * 4 + [1] * 4 + [2] * 4, found.records, strict=True)
    ]
    shifted = Sensitivities(found.columns, records)
    plain, learnt = LinearProblem(shifted), LinearProblem(shifted, may_be_uneven=True)
    assert np.abs(centred_own(plain).mean(0)).max() < 1e-9
    assert np.ptp([centred_own(plain)[m].mean() for m in plain.conditions.values()]) > 2.0
    for members in learnt.conditions.values():
        assert np.abs(centred_own(learnt)[members].mean(0)).max() < 1e-9


def test_less_is_asked_of_an_effect_where_what_looks_like_it_is_known():
    rule, e = DecisionRule(), screen(slices(11, 1.0), 20).evidence("skin")
    assert rule.least_size(slices(11, 1.0), e) == rule.size
    assert rule.least_size(slices(11, 1.0, known_from=12), e) == rule.size_known < rule.size


@pytest.mark.parametrize("known_from", [0, 12])
def test_what_is_simulated_is_seen_on_the_finer_mesh_also_where_an_error_is_known(known_from):
    of = slices(11, 0.0, known_from=known_from)
    records = of.found.records
    (mesh,) = of.found.index("numerical", MESH.name)
    coarse = [r.predicted + r.columns[:, :, mesh] for r in records]
    assert any(r.columns[:, :, mesh].any() for r in records)
    predictor = SimpleNamespace(
        predict=lambda *_: [[SimpleNamespace(wrench=values) for values in coarse]],
        targets=[SimpleNamespace(compare=lambda values: values)] * len(records),
    )
    again = predicted_at(Point(), of, predictor).found.records
    for now, before in zip(again, records, strict=True):
        np.testing.assert_allclose(now.predicted, before.predicted)
