"""Least squares by Gauss and Newton with Levenberg's and Marquardt's damping, within the ranges."""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import lsq_linear

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.noise import EvenNoise, NoiseModel

__all__ = [
    "PRIOR_CENTER",
    "PRIOR_VARIANCE",
    "Fit",
    "Linearisation",
    "gauss_newton",
    "linear_step",
    "linearise",
    "residuals_at",
]

PRIOR_CENTER, PRIOR_VARIANCE = 0.5, 1.0 / 12.0
"""Mean and variance of a place that is uniform in the unit range: what is known beforehand."""
DAMPINGS = (0.0, 1e-2, 1.0, 1e2)
"""Tried side by side, times the present damping; in units of the diagonal."""
FIRST_DAMPING, WORST_DAMPING = 1e-2, 1e6
RETREAT = 1e3
"""By which the damping grows where none of a step's was good enough."""
EASE = 1e-2
"""By which it falls at most after a step."""
NUISANCE_FLOOR = 1e-9


@dc.dataclass
class Linearisation:
    """The residuals about a place; entries that are not used are zero.

    Attributes:
        unit: The place [d].
        residuals: Predicted minus measured [M], N.
        jacobian: By the unit values [M, d].
        nuisance: By numbers that are fitted within each prediction [M, q].
    """

    unit: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    nuisance: np.ndarray


@dc.dataclass
class Fit:
    """Result of `gauss_newton`.

    Attributes:
        unit: Best place [d].
        cost: Weighted sum of squares there, with the prior's where there is a noise model.
        converged: Whether it ended because no step promised a further decrease.
        linearisation: The last that was taken, at `unit` or one small step before.
    """

    unit: np.ndarray
    cost: float
    converged: bool
    linearisation: Linearisation


def linearise(model: Predictor, unit: np.ndarray, free: np.ndarray | None = None) -> Linearisation:
    """Residuals and derivatives at a place; by values that are not `free`, mask [d], zero.

    Raises:
        CuttingError: A slice breaks down near it.
    """
    residuals, jacobian = model.jacobian(unit, free=free)
    mask = model.used
    nuisance = model.nuisance_jacobian(unit)
    return Linearisation(
        unit.copy(), mask * residuals, mask[:, None] * jacobian, mask[:, None] * nuisance
    )


def residuals_at(model: Predictor, units: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Residuals [M] at several places, computed side by side.

    Entries that are not used are zero; NaN marks a slice that broke down.
    """
    measured = model.measured
    return [
        np.where(model.used, np.concatenate([p.predicted.ravel() for p in row]) - measured, 0.0)
        for row in model.predict(units)
    ]


def gauss_newton(
    model: Predictor,
    start: np.ndarray,
    *,
    noise: NoiseModel | EvenNoise | None = None,
    free: np.ndarray | None = None,
    steps: int = 10,
    tolerance: float = 1e-4,
    linearisation: Linearisation | None = None,
    progress: Callable[[int], None] | None = None,
) -> Fit:
    """Minimises the sum of squares within the unit ranges.

    Each step solves the damped linear problem with its bounds for several dampings and takes the
    best of them (Levenberg 1944, Marquardt 1963); one that breaks a slice down is never taken.
    Numbers that are fitted within each prediction take part in the linear problem, so that the step
    allows for their change (variable projection).

    Args:
        model: Gives residuals and derivatives.
        start: Places in the ranges [d].
        noise: Its inverse covariance weighs the residuals, and the prior of a uniform range is
            added; None for the plain sum of squares.
        free: Mask [d] of the parameters that may move; all by default.
        steps: Most steps.
        tolerance: Ends where the linear problem promises a smaller relative decrease.
        linearisation: At `start`, if it is there already.
        progress: Called before each step with the number of those taken.

    Raises:
        CuttingError: A slice breaks down at the start.
    """
    free = np.ones(len(start), bool) if free is None else free
    at = linearisation or linearise(model, np.clip(start, 0.0, 1.0), free)
    cost = _cost(at.residuals, at.unit, noise)
    damping, taken = FIRST_DAMPING, 0
    while taken < steps:
        if progress is not None:
            progress(taken)
        H, g = _normal_equations(at, noise)
        move = linear_step(H, g, at.unit, 0.0, free)
        promised = float(-2.0 * g @ move - move @ H @ move)
        if promised <= tolerance * cost:
            return Fit(at.unit, cost, True, at)
        accepted = None
        while accepted is None and damping <= WORST_DAMPING:
            moves = [linear_step(H, g, at.unit, factor * damping, free) for factor in DAMPINGS]
            places = [np.clip(at.unit + move, 0.0, 1.0) for move in moves]
            tried = residuals_at(model, places)
            costs = [_cost(r, u, noise) for r, u in zip(tried, places, strict=True)]
            k = int(np.argmin(costs))
            if costs[k] >= cost:
                damping *= RETREAT
                continue
            if taken + 1 == steps or cost - costs[k] <= tolerance * cost:
                return Fit(places[k], costs[k], taken + 1 < steps, at)
            try:
                accepted = linearise(model, places[k], free)
            except CuttingError:
                # So near to where slices break down there is no derivative.
                damping *= RETREAT
        if accepted is None:
            return Fit(at.unit, cost, False, at)
        at, taken = accepted, taken + 1
        cost = _cost(at.residuals, at.unit, noise)
        damping = float(np.clip(damping * max(DAMPINGS[k], EASE), 1e-8, 1.0))
    return Fit(at.unit, cost, False, at)


def _cost(residuals: np.ndarray, unit: np.ndarray, noise: NoiseModel | EvenNoise | None) -> float:
    """Sum of squares; infinite where a slice broke down."""
    if not np.isfinite(residuals).all():
        return float("inf")
    if noise is None:
        return float(residuals @ residuals)
    prior = float(((unit - PRIOR_CENTER) ** 2).sum()) / PRIOR_VARIANCE
    return float(residuals @ noise.solve(residuals[:, None])[:, 0]) + prior


def _normal_equations(
    at: Linearisation, noise: NoiseModel | EvenNoise | None
) -> tuple[np.ndarray, np.ndarray]:
    """Half the second derivatives [d, d] and half the gradient [d] of the cost.

    Nuisance numbers are eliminated.
    """
    d = at.jacobian.shape[1]
    columns = np.column_stack([at.jacobian, at.nuisance])
    weighted = columns if noise is None else noise.solve(columns)
    H, g = columns.T @ weighted, weighted.T @ at.residuals
    if columns.shape[1] > d:
        B, C = H[:d, d:], H[d:, d:]
        size = np.diag(C).copy()
        C = C + np.diag(NUISANCE_FLOOR * size + np.where(size > 0.0, 0.0, 1.0))
        H, g = H[:d, :d] - B @ np.linalg.solve(C, B.T), g[:d] - B @ np.linalg.solve(C, g[d:])
    if noise is not None:
        H = H + np.eye(d) / PRIOR_VARIANCE
        g = g + (at.unit - PRIOR_CENTER) / PRIOR_VARIANCE
    return H, g


def linear_step(
    H: np.ndarray, g: np.ndarray, unit: np.ndarray, damping: float, free: np.ndarray
) -> np.ndarray:
    """The move [d] that minimises the damped quadratic within the box."""
    diagonal = np.diag(H)
    floor = 1e-12 * max(float(diagonal.max()), 1e-300)
    A = H + np.diag(damping * diagonal + floor)
    move = np.zeros(len(unit))
    some = np.flatnonzero(free)
    if some.size == 0:
        return move
    # |L' x + L^-1 g|^2 is the quadratic, up to a constant.
    values, vectors = np.linalg.eigh(A[np.ix_(some, some)])
    root = np.sqrt(np.maximum(values, floor))
    # Bounds must be apart for the solver.
    low, high = -unit[some] - 1e-12, 1.0 - unit[some] + 1e-12
    target = -(vectors.T @ g[some]) / root
    result = lsq_linear(root[:, None] * vectors.T, target, (low, high), method="bvls")
    move[some] = result.x
    return move
