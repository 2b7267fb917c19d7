"""A station with the SliceIt! agent on it."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints
from sliceit_drake.diagrams.randomize import randomize
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.station_interface import Station, connect
from sliceit_drake.systems.agent import AgentConfig, AgentSystem, Decide

__all__ = ["AgentStation", "add_agent"]

DESCENT_TOLERANCE = 5e-4


def add_agent(
    builder: DiagramBuilder, station: Station, config: AgentConfig, decide: Decide | None
) -> AgentSystem:
    """Adds the agent to a diagram and connects it with the station in it.

    Args:
        builder: Of the diagram that holds the station.
        station: With the controller in parallel mode.
        config: What the agent may do.
        decide: From observation to action; None leaves the agent's port `action` open.

    Raises:
        ConfigurationError: The controller does not fit the agent, or the start is not at `descent`.
    """
    controller = station.scenario.controller
    if controller.mode != "parallel":
        raise ConfigurationError(
            f"is {controller.mode!r}; the agent decides stiffness and gains of parallel control",
            field="scenario.controller.mode",
            fix="Write parallel, with the gains of docs/explanation/control.md.",
        )
    descent = station.descent()
    if abs(descent - config.descent) > DESCENT_TOLERANCE:
        raise ConfigurationError(
            f"is {config.descent:.4f} m; the start is {descent:.4f} m over the board",
            field="scenario.policy.descent",
            fix=f"Write {descent:.4f}.",
        )
    agent = builder.AddNamedSystem(
        "agent",
        AgentSystem(
            config,
            station.start_pose,
            station.X_KS(),
            controller.stiffness,
            controller.p_gains,
            decide,
        ),
    )
    for name in ("sensor_wrench", "knife_pose"):
        connect(builder, station.GetOutputPort(name), agent)
    for name in ("target_pose", "stiffness", "p_gains", "error_scale"):
        connect(builder, agent.GetOutputPort(name), station)
    return agent


class AgentStation(Diagram):
    """A simulated station and an agent whose actions come through the port `action`.

    Attributes:
        station: The station.
        agent: The agent's system.
    """

    def __init__(self, station: SimulatedStation, config: AgentConfig) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self.station: SimulatedStation = builder.AddNamedSystem("station", station)
        self.agent = add_agent(builder, station, config, None)
        builder.ExportInput(self.agent.GetInputPort("action"), "action")
        for name in ("observation", "error", "wrench", "at_goal"):
            builder.ExportOutput(self.agent.GetOutputPort(name), name)
        for name in ("food_wrench_vector", "board_wrench_vector", "cut_progress"):
            builder.ExportOutput(station.GetOutputPort(name), name)
        builder.ExportOutput(station.GetOutputPort("sensor_wrench"), "sensor_wrench")
        builder.BuildInto(self)
        self.set_name("agent_station")

    def begin(
        self, simulator: Simulator, rng: np.random.Generator, shift: RigidTransform | None = None
    ) -> None:
        """Starts a slice anew: everything random is drawn, the knife at rest at its start.

        Args:
            simulator: A simulator of this diagram.
            rng: Where all numbers come from.
            shift: Of the knife from the start, in its frame; None for none.

        Raises:
            ConfigurationError: The arm cannot reach the shifted start.
        """
        context = simulator.get_mutable_context()
        randomize(self, context, rng)
        context.SetTime(0.0)
        station, joints = self.station, None
        if shift is not None:
            joints = solve_start_joints(
                station.plant,
                station.robot.knife,
                station.start_pose @ shift,
                station.start_joints,
            )
        station.SetStart(context, joints)
        self.GetInputPort("action").FixValue(context, np.zeros(6))
        simulator.Initialize()
