"""Faults that a test or a person injects, by name, at a time of the controller's clock."""

import heapq
import itertools
from collections.abc import Callable

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.emulator.connections import Service, SocketHub
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.fault_table import FAULTS
from sliceit_drake.emulator.modes import RobotMode, SafetyMode
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.emulator.rtde_server import RATE, RtdeServer
from sliceit_drake.emulator.variables import INPUTS

__all__ = ["FaultInjector"]

_CB3_RATE = 125.0


class FaultInjector:
    """Does what `FAULTS` says when the controller's time has come."""

    def __init__(
        self,
        controller: Controller,
        hub: SocketHub,
        rtde: RtdeServer,
        services: dict[str, list[Service]],
    ) -> None:
        """Prepares.

        Args:
            controller: The controller on which faults act.
            hub: Its ports.
            rtde: Its RTDE service.
            services: Services by the name that ``close`` has for them.
        """
        self._controller, self._hub, self._rtde = controller, hub, rtde
        self._services = services
        self._number = itertools.count()
        self._waiting: list[tuple[float, int, Callable[[], None], str]] = []

    def inject(self, fault: str, at: float | None = None) -> None:
        """Injects a fault.

        Args:
            fault: The fault, as ``"silence:0.1"``, see `FAULTS`.
            at: Controller time, s; None for the next cycle.

        Raises:
            ConfigurationError: There is no such fault, or its argument is wrong.
        """
        name, _, argument = fault.partition(":")
        if name not in FAULTS:
            raise ConfigurationError(
                f"{name!r} is no fault", field="inject", fix=f"Give one of {', '.join(FAULTS)}."
            )
        try:
            action = getattr(self, FAULTS[name].method)(argument)
        except (ValueError, KeyError):
            raise ConfigurationError(
                f"{fault!r} is not understood", field="inject", fix=f"Write {FAULTS[name].usage}."
            ) from None
        self._at(self._controller.time if at is None else at, action, fault)

    def apply(self) -> None:
        """Does what is due in the cycle that comes; before each cycle."""
        now = self._controller.time
        while self._waiting and self._waiting[0][0] <= now + 0.5 * CYCLE:
            _, _, action, what = heapq.heappop(self._waiting)
            if what:
                self._controller.log.append((now, f"injected: {what}"))
            action()

    def _at(self, time: float, action: Callable[[], None], what: str = "") -> None:
        heapq.heappush(self._waiting, (time, next(self._number), action, what))

    # Each method reads its argument now and returns what to do later.

    def _protective_stop(self, argument: str) -> Callable[[], None]:
        program = _one_of(argument, "pause", "stop") if argument else None
        return lambda: self._controller.set_safety(SafetyMode.PROTECTIVE_STOP, "injected", program)

    def _safeguard_stop(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: self._controller.set_safety(SafetyMode.SAFEGUARD_STOP, "injected")

    def _emergency_stop(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: self._controller.set_safety(SafetyMode.ROBOT_EMERGENCY_STOP, "injected")

    def _normal(self, argument: str) -> Callable[[], None]:
        _nothing(argument)

        def act() -> None:
            self._controller.set_safety(SafetyMode.NORMAL, "injected")
            self._controller.mode = RobotMode.RUNNING

        return act

    def _program_stopped(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: self._controller.stop_program("stopped on the pendant")

    def _program_paused(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: _discard(self._controller.pause("on the pendant"))

    def _program_resumed(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: _discard(self._controller.play())

    def _remote_control_off(self, argument: str) -> Callable[[], None]:
        stops = not argument or _one_of(argument, "keep") != "keep"

        def act() -> None:
            self._controller.is_remote = False
            if stops:
                self._controller.stop_program("remote control off")

        return act

    def _remote_control_on(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: setattr(self._controller, "is_remote", True)

    def _silence(self, argument: str) -> Callable[[], None]:
        return self._for_a_time("is_silent", _positive(argument))

    def _refuse(self, argument: str) -> Callable[[], None]:
        return self._for_a_time("refuses", _positive(argument))

    def _for_a_time(self, flag: str, duration: float) -> Callable[[], None]:
        def act() -> None:
            setattr(self._hub, flag, True)
            end = self._controller.time + duration
            self._at(end, lambda: setattr(self._hub, flag, False))

        return act

    def _drop_packets(self, argument: str) -> Callable[[], None]:
        share = float(argument)
        if not 0.0 <= share <= 1.0:
            raise ValueError(argument)
        return lambda: setattr(self._rtde, "drop_share", share)

    def _late_packets(self, argument: str) -> Callable[[], None]:
        delay = float(argument)
        if not 0.0 <= delay < 1e3:
            raise ValueError(argument)
        return lambda: setattr(self._rtde, "delay", delay)

    def _close(self, argument: str) -> Callable[[], None]:
        name, _, how = argument.partition(":")
        services = self._services[name]
        reset = bool(how) and _one_of(how, "reset") == "reset"

        def act() -> None:
            for service in services:
                for connection in self._hub.connections(service):
                    connection.close(reset)

        return act

    def _frequency(self, argument: str) -> Callable[[], None]:
        _nothing(argument)
        return lambda: setattr(self._rtde, "frequency_limit", min(_CB3_RATE, RATE))

    def _wrong_payload(self, argument: str) -> Callable[[], None]:
        mass = float(argument)
        if not 0.0 <= mass < 1e3:
            raise ValueError(argument)

        def act() -> None:
            self._controller.payload_is_locked = False
            self._controller.set_payload(mass, None)
            self._controller.payload_is_locked = True

        return act

    def _sensor_bias(self, argument: str) -> Callable[[], None]:
        force = float(argument)
        if not np.isfinite(force):
            raise ValueError(argument)
        bias = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
        return lambda: setattr(self._controller, "sensor_bias", bias)

    def _model(self, argument: str) -> Callable[[], None]:
        if not argument:
            raise ValueError(argument)
        return lambda: setattr(self._controller.config, "model", argument)

    def _second_client(self, argument: str) -> Callable[[], None]:
        _nothing(argument)

        def act() -> None:
            taken = self._controller.registers.claim_free("another client", list(INPUTS))
            text = f"another client has taken {len(taken)} of {len(INPUTS)} input registers"
            self._controller.log.append((self._controller.time, text))

        return act


def _discard(_: object) -> None:
    """Ignores the answer of an action."""


def _nothing(argument: str) -> None:
    if argument:
        raise ValueError(argument)


def _one_of(argument: str, *choices: str) -> str:
    if argument not in choices:
        raise ValueError(argument)
    return argument


def _positive(argument: str) -> float:
    value = float(argument)
    if not 0.0 < value < 1e3:
        raise ValueError(argument)
    return value
