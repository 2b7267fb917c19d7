"""Kernels of a coupling step: the knife's motion in its sub-steps, and what they add up to.

In double precision whatever the scalars of the sub-steps.
"""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.layouts import (
    ACCUMULATED,
    BLADE_SUMS,
    NODE_SUMS,
    POINT_SUMS,
    first,
)
from sliceit_drake.cutting.kernels.types import kernel_types

__all__ = ["coupling_kernels"]


def coupling_kernels(real: Any, module: str) -> types.SimpleNamespace:
    """The kernels for sub-steps with scalars `real`, in the Warp module `module`."""
    t = kernel_types(real)
    vec3, vec4, mat33 = t.vec3, t.vec4, t.mat33
    vec3d, mat33d, float64 = wp.vec3d, wp.mat33d, wp.float64
    FORCES, MOMENTS, BURIED_MOMENT, BURIED_AREA = map(
        wp.constant, first(POINT_SUMS, "forces", "moments", "buried_moment", "buried_area")
    )
    BOARD_FORCE, BOARD_LOSS = map(wp.constant, first(NODE_SUMS, "board_force", "board_loss"))
    ON_KNIFE, ON_BLADE = map(wp.constant, first(BLADE_SUMS, "on_knife", "on_blade"))

    @wp.func
    def to_real(a: vec3d):
        return vec3(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def rates(
        R: wp.array2d(dtype=mat33d),
        p: wp.array2d(dtype=vec3d),
        cut: wp.int32,
        e: wp.int32,
        period: float64,
    ):
        """Velocity of Ko and angular velocity in a coupling step."""
        # R - R^T holds twice the axis times the sine.
        turn = R[cut, e + 1] * wp.transpose(R[cut, e])
        twice = vec3d(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
        return (p[cut, e + 1] - p[cut, e]) / period, twice * (float64(0.5) / period)

    @wp.kernel(enable_backward=False, module=module)
    def move_knife(
        R: wp.array2d(dtype=mat33d),
        p: wp.array2d(dtype=vec3d),
        substeps: wp.int32,
        period: float64,
        R_CK: wp.array2d(dtype=mat33),
        p_CK: wp.array2d(dtype=vec3),
        v_CK: wp.array2d(dtype=vec3),
        w_CK: wp.array2d(dtype=vec3),
    ):
        """Knife poses at the ends of the sub-steps, from those at the ends of the coupling steps.

        Velocity and rotation rate are constant in a coupling step. Rotation matrices are
        interpolated
        linearly: for a turn of angle a between coupling steps they are orthonormal to a^2 / 8, 1e-6
            at 1 rad/s and 2 ms."""
        cut, k = wp.tid()
        e = k / substeps
        share = float64(k - e * substeps + 1) / float64(substeps)
        rotation = R[cut, e] + share * (R[cut, e + 1] - R[cut, e])
        rounded = mat33()
        for a in range(3):
            for b in range(3):
                rounded[a, b] = real(rotation[a, b])
        R_CK[cut, k] = rounded
        v, w = rates(R, p, cut, e, period)
        p_CK[cut, k] = to_real(p[cut, e] + share * (p[cut, e + 1] - p[cut, e]))
        v_CK[cut, k] = to_real(v)
        w_CK[cut, k] = to_real(w)

    @wp.kernel(enable_backward=False, module=module)
    def add_points(
        total: wp.array4d(dtype=real),
        immersed: wp.array3d(dtype=vec4),
        sums: wp.array3d(dtype=float64),
    ):
        """Sums of `total` and `immersed` over the cut points, a thread for each column."""
        cut, e, j = wp.tid()
        s = float64(0.0)
        for i in range(total.shape[2]):
            if j < ACCUMULATED:
                s += float64(total[cut, e, i, j])
            else:
                s += float64(immersed[cut, e, i][j - ACCUMULATED])
        sums[cut, e, j] = s

    @wp.kernel(enable_backward=False, module=module)
    def add_nodes(
        board_force: wp.array2d(dtype=vec3),
        board_loss: wp.array2d(dtype=real),
        internal_work: wp.array2d(dtype=real),
        sums: wp.array2d(dtype=float64),
    ):
        """Sums over the nodes, see `NODE_SUMS`; a thread for each."""
        cut, j = wp.tid()
        s = float64(0.0)
        for i in range(board_loss.shape[1]):
            if j < BOARD_LOSS:
                s += float64(board_force[cut, i][j - BOARD_FORCE])
            elif j == BOARD_LOSS:
                s += float64(board_loss[cut, i])
            else:
                s += float64(internal_work[cut, i])
        sums[cut, j] = s

    @wp.kernel(enable_backward=False, module=module)
    def knife_wrenches(
        sums: wp.array3d(dtype=float64),
        blade_sums: wp.array3d(dtype=real),
        R: wp.array2d(dtype=mat33d),
        p: wp.array2d(dtype=vec3d),
        substeps: wp.int32,
        period: float64,
        blade: wp.array3d(dtype=float64),
        wrenches: wp.array4d(dtype=float64),
        work: wp.array2d(dtype=float64),
    ):
        """Mean wrenches on the knife in each coupling step, moment about Ko and force, and its
        work.

        By edge, flank pressure with the blade's bending, friction. Moments are about Ko at each
        sub-step; its mean position is half a period back.
        """
        cut, e = wp.tid()
        n = float64(substeps)
        for c in range(3):
            blade[cut, e, c] = float64(blade_sums[cut, e, c])
        # The flanks push the blade, and the blade's spring and damper the knife's body. The
        # difference acts at the middle of the buried flanks.
        end = R[cut, e + 1]
        push = (blade[cut, e, ON_KNIFE] - blade[cut, e, ON_BLADE]) / n
        lateral = push * vec3d(end[0, 1], end[1, 1], end[2, 1])
        area = sums[cut, e, BURIED_AREA]
        moment = vec3d()
        if area > float64(0.0):
            middle = vec3d()
            for c in range(3):
                middle[c] = sums[cut, e, BURIED_MOMENT + c]
            moment = wp.cross(middle / area, lateral)
        v, w = rates(R, p, cut, e, period)
        power = float64(0.0)
        for m in range(3):
            for c in range(3):
                M = sums[cut, e, MOMENTS + 3 * m + c] / n
                F = sums[cut, e, FORCES + 3 * m + c] / n
                if m == 1:
                    M += moment[c]
                    F += lateral[c]
                wrenches[cut, e, m, c] = M
                wrenches[cut, e, m, 3 + c] = F
                power += F * v[c] + M * w[c]
        work[cut, e] = -power * period

    return types.SimpleNamespace(
        move_knife=move_knife,
        add_points=add_points,
        add_nodes=add_nodes,
        knife_wrenches=knife_wrenches,
    )
