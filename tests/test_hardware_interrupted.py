"""`sliceit hardware` in its own process, which ends or never begins: the robot stands, stopped."""

import contextlib
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from emulator_bench import free_address
from hardware_bench import PATIENT, ROBOT

from sliceit_drake.emulator.process import EmulatorProcess
from sliceit_drake.resources import resource_path

pytestmark = [pytest.mark.second_tier, pytest.mark.usefixtures("no_test_hangs")]

SPRING = resource_path("scenarios/cucumber_spring.yaml")
PACE = 0.2
LIMITS = PATIENT.replace("limits: {", "limits: {knife_speed: 0.02, ")


@pytest.fixture
def emulator():
    """The arm 60 mm over the start."""
    with EmulatorProcess(
        SPRING, free_address(), PACE, options=["--set", "{start: {clearance: 0.07}}"]
    ) as process:
        yield process


@contextlib.contextmanager
def hardware(emulator, *options):
    command = [sys.executable, "-m", "sliceit_drake.cli.main", "hardware", str(SPRING), *options]
    command += ["--host", emulator.address, "--pace", str(PACE), "--robot", str(ROBOT)]
    command += ["--set-robot", f"{{{LIMITS}}}", "--no-replay"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def read_until(process, text):
    printed = ""
    while text not in printed:
        character = process.stdout.read(1)
        assert character, printed
        printed += character
    return printed


def type_(process, word):
    process.stdin.write(word + "\n")
    process.stdin.flush()


def wait_for(emulator, condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition(status := emulator.pendant.status()):
        assert time.monotonic() < end, status
        time.sleep(0.02)
    return status


def is_still(status):
    return np.abs(status["velocities"]).max() < 1e-3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_program_that_ends_on_the_way_to_the_start_stops_the_arm(number, emulator):
    with hardware(emulator, "--move-to-start") as process:
        read_until(process, 'Type "move"')
        type_(process, "move")
        moving = wait_for(emulator, lambda status: np.abs(status["velocities"]).max() > 0.01)
        process.send_signal(number)
        status = wait_for(
            emulator, lambda status: status["runtime_state"] == "STOPPED" and is_still(status)
        )
        process.wait(30.0)
    entries = [e for e in status["log"] if e[1].startswith(("program stopped", "RTDE"))]
    # 60 mm take 3 s at that speed. By the controller's log: a busy machine asks late.
    assert entries[0][0] - moving["time"] < 1.0, status["log"]
    stopped = [text for _, text in entries]
    is_by_others = any("RTDE watchdog" in t or "by the dashboard" in t for t in stopped)
    assert is_by_others == (number == signal.SIGKILL), stopped


@pytest.mark.parametrize("typed", ["no", None], ids=["another word", "closed terminal"])
def test_a_robot_that_is_not_moved_is_left_without_a_program(typed, emulator):
    with hardware(emulator, "--move-to-start") as process:
        read_until(process, 'Type "move"')
        assert emulator.pendant.status()["runtime_state"] == "PLAYING"
        if typed is None:
            process.send_signal(signal.SIGHUP)
        else:
            type_(process, typed)
        assert process.wait(30.0) in (1, 130)
        wait_for(emulator, lambda status: status["runtime_state"] == "STOPPED")


@pytest.mark.parametrize("pause", [0.003, 0.01])
def test_signals_in_a_row_at_the_question_stop_the_robots_program(pause, emulator):
    with hardware(emulator, "--move-to-start") as process:
        read_until(process, 'Type "move"')
        for _ in range(4):
            process.send_signal(signal.SIGINT)
            time.sleep(pause)
        printed = process.stdout.read()
        assert process.wait(30.0) == 130, printed
        assert emulator.pendant.status()["runtime_state"] == "STOPPED"


def test_a_program_that_runs_on_the_robot_is_not_replaced(emulator):
    with hardware(emulator, "--move-to-start") as first:
        read_until(first, 'Type "move"')
        with hardware(emulator, "--dry-run") as second:
            printed = second.stdout.read()
            assert second.wait(30.0) == 2
        assert "a program runs on the robot" in printed
        log = [text for _, text in emulator.pendant.status()["log"]]
        assert not any("replaced" in text for text in log)
        type_(first, "move")
        wait_for(emulator, lambda status: np.abs(status["velocities"]).max() > 0.01)


@pytest.mark.parametrize("is_read", [True, False], ids=["read", "paused terminal"])
@pytest.mark.parametrize("how", ["SIGKILL", "frame_size:2", "close:rtde"])
def test_a_lost_link_or_a_crash_at_the_question_stops_the_program_and_says_so(
    how, is_read, emulator
):
    # No watchdog is set yet: nobody but the program and its supervisor stop the robot's.
    with hardware(emulator, "--move-to-start") as process:
        read_until(process, 'Type "move"')
        said: list[str] = []
        reader = threading.Thread(target=lambda: said.extend(process.stdout))
        if is_read:
            reader.start()
        if how == "SIGKILL":
            process.kill()
        else:
            emulator.pendant.inject(how)
        # Nobody types: after a lost link most calls of ur_rtde never return.
        status = wait_for(emulator, lambda status: status["runtime_state"] == "STOPPED")
        if not is_read:
            reader.start()
        process.wait(30.0)
        reader.join(30.0)
        assert not reader.is_alive()
        printed = "".join(said)
    assert is_still(status)
    # ur_rtde connects again, and would upload its program anew, and anew.
    assert sum(text.startswith("program started") for _, text in status["log"]) == 1
    assert any("stopped by the dashboard" in text for _, text in status["log"])
    has_crashed = "HAS CRASHED. The robot's program was stopped through its dashboard" in printed
    if process.returncode < 0:
        assert has_crashed, printed
    else:
        assert has_crashed or "STOPPED: the connection to the robot was lost" in printed, printed


def test_a_program_that_shows_no_life_is_stopped_and_the_operator_is_told(emulator):
    script = f"""
import time
from sliceit_drake.hardware import supervisor
from sliceit_drake.hardware.ur_client import UrClient
with supervisor.Supervisor("{emulator.address}") as watched:
    client = UrClient("{emulator.address}", 0.05, 500.0, pace={PACE}, supervisor=watched)
    print("PLAYING", flush=True)
    time.sleep(60.0)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            read_until(process, "PLAYING")
            time.sleep(3.0)
            assert emulator.pendant.status()["runtime_state"] == "PLAYING"
            process.send_signal(signal.SIGSTOP)
            status = wait_for(emulator, lambda status: status["runtime_state"] == "STOPPED", 40.0)
            assert "HAS SHOWN NO LIFE" in read_until(process, "Find the cause first.")
        finally:
            process.kill()
    assert any("stopped by the dashboard" in text for _, text in status["log"])


def test_a_call_that_never_returns_ends_the_program_and_stops_the_robots(emulator):
    # As ur_rtde does after a lost link: it waits with Python's lock held.
    script = f"""
import ctypes, time
from sliceit_drake.hardware import supervisor
from sliceit_drake.hardware.ur_client import UrClient
supervisor.CALL_TIME = 1.0
with supervisor.Supervisor("{emulator.address}") as watched:
    client = UrClient("{emulator.address}", 0.05, 500.0, pace={PACE}, supervisor=watched)
    print("PLAYING", flush=True)
    client._ask(ctypes.PyDLL(None).sleep, 60)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        read_until(process, "PLAYING")
        status = wait_for(emulator, lambda status: status["runtime_state"] == "STOPPED")
        printed = process.stdout.read()
    assert any("stopped by the dashboard" in text for _, text in status["log"])
    assert process.returncode == 1
    assert "HAS CRASHED. The robot's program was stopped through its dashboard" in printed


def test_a_robot_that_never_confirms_its_stop_is_an_error_that_names_the_emergency_stop():
    script = f"""
from sliceit_drake.hardware.supervisor import Supervisor
with Supervisor("{free_address()}") as supervisor:
    supervisor.begin()
"""
    # Nothing answers there.
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "THE ROBOT HAS NOT CONFIRMED THAT ITS PROGRAM IS STOPPED. Stay away" in done.stderr
    assert "RobotUnavailableError" in done.stderr and "emergency stop" in done.stderr
