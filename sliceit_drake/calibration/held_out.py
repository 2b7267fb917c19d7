"""Error on data that were held out: blocks of depth."""

import dataclasses as dc

import numpy as np

from sliceit_drake.calibration.gauss_newton import gauss_newton, residuals_at
from sliceit_drake.calibration.prediction import Predictor

__all__ = ["HeldOutError", "blocked_error"]

STEPS = 4
"""Most steps of a refit."""


@dc.dataclass
class HeldOutError:
    """Errors on blocks of the data, each from a fit without it.

    Attributes:
        names: Of the blocks.
        blocks: Root mean square error on each, N; NaN where the refitted slice broke down.
        counts: Entries in each.
        rms: On all of them, N.
        fitted: Of the fit to all data on the same entries, N.
    """

    names: list[str]
    blocks: list[float]
    counts: list[int]
    rms: float
    fitted: float


def blocked_error(
    model: Predictor, unit: np.ndarray, blocks: int = 5, steps: int = STEPS
) -> HeldOutError:
    """Holds out contiguous blocks of depth in turn, in all records at once.

    Neighbouring samples share their error, so that samples held out one by one would be predicted
    by their neighbours; a block must be predicted by the physics. What lies above the food belongs
    to the first block. What is a record's own (its height, its speed) stays as fitted: where the
    knife was is not what is predicted.

    Args:
        model: Of the records.
        unit: The fit to all data [d]; each refit starts there.
        blocks: Number of blocks of equal depth.
        steps: Most steps of each refit.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    depth = model.depth
    edges = np.linspace(0.0, float(depth[model.used].max()), blocks + 1)
    block = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, blocks - 1)
    shared = np.array([p.shared for p in model.parameters])
    (fit,) = residuals_at(model, [unit])
    names, errors, counts = [], [], []
    squares = fitted = 0.0
    for k, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        held, rest = (block == k) & model.used, model.used & (block != k)
        if not held.any() or not rest.any():
            continue
        without = model.holding_out(~rest)
        refit = gauss_newton(without, unit, free=shared, steps=steps).unit
        (row,) = without.predict([refit])
        error = (np.concatenate([p.predicted.ravel() for p in row]) - model.measured)[held]
        names.append(f"{1e3 * low:.1f} to {1e3 * high:.1f} mm")
        errors.append(float(np.sqrt(np.mean(error**2))))
        counts.append(int(held.sum()))
        squares += float((error**2).sum())
        fitted += float((fit[held] ** 2).sum())
    total = max(sum(counts), 1)
    return HeldOutError(
        names, errors, counts, float(np.sqrt(squares / total)), float(np.sqrt(fitted / total))
    )
