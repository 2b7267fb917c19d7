"""The robot that a user has: one YAML file in hardware/, which every run reads.

A limit of what may be sent stands at its default unless the user's YAML names it, so that nobody
loosens one unaware.
"""

import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError, choice, dump_yaml, quantity
from sliceit_drake.overrides import Overrides, load_overridden

__all__ = [
    "HardwareConfig",
    "SafetyLimits",
    "TouchConfig",
    "differing",
    "load_hardware_config",
    "loosened",
]

JOINTS = 6

FACTS = ("model", "serial", "payload", "payload_cog", "board_height")
"""Fields that say what a robot is; the others say what is allowed, and how it is driven."""


@dc.dataclass
class SafetyLimits:
    """Limits of what the safety layer lets through.

    The defaults are for slow slicing beside a person who holds the emergency stop. Their sources:
    the UR5e's published ranges and joint limits (Universal Robots' technical details; model file
    models/ur5e/ur5e.urdf) bound them, and the motion of the scenario cucumber_measured, simulated,
    needs 0.22 rad/s, 1.4 rad/s2, 0.08 m/s, 16 N, 0.007 rad of tracking error.
    In between they are choices, not measurements.
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
    measured_margin: float = quantity(2e-3, "m", low=0.0, high=0.05)
    """How far beyond workspace and board_depth the edge may be measured; commands may not."""
    measured_speed: float = quantity(1.5, "", low=1.0, high=5.0)
    """How much faster than joint_speed and knife_speed the arm may be measured."""
    singular_margin: float = quantity(0.1, "", low=0.0, high=0.5)
    """Least distance of the arm from a singularity: sines of elbow and wrist, shoulder in m."""
    clearance: float = quantity(2e-3, "m", low=0.0, high=0.1)
    """Least distance of gripper, knife, wrists and forearm from board, table and holder, and of
    gripper and knife from the arm, where the arm could stop after a target; the measured arm may
    come nearer by measured_margin."""
    force_age: float = quantity(0.02, "s", low=0.002, high=1.0)
    """Longest time in which the force readings are the same to the last digit."""
    force_rate: float = quantity(5000.0, "N/s", low=100.0, high=1e5)
    """Fastest change of the force between two readings; a board of 30 kN/m at 0.15 m/s: 4500."""
    raw_force: float = quantity(5.0, "N", low=0.5, high=250.0)
    """How far the raw force and the one that counts may come apart, for longer than force_age."""
    felt_force: float = quantity(0.1, "N", low=0.0, high=10.0)
    """Change of the force, averaged over 0.1 s, that the knife must feel in a food; noise may ask
    for more."""
    blind_depth: float = quantity(5e-3, "m", low=0.0, high=0.05)
    """Way down in a food on which felt_force must be felt, in each part of it."""
    read_back: float = quantity(5e-4, "rad", low=1e-4, high=0.1)
    """How far the robot's own joint targets may be from all that was sent a moment before."""
    kinematics: float = quantity(5e-3, "m", low=1e-4, high=0.05)
    """How far the robot's own flange may be from where the nominal kinematics have it."""
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


@dc.dataclass
class TouchConfig:
    """How the knife feels for the board (hardware.guarded_touch).

    The force goes on rising while the arm comes to rest, in proportion to speed and stiffness: 4 N
    at the defaults on the emulated board of 30 kN/m (docs/how_to/hardware.md).
    """

    speed: float = quantity(0.005, "m/s", low=5e-4, high=0.02)
    """Speed of the knife, down and until it is clear again."""
    retract_speed: float = quantity(0.02, "m/s", low=5e-4, high=0.1)
    """Speed of the knife when it is clear again."""
    force: float = quantity(5.0, "N", low=0.5, high=25.0)
    """Change of the force that means contact."""
    force_limit: float = quantity(30.0, "N", low=1.0, high=50.0)
    """Force at the sensor that stops the robot in a touch."""
    below: float = quantity(0.005, "m", low=0.0, high=0.02)
    """How far under the expected height it looks."""
    tolerance: float = quantity(1e-3, "m", low=1e-4, high=5e-3)
    """How far the board may be from the expected height."""


@dc.dataclass
class HardwareConfig:
    """A robot, its tool, how it is driven and within which limits.

    Attributes:
        serial: Serial number of the one robot that this file is for; empty accepts any.
        limits: What may be sent; every limit has a default.
    """

    model: str = choice("UR5", ("UR5",))
    """As the dashboard names it; a UR5e says UR5."""
    serial: str = ""
    software: str = "5.6"
    """Least version of PolyScope."""
    payload: float | None = quantity(None, "kg", low=0.0, high=5.0)
    """Mass beyond the flange: gripper, adapter and knife."""
    payload_cog: list[float] | None = quantity(None, "m", low=-0.5, high=0.5, size=3)
    """Its centre of gravity, from the flange."""
    payload_tolerance: float = quantity(0.05, "kg", low=0.0, high=1.0)
    """How far the controller's payload may be off."""
    cog_tolerance: float = quantity(0.01, "m", low=0.0, high=0.2)
    """How far its centre of gravity may be off."""
    board_height: float | None = quantity(None, "m", low=-1.0, high=2.0)
    """Measured height of the board's surface in the world; null: unknown, no slice begins."""
    unzeroed_force: float = quantity(10.0, "N", low=0.1, high=50.0)
    """Most that the sensor may show in the air before zeroing, less the payload's weight."""
    sensor_force: float = quantity(3.0, "N", low=0.1, high=20.0)
    """Most that the sensor may show in the air after zeroing."""
    sensor_torque: float = quantity(0.5, "Nm", low=0.01, high=5.0)
    """Most that the sensor may show in the air after zeroing."""
    start_tolerance: float = quantity(0.01, "rad", low=1e-4, high=0.2)
    """How far a joint may be off the start."""
    singularity: float = quantity(0.05, "", low=0.0, high=0.5)
    """Least singular value of the knife's Jacobian (m and rad) on the plan."""
    lookahead_time: float = quantity(0.03, "s", low=0.03, high=0.2)
    """Argument of servoj."""
    gain: float = quantity(2000.0, "1/s2", low=100.0, high=2000.0)
    """Argument of servoj."""
    watchdog: float = quantity(50.0, "Hz", low=5.0, high=250.0)
    """Inputs a second below which the controller stops."""
    touch: TouchConfig = dc.field(default_factory=TouchConfig)
    limits: SafetyLimits = dc.field(default_factory=SafetyLimits)

    def check(self, where: str) -> None:
        if not all(part.isdigit() for part in self.software.split(".")):
            raise ConfigurationError(
                f"{self.software!r} is no version", field=f"{where}.software", fix="Write 5.11."
            )


def load_hardware_config(file: str | Path, overrides: Overrides = None) -> HardwareConfig:
    """Reads and validates a robot's file; what it does not name keeps its default.

    Args:
        file: YAML of `HardwareConfig` fields.
        overrides: What replaces them, see `Overrides`.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    config: HardwareConfig = load_overridden(HardwareConfig, file, overrides, "--set-robot")
    return config


def differing(config: HardwareConfig) -> list[str]:
    """Lines that say which limits, tolerances and settings differ from the defaults."""
    default, lines = HardwareConfig(), []
    for part, where, ours, theirs in (
        (HardwareConfig, "", config, default),
        (TouchConfig, "touch.", config.touch, default.touch),
    ):
        for field in dc.fields(part):
            value = getattr(ours, field.name)
            if field.name in (*FACTS, "touch", "limits") or value == getattr(theirs, field.name):
                continue
            lines.append(f"{where}{field.name}: {value}")
    return lines + loosened(config.limits)


def loosened(limits: SafetyLimits) -> list[str]:
    """Lines that say which limits differ from the defaults, for the operator to read."""
    text = dump_yaml(limits, defaults=SafetyLimits()).strip()
    return [] if text in ("", "{}") else text.splitlines()
