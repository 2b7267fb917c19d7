"""The comparison on the measured curves: bands of depth that was left out."""

import copy
from types import SimpleNamespace

import numpy as np
from test_bands import HEIGHT, PressModel

from sliceit_drake.calibration.bands import ForceBand
from studies.calibration.comparison import (
    FoodComparison,
    Row,
    comparison_tables,
    left_out_band,
    plot_comparisons,
)


class HoldingOut(PressModel):
    """With entries that may be held out."""

    def holding_out(self, held_out):
        other = copy.copy(self)
        other.used = self.used & ~held_out
        return other


def test_the_band_of_left_out_depth_knows_nothing_of_what_is_there():
    model, bands = HoldingOut(), []
    noise = 0.1 * np.random.default_rng(0).normal(size=len(model.depth))
    for height in (0.0, 4.0):
        other = copy.copy(model)
        other.measured = model.measured + noise + height * (model.depth > 0.6 * HEIGHT)
        bands.append(left_out_band(other, np.full(2, 0.5), blocks=2))
    lower = model.depth > 0.5 * HEIGHT
    np.testing.assert_allclose(bands[0].mean[lower], bands[1].mean[lower])
    np.testing.assert_allclose(bands[0].deviation[lower], bands[1].deviation[lower])
    assert np.abs(bands[0].mean - bands[1].mean)[~lower].max() > 0.1


def test_its_table_and_its_figure_have_both_bands(tmp_path):
    time = np.linspace(0.0, 1.0, 50)
    force = 10.0 * time
    record = SimpleNamespace(metadata=SimpleNamespace(motion=SimpleNamespace(speed=0.02)))
    target = SimpleNamespace(record=record, model=SimpleNamespace(point_nodes=[0] * 61))
    predictor = SimpleNamespace(targets=[target], setup=SimpleNamespace(oscillation=None))
    bands = [ForceBand(force[None], np.full(50, d), np.ones(1)) for d in (0.1, 1.0)]
    errors = dict.fromkeys(("rms", "search_rms", "refined_rms", "held_out_rms"), 0.2)
    ours = SimpleNamespace(predictor=predictor, unit=np.zeros(4), band=bands[0], **errors)
    rows = [Row(n, time, force + 0.2, 0.0, 0.2, 10.2, 0.1) for n in ("DiSECt", "spring", "ours")]
    comparison = FoodComparison("potato", time, force + 0.5, rows, ours, bands[1], 1.0)
    text = comparison_tables([comparison])
    assert "| potato | fitted | 0 % | 0.33 |" in text
    assert "| potato | left out | 100 % | 3.29 |" in text
    plot_comparisons([comparison], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1e4
