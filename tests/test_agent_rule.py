"""The rule that presses and draws by itself, and the network that corrects it."""

import numpy as np
import pytest

from sliceit_drake.systems.agent import ACTIONS
from sliceit_drake.systems.agent_rule import AgentRule

DRAW, PRESS, SOFT = (ACTIONS.index(name) for name in ("draw", "press", "p_z"))


def acted(rule, force=0.0, height=0.03, place=0.0, way=0.0, speed=0.0, waited=0.0):
    return rule.action(height, speed, force, place, way, waited)


def test_it_draws_on_to_its_reach_and_back():
    rule = AgentRule(9.0, reach=0.5)
    assert acted(rule)[DRAW] == 1.0
    assert acted(rule, way=1.0, place=0.4)[DRAW] == 1.0
    assert acted(rule, way=1.0, place=0.5)[DRAW] == -1.0
    assert acted(rule, way=-1.0, place=0.4)[DRAW] == -1.0
    assert acted(rule, way=-1.0, place=-0.5)[DRAW] == 1.0
    assert acted(AgentRule(9.0, reach=0.0))[DRAW] == 0.0


def test_it_presses_where_it_feels_less_than_its_level_and_gives_way_where_more():
    rule = AgentRule(10.0, gain=1.0, softness=0.0)
    assert acted(rule, 10.0)[[PRESS, SOFT]] == pytest.approx([0.0, 0.0])
    assert acted(rule, 5.0)[[PRESS, SOFT]] == pytest.approx([0.5, 0.5])
    assert acted(rule, 15.0)[[PRESS, SOFT]] == pytest.approx([-0.5, -0.5])
    # At the board its level is lower, and where it falls; food that holds it near is pressed on.
    soft = AgentRule(10.0, landing=0.2, approach=0.0)
    assert acted(soft, 2.0, 0.0)[PRESS] == pytest.approx(0.0)
    assert acted(soft, 3.0, 4e-4, speed=0.01)[PRESS] == pytest.approx(0.0)
    assert acted(soft, 3.0, 4e-4)[PRESS] == pytest.approx(0.5)
    assert (np.abs(acted(rule, 1e3)) <= 1.0).all()


def test_it_presses_harder_the_longer_food_holds_it_but_not_on_the_board():
    patient = AgentRule(10.0, softness=0.0, patience=0.5)
    assert acted(patient, 10.0)[PRESS] == pytest.approx(0.0)
    assert acted(patient, 10.0, waited=0.5)[PRESS] == pytest.approx(0.5)
    assert acted(patient, 10.0, waited=1.5)[PRESS] == pytest.approx(0.75)
    # Near the board too, where the level is less; on it no more.
    assert acted(patient, 10.0, 2e-3, speed=0.01, waited=1.0)[PRESS] > 0.4
    assert acted(patient, 3.0, 1e-4, waited=1.0)[PRESS] == acted(patient, 3.0, 1e-4)[PRESS]
    never = AgentRule(10.0, softness=0.0)
    assert (acted(never, 5.0, waited=9.0) == acted(never, 5.0)).all()


def test_near_the_board_it_draws_less_and_brakes():
    rule = AgentRule(10.0, calm=0.1, approach=0.1)
    assert acted(rule, height=4e-3)[DRAW] == 1.0
    assert acted(rule, height=1e-3)[DRAW] == pytest.approx(0.35)
    assert acted(rule, height=-1e-3, way=0.1)[DRAW] == pytest.approx(0.1)
    # At 2 mm it may have 20 mm/s and the 5 mm/s that it may always have.
    assert acted(rule, height=2e-3, speed=0.025)[PRESS] == 1.0
    assert acted(rule, height=2e-3, speed=0.03)[PRESS] == pytest.approx(0.0)
    assert acted(AgentRule(10.0, approach=0.0), height=2e-3, speed=0.5)[PRESS] == 1.0
