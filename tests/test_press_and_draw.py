"""Cutting force of the edge against Atkins, Xu and Jeronimidis (2004)."""

import numpy as np
import pytest

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

TOUGHNESS = 300.0
WIDTH = 0.024
HEIGHT = 0.030
SPEED = 0.02


def cut_bar(draw_ratio: float, divisions: list[int], layers: list[float]) -> SliceResult:
    """Cuts a bar of constant width, its sides along the knife's motion, without flank friction."""
    food = Food(
        name="bar",
        shape=Box(size=[WIDTH, 0.1, HEIGHT], divisions=divisions, layers=layers),
        material=Material(youngs_modulus=2e6, toughness=TOUGHNESS, friction=0.0),
    )
    # A blade as thin as a razor's, so that it does not wedge the cut open ahead of its edge: what
    # the wedge spends on opening is not asked of the edge.
    knife = Knife(length=0.4, spine_thickness=4e-4)
    model = make_food_model(food, knife, Numerics(time_step=2e-4))
    plan = MotionPlan(
        [
            ConstantSpeed(
                direction=[draw_ratio, 0.0, 1.0],
                duration=1.3,
                acceleration=None,
                speed=SPEED * np.hypot(1.0, draw_ratio),
            )
        ]
    )
    start = start_pose(model, clearance=5e-4, offset=-0.5 * draw_ratio * HEIGHT)
    return simulate_slice(CuttingSolver(model, 2e-3), Motion(plan, start))


MESHES = {
    "coarse": ([5, 6], [0.0, 0.004, 0.012]),
    "fine": ([9, 11], [0.0, 0.0025, 0.0055, 0.012]),
}


@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("draw_ratio", [0.0, 3.0])
def test_steady_edge_force_follows_atkins(draw_ratio, mesh):
    result = cut_bar(draw_ratio, *MESHES[mesh])
    depth = HEIGHT - result.position[:, 2]
    steady = (depth > 0.25 * HEIGHT) & (depth < 0.75 * HEIGHT)
    vertical, along = result.edge[steady, 2], result.edge[steady, 0]

    expected = TOUGHNESS * WIDTH / (1.0 + draw_ratio**2)
    assert vertical.mean() == pytest.approx(expected, rel=0.02)
    assert vertical.std() <= 0.05 * expected
    # The knife is drawn along +x, so the food resists along -x.
    assert -along.mean() == pytest.approx(draw_ratio * expected, rel=0.02, abs=0.01 * expected)


def test_drawing_does_the_work_of_the_toughness_like_pressing():
    works = [cut_bar(xi, *MESHES["coarse"]).balance.edge for xi in (0.0, 3.0)]
    depth = 1.3 * SPEED - 5e-4
    for work in works:
        assert work == pytest.approx(TOUGHNESS * WIDTH * depth, rel=0.03)
