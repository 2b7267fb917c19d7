"""Kinematic chains of revolute joints, that of the UR5e, and the virtual arm along a chain."""

import dataclasses as dc
import math

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia

from sliceit_drake.configuration import ConfigurationError

__all__ = ["ChainJoint", "KinematicChain", "make_virtual_model", "ur5e_chain", "virtual_bodies"]

_END_EFFECTOR = "end_effector"

# Virtual mass [kg] and moment of inertia [kg m2] of the end effector, moment of inertia of a link.
_END_EFFECTOR_MASS = 1.0
_END_EFFECTOR_INERTIA = 1.0
_LINK_INERTIA = 1e-6


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

    Raises:
        ConfigurationError: If there are no joints, or a joint's limits are the wrong way round.
    """

    joints: tuple[ChainJoint, ...]
    X_LE: RigidTransform | None = None

    def __post_init__(self) -> None:
        if not self.joints:
            raise ConfigurationError(
                "the chain has no joints", field="chain.joints", fix="Give one."
            )
        for index, joint in enumerate(self.joints):
            if not joint.lower <= joint.upper:
                raise ConfigurationError(
                    f"the limits of {joint.name} are [{joint.lower:.6g}, {joint.upper:.6g}] rad",
                    field=f"chain.joints[{index}]",
                    fix="Give lower <= upper.",
                )


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


def make_virtual_model(chain: KinematicChain, link_mass: float) -> MultibodyPlant:
    """Makes the arm that FDCC moves instead of the real one.

    A point-like mass sits at the origin of every link that a joint moves, and 1 kg with 1 kg m2
    about every axis at the end effector. There is no gravity. If the last link is itself the end
    effector, it has the end effector's inertia alone.

    Args:
        chain: The arm; its base B is the plant's world frame.
        link_mass: Mass [kg] of each moving link.

    Returns:
        The finalized plant, one position [rad] per joint, with a body named ``end_effector``.
    """
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    parent = plant.world_body()
    end_effector_inertia = _inertia(_END_EFFECTOR_MASS, _END_EFFECTOR_INERTIA)
    for index, joint in enumerate(chain.joints):
        is_end_effector = chain.X_LE is None and index == len(chain.joints) - 1
        link = plant.AddRigidBody(
            _END_EFFECTOR if is_end_effector else joint.name,
            end_effector_inertia if is_end_effector else _inertia(link_mass, _LINK_INERTIA),
        )
        mount = FixedOffsetFrame(f"{joint.name}_mount", parent.body_frame(), joint.X_PL)
        plant.AddJoint(
            RevoluteJoint(
                f"{joint.name}_joint", plant.AddFrame(mount), link.body_frame(), [0.0, 0.0, 1.0]
            )
        )
        parent = link
    if chain.X_LE is not None:
        end_effector = plant.AddRigidBody(_END_EFFECTOR, end_effector_inertia)
        plant.WeldFrames(parent.body_frame(), end_effector.body_frame(), chain.X_LE)
    plant.Finalize()
    return plant


def _inertia(mass: float, moment: float) -> SpatialInertia:
    """Returns the inertia of a body with equal moments [kg m2] about its origin."""
    return SpatialInertia(mass, np.zeros(3), UnitInertia.TriaxiallySymmetric(moment / mass))


def virtual_bodies(chain: KinematicChain, link_mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Masses [n + 1], kg, and moments of inertia, kg m2, of the virtual links and end effector."""
    n = len(chain.joints)
    mass = np.array([link_mass] * n + [_END_EFFECTOR_MASS])
    moment = np.array([_LINK_INERTIA] * n + [_END_EFFECTOR_INERTIA])
    if chain.X_LE is None:
        # The end effector stands for the last link.
        mass[-2] = moment[-2] = 0.0
    return mass, moment
