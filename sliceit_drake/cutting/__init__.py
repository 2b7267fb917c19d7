"""Cutting physics: finite elements, cut surface, knife and board; no Drake."""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.cutting import parameters as parameters
    from sliceit_drake.cutting.batch import simulate_batch as simulate_batch
    from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood as CalibratedFood
    from sliceit_drake.cutting.foods.effects import Effects as Effects
    from sliceit_drake.cutting.foods.food import make_food_model as make_food_model
    from sliceit_drake.cutting.foods.food import start_pose as start_pose
    from sliceit_drake.cutting.gradient import SliceAdjoint as SliceAdjoint
    from sliceit_drake.cutting.knife import load_knife as load_knife
    from sliceit_drake.cutting.knife_path import KnifePath as KnifePath
    from sliceit_drake.cutting.model import Numerics as Numerics
    from sliceit_drake.cutting.motion_optimization import optimize_motion as optimize_motion
else:
    __getattr__, __dir__ = lazy_names(__name__)
