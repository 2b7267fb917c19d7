"""The kernel of compliance control: the dynamics of Drake's plant, rooms that share nothing."""

import copy

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import JacobianWrtVariable

from sliceit_drake.systems.compliance_controller import (
    ComplianceController,
    ComplianceControllerConfig,
    ComplianceUpdate,
)
from sliceit_drake.systems.ur5e_kinematics import (
    ChainJoint,
    KinematicChain,
    make_virtual_model,
    ur5e_chain,
)

LINK_MASS = 0.3
FORCE_LAW = ComplianceControllerConfig(
    mode="force", link_mass=LINK_MASS, error_scale=1.0, p_gains=[1.0] * 6, d_gains=[0.0] * 6
)


def random_pose(rng):
    return RigidTransform(RollPitchYaw(rng.uniform(-3.0, 3.0, 3)), rng.uniform(-0.5, 0.5, 3))


def random_chain(rng, joints, end_effector_is_a_link=False):
    return KinematicChain(
        joints=tuple(ChainJoint(f"link_{k}", random_pose(rng)) for k in range(joints)),
        X_LE=None if end_effector_is_a_link else random_pose(rng),
    )


def plant_pose_and_acceleration(chain, q, force):
    """X_BE, and H^-1 J^T of a force on E in E's axes [6], moment first, after Drake's plant."""
    plant = make_virtual_model(chain, LINK_MASS)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    E, B = plant.GetFrameByName("end_effector"), plant.world_frame()
    X_BE = E.CalcPoseInWorld(context)
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, E, np.zeros(3), B, B)
    force_B = np.kron(np.eye(2), X_BE.rotation().matrix()) @ force
    return X_BE, np.linalg.solve(plant.CalcMassMatrix(context), J.T @ force_B)


@pytest.mark.parametrize(
    ("joints", "end_effector_is_a_link"),
    [(1, False), (2, True), (6, False), (6, True), (7, False), (9, True)],
)
def test_an_arm_of_any_joints_moves_as_its_multibody_plant_does(joints, end_effector_is_a_link):
    rng = np.random.default_rng(joints)
    for _ in range(10):
        chain = random_chain(rng, joints, end_effector_is_a_link)
        q, force = rng.uniform(-3.0, 3.0, joints), rng.normal(size=6) * ([1.0] * 3 + [5.0] * 3)
        controller = ComplianceController(FORCE_LAW, chain, X_ES=RigidTransform())
        context = controller.CreateDefaultContext()
        controller.GetInputPort("joint_positions").FixValue(context, q)
        wrench = Value(SpatialForce(force[:3], force[3:]))
        controller.GetInputPort("sensor_wrench").FixValue(context, wrench)
        controller.ExecuteInitializationEvents(context)
        context.SetDiscreteState(controller.EvalUniquePeriodicDiscreteUpdate(context))
        velocity = controller.GetOutputPort("joint_velocities_command").Eval(context)
        X_BE, acceleration = plant_pose_and_acceleration(chain, q, force)
        # From rest, in one step.
        expected = FORCE_LAW.damping_factor * FORCE_LAW.virtual_time_step * acceleration
        np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        pose = controller.GetOutputPort("commanded_pose").Eval(context)
        np.testing.assert_allclose(pose.GetAsMatrix34(), X_BE.GetAsMatrix34(), rtol=0, atol=1e-13)


def motion_room():
    config = ComplianceControllerConfig(mode="motion", iterations=3, link_mass=0.1)
    return ComplianceUpdate(config, ur5e_chain(RigidTransform([0.0, 0.0, 0.15])), np.eye(3))


Q0 = np.array([1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493])


def fill(room):
    room.q[:] = room.measured[:] = Q0
    room.v[:], room.error[:] = 0.1, 0.0
    room.target[:] = np.eye(3, 4)
    room.settings[2] = 5.0


def state(room):
    return np.concatenate([room.q, room.v, room.error.ravel()])


def test_a_run_repeats_bit_for_bit_and_takes_nothing_from_the_one_before():
    room = motion_room()
    fill(room)
    assert room.run()
    first = state(room)
    assert np.abs(room.q - Q0).max() > 1e-3
    # Another update in between, one that fails.
    room.v[:] = np.nan
    room.settings[:] = np.nan
    room.run()
    fill(room)
    room.settings[3] = 0.0
    assert room.run()
    np.testing.assert_array_equal(state(room), first)


def test_a_deep_copy_is_a_room_of_its_own_for_the_same_law():
    room = motion_room()
    fill(room)
    other = copy.deepcopy(room)
    fill(other)
    other.measured[:] += 0.1
    before = state(room)
    assert other.run()
    np.testing.assert_array_equal(state(room), before)
    fill(other)
    assert other.run() and room.run()
    np.testing.assert_array_equal(state(other), state(room))


def test_an_acceleration_that_is_not_finite_is_told_and_stops_the_update():
    room = motion_room()
    fill(room)
    room.settings[2, 1, 0] = np.inf
    assert not room.run()
    np.testing.assert_array_equal(room.q, Q0)
    assert not np.isfinite(room.u).all() and np.isfinite(room.v).all()
    fill(room)
    assert room.run()
