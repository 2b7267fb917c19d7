"""An extended food, loaded from its file, predicts what was named; what it cannot hold is said."""

import copy
import dataclasses as dc

import numpy as np
import pytest
from cause_bench import bench
from scipy.spatial.transform import Rotation

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.bench_errors import BenchErrors, SensorErrors
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.diagnosis.cause import Cause, CauseParameter
from sliceit_drake.diagnosis.causes import BUILT_IN
from sliceit_drake.diagnosis.evidence.held_out import held_out_gain
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.extension import extended_food, predicting_by
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.records.slice_record import SliceRecord

SEEN_IN = ("fast", "draw", "board", "weight")
CAUSES = [kind() for kind in BUILT_IN]


@pytest.fixture(scope="module")
def predictor() -> SlicePredictor:
    setup, records = bench()
    return SlicePredictor(setup, [r for r in records if r.metadata.condition in SEEN_IN])


def at_size(cause: Cause) -> dict[str, float]:
    """All parameters by their size, at the last value of the scan."""
    values = cause.nulls(cause.scan.values[-1] if cause.scan else None)
    return values | {p.name: p.null + p.step for p in cause.parameters}


def wrenches(predictor: SlicePredictor, point: Point) -> np.ndarray:
    (row,) = predictor.predict([point])
    return np.concatenate([series.wrench for series in row if series is not None])


@pytest.mark.parametrize(
    "cause", [cause for cause in CAUSES if not cause.per_record], ids=lambda cause: cause.name
)
def test_a_file_with_a_cause_predicts_what_the_cause_does(predictor, tmp_path, cause):
    values = at_size(cause)
    food, left = extended_food(predictor.setup, {"material.toughness": 1.1}, [(cause, values)])
    dump_yaml(food, tmp_path / "extended.yaml")
    assert not left
    loaded = load_calibrated_food(tmp_path / "extended.yaml")
    from_file = predictor.of(dc.replace(predictor.setup, food=loaded.food, bench=loaded.bench))
    toughness = 1.1 * predictor.setup.food.material.toughness
    base = Point(values={"material.toughness": toughness})
    without = wrenches(predictor, base)
    named = wrenches(predictor, Point(base.values, causes=(ActiveCause(cause, values),)))
    assert np.abs(named - without).max() > 0.02
    assert wrenches(from_file, Point()) == pytest.approx(named, abs=1e-3)


CUT_IN = {
    "skin": "draw",
    "adhesion": "draw",
    "board_height": "board",
    "sensor_tilt": "draw",
    "tool_weight": "weight",
    "arm_compliance": "board",
}
"""A cause of each family, and the condition beside a press in which it is hidden."""


def hidden(predictor, cause: Cause, seed: int) -> list[SliceRecord]:
    """Three slices of two conditions in which a cause is at work, with noise and variation."""
    rng = np.random.default_rng(seed)
    out, active = [], (ActiveCause(cause, at_size(cause)),)
    for number, target in enumerate(predictor.targets):
        if target.record.metadata.condition not in ("fast", CUT_IN[cause.name]):
            continue
        R_WF = Rotation.from_euler("z", predictor.targets[0].record.metadata.food.yaw or 0.0)
        for k in range(3):
            own = {target.facts.name: {"toughness": float(0.03 * rng.normal())}}
            series = predictor.series(Point(records=own, causes=active), number)
            seen = target.compare(series.wrench) + 0.05 * rng.normal(size=target.measured.shape)
            record = copy.deepcopy(target.record)
            record.force, record.torque = R_WF.apply(seen[:, :3]), None
            record.metadata.name = f"{target.facts.name}_{seed}_{k}"
            out.append(record)
    return out


@pytest.mark.parametrize("name", CUT_IN)
def test_the_gain_that_is_said_is_found_on_other_slices_by_loading_the_file(
    predictor, tmp_path, name
):
    cause = next(c for c in CAUSES if c.name == name)
    setup, values = predictor.setup, at_size(cause)
    food, _ = extended_food(setup, {}, [(cause, values)])
    dump_yaml(food, tmp_path / "extended.yaml")

    first = hidden(predictor, cause, 1)
    problem = LinearProblem(sensitivities(setup, first, [cause], finer=None))
    by_file = predicting_by(problem, SlicePredictor(setup, first), food)
    scan = cause.scan.values[-1] if cause.scan else None
    said = held_out_gain(problem, [(cause.name, scan)], 0, by_file)

    loaded, other = load_calibrated_food(tmp_path / "extended.yaml"), []
    for used in (setup, dc.replace(setup, food=loaded.food, bench=loaded.bench)):
        found = sensitivities(used, hidden(predictor, cause, 2), [], finer=None)
        other.append(held_out_gain(LinearProblem(found), []).after)
    before, after = other
    assert said.before > 1.2 * said.after
    assert after == pytest.approx(said.after, rel=0.1)
    assert before - after == pytest.approx(said.before - said.after, rel=0.1)


def test_a_calibration_refuses_a_bench_that_it_would_not_apply():
    setup, records = bench()
    given = dc.replace(setup, bench=BenchErrors(sensor=SensorErrors(delay=0.01)))
    with pytest.raises(ConfigurationError, match="force of the cut") as error:
        Predictor(given, records[:1])
    assert error.value.field == "bench"


def test_what_differs_from_slice_to_slice_or_is_code_is_not_in_the_file_and_said_so(predictor):
    class Squeak(Cause):
        """A wrench of a user's own."""

        name = "squeak"
        parameters = (CauseParameter("pitch", "N", 1.0),)

        def wrench(self, series, values, facts):
            return series.wrench + values["pitch"]

    causes = [*(c for c in CAUSES if c.per_record), Squeak()]
    food, left = extended_food(predictor.setup, {}, [(c, at_size(c)) for c in causes])
    assert [text.split()[0] for text in left] == ["slip", "vibration", "stick_slip", "squeak"]
    assert "slice to slice" in left[0] and "code" in left[-1]
    assert food.food.effects == predictor.setup.food.effects and food.bench == BenchErrors()


@pytest.mark.parametrize(
    ("text", "field", "fix"),
    [
        ("bench: {sensor: {gain: [0.0, 7.0, 0.0]}}", "bench.sensor.gain[1]", "5"),
        ("bench: {sensor: {tilt: [5.0, 0.0]}}", "bench.sensor.tilt[0]", "degrees"),
        ("bench: {board: {height: 0.5}}", "bench.board.height", "mm"),
        ("bench: {tool: {mas: 0.5}}", "bench.tool", "mass"),
        ("bench: {arm: {compliance: -1e-5}}", "bench.arm.compliance", "0"),
        ("bench: {sensor: {force_bias: [0.0, 1.0]}}", "bench.sensor.force_bias", "3"),
    ],
)
def test_a_bad_value_of_the_bench_is_refused_with_file_field_and_fix(tmp_path, text, field, fix):
    file = tmp_path / "food.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_calibrated_food(file)
    assert "food.yaml" in str(error.value.source)
    assert field in str(error.value.field) and fix in str(error.value)
