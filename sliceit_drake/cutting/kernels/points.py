"""Kernels of the cut points: edge, bonds, flank contact, friction, adhesion; and their energy."""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.foods.effects import LINEAR_BELOW
from sliceit_drake.cutting.kernels.layouts import KNIFE, POINT_SUMS, first
from sliceit_drake.cutting.kernels.types import kernel_types

__all__ = ["point_kernels"]


def point_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    table, place, slide, TINY = t.table, t.place, t.slide, t.TINY
    BOND_STIFFNESS, STRENGTH = t.BOND_STIFFNESS, t.STRENGTH
    FLANK_STIFFNESS, FRICTION = t.FLANK_STIFFNESS, t.FRICTION
    STATIC_FRICTION, STRIBECK_VELOCITY = t.STATIC_FRICTION, t.STRIBECK_VELOCITY
    UNLOADING_LENGTH, DIRECTION_LENGTH = t.UNLOADING_LENGTH, t.DIRECTION_LENGTH
    RATE_EXPONENT, REFERENCE_SPEED = t.RATE_EXPONENT, t.REFERENCE_SPEED
    SLICE_PUSH_EXPONENT, SKIN_TOUGHNESS = t.SLICE_PUSH_EXPONENT, t.SKIN_TOUGHNESS
    ADHESION, FLANK_VISCOSITY = t.ADHESION, t.FLANK_VISCOSITY
    FLANK_EXPONENT, FLANK_SPEED = t.FLANK_EXPONENT, t.FLANK_SPEED
    INITIATION, INITIATION_DEPTH = t.INITIATION, t.INITIATION_DEPTH
    EDGE_SHARE = t.EDGE_SHARE
    SHOULDER, SPINE, EDGE_RADIUS, HALF_LENGTH = map(
        wp.constant, first(KNIFE, "shoulder", "spine", "edge_radius", "half_length")
    )
    FORCES, MOMENTS = map(wp.constant, first(POINT_SUMS, "forces", "moments"))
    EDGE_LOSS, OPENING_LOSS, FRICTION_LOSS, CUT_AREA = map(
        wp.constant, first(POINT_SUMS, "edge_loss", "opening_loss", "friction_loss", "cut_area")
    )
    # Without gradients, an effect that is off costs nothing; with them its derivative is wanted.
    ALL = wp.constant(gradients)
    LINEAR = wp.constant(real(LINEAR_BELOW**2))

    @wp.func
    def intact_fraction(cohesive_damage: real, onset: real, failure: real):
        """Secant over initial stiffness of a bilinear bond that spent the share
        `cohesive_damage`."""
        share = real(0.0)
        if failure > onset:
            share = (
                onset
                * (real(1.0) - cohesive_damage)
                / (onset + cohesive_damage * (failure - onset))
            )
        return share

    @wp.func
    def wedge(y: real, height: real, cut: wp.int32, knife: wp.array2d(dtype=real)):
        """Distance to flank or spine on one side of the section and its gradient (y, height).

        The side is known, so a point that crossed the middle plane is still pushed back to its own
        side. The bevel at the edge is left out: what it does to the food is the work of the edge,
        which the toughness holds; its steep normal would count that twice, in spikes.
        """
        y1 = knife[cut, SHOULDER]
        h1 = knife[cut, SHOULDER + 1]
        y2 = knife[cut, SPINE]
        h2 = knife[cut, SPINE + 1]
        flank = wp.normalize(vec2(h2 - h1, y1 - y2))
        to_flank = flank[0] * (y - y1) + flank[1] * (wp.max(height, h1) - h1)
        to_spine = height - h2
        phi = wp.max(to_flank, to_spine)
        n = wp.where(to_spine > to_flank, vec2(real(0.0), real(1.0)), flank)
        return phi - knife[cut, EDGE_RADIUS], n

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
        i: wp.int32,
        whole: real,
        width: wp.array2d(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        reach: real,
        per_spacing: real,
        stiffness: real,
        friction_scale: real,
        slip: vec3,
        dt: real,
        cut: wp.int32,
        P: wp.array2d(dtype=real),
        knife: wp.array2d(dtype=real),
    ):
        """Flank pressure and friction on one face of the cut.

        A part of the face's `whole` area is above the edge: `area` now, `old_area` before the
        sub-step. It goes by the depth of the edge below this face, not below the middle of both: a
        piece that is cut off leaves the other where it is. The mean of the flank's thickness over
        that part is that at its centroid, `rise` above the point, for the flank is straight.

        The normal force is minus the gradient of 1/2 stiffness area depth^2, `growth` of the area
        with the depth of the edge included: a knife at rest then puts no energy into a vibration.

        Returns: normal force and friction force on the food, new slip, energy lost by friction,
        area between the ends of the blade.
        """
        arm = p - origin
        knife_y = vec3(R[0, 1], R[1, 1], R[2, 1])
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        relative = v - velocity - wp.cross(rotation_rate, arm) - bend_rate * knife_y
        grid = fraction.shape[1]
        depth = -wp.dot(arm, knife_z)
        k_now, w_now = place(depth, reach, per_spacing, grid)
        k_old, w_old = place(depth + wp.dot(relative, knife_z) * dt, reach, per_spacing, grid)
        area = whole * table(fraction, i, k_now, w_now)
        old_area = whole * table(fraction, i, k_old, w_old)
        growth = table(width, i, k_now, w_now)
        rise = table(centroid, i, k_now, w_now)
        r = wp.transpose(R) * (arm + vec3(real(0.0), real(0.0), rise))
        between = wp.abs(r[0]) < knife[cut, HALF_LENGTH]
        normal_force = vec3()
        friction_force = vec3()
        new_slip = vec3()
        # What the anchor stored, less what it stores when the part in contact has changed.
        lost = real(0.5) * stiffness * old_area * wp.dot(slip, slip)
        if area > real(0.0) and between:
            # Ky points to the minus side when the knife hangs upside down in C.
            facing = wp.where(R[1, 1] < real(0.0), -side, side)
            height = -r[2]
            phi, n2 = wedge(facing * (r[1] - bend), height, cut, knife)
            if phi < real(0.0):
                n = R * vec3(real(0.0), facing * n2[0], -n2[1])
                N = -stiffness * area * phi
                # The part grows at the edge, where the flank is thinner than at the centroid.
                at_edge = stiffness * growth * phi * (real(0.5) * phi - n[2] * height)
                normal_force = N * n + at_edge * knife_z
                sliding = relative - wp.dot(relative, n) * n
                extra = wp.max(P[cut, STATIC_FRICTION] - P[cut, FRICTION], real(0.0))
                mu = P[cut, FRICTION]
                if extra > real(0.0):
                    mu = mu + extra * wp.exp(-wp.length(sliding) / P[cut, STRIBECK_VELOCITY])
                old = slip * wp.min(old_area / area, real(1.0))
                old = old - wp.dot(old, n) * n
                limit = friction_scale * mu * N + P[cut, ADHESION] * area
                anchored, slid = slide(old, sliding * dt, stiffness * area, limit)
                new_slip = anchored
                viscosity = P[cut, FLANK_VISCOSITY] * area
                if ALL or viscosity > real(0.0):
                    ratio = wp.dot(sliding, sliding) / (P[cut, FLANK_SPEED] * P[cut, FLANK_SPEED])
                    power = real(0.5) * (P[cut, FLANK_EXPONENT] - real(1.0))
                    viscosity = viscosity * wp.pow(ratio + LINEAR, power)
                friction_force = -stiffness * area * anchored - viscosity * sliding
                lost = (
                    lost
                    + slid
                    - real(0.5) * stiffness * area * wp.dot(old, old)
                    + viscosity * wp.dot(sliding, sliding) * dt
                )
        return normal_force, friction_force, new_slip, lost, wp.where(between, area, real(0.0))

    @wp.func
    def advance_point(
        cut: wp.int32,
        i: wp.int32,
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        area: wp.array(dtype=real),
        width: wp.array2d(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        outline: wp.array2d(dtype=real),
        surface: wp.array(dtype=real),
        reach: real,
        per_spacing: real,
        toughness: wp.array2d(dtype=real),
        flank_scale: wp.array2d(dtype=real),
        friction_scale: wp.array2d(dtype=real),
        unloading: wp.array2d(dtype=real),
        P: wp.array2d(dtype=real),
        knife: wp.array2d(dtype=real),
        k: wp.int32,
        coupling_step: wp.int32,
        dt: real,
        R_CK: wp.array2d(dtype=mat33),
        p_CK: wp.array2d(dtype=vec3),
        v_CK: wp.array2d(dtype=vec3),
        w_CK: wp.array2d(dtype=vec3),
        blade: wp.array2d(dtype=real),
        edge_depth: wp.array2d(dtype=real),
        cohesive_damage: wp.array2d(dtype=real),
        edge_force: wp.array2d(dtype=real),
        edge_direction: wp.array2d(dtype=vec3),
        slip: wp.array3d(dtype=vec3),
        edge_depth_next: wp.array2d(dtype=real),
        cohesive_damage_next: wp.array2d(dtype=real),
        edge_force_next: wp.array2d(dtype=real),
        edge_direction_next: wp.array2d(dtype=vec3),
        slip_next: wp.array3d(dtype=vec3),
        force: wp.array3d(dtype=vec3),
        lateral: wp.array2d(dtype=real),
        immersed: wp.array3d(dtype=vec4),
        total: wp.array4d(dtype=real),
    ):
        """One cut point, see `points`."""
        w = weights[i]
        xm = x[cut, nodes[i, 0]] * w[0] + x[cut, nodes[i, 1]] * w[1]
        xp = x[cut, nodes[i, 2]] * w[0] + x[cut, nodes[i, 3]] * w[1]
        vm = v[cut, nodes[i, 0]] * w[0] + v[cut, nodes[i, 1]] * w[1]
        vp = v[cut, nodes[i, 2]] * w[0] + v[cut, nodes[i, 3]] * w[1]
        middle = real(0.5) * (xm + xp)
        R = R_CK[cut, k]
        origin = p_CK[cut, k]
        velocity = v_CK[cut, k]
        rotation_rate = w_CK[cut, k]
        knife_x = vec3(R[0, 0], R[1, 0], R[2, 0])
        knife_y = vec3(R[0, 1], R[1, 1], R[2, 1])
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        arm = middle - origin
        motion = (velocity + wp.cross(rotation_rate, arm) - real(0.5) * (vm + vp)) * dt
        A = area[i]
        toughness_i = toughness[cut, i]
        grid = fraction.shape[1]
        # s: depth of the edge below the point. Nothing happens beyond the ends of the blade.
        old_edge_depth = edge_depth[cut, i]
        s = old_edge_depth
        beyond = wp.abs(wp.dot(arm, knife_x)) >= knife[cut, HALF_LENGTH]
        if not beyond:
            s = -wp.dot(arm, knife_z)
        new_edge_depth = wp.max(old_edge_depth, s)
        edge_depth_next[cut, i] = new_edge_depth
        k0, w0 = place(old_edge_depth, reach, per_spacing, grid)
        k1, w1 = place(new_edge_depth, reach, per_spacing, grid)
        D0 = table(fraction, i, k0, w0)
        D = table(fraction, i, k1, w1)

        # Bonds of the part that is not cut; its faces may also press on each other.
        gap = xp - xm
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        length = wp.length(opening)
        bond = P[cut, BOND_STIFFNESS]
        onset = P[cut, STRENGTH] / bond
        failure = real(2.0) * toughness_i / P[cut, STRENGTH]
        old_cohesive_damage = cohesive_damage[cut, i]
        new_cohesive_damage = wp.max(
            old_cohesive_damage,
            wp.clamp((length - onset) / wp.max(failure - onset, TINY), real(0.0), real(1.0)),
        )
        cohesive_damage_next[cut, i] = new_cohesive_damage
        intact = intact_fraction(new_cohesive_damage, onset, failure)
        by_edge = P[cut, EDGE_SHARE]
        stiffness = bond * A * (real(1.0) - by_edge * D) * intact
        closing = bond * A * wp.min(gap[1], real(0.0))
        pull = stiffness * opening + vec3(real(0.0), closing, real(0.0))
        opening_loss = (
            toughness_i
            * A
            * (real(1.0) - by_edge * D0)
            * (new_cohesive_damage - old_cohesive_damage)
        )

        # Edge: a force against the edge's direction d, elastic up to R T (d . n), where R is the
        # toughness that opening left less what the bonds that the edge cuts give up. d follows the
        # knife's own motion: with the food's in it, a drawn edge would feel less force the faster
        # the food moves, and chatter. Behind the deepest point there is a slack and then nothing.
        moved = velocity + wp.cross(rotation_rate, arm)
        along = moved - wp.dot(moved, knife_y) * knife_y
        speed = wp.length(along)
        travel = speed * dt
        old_edge_direction = edge_direction[cut, i]
        followed = old_edge_direction
        if travel > real(0.0):
            keep = wp.exp(-travel / P[cut, DIRECTION_LENGTH])
            followed = keep * old_edge_direction + ((real(1.0) - keep) * dt / travel) * along
        in_plane = followed - wp.dot(followed, knife_y) * knife_y
        size = wp.length(in_plane)
        d = old_edge_direction
        if size > real(1.0e-6):
            d = in_plane / size
        edge_direction_next[cut, i] = d
        bonded = real(0.5) * by_edge * bond * intact * length * length
        left = wp.max(by_edge * toughness_i * (real(1.0) - new_cohesive_damage) - bonded, real(0.0))
        # The edge cuts what its direction has across it; pressing straight, all.
        across = wp.max(wp.dot(d, knife_z), real(0.0))
        effect = across
        if ALL or P[cut, SLICE_PUSH_EXPONENT] != real(1.0):
            # Nothing on the way out, where nothing is across, whatever the exponent.
            exponent = real(2.0) * P[cut, SLICE_PUSH_EXPONENT] - real(2.0)
            effect = across * wp.pow(wp.max(across, real(1.0e-3)), exponent)
        if ALL or P[cut, RATE_EXPONENT] != real(0.0):
            relative_speed = wp.max(speed / P[cut, REFERENCE_SPEED], real(1.0e-3))
            effect = effect * wp.pow(relative_speed, P[cut, RATE_EXPONENT])
        if ALL or P[cut, INITIATION] > real(0.0):
            below = wp.max(surface[i] + new_edge_depth, real(0.0))
            left = left + P[cut, INITIATION] * wp.exp(-below / P[cut, INITIATION_DEPTH])
        resistance = left * table(width, i, k1, w1)
        if ALL or P[cut, SKIN_TOUGHNESS] > real(0.0):
            resistance = resistance + P[cut, SKIN_TOUGHNESS] * table(outline, i, k1, w1)
        spring = wp.max(unloading[cut, i], TINY)
        slack = wp.max(new_edge_depth - s - P[cut, UNLOADING_LENGTH], real(0.0))
        limit = wp.max(resistance * effect - spring * slack, real(0.0))
        if beyond:
            limit = real(0.0)
        q0 = edge_force[cut, i]
        step = wp.dot(d, motion)
        q = wp.clamp(q0 + spring * step, real(0.0), limit)
        edge_force_next[cut, i] = q
        edge = q * d
        edge_loss = q * step - real(0.5) * (q * q - q0 * q0) / spring + bonded * A * (D - D0)

        # Flanks on the part that is cut.
        flank = P[cut, FLANK_STIFFNESS] * flank_scale[cut, i]
        normal_m, friction_m, slip_m, loss_m, area_m = flank_contact(
            xm,
            vm,
            real(-1.0),
            R,
            origin,
            velocity,
            rotation_rate,
            blade[cut, 0],
            blade[cut, 1],
            i,
            A,
            width,
            fraction,
            centroid,
            reach,
            per_spacing,
            flank,
            friction_scale[cut, i],
            slip[cut, i, 0],
            dt,
            cut,
            P,
            knife,
        )
        normal_p, friction_p, slip_p, loss_p, area_p = flank_contact(
            xp,
            vp,
            real(1.0),
            R,
            origin,
            velocity,
            rotation_rate,
            blade[cut, 0],
            blade[cut, 1],
            i,
            A,
            width,
            fraction,
            centroid,
            reach,
            per_spacing,
            flank,
            friction_scale[cut, i],
            slip[cut, i, 1],
            dt,
            cut,
            P,
            knife,
        )
        slip_next[cut, i, 0] = slip_m
        slip_next[cut, i, 1] = slip_p

        force[cut, i, 0] = pull + real(0.5) * edge + normal_m + friction_m
        force[cut, i, 1] = -pull + real(0.5) * edge + normal_p + friction_p

        lateral[cut, i] = -wp.dot(normal_m + normal_p + friction_m + friction_p, knife_y)

        edge_moment = wp.cross(arm, edge)
        normal_moment = wp.cross(xm - origin, normal_m) + wp.cross(xp - origin, normal_p)
        friction_moment = wp.cross(xm - origin, friction_m) + wp.cross(xp - origin, friction_p)
        normal = normal_m + normal_p
        friction = friction_m + friction_p
        for c in range(3):
            total[cut, coupling_step, i, FORCES + c] += -edge[c]
            total[cut, coupling_step, i, FORCES + 3 + c] += -normal[c]
            total[cut, coupling_step, i, FORCES + 6 + c] += -friction[c]
            total[cut, coupling_step, i, MOMENTS + c] += -edge_moment[c]
            total[cut, coupling_step, i, MOMENTS + 3 + c] += -normal_moment[c]
            total[cut, coupling_step, i, MOMENTS + 6 + c] += -friction_moment[c]
        total[cut, coupling_step, i, EDGE_LOSS] += edge_loss
        total[cut, coupling_step, i, OPENING_LOSS] += opening_loss
        total[cut, coupling_step, i, FRICTION_LOSS] += loss_m + loss_p
        total[cut, coupling_step, i, CUT_AREA] = A * D
        a = real(0.5) * (area_m + area_p)
        b = real(0.5) * (area_m * (xm - origin) + area_p * (xp - origin))
        immersed[cut, coupling_step, i] = vec4(b[0], b[1], b[2], a)

    @wp.kernel(enable_backward=gradients, module=module)
    def points(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        area: wp.array(dtype=real),
        width: wp.array2d(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        outline: wp.array2d(dtype=real),
        surface: wp.array(dtype=real),
        reach: real,
        per_spacing: real,
        toughness: wp.array2d(dtype=real),
        flank_scale: wp.array2d(dtype=real),
        friction_scale: wp.array2d(dtype=real),
        unloading: wp.array2d(dtype=real),
        P: wp.array2d(dtype=real),
        knife: wp.array2d(dtype=real),
        k: wp.int32,
        coupling_step: wp.int32,
        dt: real,
        R_CK: wp.array2d(dtype=mat33),
        p_CK: wp.array2d(dtype=vec3),
        v_CK: wp.array2d(dtype=vec3),
        w_CK: wp.array2d(dtype=vec3),
        blade: wp.array2d(dtype=real),
        edge_depth: wp.array2d(dtype=real),
        cohesive_damage: wp.array2d(dtype=real),
        edge_force: wp.array2d(dtype=real),
        edge_direction: wp.array2d(dtype=vec3),
        slip: wp.array3d(dtype=vec3),
        edge_depth_next: wp.array2d(dtype=real),
        cohesive_damage_next: wp.array2d(dtype=real),
        edge_force_next: wp.array2d(dtype=real),
        edge_direction_next: wp.array2d(dtype=vec3),
        slip_next: wp.array3d(dtype=vec3),
        force: wp.array3d(dtype=vec3),
        lateral: wp.array2d(dtype=real),
        immersed: wp.array3d(dtype=vec4),
        total: wp.array4d(dtype=real),
        per_thread: wp.int32,
    ):
        """Edge, opening, self contact, flank contact and friction at each cut point.

        Advances the history: `edge_depth`, the largest depth of the edge below the point;
        `cohesive_damage`, the fraction of the surface energy spent by opening; `edge_force` on the
        food and its direction `edge_direction`; `slip`, from the friction anchors. Adds to `total`
        forces on the knife, their moments about Ko and energies dissipated, and writes the area
        that is cut; see `POINT_SUMS`. Writes to `immersed` the moment about Ko of the part of it
        above the edge, and that part."""
        cut, chunk = wp.tid()
        for i in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, area.shape[0])):
            advance_point(
                cut,
                i,
                x,
                v,
                nodes,
                weights,
                area,
                width,
                fraction,
                centroid,
                outline,
                surface,
                reach,
                per_spacing,
                toughness,
                flank_scale,
                friction_scale,
                unloading,
                P,
                knife,
                k,
                coupling_step,
                dt,
                R_CK,
                p_CK,
                v_CK,
                w_CK,
                blade,
                edge_depth,
                cohesive_damage,
                edge_force,
                edge_direction,
                slip,
                edge_depth_next,
                cohesive_damage_next,
                edge_force_next,
                edge_direction_next,
                slip_next,
                force,
                lateral,
                immersed,
                total,
            )

    @wp.kernel(enable_backward=False, module=module)
    def point_energy(
        x: wp.array2d(dtype=vec3),
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        area: wp.array(dtype=real),
        fraction: wp.array2d(dtype=real),
        centroid: wp.array2d(dtype=real),
        reach: real,
        per_spacing: real,
        toughness: wp.array2d(dtype=real),
        flank_scale: wp.array2d(dtype=real),
        unloading: wp.array2d(dtype=real),
        P: wp.array2d(dtype=real),
        knife: wp.array2d(dtype=real),
        R_CK: wp.array2d(dtype=mat33),
        p_CK: wp.array2d(dtype=vec3),
        k: wp.int32,
        blade: wp.array2d(dtype=real),
        edge_depth: wp.array2d(dtype=real),
        cohesive_damage: wp.array2d(dtype=real),
        edge_force: wp.array2d(dtype=real),
        slip: wp.array3d(dtype=vec3),
        energy: wp.array2d(dtype=real),
    ):
        """Recoverable energy of each cut point."""
        cut, i = wp.tid()
        w = weights[i]
        xm = x[cut, nodes[i, 0]] * w[0] + x[cut, nodes[i, 1]] * w[1]
        xp = x[cut, nodes[i, 2]] * w[0] + x[cut, nodes[i, 3]] * w[1]
        R = R_CK[cut, k]
        A = area[i]
        grid = fraction.shape[1]
        k0, w0 = place(edge_depth[cut, i], reach, per_spacing, grid)
        D = table(fraction, i, k0, w0)
        gap = xp - xm
        bond = P[cut, BOND_STIFFNESS]
        onset = P[cut, STRENGTH] / bond
        failure = real(2.0) * toughness[cut, i] / P[cut, STRENGTH]
        intact = intact_fraction(cohesive_damage[cut, i], onset, failure)
        opening = vec3(gap[0], wp.max(gap[1], real(0.0)), gap[2])
        closing = wp.min(gap[1], real(0.0))
        doubled = (
            bond
            * A
            * (
                (real(1.0) - P[cut, EDGE_SHARE] * D) * intact * wp.dot(opening, opening)
                + closing * closing
            )
        )
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        doubled += edge_force[cut, i] * edge_force[cut, i] / wp.max(unloading[cut, i], TINY)
        facing = real(1.0)
        if R[1, 1] < real(0.0):
            facing = real(-1.0)
        flank = P[cut, FLANK_STIFFNESS] * flank_scale[cut, i]
        for side in range(2):
            p = xm
            sign = -facing
            if side == 1:
                p = xp
                sign = facing
            arm = p - p_CK[cut, k]
            k1, w1 = place(-wp.dot(arm, knife_z), reach, per_spacing, grid)
            share = table(fraction, i, k1, w1)
            rise = table(centroid, i, k1, w1)
            r = wp.transpose(R) * (arm + vec3(real(0.0), real(0.0), rise))
            if share > real(0.0) and wp.abs(r[0]) < knife[cut, HALF_LENGTH]:
                phi, _n = wedge(sign * (r[1] - blade[cut, 0]), -r[2], cut, knife)
                if phi < real(0.0):
                    held = slip[cut, i, side]
                    doubled += flank * A * share * (phi * phi + wp.dot(held, held))
        energy[cut, i] = real(0.5) * doubled

    return types.SimpleNamespace(points=points, point_energy=point_energy)
