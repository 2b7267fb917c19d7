"""Pose, velocity and board contact of the knife, read from the plant's ports."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem

__all__ = ["BoardContact", "KnifeKinematics"]

NEAR_BOARD = 1e-3


class KnifeKinematics(LeafSystem):
    """Picks the knife from the plant's lists of poses and velocities.

    Input ports:
        body_poses: list[RigidTransform] of the plant.
        body_velocities: list[SpatialVelocity] of the plant.

    Output ports:
        knife_pose: RigidTransform X_WK.
        knife_velocity: SpatialVelocity V_WK.

    Args:
        knife_body: Index of the knife's body, whose frame is K.
    """

    def __init__(self, knife_body: BodyIndex) -> None:
        super().__init__()
        self._index = int(knife_body)
        poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        velocities = self.DeclareAbstractInputPort(
            "body_velocities", Value[list[SpatialVelocity]]()
        )
        self._poses, self._velocities = poses, velocities
        self.DeclareAbstractOutputPort(
            "knife_pose", lambda: Value(RigidTransform()), self._calc_pose, {poses.ticket()}
        )
        self.DeclareAbstractOutputPort(
            "knife_velocity",
            lambda: Value(SpatialVelocity.Zero()),
            self._calc_velocity,
            {velocities.ticket()},
        )

    def _calc_pose(self, context: Context, output: Value) -> None:
        output.set_value(self._poses.Eval(context)[self._index])

    def _calc_velocity(self, context: Context, output: Value) -> None:
        output.set_value(self._velocities.Eval(context)[self._index])


class BoardContact(LeafSystem):
    """Sums the point contacts on the knife in the plant's contact results.

    Input ports:
        contact_results: ContactResults of the plant.
        knife_pose: RigidTransform X_WK.

    Output ports:
        board_wrench: SpatialForce F_K_W of the board on the knife, at Ko, in W.
        board_wrench_vector: `board_wrench` as moment and force [6].

    The plant computes contact results by solving its step once more, so they are asked for only
    when the edge is near the board.

    Args:
        knife_body: Index of the knife's body.
        edge_length: Length of the knife's edge, metres.
        board_height: Height of the board in the world, metres.
    """

    def __init__(self, knife_body: BodyIndex, edge_length: float, board_height: float) -> None:
        super().__init__()
        self._knife_body = knife_body
        self._half_length = 0.5 * edge_length
        self._near_height = board_height + NEAR_BOARD
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort(
            "board_wrench",
            lambda: Value(SpatialForce.Zero()),
            self._calc_wrench,
            {self._results.ticket(), self._pose.ticket()},
        )
        self.DeclareVectorOutputPort(
            "board_wrench_vector",
            6,
            self._calc_vector,
            {self._results.ticket(), self._pose.ticket()},
        )

    def _calc_wrench(self, context: Context, output: Value) -> None:
        wrench = self._wrench(context)
        output.set_value(SpatialForce(wrench[:3], wrench[3:]))

    def _calc_vector(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._wrench(context))

    def _wrench(self, context: Context) -> np.ndarray:
        X_WK = self._pose.Eval(context).GetAsMatrix34()
        lowest = X_WK[2, 3] - abs(X_WK[2, 0]) * self._half_length
        moment, force = np.zeros(3), np.zeros(3)
        if lowest < self._near_height:
            results = self._results.Eval(context)
            for i in range(results.num_point_pair_contacts()):
                info = results.point_pair_contact_info(i)
                # contact_force acts on body B of the pair.
                if info.bodyB_index() == self._knife_body:
                    f = info.contact_force()
                elif info.bodyA_index() == self._knife_body:
                    f = -info.contact_force()
                else:
                    continue
                force += f
                moment += np.cross(info.contact_point() - X_WK[:, 3], f)
        return np.concatenate([moment, force])
