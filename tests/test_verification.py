"""docs/results/verification.md says what its numbers say, and these are what the code computes."""

import copy
import json
from pathlib import Path

import pytest

from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.resources import resource_path
from studies.physics import verification as study
from studies.physics.bulk_checks import check_patch
from studies.physics.contact_checks import check_edge, check_friction, check_hold
from studies.physics.measured_curves import (
    FITTED,
    cut_measured_food,
    load_measured_foods,
    save_measured_foods,
)
from studies.physics.verification import EDGE_CASES, FRICTION_CASES, food_numbers, limits
from studies.physics.verification_page import verification_page

PAGE = Path(__file__).parents[1] / "docs/results/verification.md"
RESULTS = json.loads(PAGE.with_suffix(".json").read_text(encoding="utf-8"))
FOODS = load_measured_foods(resource_path("calibration/verification_foods.yaml")).foods

# The numbers are kept to six digits, and another machine rounds single precision elsewhere.
ROUNDING = 1e-3
REMEDY = "run: python -m studies verification --output docs/results/verification.md"


def assert_same(found, stored, where="", tolerance=ROUNDING, scale=0.0):
    if isinstance(stored, dict):
        assert found.keys() == stored.keys(), where
        for name in stored:
            assert_same(found[name], stored[name], f"{where}.{name}", tolerance, scale)
    elif isinstance(stored, float):
        near = pytest.approx(stored, rel=tolerance, abs=tolerance * scale)
        assert found == near, f"{where}: {REMEDY}"
    else:
        assert found == stored, f"{where}: {REMEDY}"


def as_dict(check):
    return dict(vars(check))


def test_page_is_that_of_the_stored_numbers():
    assert PAGE.read_text(encoding="utf-8") == verification_page(RESULTS), REMEDY


def test_page_shows_the_numbers():
    changed = copy.deepcopy(RESULTS)
    changed["edge"][0]["vertical"] += 0.01
    changed["foods"][-1]["curves"]["ours"]["rms"] += 1.0
    lines = set(verification_page(changed).splitlines()) - set(
        verification_page(RESULTS).splitlines()
    )
    assert len(lines) >= 3  # Both rows, and the verdict on the food.


def test_every_number_is_within_its_limit():
    found = limits(RESULTS)
    assert [limit.what for limit in found if not limit.holds] == []
    bounds = {limit.what: limit.bound for limit in found}
    for food in ("cucumber", "potato", "tomato"):
        assert bounds[f"{food}: energy imbalance of the whole cut"] == 0.02
    assert bounds["edge: force against Atkins"] == 0.02


def test_a_number_beyond_its_limit_or_not_a_number_does_not_hold():
    changed = copy.deepcopy(RESULTS)
    changed["foods"][0]["budget"]["imbalance"] = -0.021
    changed["hold"]["creep"] = float("nan")
    missed = [limit.what for limit in limits(changed) if not limit.holds]
    assert missed == [
        "hold: creep [m/s]",
        f"{FOODS[0].food.name}: energy imbalance of the whole cut",
    ]


def test_patch_tests_come_out_as_stored():
    for found, stored in zip(check_patch(), RESULTS["patch"], strict=True):
        for name in ("inside", "surface", "rigid", "one_body"):
            # Rounding errors of double precision, whose digits mean nothing.
            assert 0.0 < getattr(found, name) < 1e-9
            assert 0.0 < stored[name] < 1e-9
        assert (found.name, found.elements) == (stored["name"], stored["elements"])


def test_edge_friction_and_hold_come_out_as_stored():
    for k in (0, 1):
        assert_same(as_dict(check_edge(*EDGE_CASES[k])), RESULTS["edge"][k], "edge", 5e-3)
        assert_same(as_dict(check_friction(*FRICTION_CASES[k])), RESULTS["friction"][k], "friction")
    found, stored = check_hold(), RESULTS["hold"]
    assert found.force == pytest.approx(stored["force"], rel=ROUNDING)
    assert abs(found.drift) < 0.01 and found.creep < 1e-6


def test_a_cut_beside_its_record_comes_out_as_stored():
    cut = cut_measured_food(FOODS[0], study.COARSE)
    found, stored = food_numbers(FOODS[0], cut), copy.deepcopy(RESULTS["coarse"])
    balance, kept = found.pop("budget"), stored.pop("budget")
    assert abs(balance.pop("imbalance")) <= 0.02 and abs(kept.pop("imbalance")) <= 0.02
    assert balance.pop("energy_ratio") == pytest.approx(kept.pop("energy_ratio"), rel=0.05)
    assert_same(found, stored, "coarse")
    assert_same(balance, kept, "coarse.budget", scale=kept["work"])


def test_errors_of_the_authors_curves_are_those_of_their_record():
    expected = {"cucumber": (0.76, 3.39), "potato": (3.67, 7.62), "tomato": (2.71, 13.97)}
    for food in RESULTS["foods"]:
        curves = food["curves"]
        rms = tuple(round(curves[name]["rms"], 2) for name in ("DiSECt", "spring"))
        assert rms == expected[food["name"]]
        profile = load_force_profile(
            resource_path(f"calibration/measured/sliceit_real_{food['name']}_force.csv")
        )
        assert curves["measured"]["peak"] == pytest.approx(profile.force.max())
        assert curves["measured"]["rms"] == 0.0


def test_stored_parameters_are_the_fitted_ones_and_within_their_bounds(tmp_path):
    assert [case.food.name for case in FOODS] == [food["name"] for food in RESULTS["foods"]]
    names = dict(zip(("toughness", "youngs_modulus", "friction", "skin"), FITTED, strict=True))
    for case, food in zip(FOODS, RESULTS["foods"], strict=True):
        for short, name in names.items():
            value = case
            for part in ["food", *name.split(".")]:
                value = getattr(value, part)
            assert value == pytest.approx(food[short])
            assert FITTED[name][0] <= value <= FITTED[name][1]
    foods = load_measured_foods(resource_path("calibration/verification_foods.yaml"))
    save_measured_foods(foods, tmp_path / "foods.yaml", "a command")
    assert load_measured_foods(tmp_path / "foods.yaml") == foods
