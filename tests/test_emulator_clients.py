"""The emulated controller under the clients that people use: ur_rtde, and Universal Robots' own."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rtde_control
import rtde_io
import rtde_receive
from emulator_bench import free_address, wait_until
from pydrake.systems.analysis import Simulator
from urpy.rtde import rtde as universal_robots

from sliceit_drake.cli.main import main
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.emulator.kinematics import forward
from sliceit_drake.emulator.process import EmulatorError, EmulatorProcess
from sliceit_drake.emulator.robot_model import CYCLE, START
from sliceit_drake.resources import resource_path

SERVO = (0.0, 0.0, 0.002, 0.03, 2000.0)


pytestmark = pytest.mark.usefixtures("no_test_hangs")


@contextlib.contextmanager
def arm_alone(pace=1.0, **options):
    with EmulatorProcess(address=free_address(), pace=pace, **options) as emulator:
        yield emulator


@contextlib.contextmanager
def client(kind, *arguments):
    interface = kind(*arguments)
    try:
        yield interface
    finally:
        interface.disconnect()


def receiver(emulator):
    return client(rtde_receive.RTDEReceiveInterface, emulator.address)


def control(emulator):
    return client(rtde_control.RTDEControlInterface, emulator.address)


def wait_for(condition, timeout=10.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"not within {timeout} s"
        time.sleep(0.005)


def servo_along(receive, ctrl, cycles, path):
    """Sends `path(time)` with every new timestamp; returns times, commands and measured joints.

    A row is kept where the robot's time did not go on between the command and the measurement.
    """
    last, begin, rows = None, receive.getTimestamp(), []
    while len(rows) < cycles:
        now = receive.getTimestamp()
        if now == last:
            time.sleep(1e-4)
            continue
        last = now
        target = path(now - begin)
        assert ctrl.servoJ(target.tolist(), *SERVO)
        measured = receive.getActualQ()
        if receive.getTimestamp() == now:
            rows.append((now, target, measured))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def test_ur_rtde_connects_moves_servos_and_sees_a_protective_stop():
    with arm_alone(pace=0.5) as emulator, receiver(emulator) as receive, control(emulator) as ctrl:
        assert receive.isConnected() and ctrl.isConnected() and ctrl.isProgramRunning()
        assert receive.getActualQ() == pytest.approx(START)
        assert (receive.getRobotMode(), receive.getSafetyMode()) == (7, 1)
        with client(rtde_io.RTDEIOInterface, emulator.address) as io:
            assert io.setSpeedSlider(0.8)
            wait_for(lambda: receive.getTargetSpeedFraction() == pytest.approx(0.8))

        target = np.array(START) + [0.1, 0.0, -0.1, 0.0, 0.0, 0.2]
        assert ctrl.moveJ(target.tolist(), 1.0, 4.0)
        wait_for(lambda: np.abs(receive.getActualQd()).max() == 0.0)
        assert receive.getActualQ() == pytest.approx(target, abs=1e-9)
        assert ctrl.setTcp([0.0, 0.0, 0.21, 0.0, 0.0, 0.0]) and ctrl.setPayload(1.5, [0, 0, 0.1])
        assert ctrl.zeroFtSensor()
        pose = np.array(receive.getActualTCPPose()) - [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
        assert ctrl.moveL(pose.tolist(), 0.1, 1.0)
        assert ctrl.getForwardKinematics() == pytest.approx(pose, abs=1e-7)
        assert receive.getPayload() == 1.5

        start = np.array(receive.getActualQ())
        speed = np.array([0.1, 0.0, 0.0, -0.1, 0.0, 0.0])
        times, commands, measured = servo_along(receive, ctrl, 500, lambda t: start + speed * t)
        # The measured joints trail by the lookahead time, never by less, and by the cycles that a
        # command is on its way: how many depends on when the client's threads wake.
        lag = (commands - measured)[250:, 0] / speed[0]
        assert 0.03 <= lag.min() <= 0.03 + 4 * CYCLE
        assert ctrl.servoStop(5.0)

        emulator.pendant.inject("protective_stop:stop")
        wait_for(receive.isProtectiveStopped)
        assert receive.getSafetyStatusBits() == 1 << 2 | 1 << 10
        assert receive.getSafetyMode() == 3 and receive.getRuntimeState() == 1
        assert not ctrl.servoJ(start.tolist(), *SERVO)
        emulator.pendant.inject("normal")
        wait_for(lambda: not receive.isProtectiveStopped())
        assert ctrl.reuploadScript()
        wait_for(ctrl.isProgramRunning)
        assert ctrl.moveJ(target.tolist(), 1.0, 4.0)
        assert receive.getActualQ() == pytest.approx(target, abs=1e-6)


def test_a_newer_controller_is_served_too():
    # Another recipe, other registers' numbers, another script, no dashboard.
    with arm_alone(options=["--version", "10.11.0.1"]) as emulator, control(emulator) as ctrl:
        assert ctrl.moveJ((np.array(START) + 0.01).tolist(), 1.0, 4.0)
        assert emulator.pendant.status()["positions"] == pytest.approx(np.array(START) + 0.01)


def test_a_second_control_client_is_told_that_the_registers_are_in_use():
    with arm_alone() as emulator, control(emulator) as ctrl:
        with pytest.raises(RuntimeError, match="already in use"):
            rtde_control.RTDEControlInterface(emulator.address)
        assert ctrl.moveJ((np.array(START) + 0.01).tolist(), 1.0, 4.0)


STOPPED_CLIENT = """
import sys, time, rtde_control, rtde_receive
receive = rtde_receive.RTDEReceiveInterface(sys.argv[1])
control = rtde_control.RTDEControlInterface(sys.argv[1])
control.setWatchdog(10.0)
q, last = receive.getActualQ(), None
while True:
    now = receive.getTimestamp()
    if now != last:
        last = now
        q[0] += 0.0002
        control.servoJ(q, 0, 0, 0.002, 0.03, 2000)
        print("servo", flush=True)
    time.sleep(1e-4)
"""


@pytest.mark.parametrize("ending", [signal.SIGSTOP, signal.SIGKILL])
def test_the_watchdog_stops_the_arm_when_the_client_falls_silent(ending):
    with arm_alone() as emulator:
        command = [sys.executable, "-c", STOPPED_CLIENT, emulator.address]
        child = subprocess.Popen(command, stdout=subprocess.PIPE)
        try:
            assert child.stdout is not None and child.stdout.readline()
            wait_for(lambda: emulator.pendant.status()["velocities"][0] > 0.05)
            child.send_signal(ending)
            silent = emulator.pendant.status()
            wait_for(lambda: emulator.pendant.status()["runtime_state"] == "STOPPED")
            status = wait_until(emulator.pendant, silent["time"] + 0.5)
            stops = [when for when, text in status["log"] if "RTDE watchdog: no" in text]
            # What the child had sent before it fell silent may still have been on its way.
            assert stops[0] - silent["time"] < 0.1 + 0.05
            assert status["velocities"] == [0.0] * 6
        finally:
            child.send_signal(signal.SIGKILL)
            child.wait()
            child.stdout.close()


def test_silence_freezes_the_timestamp_and_a_cut_socket_is_seen():
    with arm_alone() as emulator, receiver(emulator) as receive:
        emulator.pendant.inject("silence:0.3")
        wait_until(emulator.pendant, emulator.pendant.status()["time"] + 0.05)
        frozen = receive.getTimestamp()
        status = wait_until(emulator.pendant, frozen + 0.15)
        assert receive.getTimestamp() == frozen < status["time"] - 0.1
        assert receive.isConnected()
        wait_for(lambda: receive.getTimestamp() > frozen + 0.3)
        emulator.pendant.inject("close:rtde:reset")
        wait_for(lambda: not receive.isConnected())
        assert receive.reconnect()
        wait_for(lambda: receive.getTimestamp() > frozen + 0.4)


def test_what_is_not_emulated_stops_the_program_and_the_client_sees_it():
    with arm_alone() as emulator, control(emulator) as ctrl:
        assert not ctrl.freedriveMode()
        assert not ctrl.isProgramRunning()
        log = " ".join(text for _, text in emulator.pendant.status()["log"])
        assert "command 52 (freedriveMode) is not emulated" in log


def test_local_control_is_reported_and_scripts_are_ignored():
    with arm_alone(options=["--inject", "remote_control_off"]) as emulator:
        with pytest.raises(RuntimeError, match="remote control"):
            rtde_control.RTDEControlInterface(emulator.address)


def test_universal_robots_own_client_reads_and_writes():
    with arm_alone() as emulator:
        ur = universal_robots.RTDE(emulator.address)
        ur.connect()
        try:
            assert ur.get_controller_version() == (5, 11, 1, 108318)
            names = ["timestamp", "actual_q", "runtime_state", "input_double_register_5"]
            types = ["DOUBLE", "VECTOR6D", "UINT32", "DOUBLE"]
            assert ur.send_output_setup(names, types, 125)
            inputs = ur.send_input_setup(["input_double_register_5"], ["DOUBLE"])
            assert ur.send_start()
            inputs.input_double_register_5 = 2.5
            assert ur.send(inputs)
            samples = [ur.receive() for _ in range(30)]
            assert ur.send_pause()
        finally:
            ur.disconnect()
        assert samples[-1].actual_q == pytest.approx(START)
        assert samples[-1].input_double_register_5 == 2.5
        assert samples[-1].runtime_state == 1
        steps = np.diff([s.timestamp for s in samples])
        assert steps.min() == pytest.approx(0.008)


def lockstep_run(address, hesitation):
    """Joints of a feedback loop over the network, which any missed cycle would change.

    The client hesitates, s, at its first commands, before it is in step, and twice later on.
    """
    with EmulatorProcess(address=address, lockstep=True) as emulator:
        with receiver(emulator) as receive, control(emulator) as ctrl:
            last, rows = None, []
            while len(rows) < 300:
                now = receive.getTimestamp()
                if now == last:
                    time.sleep(1e-5)
                    continue
                last, q = now, np.array(receive.getActualQ())
                if len(rows) < 4:
                    time.sleep(hesitation)
                if len(rows) in (100, 150):
                    time.sleep(0.05)
                assert ctrl.servoJ((q + 0.05 * (np.array(START) + 0.2 - q)).tolist(), *SERVO)
                rows.append(q)
            assert ctrl.servoStop(10.0)
            missed = emulator.pendant.status()["missed_cycles"]
    return np.array(rows), missed


def test_in_lockstep_a_run_is_the_same_every_time_however_slow_the_client():
    # How long the arm still stands when the client begins is the only chance in a run.
    runs = []
    for hesitation in (0.0, 0.007):
        joints, missed = lockstep_run(free_address(), hesitation)
        assert missed == 0
        begin = int(np.argmax(joints[:, 0] > START[0]))
        assert 0 < begin < 80
        runs.append(joints[begin : begin + 200])
    assert np.ptp(runs[0][:, 0]) > 0.05
    assert np.array_equal(*runs)


def commands_and_record(scenario, cycles):
    """What the simulated station commands, and its joints and force in the robot's base."""
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.Initialize()
    context = diagram.station.GetMyContextFromRoot(simulator.get_context())

    def value(port):
        return diagram.station.GetOutputPort(port).Eval(context)

    commands, record = [], []
    for cycle in range(cycles):
        simulator.AdvanceTo(cycle * CYCLE)
        joints, wrench = value("joint_positions"), value("sensor_wrench")
        force = forward(joints)[:3, :3] @ wrench.translational()
        record.append(np.concatenate([joints, force]))
        simulator.AdvancePendingEvents()
        commands.append(value("joint_positions_command").copy())
    return commands, np.array(record)


def test_a_slice_over_the_network_has_the_force_of_the_simulated_one():
    overrides = "{start: {clearance: 0.001}}"
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"), overrides)
    commands, simulated = commands_and_record(scenario, 250)
    with EmulatorProcess(
        resource_path("scenarios/cucumber_measured.yaml"),
        free_address(),
        lockstep=True,
        options=["--set", overrides],
    ) as emulator:
        with receiver(emulator) as receive, control(emulator) as ctrl:
            last, rows = None, []
            while len(rows) < len(commands):
                now = receive.getTimestamp()
                if now == last:
                    time.sleep(1e-4)
                    continue
                last = now
                rows.append([*receive.getActualQ(), *receive.getActualTCPForce()[:3]])
                assert ctrl.servoJ(commands[len(rows) - 1].tolist(), *SERVO)
            status = emulator.pendant.status()
    assert status["missed_cycles"] == 0
    # The first few commands may each have stood for some cycles, in the air.
    joints, force = np.array(rows)[:, :6], np.array(rows)[:, 6:]
    assert joints == pytest.approx(simulated[:, :6], abs=2e-5)
    error = np.sqrt(np.mean((force - simulated[:, 6:]) ** 2))
    assert np.abs(simulated[:, 6:]).max() > 2.0
    assert error < 0.01 * np.sqrt(np.mean(simulated[:, 6:] ** 2))


def test_the_emulator_ends_with_the_process_that_started_it(tmp_path):
    script = tmp_path / "starter.py"
    script.write_text(
        "import os, signal\n"
        "from sliceit_drake.emulator.process import EmulatorProcess\n"
        f"emulator = EmulatorProcess(address={free_address()!r})\n"
        "print(emulator.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    starter = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=30)
    child = int(starter.stdout)

    def has_ended():
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return True
        with open(f"/proc/{child}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] == "Z"

    wait_for(has_ended, 5.0)


def test_what_the_emulator_cannot_do_is_said(capsys):
    with arm_alone() as emulator:
        with pytest.raises(EmulatorError, match="is no fault"):
            emulator.pendant.inject("thunder")
        with pytest.raises(EmulatorError, match="cannot listen on.*Another emulator"):
            EmulatorProcess(address=emulator.address)
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 0)):
        command = [sys.executable, "-m", "sliceit_drake.cli.main", "emulate", "--arm-alone"]
        command += ["--address", emulator.address]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert child.stdout is not None and b"Emulated UR5e" in child.stdout.readline()
        child.send_signal(number)
        _, said = child.communicate(timeout=60.0)
        assert child.returncode == code and b"Traceback" not in said
    assert main(["emulate", "--arm-alone", "--pace", "0"]) == 2
    assert "pace" in capsys.readouterr().err
    assert main(["emulate", "--arm-alone", "--address", free_address(), "--inject", "rain"]) == 2
    assert "is no fault" in capsys.readouterr().err
