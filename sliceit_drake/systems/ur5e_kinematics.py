"""Kinematic chains of revolute joints, and the chain of the UR5e."""

import dataclasses as dc
import math

from pydrake.math import RigidTransform, RollPitchYaw

__all__ = ["ChainJoint", "KinematicChain", "ur5e_chain"]


@dc.dataclass(frozen=True)
class ChainJoint:
    """A revolute joint, and the link L that it moves in its parent P.

    Attributes:
        name: Name of the link L.
        X_PL: Pose of L in P at joint angle 0. P is the previous link, or the base B for the first.
            The joint turns L about its own z axis, through its origin.
        lower: Lower position limit [rad]; -inf for a continuous joint.
        upper: Upper position limit [rad]; inf for a continuous joint.
    """

    name: str
    X_PL: RigidTransform
    lower: float = -math.inf
    upper: float = math.inf


@dc.dataclass(frozen=True)
class KinematicChain:
    """A serial chain from the base B to the end effector E.

    Attributes:
        joints: The joints, from base to tip.
        X_LE: Pose of the end effector E in the last link L, to which it is fixed; None if the last
            link itself is the end effector.
    """

    joints: tuple[ChainJoint, ...]
    X_LE: RigidTransform | None = None


def ur5e_chain(X_TE: RigidTransform) -> KinematicChain:
    """Returns the chain of a UR5e from UR's "Base" to an end effector on the tool flange.

    The lengths are those of the UR5e in Universal Robots' "DH parameters for calculations of
    kinematics and dynamics"; the link frames are those of Universal_Robots_ROS2_Description
    (config/ur5e/default_kinematics.yaml), in which the mass of a virtual link sits on its own
    joint's axis. The limits are those of its config/ur5e/joint_limits.yaml: one turn either way,
    half a turn for the elbow. UR's "Base" is the URDF's ``base_link`` turned by pi about z.

    Args:
        X_TE: Pose of the end effector E (the knife frame K) in the flange frame T (``tool0``).

    Returns:
        The chain; its last link is ``wrist_3_link``, whose frame is T.
    """
    quarter_turn, half_turn, turn = 0.5 * math.pi, math.pi, 2.0 * math.pi

    def pose(rpy: tuple[float, float, float], xyz: tuple[float, float, float]) -> RigidTransform:
        return RigidTransform(RollPitchYaw(*rpy), xyz)

    return KinematicChain(
        joints=(
            ChainJoint("shoulder_link", pose((0, 0, 0), (0, 0, 0.1625)), -turn, turn),
            ChainJoint("upper_arm_link", pose((quarter_turn, 0, 0), (0, 0, 0)), -turn, turn),
            ChainJoint("forearm_link", pose((0, 0, 0), (-0.425, 0, 0)), -half_turn, half_turn),
            ChainJoint("wrist_1_link", pose((0, 0, 0), (-0.3922, 0, 0.1333)), -turn, turn),
            ChainJoint("wrist_2_link", pose((quarter_turn, 0, 0), (0, -0.0997, 0)), -turn, turn),
            ChainJoint(
                "wrist_3_link",
                pose((quarter_turn, half_turn, half_turn), (0, 0.0996, 0)),
                -turn,
                turn,
            ),
        ),
        X_LE=X_TE,
    )
