"""The robot of a station: arm, gripper and knife in a plant, and the controller of the joints."""

import dataclasses as dc

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    ModelInstanceIndex,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import LinearSystem, Multiplexer

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.bench_errors import ToolErrors
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.plant.knife_body import add_knife
from sliceit_drake.resources import add_package_map
from sliceit_drake.systems.servo import JOINTS, Servo, ServoConfig

__all__ = [
    "ArmController",
    "JointControlConfig",
    "Robot",
    "RobotConfig",
    "add_arm_and_gripper",
    "add_plant",
    "add_robot",
    "connect_arm_controller",
]


@dc.dataclass
class JointControlConfig:
    """Gains of the controller that makes the joints follow the servo's desired motion.

    Universal Robots publish none. The stiffnesses are of the order of the torsional stiffness of
    strain-wave gears of the joints' torque classes; with the arm's and the rotors' inertias at the
    start they give 13 to 39 Hz, damping ratios of 0.8 to 1.2. The integral takes up lasting loads
    within 0.1 s: a real UR shows no lasting error under load either, and compliance control that
    starts each cycle from the measured joints would turn one into millimetres of the tool.
    """

    stiffness: list[float] = quantity(
        [3e4, 3e4, 3e4, 1e4, 1e4, 1e4], "Nm/rad", low=0.0, high=1e6, size=JOINTS
    )
    """Torque per position error."""
    damping: list[float] = quantity(
        [600.0, 600.0, 500.0, 110.0, 110.0, 100.0], "Nms/rad", low=0.0, high=1e5, size=JOINTS
    )
    """Torque per velocity error."""
    reset_rate: float = quantity(20.0, "1/s", low=0.0, high=200.0)
    """Integral gain over stiffness; 0 for no integral."""


@dc.dataclass
class RobotConfig:
    """The arm, where it stands, and how it is simulated."""

    base_position: list[float] = quantity([0.0, 0.0, 0.0], "m", low=-5.0, high=5.0, size=3)
    """Origin of B in the world."""
    base_rpy: list[float] = quantity([0.0, 0.0, 0.0], "rad", low=-6.3, high=6.3, size=3)
    """Roll, pitch, yaw of B in W."""
    joint_positions: list[float] = quantity(
        [1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493],
        "rad",
        low=-6.2832,
        high=6.2832,
        size=JOINTS,
    )
    """Joints at the start; the default is the start of SliceIt!."""
    tool_position: list[float] = quantity([0.0, 0.0, 0.21], "m", low=-1.0, high=1.0, size=3)
    """Origin of the knife frame in tool0."""
    tool_rpy: list[float] = quantity([0.0, 0.0, 0.0], "rad", low=-6.3, high=6.3, size=3)
    """Rotation of the knife in tool0."""
    plant_time_step: float = quantity(1e-3, "s", low=1e-5, high=4e-3)
    """Step of the plant."""
    servo: ServoConfig = dc.field(default_factory=ServoConfig)
    joint_control: JointControlConfig = dc.field(default_factory=JointControlConfig)

    def X_WB(self) -> RigidTransform:
        """Pose of the robot's base frame B in the world."""
        return RigidTransform(RollPitchYaw(self.base_rpy), self.base_position)

    def X_TK(self) -> RigidTransform:
        """Pose of the knife frame K in tool0."""
        return RigidTransform(RollPitchYaw(self.tool_rpy), self.tool_position)


@dc.dataclass
class Robot:
    """Handles of a robot in a plant.

    Attributes:
        arm: Model instance with the six joints.
        knife: Body ``knife``, whose frame is K.
        sensor_weld: Weld between tool0 and the gripper, where the wrench sensor sits.
    """

    arm: ModelInstanceIndex
    knife: RigidBody
    sensor_weld: WeldJoint


def add_plant(builder: DiagramBuilder, config: RobotConfig) -> tuple[MultibodyPlant, SceneGraph]:
    """Adds an empty discrete plant, with the contact law of `Board`, and its scene graph."""
    return AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=config.plant_time_step,
            contact_model="point",
            # Hunt and Crossley's law; "sap" would replace its dissipation by a relaxation time.
            discrete_contact_approximation="lagged",
            # A plant with sampled ports steps in an unrestricted update: before the controllers of
            # the same instant, beside the cutting system instead of after it, and with a copy of
            # the whole diagram's state at every step.
            use_sampled_output_ports=False,
        ),
        builder,
    )


def add_robot(
    plant: MultibodyPlant,
    config: RobotConfig,
    knife: Knife,
    board: Board,
    tool: ToolErrors | None = None,
) -> Robot:
    """Adds the arm, the gripper and the knife, at their initial positions.

    The plant is not finalized, and registered with a scene graph; `board` is what the knife may
    touch, and `tool` a part on Kz that it carries beside, of a mass above zero.
    """
    arm, gripper = add_arm_and_gripper(plant)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", arm), config.X_WB())
    tool0 = plant.GetFrameByName("tool0", arm)
    gripper_frame = plant.GetFrameByName("gripper", gripper)
    sensor_weld = plant.AddJoint(
        WeldJoint("sensor_weld", tool0, gripper_frame, RigidTransform.Identity())
    )
    knife_body = add_knife(plant, knife, board, gripper_frame, config.X_TK())
    if tool is not None and tool.mass > 0.0:
        point = SpatialInertia(tool.mass, np.zeros(3), UnitInertia(0.0, 0.0, 0.0))
        part = plant.AddRigidBody("uncompensated", plant.AddModelInstance("uncompensated"), point)
        place = RigidTransform([0.0, 0.0, tool.moment / tool.mass])
        plant.WeldFrames(knife_body.body_frame(), part.body_frame(), place)
    joints = map(plant.get_joint, plant.GetJointIndices(arm))
    turning = (joint for joint in joints if isinstance(joint, RevoluteJoint))
    for joint, position in zip(turning, config.joint_positions, strict=True):
        joint.set_default_angle(position)
    return Robot(arm, knife_body, sensor_weld)


def add_arm_and_gripper(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, ModelInstanceIndex]:
    """Adds a UR5e and its gripper, welded to nothing."""
    parser = Parser(plant)
    add_package_map(parser)
    (arm,) = parser.AddModelsFromUrl("package://sliceit_drake_models/ur5e/ur5e.urdf")
    (gripper,) = parser.AddModelsFromUrl("package://sliceit_drake_models/gripper/gripper.sdf")
    return arm, gripper


class ArmController(Diagram):
    """What a UR's control box does with joint targets: servo, model feedforward, joint control.

    The torque is ``inverse dynamics(q, v, a_d) + stiffness (q_d - q) + damping (v_d - v) +
    integral``, computed at each plant step and held. q_d, v_d and a_d are the servo's. The inverse
    dynamics know arm, rotors, payload and gravity exactly (a control box publishes its own
    ``target_qdd`` and ``target_moment``): the arm follows the servo's motion without further lag
    and sags under no weight, while gravity stays on in the plant, so that the wrench sensor sees
    the tool's weight. Only forces of the environment make the arm deviate.

    The plant's own implicit PD control would be stable with any gains, but makes its contact solver
    run at every step, which triples the cost of an arm that touches nothing most of the time
    (220 us a step against 57 us). With the reflected inertia of the gears the explicit law
    is stable, which is checked.

    Inputs:
        joint_positions_command: Targets of the joints [6], rad.
        joint_state: Positions and velocities of the joints [12], rad and rad/s.

    Outputs:
        joint_torques: Torques of the joints [6], Nm; the plant limits them to its effort limits.
            Depends directly on both inputs.
        desired_state: Positions and velocities asked by the servo [12], rad and rad/s.
    """

    def __init__(self, plant: MultibodyPlant, robot: Robot, config: RobotConfig) -> None:
        """Builds the controller, at rest at the initial positions, of a robot in a finalized plant.

        Raises:
            ConfigurationError: If the gains are unstable at the plant's time step.
            ValueError: If the plant has other degrees of freedom than the arm's.
        """
        super().__init__()
        if plant.num_velocities() != JOINTS:
            raise ValueError(
                f"The plant has {plant.num_velocities()} degrees of freedom; the arm's controller "
                f"expects the {JOINTS} of the arm alone."
            )
        _check_gains(plant, robot.arm, config.joint_control)
        self._plant, self._arm = plant, robot.arm
        period = plant.time_step()
        builder = DiagramBuilder()
        self._servo = builder.AddNamedSystem(
            "servo", Servo(config.servo, period, config.joint_positions)
        )
        feedforward = builder.AddNamedSystem("inverse_dynamics", InverseDynamics(plant))
        signals = builder.AddNamedSystem("signals", Multiplexer([2 * JOINTS, 2 * JOINTS, JOINTS]))
        self._joint_control = builder.AddNamedSystem(
            "joint_control", _joint_control(config.joint_control, period)
        )
        builder.ExportInput(self._servo.get_input_port(), "joint_positions_command")
        state = builder.ExportInput(signals.get_input_port(1), "joint_state")
        builder.ConnectInput(state, feedforward.get_input_port_estimated_state())
        desired_state = self._servo.GetOutputPort("desired_state")
        builder.Connect(desired_state, signals.get_input_port(0))
        builder.Connect(
            self._servo.GetOutputPort("desired_acceleration"),
            feedforward.get_input_port_desired_acceleration(),
        )
        builder.Connect(feedforward.get_output_port(), signals.get_input_port(2))
        builder.Connect(signals.get_output_port(), self._joint_control.get_input_port())
        builder.ExportOutput(self._joint_control.get_output_port(), "joint_torques")
        builder.ExportOutput(desired_state, "desired_state")
        builder.BuildInto(self)

    def set_positions(self, root_context: Context, positions: ArrayLike) -> None:
        """Puts arm and controller at rest at `positions` [6], rad, in the diagram's context."""
        plant_context = self._plant.GetMyMutableContextFromRoot(root_context)
        self._plant.SetPositions(plant_context, self._arm, np.asarray(positions, float))
        self._plant.SetVelocities(plant_context, self._arm, np.zeros(JOINTS))
        self._servo.set_positions(root_context, positions)
        control = self._joint_control.GetMyMutableContextFromRoot(root_context)
        control.SetDiscreteState(np.zeros(JOINTS))


def connect_arm_controller(
    builder: DiagramBuilder, plant: MultibodyPlant, robot: Robot, config: RobotConfig
) -> ArmController:
    """Adds the arm's controller and connects it to the finalized plant in the same diagram.

    Returns:
        The controller; its input ``joint_positions_command`` is left open.
    """
    controller = builder.AddNamedSystem("arm_controller", ArmController(plant, robot, config))
    builder.Connect(plant.get_state_output_port(robot.arm), controller.GetInputPort("joint_state"))
    builder.Connect(
        controller.GetOutputPort("joint_torques"), plant.get_actuation_input_port(robot.arm)
    )
    return controller


def _joint_control(config: JointControlConfig, period: float) -> LinearSystem:
    """PID law on [desired state, state, feedforward]; its state is the integral's torque."""
    p, d = np.diag(config.stiffness), np.diag(config.damping)
    none = np.zeros((JOINTS, JOINTS))
    integral = period * config.reset_rate * p
    return LinearSystem(
        A=np.eye(JOINTS),
        B=np.hstack([integral, none, -integral, none, none]),
        C=np.eye(JOINTS),
        D=np.hstack([p, d, -p, -d, np.eye(JOINTS)]),
        time_period=period,
    )


def _check_gains(
    plant: MultibodyPlant, arm: ModelInstanceIndex, config: JointControlConfig
) -> None:
    """Refuses gains that are unstable on the least inertia a joint can have, that of its rotor.

    A mass under an explicit law, integrated by the plant's symplectic step h, is stable if
    2 d h + p h^2 < 4 J (Jury's conditions).
    """
    h = plant.time_step()
    for i, index in enumerate(plant.GetJointActuatorIndices(arm)):
        actuator = plant.get_joint_actuator(index)
        inertia = actuator.default_reflected_inertia()
        load = (2.0 * config.damping[i] * h + config.stiffness[i] * h * h) / (4.0 * inertia)
        if load >= 1.0:
            raise ConfigurationError(
                f"stiffness {config.stiffness[i]:.6g} Nm/rad and damping {config.damping[i]:.6g} "
                f"Nms/rad are unstable at the plant step of {h:.6g} s with the reflected inertia "
                f"of {inertia:.3g} kg m2",
                field=f"robot.joint_control ({actuator.name()})",
                fix=f"Divide the gains or the plant step by at least {load:.3g}.",
            )
