"""Joint positions that put the knife where a scenario starts."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.solvers import Solve

from sliceit_drake.configuration import ConfigurationError

__all__ = ["solve_start_joints"]

POSITION_TOLERANCE = 1e-6
ANGLE_TOLERANCE = 1e-6


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
    ik = InverseKinematics(plant)
    world, K = plant.world_frame(), knife.body_frame()
    p_WK = X_WK.translation()
    slack = np.full(3, 0.5 * POSITION_TOLERANCE)
    ik.AddPositionConstraint(K, np.zeros(3), world, p_WK - slack, p_WK + slack)
    ik.AddOrientationConstraint(
        world, X_WK.rotation(), K, RotationMatrix.Identity(), 0.5 * ANGLE_TOLERANCE
    )
    program = ik.prog()
    program.AddQuadraticErrorCost(np.eye(6), guess, ik.q())
    result = Solve(program, guess)
    q = result.GetSolution(ik.q())
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    X_WK_found = plant.EvalBodyPoseInWorld(context, knife)
    missed = float(np.linalg.norm(X_WK_found.translation() - p_WK))
    if not result.is_success() or missed > 1e-4:
        raise ConfigurationError(
            f"the arm cannot put the knife at {np.round(p_WK, 4).tolist()} m; it comes "
            f"within {1e3 * missed:.3g} mm",
            field="scenario.placement and scenario.start",
            fix="Place the food nearer to the robot's base (reach of the knife: about 0.85 m), or "
            "give robot.joint_positions near a posture that reaches it.",
        )
    return q
