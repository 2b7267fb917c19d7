"""`sliceit hardware` against `sliceit emulate`, over TCP with ur_rtde, beside `sliceit simulate`.

The emulated controller is the clock and waits for each command (`--lockstep`), and the pace that
the client is told lets the machine pause for two seconds: a slow machine makes these tests slow,
not wrong.
"""

import json
import re
import time

import numpy as np
import pytest
from hardware_bench import (
    CUCUMBER,
    SLICE,
    emulated,
    run_hardware,
)

from sliceit_drake.cli.main import main
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run import operated_robot
from sliceit_drake.systems.policy import PressByForce

pytestmark = [pytest.mark.second_tier, pytest.mark.usefixtures("no_test_hangs")]

SPRING = resource_path("scenarios/cucumber_spring.yaml")
CUCUMBER_POLICY = resource_path("scenarios/cucumber_policy.yaml")
POLICY = """{
  food: {shape: !Cylinder
    {diameter: 0.027, length: 0.12, rings: 2, layers: [0.0, 0.006, 0.0095, 0.012]}},
  start: {clearance: 0.002},
  policy: {duration: 1.2, press: 0.0292, draw: 0.005, speed: 0.08, decide:
    {fastest: 0.04, force: 25.0, draw_ratio: 0.2, cut_time: 0.8, lift_speed: 0.06}}}"""
BARE_BOARD = """food: !AnalyticFood {diameter: 0.006, toughness: 0.0}, start: {clearance: 0.003},
  measurement: null, motion: {segments: [
    !ConstantSpeed {distance: 0.009, speed: 0.03, acceleration: 0.5, label: board},
    !Hold {duration: 0.2, label: hold},
    !Retract {distance: 0.009, speed: 0.05, acceleration: 0.5, label: retract}]}"""


def with_board_at(height):
    return f"{{{BARE_BOARD}, board: {{height: {height}}}}}"


def read(directory):
    return np.genfromtxt(directory / "record.csv", delimiter=",", names=True)


def sensor_force(record):
    return np.column_stack([record[f"sensor_wrench_f_{axis}"] for axis in "xyz"])


def difference(real, simulated):
    """RMS of the difference of two records' sensor forces over the RMS of the simulated one."""
    assert abs(real["time"][-1] - simulated["time"][-1]) < 0.01
    wanted = np.column_stack(
        [np.interp(real["time"], simulated["time"], force) for force in sensor_force(simulated).T]
    )
    return np.linalg.norm(sensor_force(real) - wanted) / np.linalg.norm(wanted)


def test_a_robot_slices_over_the_network_as_the_simulation_does(tmp_path, monkeypatch, capsys):
    simulated = ["simulate", str(CUCUMBER), "--set", SLICE, "--output", str(tmp_path / "simulated")]
    assert main([*simulated, "--no-replay"]) == 0
    with emulated() as emulator:
        assert run_hardware(emulator, tmp_path / "real", monkeypatch, ["slice"]) == 0
        status = emulator.pendant.status()
    assert not emulator.is_running
    real, wanted = read(tmp_path / "real"), read(tmp_path / "simulated")
    timing = json.loads((tmp_path / "real" / "summary.json").read_text())["robot"]
    with capsys.disabled():
        print(
            f"\n{100 * difference(real, wanted):.2f} % RMS of force apart, "
            f"{timing['missed_cycles']} of {timing['cycles']} cycles missed"
        )
    assert np.abs(sensor_force(wanted)).max() > 8.0
    assert difference(real, wanted) < 0.05
    # It ended on its own: the program is stopped, the arm stands.
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"
    assert np.abs(status["velocities"]).max() < 1e-3


def test_a_policy_drives_the_robot_as_it_drives_the_simulation(tmp_path, monkeypatch, capsys):
    simulated = ["simulate", str(CUCUMBER_POLICY), "--set", POLICY]
    assert main([*simulated, "--output", str(tmp_path / "simulated"), "--no-replay"]) == 0
    with emulated(CUCUMBER_POLICY, POLICY) as emulator:
        code = run_hardware(
            emulator, tmp_path / "real", monkeypatch, ["slice"], scenario=CUCUMBER_POLICY,
            overrides=POLICY,
        )  # fmt: skip
    assert code == 0
    real, wanted = read(tmp_path / "real"), read(tmp_path / "simulated")
    timing = json.loads((tmp_path / "real" / "summary.json").read_text())["robot"]
    assert "PressByForce decides every 0.05 s" in capsys.readouterr().out
    with capsys.disabled():
        print(
            f"\n{100 * difference(real, wanted):.2f} % RMS of force apart, "
            f"{timing['missed_cycles']} of {timing['cycles']} cycles missed"
        )
    assert difference(real, wanted) < 0.05
    # What it did followed from the force: in the food it slowed down.
    depth = real["target_pose_p_z"][0] - real["target_pose_p_z"]
    assert 0.01 < depth.max() < 0.9 * 0.04 * 0.8
    assert np.abs(sensor_force(wanted)).max() > 8.0


def test_a_policy_that_decides_too_late_stops_the_robot_and_is_named(tmp_path, monkeypatch, capsys):
    decide = PressByForce.decide

    def sometimes_slow(policy, observation):
        # In lockstep the emulator waits for 1 s, and then goes on at its pace.
        if observation.time > 0.19:
            time.sleep(2.0)
        return decide(policy, observation)

    monkeypatch.setattr(PressByForce, "decide", sometimes_slow)
    with emulated(CUCUMBER_POLICY, POLICY) as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["slice"], scenario=CUCUMBER_POLICY, overrides=POLICY
        )
        status = emulator.pendant.status()
    printed = capsys.readouterr().out
    assert code == 1
    assert re.search(r"STOPPED: policy at controller time .*: the policy takes 0\.04", printed)
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"
    assert np.abs(status["velocities"]).max() < 1e-3
    # The record is kept, up to the decision that came too late.
    assert read(tmp_path)["time"][-1] == pytest.approx(0.2, abs=0.02)


def test_the_touch_finds_a_lifted_board_and_refuses_the_height_that_was_given(
    tmp_path, monkeypatch, capsys
):
    with emulated(overrides=with_board_at(0.053)) as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["move", "touch", "slice"], "--touch",
            "--move-to-start", overrides=with_board_at(0.05),
        )  # fmt: skip
        status = emulator.pendant.status()
    printed = capsys.readouterr()
    assert code == 2
    found = re.search(r"board_height: is 0.0500 m, but .* at ([\d.]+) m", printed.err)
    assert found, printed.out + printed.err
    assert float(found[1]) == pytest.approx(0.053, abs=5e-4)
    # It is back where it began, and stopped.
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"
    assert not (tmp_path / "record.csv").exists()


def test_a_board_found_near_the_expected_height_is_the_one_that_is_run_on(
    tmp_path, monkeypatch, capsys
):
    with emulated(overrides=with_board_at(0.0496)) as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["touch", "slice"], "--touch",
            overrides=with_board_at(0.05),
        )  # fmt: skip
    printed = capsys.readouterr()
    assert code == 0, printed.out + printed.err
    with capsys.disabled():
        print("\n" + re.search(r"The board is at.*", printed.out)[0])
    lowest = read(tmp_path)["knife_pose_p_z"].min()
    assert lowest == pytest.approx(0.0496, abs=2e-4)


@pytest.mark.parametrize(
    ("board", "robot", "said"),
    [
        (0.04, "touch: {speed: 0.01}", "nothing was touched down to 0.045"),
        # The board is where it should be: the force goes on rising while the arm comes to rest.
        (0.05, "touch: {force_limit: 6.0}", "STOPPED: force .*the tool meets a force: [67]"),
    ],
    ids=["no board", "force"],
)
def test_a_touch_that_fails_stops_the_robot_and_says_why(
    board, robot, said, tmp_path, monkeypatch, capsys
):
    with emulated(overrides=with_board_at(board)) as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["move", "touch", "slice"], "--touch",
            "--move-to-start", overrides=with_board_at(0.05), robot=robot,
        )  # fmt: skip
        status = emulator.pendant.status()
    printed = capsys.readouterr().out
    assert code == 1 and re.search(said, printed), printed
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"
    assert not (tmp_path / "record.csv").exists()


@pytest.mark.parametrize("typed", [["slice", "retreat"], ["slice", "no"]], ids=["word", "no word"])
def test_after_a_breach_of_force_the_knife_goes_back_if_the_operator_says_so(
    typed, tmp_path, monkeypatch, capsys
):
    with emulated(SPRING, "measurement: null") as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, typed, "--set-robot", "limits.force=6",
            scenario=SPRING, overrides="measurement: null",
        )  # fmt: skip
        status, trace = emulator.pendant.status(), np.array(emulator.pendant.trace())
    printed = capsys.readouterr().out
    assert code == 1 and re.search("STOPPED: force .*RETREAT: the knife", printed, re.S), printed
    force = np.linalg.norm(trace[:, 7:], axis=1)
    assert 6.0 < force.max() < 7.0
    assert (force[-1] < 0.1) == ("retreat" in typed), force[-1]
    log = tmp_path / "retreat.csv"
    assert log.exists() == ("retreat" in typed)
    if log.exists():
        assert re.search("The knife is back.*program is stopped", printed, re.S), printed
        assert log.read_text().count("\n") > 100
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"


def test_ctrl_c_at_the_question_of_a_retreat_leaves_the_record_of_the_slice(
    tmp_path, monkeypatch, capsys
):
    asked = operated_robot.ask

    def interrupted(word, is_emulated):
        if word == "retreat":
            raise KeyboardInterrupt
        return asked(word, is_emulated)

    monkeypatch.setattr(operated_robot, "ask", interrupted)
    with emulated(SPRING, "measurement: null") as emulator:
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["slice"], "--set-robot", "limits.force=6",
            scenario=SPRING, overrides="measurement: null",
        )  # fmt: skip
    assert code == 130 and "RETREAT: the knife" in capsys.readouterr().out
    names = {"record.csv", "robot.csv", "summary.json", "slice.csv", "slice.yaml"}
    assert names <= {file.name for file in tmp_path.iterdir()}
