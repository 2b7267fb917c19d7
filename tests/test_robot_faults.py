"""The table of faults of the emulated robot: its list, what it measures, and its page."""

import json
from pathlib import Path

import numpy as np
import pytest
from arm_at_start import LENGTH, START, X_TK, X_WB

from sliceit_drake.emulator.fault_table import FAULTS
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from studies.robot import faults
from studies.robot.fault_list import cases

RESULTS = Path(__file__).resolve().parent.parent / "docs/results"


def test_the_list_has_each_fault_once_by_a_name_that_the_emulator_knows():
    listed = list(cases())
    assert len(listed) == len({case.key for case in listed}) >= 60
    for case in listed:
        assert bool(case.faults) != bool(case.signal)
        assert all(fault.partition(":")[0] in FAULTS for fault in case.faults)


def test_the_page_is_that_of_the_stored_results():
    rows = faults.read(RESULTS / "robot_faults.jsonl")
    assert faults.page(rows) == (RESULTS / "robot_faults.md").read_text(encoding="utf-8")
    made = [row for row in rows if "free" not in row]
    assert len(made) >= 60
    assert [row["key"] for row in made if not faults.is_held(row)] == []
    reasons = {case.key: case.unseen for case in cases()}
    assert [row["key"] for row in made if not row["by"] and not reasons[row["key"]]] == []


def slice_along(turns, force, at=0.1):
    """A slice whose first joint is at these angles from the start, a cycle each."""
    turns = np.asarray(turns, float)
    trace = np.zeros((len(turns), 10))
    trace[:, 0] = 0.002 * np.arange(len(turns))
    trace[:, 1:7] = START
    trace[:, 1] += turns
    trace[:, 9] = force
    return faults.Slice("", 0, [], trace, at)


def test_a_slice_that_stays_on_the_path_and_stops_is_not_beyond_it():
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    path = 1e-4 * np.arange(101)
    base = slice_along(path, 5.0, np.nan)
    found = faults.compare(slice_along(np.minimum(path, 6e-3), 5.0), base, kinematics)
    assert found["after"] == pytest.approx(0.02, abs=0.0021)
    assert found["beyond"] < 1e-9 and found["force"] == 0.0
    reach = np.hypot(*kinematics.edge(START).heel[:2])
    assert found["way"] == pytest.approx(1e-3 * reach, rel=0.2)


def test_a_slice_that_leaves_the_path_and_presses_is_beyond_it():
    kinematics = EdgeKinematics(X_WB, X_TK, LENGTH)
    path = 1e-4 * np.arange(101)
    base = slice_along(path, 5.0, np.nan)
    away = slice_along(np.where(path > 5e-3, 0.02, path), 12.0)
    found = faults.compare(away, base, kinematics)
    reach = np.hypot(*kinematics.edge(START).heel[:2])
    assert found["beyond"] == pytest.approx(0.01 * reach, rel=0.05)
    assert found["force"] == pytest.approx(7.0)


def test_slices_without_a_fault_are_all_different():
    runs = list(faults.free_runs(200))
    assert len({name for name, _, _ in runs}) == len({fields for _, fields, _ in runs}) == 200
    json.dumps(runs)
