"""Joint positions that put the knife where a scenario starts."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, RigidBody
from pydrake.solvers import Solve

from sliceit_drake.configuration import ConfigurationError

__all__ = ["solve_start_joints"]

POSITION_TOLERANCE = 1e-6
ANGLE_TOLERANCE = 1e-6
ACCEPTED = 1e-4
"""How far from the pose a solution of the solver may be, metres."""
NEWTON_STEPS = 8
LONGEST_STEP = 0.1
"""rad."""


def solve_start_joints(
    plant: MultibodyPlant, knife: RigidBody, X_WK: RigidTransform, guess: np.ndarray
) -> np.ndarray:
    """Joint positions nearest to `guess` that put the knife at a pose.

    Args:
        plant: Finalized plant with the arm alone.
        knife: Body whose frame is K.
        X_WK: Where the knife shall be.
        guess: Joint positions to stay close to [6], rad.

    Returns:
        Joint positions [6], rad.

    Raises:
        ConfigurationError: The pose cannot be reached within the joint limits.
    """
    context, world, K = plant.CreateDefaultContext(), plant.world_frame(), knife.body_frame()
    p_WK = X_WK.translation()

    def pose_error(q: np.ndarray) -> np.ndarray:
        """Rotation vector and translation from the knife at q to X_WK, in W [6], rad and metres."""
        plant.SetPositions(context, q)
        found = plant.EvalBodyPoseInWorld(context, knife)
        turn = (X_WK.rotation() @ found.rotation().inverse()).ToAngleAxis()
        return np.concatenate([turn.angle() * turn.axis(), p_WK - found.translation()])

    ik = InverseKinematics(plant)
    slack = np.full(3, 0.5 * POSITION_TOLERANCE)
    ik.AddPositionConstraint(K, np.zeros(3), world, p_WK - slack, p_WK + slack)
    ik.AddOrientationConstraint(
        world, X_WK.rotation(), K, RotationMatrix.Identity(), 0.5 * ANGLE_TOLERANCE
    )
    program = ik.prog()
    program.AddQuadraticErrorCost(np.eye(6), guess, ik.q())
    result = Solve(program, guess)
    solution = result.GetSolution(ik.q())
    if result.is_success() and np.linalg.norm(pose_error(solution)[3:]) <= ACCEPTED:
        return solution
    # The solver gives up now and then beside a pose, or far from one, that the arm does reach.
    low, high = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    for q in (solution, guess):
        for _ in range(NEWTON_STEPS):
            error = pose_error(q)
            J = plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kQDot, K, np.zeros(3), world, world
            )
            step = np.linalg.lstsq(J, error, rcond=1e-6)[0]
            q = q + step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        error = pose_error(q)
        turned, missed = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        is_within = np.all((q >= low) & (q <= high))
        if missed <= POSITION_TOLERANCE and turned <= ANGLE_TOLERANCE and is_within:
            return q
    raise ConfigurationError(
        f"the arm cannot put the knife at {np.round(p_WK, 4).tolist()} m; it comes "
        f"within {missed:.4f} m and {np.rad2deg(turned):.1f} degrees",
        field="scenario.placement and scenario.start",
        fix="Place the food nearer to the robot's base (reach of the knife: about 0.85 m), or "
        "give robot.joint_positions near a posture that reaches it.",
    )
