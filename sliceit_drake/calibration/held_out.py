"""Error on data that were held out: blocks of depth, and whole records."""

import dataclasses as dc
from typing import Protocol

import numpy as np

from sliceit_drake.calibration.gauss_newton import gauss_newton, residuals_at
from sliceit_drake.calibration.uncertainty import RecordModel

__all__ = ["HeldOutModel", "HeldOutError", "blocked_error", "record_error"]

STEPS = 4


class HeldOutModel(RecordModel, Protocol):
    """What can fit without some entries: `prediction.Predictor`, or anything that acts like it."""

    @property
    def depth(self) -> np.ndarray: ...

    def holding_out(self, held_out: np.ndarray, /) -> "HeldOutModel": ...


@dc.dataclass
class HeldOutError:
    """Errors on parts of the data, each from a fit without it.

    Attributes:
        names: Of the parts.
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
    model: HeldOutModel, unit: np.ndarray, blocks: int = 5, steps: int = STEPS
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
    parts = [
        (f"{1e3 * low:.1f} to {1e3 * high:.1f} mm", block == k)
        for k, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True))
    ]
    shared = np.array([p.shared for p in model.parameters])
    return _held_out(model, unit, parts, steps, shared)


def record_error(model: HeldOutModel, unit: np.ndarray, steps: int = STEPS) -> HeldOutError:
    """Holds out whole records in turn.

    What is a record's own (its height) is then not known for the one that is held out: it gets the
    mean of the others'.

    Args:
        model: Of two or more records.
        unit: The fit to all data [d].
        steps: Most steps of each refit.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    record_of = model.record_of
    own = [p.name.split(":", 1)[1] for p in model.parameters if not p.shared]
    names = list(dict.fromkeys(own)) or [f"record {k}" for k in np.unique(record_of)]
    return _held_out(model, unit, [(n, record_of == k) for k, n in enumerate(names)], steps)


def _held_out(
    model: HeldOutModel,
    unit: np.ndarray,
    parts: list[tuple[str, np.ndarray]],
    steps: int,
    free: np.ndarray | None = None,
) -> HeldOutError:
    names, errors, counts = [], [], []
    squares = fitted = 0.0
    (residuals,) = residuals_at(model, [unit])
    for name, mask in parts:
        held = mask & model.used
        rest = model.used & ~mask
        if not held.any() or not rest.any():
            continue
        without = model.holding_out(~rest)
        refit = gauss_newton(without, unit, free=free, steps=steps).unit
        place = _of_others(model, refit, set(model.record_of[rest]))
        (row,) = without.predict([place])
        error = (np.concatenate([p.predicted.ravel() for p in row]) - model.measured)[held]
        names.append(name)
        errors.append(float(np.sqrt(np.mean(error**2))))
        counts.append(int(held.sum()))
        squares += float((error**2).sum())
        fitted += float((residuals[held] ** 2).sum())
    total = max(sum(counts), 1)
    return HeldOutError(
        names, errors, counts, float(np.sqrt(squares / total)), float(np.sqrt(fitted / total))
    )


def _of_others(model: HeldOutModel, unit: np.ndarray, fitted: set[int]) -> np.ndarray:
    """Places in which parameters of records that were not fitted are the mean of the others'."""
    place = unit.copy()
    own: dict[str, list[int]] = {}
    for k, parameter in enumerate(model.parameters):
        if not parameter.shared:
            own.setdefault(parameter.name.split(":", 1)[0], []).append(k)
    records = list(dict.fromkeys(p.name.split(":", 1)[1] for p in model.parameters if not p.shared))
    for members in own.values():
        seen = [
            k for k in members if records.index(model.parameters[k].name.split(":", 1)[1]) in fitted
        ]
        for k in members:
            if k not in seen and seen:
                place[k] = float(np.mean(unit[seen]))
    return place
