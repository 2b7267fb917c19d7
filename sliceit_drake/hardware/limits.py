"""Limits of what may be sent to a robot: every one on by default, YAML to change them.

A limit stands at its default unless the user's YAML names it, so that nobody loosens one unaware.
"""

import dataclasses as dc

from sliceit_drake.configuration import ConfigurationError, dump_yaml, quantity

__all__ = ["SafetyLimits", "loosened"]

JOINTS = 6


@dc.dataclass
class SafetyLimits:
    """Limits of what the safety layer lets through.

    The defaults are for slow slicing beside a person who holds the emergency stop. Their sources:
    the UR5e's published ranges and joint limits (Universal Robots' technical details; model file
    models/ur5e/ur5e.urdf) bound them, and the motion of scenarios/cucumber.yaml, simulated, needs
    0.22 rad/s, 1.4 rad/s2, 0.08 m/s, 16 N, 0.007 rad of tracking error (docs/hardware.md). In
    between they are choices, not measurements.
    """

    joint_lower: list[float] = quantity(
        [-6.1, -6.1, -3.0, -6.1, -6.1, -6.1], "rad", low=-6.2832, high=6.2832, size=JOINTS
    )
    """Least joint positions; the arm's own are -2 pi, of the elbow -pi."""
    joint_upper: list[float] = quantity(
        [6.1, 6.1, 3.0, 6.1, 6.1, 6.1], "rad", low=-6.2832, high=6.2832, size=JOINTS
    )
    """Greatest joint positions; the arm's own are 2 pi, of the elbow pi."""
    joint_window: float = quantity(1.0, "rad", low=1e-3, high=12.6)
    """Greatest distance of a joint from where the plan starts, for cables and elbow flips."""
    joint_speed: list[float] = quantity([0.5] * JOINTS, "rad/s", low=1e-3, high=3.1416, size=JOINTS)
    """Speed of a joint; the arm's own limit is pi."""
    joint_acceleration: list[float] = quantity(
        [10.0] * JOINTS, "rad/s2", low=0.1, high=40.0, size=JOINTS
    )
    """Acceleration of a joint, and how it is stopped; ur_rtde allows 40 at most."""
    deviation: float = quantity(5e-4, "rad", low=0.0, high=5e-3)
    """How far a target may be moved to keep joint_acceleration, before it is a breach: cycles that
    come late and noise of the encoders ask for that."""
    joint_step: float = quantity(0.01, "rad", low=1e-6, high=0.1)
    """Change of a target from the one sent before, however long ago that was."""
    knife_speed: float = quantity(0.15, "m/s", low=1e-3, high=1.0)
    """Speed of either end of the edge."""
    workspace_lower: list[float] = quantity([-0.40, -0.75, -0.01], "m", low=-3.0, high=3.0, size=3)
    """Least x, y, z of both ends of the edge, in the world."""
    workspace_upper: list[float] = quantity([0.40, -0.25, 0.50], "m", low=-3.0, high=3.0, size=3)
    """Greatest x, y, z of both ends of the edge, in the world."""
    board_depth: float = quantity(5e-4, "m", low=0.0, high=0.02)
    """How far the lowest point of the edge may be sent below the board's surface."""
    tilt: float = quantity(0.6, "rad", low=0.0, high=1.5)
    """Angle between the blade, spine to edge, and down."""
    force: float = quantity(50.0, "N", low=1.0, high=250.0)
    """Force at the sensor; the UR5e's sensor has 50 N."""
    torque: float = quantity(10.0, "Nm", low=0.1, high=50.0)
    """Torque at the sensor; the UR5e's sensor has 10 Nm."""
    tracking_error: float = quantity(0.02, "rad", low=1e-4, high=0.5)
    """Distance of a joint from the target sent before."""
    state_age: float = quantity(0.01, "s", low=0.002, high=0.2)
    """Time in which the controller's clock must go on, and its longest jump."""
    command_age: float = quantity(0.01, "s", low=0.002, high=0.2)
    """Controller time between the measurement that a command answers and its sending."""

    def check(self, where: str) -> None:
        for low, high in (
            ("joint_lower", "joint_upper"),
            ("workspace_lower", "workspace_upper"),
        ):
            for k, (a, b) in enumerate(zip(getattr(self, low), getattr(self, high), strict=True)):
                if a >= b:
                    raise ConfigurationError(
                        f"{a:.6g} is not below {high}, {b:.6g}",
                        field=f"{where}.{low}[{k}]",
                        fix="Leave room between the two.",
                    )
        # A stop begins as fast as the arm moves, as late as these ages let it.
        least = max(self.joint_speed) * (self.state_age + self.command_age)
        if self.joint_step < least * (1.0 - 1e-9):
            raise ConfigurationError(
                f"{self.joint_step:.6g} rad is less than a stop needs after the longest gap, "
                f"joint_speed (state_age + command_age) = {least:.6g} rad",
                field=f"{where}.joint_step",
                fix="Lower joint_speed or the ages, or raise it.",
            )


def loosened(limits: SafetyLimits) -> list[str]:
    """Lines that say which limits differ from the defaults, for the operator to read."""
    text = dump_yaml(limits, defaults=SafetyLimits()).strip()
    return [] if text in ("", "{}") else text.splitlines()
