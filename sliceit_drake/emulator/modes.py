"""Modes of a UR controller, with the numbers and bits under which RTDE shows them.

Numbers and bits are those of Universal Robots' RTDE guide and of its client libraries.
"""

import enum

__all__ = [
    "JOINT_MODES",
    "SAFETY_BITS",
    "MessageLevel",
    "RobotMode",
    "RuntimeState",
    "SafetyMode",
]


class RuntimeState(enum.IntEnum):
    """State of the program."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class MessageLevel(enum.IntEnum):
    """How grave a text message to the clients is."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFORMATION = 3


class RobotMode(enum.IntEnum):
    """How far the arm is powered."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7


class SafetyMode(enum.IntEnum):
    """State of the safety system."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9

    @property
    def may_move(self) -> bool:
        """Whether the arm may move."""
        return self in (SafetyMode.NORMAL, SafetyMode.REDUCED)


_STOPPED = 1 << 10
_EMERGENCY = 1 << 7

SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | _STOPPED,
    SafetyMode.RECOVERY: 1 << 3,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | _STOPPED,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 1 << 5 | _EMERGENCY | _STOPPED,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | _EMERGENCY | _STOPPED,
    SafetyMode.VIOLATION: 1 << 8 | _STOPPED,
    SafetyMode.FAULT: 1 << 9 | _STOPPED,
}
"""safety_status_bits by mode."""

JOINT_MODES = dict.fromkeys(RobotMode, 239) | {RobotMode.RUNNING: 253, RobotMode.IDLE: 255}
"""joint_mode of each joint by mode: running, idle, or else power off."""
