"""The robot that a user has: one YAML file in hardware/, which every run reads."""

import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError, choice, load_yaml, quantity
from sliceit_drake.hardware.limits import SafetyLimits, loosened

__all__ = ["HardwareConfig", "TouchConfig", "differing", "load_hardware_config"]

FACTS = ("model", "serial", "payload", "payload_cog", "board_height")
"""Fields that say what a robot is; the others say what is allowed, and how it is driven."""


@dc.dataclass
class TouchConfig:
    """How the knife feels for the board (hardware.guarded_touch).

    The force goes on rising while the arm comes to rest, in proportion to speed and stiffness: 4 N
    at the defaults on the emulated board of 30 kN/m (docs/hardware.md).
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
        limits: What may be sent; every limit has a default (hardware.limits).
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
    """Measured height of the board's surface in the world; null: unknown, nothing moves."""
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


def load_hardware_config(file: str | Path, overrides: str | None = None) -> HardwareConfig:
    """Reads and validates a robot's file; what it does not name keeps its default.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    config = load_yaml(HardwareConfig, file, defaults=HardwareConfig(), overrides_text=overrides)
    assert isinstance(config, HardwareConfig)
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
