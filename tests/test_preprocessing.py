"""Preprocessing recovers a known wrench, and does to a prediction what it did to a measurement."""

import dataclasses as dc

import numpy as np
import pytest
from example_slices import example_slice, wrist_motion
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records.metadata import Phase, ToolFacts
from sliceit_drake.records.preprocessing import (
    apply_filters,
    as_measured,
    compensate_tool,
    crop,
    low_pass,
    resample,
    tare,
)
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.records.validation import load_record

TOOL = ToolFacts(0.8, [0.03, -0.01, -0.09], [2.5e-3, 3e-3, 1.5e-3, 2e-4, -1e-4, 3e-4])


def tool_wrench(record: SliceRecord, *, inertia: bool) -> tuple[np.ndarray, np.ndarray]:
    """Weight, and inertial wrench about Ko, of TOOL made of point masses; the other way round.

    Four masses have its mass, its centre and its inertia; each has its weight and m a, with the
    acceleration from its path.
    """
    Ixx, Iyy, Izz, Ixy, Ixz, Iyz = TOOL.inertia
    I_K = np.array([[Ixx, Ixy, Ixz], [Ixy, Iyy, Iyz], [Ixz, Iyz, Izz]])
    # I = tr(J) 1 - J with J the second moments of mass: sum m x x^T.
    J = 0.5 * np.trace(I_K) * np.eye(3) - I_K
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    points = corners @ np.linalg.cholesky(J / TOOL.mass).T + TOOL.center_of_mass
    force, torque = np.zeros_like(record.position), np.zeros_like(record.position)
    for point in points:
        arm = record.rotation @ point
        f = np.zeros_like(force)
        f[:, 2] -= 0.25 * TOOL.mass * 9.81
        if inertia:
            path = record.position + arm
            speed = np.gradient(path, record.time, axis=0)
            f -= 0.25 * TOOL.mass * np.gradient(speed, record.time, axis=0)
        force += f
        torque += np.cross(arm, f)
    return force, torque


def swung_slice() -> SliceRecord:
    """A noiseless slice force on a knife that swings, in the air at first."""
    record = example_slice(0.0)
    p, R, v, w = wrist_motion(record.time)
    record = dc.replace(record, position=p, rotation=R, velocity=v, angular_velocity=w)
    record.torque = np.cross([0.02, 0.0, 0.0], record.force)
    record.metadata.tool = TOOL
    # Differences are one-sided at the ends.
    record.metadata.motion.phases[0].start = 0.05
    record.metadata.wrench.tared = "no"
    return record


@pytest.mark.parametrize("inertia", [False, True])
def test_weight_inertia_and_zero_of_the_sensor_are_removed(inertia):
    truth = swung_slice()
    record = dc.replace(truth)
    record.metadata.wrench.includes = ["food", "board", "gravity"] + inertia * ["inertia"]
    force, torque = tool_wrench(truth, inertia=inertia)
    zero_f, zero_t = truth.rotation @ [2.0, -1.0, 7.0], truth.rotation @ [0.3, 0.1, -0.2]
    record.force, record.torque = truth.force + force + zero_f, truth.torque + torque + zero_t
    result = tare(compensate_tool(record, cutoff=None))
    # Second differences of the wrist's motion over 4 ms; exact for the weight alone.
    inside = slice(5, -5)
    atol = 2e-3 if inertia else 1e-12
    np.testing.assert_allclose(result.force[inside], truth.force[inside], atol=atol)
    np.testing.assert_allclose(result.torque[inside], truth.torque[inside], atol=atol)
    assert result.metadata.wrench.includes == ["food", "board"]
    assert result.metadata.wrench.tared == "yes"
    steps = {step.name: step.numbers for step in result.metadata.processing}
    assert list(steps) == ["compensate_tool", "tare"]
    assert steps["tare"]["force_z"] == pytest.approx(7.0, abs=atol + 1e-9)
    assert steps["tare"]["torque_x"] == pytest.approx(0.3, abs=atol + 1e-9)
    assert record.metadata.processing == [], "the record that went in is as it was"


@pytest.mark.parametrize("vertical", [False, True])
def test_spikes_in_the_air_do_not_move_the_zero(vertical):
    record = example_slice(0.05, seed=3)
    if vertical:
        record = dc.replace(record, force=None, torque=None, force_vertical=record.force[:, 2])
    row = int(np.flatnonzero(record.first_phase("air"))[20])
    faulty = dc.replace(record)
    if vertical:
        faulty.force_vertical = record.force_vertical.copy()
        faulty.force_vertical[row] += 100.0
    else:
        faulty.force = record.force.copy()
        faulty.force[row] += 100.0
    zeros = [tare(r).metadata.processing[-1].numbers for r in (record, faulty)]
    for name, zero in zeros[0].items():
        assert zeros[1][name] == pytest.approx(zero, abs=2e-3)


def test_filtered_velocities_still_remove_most_of_the_inertia():
    truth = swung_slice()
    truth.metadata.wrench.includes = ["food", "inertia"]
    force, torque = tool_wrench(truth, inertia=True)
    weight, weight_torque = tool_wrench(truth, inertia=False)
    rng = np.random.default_rng(0)
    record = dc.replace(
        truth,
        force=truth.force + force - weight,
        torque=truth.torque + torque - weight_torque,
        velocity=truth.velocity + 1e-3 * rng.normal(size=truth.velocity.shape),
    )
    inside = slice(100, -100)
    error = {
        cutoff: np.abs(compensate_tool(record, cutoff=cutoff).force - truth.force)[inside].max()
        for cutoff in (20.0, None)
    }
    assert error[20.0] < 0.1 * np.abs(force - weight).max()
    assert error[20.0] < 0.2 * error[None]


def test_taring_takes_the_mean_of_the_first_air_alone():
    record = example_slice()
    # After the withdrawal the zero has drifted, which is to remain.
    record.metadata.motion.phases[-1].label = "air"
    record.force[-400:] += 1.0
    offset = np.array([1.0, 2.0, -3.0])
    result = tare(dc.replace(record, force=record.force + offset))
    air = record.time < 0.5
    np.testing.assert_allclose(result.force[air].mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(result.force, record.force - record.force[air].mean(axis=0))


@pytest.mark.parametrize("step", [tare, compensate_tool])
def test_what_a_step_needs_is_asked_for(step):
    record = example_slice()
    norm = dc.replace(record, force_norm=record.force_magnitude, force=None, torque=None)
    with pytest.raises(ConfigurationError, match="cucumber_00.csv: has the norm of the force"):
        step(norm)
    record.metadata.motion.phases.pop(0)
    record.metadata.tool = ToolFacts()
    message = (
        "has 0 rows in its first phase labelled air|tool.mass or tool.center_of_mass is not given"
    )
    with pytest.raises(ConfigurationError, match=message):
        step(record)


def filtered(record: SliceRecord) -> SliceRecord:
    return crop(resample(low_pass(record, 30.0, zero_phase=False), 100.0), 0.3, 2.5)


@pytest.mark.parametrize(
    "steps",
    [
        lambda r: low_pass(r, 20.0),
        lambda r: low_pass(r, 20.0, order=1, zero_phase=False),
        lambda r: resample(r, 100.0),
        lambda r: resample(r, 1000.0),
        filtered,
    ],
    ids=["zero phase", "causal", "resampled down", "resampled up", "all"],
)
@pytest.mark.parametrize("jitter", [0.0, 0.0005])
def test_a_prediction_passes_the_very_filters_of_the_measurement(steps, jitter, tmp_path):
    record = example_slice()
    record.time = record.time + jitter * np.random.default_rng(3).uniform(size=len(record))
    # From the file, as a comparison has the steps.
    result = load_record(write_record(steps(record), tmp_path / "filtered"))
    time, force = apply_filters(result.metadata.processing, record.time, record.force)
    np.testing.assert_allclose(time, result.time, atol=1e-8)
    np.testing.assert_allclose(force, result.force, atol=1e-6)
    _, column = apply_filters(result.metadata.processing, record.time, record.force[:, 2])
    np.testing.assert_array_equal(column, force[:, 2])


def test_a_filter_means_the_same_at_another_rate():
    """A prediction has its own time step; the same force must come out."""
    record = filtered(example_slice(0.0))
    fine = np.arange(0.0, 3.0, 0.0005)
    true = example_slice(0.0)
    dense = np.interp(fine, true.time, true.force[:, 2])
    time, force = apply_filters(record.metadata.processing, fine, dense)
    np.testing.assert_allclose(time, record.time, atol=1e-9)
    np.testing.assert_allclose(force, record.force[:, 2], atol=0.1)


def test_a_low_pass_has_its_gain_and_no_delay():
    record = example_slice(0.0)
    for frequency, gain in ((20.0, 0.5), (2.0, 1.0), (60.0, 1.0 / 82.0)):
        wave = np.sin(2.0 * np.pi * frequency * record.time)
        record.force = np.outer(wave, [1.0, 0.0, 0.0])
        # Two passes of order 2: 1 / (1 + (f / 20)^4).
        result = low_pass(record, 20.0).force[500:-500, 0]
        np.testing.assert_allclose(result, gain * wave[500:-500], atol=0.01)


def test_a_low_pass_means_the_same_where_rows_are_left_out():
    """As in a curve read from the dashes of a figure."""
    record = example_slice(0.0)
    kept = record.rows(np.random.default_rng(4).uniform(size=len(record)) < 0.7)
    wave = np.sin(2.0 * np.pi * 10.0 * kept.time)
    kept.force = np.outer(wave, [1.0, 0.0, 0.0])
    result = low_pass(kept, 10.0).force[350:-350, 0]
    np.testing.assert_allclose(result, 0.5 * wave[350:-350], atol=0.03)


def test_a_causal_filter_starts_at_rest_on_an_offset():
    record = example_slice(0.0)
    record.force = np.full_like(record.force, 3.0)
    result = low_pass(record, 5.0, zero_phase=False)
    np.testing.assert_allclose(result.force, 3.0, atol=1e-9)


def test_fewer_rows_do_not_alias_noise():
    record = example_slice(1.0)
    result = resample(record, 50.0)
    air = result.phase("air") & (result.time > 0.05) & (result.time < 0.45)
    # White noise of 1 N to 250 Hz, of which what is below 25 Hz remains: a tenth of the power.
    assert 0.1 < result.force[air].std() < 0.33


def test_resampling_keeps_the_motion():
    record = example_slice()
    p, R, v, w = wrist_motion(record.time)
    record = dc.replace(record, position=p, rotation=R, velocity=v, angular_velocity=w)
    result = resample(record, 130.0)
    p, R, v, w = wrist_motion(result.time)
    np.testing.assert_allclose(np.diff(result.time), 1.0 / 130.0, atol=1e-12)
    np.testing.assert_allclose(result.position, p, atol=1e-6)
    np.testing.assert_allclose(result.velocity, v, atol=1e-5)
    turn = Rotation.from_matrix(result.rotation.transpose(0, 2, 1) @ R)
    assert turn.magnitude().max() < 1e-5


def test_a_prediction_sees_the_filter_inside_the_sensor():
    record = example_slice()
    record.metadata.sensor.cutoff_frequency = 5.0
    step = np.where(record.time < 1.0, 0.0, 1.0)
    _, seen = as_measured(record.metadata, record.time, step)
    after = record.time[record.time >= 1.0] - 1.0
    exact = 1.0 - np.exp(-2.0 * np.pi * 5.0 * after)
    np.testing.assert_allclose(seen[record.time >= 1.0], exact, atol=0.05)


def test_a_cutoff_beyond_half_the_rate_is_refused():
    with pytest.raises(ConfigurationError, match="cutoff: 300 Hz is not between 0 and half the"):
        low_pass(example_slice(), 300.0)


@pytest.mark.parametrize(("start", "end"), [(0.0, 2.0), (0.5, 3.0)])
def test_a_prediction_of_a_part_is_refused(start, end):
    record = resample(example_slice(), 100.0)
    time = np.arange(start, end, 0.002)
    with pytest.raises(ConfigurationError, match="Predict the whole record"):
        apply_filters(record.metadata.processing, time, np.sin(time))


def test_cropping_keeps_the_clock_and_the_phases():
    result = crop(example_slice(), 0.4, 2.0)
    assert result.time[0] == pytest.approx(0.4) and result.time[-1] == pytest.approx(2.0)
    assert result.metadata.motion.phases[1] == Phase("slice", 0.5, 1.85)
    assert result.metadata.processing[-1].name == "crop"
    with pytest.raises(ConfigurationError, match="0 rows lie between 5 and 6 s"):
        crop(result, 5.0, 6.0)
