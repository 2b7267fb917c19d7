"""One function for the station of a scenario: simulated, or a robot behind the same ports."""

from typing import overload

from pydrake.geometry import Meshcat

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.hardware_station import HardwareStation, RobotConnection
from sliceit_drake.diagrams.prepared_food import OwnCutting
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.station_interface import OwnController

__all__ = ["MakeStation"]


@overload
def MakeStation(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    hardware: None = None,
    *,
    cutting: OwnCutting | None = None,
    controller: OwnController | None = None,
) -> SimulatedStation: ...


@overload
def MakeStation(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    *,
    hardware: RobotConnection,
    controller: OwnController | None = None,
) -> HardwareStation: ...


def MakeStation(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    hardware: RobotConnection | None = None,
    *,
    cutting: OwnCutting | None = None,
    controller: OwnController | None = None,
) -> SimulatedStation | HardwareStation:
    """The station of a scenario; connect a source of targets to its input ports.

    Both stations export `ports.STATION_PORTS`, so nothing around a station need know which it is.

    Args:
        scenario: What to simulate, or to run on a robot.
        meshcat: Viewer to draw in, or None. Of a hardware station, its twin draws.
        hardware: The robot; None for the simulated station.
        cutting: A cutting system of your own in place of that of the scenario's food, or a function
            that makes one of the scenario; the scenario's food still says where the knife starts.
            Or a food of your own, see `CuttableFood`.
        controller: What commands the joints in place of the compliance controller, with the same
            ports, or a function that makes it of the scenario.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built, or does not fit
            the robot.
    """
    if hardware is None:
        return SimulatedStation(scenario, meshcat, cutting, controller)
    if cutting is not None:
        raise ConfigurationError(
            "cannot stand beside hardware: a robot cuts what lies on its board",
            field="cutting",
            fix="Leave out one of cutting and hardware.",
        )
    return HardwareStation(scenario, hardware, meshcat, controller)
