"""What is hidden in records of the stand-in is found, nothing is found in those where nothing is,
and what one motion cannot tell apart is said to be so.

Records are cut and diagnosed by simulation, on the coarse mesh of the study of hidden effects.
"""

import argparse
import html
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.cli import calibrate
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.diagnosis.causes.sensor import SensorDelay, SensorZero
from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
from sliceit_drake.diagnosis.evidence.held_out import held_out_gain
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.own_values import at_own_values
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.evidence.verdict import LAW
from sliceit_drake.diagnosis.known_error import learn_known_error
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.result import Diagnosis
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.spikes import without_spikes
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect_registry import make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import load_protocol
from sliceit_drake.stand_in.session import Session

PROTOCOL = load_protocol(str(resource_path("calibration/protocols/poor.yaml")))
WORLD = FiniteElementSettings(refinement=0.85, time_step=2e-4, travel=2e-4)
REFINEMENT = 0.75
"""Refinement of the diagnosis: coarser than the world, as a simulation is coarser than reality."""
REPLICATES = 100


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def cut(seed: int, *effects: str, slices: int = 6) -> list[SliceRecord]:
    """Slices in which effects are hidden."""
    session = Session(PROTOCOL, [make_effect(e) for e in effects], seed=seed, settings=WORLD)
    return [session.record(k) for k in range(slices)]


def diagnosis_of(cache: Path, seed: int, *effects: str, slices: int = 6) -> Diagnosis:
    """Diagnosis of such slices."""
    records = cut(seed, *effects, slices=slices)
    setup = setup_of_food(CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife), REFINEMENT)
    return diagnose(setup, records, cache=cache, replicates=REPLICATES, workers=1)


def error_on(cache: Path, records: list[SliceRecord], food: CalibratedFood, named: str) -> float:
    """Error that a food leaves in records, each predicted with base parameters of the others, N."""
    usual = [c for c in (SensorZero(), SensorDelay()) if c.name != named]
    setup = setup_of_food(food, REFINEMENT)
    found = sensitivities(setup, records, usual, cache=cache, workers=1)
    predictor = SlicePredictor(setup, records, cache=cache, workers=1)
    return held_out_gain(at_own_values(LinearProblem(found), predictor), []).after


@pytest.mark.parametrize("seed", [41, 43])
def test_nothing_is_found_where_nothing_is_hidden(cache, seed):
    result = diagnosis_of(cache, seed)
    assert result.verdict.kind == "nothing"
    assert result.verdict.screening.p_value > 0.1
    assert not result.verdict.findings and result.gain is None
    assert "Verdict: nothing" in result.table()
    assert "as close to these records" in result.sentence()
    upper, *_ = result.plot_overview().axes
    assert len([line for line in upper.lines if not line.get_label().startswith("_")]) == 2
    assert result.extended().food.effects == PROTOCOL.food.effects


@pytest.mark.parametrize(
    ("effect", "seed", "cause", "of_the_food"),
    [("blunt_edge:0.9", 53, "bluntness", True), ("sensor_drift:0.6", 57, "sensor_zero", False)],
)
def test_a_hidden_effect_is_found_alone(cache, tmp_path, effect, seed, cause, of_the_food):
    result = diagnosis_of(cache, seed, effect)
    assert result.verdict.kind == "cause"
    assert result.verdict.names == [[cause]]
    assert result.verdict.screening.p_value <= 1.0 / REPLICATES
    (finding,) = result.verdict.findings
    assert finding.share > 0.8
    assert result.gain is not None and result.gain.after < result.gain.before
    assert f"Supported: {cause}" in result.table()
    extended = result.extended()
    assert (extended.food.effects != PROTOCOL.food.effects) == of_the_food
    assert (extended.bench != BenchErrors()) != of_the_food
    assert not extended.note
    # The report begins with a picture and a sentence: the file's own prediction is drawn.
    assert cause in result.sentence() and f"{result.gain.after:.2g} N" in result.sentence()
    upper, lower, bars, intervals = result.plot_overview().axes
    drawn = {line.get_label(): line.get_ydata() for line in upper.lines}
    assert list(drawn)[:3] == ["measured", "simulated", f"simulated with {cause}"]
    measured, simulated, with_cause = list(drawn.values())[:3]
    assert any(
        np.array_equal(with_cause, r.predicted[:, c])
        for r in result.extension.found.records
        for c in range(len(r.channels))
    )
    assert np.std(measured - with_cause) < 0.6 * np.std(measured - simulated)
    assert cause in [label.get_text() for label in bars.get_yticklabels()]
    assert all(axis.get_xlabel() for axis in (lower, bars, intervals)) and upper.get_ylabel()
    result.save(tmp_path / "out")
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    text = html.escape(result.sentence())
    assert 0 < page.index("<img") < page.index(text) < page.index("<pre>")
    # Where the file is of quite another food, that is said whatever is found.
    assert "calibrate" not in text
    result.shifts = {"material.toughness": (2.1, 0.03), "material.friction": (1.3, 0.02)}
    assert result.sentence().endswith(
        "calibrate first: the file's food needs toughness times 2.10."
    )


def test_an_arm_that_gives_on_the_board_is_not_the_simulations_own_error(cache):
    protocol = load_protocol(str(resource_path("calibration/protocols/rich.yaml")))
    chosen = ("press", "press_fast", "draw_1")
    protocol.conditions = [c for c in protocol.conditions if c.label in chosen]
    effect = make_effect("arm_compliance:7.5e-6")
    session = Session(protocol, [effect], seed=67, settings=WORLD)
    records = [session.record(k) for k in range(len(session))]
    setup = setup_of_food(CalibratedFood(food=protocol.food, knife=protocol.knife), REFINEMENT)
    result = diagnose(setup, records, cache=cache, replicates=REPLICATES, workers=1)
    assert result.verdict.names == [["arm_compliance"]]
    (finding,) = result.verdict.findings
    assert finding.size > 1.5 and result.verdict.own_error < 0.04


@pytest.mark.second_tier
def test_a_food_half_as_stiff_is_followed_to_its_stiffness(cache):
    protocol = load_protocol(str(resource_path("calibration/protocols/rich.yaml")))
    chosen = ("press", "press_fast", "draw_1")
    protocol.conditions = [c for c in protocol.conditions if c.label in chosen]
    session = Session(protocol, [make_effect("stiffness:0.45")], seed=67, settings=WORLD)
    records = [session.record(k) for k in range(len(session))]
    setup = setup_of_food(CalibratedFood(food=protocol.food, knife=protocol.knife), REFINEMENT)
    result = diagnose(setup, records, cache=cache, replicates=REPLICATES, workers=1)
    assert result.verdict.kind == "nothing"
    assert result.shifts["material.youngs_modulus"][0] == pytest.approx(0.55, rel=0.15)
    assert result.sentence().startswith("With its youngs modulus times 0.5")
    material = result.extended().food.material
    assert material.youngs_modulus == pytest.approx(
        protocol.food.material.youngs_modulus * result.shifts["material.youngs_modulus"][0]
    )


@pytest.mark.parametrize(
    ("effect", "seed", "cause"),
    [("blunt_edge:0.9", 53, "bluntness"), ("sensor_drift:0.6", 57, "sensor_zero")],
)
def test_what_a_file_is_said_to_be_worth_it_is_worth_on_other_slices(
    cache, tmp_path, effect, seed, cause
):
    """Over four sessions: the error of six slices differs by a sixth from that of six others."""
    given = CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife)
    said, found = [], []
    for session in range(seed, seed + 4):
        result = diagnosis_of(cache, session, effect)
        said.append((result.gain.before, result.gain.after))
        dump_yaml(result.extended(), tmp_path / "extended.yaml")
        for more in (1000, 2000):
            fresh = cut(session + more, effect)
            foods = given, load_calibrated_food(tmp_path / "extended.yaml")
            found.append([error_on(cache, fresh, food, cause) for food in foods])
    (said_before, said_after), (before, after) = (
        np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (said, found)
    )
    assert after == pytest.approx(said_after, rel=0.1)
    assert before - after == pytest.approx(said_before - said_after, rel=0.1)


def test_what_was_so_at_the_calibration_is_not_named_again(cache, tmp_path):
    """A skin that the model has not stands for a law that is wrong; then the sensor drifts."""
    given = CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife)
    setup = setup_of_food(given, REFINEMENT)
    before, after = cut(61, "skin:2.5"), cut(62, "skin:2.5", "sensor_drift:0.6")
    given.known_error = learn_known_error(setup, before, cache, workers=1)
    dump_yaml(given, tmp_path / "food.yaml")
    known = load_calibrated_food(tmp_path / "food.yaml").known_error
    settings = {"cache": cache, "replicates": REPLICATES, "workers": 1}
    # Unless that is known, the law is wrong by more than three times the noise beside the sensor.
    plain, found = (diagnose(setup, after, **settings, known=k) for k in (None, known))
    assert plain.verdict.misfit > 3.0
    assert found.verdict.names == [["sensor_zero"]] and found.verdict.misfit < 0.6
    assert found.extended().known_error == known
    assert "skin" not in {e.name for s in found.verdict.screenings for e in s.causes if e.score > 0}
    # Where nothing has changed nothing is named, though a skin would be without the file.
    same = cut(63, "skin:2.5")
    plain, found = (diagnose(setup, same, **settings, known=k) for k in (None, known))
    assert "skin" in plain.verdict.names[0] and not found.verdict.names
    # Of the records that it was learnt from it can say nothing.
    again = diagnose(setup, before, **settings, known=known)
    assert again.verdict.names and again.problem.found.known_from == 0
    assert any("cannot tell what has changed" in remark for remark in again.remarks)


def test_a_calibration_adds_what_it_gets_wrong_to_the_file_or_says_why_not(tmp_path, capsys):
    dump_yaml(CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife), tmp_path / "food.yaml")
    records = cut(61, "skin:2.0", slices=2)
    options = argparse.Namespace(output=tmp_path, workers=1, other_food=False)
    learn = calibrate._learn_known_error
    learn([record.rows(np.arange(19) * 20) for record in records], options)
    assert "What the simulation gets wrong is not in food.yaml: " in capsys.readouterr().out
    assert load_calibrated_food(tmp_path / "food.yaml").known_error is None
    learn(records, options)
    known = load_calibrated_food(tmp_path / "food.yaml").known_error
    # The skin that the food has not: some N where the edge enters, and what two slices show of it.
    (cuts,) = known.cuts
    vertical = cuts.values[known.channels.index("force_z")]
    assert known.slices == 2 and 0.5 < np.abs(vertical).max() < 50.0


def test_spikes_and_missing_rows_change_no_verdict(cache):
    """0.4 % of the samples kicked by 1.5 N, and 1 % of one record's rows lost."""
    # So strong that one of the depths that are tried is clearly the best.
    records = cut(53, "blunt_edge:1.2")
    rng = np.random.default_rng(0)
    for k, record in enumerate(records):
        # Of a good record nothing is taken for a spike.
        assert not without_spikes(record.force)[1].any()
        kick = (rng.random(record.force.shape) < 0.004) * rng.choice(
            (-1.5, 1.5), record.force.shape
        )
        record.force = record.force + kick
        if k == 2:
            records[k] = record.rows(rng.random(len(record)) > 0.01)
    setup = setup_of_food(CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife), REFINEMENT)
    plain = diagnosis_of(cache, 53, "blunt_edge:1.2")
    result = diagnose(setup, records, cache=cache, replicates=REPLICATES, workers=1)
    assert result.verdict.names == plain.verdict.names == [["bluntness"]]
    assert len([r for r in result.remarks if "stands out" in r or "missing" in r]) == 2
    (before,), (after,) = (r.verdict.findings for r in (plain, result))
    size = before.evidence.coefficients[0]
    assert after.evidence.coefficients[0] == pytest.approx(size, rel=0.05)
    assert result.gain.after == pytest.approx(plain.gain.after, rel=0.1)


def test_what_one_motion_cannot_tell_apart_is_one_class(cache):
    """A skin and a tougher core change a press through both of them alike, and so may the law."""
    result = diagnosis_of(cache, 52, "skin:2.0")
    assert result.verdict.kind == "cause"
    (named,) = result.verdict.names
    assert {"skin", "core", LAW} <= set(named) <= {"skin", "core", "section_shape", LAW}
    text = result.table()
    assert "These records cannot tell it from: " in text and "--next-experiment" in text


def test_two_slices_are_too_few_to_tell_an_effect_from_how_slices_vary(cache):
    result = diagnosis_of(cache, 53, "blunt_edge:0.9", slices=2)
    assert result.verdict.kind == "too_few_replicates"
    assert result.verdict.slices_needed == 1
