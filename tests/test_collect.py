"""`sliceit collect`: a protocol's slices on a station, in random order, as records."""

import io
import re

import numpy as np
import pytest
from emulator_bench import free_address
from hardware_bench import CLIENT_PACE, PATIENT, ROBOT, emulated

from sliceit_drake.cli.main import main
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import load_protocol, scenario_of_cut, schedule
from sliceit_drake.systems.analytic_cutter import AnalyticFood

pytestmark = pytest.mark.second_tier

STATION = "scenarios/cucumber_measured.yaml"
PROTOCOL = """
name: short
food:
  shape: !Cylinder {diameter: 0.02, length: 0.06, rings: 2, layers: [0.0, 0.005, 0.01]}
  hold_distance: 0.009
conditions:
  - label: press
    replicates: 2
    motion:
      segments:
        - !Hold {duration: 0.06, label: air}
        - !ConstantSpeed {distance: 0.014, speed: 0.03, acceleration: 2.0, label: slice}
        - !Hold {duration: 0.05, label: hold}
  - label: board
    replicates: 1
    without_food: true
    motion:
      segments:
        - !Hold {duration: 0.06, label: air}
        - !ConstantSpeed {distance: 0.004, speed: 0.03, acceleration: 2.0, label: board_press}
"""


@pytest.fixture
def protocol(tmp_path):
    file = tmp_path / "short.yaml"
    file.write_text(PROTOCOL)
    return file


def test_it_cuts_all_slices_records_them_and_goes_on_where_it_was(protocol, tmp_path, capsys):
    output = tmp_path / "records"
    arguments = ["collect", str(protocol), "--output", str(output), "--seed", "3"]
    assert main([*arguments, "--first", "1"]) == 0
    written = (output / "slice_000.csv").stat().st_mtime_ns
    assert main(arguments) == 0
    assert (output / "slice_000.csv").stat().st_mtime_ns == written, "it was cut twice"
    specimens = schedule(load_protocol(str(protocol)), np.random.default_rng([3, 0]))
    records = [load_record(output / f"slice_{k:03d}.csv") for k in range(3)]
    assert [r.metadata.condition for r in records] == [s.condition.label for s in specimens]
    assert [r.metadata.slice_index for r in records] == [0, 1, 2]
    for record in records:
        press = record.metadata.condition == "press"
        assert (record.force[:, 2].max() > 1.0) == press
        assert record.phase("air").sum() > 10
    presses = [r.force[:, 2].max() for r in records if r.metadata.condition == "press"]
    assert presses[0] != presses[1], "replicates differ as the protocol's variation says"
    capsys.readouterr()
    assert main([*arguments[:-1], "5"]) == 2
    assert "--seed" in capsys.readouterr().err


def test_a_protocol_on_one_emulated_robot_is_recorded_as_on_the_simulated_station(
    protocol, tmp_path, monkeypatch, capsys
):
    slices = ["collect", str(protocol), "--seed", "3"]
    assert main([*slices, "--output", str(tmp_path / "simulated")]) == 0
    with emulated() as emulator:
        robot = ["--host", emulator.address, "--pace", str(CLIENT_PACE), "--robot", str(ROBOT)]
        robot += ["--set-robot", f"{{{PATIENT}}}", "--output", str(tmp_path / "real")]
        robot += ["--move-to-start", "--emulator-pendant", "30099"]
        monkeypatch.setattr("sys.stdin", io.StringIO("move\ntouch\nmove\ngo on\n"))
        assert main([*slices, *robot, "--touch"]) == 1, "that was not the word"
        assert not (tmp_path / "real" / "slice_000.csv").exists()
        printed = capsys.readouterr()
        touched = re.search(r"The board is at ([\d.]+) m", printed.out)
        assert touched, printed.out + printed.err
        assert float(touched[1]) == pytest.approx(0.05, abs=2e-4)
        monkeypatch.setattr("sys.stdin", io.StringIO("move\nslice\n" * 3))
        assert main([*slices, *robot]) == 0
        log = [text for _, text in emulator.pendant.status()["log"]]
    # A bare board for the touch, food before the wrong word, and for each slice.
    assert log.count("fresh food") == 5
    printed = capsys.readouterr().out
    assert printed.count("a fresh piece of food") == 2 and "the bare board" in printed
    conditions = []
    for name in ("slice_000", "slice_001", "slice_002"):
        real = load_record(tmp_path / "real" / f"{name}.csv")
        wanted = load_record(tmp_path / "simulated" / f"{name}.csv")
        conditions.append(real.metadata.condition)
        assert real.metadata.condition == wanted.metadata.condition
        assert real.metadata.provenance == "UR5e through RTDE."
        assert (tmp_path / "real" / name / "robot.csv").exists()
        force = [np.interp(real.time, wanted.time, column) for column in wanted.force.T]
        error = np.linalg.norm(real.force - np.transpose(force)) / np.linalg.norm(force)
        with capsys.disabled():
            print(f"\n{name}, {real.metadata.condition}: {100 * error:.2f} % RMS of force apart")
        assert error < 0.05
    assert sorted(conditions) == ["board", "press", "press"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--emulator-pendant", "30099"], "--emulator-pendant: .* on this machine"),
        (["--emulator-pendant", "30099", "--host", "10.0.0.5"], "with a robot leave this out"),
        (["--touch"], "--touch: is for a robot"),
        (["--move-to-start"], "--move-to-start: is for a robot"),
        (["--dry-run"], "--dry-run: is for a robot"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, said, protocol, tmp_path, capsys):
    output = tmp_path / "records"
    assert main(["collect", str(protocol), "--output", str(output), *options]) == 2
    assert re.search(said, capsys.readouterr().err)
    assert not output.exists()


def test_food_is_renewed_only_where_an_emulator_answers(protocol, tmp_path, capsys):
    address = free_address()
    arguments = ["--host", address, "--robot", str(ROBOT), "--emulator-pendant", "30099"]
    assert main(["collect", str(protocol), "--output", str(tmp_path), *arguments]) == 2
    assert f"{address}:30099 puts no fresh food there" in capsys.readouterr().err


def test_every_shipped_protocol_makes_scenarios_of_a_station():
    station = load_scenario(resource_path(STATION))
    for file in resource_path("calibration/protocols").glob("*.yaml"):
        protocol = load_protocol(str(file))
        for specimen in schedule(protocol, np.random.default_rng(0)):
            scenario = scenario_of_cut(protocol, specimen, station)
            assert scenario.robot == station.robot
            assert scenario.motion == specimen.condition.motion
            assert isinstance(scenario.food, AnalyticFood) == specimen.condition.without_food
