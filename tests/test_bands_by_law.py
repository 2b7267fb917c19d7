"""The study of bands on benches of other laws: its score, its choice of records, and its table."""

import numpy as np
import pytest

from studies.benches.draw import Draw
from studies.calibration.bands_by_law import Row, _chosen, _table, interval_score


def test_a_narrow_band_is_worth_more_and_each_miss_costs():
    measured = np.array([0.0, 1.0, 2.0])
    wide = interval_score(measured - 1.0, measured + 1.0, measured)
    narrow = interval_score(measured - 0.1, measured + 0.1, measured)
    assert (wide, narrow) == pytest.approx((2.0, 0.2))
    missed = interval_score(measured + 0.1, measured + 0.3, measured)
    assert missed == pytest.approx(0.2 + 20.0 * 0.1)


def test_the_band_is_asked_for_what_was_not_fitted():
    fitted, left = _chosen(Draw("slice_push", 3).records())
    assert len({r.metadata.condition for r in fitted}) == 1 and len(fitted) == 2
    assert [kind for kind, _ in left] == ["same speed", *["other speeds"] * 2, *["draws"] * 2]
    names = [r.name for r in fitted] + [r.name for _, r in left]
    assert len(set(names)) == len(names)
    assert left[0][1].metadata.condition == fitted[0].metadata.condition


def test_its_table_has_means_by_law_and_kind():
    rows = [
        Row("training", "bonds", k, "draws", inside, False, 0.5, 2.0, 4.0, 0.7)
        for k, inside in enumerate((0.8, 1.0))
    ]
    (line,) = [line for line in _table(rows).splitlines() if "draws" in line]
    assert "90 %" in line and "2.00" in line and "4.00" in line and "| 2 |" in line
