"""Sensitivities of slice records to causes: right, found again, and what they can tell apart."""

import dataclasses as dc
import functools
from collections.abc import Mapping

import numpy as np
import pytest
from cause_bench import BOARD, DRAW, TURNED, bench, push

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan
from sliceit_drake.diagnosis.cause import Cause, CauseParameter
from sliceit_drake.diagnosis.causes.contact import BluntEdge, FlankAdhesion
from sliceit_drake.diagnosis.causes.material import SkinToughness, ToughnessBySpeed
from sliceit_drake.diagnosis.causes.mounting import BoardLaw, FoodSlip
from sliceit_drake.diagnosis.causes.sensor import SensorGain
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.experiments.identifiability import ANGLE, Evidence
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor
from sliceit_drake.diagnosis.registry import load_cause
from sliceit_drake.prediction.clock import BLOCK, Clock
from sliceit_drake.prediction.record_target import Meshing
from sliceit_drake.prediction.series import SliceFacts
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import Condition, Protocol, load_protocol
from studies.diagnosis.identifiability import study
from studies.diagnosis.identifiability_page import Study, page_values
from studies.pages import render

Z = 2
EVEN = Clock(longest=1)


def slices(*conditions: str) -> list[SliceRecord]:
    return [r for r in bench()[1] if r.metadata.condition in conditions]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_clock_covers_the_motion_and_doubles_its_step_when_the_food_has_settled():
    clock = Clock(travel=6e-5, longest=8, settling=3)
    moved = np.concatenate([np.full(100, 1e-4), np.zeros(700), np.full(53, 2e-5)])
    stretches = clock.stretches(moved, 3, len(moved))
    ends, m = stretches.ends, stretches.multiples
    assert ends[0] == 3 and len(moved) <= ends[-1] < len(moved) + BLOCK
    assert np.array_equal(np.diff(ends), np.repeat(m, BLOCK))
    assert m.max() == 8
    for k in np.flatnonzero(np.diff(m) > 0) + 1:
        assert m[k] == 2 * m[k - 1] and len(set(m[max(k - 3, 0) : k])) == 1
    way = np.concatenate([[0.0], np.cumsum(moved)])
    steps = np.diff(way[np.minimum(ends, len(moved))])
    assert steps[np.repeat(m, BLOCK) > 1].max() <= 6e-5
    assert (m[ends[:-1:BLOCK] < 100 - BLOCK] == 1).all()


def test_an_uneven_clock_gives_the_forces_and_rates_of_an_even_one():
    setup, _ = bench()
    records = slices("slow")
    points = [
        Point(),
        Point(causes=(ActiveCause(ToughnessBySpeed(), {"exponent": 0.1}),)),
        Point(
            causes=(
                ActiveCause(FlankAdhesion(), {"stress": 0.0, "viscosity": 3e4, "exponent": 1.0}),
            )
        ),
        Point(causes=(ActiveCause(BulkRelaxation(), {"share": 0.3}),)),
    ]
    forces, coupling_steps = [], []
    for clock in (EVEN, Clock()):
        predictor = SlicePredictor(setup, records, [Meshing()], clock)
        rows = predictor.predict(points)
        forces.append([row[0].wrench[:, 3:] for row in rows])
        coupling_steps.append(len(predictor.targets[0].stretches.ends))
    even, uneven = forces
    assert coupling_steps[1] < 0.6 * coupling_steps[0]
    assert rms(uneven[0] - even[0]) < 0.005 * rms(even[0])
    for name, a, b in zip(("rate", "viscosity", "relaxation"), even[1:], uneven[1:], strict=True):
        change = rms(a - even[0])
        assert change > 0.1, name
        assert rms((b - uneven[0]) - (a - even[0])) < 0.1 * change, name


class BulkRelaxation(Cause):
    """The simulator's own relaxation."""

    name = "bulk_relaxation"
    family = "material"
    parameters = (CauseParameter("share", "", 0.3, low=0.0),)
    signature = "decays in a hold"
    experiment = "hold"

    def model(
        self, model: CuttingModel, values: Mapping[str, float], facts: SliceFacts
    ) -> CuttingModel:
        effects = dc.replace(
            model.effects,
            relaxation=dc.replace(model.effects.relaxation, shares=[values["share"]], times=[0.2]),
        )
        return model.derive(effects=effects)


def test_a_board_alone_and_a_known_weight_need_no_food():
    setup, _ = bench()
    records = slices("board", "weight")
    predictor = SlicePredictor(setup, records)
    board, weight = (s.wrench for s in predictor.predict([Point()])[0])
    depth = np.maximum(-predictor.targets[0].p[1:, 2], 0.0)
    held = slice(-40, None)
    assert depth[held].min() > 1e-4
    assert board[held, 5] == pytest.approx(setup.board.stiffness * depth[held], rel=1e-6)
    assert predictor.simulator.simulated == 0
    hanging = np.unique(weight[:, 5].round(9))
    assert hanging == pytest.approx([-9.81, 0.0])


def test_a_column_is_the_change_of_the_prediction():
    setup, _ = bench()
    records = slices("fast")
    s = sensitivities(setup, records, [SkinToughness()], finer=None)
    (record,) = s.records
    predictor = SlicePredictor(setup, records)
    (target,) = predictor.targets
    name, toughness = "material.toughness", setup.food.material.toughness

    def seen(point: Point) -> np.ndarray:
        return target.compare(predictor.predict([point])[0][0].wrench) - record.predicted

    (k,) = s.index("base", name)
    more = seen(Point(values={name: toughness * np.exp(s.columns[k].size)}))
    assert record.columns[:, :, k] + record.even[:, :, k] == pytest.approx(more, abs=1e-4)
    # One slice: what its toughness does is what that of all does.
    (own,) = s.index("record", "toughness")
    assert record.columns[:, :, own] == pytest.approx(record.columns[:, :, k], abs=1e-4)
    (skin,) = s.index("cause", "skin", 1.2e-3)
    values = {"toughness": s.columns[skin].size, "thickness": 1.2e-3}
    skinned = seen(Point(causes=(ActiveCause(SkinToughness(), values),)))
    assert s.columns[skin].one_sided and not record.even[:, :, skin].any()
    assert record.columns[:, :, skin] == pytest.approx(skinned, abs=1e-4)
    (step,) = s.index("numerical", "step")
    finer = SlicePredictor(setup, records, [Meshing(time_step=2.5e-4)])
    halved = finer.targets[0].compare(finer.predict([Point()])[0][0].wrench)
    assert record.columns[:, :, step] == pytest.approx(record.predicted - halved, abs=1e-4)


def test_a_record_is_compared_in_the_air_too_and_by_its_norm_where_no_more_is_known(tmp_path):
    setup, _ = bench()
    (record,) = slices("fast")
    norm = dc.replace(record, force=None, torque=None, force_norm=record.force_magnitude)
    three = dc.replace(record, torque=None)
    for given, channels in ((record, 4), (three, 3), (norm, 1)):
        s = sensitivities(setup, [given], [], finer=None, cache=tmp_path)
        assert s.records[0].predicted.shape == (len(record), channels)
    assert s.records[0].channels == ("force_norm",)
    # Far above the food the blade feels the inertia that couples it to the faces, and no contact.
    assert s.records[0].predicted[s.records[0].phase == "air"][:5].max() < 1e-4
    assert s.records[0].in_contact[s.records[0].phase == "slice"].any()


def test_a_knife_that_starts_in_the_food_is_refused():
    setup, _ = bench()
    (record,) = slices("fast")
    late = record.rows(record.phase("slice") & (record.time > 0.3))
    with pytest.raises(ConfigurationError, match="starts .* mm in the food"):
        sensitivities(setup, [late], [], finer=None)


CAUSE = '''
from sliceit_drake.diagnosis.cause import Cause, CauseParameter

FACTOR = {factor}


class Offset(Cause):
    """An offset."""

    name = "offset"
    family = "sensor"
    parameters = (CauseParameter("size", "N", 1.0),)
    signature = "everywhere"
    experiment = "air"

    def wrench(self, series, values, facts):
        return series.wrench + FACTOR * values["size"]
'''


def test_a_cause_may_be_named_as_what_differs_between_slices():
    columns = [Column("record", "friction", per_record=True), Column("base", "material.friction")]
    columns += [Column("cause", "friction", "share", scan) for scan in (1e-3, 1e-2)]
    found = Sensitivities(columns, [])
    assert found.scans("friction") == [1e-3, 1e-2]
    assert [found.index("cause", "friction", x) for x in found.scans("friction")] == [[2], [3]]


def test_results_are_found_again_until_a_cause_changes(tmp_path):
    setup, _ = bench()
    records = slices("fast", "board")
    ran = []

    def again(factor: float) -> Sensitivities:
        file = tmp_path / "offset.py"
        file.write_text(CAUSE.format(factor=factor))
        ran.clear()
        return sensitivities(
            setup,
            records,
            [load_cause(file), BluntEdge()],
            finer=None,
            cache=tmp_path / "cache",
            progress=lambda done, of: ran.append((done, of)),
        )

    first = again(1.0)
    assert ran[-1][0] == ran[-1][1] > 5
    second = again(1.0)
    assert not ran
    assert second.columns == first.columns
    for a, b in zip(first.records, second.records, strict=True):
        for field in dc.fields(a):
            x, y = getattr(a, field.name), getattr(b, field.name)
            assert np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y, field.name
    third = again(3.0)
    # What was simulated has not changed.
    assert not ran
    (k,) = first.index("cause", "offset")
    change = third.records[0].columns[:, :, k] / first.records[0].columns[:, :, k]
    assert change == pytest.approx(3.0, rel=1e-4)
    moved = [dc.replace(r, force=r.force + 1.0) for r in records]
    other = sensitivities(setup, moved, [BluntEdge()], finer=None, cache=tmp_path / "cache")
    assert other.records[0].residual == pytest.approx(first.records[0].residual, abs=5.0)
    assert not np.array_equal(other.records[0].measured, first.records[0].measured)


def test_what_a_cause_saw_in_a_record_is_kept_for_that_record_alone(tmp_path):
    setup, _ = bench()
    (record,) = slices("fast")
    middle = record.time[record.phase("slice")].mean()

    def knocked(name: str, moment: float) -> SliceRecord:
        force = record.force + np.outer(record.time > moment, [0.0, 3.0, 0.0])
        return dc.replace(record, force=force, metadata=dc.replace(record.metadata, name=name))

    # The same path, so that only the name tells them apart.
    records = [knocked("early", middle - 0.05), knocked("late", middle + 0.05)]
    cache = tmp_path / "cache"
    first, again, afresh = (
        sensitivities(setup, records, [FoodSlip()], finer=None, cache=where)
        for where in (cache, cache, None)
    )
    (knock,) = first.index("cause", "slip", 0.05)[1:2]
    early, late = (r.columns[:, 1, knock] for r in first.records)
    assert abs(np.argmax(np.abs(early)) - np.argmax(np.abs(late))) > 5
    for found in (again, afresh):
        for a, b in zip(first.records, found.records, strict=True):
            assert np.array_equal(a.columns, b.columns)
    moved = [knocked("early", middle + 0.02), knocked("late", middle - 0.02)]
    other = sensitivities(setup, moved, [FoodSlip()], finer=None, cache=cache)
    assert not np.array_equal(other.records[0].columns, first.records[0].columns)


class StepLaw(Cause):
    """A deliberately wrong law: each sub-step takes from the toughness by speed times step."""

    name = "step_law"
    family = "numerical"
    row = 3
    parameters = (CauseParameter("share", "1/m", 5e3),)
    signature = "goes with speed times step"
    experiment = "finer"

    def model(
        self, model: CuttingModel, values: Mapping[str, float], facts: SliceFacts
    ) -> CuttingModel:
        step = facts.speed * model.numerics.time_step
        material = dc.replace(
            model.material, toughness=model.material.toughness * (1.0 + values["share"] * step)
        )
        return model.derive(material=material)


def test_a_law_that_depends_on_the_step_shows_in_the_numerical_column():
    setup = dc.replace(bench()[0], parameters=[])
    records = slices("slow", "fast")
    point = Point(causes=(ActiveCause(StepLaw(), {"share": 5e3}),))
    columns = []
    for at in (Point(), point):
        s = sensitivities(setup, records, [], point=at, finer=None)
        (k,) = s.index("numerical", "step")
        columns.append([r.columns[:, Z, k] for r in s.records])
    cutting = [(r.phase == "slice") & (r.depth > 4e-3) & (r.depth < 0.013) for r in s.records]
    slow, fast = (float((b - a)[rows].mean()) for a, b, rows in zip(*columns, cutting, strict=True))
    # Half the step takes away half of what speed times step adds: 0.012 and 0.04 m/s.
    assert slow > 0.02
    assert fast / slow == pytest.approx(0.04 / 0.012, rel=0.25)


@functools.cache
def protocols() -> Study:
    """A poor protocol, a rich one and a full one, of a coarse cucumber and few slices."""
    food = load_protocol(str(resource_path("calibration/protocols/poor.yaml"))).food
    straight = MotionPlan(
        [
            Hold(0.1, label="air"),
            # Not through, and never at rest in the food.
            ConstantSpeed(distance=0.02, speed=0.03, label="slice"),
        ]
    )
    poor = [Condition("straight", straight, 3)]
    rich = [
        Condition("slow", push(0.012), 2),
        Condition("fast", push(0.04), 2),
        Condition("draw", DRAW, 2, offset=-0.015),
    ]
    full = [
        *rich,
        Condition("peeled", push(0.04), 2, peeled=True),
        Condition("board", BOARD, 2, clearance=-0.02, without_food=True),
        Condition("weight", TURNED, 2, clearance=0.08, without_food=True, weight=1.0),
    ]
    made = [
        Protocol(name=name, food=food, conditions=conditions)
        for name, conditions in (("poor", poor), ("rich", rich), ("full", full))
    ]
    return study(made, CHOSEN)


CHOSEN = [
    ToughnessBySpeed(),
    BluntEdge(),
    SkinToughness(),
    BoardLaw(),
    SensorGain(),
    BulkRelaxation(),
]


def test_confounded_causes_are_parted_by_the_experiments_that_should():
    found = protocols()
    poor, rich, full = found.results
    names = poor.names

    def angle(result, a: str, b: str) -> float:
        i, j = names.index(a), names.index(b)
        return float(min(result.angles[i, j], result.angles[j, i]))

    def shows(result, a: str) -> float:
        return float(result.shows[names.index(a)])

    toughness, friction = "material.toughness", "material.friction"
    # 1 and 2: at one speed without a hold a rate is a toughness.
    assert shows(poor, "toughness_rate") < 3.0 < 10.0 < shows(rich, "toughness_rate")
    assert poor.equivalence_class("toughness_rate") == ["toughness_rate", toughness]
    assert angle(rich, "toughness_rate", "bulk_relaxation") > ANGLE
    # 4 and 6: a push tells friction neither from the modulus nor well; the way out does.
    modulus = "material.youngs_modulus"
    assert angle(poor, friction, modulus) < 60.0 < angle(rich, friction, modulus)
    assert angle(rich, friction, toughness) > angle(poor, friction, toughness)
    # 6 and 17: a gain is a toughness, and on a board its stiffness, until a known weight hangs.
    assert angle(poor, "sensor_gain", toughness) < ANGLE
    assert angle(rich, "sensor_gain", "board_stiffness") < ANGLE
    assert angle(full, "sensor_gain", "board_stiffness") > ANGLE
    assert shows(rich, "sensor_gain") < 0.5 * shows(full, "sensor_gain")
    # 7 and 8: the exit and a draw part them, and skinned food.
    assert angle(poor, "skin", "bluntness") < angle(rich, "skin", "bluntness")
    assert angle(full, "skin", "bluntness") > ANGLE


def test_the_report_names_what_does_not_show_and_what_would_part_it():
    found = protocols()
    text = render("identifiability", **page_values(found))
    (line,) = [
        x for x in text.split("## rich")[0].splitlines() if x.startswith("| `toughness_rate`")
    ]
    assert "does not show" in line and "sd |" in line
    assert all(f"## {name}" in text for name in ("poor", "rich", "full"))


def test_what_is_integrated_out_takes_no_part_in_an_angle():
    found = protocols()
    s = found.found
    record = dc.replace(s.records[0])
    evidence = Evidence(dc.replace(s, records=[record]))
    (k,) = s.index("base", "material.toughness")
    # With one slice its toughness is known to 5 % at best: the column is a standard deviation.
    assert evidence.gram([k], [0])[0, 0] < 1.0
    assert evidence.gram(s.index("cause", "sensor_gain"), [0])[0, 0] > 1.0
