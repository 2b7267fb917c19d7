"""The emulator: a controller, its services on one address, and the clock."""

import collections
import dataclasses as dc
import os
import time

import numpy as np

from sliceit_drake.configuration import ConfigurationError, load_yaml
from sliceit_drake.emulator.connections import SocketHub
from sliceit_drake.emulator.control_script import SERVO_COMMAND
from sliceit_drake.emulator.controller import Controller, ControllerConfig
from sliceit_drake.emulator.dashboard import Dashboard
from sliceit_drake.emulator.faults import FaultInjector
from sliceit_drake.emulator.modes import RuntimeState
from sliceit_drake.emulator.pendant import PENDANT_PORT, Pendant
from sliceit_drake.emulator.robot_model import CYCLE, RobotModel
from sliceit_drake.emulator.rtde_server import RtdeServer
from sliceit_drake.emulator.script_server import ScriptServer

__all__ = ["ControllerClock", "Emulator"]

_RTDE_PORT, _DASHBOARD_PORT = 30004, 29999
_SCRIPT_PORTS = (30003, 30001, 30002)

# Wall time beyond which the clock gives up catching up, in cycles.
_LATE_CYCLES = 5
_STATUS_LOG = 50
# Joint speed below which somebody may reach under the knife, rad/s.
_REST = 0.01
# Wall time without a command after which a client has nothing more to answer, s.
_SETTLING = 0.05


@dc.dataclass
class ControllerClock:
    """How controller time goes beside wall time.

    Attributes:
        pace: Controller time per wall time; 1 for real time.
        lockstep: Whether, while a client servos, a cycle waits for its next ``servoJ`` instead of
            for the pace. One package, one cycle: the same run every time, on any machine.
        patience: Wall time that a cycle in lockstep waits, s. Then it runs without, and the pace
            holds until the next ``servoJ``. ur_rtde gives up a connection after some 2 s of
            silence.
    """

    pace: float = 1.0
    lockstep: bool = False
    patience: float = 0.5

    def __post_init__(self) -> None:
        for field, low, high in (("pace", 1e-3, 10.0), ("patience", 1e-3, 100.0)):
            value = getattr(self, field)
            if not low <= value <= high:
                raise ConfigurationError(
                    f"{value} is not between {low:g} and {high:g}", field=field, fix="Change it."
                )


class Emulator:
    """One emulated robot on one address; ports are those of a UR.

    Args:
        robot: What moves.
        address: Loopback address, such as 127.0.0.2; one emulator each.
        clock: Pace.
        config: Kind of controller.

    Attributes:
        address: Address on which it listens.
        controller: The controller.
        faults: The faults that can be injected.
        rtde: The RTDE service.
        late_cycles: Cycles that began more than half a period late.
        missed_cycles: Cycles in lockstep that ran without a command.

    Raises:
        OSError: A port is taken.
    """

    def __init__(
        self,
        robot: RobotModel,
        address: str = "127.0.0.1",
        clock: ControllerClock | None = None,
        config: ControllerConfig | None = None,
    ) -> None:
        self.address = address
        self.controller = controller = Controller(robot, config)
        self.late_cycles = self.missed_cycles = 0
        self._clock = clock or ControllerClock()
        self._stopped = False
        self._served = 0
        self._in_step = False
        self._busy: collections.deque[float] = collections.deque(maxlen=5000)
        # Apart from the robot's own ports, so that it answers while they are silent.
        self._hub, self._own_hub = SocketHub(address), SocketHub(address)
        self.rtde = RtdeServer(controller)
        dashboard, script = Dashboard(controller), ScriptServer(controller)
        services = {"rtde": self.rtde, "dashboard": dashboard, "script": script}
        self.faults = FaultInjector(controller, self._hub, self.rtde, services)
        pendant = Pendant(self.faults, self.status, self.trace, self.stop, self.put_fresh_food)
        try:
            self._hub.listen(_RTDE_PORT, self.rtde)
            self._hub.listen(_DASHBOARD_PORT, dashboard)
            for port in _SCRIPT_PORTS:
                self._hub.listen(port, script)
            self._own_hub.listen(PENDANT_PORT, pendant)
        except OSError:
            self.close()
            raise

    def run(self) -> None:
        """Runs cycles until `stop` or an exception, then closes all sockets."""
        period = CYCLE / self._clock.pace
        due = time.monotonic() + period
        try:
            self.faults.apply()
            while not self._stopped:
                self._wait(due)
                late = time.monotonic() - due
                self.late_cycles += late > 0.5 * period and not self._in_step
                if self._in_step or late > _LATE_CYCLES * period:
                    due = time.monotonic()
                due += period
                begin = time.perf_counter()
                self.cycle()
                self._busy.append(time.perf_counter() - begin)
        finally:
            self.close()

    def cycle(self) -> None:
        """One cycle of controller time, without waiting."""
        self.faults.apply()
        self.rtde.take_late_inputs()
        self.controller.step()
        self.rtde.publish()

    def stop(self) -> None:
        """Ends `run` after the cycle."""
        self._stopped = True

    def close(self) -> None:
        """Closes all sockets."""
        self._hub.close()
        self._own_hub.close()

    def status(self) -> dict[str, object]:
        """How the controller does, as JSON."""
        controller = self.controller
        state = controller.robot.state
        busy = sorted(self._busy) or [0.0]
        return {
            "pid": os.getpid(),
            "time": controller.time,
            "runtime_state": controller.runtime.name,
            "safety_mode": controller.safety.name,
            "robot_mode": controller.mode.name,
            "remote_control": controller.is_remote,
            "positions": state.positions.tolist(),
            "velocities": state.velocities.tolist(),
            "target": controller.target.tolist(),
            "payload": controller.payload,
            "payload_cog": controller.payload_cog.tolist(),
            "tcp": controller.tcp.tolist(),
            "late_cycles": self.late_cycles,
            "missed_cycles": self.missed_cycles,
            "busy_mean": sum(busy) / len(busy),
            "busy_p99": busy[int(0.99 * (len(busy) - 1))],
            "rtde": self.rtde.statistics(),
            "log": list(controller.log)[-_STATUS_LOG:],
        }

    def trace(self, since: float) -> list[list[float]]:
        """The controller's trace from a controller time on, s."""
        return [row for row in self.controller.trace if row[0] >= since]

    def put_fresh_food(self, scenario: str | None = None) -> None:
        """Puts an uncut food under the knife, as a person does between two cuts.

        The clock and the ports stand while the food is prepared. It is that of a `Scenario`, as
        YAML, or the same again.

        Raises:
            ConfigurationError: A program plays, the arm moves, the knife is in the way, or there is
                no such food.
        """
        controller = self.controller
        speed = float(np.abs(controller.robot.state.velocities).max())
        if controller.runtime != RuntimeState.STOPPED or speed > _REST:
            raise ConfigurationError(
                f"nobody reaches under a knife that may move: the program is "
                f"{controller.runtime.name}, the fastest joint has {speed:.3g} rad/s",
                field="fresh_food",
                fix="Stop the program first.",
            )
        food = None
        if scenario is not None:
            from sliceit_drake.diagrams.scenario import Scenario

            food = load_yaml(Scenario, None, defaults=Scenario(), overrides_text=scenario)
        controller.robot.put_fresh_food(food)
        controller.note("fresh food")

    def _wait(self, due: float) -> None:
        """Serves the sockets until the next cycle is due."""
        was_in_step, self._in_step = self._in_step, False
        if not self._is_servoing():
            self._serve_until(due)
            return
        if not was_in_step:
            self._serve_until(due)
            if self._servo_packages() > self._served:
                self._await_silence()
                self._in_step = True
        elif not self.rtde.has_reached_all:
            # Nothing to answer: a lost or late package, or a client at a lower frequency.
            self._in_step = True
            self._serve_until(due)
        elif self._await_command():
            self._in_step = True
        else:
            self.missed_cycles += 1
            self._serve_until(due)
        self._served = self._servo_packages()

    def _await_command(self) -> bool:
        """Waits for the next servo command, or the end of servoing; False if none comes in time."""
        limit = time.monotonic() + self._clock.patience
        while self._servo_packages() == self._served and self._is_servoing():
            left = limit - time.monotonic()
            if left <= 0.0 or self._stopped or self._hub.is_silent:
                return False
            self.serve(left)
        return True

    def _await_silence(self) -> None:
        """Waits until the client has answered all that it was sent while the pace held.

        Otherwise each of its commands would stay a fixed but random number of cycles on the way.
        """
        seen, quiet_since = self._servo_packages(), time.monotonic()
        while time.monotonic() - quiet_since < _SETTLING and not self._stopped:
            self.serve(_SETTLING)
            if self._servo_packages() > seen:
                seen, quiet_since = self._servo_packages(), time.monotonic()

    def _is_servoing(self) -> bool:
        return (
            self._clock.lockstep
            and self.controller.runtime == RuntimeState.PLAYING
            and self.rtde.last_command == SERVO_COMMAND
        )

    def _servo_packages(self) -> int:
        return self.rtde.command_counts[SERVO_COMMAND]

    def _serve_until(self, due: float) -> None:
        while True:
            left = due - time.monotonic()
            self.serve(max(0.0, left))
            if left <= 0.0 or self._stopped:
                return

    def serve(self, timeout: float) -> None:
        """Serves all ports for up to `timeout` s, or until something has come."""
        self._own_hub.poll(0.0)
        # Short enough for the emulator's own port, which has a selector of its own.
        self._hub.poll(min(timeout, 0.01))
