"""The simulated station: a Scenario becomes a Diagram."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.spring_food import SpringFood
from sliceit_drake.cutting.motion import MotionPlan
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.holder_arm import add_holding_arm
from sliceit_drake.diagrams.knife_body import check_plant_step, effective_mass
from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.diagrams.robot import (
    ArmController,
    Robot,
    add_plant,
    add_robot,
    connect_arm_controller,
    set_joint_positions,
)
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.start import solve_start_joints
from sliceit_drake.diagrams.station_interface import OwnController, Station, make_controller
from sliceit_drake.diagrams.workspace import add_board, add_holder, add_table
from sliceit_drake.systems.analytic_cutter import AnalyticCutter, AnalyticFood
from sliceit_drake.systems.contact_monitor import ContactMonitor
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.food_visualizer import FoodVisualizer, frame_size
from sliceit_drake.systems.frame_visualizer import FrameVisualizer
from sliceit_drake.systems.knife_force import AppliedForce, KnifeForceSystem
from sliceit_drake.systems.knife_kinematics import BoardContact, KnifeKinematics
from sliceit_drake.systems.motion_sources import placed_motion
from sliceit_drake.systems.servo import JOINTS
from sliceit_drake.systems.spring_cutter import SpringCutter
from sliceit_drake.systems.spring_visualizer import SpringVisualizer
from sliceit_drake.systems.wrench_sensor import WrenchSensor
from sliceit_drake.systems.wrench_visualizer import WrenchVisualizer

__all__ = ["FRAMES_PER_SECOND", "OwnCutting", "SimulatedStation"]

OwnCutting = KnifeForceSystem | Callable[[Scenario], KnifeForceSystem]
"""A cutting system of a user's own, or what makes it."""

FRAMES_PER_SECOND = 32
"""Of what is drawn and of replays; fewer where a replay would be too large."""
# A browser opens no more than 20 MB with ease: 3 MB are the arm, the rest is for frames. What is
# drawn beside the food takes this much a frame.
REPLAY_SIZE = 16e6
SCENE_FRAME_SIZE = 4e3
FINGER = 0.015
"""Half the breadth of the holding arm's fingers along the food, metres."""
CAMERA_OFFSET = np.array([0.17, 0.23, 0.17])


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
        scenario: What it was made from.
        plant: The arm with gripper and knife, and the board.
        cutting: The food: finite elements, analytic, or the spring of the baseline.
        controller: The compliance controller, or what was given in its place.
        sensor: The wrench sensor.
        motion_plan: The scenario's segments, those of its sequence, or the bounds of its policy.
        start_pose: X_WK at the start.
        start_joints: Joint positions there [6], rad.
        board_peak_loss: Estimated share of an impact's peak force on the board that the plant's
            steps take, see `check_plant_step`.
        meshcat: The viewer, or None.
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
        solvers = _food_solvers(scenario)
        self.motion_plan: MotionPlan = _motion_plan(scenario, solvers)
        builder = DiagramBuilder()
        self.plant, scene_graph = add_plant(builder, scenario.robot)
        self.robot: Robot = add_robot(self.plant, scenario.robot, scenario.knife, scenario.board)
        add_table(self.plant, (0.1 if scenario.holder == "clamp" else -0.15, -0.3))
        add_board(self.plant, scenario.board, scenario.X_WF())
        _add_holder(self.plant, scenario, solvers)
        self.plant.Finalize()

        self.cutting: KnifeForceSystem
        self.cutting, self.start_pose = _make_cutting(scenario, solvers)
        if cutting is not None:
            self.cutting = cutting(scenario) if callable(cutting) else cutting
            _check_period(self.cutting, scenario)
        self.start_joints = solve_start_joints(
            self.plant,
            self.robot.knife,
            self.start_pose,
            np.array(scenario.robot.joint_positions),
        )
        mass = effective_mass(self.plant, self.robot.knife, self.start_joints)
        self.board_peak_loss = check_plant_step(
            scenario.board, mass, scenario.robot.plant_time_step, scenario.exchange_period
        )
        self._arm: ArmController = connect_arm_controller(
            builder, self.plant, self.robot, scenario.robot
        )
        self.controller = make_controller(scenario, controller)
        self.sensor = sensor = WrenchSensor(
            self.plant, self.robot.sensor_weld, scenario.exchange_period, scenario.sensor
        )
        kinematics = KnifeKinematics(self.robot.knife.index())
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

        plant = self.plant
        for source, target in (
            (plant.get_body_poses_output_port(), kinematics.GetInputPort("body_poses")),
            (
                plant.get_body_spatial_velocities_output_port(),
                kinematics.GetInputPort("body_velocities"),
            ),
            (kinematics.GetOutputPort("knife_pose"), self.cutting.GetInputPort("knife_pose")),
            (
                kinematics.GetOutputPort("knife_velocity"),
                self.cutting.GetInputPort("knife_velocity"),
            ),
            (self.cutting.GetOutputPort("food_wrench"), applied_force.get_input_port()),
            (applied_force.get_output_port(), plant.get_applied_spatial_force_input_port()),
            (
                plant.get_contact_results_output_port(),
                board_contact.GetInputPort("contact_results"),
            ),
            (kinematics.GetOutputPort("knife_pose"), board_contact.GetInputPort("knife_pose")),
            (plant.get_reaction_forces_output_port(), sensor.GetInputPort("reaction_forces")),
            (sensor.GetOutputPort("sensor_wrench"), self.controller.GetInputPort("sensor_wrench")),
            (sensor.GetOutputPort("sensor_wrench"), monitor.GetInputPort("sensor_wrench")),
            (
                self.controller.GetOutputPort("joint_positions_command"),
                self._arm.GetInputPort("joint_positions_command"),
            ),
        ):
            builder.Connect(source, target)
        joints = builder.AddNamedSystem("joints", Demultiplexer([JOINTS, JOINTS]))
        builder.Connect(plant.get_state_output_port(self.robot.arm), joints.get_input_port())
        builder.Connect(joints.get_output_port(0), self.controller.GetInputPort("joint_positions"))

        outputs = {
            "joint_positions": joints.get_output_port(0),
            "joint_velocities": joints.get_output_port(1),
            "joint_positions_command": self.controller.GetOutputPort("joint_positions_command"),
            "commanded_pose": self.controller.GetOutputPort("commanded_pose"),
            "knife_pose": kinematics.GetOutputPort("knife_pose"),
            "knife_velocity": kinematics.GetOutputPort("knife_velocity"),
            "sensor_wrench": sensor.GetOutputPort("sensor_wrench"),
            "food_wrench": self.cutting.GetOutputPort("food_wrench"),
            "board_wrench": board_contact.GetOutputPort("board_wrench"),
            "cut_progress": self.cutting.GetOutputPort("cut_progress"),
        }
        for port in STATION_PORTS:
            if port.direction == "input":
                builder.ExportInput(self.controller.GetInputPort(port.name), port.name)
            else:
                builder.ExportOutput(outputs[port.name], port.name)
        if isinstance(self.cutting, CuttingSystem):
            for name in (
                "force_components",
                "ledger",
                "energy",
                "coupling_work_error",
                "food_index",
            ):
                builder.ExportOutput(self.cutting.GetOutputPort(name), name)
        # For records: what the contract gives as typed values, as vectors.
        builder.ExportOutput(self.cutting.GetOutputPort("food_wrench_vector"), "food_wrench_vector")
        builder.ExportOutput(
            board_contact.GetOutputPort("board_wrench_vector"), "board_wrench_vector"
        )
        builder.ExportOutput(sensor.GetOutputPort("state"), "sensor_state")
        builder.ExportOutput(monitor.GetOutputPort("unstable_gains"), "unstable_gains")

        self.frame_period = self._frame_period()
        self.visualizer: MeshcatVisualizer | None = None
        self.food_visualizer: FoodVisualizer | None = None
        if meshcat is not None:
            self._add_visualization(builder, scene_graph, meshcat)
        builder.BuildInto(self)
        self.set_name("station")

    def _add_visualization(
        self, builder: DiagramBuilder, scene_graph: SceneGraph, meshcat: Meshcat
    ) -> None:
        period = self.frame_period
        self.visualizer = MeshcatVisualizer.AddToBuilder(
            builder, scene_graph, meshcat, MeshcatVisualizerParams(publish_period=period)
        )
        if isinstance(self.cutting, CuttingSystem):
            self.food_visualizer = builder.AddNamedSystem(
                "food_visualizer", FoodVisualizer(self.cutting, meshcat, period)
            )
            for name in ("surface_vertices", "surface_damage", "food_index"):
                builder.Connect(
                    self.cutting.GetOutputPort(name), self.food_visualizer.GetInputPort(name)
                )
        elif isinstance(self.cutting, SpringCutter):
            plates = builder.AddNamedSystem(
                "spring_visualizer",
                SpringVisualizer(self.cutting.food, self.scenario.X_WF(), meshcat, period),
            )
            builder.Connect(
                self.cutting.GetOutputPort("compression"), plates.GetInputPort("compression")
            )
        self._add_arrows_and_frames(builder, meshcat)
        _set_scene(meshcat, self.start_pose)

    def _frame_period(self) -> float:
        size = SCENE_FRAME_SIZE
        if isinstance(self.cutting, CuttingSystem):
            size += frame_size(self.cutting)
        frames = FRAMES_PER_SECOND * placed_motion(self.motion_plan, self.start_pose).duration
        return math.ceil(frames * size / REPLAY_SIZE) / FRAMES_PER_SECOND

    def _add_arrows_and_frames(self, builder: DiagramBuilder, meshcat: Meshcat) -> None:
        """Wrenches on knife and sensor as arrows; triads of W, B, F, S, K."""
        period = self.frame_period
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
            builder.Connect(output, arrows.GetInputPort(output.get_name()))
        fixed = {
            "W": (RigidTransform(), 0.15),
            "B": (self.scenario.robot.X_WB(), 0.15),
            "F": (self.scenario.X_WF(), 0.035),
        }
        carried = {"K": (RigidTransform(), 0.035), "S": (X_KS, 0.06)}
        frames = FrameVisualizer(meshcat, fixed, carried, self.start_pose, CAMERA_OFFSET, period)
        builder.AddNamedSystem("frame_visualizer", frames)
        builder.Connect(knife_pose, frames.GetInputPort("knife_pose"))

    def sensor_columns(self, reading: Sequence[str]) -> list[str]:
        """Names for the port `sensor_state`: `reading` [6] for the moment and force."""
        return self.sensor.state_columns(reading)

    def SetStart(self, root_context: Context, joints: np.ndarray | None = None) -> None:
        """Puts arm and controller at rest at the start, in the context of the whole diagram.

        Args:
            root_context: Of the whole diagram.
            joints: Joint positions [6], rad; None for `start_joints`.
        """
        start = self.start_joints if joints is None else joints
        set_joint_positions(root_context, self.plant, self.robot, self._arm, start)


def _check_period(cutting: KnifeForceSystem, scenario: Scenario) -> None:
    if abs(cutting.exchange_period - scenario.exchange_period) > 1e-12:
        raise ConfigurationError(
            f"is {scenario.exchange_period:g} s, and that of the cutting system that was put in "
            f"{cutting.exchange_period:g} s",
            field="scenario.exchange_period",
            fix="Make the cutting system with the period of the scenario.",
        )


def _set_scene(meshcat: Meshcat, X_WK: RigidTransform) -> None:
    """Looks at the knife, before a plain background."""
    target = X_WK.translation() + [0.0, 0.0, 0.05]
    meshcat.SetCameraPose(target + CAMERA_OFFSET, target)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", [0.92, 0.94, 0.96])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.80, 0.83, 0.86])


def _food_solvers(scenario: Scenario) -> list[CuttingSolver]:
    """The prepared cuts: one, or those of a sequence; none for a food without elements."""
    food, sequence = scenario.food, scenario.sequence
    if not isinstance(food, Food):
        return []
    foods = sequence.foods(food) if sequence else [food]
    models = [make_food_model(each, scenario.knife, scenario.numerics) for each in foods]
    blade = scenario.knife.tip_height + scenario.knife.height
    highest = max(model.top - model.bottom for model in models)
    if highest > blade:
        raise ConfigurationError(
            f"the blade is {1e3 * blade:.3g} mm high and the food {1e3 * highest:.3g} mm: spine "
            "and gripper would go into the food",
            field="scenario.knife.height",
            fix="Take a higher knife (those of calibration/knives by `knife_name`), or a smaller "
            "food.",
        )
    return [CuttingSolver(model, scenario.exchange_period) for model in models]


def _motion_plan(scenario: Scenario, solvers: list[CuttingSolver]) -> MotionPlan:
    if scenario.policy is not None:
        return scenario.policy.envelope()
    if scenario.sequence is None:
        return scenario.motion
    tops = [solver.model.top for solver in solvers]
    return scenario.sequence.motion(tops, scenario.start.clearance)


def _make_cutting(
    scenario: Scenario, solvers: list[CuttingSolver]
) -> tuple[KnifeForceSystem, RigidTransform]:
    """The cutting system of a scenario and X_WK at the start."""
    period, start, X_WF = scenario.exchange_period, scenario.start, scenario.X_WF()
    if solvers:
        assert isinstance(scenario.food, Food)
        poses = [X_WF]
        if scenario.sequence is not None:
            poses = scenario.sequence.poses(scenario.food, X_WF)
        in_sequence = scenario.sequence is not None
        pose = start_pose(solvers[0].model, start.clearance, start.offset)
        cutting = CuttingSystem(solvers, poses, in_sequence=in_sequence)
        return cutting, poses[0] @ RigidTransform(RotationMatrix(pose.R), pose.p)
    food = scenario.food
    assert isinstance(food, AnalyticFood | SpringFood)
    cutter: KnifeForceSystem
    if isinstance(food, SpringFood):
        height = food.height
        cutter = SpringCutter(food, scenario.knife, scenario.X_WF(), period)
    else:
        height = food.diameter
        cutter = AnalyticCutter(food, scenario.board.height, period)
    p_FK = [start.offset, 0.0, height + start.clearance]
    return cutter, X_WF @ RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), p_FK)


def _add_holder(plant: MultibodyPlant, scenario: Scenario, solvers: list[CuttingSolver]) -> None:
    """Draws the holder where the food is held, in a sequence behind the last cut."""
    food = scenario.food
    if not isinstance(food, Food) or food.held_sides not in ("both", "plus"):
        return
    model, distance = solvers[0].model, food.hold_distance + 0.005
    if scenario.sequence is not None:
        distance += scenario.sequence.positions(food)[-1]
    size = np.ptp(model.split.vertex_position @ model.X_FC_rotation.T, axis=0)
    if scenario.holder == "arm":
        grip = np.array([0.0, distance + FINGER, 0.5 * size[2]])
        add_holding_arm(plant, scenario.X_WF(), grip)
        return
    add_holder(
        plant,
        scenario.board,
        scenario.X_WF(),
        food_width=float(size[0]),
        food_height=float(size[2]),
        distance=distance,
    )
