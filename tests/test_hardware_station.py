"""The hardware station on a fake robot: the simulated station's ports, plan, checks and outputs."""

import argparse
import contextlib
import dataclasses as dc
import errno
import io
import json
import os
import signal
import threading
import time as clock
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from fake_robot import FakeRobot
from fake_station import CONFIG, PACE, spring_scenario
from station_contract import check_station_ports

from sliceit_drake.cli.hardware import robot_of
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.hardware_station import RobotConnection
from sliceit_drake.diagrams.outputs.slice_record_of_run import slice_record_of
from sliceit_drake.diagrams.run import Run
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.checks import check_facts, check_start
from sliceit_drake.hardware.client import is_loopback
from sliceit_drake.hardware.hardware_config import (
    HardwareConfig,
    differing,
    load_hardware_config,
)
from sliceit_drake.hardware.rtde_system import RtdeSystem
from sliceit_drake.interruption import catch_signals
from sliceit_drake.output_folder import unused
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.hardware_run import prepare_hardware_run, write_hardware_outputs
from sliceit_drake.robot_run.operated_robot import OperatedRobot, ask, plan_text
from sliceit_drake.robot_run.plan_check import check_plan, plan_joints

EMULATED = "127.0.0.1"


@pytest.fixture(scope="module")
def twin():
    return MakeStation(spring_scenario())


@pytest.fixture
def robot(twin):
    robot = FakeRobot(twin.start_joints.tolist(), PACE)
    yield robot
    robot.close()


def hardware_run(robot, **changes):
    return prepare_hardware_run(
        spring_scenario(), HardwareConfig(**(CONFIG | changes)), robot, PACE
    )


def checked_run(robot, directory, duration=0.1, host=EMULATED):
    hardware = hardware_run(robot)
    return OperatedRobot(host, hardware.config, PACE).checked_run(hardware, directory, duration)


def failed(checks):
    return [check.name for check in checks if not check.passed]


def test_it_keeps_the_port_contract_of_the_simulated_station(twin, robot):
    connection = RobotConnection(robot, HardwareConfig(), PACE, twin)
    station = MakeStation(twin.scenario, hardware=connection)
    check_station_ports(station)
    for name in ("period", "lateness", "age", "latched", "missed_cycles", "stop_reason"):
        assert station.HasOutputPort(name)


def test_without_a_twin_it_is_made_on_the_measured_board(robot):
    scenario = spring_scenario()
    usual = scenario.board.height
    connection = RobotConnection(robot, HardwareConfig(board_height=usual + 0.01), PACE)
    station = MakeStation(scenario, hardware=connection)
    check_station_ports(station)
    assert station.scenario.board.height == usual + 0.01 and scenario.board.height == usual
    higher = station.start_pose.translation() - MakeStation(scenario).start_pose.translation()
    np.testing.assert_allclose(higher, [0.0, 0.0, 0.01], atol=1e-12)


def test_a_scenario_runs_and_leaves_the_outputs_of_simulate(robot, tmp_path):
    hardware = hardware_run(robot)
    assert failed(hardware.check_before()) == []
    assert failed(hardware.check_at_start()) == []
    assert robot.log == ["zero"]
    run = hardware.execute(0.3)
    assert run.stopped is None
    summary = write_hardware_outputs(hardware, tmp_path)
    names = {"record.csv", "summary.json", "force.png", "scenario.yaml", "robot.csv"}
    assert names <= {file.name for file in tmp_path.iterdir()}
    assert json.loads((tmp_path / "summary.json").read_text())["robot"] == summary["robot"]
    record = run.record()
    assert record["time"][-1] == pytest.approx(0.3, abs=0.02)
    # The arm went where the plan has it, one servo lag behind.
    plan = hardware.plan
    wanted = np.interp(0.3, plan.time, plan.q[:, 1])
    assert record["q_2"][-1] == pytest.approx(wanted, abs=0.01)
    assert abs(record["q_2"][-1] - record["q_2"][0]) > 0.003
    log = np.genfromtxt(tmp_path / "robot.csv", delimiter=",", names=True)
    assert np.isfinite(log["sent_1"]).sum() == summary["robot"]["targets_sent"] > 50
    late = summary["robot"]["lateness_histogram"]
    assert sum(late.values()) == len(log) == summary["robot"]["cycles"]
    assert late["below 0.1 ms"] == (log["lateness"] < 1e-4).sum()
    made = slice_record_of(run, "a test")
    assert made.force.shape == (len(record["time"]), 3)


def test_the_same_wrench_is_shown_at_the_knife_in_the_world(robot):
    robot.wrench = [1.0, -2.0, 12.0, 0.0, 0.0, 0.0]  # In the base, which is the world here.
    hardware = hardware_run(robot)
    run = hardware.execute(0.05, moves=False)
    record = run.record()
    assert np.allclose(record.vector("food_wrench_f")[-1], robot.wrench[:3], atol=1e-6)
    # From the flange, 0.21 m above Ko, to Ko.
    moment = np.cross([0.0, 0.0, 0.21], robot.wrench[:3])
    assert np.allclose(record.vector("food_wrench_m")[-1], moment, atol=1e-3)
    made = slice_record_of(run, "a test")
    assert np.allclose(made.force[-1], robot.wrench[:3], atol=1e-6)
    assert np.allclose(made.torque[-1], moment, atol=1e-3)
    assert robot.sent == [] and robot.watchdog is None, "a dry run sends nothing"


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"bits": 1 << 6 | 1 << 7 | 1 << 10}, "safety_status"),
        ({"runtime": 1}, "program is stopped"),
        ({"wrench": [np.nan] * 6}, "no 6 finite numbers"),
        ({"wrench": [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]}, "meets a force"),
    ],
    ids=["safety", "program", "nan", "force"],
)
def test_a_dry_run_ends_without_success_at_what_would_stop_a_run(
    fault, said, robot, capsys, tmp_path
):
    hardware = hardware_run(robot)

    def fail():
        for name, value in fault.items():
            setattr(robot, name, value)

    prepare = hardware._prepare
    hardware._prepare = lambda station: (prepare(station), robot.later(0.1, fail))[0]
    made = OperatedRobot(EMULATED, hardware.config, PACE, dry_run=True).checked_run(
        hardware, tmp_path
    )
    assert said in made.stopped and robot.sent == []
    printed = capsys.readouterr().out
    assert f"NOT READY: {made.stopped}" in printed and "robot's program is stopped" in printed


def test_a_fault_ends_the_run_with_its_reason_and_keeps_the_record(robot, tmp_path):
    hardware = hardware_run(robot)

    def fail():
        robot.bits = 1 << 2 | 1 << 10

    robot.later(0.3, fail)
    run = hardware.execute(3.0)
    assert run.stopped.startswith("safety_status") and "protective stop" in run.stopped
    assert robot.stopped.is_set()
    summary = write_hardware_outputs(hardware, tmp_path)
    assert summary["stopped"] == run.stopped
    assert 0.01 < run.record()["time"][-1] < 1.0


def test_it_begins_nothing_where_the_robot_is_not_ready(twin, robot):
    config, facts = HardwareConfig(**CONFIG), robot.facts()
    assert failed(check_facts(facts, config)) == []
    for change, name in (
        ({"model": "UR10"}, "model"),
        ({"software": "3.15.8"}, "software"),
        ({"software": "10.7.0"}, "software"),
        ({"software": ""}, "software"),
        ({"robot_mode": "IDLE"}, "robot mode"),
        ({"safety_mode": "PROTECTIVE_STOP"}, "safety mode"),
        ({"remote_control": False}, "remote control"),
        ({"payload": 0.0}, "payload"),
        ({"payload_cog": [0.0, 0.0, 0.0]}, "centre of gravity"),
        ({"tcp": [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]}, "tool centre point"),
        ({"tcp": [float("nan")] * 6}, "tool centre point"),
        ({"speed_scaling": 0.5}, "speed slider"),
        # What is missing has not been checked.
        ({"remote_control": None}, "remote control"),
        ({"tcp": []}, "tool centre point"),
        ({"speed_scaling": float("nan")}, "speed slider"),
    ):
        assert failed(check_facts(dc.replace(facts, **change), config)) == [name]
    other = dc.replace(config, serial="1")
    assert failed(check_facts(facts, other)) == ["serial number"]
    assert failed(check_facts(facts, HardwareConfig())) == ["payload"]
    for cog in ([], [0.0, 0.0], [float("nan")] * 3):
        assert "centre of gravity" in failed(
            check_facts(dc.replace(facts, payload_cog=cog), config)
        )
    assert "payload" in failed(check_facts(dc.replace(facts, payload=float("nan")), config))
    turned = robot.read()._replace(q=[*robot.q[:5], robot.q[5] - 2.0 * np.pi])
    (check,) = [c for c in check_start(turned, robot.q, config) if not c.passed]
    assert "whole turn" in check.fix


@pytest.mark.parametrize("joint", range(6))
def test_a_number_that_is_none_among_good_ones_is_not_at_the_start(joint, robot):
    state, config = robot.read(), HardwareConfig(**CONFIG)
    assert failed(check_start(state, robot.q, config)) == []
    for name in ("q", "qd"):
        values = list(getattr(state, name))
        values[joint] = float("nan")
        assert failed(check_start(state._replace(**{name: values}), robot.q, config))
        assert failed(check_start(state._replace(**{name: values[:5]}), robot.q, config))


def test_old_readings_of_the_sensor_are_not_taken_for_a_zero(robot):
    hardware = hardware_run(robot)
    robot.frozen = True
    checks = hardware.check_at_start()
    assert failed(checks) == ["force before zeroing"]
    assert "0 of 50 readings" in checks[-1].found and "zero" not in robot.log


def test_a_plan_out_of_limits_is_refused_before_the_word(twin, robot):
    plan, config = plan_joints(twin), HardwareConfig(**CONFIG)
    assert failed(check_plan(plan, twin, config, robot)) == []
    low = dc.replace(config.limits, board_depth=0.0, knife_speed=0.05)
    names = failed(check_plan(plan, twin, dc.replace(config, limits=low), robot))
    assert "knife speed" in names
    robot.allows_joints = lambda q: False
    assert "the robot's own safety limits" in failed(check_plan(plan, twin, config, robot))
    assert "board height" in failed(
        check_plan(plan, twin, dc.replace(config, board_height=None), robot)
    )


@pytest.mark.parametrize("typed", ["", "\n", "y\n", "yes\n", "Slice\n"])
def test_only_the_word_itself_moves_the_robot(typed, robot, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    assert checked_run(robot, tmp_path) is None
    assert "Nothing was moved" in capsys.readouterr().out
    assert robot.sent == [] and robot.watchdog is None


def test_a_pipe_moves_an_emulated_robot_but_no_other(robot, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    assert checked_run(robot, tmp_path, host="192.168.1.10") is None
    assert "must be typed at a terminal" in capsys.readouterr().out
    assert robot.sent == []
    run = checked_run(robot, tmp_path)
    assert run.stopped is None
    assert len(robot.sent) > 20


@pytest.mark.parametrize(
    ("host", "is_ours"),
    [
        ("127.0.0.1", True), ("127.9.8.7", True), ("::1", True), ("localhost", False),
        ("127.evil.example", False), ("127.1.evil", False), ("10.0.0.5", False), ("", False),
    ],
)  # fmt: skip
def test_only_a_numeric_loopback_address_is_of_this_machine(host, is_ours):
    assert is_loopback(host) == is_ours


def test_with_a_full_disk_the_operator_reads_of_the_stop_and_has_the_log(
    robot, monkeypatch, capsys, tmp_path
):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    def stop():
        raise RuntimeError("no answer")

    monkeypatch.setattr(Run, "save", full)
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    robot.stop = stop
    robot.later(0.6, lambda: setattr(robot, "bits", 1 << 2))
    with pytest.raises(OSError, match="No space"):
        checked_run(robot, tmp_path, 2.0)
    printed = capsys.readouterr().out
    assert printed.index("STOPPED: safety_status") < printed.index("NOT ALL IS WRITTEN")
    assert "DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED (no answer)" in printed
    assert len((tmp_path / "robot.csv").read_text().splitlines()) > 50


def test_a_run_leaves_the_records_of_the_runs_before(robot, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n" * 3))
    (tmp_path / "notes.txt").write_text("mine")
    checked_run(robot, tmp_path)
    first = (tmp_path / "robot.csv").read_text()
    (tmp_path / "record.csv").unlink()  # As after a full disk.
    robot.payload = (1.2, 0.0, 0.0, 0.07)
    assert "centre" in checked_run(robot, tmp_path).stopped, "it is not ready"
    second = (tmp_path / "robot.csv").read_text()
    assert checked_run(robot, tmp_path).stopped
    assert (tmp_path / "earlier" / "robot.csv").read_text() == first
    assert (tmp_path / "earlier_2" / "robot.csv").read_text() == second
    assert (tmp_path / "record.csv").exists() and (tmp_path / "notes.txt").exists()


def test_the_records_of_stopped_slices_of_a_protocol_are_all_kept(tmp_path):
    for name in ("slice_000_stopped.csv", "slice_000_stopped_2.yaml"):
        (tmp_path / name).touch()
    free = unused(tmp_path / "slice_000_stopped", ".csv", ".yaml")
    assert free == tmp_path / "slice_000_stopped_3"
    assert unused(tmp_path / "slice_001_stopped", ".csv", ".yaml").name == "slice_001_stopped"


def test_without_room_for_the_record_nothing_moves(robot, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=5e6))
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    assert checked_run(robot, tmp_path / "new" / "run", 2.0) is None
    assert "5 MB free" in capsys.readouterr().out
    assert robot.sent == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_record_is_written_does_not_lose_it(
    number, robot, monkeypatch, capsys, tmp_path
):
    save = Run.save

    def interrupted(*args, **kwargs):
        os.kill(os.getpid(), number)
        return save(*args, **kwargs)

    monkeypatch.setattr(Run, "save", interrupted)
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    checked_run(robot, tmp_path, 0.2)
    assert "Still writing the record." in capsys.readouterr().out
    assert {"record.csv", "robot.csv", "summary.json"} <= {file.name for file in tmp_path.iterdir()}


def test_a_run_that_is_interrupted_again_and_again_keeps_its_log(
    robot, monkeypatch, capsys, tmp_path
):
    sleep = clock.sleep

    def impatient(seconds):
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        sleep(seconds)

    def interrupt(run, now, wall):
        monkeypatch.setattr("sliceit_drake.hardware.rtde_link.clock.sleep", impatient)
        raise KeyboardInterrupt

    hardware = hardware_run(robot)
    execute = hardware.execute
    hardware.execute = lambda duration, show: execute(duration, partial(interrupt, show))
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    operated = OperatedRobot(EMULATED, hardware.config, PACE)
    with pytest.raises(KeyboardInterrupt):
        operated.checked_run(hardware, tmp_path, 2.0)
    monkeypatch.undo()
    assert "STOPPED: interrupted by the user, more than once" in capsys.readouterr().out
    assert robot.stopped.wait(2.0)
    assert {"record.csv", "robot.csv", "summary.json"} <= {file.name for file in tmp_path.iterdir()}


def test_signals_in_a_row_cut_neither_the_stop_nor_the_record_short(
    robot, monkeypatch, capsys, tmp_path
):
    def stop():
        clock.sleep(0.5)
        raise RuntimeError("no answer")

    def press_again_and_again():
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM) * 2:
            os.kill(os.getpid(), number)
            clock.sleep(0.05)

    robot.stop = stop
    robot.later(0.6, lambda: threading.Thread(target=press_again_and_again).start())
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    with catch_signals():
        made = checked_run(robot, tmp_path, 2.0)
    assert made.stopped.startswith("interrupted by the user")
    # The robot's answer was waited for.
    assert "DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED (no answer)" in capsys.readouterr().out
    assert {"record.csv", "robot.csv", "summary.json"} <= {file.name for file in tmp_path.iterdir()}


class GoneTerminal(io.StringIO):
    """A terminal that is closed, or a reader that leaves, once the motion is shown."""

    is_gone = False

    def write(self, text):
        if self.is_gone:
            raise OSError(errno.EIO, "Input/output error")
        return super().write(text)


@pytest.mark.parametrize("is_told", [True, False], ids=["by a signal", "by the bar alone"])
def test_a_closed_terminal_ends_the_motion_and_leaves_the_whole_record(
    is_told, robot, monkeypatch, tmp_path
):
    terminals = GoneTerminal(), GoneTerminal()

    def close():
        for terminal in terminals:
            terminal.is_gone = True
        if is_told:
            os.kill(os.getpid(), signal.SIGHUP)

    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    monkeypatch.setattr("sys.stdout", terminals[0])
    monkeypatch.setattr("sys.stderr", terminals[1])
    robot.later(0.6, close)
    with catch_signals(), contextlib.suppress(OSError):
        checked_run(robot, tmp_path, 2.0)
    assert robot.stopped.is_set()
    names = {"record.csv", "robot.csv", "summary.json"}
    assert names <= {file.name for file in tmp_path.iterdir()}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["stopped"] and len(robot.sent) > 5


def test_a_contact_after_zeroing_is_found_before_it_moves(robot, monkeypatch, capsys, tmp_path):
    def typed(_):
        robot.wrench = [0.0, 0.0, 40.0, 0.0, 0.0, 0.0]
        return "slice"

    monkeypatch.setattr("builtins.input", typed)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    made = checked_run(robot, tmp_path)
    assert "force after zeroing: " in made.stopped
    assert robot.sent == [] and robot.watchdog is None


def test_a_contact_that_begins_while_it_is_zeroed_is_found_after_the_word(
    robot, monkeypatch, capsys, tmp_path
):
    # The sensor shows the payload's weight alone, along the flange's axis: the tool points down.
    weight = 1.2 * 9.81
    robot.raw = [0.0, 0.0, weight, 0.0, 0.0, 0.0]

    def press():
        robot.raw = [0.0, 0.0, weight - 40.0, 0.0, 0.0, 0.0]

    robot.zero_sensor = press
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    made = checked_run(robot, tmp_path)
    assert "force before zeroing: " in made.stopped
    assert robot.sent == [] and robot.watchdog is None


def test_other_software_is_refused_by_its_name(robot):
    facts = dc.replace(robot.facts(), software="10.7.0")
    (check,) = [c for c in check_facts(facts, HardwareConfig(**CONFIG)) if not c.passed]
    assert "PolyScope X (10.7.0)" in check.found


def test_a_contact_is_not_zeroed_away(robot):
    robot.wrench = [0.0, 0.0, 40.0, 0.0, 0.0, 0.0]
    assert failed(hardware_run(robot).check_at_start()) == ["force before zeroing"]
    assert "zero" not in robot.log


def test_a_word_typed_before_the_question_does_not_answer_it(monkeypatch):
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        os.write(ours, b"slice\n")
        timer = threading.Timer(0.5, lambda: os.write(ours, b"no\n"))
        timer.start()
        assert not ask("slice", is_emulated=True)
        timer = threading.Timer(0.5, lambda: os.write(ours, b"slice\n"))
        timer.start()
        assert ask("slice", is_emulated=True)
        timer.join()
    os.close(ours)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"payload": (2.0, 0.0, 0.0, 0.06)}, "payload: 2.000 kg"),
        ({"payload": None}, "payload: nan kg"),
        ({"q": "moved"}, "start pose"),
    ],
)
def test_what_changes_while_the_plan_is_read_is_found_before_it_moves(
    change, said, robot, monkeypatch, capsys, tmp_path
):
    def typed(_):
        for name, value in change.items():
            if value == "moved":
                robot.frozen = True
                value = [*robot.q[:5], robot.q[5] + 0.05]
                robot.wait(0.01)
            setattr(robot, name, value)
        if robot.frozen:
            robot.target = robot.q
            robot._state = robot._law.state_at_rest(robot.q)
            robot.frozen = False
        return "slice"

    monkeypatch.setattr("builtins.input", typed)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    made = checked_run(robot, tmp_path)
    assert said in made.stopped
    assert robot.sent == [] and robot.watchdog is None


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf"), 100.0])
def test_a_run_lasts_as_long_as_its_motion_at_most(duration, robot, tmp_path):
    with pytest.raises(ConfigurationError, match="--duration"):
        checked_run(robot, tmp_path, duration)
    assert robot.log == []


def test_the_plan_names_each_setting_that_is_not_the_default(robot):
    config = HardwareConfig(**CONFIG)
    assert not [line for line in differing(config) if "payload" in line or "board" in line]
    for name, value in (
        ("payload_tolerance", 1.0), ("cog_tolerance", 0.2), ("sensor_force", 20.0),
        ("start_tolerance", 0.2), ("singularity", 0.0), ("watchdog", 5.0), ("software", "1.0"),
    ):  # fmt: skip
        assert f"{name}: {value}" in differing(dc.replace(config, **{name: value}))
    config.touch.force_limit = 50.0
    config.limits = dc.replace(config.limits, force=200.0)
    text = plan_text(hardware_run(robot, limits=config.limits, touch=config.touch), 1.0)
    assert "touch.force_limit: 50.0" in text and "force: 200.0" in text


def test_a_second_ctrl_c_does_not_keep_the_robot_from_stopping(robot, monkeypatch):
    hardware = hardware_run(robot)

    sleep = clock.sleep

    def impatient(seconds):
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        sleep(seconds)

    def interrupt(now, wall):
        monkeypatch.setattr("sliceit_drake.hardware.rtde_link.clock.sleep", impatient)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hardware.execute(3.0, interrupt)
    monkeypatch.undo()
    assert robot.stopped.wait(2.0), "the program on the robot goes on"


def test_a_robot_that_does_not_confirm_its_stop_is_named(robot, monkeypatch, capsys, tmp_path):
    def stop():
        raise RuntimeError("no answer")

    robot.stop = stop
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    robot.wrench = [0.0, 0.0, 2.9, 0.0, 0.0, 0.0]
    robot.later(0.3, lambda: setattr(robot, "bits", 1 << 2))
    assert checked_run(robot, tmp_path, 2.0).stopped
    assert "DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED (no answer)" in capsys.readouterr().out


def test_a_motion_that_ends_without_a_confirmed_stop_is_no_success(
    robot, monkeypatch, capsys, tmp_path
):
    def stop():
        raise RuntimeError("no answer")

    robot.stop = stop
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))
    made = checked_run(robot, tmp_path)
    assert "complete, but the robot has not confirmed" in made.stopped
    assert "DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED (no answer)" in capsys.readouterr().out
    assert json.loads((tmp_path / "summary.json").read_text())["stopped"] == made.stopped


def after_twenty_targets(monkeypatch, happens):
    """Lets something happen in the diagram in the middle of a confirmed run."""
    send, sent = RtdeSystem.send, []

    def count(system, context):
        sent.append(1)
        if len(sent) > 20:
            happens()
        send(system, context)

    monkeypatch.setattr(RtdeSystem, "send", count)
    monkeypatch.setattr("sys.stdin", io.StringIO("slice\n"))


def test_a_diagram_that_does_not_come_back_is_ended_and_its_stop_is_told(
    robot, monkeypatch, capsys, tmp_path
):
    came_back = []

    def stands():
        clock.sleep(60.0)
        came_back.append(True)

    after_twenty_targets(monkeypatch, stands)
    monkeypatch.setattr("sliceit_drake.hardware.rtde_link.HOLD_TIME", 0.1)
    with catch_signals():
        made = checked_run(robot, tmp_path, 2.0)
    assert not came_back
    assert made.stopped.startswith("command_age") and robot.stopped.is_set()
    printed = capsys.readouterr()
    assert "STOPPED: command_age" in printed.out and "STOPPED: command_age" in printed.err
    assert {"record.csv", "robot.csv", "summary.json"} <= {file.name for file in tmp_path.iterdir()}


def test_an_error_in_the_diagram_stops_the_robot_and_keeps_the_record(
    robot, monkeypatch, capsys, tmp_path
):
    def broken():
        raise ValueError("the policy decides nan")

    after_twenty_targets(monkeypatch, broken)
    made = checked_run(robot, tmp_path, 2.0)
    assert made.stopped == "ValueError: the policy decides nan"
    assert robot.stopped.is_set()
    printed = capsys.readouterr()
    assert "STOPPED: ValueError: the policy decides nan" in printed.out
    assert "robot's program is stopped" in printed.out and "in broken" in printed.err
    assert {"record.csv", "robot.csv", "summary.json"} <= {file.name for file in tmp_path.iterdir()}


def test_the_files_for_users_are_read_and_an_absent_robot_is_named(capsys):
    for file in resource_path("hardware").glob("*.yaml"):
        load_hardware_config(file)
    assert main(["hardware"]) == 2
    assert "--host" in capsys.readouterr().err
    with pytest.raises(ConfigurationError, match="pace 1"):
        robot_of(argparse.Namespace(host="10.0.0.5", pace=0.2, board_height=None))
