"""Force against time: the rules that policies are set beside, and the comparison at equal time."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from sliceit_drake.systems.agent import ACTIONS, AgentConfig, observation_names
from sliceit_drake.systems.agent_rule import AgentRule
from studies.learning.fronts import (
    KINDS,
    cells,
    comparisons,
    interval,
    over_rule,
    split,
    strategies,
    summarise,
)
from studies.learning.rules import uniform, with_draw

ROOT = Path(__file__).resolve().parent.parent
NAMES = observation_names(AgentConfig().history)
DRAW = ACTIONS.index("draw")


def test_a_policys_draw_is_replaced_and_nothing_else():
    seen, own = np.zeros(len(NAMES)), np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    seen[NAMES.index("last_draw")] = -1.0
    for rule, draw in ((AgentRule(9.0), -1.0), (None, 0.0)):
        found = with_draw(lambda _: own, rule)(seen)
        assert found.tolist() == [0.1, 0.2, 0.3, 0.4, draw, 0.6]
    assert own[DRAW] == 0.5


def test_random_actions_fill_their_range():
    decide = uniform(np.random.default_rng(0))
    actions = np.array([decide(np.zeros(len(NAMES))) for _ in range(500)])
    assert np.abs(actions).max() <= 1.0 and np.ptp(actions, axis=0).min() > 1.95


def mean(duration, force, completed=1.0):
    return {"duration": duration, "median_force": force, "completed": completed}


def test_forces_are_compared_at_equal_time():
    rule = [mean(8.0, 5.0), mean(2.0, 20.0), mean(25.0, 1.0, completed=0.5)]
    # Between 2 s and 8 s the rule's front is F T = 40 N s.
    assert over_rule([mean(4.0, 5.0)], rule, "median_force") == pytest.approx([0.5])
    others = [mean(1.9, 1.0), mean(8.1, 1.0), mean(4.0, 1.0, completed=0.9)]
    assert over_rule(others, rule, "median_force") == []
    assert over_rule([mean(4.0, 5.0)], rule[2:], "median_force") == []


def test_policies_and_not_slices_are_the_unit_of_an_interval():
    forces = np.array([[8.0, 12.0], [10.0, 16.0], [15.0, 17.0]])
    rows = [
        {"policy": f"cutting {seed}", "food": "potato", "slice": k, "median_force": force}
        | {"peak_force": 30.0, "board_peak": 9.0, "duration": 3.0, "completed": seed < 2}
        for seed, each in enumerate(forces)
        for k, force in enumerate(each)
    ]
    (point,) = summarise(rows)
    assert (point["policies"], point["slices"], point["completed"]) == (3, 6, 4)
    half = stats.t.ppf(0.975, 2) * np.std([10.0, 13.0, 16.0], ddof=1) / 3**0.5
    assert point["median_force"] == pytest.approx((13.0, 13.0 - half, 13.0 + half))
    assert interval(np.array([4.0])) == (4.0, 4.0, 4.0)


def test_the_page_is_that_of_the_slices():
    results = ROOT / "docs/results"
    lines = (results / "learning_fronts.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    names = strategies()
    assert {split(name)[0] for name in names} == set(KINDS)
    slices = {name: set() for name in names}
    for row in rows:
        slices[row["policy"]].add((row["world"], row["food"], row["slice"], row["seed"]))
    # All cut the same.
    assert len({frozenset(each) for each in slices.values()}) == 1
    assert len(rows) == sum(map(len, slices.values()))
    page, points = (results / "learning_fronts.md").read_text(encoding="utf-8"), summarise(rows)
    for shown in (*map(cells, points), *comparisons(points)):
        assert f"| {' | '.join(shown)} |" in page
