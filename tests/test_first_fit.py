"""The first fit of a calibration, on a coarse mesh."""

import numpy as np
import pytest
from test_calibration import bench_records, coarse_setup

from sliceit_drake.calibration import first_fit as module
from sliceit_drake.calibration.first_fit import first_fit
from sliceit_drake.cutting.solver import CuttingError


def test_a_first_fit_follows_the_record_and_draws_it(tmp_path):
    seen = []
    found = first_fit(coarse_setup(), bench_records(1), 1, lambda *steps: seen.append(steps))
    measured = found.predictor.measured
    # The mesh is half as fine as that of the record.
    assert found.rms < 0.1 * np.sqrt(np.mean(measured**2))
    low, high = found.band.interval()
    assert np.mean((low <= measured) & (measured <= high)) > 0.8
    found.save(tmp_path / "first_fit.png")
    assert (tmp_path / "first_fit.png").stat().st_size > 1e4
    assert seen == [(k, 4) for k in range(5)]


def test_a_first_fit_passes_over_starts_that_break_down(monkeypatch):
    fit, fits = module.gauss_newton, []

    def first_breaks(*given, **named):
        fits.append(given)
        if len(fits) == 1:
            raise CuttingError("it breaks down")
        return fit(*given, **named)

    monkeypatch.setattr(module, "gauss_newton", first_breaks)
    assert np.isfinite(first_fit(coarse_setup(), bench_records(1), 1).rms)

    def breaks(*given, **named):
        raise CuttingError("it breaks down")

    monkeypatch.setattr(module, "gauss_newton", breaks)
    with pytest.raises(CuttingError, match="widen the setup's ranges"):
        first_fit(coarse_setup(), bench_records(1), 1)
