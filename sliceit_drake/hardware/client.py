"""Interface of a robot as the link needs it, so that tests and other libraries can stand in."""

import dataclasses as dc
import ipaddress
from typing import NamedTuple, Protocol

__all__ = [
    "PLAYING",
    "RUNNING",
    "RUNTIME_STATES",
    "SAFE_BITS",
    "STOPPED",
    "RobotClient",
    "RobotFacts",
    "RobotState",
    "RobotUnavailableError",
    "is_loopback",
    "safety_text",
]

STOPPED, PLAYING = 1, 2
RUNNING = 7
RUNTIME_STATES = ("stopping", "stopped", "playing", "pausing", "paused", "resuming")

SAFETY_BITS = (
    "normal",
    "reduced mode",
    "protective stop",
    "recovery mode",
    "safeguard stop",
    "system emergency stop",
    "robot emergency stop",
    "emergency stop",
    "safety violation",
    "safety fault",
    "stopped due to safety",
)
SAFE_BITS = 0b11
"""Normal and reduced mode: in all others the controller moves nothing."""


class RobotUnavailableError(RuntimeError):
    """There is no robot to talk to, or it refuses; the message says what to do."""


class RobotState(NamedTuple):
    """One cycle of the controller.

    Attributes:
        time: The controller's clock, s: the only evidence that the data are fresh.
        q: Joint positions [6], rad.
        qd: Joint velocities [6], rad/s.
        wrench: Force of the environment on the tool, then the torque, at the flange in the axes of
            the base [6], N and Nm (the controller's "TCP force" while its TCP is the flange).
        runtime_state: Index into `RUNTIME_STATES`.
        safety_bits: The controller's safety_status_bits.
        payload: Mass that the controller subtracts, kg, and its centre in the flange, m [4]; None
            where it is not read.
        target_q: Joint positions that the controller itself aims at [6], rad.
        raw_wrench: What the sensor shows without payload and zeroing, in the flange's axes [6].
        tcp_pose: Where the controller has its tool centre point in the base: position, m, and
            rotation vector, rad [6].
        speed: Product of its speed scaling and of the speed slider, 1 for 100 %.
        robot_mode: Its mode; `RUNNING` if it may move. None like the four before where not read.
    """

    time: float
    q: list[float]
    qd: list[float]
    wrench: list[float]
    runtime_state: int
    safety_bits: int
    payload: tuple[float, ...] | None = None
    target_q: list[float] | None = None
    raw_wrench: list[float] | None = None
    tcp_pose: list[float] | None = None
    speed: float | None = None
    robot_mode: int | None = None


def safety_text(bits: int) -> str:
    """Names of the safety bits that are set."""
    names = [name for k, name in enumerate(SAFETY_BITS) if bits >> k & 1]
    return ", ".join(names) or "no safety bit"


@dc.dataclass
class RobotFacts:
    """Facts that a robot tells before it is used.

    Attributes:
        model: Model as the dashboard has it, such as "UR5".
        serial: Serial number.
        software: PolyScope's version, as "5.11.1".
        robot_mode: Mode as the dashboard has it, such as "RUNNING".
        safety_mode: Safety mode as the dashboard has it, such as "NORMAL".
        remote_control: Whether it is in remote control; None where the robot cannot say.
        payload: Mass that the controller was told, kg.
        payload_cog: Its centre of gravity in the flange's frame [3], m.
        tcp: Tool centre point in the flange's frame, position and rotation vector [6], m, rad.
        speed_scaling: The speed slider, 1 for 100 %.
    """

    model: str
    serial: str
    software: str
    robot_mode: str
    safety_mode: str
    remote_control: bool | None
    payload: float
    payload_cog: list[float]
    tcp: list[float]
    speed_scaling: float


class RobotClient(Protocol):
    """A connected robot. Only `RobotLink`'s thread calls `timestamp` to `servo` during a run."""

    def timestamp(self) -> float:
        """The controller's time in the newest data, s; the same again if nothing came."""

    def read(self) -> RobotState:
        """The newest data, all of one cycle."""

    def is_connected(self) -> bool:
        """Whether no connection is known to be lost; True proves nothing."""

    def servo(self, q: list[float]) -> bool:
        """Sends a joint target [6], rad; False if it was refused. True proves nothing."""

    def kick(self) -> None:
        """Tells the watchdog that the program lives, where no target is sent."""

    def set_watchdog(self, frequency: float) -> bool:
        """Lets the controller stop the program if less than `frequency` inputs a second come."""

    def stop(self) -> None:
        """Stops the motion and the program on the robot; may block while a link is dead.

        Raises:
            RuntimeError: The program does not stop, or nobody can tell.
        """

    def facts(self) -> RobotFacts:
        """The facts that the robot tells."""

    def zero_sensor(self) -> None:
        """Subtracts what the force sensor shows now from all that it shows later."""

    def allows_joints(self, q: list[float]) -> bool:
        """Whether the robot's own safety limits and planes allow joint positions [6], rad."""

    def start_move(self, q: list[float], speed: float, acceleration: float) -> bool:
        """Begins to move all joints to `q` [6], rad, along a line in joint space; rad/s, rad/s2.

        Returns at once, with whether the robot took it. Only `stop` ends the motion before.
        """

    def close(self) -> None:
        """Stops the program on the robot, if it was not stopped, and disconnects.

        Raises:
            RuntimeError: The program does not stop, and nobody else sees to it.
        """


def is_loopback(host: str) -> bool:
    """Whether this is a numeric loopback address, as an emulated controller's is.

    A name is none, not even localhost: what it stands for can change, to a tunnel for example.
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
