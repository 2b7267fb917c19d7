"""What counts in the comparison of policies, and how sure it is."""

import dataclasses as dc
import json
import math
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from sliceit_drake.cli.main import main
from sliceit_drake.diagrams.agent_gains import AgentGains
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.learning import unseen_worlds
from sliceit_drake.learning.evaluation import LIMITS, cut_slice, slice_metrics
from sliceit_drake.learning.model_card import model_card
from sliceit_drake.learning.task import Limits
from sliceit_drake.learning.training_config import load_training
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from studies.__main__ import main as studies
from studies.learning import faster_draws
from studies.learning.comparison import EQUAL, claim, compare, comparison_page, plot_boxes
from studies.learning.ratio import bootstrap_ratio

ROOT = Path(__file__).resolve().parent.parent


def forces(*norms):
    out = np.zeros((len(norms), 3))
    out[:, 2] = norms
    return out


def test_the_median_is_over_contact_and_the_resultant_of_food_and_board():
    food, board = forces(0.0, 0.2, 4.0, 6.0, 0.0), forces(0.0, 0.0, 0.0, -2.0, 30.0)
    time, cut = np.arange(5) * 0.002, np.array([0.0, 0.0, 0.5, 1.0, 1.0])
    found = slice_metrics(time, food, board, cut, "goal")
    # 0.2 N is no contact; 4, |6 - 2| and 30 are.
    assert (found.median_force, found.peak_force, found.board_peak) == (4.0, 30.0, 30.0)
    assert found.duration == pytest.approx(0.008) and found.completed


@pytest.mark.parametrize(("cut", "end"), [(0.99, "goal"), (1.0, "time"), (1.0, "shaking")])
def test_a_slice_is_completed_only_if_it_is_cut_and_brought_to_its_end(cut, end):
    one = forces(1.0)
    assert not slice_metrics(np.zeros(1), one, one, np.array([cut]), end).completed


def test_a_slice_without_contact_has_no_force():
    none = np.zeros((3, 3))
    found = slice_metrics(np.arange(3.0), none, none, np.zeros(3), "time")
    assert (found.median_force, found.peak_force, found.board_peak) == (0.0, 0.0, 0.0)


def test_the_interval_of_a_ratio_holds_the_truth_as_often_as_it_says():
    # Policies differ by 10 %, slices by 20 %, together: as in a study of five seeds.
    rng, hits, runs = np.random.default_rng(0), 0, 150
    for _ in range(runs):
        shared = rng.normal(0.0, 0.2, 15)

        def drawn(mean, shared=shared):
            policies = rng.normal(0.0, 0.1, (5, 1))
            return mean * np.exp(policies + shared + rng.normal(0.0, 0.05, (5, 15)))

        found = bootstrap_ratio(drawn(7.0), drawn(10.0), rng, draws=400)
        hits += found.low <= 0.7 <= found.high
    # A bootstrap of five is too narrow by a factor of sqrt(4/5), so 92 % at best.
    assert hits / runs > 0.85


def test_slices_under_one_policy_are_no_replicates_of_the_training():
    rng = np.random.default_rng(1)
    ours = np.repeat([[5.0], [9.0]], 100, axis=1) + rng.normal(0.0, 0.1, (2, 100))
    baseline = 10.0 + rng.normal(0.0, 0.1, (2, 100))
    found = bootstrap_ratio(ours, baseline, rng)
    assert found.value == pytest.approx(0.7, abs=0.01)
    assert found.low < 0.55 and found.high > 0.85


def test_a_ratio_has_no_upper_limit_where_policies_of_the_baseline_meet_nothing():
    baseline = np.array([[2.0] * 4, [0.0] * 4, [0.0] * 4])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = bootstrap_ratio(np.ones((3, 4)), baseline, np.random.default_rng(0))
        nothing = bootstrap_ratio(np.ones((3, 4)), 0.0 * baseline, np.random.default_rng(0))
    assert (found.value, found.high) == (pytest.approx(1.5), math.inf)
    assert found.low == pytest.approx(0.5)
    assert (nothing.value, nothing.low, nothing.high) == (math.inf, math.inf, math.inf)


def rows(ours=6.0, baseline=10.0, world="stand_in", foods=("cucumber", "potato")):
    found = []
    for simulator, level in (("cutting", ours), ("spring", baseline)):
        for seed in range(3):
            for food in foods:
                for k in range(4):
                    found.append(
                        {
                            "policy": f"{simulator}_{seed}",
                            "simulator": simulator,
                            "world": world,
                            "food": food,
                            "slice": k,
                            "board_stiffness": 3e4,
                            "seed": 0,
                            "median_force": level + 0.1 * k + 0.05 * seed,
                            "peak_force": 2.0 * level,
                            "board_peak": level,
                            "duration": 3.0,
                            "completed": True,
                        }
                    )
    return found


def test_the_claim_holds_where_the_interval_ends_below_one(tmp_path):
    lower = compare(rows())
    assert [each.food for each in lower] == ["cucumber", "potato"]
    assert lower[0].ratios["median_force"].high < 1.0
    shown = ["stand_in", "30", "cucumber, potato", "none", "100 %", "100 %"]
    assert claim(lower) == [shown]
    same = compare(rows(ours=10.0))
    assert claim(same)[0][2:4] == ["none", "cucumber, potato"]
    page = comparison_page(lower)
    rows_of_table = [line for line in page.splitlines() if line.startswith("| stand_in | 3e4 |")]
    assert len(rows_of_table) == 2
    assert "12 of 12, 12 of 12" in rows_of_table[0] and rows_of_table[0].endswith("| 0.61 |")
    # A food that the paper did not cut has no ratio of the paper's.
    assert " |  |\n" in comparison_page([dc.replace(lower[0], food="leek")])
    # Who gives slices up on which it met little has not cut with less force.
    given_up = rows()
    for row in given_up:
        if row["simulator"] == "cutting" and row["food"] == "potato" and row["slice"] < 3:
            row["completed"] = False
    potato = compare(given_up)[1]
    assert potato.ratios["median_force"].high < 1.0 < potato.strict.high
    # Nine of the twelve count as the worst of the baseline's: 10 N, 0.3 N and 0.1 N.
    kept = [6.0 + 0.3 + 0.05 * seed for seed in range(3)]
    counted = (9 * 10.4 + sum(kept)) / 12.0
    assert potato.strict.value == pytest.approx(counted / 10.2)
    assert claim(compare(given_up))[0][2:5] == ["cucumber", "potato", "62 %"]
    plot_boxes(lower, tmp_path / "boxes.png")
    assert (tmp_path / "boxes.png").stat().st_size > 5000


def test_comparisons_are_in_the_order_of_worlds_and_boards():
    both = [dict(row, board_stiffness=3e5) for row in rows()] + rows()
    both += rows(world="curves")
    found = [(each.world, each.board_stiffness, each.food) for each in compare(both)]
    boards = (("curves", 3e4), ("stand_in", 3e4), ("stand_in", 3e5))
    assert found == [(*board, food) for board in boards for food in ("cucumber", "potato")]


def test_a_baseline_with_all_else_equal_has_a_table_of_its_own_and_seeds_are_not_mixed():
    equal = [
        dict(row, policy=f"corrected_{row['policy']}")
        for row in rows(baseline=7.5)
        if row["simulator"] == "spring"
    ]
    other_seed = [dict(row, seed=1, median_force=1.0) for row in equal]
    both = [*rows(), *equal, *other_seed]
    ratio = {
        kind: compare(both, "cutting", kind)[0].ratios["median_force"].value
        for kind in ("spring", EQUAL)
    }
    assert ratio["spring"] == compare(rows())[0].ratios["median_force"].value
    assert ratio["spring"] == pytest.approx(6.2 / 10.2)
    assert ratio[EQUAL] == pytest.approx(6.2 / 7.7)
    assert len(compare(both, "cutting", EQUAL)) == 2
    page = comparison_page(compare(both), equal=compare(both, "cutting", EQUAL))
    assert "| stand_in | cucumber | 12 of 12, 12 of 12 | **0.81**" in page
    assert "all else equal" not in comparison_page(compare(both))


def test_policies_of_any_name_are_compared_by_their_simulator():
    renamed = [dict(row, policy=f"output/mine_{row['policy'][::-1]}") for row in rows()]
    assert len(compare(renamed)) == len(compare(rows())) == 2
    assert compare(renamed, "corrected") == []


def test_policies_that_did_not_cut_the_same_slices_are_not_compared():
    with pytest.raises(ValueError, match=r"spring_2 did not cut slices \[3\] of potato"):
        compare(rows()[:-1])


def test_the_study_writes_its_page_and_says_what_it_lacks(tmp_path, capsys):
    file = tmp_path / "evaluation.jsonl"
    file.write_text("\n".join(map(json.dumps, rows())))
    assert studies(["slicing", str(file), "--output", str(tmp_path)]) == 0
    assert "**0.6" in (tmp_path / "slicing_results.md").read_text()
    file.write_text("\n".join(map(json.dumps, rows()[: len(rows()) // 2])))
    assert studies(["slicing", str(file), "--output", str(tmp_path)]) == 2
    assert "policies of both simulators" in capsys.readouterr().err


def test_an_evaluation_goes_on_over_batches_of_processes_and_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(unseen_worlds, "SLICES", 1)
    file, policy = tmp_path / "evaluation.jsonl", resource_path("models/policies/cutting_0")
    given = ["evaluate", str(policy), "--world", "curves", "--foods", "cucumber"]
    given += ["--workers", "1", "--output", str(file)]
    assert main([*given, "--slices", "1"]) == 0
    first = file.read_text()
    assert main([*given, "--slices", "3"]) == 0
    assert file.read_text().startswith(first)
    found = [json.loads(line) for line in file.read_text().splitlines()]
    assert sorted(row["slice"] for row in found) == [0, 1, 2]
    assert all(row["completed"] and row["simulator"] == "cutting" for row in found)
    assert "3 of 3" in capsys.readouterr().out


def test_policies_are_evaluated_without_what_trained_them():
    code = """if True:
        from importlib.machinery import PathFinder
        find, absent = PathFinder.find_spec, ("torch", "gymnasium", "stable_baselines3", "torchrl")
        PathFinder.find_spec = lambda name, *rest: None if name in absent else find(name, *rest)
        from pathlib import Path
        from sliceit_drake.cli import evaluate
        from sliceit_drake.learning.unseen_worlds import cases_of, cut
        policies = [Path("models/policies/cutting_0")]
        (case,) = cases_of(policies, ["curves"], ["cucumber"], [3e4], 0, 1)
        assert cut(case)["completed"]
    """
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(("ours", "stem"), [("cutting", "slicing"), ("corrected", "corrected")])
def test_the_page_is_that_of_the_slices(ours, stem, tmp_path, capsys):
    files = [str(ROOT / f"docs/results/{name}_evaluation.jsonl") for name in {stem, "slicing"}]
    assert studies(["slicing", *files, "--ours", ours, "--output", str(tmp_path)]) == 0
    for name in (f"{stem}_results.md", f"{stem}_results.json"):
        assert (tmp_path / name).read_text() == (ROOT / "docs/results" / name).read_text()
    capsys.readouterr()


def test_the_table_of_faster_draws_is_that_of_the_slices():
    text = (ROOT / "docs/results/learning.md").read_text(encoding="utf-8")
    files = ["docs/results/slicing_evaluation.jsonl", "docs/results/faster_draws.jsonl"]
    command = f"python -m studies faster_draws {' '.join(files)} --output docs/results/learning.md"
    table = faster_draws.draws_table(*(ROOT / file for file in files), command)
    assert faster_draws.PLACE.put(text, "\n".join(table), "learning.md") == text, command


def test_the_page_says_what_the_policies_are_worth():
    facts = json.loads((ROOT / "docs/results/slicing_results.json").read_text())
    everywhere = [case["ratios"]["median_force"][0] for case in facts]
    ratios = [c["ratios"]["median_force"][0] for c in facts if c["board_stiffness"] == 3e4]
    said = " ".join((ROOT / "docs/explanation/learning.md").read_text().split())
    assert f"press with {min(ratios):.2f} to {max(ratios):.2f} times the contact force" in said
    assert f"it is {min(everywhere):.2f} to {max(everywhere):.2f} times" in said


@pytest.mark.parametrize("seed", range(5))
def test_a_shipped_correction_was_trained_as_its_file_says(seed):
    said = load_training(ROOT / "models/policies/correction.yaml")
    found = load_training(ROOT / f"models/policies/corrected_{seed}/training.yaml")
    assert dc.replace(said, seed=seed) == found


def test_each_shipped_policy_has_the_card_that_its_training_leaves():
    folders = sorted((ROOT / "models/policies").glob("*_[0-9]"))
    assert len(folders) == 15
    for folder in folders:
        done = json.loads((folder / "summary.json").read_text())
        file, found = folder / "validation.jsonl", None
        if file.exists():
            rows = map(json.loads, file.read_text().splitlines())
            found = next(row for row in rows if row["steps"] == done["best_steps"])
        config = load_training(folder / "training.yaml")
        card = model_card(config, done["best_steps"], done["ends"], found)
        assert card == (folder / "README.md").read_text(encoding="utf-8"), folder


def test_a_trained_policy_runs_in_a_scenario():
    run = prepare_run(load_scenario(resource_path("scenarios/cucumber_agent.yaml")))
    run.advance(2.4)
    record = run.record()
    assert not run.stopped and record["cut_progress"][-1] > 0.999
    assert 5.0 < np.abs(record["food_wrench_f_z"]).max() < 30.0


def scenario():
    return Scenario(
        controller=AgentGains().controller(), food=AnalyticFood(diameter=0.027, toughness=200.0)
    )


def press(observation):
    return np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])


def test_a_pressing_policy_completes_a_slice_and_its_forces_are_those_of_food_and_board():
    trace = cut_slice(scenario(), AgentConfig(), press)
    assert trace.metrics.end == "goal" and trace.metrics.completed
    # R w of the widest chord, by the analytic cutter's law.
    assert np.linalg.norm(trace.food, axis=1).max() == pytest.approx(200.0 * 0.027, rel=0.05)
    assert trace.metrics.board_peak > 5.0
    assert len(trace.height) == len(trace.actions) and trace.height[-1] < 1e-3


def test_a_slice_ends_by_time_and_by_force_where_a_policy_goes_on():
    short = cut_slice(scenario(), AgentConfig(), press, longest=0.3)
    assert short.metrics.end == "time" and not short.metrics.completed
    weak = cut_slice(scenario(), AgentConfig(), press, limits=dc.replace(LIMITS, force=3.0))
    assert weak.metrics.end == "force"


@pytest.mark.parametrize(
    ("at_goal", "time", "wrench", "error", "end"),
    [
        (True, 0.9, [11.0] * 6, [1.0, 0.0, 0.0], "goal"),
        (False, 0.9, [0.0] * 6, [0.0, 0.0, 0.0], "shaking"),
        (False, 1.0, [0.0, 0.0, 0.0, 0.0, -51.0, 0.0], [0.0, 0.0, 0.0], "force"),
        (False, 1.0, [0.0, -11.0, 0.0, 0.0, 49.0, 0.0], [0.0, 0.0, 0.0], "torque"),
        (False, 1.0, [9.0, 0.0, 0.0, 0.0, 49.0, 0.0], [0.0, 0.0, -0.3], "workspace"),
        (False, 1.0, [9.0, 0.0, 0.0, 0.0, 49.0, 0.0], [0.1, 0.1, 0.1], ""),
    ],
)
def test_a_slice_ends_by_the_first_of_goal_shaking_force_torque_and_workspace(
    at_goal, time, wrench, error, end
):
    limits = Limits(force=50.0, torque=10.0, workspace=(0.2, 0.2, 0.2))
    assert limits.end(at_goal, time, 1.0, np.array(wrench), np.array(error)) == end
