"""The calibration finds what made the records; a run that was killed ends where it would have."""

import copy
import dataclasses as dc
import json
import multiprocessing
import signal
import subprocess
import sys
import time

import numpy as np
import optuna
import pytest

from sliceit_drake.calibration import calibrate as calibrate_module
from sliceit_drake.calibration.calibrate import CalibrationOptions, calibrate
from sliceit_drake.calibration.gauss_newton import residuals_at
from sliceit_drake.calibration.oscillation import Oscillation, fit_oscillation
from sliceit_drake.calibration.per_point import fit_points
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.refine import refine
from sliceit_drake.calibration.search import open_study, search
from sliceit_drake.calibration.setup import (
    CalibrationSetup,
    ParameterRange,
    load_setup,
)
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import (
    CalibratedFood,
    load_calibrated_food,
)
from sliceit_drake.cutting.foods.distribution import ParameterDistribution
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.records.preprocessing import low_pass
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.resources import shipped_names
from sliceit_drake.stand_in.effect_registry import make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import Condition, Protocol, Variation
from sliceit_drake.stand_in.sensor_model import SensorModel
from sliceit_drake.stand_in.session import Session

TRUTH = {"material.toughness": 420.0, "material.youngs_modulus": 1.2e6, "material.friction": 0.15}
SHAPE = Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3])
SAME = Variation(toughness=0.0, stiffness=0.0, friction=0.0, height=0.0)


def coarse_setup(**changes) -> CalibrationSetup:
    material = Material(youngs_modulus=1.6e6, toughness=300.0, friction=0.1)
    return CalibrationSetup(
        food=Food(shape=SHAPE, material=material),
        numerics=Numerics(time_step=1e-3),
        parameters=[
            ParameterRange("material.toughness", 100.0, 1000.0),
            ParameterRange("material.youngs_modulus", 2e5, 5e6),
            ParameterRange("material.friction", 0.02, 1.0),
        ],
        **changes,
    )


def bench_records(
    count: int = 1, noise: float = 0.1, time_step: float = 1e-3, hidden: tuple[str, ...] = ()
) -> list[SliceRecord]:
    """Press cuts to 18 mm with a withdrawal, in a world with hidden effects."""
    material = Material(
        youngs_modulus=TRUTH["material.youngs_modulus"],
        toughness=TRUTH["material.toughness"],
        friction=TRUTH["material.friction"],
    )
    plan = MotionPlan(
        [
            Hold(duration=0.1, label="air"),
            ConstantSpeed(distance=0.021, speed=0.1, acceleration=5.0, label="slice"),
            ConstantSpeed(
                distance=0.01,
                speed=0.1,
                direction=[0.0, 0.0, -1.0],
                acceleration=5.0,
                label="retract",
            ),
        ]
    )
    protocol = Protocol(
        food=Food(shape=SHAPE, material=material),
        sensor=SensorModel(
            force_noise=noise,
            correlated_share=0.0,
            force_bias=0.0,
            force_drift=0.0,
            delay=0.0,
            cutoff_frequency=0.0,
            force_resolution=0.0,
        ),
        variation=SAME,
        conditions=[Condition("press", plan, replicates=count)],
    )
    settings = FiniteElementSettings(refinement=1.0, time_step=time_step)
    session = Session(protocol, [make_effect(e) for e in hidden], seed=3, settings=settings)
    return [session.record(k) for k in range(count)]


@pytest.fixture(scope="module")
def records() -> list[SliceRecord]:
    return bench_records(2)


def truth(predictor: Predictor) -> np.ndarray:
    return np.array([p.unit(TRUTH.get(p.name, 0.0)) for p in predictor.parameters])


def test_the_parameters_that_made_a_record_predict_it_up_to_its_noise(records):
    predictor = Predictor(coarse_setup(), records)
    (rest,) = residuals_at(predictor, [truth(predictor)])
    assert np.std(rest) == pytest.approx(0.1, rel=0.15)
    assert abs(np.mean(rest)) < 0.02


def test_the_gradient_of_the_error_is_that_of_differences(records, monkeypatch):
    """Exactly where differences hold the added inertia as the adjoint does; else nearly."""
    setup = coarse_setup(oscillation=[3.0, 9.0])
    predictor = Predictor(setup, records[:1], precision="float64")
    unit = predictor.start + 0.02
    _, gradient = predictor.mean_square_and_gradient(unit)
    model = Predictor.model
    base = model(predictor, predictor.targets[0], predictor.values(unit))
    for tolerance in (1e-2, 1e-3):
        for k, name in enumerate(p.name for p in predictor.parameters):
            ends = [unit + sign * 3e-5 * (np.arange(len(unit)) == k) for sign in (1.0, -1.0)]
            squares = [predictor.error(row) ** 2 for row in predictor.predict(ends)]
            slope = (squares[0] - squares[1]) / 6e-5
            close = pytest.approx(slope, rel=tolerance, abs=tolerance * abs(gradient).max())
            assert gradient[k] == close, name
        monkeypatch.setattr(Predictor, "model", lambda *args: model(*args).derive(base))


@pytest.mark.parametrize("skin", [0.3, 1.0])
def test_differences_take_the_sub_steps_of_the_slice_that_they_are_from(records, skin):
    """A skin gives way, and the knife turns round: each slice alone would choose its own."""
    setup = coarse_setup()
    setup.food.effects.skin.toughness = skin
    predictor = Predictor(setup, records[:1], precision="float64")
    unit, friction = predictor.start, 2
    _, gradient = predictor.mean_square_and_gradient(unit)
    residual, jacobian = predictor.jacobian(unit, 5e-4)
    slope = 2.0 * float(residual @ jacobian[:, friction]) / len(residual)
    assert slope == pytest.approx(gradient[friction], rel=5e-4)
    rows = predictor.predict([unit]) + predictor.predict([unit], near=unit)
    np.testing.assert_array_equal(*(row[0].smooth for row in rows))


def test_samples_that_are_held_out_do_not_count(records):
    predictor = Predictor(coarse_setup(), records)
    hidden = predictor.depth > 0.01
    spoiled = [dc.replace(r, force=r.force.copy()) for r in records]
    for record, target in zip(spoiled, predictor.targets, strict=True):
        deep = np.isin(record.time, target.time[target.depth > 0.01])
        record.force[deep] += 50.0
    unit = predictor.start
    error, gradient = predictor.holding_out(hidden).mean_square_and_gradient(unit)
    other = Predictor(coarse_setup(), spoiled).holding_out(hidden)
    assert other.mean_square_and_gradient(unit)[0] == error
    np.testing.assert_array_equal(other.mean_square_and_gradient(unit)[1], gradient)


def test_turned_rows_are_predicted_within_three_times_the_noise():
    """The error is 2.4 times the noise; 17 times without shorter sub-steps at the turn."""
    (record,) = bench_records(1, noise=0.05, time_step=5e-5)
    predictor = Predictor(coarse_setup(), [record])
    (target,) = predictor.targets
    since = target.time - target.time[target.depth.argmax()]
    turned = (since > 0.0) & (since < 0.03)
    assert turned.sum() >= 7 and predictor.used.all()
    ((prediction,),) = predictor.predict([truth(predictor)])
    rest = prediction.predicted - target.measured
    assert np.sqrt(np.mean(rest[turned] ** 2)) < 3.0 * 0.05
    assert np.sqrt(np.mean(rest[~turned] ** 2)) == pytest.approx(0.05, rel=0.1)


def test_what_the_sub_step_does_wrong_is_taken_off(records):
    usual = Predictor(coarse_setup(), records[:1], precision="float64")
    unit = truth(usual)
    ((true,),) = usual.predict([unit], step=1.25e-5)
    usual.targets[0].measured = true.predicted
    errors = []
    for predictor in (usual, usual.without_step_error(unit)):
        (row,) = predictor.predict([unit])
        errors.append(predictor.error(row))
    # The gradient is that of the same error.
    assert predictor.mean_square_and_gradient(unit)[0] == pytest.approx(errors[1] ** 2)
    assert 0.01 < errors[0] < 0.1 and errors[1] < 0.3 * errors[0]
    assert not usual.step_error.any()


def test_a_record_that_breaks_down_with_small_sub_steps_is_named(records, monkeypatch):
    predictor, predict = Predictor(coarse_setup(), records), Predictor.predict

    def broken(self, units, step=None):
        rows = predict(self, units)
        if step is not None:
            rows[0][1] = dc.replace(rows[0][1], smooth=np.full_like(rows[0][1].smooth, np.nan))
        return rows

    monkeypatch.setattr(Predictor, "predict", broken)
    other = predictor.without_step_error(truth(predictor))
    assert other.step_unknown == [records[1].name] and not other.step_error.any()


def test_a_knife_that_is_upside_down_is_refused(records):
    wrong = copy.deepcopy(records[0])
    wrong.rotation[:] = wrong.rotation @ np.diag([1.0, -1.0, -1.0])
    with pytest.raises(ConfigurationError, match="upside down at the food, .* s") as error:
        Predictor(coarse_setup(), [wrong])
    assert "from the spine to the edge" in str(error.value)


@pytest.mark.parametrize(("part", "off"), [(1.0, 0.05), (0.55, 0.08)])
def test_the_filters_of_a_record_are_repeated_on_its_prediction(part, off):
    """At the end of a record that ends in the cut, too."""
    (record,) = bench_records(1, noise=1e-6)
    record = record.between(0.0, part * record.time[-1])
    filtered = low_pass(record, 7.0)
    ends = []
    for r in (record, filtered):
        predictor = Predictor(coarse_setup(), [r])
        ends += residuals_at(predictor, [truth(predictor)])
    change = filtered.force - record.force
    assert np.std(change) > 0.3
    assert np.std(ends[1]) < off * np.std(change)


def test_a_weight_that_was_measured_is_predicted(records):
    heavy = copy.deepcopy(records[0])
    heavy.metadata.tool.mass, heavy.metadata.tool.center_of_mass = 0.3, [0.0, 0.0, 0.0]
    heavy.metadata.wrench.includes.append("gravity")
    heavy.metadata.wrench.tared = "no"
    heavy.force[:, 2] -= 9.81 * 0.3
    rests = []
    for record in (records[0], heavy):
        predictor = Predictor(coarse_setup(), [record])
        rests += residuals_at(predictor, [truth(predictor)])
    np.testing.assert_allclose(rests[1], rests[0], atol=1e-9)


def test_a_peeled_record_is_cut_without_skin(records):
    setup = coarse_setup()
    setup.food.effects.skin.toughness = 0.5
    setup.parameters.append(ParameterRange("effects.skin.toughness", 0.1, 2.0))
    peeled = copy.deepcopy(records[0])
    peeled.metadata.food.peeled = True
    predictor = Predictor(setup, [peeled])
    names = [p.name for p in predictor.parameters]
    _, gradient = predictor.mean_square_and_gradient(predictor.start)
    assert gradient[names.index("effects.skin.toughness")] == 0.0
    (rest,) = residuals_at(predictor, [truth(predictor)])
    without = Predictor(coarse_setup(), records[:1])
    (bare,) = residuals_at(without, [truth(without)])
    np.testing.assert_allclose(rest, bare, atol=1e-3)


def test_a_record_without_food_is_refused(records):
    bare = copy.deepcopy(records[0])
    bare.metadata.food.name = "none"
    with pytest.raises(ConfigurationError, match="no food under the knife"):
        Predictor(coarse_setup(), [bare])


def test_a_search_that_was_killed_ends_where_it_would_have_ended(records, tmp_path, monkeypatch):
    predictor = Predictor(coarse_setup(), records[:1])
    whole = search(predictor, open_study(tmp_path / "whole.log", "s"), 40, seed=5)

    class Killed(Exception):
        pass

    add, left = optuna.Study.add_trial, [30]

    def kill(study, trial):
        if study.study_name == "s":
            if left[0] == 0:
                raise Killed
            left[0] -= 1
        add(study, trial)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(optuna.Study, "add_trial", kill)
        search(predictor, open_study(tmp_path / "parts.log", "s"), 40, seed=5)
    parts = search(predictor, open_study(tmp_path / "parts.log", "s"), 40, seed=5)
    np.testing.assert_array_equal(parts.units, whole.units)
    np.testing.assert_array_equal(parts.errors, whole.errors)
    other = search(predictor, open_study(tmp_path / "other.log", "s"), 40, seed=6)
    assert not np.array_equal(other.units, whole.units)


def test_adam_that_was_killed_ends_where_it_would_have_ended_and_improves(records, tmp_path):
    predictor = Predictor(coarse_setup(), records[:1])
    start = predictor.start
    before = predictor.error(predictor.predict([start])[0])
    whole = refine(predictor, start, 8)

    class Killed(Exception):
        pass

    def kill(step: int, error: float) -> None:
        if step == 3:
            raise Killed

    with pytest.raises(Killed):
        refine(predictor, start, 8, tmp_path / "adam.npz", kill)
    parts = refine(predictor, start, 8, tmp_path / "adam.npz")
    np.testing.assert_array_equal(parts.unit, whole.unit)
    assert parts.errors == whole.errors
    assert whole.error < 0.9 * before


def test_search_and_adam_beat_the_search_alone_at_the_same_number_of_slices(records, tmp_path):
    predictor = Predictor(coarse_setup(), records[:1])
    study = open_study(tmp_path / "a.log", "s")
    first = search(predictor, study, 40, seed=1)
    refined = refine(predictor, first.best(1)[0], 15)
    # A gradient costs six slices.
    longer = search(predictor, study, 40 + 6 * 15, seed=1)
    assert refined.error < longer.errors.min()


def _work(storage: str, seed: int) -> int:
    predictor = Predictor(coarse_setup(), bench_records(1), workers=1)
    study = open_study(storage, "shared")
    generations: list[int] = []
    search(predictor, study, 24, seed, lambda done, error: generations.append(done))
    return len(generations)


def test_two_workers_share_a_journal_file(tmp_path):
    storage = str(tmp_path / "shared.log")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        generations = pool.starmap(_work, [(storage, 1), (storage, 2)])
    assert min(generations) >= 1
    done = [t for t in open_study(storage, "shared").trials if t.value is not None]
    assert 24 <= len(done) <= 24 + 8
    # Both begin with the setup's values.
    assert len({tuple(t.params.values()) for t in done}) >= len(done) - 1


def test_a_storage_with_other_parameters_is_refused(records, tmp_path):
    study = open_study(tmp_path / "a.log", "s")
    search(Predictor(coarse_setup(), records[:1]), study, 4, seed=1)
    other = coarse_setup()
    other.parameters[0].high = 900.0
    with pytest.raises(ConfigurationError, match="other parameters"):
        search(Predictor(other, records[:1]), study, 8, seed=1)


def test_a_record_that_is_fitted_and_held_out_is_refused_before_anything_is_computed(
    records, tmp_path
):
    with pytest.raises(ConfigurationError, match="slice_000 is fitted and held out") as error:
        calibrate(coarse_setup(), records, tmp_path, held_out=records[:1])
    assert error.value.field == "--hold-out" and not list(tmp_path.iterdir())


def test_a_held_out_record_may_have_a_parameter_that_no_fitted_one_has(records):
    fitted = Predictor(coarse_setup(), records[:1], workers=1)
    other = copy.deepcopy(records[1])
    other.metadata.unknown.append("motion.speed")
    held_out = Predictor(coarse_setup(), [other], workers=1)
    (error,) = calibrate_module._held_out(held_out, fitted, fitted.start).values()
    assert np.isfinite(error)


def test_a_calibration_recovers_what_made_the_records_within_its_intervals(tmp_path):
    # The error of the calibration's sub-steps is taken off, so that the bench must have little.
    records = bench_records(2, time_step=5e-5)
    options = CalibrationOptions(trials=24, steps=6, starts=1, workers=1, blocks=3)
    setup = coarse_setup(search_time_step=1e-3)
    result = calibrate(setup, records[:1], tmp_path, options, held_out=records[1:])
    intervals = result.posterior.intervals(0.99)
    for name, value in TRUTH.items():
        low, high = intervals[name]
        assert low < value < high
        assert result.posterior.determined()[name]
    assert result.rms == pytest.approx(0.1, rel=0.2)
    assert result.polished_rms <= result.refined_rms + 1e-6
    assert result.held_out_records["slice_001"] == pytest.approx(0.1, rel=0.3)
    assert result.held_out_rms == pytest.approx(0.1, rel=0.5)
    assert f"polished {result.polished_rms:.3f}, with these values {result.rms:.3f} N" in (
        result.table()
    )
    # One estimate, one covariance: what is printed is what the food has, inside its interval.
    values = result.predictor.values(result.unit)
    assert result.posterior.values() == values
    for name, (low, high) in result.posterior.intervals(0.9).items():
        assert low <= values[name] <= high, name
    assert f"Held-out record slice_001: {result.held_out_records['slice_001']:.3f} N" in (
        result.table()
    )
    above, below = result.plot().axes
    measured = result.predictor.targets[0].measured
    np.testing.assert_array_equal(above.lines[0].get_ydata(), measured[:, 0])
    rest = measured - result.predictions[0].predicted
    np.testing.assert_array_equal(below.lines[0].get_ydata(), rest[:, 0])
    again = calibrate(setup, records[:1], tmp_path, options)
    np.testing.assert_array_equal(again.unit, result.unit)
    food = result.calibrated_food("2026-01-01", "sliceit calibrate")
    dump_yaml(food, tmp_path / "food.yaml")
    loaded = load_calibrated_food(tmp_path / "food.yaml")
    assert loaded.food.material == food.food.material
    assert set(loaded.distribution.names) == set(TRUTH)
    start = {p.name: result.predictor.values(result.unit)[p.name] for p in setup.parameters}
    polished = calibrate(
        setup, records[1:], tmp_path / "other", dc.replace(options, start=start, blocks=0)
    )
    assert polished.rms == pytest.approx(0.1, rel=0.2)
    assert not (tmp_path / "other" / "trials.log").exists()
    spread = [loaded.distribution.draw(np.random.default_rng(k), 1)[0] for k in range(50)]
    for name in TRUTH:
        assert np.mean([d[name] for d in spread]) == pytest.approx(TRUTH[name], rel=0.05)


def test_a_strength_that_the_mesh_cannot_carry_stands_in_table_and_summary(records, tmp_path):
    setup = coarse_setup()
    setup.food.material.strength = 3e6
    options = CalibrationOptions(blocks=0, start=TRUTH)
    result = calibrate(setup, records[:1], tmp_path, options)
    (warning,) = result.warnings
    assert warning.startswith("material.strength = 3e+06 Pa is more than bonds of")
    assert result.table().endswith(f"Warning: {warning}")
    result.save(tmp_path)
    summary = json.loads((tmp_path / "calibration.json").read_text(encoding="utf-8"))
    assert summary["warnings"] == [warning]


def test_a_toughness_for_each_cut_point_finds_a_layer_that_shared_parameters_lack(records):
    predictor = Predictor(coarse_setup(), records[:1])
    unit = truth(predictor)
    model = predictor.targets[0].model
    z = model.split.points[:, 2]
    layer = 1.0 + 0.6 * ((z > np.quantile(z, 0.5)) & (z < np.quantile(z, 0.8)))
    scaled = predictor.with_point_factors({"point_scales.toughness": layer})
    (prediction,) = scaled.predict([unit])[0]
    spoiled = copy.copy(predictor)
    target = copy.copy(predictor.targets[0])
    target.measured = prediction.predicted
    spoiled.targets = [target]
    before = spoiled.error(spoiled.predict([unit])[0])
    fit = fit_points(spoiled, unit, steps=25)
    assert fit.rms < 0.3 * before
    inside = layer > 1.0
    assert fit.factors[inside].mean() > fit.factors[~inside].mean() + 0.2


def test_an_oscillation_in_proportion_to_the_force_is_found():
    time = np.linspace(0.0, 1.0, 400)
    smooth = np.column_stack([10.0 * time, 3.0 + 0.0 * time])
    true = Oscillation(5.3, 0.04, -0.07)
    measured = true.factor(time)[:, None] * smooth
    found = fit_oscillation(time, smooth, measured, np.ones_like(smooth), (2.0, 12.0))
    assert found.frequency == pytest.approx(true.frequency, abs=0.02)
    assert (found.cosine, found.sine) == pytest.approx((true.cosine, true.sine), abs=3e-3)
    step = 1e-6
    for k, name in enumerate(("frequency", "cosine", "sine")):
        moved = dc.replace(true, **{name: getattr(true, name) + step})
        slope = (moved.factor(time) - true.factor(time)) / step
        np.testing.assert_allclose(true.derivatives(time)[:, k], slope, atol=1e-4)


@pytest.mark.parametrize("name", ["cucumber", "potato", "tomato"])
def test_each_setup_names_parameters_of_its_food_within_their_ranges(name):
    assert name in shipped_names("calibration/setups")
    setup = load_setup(name)
    assert len(setup.parameters) + 2 + 3 * (setup.oscillation is not None) <= 14
    assert all(p.why for p in setup.parameters)


@pytest.mark.parametrize("name", ["apple", "carrot", "potato", "tomato"])
def test_a_shipped_food_is_cut_with_the_values_that_its_distribution_has(name):
    shipped = load_calibrated_food(name)
    for parameter, value in shipped.distribution.values().items():
        assert get_parameter(shipped.food, parameter) == pytest.approx(value, rel=1e-4), parameter


def test_a_setup_with_a_parameter_that_does_not_exist_is_refused(tmp_path):
    file = tmp_path / "food.yaml"
    file.write_text("parameters: [{name: material.toughnes, low: 1.0, high: 2.0}]\n")
    with pytest.raises(ConfigurationError, match='Did you mean "material.toughness"'):
        load_setup(file)
    with pytest.raises(ConfigurationError, match="no food that a setup ships for"):
        load_setup("pineapple")


def test_draws_from_a_calibrated_food_stay_in_its_ranges_and_have_its_covariance():
    covariance = [[0.01, 0.006], [0.006, 0.01]]
    what = ParameterDistribution(
        ["a", "b"], [1.0, -1.0], [100.0, 1.0], [True, False], [0.5, 0.5], covariance
    )
    rng = np.random.default_rng(0)
    draws = what.draw(rng, 4000)
    places = np.array([[np.log(d["a"]) / np.log(100.0), 0.5 * (d["b"] + 1.0)] for d in draws])
    np.testing.assert_allclose(np.cov(places.T), covariance, atol=1e-3)
    near_end = dc.replace(what, mean=[0.99, 0.5])
    assert max(draw["a"] for draw in near_end.draw(rng, 500)) <= 100.0


@pytest.mark.parametrize("name", shipped_names("calibration/foods"))
def test_a_scenario_loads_a_calibrated_food_by_name(name):
    calibrated = load_calibrated_food(name)
    scenario = load_scenario(Scenario(), f"{{calibration: {name}}}")
    assert scenario.food.material == calibrated.food.material
    assert scenario.food.effects.skin == calibrated.food.effects.skin
    # The holder's give is that of the robot that was measured.
    assert scenario.food.effects.compliance.arm == 0.0


def test_an_unknown_calibration_is_refused_with_the_names_there_are():
    with pytest.raises(ConfigurationError, match="pear.*not calibrated"):
        load_scenario(Scenario(), "{calibration: pear}")


def test_a_distribution_that_is_none_is_refused():
    bad = ParameterDistribution(["a"], [1.0], [2.0], [False], [0.5], [[-0.1]])
    with pytest.raises(ConfigurationError, match="variance is negative"):
        bad.check("distribution")
    with pytest.raises(ConfigurationError, match="entries"):
        dc.replace(bad, low=[]).check("distribution")
    assert CalibratedFood().distribution.draw(np.random.default_rng(0), 1) == [{}]


def test_the_age_of_a_lock_that_a_killed_run_left_can_be_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    backend = open_study("out/trials.log", "s")._storage._backend
    backend = getattr(backend, "_backend", backend)
    backend._lock.acquire()
    # A link to nowhere has no age, and whoever waits for it waits for ever.
    assert (tmp_path / "out/trials.log.lock").exists()
    assert backend._lock.grace_period <= 10


@pytest.mark.second_tier
def test_a_command_that_was_killed_ends_with_the_same_numbers(records, tmp_path):
    write_record(records[0], tmp_path / "press")
    dump_yaml(coarse_setup(), tmp_path / "setup.yaml")

    def calibration(folder: str) -> subprocess.Popen:
        words = ["press.csv", "--food", "setup.yaml", "--output", folder, "--workers", "1"]
        words += ["--trials", "8", "--steps", "2", "--starts", "1", "--blocks", "0"]
        program = [sys.executable, "-m", "sliceit_drake.cli.main", "calibrate"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen([*program, *words], cwd=tmp_path, **quiet)

    killed, log = calibration("killed"), tmp_path / "killed/trials.log"
    # One of two generations is begun. Whoever is killed as it writes leaves its lock.
    while killed.poll() is None and not (log.exists() and log.read_text().count("\n") > 4):
        time.sleep(0.01)
    killed.kill()
    assert killed.wait() == -signal.SIGKILL
    results = []
    for folder in ("killed", "whole"):
        assert calibration(folder).wait() == 0
        results.append(json.loads((tmp_path / folder / "calibration.json").read_text()))
    assert results[0] == results[1]


KILLED_IN_THE_CHOICE = """
import os, signal, sys
from sliceit_drake.calibration import structure
from sliceit_drake.cli.main import main
fit, fits = structure._fit, []
def third_kills(*given):
    fits.append(fit(*given))
    if len(fits) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return fits[-1]
structure._fit = third_kills
main(sys.argv[1:])
"""


@pytest.mark.second_tier
def test_a_choice_of_structure_that_was_killed_ends_with_the_same_numbers(tmp_path):
    """Killed within the choice, and once more when it is made and the fit begins."""
    (record,) = bench_records(1, hidden=("core:0.5",))
    write_record(record, tmp_path / "press")
    dump_yaml(coarse_setup(), tmp_path / "setup.yaml")

    def calibration(folder: str, *program: str) -> subprocess.Popen:
        words = ["press.csv", "--food", "setup.yaml", "--output", folder, "--workers", "1"]
        words = [sys.executable, *program, "calibrate", *words, "--blocks", "0"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(words, cwd=tmp_path, **quiet)

    usual, chosen = ("-m", "sliceit_drake.cli.main"), tmp_path / "killed/structure.json"
    assert calibration("killed", "-c", KILLED_IN_THE_CHOICE).wait() == -signal.SIGKILL
    assert not chosen.exists()
    killed = calibration("killed", *usual)
    while killed.poll() is None and not chosen.exists():
        time.sleep(0.01)
    killed.kill()
    assert killed.wait() == -signal.SIGKILL
    assert not (tmp_path / "killed/food.yaml").exists()
    for folder in ("killed", "whole"):
        assert calibration(folder, *usual).wait() == 0
    assert json.loads(chosen.read_text())["taken"]
    for name in ("calibration.json", "structure.json", "setup.yaml"):
        ends = [(tmp_path / folder / name).read_text() for folder in ("killed", "whole")]
        assert ends[0] == ends[1], name


def test_rows_of_a_sensor_at_its_limit_do_not_count(records):
    clipped = copy.deepcopy(records[0])
    clipped.force[:, 2] = np.minimum(clipped.force[:, 2], 0.8 * clipped.force[:, 2].max())
    predictor = Predictor(coarse_setup(), [clipped])
    up = predictor.split(predictor.used)[0][:, 2]
    at_limit = predictor.targets[0].measured[:, 2] == clipped.force[:, 2].max()
    assert at_limit.sum() > 5
    np.testing.assert_array_equal(up, ~at_limit)
    assert Predictor(coarse_setup(), [records[0]]).used.all()
