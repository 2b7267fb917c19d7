"""`sliceit collect`: a protocol's slices on a station, in random order, as records."""

import numpy as np
import pytest

from sliceit_drake.cli.main import main
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import load_protocol, schedule
from sliceit_drake.stand_in.station_cuts import scenario_of_cut
from sliceit_drake.systems.analytic_cutter import AnalyticFood

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


def test_every_shipped_protocol_makes_scenarios_of_a_station():
    station = load_scenario(resource_path("scenarios/cucumber.yaml"))
    for file in resource_path("calibration/protocols").glob("*.yaml"):
        protocol = load_protocol(str(file))
        for specimen in schedule(protocol, np.random.default_rng(0)):
            scenario = scenario_of_cut(protocol, specimen, station)
            assert scenario.robot == station.robot
            assert scenario.motion == specimen.condition.motion
            assert isinstance(scenario.food, AnalyticFood) == specimen.condition.without_food
