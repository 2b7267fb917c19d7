"""Kernels of the cut points: edge, bonds, flank contact, friction, adhesion; and their energy."""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.foods.effects import LINEAR_BELOW
from sliceit_drake.cutting.kernels.layouts import PointSum, Section
from sliceit_drake.cutting.kernels.types import Scalar, kernel_types

__all__ = ["point_kernels"]


def point_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    slide, TINY = t.slide, t.TINY
    Points, Parameters, Motion, State = t.Points, t.Parameters, t.Motion, t.State
    Forces, Sums, Energies = t.Forces, t.Sums, t.Energies
    # Without gradients, an effect that is off costs nothing; with them its derivative is wanted.
    ALL = wp.constant(gradients)
    LINEAR = wp.constant(real(LINEAR_BELOW**2))

    @wp.struct
    class KnifePose:
        """Pose of the knife in C, velocity of Ko and angular velocity."""

        R: mat33
        p: vec3
        v: vec3
        w: vec3

    @wp.func
    def place(s: real, points: Points):
        """Interval of the tables, and the fraction of its end, where the edge is s below."""
        u = (s + points.reach) * points.per_spacing
        k = wp.clamp(wp.int32(wp.floor(u)), 0, points.fraction.shape[1] - 2)
        return k, wp.clamp(u - real(k), real(0.0), real(1.0))

    @wp.func
    def table(values: wp.array2d(dtype=real), row: wp.int32, k: wp.int32, w: real):
        return values[row, k] * (real(1.0) - w) + values[row, k + 1] * w

    @wp.func
    def intact_fraction(damage: real, onset: real, failure: real):
        """Secant over initial stiffness of a bilinear bond that spent the share `damage`."""
        share = real(0.0)
        if failure > onset:
            share = onset * (real(1.0) - damage) / (onset + damage * (failure - onset))
        return share

    @wp.func
    def wedge(y: real, height: real, cut: wp.int32, parameters: Parameters):
        """Distance to flank or spine on one side of the section and its gradient (y, height).

        The side is known, so a point that crossed the middle plane is still pushed back to its own
        side. The bevel at the edge is left out: what it does to the food is the work of the edge,
        which the toughness holds; its steep normal would count that twice, in spikes.
        """
        y1 = parameters.knife[cut, Section.SHOULDER]
        h1 = parameters.knife[cut, Section.SHOULDER + 1]
        y2 = parameters.knife[cut, Section.SPINE]
        h2 = parameters.knife[cut, Section.SPINE + 1]
        flank = wp.normalize(vec2(h2 - h1, y1 - y2))
        to_flank = flank[0] * (y - y1) + flank[1] * (wp.max(height, h1) - h1)
        to_spine = height - h2
        phi = wp.max(to_flank, to_spine)
        n = wp.where(to_spine > to_flank, vec2(real(0.0), real(1.0)), flank)
        return phi - parameters.knife[cut, Section.EDGE_RADIUS], n

    @wp.func
    def on_face(
        field: wp.array2d(dtype=vec3), cut: wp.int32, i: wp.int32, face: wp.int32, points: Points
    ):
        """A field of the nodes at a cut point, on the minus (0) or plus (1) side of the cut."""
        w = points.weights[i]
        return (
            field[cut, points.nodes[i, 2 * face]] * w[0]
            + field[cut, points.nodes[i, 2 * face + 1]] * w[1]
        )

    @wp.func
    def outwards(R: mat33, face: wp.int32):
        """Sign of Ky that points to a face's side of the cut: Ky points to the minus side when the
        knife hangs upside down in C."""
        return wp.where((R[1, 1] < real(0.0)) == (face == 0), real(1.0), real(-1.0))

    @wp.func(inline=True)
    def flank_contact(
        cut: wp.int32,
        i: wp.int32,
        face: wp.int32,
        p: vec3,
        v: vec3,
        knife: KnifePose,
        stiffness: real,
        dt: real,
        points: Points,
        parameters: Parameters,
        now: State,
    ):
        """Flank pressure and friction on one face of the cut.

        A part of the face's area is above the edge: `area` now, `old_area` before the sub-step. It
        goes by the depth of the edge below this face, not below the middle of both: a piece that is
        cut off leaves the other where it is. The mean of the flank's thickness over that part is
        that at its centroid, `rise` above the point, for the flank is straight.

        The normal force is minus the gradient of 1/2 stiffness area depth^2, `growth` of the area
        with the depth of the edge included: a knife at rest then puts no energy into a vibration.

        Returns: normal force and friction force on the food, new slip, energy lost by friction,
        area between the ends of the blade.
        """
        P = parameters.P
        arm = p - knife.p
        knife_y = vec3(knife.R[0, 1], knife.R[1, 1], knife.R[2, 1])
        knife_z = vec3(knife.R[0, 2], knife.R[1, 2], knife.R[2, 2])
        relative = v - knife.v - wp.cross(knife.w, arm) - now.blade[cut, 1] * knife_y
        slip = now.slip[cut, i, face]
        whole = points.area[i]
        depth = -wp.dot(arm, knife_z)
        k_now, w_now = place(depth, points)
        k_old, w_old = place(depth + wp.dot(relative, knife_z) * dt, points)
        area = whole * table(points.fraction, i, k_now, w_now)
        old_area = whole * table(points.fraction, i, k_old, w_old)
        growth = table(points.width, i, k_now, w_now)
        rise = table(points.centroid, i, k_now, w_now)
        r = wp.transpose(knife.R) * (arm + vec3(real(0.0), real(0.0), rise))
        between = wp.abs(r[0]) < parameters.knife[cut, Section.HALF_LENGTH]
        normal_force = vec3()
        friction_force = vec3()
        new_slip = vec3()
        # What the anchor stored, less what it stores when the part in contact has changed.
        lost = real(0.5) * stiffness * old_area * wp.dot(slip, slip)
        if area > real(0.0) and between:
            facing = outwards(knife.R, face)
            height = -r[2]
            phi, n2 = wedge(facing * (r[1] - now.blade[cut, 0]), height, cut, parameters)
            if phi < real(0.0):
                n = knife.R * vec3(real(0.0), facing * n2[0], -n2[1])
                N = -stiffness * area * phi
                # The part grows at the edge, where the flank is thinner than at the centroid.
                at_edge = stiffness * growth * phi * (real(0.5) * phi - n[2] * height)
                normal_force = N * n + at_edge * knife_z
                sliding = relative - wp.dot(relative, n) * n
                extra = wp.max(P[cut, Scalar.STATIC_FRICTION] - P[cut, Scalar.FRICTION], real(0.0))
                mu = P[cut, Scalar.FRICTION]
                if extra > real(0.0):
                    mu = mu + extra * wp.exp(-wp.length(sliding) / P[cut, Scalar.STRIBECK_VELOCITY])
                old = slip * wp.min(old_area / area, real(1.0))
                old = old - wp.dot(old, n) * n
                limit = parameters.friction_scale[cut, i] * mu * N + P[cut, Scalar.ADHESION] * area
                anchored, slid = slide(old, sliding * dt, stiffness * area, limit)
                new_slip = anchored
                viscosity = P[cut, Scalar.FLANK_VISCOSITY] * area
                if ALL or viscosity > real(0.0):
                    ratio = wp.dot(sliding, sliding) / (
                        P[cut, Scalar.FLANK_SPEED] * P[cut, Scalar.FLANK_SPEED]
                    )
                    power = real(0.5) * (P[cut, Scalar.FLANK_EXPONENT] - real(1.0))
                    viscosity = viscosity * wp.pow(ratio + LINEAR, power)
                friction_force = -stiffness * area * anchored - viscosity * sliding
                lost = (
                    lost
                    + slid
                    - real(0.5) * stiffness * area * wp.dot(old, old)
                    + viscosity * wp.dot(sliding, sliding) * dt
                )
        return normal_force, friction_force, new_slip, lost, wp.where(between, area, real(0.0))

    @wp.func(inline=True)
    def advance_point(
        cut: wp.int32,
        i: wp.int32,
        k: wp.int32,
        dt: real,
        points: Points,
        parameters: Parameters,
        motion: Motion,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
    ):
        """One cut point, see `step_points`."""
        P = parameters.P
        xm = on_face(now.x, cut, i, 0, points)
        xp = on_face(now.x, cut, i, 1, points)
        vm = on_face(now.v, cut, i, 0, points)
        vp = on_face(now.v, cut, i, 1, points)
        middle = real(0.5) * (xm + xp)
        knife = KnifePose(
            motion.R_CK[cut, k], motion.p_CK[cut, k], motion.v_CK[cut, k], motion.w_CK[cut, k]
        )
        knife_x = vec3(knife.R[0, 0], knife.R[1, 0], knife.R[2, 0])
        knife_y = vec3(knife.R[0, 1], knife.R[1, 1], knife.R[2, 1])
        knife_z = vec3(knife.R[0, 2], knife.R[1, 2], knife.R[2, 2])
        arm = middle - knife.p
        advance = (knife.v + wp.cross(knife.w, arm) - real(0.5) * (vm + vp)) * dt
        A = points.area[i]
        toughness = parameters.toughness[cut, i]
        # s: depth of the edge below the point. Nothing happens beyond the ends of the blade.
        old_depth = now.edge_depth[cut, i]
        s = old_depth
        beyond = wp.abs(wp.dot(arm, knife_x)) >= parameters.knife[cut, Section.HALF_LENGTH]
        if not beyond:
            s = -wp.dot(arm, knife_z)
        depth = wp.max(old_depth, s)
        after.edge_depth[cut, i] = depth
        k0, w0 = place(old_depth, points)
        k1, w1 = place(depth, points)
        D0 = table(points.fraction, i, k0, w0)
        D = table(points.fraction, i, k1, w1)

        # Bonds of the part that is not cut; its faces may also press on each other.
        gap = xp - xm
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        length = wp.length(opening)
        bond = P[cut, Scalar.BOND_STIFFNESS]
        onset = P[cut, Scalar.STRENGTH] / bond
        failure = real(2.0) * toughness / P[cut, Scalar.STRENGTH]
        old_damage = now.cohesive_damage[cut, i]
        damage = wp.max(
            old_damage,
            wp.clamp((length - onset) / wp.max(failure - onset, TINY), real(0.0), real(1.0)),
        )
        after.cohesive_damage[cut, i] = damage
        intact = intact_fraction(damage, onset, failure)
        by_edge = P[cut, Scalar.EDGE_SHARE]
        stiffness = bond * A * (real(1.0) - by_edge * D) * intact
        closing = bond * A * wp.min(gap[1], real(0.0))
        pull = stiffness * opening + vec3(real(0.0), closing, real(0.0))
        opening_loss = toughness * A * (real(1.0) - by_edge * D0) * (damage - old_damage)

        # Edge: a force against the edge's direction d, elastic up to R T (d . n), where R is the
        # toughness that opening left less what the bonds that the edge cuts give up. d follows the
        # knife's own motion: with the food's in it, a drawn edge would feel less force the faster
        # the food moves, and chatter. Behind the deepest point there is a slack and then nothing.
        moved = knife.v + wp.cross(knife.w, arm)
        along = moved - wp.dot(moved, knife_y) * knife_y
        speed = wp.length(along)
        travel = speed * dt
        old_direction = now.edge_direction[cut, i]
        followed = old_direction
        if travel > real(0.0):
            keep = wp.exp(-travel / P[cut, Scalar.DIRECTION_LENGTH])
            followed = keep * old_direction + ((real(1.0) - keep) * dt / travel) * along
        in_plane = followed - wp.dot(followed, knife_y) * knife_y
        size = wp.length(in_plane)
        d = old_direction
        if size > real(1.0e-6):
            d = in_plane / size
        after.edge_direction[cut, i] = d
        bonded = real(0.5) * by_edge * bond * intact * length * length
        left = wp.max(by_edge * toughness * (real(1.0) - damage) - bonded, real(0.0))
        # The edge cuts what its direction has across it; pressing straight, all.
        across = wp.max(wp.dot(d, knife_z), real(0.0))
        effect = across
        if ALL or P[cut, Scalar.SLICE_PUSH_EXPONENT] != real(1.0):
            # Nothing on the way out, where nothing is across, whatever the exponent.
            exponent = real(2.0) * P[cut, Scalar.SLICE_PUSH_EXPONENT] - real(2.0)
            effect = across * wp.pow(wp.max(across, real(1.0e-3)), exponent)
        if ALL or P[cut, Scalar.RATE_EXPONENT] != real(0.0):
            relative_speed = wp.max(speed / P[cut, Scalar.REFERENCE_SPEED], real(1.0e-3))
            effect = effect * wp.pow(relative_speed, P[cut, Scalar.RATE_EXPONENT])
        if ALL or P[cut, Scalar.INITIATION] > real(0.0):
            below = wp.max(points.depth[i] + depth, real(0.0))
            left = left + P[cut, Scalar.INITIATION] * wp.exp(
                -below / P[cut, Scalar.INITIATION_DEPTH]
            )
        resistance = left * table(points.width, i, k1, w1)
        if ALL or P[cut, Scalar.SKIN_TOUGHNESS] > real(0.0):
            resistance = resistance + P[cut, Scalar.SKIN_TOUGHNESS] * table(
                points.outline, i, k1, w1
            )
        spring = wp.max(parameters.unloading[cut, i], TINY)
        slack = wp.max(depth - s - P[cut, Scalar.UNLOADING_LENGTH], real(0.0))
        limit = wp.max(resistance * effect - spring * slack, real(0.0))
        if beyond:
            limit = real(0.0)
        q0 = now.edge_force[cut, i]
        step = wp.dot(d, advance)
        q = wp.clamp(q0 + spring * step, real(0.0), limit)
        after.edge_force[cut, i] = q
        edge = q * d
        edge_loss = q * step - real(0.5) * (q * q - q0 * q0) / spring + bonded * A * (D - D0)

        # Flanks on the part that is cut.
        flank = P[cut, Scalar.FLANK_STIFFNESS] * parameters.flank_scale[cut, i]
        normal_m, friction_m, slip_m, loss_m, area_m = flank_contact(
            cut, i, 0, xm, vm, knife, flank, dt, points, parameters, now
        )
        normal_p, friction_p, slip_p, loss_p, area_p = flank_contact(
            cut, i, 1, xp, vp, knife, flank, dt, points, parameters, now
        )
        after.slip[cut, i, 0] = slip_m
        after.slip[cut, i, 1] = slip_p

        forces.points[cut, i, 0] = pull + real(0.5) * edge + normal_m + friction_m
        forces.points[cut, i, 1] = -pull + real(0.5) * edge + normal_p + friction_p

        forces.lateral[cut, i] = -wp.dot(normal_m + normal_p + friction_m + friction_p, knife_y)

        origin = knife.p
        edge_moment = wp.cross(arm, edge)
        normal_moment = wp.cross(xm - origin, normal_m) + wp.cross(xp - origin, normal_p)
        friction_moment = wp.cross(xm - origin, friction_m) + wp.cross(xp - origin, friction_p)
        normal = normal_m + normal_p
        friction = friction_m + friction_p
        coupling_step = k / motion.substeps
        for c in range(3):
            sums.total[cut, coupling_step, i, PointSum.FORCES + c] += -edge[c]
            sums.total[cut, coupling_step, i, PointSum.FORCES + 3 + c] += -normal[c]
            sums.total[cut, coupling_step, i, PointSum.FORCES + 6 + c] += -friction[c]
            sums.total[cut, coupling_step, i, PointSum.MOMENTS + c] += -edge_moment[c]
            sums.total[cut, coupling_step, i, PointSum.MOMENTS + 3 + c] += -normal_moment[c]
            sums.total[cut, coupling_step, i, PointSum.MOMENTS + 6 + c] += -friction_moment[c]
        sums.total[cut, coupling_step, i, PointSum.EDGE_LOSS] += edge_loss
        sums.total[cut, coupling_step, i, PointSum.OPENING_LOSS] += opening_loss
        sums.total[cut, coupling_step, i, PointSum.FRICTION_LOSS] += loss_m + loss_p
        sums.total[cut, coupling_step, i, PointSum.CUT_AREA] = A * D
        a = real(0.5) * (area_m + area_p)
        b = real(0.5) * (area_m * (xm - origin) + area_p * (xp - origin))
        sums.immersed[cut, coupling_step, i] = vec4(b[0], b[1], b[2], a)

    @wp.kernel(enable_backward=gradients, module=module)
    def step_points(
        k: wp.int32,
        dt: real,
        points: Points,
        parameters: Parameters,
        motion: Motion,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
        per_thread: wp.int32,
    ):
        """Edge, opening, self contact, flank contact and friction at each cut point in sub-step k.

        Advances the history of the points. Adds to `sums.total` forces on the knife, their moments
        about Ko and energies dissipated, and writes the area that is cut; see `POINT_SUMS`. Writes
        to `sums.immersed` the moment about Ko of the part of it above the edge, and that part."""
        cut, chunk = wp.tid()
        for i in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, points.area.shape[0])):
            advance_point(cut, i, k, dt, points, parameters, motion, now, after, forces, sums)

    @wp.kernel(enable_backward=False, module=module)
    def point_energy(
        points: Points, parameters: Parameters, motion: Motion, state: State, energies: Energies
    ):
        """Recoverable energy of each cut point, the knife at its pose in the first sub-step."""
        cut, i = wp.tid()
        P = parameters.P
        R = motion.R_CK[cut, 0]
        A = points.area[i]
        k0, w0 = place(state.edge_depth[cut, i], points)
        D = table(points.fraction, i, k0, w0)
        gap = on_face(state.x, cut, i, 1, points) - on_face(state.x, cut, i, 0, points)
        bond = P[cut, Scalar.BOND_STIFFNESS]
        onset = P[cut, Scalar.STRENGTH] / bond
        failure = real(2.0) * parameters.toughness[cut, i] / P[cut, Scalar.STRENGTH]
        intact = intact_fraction(state.cohesive_damage[cut, i], onset, failure)
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        closing = wp.min(gap[1], real(0.0))
        uncut = (real(1.0) - P[cut, Scalar.EDGE_SHARE] * D) * intact
        doubled = bond * A * (uncut * wp.dot(opening, opening) + closing * closing)
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        edge = state.edge_force[cut, i]
        doubled += edge * edge / wp.max(parameters.unloading[cut, i], TINY)
        flank = P[cut, Scalar.FLANK_STIFFNESS] * parameters.flank_scale[cut, i]
        for face in range(2):
            arm = on_face(state.x, cut, i, face, points) - motion.p_CK[cut, 0]
            k1, w1 = place(-wp.dot(arm, knife_z), points)
            share = table(points.fraction, i, k1, w1)
            rise = table(points.centroid, i, k1, w1)
            r = wp.transpose(R) * (arm + vec3(real(0.0), real(0.0), rise))
            if share > real(0.0) and wp.abs(r[0]) < parameters.knife[cut, Section.HALF_LENGTH]:
                y = outwards(R, face) * (r[1] - state.blade[cut, 0])
                phi, _n = wedge(y, -r[2], cut, parameters)
                if phi < real(0.0):
                    held = state.slip[cut, i, face]
                    doubled += flank * A * share * (phi * phi + wp.dot(held, held))
        energies.points[cut, i] = real(0.5) * doubled

    out = types.SimpleNamespace(step_points=step_points, point_energy=point_energy)
    if not gradients:
        return out

    @wp.kernel(enable_backward=False, module=module)
    def spread_adjoint(
        points: Points, adj_from_points: wp.array2d(dtype=vec3), adj_force: wp.array3d(dtype=vec3)
    ):
        """Adjoint of the forces of the cut points, from those of the nodes that gather them."""
        cut, i = wp.tid()
        for face in range(2):
            adj_force[cut, i, face] = on_face(adj_from_points, cut, i, face, points)

    out.spread_adjoint = spread_adjoint
    return out
