"""Records that carry no diagnosis are refused with file, field and fix before any simulation.

What a reader must know of the others is said.
"""

import copy
import shutil
from pathlib import Path

import numpy as np
import pytest
from example_slices import example_slice
from threadpoolctl import threadpool_info, threadpool_limits

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.diagnosis import diagnose as diagnosis_module
from sliceit_drake.diagnosis.cause import Cause, CauseParameter
from sliceit_drake.diagnosis.causes import BUILT_IN
from sliceit_drake.diagnosis.input_checks import check_records, without_lone_torques
from sliceit_drake.diagnosis.registry import dry_run, load_cause
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.records.validation import load_records

CUCUMBER = Food(name="cucumber")


def slices(count: int = 3) -> list[SliceRecord]:
    out = [example_slice(seed=k) for k in range(count)]
    for k, record in enumerate(out):
        record.metadata.name, record.metadata.slice_index = f"slice_{k}", k
        record.file = f"slice_{k}.csv"
    return out


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for record in slices():
        write_record(record, tmp_path / "records" / record.name)
    return tmp_path / "records"


def refused(folder: Path, capsys, monkeypatch, *options: str) -> str:
    """What `sliceit diagnose` says of records that it refuses without a simulation."""

    def simulated(*_, **__):
        raise AssertionError("simulated before the input was looked at")

    monkeypatch.setattr(diagnosis_module, "sensitivities", simulated)
    command = ["diagnose", str(folder), "--model", "cucumber"]
    if "--output" not in options:
        command += ["--output", str(folder.parent / "out")]
    assert main([*command, *options]) == 2
    said = capsys.readouterr().err
    assert said.startswith("sliceit: ") and "Traceback" not in said
    return said


def edit_facts(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def edit_table(file: Path, names: tuple[str, ...], change) -> None:
    header = file.read_text().splitlines()[0].split(",")
    values = np.genfromtxt(file, delimiter=",", skip_header=1)
    at = [header.index(name) for name in names]
    values[:, at] = change(values[:, at])
    np.savetxt(file, values, delimiter=",", header=",".join(header), comments="", fmt="%.10g")


FORCES = ("force_x", "force_y", "force_z")


@pytest.mark.parametrize(
    ("names", "change", "words"),
    [
        (FORCES, lambda x: 1e-3 * x, ("kN", "1000")),
        (FORCES, lambda x: -x, ("wrench.sign: by_knife",)),
        (FORCES, lambda x: 0.0 * x + 3.0, ("in every row",)),
        (("p_WK_z",), lambda x: np.where(np.arange(len(x))[:, None] == 7, np.nan, x), ("line 9",)),
        (("p_WK_x", "p_WK_y", "p_WK_z"), lambda x: 1e3 * x, ("mm", "1000")),
        (("time",), lambda x: 1e3 * x, ("ms", "1000")),
    ],
    ids=["kN", "sign", "constant", "NaN", "mm", "ms"],
)
def test_a_table_that_cannot_be_is_named_with_what_to_do(
    folder, capsys, monkeypatch, names, change, words
):
    edit_table(folder / "slice_1.csv", names, change)
    said = refused(folder, capsys, monkeypatch)
    assert "slice_1.csv" in said and all(word in said for word in words)


def test_rows_without_a_reading_are_left_out_and_said(folder):
    lost = range(700, 704)
    edit_table(
        folder / "slice_1.csv",
        ("force_z",),
        lambda x: np.where(np.isin(np.arange(len(x)), lost)[:, None], np.nan, x),
    )
    records = load_records(folder)
    assert len(records[0]) - len(records[1]) == len(lost)
    assert np.array_equal(records[1].time, np.delete(records[0].time, lost))
    assert np.isfinite(records[1].force).all()
    said = [text for text in check_records(records, CUCUMBER) if "rows are missing" in text]
    assert len(said) == 1 and "slice_1 4 of 1500" in said[0]


def test_degrees_are_named_with_the_value_in_radians(folder, capsys, monkeypatch):
    edit_facts(folder / "slice_2.yaml", "yaw: 0.0", "yaw: 90.0")
    said = refused(folder, capsys, monkeypatch)
    assert "slice_2.yaml" in said and "Is it in degrees? Write 1.57" in said


def test_the_same_measurement_twice_is_refused(folder, capsys, monkeypatch):
    for kind in ("csv", "yaml"):
        shutil.copy(folder / f"slice_1.{kind}", folder / f"slice_9.{kind}")
    edit_facts(folder / "slice_9.yaml", "name: slice_1", "name: slice_9")
    said = refused(folder, capsys, monkeypatch)
    assert "slice_9.csv" in said and "slice_1.csv" in said and "Remove one" in said


def test_two_records_of_one_name_are_refused():
    records = slices()
    records[2].metadata.name = "slice_0"
    with pytest.raises(ConfigurationError, match="name") as error:
        check_records(records, CUCUMBER)
    assert error.value.field == "name"


def test_records_of_different_foods_are_refused(folder, capsys, monkeypatch):
    edit_facts(folder / "slice_2.yaml", "name: cucumber\n", "name: potato\n")
    said = refused(folder, capsys, monkeypatch)
    assert "slice_2.yaml" in said and "2 of cucumber, 1 of potato" in said


def test_the_model_of_another_food_is_refused_unless_it_is_meant(folder, capsys, monkeypatch):
    said = refused(folder, capsys, monkeypatch, "--model", "tomato")
    assert "of cucumber, the model is of tomato" in said and "--other-food" in said
    assert check_records(slices(), Food(name="tomato"), other_food=True) == []


def test_the_norm_beside_components_is_refused():
    records = slices()
    one = records[1]
    one.force_norm, one.force, one.torque = one.force_magnitude, None, None
    with pytest.raises(ConfigurationError, match="unlike 2 of the 3") as error:
        check_records(records, CUCUMBER)
    assert error.value.source == "slice_1.csv" and error.value.field == "force_norm"


def test_a_torque_that_some_lack_is_left_out_for_all_and_said_so():
    records = slices()
    records[1].torque = None
    (remark,) = [r for r in check_records(records, CUCUMBER) if "torque" in r]
    assert remark.startswith("slice_1:")
    assert all(r.torque is None for r in without_lone_torques(records))
    assert all(r.torque is not None for r in without_lone_torques(slices()))


def test_a_record_that_begins_in_the_food_is_refused():
    records = slices()
    for k, record in enumerate(records):
        record.force_norm, record.force, record.torque = record.force_magnitude, None, None
        if k == 1:
            records[k] = record.rows(record.time > 1.0)
    with pytest.raises(ConfigurationError, match="begins with") as error:
        check_records(records, CUCUMBER)
    assert error.value.source == "slice_1.csv" and "before the first contact" in error.value.fix


@pytest.mark.parametrize(("shift", "words"), [(0.02, "below the top"), (-0.02, "above the top")])
def test_a_food_that_is_not_where_the_force_begins_is_refused(shift, words):
    records = slices()
    records[0].metadata.food.position[2] += shift
    with pytest.raises(ConfigurationError, match=words) as error:
        check_records(records, CUCUMBER)
    assert error.value.field == "p_WK_z" and "food.position" in error.value.fix


def test_noise_above_a_food_is_no_contact():
    records = slices()
    air, cut = records[0].metadata.motion.phases[:2]
    air.end = cut.start = 0.25
    # 4 to 5 mm above the food.
    above = np.flatnonzero((records[0].time > 0.25) & (records[0].time < 0.3))
    records[0].force[above[::3], 2] += 0.2 * records[0].force_magnitude.max()
    assert check_records(records, CUCUMBER) == []
    # What lasts is one.
    records[0].force[above, 2] += 0.2 * records[0].force_magnitude.max()
    with pytest.raises(ConfigurationError, match="begins 5.0 mm above the top"):
        check_records(records, CUCUMBER)


def test_a_knife_that_never_reaches_the_food_is_refused():
    records = slices()
    records[0].metadata.food.position[2] -= 0.1
    with pytest.raises(ConfigurationError, match="stays .* above the food"):
        check_records(records, CUCUMBER)


def test_records_without_food_or_without_a_cut_are_refused():
    bare, uncut = slices(), slices()
    for record in bare:
        record.metadata.food.name = "none"
    for record in uncut:
        record.metadata.motion.phases = record.metadata.motion.phases[:1]
    with pytest.raises(ConfigurationError, match="none of the records is there food"):
        check_records(bare, CUCUMBER)
    with pytest.raises(ConfigurationError, match="nothing is cut"):
        check_records(uncut, CUCUMBER)


def test_one_condition_of_two_speeds_is_refused():
    records = slices()
    records[2].metadata.motion.speed = 0.03
    with pytest.raises(ConfigurationError, match="0.02 m/s .* not 0.03 m/s") as error:
        check_records(records, CUCUMBER)
    assert error.value.field == "condition" and error.value.source == "slice_2.yaml"


def test_what_a_reader_must_know_is_said_with_the_records_concerned():
    good = slices()
    assert check_records(good, CUCUMBER) == []
    spoiled = copy.deepcopy(good)
    for record in spoiled:
        record.metadata.condition = ""
        record.metadata.motion.phases = record.metadata.motion.phases[1:]
        record.metadata.sensor.force_range = 10.0
        record.force = np.clip(record.force, -10.0, 10.0)
    spoiled[2].metadata.knife.spine_thickness = 2e-3
    remarks = check_records(spoiled, CUCUMBER)
    for words in ("no condition", "no air phase", "clipped", "another knife"):
        (found,) = [r for r in remarks if words in r]
        assert found.startswith("slice_2:" if words == "another knife" else "slice_0, slice_1")


def test_a_sensor_that_saturates_far_below_its_range_is_found():
    record = slices(1)[0]
    record.metadata.sensor.force_range = 300.0
    assert check_records([record], CUCUMBER) == []
    record.force = np.clip(record.force, -10.0, 10.0)
    assert any("clipped" in r for r in check_records([record], CUCUMBER))


@pytest.mark.parametrize("option", ["--output", "--cache", "--next-experiment"])
def test_a_place_that_cannot_be_written_to_is_named_before_work_is_done(
    folder, capsys, monkeypatch, option
):
    (folder.parent / "file").write_text("")
    place = folder.parent / "file" / "sub"
    said = refused(folder, capsys, monkeypatch, option, str(place / "next.yaml"))
    assert option in said and "cannot be written to" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--workers", "0"), "--workers"),
        (("--refinement", "-1"), "--refinement"),
        (("--replicates", "3"), "--replicates"),
        (("--backend", "dask"), "--scheduler"),
        (("--scheduler", "tcp://127.0.0.1:9"), "--backend dask"),
        (("--cause", "nowhere.py"), "nowhere.py"),
    ],
)
def test_an_option_that_cannot_be_is_named(folder, capsys, monkeypatch, options, words):
    assert words in refused(folder, capsys, monkeypatch, *options)


CAUSE = '''
from sliceit_drake.diagnosis.cause import Cause, CauseParameter


class Mine(Cause):
    """A pull."""

    name = "mine"
    family = "sensor"
    parameters = (CauseParameter("pull", "N", 0.5),)
    signature = "a pull"
    experiment = "retract"

    def wrench(self, series, values, facts):
        out = series.wrench.copy()
        {line}
        return out
'''


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("out[:, 5] += values['pul']", ("line 16", "KeyError", "pul")),
        ("out = out[:, 5]", ("Mine.wrench", "expected [200, 6]")),
        ("out = out + 1.0", ("at its nulls",)),
        ("series.wrench[:, 5] += values['pull']", ("series.wrench.copy()",)),
        ("out[:, 5] += values['pull'] / 0.0 if values['pull'] else 0.0", ("ZeroDivisionError",)),
        ("out[values['pull'] > 0.0, 5] = float('nan')", ("not finite",)),
        ("out[:, 5] += (", ("SyntaxError", "line")),
    ],
)
def test_a_mistake_in_a_users_cause_is_shown_with_its_line(tmp_path, line, words):
    file = tmp_path / "mine.py"
    file.write_text(CAUSE.format(line=line))
    with pytest.raises(ConfigurationError) as error:
        load_cause(file)
    assert str(file) in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_a_users_cause_without_a_mistake_is_taken(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(CAUSE.format(line="out[:, 5] += values['pull']"))
    assert load_cause(file).name == "mine"


def test_the_rehearsal_takes_every_built_in_cause():
    for kind in BUILT_IN:
        dry_run(kind())


def test_a_motion_of_the_wrong_shape_is_refused():
    class Cut(Cause):
        name = "cut"
        parameters = (CauseParameter("x", "m", 1.0),)

        def motion(self, R, p, t, values, facts, force=None):
            return R[1:], p[1:]

    with pytest.raises(ConfigurationError, match="gives arrays"):
        dry_run(Cut())


def test_a_diagnosis_keeps_the_linear_algebra_to_one_thread(monkeypatch):
    seen = []

    def check(*_):
        seen.extend(i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas")
        raise ConfigurationError("enough")

    monkeypatch.setattr(diagnosis_module, "check_records", check)
    setup = diagnosis_module.setup_of_food(load_calibrated_food("cucumber"))
    with threadpool_limits(2, "blas"), pytest.raises(ConfigurationError, match="enough"):
        diagnosis_module.diagnose(setup, slices())
    assert set(seen) == {1}
