"""Warp kernels of one sub-step: elements, cut points, nodes, blade; and the energy of a state.

One source for CPU and GPU, single and double precision: `kernels(real)` builds the set for a scalar
type. Elements are handled eight a thread with eight-wide vectors, which halves their cost on a CPU.
All vectors are in the frame C of the cut: x along the edge, y normal to the cut, z up.
"""

import functools
import types
from typing import Any

import warp as wp

__all__ = ["ACCUMULATED", "GATHER", "LANES", "PARAMETERS", "kernels"]

LANES = 8
"""Elements that a thread handles."""

GATHER = 4
"""Element forces that a node adds at a time."""

PARAMETERS = (
    "mu",
    "lam",
    "damping_time",
    "bond_stiffness",
    "strength",
    "flank_stiffness",
    "friction",
    "static_friction",
    "stribeck_velocity",
    "unloading_length",
    "direction_length",
    "board_stiffness",
    "board_friction",
    "board_damping_time",
    "blade_stiffness",
    "blade_damping",
    "blade_mass",
)
"""Scalars that the kernels read, in the order of their array."""

ACCUMULATED = 26
"""Sums kept for each cut point over an exchange, see `make.points`."""

_INDEX = {name: k for k, name in enumerate(PARAMETERS)}


@functools.cache
def kernels(real: Any) -> types.SimpleNamespace:
    """The kernels for `real` = wp.float32 or wp.float64."""
    # A module for each precision, so that using both compiles neither twice.
    module = f"{__name__}.{real.__name__}"
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    lanes = wp.types.vector(LANES, real)
    indices = wp.types.vector(LANES, wp.int32)
    # From the x component of a nodal force in `elements` to its z component.
    strided = wp.types.vector(2 * LANES + 1, real)
    entries = wp.types.vector(GATHER, wp.int32)

    MU = wp.constant(_INDEX["mu"])
    LAM = wp.constant(_INDEX["lam"])
    DAMPING_TIME = wp.constant(_INDEX["damping_time"])
    BOND_STIFFNESS = wp.constant(_INDEX["bond_stiffness"])
    STRENGTH = wp.constant(_INDEX["strength"])
    FLANK_STIFFNESS = wp.constant(_INDEX["flank_stiffness"])
    FRICTION = wp.constant(_INDEX["friction"])
    STATIC_FRICTION = wp.constant(_INDEX["static_friction"])
    STRIBECK_VELOCITY = wp.constant(_INDEX["stribeck_velocity"])
    UNLOADING_LENGTH = wp.constant(_INDEX["unloading_length"])
    DIRECTION_LENGTH = wp.constant(_INDEX["direction_length"])
    BOARD_STIFFNESS = wp.constant(_INDEX["board_stiffness"])
    BOARD_FRICTION = wp.constant(_INDEX["board_friction"])
    BOARD_DAMPING_TIME = wp.constant(_INDEX["board_damping_time"])
    BLADE_STIFFNESS = wp.constant(_INDEX["blade_stiffness"])
    BLADE_DAMPING = wp.constant(_INDEX["blade_damping"])
    BLADE_MASS = wp.constant(_INDEX["blade_mass"])
    TINY = wp.constant(real(1.0e-20))

    @wp.func
    def dot8(ax: lanes, ay: lanes, az: lanes, bx: lanes, by: lanes, bz: lanes):
        return wp.cw_mul(ax, bx) + wp.cw_mul(ay, by) + wp.cw_mul(az, bz)

    @wp.func
    def cross8(ax: lanes, ay: lanes, az: lanes, bx: lanes, by: lanes, bz: lanes):
        return (
            wp.cw_mul(ay, bz) - wp.cw_mul(az, by),
            wp.cw_mul(az, bx) - wp.cw_mul(ax, bz),
            wp.cw_mul(ax, by) - wp.cw_mul(ay, bx),
        )

    @wp.func
    def corner8(
        x: wp.array(dtype=vec3),
        nodes: wp.array2d(dtype=indices),
        block: wp.int32,
        corner: wp.int32,
    ):
        node = nodes[block, corner]
        a = lanes()
        b = lanes()
        c = lanes()
        for lane in range(LANES):
            p = x[node[lane]]
            a[lane] = p[0]
            b[lane] = p[1]
            c[lane] = p[2]
        return a, b, c

    @wp.func
    def column8(
        ax: lanes,
        bx: lanes,
        cx: lanes,
        block: wp.int32,
        k: wp.int32,
        shape: wp.array2d(dtype=lanes),
    ):
        """Row of F: edges (ax, bx, cx) times column k of the inverse rest edges."""
        return dot8(ax, bx, cx, shape[block, k], shape[block, 3 + k], shape[block, 6 + k])

    @wp.kernel(enable_backward=False, module=module)
    def elements(
        x: wp.array(dtype=vec3),
        nodes: wp.array2d(dtype=indices),
        shape: wp.array2d(dtype=lanes),
        P: wp.array(dtype=real),
        force: wp.array2d(dtype=lanes),
    ):
        """Nodal forces of eight elements: minus the gradient of the energy at x.

        `x` is `ahead`: positions plus tau times velocities. Evaluating at x + tau v is Kelvin-Voigt
        damping with viscosity tau times the tangent stiffness; invariant under translation, and
        under rotation to second order in tau times its rate.
        """
        block = wp.tid()
        mu = P[MU]
        lam = P[LAM]
        ox, oy, oz = corner8(x, nodes, block, 0)
        ax, ay, az = corner8(x, nodes, block, 1)
        bx, by, bz = corner8(x, nodes, block, 2)
        cx, cy, cz = corner8(x, nodes, block, 3)
        ax -= ox
        ay -= oy
        az -= oz
        bx -= ox
        by -= oy
        bz -= oz
        cx -= ox
        cy -= oy
        cz -= oz
        f00 = column8(ax, bx, cx, block, 0, shape)
        f10 = column8(ay, by, cy, block, 0, shape)
        f20 = column8(az, bz, cz, block, 0, shape)
        f01 = column8(ax, bx, cx, block, 1, shape)
        f11 = column8(ay, by, cy, block, 1, shape)
        f21 = column8(az, bz, cz, block, 1, shape)
        f02 = column8(ax, bx, cx, block, 2, shape)
        f12 = column8(ay, by, cy, block, 2, shape)
        f22 = column8(az, bz, cz, block, 2, shape)
        d00, d10, d20 = cross8(f01, f11, f21, f02, f12, f22)
        d01, d11, d21 = cross8(f02, f12, f22, f00, f10, f20)
        d02, d12, d22 = cross8(f00, f10, f20, f01, f11, f21)
        J = dot8(f00, f10, f20, d00, d10, d20)
        Ic = (
            dot8(f00, f10, f20, f00, f10, f20)
            + dot8(f01, f11, f21, f01, f11, f21)
            + dot8(f02, f12, f22, f02, f12, f22)
        )
        one = lanes(real(1.0))
        weight = shape[block, 9]
        s = wp.cw_mul(weight, (one - wp.cw_div(one, Ic + one)) * mu)
        p = wp.cw_mul(weight, J * lam - one * (lam + real(0.75) * mu))
        p00 = wp.cw_mul(s, f00) + wp.cw_mul(p, d00)
        p10 = wp.cw_mul(s, f10) + wp.cw_mul(p, d10)
        p20 = wp.cw_mul(s, f20) + wp.cw_mul(p, d20)
        p01 = wp.cw_mul(s, f01) + wp.cw_mul(p, d01)
        p11 = wp.cw_mul(s, f11) + wp.cw_mul(p, d11)
        p21 = wp.cw_mul(s, f21) + wp.cw_mul(p, d21)
        p02 = wp.cw_mul(s, f02) + wp.cw_mul(p, d02)
        p12 = wp.cw_mul(s, f12) + wp.cw_mul(p, d12)
        p22 = wp.cw_mul(s, f22) + wp.cw_mul(p, d22)
        hx = lanes()
        hy = lanes()
        hz = lanes()
        for k in range(3):
            m0 = shape[block, 3 * k]
            m1 = shape[block, 3 * k + 1]
            m2 = shape[block, 3 * k + 2]
            gx = dot8(p00, p01, p02, m0, m1, m2)
            gy = dot8(p10, p11, p12, m0, m1, m2)
            gz = dot8(p20, p21, p22, m0, m1, m2)
            force[block, 3 * k + 3] = gx
            force[block, 3 * k + 4] = gy
            force[block, 3 * k + 5] = gz
            hx += gx
            hy += gy
            hz += gz
        force[block, 0] = -hx
        force[block, 1] = -hy
        force[block, 2] = -hz

    @wp.kernel(enable_backward=False, module=module)
    def look_ahead(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        P: wp.array(dtype=real),
        ahead: wp.array(dtype=vec3),
    ):
        """Positions at which the elements are evaluated."""
        i = wp.tid()
        ahead[i] = x[i] + P[DAMPING_TIME] * v[i]

    @wp.kernel(enable_backward=False, module=module)
    def element_energy(
        x: wp.array(dtype=vec3),
        nodes: wp.array2d(dtype=indices),
        shape: wp.array2d(dtype=lanes),
        P: wp.array(dtype=real),
        energy: wp.array2d(dtype=real),
        volume_ratio: wp.array2d(dtype=real),
    ):
        """Elastic energy and volume ratio J of each element."""
        block, lane = wp.tid()
        mu = P[MU]
        lam = P[LAM]
        o = x[nodes[block, 0][lane]]
        a = x[nodes[block, 1][lane]] - o
        b = x[nodes[block, 2][lane]] - o
        c = x[nodes[block, 3][lane]] - o
        M = mat33()
        for k in range(9):
            M[k // 3, k % 3] = shape[block, k][lane]
        F = wp.matrix_from_cols(a, b, c) * M
        Ic = wp.ddot(F, F)
        J = wp.determinant(F)
        alpha = real(1.0) + real(0.75) * mu / lam
        psi = real(0.5) * (
            mu * (Ic - real(3.0))
            + lam * ((J - alpha) * (J - alpha) - (real(1.0) - alpha) * (real(1.0) - alpha))
            - mu * wp.log(real(0.25) * (Ic + real(1.0)))
        )
        energy[block, lane] = -shape[block, 9][lane] * psi
        volume_ratio[block, lane] = J

    @wp.func
    def table(values: wp.array2d(dtype=real), row: wp.int32, u: real):
        last = values.shape[1] - 2
        k = wp.clamp(wp.int32(wp.floor(u)), 0, last)
        w = wp.clamp(u - real(k), real(0.0), real(1.0))
        return values[row, k] * (real(1.0) - w) + values[row, k + 1] * w

    @wp.func
    def intact_share(parted: real, onset: real, failure: real):
        """Secant over initial stiffness of a bilinear bond that spent the share `parted`."""
        share = real(0.0)
        if failure > onset:
            share = onset * (real(1.0) - parted) / (onset + parted * (failure - onset))
        return share

    @wp.func
    def wedge(y: real, height: real, knife: wp.array(dtype=real)):
        """Distance to flank or spine on one side of the section and its gradient (y, height).

        The side is known, so a point that crossed the middle plane is still pushed back to its own
        side. The bevel at the edge is left out: what it does to the food is the work of the edge,
        which the toughness holds; its steep normal would count that twice, in spikes.
        """
        y1 = knife[2]
        h1 = knife[3]
        y2 = knife[4]
        h2 = knife[5]
        n = wp.normalize(vec2(h2 - h1, y1 - y2))
        phi = n[0] * (y - y1) + n[1] * (wp.max(height, h1) - h1)
        spine = height - h2
        if spine > phi:
            phi = spine
            n = vec2(real(0.0), real(1.0))
        return phi - knife[6], n

    @wp.func
    def slide(slip: vec3, step: vec3, stiffness: real, limit: real):
        """Coulomb friction with an elastic anchor, returned to the limit.

        Args: slip from the anchor so far, its increment, tangential stiffness, largest force.
        Returns: new slip, energy lost by sliding.
        """
        trial = slip + step
        length = wp.length(trial)
        reach = limit / wp.max(stiffness, TINY)
        new_slip = trial
        lost = real(0.0)
        if length > reach:
            new_slip = trial * (reach / length)
            change = new_slip - slip
            lost = wp.dot(new_slip, trial - new_slip) + real(0.5) * wp.dot(change, change)
        return new_slip, stiffness * lost

    @wp.func
    def flank_contact(
        p: vec3,
        v: vec3,
        side: real,
        R: mat33,
        origin: vec3,
        velocity: vec3,
        rotation_rate: vec3,
        bend: real,
        bend_rate: real,
        area: real,
        old_area: real,
        growth: real,
        rise: real,
        slip: vec3,
        dt: real,
        P: wp.array(dtype=real),
        knife: wp.array(dtype=real),
    ):
        """Flank pressure and friction on one face of the cut.

        The edge has passed a part of the point's area: `area` now, `old_area` before the sub-step.
        The mean of the flank's thickness over that part is that at its centroid, `rise` above the
        point, for the flank is straight.

        The normal force is minus the gradient of 1/2 stiffness area depth^2, `growth` of the area
        with the depth of the edge included: a knife at rest then puts no energy into a vibration.

        Returns: normal force and friction force on the food, new slip, energy lost by friction.
        """
        stiffness = P[FLANK_STIFFNESS]
        arm = p - origin
        r = wp.transpose(R) * (arm + vec3(real(0.0), real(0.0), rise))
        normal_force = vec3()
        friction_force = vec3()
        new_slip = vec3()
        # What the anchor stored, less what it stores when the part in contact has changed.
        lost = real(0.5) * stiffness * old_area * wp.dot(slip, slip)
        if area > real(0.0) and wp.abs(r[0]) < knife[7]:
            # Ky points to the minus side when the knife hangs upside down in C.
            facing = side
            if R[1, 1] < real(0.0):
                facing = -side
            height = -r[2]
            phi, n2 = wedge(facing * (r[1] - bend), height, knife)
            if phi < real(0.0):
                n = R * vec3(real(0.0), facing * n2[0], -n2[1])
                knife_y = vec3(R[0, 1], R[1, 1], R[2, 1])
                knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
                N = -stiffness * area * phi
                # The part grows at the edge, where the flank is thinner than at the centroid.
                at_edge = stiffness * growth * phi * (real(0.5) * phi - n[2] * height)
                normal_force = N * n + at_edge * knife_z
                relative = v - velocity - wp.cross(rotation_rate, arm) - bend_rate * knife_y
                sliding = relative - wp.dot(relative, n) * n
                mu = P[FRICTION]
                extra = P[STATIC_FRICTION] - mu
                if extra > real(0.0):
                    mu += extra * wp.exp(-wp.length(sliding) / P[STRIBECK_VELOCITY])
                old = slip * wp.min(old_area / area, real(1.0))
                old = old - wp.dot(old, n) * n
                new_slip, slid = slide(old, sliding * dt, stiffness * area, mu * N)
                friction_force = -stiffness * area * new_slip
                lost += slid - real(0.5) * stiffness * area * wp.dot(old, old)
        return normal_force, friction_force, new_slip, lost

    @wp.kernel(enable_backward=False, module=module)
    def points(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        area: wp.array(dtype=real),
        toughness: wp.array(dtype=real),
        width: wp.array2d(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        unloading: wp.array(dtype=real),
        reach: real,
        per_spacing: real,
        P: wp.array(dtype=real),
        knife: wp.array(dtype=real),
        k: wp.int32,
        dt: real,
        R_CK: wp.array(dtype=mat33),
        p_CK: wp.array(dtype=vec3),
        v_CK: wp.array(dtype=vec3),
        w_CK: wp.array(dtype=vec3),
        blade: wp.array(dtype=real),
        passed: wp.array(dtype=real),
        parted: wp.array(dtype=real),
        edge_force: wp.array(dtype=real),
        heading: wp.array(dtype=vec3),
        slip: wp.array2d(dtype=vec3),
        force: wp.array2d(dtype=vec3),
        lateral: wp.array(dtype=real),
        total: wp.array2d(dtype=real),
    ):
        """Edge, opening, self contact, flank contact and friction at each cut point.

        Advances the history: `passed`, the largest depth of the edge below the point; `parted`, the
        share of the surface energy spent by opening; `edge_force` on the food and its direction
        `heading`; `slip`, from the friction anchors. Adds to `total`: forces on the knife by edge,
        flank pressure, friction [0:9], their moments about Ko [9:18], and energies dissipated by
        the edge 18, by opening 19, by friction 20. Writes the area that is cut 21, the part of it
        above the edge 22, and its moment about Ko [23:26].
        """
        i = wp.tid()
        w = weights[i]
        xm = x[nodes[i, 0]] * w[0] + x[nodes[i, 1]] * w[1]
        xp = x[nodes[i, 2]] * w[0] + x[nodes[i, 3]] * w[1]
        vm = v[nodes[i, 0]] * w[0] + v[nodes[i, 1]] * w[1]
        vp = v[nodes[i, 2]] * w[0] + v[nodes[i, 3]] * w[1]
        middle = real(0.5) * (xm + xp)
        R = R_CK[k]
        origin = p_CK[k]
        knife_x = vec3(R[0, 0], R[1, 0], R[2, 0])
        knife_y = vec3(R[0, 1], R[1, 1], R[2, 1])
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        arm = middle - origin
        motion = (v_CK[k] + wp.cross(w_CK[k], arm) - real(0.5) * (vm + vp)) * dt
        A = area[i]
        toughness_i = toughness[i]
        # s: depth of the edge below the point. Nothing happens beyond the ends of the blade.
        old_passed = passed[i]
        s = old_passed
        s0 = old_passed
        share = real(0.0)
        old_share = real(0.0)
        growth = real(0.0)
        rise = real(0.0)
        beyond = wp.abs(wp.dot(arm, knife_x)) >= knife[7]
        if not beyond:
            s = -wp.dot(arm, knife_z)
            s0 = s - wp.dot(motion, knife_z)
            u = (s + reach) * per_spacing
            share = table(fraction, i, u)
            growth = table(width, i, u)
            old_share = table(fraction, i, (s0 + reach) * per_spacing)
            rise = table(centroid, i, u)
        new_passed = wp.max(old_passed, s)
        passed[i] = new_passed
        u0 = (old_passed + reach) * per_spacing
        u1 = (new_passed + reach) * per_spacing
        D0 = table(fraction, i, u0)
        D = table(fraction, i, u1)

        # Bonds of the part that is not cut; its faces may also press on each other.
        gap = xp - xm
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        length = wp.length(opening)
        bond = P[BOND_STIFFNESS]
        onset = P[STRENGTH] / bond
        failure = real(2.0) * toughness_i / P[STRENGTH]
        old_parted = parted[i]
        new_parted = wp.max(
            old_parted,
            wp.clamp((length - onset) / wp.max(failure - onset, TINY), real(0.0), real(1.0)),
        )
        parted[i] = new_parted
        intact = intact_share(new_parted, onset, failure)
        stiffness = bond * A * (real(1.0) - D) * intact
        closing = bond * A * wp.min(gap[1], real(0.0))
        pull = stiffness * opening + vec3(real(0.0), closing, real(0.0))
        opening_loss = toughness_i * A * (real(1.0) - D0) * (new_parted - old_parted)

        # Edge: a force against the edge's direction d, elastic up to R T (d . n), where R is the
        # toughness that opening left less what the bonds that the edge cuts give up. d follows the
        # knife's own motion: with the food's in it, a drawn edge would feel less force the faster
        # the food moves, and chatter. Behind the deepest point there is a slack and then nothing.
        along = v_CK[k] + wp.cross(w_CK[k], arm)
        along = along - wp.dot(along, knife_y) * knife_y
        travel = wp.length(along) * dt
        d = heading[i]
        if travel > real(0.0):
            keep = wp.exp(-travel / P[DIRECTION_LENGTH])
            d = keep * d + ((real(1.0) - keep) * dt / travel) * along
        d = d - wp.dot(d, knife_y) * knife_y
        size = wp.length(d)
        d = wp.where(size > real(1.0e-6), d / wp.max(size, real(1.0e-6)), heading[i])
        heading[i] = d
        bonded = real(0.5) * bond * intact * length * length
        left = wp.max(toughness_i * (real(1.0) - new_parted) - bonded, real(0.0))
        spring = wp.max(unloading[i], TINY)
        limit = left * table(width, i, u1) * wp.max(wp.dot(d, knife_z), real(0.0))
        limit -= spring * wp.max(new_passed - s - P[UNLOADING_LENGTH], real(0.0))
        if beyond:
            limit = real(0.0)
        q0 = edge_force[i]
        step = wp.dot(d, motion)
        q = wp.clamp(q0 + spring * step, real(0.0), wp.max(limit, real(0.0)))
        edge_force[i] = q
        edge = q * d
        edge_loss = q * step - real(0.5) * (q * q - q0 * q0) / spring + bonded * A * (D - D0)

        # Flanks on the part that is cut.
        normal_m, friction_m, slip_m, loss_m = flank_contact(
            xm,
            vm,
            real(-1.0),
            R,
            origin,
            v_CK[k],
            w_CK[k],
            blade[0],
            blade[1],
            A * share,
            A * old_share,
            growth,
            rise,
            slip[i, 0],
            dt,
            P,
            knife,
        )
        normal_p, friction_p, slip_p, loss_p = flank_contact(
            xp,
            vp,
            real(1.0),
            R,
            origin,
            v_CK[k],
            w_CK[k],
            blade[0],
            blade[1],
            A * share,
            A * old_share,
            growth,
            rise,
            slip[i, 1],
            dt,
            P,
            knife,
        )
        slip[i, 0] = slip_m
        slip[i, 1] = slip_p

        force[i, 0] = pull + real(0.5) * edge + normal_m + friction_m
        force[i, 1] = -pull + real(0.5) * edge + normal_p + friction_p

        lateral[i] = -wp.dot(normal_m + normal_p + friction_m + friction_p, knife_y)

        edge_moment = wp.cross(arm, edge)
        normal_moment = wp.cross(xm - origin, normal_m) + wp.cross(xp - origin, normal_p)
        friction_moment = wp.cross(xm - origin, friction_m) + wp.cross(xp - origin, friction_p)
        normal = normal_m + normal_p
        friction = friction_m + friction_p
        for c in range(3):
            total[i, c] = total[i, c] - edge[c]
            total[i, 3 + c] = total[i, 3 + c] - normal[c]
            total[i, 6 + c] = total[i, 6 + c] - friction[c]
            total[i, 9 + c] = total[i, 9 + c] - edge_moment[c]
            total[i, 12 + c] = total[i, 12 + c] - normal_moment[c]
            total[i, 15 + c] = total[i, 15 + c] - friction_moment[c]
        total[i, 18] = total[i, 18] + edge_loss
        total[i, 19] = total[i, 19] + opening_loss
        total[i, 20] = total[i, 20] + loss_m + loss_p
        total[i, 21] = A * D
        total[i, 22] = A * share
        for c in range(3):
            total[i, 23 + c] = A * share * arm[c]

    @wp.kernel(enable_backward=False, module=module)
    def move_nodes(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        moving: wp.array(dtype=wp.int32),
        element_force: wp.array(dtype=strided),
        element_start: wp.array(dtype=wp.int32),
        element_entry: wp.array(dtype=entries),
        point_force: wp.array(dtype=vec3),
        point_start: wp.array(dtype=wp.int32),
        point_entry: wp.array(dtype=wp.int32),
        point_weight: wp.array(dtype=real),
        inverse_mass: wp.array(dtype=real),
        weight: wp.array(dtype=vec3),
        board_area: wp.array(dtype=real),
        board: wp.array(dtype=real),
        P: wp.array(dtype=real),
        dt: real,
        board_slip: wp.array(dtype=vec3),
        board_force: wp.array(dtype=vec3),
        board_loss: wp.array(dtype=real),
        internal_work: wp.array(dtype=real),
        x_next: wp.array(dtype=vec3),
        v_next: wp.array(dtype=vec3),
        ahead: wp.array(dtype=vec3),
    ):
        """Gathers the forces of each moving node and steps it, semi-implicit Euler.

        Row k of `element_force` begins at the k-th number of the elements' forces. Entries come in
        fours, filled up with a row of zeros.
        """
        i = moving[wp.tid()]
        fx = real(0.0)
        fy = real(0.0)
        fz = real(0.0)
        for e in range(element_start[i], element_start[i + 1]):
            entry = element_entry[e]
            a = element_force[entry[0]]
            b = element_force[entry[1]]
            c = element_force[entry[2]]
            d = element_force[entry[3]]
            fx += (a[0] + b[0]) + (c[0] + d[0])
            fy += (a[LANES] + b[LANES]) + (c[LANES] + d[LANES])
            fz += (a[2 * LANES] + b[2 * LANES]) + (c[2 * LANES] + d[2 * LANES])
        internal = vec3(fx, fy, fz)
        f = internal + weight[i]
        for e in range(point_start[i], point_start[i + 1]):
            f += point_force[point_entry[e]] * point_weight[e]
        xi = x[i]
        vi = v[i]
        pressed = real(0.0)
        if board_area[i] > real(0.0):
            n = vec3(board[0], board[1], board[2])
            depth = board[3] - wp.dot(n, xi)
            stiffness = P[BOARD_STIFFNESS] * board_area[i]
            old = board_slip[i]
            slip = vec3()
            lost = real(0.5) * stiffness * wp.dot(old, old)
            if depth > real(0.0):
                sliding = (vi - wp.dot(vi, n) * n) * dt
                slip, lost = slide(old, sliding, stiffness, P[BOARD_FRICTION] * stiffness * depth)
                pressed = stiffness * depth
                on_food = pressed * n - stiffness * slip
                f += on_food
                board_force[i] = board_force[i] + on_food
            board_loss[i] = board_loss[i] + lost
            board_slip[i] = slip
        v1 = vi + f * (inverse_mass[i] * dt)
        if pressed > real(0.0):
            # The board damps the normal motion, implicitly, and does not pull.
            n = vec3(board[0], board[1], board[2])
            per_force = inverse_mass[i] * dt
            damping = P[BOARD_STIFFNESS] * board_area[i] * P[BOARD_DAMPING_TIME]
            normal = wp.dot(v1, n)
            damped = normal / (real(1.0) + damping * per_force)
            damped = wp.max(damped, normal - pressed * per_force)
            v1 += (damped - normal) * n
            force = (damped - normal) / per_force
            board_force[i] = board_force[i] + force * n
            moved = real(0.5) * (wp.dot(vi, n) + damped) * dt
            board_loss[i] = board_loss[i] + wp.max(-force * moved, real(0.0))
        # Trapezoidal rule for the work along the path, summed by parts.
        internal_work[i] = internal_work[i] + real(0.5) * wp.dot(internal, vi + v1) * dt
        v_next[i] = v1
        x1 = xi + v1 * dt
        x_next[i] = x1
        ahead[i] = x1 + P[DAMPING_TIME] * v1

    @wp.kernel(enable_backward=False, module=module)
    def bend_blade(
        lateral: wp.array(dtype=real),
        P: wp.array(dtype=real),
        dt: real,
        blade: wp.array(dtype=real),
        blade_sums: wp.array(dtype=real),
    ):
        """Steps the blade's lateral deflection and its rate, pushed by the flanks.

        Adds to `blade_sums`: energy lost, force that reaches the knife's body, force of the flanks.
        """
        F = real(0.0)
        for i in range(lateral.shape[0]):
            F += lateral[i]
        m = P[BLADE_MASS]
        rate = blade[1] + dt * (F - P[BLADE_STIFFNESS] * blade[0]) / m
        rate = rate / (real(1.0) + dt * P[BLADE_DAMPING] / m)
        blade[1] = rate
        blade[0] = blade[0] + dt * rate
        blade_sums[0] = blade_sums[0] + P[BLADE_DAMPING] * rate * rate * dt
        blade_sums[1] = blade_sums[1] + P[BLADE_STIFFNESS] * blade[0] + P[BLADE_DAMPING] * rate
        blade_sums[2] = blade_sums[2] + F

    @wp.kernel(enable_backward=False, module=module)
    def point_energy(
        x: wp.array(dtype=vec3),
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        area: wp.array(dtype=real),
        toughness: wp.array(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        unloading: wp.array(dtype=real),
        reach: real,
        per_spacing: real,
        P: wp.array(dtype=real),
        knife: wp.array(dtype=real),
        R_CK: wp.array(dtype=mat33),
        p_CK: wp.array(dtype=vec3),
        k: wp.int32,
        blade: wp.array(dtype=real),
        passed: wp.array(dtype=real),
        parted: wp.array(dtype=real),
        edge_force: wp.array(dtype=real),
        slip: wp.array2d(dtype=vec3),
        energy: wp.array(dtype=real),
    ):
        """Recoverable energy of each cut point."""
        i = wp.tid()
        w = weights[i]
        xm = x[nodes[i, 0]] * w[0] + x[nodes[i, 1]] * w[1]
        xp = x[nodes[i, 2]] * w[0] + x[nodes[i, 3]] * w[1]
        R = R_CK[k]
        A = area[i]
        u = (passed[i] + reach) * per_spacing
        D = table(fraction, i, u)
        gap = xp - xm
        bond = P[BOND_STIFFNESS]
        onset = P[STRENGTH] / bond
        failure = real(2.0) * toughness[i] / P[STRENGTH]
        intact = intact_share(parted[i], onset, failure)
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        closing = wp.min(gap[1], real(0.0))
        doubled = (
            bond * A * ((real(1.0) - D) * intact * wp.dot(opening, opening) + closing * closing)
        )
        knife_x = vec3(R[0, 0], R[1, 0], R[2, 0])
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        arm = real(0.5) * (xm + xp) - p_CK[k]
        share = real(0.0)
        rise = real(0.0)
        if wp.abs(wp.dot(arm, knife_x)) < knife[7]:
            s = -wp.dot(arm, knife_z)
            share = table(fraction, i, (s + reach) * per_spacing)
            rise = table(centroid, i, (s + reach) * per_spacing)
        doubled += edge_force[i] * edge_force[i] / wp.max(unloading[i], TINY)
        facing = real(1.0)
        if R[1, 1] < real(0.0):
            facing = real(-1.0)
        for side in range(2):
            p = xm
            sign = -facing
            if side == 1:
                p = xp
                sign = facing
            r = wp.transpose(R) * (p - p_CK[k] + vec3(real(0.0), real(0.0), rise))
            if share > real(0.0) and wp.abs(r[0]) < knife[7]:
                phi, _n = wedge(sign * (r[1] - blade[0]), -r[2], knife)
                if phi < real(0.0):
                    held = slip[i, side]
                    doubled += P[FLANK_STIFFNESS] * A * share * (phi * phi + wp.dot(held, held))
        energy[i] = real(0.5) * doubled

    return types.SimpleNamespace(
        real=real,
        vec2=vec2,
        vec3=vec3,
        mat33=mat33,
        lanes=lanes,
        indices=indices,
        strided=strided,
        entries=entries,
        look_ahead=look_ahead,
        elements=elements,
        element_energy=element_energy,
        points=points,
        move_nodes=move_nodes,
        bend_blade=bend_blade,
        point_energy=point_energy,
    )
