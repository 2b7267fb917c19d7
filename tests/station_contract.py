"""Checks a station against the port contract of all stations."""

import itertools

from pydrake.common.value import Value
from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, PortDataType

from sliceit_drake.diagrams.ports import STATION_PORTS


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
