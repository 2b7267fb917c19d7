"""Bad slice records are refused or flagged by file, column and row; good ones pass in silence."""

import copy
import dataclasses as dc

import numpy as np
import pytest
from example_slices import example_slice
from scipy.spatial.transform import Rotation

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.metadata import FoodFacts, Phase, WrenchFacts
from sliceit_drake.records.slice_record import SliceRecord, SliceTable, read_table, write_record
from sliceit_drake.records.validation import check_record, check_table, load_record
from sliceit_drake.resources import resource_path


def good_records() -> dict[str, SliceRecord]:
    """Records with nothing wrong, of the kinds that are near to something wrong."""
    records = {"noisy": example_slice(0.5), "ideal": example_slice(0.0)}
    norm = example_slice()
    records["norm"] = dc.replace(norm, force_norm=norm.force_magnitude, force=None, torque=None)
    slow_sensor = example_slice()
    held = np.arange(len(slow_sensor)) // 5 * 5
    slow_sensor.force, slow_sensor.torque = slow_sensor.force[held], slow_sensor.torque[held]
    records["100 Hz sensor in a 500 Hz table"] = slow_sensor
    coarse = example_slice(0.5)
    coarse.force = np.round(coarse.force)
    records["resolution of 1 N"] = coarse
    soft = example_slice(0.3)
    soft.force = 0.03 * soft.force
    records["tofu"] = soft
    hard = example_slice(1.0)
    hard.force, hard.metadata.sensor.force_range = 20.0 * hard.force, 500.0
    records["pumpkin"] = hard
    jittery = example_slice()
    jittery.time = jittery.time + np.random.default_rng(2).uniform(0.0, 0.001, len(jittery))
    jittery.velocity, jittery.angular_velocity = fmt.velocities(
        jittery.time, jittery.position, jittery.rotation
    )
    records["irregular times"] = jittery
    weighing = example_slice()
    weighing.force = weighing.force + np.array([0.0, 0.0, -0.3 * 9.81])
    weighing.metadata.wrench = WrenchFacts(includes=["food", "board", "gravity"], tared="no")
    records["tool's weight included"] = weighing
    air = example_slice().between(0.0, 0.4)
    air.metadata.motion.phases = [Phase("air", 0.0, 0.5)]
    air.metadata.food = FoodFacts()
    records["air alone"] = air
    weight = example_slice(0.05)
    weight.force = weight.force * 0.0 + [0.0, 0.0, -5.0]
    weight.force[::2] += 0.1
    weight.metadata.motion.phases = [Phase("air", 0.0, 0.5), Phase("weight", 0.5, 3.0)]
    weight.force[:250, 2] += 5.0
    weight.metadata.food = FoodFacts()
    records["a weight"] = weight
    return records


@pytest.mark.parametrize("name", good_records())
def test_a_good_record_has_no_findings(name, tmp_path):
    record = good_records()[name]
    assert [str(finding) for finding in check_record(record)] == []
    load_record(write_record(record, tmp_path / record.name))


def kilonewtons(table: SliceTable) -> None:
    scale(table, (*fmt.FORCE, *fmt.TORQUE), 1e-3)


def hard_in_kilonewtons(table: SliceTable) -> None:
    """A force of 200 N in kN is no smaller than a soft food's in N; the sensor's noise is."""
    table.columns.update(example_slice(0.03).table().columns)
    scale(table, fmt.FORCE, 10e-3)


def kilonewtons_without_air(table: SliceTable) -> None:
    """A force of 120 N in kN, through a food of which the work tells."""
    scale(table, fmt.FORCE, 6e-3)
    table.metadata.motion.phases.pop(0)
    table.metadata.food.size = [0.15, 0.15, 0.15]


def kilonewtons_without_size(table: SliceTable) -> None:
    kilonewtons(table)
    table.metadata.food.size = None
    table.metadata.unknown.append("food.size")


def grams(table: SliceTable) -> None:
    scale(table, fmt.FORCE, 1.0 / 9.80665e-3)


def counts(table: SliceTable) -> None:
    scale(table, fmt.FORCE, 1e3)


def millimetres(table: SliceTable) -> None:
    scale(table, (*fmt.POSITION, *fmt.VELOCITY), 1e3)


def millimetres_near_the_origin(table: SliceTable) -> None:
    """A travel of 27 that starts near 0 is within an arm's reach; its speed is not."""
    for name in fmt.POSITION:
        table.columns[name] = 1e2 * (table.columns[name] - table.columns[name][0])
    table.metadata.motion.speed = 0.005


def milliseconds(table: SliceTable) -> None:
    scale(table, (fmt.TIME,), 1e3)
    for phase in table.metadata.motion.phases:
        phase.start, phase.end = 1e3 * phase.start, 1e3 * phase.end


def milliseconds_without_rate(table: SliceTable) -> None:
    milliseconds(table)
    table.metadata.sensor.rate = None


def degrees(table: SliceTable) -> None:
    for k, name in enumerate(fmt.JOINTS):
        table.columns[name] = np.full(len(table.lines), -30.0 * k)


def time_backwards(table: SliceTable) -> None:
    table.columns["time"][7 * len(table.lines) // 15 :] -= 0.5


def time_repeated(table: SliceTable) -> None:
    table.columns["time"][700] = table.columns["time"][699]


def nan_burst(table: SliceTable) -> None:
    row = 2 * len(table.lines) // 5
    table.columns["force_z"][row : row + 40] = np.nan


def mostly_nan(table: SliceTable) -> None:
    table.columns["force_z"][::2] = np.nan


def nan_pose(table: SliceTable) -> None:
    table.columns["p_WK_z"][600:640] = np.nan


def no_tare(table: SliceTable) -> None:
    table.columns["force_z"] += 2.5


def no_tare_and_a_spike_in_the_cut(table: SliceTable) -> None:
    no_tare(table)
    table.columns["force_z"][600] = 300.0


def no_tare_said(table: SliceTable) -> None:
    no_tare(table)
    table.metadata.wrench.tared = "no"


def flipped_sign(table: SliceTable) -> None:
    scale(table, fmt.FORCE, -1.0)


def flipped_sign_of_an_offset_sensor(table: SliceTable) -> None:
    """An offset of the sensor does not hide it."""
    scale(table, fmt.FORCE, -1.0)
    table.columns["force_z"] += 30.0


def wrong_frame(table: SliceTable) -> None:
    """Components in W that are said to be in K, whose z points down."""
    table.metadata.wrench.frame = "K"


def force_across(table: SliceTable) -> None:
    table.columns["force_z"], table.columns["force_y"] = (
        table.columns["force_y"],
        table.columns["force_z"],
    )


def clipped_at_its_range(table: SliceTable) -> None:
    table.metadata.sensor.force_range = 15.0
    table.columns["force_z"] = np.clip(table.columns["force_z"], -15.0, 15.0)


def clipped_at_an_unknown_range(table: SliceTable) -> None:
    table.metadata.sensor.force_range = None
    limit = 0.75 * np.abs(table.columns["force_z"]).max()
    table.columns["force_z"] = np.clip(table.columns["force_z"], -limit, limit)


def constant(table: SliceTable) -> None:
    for name in fmt.FORCE:
        table.columns[name] = np.full(len(table.lines), 1.0)


def frozen(table: SliceTable) -> None:
    for name in fmt.FORCE:
        table.columns[name][400:550] = table.columns[name][400]


def no_air(table: SliceTable) -> None:
    table.metadata.motion.phases.pop(0)


def no_phases(table: SliceTable) -> None:
    table.metadata.motion.phases.clear()


def phase_beside(table: SliceTable) -> None:
    table.metadata.motion.phases.append(Phase("other", 7.0, 8.0))


def jump(table: SliceTable) -> None:
    table.columns["p_WK_y"][800:] += 0.01


def turned(table: SliceTable) -> None:
    turn = Rotation.from_euler("x", 0.2) * Rotation.from_quat(
        table.stack(fmt.QUATERNION)[900:], scalar_first=True
    )
    for name, column in zip(fmt.QUATERNION, turn.as_quat(scalar_first=True).T, strict=True):
        table.columns[name][900:] = column


def upside_down(table: SliceTable) -> None:
    """As a tool that is turned by pi once more than it was."""
    for name, values in zip(fmt.QUATERNION, (1.0, 0.0, 0.0, 0.0), strict=True):
        table.columns[name] = np.full(len(table.lines), values)


def scalar_last(table: SliceTable) -> None:
    table.columns["quat_WK_w"] = table.columns["quat_WK_w"] + 0.3


def dropout(table: SliceTable) -> None:
    table.columns["time"][1000:] += 0.1


def velocity_of_another_axis(table: SliceTable) -> None:
    scale(table, ("v_WK_z",), -1.0)


def velocity_in_degrees(table: SliceTable) -> None:
    table.columns["w_WK_y"] += 0.3


def below_board(table: SliceTable) -> None:
    table.metadata.board_height = 0.1


def missing_column(table: SliceTable) -> None:
    del table.columns["p_WK_y"]


def missing_force(table: SliceTable) -> None:
    for name in (*fmt.FORCE, *fmt.TORQUE):
        del table.columns[name]


def missing_component(table: SliceTable) -> None:
    del table.columns["torque_y"]


def few_rows(table: SliceTable) -> None:
    table.columns = {name: values[:5] for name, values in table.columns.items()}
    table.lines = table.lines[:5]


def negative_norm(table: SliceTable) -> None:
    table.columns["force_norm"] = table.columns["force_z"] - 1.0
    for name in (*fmt.FORCE, *fmt.TORQUE):
        del table.columns[name]


def forgotten_facts(table: SliceTable) -> None:
    table.metadata.food.size, table.metadata.food.support = None, "unknown"


def unknown_unknown(table: SliceTable) -> None:
    table.metadata.unknown.append("food.sise")


def torque_about_nowhere(table: SliceTable) -> None:
    table.metadata.wrench.point = "unknown"


def missing_rotation(table: SliceTable) -> None:
    table.metadata.wrench.frame = "S"


def scale(table: SliceTable, names: tuple[str, ...], factor: float) -> None:
    for name in names:
        table.columns[name] = factor * table.columns[name]


# Lines of the file: the header is line 1, so that the row with index k stands on line k + 2.
@pytest.mark.parametrize(
    ("spoil", "severity", "kind", "message"),
    [
        (kilonewtons, "error", "kilonewtons", "lines 252 to 926: force_x: .*stays below 0.02"),
        (hard_in_kilonewtons, "error", "kilonewtons", "its noise in the air is 0.0003 N"),
        (kilonewtons_without_air, "error", "kilonewtons", "J per m2 of cut, expected at least 1 J"),
        (kilonewtons_without_size, "error", "kilonewtons", "0.1 N. Is it in kN. Multiply"),
        (
            grams,
            "warning",
            "great work",
            "J per m2 of cut, .* at most 20000 J/m2. Is the force in g",
        ),
        (counts, "error", "force unit", "line .*: the force reaches .*e.04 N. Is it in mN"),
        (millimetres, "error", "millimetres", "line .*: p_WK_x: 4.* Is it in mm. Divide"),
        (
            millimetres_near_the_origin,
            "error",
            "millimetres",
            "the knife moves at 400 times the nominal 0.005 m/s. Is it in mm",
        ),
        (milliseconds, "error", "milliseconds", "2 s apart, expected 0.002 s from sensor.rate"),
        (milliseconds_without_rate, "error", "milliseconds", "expected 0.02 m/s from motion.speed"),
        (degrees, "error", "degrees", "line 2: q_6: -150 rad is more.*Is it in degrees"),
        (time_backwards, "error", "time", "line 702: time: 0.9 s goes back from 1.398 s"),
        (time_repeated, "error", "time", "line 702: time: 1.398 s repeats 1.398 s"),
        (nan_burst, "warning", "no reading", "lines 602 to 641: 40 of 1500 rows have no finite wr"),
        (mostly_nan, "error", "gap", "line 1500: force_z: 1 of 1500 rows"),
        (nan_pose, "error", "gap", "lines 602 to 641: p_WK_z: 40 of 1500 rows"),
        (no_tare, "warning", "no tare", "lines 2 to 251: force_z: .*2.5 N.*tared is yes. Apply"),
        (no_tare_and_a_spike_in_the_cut, "warning", "no tare", "force_z: .*2.5 N in the mean"),
        (no_tare_said, "warning", "no tare", "wrench.tared is no. Apply the step tare"),
        (flipped_sign, "error", "flipped sign", "lines 252 to 926: force_z.*Write wrench.sign: by"),
        (flipped_sign_of_an_offset_sensor, "error", "flipped sign", "force_z: .*the force on"),
        (wrong_frame, "error", "flipped sign", 'or correct wrench.frame .*"K"'),
        (force_across, "warning", "frame", "across the knife's motion.*Check wrench.frame"),
        (clipped_at_its_range, "warning", "clipped", "force_z: .*at the sensor's range, 15"),
        (clipped_at_an_unknown_range, "warning", "clipped", "rows in a row are exactly 15"),
        (constant, "error", "constant", "force_x: is 1.73205 N in every row"),
        (frozen, "warning", "frozen", "lines 402 to 551: force_x: .*for 0.3 s of the slice"),
        (
            no_air,
            "warning",
            "no air phase",
            "yaml: motion.phases: the first phase labelled air has not",
        ),
        (no_phases, "warning", "phases", "no phase is labelled, so that the whole"),
        (phase_beside, "warning", "phases", "phases.4.: other from 7 to 8 s is beside the record"),
        (jump, "error", "jump", "lines 801 to 802: p_WK_x: the pose jumps: 5 m/s between two"),
        (turned, "error", "jump", "lines 901 to 902: quat_WK_w: the pose jumps: 100 rad/s"),
        (upside_down, "error", "upside down", "lines 252 to 926: quat_WK_w: .*--tcp-to-knife"),
        (scalar_last, "error", "quaternion", "lines 2 to 1501: quat_WK_w: .*length 1.04.*w first"),
        (dropout, "warning", "dropout", "lines 1001 to 1002: time: 0.102 s without a row, where"),
        (velocity_of_another_axis, "warning", "velocity", "v_WK_x: the velocities add up to a"),
        (velocity_in_degrees, "warning", "velocity", "w_WK_x: .* rad from the poses after 3 s"),
        (below_board, "warning", "below board", "p_WK_z: the edge is up to 80 mm below the board"),
        (missing_column, "error", "missing column", "p_WK_y: the column is missing. Add it"),
        (missing_force, "error", "missing column", "there is no force. Add force_x"),
        (missing_component, "error", "missing column", "torque_y: .*missing beside torque_x"),
        (few_rows, "error", "short", "time: the table has 5 rows. Give at least 10"),
        (negative_norm, "error", "negative norm", "force_norm: a norm is -"),
        (forgotten_facts, "warning", "missing fact", "food.size, food.support: not given"),
        (unknown_unknown, "warning", "unknown name", "unknown: 'food.sise'.*mean \"food.size\""),
        (torque_about_nowhere, "warning", "missing fact", "wrench.point: is unknown, so that the"),
        (missing_rotation, "error", "missing fact", "sensor.rotation: is not given, but wrench"),
    ],
)
def test_a_bad_record_is_named_by_file_column_row_and_fix(spoil, severity, kind, message, tmp_path):
    table = copy.deepcopy(example_slice().table())
    spoil(table)
    findings = {finding.kind: finding for finding in check_table(table)}
    assert kind in findings, [str(finding) for finding in findings.values()]
    finding = findings[kind]
    assert finding.severity == severity
    assert str(finding).startswith(f"{severity}: cucumber_00.")
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(str(finding))
    others = [f for k, f in findings.items() if k != kind and f.severity == "error"]
    assert [str(finding) for finding in others] == [], "one fault, one error"


def test_a_record_with_an_error_is_not_loaded_and_the_message_names_its_file(tmp_path):
    record = example_slice()
    record.force = 1e-3 * record.force
    file = write_record(record, tmp_path / "cucumber_00")
    with pytest.raises(ConfigurationError, match="lines 252 to 926: force_x: .*Is it in kN"):
        load_record(file)
    rows = file.read_text(encoding="utf-8").split("\n")
    rows[100] = ",".join(["", *rows[100].split(",")[1:]])
    file.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="csv, line 101: time: 1 of 1500 rows"):
        load_record(file)


def test_a_record_that_cannot_be_split_into_cells_does_not_hide_the_next(tmp_path, capsys):
    for name in ("a", "b"):
        write_record(example_slice(), tmp_path / name)
    rows = (tmp_path / "a.csv").read_text(encoding="utf-8").split("\n")
    rows[2] = '"' + rows[2]
    (tmp_path / "a.csv").write_text("\n".join(rows), encoding="utf-8")
    assert main(["records", "check", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "a.csv: the table cannot be read (field larger" in said and "quotation mark" in said
    assert "b.csv: nothing found" in said and "2 records, 1 with errors" in said


def test_a_coarse_sensor_may_feel_nothing_in_the_air(tmp_path):
    record = example_slice()
    record.force = np.zeros_like(record.force)
    whole = Phase("air", float(record.time[0]), float(record.time[-1]))
    for phases in ([whole], [dc.replace(whole, label="slice")]):
        record.metadata.motion.phases = phases
        findings = check_table(record.table())
        assert any(f.kind == "constant" for f in findings) == (phases != [whole])


def test_a_record_with_a_warning_is_loaded(tmp_path):
    record = example_slice()
    record.force = record.force + 1.0
    load_record(write_record(record, tmp_path / "cucumber_00"))


FAULTS = {
    "kilonewtons": kilonewtons,
    "millimetres": millimetres,
    "milliseconds": milliseconds,
    "time": time_backwards,
    "gap": nan_pose,
    "no reading": nan_burst,
    "no tare": no_tare,
    "flipped sign": flipped_sign,
    "clipped": clipped_at_an_unknown_range,
}


@pytest.fixture(scope="module")
def bench_tables(tmp_path_factory) -> list[SliceTable]:
    """Records of the simulated bench: made of measured curves, with its sensor's noise."""
    folder = tmp_path_factory.mktemp("bench")
    protocol = str(resource_path("calibration/protocols/rich.yaml"))
    assert main(["record", protocol, *"--world curves --seed 5 --output".split(), str(folder)]) == 0
    return [read_table(file) for file in sorted(folder.glob("*.csv"))]


def test_the_benchs_records_have_no_findings(bench_tables):
    assert [str(f) for table in bench_tables for f in check_table(table)] == []


@pytest.mark.parametrize("kind", FAULTS)
def test_each_fault_is_found_in_every_record_of_the_bench(bench_tables, kind):
    tables = [copy.deepcopy(table) for table in bench_tables]
    tables = [t for t in tables if "slice" in {p.label for p in t.metadata.motion.phases}]
    assert len(tables) >= 12
    for table in tables:
        FAULTS[kind](table)
        assert kind in {finding.kind for finding in check_table(table)}, table.file
