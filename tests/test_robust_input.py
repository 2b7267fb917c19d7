"""Spikes and missing rows count for little and are reported; what carries nothing is refused."""

import dataclasses as dc

import numpy as np
import pytest
from synthetic_records import COLUMNS, NOISE, SPEEDS, record
from test_diagnosis import problem
from test_diagnosis_input import CUCUMBER, slices

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.verdict import reach_verdict
from sliceit_drake.diagnosis.input_checks import check_records
from sliceit_drake.records.spikes import without_spikes

RNG_SEED = 5


def kicked(values: np.ndarray, size: float, share: float = 0.004) -> tuple[np.ndarray, np.ndarray]:
    """A series with some rows moved by `size` either way, and which [n]."""
    rng = np.random.default_rng(RNG_SEED)
    rows = rng.random(len(values)) < share
    rows[[0, -1]] = False
    signs = rng.choice((-1.0, 1.0), values.shape)
    return values + size * signs * rows[:, None], rows


def test_noise_steps_ramps_and_held_values_are_no_spikes():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 3.0, 1500)
    shapes = {
        "ramp": 8.0 * time,
        "step": np.where(time > 1.5, 15.0, 0.0),
        "peak": 20.0 * np.exp(-np.abs(time - 1.5) / 0.01),
        "waves": np.sin(2.0 * np.pi * 40.0 * time),
    }
    for name, shape in shapes.items():
        for noise in (0.0, 0.05):
            values = (shape + noise * rng.normal(size=len(time)))[:, None]
            for held in (1, 2, 4):
                series = np.repeat(values[::held], held, axis=0)
                clean, doubt = without_spikes(series)
                assert np.array_equal(clean, series), (name, noise, held)
                assert not doubt.any()


def test_a_spike_takes_its_neighbours_value_and_is_doubted_by_its_size():
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 3.0, 1500)
    values = np.column_stack([10.0 * time, 15.0 * np.sin(time)]) + 0.05 * rng.normal(size=(1500, 2))
    spoiled, rows = kicked(values, 1.5)
    clean, doubt = without_spikes(spoiled)
    assert rows.sum() >= 4
    assert (doubt[rows] == pytest.approx(1.5, abs=0.3)) and not doubt[~rows].any()
    assert np.abs(clean - values)[rows].max() < 0.2
    assert np.array_equal(clean[~rows], values[~rows])
    # In other units it is the same.
    scaled, doubted = without_spikes(1e3 * spoiled)
    assert scaled == pytest.approx(1e3 * clean) and doubted == pytest.approx(1e3 * doubt)


def test_spikes_leave_verdict_size_and_noise_as_they_are():
    plain = problem(20, rate=2.0)
    records = []
    for r in plain.found.records:
        measured, doubt = without_spikes(kicked(r.measured, 15.0 * NOISE, 0.01)[0])
        assert 0 < (doubt > 0.0).sum() < 10
        records.append(dc.replace(r, measured=measured, doubt=doubt))
    spoiled = LinearProblem(Sensitivities(plain.found.columns, records))
    assert spoiled.noise[0].deviation == pytest.approx(plain.noise[0].deviation, rel=0.03)
    (before,), (after,) = (reach_verdict(p, 60).findings for p in (plain, spoiled))
    assert after.names == before.names
    assert after.evidence.coefficients == pytest.approx(before.evidence.coefficients, rel=0.03)
    assert after.evidence.gain > 0.95 * before.evidence.gain


def test_a_row_that_is_doubted_says_next_to_nothing():
    plain = problem(21)
    r = plain.found.records[0]
    row = int(np.flatnonzero(r.in_contact)[80])
    wrong, doubt = r.measured.copy(), np.zeros_like(r.measured)
    wrong[row], doubt[row] = wrong[row] + 5.0, 5.0

    def squares(**changes) -> float:
        records = [dc.replace(r, **changes), *plain.found.records[1:]]
        found = Sensitivities(plain.found.columns, records)
        return float(LinearProblem(found, plain.noise, plain.variation).moments.gram[0][-1, -1])

    assert squares(measured=wrong, doubt=doubt) - squares() < 2.0
    assert squares(measured=wrong) - squares() > 100.0


def test_one_record_of_each_condition_gives_what_it_can():
    rng = np.random.default_rng(0)
    records = [record(f"at {speed}", speed, rng, {"skin": 4.0}, 0.0) for speed in SPEEDS]
    found = LinearProblem(Sensitivities(COLUMNS, records))
    assert not found.repeated
    verdict = reach_verdict(found, 60)
    assert verdict.kind == "too_few_replicates" and verdict.slices_needed == 2
    assert verdict.names and "skin" in verdict.names[0]


def test_spikes_and_missing_rows_are_reported_and_not_refused():
    records = slices()
    for r in records[:2]:
        # High enough to be taken for the contact, in the air before it.
        r.metadata.motion.phases = r.metadata.motion.phases[1:]
        r.metadata.motion.phases[0].start = 0.0
        r.force = r.force.copy()
        r.force[100, 1] += 8.0
    rng = np.random.default_rng(0)
    records[2] = records[2].rows(rng.random(len(records[2])) > 0.01)
    remarks = check_records(records, CUCUMBER)
    (spikes,) = [r for r in remarks if "stands out" in r]
    assert spikes.startswith("slice_0 1 of 1500, slice_1 1 of 1500:")
    (missing,) = [r for r in remarks if "missing" in r]
    assert missing.startswith("slice_2 ") and "of 1500" in missing


def test_a_record_of_nineteen_rows_is_refused_by_name():
    records = slices()
    records[1] = records[1].rows(np.arange(19) * 75)
    with pytest.raises(ConfigurationError, match="19 rows") as error:
        check_records(records, CUCUMBER)
    assert error.value.source == "slice_1.csv" and "40" in error.value.fix


def test_a_draw_that_meets_a_tenth_of_what_the_board_pushes_back_with_is_no_late_contact():
    records = slices()
    r = records[1]
    bottom = r.metadata.board_height
    down = r.phase("slice") & (r.position[:, 2] < bottom + 5e-4)
    assert down.any()
    r.force = r.force.copy()
    r.force[down, 2] += 20.0 * np.abs(r.force).max()
    check_records(records, CUCUMBER)
    # Where the sensor feels no more than in the air it begins at the board.
    r.force[~down] = np.random.default_rng(0).normal(0.0, 0.05, (int((~down).sum()), 3))
    with pytest.raises(ConfigurationError, match="below the top of the food") as error:
        check_records(records, CUCUMBER)
    assert error.value.field == "p_WK_z"


@pytest.mark.parametrize(("shift", "words"), [(0.01, "10 mm below"), (-0.01, "10 mm above")])
def test_a_board_that_is_not_under_its_food_is_refused_by_name(shift, words):
    records = slices()
    records[2].metadata.board_height += shift
    with pytest.raises(ConfigurationError, match=words) as error:
        check_records(records, CUCUMBER)
    assert error.value.source == "slice_2.yaml" and error.value.field == "board_height"
    # So is that of a record without food, against the food of the others.
    records[2].metadata.food.name = "none"
    with pytest.raises(ConfigurationError, match=words) as error:
        check_records(records, CUCUMBER)
    assert error.value.source == "slice_2.yaml"
    records[2].metadata.unknown.append("board_height")
    check_records(records, CUCUMBER)
