"""Forward dynamics compliance control: the reference's trajectories, its statics and stability."""

import dataclasses as dc
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.systems.compliance_controller import (
    ComplianceController,
    ComplianceControllerConfig,
)
from sliceit_drake.systems.ur5e_kinematics import (
    ChainJoint,
    KinematicChain,
    make_virtual_model,
    ur5e_chain,
)

DATA = Path(__file__).resolve().parent / "data" / "fdcc"
Q0 = np.array([1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493])
X_TE = RigidTransform([0.0, 0.0, 0.15])


def controller_with(chain=None, frames=None, **config):
    """Returns a controller of the arm of the reference trajectories."""
    return ComplianceController(
        ComplianceControllerConfig(**config), chain or ur5e_chain(X_TE), **(frames or {})
    )


def pose_at(q, chain=None):
    """Returns X_BE of the arm."""
    plant = make_virtual_model(chain or ur5e_chain(X_TE), 0.1)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return plant.GetBodyByName("end_effector").EvalPoseInWorld(context)


def spatial_force(force_first):
    return SpatialForce(force_first[3:], force_first[:3])


def fix_inputs(controller, context, inputs):
    """Fixes input ports by name; wrenches are given as six numbers, force first."""
    for name, value in inputs.items():
        if name.endswith("_wrench"):
            value = Value(spatial_force(np.asarray(value, dtype=float)))
        elif isinstance(value, RigidTransform):
            value = Value(value)
        controller.GetInputPort(name).FixValue(context, value)


def start(controller, q=Q0, **inputs):
    """Returns a context in which the controller has been activated at `q`."""
    context = controller.CreateDefaultContext()
    fix_inputs(controller, context, {"joint_positions": q} | inputs)
    controller.ExecuteInitializationEvents(context)
    return context


def step(controller, context, **inputs):
    """Runs one update; returns copies of the joint position and velocity commands."""
    fix_inputs(controller, context, inputs)
    context.SetDiscreteState(controller.EvalUniquePeriodicDiscreteUpdate(context))
    return (
        controller.GetOutputPort("joint_positions_command").Eval(context).copy(),
        controller.GetOutputPort("joint_velocities_command").Eval(context).copy(),
    )


def run(controller, context, cycles, **inputs):
    """Runs updates with a robot that follows at once; returns the commands [cycles, n]."""
    fix_inputs(controller, context, inputs)
    commands = []
    q = controller.GetInputPort("joint_positions").Eval(context).copy()
    for _ in range(cycles):
        q, _ = step(controller, context, joint_positions=q)
        commands.append(q)
    return np.array(commands)


def commanded_pose(controller, context):
    return controller.GetOutputPort("commanded_pose").Eval(context)


def recording(name):
    with np.load(DATA / f"{name}.npz") as file:
        return dict(file)


class Transcription:
    """The control law written a second time: numpy, DH parameters, no Drake, no dead zones.

    Arrays are force or translation first. The link masses sit on the joints' axes as they do in
    the URDF, which are the DH origins 1, 1, 2, 4, 5 and 6.
    """

    D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
    A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
    ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
    MASS_ORIGINS = (1, 1, 2, 4, 5, 6)

    def __init__(self, config, q, R_EC, p_EC, R_ES, p_ES):
        self.config, self.R_EC = config, R_EC
        self.R_CS, self.p_CS = R_EC.T @ R_ES, R_EC.T @ (p_ES - p_EC)
        self.v, self.previous = np.zeros(6), np.zeros(6)
        self.pose = self.kinematics(q)[:2]

    def kinematics(self, q):
        """Returns R_BE, p_BE, H and J."""
        T, axes, origins = np.eye(4), [], [np.zeros(3)]
        for angle, d, a, alpha in zip(q, self.D, self.A, self.ALPHA, strict=True):
            axes.append(T[:3, 2])
            step = np.eye(4)
            step[:3, :3] = Rotation.from_euler("ZX", [angle, alpha]).as_matrix()
            step[:3, 3] = [a * math.cos(angle), a * math.sin(angle), d]
            T = T @ step
            origins.append(T[:3, 3])
        R, p = T[:3, :3], T[:3, 3] + T[:3, :3] @ [0.0, 0.0, 0.15]
        axes, joint_origins = np.array(axes), np.array(origins[:6])

        def jacobian(point, links):
            J = np.zeros((6, 6))
            J[:3, :links] = np.cross(axes[:links], point - joint_origins[:links]).T
            J[3:, :links] = axes[:links].T
            return J

        mass = self.config.link_mass
        bodies = [(origins[o], i + 1, mass, 1e-6) for i, o in enumerate(self.MASS_ORIGINS)]
        H = np.zeros((6, 6))
        for point, links, m, moment in [*bodies, (p, 6, 1.0, 1.0)]:
            J = jacobian(point, links)
            H += J.T @ np.diag([m] * 3 + [moment] * 3) @ J
        return R, p, H, jacobian(p, 6)

    def update(self, q, target, sensor_wrench, target_wrench):
        """Takes the measured joints, (R, p) of the target, and wrenches in S and in B or E."""
        c, dt = self.config, self.config.virtual_time_step
        force_C = self.R_CS @ sensor_wrench[:3]
        moment_C = self.R_CS @ sensor_wrench[3:] + np.cross(self.p_CS, force_C)
        for _ in range(c.iterations):
            R, _, H, J = self.kinematics(q)
            rotate_C, rotate_E = np.kron(np.eye(2), R @ self.R_EC), np.kron(np.eye(2), R)
            translation = target[1] - self.pose[1]
            rotation = Rotation.from_matrix(target[0] @ self.pose[0].T).as_rotvec()
            e = np.concatenate(
                [part / max(1.0, np.linalg.norm(part)) for part in (translation, rotation)]
            )
            f = rotate_C @ [*force_C, *moment_C]
            f = f + (rotate_E @ target_wrench if c.hand_frame_control else target_wrench)
            spring = rotate_C @ np.diag(c.stiffness) @ rotate_C.T @ e
            S = np.diag(c.selection)
            e = {
                "compliance": spring + f,
                "motion": e,
                "force": f,
                "parallel": S @ spring + (np.eye(6) - S) @ f,
            }[c.mode]
            u = c.error_scale * (
                np.array(c.p_gains) * e + np.array(c.d_gains) * (e - self.previous) / dt
            )
            self.previous = e
            acceleration = np.linalg.solve(H, J.T @ u)
            q = q + dt * self.v
            self.v = c.damping_factor * (self.v + dt * acceleration)
            self.pose = self.kinematics(q)[:2]
        return q


@pytest.mark.parametrize("name", ["s1_step_z", "s3_const_wrench"])
def test_the_reference_trajectories_are_reproduced(name):
    data = recording(name)
    controller = controller_with()
    context = start(controller, data["q_meas"][0])
    for k in range(len(data["t"])):
        q, v = step(
            controller,
            context,
            joint_positions=data["q_meas"][k],
            target_pose=RigidTransform(
                Quaternion(data["target_quat_wxyz"][k]), data["target_pos"][k]
            ),
            sensor_wrench=data["sensor_wrench_msg"][k],
            target_wrench=data["target_wrench_msg"][k],
        )
        np.testing.assert_allclose(q, data["q_cmd"][k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(v, data["qd_cmd_virtual"][k], rtol=0, atol=1e-9)
        X_BE = commanded_pose(controller, context)
        np.testing.assert_allclose(X_BE.translation(), data["tip_pos_of_q_cmd"][k], 0, 1e-9)
        R_BE = RotationMatrix(Quaternion(data["tip_quat_wxyz_of_q_cmd"][k]))
        np.testing.assert_allclose(X_BE.rotation().matrix(), R_BE.matrix(), rtol=0, atol=1e-9)


def test_without_dead_zones_the_end_of_a_step_differs_by_micrometres():
    # reference/fdcc.md, section 8: 2.5e-6 rad for this trajectory.
    data = recording("s1_step_z")
    controller = controller_with(dead_zones=False)
    context = start(controller, data["q_meas"][0])
    run(controller, context, 50, target_pose=pose_at(Q0))
    target = RigidTransform(Quaternion(data["target_quat_wxyz"][-1]), data["target_pos"][-1])
    commands = run(controller, context, 950, target_pose=target)
    assert 2e-6 < np.abs(commands - data["q_cmd"][50:]).max() < 3e-6


SLANTED = RigidTransform(RollPitchYaw(0.4, -0.7, 1.1), [0.03, -0.02, 0.05])
TURNED_SENSOR = RigidTransform(RollPitchYaw(-0.3, 0.2, 2.0), [0.01, 0.02, -0.13])
NEAR_SINGULAR = np.array([0.4, -1.2, 0.002, -1.9, 0.001, 0.3])


@pytest.mark.parametrize(
    ("q0", "lag", "config"),
    [
        (Q0, 1.0, {}),
        (Q0, 0.1, {}),
        (Q0, 0.1, {"iterations": 10, "d_gains": [0.005] * 6}),
        (Q0, 1.0, {"stiffness": [2000.0, 200.0, 900.0, 5.0, 40.0, 15.0], "link_mass": 0.4}),
        (Q0, 0.3, {"hand_frame_control": True, "virtual_time_step": 0.01, "damping_factor": 0.8}),
        (Q0, 0.5, {"mode": "parallel", "selection": [1.0, 0.9, 0.5, 0.8, 0.0, 0.3]}),
        (Q0, 0.5, {"mode": "motion", "p_gains": [1.0] * 3 + [0.5] * 3, "iterations": 10}),
        (Q0, 0.5, {"mode": "force", "error_scale": 0.2}),
        (NEAR_SINGULAR, 1.0, {}),
        (NEAR_SINGULAR, 0.2, {"iterations": 3, "d_gains": [0.002] * 3 + [0.01] * 3}),
    ],
)
def test_random_poses_and_wrenches_give_what_a_second_transcription_gives(q0, lag, config):
    controller = controller_with(
        frames={"X_EC": SLANTED, "X_ES": TURNED_SENSOR}, dead_zones=False, **config
    )
    second = Transcription(
        ComplianceControllerConfig(**config),
        q0,
        SLANTED.rotation().matrix(),
        SLANTED.translation(),
        TURNED_SENSOR.rotation().matrix(),
        TURNED_SENSOR.translation(),
    )
    rng = np.random.default_rng(7)
    context = start(controller, q0)
    X_BE, q = pose_at(q0), q0
    for cycle in range(60):
        if cycle % 20 == 0:
            offset = RigidTransform(RollPitchYaw(rng.normal(0, 0.2, 3)), rng.normal(0, 0.03, 3))
            target = RigidTransform(
                offset.rotation() @ X_BE.rotation(), X_BE.translation() + offset.translation()
            )
        sensor_wrench, target_wrench = rng.normal(size=(2, 6)) * ([8.0] * 3 + [0.5] * 3)
        command, velocity = step(
            controller,
            context,
            joint_positions=q,
            target_pose=target,
            sensor_wrench=sensor_wrench,
            target_wrench=target_wrench,
        )
        expected = second.update(
            q, (target.rotation().matrix(), target.translation()), sensor_wrench, target_wrench
        )
        np.testing.assert_allclose(command, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(velocity, second.v, rtol=0, atol=1e-7)
        # A servo that closes part of the gap: the measured joints are not the model's.
        q = q + lag * (command - q)
    assert np.abs(q - q0).max() > 1e-3


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("p_factor", [1.0, 2.5])
def test_a_constant_wrench_displaces_by_wrench_over_stiffness_whatever_the_gains(axis, p_factor):
    stiffness = np.array([500.0, 800.0, 300.0, 20.0, 30.0, 12.0])
    controller = controller_with(
        dead_zones=False,
        stiffness=list(stiffness),
        p_gains=list(p_factor * np.array([0.05] * 3 + [1.5] * 3)),
        # A stiffness in the axes of the base: C is turned back by the tool's rotation.
        frames={
            "X_EC": RigidTransform(pose_at(Q0).rotation().inverse()),
            "X_ES": RigidTransform(),
        },
    )
    wrench = np.zeros(6)
    wrench[axis] = 10.0 if axis < 3 else 0.8
    X_BE = pose_at(Q0)
    R_EB = np.kron(np.eye(2), X_BE.rotation().matrix().T)
    context = start(controller, target_pose=X_BE, sensor_wrench=R_EB @ wrench)
    run(controller, context, 1200)
    reached = commanded_pose(controller, context)
    turn = Rotation.from_matrix((reached.rotation() @ X_BE.rotation().inverse()).matrix())
    displacement = [*(reached.translation() - X_BE.translation()), *turn.as_rotvec()]
    np.testing.assert_allclose(displacement, wrench / stiffness, rtol=0, atol=1e-10)


def test_stiffness_acts_along_the_axes_of_a_tilted_compliance_frame():
    stiffness = np.array([400.0, 1500.0, 700.0])
    tilt = RollPitchYaw(0.5, -0.4, 0.8).ToRotationMatrix()
    controller = controller_with(
        dead_zones=False,
        stiffness=[*stiffness, 20.0, 20.0, 20.0],
        frames={"X_EC": RigidTransform(tilt), "X_ES": RigidTransform()},
    )
    X_BE = pose_at(Q0)
    force_B = np.array([6.0, -3.0, 9.0])
    R_EB = X_BE.rotation().matrix().T
    context = start(controller, target_pose=X_BE, sensor_wrench=[*(R_EB @ force_B), 0, 0, 0])
    run(controller, context, 1200)
    R_BC = (X_BE.rotation() @ tilt).matrix()
    np.testing.assert_allclose(
        commanded_pose(controller, context).translation() - X_BE.translation(),
        R_BC @ (R_BC.T @ force_B / stiffness),
        rtol=0,
        atol=1e-10,
    )


X_WB = RigidTransform(RollPitchYaw(0.1, -0.2, 0.7), [0.4, -0.3, 0.9])


@pytest.mark.parametrize("hand_frame_control", [False, True])
def test_a_target_wrench_balances_the_opposite_sensor_wrench(hand_frame_control):
    controller = controller_with(
        hand_frame_control=hand_frame_control, frames={"X_WB": X_WB, "X_ES": RigidTransform()}
    )
    sensor_wrench = np.array([3.0, -8.0, 5.0, 0.2, -0.4, 0.3])
    X_WE = X_WB @ pose_at(Q0)
    given_in = np.eye(3) if hand_frame_control else X_WE.rotation().matrix()
    context = start(
        controller,
        target_pose=X_WE,
        sensor_wrench=sensor_wrench,
        target_wrench=-np.kron(np.eye(2), given_in) @ sensor_wrench,
    )
    np.testing.assert_allclose(run(controller, context, 20), np.tile(Q0, (20, 1)), atol=1e-13)
    # The sensor wrench alone does move the arm.
    assert np.abs(run(controller, context, 20, target_wrench=np.zeros(6)) - Q0).max() > 1e-3


def test_a_target_wrench_pulls_the_robot_along_it_in_the_world():
    controller = controller_with(dead_zones=False, frames={"X_WB": X_WB})
    X_WE = X_WB @ pose_at(Q0)
    context = start(controller, target_pose=X_WE, target_wrench=[0.0, 0.0, -10.0, 0, 0, 0])
    run(controller, context, 1200)
    displacement = commanded_pose(controller, context).translation() - X_WE.translation()
    np.testing.assert_allclose(displacement, [0.0, 0.0, -0.02], rtol=0, atol=1e-10)


def test_a_wrench_at_the_sensor_equals_the_same_wrench_at_the_compliance_frame():
    wrench_S = SpatialForce([0.3, -0.6, 0.2], [4.0, 7.0, -9.0])
    X_CS = SLANTED.InvertAndCompose(TURNED_SENSOR)
    # Drake's own shift and change of axes: about Co, then in C.
    p_SoCo_S = X_CS.inverse().translation()
    wrench_C = wrench_S.Shift(p_SoCo_S)
    R_CS = X_CS.rotation().matrix()
    messages = (
        (TURNED_SENSOR, [*wrench_S.translational(), *wrench_S.rotational()]),
        (SLANTED, [*(R_CS @ wrench_C.translational()), *(R_CS @ wrench_C.rotational())]),
    )
    commands = []
    for X_ES, message in messages:
        controller = controller_with(frames={"X_EC": SLANTED, "X_ES": X_ES})
        context = start(controller, target_pose=pose_at(Q0), sensor_wrench=message)
        commands.append(run(controller, context, 200))
    np.testing.assert_allclose(commands[0], commands[1], rtol=0, atol=1e-12)
    assert np.abs(commands[0][-1] - Q0).max() > 1e-2


def test_the_sensor_is_at_the_flange_unless_said_otherwise():
    message = [1.0, -2.0, 6.0, 0.1, 0.2, -0.3]
    commands = []
    for frames in ({}, {"X_ES": X_TE.inverse()}):
        controller = controller_with(frames=frames)
        context = start(controller, target_pose=pose_at(Q0), sensor_wrench=message)
        commands.append(run(controller, context, 50))
    np.testing.assert_array_equal(commands[0], commands[1])


def moved(X, translation, rpy=(0.0, 0.0, 0.0)):
    """Returns X moved and turned along and about the axes of its parent."""
    turn = RollPitchYaw(*rpy).ToRotationMatrix()
    return RigidTransform(turn @ X.rotation(), X.translation() + translation)


INPUTS = {
    "target_pose": moved(pose_at(Q0), [0.01, 0.02, -0.03], (0.1, 0.05, -0.1)),
    "sensor_wrench": [3.0, -5.0, 8.0, 0.3, 0.1, -0.4],
}


def commands_of(inputs=None, **config):
    controller = controller_with(**config)
    return run(controller, start(controller, **(inputs or INPUTS)), 150)


def test_parallel_mode_with_full_selection_is_the_spring_alone():
    parallel = commands_of(mode="parallel", selection=[1.0] * 6)
    spring = commands_of({"target_pose": INPUTS["target_pose"]}, mode="compliance")
    np.testing.assert_allclose(parallel, spring, rtol=0, atol=1e-13)


def test_parallel_mode_without_selection_is_force_control():
    parallel = commands_of(mode="parallel", selection=[0.0] * 6)
    np.testing.assert_allclose(parallel, commands_of(mode="force"), rtol=0, atol=1e-13)


def test_parallel_mode_weighs_spring_and_force_along_the_axes_of_the_base():
    # At rest S K dz = (1 - S) F.
    controller = controller_with(
        mode="parallel",
        dead_zones=False,
        selection=[1.0, 1.0, 0.25, 1.0, 1.0, 1.0],
        frames={"X_ES": RigidTransform()},
    )
    X_BE = pose_at(Q0)
    force_E = X_BE.rotation().matrix().T @ [4.0, -4.0, 5.0]
    context = start(controller, target_pose=X_BE, sensor_wrench=[*force_E, 0, 0, 0])
    run(controller, context, 2500)
    displacement = commanded_pose(controller, context).translation() - X_BE.translation()
    np.testing.assert_allclose(displacement, [0.0, 0.0, 3.0 * 5.0 / 500.0], rtol=0, atol=1e-10)


def test_motion_mode_is_compliance_with_unit_stiffness_and_no_wrench():
    gains = {"p_gains": [20.0] * 3 + [5.0] * 3, "iterations": 3}
    motion = commands_of(mode="motion", **gains)
    unit_spring = commands_of(
        {"target_pose": INPUTS["target_pose"]}, mode="compliance", stiffness=[1.0] * 6, **gains
    )
    np.testing.assert_allclose(motion, unit_spring, rtol=0, atol=1e-13)
    assert np.abs(motion[-1] - Q0).max() > 1e-2


def test_force_mode_takes_one_step_whatever_the_iterations():
    np.testing.assert_array_equal(
        commands_of(mode="force", iterations=10), commands_of(mode="force", iterations=1)
    )


@pytest.mark.parametrize(
    ("axis", "stiffness", "grows"),
    [(2, 14000.0, False), (2, 15000.0, True), (5, 340.0, False), (5, 400.0, True)],
)
def test_the_loop_is_stable_up_to_the_stiffness_that_theory_gives(axis, stiffness, grows):
    # reference/fdcc.md, section 7: limits 14.5 kN/m along z and 370 Nm/rad about z.
    values = [500.0, 500.0, 500.0, 20.0, 20.0, 20.0]
    values[axis] = stiffness
    controller = controller_with(
        stiffness=values, frames={"X_EC": RigidTransform(pose_at(Q0).rotation().inverse())}
    )
    offset = np.zeros(6)
    offset[axis] = 5e-4
    target = moved(pose_at(Q0), offset[:3], offset[3:])
    commands = run(controller, start(controller, target_pose=target), 1000)
    ripple = np.abs(np.diff(commands, axis=0)).max(axis=1)
    assert (ripple[-100:].max() > 1.5 * ripple[100:200].max()) == grows
    if not grows:
        assert ripple[-100:].max() < 0.5 * ripple[100:200].max()


def test_a_target_far_away_pulls_no_more_than_one_metre_and_one_radian_do():
    X_BE = pose_at(Q0)
    direction, axis = np.array([0.6, 0.0, 0.8]), np.array([2.0, -1.0, 2.0]) / 3.0

    def velocity(distance, angle):
        turn = RotationMatrix(Rotation.from_rotvec(angle * axis).as_matrix())
        target = RigidTransform(turn @ X_BE.rotation(), X_BE.translation() + distance * direction)
        controller = controller_with()
        return step(controller, start(controller, target_pose=target))[1]

    np.testing.assert_allclose(velocity(3.0, 2.5), velocity(1.0, 1.0), rtol=1e-12)
    # Half a turn has two axes; the one whose largest component is positive is taken.
    np.testing.assert_allclose(velocity(0.5, math.pi), velocity(0.5, 1.0), rtol=1e-9)
    np.testing.assert_allclose(velocity(0.5, -math.pi), velocity(0.5, 1.0), rtol=1e-9)
    np.testing.assert_allclose(velocity(0.5, -3.0), velocity(0.5, -1.0), rtol=1e-9)


def test_commands_stay_within_the_joint_limits_and_a_joint_without_range_stays():
    chain = ur5e_chain(X_TE)
    joints = list(chain.joints)
    joints[1] = dc.replace(joints[1], lower=Q0[1] - 0.005, upper=Q0[1] + 0.005)
    joints[4] = dc.replace(joints[4], lower=Q0[4], upper=Q0[4])
    chain = dc.replace(chain, joints=tuple(joints))
    controller = controller_with(chain)
    target = moved(pose_at(Q0), [0.02, -0.05, -0.1], (0.2, 0.1, 0.0))
    commands = run(controller, start(controller, target_pose=target), 200)
    assert commands[:, 1].min() >= Q0[1] - 0.005 and commands[:, 1].max() <= Q0[1] + 0.005
    assert np.abs(commands[:, 1] - Q0[1]).max() == pytest.approx(0.005, abs=1e-12)
    np.testing.assert_array_equal(commands[:, 4], np.full(200, Q0[4]))
    assert np.abs(commands[-1, 0] - Q0[0]) > 0.01


def test_the_elbow_alone_is_limited_to_half_a_turn():
    limits = [(joint.lower, joint.upper) for joint in ur5e_chain(X_TE).joints]
    turn = (-2 * math.pi, 2 * math.pi)
    assert limits == [turn, turn, (-math.pi, math.pi), turn, turn, turn]


def test_an_end_effector_that_is_itself_a_link_has_no_link_mass():
    fixed = ur5e_chain(X_TE)
    link = dc.replace(fixed, X_LE=None)
    for chain, mass in ((fixed, 1.6), (link, 1.5)):
        plant = make_virtual_model(chain, 0.1)
        assert plant.CalcTotalMass(plant.CreateDefaultContext()) == pytest.approx(mass)
    assert pose_at(Q0, link).IsNearlyEqualTo(pose_at(Q0) @ X_TE.inverse(), 1e-12)


def test_activation_starts_at_rest_at_the_measured_joints():
    controller = controller_with()
    context = start(controller, **INPUTS)
    run(controller, context, 30)
    elsewhere = Q0 + 0.2
    fix_inputs(controller, context, {"joint_positions": elsewhere})
    controller.ExecuteInitializationEvents(context)
    outputs = [
        controller.GetOutputPort(f"joint_{name}_command").Eval(context)
        for name in ("positions", "velocities")
    ]
    np.testing.assert_array_equal(outputs[0], elsewhere)
    np.testing.assert_array_equal(outputs[1], np.zeros(6))


def test_an_input_changes_the_velocity_at_once_and_the_positions_one_update_later():
    controller = controller_with()
    context = start(controller, **INPUTS)
    q, v = step(controller, context)
    np.testing.assert_array_equal(q, Q0)
    assert np.abs(v).max() > 1e-3
    q_next, _ = step(controller, context, joint_positions=q)
    np.testing.assert_allclose(q_next, q + 0.02 * v, rtol=0, atol=1e-16)


def test_in_a_simulation_it_updates_each_period_and_feeds_nothing_through():
    controller = controller_with(frames={"X_WB": X_WB})
    builder = DiagramBuilder()
    builder.AddSystem(controller)
    robot = builder.AddSystem(ZeroOrderHold(0.002, 6))
    builder.Connect(controller.GetOutputPort("joint_positions_command"), robot.get_input_port())
    builder.Connect(robot.get_output_port(), controller.GetInputPort("joint_positions"))
    simulator = Simulator(builder.Build())
    context = controller.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    target = X_WB @ INPUTS["target_pose"]
    fix_inputs(controller, context, INPUTS | {"target_pose": target})
    robot.SetVectorState(robot.GetMyMutableContextFromRoot(simulator.get_mutable_context()), Q0)
    simulator.Initialize()
    assert commanded_pose(controller, context).IsNearlyEqualTo(X_WB @ pose_at(Q0), 1e-12)
    # The robot takes over a command at the update after the one that made it, so its first
    # measurements are those of an ideal robot one update late.
    simulator.AdvanceTo(0.0995)

    alone = controller_with()
    expected = start(alone, **INPUTS)
    q_now = q_next = Q0
    for _ in range(50):
        q_now, q_next = q_next, step(alone, expected, joint_positions=q_now)[0]
    command = controller.GetOutputPort("joint_positions_command").Eval(context)
    np.testing.assert_allclose(command, q_next, rtol=0, atol=1e-13)
    assert not controller.HasAnyDirectFeedthrough()


def test_contexts_of_one_controller_do_not_disturb_each_other():
    controller = controller_with(iterations=2)
    other_inputs = {"target_pose": moved(pose_at(Q0), [-0.03, 0.01, 0.02])}
    starts = (
        lambda: start(controller, **INPUTS),
        lambda: start(controller, NEAR_SINGULAR, **other_inputs),
    )
    alone = [run(controller, make(), 60) for make in starts]

    contexts = [make() for make in starts]
    # A clone taken in mid-run goes on by itself.
    interleaved: list[list[np.ndarray]] = [[], []]
    for cycle in range(60):
        for context, commands in zip(contexts, interleaved, strict=True):
            commands.append(run(controller, context, 1)[0])
            fix_inputs(controller, context, {"joint_positions": commands[-1]})
        if cycle == 29:
            clone = contexts[0].Clone()
    np.testing.assert_array_equal(interleaved, alone)
    np.testing.assert_array_equal(run(controller, clone, 30), alone[0][30:])

    with ThreadPoolExecutor(2) as pool:
        threaded = list(pool.map(lambda make: run(controller, make(), 60), starts))
    np.testing.assert_array_equal(threaded, alone)


@pytest.mark.parametrize("mode", ["compliance", "parallel"])
def test_a_port_that_is_not_connected_takes_the_value_of_the_configuration(mode):
    values = {
        "stiffness": [900.0, 700.0, 600.0, 25.0, 15.0, 10.0],
        "p_gains": [0.03, 0.04, 0.05, 1.0, 1.2, 1.4],
        "d_gains": [0.001] * 6,
        "selection": [0.9, 0.8, 0.7, 0.6, 0.5, 0.4],
        "error_scale": 0.7,
    }
    ports = {name: np.atleast_1d(value) for name, value in values.items()}
    configured = commands_of(mode=mode, **values)
    connected = commands_of(INPUTS | ports | {"target_wrench": np.zeros(6)}, mode=mode)
    np.testing.assert_array_equal(configured, connected)
    for name, value in values.items():
        if name != "selection" or mode == "parallel":
            halved = {name: np.multiply(value, 0.5).tolist()}
            assert np.abs(commands_of(mode=mode, **(values | halved)) - configured).max() > 1e-6


def test_settings_may_change_at_any_update():
    controller = controller_with()
    context = start(controller, **INPUTS)
    run(controller, context, 10)
    clone = context.Clone()
    same = run(controller, context, 10)
    changed = run(controller, clone, 10, stiffness=[2000.0] * 3 + [20.0] * 3)
    assert np.abs(changed - same).max() > 1e-4


def test_the_configuration_is_read_at_construction_alone():
    config = ComplianceControllerConfig()
    controller = ComplianceController(config, ur5e_chain(X_TE))
    expected = commands_of()
    config.stiffness[0] = config.error_scale = 0.0
    np.testing.assert_array_equal(run(controller, start(controller, **INPUTS), 150), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "admittance"}, r"compliance_controller\.mode: 'admittance' is not one of"),
        ({"period": 2.0}, r"compliance_controller\.period: 2 s .*in ms\? Write 0\.002"),
        ({"iterations": 0}, r"compliance_controller\.iterations: 0 is not within \[1, 100\]"),
        ({"stiffness": [500.0] * 3}, r"compliance_controller\.stiffness: has 3 values.*Give 6"),
        ({"p_gains": [0.1] * 5 + [-1.0]}, r"compliance_controller\.p_gains\[5\]: -1 "),
        ({"selection": [1.5] + [0.0] * 5}, r"compliance_controller\.selection\[0\]: 1\.5 "),
        ({"error_scale": math.nan}, r"compliance_controller\.error_scale: is nan"),
        ({"link_mass": 0.0}, r"compliance_controller\.link_mass: 0 kg"),
    ],
)
def test_a_wrong_configuration_is_refused_with_field_and_range(change, message):
    with pytest.raises(ConfigurationError, match=message):
        controller_with(**change)


def test_a_chain_that_cannot_move_is_refused():
    with pytest.raises(ConfigurationError, match=r"chain\.joints.*no joints"):
        controller_with(KinematicChain(joints=()))
    backwards = ChainJoint("wrist", RigidTransform(), lower=1.0, upper=-1.0)
    with pytest.raises(ConfigurationError, match=r"chain\.joints\[0\].*limits of wrist.*\[1, -1\]"):
        controller_with(KinematicChain(joints=(backwards,)))


def test_a_missing_target_pose_is_named_unless_the_mode_needs_none():
    controller = controller_with()
    with pytest.raises(Exception, match="target_pose"):
        step(controller, start(controller))
    force = controller_with(mode="force")
    q, _ = step(force, start(force))
    np.testing.assert_array_equal(q, Q0)


def test_an_input_that_is_not_finite_stops_the_simulation_with_time_and_cause():
    controller = controller_with()
    context = start(controller, **(INPUTS | {"sensor_wrench": [math.nan] * 6}))
    context.SetTime(1.25)
    with pytest.raises(RuntimeError, match=r"no finite acceleration at t = 1\.25 s.*not finite"):
        step(controller, context)
