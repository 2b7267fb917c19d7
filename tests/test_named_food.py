"""Foods that ship: each says what was measured and what was not, and the apple can be cut."""

import numpy as np
import pytest

from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.cli.main import main
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.knife import Knife, load_knife
from sliceit_drake.diagrams import run as run_module
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path, shipped_names

FOODS = shipped_names("calibration/foods")


def test_the_foods_that_ship_each_have_a_setup_to_calibrate_them():
    assert FOODS == ["apple", "carrot", "cucumber", "potato", "tomato"]
    assert shipped_names("calibration/setups") == FOODS
    setup = load_setup("apple")
    apple = load_calibrated_food("apple")
    assert setup.food.material == apple.food.material
    for parameter in setup.parameters:
        assert parameter.why


@pytest.mark.parametrize("name", FOODS)
def test_a_food_without_a_record_says_so_and_calls_nothing_determined(name):
    food = load_calibrated_food(name)
    assert food.records and food.command and food.date
    assert food.is_measured == (name not in ("apple", "carrot"))
    if food.rms_error is None:
        assert "not from a record" in food.note.lower()
        assert not any(food.distribution.determined().values())
    else:
        assert food.held_out_error is not None


def test_the_apples_values_are_those_of_its_distribution():
    apple = load_calibrated_food("apple")
    values = apple.distribution.values()
    material = apple.food.material
    for name in ("toughness", "youngs_modulus", "friction"):
        assert values[f"material.{name}"] == pytest.approx(getattr(material, name), rel=1e-4)
    sources = " ".join(apple.records)
    assert all(name in sources for name in ("toughness", "youngs_modulus", "density"))
    # What has no source is named in the note.
    assert all(n in apple.note for n in ("poisson_ratio", "friction", "strength", "Skin and core"))


def test_showing_the_apple_prints_its_sources_and_what_it_cannot_be_used_for(capsys):
    assert main(["calibrate", "--show", "apple"]) == 0
    shown = capsys.readouterr().out
    assert "Granny Smith" in shown and "Not from a record of a cut" in shown
    assert shown.count("not determined by these records") == 3


def test_the_apple_is_cut_by_a_knife_that_is_higher_and_the_arm_reaches_its_start():
    scenario = load_scenario(resource_path("scenarios/apple.yaml"))
    assert scenario.food.material == load_calibrated_food("apple").food.material
    assert scenario.knife == load_knife("cleaver").knife
    run = prepare_run(scenario)
    # Every picture of the run has this title.
    assert run_module._title(run) == "A UR5e slices apple at 20 mm/s, not calibrated"
    model = run.station.cutting.solvers[0].model
    assert Knife().height < model.top < scenario.knife.height
    assert model.section_area == pytest.approx(0.25 * np.pi * 0.063**2, rel=1e-9)
    press = scenario.motion.segments[0].distance
    assert press > model.top + scenario.start.clearance
