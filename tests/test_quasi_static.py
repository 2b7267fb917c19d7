"""Static equilibrium: what pushes the knife is what holds the food."""

import numpy as np
import pytest
from held_reaction import held_reaction

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver


@pytest.mark.parametrize("held_sides", ["both", "minus", "none"])
@pytest.mark.parametrize("depth", [0.008, 0.020])
def test_knife_wrench_equals_the_reaction_of_clamp_and_board(held_sides, depth):
    food = Food(
        shape=Cylinder(rings=3, layers=[0.0, 0.004, 0.012]),
        material=Material(toughness=400.0, friction=0.1),
        held_sides=held_sides,
    )
    model = make_food_model(food, Knife(), Numerics())
    solver = CuttingSolver(model, 2e-3)
    plan = MotionPlan(
        [
            ConstantSpeed(distance=depth, speed=0.02, acceleration=None),
            Hold(duration=0.3),
        ]
    )
    result = simulate_slice(solver, Motion(plan, start_pose(model, clearance=5e-4)))
    # The mean of the last coupling steps takes out what still rings.
    state, X = result.state, result.pose
    steps = []
    held = []
    for _ in range(50):
        step = solver.coupling_step(state, X, X)
        state = step.state
        steps.append(step)
        held.append(held_reaction(solver, state, X))
    on_knife = np.mean([s.wrench[3:] for s in steps], axis=0)
    board = np.mean([s.board_force for s in steps], axis=0)
    reaction = np.mean(held, axis=0) + board
    weight = model.weight.sum(0)
    # Forces on the food: minus that on the knife, holder, board, weight.
    rest = -on_knife + reaction + weight
    assert np.linalg.norm(on_knife) > 3.0
    assert np.linalg.norm(rest) < 0.03 * np.linalg.norm(on_knife)
