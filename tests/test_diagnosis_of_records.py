"""What is hidden in records of the stand-in is found, nothing is found in those where nothing is,
and what one motion cannot tell apart is said to be so.

Records are cut and diagnosed by simulation, on the coarse mesh of the study of hidden effects.
"""

from pathlib import Path

import pytest

from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.diagnosis.diagnose import diagnose, setup_of_food
from sliceit_drake.diagnosis.result import Diagnosis
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


def diagnosis_of(cache: Path, seed: int, *effects: str, slices: int = 6) -> Diagnosis:
    """Diagnosis of slices in which effects are hidden."""
    session = Session(PROTOCOL, [make_effect(e) for e in effects], seed=seed, settings=WORLD)
    records = [session.record(k) for k in range(slices)]
    setup = setup_of_food(CalibratedFood(food=PROTOCOL.food, knife=PROTOCOL.knife), REFINEMENT)
    return diagnose(setup, records, cache=cache, replicates=REPLICATES, workers=1)


@pytest.mark.parametrize("seed", [41, 43])
def test_nothing_is_found_where_nothing_is_hidden(cache, seed):
    result = diagnosis_of(cache, seed)
    assert result.verdict.kind == "nothing"
    assert result.verdict.screening.p_value > 0.1
    assert not result.verdict.findings and result.gain is None
    assert "Verdict: nothing" in result.table()
    assert result.extended().food.effects == PROTOCOL.food.effects


@pytest.mark.parametrize(
    ("effect", "seed", "cause", "of_the_food"),
    [("blunt_edge:0.9", 53, "bluntness", True), ("sensor_drift:0.6", 57, "sensor_zero", False)],
)
def test_a_hidden_effect_is_found_alone(cache, effect, seed, cause, of_the_food):
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
    assert (f"Not in the food: {cause}" in extended.note) != of_the_food


def test_what_one_motion_cannot_tell_apart_is_one_class(cache):
    """A skin and a tougher core change a press through both of them alike."""
    result = diagnosis_of(cache, 52, "skin:2.0")
    assert result.verdict.kind == "cause"
    (named,) = result.verdict.names
    assert {"skin", "core"} <= set(named) <= {"skin", "core", "section_shape"}
    text = result.table()
    assert "These records cannot tell it from: " in text and "--next-experiment" in text


def test_two_slices_are_too_few_to_tell_an_effect_from_how_slices_vary(cache):
    result = diagnosis_of(cache, 53, "blunt_edge:0.9", slices=2)
    assert result.verdict.kind == "too_few_replicates"
    assert result.verdict.slices_needed == 1
