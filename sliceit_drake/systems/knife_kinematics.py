"""Pose, velocity and board contact of the knife, read from the plant's ports."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import FramePoseVector
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context

from sliceit_drake.systems.declare import PlainSystem, declare_output

__all__ = ["BoardContact", "KnifeKinematics"]

NEAR_BOARD = 1e-3

_NO_WRENCH = np.zeros(6)
_NO_WRENCH.setflags(write=False)


class KnifeKinematics(PlainSystem):
    """Picks the knife from what the plant says of all bodies.

    Input ports:
        geometry_pose: FramePoseVector of the plant; it gives one pose alone.
        body_velocities: list[SpatialVelocity] of the plant.

    Output ports:
        knife_pose: RigidTransform X_WK.
        knife_velocity: SpatialVelocity V_WK.

    Args:
        plant: The plant, with the knife's geometry.
        knife: The knife's body, whose frame is K.
    """

    def __init__(self, plant: MultibodyPlant, knife: RigidBody) -> None:
        super().__init__()
        index = int(knife.index())
        frame = plant.GetBodyFrameIdOrThrow(knife.index())
        poses = self.DeclareAbstractInputPort("geometry_pose", Value(FramePoseVector()))
        velocities = self.DeclareAbstractInputPort(
            "body_velocities", Value[list[SpatialVelocity]]()
        )
        declare_output(
            self,
            "knife_pose",
            Value(RigidTransform()),
            lambda context: poses.Eval(context).value(frame),
            {poses.ticket()},
        )
        declare_output(
            self,
            "knife_velocity",
            Value(SpatialVelocity.Zero()),
            lambda context: velocities.Eval(context)[index],
            {velocities.ticket()},
        )


class BoardContact(PlainSystem):
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
        self._knife_body = int(knife_body)
        self._half_length = 0.5 * edge_length
        self._near_height = board_height + NEAR_BOARD
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        seen = {self._results.ticket(), self._pose.ticket()}
        declare_output(
            self,
            "board_wrench",
            Value(SpatialForce.Zero()),
            lambda context: SpatialForce(self._wrench(context)),
            seen,
        )
        declare_output(self, "board_wrench_vector", 6, self._wrench, seen)

    def _wrench(self, context: Context) -> np.ndarray:
        X_WK = self._pose.Eval(context).GetAsMatrix34()
        lowest = X_WK[2, 3] - abs(X_WK[2, 0]) * self._half_length
        if lowest >= self._near_height:
            return _NO_WRENCH
        # Plain numbers, which cost a fraction of arrays of three.
        results, total = self._results.Eval(context), [0.0] * 6
        ox, oy, oz = X_WK[:, 3].tolist()
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            fx, fy, fz = info.contact_force().tolist()
            # It acts on body B of the pair.
            if int(info.bodyA_index()) == self._knife_body:
                fx, fy, fz = -fx, -fy, -fz
            elif int(info.bodyB_index()) != self._knife_body:
                continue
            x, y, z = info.contact_point().tolist()
            x, y, z = x - ox, y - oy, z - oz
            # By hand, a tenth of the time of `np.cross`.
            one = (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx, fx, fy, fz)
            total = [a + b for a, b in zip(total, one, strict=True)]
        return np.array(total)
