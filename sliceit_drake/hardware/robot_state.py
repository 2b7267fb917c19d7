"""State that a UR controller reports in one cycle, and the meaning of its numbers."""

from typing import NamedTuple

__all__ = [
    "PLAYING",
    "RUNTIME_STATES",
    "SAFE_BITS",
    "RobotState",
    "safety_text",
]

PLAYING = 2
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
    """

    time: float
    q: list[float]
    qd: list[float]
    wrench: list[float]
    runtime_state: int
    safety_bits: int
    payload: tuple[float, ...] | None = None


def safety_text(bits: int) -> str:
    """Names of the safety bits that are set."""
    names = [name for k, name in enumerate(SAFETY_BITS) if bits >> k & 1]
    return ", ".join(names) or "no safety bit"
