"""A food by a law of the benches is cut in a station as the law says, from its context alone."""

import json

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator

from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import Condition, Specimen
from studies.__main__ import main as studies
from studies.benches.section import Section
from studies.benches.slice_push import SlicePush
from studies.learning.foreign_law import ForeignCutter, ForeignFood, ForeignWorld

PERIOD, DIAMETER = 2e-3, 0.03
LAW = SlicePush(aside=0.01)
X_WF = RigidTransform(RotationMatrix.MakeZRotation(0.7), [0.4, 0.1, 0.05])


def pose(step: int) -> RigidTransform:
    """Down at 20 mm/s with a draw to and fro, the edge along Fx."""
    place = [4e-3 * np.sin(0.05 * step), 0.0, DIAMETER + 1e-3 - 0.02 * PERIOD * step]
    return X_WF @ RigidTransform(RotationMatrix.MakeXRotation(np.pi), place)


def simulator(cutter: ForeignCutter) -> Simulator:
    out = Simulator(cutter)
    move(cutter, out, 0)
    out.Initialize()
    return out


def move(cutter: ForeignCutter, run: Simulator, step: int) -> np.ndarray:
    """The wrench that the cutter holds after a coupling step at a pose."""
    context = run.get_mutable_context()
    cutter.GetInputPort("knife_pose").FixValue(context, Value(pose(step)))
    cutter.GetInputPort("knife_velocity").FixValue(context, Value(SpatialVelocity.Zero()))
    if step:
        # A step's update is at its start.
        run.AdvanceTo((step + 0.5) * PERIOD)
    return cutter.GetOutputPort("food_wrench_vector").Eval(context).copy()


def test_the_force_is_that_of_the_law_and_the_whole_section_is_cut():
    food = ForeignFood(LAW, DIAMETER, toughness=1.2, friction=0.9)
    cutter = ForeignCutter(food, X_WF, PERIOD)
    run = simulator(cutter)
    specimen = Specimen(0, Condition(), toughness=1.2, friction=0.9)
    section = Section(DIAMETER, DIAMETER, is_round=True)
    X_FW = X_WF.inverse()
    x, _, z = (X_FW @ pose(0)).translation()
    law = LAW.begin(section, specimen, x, z)
    largest = 0.0
    for step in range(1, 800):
        wrench = move(cutter, run, step)
        x, _, z = (X_FW @ pose(step)).translation()
        forces = law.advance(PERIOD, x, z, 1.0, 1.0)
        force = X_WF.rotation().matrix() @ forces.sum(0)
        np.testing.assert_allclose(wrench[3:], force, atol=1e-9)
        largest = max(largest, float(np.linalg.norm(force)))
        # The edge's force acts where the section is, wherever the knife is drawn to.
        turned = X_WF.rotation().matrix().T @ wrench[:3]
        about_y = -(law.middle - x) * forces.sum(0)[2]
        raised = 0.5 * max(DIAMETER - z, 0.0) * forces[1:].sum(0)[0]
        assert turned[1] == pytest.approx(about_y + raised, abs=1e-9)
    assert largest > 5.0
    assert cutter.progress(run.get_context()) == pytest.approx(1.0)


def test_two_contexts_of_one_food_do_not_disturb_each_other():
    cutter = ForeignCutter(ForeignFood(LAW, DIAMETER), X_WF, PERIOD)
    alone = simulator(cutter)
    expected = [move(cutter, alone, step) for step in range(1, 300)]
    one, other = simulator(cutter), simulator(cutter)
    found = []
    for step in range(1, 300):
        found.append(move(cutter, one, step))
        if step % 2:
            move(cutter, other, step)
    np.testing.assert_array_equal(found, expected)


def test_slices_of_a_food_have_its_law_and_differ_and_repeat():
    foods = [ForeignWorld(5).scenario("potato", k).cutting for k in range(3)]
    assert len({food.law for food in foods}) == 1
    assert len({(food.toughness, food.diameter) for food in foods}) == 3
    assert ForeignWorld(5).scenario("potato", 1).cutting == foods[1]
    assert ForeignWorld(6).scenario("potato", 1).cutting.law != foods[1].law


@pytest.mark.second_tier
def test_policies_are_evaluated_by_it_and_finish(tmp_path, capsys):
    policy, file = str(resource_path("models/policies/corrected_0")), tmp_path / "slices.jsonl"
    assert studies(["foreign_law", policy, "--slices", "1", "--output", str(file)]) == 0
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(rows) == 4
    assert all(r["world"] == "slice_push" and r["completed"] and r["peak_force"] > 2 for r in rows)
    assert "slice_push" in capsys.readouterr().out
