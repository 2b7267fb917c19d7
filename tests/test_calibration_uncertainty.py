"""Uncertainty of a calibration: noise of records, intervals, profiles, held-out error, drawing."""

import copy
from types import SimpleNamespace

import numpy as np

from sliceit_drake.calibration.gauss_newton import gauss_newton
from sliceit_drake.calibration.noise import NoiseModel, group_series
from sliceit_drake.calibration.prediction import Parameter
from sliceit_drake.calibration.uncertainty import estimate


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
        self.tried = []

    def split(self, entries):
        ends = np.cumsum(np.bincount(self.record_of))[:-1]
        return [part[:, None] for part in np.split(entries, ends)]

    def predict(self, units):
        self.tried += [u.copy() for u in units]
        return [[SimpleNamespace(predicted=p) for p in self.split(self.function(u))] for u in units]

    def jacobian(self, unit):
        columns = []
        for k in range(len(unit)):
            step = np.zeros(len(unit))
            step[k] = 1e-6
            columns.append((self.function(unit + step) - self.function(unit - step)) / 2e-6)
        return self.function(unit) - self.measured, np.array(columns).T

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
    sample = np.array([noise.sample(np.random.default_rng(k), len(t)) for k in range(4000)])
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
    covered, naive = [], []
    for _ in range(120):
        model = linear_model()
        truth = rng.uniform(0.3, 0.7, 3)
        force = model.function(truth)
        model.measured = force - noise_of(model, 0.3, 0.1, 0.1, 0.07, force).sample(rng, len(force))
        mean, reach = white_noise_interval(model, truth)
        naive.append(np.abs(mean - truth) < reach)
        result = estimate(model, mean, rounds=1).posterior
        reach = 1.645 * result.deviation
        covered.append(np.abs(np.array(result.mean) - truth) < reach)
    share = np.mean(covered, axis=0)
    print(share, np.mean(naive, axis=0))
    assert (share > 0.80).all() and (share < 0.98).all()
    assert np.mean(naive) < 0.7
