"""Kernels of a coupling step: the knife's motion in its sub-steps, and what they add up to.

In double precision whatever the scalars of the sub-steps.
"""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.layouts import Balance, BladeSum, Planned, PointSum
from sliceit_drake.cutting.kernels.types import LANES, kernel_types, mat34d, origin_of, rotation_of

__all__ = ["coupling_kernels"]

LEAST_BURIED = 1e-8
"""Area of buried flanks up to which the moment of a blade that rings fades in, m^2."""


def coupling_kernels(real: Any, module: str) -> types.SimpleNamespace:
    """The kernels for sub-steps with scalars `real`, in the Warp module `module`."""
    t = kernel_types(real)
    vec3, mat33, vec3d, float64 = t.vec3, t.mat33, wp.vec3d, wp.float64
    Motion, Sums, Results = t.Motion, t.Sums, t.Results
    State, Parameters = t.State, t.Parameters
    LEAST_AREA = wp.constant(float64(LEAST_BURIED))

    @wp.func
    def to_real(a: vec3d):
        return vec3(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def rates(motion: Motion, cut: wp.int32, e: wp.int32):
        """Velocity of Ko and angular velocity in a coupling step."""
        # R - R^T holds twice the axis times the sine.
        turn = motion.R[cut, e + 1] * wp.transpose(motion.R[cut, e])
        twice = vec3d(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
        v = (motion.p[cut, e + 1] - motion.p[cut, e]) / motion.period
        return v, twice * (float64(0.5) / motion.period)

    @wp.func
    def micro(v: vec3d):
        """Rounded to 1e-6."""
        scale = float64(1.0e6)
        return vec3d(wp.rint(scale * v[0]), wp.rint(scale * v[1]), wp.rint(scale * v[2])) / scale

    @wp.kernel(enable_backward=False, module=module)
    def move_knife(motion: Motion):
        """Knife poses at the ends of the sub-steps, from those at the ends of the coupling steps.

        Velocity and rotation rate are constant in a coupling step. Rotation matrices are
        interpolated linearly: for a turn of angle a between coupling steps they are orthonormal to
        a^2 / 8, 1e-6 at 1 rad/s and 2 ms.
        """
        cut, k = wp.tid()
        e = k / motion.substeps
        share = float64(k - e * motion.substeps + 1) / float64(motion.substeps)
        R = motion.R[cut, e]
        p = motion.p[cut, e]
        rotation = R + share * (motion.R[cut, e + 1] - R)
        rounded = mat33()
        for a in range(3):
            for b in range(3):
                rounded[a, b] = real(rotation[a, b])
        motion.R_CK[cut, k] = rounded
        v, w = rates(motion, cut, e)
        motion.p_CK[cut, k] = to_real(p + share * (motion.p[cut, e + 1] - p))
        motion.v_CK[cut, k] = to_real(v)
        motion.w_CK[cut, k] = to_real(w)

    @wp.func
    def larger(a: vec3d, b: vec3d):
        return wp.max(wp.length(a), wp.length(b))

    @wp.kernel(enable_backward=False, module=module)
    def plan_steps(
        limits: wp.array(dtype=float64),
        rule: wp.array(dtype=float64),
        X_CA: wp.array(dtype=mat34d),
        X_AK: wp.array(dtype=mat34d),
        stepping: wp.array(dtype=float64),
        R: wp.array(dtype=wp.mat33d),
        p: wp.array(dtype=vec3d),
        numbers: wp.array(dtype=wp.int32),
        after: wp.array2d(dtype=float64),
    ):
        """Poses of the knife in C, and sub-steps of the coupling steps between them, in one thread.

        See `Stepping`; `limits` are travel, change, settling way, settling time, most sub-steps,
        slack, calm; `rule` is half the span, top, coarsest number, by need, period.
        """
        R_CA, p_CA = rotation_of(X_CA[0]), origin_of(X_CA[0])
        for k in range(R.shape[0]):
            R[k] = R_CA * rotation_of(X_AK[k])
            p[k] = R_CA * origin_of(X_AK[k]) + p_CA
        half_span, period = rule[0], rule[4]
        before = vec3d(stepping[0], stepping[1], stepping[2])
        behind = vec3d(stepping[3], stepping[4], stepping[5])
        last, calm = stepping[Planned.SUB_STEP], float64(stepping[Planned.CALM])
        coarsest = wp.int32(rule[2])
        number = coarsest
        if last > float64(0.0):
            doubled = wp.int32(wp.rint(wp.log2(period / last / rule[2])))
            for _k in range(doubled):
                number = number * 2
        for k in range(numbers.shape[0]):
            x0 = half_span * vec3d(R[k][0, 0], R[k][1, 0], R[k][2, 0])
            x1 = half_span * vec3d(R[k + 1][0, 0], R[k + 1][1, 0], R[k + 1][2, 0])
            v0 = ((p[k + 1] - x1) - (p[k] - x0)) / period
            v1 = ((p[k + 1] + x1) - (p[k] + x0)) / period
            speed = larger(v0, v1)
            # What nothing touches is at rest.
            in_air = wp.min(p[k][2], p[k + 1][2]) > rule[1]
            if in_air:
                before = vec3d()
                behind = vec3d()
            # Rounded, so that it is the same whether a state in single precision came between.
            off0 = v0 - micro(before)
            off1 = v1 - micro(behind)
            change = larger(off0, off1)
            way, unsettled = float64(0.0), float64(0.0)
            if rule[3] != float64(0.0) and not in_air:
                way, unsettled = period * speed / limits[0], period * wp.sqrt(change / limits[1])
            least = wp.min(wp.max(way, unsettled), limits[4])
            longer = float64(2.0) * wp.max(way, unsettled / limits[5])
            calm += float64(1.0)
            if number == coarsest or longer >= float64(number):
                calm = float64(0.0)
            if calm > limits[6]:
                number = number / 2
                calm = float64(0.0)
            while float64(number) < least:
                number = number * 2
            keep = wp.exp(-speed * period / limits[2] - period / limits[3])
            before = v0 - keep * off0
            behind = v1 - keep * off1
            numbers[k] = number
            for c in range(3):
                after[k, c] = before[c]
                after[k, 3 + c] = behind[c]
            after[k, Planned.SUB_STEP] = period / float64(number)
            after[k, Planned.CALM] = calm

    @wp.kernel(enable_backward=False, module=module)
    def count(loop: wp.int32, left: wp.array(dtype=wp.int32), done: wp.array(dtype=wp.int32)):
        """Counts a round of a loop, over sub-steps or over coupling steps."""
        left[loop] -= 1
        done[loop] += 1

    @wp.kernel(enable_backward=False, module=module)
    def add_points(sums: Sums, results: Results):
        """Sums over the cut points, a thread for each column."""
        cut, e, j = wp.tid()
        s = float64(0.0)
        for block in range(sums.points.shape[2]):
            for lane in range(LANES):
                s += float64(sums.points[cut, e, block, j][lane])
        results.point_sums[cut, e, j] = s

    @wp.kernel(enable_backward=False, module=module)
    def knife_wrenches(sums: Sums, motion: Motion, results: Results):
        """Mean wrenches on the knife in each coupling step, moment about Ko and force, and its
        work.

        By edge, flank pressure with the blade's bending, friction, in the axes of A. Moments are
        about Ko at each sub-step; its mean position is half a period back.
        """
        cut, e = wp.tid()
        n = float64(motion.substeps)
        for c in range(3):
            results.blade[cut, e, c] = float64(sums.blade[cut, e, c])
        # The flanks push the blade, and the blade's spring and damper the knife's body. The
        # difference acts at the middle of the buried flanks.
        end = motion.R[cut, e + 1]
        on_knife = results.blade[cut, e, BladeSum.ON_KNIFE]
        push = (on_knife - results.blade[cut, e, BladeSum.ON_BLADE]) / n
        lateral = push * vec3d(end[0, 1], end[1, 1], end[2, 1])
        area = wp.max(results.point_sums[cut, e, PointSum.BURIED_AREA], LEAST_AREA)
        middle = vec3d()
        for c in range(3):
            middle[c] = results.point_sums[cut, e, PointSum.BURIED_MOMENT + c]
        moment = wp.cross(middle / area, lateral)
        v, w = rates(motion, cut, e)
        power = float64(0.0)
        for m in range(3):
            M, F = vec3d(), vec3d()
            for c in range(3):
                M[c] = results.point_sums[cut, e, PointSum.MOMENTS + 3 * m + c] / n
                F[c] = results.point_sums[cut, e, PointSum.FORCES + 3 * m + c] / n
                if m == 1:
                    M[c] += moment[c]
                    F[c] += lateral[c]
                power += F[c] * v[c] + M[c] * w[c]
            M, F = motion.R_AC[cut] * M, motion.R_AC[cut] * F
            for c in range(3):
                results.wrenches[cut, e, m, c] = M[c]
                results.wrenches[cut, e, m, 3 + c] = F[c]
        for c in range(6):
            total = results.wrenches[cut, e, 0, c] + results.wrenches[cut, e, 1, c]
            results.wrench[cut, e, c] = total + results.wrenches[cut, e, 2, c]
        results.work[cut, e] = -power * motion.period
        results.cut[cut, e] = results.point_sums[cut, e, PointSum.CUT_AREA]

    @wp.kernel(enable_backward=False, module=module)
    def weigh(sign: float64, state: State, parameters: Parameters, results: Results):
        """Work of the food's weight in a motion from the origin to where it is, times a sign; the
        negative one begins the sum."""
        cut = wp.tid()
        gravity = float64(0.0)
        for i in range(state.x.shape[1]):
            weight, x = parameters.weight[cut, i], state.x[cut, i]
            for c in range(3):
                gravity += float64(weight[c]) * float64(x[c])
        if sign < float64(0.0):
            results.balance[cut, Balance.GRAVITY] = -gravity
        else:
            results.balance[cut, Balance.GRAVITY] += gravity

    @wp.kernel(enable_backward=False, module=module)
    def add_up(sums: Sums, motion: Motion, results: Results):
        """Mean force of the board and balance over all coupling steps, but for gravity."""
        cut = wp.tid()
        force, lost, internal = wp.vec3d(), float64(0.0), float64(0.0)
        for i in range(sums.board_loss.shape[1]):
            on_node = sums.board_force[cut, i]
            force += wp.vec3d(float64(on_node[0]), float64(on_node[1]), float64(on_node[2]))
            lost += float64(sums.board_loss[cut, i])
            internal += float64(sums.internal_work[cut, i])
        count = results.work.shape[1]
        for c in range(3):
            results.board_force[cut, c] = force[c] / float64(motion.substeps * count)
        work, edge, opening = float64(0.0), float64(0.0), float64(0.0)
        friction, blade = float64(0.0), float64(0.0)
        for e in range(count):
            work += results.work[cut, e]
            edge += results.point_sums[cut, e, PointSum.EDGE_LOSS]
            opening += results.point_sums[cut, e, PointSum.OPENING_LOSS]
            friction += results.point_sums[cut, e, PointSum.FRICTION_LOSS]
            blade += results.blade[cut, e, BladeSum.LOSS]
        results.balance[cut, Balance.WORK] = work
        results.balance[cut, Balance.EDGE] = edge
        results.balance[cut, Balance.OPENING] = opening
        results.balance[cut, Balance.FRICTION] = friction
        results.balance[cut, Balance.BOARD_FRICTION] = lost
        results.balance[cut, Balance.BLADE] = blade
        results.balance[cut, Balance.INTERNAL] = internal

    return types.SimpleNamespace(
        move_knife=move_knife,
        plan_steps=plan_steps,
        count=count,
        add_points=add_points,
        knife_wrenches=knife_wrenches,
        weigh=weigh,
        add_up=add_up,
    )
