"""The robot in the plant: kinematics, knife, contact with the board, and the arm's controller."""

import dataclasses as dc
import math

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Role, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import CalcSpatialInertia, JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml, validate
from sliceit_drake.cutting.board import (
    Board,
    board_wrench,
    edge_contact_positions,
    impact_peak_loss,
)
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.plant.knife_body import blade_surface, effective_mass
from sliceit_drake.diagrams.plant.robot_plant import (
    ArmController,
    JointControlConfig,
    Robot,
    RobotConfig,
    add_plant,
    add_robot,
    connect_arm_controller,
)
from sliceit_drake.diagrams.plant.surroundings import add_board, add_holder, add_table
from sliceit_drake.records.rosbag import JOINT_NAMES
from sliceit_drake.systems.servo import ServoConfig


@dc.dataclass
class Cell:
    """A robot over a board, driven by prescribed joint targets."""

    diagram: Diagram
    plant: MultibodyPlant
    robot: Robot
    controller: ArmController

    def simulator(self) -> Simulator:
        return Simulator(self.diagram)

    def plant_context(self, simulator: Simulator):
        return self.plant.GetMyContextFromRoot(simulator.get_context())

    def knife_pose(self, simulator: Simulator) -> RigidTransform:
        return self.robot.knife.EvalPoseInWorld(self.plant_context(simulator))

    def joint_errors(self, simulator: Simulator) -> np.ndarray:
        desired = self.controller.GetOutputPort("desired_state").Eval(
            self.controller.GetMyContextFromRoot(simulator.get_context())
        )
        return desired[:6] - self.plant.GetPositions(self.plant_context(simulator))

    def board_on_knife(self, simulator: Simulator) -> np.ndarray:
        """Contact wrench on the knife at Ko in W [6], moment first."""
        context = self.plant_context(simulator)
        results = self.plant.get_contact_results_output_port().Eval(context)
        p_WK = self.knife_pose(simulator).translation()
        wrench = np.zeros(6)
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            sign = 1.0 if contact.bodyB_index() == self.robot.knife.index() else -1.0
            force = sign * contact.contact_force()
            wrench[:3] += np.cross(contact.contact_point() - p_WK, force)
            wrench[3:] += force
        return wrench


def make_cell(
    config: RobotConfig | None = None,
    *,
    board: Board | None = None,
    targets: PiecewisePolynomial | None = None,
    force: np.ndarray | None = None,
) -> Cell:
    config, board = config or RobotConfig(), board or Board(height=0.0)
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, config)
    robot = add_robot(plant, config, Knife(), board)
    add_board(plant, board, RigidTransform([0.026, -0.505, 0.0]))
    plant.Finalize()
    controller = connect_arm_controller(builder, plant, robot, config)
    source = (
        ConstantVectorSource(config.joint_positions)
        if targets is None
        else TrajectorySource(targets)
    )
    builder.AddSystem(source)
    builder.Connect(source.get_output_port(), controller.GetInputPort("joint_positions_command"))
    if force is not None:
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = robot.knife.index()
        applied.F_Bq_W = SpatialForce(np.zeros(3), force)
        forces = builder.AddSystem(ConstantValueSource(AbstractValue.Make([applied])))
        builder.Connect(forces.get_output_port(), plant.get_applied_spatial_force_input_port())
    return Cell(builder.Build(), plant, robot, controller)


def vertical_path(config: RobotConfig, speed: float, depth: float) -> PiecewisePolynomial:
    """Joint targets that level the knife's edge and lower it by `depth` at `speed`, then wait."""
    cell = make_cell(config)
    plant, context = cell.plant, cell.plant.CreateDefaultContext()
    frame = cell.robot.knife.body_frame()
    start = frame.CalcPoseInWorld(context).translation()
    R_WK = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
    R_WK = RotationMatrix.MakeZRotation(math.pi / 2) @ R_WK
    q = np.array(config.joint_positions)
    times = np.append(np.linspace(0.0, depth / speed, 40), 10.0)
    samples = []
    for time in times:
        goal = start - [0.0, 0.0, min(speed * time, depth)]
        for _ in range(8):
            plant.SetPositions(context, q)
            X = frame.CalcPoseInWorld(context)
            turn = (R_WK @ X.rotation().inverse()).ToAngleAxis()
            J = plant.CalcJacobianSpatialVelocity(
                context,
                JacobianWrtVariable.kV,
                frame,
                np.zeros(3),
                plant.world_frame(),
                plant.world_frame(),
            )
            error = np.concatenate([turn.axis() * turn.angle(), goal - X.translation()])
            q = q + np.linalg.solve(J, error)
        samples.append(q)
    return PiecewisePolynomial.FirstOrderHold(times, np.array(samples).T)


def press(config: RobotConfig, board_of, gap: float, depth: float, speed: float, duration: float):
    """Lowers the knife onto a board `gap` below; returns the cell and wrenches on it [N, 6]."""
    targets = vertical_path(config, speed, gap + depth)
    config = dc.replace(config, joint_positions=list(targets.value(0.0)[:, 0]))
    height = make_cell(config)
    edge = height.knife_pose(height.simulator()).translation()[2]
    board = board_of(edge - gap)
    cell = make_cell(config, board=board, targets=targets)
    simulator = cell.simulator()
    wrenches = []
    for time in np.arange(config.plant_time_step, duration, config.plant_time_step):
        simulator.AdvanceTo(time)
        wrenches.append(cell.board_on_knife(simulator))
    return cell, simulator, board, np.array(wrenches)


# Kinematics and inertia -------------------------------------------------------------------------


def arm_in_base():
    cell = make_cell()
    context = cell.plant.CreateDefaultContext()
    return cell.plant, context, cell.plant.GetFrameByName("base")


def test_the_tip_is_where_the_reference_of_the_compliance_controller_has_it():
    plant, context, base = arm_in_base()
    plant.SetPositions(context, [1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493])
    X_BT = plant.GetFrameByName("tool0").CalcPose(context, base)
    np.testing.assert_allclose(X_BT @ [0, 0, 0.15], [0.026000, -0.505454, 0.253845], atol=1e-6)


def test_tool0_follows_the_published_dh_table():
    a = [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
    d = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
    alpha = [math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0]
    plant, context, base = arm_in_base()
    for q in np.random.default_rng(3).uniform(-3.0, 3.0, (20, 6)):
        X = RigidTransform()
        for theta, a_i, d_i, alpha_i in zip(q, a, d, alpha, strict=True):
            X = X @ RigidTransform(RotationMatrix.MakeZRotation(theta), [0, 0, d_i])
            X = X @ RigidTransform(RotationMatrix.MakeXRotation(alpha_i), [a_i, 0, 0])
        plant.SetPositions(context, q)
        X_BT = plant.GetFrameByName("tool0").CalcPose(context, base)
        assert X_BT.IsNearlyEqualTo(X, 1e-12)


def test_base_link_is_the_dh_base_turned_by_half_a_turn():
    plant, context, base = arm_in_base()
    X = plant.GetFrameByName("base_link").CalcPose(context, base)
    assert X.IsNearlyEqualTo(
        RigidTransform(RotationMatrix.MakeZRotation(math.pi), [0, 0, 0]), 1e-12
    )


def test_joints_have_the_published_limits_and_rotors_with_inertia():
    plant, _, _ = arm_in_base()
    for i, name in enumerate(JOINT_NAMES):
        joint, actuator = plant.GetJointByName(name), plant.GetJointActuatorByName(name)
        turn = math.pi if name == "elbow_joint" else 2 * math.pi
        assert joint.position_upper_limits()[0] == -joint.position_lower_limits()[0] == turn
        assert joint.velocity_upper_limits()[0] == math.pi
        assert actuator.effort_limit() == (150.0 if i < 3 else 28.0)
        assert actuator.default_gear_ratio() == 101.0
        reflected = 1.916 if i < 3 else 0.160
        assert actuator.default_reflected_inertia() == pytest.approx(reflected, rel=1e-3)


def test_the_arm_stands_where_it_is_configured():
    config = RobotConfig(base_position=[0.3, -0.2, 0.7], base_rpy=[0.1, 0.2, -0.5])
    cell = make_cell(config)
    context = cell.plant.CreateDefaultContext()
    X_WB = cell.plant.GetFrameByName("base").CalcPoseInWorld(context)
    assert X_WB.IsNearlyEqualTo(
        RigidTransform(RollPitchYaw(0.1, 0.2, -0.5), [0.3, -0.2, 0.7]), 1e-12
    )
    np.testing.assert_array_equal(cell.plant.GetPositions(context), config.joint_positions)


def test_a_robot_survives_yaml_and_its_ranges_are_checked(tmp_path):
    config = RobotConfig(servo=ServoConfig(gain=500.0), base_position=[0.0, 0.1, 0.0])
    dump_yaml(config, tmp_path / "robot.yaml")
    assert load_yaml(RobotConfig, tmp_path / "robot.yaml") == config
    config.joint_positions = [0.0] * 5
    with pytest.raises(ConfigurationError, match=r"robot.joint_positions: has 5 values. Give 6"):
        validate(config, "robot")


# The knife --------------------------------------------------------------------------------------


def test_the_knife_weighs_what_its_section_and_its_handle_do():
    knife = Knife()
    cell = make_cell()
    inertia = cell.robot.knife.default_spatial_inertia()
    section = 0.5 * knife.edge_thickness * knife.tip_height
    section += 0.5 * (knife.edge_thickness + knife.spine_thickness) * knife.height
    blade = 7800.0 * section * knife.length
    handle = inertia.get_mass() - blade
    assert blade == pytest.approx(0.1236, abs=1e-4)
    assert 0.05 < handle < 0.10
    # The centre lies in the blade's plane, behind the middle, between edge and spine.
    x, y, z = inertia.get_com()
    assert -0.075 < x < 0.0 and abs(y) < 1e-12 and -0.045 < z < -0.03


def test_a_blade_of_nearly_constant_thickness_has_the_inertia_of_a_box():
    knife = Knife(spine_thickness=2.0e-3, edge_thickness=1.9999e-3, tip_height=1e-6, height=0.04)
    inertia = CalcSpatialInertia(blade_surface(knife), 7800.0)
    mass = 7800.0 * 2e-3 * 0.04 * knife.length
    assert inertia.get_mass() == pytest.approx(mass, rel=1e-4)
    np.testing.assert_allclose(inertia.get_com(), [0.0, 0.0, -0.02], atol=1e-6)
    about_centre = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
    a, b, c = knife.length, 2e-3, 0.04
    box = mass / 12.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(about_centre, box, rtol=1e-3)


def test_the_knife_frame_lies_in_tool0_as_configured():
    config = RobotConfig(tool_position=[0.01, -0.02, 0.2], tool_rpy=[0.0, 0.3, 0.0])
    cell = make_cell(config)
    context = cell.plant.CreateDefaultContext()
    X_TK = cell.robot.knife.body_frame().CalcPose(context, cell.plant.GetFrameByName("tool0"))
    assert X_TK.IsNearlyEqualTo(config.X_TK(), 1e-12)


def test_the_edge_is_a_row_of_spheres_that_touch_the_edge_line_from_inside():
    cell = make_cell()
    inspector = cell.diagram.GetSubsystemByName("scene_graph").model_inspector()
    spheres = [
        (inspector.GetPoseInFrame(i).translation(), inspector.GetShape(i))
        for i in cell.plant.GetCollisionGeometriesForBody(cell.robot.knife)
    ]
    assert len(spheres) >= 7
    assert all(isinstance(shape, Sphere) for _, shape in spheres)
    x = sorted(p[0] for p, _ in spheres)
    np.testing.assert_allclose(x, edge_contact_positions(Knife()), atol=1e-12)
    for p, shape in spheres:
        np.testing.assert_allclose([p[1], p[2] + shape.radius()], 0.0, atol=1e-12)


def test_only_the_edge_and_the_board_collide():
    cell = make_cell()
    inspector = cell.diagram.GetSubsystemByName("scene_graph").model_inspector()
    colliding = inspector.GetAllGeometryIds(Role.kProximity)
    bodies = {cell.plant.GetBodyFromFrameId(inspector.GetFrameId(i)).name() for i in colliding}
    assert bodies == {"knife", "world"}
    assert sum(inspector.GetName(i).endswith("board") for i in colliding) == 1


# Contact with the board -------------------------------------------------------------------------


@pytest.mark.parametrize(("stiffness", "depth"), [(1e4, 5e-3), (1e5, 5e-4)])
def test_a_knife_pressed_on_the_board_rests_steadily_at_stiffness_times_depth(stiffness, depth):
    cell, simulator, board, wrenches = press(
        RobotConfig(), lambda z: Board(height=z, stiffness=stiffness), 0.003, depth, 0.05, 0.9
    )
    steady = wrenches[-100:]
    assert steady[:, 5].mean() == pytest.approx(50.0, rel=0.01)
    assert steady[:, 5].std() < 0.1
    assert (steady[:, :3].std(axis=0) < 0.05).all()
    X_WK = cell.knife_pose(simulator)
    penetration = board.height - X_WK.translation()[2]
    assert steady[-1, 5] / board.stiffness == pytest.approx(penetration, rel=0.005)
    # The same law without a plant.
    law = board_wrench(
        board,
        Knife(),
        X_WK.rotation().matrix(),
        X_WK.translation(),
        np.zeros(3),
        np.zeros(3),
    )
    np.testing.assert_allclose(steady[-1], law, atol=0.3)


@pytest.mark.parametrize(("stiffness", "step"), [(1e5, 1e-3), (3e5, 5e-4), (1e6, 2.5e-4)])
def test_the_plants_steps_take_of_an_impacts_peak_what_is_estimated(stiffness, step):
    peaks = []
    for time_step in (step, 1e-4):
        config = RobotConfig(plant_time_step=time_step)
        # The command stops 0.3 mm deep, and the time ends while the knife rebounds: later the arm
        # presses harder than the impact did.
        cell, simulator, board, wrenches = press(
            config, lambda z: Board(height=z, stiffness=stiffness), 0.003, 3e-4, 0.1, 0.10
        )
        peaks.append(wrenches[:, 5].max())
        assert wrenches[-1, 5] < 0.97 * peaks[-1]
    q = cell.plant.GetPositions(cell.plant_context(simulator))
    mass = effective_mass(cell.plant, cell.robot.knife, q)
    kept = [1.0 - impact_peak_loss(stiffness, mass, time_step) for time_step in (step, 1e-4)]
    estimate = 1.0 - kept[0] / kept[1]
    assert 0.7 * estimate < 1.0 - peaks[0] / peaks[1] < 1.05 * estimate
    assert 0.03 < estimate < 0.10


@pytest.mark.parametrize("speed", [0.05, 0.1])
def test_an_impact_on_the_default_board_peaks_alike_at_steps_of_1_and_of_a_tenth_ms(speed):
    coarse, fine = (
        press(
            RobotConfig(plant_time_step=step), lambda z: Board(height=z), 0.003, 3e-4, speed, 0.12
        )[3][:, 5].max()
        for step in (1e-3, 1e-4)
    )
    assert fine > 5.0
    assert coarse == pytest.approx(fine, rel=0.05)


def test_the_effective_mass_is_what_a_blow_on_the_edge_moves():
    cell = make_cell()
    plant, context = cell.plant, cell.plant.CreateDefaultContext()
    mass = effective_mass(plant, cell.robot.knife, plant.GetPositions(context))
    # A unit vertical impulse on the edge gives the joints M^-1 J', and the edge 1 / mass.
    rates = []
    for force in (0.0, 1.0):
        cell = make_cell(force=np.array([0.0, 0.0, force]))
        simulator = cell.simulator()
        simulator.AdvanceTo(1e-3)
        velocity = cell.robot.knife.EvalSpatialVelocityInWorld(cell.plant_context(simulator))
        rates.append(velocity.translational()[2])
    assert rates[1] - rates[0] == pytest.approx(1e-3 / mass, rel=0.02)


# The arm's controller ---------------------------------------------------------------------------


def test_the_plant_steps_beside_the_controllers_and_not_before_them():
    plant = make_cell().plant
    assert plant.num_abstract_states() == 0
    assert plant.IsDifferenceEquationSystem() == (True, 1e-3)


def test_the_arm_does_not_sag_under_its_own_weight_nor_the_tool():
    cell = make_cell()
    simulator = cell.simulator()
    simulator.AdvanceTo(0.2)
    q = cell.plant.GetPositions(cell.plant_context(simulator))
    np.testing.assert_allclose(q, RobotConfig().joint_positions, atol=1e-10)


@pytest.mark.parametrize("step", [1e-3, 1e-4])
def test_the_arm_trails_a_ramp_by_the_servos_lag_alone(step):
    config = RobotConfig(plant_time_step=step)
    start, speed = np.array(config.joint_positions), 0.3
    targets = PiecewisePolynomial.FirstOrderHold(
        [0.0, 1.0], np.stack([start, start + speed], axis=1)
    )
    cell = make_cell(config, targets=targets)
    simulator = cell.simulator()
    simulator.AdvanceTo(0.6)
    q = cell.plant.GetPositions(cell.plant_context(simulator))
    lag = 0.6 - (q - start) / speed
    np.testing.assert_allclose(lag, config.servo.lag, atol=1.5 * step)


def test_a_step_of_the_targets_moves_the_arm_as_the_servo_asks():
    config = RobotConfig()
    start = np.array(config.joint_positions)
    targets = PiecewisePolynomial.ZeroOrderHold([0.0, 1.0], np.tile((start + 0.01)[:, None], 2))
    cell = make_cell(config, targets=targets)
    simulator = cell.simulator()
    worst, highest = 0.0, 0.0
    for time in np.arange(2e-3, 0.3, 2e-3):
        simulator.AdvanceTo(time)
        worst = max(worst, np.abs(cell.joint_errors(simulator)).max())
        q = cell.plant.GetPositions(cell.plant_context(simulator))
        highest = max(highest, ((q - start) / 0.01).max())
    assert worst < 4e-4
    assert highest == pytest.approx(1.058, abs=0.01)


def test_a_lasting_force_deflects_the_arm_for_a_moment_only():
    force = np.array([0.0, 0.0, 50.0])
    cell = make_cell(force=force)
    simulator = cell.simulator()
    start = cell.knife_pose(simulator).translation()
    deflections = []
    for time in np.arange(5e-3, 0.5, 5e-3):
        simulator.AdvanceTo(time)
        deflections.append(cell.knife_pose(simulator).translation()[2] - start[2])
    assert 0.5e-3 < max(deflections) < 2e-3
    assert abs(deflections[-1]) < 0.02 * max(deflections)


def test_without_integral_a_force_bends_the_arm_by_its_stiffness():
    force = np.array([0.0, 0.0, 50.0])
    control = JointControlConfig(reset_rate=0.0)
    cell = make_cell(RobotConfig(joint_control=control), force=force)
    simulator = cell.simulator()
    simulator.AdvanceTo(0.5)
    context = cell.plant_context(simulator)
    J = cell.plant.CalcJacobianTranslationalVelocity(
        context,
        JacobianWrtVariable.kV,
        cell.robot.knife.body_frame(),
        np.zeros(3),
        cell.plant.world_frame(),
        cell.plant.world_frame(),
    )
    expected = (J.T @ force) / np.array(control.stiffness)
    np.testing.assert_allclose(-cell.joint_errors(simulator), expected, atol=1e-6)


def test_torques_stop_at_the_limits_of_the_joints():
    cell = make_cell()
    simulator = cell.simulator()
    context = simulator.get_mutable_context()
    here = np.array(RobotConfig().joint_positions)
    cell.controller.set_positions(context, here + 0.5)
    plant_context = cell.plant.GetMyMutableContextFromRoot(context)
    cell.plant.SetPositions(plant_context, here)
    torques = cell.plant.get_net_actuation_output_port(cell.robot.arm).Eval(plant_context)
    np.testing.assert_allclose(torques, [150.0] * 3 + [28.0] * 3)


def test_the_arm_rests_where_it_is_put():
    config = RobotConfig()
    elsewhere = np.array(config.joint_positions) + [0.2, -0.1, 0.1, 0.0, 0.3, -0.2]
    targets = PiecewisePolynomial.ZeroOrderHold([0.0, 1.0], np.tile(elsewhere[:, None], 2))
    cell = make_cell(config, targets=targets)
    simulator = cell.simulator()
    simulator.AdvanceTo(0.05)
    context = simulator.get_mutable_context()
    context.SetTime(0.0)
    cell.controller.set_positions(context, elsewhere)
    simulator.Initialize()
    simulator.AdvanceTo(0.1)
    q = cell.plant.GetPositions(cell.plant_context(simulator))
    np.testing.assert_allclose(q, elsewhere, atol=1e-10)


def test_two_runs_agree_to_the_last_bit():
    states = []
    for _ in range(2):
        cell = make_cell(force=np.array([3.0, -5.0, 20.0]))
        simulator = cell.simulator()
        simulator.AdvanceTo(0.1)
        states.append(cell.plant.GetPositionsAndVelocities(cell.plant_context(simulator)))
    np.testing.assert_array_equal(states[0], states[1])


def test_gains_that_would_be_unstable_are_refused_with_a_way_out():
    control = JointControlConfig(damping=[600.0, 600.0, 500.0, 110.0, 110.0, 600.0])
    with pytest.raises(ConfigurationError, match=r"wrist_3_joint\).*Divide .* at least 1.89"):
        make_cell(RobotConfig(joint_control=control))


def test_the_default_gains_are_stable_at_every_allowed_plant_step_up_to_two_milliseconds():
    for step in (1e-4, 1e-3, 2e-3):
        make_cell(RobotConfig(plant_time_step=step))


# The surroundings -------------------------------------------------------------------------------


def test_the_board_lies_under_the_food_frame_and_the_rest_is_only_drawn():
    board = Board(height=0.07, size=[0.30, 0.20, 0.02])
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, RobotConfig())
    X_WF = RigidTransform(RotationMatrix.MakeZRotation(0.4), [0.1, -0.5, 0.07])
    add_board(plant, board, X_WF)
    add_holder(plant, X_WF, food_width=0.03, food_height=0.04, distance=0.02)
    add_table(plant, (0.0, -0.3))
    inspector = scene_graph.model_inspector()
    (contact,) = inspector.GetAllGeometryIds(Role.kProximity)
    X_WBox = inspector.GetPoseInFrame(contact)
    assert X_WBox.IsNearlyEqualTo(RigidTransform(X_WF.rotation(), [0.1, -0.5, 0.06]), 1e-12)
    drawn = [inspector.GetName(i) for i in inspector.GetAllGeometryIds(Role.kIllustration)]
    for part in ("board", "board_feet", "table", "holder_jaw_left", "holder_jaw_right"):
        assert sum(name.endswith(part) for name in drawn) == 1, part
    left = next(
        i
        for i in inspector.GetAllGeometryIds(Role.kIllustration)
        if inspector.GetName(i).endswith("holder_pad_left")
    )
    p_FPad = X_WF.inverse() @ inspector.GetPoseInFrame(left).translation()
    assert p_FPad[0] < -0.015 and p_FPad[1] > 0.02 and p_FPad[2] > 0.0
