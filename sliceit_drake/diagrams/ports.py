"""The port contract of every slicing station, simulated or hardware, as data."""

import dataclasses as dc
import itertools

from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, PortDataType

__all__ = ["STATION_PORTS", "StationPort", "check_station_ports", "ports_as_markdown"]


@dc.dataclass(frozen=True)
class StationPort:
    """One exported port of a station.

    Attributes:
        name: Port name.
        direction: "input" or "output".
        type: RigidTransform, SpatialVelocity or SpatialForce, or the size of a vector.
        unit: Units of the elements.
        frame: Frame in which it is expressed.
        point: Point that it is about.
        meaning: What it is, and its sign.
        period: "coupling step" (2 ms by default), "plant" (1 ms), or "continuous".
        required: Whether an input must be connected; otherwise the configured value is used.
    """

    name: str
    direction: str
    type: type | int
    unit: str
    frame: str
    point: str
    meaning: str
    period: str
    required: bool = False

    def type_name(self) -> str:
        """Drake type as people write it."""
        return f"vector[{self.type}]" if isinstance(self.type, int) else self.type.__name__


def _input(
    name: str,
    kind: type | int,
    unit: str,
    frame: str,
    point: str,
    meaning: str,
    required: bool = False,
) -> StationPort:
    return StationPort(name, "input", kind, unit, frame, point, meaning, "coupling step", required)


def _output(
    name: str, kind: type | int, unit: str, frame: str, point: str, meaning: str, period: str
) -> StationPort:
    return StationPort(name, "output", kind, unit, frame, point, meaning, period)


STATION_PORTS: tuple[StationPort, ...] = (
    _input("target_pose", RigidTransform, "m", "W", "Ko", "X_WK that the knife shall reach", True),
    _input("target_wrench", SpatialForce, "N, Nm", "W", "Ko", "pull on the robot; 0 by default"),
    _input("stiffness", 6, "N/m, Nm/rad", "K", "Ko", "x y z, about x y z"),
    _input("p_gains", 6, "1", "B", "Ko", "x y z, about x y z"),
    _input("d_gains", 6, "s", "B", "Ko", "x y z, about x y z, per virtual second"),
    _input("selection", 6, "1", "B", "Ko", "1 position, 0 force; used in parallel mode"),
    _input("error_scale", 1, "1", "-", "-", "factor on the controlled error"),
    _output("joint_positions", 6, "rad", "joints", "-", "measured", "plant"),
    _output("joint_velocities", 6, "rad/s", "joints", "-", "measured", "plant"),
    _output(
        "joint_positions_command",
        6,
        "rad",
        "joints",
        "-",
        "sent to the joint servo",
        "coupling step",
    ),
    _output(
        "commanded_pose", RigidTransform, "m", "W", "Ko", "X_WK at the command", "coupling step"
    ),
    _output("knife_pose", RigidTransform, "m", "W", "Ko", "X_WK measured", "plant"),
    _output("knife_velocity", SpatialVelocity, "m/s, rad/s", "W", "Ko", "V_WK measured", "plant"),
    _output(
        "sensor_wrench",
        SpatialForce,
        "N, Nm",
        "S",
        "So",
        "of the environment on the robot, after taring",
        "coupling step",
    ),
    _output(
        "food_wrench", SpatialForce, "N, Nm", "W", "Ko", "of the food on the knife", "coupling step"
    ),
    _output("board_wrench", SpatialForce, "N, Nm", "W", "Ko", "of the board on the knife", "plant"),
    _output(
        "cut_progress", 1, "1", "-", "-", "fraction of the section that is cut", "coupling step"
    ),
)


def check_station_ports(station: Diagram) -> None:
    """Checks a station against the contract: names, directions, types, sizes, no feedthrough.

    Raises:
        ValueError: Naming every difference.
    """
    problems = []
    inputs = [station.get_input_port(InputPortIndex(i)) for i in range(station.num_input_ports())]
    outputs = [
        station.get_output_port(OutputPortIndex(i)) for i in range(station.num_output_ports())
    ]
    present = {("input", p.get_name()): p for p in inputs}
    present |= {("output", p.get_name()): p for p in outputs}
    for port in STATION_PORTS:
        found = present.get((port.direction, port.name))
        if found is None:
            problems.append(f"no {port.direction} port {port.name}")
            continue
        if isinstance(port.type, int):
            if found.get_data_type() != PortDataType.kVectorValued or found.size() != port.type:
                problems.append(f"{port.name} is not a vector of {port.type}")
            continue
        if found.get_data_type() != PortDataType.kAbstractValued:
            problems.append(f"{port.name} is not a {port.type.__name__}")
            continue
        value = found.Allocate()
        if not isinstance(value, Value[port.type]):
            problems.append(f"{port.name} carries {type(value).__name__}, not {port.type.__name__}")
    for i, o in itertools.product(range(len(inputs)), range(len(outputs))):
        if station.HasDirectFeedthrough(i, o):
            problems.append(
                f"{inputs[i].get_name()} feeds through to {outputs[o].get_name()} in an instant"
            )
    if problems:
        raise ValueError(f"{station.get_name()} breaks the port contract: " + "; ".join(problems))


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
