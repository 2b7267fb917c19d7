"""A toughness for each cut point, as the paper fits its springs one by one."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.refine import Adam
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["PointFit", "fit_points"]

NAME = "point_scales.toughness"
PRIOR = 0.5
"""Standard deviation of the logarithm of a point's factor."""
NOISE = 0.3
"""Error that the prior is weighed against, N."""
RATE, MIN_RATE = 0.1, 0.01
EPSILON = 1e-12


@dc.dataclass
class PointFit:
    """Toughness factors of the cut points.

    Attributes:
        factors: [P].
        positions: Of the points along the edge and over the board, x and z in C [P, 2], metres.
        rms: Root mean square error, N.
    """

    factors: np.ndarray
    positions: np.ndarray
    rms: float

    def save(self, file: Path) -> None:
        """Writes a table of points and factors (CSV)."""
        np.savetxt(
            file,
            np.column_stack([self.positions, self.factors]),
            fmt="%.6g",
            delimiter=",",
            header="x,z,toughness_factor",
            comments="",
        )


def fit_points(
    predictor: Predictor,
    unit: np.ndarray,
    steps: int = 100,
    progress: Callable[[int, float], None] | None = None,
) -> PointFit:
    """Adam on the logarithm of each point's factor, with a normal prior about 1.

    Args:
        predictor: Of records of one food.
        unit: The shared parameters, which stay.
        progress: Called with the steps done and the best error so far, N.

    Raises:
        ConfigurationError: The records' foods differ.
        CuttingError: The slice breaks down at the start.
    """
    model = predictor.targets[0].model
    points = len(model.point_nodes)
    x, adam = np.zeros(points), Adam.of(points)
    best, best_x = np.inf, x
    weight = NOISE**2 / (PRIOR**2 * float(predictor.used.sum()))
    for k in range(steps):
        trial = predictor.with_point_factors({NAME: np.exp(x)})
        try:
            square, by_name = trial.mean_square_by(unit, [NAME])
        except CuttingError:
            if k == 0:
                raise
            x, adam.m = 0.5 * (x + best_x), 0.0 * adam.m
            continue
        if square < best:
            best, best_x = square, x.copy()
        slope = by_name[NAME] * np.exp(x) + 2.0 * weight * x
        rate = RATE * (MIN_RATE / RATE) ** (k / max(steps - 1, 1))
        x = x + rate * adam.descent(slope, k, EPSILON)
        if progress is not None:
            progress(k + 1, float(np.sqrt(best)))
    return PointFit(np.exp(best_x), model.split.points[:, [0, 2]], float(np.sqrt(best)))
