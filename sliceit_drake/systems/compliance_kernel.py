"""Warp kernels of forward dynamics compliance control, in double precision.

The law is that of `sliceit_drake.systems.compliance_controller`, the arm a chain of n revolute
joints that turn their links about the links' own z axes. Vectors are in the axes of the arm's base
B if nothing else is said. Pairs of vectors have the translational one first. Arrays over bodies
[n + 1] have the end effector E behind the links.
"""

import warp as wp

from sliceit_drake.cutting.kernels.types import mat34d, origin_of, rotation_of
from sliceit_drake.cutting.warp_start import CPU_FLAGS

__all__ = ["MODES", "place_arm", "update_arm"]

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

MODES = ("compliance", "motion", "force", "parallel")
"""The kernel knows a mode by its place here."""

MOTION = wp.constant(MODES.index("motion"))
FORCE = wp.constant(MODES.index("force"))
PARALLEL = wp.constant(MODES.index("parallel"))

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))

Numbers = wp.array(dtype=wp.float64)
Vectors = wp.array(dtype=wp.vec3d)
Rotations = wp.array(dtype=wp.mat33d)
Matrix = wp.array2d(dtype=wp.float64)

"""Three rows of a rigid transform, in doubles."""

# A pose error is limited to this length [m] and to this angle [rad].
MAX_DISTANCE = wp.constant(wp.float64(1.0))
MAX_ANGLE = wp.constant(wp.float64(1.0))


@wp.func
def place_links(q: Numbers, R_PL: Rotations, p_PL: Vectors, R_BL: Rotations, p_BL: Vectors):
    """Poses of the bodies at joint positions q, from those in their parents at zero."""
    R = wp.identity(n=3, dtype=wp.float64)
    p = wp.vec3d()
    for i in range(q.shape[0]):
        c = wp.cos(q[i])
        s = wp.sin(q[i])
        p += R * p_PL[i]
        R = R * R_PL[i] * wp.mat33d(c, -s, ZERO, s, c, ZERO, ZERO, ZERO, ONE)
        R_BL[i] = R
        p_BL[i] = p
    end = q.shape[0]
    R_BL[end] = R * R_PL[end]
    p_BL[end] = p + R * p_PL[end]


@wp.func
def joint_axis(R_BL: Rotations, i: wp.int32):
    R = R_BL[i]
    return wp.vec3d(R[0, 2], R[1, 2], R[2, 2])


@wp.func
def mass_matrix(R_BL: Rotations, p_BL: Vectors, mass: Numbers, moment: Numbers, H: Matrix):
    """Sum of J^T M J over the bodies, each with equal moments of inertia about its origin.

    The lower triangle of H alone is written.
    """
    for i in range(H.shape[0]):
        a_i = joint_axis(R_BL, i)
        for j in range(i + 1):
            a_j = joint_axis(R_BL, j)
            both_turn = wp.dot(a_i, a_j)
            h = wp.float64(0.0)
            for k in range(i, mass.shape[0]):
                v_i = wp.cross(a_i, p_BL[k] - p_BL[i])
                v_j = wp.cross(a_j, p_BL[k] - p_BL[j])
                h += mass[k] * wp.dot(v_i, v_j) + moment[k] * both_turn
            H[i, j] = h


@wp.func
def joint_torques(R_BL: Rotations, p_BL: Vectors, force: wp.vec3d, moment: wp.vec3d, tau: Numbers):
    """J^T of a force and a moment that act at the end effector's origin."""
    p_BE = p_BL[tau.shape[0]]
    for i in range(tau.shape[0]):
        a = joint_axis(R_BL, i)
        tau[i] = wp.dot(wp.cross(a, p_BE - p_BL[i]), force) + wp.dot(a, moment)


@wp.func
def solve(H: Matrix, x: Numbers):
    """Puts H^-1 x in place of x, and the Cholesky factor in place of the lower triangle of H.

    Returns: whether the result is finite, which it is not if H is not positive definite.
    """
    n = x.shape[0]
    for j in range(n):
        pivot = H[j, j]
        for k in range(j):
            pivot -= H[j, k] * H[j, k]
        H[j, j] = wp.sqrt(pivot)
        for i in range(j + 1, n):
            h = H[i, j]
            for k in range(j):
                h -= H[i, k] * H[j, k]
            H[i, j] = h / H[j, j]
    for i in range(n):
        y = x[i]
        for k in range(i):
            y -= H[i, k] * x[k]
        x[i] = y / H[i, i]
    square = wp.float64(0.0)
    for back in range(n):
        i = n - 1 - back
        y = x[i]
        for k in range(i + 1, n):
            y -= H[k, i] * x[k]
        x[i] = y / H[i, i]
        square += x[i] * x[i]
    return wp.isfinite(square)


@wp.func
def displacement(d: wp.vec3d, threshold: wp.float64):
    """The displacement d, limited in length, zero if it is shorter than the threshold."""
    distance = wp.length(d)
    if distance < threshold:
        return wp.vec3d()
    return wp.min(ONE, MAX_DISTANCE / distance) * d


@wp.func
def rotation_vector(R: wp.mat33d, threshold: wp.float64):
    """Axis times angle, the angle limited; zero if R is symmetric to the threshold."""
    # These are 2 sin(angle) axis and 2 cos(angle).
    x = R[2, 1] - R[1, 2]
    y = R[0, 2] - R[2, 0]
    z = R[1, 0] - R[0, 1]
    cosine = R[0, 0] + R[1, 1] + R[2, 2] - ONE
    if wp.abs(x) < threshold and wp.abs(y) < threshold and wp.abs(z) < threshold:
        if cosine > ZERO:
            return wp.vec3d()
        # A half turn, R = 2 a a^T - 1, leaves the sign of the axis a open. As in KDL, the component
        # with the largest diagonal element is positive.
        i = wp.int32(2)
        if R[0, 0] > R[1, 1] and R[0, 0] > R[2, 2]:
            i = 0
        elif R[1, 1] > R[2, 2]:
            i = 1
        largest = wp.sqrt(wp.float64(0.5) * (R[i, i] + ONE))
        axis = wp.vec3d()
        for j in range(3):
            axis[j] = wp.float64(0.25) * (R[i, j] + R[j, i]) / largest
        axis[i] = largest
        return MAX_ANGLE * axis
    norm = wp.length(wp.vec3d(x, y, z))
    return wp.min(wp.atan2(norm, cosine), MAX_ANGLE) / norm * wp.vec3d(x, y, z)


@wp.kernel(enable_backward=False)
def place_arm(q: Numbers, R_PL: Rotations, p_PL: Vectors, R_BL: Rotations, p_BL: Vectors):
    """Poses of the bodies in B, see `place_links`."""
    place_links(q, R_PL, p_PL, R_BL, p_BL)


@wp.kernel(enable_backward=False)
def update_arm(
    q: Numbers,
    R_PL: Rotations,
    p_PL: Vectors,
    R_BL: Rotations,
    p_BL: Vectors,
    mass: Numbers,
    moment: Numbers,
    lower: Numbers,
    upper: Numbers,
    mode: wp.int32,
    iterations: wp.int32,
    dt: wp.float64,
    damping_factor: wp.float64,
    threshold: wp.float64,
    hand_frame_control: wp.bool,
    R_EC: wp.mat33d,
    X_BA: mat34d,
    to_C: Matrix,
    measured: Numbers,
    target: wp.array(dtype=mat34d),
    sensor_wrench: Numbers,
    stiffness: Vectors,
    selection: Vectors,
    proportional: Vectors,
    derivative: Vectors,
    target_wrench: Vectors,
    v: Numbers,
    error: Vectors,
    u: Vectors,
    H: Matrix,
    acceleration: Numbers,
    failed: wp.array(dtype=wp.int32),
):
    """Advances q, v and the error by one update, in one thread.

    It stops where the acceleration is not finite, with that step's q and u.
    """
    n = q.shape[0]
    R_BA = rotation_of(X_BA)
    R_target = R_BA * rotation_of(target[0])
    p_target = R_BA * origin_of(target[0]) + origin_of(X_BA)
    failed[0] = 0
    # The first error is that of the pose which the model reached in the last update, although
    # everything else is taken at the measured joints, as in the reference implementation.
    place_links(q, R_PL, p_PL, R_BL, p_BL)
    R_of_error = R_BL[n]
    p_of_error = p_BL[n]
    for i in range(n):
        q[i] = measured[i]
    for step in range(iterations):
        place_links(q, R_PL, p_PL, R_BL, p_BL)
        R_BE = R_BL[n]
        if step > 0:
            R_of_error = R_BE
            p_of_error = p_BL[n]

        turn = R_target * wp.transpose(R_of_error)
        R_BC = R_BE * R_EC
        for row in range(2):
            pose_error = displacement(p_target - p_of_error, threshold)
            if row == 1:
                pose_error = rotation_vector(turn, threshold)
            f_target = target_wrench[row]
            if hand_frame_control:
                f_target = R_BE * f_target
            sensed = wp.vec3d()
            for c in range(3):
                for k in range(6):
                    sensed[c] += to_C[3 * row + c, k] * sensor_wrench[k]
            f = R_BC * sensed + f_target
            spring = R_BC * wp.cw_mul(stiffness[row], wp.transpose(R_BC) * pose_error)
            e = spring + f
            if mode == MOTION:
                e = pose_error
            elif mode == FORCE:
                e = f
            elif mode == PARALLEL:
                S = selection[row]
                e = wp.cw_mul(S, spring) + wp.cw_mul(wp.vec3d(ONE, ONE, ONE) - S, f)
            change = e - error[row]
            u[row] = wp.cw_mul(proportional[row], e) + wp.cw_mul(derivative[row], change)
            error[row] = e

        mass_matrix(R_BL, p_BL, mass, moment, H)
        joint_torques(R_BL, p_BL, u[0], u[1], acceleration)
        if not solve(H, acceleration):
            failed[0] = 1
            return
        for i in range(n):
            # Written so that what is not a number stays so.
            moved = q[i] + dt * v[i]
            if moved < lower[i]:
                moved = lower[i]
            if moved > upper[i]:
                moved = upper[i]
            q[i] = moved
            v[i] = damping_factor * (v[i] + dt * acceleration[i])
