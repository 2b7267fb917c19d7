"""Error on data that were held out: blocks of depth."""

import dataclasses as dc

import numpy as np

from sliceit_drake.calibration.gauss_newton import gauss_newton
from sliceit_drake.calibration.prediction import Predictor

__all__ = ["HeldOutError", "blocked_error"]

STEPS = 4
"""Most steps of a refit."""


@dc.dataclass
class HeldOutError:
    """Errors on blocks of the data, each from a fit without it.

    Attributes:
        blocks: Root mean square error on each, N; NaN where the refitted slice broke down.
        counts: Entries in each.
        rms: On all of them, N.
    """

    blocks: list[float]
    counts: list[int]
    rms: float


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
    errors, counts, squares = [], [], 0.0
    for k in range(blocks):
        held, rest = (block == k) & model.used, model.used & (block != k)
        if not held.any() or not rest.any():
            continue
        without = model.holding_out(~rest)
        refit = gauss_newton(without, unit, free=shared, steps=steps).unit
        (row,) = without.predict([refit])
        error = (np.concatenate([p.predicted.ravel() for p in row]) - model.measured)[held]
        errors.append(float(np.sqrt(np.mean(error**2))))
        counts.append(int(held.sum()))
        squares += float((error**2).sum())
    return HeldOutError(errors, counts, float(np.sqrt(squares / max(sum(counts), 1))))
