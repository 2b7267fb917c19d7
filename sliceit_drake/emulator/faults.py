"""Faults that a test or a person injects, by name, at a time of the controller's clock."""

import heapq
import itertools
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.emulator.connections import Service, SocketHub
from sliceit_drake.emulator.control_script import SERVO_COMMAND
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.fault_table import FAULTS
from sliceit_drake.emulator.modes import RobotMode, SafetyMode
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.emulator.rtde_server import InputValues, RtdeServer
from sliceit_drake.emulator.variables import INPUTS, OUTPUTS, TYPES, WHOLE_NUMBERS

__all__ = ["FaultInjector"]

_CB3_RATE = 125.0
# Where a control script has the target of joint 1.
_FIRST_TARGETS = ("input_double_register_0", "input_double_register_24")


class FaultInjector:
    """Does what `FAULTS` says when the controller's time has come.

    Args:
        controller: The controller on which faults act.
        hub: Its ports.
        rtde: Its RTDE service.
        services: Services by the name that ``close`` has for them.
    """

    def __init__(
        self,
        controller: Controller,
        hub: SocketHub,
        rtde: RtdeServer,
        services: Mapping[str, Service],
    ) -> None:
        self._controller, self._hub, self._services = controller, hub, services
        self._rtde = rtde
        # Faults that wait for a client to servo: delay, what to do, and words.
        self._at_servoing: list[tuple[float, Callable[[], object], str]] = []
        self._targets_before = 0
        self._number = itertools.count()
        self._waiting: list[tuple[float, int, Callable[[], object], str]] = []
        # How the argument of each is read when it is injected, and what is then done with it.
        self._faults: dict[str, tuple[Callable[[str], tuple], Callable[..., object]]] = {
            "protective_stop": (
                _value(str, lambda word: word in ("", "pause", "stop")),
                partial(controller.set_safety, SafetyMode.PROTECTIVE_STOP, "injected"),
            ),
            "safeguard_stop": (
                _nothing,
                partial(controller.set_safety, SafetyMode.SAFEGUARD_STOP, "injected"),
            ),
            "emergency_stop": (
                _nothing,
                partial(controller.set_safety, SafetyMode.ROBOT_EMERGENCY_STOP, "injected"),
            ),
            "normal": (_nothing, self._make_normal),
            "program_stopped": (
                _nothing,
                partial(controller.stop_program, "stopped on the pendant"),
            ),
            "program_paused": (_nothing, partial(controller.pause, "on the pendant")),
            "program_resumed": (_nothing, controller.play),
            "remote_control_off": (
                _value(str, lambda word: word in ("", "keep")),
                self._leave_remote_control,
            ),
            "remote_control_on": (_nothing, partial(setattr, controller, "is_remote", True)),
            "silence": (_value(float, _is_duration), partial(self._for_a_time, "is_silent")),
            "refuse": (_value(float, _is_duration), partial(self._for_a_time, "refuses")),
            "drop_packets": (
                _value(float, lambda share: 0.0 <= share <= 1.0),
                partial(setattr, rtde, "drop_share"),
            ),
            "late_packets": (_value(float, _is_amount), partial(setattr, rtde, "delay")),
            "late_inputs": (_value(float, _is_amount), partial(setattr, rtde, "input_delay")),
            "jump_inputs": (_value(float, math.isfinite), partial(self._shift_inputs, once=True)),
            "shift_inputs": (_value(float, math.isfinite), self._shift_inputs),
            "swap_inputs": (_nothing, self._swap_inputs),
            "lose_inputs": (_value(float, lambda share: 0.0 <= share <= 1.0), self._lose_inputs),
            "arm_stuck": (_nothing, self._hold_arm),
            "frame_size": (
                _value(int, lambda size: 0 <= size <= 0xFFFF),
                partial(setattr, rtde, "next_size"),
            ),
            "shows": (self._what_is_shown, self._show),
            "close": (self._service_to_close, self._close),
            "frequency_125": (_nothing, partial(setattr, rtde, "frequency_limit", _CB3_RATE)),
            "wrong_payload": (_value(float, _is_amount), self._lock_payload),
            "sensor_bias": (_value(float, math.isfinite), self._bias_sensor),
            "model": (
                _value(str, lambda name: bool(name) and name.isprintable()),
                partial(setattr, controller.config, "model"),
            ),
            "second_client": (_nothing, self._claim_inputs),
        }

    def inject(self, fault: str, at: float | None = None, *, after: float | None = None) -> None:
        """Injects a fault.

        Args:
            fault: The fault, as ``"silence:0.1"``, see `FAULTS`.
            at: Controller time, s; None for the next cycle.
            after: In place of `at`, controller time since the first target of servoJ that comes, s.

        Raises:
            ConfigurationError: There is no such fault, or its argument or time is wrong.
        """
        name, _, argument = fault.partition(":")
        if name not in FAULTS:
            raise ConfigurationError(
                f"{name!r} is no fault", field="inject", fix=f"Give one of {', '.join(FAULTS)}."
            )
        read, act = self._faults[name]
        try:
            action = partial(act, *read(argument))
        except (ValueError, KeyError):
            raise ConfigurationError(
                f"{fault!r} is not understood", field="inject", fix=f"Write {FAULTS[name]}."
            ) from None
        if not all(x is None or math.isfinite(x) for x in (at, after)):
            raise ConfigurationError(f"{at or after} is no time", field="at", fix="Give seconds.")
        if after is not None:
            self._targets_before = self._rtde.command_counts[SERVO_COMMAND]
            self._at_servoing.append((after, action, fault))
        else:
            self._at(self._controller.time if at is None else at, action, fault)

    def apply(self) -> None:
        """Does what is due in the cycle that comes; before each cycle."""
        now = self._controller.time
        if self._at_servoing and self._rtde.command_counts[SERVO_COMMAND] > self._targets_before:
            for delay, action, what in self._at_servoing:
                self._at(now + delay, action, what)
            self._at_servoing.clear()
        while self._waiting and self._waiting[0][0] <= now + 0.5 * CYCLE:
            _, _, action, what = heapq.heappop(self._waiting)
            if what:
                self._controller.note(f"injected: {what}")
            action()

    def _at(self, time: float, action: Callable[[], object], what: str = "") -> None:
        heapq.heappush(self._waiting, (time, next(self._number), action, what))

    def _make_normal(self) -> None:
        self._controller.set_safety(SafetyMode.NORMAL, "injected")
        self._controller.mode = RobotMode.RUNNING

    def _leave_remote_control(self, keep: str) -> None:
        self._controller.is_remote = False
        if not keep:
            self._controller.stop_program("remote control off")

    def _for_a_time(self, flag: str, duration: float) -> None:
        setattr(self._hub, flag, True)
        self._at(self._controller.time + duration, partial(setattr, self._hub, flag, False))

    def _service_to_close(self, argument: str) -> tuple[Service, bool]:
        name, _, how = argument.partition(":")
        if how not in ("", "reset"):
            raise ValueError(argument)
        return self._services[name], how == "reset"

    def _close(self, service: Service, reset: bool) -> None:
        for connection in self._hub.connections(service):
            connection.close(reset)

    def _what_is_shown(self, argument: str) -> tuple[str, str, float]:
        name, _, how = argument.partition(":")
        value = self._controller.outputs[name]
        number = 0.0 if how in ("frozen", "flipped", "true") else float(how.lstrip("+*"))
        first = value[0] if isinstance(value, list | tuple) else value
        # What is an integer has to stay one that the wire holds.
        is_whole = number.is_integer() and number >= 0.0 and how != "flipped"
        if not (is_whole or isinstance(first, float)):
            raise ValueError(argument)
        if how not in ("frozen", "true"):
            low, high = _range_of(name)
            elements = value if isinstance(value, list | tuple) else [value]
            shown = [_change(how, number)(x) for x in elements]
            if not all(low <= x <= high for x in shown if not math.isnan(x)):
                raise ValueError(argument)
        return name, how, number

    def _show(self, name: str, how: str, number: float) -> None:
        self._controller.shown.pop(name, None)
        if how == "true":
            return
        if how == "frozen":
            held = self._controller.outputs[name]
            self._controller.shown[name] = lambda value: held
            return
        change, (low, high) = _change(how, number), _range_of(name)

        def one(value: Any) -> object:
            shown = change(value)
            # A value that grows stops where its type ends.
            return type(value)(low if shown < low else high if shown > high else shown)

        def each(value: Any) -> object:
            return [one(x) for x in value] if isinstance(value, list | tuple) else one(value)

        self._controller.shown[name] = each

    def _shift_inputs(self, angle: float, once: bool = False) -> None:
        def shifted(values: InputValues) -> list[InputValues]:
            if once:
                self._rtde.change_targets = None
            first = next((name for name in _FIRST_TARGETS if name in values), None)
            if first is None:
                return [values]
            return [values | {first: float(values[first]) + angle}]  # type: ignore[arg-type]

        self._rtde.change_targets = shifted

    def _swap_inputs(self) -> None:
        held: list[InputValues] = []

        def swapped(values: InputValues) -> list[InputValues]:
            if not held:
                held.append(values)
                return []
            self._rtde.change_targets = None
            return [values, *held]

        self._rtde.change_targets = swapped

    def _lose_inputs(self, share: float) -> None:
        random = np.random.default_rng(0)
        self._rtde.change_targets = lambda values: [] if random.random() < share else [values]

    def _hold_arm(self) -> None:
        self._controller.stuck_at = self._controller.robot.state.positions.copy()

    def _lock_payload(self, mass: float) -> None:
        self._controller.payload_is_locked = False
        self._controller.set_payload(mass, None)
        self._controller.payload_is_locked = True

    def _bias_sensor(self, force: float) -> None:
        self._controller.sensor_bias = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])

    def _claim_inputs(self) -> None:
        taken = self._controller.registers.claim_free("another client", list(INPUTS))
        self._controller.note(
            f"another client has taken {len(taken)} of {len(INPUTS)} input registers"
        )


def _change(how: str, number: float) -> Callable[[Any], Any]:
    """What is made of an element of a variable that is shown otherwise."""
    if how == "flipped":
        return lambda x: -x
    by_sign: dict[str, Callable[[Any], Any]] = {
        "+": lambda x: x + number,
        "*": lambda x: x * number,
    }
    return by_sign.get(how[:1], lambda x: number)


def _range_of(name: str) -> tuple[float, float]:
    """Least and greatest value that the wire holds of an output variable."""
    return WHOLE_NUMBERS.get(TYPES[OUTPUTS[name]][-1], (-math.inf, math.inf))


# Readers of a fault's argument; they raise a ValueError where it has no meaning.


def _nothing(argument: str) -> tuple[()]:
    if argument:
        raise ValueError(argument)
    return ()


def _value(read: Callable[[str], Any], is_valid: Callable[[Any], bool]) -> Callable[[str], tuple]:
    def checked(argument: str) -> tuple:
        value = read(argument)
        if not is_valid(value):
            raise ValueError(argument)
        return (value,)

    return checked


def _is_amount(value: float) -> bool:
    return 0.0 <= value < 1e3


def _is_duration(value: float) -> bool:
    return 0.0 < value < 1e3
