"""A whole scenario as a diagram: station, motion or policy, and record."""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, OutputPort

from sliceit_drake.cutting.motion import Motion
from sliceit_drake.diagrams.agent_station import add_agent
from sliceit_drake.diagrams.outputs.run_log import Record, Recorder, add_recorder
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.diagrams.station_interface import Station
from sliceit_drake.systems.agent import AgentConfig, AgentSystem
from sliceit_drake.systems.exported_network import load_network
from sliceit_drake.systems.motion_sources import MotionSource, placed_motion
from sliceit_drake.systems.policy import PolicySystem

__all__ = ["MakeScenarioDiagram", "ScenarioDiagram"]


class ScenarioDiagram(Diagram):
    """A station driven by its scenario's motion or policy, with a log of all ports.

    Attributes:
        station: The slicing station, simulated or hardware.
        motion: The prescribed targets of the knife; of a policy, its bounds (`PolicyConfig`).
        policy: The policy's system, or None.
    """

    def __init__(
        self, scenario: Scenario, meshcat: Meshcat | None = None, station: Station | None = None
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self.station: Station = builder.AddNamedSystem(
            "station", station or MakeStation(scenario, meshcat)
        )
        plan, start = self.station.motion_plan, self.station.start_pose
        self.motion: Motion = placed_motion(plan, start)
        self.policy: PolicySystem | AgentSystem | None = None
        sources: dict[str, OutputPort] = {}
        if scenario.policy is None:
            driver: LeafSystem = builder.AddNamedSystem("motion", MotionSource(plan, start))
        elif isinstance(scenario.policy, AgentConfig):
            network = load_network(scenario.policy)
            driver = self.policy = add_agent(builder, self.station, scenario.policy, network)
            for name in ("stiffness", "p_gains", "error_scale", "target_offset"):
                sources[name] = driver.GetOutputPort(name)
        else:
            gains = scenario.controller
            driver = self.policy = builder.AddNamedSystem(
                "policy", PolicySystem(scenario.policy, start, gains.stiffness, gains.p_gains)
            )
            wrench = self.station.GetOutputPort("sensor_wrench")
            builder.Connect(wrench, driver.GetInputPort("sensor_wrench"))
            for name in ("stiffness", "p_gains"):
                sources[name] = driver.GetOutputPort(name)
                builder.Connect(sources[name], self.station.GetInputPort(name))
            sources["target_offset"] = driver.GetOutputPort("target_offset")
        if not isinstance(driver, AgentSystem):
            target_pose = driver.GetOutputPort("target_pose")
            builder.Connect(target_pose, self.station.GetInputPort("target_pose"))
        self._recorder: Recorder = add_recorder(builder, self.station, self.motion, sources)
        builder.BuildInto(self)
        self.set_name(scenario.name)

    def SetStart(self, context: Context) -> None:
        """Puts the robot at rest at the scenario's start."""
        self.station.SetStart(context)

    def record(self, context: Context) -> Record:
        """What has been logged so far in this diagram's context."""
        return self._recorder.record(context)


def MakeScenarioDiagram(
    scenario: Scenario, meshcat: Meshcat | None = None, station: Station | None = None
) -> ScenarioDiagram:
    """The diagram of a scenario, ready for a Simulator.

    Args:
        scenario: What to simulate.
        meshcat: Viewer to draw in, or None.
        station: What to drive; None for a simulated station of the scenario.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built.
    """
    return ScenarioDiagram(scenario, meshcat, station)
