"""`import sliceit_drake as sliceit`: its names, and what a user makes with them."""

import csv
import dataclasses as dc
import importlib.util
import inspect
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

import sliceit_drake as sliceit
from sliceit_drake.diagrams.run import prepare_run

ROOT = Path(__file__).resolve().parent.parent
COARSE = "{food: {shape: !Cylinder {rings: 2, layers: [0.0, 0.004, 0.012]}}}"
LEARN = {"train": "stable_baselines3", "learning.TrainingConfig": "stable_baselines3"}
FILES = {"record.csv", "replay.html", "force.png", "summary.json", "scenario.yaml"}


# --- The names.


def with_packages() -> dict[str, object]:
    """Names of the front door, and of its packages as PACKAGE.NAME, each with where it is found."""
    names: dict[str, object] = dict.fromkeys(sliceit.__all__, sliceit)
    for package in sorted(
        set(sliceit.__all__) & {path.name for path in Path(*sliceit.__path__).iterdir()}
    ):
        home = getattr(sliceit, package)
        names |= {f"{package}.{name}": home for name in home.__all__}
    return names


NAMES = with_packages()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.second_tier] if name in LEARN else [])
        for name in NAMES
    ],
)
def test_a_name_resolves_and_its_docstring_begins_with_what_it_is(name):
    if name in LEARN and importlib.util.find_spec(LEARN[name]) is None:
        pytest.skip(f"{name} is of the extra [learn]")
    words = inspect.getdoc(getattr(NAMES[name], name.rpartition(".")[2])) or ""
    assert words[:1].isupper()
    assert words.split()[0] not in ("Of", "What", "How", "Which", "All", name)
    assert not words.startswith(f"{name}(")  # As a dataclass without one has.


def test_a_user_sees_some_forty_names_first_and_each_name_in_one_place():
    assert 35 <= len(sliceit.__all__) <= 45
    names = [name.rpartition(".")[2] for name in NAMES]
    assert sorted(set(names)) == sorted(names)
    for name, home in NAMES.items():
        assert name.rpartition(".")[2] in dir(home)


def test_a_name_is_found_by_import_and_by_attribute():
    from sliceit_drake.hardware import UrClient
    from sliceit_drake.records import preprocessing

    assert UrClient is sliceit.hardware.UrClient
    assert preprocessing is sliceit.records.preprocessing
    names: dict = {}
    exec("from sliceit_drake.stand_in import *", names)
    assert names["Protocol"] is sliceit.stand_in.Protocol


def test_a_name_that_is_not_there_is_an_attribute_error():
    for home in (sliceit, sliceit.hardware):
        with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
            getattr(home, "simulat")  # noqa: B009


def test_a_plain_session_simulates_without_a_word_of_warp():
    code = (
        "import sliceit_drake as sliceit\n"
        f"run = sliceit.simulate('cucumber_measured', {COARSE!r}, duration=0.01)\n"
        "assert run.stopped is None"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# --- The programs of the docs.


def programs() -> list[str]:
    text = (ROOT / "docs/tutorials/programs.md").read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)


def run_program(number: int, folder: Path, monkeypatch) -> dict:
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(compile(programs()[number], "docs/tutorials/programs.md", "exec"), names)
    return names


def test_there_are_four_of_at_most_fifteen_lines_that_use_the_front_door():
    assert len(programs()) == 4
    for program in programs():
        assert len([line for line in program.splitlines() if line.strip()]) <= 15
        assert not re.search(r"from sliceit_drake|import sliceit_drake\.", program)


def test_a_policy_of_ones_own_moves_the_knife(tmp_path, monkeypatch):
    run_program(0, tmp_path, monkeypatch)
    folder = tmp_path / "output/saw"
    assert {file.name for file in folder.iterdir()} == FILES
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["own"] == {"policy": "Saw"} and summary["stopped"] is None
    assert summary["discretization_error"] is None
    with (folder / "record.csv").open() as file:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    time = np.array([row["time"] for row in rows])
    target = np.array([row["target_pose_p_z"] for row in rows])
    assert target[0] - target == pytest.approx(np.minimum(0.02 * time, 0.0372), abs=1e-6)
    # The blade lies along the world's y, as the scenario places the food.
    knife = np.array([row["knife_pose_p_y"] for row in rows])
    assert 0.015 < np.ptp(knife) < 0.021
    assert 3.0 < summary["peak_force_N"] < 30.0


def test_a_controller_of_ones_own_follows_the_motion(tmp_path, monkeypatch):
    run = run_program(1, tmp_path, monkeypatch)["run"]
    folder = tmp_path / "output/resolved_rate"
    assert {file.name for file in folder.iterdir()} == FILES
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["own"] == {"controller": "ResolvedRate"} and summary["stopped"] is None
    record = run.record()
    assert record["cut_progress"][-1] > 0.999
    # A tenth of the error each 2 ms: at 20 mm/s the command is 0.4 mm behind.
    moving = (record["time"] > 0.5) & (record["time"] < 1.5)
    behind = (record["commanded_pose_p_z"] - record["target_pose_p_z"])[moving]
    assert behind == pytest.approx(0.4e-3, abs=0.02e-3)


def test_a_cutting_system_of_ones_own_gives_the_force(tmp_path, monkeypatch):
    run_program(2, tmp_path, monkeypatch)
    folder = tmp_path / "output/dough"
    assert {file.name for file in folder.iterdir()} == FILES
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["own"] == {"cutting": "Dough"}
    record = np.genfromtxt(folder / "record.csv", delimiter=",", names=True)
    # 300 N s/m at 20 mm/s.
    inside = (record["time"] > 1.0) & (record["time"] < 1.5)
    assert record["food_wrench_f_z"][inside].mean() == pytest.approx(6.0, rel=0.05)
    assert "elements" not in summary and "measurement" in summary


def test_twenty_values_of_toughness_are_swept_and_drawn(tmp_path, monkeypatch):
    names = run_program(3, tmp_path, monkeypatch)
    folder = tmp_path / "output/toughness"
    assert {file.name for file in folder.iterdir()} == {"sweep.csv", "curves.csv", "sweep.png"}
    with (folder / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["food.material.toughness"]) for r in rows] == list(names["toughness"])
    peaks = np.array([float(row["peak_force_N"]) for row in rows])
    assert np.all(np.diff(peaks) > 0.0)
    # Toughness times the width of the cut, 27 mm, and friction.
    slope = np.polyfit(names["toughness"], peaks, 1)[0]
    assert 0.018 < slope < 0.027
    assert all(row["stopped"] == "" for row in rows)


# --- Scenarios.


def test_a_scenario_is_found_by_name_and_by_file_and_copied(tmp_path):
    by_name = sliceit.load_scenario("cucumber_measured")
    assert by_name == sliceit.load_scenario(
        sliceit.resource_path("scenarios/cucumber_measured.yaml")
    )
    copy = sliceit.load_scenario(by_name, {"food.material.toughness": 123.0})
    assert copy.food.material.toughness == 123.0 != by_name.food.material.toughness
    sliceit.dump_yaml(copy, tmp_path / "mine.yaml")
    assert sliceit.load_scenario(tmp_path / "mine.yaml") == copy
    with pytest.raises(sliceit.ConfigurationError, match="no such scenario.*cucumber_spring"):
        sliceit.load_scenario("cucumbre")


def test_overrides_are_text_a_dictionary_or_paths():
    nested = {"food": {"material": {"toughness": np.float64(200.0), "damping_time": 1e-5}}}
    text = "{food: {material: {toughness: 200.0, damping_time: 0.00001}}}"
    given = [sliceit.load_scenario("cucumber_measured", each) for each in (nested, text)]
    paths = {"food.material.toughness": 200.0, "food.material.damping_time": 1e-5}
    assert given[0] == given[1] == sliceit.load_scenario("cucumber_measured", paths)
    swept = sliceit.load_scenario(
        "cucumber_measured", {"motion.segments.0.speed": np.float64(0.05)}
    )
    assert swept.motion.segments[0].speed == 0.05
    for path in ("food.material.tougness", "motion.segments.9.speed", "food.material.toughness.x"):
        with pytest.raises(sliceit.ConfigurationError, match="there is no such field"):
            sliceit.load_scenario("cucumber_measured", {path: 1.0})
    with pytest.raises(sliceit.ConfigurationError, match="toughness"):
        sliceit.load_scenario("cucumber_measured", {"food.material.toughness": -1.0})


def test_a_named_food_can_be_changed_after_it_is_loaded_and_replaced_by_another():
    calibrated = sliceit.load_scenario("cucumber_measured", {"calibration": "cucumber"})
    tougher = sliceit.load_scenario(calibrated, {"food.material.toughness": 999.0})
    assert tougher.food.material.toughness == 999.0
    assert tougher.food.material.friction == calibrated.food.material.friction
    potato = sliceit.load_scenario(tougher, {"calibration": "potato"})
    assert potato.food.material == sliceit.load_calibrated_food("potato").food.material
    knives = sliceit.load_scenario(
        sliceit.load_scenario("cucumber_measured", {"knife_name": "nakiri"}), {"knife_name": "chef"}
    )
    assert knives.knife == sliceit.cutting.load_knife("chef").knife


@pytest.mark.parametrize(
    "changes",
    [
        "food.material.toughness=400",
        "{food: {material: {toughness: 400}}}",
        "food={material: {toughness: 400}}",
        {"food.material.toughness": 400},
        {"food": {"material": {"toughness": 400}}},
        {"food.material": {"toughness": 400}},
    ],
)
def test_a_change_of_a_named_food_is_simulated_in_all_its_forms_and_from_its_file(
    changes, tmp_path
):
    changed = sliceit.load_scenario("apple", changes)
    apple = sliceit.load_calibrated_food("apple").food.material
    assert changed.food.material == dc.replace(apple, toughness=400.0)
    sliceit.dump_yaml(changed, tmp_path / "scenario.yaml")
    assert sliceit.load_scenario(tmp_path / "scenario.yaml") == changed


def test_a_name_that_is_set_in_python_is_put_in_once():
    scenario = sliceit.load_scenario("cucumber_measured")
    scenario.calibration, scenario.knife_name = "potato", "nakiri"
    loaded = sliceit.load_scenario(scenario)
    assert loaded.food.material == sliceit.load_calibrated_food("potato").food.material
    assert loaded.knife == sliceit.cutting.load_knife("nakiri").knife
    loaded.food.material.toughness = 5.0
    assert sliceit.load_scenario(dc.replace(loaded, seed=1)).food.material.toughness == 5.0
    scenario.calibration = "no food"
    with pytest.raises(sliceit.ConfigurationError, match="calibration: 'no food'"):
        sliceit.load_scenario(scenario)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("controller.p_gains.0=[1]", r"p_gains\[0\]: is a list. Give a number"),
        ("controller.p_gains.0=[1,", "not valid YAML"),
        ("motion.segments.0=3", r"segments\[0\]: expected named fields"),
        ({"controller.dead_zones": "maybe"}, "controller.dead_zones"),
        ({"food.material": {"toughnes": 300}}, 'Did you mean "toughness"'),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_whatever_gives_it(changes, message):
    with pytest.raises(sliceit.ConfigurationError, match=message):
        sliceit.load_scenario("cucumber_measured", changes)


def test_an_element_of_a_list_is_replaced_as_its_type_is_written():
    found = sliceit.load_scenario(
        "cucumber_measured", "motion.segments.0=!Hold {duration: 1.0}, controller.p_gains.0=2e2"
    )
    assert type(found.motion.segments[0]).__name__ == "Hold"
    assert found.controller.p_gains[0] == 200.0


@pytest.mark.parametrize("duration", [math.nan, 0.0, -1.0, math.inf])
def test_a_duration_that_is_none_is_refused(duration):
    with pytest.raises(sliceit.ConfigurationError, match="duration: is .*above 0 s"):
        sliceit.simulate("cucumber_spring", duration=duration, replay=False)


# --- What is put in.


class Still(LeafSystem):
    """Stays where it is."""

    def __init__(self, station, port="target_pose", inputs=()):
        super().__init__()
        for name in inputs:
            self.DeclareAbstractInputPort(name, Value(RigidTransform()))
        pose = Value(station.start_pose)
        self.DeclareAbstractOutputPort(port, lambda: pose, lambda context, output: None)


class Gentle:
    """Presses the slower the more force it feels."""

    def decide(self, observation):
        force = np.linalg.norm(observation.wrenches[-1, 3:])
        return sliceit.PolicyAction(draw=0.0, press=0.03 / (1.0 + force / 5.0))


def test_what_decides_is_a_policy_too():
    run = sliceit.simulate("cucumber_measured", COARSE, policy=Gentle(), duration=1.0, replay=False)
    assert run.own == {"policy": "Gentle"} and run.stopped is None
    assert 0.2 < run.record()["cut_progress"][-1] < 0.6
    assert run.meshcat is None and run.plot() is not None


def test_what_cannot_decide_is_no_policy():
    with pytest.raises(sliceit.ConfigurationError, match="policy: str has no method decide"):
        sliceit.simulate("cucumber_spring", policy="PressByForce", replay=False)


def test_a_policy_of_ones_own_under_limits_of_ones_own_is_saved(tmp_path):
    policy = sliceit.PolicyConfig(decide=Gentle(), draw=0.01, duration=10.0)
    run = sliceit.simulate("cucumber_measured", COARSE, policy=policy, duration=0.02, replay=False)
    assert run.own == {"policy": "Gentle"}
    run.save(tmp_path)
    # A file cannot say the policy; its limits it can.
    assert sliceit.load_scenario(tmp_path / "scenario.yaml").policy.draw == 0.01


def test_a_configured_policy_takes_the_place_of_the_motion(tmp_path):
    policy = sliceit.PolicyConfig(duration=2.4)
    run = sliceit.simulate("cucumber_measured", COARSE, policy=policy, duration=0.02, replay=False)
    assert run.scenario.policy == policy and run.own == {}
    run.save(tmp_path)
    assert sliceit.load_scenario(tmp_path / "scenario.yaml").policy == policy


def test_a_policy_that_does_not_fit_is_refused_by_its_ports():
    scenario = sliceit.load_scenario("cucumber_spring")
    with pytest.raises(sliceit.ConfigurationError, match="no output port 'target_pose'"):
        prepare_run(scenario, policy=lambda station: Still(station, "pose"))
    with pytest.raises(sliceit.ConfigurationError, match="'wrench', which a station does not give"):
        prepare_run(scenario, policy=lambda station: Still(station, inputs=["wrench"]))


def test_a_controller_of_ones_own_is_put_in_and_named(tmp_path):
    from sliceit_drake.diagrams.station_interface import make_controller

    scenario = sliceit.load_scenario("cucumber_spring")
    run = sliceit.simulate(
        scenario,
        policy=Still,
        controller=lambda scenario: make_controller(scenario, None),
        duration=0.01,
    )
    summary = run.save(tmp_path)
    assert summary["own"] == {"policy": "Still", "controller": "ComplianceController"}
    assert summary["contact_margin"] is None
    assert {file.name for file in tmp_path.iterdir()} == FILES
    knife = run.record().vector("knife_pose_p")
    assert knife == pytest.approx(np.broadcast_to(knife[0], knife.shape), abs=1e-3)


# --- Sweeps.


def test_a_sweep_in_the_station_and_one_without_a_robot_agree():
    values = {"food.material.toughness": [200.0, 400.0]}
    station = sliceit.sweep("cucumber_measured", values, COARSE)
    alone = sliceit.sweep("cucumber_measured", values, COARSE, robot=False)
    assert station.peaks == pytest.approx(alone.peaks, rel=0.01)
    assert station.peaks[0] < 0.8 * station.peaks[1]


def test_several_fields_make_a_grid_and_what_cannot_start_says_why(tmp_path):
    done = []
    found = sliceit.sweep(
        "cucumber_measured",
        {
            "calibration": ["cucumber", "potato"],
            "food.cut_point": [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]],
        },
        COARSE,
        robot=False,
        progress=lambda count, of: done.append((count, of)),
    )
    assert found.peaks.shape == (2, 2) and np.isfinite(found.peaks[:, 0]).all()
    assert np.isnan(found.peaks[:, 1]).all()
    assert "plane" in found.slices[1].stopped
    assert done[-1] == (4, 4)
    found.save(tmp_path)
    assert (tmp_path / "sweep.png").stat().st_size > 10_000


def test_a_sweep_that_makes_no_sense_is_refused():
    with pytest.raises(sliceit.ConfigurationError, match="has no values"):
        sliceit.sweep("cucumber_measured", {"food.material.toughness": []})
    with pytest.raises(sliceit.ConfigurationError, match="there is no such field"):
        sliceit.sweep("cucumber_measured", {"food.material.tougness": [1.0]})
    for name, field in (("cucumber_sequence", "sequence"), ("cucumber_policy", "policy")):
        with pytest.raises(sliceit.ConfigurationError, match=f"{field}: needs the robot"):
            sliceit.sweep(name, {"seed": [0]}, robot=False)
    with pytest.raises(sliceit.ConfigurationError, match="no finite elements"):
        sliceit.sweep("cucumber_spring", {"seed": [0]}, robot=False)
    with pytest.raises(sliceit.ConfigurationError, match="bench: is of a station"):
        sliceit.sweep("cucumber_measured", {"bench.board.height": [0.0, 1e-3]}, robot=False)
