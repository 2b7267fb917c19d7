"""DiSECt's reference case here: both measures of the force, its parameters, and the page on it."""

import dataclasses as dc
import math
import re
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.cutting.foods.effects import Edge, Effects
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan, Pose
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.resources import resource_path
from studies.disect import case as disect
from studies.disect import page as disect_page
from studies.disect.case import load_case, load_reference, run_case
from studies.disect.contact_sums import contact_forces, contact_sums
from studies.disect.settings import SETTINGS
from studies.disect.study import Curve, Difference, DisectStudy, MeasuredCurves
from studies.pages import render
from studies.simulated_profiles import load_simulated_profile

ROOT = Path(__file__).resolve().parent.parent
TOUGHNESS = 300.0
RAZOR = Knife(spine_thickness=2e-4, edge_thickness=1e-6, tip_height=1e-6, length=0.4)


def bar(knife=None, share=1.0, friction=0.2, **numerics):
    food = Food(
        shape=Box(size=[0.02, 0.04, 0.015], divisions=[3, 3], layers=[0.0, 0.005]),
        material=Material(youngs_modulus=2e6, toughness=TOUGHNESS, friction=friction),
        effects=Effects(edge=Edge(share)),
        hold_distance=0.008,
    )
    return make_food_model(food, knife or Knife(length=0.4), Numerics(**numerics))


def along(model, depth=0.012, direction=(0.0, 0.0, 1.0)):
    way = ConstantSpeed(distance=depth, speed=0.05, direction=list(direction))
    return Motion(MotionPlan([way]), start_pose(model, 5e-4))


def cut(model, depth=0.012):
    return simulate_slice(CuttingSolver(model, 2e-3), along(model, depth))


def both_measures(model, motion):
    """Norms of the resultants of a slice and sums of norms, each coupling step."""
    solver = CuttingSolver(model, 2e-3)
    force = simulate_slice(solver, motion).food_wrench[:, 3:]
    return np.linalg.norm(force, axis=1), contact_sums(solver, motion)


def test_the_sum_of_norms_is_never_less_than_the_resultant():
    model = bar()
    resultant, norms = both_measures(model, along(model, direction=(1.0, 0.0, 1.0)))
    assert norms[-1] > 0.0 and norms[0] == 0.0
    # Two percent, for one is the coupling step's mean and the other its end. The blade shares added
    # inertia with faces that it does not touch yet, and its spring then has up to 0.1 mN.
    assert np.all(norms >= 0.98 * resultant - 2e-4)
    assert norms[-1] > 1.5 * resultant[-1]


def test_parallel_contacts_have_a_sum_of_norms_that_is_their_resultant():
    model = bar(RAZOR, friction=0.0, flank_length=0.4)
    resultant, norms = both_measures(model, along(model))
    assert resultant[-1] == pytest.approx(TOUGHNESS * 0.02, rel=0.1)
    assert norms[-1] == pytest.approx(resultant[-1], rel=0.01)


def test_contact_forces_add_up_to_the_force_on_the_knife():
    model = bar(time_step=2e-4, precision="float64")
    solver = CuttingSolver(model, 2e-4)
    pose, state = start_pose(model, 5e-4), solver.initial_state()
    pose = Pose(model.X_FC_rotation.T @ pose.R, model.to_cut_frame(pose.p))
    for _ in range(600):
        after = pose._replace(p=pose.p + 2e-4 * np.array([0.03, 0.0, -0.05]))
        step = solver.coupling_step(state, pose, after)
        forces = contact_forces(solver, step.state, pose, after)
        state, pose = step.state, after
    assert forces.shape == (len(model.point_nodes), 2, 3)
    total = forces.sum((0, 1))
    # Along the cut; across it the knife has the force of its bending blade.
    np.testing.assert_allclose(total[[0, 2]], step.wrench[[3, 5]], rtol=0.02)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_the_edge_takes_its_share_and_leaves_the_rest_to_opening(share):
    model = bar(RAZOR, share, friction=0.0, flank_length=0.4)
    result = cut(model, depth=0.0156)
    balance = result.balance
    whole = TOUGHNESS * model.section_area
    assert balance.edge == pytest.approx(share * whole, rel=0.02, abs=1e-9)
    assert balance.opening < 0.02 * whole, "a razor opens nothing"
    assert abs(balance.residual(result.energies)) < 0.01 * max(balance.work, 0.02 * whole)


def test_bonds_that_the_edge_left_are_torn_apart_by_a_thick_blade():
    model = bar(Knife(length=0.4, spine_thickness=0.015), 0.0, friction=0.0).derive(
        material=Material(youngs_modulus=2e6, toughness=20.0, friction=0.0)
    )
    result = cut(model, depth=0.03)
    balance, whole = result.balance, 20.0 * model.section_area
    assert balance.edge == 0.0
    assert balance.opening == pytest.approx(whole, rel=0.05)
    # Bonds that held nothing behind the edge would dissipate what nobody put in.
    assert abs(balance.residual(result.energies)) < 0.1 * whole


def test_bonds_that_hold_behind_the_edge_store_what_the_energy_balance_says():
    model = bar(Knife(length=0.4, spine_thickness=0.002), 0.0, friction=0.0, time_step=2.5e-4)
    result = cut(model, depth=0.01)
    assert result.cut[-1] > 0.5 and result.balance.opening == 0.0
    assert abs(result.balance.residual(result.energies)) < 0.003 * result.balance.work


def test_the_case_holds_disects_parameters_per_area():
    case, springs = load_case("opening_alone"), load_reference().springs
    model = case.model()
    unit = case.food.material.youngs_modulus / model.element_size
    given, material = case.numerics, case.food.material
    assert model.section_area == pytest.approx(springs.section)
    assert springs.count == disect.spring_count(6, 5)
    bond, flank = (springs.per_area(k) for k in (springs.stiffness, springs.contact_stiffness))
    assert given.bond_stiffness * unit == pytest.approx(bond, rel=2e-3)
    assert case.food.material.youngs_modulus / given.flank_length == pytest.approx(flank, rel=2e-3)
    assert given.board_stiffness * unit == pytest.approx(1000.0 / 36e-6, rel=5e-3)
    assert material.friction == pytest.approx(springs.friction_at(0.05), rel=1e-3)
    entered = load_reference().foods[0]
    E, nu = disect.small_strain_moduli(entered.youngs_modulus, entered.poisson_ratio)
    assert (material.youngs_modulus, material.poisson_ratio) == pytest.approx((E, nu), rel=1e-3)
    toughness, strength = disect.opening_law(springs, 1.982e-4)
    assert (material.toughness, material.strength) == pytest.approx((toughness, strength), rel=0.01)


def test_springs_contact_and_board_keep_their_stiffness_per_area_in_another_material():
    case = load_case("opening_alone")
    other = disect.with_material(case, youngs_modulus=2.0 * case.food.material.youngs_modulus)

    def per_area(case):
        E, given = case.food.material.youngs_modulus, case.numerics
        return E / given.flank_length, E * given.bond_stiffness, E * given.board_stiffness

    assert per_area(other) == pytest.approx(per_area(case))


def test_turning_a_body_strains_it_in_disect_as_was_found_there():
    assert disect.rotation_stress(0.0, 2.6e6, 0.37) == pytest.approx(0.0, abs=1e-6)
    assert disect.rotation_stress(math.radians(10.0), 2.6e6, 0.37) == pytest.approx(3.6e3, rel=0.02)


@pytest.fixture(scope="module")
def runs():
    reference, case = load_reference(), load_case("opening_alone")
    nominal = run_case(case, whole_copies=True)
    stiff = next(run for run in reference.runs if run.contact_factor == 4.0)
    return (
        reference,
        nominal,
        run_case(disect.as_run(case, reference.springs, reference.runs[0], stiff, nominal), True),
        stiff,
    )


def test_the_opening_law_with_disects_parameters_has_disects_force(runs):
    reference, ours, stiffer, stiff = runs
    theirs = reference.runs[0]
    assert ours.norms[-1] == pytest.approx(theirs.sum_end, rel=0.01)
    # Springs press there as soon as the knife touches them, and here by the part that is cut.
    assert ours.at(disect.MIDDLE, ours.norms) == pytest.approx(theirs.sum_middle, rel=0.04)
    assert ours.vertical[-1] == pytest.approx(theirs.vertical_end, rel=0.01)
    assert stiffer.norms.max() == pytest.approx(stiff.sum_peak, rel=0.02)
    assert stiffer.vertical.max() == pytest.approx(stiff.vertical_peak, rel=0.02)


def test_the_springs_of_the_case_open_as_far_as_its_toughness_says(runs):
    reference, ours, _, _ = runs
    nominal = reference.runs[0]
    delay, opened = disect.break_opening(
        reference.springs, nominal, nominal, ours.offset, ours.slope
    )
    assert delay == pytest.approx(nominal.break_delay)
    assert opened == pytest.approx(1.982e-4, rel=0.02)
    other = dc.replace(nominal, spring_factor=4.0, time_step=0.25 * nominal.time_step)
    again = disect.break_opening(reference.springs, nominal, other, ours.offset, ours.slope)
    assert again == pytest.approx((delay, opened)), "four times as stiff, four times as often"


def settings_rows(text):
    table = text.split("## Everything that DiSECt sets")[1]
    rows = re.findall(r"^\| (.*?) \| (.*?) \| (.*?) \|$", table, re.M)
    assert rows[0][0] == "DiSECt"
    return rows[1:]


def test_every_field_that_the_page_names_exists():
    rows = settings_rows((ROOT / "docs/results/disect.md").read_text(encoding="utf-8"))
    assert [row[0] for row in rows] == [name for name, _, _ in SETTINGS]
    for name, _, here in rows:
        named = re.findall(r"`([^`]+)`", here)
        fields = [n for n in named if "." in n or n in ("clearance", "period")]
        assert fields or "no counterpart, because" in here, name
        for field in fields:
            disect_page.field_unit(field)
        for function in set(named) - set(fields):
            assert callable(getattr(disect, function)), function


def test_a_field_that_does_not_exist_is_named():
    assert disect_page.field_unit("food.shape.divisions") == ""
    assert disect_page.field_unit("motion.segments.speed") == "m/s"
    with pytest.raises(KeyError, match="food.material.colour: there is no colour"):
        disect_page.field_unit("food.material.colour")


def test_page_and_figure_show_what_the_study_found(runs, tmp_path):
    reference, ours, stiffer, stiff = runs
    profile = load_simulated_profile(
        resource_path("calibration/measured/sliceit_real_cucumber_force.csv")
    )
    curves = [
        Curve("measured", "norm of the resultant", profile.force),
        Curve("DiSECt, calibrated", "sum of norms", profile.references["DiSECt"]),
        *(
            Curve(name, measure, 2.0 * profile.force)
            for name in ("full model", "opening law alone")
            for measure in ("resultant", "sum of norms")
        ),
    ]
    study = DisectStudy(
        reference=reference,
        contact_stiffness=1429.0,
        runs=[(reference.runs[0], ours), (stiff, stiffer)],
        delays=[0.1343, 0.1],
        laws=[(0.185, 1390.0)] * 2,
        opening=ours,
        full=stiffer,
        differences=[Difference("a difference", "there", "here", "reason", "effect")],
        measured=[MeasuredCurves("cucumber", profile, 0.02, curves, 0.1)] * 3,
    )
    page = render("disect", **disect_page.page_values(study, "a command", 1.5))
    assert f"| 88.6 / {ours.norms.max():.1f} |" in page
    assert "| cucumber | DiSECt, calibrated | sum of norms | 18.0 |" in page
    assert len(settings_rows(page)) == len(SETTINGS)
    disect_page.plot_disect(study, tmp_path / "disect.png")
    assert (tmp_path / "disect.png").stat().st_size > 1e4
