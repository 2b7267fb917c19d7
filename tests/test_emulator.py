"""The emulated controller: its bytes, its program, its ports, and the true clients at them."""

import contextlib
import math
import random
import socket
import struct
import threading

import numpy as np
import pytest
from emulator_bench import Bench, RawClient, ScriptBench, free_address
from pydrake.systems.analysis import Simulator

from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.robot_plant import RobotConfig
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.emulator.control_script import COMMAND_NAMES, ControlScript, read_script
from sliceit_drake.emulator.controller import ControllerConfig
from sliceit_drake.emulator.emulator import ControllerClock, Emulator
from sliceit_drake.emulator.fault_table import FAULTS
from sliceit_drake.emulator.kinematics import Posture, forward, inverse, pose_of_matrix
from sliceit_drake.emulator.modes import RobotMode, RuntimeState, SafetyMode
from sliceit_drake.emulator.process import PendantClient
from sliceit_drake.emulator.robot_model import CYCLE, START, KinematicRobot, SimulationStopped
from sliceit_drake.emulator.rtde_server import (
    FrameError,
    PackageType,
    Recipe,
    encode_frame,
    split_names,
    take_frames,
)
from sliceit_drake.emulator.station_robot import JointTargets, StationRobot
from sliceit_drake.emulator.variables import INPUTS, OUTPUTS, TYPES
from sliceit_drake.hardware.control_script import control_script
from sliceit_drake.hardware.hardware_config import load_hardware_config
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.ur5e_kinematics import make_virtual_model, ur5e_chain

# Bytes.


def random_value(kind: str, rng: random.Random):
    code, count = TYPES[kind][-1], int(TYPES[kind][:-1] or 1)
    limits = {"B": (0, 2**8 - 1), "I": (0, 2**32 - 1), "Q": (0, 2**64 - 1)}
    limits["i"] = (-(2**31), 2**31 - 1)

    def one():
        if code == "?":
            return rng.random() < 0.5
        if code == "d":
            return rng.choice([0.0, -0.0, 5e-324, 1.7e308, rng.gauss(0.0, 1e3)])
        return rng.choice([*limits[code], rng.randint(*limits[code])])

    return one() if count == 1 else tuple(one() for _ in range(count))


@pytest.mark.parametrize("seed", range(20))
def test_a_recipe_gives_back_what_it_packed(seed):
    rng = random.Random(seed)
    names = rng.sample(sorted(OUTPUTS), rng.randint(1, 60))
    types = [OUTPUTS[name] for name in names]
    values = {name: random_value(kind, rng) for name, kind in zip(names, types, strict=True)}
    recipe = Recipe(names, types)
    packed = recipe.pack(values)
    assert len(packed) == recipe.size
    assert recipe.unpack(packed) == values
    with pytest.raises(FrameError, match="bytes of values where"):
        recipe.unpack(packed + b"\0")


@pytest.mark.parametrize("seed", range(20))
def test_frames_are_found_however_the_network_splits_them(seed):
    rng = random.Random(seed)
    frames = [(rng.randrange(256), rng.randbytes(rng.choice([0, 1, 9, 3000]))) for _ in range(30)]
    stream = b"".join(encode_frame(kind, payload) for kind, payload in frames)
    unread, found = bytearray(), []
    while stream:
        size = rng.choice([1, 2, 3, 700, 5000])
        unread += stream[:size]
        found += take_frames(unread)
        stream = stream[size:]
    assert found == frames


def test_a_data_package_has_the_bytes_of_the_protocol():
    recipe = Recipe(["timestamp", "runtime_state"], ["DOUBLE", "UINT32"])
    frame = encode_frame(
        PackageType.DATA, b"\x01" + recipe.pack({"timestamp": 0.5, "runtime_state": 2})
    )
    assert frame.hex() == "0010" + "55" + "01" + "3fe0000000000000" + "00000002"


def test_what_is_no_frame_is_refused():
    with pytest.raises(FrameError, match="cannot have 2 bytes"):
        list(take_frames(bytearray(b"\x00\x02U")))
    with pytest.raises(FrameError, match="65532"):
        encode_frame(PackageType.DATA, bytes(65533))
    with pytest.raises(FrameError, match="ASCII"):
        split_names(b"timest\xffmp")
    assert split_names(b"timestamp, actual_q,") == ["timestamp", "actual_q"]


# Kinematics.


@pytest.mark.parametrize("seed", range(5))
def test_the_controllers_kinematics_are_those_of_the_simulated_arm(seed):
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, 6)
    X_TK = RobotConfig().X_TK()
    plant = make_virtual_model(ur5e_chain(X_TK), 1.0)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    X_BK = plant.GetBodyByName("end_effector").EvalPoseInWorld(context).GetAsMatrix4()
    assert forward(q, X_TK.GetAsMatrix4()) == pytest.approx(X_BK, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_inverse_finds_the_joints_again_and_the_jacobian_is_the_derivative(seed):
    rng = np.random.default_rng(seed)
    q = np.array(START) + rng.uniform(-0.3, 0.3, 6)
    X = forward(q)
    found = inverse(X, q + rng.uniform(-0.05, 0.05, 6))
    assert found == pytest.approx(q, abs=1e-6)
    v, h = rng.uniform(-1.0, 1.0, 6), 1e-6
    p = [forward(q + s * h * v)[:3, 3] for s in (1.0, -1.0)]
    velocity = (Posture(q).jacobian(X[:3, 3]) @ v)[:3]
    assert velocity == pytest.approx((p[0] - p[1]) / (2.0 * h), abs=1e-8)
    assert inverse(forward(q) + np.diag([0, 0, 0, 0]) + 9.0 * np.eye(4, k=3), q) is None


# The control script.


def test_movej_ends_at_its_target_within_its_limits():
    bench = ScriptBench()
    target = np.array(START) + [0.2, -0.1, 0.05, 0.0, 0.0, 0.3]
    speeds = []
    bench.write(1, [*target, 1.0, 4.0])
    while bench.controller.outputs["output_int_register_0"] != 2:
        bench.step()
        assert bench.controller.runtime == RuntimeState.PLAYING
        speeds.append(np.abs(bench.controller.robot.state.velocities).max())
    assert bench.positions == pytest.approx(target, abs=1e-12)
    # 0.3 rad at 1 rad/s with ramps of 0.25 s.
    assert len(speeds) * CYCLE == pytest.approx(0.55, abs=3 * CYCLE)
    assert max(speeds) <= 1.0 + 1e-9
    assert np.abs(np.diff(speeds)).max() <= 4.0 * CYCLE * 1.001


def test_movel_goes_along_a_line():
    bench = ScriptBench()
    bench.controller.tcp = [0.0, 0.0, 0.21, 0.0, 0.0, 0.0]
    bench.step()
    start = np.array(bench.controller.outputs["actual_TCP_pose"])
    bench.write(3, [*(start + [0.05, 0.03, 0.0, 0.0, 0.0, 0.0]), 0.1, 1.0])
    path = []
    while bench.controller.outputs["output_int_register_0"] != 2:
        bench.step()
        assert bench.controller.runtime == RuntimeState.PLAYING
        path.append(bench.controller.outputs["actual_TCP_pose"])
    shift = np.array(path) - start
    assert shift[-1] == pytest.approx([0.05, 0.03, 0, 0, 0, 0], abs=1e-8)
    assert np.abs(shift[:, 1] - 0.6 * shift[:, 0]).max() < 1e-8
    assert np.abs(shift[:, 2]).max() < 1e-8
    assert np.abs(bench.controller.outputs["actual_TCP_speed"]).max() < 1e-6


@pytest.mark.parametrize("lookahead", [0.03, 0.1])
def test_servoj_trails_a_ramp_by_its_lookahead_time(lookahead):
    bench, speed = ScriptBench(), 0.2
    ramp = np.array(START)
    for _ in range(1000):
        ramp = ramp + speed * CYCLE
        bench.write(11, [*ramp, 0.0, 0.0, 0.002, lookahead, 1000.0])
        bench.step()
    # A command that is held over its cycle is ahead of the ramp by half a cycle on average.
    lag = (ramp - bench.positions) / speed
    assert lag == pytest.approx(np.full(6, lookahead - 0.5 * CYCLE), abs=1e-5)


def test_servostop_brings_the_arm_to_rest():
    bench = ScriptBench()
    target = np.array(START) + 0.1
    for _ in range(20):
        bench.write(11, [*target, 0.0, 0.0, 0.002, 0.1, 300.0])
        bench.step()
    assert np.abs(bench.controller.robot.state.velocities).max() > 0.1
    bench.call(16, [10.0])
    rest = bench.positions
    bench.step(50)
    assert bench.controller.is_steady
    assert bench.positions == pytest.approx(rest, abs=1e-6)


def test_an_answer_of_done_stays_until_the_command_is_cleared():
    bench = ScriptBench()
    bench.write(43)
    bench.step(5)
    assert bench.controller.outputs["output_int_register_0"] == 2
    assert bench.answer() == pytest.approx(pose_of_matrix(forward(START)))
    bench.write(0)
    bench.step()
    assert bench.controller.outputs["output_int_register_0"] == 1


def test_an_asynchronous_move_is_done_at_once_and_goes_on():
    bench = ScriptBench()
    target = np.array(START) + 0.1
    assert bench.call(1, [*target, 1.0, 4.0], integer=1) <= 2
    running = bench.controller.outputs["output_int_register_2"]
    bench.step(200)
    finished = bench.controller.outputs["output_int_register_2"]
    assert (running >> 15 & 1, finished >> 15 & 1) == (1, 0)
    assert bench.positions == pytest.approx(target, abs=1e-12)


def test_tool_payload_and_forward_kinematics_are_kept():
    bench = ScriptBench()
    bench.call(29, [0.0, 0.0, 0.21, 0.0, 0.0, 0.0])
    bench.call(40)
    assert bench.answer() == pytest.approx([0, 0, 0.21, 0, 0, 0])
    bench.call(17, [1.2, 0.0, 0.01, 0.08])
    bench.call(17, [1.5, 0.0, 0.0, 0.0])
    assert bench.controller.outputs["payload"] == 1.5
    assert bench.controller.outputs["payload_cog"] == [0.0, 0.01, 0.08]
    q = np.array(START) + 0.1
    bench.call(44, [*q, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    pose = bench.answer()
    bench.call(29, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    bench.call(30, [*pose, *START, 1e-6, 1e-6])
    assert bench.answer() == pytest.approx(q, abs=1e-6)


EMULATED = {1, 2, 3, 4, 8, 9, 11, 15, 16, 17, 26, 27, 29, 30, 31, 33, 34, 35, 36, 37, 38, 39, 40}
EMULATED |= {43, 44, 46, 47, 58, 60, 61, 65}


@pytest.mark.parametrize("command", [*COMMAND_NAMES, 200])
def test_a_command_is_answered_or_stops_the_program_aloud(command):
    bench = ScriptBench()
    # Arguments that most commands can use: joint positions or a pose within reach.
    pose = pose_of_matrix(forward(START))
    first = START if command in (1, 4, 9, 11, 37, 44) else pose
    servo = [0.0, 0.0, 0.002, 0.1, 500.0]
    bench.write(command, [*first, *(servo if command == 11 else [1.0, 1.0, *START[2:], 1.0, 1.0])])
    bench.step(20)
    if command not in EMULATED:
        assert bench.controller.runtime == RuntimeState.STOPPED
        assert f"command {command} ({COMMAND_NAMES.get(command, 'of no')}" in bench.texts()
        assert "is not emulated" in bench.texts()
    else:
        assert bench.texts() == "" or command == 31
        assert bench.controller.outputs["output_int_register_0"] in (1, 2)


def test_a_pose_out_of_reach_stops_the_program():
    bench = ScriptBench()
    bench.call(46, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert bench.controller.runtime == RuntimeState.STOPPED
    assert "no solution" in bench.texts()


def test_the_watchdog_stops_the_program_and_the_arm():
    bench = ScriptBench()
    bench.call(35, [10.0])
    target = np.array(START)
    for _ in range(100):
        target = target + 0.5 * CYCLE
        bench.write(11, [*target, 0, 0, 0.002, 0.05, 1000.0])
        bench.step()
    assert bench.controller.runtime == RuntimeState.PLAYING
    silent_since = bench.controller.time
    while bench.controller.runtime == RuntimeState.PLAYING:
        bench.step()
    assert bench.controller.time - silent_since == pytest.approx(0.1, abs=2 * CYCLE)
    bench.step(100)
    assert bench.controller.is_steady
    assert "watchdog" in bench.texts()


def moving_bench(config: ControllerConfig | None = None) -> ScriptBench:
    """An arm in the middle of a servo motion at 0.5 rad/s."""
    bench = ScriptBench(config=config)
    target = np.array(START)
    for _ in range(200):
        target = target + 0.5 * CYCLE
        bench.write(11, [*target, 0, 0, 0.002, 0.03, 2000.0])
        bench.step()
    return bench


@pytest.mark.parametrize(
    ("mode", "variant", "runtime", "bits"),
    [
        (SafetyMode.PROTECTIVE_STOP, "pause", RuntimeState.PAUSED, 1 << 2 | 1 << 10),
        (SafetyMode.PROTECTIVE_STOP, "stop", RuntimeState.STOPPED, 1 << 2 | 1 << 10),
        (SafetyMode.SAFEGUARD_STOP, "", RuntimeState.PAUSED, 1 << 4 | 1 << 10),
        (SafetyMode.ROBOT_EMERGENCY_STOP, "", RuntimeState.STOPPED, 1 << 6 | 1 << 7 | 1 << 10),
    ],
)
def test_a_stop_shows_in_the_bits_and_the_arm_brakes(mode, variant, runtime, bits):
    bench = moving_bench()
    start, speed = bench.positions, 0.5
    bench.controller.set_safety(mode, "test", variant)
    bench.step(200)
    outputs = bench.controller.outputs
    assert outputs["runtime_state"] == runtime
    assert outputs["safety_status_bits"] == bits
    assert outputs["safety_mode"] == mode
    assert bench.controller.is_steady
    way = speed**2 / (2.0 * bench.controller.config.deceleration)
    assert bench.positions - start == pytest.approx(np.full(6, way), abs=speed * CYCLE)


def test_a_protective_stop_is_unlocked_no_sooner_than_after_its_delay():
    bench = moving_bench()
    bench.controller.set_safety(SafetyMode.PROTECTIVE_STOP, "test")
    bench.step(100)
    assert not bench.controller.unlock_protective_stop()
    assert not bench.controller.play()
    bench.step(2500)
    assert bench.controller.unlock_protective_stop()
    assert bench.controller.play()
    bench.step()
    assert bench.controller.outputs["safety_status_bits"] == 1
    assert bench.controller.runtime == RuntimeState.PLAYING


def test_a_jump_of_the_target_raises_a_protective_stop():
    bench = moving_bench()
    jump = bench.positions + [0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    bench.write(11, [*jump, 0, 0, 0.002, 0.03, 2000.0])
    bench.step(20)
    assert bench.controller.safety == SafetyMode.PROTECTIVE_STOP
    assert "joint 2 at" in bench.texts()


class WeighedRobot(KinematicRobot):
    """An arm whose sensor feels a tool of known weight."""

    mass, cog, zero = 2.0, np.array([0.0, 0.01, 0.1]), np.zeros(6)

    def step(self, targets, servo):
        state = super().step(targets, servo)
        force = self.mass * (forward(state.positions)[:3, :3].T @ self.gravity)
        self.felt = np.concatenate([force, np.cross(self.cog, force)])
        state.wrench = self.felt - self.zero
        return state

    def zero_sensor(self):
        self.zero = self.felt


def test_the_right_payload_takes_the_tools_weight_out_and_a_wrong_one_does_not():
    bench = ScriptBench(WeighedRobot())
    bench.step()
    weight = WeighedRobot.mass * 9.81
    assert bench.controller.outputs["actual_TCP_force"][:3] == pytest.approx([0, 0, -weight])
    bench.call(17, [WeighedRobot.mass, *WeighedRobot.cog])
    assert bench.controller.outputs["actual_TCP_force"] == pytest.approx(np.zeros(6), abs=1e-9)
    bench.call(17, [WeighedRobot.mass + 0.5, *WeighedRobot.cog])
    assert bench.controller.outputs["actual_TCP_force"][2] == pytest.approx(0.5 * 9.81)
    # Zeroing hides it, until the tool is turned upside down.
    bench.call(8)
    assert bench.controller.outputs["actual_TCP_force"] == pytest.approx(np.zeros(6), abs=1e-9)
    turned = np.array(START) + [0.0, 0.0, 0.0, 0.0, np.pi, 0.0]
    bench.call(1, [*turned, 3.0, 20.0])
    R = forward(turned)[:3, :3] @ forward(START)[:3, :3].T
    expected = 0.5 * 9.81 * (np.array([0, 0, 1.0]) - R @ [0, 0, 1.0])
    assert bench.controller.outputs["actual_TCP_force"][:3] == pytest.approx(expected, abs=1e-9)


def test_a_payload_set_from_the_start_with_a_zeroed_sensor_shows_nothing_in_any_posture():
    robot = WeighedRobot()
    robot.step(START, None)
    robot.zero_sensor()
    config = ControllerConfig(payload=robot.mass, payload_cog=tuple(robot.cog), is_zeroed=True)
    bench = ScriptBench(robot, config)
    assert bench.controller.outputs["payload"] == robot.mass
    assert bench.controller.outputs["actual_TCP_force"] == pytest.approx(np.zeros(6), abs=1e-9)
    bench.call(1, [*(np.array(START) + [0.0, 0.0, 0.0, 0.0, np.pi, 0.0]), 3.0, 20.0])
    assert bench.controller.outputs["actual_TCP_force"] == pytest.approx(np.zeros(6), abs=1e-9)


class BrokenRobot(KinematicRobot):
    def step(self, targets, servo):
        raise SimulationStopped("the knife left the food")


def test_a_simulation_that_stops_is_a_fault_that_says_why():
    bench = ScriptBench(BrokenRobot())
    bench.step(3)
    assert bench.controller.safety == SafetyMode.FAULT
    assert bench.controller.mode == RobotMode.POWER_OFF
    assert "the knife left the food" in bench.texts()


# The ports.


def test_a_client_gets_what_it_asks_for_at_its_frequency():
    with Bench() as bench:
        fast, slow = RawClient(bench), RawClient(bench)
        assert fast.ask(PackageType.PROTOCOL_VERSION, b"\x00\x01") == b"\x00"
        assert fast.ask(PackageType.PROTOCOL_VERSION, b"\x00\x02") == b"\x01"
        assert struct.unpack(">IIII", fast.ask(PackageType.CONTROL_VERSION)) == (5, 11, 1, 108318)
        recipes = [
            client.read_from("timestamp,actual_q", ["DOUBLE", "VECTOR6D"], frequency)
            for client, frequency in ((fast, 500.0), (slow, 125.0))
        ]
        bench.cycles(40)
        times = [d["timestamp"] for d in fast.data(recipes[0])]
        assert np.diff(times) == pytest.approx(np.full(39, 0.002))
        packages = slow.data(recipes[1])
        assert np.diff([d["timestamp"] for d in packages]) == pytest.approx(np.full(9, 0.008))
        assert packages[-1]["actual_q"] == pytest.approx(START)
        assert fast.ask(PackageType.PAUSE) == b"\x01"
        bench.cycles(5)
        assert fast.data(recipes[0]) == []


@pytest.mark.parametrize(
    ("frequency", "names", "answer"),
    [
        (500.0, "timestamp,no_such", b"\x00DOUBLE,NOT_FOUND"),
        (501.0, "timestamp", b"\x00DOUBLE"),
        (0.0, "timestamp", b"\x00DOUBLE"),
        (500.0, "actual_current_as_torque", b"\x00NOT_FOUND"),
    ],
)
def test_what_a_controller_does_not_have_is_refused(frequency, names, answer):
    with Bench() as bench:
        client = RawClient(bench)
        request = struct.pack(">d", frequency) + names.encode()
        assert client.ask(PackageType.SETUP_OUTPUTS, request) == answer
        assert client.ask(PackageType.START) == b"\x00"


def test_inputs_belong_to_who_asked_first_until_it_goes():
    with Bench() as bench:
        first, second = RawClient(bench), RawClient(bench)
        names = b"input_int_register_0,input_double_register_3,"
        assert first.ask(PackageType.SETUP_INPUTS, names) == b"\x01INT32,DOUBLE"
        assert first.ask(PackageType.SETUP_INPUTS, names) == b"\x02INT32,DOUBLE"
        assert second.ask(PackageType.SETUP_INPUTS, names) == b"\x00IN_USE,IN_USE"
        assert (
            second.ask(PackageType.SETUP_INPUTS, b"input_int_register_5,x")
            == b"\x00INT32,NOT_FOUND"
        )
        # What was refused has changed nothing.
        answer = first.ask(PackageType.SETUP_INPUTS, names + b"input_int_register_5")
        assert answer == b"\x03INT32,DOUBLE,INT32"
        first.send(PackageType.DATA, b"\x02" + struct.pack(">id", 7, 2.5))
        first.close()
        assert second.ask(PackageType.SETUP_INPUTS, names) == b"\x01INT32,DOUBLE"
        assert bench.controller.registers.integer(0) == 7
        assert bench.controller.registers.doubles(3, 1) == [2.5]


def test_a_wrong_input_package_is_ignored_aloud_and_garbage_ends_the_connection():
    with Bench() as bench:
        client = RawClient(bench)
        client.ask(PackageType.SETUP_INPUTS, b"input_int_register_0")
        client.send(PackageType.DATA, b"\x01" + struct.pack(">ii", 7, 8))
        client.send(PackageType.DATA, b"\x09" + struct.pack(">i", 7))
        ignored = client.texts()
        assert len(ignored) == 2 and all("ignored" in text for text in ignored)
        assert bench.controller.registers.integer(0) == 0
        client.socket.sendall(b"\x00\x01V")
        bench.serve()
        assert "connection closed" in client.texts()[0]
        client.frames()
        assert client.is_closed


def test_a_client_that_does_not_read_loses_whole_packages_only():
    with Bench() as bench:
        client = RawClient(bench, receive_buffer=4096)
        # The system holds megabytes for a client; long packages fill them soon.
        doubles = [f"{way}put_double_register_{i}" for way in ("in", "out") for i in range(48)]
        recipe = client.read_from(",".join([*doubles, "timestamp"]), ["DOUBLE"] * 97)
        bench.cycles(6000)
        assert bench.emulator.rtde.statistics()["skipped"] > 0
        times = []
        for _ in range(400):
            times += [d["timestamp"] for d in client.data(recipe)]
            bench.cycles(1)
        steps = np.diff(times) / CYCLE
        assert steps == pytest.approx(np.rint(steps), abs=1e-6)
        assert times[-1] > 6000 * CYCLE
        assert steps.min() == pytest.approx(1.0) and steps.max() > 10.0


def test_the_dashboard_answers_in_its_words():
    with Bench() as bench:
        dashboard = RawClient(bench, 29999)

        def say(line: str) -> str:
            dashboard.socket.sendall(line.encode() + b"\n")
            bench.serve()
            return dashboard.socket.recv(4096).decode()

        assert dashboard.socket.recv(4096) == b"Connected: Universal Robots Dashboard Server\n"
        assert say("PolyscopeVersion").startswith("URSoftware 5.11.1.108318 ")
        assert say("get serial number").strip().isdigit()
        assert say("is in remote control") == "true\n"
        assert say("robotmode") == "Robotmode: RUNNING\n"
        assert say("unlock protective stop") == "Protective stop releasing\n"
        assert say("programState") == "STOPPED rtde_control.urp\n"
        assert "not emulated" in say("make coffee")
        bench.inject("remote_control_off")
        bench.cycles(1)
        assert "not allowed" in say("stop")
        bench.inject("remote_control_on")
        bench.inject("emergency_stop")
        bench.cycles(1)
        assert say("safetystatus") == "Safetystatus: ROBOT_EMERGENCY_STOP\n"
        for line in ("restart safety", "power on", "brake release"):
            say(line)
        assert (bench.controller.mode, bench.controller.safety) == (
            RobotMode.RUNNING,
            SafetyMode.NORMAL,
        )


def test_another_program_than_the_control_script_is_refused_aloud():
    with Bench() as bench:
        client, script = RawClient(bench), RawClient(bench, 30002)
        client.read_from("timestamp", ["DOUBLE"])
        script.socket.sendall(b"def p():\n  movej([0,0,0,0,0,0])\n")
        bench.cycles(2)
        script.socket.sendall(b"end\n")
        bench.serve()
        bench.cycles(2)
        assert "only a control script is" in client.texts()[0]


# Faults.


def watched(bench: Bench) -> tuple[RawClient, Recipe]:
    client = RawClient(bench)
    return client, client.read_from("timestamp,actual_TCP_force", ["DOUBLE", "VECTOR6D"])


def test_a_fault_comes_at_its_time():
    with Bench() as bench:
        bench.inject("protective_stop", at=0.1)
        bench.cycles(50)
        assert bench.controller.safety == SafetyMode.NORMAL
        bench.cycles(1)
        assert bench.controller.safety == SafetyMode.PROTECTIVE_STOP


def test_after_silence_everything_arrives_at_once():
    with Bench() as bench:
        client, recipe = watched(bench)
        client.ask(PackageType.SETUP_INPUTS, b"input_int_register_0")
        bench.inject("silence:0.1")
        bench.cycles(1)
        client.frames()
        client.socket.sendall(encode_frame(PackageType.DATA, b"\x01" + struct.pack(">i", 9)))
        bench.cycles(48)
        assert client.data(recipe) == []
        assert bench.controller.registers.integer(0) == 0
        bench.cycles(5)
        times = [d["timestamp"] for d in client.data(recipe)]
        assert np.diff(times) == pytest.approx(np.full(len(times) - 1, CYCLE))
        assert len(times) >= 50
        assert bench.controller.registers.integer(0) == 9


def test_a_silence_that_fills_the_buffers_ends_too():
    with Bench() as bench:
        client, recipe = watched(bench)
        bench.inject("silence:4")
        bench.cycles(2001)
        client.frames()
        bench.cycles(5)
        assert client.data(recipe)[-1]["timestamp"] == pytest.approx(bench.controller.time)
        assert bench.emulator.rtde.statistics()["skipped"] > 0


def test_packages_are_lost_and_late():
    with Bench() as bench:
        client, recipe = watched(bench)
        bench.inject("drop_packets:0.25")
        bench.cycles(1000)
        got = len(client.data(recipe))
        assert 650 < got < 850
        client.ask(PackageType.SETUP_INPUTS, b"input_int_register_0")
        bench.inject("drop_packets:1")
        bench.cycles(1)
        client.send(PackageType.DATA, b"\x01" + struct.pack(">i", 3))
        bench.cycles(2)
        assert bench.controller.registers.integer(0) == 0
        bench.inject("drop_packets:0")
        bench.inject("late_packets:0.05")
        bench.cycles(200)
        assert client.data(recipe)[-1]["timestamp"] == pytest.approx(bench.controller.time - 0.05)
        client.send(PackageType.DATA, b"\x01" + struct.pack(">i", 4))
        bench.cycles(20)
        assert bench.controller.registers.integer(0) == 0
        bench.cycles(10)
        assert bench.controller.registers.integer(0) == 4


@pytest.mark.parametrize(
    ("fault", "port"), [("rtde", 30004), ("dashboard", 29999), ("script", 30003)]
)
def test_a_service_is_cut_and_can_be_reached_again(fault, port):
    with Bench() as bench:
        client, other = RawClient(bench, port), RawClient(bench, 30001 if port != 30003 else 30004)
        bench.inject(f"close:{fault}")
        bench.inject("refuse:0.1")
        bench.cycles(1)
        client.socket.setblocking(True)
        client.socket.settimeout(1.0)
        while client.socket.recv(100):
            pass
        assert other.frames() == [] and not other.is_closed
        refused = RawClient(bench, port)
        bench.cycles(60)
        assert refused.frames() == [] and refused.is_closed
        assert not RawClient(bench, port).is_closed


def test_the_remaining_faults_do_what_they_say():
    with Bench() as bench:
        client, recipe = watched(bench)
        bench.inject("sensor_bias:7")
        bench.inject("wrong_payload:3")
        bench.inject("model:UR10")
        bench.inject("second_client")
        bench.inject("frequency_125")
        bench.cycles(2)
        client.frames()
        bench.cycles(40)
        packages = client.data(recipe)
        assert np.diff([d["timestamp"] for d in packages]) == pytest.approx(np.full(9, 0.008))
        bench.controller.set_payload(1.0, None)
        assert bench.controller.payload == 3.0
        axis = forward(START)[:3, 2]
        expected = 7.0 * axis + [0.0, 0.0, 3.0 * 9.81]
        assert packages[-1]["actual_TCP_force"][:3] == pytest.approx(expected)
        answer = client.ask(PackageType.SETUP_INPUTS, b"input_int_register_0")
        assert answer == b"\x00IN_USE"
        assert len(INPUTS) > 100
        assert bench.controller.config.model == "UR10"


@pytest.mark.parametrize(
    "fault",
    [
        "thunder",
        "silence",
        "silence:-1",
        "drop_packets:2",
        "close:door",
        "emergency_stop:5",
        "shows:nothing:0",
        "shows:actual_q:no",
        "shows:robot_mode:nan",
        "shows:robot_mode:-1",
        "shows:safety_mode:flipped",
        "frame_size:65536",
        "lose_inputs:2",
        "jump_inputs:nan",
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(fault):
    with Bench() as bench, pytest.raises(ConfigurationError, match="inject"):
        bench.inject(fault)


@pytest.mark.parametrize("at", [math.nan, math.inf, -math.inf])
def test_a_time_that_never_comes_is_refused_and_blocks_no_later_fault(at):
    with Bench() as bench:
        with pytest.raises(ConfigurationError, match="is no time"):
            bench.inject("protective_stop", at)
        bench.inject("emergency_stop")
        bench.cycles(1)
        assert bench.controller.safety == SafetyMode.ROBOT_EMERGENCY_STOP


@pytest.mark.parametrize(
    ("variable", "how", "shown"),
    [
        ("actual_q", "flipped", -np.array(START)), ("actual_q", "+0.5", np.array(START) + 0.5),
        ("actual_qd", "3", np.full(6, 3.0)), ("robot_mode", "5", 5), ("actual_q", "true", START),
        ("actual_q", "*2", 2.0 * np.array(START)), ("actual_q", "+-1", np.array(START) - 1.0),
    ],
)  # fmt: skip
def test_a_variable_is_shown_otherwise_than_it_is_and_the_arm_stays(variable, how, shown):
    with Bench() as bench:
        bench.inject(f"shows:{variable}:{how}")
        bench.cycles(2)
        assert bench.controller.outputs[variable] == pytest.approx(shown)
        assert bench.controller.robot.state.positions == pytest.approx(np.array(START))


# Port, what is sent, and whether the connection ends by it.
HOSTILE = {
    "a recipe too long for a frame": (
        30004, encode_frame(PackageType.SETUP_OUTPUTS, np.array([500.0], ">f8").tobytes()
                            + b",".join([b"actual_q"] * 1500)), True),
    "a frame without a size": (30004, b"\0\0\0\0", True),
    "a frame cut short": (30004, encode_frame(PackageType.SETUP_OUTPUTS, b"\1"), True),
    "more recipes than have a number": (
        30004, encode_frame(PackageType.SETUP_INPUTS, b"input_int_register_9") * 256, True),
    "deep JSON": (30099, b"[" * 100_000 + b"\n", False),
    "a time that is none": (30099, b'{"inject": "normal", "at": NaN}\n', False),
    "a time too long": (30099, b'{"inject": "normal", "at": 1' + b"0" * 400 + b"}\n", False),
    "a mode that the wire does not hold": (
        30099, b'{"inject": "shows:robot_mode:*1000000000"}\n', False),
    "a model that is no text": (30099, b'{"inject": "model:\\ud800"}\n', False),
    "a line without an end": (30099, b"x" * ((1 << 20) + 1), True),
    "bytes that are no text": (29999, bytes(range(256)) * 40, False),
    "a register far away": (
        30003, b"def x():\n# float register offset\n a = 99999999\n"
        b"# RTDE Control script - Main loop\nend\n", False),
    "a limit that is no number": (
        30003, control_script(0.01, 0.5).replace("step = 0.01", "step = 1.2.3").encode(), False),
}  # fmt: skip


def has_ended(connection: socket.socket) -> bool:
    """Whether the other side of a connection has closed it; reads what came before."""
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_input_is_refused_and_the_others_are_served(name):
    port, data, ends = HOSTILE[name]
    with Bench() as bench:
        other = RawClient(bench)
        recipe = other.read_from("timestamp,robot_mode", ["DOUBLE", "INT32"])
        dashboard = RawClient(bench, 29999)
        attacker = socket.create_connection((bench.address, port))
        attacker.setblocking(False)
        for _ in range(200):
            with contextlib.suppress(BlockingIOError, ConnectionError):
                data = data[attacker.send(data) :]
            bench.serve()
            if not data:
                break
        for _ in range(20):
            bench.serve()
        bench.cycles(5)
        dashboard.socket.sendall(b"get robot model\n")
        bench.serve()
        assert has_ended(attacker) == ends
        assert dashboard.socket.recv(4096).endswith(b"UR5\n")
        attacker.close()
        bench.cycles(5)
        assert len(other.data(recipe)) == 10, "the emulator goes on for its other clients"
        assert bench.controller.runtime.name == "STOPPED"


def far(first: float) -> list[float]:
    return [first, *START[1:]]


# Command, its doubles, and what the controller says of them.
NO_NUMBERS = {
    "a tool that is nowhere": (29, [math.nan] * 6, "argument 0 of the command is nan"),
    "a tool turned without end": (29, [0.0, 0.0, 0.0, 1e308, 1e308, 0.0], "argument 3"),
    "a pose that is none": (46, [math.nan] * 6, "argument 0 of the command is nan"),
    "a pose at infinity": (60, [math.inf, 0.0, 0.0, 0.0, 0.0, 0.0], "argument 0"),
    "joints that are none": (44, [math.nan] * 12, "argument 0 of the command is nan"),
    "a move to infinity": (1, [*far(math.inf), 1.0, 1.0], "argument 0 of the command is inf"),
    "a move too slow to divide by": (1, [*far(2.0), 5e-324, 1e6], "program error"),
    "a speed without end": (9, [1e308] * 7, "argument 0 of the command is 1e+308"),
    "a payload without end": (17, [1e308, 0.0, 0.0, 0.0], "argument 0"),
    "a watchdog of no time": (35, [math.inf], "argument 0 of the command is inf"),
    "servoj with a gain without end": (11, [*START, 0, 0, 0.002, 0.03, math.inf], "argument 10"),
    "servoj with a gain of 1e308": (11, [*START, 0, 0, 0.002, 0.03, 1e308], "argument 10"),
    "servoj with a gain of a million": (11, [*START, 0, 0, 0.002, 1e-9, 1e6], "lookahead_time"),
    "servoj with a gain of nothing": (11, [*START, 0, 0, 0.002, 0.03, 0.0], "servoj.gain"),
    "servoj to no number": (11, [*far(math.nan), 0, 0, 0.002, 0.03, 500.0], " nan"),
}  # fmt: skip
ALL_COMMANDS = "".join(f" if cmd == {number}:\n" for number in COMMAND_NAMES)
SCRIPTS = {
    "one like ur_rtde's": (
        f"def x():\n# RTDE Control script - Main loop\n{ALL_COMMANDS}\nend\n".encode()
    ),
    "ours": control_script(0.01, 0.5).encode(),
}


@pytest.mark.parametrize("whose", SCRIPTS)
@pytest.mark.parametrize("name", NO_NUMBERS)
def test_a_command_with_no_numbers_ends_its_program_alone_and_moves_nothing(name, whose):
    command, doubles, said = NO_NUMBERS[name]
    with Bench() as bench:
        other, attacker = RawClient(bench), RawClient(bench)
        recipe = other.read_from("timestamp,actual_q", ["DOUBLE", "VECTOR6D"])
        script = RawClient(bench, 30003)
        script.socket.sendall(SCRIPTS[whose])
        bench.cycles(5)
        assert bench.controller.runtime == RuntimeState.PLAYING
        names = "".join(f",input_double_register_{i}" for i in range(len(doubles)))
        attacker.ask(PackageType.SETUP_INPUTS, b"input_int_register_0" + names.encode())
        values = struct.pack(f">Bi{len(doubles)}d", 1, command, *doubles)
        attacker.send(PackageType.DATA, values)
        bench.cycles(5)
        assert bench.controller.runtime == RuntimeState.STOPPED
        texts = " ".join(attacker.texts())
        if whose == "ours" and command not in read_script(SCRIPTS[whose].decode()).commands:
            said = f"no command {command}"
        assert said in texts
        packages = other.data(recipe)
        assert len(packages) == 10, "the emulator goes on for its other clients"
        assert np.abs(np.array([p["actual_q"] for p in packages]) - START).max() < 1e-9
        # Another program can be started.
        script.socket.sendall(SCRIPTS[whose])
        attacker.send(PackageType.DATA, struct.pack(f">Bi{len(doubles)}d", 1, 0, *doubles))
        bench.cycles(5)
        assert bench.controller.runtime == RuntimeState.PLAYING


def test_a_speed_slider_that_is_no_number_holds_the_arm():
    bench = ScriptBench()
    slider = {"speed_slider_mask": 1, "speed_slider_fraction": math.nan}
    bench.controller.registers.write(slider, bench.controller.time)
    bench.write(1, [*(np.array(START) + 0.1), 1.0, 1.0])
    bench.step(50)
    assert bench.positions == pytest.approx(np.array(START), abs=1e-12)
    assert bench.controller.outputs["target_speed_fraction"] == 0.0


def test_a_whole_number_that_is_shown_greater_stops_where_its_type_ends():
    with Bench() as bench:
        client = RawClient(bench)
        recipe = client.read_from("output_int_register_5,robot_mode", ["INT32", "INT32"])
        bench.inject("shows:output_int_register_5:*1000000")
        bench.controller.write_integer(5, 2**30)
        bench.cycles(3)
        assert client.data(recipe)[-1] == {"output_int_register_5": 2**31 - 1, "robot_mode": 7}
        with pytest.raises(ConfigurationError, match="robot_mode"):
            bench.inject("shows:robot_mode:*1000000000")


@pytest.mark.parametrize("first", [0, 24])
def test_a_target_is_shifted_wherever_the_script_has_its_registers(first):
    with Bench() as bench:
        client = RawClient(bench)
        names = f"input_int_register_{first},input_double_register_{first}"
        client.ask(PackageType.SETUP_INPUTS, names.encode())
        client.ask(PackageType.SETUP_INPUTS, b"input_int_register_0")
        bench.inject("shift_inputs:0.5")
        bench.cycles(1)
        client.send(PackageType.DATA, struct.pack(">Bid", 1, 11, 1.0))
        assert bench.controller.registers.doubles(first, 1) == [1.5]
        client.send(PackageType.DATA, struct.pack(">Bi", 2, 11))
        bench.cycles(2)
        assert not client.is_closed


def test_a_frame_that_claims_another_size_goes_out_once():
    with Bench() as bench:
        client = RawClient(bench)
        client.read_from("timestamp", ["DOUBLE"])
        bench.inject("frame_size:2")
        bench.cycles(2)
        with pytest.raises(FrameError, match="2 bytes"):
            client.frames()


def test_an_address_that_others_reach_has_to_be_asked_for_twice(capsys):
    assert main(["emulate", "--arm-alone", "--address", "0.0.0.0"]) == 2
    assert "--open-to-the-network" in capsys.readouterr().err


def test_every_fault_of_the_table_can_be_injected():
    arguments = {
        "silence": ":1", "drop_packets": ":0.1", "late_packets": ":0.1", "close": ":rtde",
        "late_inputs": ":0.1", "frame_size": ":2", "shows": ":actual_q:frozen",
        "jump_inputs": ":0.1", "shift_inputs": ":0.1", "lose_inputs": ":0.1",
        "refuse": ":1", "wrong_payload": ":1", "sensor_bias": ":1", "model": ":UR3",
    }  # fmt: skip
    with Bench() as bench:
        for name in FAULTS:
            bench.inject(name + arguments.get(name, ""))
            bench.cycles(1)


@pytest.mark.parametrize("fault", ["late_packets:0.02", "drop_packets:0.3", "frequency_125"])
def test_lockstep_does_not_wait_for_the_answer_to_a_package_that_did_not_arrive(fault):
    clock = ControllerClock(lockstep=True, patience=1.0)
    emulator = Emulator(KinematicRobot(), free_address(), clock)
    controller = emulator.controller
    controller.start_program(ControlScript(controller).step, "test")
    thread = threading.Thread(target=emulator.run)
    thread.start()
    try:
        pendant = PendantClient(emulator.address)
        sock = socket.create_connection((emulator.address, 30004), 5.0)
        doubles = "".join(f",input_double_register_{i}" for i in range(11))
        for kind, payload in (
            (PackageType.SETUP_OUTPUTS, struct.pack(">d", 500.0) + b"timestamp"),
            (PackageType.SETUP_INPUTS, b"input_int_register_0" + doubles.encode()),
            (PackageType.START, b""),
        ):
            sock.sendall(encode_frame(kind, payload))
        servo = struct.pack(">Bi11d", 1, 11, *START, 0.0, 0.0, 0.002, 0.03, 2000.0)
        unread, answered = bytearray(), 0
        while answered < 200:
            unread += sock.recv(4096)
            for kind, _ in take_frames(unread):
                if kind == PackageType.DATA:
                    sock.sendall(encode_frame(PackageType.DATA, servo))
                    answered += 1
                    if answered == 50:
                        pendant.inject(fault)
        status = pendant.status()
        sock.close()
        pendant.close()
    finally:
        emulator.stop()
        thread.join()
    assert status["rtde"]["commands"]["11"] >= 190
    assert status["missed_cycles"] == 0


# The simulated station.


def test_the_emulated_station_moves_as_the_simulated_one_under_the_same_commands():

    scenario = load_scenario(
        resource_path("scenarios/cucumber_spring.yaml"), "{start: {clearance: 0.001}}"
    )
    diagram = ScenarioDiagram(scenario)
    station = diagram.station
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.Initialize()
    robot = StationRobot(scenario)
    assert isinstance(robot._targets, JointTargets)
    config = load_hardware_config(resource_path("hardware/emulated.yaml"))
    assert robot.payload == pytest.approx(config.payload, abs=1e-3)
    assert robot.payload_cog == pytest.approx(config.payload_cog, abs=1e-4)
    context = station.GetMyContextFromRoot(simulator.get_context())
    force = 0.0
    for cycle in range(1, 151):
        # Its controller computes the command of a cycle at the cycle's start.
        simulator.AdvanceTo((cycle - 1) * CYCLE)
        simulator.AdvancePendingEvents()
        command = station.GetOutputPort("joint_positions_command").Eval(context)
        state = robot.step(command, scenario.robot.servo)
        simulator.AdvanceTo(cycle * CYCLE)
        positions = station.GetOutputPort("joint_positions").Eval(context)
        wrench = station.GetOutputPort("sensor_wrench").Eval(context)
        assert state.positions == pytest.approx(positions, abs=1e-12)
        assert state.wrench[:3] == pytest.approx(wrench.translational(), abs=1e-9)
        assert state.wrench[3:] == pytest.approx(wrench.rotational(), abs=1e-9)
        force = max(force, float(np.linalg.norm(wrench.translational())))
    assert force > 1.0


def test_a_clock_that_cannot_be_is_refused():
    with pytest.raises(ConfigurationError, match="pace"):
        ControllerClock(pace=0.0)
