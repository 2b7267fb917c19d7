"""A whole scenario as a diagram: station, motion or policy, and record."""

import dataclasses as dc
from collections.abc import Callable
from typing import TypeAlias

from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPortIndex,
    LeafSystem,
    OutputPort,
    OutputPortIndex,
)

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import Hold, Motion, MotionPlan
from sliceit_drake.diagrams.agent_station import add_agent
from sliceit_drake.diagrams.outputs.run_log import Record, Recorder, add_recorder
from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.diagrams.station_interface import Station
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.exported_network import load_network
from sliceit_drake.systems.motion_sources import MotionSource, placed_motion
from sliceit_drake.systems.policy import Policy, PolicyConfig, PolicySystem

__all__ = ["OwnPolicy", "ScenarioDiagram"]

OwnPolicy: TypeAlias = LeafSystem | Callable[[Station], LeafSystem] | Policy
"""A user's own source of targets: a system, what makes one for a station, or what decides."""

CLEAR_OF_BOARD = 2e-4
"""How far below the board's top a policy's target may go, metres."""


class ScenarioDiagram(Diagram):
    """A station driven by its scenario's motion or policy, with a log of all ports.

    Args:
        scenario: What to simulate.
        station: What to drive; None for a simulated station of the scenario.
        policy: Drives the station in place of the scenario's motion or policy: a system with an
            output port `target_pose`, what makes such a system for a station, or an object that
            decides (`Policy`). Its ports are connected with those of the station by their names.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built.

    Attributes:
        station: The slicing station, simulated or hardware.
        motion: The prescribed targets of the knife; of a policy, its bounds (`PolicyConfig`).
        policy: The policy's system, or None.
    """

    def __init__(
        self,
        scenario: Scenario,
        station: Station | None = None,
        policy: OwnPolicy | None = None,
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self.station: Station = builder.AddNamedSystem("station", station or MakeStation(scenario))
        plan, start = self.station.motion_plan, self.station.start_pose
        self.motion: Motion = placed_motion(plan, start)
        self.policy: LeafSystem | None = None
        sources: dict[str, OutputPort] = {}
        if policy is not None:
            own = _policy_system(policy, self.station, self.motion.duration)
            self.policy = builder.AddNamedSystem("policy", own)
            # Nothing is known of its motion but how long it may last.
            plan = MotionPlan([Hold(self.motion.duration, label="policy")])
            self.station.motion_plan, self.motion = plan, placed_motion(plan, start)
            sources = _connect_by_name(builder, self.policy, self.station)
        elif scenario.policy is None:
            driver = builder.AddNamedSystem("motion", MotionSource(plan, start))
            _connect_by_name(builder, driver, self.station)
        elif isinstance(scenario.policy, AgentConfig):
            network = load_network(scenario.policy)
            agent = self.policy = add_agent(builder, self.station, scenario.policy, network)
            for name in ("stiffness", "p_gains", "error_scale", "target_offset"):
                sources[name] = agent.GetOutputPort(name)
        else:
            gains = scenario.controller
            self.policy = builder.AddNamedSystem(
                "policy", PolicySystem(scenario.policy, start, gains.stiffness, gains.p_gains)
            )
            sources = _connect_by_name(builder, self.policy, self.station)
            sources["target_offset"] = self.policy.GetOutputPort("target_offset")
        self._recorder: Recorder = add_recorder(builder, self.station, self.motion, sources)
        builder.BuildInto(self)
        self.set_name(scenario.name)

    def SetStart(self, context: Context) -> None:
        """Puts the robot at rest at the scenario's start."""
        self.station.SetStart(context)

    def record(self, context: Context) -> Record:
        """What has been logged so far in this diagram's context."""
        return self._recorder.record(context)


def _policy_system(own: OwnPolicy, station: Station, duration: float) -> LeafSystem:
    """The system of a user's own policy, for a run of a duration in seconds."""
    if isinstance(own, LeafSystem):
        return own
    if callable(own):
        return own(station)
    if not hasattr(own, "decide"):
        raise ConfigurationError(
            f"{type(own).__name__} has no method decide",
            field="policy",
            fix="Give an object that has one, a system, or what makes a system for a station.",
        )
    scenario = station.scenario
    config = scenario.policy
    if not isinstance(config, PolicyConfig):
        config = PolicyConfig(duration=duration, press=station.descent() + CLEAR_OF_BOARD)
    gains = scenario.controller
    # The scenario's file cannot hold the user's object; it stands in the summary by its name.
    config = dc.replace(config, decide=own)  # type: ignore[arg-type]
    return PolicySystem(config, station.start_pose, gains.stiffness, gains.p_gains)


def _connect_by_name(
    builder: DiagramBuilder, driver: LeafSystem, station: Station
) -> dict[str, OutputPort]:
    """Connects a system with the ports of a station that have the names of its own.

    Returns:
        Its output ports that drive the station, by name.

    Raises:
        ConfigurationError: It has no target pose, or an input that no station gives.
    """
    given = {port.name for port in STATION_PORTS if port.direction == "output"}
    taken = {port.name for port in STATION_PORTS if port.direction == "input"}
    for k in range(driver.num_input_ports()):
        port = driver.get_input_port(InputPortIndex(k))
        if port.get_name() not in given:
            raise ConfigurationError(
                f"{type(driver).__name__} has an input port {port.get_name()!r}, which a station "
                "does not give",
                field="policy",
                fix=f"Name the port as one of {', '.join(sorted(given))}.",
            )
        builder.Connect(station.GetOutputPort(port.get_name()), port)
    ports = (driver.get_output_port(OutputPortIndex(k)) for k in range(driver.num_output_ports()))
    driving = {port.get_name(): port for port in ports if port.get_name() in taken}
    if "target_pose" not in driving:
        raise ConfigurationError(
            f"{type(driver).__name__} has no output port 'target_pose'",
            field="policy",
            fix="Declare an abstract output port of that name, of type RigidTransform (X_WK).",
        )
    for name, port in driving.items():
        builder.Connect(port, station.GetInputPort(name))
    return driving
