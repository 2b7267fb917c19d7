"""A food from published levels of force: what its parameters may be, and no more."""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from scipy.stats import qmc

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.distribution import ParameterDistribution
from sliceit_drake.cutting.foods.food import make_food_model, start_pose
from sliceit_drake.cutting.foods.spring_food import calibrate_spring
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.prediction.clock import EXCHANGE_PERIOD

__all__ = ["food_from_literature"]

CLEARANCE = 5e-4
"""Height of the edge over the food at the start, metres."""
MIN_KEPT = 20
"""Cuts within the published range without which there is no distribution."""


def food_from_literature(
    setup: CalibrationSetup,
    cuts: int = 256,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> CalibratedFood:
    """Keeps the parameters whose press cut peaks within the published range.

    Approximate Bayesian computation by rejection (Pritchard et al. 1999): places drawn evenly from
    the ranges (a scrambled Sobol sequence) are kept where the simulated peak is in the range. Mean
    and covariance of what is kept are the food's; the range of forces leaves most of them wide.

    Args:
        setup: With `literature`.
        cuts: Number of places tried; rounded up to a power of two.
        progress: Called with the number of cuts done.

    Raises:
        ConfigurationError: The setup has no literature, or hardly any cut is within the range.
    """
    literature = setup.literature
    if literature is None:
        raise ConfigurationError(
            "has no published levels",
            field="literature",
            fix="Give peak_force and source in the setup, or calibrate from records.",
        )
    model = make_food_model(setup.food, setup.knife, setup.numerics, setup.refinement)
    plan = MotionPlan([ConstantSpeed(distance=model.top + CLEARANCE, speed=literature.speed)])
    ranges = setup.parameters
    distribution = ParameterDistribution(
        names=[p.name for p in ranges],
        low=[p.low for p in ranges],
        high=[p.high for p in ranges],
        log=[p.scale == "log" for p in ranges],
    )
    sampler = qmc.Sobol(len(ranges), seed=seed)
    places = sampler.random_base2(int(np.ceil(np.log2(max(cuts, 2)))))
    slices = simulate_batch(
        [with_parameters(model, distribution.values(place)) for place in places],
        [Motion(plan, start_pose(model, CLEARANCE))],
        EXCHANGE_PERIOD,
        progress=progress,
    )
    low, high = literature.peak_force
    peaks = np.array(
        [
            np.nan if s.failure else float(np.linalg.norm(s.food_wrench[:, 3:], axis=1).max())
            for s in slices
        ]
    )
    kept = (peaks >= low) & (peaks <= high)
    if kept.sum() < MIN_KEPT:
        middle = np.nanquantile(peaks, [0.05, 0.95])
        raise ConfigurationError(
            f"{int(kept.sum())} of {len(peaks)} cuts peak within {low:g} to {high:g} N; most are "
            f"within {middle[0]:.3g} to {middle[1]:.3g} N",
            field="literature.peak_force",
            fix="Widen the ranges of the parameters, or try more cuts (--trials).",
        )
    distribution.mean = places[kept].mean(0).tolist()
    distribution.covariance = np.atleast_2d(np.cov(places[kept].T)).tolist()
    central = with_parameters(model, distribution.values())
    return CalibratedFood(
        food=dc.replace(setup.food, material=central.material, effects=central.effects),
        knife=setup.knife,
        distribution=distribution,
        spring=calibrate_spring(peaks[kept].mean()[None], float(model.top - model.bottom)),
        records=[literature.source],
        note=f"From a published range of {low:g} to {high:g} N alone, not from a record: "
        f"{int(kept.sum())} of {len(peaks)} cuts are within it.",
    )
