"""What all that surrounds a station may ask of it besides its ports, simulated or hardware."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
    System,
)

from sliceit_drake.cutting.discretization import DiscretizationError
from sliceit_drake.cutting.motion import MotionPlan
from sliceit_drake.diagrams.plant.robot_plant import Robot
from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.systems.compliance_controller import ComplianceController
from sliceit_drake.systems.cut_report import FrameRecorder, ReportingSystem
from sliceit_drake.systems.ur5e_kinematics import ur5e_chain

__all__ = ["OwnController", "Station", "connect", "export_ports", "make_controller"]

OwnController: TypeAlias = LeafSystem | Callable[[Scenario], LeafSystem]
"""What commands the joints in place of the compliance controller, or what makes it."""


class Station(Diagram):
    """A slicing station: a diagram with `ports.STATION_PORTS`.

    Attributes:
        scenario: What it was made from.
        plant: Model of arm, gripper and knife; what moves in a simulated station alone.
        robot: Handles of the robot in it.
        cutting: What says how far the cut is, and more for the outputs of a run.
        motion_plan: The scenario's segments, those of its sequence, or the bounds of its policy.
        start_pose: X_WK at the start.
        start_joints: Joint positions there [6], rad.
        board_peak_loss: Estimated fraction of an impact's peak force on a simulated board that the
            plant's steps take.
        meshcat, visualizer, food_visualizer: The viewer, or None.
        estimate_error: Estimates the error of the food's discretisation, see `PreparedFood`.
    """

    scenario: Scenario
    plant: MultibodyPlant
    robot: Robot
    cutting: ReportingSystem
    motion_plan: MotionPlan
    start_pose: RigidTransform
    start_joints: np.ndarray
    board_peak_loss: float
    meshcat: Meshcat | None
    visualizer: MeshcatVisualizer | None
    food_visualizer: FrameRecorder | None
    estimate_error: Callable[[], DiscretizationError] | None

    def SetStart(self, root_context: Context) -> None:
        """Puts the station at its start, in the context of the whole diagram."""
        raise NotImplementedError

    def cutting_columns(self) -> list[str]:
        """Names for the port `cutting_state`; empty in a station without it."""
        return []

    def descent(self) -> float:
        """Height of the edge over the board at the start, metres."""
        return float(self.start_pose.translation()[2]) - self.scenario.board.height

    def food_top(self) -> float:
        """Height of the food's top at the cut in the world, metres."""
        return float(self.start_pose.translation()[2]) - self.scenario.start.clearance

    def X_KS(self) -> RigidTransform:
        """Pose of the wrench sensor's frame in the knife's; rigid, so the same in any context."""
        context = self.plant.CreateDefaultContext()
        frame_S = self.robot.sensor_weld.frame_on_parent()
        return frame_S.CalcPose(context, self.robot.knife.body_frame())


def connect(builder: DiagramBuilder, output: OutputPort, *systems: System) -> None:
    """Connects an output to the inputs of its name."""
    for system in systems:
        builder.Connect(output, system.GetInputPort(output.get_name()))


def export_ports(
    builder: DiagramBuilder, controller: LeafSystem, outputs: Mapping[System, Sequence[str]]
) -> None:
    """Exports the inputs of the port contract, which the controller has, and outputs by name.

    Args:
        builder: Of the station.
        controller: What commands the joints.
        outputs: Names of each system's outputs.
    """
    for port in STATION_PORTS:
        if port.direction == "input":
            builder.ExportInput(controller.GetInputPort(port.name), port.name)
    for system, names in outputs.items():
        for name in names:
            builder.ExportOutput(system.GetOutputPort(name), name)


def make_controller(scenario: Scenario, own: OwnController | None) -> LeafSystem:
    """The system that commands the joints: a user's own, or the compliance controller."""
    if own is not None:
        return own(scenario) if callable(own) else own
    robot = scenario.robot
    return ComplianceController(scenario.controller, ur5e_chain(robot.X_TK()), X_WB=robot.X_WB())
