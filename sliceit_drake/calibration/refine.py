"""Refinement by Adam on the exact gradient of the mean square error."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["Adam", "Refinement", "refine"]

RATE = 0.2
"""First step of Adam, in lengths that change the prediction by its error; in the end a tenth."""
RIDGE = 1e-3
"""Least curvature that is told apart, relative to the greatest."""
EPSILON = 1e-8
BACK_OFF = 0.5
DECAYS = (0.9, 0.999)


@dc.dataclass
class Adam:
    """Running means of a gradient, and the steps from them.

    Attributes:
        m: Mean of the gradient [d].
        v: Mean of its square [d].
    """

    m: np.ndarray
    v: np.ndarray

    @classmethod
    def of(cls, size: int) -> "Adam":
        """Before the first gradient of `size` parameters."""
        return cls(np.zeros(size), np.zeros(size))

    def descent(self, gradient: np.ndarray, step: int, least: float) -> np.ndarray:
        """Takes a gradient [d], and returns which way to go, about 1 long in each parameter [d].

        Args:
            gradient: At this step.
            step: Which it is, from 0.
            least: Gradients that are smaller than this are taken for none.
        """
        self.m = DECAYS[0] * self.m + (1.0 - DECAYS[0]) * gradient
        self.v = DECAYS[1] * self.v + (1.0 - DECAYS[1]) * gradient**2
        mean = self.m / (1.0 - DECAYS[0] ** (step + 1))
        spread = np.sqrt(self.v / (1.0 - DECAYS[1] ** (step + 1)))
        return -mean / (spread + least)


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
    curvature (one Jacobian). A step to a slice that breaks down is taken back and halved.

    Args:
        start: Places in the ranges [d].
        checkpoint: File (.npz) from which to go on and to which each step is written.
        progress: Called with the steps done and the best error so far, N.
    """
    axes = _principal_axes(predictor, start, checkpoint)
    zero = np.zeros(len(start))
    state = _State(zero, zero, unit=start, best=start, last=start)
    if checkpoint is not None and checkpoint.exists():
        with np.load(checkpoint) as saved:
            state = _State(**(dict(saved) | {"errors": saved["errors"].tolist()}))
    while len(state.errors) < steps:
        k = len(state.errors)
        try:
            square, gradient = predictor.mean_square_and_gradient(state.unit)
            error = float(np.sqrt(square))
        except CuttingError:
            error = np.inf
        if np.isfinite(error) and np.isfinite(gradient).all():
            if error < state.error:
                state.best, state.error = state.unit, error
            state.last = state.unit
            rate = state.factor * RATE * (0.1 if 4 * k >= 3 * steps else 1.0)
            move = rate * axes @ state.descent(axes.T @ gradient, k, EPSILON)
            state.unit = np.clip(state.last + move, 0.0, 1.0)
        else:
            state.factor *= BACK_OFF
            state.unit = state.last + BACK_OFF * (state.unit - state.last)
        state.errors.append(error)
        if checkpoint is not None:
            partial = checkpoint.with_suffix(".partial.npz")
            np.savez(partial, **vars(state))
            partial.replace(checkpoint)
        if progress is not None:
            progress(len(state.errors), float(state.error))
    return Refinement(state.best, float(state.error), state.errors)


@dc.dataclass
class _State(Adam):
    """Where a refinement stands, as a checkpoint holds it: Adam's means, the next place, the best,
    the last that did not break down, the best error, the factor on steps, their errors."""

    unit: np.ndarray
    best: np.ndarray
    last: np.ndarray
    error: float = np.inf
    factor: float = 1.0
    errors: list[float] = dc.field(default_factory=list)


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
