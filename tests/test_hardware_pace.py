"""How a run keeps up with the controller's clock: what the table counts, and where it goes."""

import re
from pathlib import Path

import numpy as np
import pytest
from emulator_bench import free_address

from sliceit_drake.configuration import ConfigurationError
from studies.__main__ import main
from studies.pages import render
from studies.robot import hardware_pace as pace

pytestmark = pytest.mark.second_tier

ROOT = Path(__file__).resolve().parent.parent
SHORT = """{start: {clearance: 0.005}, measurement: null, motion: {segments: [
  !ConstantSpeed {speed: 0.02, distance: 0.008, acceleration: 0.5, label: slice}]}}"""
PATIENT = "{watchdog: 5.0, limits: {state_age: 0.1, command_age: 0.1, joint_step: 0.1}}"


def cells_of(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_cycles_count_from_the_first_target_to_the_last_and_gaps_are_missed():
    time = np.array([1.000, 1.002, 1.004, 1.010, 1.012, 1.014])
    sent = np.array([np.nan, 0.1, 0.1, 0.1, 0.1, np.nan])
    late = np.array([9.0, 1e-3, 2e-3, 3e-3, 4e-3, 9.0])
    log = np.rec.fromarrays([time, sent, late], names="time,sent_1,lateness")
    cycles, missed, lateness = pace.timing(log)
    assert (cycles, missed) == (6, 2)
    assert lateness.tolist() == [1e-3, 2e-3, 3e-3, 4e-3]
    assert pace.timing(log[:1])[0] == 0


def test_runs_of_a_pace_make_a_row():
    late = np.linspace(0.0, 1e-3, 101)
    runs = [
        pace.PacedRun("", 1000, 3, late, 1, 0.02, 0.004),
        pace.PacedRun("", 1000, 0, late, 0, 0.04, 0.008),
        pace.PacedRun("state_age", 500, 2, np.array([0.012]), 4),
    ]
    row = pace.row(0.5, runs)
    assert row[:4] == ["0.5", "2 of 3", "2500", "5 (0.20 %)"]
    assert row[4:8] == ["0.50 ms", "1.00 ms", "12.00 ms", "5"], "of all runs together"
    assert row[8:] == ["0.030 N, at most 0.040 (0.80 %)", "1 state_age"]
    head = render("hardware_pace", rows=[row], command="a", machine="b").splitlines()[0]
    assert len(row) == len(cells_of(head))
    nothing = pace.row(1.0, [pace.PacedRun("Not ready")] * 2)
    assert nothing == ["1", "0 of 2", "0", "-", "-", "-", "-", "0", "-", "2 Not ready"]


@pytest.mark.parametrize(
    ("printed", "stop"),
    [
        ("x\nSTOPPED: state_age at controller time 3.201 s: no data for 0.012 s\ny", "state_age"),
        ("Not ready: payload, reach. Nothing was moved.\n", "Not ready"),
        ("\nOSError: no route\n", "OSError"),
        ("", "it said nothing"),
    ],
)
def test_stops_are_counted_by_their_reason(printed, stop):
    assert pace.stop_of(printed) == stop


def test_the_force_is_compared_at_the_times_of_the_run():
    def record(time, force):
        parts = [np.array(time), *(np.array(force) * k for k in (0.0, 0.0, 1.0))]
        names = "time," + ",".join(f"sensor_wrench_f_{axis}" for axis in "xyz")
        return np.rec.fromarrays(parts, names=names)

    simulated = record([0.0, 1.0, 2.0], [0.0, 10.0, 20.0])
    error, share = pace.force_error(record([0.5, 1.5], [6.0, 14.0]), simulated)
    assert error == pytest.approx(1.0)
    assert share == pytest.approx(1.0 / np.sqrt(125.0))


def test_a_table_replaces_what_is_between_the_marks_and_nothing_else():
    text = f"a\n{pace.PLACE.begin}\nold\n{pace.PLACE.end}\nb\n"
    new = pace.PLACE.put(text, "new", "x.md")
    assert new == f"a\n{pace.PLACE.begin}\nnew\n{pace.PLACE.end}\nb\n"
    assert pace.PLACE.put(new, "new", "x.md") == new
    for wrong in ("a", f"{pace.PLACE.end}{pace.PLACE.begin}", text + text):
        with pytest.raises(ConfigurationError, match=r"x\.md.*no place for the table"):
            pace.PLACE.put(wrong, "new", "x.md")
    pace.PLACE.put((ROOT / "docs/how_to/hardware.md").read_text(), "new", "docs/how_to/hardware.md")


def test_it_runs_emulator_and_client_and_prints_and_writes_the_table(tmp_path, capsys):
    file = tmp_path / "pace.md"
    file.write_text(f"{pace.PLACE.begin}\n{pace.PLACE.end}\n")
    arguments = ["--set", SHORT, "--set-robot", PATIENT, "--pace", "0.1", "--repeats", "1"]
    assert (
        main(["hardware_pace", *arguments, "--address", free_address(), "--output", str(file)]) == 0
    )
    printed = capsys.readouterr().out
    row = cells_of(re.search(r"\| 0\.1 \|.*", printed)[0])
    # How the machine keeps up is its own affair; that targets went out is not.
    assert row[1] in ("1 of 1", "0 of 1")
    assert int(row[2]) > 20, printed
    assert "python -m studies hardware_pace --set" in printed
    assert re.search(r"\| 0\.1 \|.*", printed)[0] in file.read_text()
