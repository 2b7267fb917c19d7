"""Press and draw with the least force, by gradient."""

import dataclasses as dc
import json

import numpy as np
import pytest

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting import motion_optimization
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import PressAndDraw
from sliceit_drake.cutting.motion_optimization import (
    MotionLimits,
    mean_force,
    optimize_motion,
    places,
)
from sliceit_drake.diagrams.scenario import load_scenario
from studies.learning import policy_and_motion

NAMES = ("amplitude", "frequency", "press_speed")


def model_of(friction=0.05, **knife):
    food = Food(
        shape=Cylinder(diameter=0.02, rings=2, layers=[0.0, 0.004, 0.012]),
        material=Material(youngs_modulus=2e6, toughness=300.0, friction=friction),
    )
    return make_food_model(food, Knife(**knife), Numerics(time_step=5e-4))


@pytest.fixture(scope="module")
def adjoint():
    return SliceAdjoint(model_of(), 0.002)


def test_the_gradient_of_the_mean_force_is_that_of_differences(adjoint):
    motion = PressAndDraw(press_speed=0.03, amplitude=0.012, frequency=1.3)
    _, slope = mean_force(adjoint, motion)
    for name, found in zip(NAMES, slope, strict=True):
        h = 0.01 * getattr(motion, name)
        ends = [
            mean_force(adjoint, dc.replace(motion, **{name: getattr(motion, name) + d}))[0]
            for d in (-h, h)
        ]
        assert found == pytest.approx((ends[1] - ends[0]) / (2.0 * h), rel=0.02)


def test_a_faster_draw_lowers_the_force_as_atkins_says():
    # Edge alone: F = R w / sqrt(1 + xi^2), xi the ratio of draw to press; fast enough to pass over
    # many periods, the mean is that over a period. Friction of the flanks would add to it.
    adjoint = SliceAdjoint(model_of(friction=0.0), 0.002)
    press = PressAndDraw(press_speed=0.02, amplitude=0.0, frequency=2.0)
    draw = dc.replace(press, amplitude=0.01)
    phase = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    xi = draw.amplitude * 2.0 * np.pi * draw.frequency / draw.press_speed * np.cos(phase)
    expected = float(np.mean(1.0 / np.sqrt(1.0 + xi**2)))
    ratio = mean_force(adjoint, draw)[0] / mean_force(adjoint, press)[0]
    # The wedge's own part, 12 % of the press, does not fall with the draw as the edge's does.
    assert expected < ratio < 0.88 * expected + 0.12


def test_the_optimum_keeps_its_limits_and_no_neighbour_within_them_is_better():
    model = model_of()
    limits = MotionLimits(duration=1.2, draw_speed=0.1, draw_acceleration=1.5)
    found = optimize_motion(model, limits, iterations=12, starts=1)
    motion, adjoint = found.motion, SliceAdjoint(model, 0.002)
    omega = 2.0 * np.pi * motion.frequency
    assert motion.amplitude * omega <= limits.draw_speed * (1.0 + 1e-6)
    assert motion.amplitude * omega**2 <= limits.draw_acceleration * (1.0 + 1e-6)
    assert motion.amplitude <= limits.amplitude(model) * (1.0 + 1e-9)
    assert motion.distance / motion.press_speed <= limits.duration * (1.0 + 1e-6)
    assert found.force < 0.8 * found.press_force and found.force <= found.start_force
    for name in NAMES:
        for factor in (0.93, 1.07):
            near = dc.replace(motion, **{name: factor * getattr(motion, name)})
            turn = 2.0 * np.pi * near.frequency
            keeps = (
                near.amplitude * turn <= limits.draw_speed
                and near.amplitude * turn**2 <= limits.draw_acceleration
                and near.amplitude <= limits.amplitude(model)
                and motion.distance / near.press_speed <= limits.duration
            )
            if keeps:
                assert mean_force(adjoint, near)[0] > 0.98 * found.force


def test_other_places_to_begin_at_leave_a_local_minimum(monkeypatch):
    # Two valleys along the logarithm of the frequency: a shallow one at 0.6 Hz, a deep one at 3 Hz.
    model, limits = model_of(), MotionLimits()

    def two_valleys(adjoint, motion):
        x = np.log(motion.frequency)
        rows = [(1.0, np.log(0.6), 0.3), (2.0, np.log(3.0), 0.3)]
        value = 5.0 - sum(h * np.exp(-0.5 * ((x - at) / w) ** 2) for h, at, w in rows)
        by_x = sum(h * (x - at) / w**2 * np.exp(-0.5 * ((x - at) / w) ** 2) for h, at, w in rows)
        return value, np.array([0.0, by_x / motion.frequency, 0.0])

    monkeypatch.setattr(motion_optimization, "mean_force", two_valleys)
    monkeypatch.setattr(motion_optimization, "mean_force_alone", lambda adjoint, motion: 5.0)
    seen = []
    once, often = (
        optimize_motion(model, limits, starts=n, progress=lambda *row: seen.append(row))
        for n in (1, 3)
    )
    assert once.motion.frequency == pytest.approx(0.6, rel=0.05)
    assert often.motion.frequency == pytest.approx(3.0, rel=0.05)
    assert often.by_start[0] == once.force and often.force == min(often.by_start)
    assert often.start_force == once.start_force and often.evaluations > once.evaluations
    # The number of slices counts on, and the best never gets worse.
    counts, forces, _ = zip(*seen[once.evaluations :], strict=True)
    assert counts == tuple(range(1, often.evaluations + 1))
    assert list(forces) == sorted(forces, reverse=True)


def test_evolution_finds_the_deepest_valley_within_the_limits(monkeypatch):
    model, limits = model_of(), MotionLimits()
    tried = []

    def force(adjoint, motion):
        tried.append(motion)
        x, y = np.log(motion.frequency / 3.0), np.log(motion.press_speed / 0.02)
        return 5.0 - 2.0 * np.exp(-(x**2) - y**2) + 20.0 * abs(motion.amplitude - 0.002)

    monkeypatch.setattr(policy_and_motion, "mean_force_alone", force)
    least, motion = policy_and_motion.evolve(SliceAdjoint(model, 0.002), limits)
    assert least == pytest.approx(3.0, abs=0.1)
    assert motion.frequency == pytest.approx(3.0, rel=0.15)
    assert motion.press_speed == pytest.approx(0.02, rel=0.15)
    assert len(tried) == 5 * 10 * 7
    assert policy_and_motion.evolve(SliceAdjoint(model, 0.002), limits) == (least, motion)
    tried.clear()
    assert policy_and_motion.drawn(SliceAdjoint(model, 0.002), limits) > least
    assert len(tried) == 5 * 10 * 7


def test_places_to_begin_at_keep_the_limits():
    model, limits = model_of(), MotionLimits(duration=1.2, draw_speed=0.1, draw_acceleration=1.5)
    low, high = limits.ranges(model)
    for shares in (*places(8), np.zeros(3), np.ones(3)):
        motion = limits.motion(model, shares)
        values = np.array([getattr(motion, name) for name in NAMES])
        assert (low - 1e-12 <= values).all() and (values <= high * (1.0 + 1e-12)).all()
        omega = 2.0 * np.pi * motion.frequency
        assert motion.amplitude * omega <= limits.draw_speed * (1.0 + 1e-12)
        assert motion.amplitude * omega**2 <= limits.draw_acceleration * (1.0 + 1e-12)


def test_limits_that_no_motion_keeps_are_named():
    with pytest.raises(ConfigurationError, match="0.02.* m wide.*longer knife"):
        MotionLimits().amplitude(model_of(length=0.03))
    with pytest.raises(ConfigurationError, match="need more than 0.1 m/s"):
        optimize_motion(model_of(), MotionLimits(duration=0.05))


def test_the_command_leaves_a_scenario_that_simulate_takes(tmp_path, capsys):
    small = (
        "{numerics: {time_step: 5.0e-4}, food: {shape: !Cylinder {diameter: 0.02, rings: 2,"
        " layers: [0.0, 0.004, 0.012]}}}"
    )
    out = tmp_path / "out"
    arguments = [
        "optimize-motion",
        "--set",
        small,
        "--output",
        str(out),
        "--iterations",
        "2",
        "--starts",
        "2",
    ]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "N in the mean over the depth" in said
    scenario = load_scenario(out / "scenario.yaml")
    assert scenario.measurement is None  # It is of another motion.
    slicing = scenario.motion.segments[0]
    summary = json.loads((out / "summary.json").read_text())
    assert len(summary["by_start"]) == 2 and min(summary["by_start"]) == summary["force"]
    assert f"from each start: {summary['by_start'][0]:.2f}, " in said
    assert slicing.amplitude == pytest.approx(summary["motion"]["amplitude"])
    assert slicing.distance == pytest.approx(scenario.start.clearance + 0.02 + 2e-4, abs=1e-3)
    assert main(["simulate", str(out / "scenario.yaml"), "--duration", "0.1", "--no-replay",
                 "--output", str(tmp_path / "run")]) == 0  # fmt: skip


def test_a_scenario_without_one_cut_of_finite_elements_is_refused(tmp_path, capsys):
    arguments = ["optimize-motion", "scenarios/cucumber_spring.yaml", "--output", str(tmp_path)]
    assert main(arguments) == 2
    assert "no single cut of finite elements" in capsys.readouterr().err
