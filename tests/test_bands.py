"""Bands of predicted force hold what they say, and widen where nothing was measured."""

from types import SimpleNamespace

import numpy as np
import pytest

from sliceit_drake.calibration.bands import ForceBand, force_band, independent
from sliceit_drake.calibration.gauss_newton import gauss_newton
from sliceit_drake.calibration.prediction import Parameter

ROWS = 200
HEIGHT = 0.03


class PressModel:
    """Presses at given speeds, whose force is linear in two places; as `Predictor` has them."""

    def __init__(self, speeds=(0.02,)):
        self.targets, depths, columns = [], [], []
        self.parameters = []
        for k, speed in enumerate(speeds):
            time = np.linspace(0.0, HEIGHT / speed, ROWS)
            depth = speed * time - 1e-3
            self.targets.append(
                SimpleNamespace(
                    time=time,
                    depth=depth,
                    path=depth - depth[0],
                    facts=SimpleNamespace(height=HEIGHT),
                    record=SimpleNamespace(name=f"record {k}"),
                    measured=np.zeros((ROWS, 1)),
                )
            )
            depths.append(depth)
            x = np.clip(depth, 0.0, None) / HEIGHT
            columns.append(np.column_stack([20.0 * np.sqrt(x), 20.0 * x**2]))
        self.depth, self.columns = np.concatenate(depths), np.concatenate(columns)
        self.record_of = np.repeat(np.arange(len(speeds)), ROWS)
        self.conditions = [f"at {speed}" for speed in speeds]
        self.used = np.ones(len(self.depth), bool)
        self.measured = self.columns @ [0.5, 0.5]

    def predict(self, units):
        return [[SimpleNamespace(predicted=self.columns @ u)] for u in units]

    def jacobian(self, unit, free=None):
        return self.columns @ unit - self.measured, self.columns

    def nuisance_jacobian(self, unit):
        return np.zeros((len(self.depth), 0))


def band_of(model):
    return force_band(model, gauss_newton(model, np.full(2, 0.4)).unit)


def bump(depth, at, wide=3e-3):
    return np.exp(-(((depth - at) / wide) ** 2)) * (depth > 0.0)


def test_a_twentieth_lies_below_and_above_a_band_of_two_slices():
    """With half of the normal distribution about each, that is a tenth of a half."""
    band = ForceBand(np.array([[0.0, 3.0], [10.0, 3.0]]), np.array([1.0, 2.0]), np.full(2, 0.5))
    low, high = band.interval()
    assert low == pytest.approx([-1.2816, 3.0 - 2.0 * 1.6449], abs=1e-3)
    assert high == pytest.approx([11.2816, 3.0 + 2.0 * 1.6449], abs=1e-3)


def test_nine_of_ten_measurements_are_in_a_band_of_90_percent():
    rng, shares = np.random.default_rng(0), []
    for _ in range(20):
        model = PressModel()
        law = sum(rng.normal(0.0, 0.8) * bump(model.depth, at) for at in (4e-3, 11e-3, 19e-3))
        model.measured = model.measured + law + 0.1 * rng.normal(size=ROWS)
        low, high = band_of(model).interval()
        shares.append(np.mean((low <= model.measured) & (model.measured <= high)))
    assert 0.85 < np.mean(shares) < 0.97


def test_depth_that_was_not_measured_has_a_wider_band_that_holds_what_is_there():
    rng, shares, widths = np.random.default_rng(1), [], []
    for _ in range(20):
        model = PressModel()
        law = sum(rng.normal(0.0, 0.8) * bump(model.depth, at) for at in (4e-3, 11e-3, 19e-3))
        model.measured = model.measured + law + 0.1 * rng.normal(size=ROWS)
        model.used = model.depth < 0.5 * HEIGHT
        band = band_of(model)
        low, high = band.interval()
        inside = (low <= model.measured) & (model.measured <= high)
        shares.append(inside[~model.used].mean())
        widths.append(band.deviation[~model.used].mean() / band.deviation[model.used].mean())
    assert np.mean(shares) > 0.8
    assert np.mean(widths) > 1.5


class BentModel(PressModel):
    """Its lower half grows with the exponential of a place that the upper half hardly tells."""

    def force(self, unit):
        x = np.clip(self.depth, 0.0, None) / HEIGHT
        return self.columns[:, 0] * unit[0] + x**6 * np.exp(8.0 * (unit[1] - 0.5))

    def predict(self, units):
        return [[SimpleNamespace(predicted=self.force(u))] for u in units]

    def jacobian(self, unit, free=None):
        ends = [self.force(unit + s * e) for e in 1e-5 * np.eye(2) for s in (1.0, -1.0)]
        columns = [(ends[0] - ends[1]) / 2e-5, (ends[2] - ends[3]) / 2e-5]
        return self.force(unit) - self.measured, np.column_stack(columns)


def test_slices_are_drawn_where_the_force_is_not_linear_in_what_is_not_known():
    model = BentModel()
    model.measured = model.force(np.array([0.5, 0.9]))
    model.measured = model.measured + 0.1 * np.random.default_rng(3).normal(size=ROWS)
    model.used = model.depth < 0.4 * HEIGHT
    unit = np.array([0.5, 0.5])
    shares = []
    for draws in (0, 200):
        low, high = force_band(model, unit, draws).interval()
        inside = (low <= model.measured) & (model.measured <= high)
        shares.append(inside[~model.used].mean())
    assert shares[1] > 0.9 > shares[0]


def test_a_speed_that_was_not_measured_has_a_wider_band():
    model = PressModel(speeds=(0.01, 0.02, 0.1))
    rng = np.random.default_rng(2)
    speed = np.repeat([-1.0, -0.5, 0.9], ROWS)
    model.measured = model.measured + bump(model.depth, 8e-3) * (1.0 + speed)
    model.measured = model.measured + 0.05 * rng.normal(size=len(model.measured))
    model.used = model.record_of < 2
    band = band_of(model)
    means = [band.deviation[model.record_of == k].mean() for k in range(3)]
    assert means[2] > 1.5 * max(means[:2])


def test_more_rows_of_the_same_error_do_not_narrow_a_band():
    widths = []
    for every in (1, 4):
        model = PressModel()
        model.measured = model.measured + 0.5 * np.sin(model.depth / 6e-4)
        model.used = (np.arange(ROWS) % every == 0) & (model.depth < 0.5 * HEIGHT)
        widths.append(band_of(model).deviation[~model.used & (model.depth > 0.02)].mean())
    assert widths[0] == pytest.approx(widths[1], rel=0.3)


class PlacedModel(PressModel):
    """Each record has a place of its own, by which it meets something hard at the end."""

    def __init__(self):
        super().__init__(speeds=(0.02, 0.02, 0.02))
        self.parameters = [Parameter(n, 0.0, 1.0, False, 0.5) for n in ("shared", "other")]
        end = 100.0 * (self.depth > 0.9 * HEIGHT)
        for k in range(3):
            own = np.where(self.record_of == k, end, 0.0)
            self.columns = np.column_stack([self.columns, own])
            self.parameters.append(Parameter(f"height_offset:record {k}", 0.0, 1.0, False, 0.5))
        self.measured = self.columns @ [0.5, 0.5, 0.48, 0.52, 0.49]
        self.measured += 0.1 * np.random.default_rng(4).normal(size=len(self.measured))


def test_a_record_that_was_not_fitted_is_where_the_others_are():
    widths = []
    for fitted in (1, 2):
        model = PlacedModel()
        model.used = model.record_of < fitted
        low, high = force_band(model, np.full(5, 0.5)).interval()
        last = (model.record_of == 2) & (model.depth > 0.9 * HEIGHT)
        assert ((low <= model.measured) & (model.measured <= high))[last].mean() > 0.9
        widths.append((high - low)[last].mean())
    assert widths[1] < 0.3 * widths[0]


class ThreeChannels(PressModel):
    """A press, again and again, then a draw; forces across, along and down, as those of a robot."""

    def __init__(self, presses, draws=0):
        super().__init__(speeds=(0.02,) * (presses + draws))
        self.conditions = ["press"] * presses + ["draw"] * draws
        along = np.repeat([0.0] * presses + [0.7] * draws, ROWS)
        down = np.repeat([1.0] * presses + [0.5] * draws, ROWS)
        for target, draws_too in zip(self.targets, along[::ROWS] > 0.0, strict=True):
            target.measured = np.zeros((ROWS, 3))
            target.path = target.path * (1.8 if draws_too else 1.0)
        self.ways = np.column_stack([0.0 * along, along, down])
        self.columns = np.einsum("mp,mc->mcp", self.columns, self.ways).reshape(-1, 2)
        self.depth, self.record_of = (np.repeat(x, 3) for x in (self.depth, self.record_of))
        self.channel = np.tile(np.arange(3), len(self.ways))
        self.used = self.record_of < presses
        self.measured = self.columns @ [0.5, 0.5]

    def inside(self):
        low, high = force_band(self, gauss_newton(self, np.full(2, 0.4)).unit).interval()
        return (low <= self.measured) & (self.measured <= high), high - low


def test_neighbours_share_their_error_in_each_channel():
    """An autoregressive series of correlation c tells as much as (1 - c) / (1 + c) of its rows."""
    model, correlation = ThreeChannels(20), 0.8
    rng, rest = np.random.default_rng(5), np.zeros((20 * ROWS, 3))
    for k in range(1, len(rest)):
        rest[k] = correlation * rest[k - 1] + rng.normal(size=3)
    found = independent(model, rest.ravel()).variance / np.mean(rest**2)
    assert found == pytest.approx((1.0 + correlation) / (1.0 - correlation), rel=0.2)


def test_a_channel_without_force_has_a_band_as_wide_as_its_noise():
    # Of few records the air does not tell whether a zero is left.
    model, rng = ThreeChannels(9), np.random.default_rng(6)
    noise = np.where(model.channel == 2, 0.8, 0.05)
    model.measured = model.measured + noise * rng.normal(size=len(noise))
    model.used = model.record_of < 8
    inside, width = model.inside()
    other = (model.record_of == 8) & (model.channel < 2)
    assert width[other].mean() == pytest.approx(2.0 * 1.645 * 0.05, rel=0.15)
    assert inside[other].mean() == pytest.approx(0.9, abs=0.04)


def test_slices_that_differ_by_a_factor_widen_the_band_of_another():
    rng, shares = np.random.default_rng(7), []
    for _ in range(12):
        model = ThreeChannels(4)
        factor = np.repeat(1.0 + 0.1 * rng.normal(size=4), 3 * ROWS)
        model.measured = factor * model.measured + 0.05 * rng.normal(size=len(factor))
        model.used = model.record_of < 3
        inside, _ = model.inside()
        shares.append(inside[(model.record_of == 3) & (model.channel == 2)].mean())
    assert 0.8 < np.mean(shares) < 0.98


def test_a_press_tells_nothing_of_what_a_draw_changes():
    """It has no force along the edge, in which the simulation of a draw may err all the more."""
    rng, shares = np.random.default_rng(8), []
    for _ in range(12):
        model = ThreeChannels(2, draws=1)
        wrong = np.where(model.record_of == 2, 1.0 + 0.3 * rng.choice([-1.0, 1.0]), 1.0)
        model.measured = wrong * model.measured + 0.05 * rng.normal(size=len(wrong))
        inside, _ = model.inside()
        draw = (model.record_of == 2) & (model.depth > 0.3 * HEIGHT)
        shares += [inside[draw & (model.channel == c)].mean() for c in (1, 2)]
    assert np.mean(shares) > 0.85


def test_a_zero_of_each_record_widens_the_band_of_another_by_what_the_air_shows():
    rng, widths, shares = np.random.default_rng(9), [], []
    for _ in range(24):
        model = ThreeChannels(4)
        noise = 0.02 * rng.normal(size=len(model.measured))
        zeros = 0.2 * rng.normal(size=(4, 3))
        # Once without them.
        for size in (0.0, 1.0):
            model.measured = model.columns @ [0.5, 0.5] + noise
            model.measured = model.measured + size * zeros[model.record_of, model.channel]
            model.used = model.record_of < 3
            inside, width = model.inside()
            other = (model.record_of == 3) & (model.channel < 2)
            widths.append(width[other].mean())
        shares.append(inside[other].mean())
    assert np.mean(widths[::2]) < 0.08
    assert 0.8 < np.mean(shares) < 0.98
