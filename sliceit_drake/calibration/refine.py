"""Refinement by Adam on the exact gradient of the mean square error."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.adam import Adam
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["Refinement", "refine"]

RATE = 0.2
"""First step of Adam, in lengths that change the prediction by its error; a tenth of it in the last
quarter."""
RIDGE = 1e-3
"""Least curvature that is told apart, relative to the greatest."""
EPSILON = 1e-8
BACK_OFF = 0.5
MIN_RATE = 1e-6


@dc.dataclass
class Refinement:
    """A refinement, finished or not.

    Attributes:
        unit: Best place so far [d].
        error: Root mean square error there, N.
        errors: Of each step so far.
    """

    unit: np.ndarray
    error: float
    errors: list[float]


def refine(
    predictor: Predictor,
    start: np.ndarray,
    steps: int,
    checkpoint: Path | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Refinement:
    """Adam (Kingma and Ba 2015, algorithm 1) from `start`, within the unit ranges.

    The parameters of a cut trade against each other in narrow valleys, along whose walls Adam goes
    to and fro. So it runs in the principal axes of the sensitivity at the start, each scaled by its
    curvature (the Gauss-Newton matrix, one Jacobian). Where a step leads to a slice that breaks
    down, it is taken back and halved.

    Args:
        predictor: Of the records.
        start: Places in the ranges [d].
        steps: Number of steps.
        checkpoint: File (.npz) from which to go on and to which each step is written.
        progress: Called with the steps done and the best error so far, N.
    """
    axes = _principal_axes(predictor, start, checkpoint)
    state = _State(start.copy(), Adam.of(len(start)), 1.0)
    best, errors, last = (start.copy(), np.inf), [], start.copy()
    if checkpoint is not None and checkpoint.exists():
        with np.load(checkpoint) as saved:
            adam = Adam(saved["m"], saved["v"])
            state = _State(saved["unit"], adam, float(saved["factor"]))
            best, errors = (saved["best"], float(saved["error"])), saved["errors"].tolist()
            last = saved["last"]
    while len(errors) < steps:
        k = len(errors)
        try:
            square, gradient = predictor.mean_square_and_gradient(state.unit)
            error = float(np.sqrt(square))
        except CuttingError:
            error = np.inf
        if np.isfinite(error) and np.isfinite(gradient).all():
            if error < best[1]:
                best = (state.unit.copy(), error)
            last = state.unit.copy()
            slope = axes.T @ gradient
            rate = state.factor * RATE * (0.1 if 4 * k >= 3 * steps else 1.0)
            move = rate * axes @ state.adam.descent(slope, k, EPSILON)
            state.unit = np.clip(last + move, 0.0, 1.0)
        else:
            state.factor *= BACK_OFF
            state.unit = last + BACK_OFF * (state.unit - last)
        errors.append(error)
        if checkpoint is not None:
            _save(checkpoint, state, best, errors, last)
        if progress is not None:
            progress(len(errors), best[1])
    return Refinement(best[0], best[1], errors)


def _principal_axes(predictor: Predictor, start: np.ndarray, checkpoint: Path | None) -> np.ndarray:
    """Directions in the unit ranges, as columns [d, d], along which the prediction changes by the
    error at the start."""
    file = None if checkpoint is None else checkpoint.with_suffix(".axes.npy")
    if file is not None and file.exists():
        return np.asarray(np.load(file))
    try:
        residual, J = predictor.jacobian(start)
    except CuttingError:
        # Near a breakdown the ranges are all there is to go by.
        axes = BACK_OFF * np.eye(len(start))
    else:
        used = predictor.used
        curvature, directions = np.linalg.eigh(J[used].T @ J[used] / used.sum())
        curvature = curvature + RIDGE * curvature.max()
        axes = directions * np.sqrt(np.mean(residual[used] ** 2) / curvature)
    if file is not None:
        np.save(file, axes)
    return np.asarray(axes)


@dc.dataclass
class _State:
    unit: np.ndarray
    adam: Adam
    factor: float


def _save(
    file: Path, state: _State, best: tuple[np.ndarray, float], errors: list[float], last: np.ndarray
) -> None:
    partial = file.with_suffix(".partial.npz")
    np.savez(
        partial,
        unit=state.unit,
        m=state.adam.m,
        v=state.adam.v,
        factor=state.factor,
        best=best[0],
        error=best[1],
        errors=np.array(errors),
        last=last,
    )
    partial.replace(file)
