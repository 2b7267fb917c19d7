"""A prescribed motion of the knife as a Drake system."""

from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import Context

from sliceit_drake.cutting.motion import Motion, MotionPlan, Pose
from sliceit_drake.systems.declare import PlainSystem, declare_output

__all__ = ["MotionSource", "placed_motion"]


def placed_motion(plan: MotionPlan, X_WK: RigidTransform) -> Motion:
    """A plan from a start pose of the knife on, as `Motion`."""
    return Motion(plan, Pose(X_WK.rotation().matrix(), X_WK.translation()))


class MotionSource(PlainSystem):
    """A prescribed motion as a source of targets: pose and velocity of the knife over time.

    It has no inputs and no state.

    Args:
        plan: The segments of the motion.
        X_WK: Pose of the knife at time 0. A plan that begins with a record placed in the world
            starts from the record's first pose instead.

    Outputs:
        target_pose: RigidTransform X_WK.
        target_velocity: SpatialVelocity V_WK of the knife frame K in W.

    Attributes:
        motion: The motion; its `phase_at` names the phase at a time.

    Raises:
        ConfigurationError: If the plan is invalid, or a record in it is.
    """

    def __init__(self, plan: MotionPlan, X_WK: RigidTransform) -> None:
        super().__init__()
        self.motion = placed_motion(plan, X_WK)
        # The rotation in the last pose asked for, as the motion has it and as Drake's: a motion
        # that does not turn gives one array, and Drake checks each that it is given.
        self._turned = X_WK.rotation().matrix(), X_WK.rotation()
        pose, velocity = Value(RigidTransform()), Value(SpatialVelocity.Zero())
        time = {self.time_ticket()}
        declare_output(self, "target_pose", pose, self._target_pose, time)
        declare_output(self, "target_velocity", velocity, self._target_velocity, time)

    def _target_pose(self, context: Context) -> RigidTransform:
        pose = self.motion.pose(context.get_time())
        R, R_WK = self._turned
        if pose.R is not R:
            R_WK = RotationMatrix(pose.R)
            self._turned = pose.R, R_WK
        return RigidTransform(R_WK, pose.p)

    def _target_velocity(self, context: Context) -> SpatialVelocity:
        velocity = self.motion.velocity(context.get_time())
        return SpatialVelocity(velocity.w, velocity.v)
