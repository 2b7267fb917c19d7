"""A simulated slice beside a measured force profile."""

import dataclasses as dc

import numpy as np
from scipy.optimize import minimize_scalar

from sliceit_drake.diagrams.scenario import Measurement
from sliceit_drake.records.force_profile import ForceProfile

__all__ = ["Comparison", "can_compare", "compare_with_measurement"]


@dc.dataclass
class Comparison:
    """Measured and simulated force over depth, with the height offset fitted.

    Attributes:
        time_since_contact: Of each measured sample [n], s.
        depth: Of the edge below the top of the food at each measured sample [n], metres.
        measured: Measured force [n], N.
        simulated: Norm of the simulated force at the same depth [n], N; NaN outside the run.
        contact_time: Time of first contact in the measured record, s: the fitted offset.
        rms: Root mean square difference over the compared samples, N.
        measured_peak, simulated_peak: N, over the compared samples.
    """

    time_since_contact: np.ndarray
    depth: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    contact_time: float
    rms: float
    measured_peak: float
    simulated_peak: float


def can_compare(depth: np.ndarray) -> bool:
    """Whether a descent [k], metres, went at least 1 mm into the food."""
    return len(depth) >= 10 and depth[-1] >= 1e-3


def compare_with_measurement(
    profile: ForceProfile, measurement: Measurement, depth: np.ndarray, force: np.ndarray
) -> Comparison:
    """Fits the unknown time of first contact of a measured record and compares forces.

    Args:
        profile: Measured force over time, taken at constant speed.
        measurement: Its speed, and its time of first contact if known.
        depth: Simulated depth of the edge below the top of the food while it descends [k], metres,
            increasing.
        force: Norm of the simulated force [k], N.

    Raises:
        ValueError: The simulated knife did not cut, see `can_compare`.
    """
    if not can_compare(depth):
        raise ValueError("the knife did not descend into the food: ask can_compare first")

    def simulated(contact_time: float) -> np.ndarray:
        d = measurement.speed * (profile.time - contact_time)
        return np.interp(d, depth, force, left=0.0, right=np.nan)

    def mean_square(contact_time: float) -> float:
        difference = simulated(contact_time) - profile.force
        return float(np.nanmean(difference**2))

    if measurement.time_offset is not None:
        contact_time = measurement.time_offset
    else:
        grid = np.linspace(profile.time[0], profile.time[0] + 0.4, 161)
        best = grid[int(np.argmin([mean_square(t) for t in grid]))]
        step = grid[1] - grid[0]
        fit = minimize_scalar(mean_square, bounds=(best - step, best + step), method="bounded")
        contact_time = float(fit.x)
    values = simulated(contact_time)
    used = np.isfinite(values)
    return Comparison(
        time_since_contact=profile.time - contact_time,
        depth=measurement.speed * (profile.time - contact_time),
        measured=profile.force,
        simulated=values,
        contact_time=contact_time,
        rms=float(np.sqrt(np.mean((values[used] - profile.force[used]) ** 2))),
        measured_peak=float(profile.force[used].max()),
        simulated_peak=float(values[used].max()),
    )
