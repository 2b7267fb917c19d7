"""The emulated controller: modes, program, supervision, and the values that RTDE shows.

It knows no sockets and no wall clock. One `step` is one cycle of controller time.
"""

import collections
import dataclasses as dc
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from sliceit_drake.emulator.kinematics import Posture, matrix_of_pose, pose_of_matrix
from sliceit_drake.emulator.modes import (
    JOINT_MODES,
    SAFETY_BITS,
    MessageLevel,
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from sliceit_drake.emulator.motions import ScriptError, slow_down
from sliceit_drake.emulator.robot_model import CYCLE, RobotModel, SimulationStopped
from sliceit_drake.emulator.variables import OUTPUTS, InputRegisters, zero
from sliceit_drake.systems.servo import ServoConfig

__all__ = ["Controller", "ControllerConfig", "Program"]

_LOG_LENGTH = 1000
_TRACE_LENGTH = 30_000
# Of the forces that are shown, N: no two readings of a sensor are the same.
_NOISE = 1e-13
# Joint speed below which the arm counts as standing still, rad/s.
_STEADY = 1e-4


@dc.dataclass
class ControllerConfig:
    """Kind of controller that is emulated.

    Attributes:
        version: Software version: major, minor, bugfix, build.
        serial_number: Digits only, as a UR's.
        model: Answer to the dashboard's ``get robot model``.
        unlock_delay: Controller time before a protective stop can be unlocked, s.
        deceleration: Deceleration of the arm when its program stops, rad/s2; of the order of what
            Universal Robots publish as stopping times.
        speed_limit: Joint speed that raises a protective stop, rad/s; 191 degrees a second.
        position_limit: Joint position that raises a protective stop, rad; 363 degrees.
        payload: Mass that is set on the pendant, kg.
        payload_cog: Its centre in the flange [3], m.
        is_zeroed: Whether the sensor shows zero at first, with that payload set.
    """

    version: tuple[int, ...] = (5, 11, 1, 108318)
    serial_number: str = "20205500001"
    model: str = "UR5"
    unlock_delay: float = 5.0
    deceleration: float = 10.0
    speed_limit: float = 3.3336
    position_limit: float = 6.3355
    payload: float = 0.0
    payload_cog: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_zeroed: bool = False


Program = Callable[[], bool]
"""A program that the controller plays: runs one cycle; False once it has ended. Raises a
ScriptError where it cannot go on."""


class Controller:
    """State of the controller.

    Attributes:
        config: What is emulated.
        robot: What moves.
        registers: What the clients have written.
        outputs: Value of each output variable at the end of the last cycle.
        time: Controller time, s.
        target: Joint positions that the arm was last told to go to [6], rad.
        X_FT: Tool in the flange [4, 4]; follows from `tcp`.
        runtime: What the program does.
        safety: Mode of the safety system.
        mode: How far the arm is powered.
        is_remote: Whether the pendant is set to remote control.
        payload: Mass that is set, kg.
        payload_cog: Its centre in the flange [3], m.
        stuck_at: Joint positions [6], rad, at which the arm stays (a fault), or None.
        payload_is_locked: Whether clients' changes of the payload are ignored (a fault).
        sensor_bias: Added to what the sensor feels [6], a fault.
        shown: What is made of the values of output variables before clients see them, by name (a
            fault).
        messages: Level and text of messages for the clients, taken from the left.
        log: Controller time and words of what happened.
        trace: Controller time, true joint positions [6], rad, and true force [3], N, of the last
            minute's cycles.
    """

    def __init__(self, robot: RobotModel, config: ControllerConfig | None = None) -> None:
        self.config = config or ControllerConfig()
        self.robot = robot
        self.registers = InputRegisters()
        self.outputs: dict[str, object] = {
            name: zero(kind) for name, kind in OUTPUTS.items() if name not in self.registers.values
        }
        self.time, self._cycle = 0.0, 0
        self.runtime = RuntimeState.STOPPED
        self.safety = SafetyMode.NORMAL
        self.mode = RobotMode.RUNNING
        self.is_remote = True
        self.payload = self.config.payload
        self.payload_cog = np.array(self.config.payload_cog, float)
        self.payload_is_locked = False
        self.stuck_at: np.ndarray | None = None
        self.sensor_bias = np.zeros(6)
        self.shown: dict[str, Callable[[object], object]] = {}
        self._random = np.random.default_rng(0)
        self.tcp = np.zeros(6)
        self.messages: collections.deque[tuple[int, str]] = collections.deque(maxlen=100)
        self.log: collections.deque[tuple[float, str]] = collections.deque(maxlen=_LOG_LENGTH)
        self.trace: collections.deque[list[float]] = collections.deque(maxlen=_TRACE_LENGTH)
        self._program: Program | None = None
        self._watchdog: tuple[str, float] | None = None
        self._stopped_at = -np.inf
        self.target = self._last_target = robot.state.positions
        self._target_velocity = np.zeros(6)
        self._servo: ServoConfig | None = None
        self._braking: Iterator[np.ndarray] | None = None
        self._sensor_zero = np.zeros(6)
        if self.config.is_zeroed:
            self._sensor_zero = -self._payload_wrench(Posture(robot.state.positions).X_BF[:3, :3])
        self._simulation_has_stopped = False
        self._show()

    # What a program uses.

    @property
    def tcp(self) -> np.ndarray:
        """Pose of the tool in the flange [6]."""
        return self._tcp

    @tcp.setter
    def tcp(self, pose: ArrayLike) -> None:
        self._tcp = np.array(pose, float)
        self.X_FT = matrix_of_pose(self._tcp)

    @property
    def speed_scale(self) -> float:
        """Fraction of the planned speeds that the speed slider allows."""
        if self.registers.values["speed_slider_mask"]:
            fraction = float(self.registers.values["speed_slider_fraction"])  # type: ignore[arg-type]
            # In this order a fraction that is no number holds the arm.
            return min(max(0.0, fraction), 1.0)
        return 1.0

    @property
    def is_steady(self) -> bool:
        """Whether the arm stands still."""
        return float(np.abs(self.robot.state.velocities).max()) < _STEADY

    def command(self, targets: ArrayLike, servo: ServoConfig | None = None) -> None:
        """Tells the arm where to go in this cycle, see `RobotModel.step`.

        Raises:
            ScriptError: A target is not finite.
        """
        q = np.array(targets, float)
        if not np.isfinite(q).all():
            raise ScriptError(f"joint targets {q.tolist()} are not finite")
        self.target, self._servo = q, servo

    def set_watchdog(self, name: str, period: float) -> None:
        """Stops the program when input `name` is not written for `period` s from now on."""
        self._watchdog = (name, period)
        self.registers.written_at[name] = self.time

    def set_payload(self, mass: float, cog: ArrayLike | None) -> None:
        """Sets mass, kg, and centre [3], m, of the payload; a centre of None stays as it was."""
        if self.payload_is_locked:
            return
        self.payload = float(mass)
        if cog is not None:
            self.payload_cog = np.array(cog, float)

    def zero_sensor(self) -> None:
        """Subtracts what the sensor shows now from all that follows."""
        self.robot.zero_sensor()
        R_BF = Posture(self.robot.state.positions).X_BF[:3, :3]
        self._sensor_zero = self.sensor_bias - self._payload_wrench(R_BF)

    def write_integer(self, index: int, value: int) -> None:
        """Sets output_int_register_<index>."""
        self.outputs[f"output_int_register_{index}"] = int(value)

    def write_doubles(self, index: int, values: ArrayLike) -> None:
        """Sets output_double_registers from `index` on."""
        for i, value in enumerate(np.asarray(values, float).tolist()):
            self.outputs[f"output_double_register_{index + i}"] = value

    # What pendant and dashboard do.

    def start_program(self, program: Program, what: str) -> None:
        """Plays a program in place of the one that runs; refused with a message if it cannot."""
        if not self.safety.may_move or self.mode != RobotMode.RUNNING:
            self.tell(
                MessageLevel.ERROR,
                f"program refused: safety mode {self.safety.name}, robot mode {self.mode.name}",
            )
            return
        self.stop_program("replaced by another program")
        self._program, self.runtime = program, RuntimeState.PLAYING
        self.note(f"program started: {what}")

    def stop_program(self, why: str) -> None:
        """Stops the program, if there is one, and the arm."""
        if self._program is not None:
            self.note(f"program stopped: {why}")
        self._program, self._watchdog = None, None
        self.runtime = RuntimeState.STOPPED

    def pause(self, why: str) -> bool:
        """Pauses the program; False if none plays."""
        if self.runtime != RuntimeState.PLAYING:
            return False
        self.note(f"program paused: {why}")
        self.runtime = RuntimeState.PAUSED
        return True

    def play(self) -> bool:
        """Resumes a paused program; False if it cannot."""
        if self.runtime != RuntimeState.PAUSED or not self.safety.may_move:
            return False
        self.note("program resumed")
        if self._watchdog is not None:
            self.registers.written_at[self._watchdog[0]] = self.time
        self.runtime = RuntimeState.PLAYING
        return True

    def set_safety(self, mode: SafetyMode, why: str, program: str = "pause") -> None:
        """Enters a safety mode, with what it does to program and power, and notes why.

        A protective stop pauses the program, or stops it if `program` is "stop"; which one a real
        PolyScope chooses was not checked.
        """
        if mode == self.safety:
            return
        self.safety = mode
        self.note(f"safety mode {mode.name}: {why}")
        if mode.may_move:
            return
        self.messages.append((MessageLevel.ERROR, f"{mode.name}: {why}"))
        self._stopped_at = self.time
        if mode == SafetyMode.PROTECTIVE_STOP:
            end = self.stop_program if program == "stop" else self.pause
            end("protective stop")
        elif mode == SafetyMode.SAFEGUARD_STOP:
            self.pause("safeguard stop")
        else:
            self.stop_program(mode.name)
            self.mode = RobotMode.POWER_OFF

    def unlock_protective_stop(self) -> bool:
        """Ends a protective stop; False if it is too early. True also if there is none."""
        if self.safety == SafetyMode.PROTECTIVE_STOP:
            if self.time - self._stopped_at < self.config.unlock_delay:
                return False
            self.set_safety(SafetyMode.NORMAL, "unlocked")
        return True

    def note(self, text: str) -> None:
        """Adds a text to the log."""
        self.log.append((self.time, text))

    def tell(self, level: int, text: str) -> None:
        """Sends a text message to all clients, and notes it."""
        self.note(text)
        self.messages.append((level, text))

    # One cycle.

    def step(self) -> None:
        """Advances one cycle of controller time."""
        self._cycle += 1
        self.time = self._cycle * CYCLE
        if self.runtime == RuntimeState.PLAYING:
            self._check_watchdog()
        if self.runtime == RuntimeState.PLAYING and self._program is not None:
            self._play(self._program)
        self._brake_if_uncommanded()
        self._target_velocity = (self.target - self._last_target) / CYCLE
        self._last_target = self.target
        self._move()
        while self.robot.warnings:
            self.tell(MessageLevel.WARNING, self.robot.warnings.pop(0))
        state = self.robot.state
        self.trace.append([self.time, *state.positions.tolist(), *state.wrench[:3].tolist()])
        self._show()
        self._supervise()

    def _move(self) -> None:
        if self._simulation_has_stopped:
            return
        try:
            target = self.target if self.stuck_at is None else self.stuck_at
            self.robot.step(target, self._servo)
        except SimulationStopped as error:
            # A robot has no such state; a fault is the nearest that clients understand.
            self._simulation_has_stopped = True
            self.robot.state.velocities = np.zeros(6)
            self.set_safety(SafetyMode.FAULT, f"the simulation stopped: {error}")

    def _play(self, program: Program) -> None:
        try:
            if not program():
                self.stop_program("it ended")
        except (ScriptError, ArithmeticError, ValueError) as error:
            # Numbers of a client may also have no result: too small to divide by, no rotation.
            self.messages.append((MessageLevel.ERROR, f"program error: {error}"))
            self.stop_program(f"error: {error}")

    def _check_watchdog(self) -> None:
        if self._watchdog is not None:
            name, period = self._watchdog
            silent = self.time - self.registers.written_at[name]
            if silent > period:
                self.tell(MessageLevel.ERROR, f"RTDE watchdog: no {name} for {silent:.3f} s")
                self.stop_program("RTDE watchdog")

    def _brake_if_uncommanded(self) -> None:
        """Holds the last target while a program plays; else the arm comes to rest."""
        if self.runtime == RuntimeState.PLAYING:
            self._braking = None
            return
        if self._braking is None:
            state = self.robot.state
            self._braking = slow_down(state.positions, state.velocities, self.config.deceleration)
            if not self.is_steady:
                self.target, self._servo = state.positions, None
        self.target = next(self._braking, self.target)

    def _supervise(self) -> None:
        if not self.safety.may_move or self.mode != RobotMode.RUNNING:
            return
        state, config = self.robot.state, self.config
        speed, reach = np.abs(state.velocities), np.abs(state.positions)
        if speed.max() > config.speed_limit:
            joint = int(speed.argmax())
            why = f"joint {joint} at {speed[joint]:.2f} rad/s, limit {config.speed_limit:.2f}"
        elif reach.max() > config.position_limit:
            joint = int(reach.argmax())
            why = f"joint {joint} at {state.positions[joint]:.2f} rad"
        else:
            return
        self.set_safety(SafetyMode.PROTECTIVE_STOP, why)

    # What RTDE shows.

    def _payload_wrench(self, R_BF: np.ndarray) -> np.ndarray:
        """Weight of the payload that is set, about the flange in its axes [6]."""
        if self.payload == 0.0:
            return np.zeros(6)
        force = self.payload * (R_BF.T @ self.robot.gravity)
        return np.concatenate([force, _cross(self.payload_cog, force)])

    def _show(self) -> None:
        state, X_FT = self.robot.state, self.X_FT
        posture = Posture(state.positions)
        X_BT = posture.X_BF @ X_FT
        R = posture.X_BF[:3, :3]
        raw = state.wrench + self.sensor_bias + _NOISE * self._random.standard_normal(6)
        wrench = raw - self._payload_wrench(R) - self._sensor_zero
        force = wrench[:3]
        moment = wrench[3:] - _cross(X_FT[:3, 3], force)
        safety, mode, is_playing = self.safety, self.mode, self.runtime == RuntimeState.PLAYING
        self.outputs |= {
            "timestamp": self.time,
            "actual_q": state.positions.tolist(),
            "actual_qd": state.velocities.tolist(),
            "target_q": self.target.tolist(),
            "target_qd": self._target_velocity.tolist(),
            "target_moment": state.torques.tolist(),
            "actual_current_as_torque": state.torques.tolist(),
            "actual_TCP_pose": pose_of_matrix(X_BT).tolist(),
            "actual_TCP_speed": (posture.jacobian(X_BT[:3, 3]) @ state.velocities).tolist(),
            "actual_TCP_force": np.concatenate([R @ force, R @ moment]).tolist(),
            "tcp_force_scalar": float(np.linalg.norm(force)),
            "ft_raw_wrench": (raw + state.zero).tolist(),
            "target_TCP_pose": pose_of_matrix(Posture(self.target).X_BF @ X_FT).tolist(),
            "tcp_offset": self.tcp.tolist(),
            "payload": self.payload,
            "payload_cog": self.payload_cog.tolist(),
            "robot_mode": int(mode),
            "joint_mode": [JOINT_MODES[mode]] * 6,
            "safety_mode": int(safety),
            "safety_status": int(safety),
            "safety_status_bits": SAFETY_BITS[safety],
            "runtime_state": int(self.runtime),
            # Power on, program running.
            "robot_status_bits": (mode >= RobotMode.POWER_ON) | is_playing << 1,
            "speed_scaling": self.speed_scale if is_playing else 0.0,
            "target_speed_fraction": self.speed_scale,
            "actual_main_voltage": 48.0,
            "actual_robot_voltage": 48.0,
        }
        self.outputs |= {name: change(self.outputs[name]) for name, change in self.shown.items()}


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b of vectors [3]; NumPy's takes ten times as long."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])
