"""The simulated station: a Scenario becomes a Diagram."""

import math

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.bench_errors import ArmErrors, BenchErrors, MountingErrors
from sliceit_drake.diagrams.plant.knife_body import check_plant_step, effective_mass
from sliceit_drake.diagrams.plant.robot_plant import (
    ArmController,
    Robot,
    add_plant,
    add_robot,
    connect_arm_controller,
)
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints
from sliceit_drake.diagrams.plant.surroundings import HoldingArm, add_board, add_holder, add_table
from sliceit_drake.diagrams.prepared_food import HeldFood, OwnCutting, food_to_cut
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station_interface import (
    OwnController,
    Station,
    connect,
    export_ports,
    make_controller,
)
from sliceit_drake.systems.contact_monitor import ContactMonitor
from sliceit_drake.systems.cut_report import FrameRecorder
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.food_visualizer import FoodVisualizer
from sliceit_drake.systems.frame_visualizer import FrameVisualizer
from sliceit_drake.systems.giving_mount import GivingMount
from sliceit_drake.systems.knife_force import AppliedForce, KnifeForceSystem
from sliceit_drake.systems.knife_kinematics import BoardContact, KnifeKinematics
from sliceit_drake.systems.loose_slices import LooseSlices
from sliceit_drake.systems.motion_sources import placed_motion
from sliceit_drake.systems.servo import JOINTS
from sliceit_drake.systems.wrench_sensor import WrenchSensor
from sliceit_drake.systems.wrench_visualizer import WrenchVisualizer

__all__ = ["FRAMES_PER_SECOND", "SimulatedStation"]

FRAMES_PER_SECOND = 32
"""Frame rate of the live view and of replays; lower where a replay would be too large."""
# A browser opens no more than 20 MB with ease: 3 MB are the arm, the rest is for frames. What is
# drawn beside the food takes this much a frame.
REPLAY_SIZE = 16e6
SCENE_FRAME_SIZE = 4e3
FINGER = 0.015
"""Half the breadth of the holding arm's fingers along the food, metres."""
LEANS = 3.0
"""Angle of a cut from the vertical from which it counts as leaning, degrees."""
CAMERA_OFFSET = np.array([0.24, -0.14, 0.13])


def _board_peak_loss(scenario: Scenario, start_pose: RigidTransform, mass: float) -> float:
    """As `check_plant_step`; names a cut that leans, where the arm is heavier against the board."""
    board, robot = scenario.board, scenario.robot
    try:
        return check_plant_step(board, mass, robot.plant_time_step, scenario.exchange_period)
    except ConfigurationError as error:
        leaning = math.degrees(math.asin(min(1.0, abs(start_pose.rotation().matrix()[2, 1]))))
        if leaning < LEANS:
            raise
        raise ConfigurationError(
            f"the cut leans by {leaning:.0f} degrees, and pressed so the arm meets the board with "
            f"{mass:.2g} kg: {error.problem}",
            field="scenario.food.cut_normal and scenario.robot.plant_time_step",
            fix=f"{error.fix} Or lean the cut less.",
        ) from None


class SimulatedStation(Station):
    """Arm, knife, controller, sensor, board and food behind the ports of `ports.STATION_PORTS`.

    Args:
        scenario: What to simulate.
        meshcat: Viewer to draw in, or None.
        cutting: See `MakeStation`.
        controller: See `MakeStation`.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built.

    Attributes:
        cutting: The food, or what was put in its place.
        controller: The compliance controller, or what was given in its place.
        sensor: The wrench sensor.
        frame_period: Time between the frames that are drawn, s: longer where the run's replay
            would be too large.
    """

    def __init__(
        self,
        scenario: Scenario,
        meshcat: Meshcat | None = None,
        cutting: OwnCutting | None = None,
        controller: OwnController | None = None,
    ) -> None:
        super().__init__()
        self.scenario = scenario
        self.meshcat = meshcat
        food = food_to_cut(scenario, cutting)
        self.motion_plan, self.start_pose = food.motion_plan, food.start_pose
        bench = scenario.bench
        if bench != BenchErrors():
            # The motion is meant for the bench as it was assumed.
            scenario = scenario.as_it_is()
            food = food_to_cut(scenario, cutting)
        self.estimate_error = food.estimate_error
        builder = DiagramBuilder()
        self.plant, self.scene_graph = add_plant(builder, scenario.robot)
        self.robot: Robot = add_robot(
            self.plant, scenario.robot, scenario.knife, scenario.board, bench.tool
        )
        add_table(self.plant, (0.1 if scenario.holder == "clamp" else -0.15, -0.3))
        add_board(self.plant, scenario.board, scenario.X_WF())
        if food.held is not None:
            _add_holder(self.plant, scenario, food.held)
        self.plant.Finalize()

        self.cutting: KnifeForceSystem = food.make_cutting()
        self.start_joints = solve_start_joints(
            self.plant,
            self.robot.knife,
            self.start_pose,
            np.array(scenario.robot.joint_positions),
        )
        mass = effective_mass(self.plant, self.robot.knife, self.start_joints)
        self.board_peak_loss = _board_peak_loss(scenario, self.start_pose, mass)
        self._arm: ArmController = connect_arm_controller(
            builder, self.plant, self.robot, scenario.robot
        )
        self.controller = make_controller(scenario, controller)
        self.sensor = sensor = WrenchSensor(
            self.plant,
            self.robot.sensor_weld,
            scenario.exchange_period,
            scenario.sensor,
            bench.sensor,
            scenario.robot.X_TK(),
        )
        kinematics = KnifeKinematics(self.plant, self.robot.knife)
        board_contact = BoardContact(
            self.robot.knife.index(), scenario.knife.length, scenario.board.height
        )
        monitor = ContactMonitor(scenario.monitor, scenario.exchange_period, scenario.sensor)
        applied_force = AppliedForce(self.robot.knife.index())
        named = {
            "cutting": self.cutting,
            "applied_force": applied_force,
            "controller": self.controller,
            "sensor": sensor,
            "kinematics": kinematics,
            "board_contact": board_contact,
            "contact_monitor": monitor,
        }
        for name, system in named.items():
            builder.AddNamedSystem(name, system)
        met_pose = kinematics.GetOutputPort("knife_pose")
        if (bench.arm, bench.mounting) != (ArmErrors(), MountingErrors()):
            mount = builder.AddNamedSystem(
                "giving_mount", GivingMount(bench, scenario.exchange_period)
            )
            connect(builder, met_pose, mount)
            connect(builder, self.cutting.GetOutputPort("food_wrench_vector"), mount)
            met_pose = mount.GetOutputPort("met_pose")
        self.slices: LooseSlices | None = None
        if food.make_slices is not None and isinstance(self.cutting, CuttingSystem):
            self.slices = builder.AddNamedSystem("slices", food.make_slices(self.cutting))
            for name in ("cut_progress", "food_index", "slice_pose", "slice_velocity"):
                connect(builder, self.cutting.GetOutputPort(name), self.slices)
            for name in ("knife_pose", "knife_velocity"):
                connect(builder, kinematics.GetOutputPort(name), self.slices)

        plant = self.plant
        for source, target in (
            (
                plant.get_body_spatial_velocities_output_port(),
                kinematics.GetInputPort("body_velocities"),
            ),
            (self.cutting.GetOutputPort("food_wrench_vector"), applied_force.get_input_port()),
            (applied_force.get_output_port(), plant.get_applied_spatial_force_input_port()),
        ):
            builder.Connect(source, target)
        for source, *systems in (
            (plant.get_geometry_pose_output_port(), kinematics),
            (plant.get_contact_results_output_port(), board_contact),
            (plant.get_reaction_forces_output_port(), sensor),
            (kinematics.GetOutputPort("knife_pose"), board_contact),
            (kinematics.GetOutputPort("knife_velocity"), self.cutting),
            (sensor.GetOutputPort("sensor_wrench"), self.controller),
            (sensor.GetOutputPort("sensor_wrench_vector"), monitor),
            (self.controller.GetOutputPort("joint_positions_command"), self._arm),
        ):
            connect(builder, source, *systems)
        builder.Connect(met_pose, self.cutting.GetInputPort("knife_pose"))
        joints = builder.AddNamedSystem("joints", Demultiplexer([JOINTS, JOINTS]))
        builder.Connect(plant.get_state_output_port(self.robot.arm), joints.get_input_port())
        builder.Connect(joints.get_output_port(0), self.controller.GetInputPort("joint_positions"))

        builder.ExportOutput(joints.get_output_port(0), "joint_positions")
        builder.ExportOutput(joints.get_output_port(1), "joint_velocities")
        builder.ExportOutput(self.cutting.GetOutputPort("state"), "cutting_state")
        # A name that ends in "vector" is for records: what the contract gives as a typed value.
        exported = {
            self.controller: ("joint_positions_command", "commanded_pose"),
            kinematics: ("knife_pose", "knife_velocity"),
            sensor: ("sensor_wrench", "sensor_wrench_vector"),
            self.cutting: ("food_wrench", "food_wrench_vector", "cut_progress")
            + tuple(self.cutting.recorded()),
            board_contact: ("board_wrench", "board_wrench_vector"),
            monitor: ("unstable_gains",),
        }
        export_ports(builder, self.controller, exported)

        self.frame_period = self._frame_period()
        self.visualizer: MeshcatVisualizer | None = None
        self.food_visualizer: FrameRecorder | None = None
        if meshcat is not None:
            self._add_visualization(builder, meshcat)
        builder.BuildInto(self)
        self.set_name("station")

    def camera_pose(self) -> RigidTransform:
        """Pose of a camera that looks at knife and food, Cz forward and Cy down."""
        target = self.start_pose.translation() + [0.01, 0.0, 0.0]
        height = target[2] - self.scenario.board.height
        target[2] -= max(0.4 * (height - 0.05), 0.0)
        offset = max(1.0, height / 0.05) * CAMERA_OFFSET
        forward = -CAMERA_OFFSET / np.linalg.norm(CAMERA_OFFSET)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R_WC = RotationMatrix(np.column_stack([right, np.cross(forward, right), forward]))
        return RigidTransform(R_WC, target + offset)

    def _frame_period(self) -> float:
        size = SCENE_FRAME_SIZE + self.cutting.frame_size()
        frames = FRAMES_PER_SECOND * placed_motion(self.motion_plan, self.start_pose).duration
        return math.ceil(frames * size / REPLAY_SIZE) / FRAMES_PER_SECOND

    def _add_visualization(self, builder: DiagramBuilder, meshcat: Meshcat) -> None:
        """Bodies and food; wrenches on knife and sensor as arrows; triads of W, B, F, S, K."""
        period = self.frame_period
        self.visualizer = MeshcatVisualizer.AddToBuilder(
            builder, self.scene_graph, meshcat, MeshcatVisualizerParams(publish_period=period)
        )
        self.food_visualizer = self.cutting.add_visualizer(builder, meshcat, period)
        if self.slices is not None and isinstance(self.food_visualizer, FoodVisualizer):
            connect(builder, self.slices.GetOutputPort("slices"), self.food_visualizer)
        X_KS = self.X_KS()
        knife_pose = builder.GetSubsystemByName("kinematics").GetOutputPort("knife_pose")
        arrows = builder.AddNamedSystem(
            "wrench_visualizer", WrenchVisualizer(meshcat, X_KS, period)
        )
        for output in (
            knife_pose,
            self.cutting.GetOutputPort("food_wrench"),
            builder.GetSubsystemByName("board_contact").GetOutputPort("board_wrench"),
            self.sensor.GetOutputPort("sensor_wrench"),
        ):
            connect(builder, output, arrows)
        fixed = {
            "W": (RigidTransform(), 0.15),
            "B": (self.scenario.robot.X_WB(), 0.15),
            "F": (self.scenario.X_WF(), 0.035),
        }
        carried = {"K": (RigidTransform(), 0.035), "S": (X_KS, 0.06)}
        frames = FrameVisualizer(meshcat, fixed, carried, self.start_pose, CAMERA_OFFSET, period)
        builder.AddNamedSystem("frame_visualizer", frames)
        connect(builder, knife_pose, frames)
        _set_scene(meshcat, self.start_pose)

    def cutting_columns(self) -> list[str]:
        """Names for the port `cutting_state`."""
        return self.cutting.state_columns()

    def SetStart(self, root_context: Context, joints: np.ndarray | None = None) -> None:
        """Puts arm and controller at rest at the start, in the context of the whole diagram.

        Args:
            root_context: Of the whole diagram.
            joints: Joint positions [6], rad; None for `start_joints`.
        """
        start = self.start_joints if joints is None else joints
        self._arm.set_positions(root_context, start)


def _set_scene(meshcat: Meshcat, X_WK: RigidTransform) -> None:
    """Looks at the knife, before a plain background."""
    target = X_WK.translation() + [0.0, 0.0, 0.05]
    meshcat.SetCameraPose(target + CAMERA_OFFSET, target)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", [0.92, 0.94, 0.96])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.80, 0.83, 0.86])


def _add_holder(plant: MultibodyPlant, scenario: Scenario, held: HeldFood) -> None:
    """Draws the scenario's holder."""
    if scenario.holder == "arm":
        grip = np.array([0.0, held.distance + FINGER, 0.5 * held.height])
        HoldingArm(scenario.X_WF(), grip).draw(plant)
    else:
        add_holder(plant, scenario.X_WF(), held.width, held.height, held.distance)
