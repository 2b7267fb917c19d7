"""Where sub-steps are long the blade is heavy against the faces of the cut: it must not swing."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from sliceit_drake.cutting import model as model_module
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import make_food_model, start_pose
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.resources import resource_path

BAND = (8.0, 30.0)
"""In which it swings, Hz."""


def swings(food: str) -> list[float]:
    """Largest lateral force of the swing, N: in 0.1 s soon after it met the food, and 0.4 s on."""
    calibrated = load_calibrated_food(resource_path(f"calibration/foods/{food}.yaml"))
    model = make_food_model(calibrated.food, calibrated.knife, Numerics(time_step=1e-3), 0.8)
    plan = MotionPlan([ConstantSpeed(distance=0.014, speed=0.02)])
    motion = Motion(plan, start_pose(model, clearance=1e-3))
    result = simulate_slice(CuttingSolver(model, 2e-3), motion)
    waves = butter(2, BAND, "band", fs=1.0 / np.diff(result.time)[0], output="sos")
    lateral = np.abs(sosfiltfilt(waves, result.food_wrench[:, 4]))
    windows = ((result.time > t) & (result.time <= t + 0.1) for t in (0.1, 0.5))
    return [float(lateral[window].max()) for window in windows]


@pytest.mark.parametrize("food", ["potato", "carrot"])
def test_the_swing_of_a_blade_dies_away_within_half_a_second(food, monkeypatch):
    soon, later = swings(food)
    assert later < 0.1 * soon
    monkeypatch.setattr(model_module, "SWING", 0.0)
    soon, later = swings(food)
    assert later > 0.1 * soon
