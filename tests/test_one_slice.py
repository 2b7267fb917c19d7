"""One slice is described, and never diagnosed.

Synthetic records as in test_diagnosis: the sensitivities are given shapes.
"""

import json

import numpy as np
import pytest
from example_slices import short_press
from synthetic_records import COLUMNS, NOISE, record

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.causes.material import SkinToughness
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.one_slice.slice_evidence import (
    LEVEL,
    SliceEvidence,
    estimate_slice_noise,
    slice_evidence,
)
from sliceit_drake.diagnosis.one_slice.slice_fit import depth_blocks, fit_slice
from sliceit_drake.diagnosis.one_slice.slice_result import KIND
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.prediction.noise import MarkovCovariance
from sliceit_drake.prediction.record_target import Meshing
from sliceit_drake.records.slice_record import SliceRecord, write_record

BROAD = Column("cause", "broad", "size", size=1.0)


def evidence(seed: int, replicates: int = 60, broad: float = 0.0, **hidden: float) -> SliceEvidence:
    """Evidence of one synthetic record; `broad` is a cause that all depths tell of."""
    own = record("only", 0.04, np.random.default_rng(seed), hidden, 0.0)
    shape = (np.sin(own.depth / 3e-3) * own.in_contact)[:, None, None]
    own.columns = np.concatenate([own.columns, shape], axis=2)
    own.even = np.zeros_like(own.columns)
    own.measured = own.measured + broad * shape[:, :, 0]
    block = depth_blocks(own.depth, own.in_contact)
    free = own.columns[:, :, :1].astype(float)
    found = Sensitivities([*COLUMNS, BROAD], [own])
    return slice_evidence(found, free, np.array([0.01]), block, replicates)


def test_chance_seldom_looks_like_a_cause():
    """All causes together, so that trying many does not help."""
    smallest = [min(c.p_value for c in evidence(k).causes) for k in range(16)]
    # 0.8 are expected; 4 or more come with a probability of 0.007.
    assert sum(p <= LEVEL for p in smallest) <= 3


@pytest.mark.parametrize(
    ("hidden", "names"),
    [
        ({"skin": 3.0}, {"skin", "skin_like"}),
        ({"fading1.0": 0.8}, {"fading"}),
        ({"broad": 1.0}, {"broad"}),
    ],
)
def test_a_hidden_cause_stands_out(hidden, names):
    best = evidence(1, **hidden).causes[0]
    assert best.name in names and best.p_value <= LEVEL


def test_a_cause_that_does_the_same_is_named_beside():
    best = evidence(1, skin=3.0).causes[0]
    assert {best.name, *best.others} == {"skin", "skin_like"}
    assert evidence(1, broad=1.0).causes[0].others == []


def test_a_cause_that_all_depths_tell_of_predicts_depth_that_was_left_out():
    found = evidence(1, broad=1.0)
    broad = next(c for c in found.causes if c.name == "broad")
    assert broad.held_out < 0.5 * found.held_out
    nothing = evidence(1)
    broad = next(c for c in nothing.causes if c.name == "broad")
    assert broad.held_out > 0.9 * nothing.held_out


def test_what_one_speed_cannot_show_does_not_show():
    rate = next(c for c in evidence(2, rate=3.0).causes if c.name == "rate")
    assert rate.p_value > LEVEL and rate.shows < 1.0


def test_noise_within_the_slice_is_that_of_a_process_beside_what_is_fitted():
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.004, 0.006, 1500))
    draw = MarkovCovariance(np.diff(time), 0.5, 0.08, 0.1).sample(rng)
    X = np.column_stack([np.ones(1500), time])
    noise = estimate_slice_noise(time, draw + X @ [3.0, -2.0], X, np.full(2, 1e-9))
    assert noise.ar == pytest.approx(0.5, rel=0.2)
    assert noise.tau == pytest.approx(0.08, rel=0.35)
    assert noise.white == pytest.approx(0.1, rel=0.2)


def test_blocks_of_depth_are_contiguous_and_cover_all_rows():
    depth = np.linspace(-2e-3, 20e-3, 300)
    block = depth_blocks(depth, depth > 0.0)
    assert block[0] == 0 and (np.diff(block) >= 0).all() and block[-1] == 4
    assert np.ptp(np.bincount(block)[1:]) <= 1


def coarse_food() -> Food:
    return Food(
        name="cucumber",
        shape=Cylinder(0.027, 0.06, 3, [0.0, 0.004, 0.012]),
        hold_distance=0.0119,
    )


def cut(cause: Cause | None = None, **values: float) -> SliceRecord:
    """A simulated record of the short press, with little noise."""
    own = short_press()
    setup = CalibrationSetup(food=coarse_food())
    causes = () if cause is None else (ActiveCause(cause, values),)
    predictor = SlicePredictor(setup, [own], (Meshing(0.5),), workers=1)
    point = Point({"material.toughness": 300.0}, causes=causes)
    ((series,),) = predictor.predict([point])
    (target,) = predictor.targets
    own.force = target.compare(series.wrench[:, :, None])[:, :3, 0]
    own.force = own.force + 0.5 * NOISE * np.random.default_rng(0).normal(size=own.force.shape)
    own.metadata.name = "only"
    return own


def test_a_fit_finds_parameters_and_cause_of_a_simulated_slice():
    cause, values = SkinToughness(), {"toughness": 1.0, "thickness": 1.2e-3}
    own = cut(cause, **values)
    parameters = [ParameterRange("material.toughness", 50.0, 2000.0)]
    setup = CalibrationSetup(food=coarse_food(), parameters=parameters)
    predictor = SlicePredictor(setup, [own], (Meshing(0.5),), workers=1)
    (target,) = predictor.targets
    block = depth_blocks(target.depth, target.depth > 0.0)
    alone = fit_slice(predictor, block)
    both = fit_slice(predictor, block, cause, 1.2e-3)
    rms = [float(np.std(target.measured - f.predicted)) for f in (alone, both)]
    assert rms[1] == pytest.approx(0.5 * NOISE, rel=0.3) and rms[0] > 1.5 * rms[1]
    assert both.values("base")["material.toughness"] == pytest.approx(300.0, rel=0.1)
    assert both.values("cause")["toughness"] == pytest.approx(1.0, rel=0.15)


def test_a_single_record_gets_a_verdict_that_is_no_diagnosis(tmp_path, capsys):
    write_record(cut(SkinToughness(), toughness=1.0, thickness=1.2e-3), tmp_path / "in" / "only")
    dump_yaml(CalibratedFood(food=coarse_food()), tmp_path / "food.yaml")
    command = ["diagnose", str(tmp_path / "in"), "--model", str(tmp_path / "food.yaml")]
    command += ["--output", str(tmp_path / "out"), "--refinement", "0.5", "--replicates", "50"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "one slice, no diagnosis" in said and "at least 3 slices of each condition" in said
    facts = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert facts["verdict"] == KIND and "findings" not in facts and "classes" not in facts
    assert facts["slices_needed_of_each_condition"] == 3 and facts["experiments"]
    assert "It is no diagnosis" in (tmp_path / "out" / "report.html").read_text()
    # What one slice shows must not become a model.
    assert not (tmp_path / "out" / "extended.yaml").exists()
