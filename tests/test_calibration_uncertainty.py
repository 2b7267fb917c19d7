"""Uncertainty of a calibration: noise of records, intervals, profiles, held-out error, drawing."""

import copy
import dataclasses as dc
import json
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from sliceit_drake.calibration import uncertainty
from sliceit_drake.calibration.calibrate import blocked_error
from sliceit_drake.calibration.gauss_newton import gauss_newton, linearise, residuals_at
from sliceit_drake.calibration.prediction import Parameter
from sliceit_drake.calibration.uncertainty import FITS, ROUNDS, Posterior, estimate
from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.noise import NoiseModel, group_series
from studies.calibration.coverage import (
    OTHERS,
    Found,
    Problem,
    Replicate,
    coverage_page,
    coverage_share,
    coverage_study,
    noise_sample,
    synthetic_predictor,
)
from studies.calibration.profile_likelihood import profile_likelihood


class MapModel:
    """Records predicted by a function of the places, as `Predictor` does it."""

    def __init__(self, function, names, times, conditions, log=False):
        self.function, self.conditions = function, conditions
        self.parameters = [Parameter(n, 1.0, 100.0, log, 10.0) for n in names]
        self.time = np.concatenate(times)
        self.record_of = np.repeat(np.arange(len(times)), [len(t) for t in times])
        self.depth = self.time * 0.02
        self.measured = np.zeros(len(self.time))
        self.used = np.ones(len(self.time), bool)
        self.tried, self.step_unknown = [], []

    def split(self, entries):
        ends = np.cumsum(np.bincount(self.record_of))[:-1]
        return [part[:, None] for part in np.split(entries, ends)]

    def predict(self, units):
        self.tried += [u.copy() for u in units]
        return [[SimpleNamespace(predicted=p) for p in self.split(self.function(u))] for u in units]

    def jacobian(self, unit, free=None):
        columns = []
        for k in range(len(unit)):
            step = np.zeros(len(unit))
            step[k] = 1e-6
            columns.append((self.function(unit + step) - self.function(unit - step)) / 2e-6)
        return self.function(unit) - self.measured, np.array(columns).T

    def without_step_error(self, unit):
        return self

    def nuisance_jacobian(self, unit):
        return np.zeros((len(self.time), 0))

    def holding_out(self, mask):
        other = copy.copy(self)
        other.used = ~mask
        return other


def linear_model(samples=80, records=(3, 3), seed=5):
    """Two conditions of several records; force rises and saturates with time, smooth in places."""
    rng = np.random.default_rng(seed)
    times = [
        np.sort(rng.uniform(0.0, 1.5 / (1 + c), samples))
        for c, n in enumerate(records)
        for _ in range(n)
    ]
    conditions = [f"speed {c}" for c, n in enumerate(records) for _ in range(n)]
    speed = np.repeat(np.arange(len(records)), [samples * n for n in records])
    x = np.concatenate(times) * (1 + speed) / 1.5
    columns = np.column_stack([x * (1.3 - x), x**2 * (1 + 0.6 * speed), np.sin(5.0 * x)])
    offset = 6.0 * x * (1.2 - x)
    model = MapModel(lambda u: offset + columns @ (u * [8.0, 6.0, 3.0]), "abc", times, conditions)
    model.columns = columns * [8.0, 6.0, 3.0]
    return model


def noise_of(model, ar, tau, white, scale, prediction):
    channels = [1] * len(model.conditions)
    groups = group_series(model.used, model.time, model.record_of, channels, model.conditions)
    scales = np.zeros((len(model.time), len(channels)))
    scales[np.arange(len(model.time)), model.record_of] = prediction
    full = [np.full(len(groups), v) for v in (ar, tau, white)]
    return NoiseModel(groups, *full, scale, scales)


def test_covariance_of_a_record_is_that_of_an_autoregressive_process_with_white_noise():
    model = linear_model(30, (1, 2))
    prediction = model.function(np.full(3, 0.5))
    noise = noise_of(model, 0.4, 0.07, 0.1, 0.2, prediction)
    t, r = model.time, model.record_of
    same = r[:, None] == r
    V = same * 0.4**2 * np.exp(-np.abs(t[:, None] - t) / 0.07) + 0.1**2 * np.eye(len(t))
    V += same * np.outer(prediction, prediction) * 0.2**2
    B = np.random.default_rng(0).normal(size=(len(t), 4))
    assert np.allclose(noise.solve(B), np.linalg.solve(V, B), rtol=1e-8, atol=1e-8)
    sample = np.array([noise_sample(noise, np.random.default_rng(k), len(t)) for k in range(4000)])
    assert np.abs(sample.T @ sample / 4000 - V).max() < 6.0 * V.max() / np.sqrt(4000)


def white_noise_interval(model, truth):
    """Half width of the 90 % interval if all samples were independent."""
    fit = gauss_newton(model, truth)
    J = fit.linearisation.jacobian
    residual = model.function(fit.unit) - model.measured
    variance = residual @ residual / (len(residual) - J.shape[1])
    return fit.unit, 1.645 * np.sqrt(np.diag(variance * np.linalg.inv(J.T @ J)))


def test_intervals_of_the_linear_problem_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(11)
    covered, naive, variation = [], [], []
    for _ in range(120):
        model = linear_model()
        truth = rng.uniform(0.3, 0.7, 3)
        force = model.function(truth)
        noise = noise_of(model, 0.2, 0.1, 0.1, 0.2, force)
        model.measured = force - noise_sample(noise, rng, len(force))
        mean, reach = white_noise_interval(model, truth)
        naive.append(np.abs(mean - truth) < reach)
        estimated = estimate(model, mean, rounds=1)
        result = estimated.posterior
        variation.append(estimated.noise.record_scale)
        reach = 1.645 * result.deviation
        covered.append(np.abs(np.array(result.mean) - truth) < reach)
    share = np.mean(covered, axis=0)
    assert (share > 0.80).all() and (share < 0.98).all()
    assert np.mean(naive) < 0.7
    assert 0.75 * 0.2 < np.median(variation) < 1.25 * 0.2


def small_model(columns, function=None, noise=0.1, seed=3, log=False):
    """One record [n] that is linear in the places [d], or a function of them; white noise."""
    n, d = columns.shape
    time = np.linspace(0.0, 1.5, n)
    names = [f"p{k}" for k in range(d)]
    model = MapModel(function or (lambda u: columns @ u), names, [time], [""], log)
    truth = np.linspace(0.4, 0.6, d)
    rng = np.random.default_rng(seed)
    model.measured = model.function(truth) + noise * rng.normal(size=n)
    return model, truth


def shapes(n, d):
    x = np.linspace(0.0, 1.0, n)[:, None]
    return np.cos(np.pi * x * np.arange(d)) * 4.0


def test_a_single_record_is_said_to_tell_nothing_of_how_slices_differ():
    model, truth = small_model(shapes(120, 2))
    estimated = estimate(model, truth)
    assert estimated.noise.record_scale is None
    assert any("no cut was repeated" in line for line in estimated.posterior.remarks())


def test_least_squares_stand_where_the_noise_gives_up_the_force_of_a_model_that_lacks_something():
    """A force that grows and at its end drops: its changes say that it hardly grows."""
    x = np.linspace(0.0, 1.0, 150)
    model, _ = small_model(10.0 * x[:, None], noise=0.0)
    model.measured = 5.0 * x - 3.0 * (x > 0.97)
    model.measured += 0.01 * np.random.default_rng(1).normal(size=150)
    fit = gauss_newton(model, np.array([0.5]))
    shown: list[int] = []
    found = estimate(model, fit.unit, progress=shown.append)
    assert shown == list(range(len(shown))) and 2 <= len(shown) < FITS * ROUNDS
    assert found.unit == pytest.approx(fit.unit, abs=0.02)
    assert "the model lacks something that noise does not explain" in found.posterior.notes[-1]
    # Their covariance allows for what goes on along the cut.
    _, naive = white_noise_interval(model, fit.unit)
    assert (1.645 * found.posterior.deviation > 1.5 * naive)[0]


def test_the_covariance_of_least_squares_is_that_of_many_repetitions():
    rng = np.random.default_rng(3)
    fits, stated = [], []
    for k in range(150):
        model = linear_model()
        truth = np.full(3, 0.5)
        force = model.function(truth)
        noise = noise_of(model, 0.2, 0.1, 0.1, 0.2, force)
        model.measured = force - noise_sample(noise, rng, len(force))
        fits.append(gauss_newton(model, truth).unit)
        if k < 30:
            problem = uncertainty._noise_problem(model, linearise(model, fits[-1]))
            found = problem.fit()
            stated.append(problem.covariance_of_least_squares(found.evened.variance))
    assert np.sqrt(np.diag(np.mean(stated, axis=0))) == pytest.approx(np.std(fits, axis=0), rel=0.3)


def test_a_parameter_at_the_end_of_its_range_is_said_with_what_to_do():
    posterior = Posterior(
        names=["material.friction", "material.toughness", "height_offset:a"],
        low=[0.02, 1.0, -2e-3],
        high=[1.0, 9.0, 2e-3],
        log=[True, False, False],
        mean=[0.0, 0.5, 1.0],
        covariance=(1e-4 * np.eye(3)).tolist(),
    )
    first, second = posterior.remarks()
    assert first == (
        "material.friction is at the low end of its range, 0.02: the force asks for less. If the "
        "food can have less, move the setup's low of material.friction under parameters; if not, "
        "the model lacks something else, and this parameter stands in for it"
    )
    assert second.startswith("height_offset:a is at the high end of its range, 0.002: the force")
    assert "move the setup's height_offset" in second


def test_a_record_that_breaks_down_with_small_sub_steps_is_noted():
    model, truth = small_model(shapes(120, 2))
    model.step_unknown = ["one"]
    notes = estimate(model, truth).posterior.notes
    assert any("one: breaks down with small sub-steps" in line for line in notes)


@pytest.mark.parametrize("log", [True, False])
def test_a_value_beyond_its_range_starts_at_the_end_of_it(log):
    parameter = Parameter("p", 1.0, 100.0, log, 10.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [parameter.unit(x) for x in (-2.0, 0.0, 1.0)] == [0.0, 0.0, 0.0]
        assert [parameter.unit(x) for x in (100.0, 1e3)] == [1.0, 1.0]


def test_what_only_enters_in_a_combination_is_named():
    columns = shapes(200, 3)
    columns[:, 1] = -0.8 * columns[:, 2]
    model, truth = small_model(columns, noise=0.02)
    posterior = estimate(model, truth).posterior
    assert posterior.determined() == {"p0": True, "p1": False, "p2": False}
    ((one, other, correlation),) = posterior.correlated_pairs()
    assert (one, other) == ("p1", "p2") and correlation > 0.9
    assert any("p1 and p2" in r and "only a combination" in r for r in posterior.remarks())
    (direction,) = posterior.undetermined_directions()
    assert direction["p1"] / direction["p2"] == pytest.approx(1.0 / 0.8, rel=0.05)
    # As wide as the range is, and not wider.
    assert posterior.deviation[1] < np.sqrt(1.0 / 12.0)


def test_a_parameter_without_effect_keeps_its_range():
    columns = shapes(100, 2)
    columns[:, 1] = 0.0
    model, _ = small_model(columns, log=True)
    posterior = estimate(model, np.array([0.5, 0.9])).posterior
    assert posterior.mean[1] == pytest.approx(0.5)
    assert posterior.deviation[1] == pytest.approx(np.sqrt(1.0 / 12.0))
    assert posterior.determined() == {"p0": True, "p1": False}


def example_posterior():
    return Posterior(
        names=["a", "b", "c"],
        low=[1.0, -2.0, 1e-6],
        high=[100.0, 2.0, 1e-3],
        log=[True, False, True],
        mean=[0.95, 0.5, 0.4],
        covariance=[[0.01, 0.0, 0.0], [0.0, 2.5e-3, -1.8e-3], [0.0, -1.8e-3, 2.0e-3]],
        notes=["a note"],
    )


def test_intervals_do_not_leave_the_ranges_and_follow_the_scale():
    intervals = example_posterior().intervals(0.9)
    assert intervals["a"][1] == 100.0
    assert intervals["a"][0] == pytest.approx(100.0 ** (0.95 - 1.6449 * 0.1), rel=1e-3)
    assert intervals["b"] == pytest.approx((-4.0 * 1.6449 * 0.05, 4.0 * 1.6449 * 0.05), rel=1e-3)


def test_drawn_places_have_the_covariance_and_stay_within_the_ranges():
    posterior = example_posterior()
    places = posterior.draw_places(np.random.default_rng(1), 20_000)
    assert places.shape == (20_000, 3) and (places >= 0.0).all() and (places <= 1.0).all()
    C = np.array(posterior.covariance)[1:, 1:]
    assert np.cov(places[:, 1:].T) == pytest.approx(C, abs=1e-4)
    assert places[:, 1:].mean(0) == pytest.approx([0.5, 0.4], abs=2e-3)
    values = posterior.draw(np.random.default_rng(1), 5)
    assert values[0]["a"] == pytest.approx(100.0 ** places[0, 0])


def test_a_posterior_is_read_back_from_yaml_as_it_was(tmp_path):
    dump_yaml(example_posterior(), tmp_path / "posterior.yaml")
    assert load_yaml(Posterior, tmp_path / "posterior.yaml") == example_posterior()


def test_the_profile_of_a_linear_problem_is_the_interval_of_the_normal_approximation():
    model, truth = small_model(shapes(150, 3), noise=0.8)
    found = estimate(model, truth)
    for name in ("p0", "p2"):
        profile = profile_likelihood(model, found, name)
        assert profile.warning is None
        assert profile.drops == pytest.approx(profile.expected, rel=1e-3)
        assert profile.interval == pytest.approx(found.posterior.intervals(0.9)[name], rel=1e-3)


def test_a_profile_that_bends_is_reported():
    columns = shapes(150, 2)

    def bent(unit):
        # Steep below 0.5, flat above it.
        x = unit[0] - 0.5
        return columns @ np.array([x - 0.45 * np.sqrt(x**2 + 1e-4), unit[1]])

    model, _ = small_model(columns, bent, noise=1.0)
    model.measured = bent(np.array([0.5, 0.5])) + 1.0 * np.random.default_rng(8).normal(size=150)
    found = estimate(model, np.array([0.5, 0.5]))
    profile = profile_likelihood(model, found, "p0")
    assert profile.warning is not None and "p0" in profile.warning


def test_a_profile_says_where_slices_break_down():
    columns = shapes(150, 2)
    model, truth = small_model(columns, noise=1.0)
    found = estimate(model, truth)
    edge = found.unit[0] + 1e-3

    def jacobian(unit, free=None):
        if unit[0] > edge:
            raise CuttingError("a slice breaks down")
        return columns @ unit - model.measured, columns

    model.jacobian = jacobian
    profile = profile_likelihood(model, found, "p0")
    assert "above breaks slices down" in profile.warning
    low, high = found.posterior.intervals(0.9)["p0"]
    assert profile.interval == pytest.approx((low, high), rel=1e-3)


def test_gauss_newton_stops_at_the_end_of_a_range():
    columns = shapes(60, 2) + 1.0
    model, _ = small_model(columns, noise=0.0)
    model.measured = columns @ np.array([1.3, 0.4])
    fit = gauss_newton(model, np.array([0.5, 0.5]))
    assert fit.converged and fit.unit[0] == 1.0
    # The other is best where the first is held, not where it would be without the bound.
    best = columns[:, 1] @ (model.measured - columns[:, 0]) / (columns[:, 1] @ columns[:, 1])
    assert fit.unit[1] == pytest.approx(best, abs=1e-6)
    assert all((u >= 0.0).all() and (u <= 1.0).all() for u in model.tried)


def test_gauss_newton_takes_no_step_to_where_a_slice_breaks_down():
    columns = shapes(60, 2)

    def fragile(unit):
        return columns @ unit**2 if unit[0] < 0.7 else np.full(60, np.nan)

    model, _ = small_model(columns, fragile, noise=0.0)
    model.measured = columns @ np.array([0.69, 0.5]) ** 2
    fit = gauss_newton(model, np.array([0.1, 0.1]), steps=20, tolerance=1e-8)
    assert any(u[0] >= 0.7 for u in model.tried)
    assert fit.unit == pytest.approx([0.69, 0.5], abs=1e-3)


def test_gauss_newton_moves_only_what_is_free():
    model, truth = small_model(shapes(60, 3))
    free = np.array([True, False, True])
    fit = gauss_newton(model, np.full(3, 0.1), free=free)
    assert fit.unit[1] == 0.1 and (np.abs(fit.unit - 0.1)[free] > 0.2).all()


def test_held_out_blocks_of_depth_show_an_overfit_and_fitted_error_does_not():
    x = np.linspace(0.0, 1.0, 100)
    rng = np.random.default_rng(2)
    wave = 0.3 * np.cumsum(rng.normal(size=100)) / 5.0
    errors = []
    for bumps in (0, 25):
        centers = np.linspace(0.0, 1.0, bumps)
        columns = np.column_stack([4.0 * x, *(np.exp(-(((x - c) / 0.03) ** 2)) for c in centers)])
        model, truth = small_model(columns, noise=0.0)
        model.measured = 2.0 * x + wave + 0.5 * columns[:, 1:].sum(1)
        fit = gauss_newton(model, truth)
        held = blocked_error(model, fit.unit)
        assert len(held.blocks) == 5 and sum(held.counts) == 100
        assert held.rms == pytest.approx(
            np.sqrt(np.average(np.square(held.blocks), weights=held.counts))
        )
        (fitted,) = residuals_at(model, [fit.unit])
        errors.append((np.sqrt(np.mean(fitted**2)), held.rms))
    assert errors[1][0] < 0.5 * errors[0][0]
    assert errors[1][1] > 2.0 * errors[1][0]


def test_interleaved_blocks_are_predicted_from_their_neighbours_and_long_ones_are_not():
    x = np.linspace(0.0, 1.0, 100)
    columns = np.column_stack([np.exp(-(((x - c) / 0.1) ** 2)) for c in np.linspace(0.0, 1.0, 6)])
    model, truth = small_model(columns, noise=0.0)
    model.measured = 0.5 * columns.sum(1) + 0.1 * np.sin(40.0 * x)
    fit = gauss_newton(model, truth)
    length = 0.02 * float(model.depth.max())
    short, long = (blocked_error(model, fit.unit, 2, each) for each in (length, None))
    assert len(short.blocks) == 2 and sum(short.counts) == 100
    (fitted,) = residuals_at(model, [fit.unit])
    assert short.rms < 1.3 * np.sqrt(np.mean(fitted**2)) < 0.7 * long.rms


def test_parameters_of_simulated_cuts_are_found_within_their_intervals():
    # A record alone does not show how slices vary.
    problem = Problem(speeds=(0.15,), records=1, record_scale=0.0)
    rng = np.random.default_rng(4)
    truth = np.array([0.5, 0.45, 0.6, 0.45])
    predictor, _ = synthetic_predictor(problem, truth, rng)
    fit = gauss_newton(predictor, truth + [0.05, -0.08, 0.06, 0.05])
    found = estimate(predictor, fit.unit)
    posterior = found.posterior
    values = posterior.values(truth)
    for name, (low, high) in posterior.intervals(0.99).items():
        assert low <= values[name] <= high, name
    # The data say something: force and friction go together, and each is known.
    assert posterior.determined()["material.friction"]


@pytest.mark.second_tier
def test_slices_that_differ_in_strength_are_not_taken_for_a_model_that_lacks_something():
    # Least squares moves each record's height by tenths of a millimetre to make up for it.
    problem = Problem(speeds=(0.15,), records=3)
    rng = np.random.default_rng(1)
    truth = np.array([0.5, 0.45, 0.6, 0.45, 0.5, 0.55])
    predictor, _ = synthetic_predictor(problem, truth, rng)
    fit = gauss_newton(predictor, truth + [0.05, -0.08, 0.06, 0.05, -0.05, 0.05])
    assert np.abs(fit.unit - truth)[3:].max() > 0.1
    found = estimate(predictor, fit.unit)
    assert not found.posterior.notes
    assert np.abs(found.unit - truth)[3:].max() < 0.04
    assert max(found.posterior.deviation[3:]) < 0.02


def test_a_coverage_study_goes_on_from_its_file_and_refuses_that_of_another(tmp_path):
    problem, names = Problem(), ["material.friction", "height_offset:0-0"]
    done = [
        Replicate(
            *[[0.5, 0.5]] * 2,
            [True, k > 0],
            k,
            repr(problem),
            names,
            [0.5, 0.5],
            {name: Found([0.5, 0.5], [0.5, 0.5], [k > 0, True]) for name in OTHERS},
            0.05,
            0.02,
            0.1,
        )
        for k in range(2)
    ]
    file = tmp_path / "coverage.jsonl"
    file.write_text("".join(json.dumps(dc.asdict(r)) + "\n" for r in reversed(done)))
    results = coverage_study(problem, 2, file)
    assert results == done and coverage_share(results) == 0.75
    page = coverage_page(problem, results, "the command")
    assert "| material.friction | 2 of 2 | 100 % |" in page
    assert "| height_offset | 1 of 2 | 50 % |" in page and "**75.0 %**, outside" in page
    with pytest.raises(ConfigurationError, match="another problem"):
        coverage_study(Problem(records=3), 2, file)
