"""The extended model: a food and its bench with what was named in them, and what they predict."""

import copy
import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import make_food_model
from sliceit_drake.cutting.parameters import get_parameter, with_parameters
from sliceit_drake.diagnosis.cause import Cause, Values
from sliceit_drake.diagnosis.evidence.confirm import predicted_at
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.prediction import Point, SlicePredictor
from sliceit_drake.prediction.series import SliceFacts

__all__ = ["extended_food", "predicting_by"]


def extended_food(
    setup: CalibrationSetup, factors: Mapping[str, float], causes: Sequence[tuple[Cause, Values]]
) -> tuple[CalibratedFood, list[str]]:
    """The food of a setup with base parameters times factors, and with causes in it and its bench.

    Returns:
        The food, and the names of the causes that it cannot hold, with the reason.
    """
    food, bench = copy.deepcopy(setup.food), setup.bench
    model = make_food_model(food, setup.knife, setup.numerics, setup.refinement)
    facts = SliceFacts(height=model.top - model.bottom, width=float(np.ptp(model.span)))
    values = {name: float(get_parameter(model, name)) * factor for name, factor in factors.items()}
    model, left = with_parameters(model, values), []
    for cause, found in causes:
        changed = cause.model(model, found, facts)
        if cause.per_record:
            left.append(f"{cause.name} (differs from slice to slice)")
        elif not cause.expressible or changed.point_scales is not model.point_scales:
            left.append(f"{cause.name} (acts by code of its own)")
        else:
            model, bench = changed, cause.bench(bench, found)
    food.material, food.effects = model.material, model.effects
    return CalibratedFood(food=food, knife=setup.knife, bench=bench), left


def predicting_by(
    problem: LinearProblem, predictor: SlicePredictor, food: CalibratedFood
) -> LinearProblem:
    """The problem with what simulations of a food and its bench predict, as its file gives them."""
    setup = dc.replace(predictor.setup, food=food.food, bench=food.bench)
    return predicted_at(Point(), problem, predictor.of(setup))
