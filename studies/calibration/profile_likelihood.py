"""The likelihood along one parameter of a calibration, beside its normal approximation."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri

from sliceit_drake.calibration.gauss_newton import Fit, gauss_newton
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.uncertainty import Estimate
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["Profile", "profile_likelihood"]

STEPS = 3
"""Most steps of each refit."""
DISAGREEMENT = 0.3
"""Relative difference of a reach from that of the normal approximation that is reported."""


@dc.dataclass
class Profile:
    """The likelihood along one parameter, all others refitted.

    Attributes:
        name: The parameter.
        places: Where it was held, in its range [n].
        drops: Fall of twice the log of likelihood times prior there [n].
        expected: What the posterior's normal approximation says [n].
        interval: Of the level that `drops` belong to, in the parameter's unit.
        warning: Where profile and normal approximation disagree, or None.
    """

    name: str
    places: np.ndarray
    drops: np.ndarray
    expected: np.ndarray
    interval: tuple[float, float]
    warning: str | None


def profile_likelihood(
    model: Predictor,
    found: Estimate,
    name: str,
    level: float = 0.9,
    steps: int = STEPS,
) -> Profile:
    """Holds a parameter at several places, refits the others and finds where the fit gets worse.

    It is held at one standard deviation and at the ends of the interval, on both sides, or at the
    end of the range. Root of the drop over distance is constant in the normal approximation.

    Args:
        model: Of the records.
        found: From `estimate`.
        name: Of the parameter.
        level: Of the interval.
        steps: Most steps of each refit.

    Returns:
        The profile; its interval is widened by as much as the posterior is by what is not known of
        the noise.

    Raises:
        CuttingError: A slice breaks down near the estimate.
        ValueError: There is no such parameter.
    """
    names = [p.name for p in model.parameters]
    if name not in names:
        raise ValueError(f"there is no parameter {name!r} among {', '.join(names)}")
    model = model.without_step_error(found.unit)
    k, z = names.index(name), float(ndtri(0.5 + level / 2.0))
    sd = float(np.sqrt(found.covariance[k, k]))
    widening = float(np.sqrt(found.posterior.covariance[k][k])) / sd
    others = np.arange(len(names)) != k
    # The last step may have left the estimate a little off the middle.
    best = _refit(model, found, found.unit, np.ones(len(names), bool), steps)
    places, drops, expected, ends, faults = [], [], [], [], []
    for side in (-1.0, 1.0):
        line = [(0.0, 0.0)]
        for distance in (1.0, z):
            place = float(np.clip(found.unit[k] + side * distance * sd, 0.0, 1.0))
            away = abs(place - found.unit[k]) / sd
            if away <= line[-1][0] + 1e-6:
                continue
            slope = found.covariance[k] / found.covariance[k, k]
            start = np.clip(found.unit + slope * (place - found.unit[k]), 0.0, 1.0)
            start[k] = place
            try:
                fit = _refit(model, found, start, others, steps)
            except CuttingError:
                faults.append(f"{_side(side)} breaks slices down")
                break
            drop = max(fit.cost - best.cost, 0.0)
            line.append((away, float(np.sqrt(drop))))
            places.append(place)
            drops.append(drop)
            expected.append(away**2)
        limit = found.unit[k] if side < 0.0 else 1.0 - found.unit[k]
        reach = _crossing(line, z) if len(line) > 1 else min(z, limit / sd)
        if len(line) > 1:
            ratio = min(reach, limit / sd) / min(z, limit / sd)
            if abs(ratio - 1.0) > DISAGREEMENT:
                faults.append(f"{_side(side)} reaches {ratio:.2g} times as far")
        ends.append(float(np.clip(found.unit[k] + side * reach * sd * widening, 0.0, 1.0)))
    parameter = model.parameters[k]
    warning = None
    if faults:
        warning = (
            f"{name}: the likelihood is not that of the normal approximation; its profile "
            f"{', and '.join(faults)}"
        )
    interval = (parameter.value(ends[0]), parameter.value(ends[1]))
    return Profile(name, np.array(places), np.array(drops), np.array(expected), interval, warning)


def _refit(
    model: Predictor, found: Estimate, start: np.ndarray, free: np.ndarray, steps: int
) -> Fit:
    return gauss_newton(model, start, noise=found.noise, free=free, steps=steps, tolerance=1e-6)


def _side(side: float) -> str:
    return "below" if side < 0.0 else "above"


def _crossing(line: Sequence[tuple[float, float]], height: float) -> float:
    """Where a line through points of rising height reaches one; beyond them it goes on straight."""
    for (x0, y0), (x1, y1) in zip(line[:-1], line[1:], strict=True):
        if y1 >= height:
            return x0 + (height - y0) / (y1 - y0) * (x1 - x0)
    (x0, y0), (x1, y1) = line[-2:]
    rise = (y1 - y0) / (x1 - x0)
    return float("inf") if rise <= 0.0 else x1 + (height - y1) / rise
