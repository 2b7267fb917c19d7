"""The study of the sub-step, and what it has found for the default."""

import csv
import dataclasses as dc
import json
import re
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import check_energies
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path
from studies.__main__ import main
from studies.physics.stepping import (
    STEPS,
    SteppingCase,
    energy_ratio,
    error_table,
    hold_table,
    slice_inertia,
    stepping_cases,
    stepping_study,
    true_step,
)
from studies.physics.stepping_report import held_half_way, sliced_food

SMALL = Food(
    shape=Cylinder(rings=3, layers=[0.0, 0.004, 0.012]),
    material=Material(toughness=400.0, friction=0.05),
)
FAST = SteppingCase(SMALL, Knife(), Numerics(), 0.1, depth=0.2)
LIMIT = 0.02
STORED = Path(__file__).resolve().parent.parent / "docs/results/data/stepping.json"


def cells(table):
    """Columns' heads, and the numbers of a Markdown table by row's head."""
    head, _, *rows = ([c.strip() for c in row.strip("| ").split("|")] for row in table.split("\n"))
    return head, {row[0]: row[1:] for row in rows}


def committed_tables():
    tables = json.loads(STORED.read_text(encoding="utf-8"))["values"].values()
    return {table.split("|")[1].strip(): table.strip() for table in tables}


def test_the_error_grows_with_the_step_and_the_reference_against_itself_is_zero():
    results = stepping_study([FAST], (1e-4, 2e-4, 1e-3))
    *_, by_need = results
    errors = [r.rms_error for r in results]
    assert results[0].reference
    assert errors[0] == 0.0 and results[0].largest_difference == 0.0
    assert 1e-5 < errors[1] < errors[2] < 0.1
    assert results[0].energy_ratio < results[1].energy_ratio < results[2].energy_ratio
    # By need the steps are as short as the speed asks for.
    assert by_need.by_need and by_need.time_step == 1e-3
    assert by_need.rms_error < 0.5 * errors[2]
    assert by_need.finer > 0.9 and by_need.substeps == pytest.approx(10.0, abs=2.0)
    assert [r.finer for r in results[:-1]] == [0.0] * 3
    assert results[0].substeps == 20.0


def test_a_fast_cut_is_compared_with_true_masses_at_a_stable_step():
    # So soft that true masses bear 4e-5 s.
    soft = dc.replace(SMALL, material=Material(youngs_modulus=3.7e4, toughness=10.0, density=470.0))
    case = dc.replace(FAST, food=soft, depth=0.1, true_masses=True)
    reference, *scaled = stepping_study([case], (4e-5, 1e-3))
    assert reference.reference and not reference.scaled and reference.refusal is None
    assert reference.time_step == true_step(case, 4e-5) == pytest.approx(4e-5)
    assert true_step(case, 1e-3) < case.model(1e-3).critical_time_step
    assert [r.scaled for r in scaled] == [True] * 3
    assert 0.0 < scaled[0].rms_error < 0.01 < scaled[1].rms_error
    _, rows = cells(error_table([reference, *scaled]))
    stars = ["*" if r.too_much_inertia else "" for r in scaled]
    assert stars == ["", "*", ""]
    errors = [f"{100 * r.rms_error:.2f}{star}" for r, star in zip(scaled, stars, strict=True)]
    assert rows == {case.label: errors}


def test_a_slice_turns_as_if_it_were_heavier_the_longer_the_step():
    food = dc.replace(SMALL, held_sides="plus")
    case = SteppingCase(food, Knife(), Numerics(board_damping_time=0.0), 0.1)
    ratios = np.array([slice_inertia(case.model(step)) for step in (1e-6, 2.5e-4, 1e-3)])
    assert np.all(ratios[0] < 1.01)
    assert np.all(np.diff(ratios, axis=0) > 0.0)
    # What the step adds goes with its square, but for the blade's own mass and damping.
    added = ratios[1:] - 1.0
    np.testing.assert_allclose(added[1] / added[0], 16.0, rtol=0.05)


def test_results_do_not_depend_on_the_number_of_threads():
    one, two = (stepping_study([FAST], (2e-4, 1e-3), workers) for workers in (1, 2))
    assert [r.rms_error for r in one] == [r.rms_error for r in two]


def test_a_hold_shows_what_scaled_masses_ring():
    # The edge unloads over 0.1 mm while the food, heavy in relative motion, comes to rest.
    case = dc.replace(FAST, hold=0.06)
    fine, coarse, by_need = stepping_study([case], (1e-4, 1e-3))
    assert abs(fine.creep) < 1e-4 * fine.peak
    assert abs(coarse.creep) > 2e-3 * fine.peak
    assert coarse.rms_error > LIMIT
    assert by_need.rms_error < LIMIT / 2
    press = stepping_study([FAST], (1e-3,))[0]
    assert np.isnan(press.force_drop)
    _, rows = cells(hold_table([fine, coarse, by_need, dc.replace(press, reference=True)]))
    assert len(rows) == 1


def test_energy_ratio_is_the_one_that_a_simulation_checks():
    model = FAST.model(5e-4, True)
    solver = CuttingSolver(model, 2e-3)
    plan = MotionPlan([ConstantSpeed(distance=0.004, speed=0.1, acceleration=None)])
    motion = Motion(plan, FAST.motion(model).pose(0.0))
    state = solver.initial_state()
    for k in range(20):
        end = motion.pose(2e-3 * (k + 1))
        state = solver.coupling_step(state, motion.pose(2e-3 * k), end).state
    energies = solver.energies(state, end)
    ratio = energy_ratio(energies, 1e-3, model)
    assert ratio > 0.0
    assert ratio == check_energies(energies, 1e-3, model, 0.0, 0.5)


def test_foods_are_those_that_the_scenarios_cut():
    whole = sliced_food(load_scenario(resource_path("scenarios/cucumber_measured.yaml")))[0]
    middle = sliced_food(load_scenario(resource_path("scenarios/potato_sequence.yaml")))[0]
    assert whole.held_sides == "both" and isinstance(whole.shape, Cylinder)
    assert middle.shape.thickness == 3e-3
    labels = [c.label for c in stepping_cases([(whole, Knife(), Numerics())])]
    assert len(set(labels)) == len(labels) == 4 + 7 + 2


def test_a_scenario_held_half_way_goes_as_far_as_before():
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    plans = [scenario.motion, held_half_way(scenario).motion]
    ends = [Motion(p, FAST.motion(FAST.model(5e-4, True)).pose(0.0)) for p in plans]
    assert np.allclose(ends[0].pose(1e3).p, ends[1].pose(1e3).p)
    assert ends[1].duration > ends[0].duration + 0.3


def test_quick_study_writes_the_kinds_of_tables_that_are_committed(tmp_path, capsys):
    assert main(["stepping", "--quick", "--output", str(tmp_path)]) == 0
    text = (tmp_path / "stepping.md").read_text(encoding="utf-8")
    assert text.strip() in capsys.readouterr().out
    quick = {t.split("|")[1].strip() for t in text.split("\n\n")}
    committed = {re.sub("to [0-9e.-]+ s", "to 0.00025 s", name) for name in committed_tables()}
    of_the_whole = {"in the station", "stepped over true inertia", "motion"}
    assert quick == committed - of_the_whole
    with (tmp_path / "stepping.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 7 * 5
    assert all(float(row["wall_per_simulated"]) > 0.0 for row in rows)
    assert (tmp_path / "figures/stepping.png").stat().st_size > 1e4


def test_in_the_committed_tables_sub_steps_by_need_err_as_little_as_asked_for():
    tables = committed_tables()
    head, rms = cells(tables["RMS error [%]"])
    assert head[1:] == [*(f"{step:g} s" for step in STEPS), "by need"]
    _, largest = cells(tables["largest difference [% of peak]"])
    held_out = {"carrot (held out)", "apple (held out)"}
    assert {name.split(",")[0] for name in rms} >= {"cucumber", "potato", "tomato"} | held_out
    for name, row in rms.items():
        turns, holds = "retract" in name, "hold" in name
        limit = 1.5 if turns else 1.0 if holds else 0.5
        # A star would mark what a simulation refuses.
        assert float(row[-1]) <= limit, name
        if turns:
            assert float(largest[name][-1]) <= 10.0, name


def test_in_the_committed_tables_a_robots_food_errs_little_at_any_step():
    _, *rows = committed_tables()["in the station"].split("\n")[1:]
    errors = {}
    for row in rows:
        _, step, rms, *_ = (cell.strip() for cell in row.strip("| ").split("|"))
        errors.setdefault(float(step), []).append(float(rms))
    # What is asked for of a press, though these turn round as well.
    assert max(map(max, errors.values())) <= 0.5
    assert 1e-3 in errors
