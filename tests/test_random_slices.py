"""Whatever is cut with whatever: a cut, or a reason."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.solver import CuttingError
from studies.pages import render
from studies.physics import random_slices
from studies.physics.random_slices import (
    Outcome,
    cut_drawn,
    cut_random_slice,
    draw_slice,
    page_values,
)


def easy():
    """A slice of the middle of what is drawn."""
    case = draw_slice(np.random.default_rng(0))
    case.food.shape = Box([0.02, 0.06, 0.015], [4, 4], [0.0, 3e-3, 8e-3])
    case.food.cut_point, case.food.cut_normal = [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    case.food.hold_distance, case.food.held_sides = 7e-3, "both"
    case.food.hold_distance_minus, case.food.effects = None, Effects()
    case.food.material = dc.replace(case.food.material, youngs_modulus=2e6, toughness=200.0)
    case.speed, case.draw_ratio, case.hold = 0.05, 0.0, 0.0
    case.amplitude, case.acceleration = 0.0, 2.0
    return case


def test_drawn_slices_are_cut_or_say_why_not():
    outcomes = [
        cut_drawn(12, index) for index in range(1, 4)
    ]  # `python -m studies random` draws more.
    assert not [o for o in outcomes if o.kind == "unexplained"], outcomes
    assert sum(o.kind == "cut" for o in outcomes) >= 2
    assert all(o.reason for o in outcomes if o.kind != "cut")


def test_a_slice_is_the_same_for_the_same_numbers():
    one, two, other = (draw_slice(np.random.default_rng([3, k])) for k in (5, 5, 6))
    assert one == two and one != other


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: r.food_wrench.__setitem__((5, 3), np.nan), "not finite"),
        (lambda r: r.cut.__setitem__(20, r.cut[19] - 0.1), "closes"),
        (lambda r: r.cut.__setitem__(slice(None), np.minimum(r.cut, 0.5)), "50.0 % are cut"),
        (lambda r: setattr(r.balance, "work", 1.5 * r.balance.work), "energy balance lacks"),
        (lambda r: setattr(r.balance, "friction", -1e-3), "friction gives energy"),
        (lambda r: setattr(r.balance, "internal", 1e-3), "damping gives energy"),
        (lambda r: setattr(r.balance, "edge", 0.5 * r.balance.edge), "toughness times the area"),
    ],
)
def test_what_no_slice_may_do_is_unexplained(change, said, monkeypatch):
    simulate = random_slices.simulate_slice

    def spoiled(*arguments):
        result = simulate(*arguments)
        change(result)
        return result

    assert cut_random_slice(easy()).kind == "cut"
    monkeypatch.setattr(random_slices, "simulate_slice", spoiled)
    outcome = cut_random_slice(easy())
    assert outcome.kind == "unexplained" and said in outcome.reason


def test_refusals_guards_and_the_unforeseen_are_told_apart(monkeypatch):
    case = easy()
    case.food.material = dc.replace(case.food.material, toughness=-1.0)
    assert cut_random_slice(case).kind == "refused"
    case = easy()
    case.knife.length, case.draw_ratio = 0.03, 2.0
    outcome = cut_random_slice(case)
    assert outcome.kind == "stopped" and "an end of the knife" in outcome.reason
    monkeypatch.setattr(random_slices, "start_pose", lambda *_: 1 / 0)
    outcome = cut_random_slice(easy())
    assert outcome.kind == "unexplained" and "ZeroDivisionError" in outcome.reason


OWN, SHORT, SHORTER, IMAGE = "own", 5e-5, 2.5e-5, "image"


@pytest.mark.parametrize(
    ("down", "up", "wrong", "let_go"),
    [
        ({OWN: 1.2}, {OWN: 1.2}, "sub-steps of 0.05 ms", []),
        ({SHORT: 1.2}, {SHORT: 1.2}, "", []),
        ({SHORT: 1.2, SHORTER: 1.2}, {SHORT: 1.2, SHORTER: 1.2}, "sub-steps of 0.05 ms", []),
        ({SHORT: 1.2, SHORTER: 1.4}, {SHORT: 1.2, SHORTER: 1.4}, "sub-steps of 0.05 ms", []),
        ({}, {SHORT: 9.0, SHORTER: -9.0}, "", [random_slices.STEPS]),
        ({}, {SHORT: 9.0, SHORTER: 9.0}, "sub-steps of 0.05 ms", []),
        ({IMAGE: 1.2}, {IMAGE: 1.2}, "mirrored slice", []),
        ({}, {IMAGE: 9.0}, "", [random_slices.MIRROR]),
    ],
)
def test_a_slice_is_compared_with_short_sub_steps_and_its_image_where_they_agree(
    down, up, wrong, let_go, monkeypatch
):
    cut, prepare, images = random_slices._cut, random_slices._prepared, []

    def prepared(case, mirrored=False):
        model = prepare(case, mirrored)
        images.extend([model] if mirrored else [])
        return model

    def spoiled(case, model, rise=True):
        solver, result = cut(case, model, rise)
        step, image = case.numerics.time_step, any(model is each for each in images)
        name = step if step in (SHORT, SHORTER) else IMAGE if image else OWN
        risen = result.time > result.time[result.position[:, 2].argmin()] + 2e-3
        result.food_wrench[~risen] *= down.get(name, 1.0)
        # Beside the force that is left in it.
        result.food_wrench[risen, 3:] += 10.0 * (up.get(name, 1.0) - 1.0)
        return solver, result

    monkeypatch.setattr(random_slices, "_prepared", prepared)
    monkeypatch.setattr(random_slices, "_cut", spoiled)
    outcome = cut_random_slice(easy(), twice_more=True)
    assert outcome.kind == ("unexplained" if wrong else "cut") and wrong in outcome.reason
    assert outcome.let_go == let_go


@pytest.mark.parametrize(
    ("reason", "kind", "advised"),
    [
        ("Use a smaller numerics.time_step than the sub-step here, 0.001 s, or", "stopped", "cut"),
        ("Use a smaller numerics.time_step than the sub-step here, 6e-05 s, or", "stopped", ""),
        ("element 3 is inverted", "unexplained", ""),
    ],
)
def test_the_advice_of_a_guard_is_followed_and_an_inversion_needs_a_warning(
    reason, kind, advised, monkeypatch
):
    cut, steps = random_slices._cut, []

    def stopped(case, model, rise=True):
        steps.append(case.numerics.time_step)
        if len(steps) == 1:
            raise CuttingError(reason)
        return cut(case, model)

    monkeypatch.setattr(random_slices, "_cut", stopped)
    outcome = cut_random_slice(easy())
    assert (outcome.kind, outcome.advised) == (kind, advised)
    assert steps == ([1e-3, 2.5e-4] if advised else [1e-3])


def test_what_is_wrong_in_a_food_that_is_warned_of_is_stopped_and_the_advice_is_followed(
    monkeypatch,
):
    judge, spreads = random_slices._wrong, []

    def wrong(result, model, solver):
        spreads.append(model.numerics.edge_spread)
        return ("the cut closes", {}) if len(spreads) == 1 else judge(result, model, solver)

    monkeypatch.setattr(random_slices, "_wrong", wrong)
    case = easy()
    case.food.material.youngs_modulus = 1e5
    case.food.material.toughness = 350.0
    outcome = cut_random_slice(case)
    assert (outcome.kind, outcome.advised) == ("stopped", "cut")
    assert "numerics.edge_spread" in outcome.reason and "Here the cut closes" in outcome.reason
    assert spreads == [0.0, pytest.approx(7.07e-3, rel=1e-3)]


def test_the_page_counts_all_and_quotes_a_reason_once():
    outcomes = [
        Outcome("cut", "", "box", 10.0, {"force against the mirrored slice": 2e-3}),
        Outcome("stopped", "at 1.0 s it stands", "box"),
        Outcome("stopped", "at 2.0 s it stands", "cylinder"),
        Outcome("unexplained", "KeyError: 'x'", "box"),
    ]
    page = render("random_slices", **page_values(outcomes, 3, "python -m studies random"))
    assert "| box | 1 | 0 | 1 | 1 |" in page and "| all | 1 | 0 | 2 | 1 |" in page
    assert "| force against the mirrored slice | 1 | 0.2 % | 0.2 % | 0.2 % | 1 % |" in page
    assert "| 2 | at 1.0 s it stands |" in page and "| 1 | KeyError: 'x' |" in page
