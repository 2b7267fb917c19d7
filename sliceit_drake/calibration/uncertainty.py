"""How well records determine the parameters: posterior, what they cannot tell, profiles."""

import dataclasses as dc
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.special import ndtri

from sliceit_drake.calibration.gauss_newton import (
    PRIOR_CENTER,
    PRIOR_VARIANCE,
    Fit,
    Linearisation,
    ResidualModel,
    gauss_newton,
    linearise,
    residuals_at,
)
from sliceit_drake.calibration.posterior import Posterior
from sliceit_drake.calibration.prediction import Parameter
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.noise import NoiseFit, NoiseModel, fit_noise, group_series

__all__ = [
    "Estimate",
    "Profile",
    "RecordModel",
    "estimate",
    "estimate_posterior",
    "profile_likelihood",
]

ROUNDS = 3
STEPS = 3
SETTLED = 0.1
"""Largest move, in standard deviations, with which the alternation of noise and fit ends."""
DISAGREEMENT = 0.3
ODDS = 3.0
"""Standard deviations between two estimates that noise does not explain."""


class RecordModel(ResidualModel, Protocol):
    """What is needed besides residuals: `prediction.Predictor`, or anything that acts like it."""

    parameters: list[Parameter]

    @property
    def record_of(self) -> np.ndarray: ...

    @property
    def time(self) -> np.ndarray: ...

    @property
    def conditions(self) -> list[str]: ...

    def split(self, entries: np.ndarray, /) -> list[np.ndarray]: ...


@dc.dataclass
class Estimate:
    """The weighted fit of all parameters.

    Attributes:
        unit: Places in the ranges [d], those of the posterior's mean.
        posterior: Of the parameters.
        noise: Of the residuals.
        covariance: Of the parameters if `noise` were exact [d, d]; the posterior's allows for its
            uncertainty too.
    """

    unit: np.ndarray
    posterior: Posterior
    noise: NoiseModel
    covariance: np.ndarray


def estimate_posterior(
    model: RecordModel, unit: np.ndarray, profiled: Sequence[str] = ()
) -> Posterior:
    """Posterior of the parameters; see `estimate`.

    Args:
        model: Of the records.
        unit: A good fit, such as that of least squares [d].
        profiled: Parameters whose intervals are compared with `profile_likelihood`; where the two
            disagree the posterior's notes say so.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    found = estimate(model, unit)
    for name in profiled:
        warning = profile_likelihood(model, found, name).warning
        if warning is not None:
            found.posterior.notes.append(warning)
    return found.posterior


def estimate(model: RecordModel, unit: np.ndarray, rounds: int = ROUNDS) -> Estimate:
    """Fits parameters and noise in turn until the parameters rest.

    The parameters minimise the residuals weighted with the noise's covariance (generalised least
    squares) plus the prior of a uniform range, which has variance 1/12 about its middle: what the
    data do not determine stays as wide as its range. Where samples are autocorrelated and slices
    differ, this is not the fit of least squares; the posterior notes where the two are further
    apart than noise explains.

    Args:
        model: Of the records.
        unit: A good fit, such as that of least squares [d].
        rounds: Most alternations.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    at = linearise(model, np.clip(unit, 0.0, 1.0))
    found = _noise(model, at, None)
    for _ in range(rounds):
        fit = gauss_newton(
            model, at.unit, noise=found.model, steps=STEPS, tolerance=1e-5, linearisation=at
        )
        moved = np.abs(fit.unit - at.unit) / np.sqrt(np.diag(found.covariance))
        at = _at_end(model, fit)
        found = _noise(model, at, found.model)
        if moved.max() < SETTLED:
            break
    return _as_estimate(model, at, found, np.asarray(unit))


def _at_end(model: ResidualModel, fit: Fit) -> Linearisation:
    """The fit's linearisation, moved to its end: after a step that is small no new one is due."""
    at = fit.linearisation
    if fit.converged and np.array_equal(fit.unit, at.unit):
        return at
    if fit.converged:
        (residuals,) = residuals_at(model, [fit.unit])
        return Linearisation(fit.unit, residuals, at.jacobian, at.nuisance)
    return linearise(model, fit.unit)


def _noise(model: RecordModel, at: Linearisation, start: NoiseModel | None) -> NoiseFit:
    measured, used, record_of = model.measured, model.used, model.record_of
    conditions = model.conditions
    channels = [part.shape[1] for part in model.split(measured)]
    present = np.unique(record_of[used])
    named = [conditions[r] for r in present if conditions[r]]
    replicated = len(set(named)) < len(named)
    predicted = np.where(used, at.residuals + measured, 0.0)
    members = present if replicated else present[:0]
    return fit_noise(
        group_series(used, model.time, record_of, channels, conditions),
        at.residuals,
        at.jacobian,
        at.nuisance,
        predicted[:, None] * (record_of[:, None] == members),
        PRIOR_CENTER - at.unit,
        PRIOR_VARIANCE,
        float(np.sqrt(np.mean(measured[used] ** 2))),
        start,
    )


def _as_estimate(
    model: RecordModel, at: Linearisation, found: NoiseFit, least_squares: np.ndarray
) -> Estimate:
    parameters = model.parameters
    notes = []
    scale = found.model.record_scale
    if scale is None:
        notes.append(
            "no cut was repeated: how much slices differ is unknown, and the intervals hold for "
            "the slices that were measured"
        )
    covariance = found.averaged_covariance()
    sd = np.sqrt(np.diag(covariance))
    for k, parameter in enumerate(parameters):
        if abs(least_squares[k] - at.unit[k]) > ODDS * sd[k]:
            notes.append(
                f"{parameter.name}: least squares gives "
                f"{parameter.value(float(least_squares[k])):.3g}, the fit weighted with the noise "
                f"{parameter.value(float(at.unit[k])):.3g}: the model lacks something that noise "
                "does not explain"
            )
    posterior = Posterior(
        names=[p.name for p in parameters],
        low=[float(p.low) for p in parameters],
        high=[float(p.high) for p in parameters],
        log=[p.log for p in parameters],
        mean=at.unit.tolist(),
        covariance=covariance.tolist(),
        effective_samples=found.model.effective_samples,
        record_variation=scale,
        notes=notes,
    )
    return Estimate(at.unit, posterior, found.model, found.covariance)


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
    model: RecordModel,
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
    model: RecordModel, found: Estimate, start: np.ndarray, free: np.ndarray, steps: int
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
