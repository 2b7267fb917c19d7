"""The port contract of every slicing station, simulated or hardware, as data."""

import dataclasses as dc
import functools

from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity

__all__ = ["STATION_PORTS", "StationPort", "ports_as_markdown"]


@dc.dataclass(frozen=True)
class StationPort:
    """One exported port of a station.

    Attributes:
        direction: "input" or "output".
        name: Port name.
        type: RigidTransform, SpatialVelocity or SpatialForce, or the size of a vector.
        unit: Units of the elements.
        frame: Frame in which it is expressed.
        point: Point that it is about.
        meaning: What it is, and its sign.
        required: Whether an input must be connected; otherwise the configured value is used.
        period: "coupling step" (2 ms by default) or "plant" (1 ms).
    """

    direction: str
    name: str
    type: type | int
    unit: str
    frame: str
    point: str
    meaning: str
    required: bool = False
    period: str = "coupling step"

    def type_name(self) -> str:
        """Drake type as people write it."""
        return f"vector[{self.type}]" if isinstance(self.type, int) else self.type.__name__


_input = functools.partial(StationPort, "input")
_output = functools.partial(StationPort, "output")

STATION_PORTS: tuple[StationPort, ...] = (
    _input("target_pose", RigidTransform, "m", "W", "Ko", "X_WK that the knife shall reach", True),
    _input("target_wrench", SpatialForce, "N, Nm", "W", "Ko", "pull on the robot; 0 by default"),
    _input("stiffness", 6, "N/m, Nm/rad", "K", "Ko", "x y z, about x y z"),
    _input("p_gains", 6, "1", "B", "Ko", "x y z, about x y z"),
    _input("d_gains", 6, "s", "B", "Ko", "x y z, about x y z, per virtual second"),
    _input("selection", 6, "1", "B", "Ko", "1 position, 0 force; used in parallel mode"),
    _input("error_scale", 1, "1", "-", "-", "factor on the controlled error"),
    _output("joint_positions", 6, "rad", "joints", "-", "measured", period="plant"),
    _output("joint_velocities", 6, "rad/s", "joints", "-", "measured", period="plant"),
    _output("joint_positions_command", 6, "rad", "joints", "-", "sent to the joint servo"),
    _output("commanded_pose", RigidTransform, "m", "W", "Ko", "X_WK at the command"),
    _output("knife_pose", RigidTransform, "m", "W", "Ko", "X_WK measured", period="plant"),
    _output(
        "knife_velocity", SpatialVelocity, "m/s, rad/s", "W", "Ko", "V_WK measured", period="plant"
    ),
    _output(
        "sensor_wrench",
        SpatialForce,
        "N, Nm",
        "S",
        "So",
        "of the environment on the robot, after taring",
    ),
    _output("food_wrench", SpatialForce, "N, Nm", "W", "Ko", "of the food on the knife"),
    _output(
        "board_wrench",
        SpatialForce,
        "N, Nm",
        "W",
        "Ko",
        "of the board on the knife",
        period="plant",
    ),
    _output("cut_progress", 1, "1", "-", "-", "fraction of the section that is cut"),
)


def ports_as_markdown() -> str:
    """The contract as a table for people."""
    lines = [
        "| port | direction | type | unit | frame | point | period | meaning |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for p in STATION_PORTS:
        meaning = p.meaning + (" (required)" if p.required else "")
        cells = (p.name, p.direction, p.type_name(), p.unit, p.frame, p.point, p.period, meaning)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
