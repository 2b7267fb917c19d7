"""A slice record is read as it was written, and means the same in every frame, sign and point."""

import dataclasses as dc
import re
from pathlib import Path

import numpy as np
import pytest
from example_slices import example_slice, wrist_motion
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.metadata import (
    PHASE_LABELS,
    Phase,
    SliceMetadata,
    WrenchFacts,
)
from sliceit_drake.records.slice_record import (
    SliceRecord,
    read_table,
    record_from_table,
    velocities,
    write_record,
)
from sliceit_drake.records.validation import check_record, load_record, load_records


def turning_slice() -> SliceRecord:
    """An example slice whose knife turns about all axes."""
    record = example_slice()
    p, R, v, w = wrist_motion(record.time)
    rng = np.random.default_rng(1)
    return dc.replace(
        record,
        position=p,
        rotation=R,
        velocity=v,
        angular_velocity=w,
        force=rng.normal(size=p.shape),
        torque=rng.normal(size=p.shape),
    )


def test_a_record_comes_back_as_it_was_written(tmp_path):
    record = example_slice()
    record.joints = np.outer(np.sin(record.time), np.arange(6.0))
    record.metadata.unknown = ["knife.edge_radius"]
    file = write_record(record, tmp_path / "session" / record.name)
    back = load_record(file)
    assert back.metadata == record.metadata
    for field in dc.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_allclose(
                getattr(back, field.name), value, rtol=1e-9, atol=1e-9, err_msg=field.name
            )


def test_the_norm_of_the_force_is_enough_for_a_record(tmp_path):
    record = example_slice()
    record = dc.replace(record, force_norm=record.force_magnitude, force=None, torque=None)
    back = load_record(write_record(record, tmp_path / record.name))
    assert back.force is None and back.torque is None
    np.testing.assert_allclose(back.force_magnitude, record.force_norm, rtol=1e-9)


@pytest.mark.parametrize("frame", ["W", "K", "S", "F"])
@pytest.mark.parametrize("sign", ["on_knife", "by_knife"])
@pytest.mark.parametrize("point", ["Ko", "So"])
def test_a_wrench_is_the_same_from_whatever_frame_sign_and_point(frame, sign, point):
    truth = turning_slice()
    table = truth.table()
    metadata = truth.metadata
    metadata.wrench = WrenchFacts(sign=sign, frame=frame, point=point)
    metadata.sensor.position, metadata.sensor.rotation = [0.01, -0.02, -0.2], [0.3, -0.2, 0.9]
    metadata.food.yaw = 0.7
    R_KS = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix()
    R_WE = {
        "W": np.eye(3)[None],
        "K": truth.rotation,
        "S": truth.rotation @ R_KS,
        "F": Rotation.from_euler("z", 0.7).as_matrix()[None],
    }[frame]
    torque = truth.torque
    if point == "So":
        # The torque about So of the same wrench: moved by the arm from So to Ko.
        p_SoKo_W = -truth.rotation @ np.array([0.01, -0.02, -0.2])
        torque = torque + np.cross(p_SoKo_W, truth.force)
    factor = -1.0 if sign == "by_knife" else 1.0
    for names, values in ((fmt.FORCE, truth.force), (fmt.TORQUE, torque)):
        recorded = factor * (R_WE.transpose(0, 2, 1) @ values[:, :, None])[:, :, 0]
        table.columns.update(zip(names, recorded.T, strict=True))
    record = record_from_table(table)
    np.testing.assert_allclose(record.force, truth.force, atol=1e-12)
    np.testing.assert_allclose(record.torque, truth.torque, atol=1e-12)
    assert record.metadata.wrench == WrenchFacts("on_knife", "W", "Ko")
    steps = [step.name for step in record.metadata.processing]
    assert steps == ([] if (frame, sign, point) == ("W", "on_knife", "Ko") else ["express_wrench"])


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        (WrenchFacts(frame="S"), "cucumber_00.yaml: sensor.rotation: is not given, but"),
        (WrenchFacts(point="So"), "sensor.position: is not given, but wrench.point is So"),
        (WrenchFacts(frame="F"), "food.yaw: is not given, but wrench.frame is F"),
    ],
)
def test_a_frame_that_is_not_placed_is_refused(facts, message):
    record = example_slice()
    record.metadata.wrench, record.metadata.food.yaw = facts, None
    with pytest.raises(ConfigurationError, match=message):
        record_from_table(record.table())


def test_a_torque_about_an_unknown_point_is_not_used():
    record = example_slice()
    record.metadata.wrench.point = "unknown"
    assert record_from_table(record.table()).torque is None


def test_velocities_that_are_not_recorded_are_those_of_the_poses():
    time = np.linspace(0.0, 2.0, 1001)
    position, rotation, v, w = wrist_motion(time)
    v_found, w_found = velocities(time, position, rotation)
    # Central differences of 4 ms err by h^2/6 times the third derivative.
    np.testing.assert_allclose(v_found[1:-1], v[1:-1], atol=2e-5)
    np.testing.assert_allclose(w_found[1:-1], w[1:-1], atol=2e-4)


def test_every_row_is_in_the_one_phase_that_begins_there():
    record = example_slice()
    labels = [phase.label for phase in record.metadata.motion.phases]
    masks = np.array([record.phase(label) for label in labels])
    np.testing.assert_array_equal(masks.sum(axis=0), 1)
    assert record.time[record.phase("slice")][0] == 0.5
    np.testing.assert_array_equal(record.phase("air", "hold"), masks[0] | masks[2])
    record.metadata.motion.phases[-1].end = record.time[-1]
    assert record.phase("retract")[-1]


def test_a_part_of_a_record_has_all_its_series_and_its_own_metadata():
    record = example_slice()
    part = record.between(0.5, 0.6)
    assert len(part) == 51 and part.rotation.shape == (51, 3, 3) and part.torque.shape == (51, 3)
    part.metadata.motion.phases[0] = Phase("other", 0.0, 0.1)
    assert record.metadata.motion.phases[0].label == "air"


def test_the_records_of_a_folder_come_in_the_order_in_which_they_were_cut(tmp_path):
    for name, index in (("b", 2), ("a", 2), ("c", 1)):
        record = example_slice()
        record.metadata.name, record.metadata.slice_index = name, index
        write_record(record, tmp_path / name)
    assert [record.name for record in load_records(tmp_path)] == ["c", "a", "b"]
    with pytest.raises(ConfigurationError, match="there are no records"):
        load_records(tmp_path / "none")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("force_x", "Fx", "line 1: Fx: is not a column of a slice record. Columns: time, p_WK_x"),
        ("force_y", "force_x", "line 1: force_x: is there twice"),
        ("\n0.002,", "\n0.002,1,", "line 3: has 21 cells under 20 names"),
        ("\n0.002,", "\n2 ms,", "line 3: time: is '2 ms', which is not a number"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_with_line_and_column(tmp_path, old, new, message):
    file = write_record(example_slice(), tmp_path / "bad")
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as caught:
        read_table(file)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("support: end_slice", "support: end", "support: 'end' is not one of"),
        ("height: 0.059", "height: 59", "line .*knife.height: 59 m is not within.*Is it in mm"),
        ("slice_index: 0", "slice_number: 0", "unknown field.*slice_index"),
        ("start: 0.5", "start: 0.4", "phases.*: 0.4 s is before the end of the last phase, 0.5"),
        ("includes: [food, board]", "includes: [fod]", "includes.*'fod' is not one of food"),
    ],
)
def test_metadata_that_are_wrong_are_refused_with_the_field(tmp_path, old, new, message):
    file = write_record(example_slice(), tmp_path / "bad").with_suffix(".yaml")
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as caught:
        load_record(file)
    assert str(caught.value).startswith(str(file))


def test_the_example_of_the_documentation_is_a_good_record(tmp_path):
    page = (Path(__file__).resolve().parent.parent / "docs/reference/records.md").read_text()
    for kind, fence in (("csv", "text"), ("yaml", "yaml")):
        (text,) = re.findall(rf"```{fence}\n(.*?)```", page, flags=re.DOTALL)
        (tmp_path / f"cucumber_03.{kind}").write_text(text, encoding="utf-8")
    assert check_record(load_record(tmp_path / "cucumber_03.csv")) == []


def test_the_documentation_names_every_column_and_field():
    page = (Path(__file__).resolve().parent.parent / "docs/reference/records.md").read_text()
    words = set(re.findall(r"\w+", page))
    for group in dc.fields(SliceMetadata):
        parts = [group.name]
        if dc.is_dataclass(group.type):
            parts += [field.name for field in dc.fields(group.type)]
        assert set(parts) <= words, group.name
    for label in PHASE_LABELS:
        assert label in words
    for name in fmt.COLUMNS:
        stem, _, axis = name.rpartition("_")
        assert name in words or (stem + "_x") in words or (stem + "_w") in words or stem == "q"


def test_a_time_far_from_zero_is_written_to_the_microsecond(tmp_path):
    record = example_slice()
    record.time = record.time + 1772323200.0
    for phase in record.metadata.motion.phases:
        phase.start, phase.end = phase.start + 1772323200.0, phase.end + 1772323200.0
    table = read_table(write_record(record, tmp_path / "late"))
    np.testing.assert_allclose(table.columns["time"] - record.time, 0.0, atol=1e-6)


def test_a_table_may_begin_with_the_mark_of_utf_8(tmp_path):
    file = write_record(example_slice(), tmp_path / "marked")
    known = read_table(file)
    file.write_text("\ufeff" + file.read_text(encoding="utf-8"), encoding="utf-8")
    np.testing.assert_array_equal(read_table(file).columns["time"], known.columns["time"])
