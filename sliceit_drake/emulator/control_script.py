"""The control scripts of ur_rtde and of `hardware.control_script`, as far as a slice needs them.

A client uploads a program in URScript that polls a register for commands. It is not interpreted
here: its side of the register protocol is written out again. Read from its text are its first
register, the commands that it has, and how far a target of servoJ may jump. Input integer register
0 has the number of a command, output integer register 0 answers 1 (ready) or 2 (done), and doubles
carry the arguments. What is not emulated stops the program with a message that says so.
"""

import dataclasses as dc
import math
import re
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.kinematics import forward, inverse, matrix_of_pose, pose_of_matrix
from sliceit_drake.emulator.modes import SafetyMode
from sliceit_drake.emulator.motions import ScriptError, joint_motion, line_motion, slow_down
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.systems.servo import ServoConfig

__all__ = ["COMMAND_NAMES", "SERVO_COMMAND", "ControlScript", "ScriptText", "read_script"]

_MAIN_LOOP = "RTDE Control script - Main loop"
_READY, _DONE = 1, 2
_STOP_SCRIPT = 255

SERVO_COMMAND = 11
"""Command number of ``servoJ``."""

# Commands that the script runs again in every cycle while they stay in the register.
_REPEATED = {6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}

COMMAND_NAMES = {
    1: "moveJ", 2: "moveJ_IK", 3: "moveL", 4: "moveL_FK", 6: "forceMode", 7: "forceModeStop",
    8: "zeroFtSensor", 9: "speedJ", 10: "speedL", 11: "servoJ", 12: "servoC", 15: "speedStop",
    16: "servoStop", 17: "setPayload", 18: "teachMode", 19: "endTeachMode",
    20: "forceModeSetDamping", 21: "forceModeSetGainScaling", 24: "servoL", 25: "toolContact",
    26: "getStepTime", 27: "getActualJointPositionsHistory", 28: "getTargetWaypoint",
    29: "setTcp", 30: "getInverseKinematics", 31: "triggerProtectiveStop", 33: "stopL",
    34: "stopJ", 35: "setWatchdog", 36: "isPoseWithinSafetyLimits",
    37: "isJointsWithinSafetyLimits", 38: "getJointTorques", 39: "poseTrans", 40: "getTCPOffset",
    41: "jogStart", 42: "jogStop", 43: "getForwardKinematics", 44: "getForwardKinematics",
    45: "movePath", 46: "getInverseKinematics", 47: "isSteady", 51: "moveUntilContact",
    52: "freedriveMode", 53: "endFreedriveMode", 54: "getFreedriveStatus",
    56: "ftRtdeInputEnable", 57: "enableExternalFtSensor",
    58: "getActualToolFlangePose", 59: "setGravity", 60: "getInverseKinematicsHasSolution",
    61: "getInverseKinematicsHasSolution", 62: "startContactDetection",
    63: "stopContactDetection", 64: "readContactDetection", 65: "setTargetPayload",
    66: "directTorque", 67: "getMassMatrix", 68: "getCoriolisAndCentrifugalTorques",
    69: "getTargetJointAccelerations", 70: "getJacobian", 71: "getJacobianTimeDerivative",
}  # fmt: skip
"""ur_rtde's name of each command of the protocol."""

# What stopL brakes a joint with, for want of its Cartesian meaning: a fifth of a metre of arm.
_RADIANS_PER_METRE = 5.0
_TOLERANCE = 1e-6
# What no argument of a command exceeds, in any of their units; its squares are far from overflow.
_GREATEST = 1e7


@dc.dataclass(frozen=True)
class ScriptText:
    """What the text of a control script says.

    Attributes:
        offset: First register that it uses: 0 or 24.
        commands: Numbers of the commands that it has; None for all.
        most_in_a_step: Most that a target of servoJ may change at once, rad.
        most_in_a_cycle: By which what it may change grows in each cycle, rad.
        most_move_speed: Greatest speed of a joint in moveJ, rad/s.
    """

    offset: int = 0
    commands: frozenset[int] | None = None
    most_in_a_step: float = math.inf
    most_in_a_cycle: float = math.inf
    most_move_speed: float = math.inf


def read_script(text: str) -> ScriptText | None:
    """Reads an uploaded program; None if it is no control script that is known."""
    if _MAIN_LOOP not in text:
        return None
    match = re.search(r"# float register offset\s*\n\D*(\d+)", text)
    offset = 0 if match is None else {"0": 0, "24": 24}.get(match.group(1))
    if offset is None:
        return None
    try:
        commands = frozenset(map(int, re.findall(r"\bcmd == (\d+)\b", text)))
        step, cycle = (_number(text, f"most_in_a_{unit}") for unit in ("step", "cycle"))
        speed = _number(text, "most_move_speed")
    except ValueError:
        return None
    return ScriptText(offset, commands, step, cycle, speed)


def _number(text: str, name: str) -> float:
    match = re.search(rf"global {name} = ([\d.e+-]+)\s", text)
    # Named but not checked, it is no limit.
    if match is None or "check_step(q)\n" not in text:
        return math.inf
    return float(match.group(1))


class ControlScript:
    """The program, one `step` a cycle.

    Args:
        controller: The controller whose registers and arm it uses.
        text: What its text says.
    """

    def __init__(self, controller: Controller, text: ScriptText | None = None) -> None:
        self._controller = controller
        self._text = text or ScriptText()
        self._offset = self._text.offset
        self._budget = 0.0
        self._main = self._main_loop()
        self._motion: Iterator[np.ndarray] | None = None
        self._servo: tuple[np.ndarray, ServoConfig] | None = None
        self._speed: tuple[np.ndarray, float] | None = None
        self._async_writes = self._async_operation = 0

    def step(self) -> bool:
        """Runs one cycle, as a `controller.Program`."""
        # A command to stop that begins in this cycle also ends what would move the arm in it.
        if next(self._main, _END) is _END:
            return False
        controller = self._controller
        if self._motion is not None:
            target = next(self._motion, None)
            if target is None:
                self._end_motion()
            else:
                controller.command(target)
        if self._servo is not None:
            controller.command(*self._servo)
        if self._speed is not None:
            self._run_speed(*self._speed)
        return True

    def _main_loop(self) -> Iterator[None]:
        is_executing = False
        self._report_async(False)
        self._answer(_READY)
        while True:
            command = self._integer(0)
            if command == _STOP_SCRIPT:
                return
            if command in _REPEATED:
                yield from self._run(command)
                self._answer(_READY)
            elif command == 0:
                is_executing = False
                self._answer(_READY)
            elif not is_executing:
                yield from self._run(command)
                self._answer(_DONE)
                is_executing = True
            yield

    def _run(self, command: int) -> Iterator[None]:
        """Runs a command to its end; each `yield` is the end of a cycle."""
        if self._text.commands is not None and command not in self._text.commands:
            raise ScriptError(f"the program has no command {command}")
        if command in _DOUBLES:
            self._controller.write_doubles(self._offset, _DOUBLES[command](self))
        elif command in _QUESTIONS:
            self._controller.write_integer(self._offset + 1, int(_QUESTIONS[command](self)))
        elif command in _SETTINGS:
            _SETTINGS[command](self)
            yield
        elif command in _MOTIONS:
            for target in _MOTIONS[command](self) or ():
                self._controller.command(target)
                yield
        else:
            name = COMMAND_NAMES.get(command, "of no known name")
            raise ScriptError(f"command {command} ({name}) is not emulated")

    # Registers.

    def _integer(self, index: int) -> int:
        return self._controller.registers.integer(self._offset + index)

    def _double(self, index: int) -> float:
        return self._doubles(index, 1)[0]

    def _doubles(self, index: int, count: int = 6) -> list[float]:
        values = self._controller.registers.doubles(self._offset + index, count)
        for k, value in enumerate(values):
            # Written so that what is no number does not pass.
            if not abs(value) <= _GREATEST:
                raise ScriptError(f"argument {index + k} of the command is {value:.6g}")
        return values

    def _pose(self, index: int = 0) -> np.ndarray:
        return matrix_of_pose(self._doubles(index))

    def _answer(self, state: int) -> None:
        self._controller.write_integer(self._offset, state)

    def _report_async(self, is_running: bool) -> None:
        """Status word of asynchronous motions: running flag, number of operation and of writes."""
        self._async_writes = (self._async_writes + 1) % 128
        self._async_operation = (self._async_operation + is_running) % 128
        word = is_running << 15 | self._async_writes << 16 | self._async_operation << 24
        self._controller.write_integer(self._offset + 2, word)

    # Motions.

    def _scale(self) -> float:
        return self._controller.speed_scale

    def _end_motion(self) -> None:
        if self._motion is not None:
            self._motion = None
            self._report_async(False)

    def _move(self, motion: Iterator[np.ndarray]) -> Iterator[np.ndarray] | None:
        """Runs a motion now, or beside the main loop if it is asynchronous."""
        self._end_motion()
        if self._integer(1):
            self._motion = motion
            self._report_async(True)
            return None
        return motion

    def _move_joints(self, end: ArrayLike) -> Iterator[np.ndarray] | None:
        speed, acceleration = self._doubles(6, 2)
        if not speed <= self._text.most_move_speed:
            raise ScriptError(f"a motion is too fast, {speed:.3g} rad/s")
        target = self._controller.target
        return self._move(joint_motion(target, end, speed, acceleration, self._scale))

    def _move_line(self, end: np.ndarray) -> Iterator[np.ndarray] | None:
        speed, acceleration = self._doubles(6, 2)
        target, X_FT = self._controller.target, self._controller.X_FT
        return self._move(line_motion(target, end, X_FT, speed, acceleration, self._scale))

    def _stop(self, factor: float = 1.0) -> Iterator[np.ndarray]:
        """Comes to rest with a deceleration of `factor` times the argument."""
        state = self._controller.robot.state
        return slow_down(state.positions, state.velocities, factor * self._double(0))

    def _servo_joints(self) -> None:
        # The program's own check comes before what the controller makes of the numbers.
        self._check_step(np.array(self._controller.registers.doubles(self._offset, 6)))
        lookahead_time, gain = self._doubles(9, 2)
        servo = ServoConfig(lookahead_time=lookahead_time, gain=gain)
        try:
            validate(servo, "servoj")
        except ConfigurationError as error:
            raise ScriptError(str(error)) from None
        self._servo = (np.array(self._doubles(0)), servo)

    def _check_step(self, target: np.ndarray) -> None:
        text = self._text
        if self._servo is None:
            self._budget = text.most_in_a_cycle
        last = self._controller.target if self._servo is None else self._servo[0]
        step = float(np.abs(target - last).max())
        self._budget = min(text.most_in_a_step, self._budget + text.most_in_a_cycle)
        if not step <= self._budget:
            raise ScriptError(f"a target jumps by {step:.3g} rad, allowed {self._budget:.3g}")
        self._budget -= step

    def _stop_servo(self) -> Iterator[np.ndarray]:
        self._servo = None
        return self._stop()

    def _speed_joints(self) -> None:
        # The real script keeps the speed until told otherwise, whatever the time sent.
        self._speed = (np.array(self._doubles(0)), self._double(6))

    def _run_speed(self, speed: np.ndarray, acceleration: float) -> None:
        controller = self._controller
        now = controller.robot.state.velocities
        change = np.clip(speed - now, -acceleration * CYCLE, acceleration * CYCLE)
        controller.command(controller.target + CYCLE * (now + change))

    def _stop_speed(self) -> Iterator[np.ndarray]:
        self._speed = None
        return self._stop()

    def _stop_motion(self, factor: float) -> Iterator[np.ndarray]:
        self._end_motion()
        return self._stop(factor)

    # Settings.

    def _set_payload(self) -> None:
        mass, *cog = self._doubles(0, 4)
        if not mass >= 0.0:
            raise ScriptError(f"set_payload: a mass of {mass} kg")
        # The client sends zeros for "keep the centre".
        self._controller.set_payload(mass, cog if any(cog) else None)

    def _set_tcp(self) -> None:
        self._controller.tcp = np.array(self._doubles(0))

    def _set_watchdog(self) -> None:
        frequency = self._double(0)
        if not frequency > 0.0:
            raise ScriptError(f"rtde_set_watchdog: a frequency of {frequency} Hz")
        self._controller.set_watchdog(f"input_int_register_{self._offset}", 1.0 / frequency)

    def _stop_protectively(self) -> None:
        self._controller.set_safety(SafetyMode.PROTECTIVE_STOP, "asked by the program")

    # Questions.

    @property
    def _positions(self) -> np.ndarray:
        return self._controller.robot.state.positions

    def _inverse(self, guess: ArrayLike) -> np.ndarray | None:
        """Joint positions near `guess` for the pose that was sent; None where there are none."""
        return inverse(self._pose(), guess, self._controller.X_FT)

    def _inverse_or_stop(self, guess: ArrayLike) -> np.ndarray:
        found = self._inverse(guess)
        if found is None:
            raise ScriptError("get_inverse_kin: no solution")
        return found

    def _is_reachable(self, q: ArrayLike | None) -> bool:
        limit = self._controller.config.position_limit + _TOLERANCE
        return q is not None and bool(np.abs(q).max() <= limit)

    def _joint_history(self) -> np.ndarray:
        if self._integer(1) != 0:
            raise ScriptError("get_actual_joint_positions_history: only 0 steps are emulated")
        return self._positions


_END = object()

# What moves the arm.
_MOTIONS: dict[int, Callable[[ControlScript], Iterator[np.ndarray] | None]] = {
    1: lambda script: script._move_joints(script._doubles(0)),
    2: lambda script: script._move_joints(script._inverse_or_stop(script._controller.target)),
    3: lambda script: script._move_line(script._pose()),
    4: lambda script: script._move_line(forward(script._doubles(0), script._controller.X_FT)),
    9: ControlScript._speed_joints,
    SERVO_COMMAND: ControlScript._servo_joints,
    15: ControlScript._stop_speed,
    16: ControlScript._stop_servo,
    33: lambda script: script._stop_motion(_RADIANS_PER_METRE),
    34: lambda script: script._stop_motion(1.0),
}
# What takes a cycle to set.
_SETTINGS: dict[int, Callable[[ControlScript], None]] = {
    8: lambda script: script._controller.zero_sensor(),
    17: ControlScript._set_payload,
    29: ControlScript._set_tcp,
    31: ControlScript._stop_protectively,
    35: ControlScript._set_watchdog,
    65: ControlScript._set_payload,
}
# What is answered with doubles.
_DOUBLES: dict[int, Callable[[ControlScript], ArrayLike]] = {
    26: lambda script: [CYCLE],
    27: ControlScript._joint_history,
    30: lambda script: script._inverse_or_stop(script._doubles(6)),
    38: lambda script: script._controller.robot.state.torques,
    39: lambda script: pose_of_matrix(script._pose() @ script._pose(6)),
    40: lambda script: script._controller.tcp,
    43: lambda script: pose_of_matrix(forward(script._positions, script._controller.X_FT)),
    44: lambda script: pose_of_matrix(forward(script._doubles(0), script._pose(6))),
    46: lambda script: script._inverse_or_stop(script._controller.target),
    58: lambda script: pose_of_matrix(forward(script._positions)),
}
# What is answered with yes or no.
_QUESTIONS: dict[int, Callable[[ControlScript], bool]] = {
    36: lambda script: script._is_reachable(script._inverse(script._controller.target)),
    37: lambda script: script._is_reachable(script._doubles(0)),
    47: lambda script: script._controller.is_steady,
    60: lambda script: script._inverse(script._controller.target) is not None,
    61: lambda script: script._inverse(script._doubles(6)) is not None,
}
