"""A first fit on a coarse mesh: a picture to look at while the calibration goes on.

It tells within a minute whether record and setup go together: a wrong unit, knife, height or food
shows at once. Its values are not the calibration's, which has a finer mesh.
"""

import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.bands import ForceBand, force_band, independent
from sliceit_drake.calibration.gauss_newton import gauss_newton, residuals_at
from sliceit_drake.calibration.plot import plot_fit
from sliceit_drake.calibration.prediction import Prediction, Predictor
from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.calibration.structure import coarse_predictor, first_starts
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.record_set import one_of_each
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["FirstFit", "first_fit", "fit_from_starts"]

STEPS = 6
"""Of each fit."""
MOST = 3
"""Records that are fitted: as many as the picture shows."""


@dc.dataclass
class FirstFit:
    """What a first fit found.

    Attributes:
        predictor: Of the records, on the coarse mesh.
        predictions: One a record.
        rms: On the records, N.
        band: Within what another measurement is expected.
    """

    predictor: Predictor
    predictions: list[Prediction]
    rms: float
    band: ForceBand

    def save(self, file: Path) -> None:
        """Draws it to a file (.png)."""
        shown = plot_fit(self.predictor, self.predictions, self.band, "first fit, coarse mesh")
        shown.savefig(file, dpi=150)


def first_fit(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FirstFit:
    """Fits a setup to records on a coarse mesh.

    Args:
        setup: Food and ranges.
        records: Of which the first of each condition is fitted, of three conditions at most.
        workers: Threads.
        progress: Called with the fits done, and all of them.

    Raises:
        ConfigurationError: A record cannot be predicted.
        CuttingError: No start leads to slices that can be cut.
    """
    predictor = coarse_predictor(setup, one_of_each(records)[:MOST], workers)
    unit = fit_from_starts(predictor, progress)
    (row,) = predictor.predict([unit])
    return FirstFit(predictor, row, predictor.error(row), force_band(predictor, unit))


def fit_from_starts(
    model: Predictor, progress: Callable[[int, int], None] | None = None
) -> np.ndarray:
    """The best fit from the first starts [d], with residuals whose neighbours are alike.

    What the records hardly tell stays near the middle of its range.

    Raises:
        CuttingError: No start leads to slices that can be cut.
    """
    show = progress or (lambda *_: None)
    starts, fits = first_starts(model), []
    for k, start in enumerate(starts):
        show(k, len(starts) + 1)
        try:
            fits.append(gauss_newton(model, model.places(start), steps=STEPS))
        except CuttingError:
            continue
    if not fits:
        raise CuttingError("no start leads to slices that can be cut; widen the setup's ranges")
    best = min(fits, key=lambda fit: fit.cost).unit
    show(len(starts), len(starts) + 1)
    noise = independent(model, *residuals_at(model, [best]))
    unit = gauss_newton(model, best, noise=noise, steps=STEPS).unit
    show(len(starts) + 1, len(starts) + 1)
    return unit
