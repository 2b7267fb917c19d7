"""Records made from other formats say what the source said, in the frames of a record."""

import dataclasses as dc
import re
from pathlib import Path

import numpy as np
import pytest
from example_slices import HEIGHT, example_metadata, example_slice, wrist_motion
from scipy.spatial.transform import Rotation

from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.setup import load_setup
from sliceit_drake.cli import records as records_command
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.records.force_table import read_force_table
from sliceit_drake.records.importers import (
    import_force,
    import_frame,
    import_ur_rtde,
    pose_matrix,
)
from sliceit_drake.records.metadata import SliceMetadata, WrenchFacts
from sliceit_drake.records.phases import phases_from_motion
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.records.validation import check_record, load_record, load_records
from sliceit_drake.resources import resource_path

# 30 rows that ur_rtde 1.6.5 wrote of a controller at rest, some of them twice.
RECORDING = Path(__file__).parent / "data" / "ur_rtde_recording.csv"
X_TK = pose_matrix([0.01, -0.02, 0.15], [0.1, -0.3, 0.4])
X_WB = pose_matrix([0.5, -0.4, 0.02], [0.0, 0.0, 2.1])


def write_recording(record: SliceRecord, file: Path) -> None:
    """Writes a record as the robot with X_TK and X_WB would have seen it, with six decimals."""
    X_WK = np.tile(np.eye(4), (len(record), 1, 1))
    X_WK[:, :3, :3], X_WK[:, :3, 3] = record.rotation, record.position
    X_BT = np.linalg.inv(X_WB) @ X_WK @ np.linalg.inv(X_TK)
    R_BW = X_WB[:3, :3].T
    # From Ko to To, in W.
    arm = -record.rotation @ (X_TK[:3, :3].T @ X_TK[:3, 3])
    v_T = record.velocity + np.cross(record.angular_velocity, arm)
    torque_T = record.torque - np.cross(arm, record.force)
    rotvec = Rotation.from_matrix(X_BT[:, :3, :3]).as_rotvec()
    parts = {
        "timestamp": 1234.5 + record.time[:, None],
        "actual_q": np.outer(np.cos(record.time), np.arange(6.0)),
        "actual_TCP_pose": np.column_stack([X_BT[:, :3, 3], rotvec]),
        "actual_TCP_speed": np.column_stack([v_T, record.angular_velocity]) @ twice(R_BW).T,
        "actual_TCP_force": np.column_stack([record.force, torque_T]) @ twice(R_BW).T,
    }
    header = ["timestamp"] + [f"{name}_{i}" for name in list(parts)[1:] for i in range(6)]
    table = np.column_stack(list(parts.values()))
    # The computer's pace is not the controller's: now and then a row comes twice.
    table = np.repeat(table, np.where(np.arange(len(table)) % 7 == 3, 2, 1), axis=0)
    np.savetxt(file, table, fmt="%.6f", delimiter=",", header=",".join(header), comments="")


def twice(R: np.ndarray) -> np.ndarray:
    return np.kron(np.eye(2), R)


def swung_slice() -> SliceRecord:
    record = example_slice()
    p, R, v, w = wrist_motion(record.time)
    torque = np.cross([0.02, 0.01, 0.0], record.force)
    return dc.replace(record, position=p, rotation=R, velocity=v, angular_velocity=w, torque=torque)


def test_a_robots_recording_has_the_knife_and_its_wrench_in_the_world(tmp_path):
    truth = swung_slice()
    write_recording(truth, tmp_path / "run.csv")
    record = import_ur_rtde(tmp_path / "run.csv", truth.metadata, X_TK, X_WB)
    np.testing.assert_allclose(record.time, truth.time, atol=1e-6)
    np.testing.assert_allclose(record.position, truth.position, atol=3e-6)
    np.testing.assert_allclose(record.rotation, truth.rotation, atol=3e-6)
    np.testing.assert_allclose(record.velocity, truth.velocity, atol=3e-6)
    np.testing.assert_allclose(record.angular_velocity, truth.angular_velocity, atol=3e-6)
    np.testing.assert_allclose(record.force, truth.force, atol=3e-6)
    np.testing.assert_allclose(record.torque, truth.torque, atol=1e-4)
    np.testing.assert_allclose(record.joints[:, 5], 5.0 * np.cos(truth.time), atol=1e-6)
    (step,) = record.metadata.processing
    assert step.numbers == {"start": 1234.5, "repeated_rows": 214.0}
    assert record.metadata.wrench.frame == "W"


def test_a_force_by_the_knife_is_turned_round(tmp_path):
    truth = swung_slice()
    write_recording(truth, tmp_path / "run.csv")
    truth.metadata.wrench.sign = "by_knife"
    record = import_ur_rtde(tmp_path / "run.csv", truth.metadata, X_TK, X_WB)
    np.testing.assert_allclose(record.force, -truth.force, atol=3e-6)
    assert record.metadata.wrench.sign == "on_knife"


def test_what_the_library_itself_writes_is_read():
    record = import_ur_rtde(RECORDING, SliceMetadata(), np.eye(4))
    assert record.name == "ur_rtde_recording"
    assert record.metadata.processing[0].numbers["repeated_rows"] == 30 - len(record) > 0
    np.testing.assert_allclose(np.diff(record.time) / 0.002, np.round(np.diff(record.time) / 0.002))
    np.testing.assert_allclose(
        record.joints[0], [0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0], atol=1e-6
    )
    # The tool of this pose points down.
    np.testing.assert_allclose(record.rotation[0] @ [0, 0, 1], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(record.force[0], [1.548741, -0.754905, 2.553751])


def test_a_recording_without_a_needed_variable_is_refused(tmp_path):
    text = RECORDING.read_text(encoding="utf-8").replace("actual_TCP_force", "ft_raw_wrench")
    (tmp_path / "run.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match='run.csv: there is no column "actual_TCP_force_0'):
        import_ur_rtde(tmp_path / "run.csv", SliceMetadata(), X_TK)


def test_a_missing_column_is_no_misspelling_of_another_that_is_read(tmp_path):
    rows = RECORDING.read_text(encoding="utf-8").replace("actual_TCP_speed", "speed")
    (tmp_path / "run.csv").write_text(rows, encoding="utf-8")
    with pytest.raises(ConfigurationError, match='no column "actual_TCP_speed_0"') as error:
        import_ur_rtde(tmp_path / "run.csv", SliceMetadata(), X_TK)
    assert "actual_TCP_pose" not in error.value.fix


def test_phases_of_a_recording_follow_from_its_motion(tmp_path):
    truth = example_slice()
    write_recording(truth, tmp_path / "run.csv")
    metadata = example_metadata()
    metadata.motion.phases = []
    found = import_ur_rtde(tmp_path / "run.csv", metadata, X_TK, X_WB).metadata.motion.phases
    expected = truth.metadata.motion.phases
    assert [phase.label for phase in found] == [phase.label for phase in expected]
    for phase, other in zip(found, expected, strict=True):
        assert phase.start == pytest.approx(other.start, abs=0.005)
        assert phase.end == pytest.approx(other.end, abs=0.005)


def test_no_phases_are_made_up_where_the_food_is_not_placed():
    record = example_slice()
    record.metadata.food.position = None
    assert phases_from_motion(record.metadata, record.time, record.position[:, 2]) == []
    record.metadata.food.position = [0.0, 0.0, 0.5]  # The knife starts inside.
    assert phases_from_motion(record.metadata, record.time, record.position[:, 2]) == []


def test_a_press_without_withdrawal_is_air_and_slice():
    record = example_slice().between(0.0, 1.8)
    phases = phases_from_motion(record.metadata, record.time, record.position[:, 2])
    assert [(phase.label, phase.end) for phase in phases][-1] == ("slice", record.time[-1])
    assert len(phases) == 2


@pytest.mark.parametrize("food", ["cucumber", "tomato", "potato"])
def test_the_shipped_records_are_the_digitised_curves(food):
    record = load_record(resource_path(f"calibration/records/{food}.csv"))
    profile = load_force_profile(
        resource_path(f"calibration/measured/sliceit_real_{food}_force.csv")
    )
    np.testing.assert_allclose(record.time, profile.time[profile.is_read])
    np.testing.assert_allclose(record.force_norm, profile.force[profile.is_read])
    np.testing.assert_allclose(record.velocity, [[0.0, 0.0, -0.02]] * len(record), atol=1e-9)
    assert {"p_WK_z", "food.support", "motion.speed"} <= set(record.metadata.unknown)
    # Rows between the dashes are left out, and said to be.
    assert {finding.kind for finding in check_record(record)} <= {"dropout"}


def test_the_shipped_records_are_what_the_program_makes(tmp_path):
    folder = resource_path("calibration/records")
    for record in load_records(folder):
        curve = resource_path(f"calibration/measured/sliceit_real_{record.name}_force.csv")
        metadata = folder / f"{record.name}.yaml"
        arguments = ["--metadata", str(metadata), "--contact", "0.15", "--output", str(tmp_path)]
        assert main(["records", "import", "profile", str(curve), *arguments]) == 0
        for suffix in ("csv", "yaml"):
            made = tmp_path / f"{record.name}.{suffix}"
            assert made.read_text() == (folder / made.name).read_text(), made.name


def table_of(force) -> str:
    """A table at 100 Hz of a force that is a function of time."""
    times = np.arange(181) / 100.0
    return "".join(f"{t:.2f},{force(t):.5f}\n" for t in times)


CURVE = table_of(lambda t: 8.0 * np.interp(t, [0.0, 0.5, 0.7, 1.8], [0.0, 0.0, 1.0, 1.3]))


def facts() -> SliceMetadata:
    metadata = example_metadata()
    metadata.motion.phases = []
    return metadata


@pytest.mark.parametrize("header", ["", "t [s],load\n"])
def test_two_columns_and_a_speed_make_a_record(tmp_path, header):
    truth = example_slice().between(0.0, 1.8)
    rows = [f"{t:.4f},{f:.5f}" for t, f in zip(truth.time, truth.force_magnitude, strict=True)]
    (tmp_path / "scale.csv").write_text(header + "\n".join(rows) + "\n", encoding="utf-8")
    metadata = dc.replace(facts(), name="")
    record = import_force(tmp_path / "scale.csv", metadata, contact=0.5)
    assert record.name == "scale" and record.force is None
    np.testing.assert_allclose(record.force_norm, truth.force_magnitude, atol=1e-5)
    # Press at 20 mm/s with a draw of half of it along the edge, from 1 mm above the food.
    np.testing.assert_allclose(record.velocity, [[0.01, 0.0, -0.02]] * len(record), atol=1e-9)
    assert record.position[0, 2] == pytest.approx(0.02 + HEIGHT + 1e-3)
    assert "p_WK_z" in record.metadata.unknown
    assert record.phase("air").sum() == 250
    assert [str(finding) for finding in check_record(record)] == []


@pytest.mark.parametrize("sign", ["on_knife", "by_knife"])
def test_a_vertical_force_keeps_its_sign(tmp_path, sign):
    truth = example_slice().between(0.0, 1.8)
    up = truth.force[:, 2] * (1.0 if sign == "on_knife" else -1.0)
    np.savetxt(tmp_path / "scale.csv", np.column_stack([truth.time, up]), delimiter=",")
    metadata = dc.replace(facts(), wrench=WrenchFacts(sign=sign, tared="yes"))
    record = import_force(tmp_path / "scale.csv", metadata, component="vertical", contact=0.5)
    np.testing.assert_allclose(record.force_vertical, truth.force[:, 2])
    assert [str(finding) for finding in check_record(record)] == []


def test_a_vertical_force_is_compared_in_one_channel_and_none_is_invented(tmp_path):
    truth = example_slice().between(0.0, 1.8)
    rows = np.column_stack([truth.time, -truth.force[:, 2]])
    np.savetxt(tmp_path / "scale.csv", rows, delimiter=",")
    metadata = dc.replace(facts(), wrench=WrenchFacts(sign="by_knife", tared="yes"))
    made = import_force(tmp_path / "scale.csv", metadata, component="vertical", contact=0.5)
    assert made.force is None
    record = load_record(write_record(made, tmp_path / "made"))
    np.testing.assert_allclose(record.force_vertical, truth.force[:, 2])
    setup = load_setup("cucumber")
    (target,) = Predictor(setup, [record], workers=1).targets
    assert target.channels == ("force_z",) and target.measured.shape[1] == 1
    wrench = np.arange(6.0 * (len(target.grid) - 1)).reshape(-1, 6)
    seen = target.compare(wrench)
    assert seen.shape == target.measured.shape
    # The adjoint is that of the comparison.
    force = wrench[target.coupling_steps[1:] - 1, 3:]
    weights = np.random.default_rng(0).normal(size=target.measured.shape)
    back = target.adjoint(force, weights)
    assert (weights * target.compare_forces(force)).sum() == pytest.approx((back * force).sum())
    assert not back[:, :2].any()


def test_an_upside_down_vertical_force_is_found(tmp_path):
    truth = example_slice().between(0.0, 1.8)
    rows = np.column_stack([truth.time, -truth.force[:, 2]])
    np.savetxt(tmp_path / "scale.csv", rows, delimiter=",")
    metadata = dc.replace(facts(), wrench=WrenchFacts(tared="yes"))
    made = import_force(tmp_path / "scale.csv", metadata, component="vertical", contact=0.5)
    (finding,) = check_record(made)
    assert "force_vertical: the force on the knife drives it" in str(finding)
    assert "Write wrench.sign: by_knife" in str(finding)


def test_a_vertical_force_is_tared_by_the_mean_in_the_air(tmp_path):
    truth = example_slice().between(0.0, 1.8)
    rows = np.column_stack([truth.time, truth.force[:, 2] + 3.0])
    np.savetxt(tmp_path / "scale.csv", rows, delimiter=",")
    said = dc.replace(facts(), wrench=WrenchFacts(tared="yes"))
    made = import_force(tmp_path / "scale.csv", said, component="vertical", contact=0.5)
    assert [finding.kind for finding in check_record(made)] == ["no tare"]
    unsaid = dc.replace(facts(), wrench=WrenchFacts())
    record = import_force(tmp_path / "scale.csv", unsaid, component="vertical", contact=0.5)
    assert abs(record.force_vertical[record.phase("air")].mean()) < 1e-9
    assert record.metadata.processing[-1].numbers == {"force_vertical": pytest.approx(3.0, abs=0.1)}
    assert [str(finding) for finding in check_record(record)] == []


@pytest.mark.parametrize(
    ("text", "change", "message"),
    [
        ("0,1,2\n", {}, "scale.csv: --columns: has 3 columns, 1, 2, 3. Name two, of time and"),
        ("0,1\n1,x\n", {}, "scale.csv, line 2: 2: is 'x', which is not a finite number"),
        ("t,f\n1,x\n", {}, "scale.csv, line 2: f: is 'x', which is not a finite number"),
        ("t,f\n1,1\n0,1\n", {}, "scale.csv: t: row 2 has 0 after 1. Sort the rows"),
        ("t,f\n0,1\n5,1\n", {}, "t: its rows are 5 s apart.* Is it in ms. Give --units ms N"),
        ("t (ms),f [stone]\n0,1\n", {"units": ["ms", "stone"]}, "'stone' is no unit of force"),
        ("t [s],U [mV]\n0,1\n", {}, r"scale.csv: U \[mV\]: 'mV' is no known unit of force"),
        (CURVE, {"size": None}, "food.size: is not given, but the motion of"),
        (CURVE, {"contact": 3.0}, "contact: 3 s is not within the record, 0 to 1.8 s"),
        (CURVE, {"component": "sideways"}, "component: 'sideways' is no component"),
        (CURVE, {"component": "components"}, "components goes with 3 columns of force"),
        (CURVE, {"between": [1.0, 1.01]}, "1 to 1.01 s holds 2 rows of the table, which has 0 to"),
        (CURVE, {"speed": 0.05}, "0.05 m/s brings the knife 64 mm down in the 1.29 s from the"),
        (table_of(lambda t: 0.05 * np.cos(900.0 * t)), {}, "force: never rises: it stays within"),
        (
            table_of(lambda t: 9.0 * np.interp(t % 0.9, [0.3, 0.31, 0.5, 0.51], [0, 1, 1, 0])),
            {},
            "holds 2 slices, 0.31 to 0.5 s, 1.21 to 1.4 s. Import each by itself",
        ),
    ],
)
def test_a_force_that_makes_no_record_is_refused(tmp_path, text, change, message):
    (tmp_path / "scale.csv").write_text(text, encoding="utf-8")
    metadata, options = facts(), dict(change)
    metadata.motion.speed = options.pop("speed", 0.02)
    metadata.food.size = options.pop("size", metadata.food.size)
    with pytest.raises(ConfigurationError, match=message):
        import_force(tmp_path / "scale.csv", metadata, **options)


def slice_in_air_and_food(rate: float = 500.0, offset: float = 0.0) -> np.ndarray:
    """Time and vertical force of a slice of 27 mm at 20 mm/s, with noise, at a rate [n, 2]."""
    t = np.arange(0.0, 1.8, 1.0 / rate)
    up = 8.0 * np.interp(t, [0.5, 0.7, 1.8], [0.0, 1.0, 1.3])
    return np.column_stack([t, up + offset + 0.02 * np.random.default_rng(0).normal(size=len(t))])


@pytest.mark.parametrize("rate", [60.0, 1000.0])
def test_the_contact_is_found_at_any_rate_and_the_rate_is_noted(tmp_path, rate):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(rate, -3.0), delimiter=",", fmt="%.7f")
    metadata = facts()
    metadata.sensor.rate, metadata.wrench = None, WrenchFacts()
    record = import_force(tmp_path / "a.csv", metadata, component="vertical")
    air, cut = record.metadata.motion.phases
    assert air.end == pytest.approx(0.5, abs=0.03) and cut.label == "slice"
    assert record.metadata.sensor.rate == pytest.approx(rate, rel=0.01)
    assert abs(record.force_vertical[record.phase("air")].mean()) < 1e-6
    (target,) = Predictor(load_setup("cucumber"), [record], workers=1).targets
    assert np.isfinite(target.measured).all() and abs(target.depth[-1] - 0.026) < 1.5e-3


@pytest.mark.parametrize("first", [0.2, 0.55])
def test_the_contact_is_found_with_few_rows_before_it_and_not_where_there_are_none(tmp_path, first):
    """Of a sensor of 20 Hz: 0.3 s in the air, or none."""
    rows = slice_in_air_and_food(20.0)
    np.savetxt(tmp_path / "a.csv", rows[rows[:, 0] > first - 1e-9], delimiter=",", fmt="%.5f")
    metadata = facts()
    metadata.motion.speed = None
    record = import_force(tmp_path / "a.csv", metadata, component="vertical")
    assert [p.label for p in record.metadata.motion.phases] == ["air", "slice"][first > 0.5 :]
    assert first > 0.5 or record.metadata.motion.phases[1].start == pytest.approx(0.5, abs=0.051)
    if first > 0.5:
        metadata.motion.speed = 0.03
        with pytest.raises(ConfigurationError, match="first to the last row.* give --contact S"):
            import_force(tmp_path / "a.csv", metadata, component="vertical")


@pytest.mark.parametrize(
    ("header", "separator", "decimal"),
    [
        ("Zeit (ms);Kraft (kN)\n", ";", ","),
        ("time\tforce\n(ms)\t(kN)\n", "\t", "."),
        ("t_ms   F_kN\n", "   ", ","),
        ("\ufefft_ms, F_kN\n", ", ", "."),
    ],
)
def test_units_and_separators_of_other_labs_are_read(tmp_path, header, separator, decimal):
    known = slice_in_air_and_food()
    rows = [
        separator.join(f"{x:.9f}".replace(".", decimal) for x in (1e3 * t, 1e-3 * f))
        for t, f in known
    ]
    (tmp_path / "a.csv").write_text(header + "\n".join(rows), encoding="utf-8")
    record = import_force(tmp_path / "a.csv", facts(), component="vertical")
    np.testing.assert_allclose(record.time, known[:, 0], atol=1e-9)
    assert record.force_vertical[-1] == pytest.approx(known[-1, 1], abs=0.02)


def test_decimal_commas_in_quotation_marks_separate_no_cells(tmp_path):
    rows = '"time","force"\n"0,002","1,5"\n"0,004","-2,5"\n'
    (tmp_path / "a.csv").write_text(rows, encoding="utf-8")
    table = read_force_table(tmp_path / "a.csv")
    np.testing.assert_allclose(table.time, [0.002, 0.004])
    np.testing.assert_allclose(table.force[:, 0], [1.5, -2.5])


@pytest.mark.parametrize("encoding", ["utf-16", "cp1252"])
def test_a_table_in_another_encoding_is_to_be_saved_as_utf_8(tmp_path, encoding):
    (tmp_path / "a.csv").write_text("t,Kraft für N\n0,1\n", encoding=encoding)
    for read in (read_force_table, lambda file: import_ur_rtde(file, SliceMetadata(), X_TK)):
        with pytest.raises(ConfigurationError, match="a.csv: .*not UTF-8.* Save it as UTF-8"):
            read(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("header", "unit", "newtons"),
    [
        ("Time (s),Load (lbs)", "lbs", 4.4482216),
        ("Time (s),Load (cN)", "cN", 0.01),
        ("t / seconds,F(t) / daN", "daN", 10.0),
        ("Time [s],Force [Newton]", "Newton", 1.0),
        ("t_s,F_min", None, 1.0),
        ("t_s,F_s", None, 1.0),
        ("Time,Force (filtered)\ns,N", "N", 1.0),
    ],
)
def test_a_unit_of_force_in_the_header_is_taken_or_there_is_none(tmp_path, header, unit, newtons):
    (tmp_path / "a.csv").write_text(f"{header}\n0,1\n0.01,2\n", encoding="utf-8")
    table = read_force_table(tmp_path / "a.csv")
    assert table.units[1] == unit
    np.testing.assert_allclose(table.force[:, 0], [newtons, 2.0 * newtons])


def test_the_time_of_a_clock_counts_from_the_first_row_and_no_row_is_lost(tmp_path, capsys):
    known = slice_in_air_and_food()
    rows = "".join(f"{1772323200.0 + t:.4f},{f:.9f}\n" for t, f in known)
    (tmp_path / "a.csv").write_text("timestamp,force\n" + rows, encoding="utf-8")
    command = ["records", "import", "force", str(tmp_path / "a.csv"), "--component", "vertical"]
    command += ["--shape", "cylinder", "--size", "0.027", "0.12", "0.027", "--name", "b"]
    assert main([*command, "--output", str(tmp_path), "--between", "0.2", "2"]) == 0
    said = capsys.readouterr().out
    assert "The force begins at 0.5" in said and "times count from its first row" in said
    record = load_record(tmp_path / "b.csv")
    np.testing.assert_allclose(record.time, known[100:, 0], atol=1e-6)
    assert record.metadata.processing[0].numbers["start"] == 1772323200.0
    with pytest.raises(ConfigurationError, match="in seconds of the table after its first row"):
        import_force(tmp_path / "a.csv", facts(), between=[1772323200.2, 1772323202.0])


def test_components_in_the_knifes_axes_become_those_of_the_world(tmp_path):
    known = slice_in_air_and_food()
    table = np.column_stack([known[:, 0], 0.1 * known[:, 1], 0.0 * known[:, 1], -known[:, 1]])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t,Fx,Fy,Fz,", comments="")
    metadata = dc.replace(facts(), wrench=WrenchFacts(frame="K", tared="yes"))
    record = import_force(tmp_path / "a.csv", metadata, component="components")
    np.testing.assert_allclose(record.force[:, 2], known[:, 1], atol=1e-9)


def test_a_record_that_begins_in_the_food_is_predicted_from_above_it(tmp_path):
    whole = slice_in_air_and_food()
    np.savetxt(tmp_path / "whole.csv", whole, delimiter=",")
    np.savetxt(tmp_path / "cropped.csv", whole[280:], delimiter=",")
    setup = load_setup("cucumber")
    ends = []
    for name in ("whole", "cropped"):
        record = import_force(tmp_path / f"{name}.csv", facts(), component="vertical")
        (target,) = Predictor(setup, [record], workers=1).targets
        assert target.p[0, 2] >= target.home[2] + 2e-3
        ends.append(target.depth[-1])
    # It began 1.2 mm below the top, which follows from how its force rises.
    assert record.metadata.motion.phases[0].label == "slice"
    assert target.grid[0] < record.time[0] - 0.1
    assert ends[1] == pytest.approx(ends[0], abs=3e-4)


def test_a_speed_that_is_not_known_follows_from_the_height_and_is_fitted(tmp_path):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(), delimiter=",")
    metadata = facts()
    metadata.motion.speed, metadata.food.size = None, [0.027, 0.12, 0.026]
    record = import_force(tmp_path / "a.csv", metadata, component="vertical")
    assert record.metadata.motion.speed == pytest.approx(0.02, rel=0.03)
    assert "motion.speed" in record.metadata.unknown


def test_a_script_says_by_options_what_the_table_does_not(tmp_path, capsys):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(), delimiter=",")
    command = ["records", "import", "force", str(tmp_path / "a.csv"), "--output", str(tmp_path)]
    command += ["--component", "vertical", "--name", "radish_1"]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert "--shape and --size: is not given: its shape: cylinder" in said
    command += ["--shape", "cylinder", "--food", "radish", "--speed", "0.02"]
    assert main([*command, "--size", "27", "120", "27"]) == 2
    assert "Is it in mm? Write 0.027" in capsys.readouterr().err
    assert main([*command, "--size", "0.027", "0.12", "0.027"]) == 0
    said = capsys.readouterr().out
    assert "The force begins at 0.5" in said and "The mean force before that is taken off" in said
    assert said.count("warning") == 0
    metadata = load_record(tmp_path / "radish_1.csv").metadata
    assert metadata.food.name == "radish" and metadata.food.size == [0.027, 0.12, 0.027]
    assert {"food.support", "food.slice_thickness", "provenance"} <= set(metadata.unknown)


@pytest.mark.parametrize("name", ["..", "a/b", "../mine"])
def test_a_record_is_not_imported_under_a_name_that_leads_elsewhere(name, tmp_path, capsys):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(), delimiter=",")
    command = ["records", "import", "force", str(tmp_path / "a.csv")]
    command += ["--output", str(tmp_path / "records"), "--name", name, "--component", "vertical"]
    command += ["--shape", "cylinder", "--food", "radish", "--speed", "0.02"]
    assert main([*command, "--size", "0.027", "0.12", "0.027"]) == 2
    assert f"{name!r} is no name for a record. Give --name NAME" in capsys.readouterr().err
    assert [file.name for file in tmp_path.rglob("*.csv")] == ["a.csv"]


def test_the_page_makes_a_record_of_a_table_with_other_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = "calibration/measured/sliceit_real_potato_force.csv"
    command = ["records", "import", "force", file, "--columns", "time_s", "F_ground_truth_N"]
    command += ["--name", "potato_1", "--component", "norm", "--food", "potato"]
    command += ["--shape", "cylinder", "--size", "0.04", "0.08", "0.04"]
    assert main([*command, "--output", "records/potato"]) == 0
    said = capsys.readouterr().out
    assert "The force begins at 0.16 s" in said and "0.0217 m/s would bring the knife to" in said
    assert "names no unit" not in said
    assert main(["records", "check", "records/potato"]) == 0
    assert "potato_1.csv: nothing found" in capsys.readouterr().out


def test_at_a_terminal_one_question_comes_after_the_other(tmp_path, capsys, monkeypatch):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(), delimiter=",")
    answers = iter(
        ["vertical", "radish", "round", "cylinder", "", "0.027 0.12 0.027", "20", "0.02"]
        + ["", "", "", "my kitchen"]
    )
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text) or next(answers))
    command = ["records", "import", "force", str(tmp_path / "a.csv"), "--output", str(tmp_path)]
    assert main([*command, "--name", "b"]) == 0
    assert len(asked) == 12 and asked[-1].startswith("Where the curve is from")
    said = capsys.readouterr().out
    assert "'round' is not one of" in said and "20 m/s is not within" in said
    metadata = load_record(tmp_path / "b.csv").metadata
    assert metadata.provenance == "my kitchen" and metadata.motion.speed == 0.02


@pytest.mark.parametrize(("answers", "option"), [([], "component"), (["norm", "radish"], "shape")])
def test_input_that_ends_at_a_question_names_its_option(
    tmp_path, capsys, monkeypatch, answers, option
):
    np.savetxt(tmp_path / "a.csv", slice_in_air_and_food(), delimiter=",")
    left = list(answers)

    def answer(_: str) -> str:
        if not left:
            raise EOFError
        return left.pop(0)

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", answer)
    command = ["records", "import", "force", str(tmp_path / "a.csv"), "--output", str(tmp_path)]
    assert main([*command, "--name", "b"]) == 2
    assert f"--{option}: is not given: the input ended. Answer, or" in capsys.readouterr().err


class Column:
    """As much of a pandas Series as the importer needs."""

    def __init__(self, values):
        self.values = values

    def to_numpy(self):
        return self.values


class Frame:
    """As much of a pandas DataFrame as the importer needs."""

    def __init__(self, columns):
        self.columns = list(columns)
        self._columns = columns

    def __getitem__(self, name):
        return Column(self._columns[name])


def test_a_table_in_memory_makes_a_record():
    truth = example_slice()
    columns = dict(truth.table().columns)
    columns["t"], columns["Fz"] = columns.pop("time"), columns.pop("force_z")
    columns["comment"] = np.array(["ok"] * len(truth))
    record = import_frame(Frame(columns), truth.metadata, {"time": "t", "force_z": "Fz"})
    np.testing.assert_array_equal(record.time, truth.time)
    np.testing.assert_array_equal(record.force, truth.force)
    np.testing.assert_array_equal(record.torque, truth.torque)
    assert [str(finding) for finding in check_record(record)] == []


@pytest.mark.parametrize(
    ("drop", "rename", "message"),
    [
        ("p_WK_y", {}, "cucumber_00: p_WK_y: the column is missing. Name it in columns"),
        ("force_x", {}, "cucumber_00: force_x: the column is missing"),
        ("force_x", {"force_x": "Fx"}, "cucumber_00: force_x: there is no column 'Fx'. There are:"),
        ("force_x", {"Fx": "time"}, "there is no column 'Fx'. There are: time, p_WK_x"),
        ("force_x", {"force_x": "words"}, "cucumber_00: words: holds no numbers"),
    ],
)
def test_a_table_in_memory_that_lacks_something_is_refused(drop, rename, message):
    columns = dict(example_slice().table().columns)
    del columns[drop]
    columns["words"] = np.array(["a"] * len(columns["time"]))
    with pytest.raises(ConfigurationError, match=message):
        import_frame(Frame(columns), example_metadata(), rename)


def test_the_program_imports_a_recording_and_says_what_is_wrong(tmp_path, capsys):
    truth = example_slice()
    truth.force = -truth.force
    write_recording(truth, tmp_path / "run.csv")
    dump_yaml(facts(), tmp_path / "facts.yaml")
    pose = ["0.01", "-0.02", "0.15", "0.1", "-0.3", "0.4"]
    arguments = ["records", "import", "ur_rtde", str(tmp_path / "run.csv")]
    arguments += ["--metadata", str(tmp_path / "facts.yaml"), "--output", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "--tcp-to-knife: is not given. Give the pose of the knife" in capsys.readouterr().err
    degrees = [*pose[:3], "180", "0", "0"]
    assert main([*arguments, "--tcp-to-knife", *degrees]) == 2
    assert "--tcp-to-knife: 180 0 0 is more than a turn. Give ROLL" in capsys.readouterr().err
    base = ["0.5", "-0.4", "0.02", "0", "0", "2.1"]
    arguments += ["--tcp-to-knife", *pose, "--world-to-base", *base, "--name", "flipped"]
    assert main(arguments) == 1
    out = capsys.readouterr().out
    assert f"{tmp_path / 'out' / 'flipped.csv'} and .yaml: 1500 rows" in out
    assert "flipped.csv, lines 252 to 92" in out and "Write wrench.sign: by_knife" in out
    text = (tmp_path / "facts.yaml").read_text().replace("sign: on_knife", "sign: by_knife")
    (tmp_path / "facts.yaml").write_text(text)
    assert main(arguments[:-1] + ["right"]) == 0
    assert main(["records", "check", str(tmp_path / "out")]) == 1
    out = capsys.readouterr().out
    assert f"{tmp_path / 'out' / 'right.csv'}: nothing found" in out
    assert "2 records, 1 with errors" in out
    assert main(["records", "check", str(tmp_path / "out" / "right.csv")]) == 0


def test_the_pose_that_the_help_gives_brings_the_edge_down(tmp_path, capsys):
    """With a tool whose z points down, as a UR5e's over its board."""
    (words,) = set(re.findall(r"--tcp-to-knife ((?:\S+ ){5}\S+)", records_command.IMPORT))
    X_TK = pose_matrix([float(x) for x in words.split()[:3]], [float(x) for x in words.split()[3:]])
    record = import_ur_rtde(RECORDING, SliceMetadata(), X_TK)
    assert (record.rotation[:, 2, 2] < -0.99).all()


def import_by_hand(folder: Path, rows: np.ndarray, capsys, *options: str) -> tuple[int, str]:
    """Status of an import, and what it says."""
    np.savetxt(folder / "scale.csv", rows, delimiter=",")
    words = ["--shape", "cylinder", "--size", "0.027", "0.12", "0.027", *options]
    words += ["--output", str(folder / "records"), "--replace"]
    status = main(["records", "import", "force", str(folder / "scale.csv"), *words])
    return status, capsys.readouterr().out


def test_an_import_writes_over_no_measurement_and_over_no_record_unasked(tmp_path, capsys):
    for day, scale in (("mon", 1.0), ("tue", 1.1)):
        (tmp_path / day).mkdir()
        rows = slice_in_air_and_food() * [1.0, scale]
        np.savetxt(tmp_path / day / "cut1.csv", rows, delimiter=",")

    def imported(day: str, output: str, *more: str) -> str:
        words = ["--component", "vertical", "--shape", "cylinder", "--size", "0.027", "0.12"]
        words += ["0.027", "--output", str(tmp_path / output), *more]
        main(["records", "import", "force", str(tmp_path / day / "cut1.csv"), *words])
        return capsys.readouterr().err

    raw = (tmp_path / "mon" / "cut1.csv").read_bytes()
    for more in ((), ("--replace",)):
        assert "Give another --output, or --name NAME" in imported("mon", "mon", *more)
    assert [f.read_bytes() for f in (tmp_path / "mon").iterdir()] == [raw]
    assert imported("mon", "records") == ""
    first = (tmp_path / "records" / "cut1.csv").read_bytes()
    said = imported("tue", "records")
    assert "cut1.csv: is there already. Give --name NAME to keep both, or --replace" in said
    assert (tmp_path / "records" / "cut1.csv").read_bytes() == first
    assert imported("tue", "records", "--name", "cut2") == ""
    assert imported("tue", "records", "--replace") == ""
    assert (tmp_path / "records" / "cut1.csv").read_bytes() != first


def test_a_spike_above_all_forces_does_not_hide_the_contact(tmp_path, capsys):
    rows = slice_in_air_and_food()
    rows[[20, 600], 1] = -500.0, 2000.0
    said = import_by_hand(tmp_path, rows, capsys, "--component", "vertical", "--speed", "0.02")[1]
    begins = float(re.search(r"The force begins at (\S+) s", said)[1])
    assert begins == pytest.approx(0.5, abs=0.02)
    assert "2 rows far from those before and after" in said
    assert "is level" not in said


@pytest.mark.parametrize("level", [10.0, 0.0])
def test_a_knife_that_stands_or_leaves_at_the_end_is_asked_about(tmp_path, capsys, level):
    rows = slice_in_air_and_food()
    rest = np.column_stack([np.arange(1.8, 3.0, 2e-3), np.full(600, level)])
    rest[:, 1] += 0.02 * np.random.default_rng(1).normal(size=600)
    said = import_by_hand(tmp_path, np.vstack([rows, rest]), capsys, "--component", "vertical")[1]
    assert re.search(r"force_vertical: the force is level at .* from 1\.\d+ s to the end", said)
    assert "import it again with --between START END" in said
    whole = import_by_hand(tmp_path, rows, capsys, "--component", "vertical")[1]
    assert "is level" not in whole


def test_a_vertical_force_that_is_taken_for_a_norm_is_told_from_one(tmp_path, capsys):
    rows = slice_in_air_and_food() * [1.0, -1.0]
    status, said = import_by_hand(tmp_path, rows, capsys, "--speed", "0.02")
    assert status == 1 and "a norm is -" in said
    assert "import it again with --component vertical (and --sign by_knife if" in said


def test_a_slice_that_ends_far_from_the_board_is_asked_about(tmp_path, capsys):
    rows = slice_in_air_and_food()
    options = ("--component", "vertical", "--speed")
    assert "correct --speed" in import_by_hand(tmp_path, rows, capsys, *options, "0.01")[1]
    assert "correct --speed" not in import_by_hand(tmp_path, rows, capsys, *options, "0.02")[1]
