"""What a newcomer meets in the program: its messages, its results, its end."""

import argparse
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from emulator_bench import free_address

from sliceit_drake.cli import doctor
from sliceit_drake.cli.main import main, run_program
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.diagrams.outputs.animation import Film
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.hardware.hardware_config import load_hardware_config
from sliceit_drake.learning.training_config import load_training
from sliceit_drake.output_folder import remove_results, results_in
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import load_protocol

SMALL = "food.shape.rings=3,food.shape.layers=[0.0, 0.004, 0.012]"
QUICK = ["--set", SMALL, "--no-replay", "--no-animation"]
BRIEF = [*QUICK, "--duration", "0.05"]

MISTAKES = {
    # The scenario.
    "a scenario's name misspelt": (["cucmber"], 'Did you mean "cucumber"?'),
    "a food's name": (["tomato"], 'Did you mean "tomato_sequence", which cuts a tomato?'),
    "a knife's name": (["nakiri"], "It is a knife: sliceit simulate --set knife_name=nakiri"),
    "a calibrated food": (
        ["calibration/foods/tomato.yaml"],
        r"is a calibrated food, and not a scenario.*--set calibration=\S*tomato.yaml",
    ),
    "a knife's file": (["calibration/knives/chef.yaml"], r"is a knife.*--set knife_name="),
    "a protocol": (["calibration/protocols/rich.yaml"], "is a protocol.*sliceit record"),
    "a setup": (["calibration/setups/tomato.yaml"], "sliceit calibrate RECORDS --food"),
    "the facts of a record": (["calibration/records/tomato.yaml"], "sliceit records check"),
    "a robot's file": (["hardware/ur5e.yaml"], "describes a robot.*--robot"),
    "a record's table": (["calibration/records/tomato.csv"], "a scenario is a YAML file"),
    "a folder": (["calibration"], "is a folder, not a scenario. Give a YAML file, or one of"),
    # Fields.
    "a field without its path": (["--set", "toughness=400"], 'mean "food.material.toughness"'),
    "the same as YAML": (["--set", "{toughness: 400}"], "Write it as a path: --set food.mater"),
    "a path misspelt": (
        ["--set", "food.material.tougness=400"],
        r'scenario.food.material.tougness: there is no such field. Did you mean "food.material.to',
    ),
    "a path without a value": (["--set", "knife.height"], "Write knife.height=VALUE"),
    "text for a number": (["--set", "food.material.toughness=high"], "is 'high'. Give a number"),
    "millimetres": (["--set", "food.shape.diameter=27"], "Is it in mm. Write 0.027"),
    "a negative value": (["--set", "food.material.density=-1"], "-1 kg/m3 is not within"),
    "an element that is not there": (["--set", "motion.segments.9.speed=1"], "no such field"),
    "the second of two": (
        ["--set", "food.material.toughness=300, food.material.frction=0.1"],
        'Did you mean "food.material.friction"',
    ),
    "a whole field": (["--set", "board=3"], "sliceit: --set, line 1: scenario.board: expected"),
    "a food by name": (["--set", "food=tomato"], "given as calibration=NAME"),
    "a food misspelt": (["--set", "calibration=tomatoe"], 'Did you mean "tomato"'),
    "a knife misspelt": (["--set", "knife_name=nakri"], 'Did you mean "nakiri"'),
    "a tag misspelt": (["--set", "food.shape=!Cilinder {}"], 'Did you mean "!Cylinder"'),
    "a missing tag": (
        ["--set", "{food: {stiffness: 500}}"],
        "It is a field of !AnalyticFood, !SpringFood. Without a tag this is !Food",
    ),
    "out of reach": (
        ["--set", "placement.position=[1.5, -1.5]"],
        r"comes within 1\.\d+ m and \d\.\d degrees",
    ),
    "a leaning cut": (
        ["--set", "food.cut_normal=[0, 1, 1]"],
        "scenario.food.cut_normal.*the cut leans by 45 degrees",
    ),
    # Options.
    "no duration": (["--duration", "-1"], "--duration: -1.0 s is not a duration"),
    "an endless duration": (["--duration", "inf"], "--duration: inf s is not a duration"),
}


FILES = {
    "of another program": ("version: 3\nservices: {web: 1}\n", "has none of a scenario's fields"),
    "with a field at the wrong place": (
        "name: mine\ntoughness: 400\n",
        r'line 2: .*Did you mean "food.material.toughness".* Write it below food.material\.',
    ),
    "with a misspelt field at depth": (
        "motion:\n  segments:\n    - !Hold {}\n    - !ConstantSpeed {distnce: 0.03}\n",
        r'line 4: scenario.motion.segments\[1\].distnce: .*Did you mean "distance"',
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_a_file_that_is_wrong_is_named_with_line_field_and_fix(case, tmp_path, capsys):
    text, message = FILES[case]
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    assert main(["simulate", str(tmp_path / "mine.yaml"), "--output", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err
    assert "mine.yaml" in shown and re.search(message, shown), shown


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_gets_a_message_that_says_what_to_do(case, tmp_path, capsys):
    given, message = MISTAKES[case]
    scenario = [] if given[0][0] != "-" else ["cucumber_measured"]
    options = ["--no-replay", "--no-animation", "--output", str(tmp_path / "out")]
    assert main(["simulate", *scenario, *given, *options]) == 2
    shown = capsys.readouterr().err
    assert re.search(message, shown, re.S), shown
    assert shown.startswith("sliceit: ") and "Traceback" not in shown
    assert "Without a tag" not in shown or case == "a missing tag"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["record", "--seed", "-1"], "--seed: is -1. Give at least 0"),
        (["record", "--workers", "0"], "--workers: is 0. Give 1 to 10000"),
        (["record", "--refinement", "0"], "settings.refinement: 0 is not within"),
        (["record", "--time-step", "0"], "settings.time_step: 0 s is not within"),
        (["record", "calibration/records/cucumber.csv"], "is a .csv file"),
        (["record", "pour"], "there is no such scenario.* Or give a protocol: full, poor, rich"),
        (["collect", "pour"], "or one of full, poor, rich"),
        (["collect", "--first", "-1"], "--first: is -1. Give at least 1"),
        (["collect", "--seed", "-1"], "--seed: is -1. Give at least 0"),
        (["calibrate", "x.csv", "--food", "tomato", "--seed", "-1"], "--seed: is -1"),
        (["calibrate", "x.csv", "--food", "nowhere/x.yaml"], "There is no folder nowhere either"),
        (["calibrate", "x.csv", "--food", "scenarios/cucumber.yaml"], "line 2: .*unknown field"),
        (["diagnose", "calibration/records", "--model", "tomato", "--seed", "-1"], "--seed"),
        (["evaluate", "models/policies/cutting_0", "--slices", "0"], "--slices: is 0"),
        (["evaluate", "models/policies/cutting_0", "--board-stiffness", "-3"], "stiffness: is -3"),
        (["optimize-motion", "cucumber_measured", "--iterations", "0"], "--iterations: is 0"),
        (["diagram", "--depth", "-1"], "--depth: is -1. Give at least 0"),
    ],
)
def test_values_of_options_that_make_no_sense_are_refused(
    given, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    output = {"evaluate": "out.jsonl", "diagram": "out.dot"}.get(given[0], "out")
    assert main([*given, "--output", output]) == 2
    shown = capsys.readouterr().err
    assert re.search(message, shown) and shown.startswith("sliceit: "), shown
    assert list(tmp_path.rglob("*.*")) == []


@pytest.mark.parametrize(
    "command", [["record", "--list-effects"], ["simulate", *BRIEF, "--output", "out"]]
)
@pytest.mark.parametrize("end", ["| head -0", ">&-", "2>&-", ">&- 2>&-"])
def test_a_command_does_what_it_shall_though_nobody_reads(command, end, tmp_path):
    program = [sys.executable, "-c", "from sliceit_drake.cli.main import main; exit(main())"]
    line = f"set -o pipefail; {shlex.join([*program, *command])} {end}"
    done = subprocess.run(
        ["bash", "-c", line], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0 and "Error" not in done.stderr, done.stderr
    assert command[0] == "record" or "force.png" in results_in(tmp_path / "out")


def test_a_robot_stops_when_nobody_reads_what_it_says():
    def say(_):
        raise BrokenPipeError

    parser = argparse.ArgumentParser()
    parser.set_defaults(run=say, host="10.0.0.5")
    with pytest.raises(BrokenPipeError):
        run_program(parser, [])


def test_a_fault_at_no_time_is_refused(capsys):
    given = ["emulate", "--arm-alone", "--address", free_address(), "--inject", "silence@soon"]
    assert main(given) == 2
    assert "--inject: 'soon' is no time. Write silence@2.5" in capsys.readouterr().err


def test_a_scenario_in_the_place_of_a_command_is_recognised(capsys):
    for given in ("cucumber", "mine.yaml"):
        with pytest.raises(SystemExit, match="2"):
            main([given])
        assert f'Did you mean "sliceit simulate {given}"?' in capsys.readouterr().err


def test_an_output_may_be_in_the_home_folder_and_is_not_empty(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    shutil.copy(resource_path("scenarios/cucumber_measured.yaml"), tmp_path / "mine.yaml")
    assert main(["simulate", "~/mine.yaml", *BRIEF, "--output=~/out"]) == 0
    assert results_in(tmp_path / "out") and not (tmp_path / "~").exists()
    with pytest.raises(SystemExit, match="2"):
        main(["simulate", "--output", ""])
    assert "--output: is empty: give a path" in capsys.readouterr().err


def test_a_record_that_is_not_there_is_named_as_it_was_given(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "mine.csv", "--food", "tomato", "--output", "out"]) == 2
    assert "mine.csv: there is no such record" in capsys.readouterr().err


NO_NAMES = ["..", ".", "", "a\0b", "a\nb", "../../mine", "/mine", "mine/"]


@pytest.mark.parametrize("name", NO_NAMES)
@pytest.mark.parametrize(
    "command",
    ["simulate", "record", "record PROTOCOL", "collect", "hardware", "hardware --commission"],
)
def test_a_name_that_leads_out_of_the_folder_of_outputs_is_refused(
    command, name, tmp_path, capsys, monkeypatch
):
    folder = tmp_path / "work" / "place"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    # What a run would take for its own earlier results, and replace.
    mine = [place / "record.csv" for place in (folder, folder.parent, tmp_path)]
    for file in mine:
        file.write_text("mine", encoding="utf-8")
    if command in ("collect", "record PROTOCOL"):
        config = load_protocol(str(resource_path("calibration/protocols/poor.yaml")))
    else:
        config = load_scenario("cucumber_measured")
    config.name = name
    text = dump_yaml(config)
    (folder / "a.yaml").write_text(text, encoding="utf-8")
    there = sorted(tmp_path.rglob("*"))
    verb, *options = command.replace(" PROTOCOL", "").split()
    assert main([verb, "a.yaml", *options]) == 2
    said = f"{name!r} is no name for the folder of the results"
    # A scenario's name is that of its one condition too.
    said = "Give the condition a name" if (command, name) == ("record", "") else said
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == there
    assert {file.read_text(encoding="utf-8") for file in mine} == {"mine"}


def test_a_walk_with_a_robot_is_no_dry_run_and_connects_to_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(socket, "socket", None)
    monkeypatch.setattr("sliceit_drake.robot_run.operated_robot.OperatedRobot.connected", None)
    given = ["hardware", "cucumber_measured", "--host", "127.0.0.1", "--commission", "--dry-run"]
    assert main(given) == 2
    assert "--dry-run: does not go with --commission" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_protocol_and_a_scenario_go_by_their_names(tmp_path, capsys, monkeypatch):
    made = []
    monkeypatch.setattr(
        "sliceit_drake.stand_in.session.record_session",
        lambda protocol, *_: made.append((protocol.name, len(protocol.conditions))) or [],
    )
    for name in ("poor", "cucumber_measured"):
        assert main(["record", name, "--output", str(tmp_path)]) == 0
    assert made == [("poor", 1), ("cucumber_measured", 1)]


def test_other_commands_say_what_is_meant_too(tmp_path, capsys):
    for given, message in (
        (["record", "--effect", "friktion"], "is no effect"),
        (["record", "--effect", "flank_frction"], 'Did you mean "flank_friction"'),
        (["calibrate", "x.csv", "--food", "tomatto"], 'Did you mean "tomato"'),
        (["diagnose", str(tmp_path), "--model", "tomatto"], 'Did you mean "tomato"'),
    ):
        assert main([*given, "--output", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    for given, message in (
        (["simulat"], 'Did you mean "simulate"?'),
        (["simulate", "--ouput", "x"], 'Did you mean "--output"?'),
        (["simulate", "--paraview", "vtk"], 'Did you mean "vtu"?'),
        (["simulate", "--set", "start.clearance", "=", "0.01"], "Write FIELD=VALUE without spaces"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(given)
        assert message in capsys.readouterr().err


def test_what_a_run_left_suggests_its_scenario(tmp_path, capsys):
    (tmp_path / "scenario.yaml").touch()
    (tmp_path / "force.png").touch()
    for given in (tmp_path, tmp_path / "force.png"):
        assert main(["simulate", str(given)]) == 2
        assert f"Give {tmp_path / 'scenario.yaml'}." in capsys.readouterr().err


def test_a_mesh_is_told_apart_from_a_scenario(tmp_path, capsys):
    (tmp_path / "pear.msh").touch()
    assert main(["simulate", str(tmp_path / "pear.msh")]) == 2
    assert "!MeshFile {path: " in capsys.readouterr().err


def test_overrides_are_paths_or_yaml_and_both_together():
    texts = ["food.material.toughness=300, motion.segments.0.speed=0.05", "{board: {height: 0.04}}"]
    found = load_scenario("cucumber_measured", [*texts, "calibration=tomato"])
    assert found.food.material.toughness == 300.0
    assert found.motion.segments[0].speed == 0.05
    assert found.board.height == 0.04
    # A food by name stands below what is set in it.
    assert found.food.material.youngs_modulus != load_scenario("cucumber").food.material.toughness
    shape = load_scenario("cucumber", "food.shape=!Box {}").food.shape
    assert type(shape).__name__ == "Box"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *(
            pytest.param(["train", *given], message, marks=pytest.mark.second_tier)  # Has torch.
            for given, message in [
                (["--set", "task.food=[potato]"], r'task.food: .*Did you mean "task.foods"'),
                (["--set", "{foods: [potato]}"], "as a path: --set task.foods=VALUE"),
                (["--steps", "-5"], "steps: -5 is not within"),
                (["--set", "zzz=3"], "zzz: there is no such field. Known: task, steps"),
            ]
        ),
        (["hardware", "--set-robot", "touch.sped=1"], 'Did you mean "touch.speed"'),
        (["hardware", "--set-robot", "{speed: 1}"], "as a path: --set-robot touch.speed=VALUE"),
        (["hardware", "--set-robot", "touch.speed=1"], "1 m/s is not within"),
    ],
)
def test_every_option_that_replaces_fields_takes_paths(given, message, tmp_path, capsys):
    given += ["--host", "127.0.0.1"] if given[0] == "hardware" else []
    assert main([*given, "--output", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err
    assert re.search(message, shown), shown


def test_fields_of_a_training_and_of_a_robot_are_replaced_by_paths_and_yaml():
    training = load_training(None, ["task.foods=[potato], steps=30", "{seed: 4}"])
    assert (training.task.foods, training.steps, training.seed) == (["potato"], 30, 4)
    file = resource_path("hardware/ur5e.yaml")
    robot = load_hardware_config(file, ["touch.speed=0.01, payload=1.0", "{gain: 1000.0}"])
    assert (robot.touch.speed, robot.payload, robot.gain) == (0.01, 1.0, 1000.0)


def test_a_file_in_the_place_of_the_folder_is_refused_before_the_run(tmp_path, capsys):
    (tmp_path / "taken").touch()
    for command in (["simulate"], ["train"], ["record"]):
        assert main([*command, "--output", str(tmp_path / "taken")]) == 2
        shown = capsys.readouterr()
        assert shown.out == "" and "it is a file, and results go to a folder" in shown.err


def test_a_second_run_replaces_the_first_and_lists_its_own_files_alone(tmp_path, capsys):
    folder = tmp_path / "run"
    assert main(["simulate", *BRIEF, "--output", str(folder)]) == 0
    assert "earlier run" not in capsys.readouterr().out
    (folder / "paraview").mkdir()
    for name in ("replay.html", "slice.gif", "notes.txt", "paraview/run.pvd", "paraview/mine"):
        (folder / name).touch()
    assert main(["simulate", *BRIEF, "--output", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert "has the results of an earlier run, which this one replaces" in shown
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    own = {"force.png", "record.csv", "summary.json", "scenario.yaml"}
    assert kept == own | {"notes.txt", "paraview", "paraview/mine"}
    assert "notes.txt" not in shown and f"Open {folder / 'force.png'}" in shown


def test_a_folder_without_a_run_is_left_alone(tmp_path):
    (tmp_path / "scenario.yaml").touch()
    remove_results(tmp_path)
    assert results_in(tmp_path) == [] and (tmp_path / "scenario.yaml").exists()


def test_a_measured_curve_of_another_slice_is_warned_of(tmp_path, capsys):
    given = ["--set", "food.material.toughness=1500, food.cut_normal=[1, 1, 0]"]
    options = ["--duration", "0.8", "--output", str(tmp_path)]
    quick = ["--no-replay", "--no-animation"]
    assert main(["simulate", "cucumber_measured", *quick, *given, *options]) == 0
    shown = capsys.readouterr().out
    assert "Against the measured curve, which ends at a depth of" in shown
    assert "your change of food.material.toughness, food.cut_normal" in shown
    assert "food.shape" not in shown


def test_nothing_but_a_food_is_cut_through_whatever_its_height(tmp_path):
    file = tmp_path / "mine.yaml"
    shape = "!Cylinder {diameter: 0.034, length: 0.08, rings: 3, layers: [0.0, 0.004, 0.012]}"
    file.write_text(f"name: mine\nfood: {{shape: {shape}}}\n", encoding="utf-8")
    run = prepare_run(load_scenario(file))
    run.advance()
    assert run.stopped is None and run.record()["cut_progress"][-1] > 0.99


def test_a_cut_that_ends_above_the_board_says_what_to_change(tmp_path, capsys):
    given = ["--set", "motion.segments.0.distance=0.02", "--output", str(tmp_path)]
    assert main(["simulate", "cucumber_measured", *QUICK, *given]) == 0
    shown = capsys.readouterr().out
    assert "not cut through: " in shown and "motion.segments.0.distance" in shown
    lengthen = float(re.search(r"lengthen the way down by ([\d.]+) mm", shown)[1])
    assert lengthen == pytest.approx(17.0, abs=0.5)


def test_ctrl_c_while_results_are_written_keeps_what_is_there(tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Film, "draw", interrupt)
    monkeypatch.setattr("sliceit_drake.diagrams.run.can_draw", lambda: True)
    options = ["--set", SMALL, "--no-replay", "--duration", "0.05", "--output", str(tmp_path)]
    assert main(["simulate", *options]) == 130
    shown = capsys.readouterr()
    assert "interrupted. What is done is in" in shown.err and "starts again" in shown.err
    assert results_in(tmp_path) == ["force.png", "record.csv", "summary.json", "scenario.yaml"]
    assert json.loads((tmp_path / "summary.json").read_text())["scenario"]


@pytest.mark.parametrize("module", ["argparse", "numpy", "pydrake.common", "matplotlib"])
def test_ctrl_c_during_imports_is_no_traceback(module, tmp_path):
    code = (
        "import os, signal, sys\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        # Who runs the tests in the background may have it ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sliceit_drake.cli import start\n"
        "sys.exit(start())"
    )
    options = ["--set", SMALL, "--no-replay", "--duration", "0.05", "--output", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", code, "simulate", *options], capture_output=True, text=True
    )
    assert done.returncode == 130, done.stderr
    assert "sliceit: interrupted" in done.stderr and "Traceback" not in done.stderr


def test_warp_says_nothing_in_a_program_of_ones_own_unless_asked():
    code = (
        "import sliceit_drake as sliceit\n"
        "food = {'food.shape.rings': 2, 'food.shape.layers': [0.0, 0.004, 0.012]}\n"
        "sliceit.simulate('cucumber_measured', food, duration=0.01, replay=False)\n"
        "short = food | {'motion.segments': []}\n"
        "sliceit.sweep('cucumber_measured', {'food.material.toughness': [300.0, 400.0]},\n"
        "    '{motion: {segments: [!Hold {duration: 0.01}]}}', robot=False)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "SLICEIT_VERBOSE"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "" and done.stderr == ""
    code = "from sliceit_drake.cutting.warp_start import start_warp; start_warp()"
    environment["SLICEIT_VERBOSE"] = "1"
    loud = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    assert b"Warp 1." in loud.stdout + loud.stderr


def test_versions_are_those_of_all_that_matters(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    shown = capsys.readouterr().out
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    for name in (f"sliceit_drake {project['version']}\n", "drake 1", "warp-lang 1", "numpy "):
        assert name in shown


def test_the_doctor_finds_what_is_there_and_says_how_to_install_the_rest(monkeypatch, capsys):
    monkeypatch.setattr("sliceit_drake.diagrams.outputs.animation.can_draw", lambda: False)
    lacking = {"": [], "learn": ["torch"]}
    monkeypatch.setattr(doctor, "_lacking", lambda extra: lacking.get(extra, []))
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert "pip install -e '.[learn]'" in shown and "apt install libegl1" in shown
    assert "`sliceit simulate` can run here" in shown
    lacking[""] = ["drake>=99 (found 1.51.1)"]
    assert main(["doctor"]) == 1
    assert "MISSING packages" in capsys.readouterr().out


def test_evaluation_needs_no_torch(tmp_path):
    code = (
        "import sys, importlib.abc\n"
        "class Block(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.split('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Block())\n"
        "from sliceit_drake.cli.main import main\n"
        "exit(main())\n"
    )
    policy = str(resource_path("models/policies/cutting_0"))
    for command, status in (
        (["evaluate", policy, "--world", "curves", "--foods", "cucumber", "--slices", "1"], 0),
        (["train"], 2),
    ):
        arguments = [*command, "--output", str(tmp_path / f"{command[0]}.jsonl")]
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments], capture_output=True, text=True
        )
        assert done.returncode == status and "Traceback" not in done.stderr, done.stderr


def test_a_table_without_its_facts_says_the_next_step(tmp_path, capsys):
    (tmp_path / "run.csv").write_text("time,food_wrench_f_z\n0.0,1.0\n", encoding="utf-8")
    for given in (["records", "check"], ["calibrate", "--food", "cucumber"]):
        output = ["--output", str(tmp_path / "out")] if given[0] == "calibrate" else []
        assert main([*given, str(tmp_path / "run.csv"), *output]) in (1, 2)
        shown = "".join(capsys.readouterr())
        assert "has no run.yaml beside it" in shown and "sliceit records import force" in shown


def test_a_warning_of_a_record_says_so_once(capsys):
    record = Path("calibration/records/cucumber.csv")
    assert main(["records", "check", str(record)]) == 0
    shown = capsys.readouterr().out
    assert "warning: " in shown and "warning: warning" not in shown
