"""Refinement by Adam on the exact gradient of the mean square error."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["Refinement", "refine"]

RATE = 0.02
"""First step of Adam in the unit ranges; a tenth of it in each later quarter, as in the paper."""
DECAYS = (0.9, 0.999)
EPSILON = 1e-8
BACK_OFF = 0.5
LEAST_RATE = 1e-6


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

    The rate is a tenth in each later quarter (reference/sliceit.md: Adam, divided by 10 each
    quarter). Where a step leads to a slice that breaks down, it is taken back and halved.

    Args:
        predictor: Of the records.
        start: Places in the ranges [d].
        steps: Number of steps.
        checkpoint: File (.npz) from which to go on and to which each step is written.
        progress: Called with the steps done and the best error so far, N.
    """
    state = _State(start.copy(), np.zeros_like(start), np.zeros_like(start), 1.0)
    best, errors, last = (start.copy(), np.inf), [], start.copy()
    if checkpoint is not None and checkpoint.exists():
        with np.load(checkpoint) as saved:
            state = _State(saved["unit"], saved["m"], saved["v"], float(saved["factor"]))
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
            state.m = DECAYS[0] * state.m + (1.0 - DECAYS[0]) * gradient
            state.v = DECAYS[1] * state.v + (1.0 - DECAYS[1]) * gradient**2
            mean = state.m / (1.0 - DECAYS[0] ** (k + 1))
            spread = np.sqrt(state.v / (1.0 - DECAYS[1] ** (k + 1)))
            quarter = min(4 * k // max(steps, 1), 3)
            move = state.factor * RATE * 0.1**quarter * mean / (spread + EPSILON)
            state.unit = np.clip(last - move, 0.0, 1.0)
        else:
            state.factor *= BACK_OFF
            state.unit = last + BACK_OFF * (state.unit - last)
        errors.append(error)
        if checkpoint is not None:
            _save(checkpoint, state, best, errors, last)
        if progress is not None:
            progress(len(errors), best[1])
    return Refinement(best[0], best[1], errors)


@dc.dataclass
class _State:
    unit: np.ndarray
    m: np.ndarray
    v: np.ndarray
    factor: float


def _save(
    file: Path, state: _State, best: tuple[np.ndarray, float], errors: list[float], last: np.ndarray
) -> None:
    partial = file.with_suffix(".partial.npz")
    np.savez(
        partial,
        unit=state.unit,
        m=state.m,
        v=state.v,
        factor=state.factor,
        best=best[0],
        error=best[1],
        errors=np.array(errors),
        last=last,
    )
    partial.replace(file)
