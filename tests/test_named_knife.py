"""Knives by name: each that ships says where its measures come from, and others are refused."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.configuration import ConfigurationError, dump_yaml, validate
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import UNSUPPORTED, Knife, NamedKnife, load_knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path, shipped_names

CUCUMBER = resource_path("scenarios/cucumber_measured.yaml")
KNIVES = shipped_names("calibration/knives")


def test_the_knives_that_ship_are_the_default_and_four_of_the_kitchen():
    assert KNIVES == ["chef", "cleaver", "gazebo", "nakiri", "paring"]
    assert load_knife("gazebo").knife == Knife()


@pytest.mark.parametrize("name", KNIVES)
def test_every_measure_of_a_knife_that_ships_has_a_source_or_says_that_it_is_chosen(name):
    named = load_knife(name)
    validate(named, name)
    measures = {field.name for field in dc.fields(Knife)} - {"profile"}
    assert set(named.sources) == measures
    assert all(len(text) > 10 for text in named.sources.values())


@pytest.mark.parametrize("name", [n for n in KNIVES if n != "gazebo"])
def test_the_stiffness_of_a_blade_is_that_of_the_cantilever_it_says(name):
    knife = load_knife(name).knife
    thickness = 0.5 * (knife.spine_thickness + knife.edge_thickness)
    inertia = knife.height * thickness**3 / 12.0
    expected = 3.0 * 200e9 * inertia / (0.5 * knife.length) ** 3
    assert knife.lateral_stiffness == pytest.approx(expected, rel=0.03)


def test_a_thicker_wedge_asks_for_more_force_in_the_same_food():
    food = Food(
        shape=Box(size=[0.02, 0.06, 0.015], divisions=[4, 4], layers=[0.0, 4e-3, 12e-3]),
        material=Material(toughness=300.0, friction=0.2),
    )
    work = {}
    for name in ("paring", "gazebo", "chef"):
        model = make_food_model(food, load_knife(name).knife, Numerics())
        plan = MotionPlan([ConstantSpeed(distance=0.0165, speed=0.03)])
        result = simulate_slice(CuttingSolver(model, 2e-3), Motion(plan, start_pose(model, 1e-3)))
        assert result.cut[-1] > 0.99
        work[name] = result.balance.work / model.section_area
    assert 300.0 < work["paring"] < work["chef"]
    assert 300.0 < work["gazebo"] < work["chef"]


def test_a_scenario_takes_the_knife_that_it_names_and_says_so_again_when_written(tmp_path):
    nakiri = load_scenario(CUCUMBER, "knife_name: nakiri")
    assert nakiri.knife == load_knife("nakiri").knife != Knife()
    dump_yaml(nakiri, tmp_path / "nakiri.yaml")
    assert load_scenario(tmp_path / "nakiri.yaml").knife == nakiri.knife


@pytest.mark.parametrize("changes", ["{knife: {length: 0.3}}", "knife.length=0.3"])
def test_what_stands_beside_a_name_wins_and_is_there_again_when_written(changes, tmp_path):
    for overrides in ([changes], ["knife_name: nakiri", changes]):
        changed = load_scenario("apple", overrides)
        named = load_knife("cleaver" if len(overrides) == 1 else "nakiri").knife
        assert changed.knife == dc.replace(named, length=0.3)
        dump_yaml(changed, tmp_path / "changed.yaml")
        assert load_scenario(tmp_path / "changed.yaml") == changed


def test_a_knife_of_ones_own_is_named_by_its_file(tmp_path):
    mine = NamedKnife(Knife(length=0.123), {"length": "my ruler"})
    dump_yaml(mine, tmp_path / "mine.yaml")
    scenario = load_scenario(CUCUMBER, f"knife_name: {tmp_path / 'mine.yaml'}")
    assert scenario.knife.length == 0.123


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ("knife_name: katana", r"scenario\.knife_name: there is no knife 'katana'; there are chef"),
        ("knife: {profile: serrated}", r"knife\.profile: serrated is not supported: teeth"),
        ("knife: {profile: wavy}", r"knife\.profile: 'wavy' is not one of straight, serrated"),
    ],
)
def test_a_knife_that_cannot_be_used_is_refused_by_name(overrides, words):
    with pytest.raises(ConfigurationError, match=words):
        load_scenario(CUCUMBER, overrides)


@pytest.mark.parametrize("profile", UNSUPPORTED)
def test_a_file_of_a_knife_with_another_edge_is_refused_with_the_reason(profile, tmp_path):
    file = tmp_path / "bread.yaml"
    file.write_text(f"knife: {{profile: {profile}}}\n")
    with pytest.raises(ConfigurationError) as raised:
        load_knife(file)
    message = str(raised.value)
    assert "bread.yaml" in message and f"knife.profile: {profile} is not supported" in message
    assert UNSUPPORTED[profile].split(";")[0] in message


def test_a_source_of_what_a_knife_does_not_have_is_refused():
    with pytest.raises(ConfigurationError, match=r"sources\.weight: is the source of nothing"):
        validate(NamedKnife(sources={"weight": "a scale"}), "knife")


def test_sections_of_the_knives_that_ship_are_as_high_and_as_thick_as_their_sources_say():
    total = {n: load_knife(n).knife.height + load_knife(n).knife.tip_height for n in KNIVES}
    inch = 25.4e-3
    measured = {"chef": 0.038, "cleaver": 0.089, "nakiri": 0.05, "paring": 0.63 * inch}
    for name, height in measured.items():
        assert total[name] == pytest.approx(height, rel=2e-3)
    paring = load_knife("paring").knife
    corners = paring.half_section()
    thickness = 2.0 * np.interp(0.25 * inch, corners[:, 1], corners[:, 0])
    assert thickness == pytest.approx(0.023 * inch, rel=0.01)
