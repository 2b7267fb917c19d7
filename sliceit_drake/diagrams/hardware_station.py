"""The hardware station: the ports of the simulated one, with a real robot behind them."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues
from pydrake.systems.primitives import ConstantVectorSource

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.clearance import Clearance
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.station_interface import (
    OwnController,
    Station,
    connect,
    export_ports,
    make_controller,
)
from sliceit_drake.hardware.client import RobotClient
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import HardwareConfig, SafetyLimits
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.hardware.rtde_system import RtdeSystem
from sliceit_drake.hardware.safety import SafetyLayer
from sliceit_drake.systems.analytic_cutter import is_no_food
from sliceit_drake.systems.contact_monitor import ContactMonitor
from sliceit_drake.systems.cut_report import ReportingSystem
from sliceit_drake.systems.declare import declare_cached, declare_output
from sliceit_drake.systems.servo import JOINTS

__all__ = [
    "PERIOD",
    "HardwareStation",
    "KnifeEstimate",
    "RobotConnection",
    "make_clearance",
    "make_edge_kinematics",
    "make_safety_layer",
]

PERIOD = 0.002
"""Cycle of an e-Series controller, s."""


class KnifeEstimate(ReportingSystem):
    """What a robot does not measure itself, from what it does.

    Inputs:
        joint_positions, joint_velocities: Measured [6].
        sensor_wrench: SpatialForce at So, in S.

    Outputs:
        knife_pose, knife_velocity: By forward kinematics.
        food_wrench: The sensor's wrench at Ko in W: food and board together, and what taring left
            of the tool's weight and inertia. No sensor of a wrist tells these apart.
        food_wrench_vector: The same as moment and force [6].
        board_wrench: Zero, for the same reason.
        cut_progress: Greatest depth of the edge's middle so far as a fraction of the food's height
            [1]; not the fraction of the section.

    Args:
        plant: Model of the arm alone.
        knife: Its body K.
        top: Height of the food's top in W, m.
        board: Height of the board, m.
    """

    def __init__(self, plant: MultibodyPlant, knife: RigidBody, top: float, board: float) -> None:
        super().__init__()
        self._plant, self._knife, self._top, self._board = plant, knife, top, board
        self._flange = plant.GetFrameByName("tool0")
        q = self._q = self.DeclareVectorInputPort("joint_positions", JOINTS)
        qd = self._qd = self.DeclareVectorInputPort("joint_velocities", JOINTS)
        wrench = self._wrench = self.DeclareAbstractInputPort(
            "sensor_wrench", Value(SpatialForce.Zero())
        )
        # Scratch paper, as in the compliance controller: every use overwrites it first.
        self._scratch = declare_cached(
            self, "model", lambda context: plant.CreateDefaultContext(), {self.nothing_ticket()}
        )
        moving, contact = {q.ticket(), qd.ticket()}, {q.ticket(), wrench.ticket()}
        self._deepest = self.DeclareDiscreteState(1)
        deepest = {q.ticket(), self.discrete_state_ticket(self._deepest)}
        nothing, no_force = {self.nothing_ticket()}, SpatialForce.Zero()
        for name, example, calc, prerequisites in (
            ("knife_pose", Value(RigidTransform()), self._pose, {q.ticket()}),
            ("knife_velocity", Value(SpatialVelocity.Zero()), self._velocity, moving),
            ("food_wrench", Value(no_force), self._contact, contact),
            ("board_wrench", Value(no_force), lambda context: no_force, nothing),
            ("food_wrench_vector", 6, lambda context: self._contact(context).get_coeffs(), contact),
            ("cut_progress", 1, lambda context: [self._progress(context)], deepest),
        ):
            declare_output(self, name, example, calc, prerequisites)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _model(self, context: Context) -> Context:
        scratch = self._scratch.Eval(context)
        self._plant.SetPositions(scratch, self._q.Eval(context))
        return scratch

    def _pose(self, context: Context) -> RigidTransform:
        return self._plant.EvalBodyPoseInWorld(self._model(context), self._knife)

    def _velocity(self, context: Context) -> SpatialVelocity:
        scratch = self._model(context)
        self._plant.SetVelocities(scratch, self._qd.Eval(context))
        return self._plant.EvalBodySpatialVelocityInWorld(scratch, self._knife)

    def _contact(self, context: Context) -> SpatialForce:
        scratch = self._model(context)
        X_WS = self._flange.CalcPoseInWorld(scratch)
        p_WK = self._plant.EvalBodyPoseInWorld(scratch, self._knife).translation()
        wrench, R = self._wrench.Eval(context), X_WS.rotation()
        force = R @ wrench.translational()
        moment = R @ wrench.rotational() + np.cross(X_WS.translation() - p_WK, force)
        return SpatialForce(moment, force)

    def _progress(self, context: Context) -> float:
        depth = self._top - self._pose(context).translation()[2]
        deepest = context.get_discrete_state(self._deepest).value()[0]
        return max(float(deepest), min(1.0, depth / (self._top - self._board)))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._deepest, [self._progress(context)])


@dc.dataclass
class RobotConnection:
    """The robot behind a hardware station.

    Attributes:
        client: Connected.
        config: The robot's file.
        pace: Controller seconds in a second; 1 for all robots.
        twin: The simulated station of the scenario, where there is one; None to make it.
    """

    client: RobotClient
    config: HardwareConfig
    pace: float = 1.0
    twin: SimulatedStation | None = None


class HardwareStation(Station):
    """A real robot behind `ports.STATION_PORTS`; `hardware_run` advances it.

    Its additional outputs are those of `RtdeSystem` about the link: period, lateness, age,
    missed_cycles, latched, stop_reason.

    Args:
        scenario: What to run; the height of its board is replaced by the one in the robot's file.
        robot: The robot.
        meshcat: Viewer for the twin to draw in, or None.
        controller: See `MakeStation`.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built, or does not fit
            a robot.

    Attributes:
        twin: The simulated station of the same scenario: its model, start and plan are used, its
            plant does not move.
        link: To the robot; `RobotLink.start` it before the diagram's start.
        rtde: The robot's system.
    """

    def __init__(
        self,
        scenario: Scenario,
        robot: RobotConnection,
        meshcat: Meshcat | None = None,
        controller: OwnController | None = None,
    ) -> None:
        super().__init__()
        config, twin = robot.config, robot.twin
        if twin is None:
            if config.board_height is not None:
                board = dc.replace(scenario.board, height=config.board_height)
                scenario = dc.replace(scenario, board=board)
            twin = SimulatedStation(scenario, meshcat)
        self.twin, scenario = twin, twin.scenario
        self.scenario = scenario
        if abs(scenario.exchange_period - PERIOD) > 1e-12:
            raise ConfigurationError(
                f"{scenario.exchange_period:.6g} s is not the cycle of the robot's controller",
                field="scenario.exchange_period",
                fix=f"Write {PERIOD:g}.",
            )
        self.plant, self.robot = twin.plant, twin.robot
        self.motion_plan, self.board_peak_loss = twin.motion_plan, twin.board_peak_loss
        self.start_pose, self.start_joints = twin.start_pose, twin.start_joints
        self.meshcat = self.visualizer = self.food_visualizer = self.estimate_error = None
        self.link = RobotLink(
            robot.client, make_safety_layer(twin, config.limits), config.watchdog, robot.pace
        )
        builder = DiagramBuilder()
        rtde = self.rtde = builder.AddNamedSystem("robot", RtdeSystem(self.link, robot.pace))
        commander = builder.AddNamedSystem("controller", make_controller(scenario, controller))
        estimate = self.cutting = builder.AddNamedSystem(
            "knife_estimate",
            KnifeEstimate(twin.plant, twin.robot.knife, twin.food_top(), scenario.board.height),
        )
        monitor = builder.AddNamedSystem(
            "contact_monitor", ContactMonitor(scenario.monitor, PERIOD, scenario.sensor)
        )
        for source, *systems in (
            (rtde.GetOutputPort("joint_positions"), commander, estimate),
            (rtde.GetOutputPort("joint_velocities"), estimate),
            (rtde.GetOutputPort("sensor_wrench"), commander, estimate),
            (rtde.GetOutputPort("sensor_wrench_vector"), monitor),
            (commander.GetOutputPort("joint_positions_command"), rtde),
        ):
            connect(builder, source, *systems)
        exported = {
            rtde: ("joint_positions", "joint_velocities", "sensor_wrench", "sensor_wrench_vector")
            + ("period", "lateness", "age", "missed_cycles", "latched", "stop_reason"),
            commander: ("joint_positions_command", "commanded_pose"),
            estimate: ("knife_pose", "knife_velocity", "food_wrench", "food_wrench_vector")
            + ("board_wrench", "cut_progress"),
            monitor: ("unstable_gains",),
        }
        export_ports(builder, commander, exported)
        # For records: what the contract gives as typed values, as vectors.
        no_board = builder.AddNamedSystem("no_board", ConstantVectorSource(np.zeros(6)))
        builder.ExportOutput(no_board.get_output_port(), "board_wrench_vector")
        builder.BuildInto(self)
        self.set_name("station")

    def SetStart(self, root_context: Context) -> None:
        """Takes in where the robot is; it is moved to the start before."""
        self.rtde.receive(self.rtde.GetMyMutableContextFromRoot(root_context))


def make_edge_kinematics(twin: Station) -> EdgeKinematics:
    """Where the edge of a scenario's knife is."""
    robot = twin.scenario.robot
    return EdgeKinematics(
        robot.X_WB().GetAsMatrix34(), robot.X_TK().GetAsMatrix34(), twin.scenario.knife.length
    )


def make_clearance(twin: SimulatedStation) -> Clearance:
    """Distances of the bodies of a scenario's robot."""
    return Clearance(twin.scenario, twin.plant, twin.scene_graph)


def make_safety_layer(
    twin: SimulatedStation, limits: SafetyLimits, board_height: float | None = None
) -> SafetyLayer:
    """The safety layer for a scenario's knife, board and start.

    Args:
        twin: The simulated station of the scenario.
        limits: What is allowed.
        board_height: That counts for the depth, m; None for the scenario's.
    """
    height = twin.scenario.board.height if board_height is None else board_height
    start = twin.start_joints.tolist()
    # A touch, whose board may be lower, is made without food.
    has_food = board_height is None and not is_no_food(twin.scenario.food)
    top = twin.food_top() if has_food else None
    nearest = make_clearance(twin).nearest
    return SafetyLayer(limits, make_edge_kinematics(twin), height, start, PERIOD, top, nearest)
