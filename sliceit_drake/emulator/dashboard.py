"""The dashboard service, port 29999: a line in, a line out."""

from collections.abc import Callable

from sliceit_drake.emulator.connections import Connection, Service, take_until
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.modes import RobotMode, RuntimeState, SafetyMode

__all__ = ["Dashboard"]

_GREETING = b"Connected: Universal Robots Dashboard Server\n"
_PROGRAM = "rtde_control.urp"
_LONGEST_LINE = 4096


class Dashboard(Service):
    """Answers as a UR's dashboard server does to what the public clients ask."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._answers: dict[str, Callable[[], str]] = {
            "polyscopeversion": self._version,
            "get serial number": lambda: controller.config.serial_number,
            "get robot model": lambda: controller.config.model,
            "is in remote control": lambda: str(controller.is_remote).lower(),
            "robotmode": lambda: f"Robotmode: {controller.mode.name}",
            "safetymode": lambda: f"Safetymode: {controller.safety.name}",
            "safetystatus": lambda: f"Safetystatus: {controller.safety.name}",
            "running": self._is_running,
            "programstate": self._program_state,
            "get loaded program": lambda: f"Loaded program: /programs/{_PROGRAM}",
            "isprogramsaved": lambda: f"true {_PROGRAM}",
            "close safety popup": lambda: "closing safety popup",
            "close popup": lambda: "closing popup",
            "quit": lambda: "Disconnected",
            "shutdown": lambda: "Shutting down",
        }
        # Only in remote control.
        self._commands: dict[str, Callable[[], str]] = {
            "play": self._play,
            "stop": self._stop,
            "pause": self._pause,
            "unlock protective stop": self._unlock,
            "restart safety": self._restart_safety,
            "power on": self._power_on,
            "power off": self._power_off,
            "brake release": self._brake_release,
        }

    def opened(self, connection: Connection) -> None:
        connection.send(_GREETING)

    def received(self, connection: Connection) -> None:
        while (text := take_until(connection.unread, b"\n")) is not None:
            line = text.decode("utf-8", "replace").strip()
            connection.send(self.answer(line).encode() + b"\n")
            if line.lower() in ("quit", "shutdown"):
                connection.close()
                return
        if len(connection.unread) > _LONGEST_LINE:
            connection.close()

    def answer(self, line: str) -> str:
        """The answer to a line, both without their ends."""
        command = line.lower()
        if command in self._answers:
            return self._answers[command]()
        if command in self._commands:
            if not self._controller.is_remote:
                return f"Command '{line}' is not allowed in local control mode"
            return self._commands[command]()
        if command.startswith("popup"):
            return "showing popup"
        if command.startswith("addtolog"):
            self._controller.note(f"client says {line[8:].strip()}")
            return "Added log message"
        return f"could not understand: '{line}' (not emulated)"

    # Answers.

    def _version(self) -> str:
        return f"URSoftware {'.'.join(map(str, self._controller.config.version))} (Mar 03 2022)"

    def _is_running(self) -> str:
        is_playing = self._controller.runtime == RuntimeState.PLAYING
        return f"Program running: {str(is_playing).lower()}"

    def _program_state(self) -> str:
        runtime = self._controller.runtime
        known = runtime if runtime in (RuntimeState.PLAYING, RuntimeState.PAUSED) else None
        return f"{known.name if known else 'STOPPED'} {_PROGRAM}"

    def _play(self) -> str:
        return "Starting program" if self._controller.play() else "Failed to execute: play"

    def _stop(self) -> str:
        self._controller.stop_program("stopped by the dashboard")
        return "Stopped"

    def _pause(self) -> str:
        paused = self._controller.pause("by the dashboard")
        return "Pausing program" if paused else "Failed to execute: pause"

    def _unlock(self) -> str:
        if self._controller.unlock_protective_stop():
            return "Protective stop releasing"
        return (
            f"Cannot unlock protective stop until {self._controller.config.unlock_delay:g}s after "
            "occurrence. Always inspect cause of protective stop before unlocking"
        )

    def _restart_safety(self) -> str:
        self._controller.set_safety(SafetyMode.NORMAL, "safety restarted")
        self._controller.mode = RobotMode.POWER_OFF
        return "Restarting safety"

    def _power_on(self) -> str:
        if self._controller.safety.may_move and self._controller.mode < RobotMode.IDLE:
            self._controller.mode = RobotMode.IDLE
        return "Powering on"

    def _power_off(self) -> str:
        self._controller.stop_program("powered off")
        self._controller.mode = RobotMode.POWER_OFF
        return "Powering off"

    def _brake_release(self) -> str:
        if self._controller.safety.may_move and self._controller.mode >= RobotMode.IDLE:
            self._controller.mode = RobotMode.RUNNING
        return "Brake releasing"
