"""Whatever is cut with whatever: a cut, or a reason."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.foods.shapes import Box
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
    case.food.material = dc.replace(case.food.material, youngs_modulus=2e6, toughness=200.0)
    case.speed, case.draw_ratio, case.hold = 0.05, 0.0, 0.0
    return case


def test_drawn_slices_are_cut_or_say_why_not():
    outcomes = [
        cut_drawn(11, index) for index in range(4)
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


def test_the_page_counts_all_and_quotes_a_reason_once():
    outcomes = [
        Outcome("cut", "", "box", 10.0),
        Outcome("stopped", "at 1.0 s it stands", "box"),
        Outcome("stopped", "at 2.0 s it stands", "cylinder"),
        Outcome("unexplained", "KeyError: 'x'", "box"),
    ]
    page = render("random_slices", **page_values(outcomes, 3, "python -m studies random"))
    assert "| box | 1 | 0 | 1 | 1 |" in page and "| all | 1 | 0 | 2 | 1 |" in page
    assert "| 2 | at 1.0 s it stands |" in page and "| 1 | KeyError: 'x' |" in page
