"""Kernels of the cut points: edge, bonds, flank contact, friction, adhesion; and their energy.

Points are handled eight a thread with eight-wide vectors: where one of them chooses, all compute
both sides.
"""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.foods.effects import LINEAR_BELOW
from sliceit_drake.cutting.kernels.lanes import lane_functions
from sliceit_drake.cutting.kernels.layouts import Front, PointSum, PointTotal, Section
from sliceit_drake.cutting.kernels.types import LANES, Scalar, kernel_types

__all__ = ["point_kernels"]

LEVEL_RISE = 1e-4
"""Least difference of height between the ends of a piece of skin, m."""


def point_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec2, vec3, mat33, TINY = t.vec2, t.vec3, t.mat33, t.TINY
    lanes, indices, Vectors = t.lanes, t.indices, t.Vectors
    f = lane_functions(real)
    dot8, cross8, scaled8, length8 = f.dot8, f.cross8, f.scaled8, f.length8
    forwards = t.forwards
    exp8, pow8, where8, gathered8 = f.exp8, f.pow8, f.where8, f.gathered8
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
    def positive8(a: lanes):
        return wp.max(a, lanes(real(0.0)))

    @wp.func
    def share8(a: lanes):
        """Limited to [0, 1]."""
        return wp.min(positive8(a), lanes(real(1.0)))

    @wp.func
    def all8(a: vec3):
        return wp.outer(a, lanes(real(1.0)))

    @wp.func
    def place8(s: lanes, points: Points):
        """Intervals of the tables, and the fractions of their ends, where the edge is s below."""
        u = (s + lanes(points.reach)) * points.per_spacing
        k = indices()
        start = lanes()
        for lane in range(LANES):
            k[lane] = wp.clamp(wp.int32(wp.floor(u[lane])), 0, points.fraction.shape[1] - 2)
            start[lane] = real(k[lane])
        return k, share8(u - start)

    @wp.func
    def table8(values: wp.array2d(dtype=real), block: wp.int32, k: indices, w: lanes):
        a = lanes()
        b = lanes()
        for lane in range(LANES):
            row = forwards(LANES * block + lane)
            column = forwards(k[lane])
            a[lane] = values[row, column]
            b[lane] = values[row, column + 1]
        return a + wp.cw_mul(b - a, w)

    @wp.func
    def number8(values: wp.array2d(dtype=lanes), cut: wp.int32, point: indices):
        a = lanes()
        for lane in range(LANES):
            n = forwards(point[lane])
            a[lane] = values[cut, n / LANES][n % LANES]
        return a

    @wp.func
    def under8(a: lanes, b: lanes, thickness: real):
        """Integral of 1 - u where a + (b - a) u, u in [0, 1], is from 0 to the thickness.

        What is level is taken to rise a little, so that the edge's spring can follow the force.
        """
        one = lanes(real(1.0))
        level = one * real(LEVEL_RISE)
        rise = b - a
        rise = where8(wp.max(rise, -rise) - level, rise, level)
        u = share8(wp.cw_div(-a, rise))
        w = share8(wp.cw_div(one * thickness - a, rise))
        part = w - u - (wp.cw_mul(w, w) - wp.cw_mul(u, u)) * real(0.5)
        return wp.max(part, -part)

    @wp.func
    def intact_fraction8(damage: lanes, onset: real, failure: lanes):
        """Secant over initial stiffness of bilinear bonds that spent the share `damage`."""
        one = lanes(real(1.0))
        opens = failure - one * onset
        below = one * onset + wp.cw_mul(damage, positive8(opens))
        return where8(opens, wp.cw_div((one - damage) * onset, below), lanes())

    @wp.func
    def wedge8(y: lanes, height: lanes, share: lanes, cut: wp.int32, parameters: Parameters):
        """Distance to flank or spine on one side of the section and its gradient, y and height; and
        the thickness of the flank continued to the edge.

        The flank counts with the part `share` of its thickness, but with its own direction.

        The side is known, so a point that crossed the middle plane is still pushed back to its own
        side. The bevel at the edge is left out, and the flank goes on to the edge: what the bevel
        does to the food is the work of the edge, which the toughness holds; its steep normal would
        count that twice, in spikes.
        """
        one = lanes(real(1.0))
        y1 = parameters.knife[cut, Section.SHOULDER]
        h1 = parameters.knife[cut, Section.SHOULDER + 1]
        y2 = parameters.knife[cut, Section.SPINE]
        h2 = parameters.knife[cut, Section.SPINE + 1]
        flank = wp.normalize(vec2(h2 - h1, y1 - y2))
        radius = parameters.knife[cut, Section.EDGE_RADIUS]
        at_edge = y1 * flank[0] + h1 * flank[1] + radius
        to_flank = y * flank[0] - wp.cw_mul(share, one * at_edge - height * flank[1])
        to_spine = height - one * (h2 + radius)
        spine = to_spine - to_flank
        phi = wp.max(to_flank, to_spine)
        n_y = where8(spine, lanes(), one * flank[0])
        return phi, n_y, where8(spine, one, one * flank[1]), at_edge

    @wp.func
    def slide8(slip: Vectors, step: Vectors, stiffness: lanes, limit: lanes, damping: real):
        """Coulomb friction by an elastic anchor with damping, a number of sub-steps, up to a limit.

        Returns: force over stiffness, new slip, energy lost.
        """
        one = lanes(real(1.0))
        trial = slip + step * (real(1.0) + damping)
        length = length8(trial)
        reach = wp.cw_div(limit, wp.max(stiffness, one * TINY))
        kept = wp.cw_div(reach, where8(length - reach, length, one))
        held = scaled8(where8(length - reach, kept, one), trial)
        new_slip = (held + slip * damping) / (real(1.0) + damping)
        change = new_slip - slip
        lost = dot8(held, step - change) + dot8(change, change) * (damping + real(0.5))
        return held, new_slip, wp.cw_mul(stiffness, lost)

    @wp.func
    def on_face8(
        field: wp.array2d(dtype=vec3),
        cut: wp.int32,
        block: wp.int32,
        face: wp.int32,
        points: Points,
    ):
        """A field of the nodes at the cut points, on the minus (0) or plus (1) side of the cut."""
        a = gathered8(field, cut, points.nodes[block, 2 * face])
        b = gathered8(field, cut, points.nodes[block, 2 * face + 1])
        return scaled8(points.weights[block, 0], a) + scaled8(points.weights[block, 1], b)

    @wp.func
    def outwards(R: mat33, face: wp.int32):
        """Sign of Ky that points to a face's side of the cut: Ky points to the minus side when the
        knife hangs upside down in C."""
        return wp.where((R[1, 1] < real(0.0)) == (face == 0), real(1.0), real(-1.0))

    # With adjoints inlining gains nothing and doubles the compiler's time.
    @wp.func(inline=not gradients)
    def flank_contact(
        cut: wp.int32,
        block: wp.int32,
        face: wp.int32,
        p: Vectors,
        v: Vectors,
        knife: KnifePose,
        whole: lanes,
        stiffness: lanes,
        anchor: lanes,
        dt: real,
        points: Points,
        parameters: Parameters,
        now: State,
    ):
        """Flank pressure and friction on one face of the cut.

        A part of the face's area is above the edge: `area` now, `old_area` before the sub-step. It
        goes by the depth of the edge below this face, not below the middle of both: a piece that is
        cut off leaves the other where it is. The mean of the flank's thickness over that part is
        that at its centroid, `rise` above the point, for the flank is straight. Ahead of the edge
        the cut is closed: what the flank asks of the point is the mean over all of its area. A
        sliver that the edge has just passed would else open all of it at once, and the force would
        hardly converge with the stiffness.

        The normal force is minus the gradient of 1/2 stiffness area depth^2, `growth` of the area
        with the depth of the edge included: a knife at rest then puts no energy into a vibration.

        Returns: normal force and friction force on the food, new slip, energy lost by friction
        and by the damping of the contact, area between the ends of the blade.
        """
        P = parameters.P
        one = lanes(real(1.0))
        arm = p - all8(knife.p)
        knife_y = vec3(knife.R[0, 1], knife.R[1, 1], knife.R[2, 1])
        knife_z = vec3(knife.R[0, 2], knife.R[1, 2], knife.R[2, 2])
        bending = now.blade[cut, 1] * knife_y
        moved = all8(knife.v + bending) + wp.skew(knife.w) * arm
        relative = v - moved
        slip = now.slip[cut, block, face]
        depth = -(knife_z * arm)
        k_now, w_now = place8(depth, points)
        k_old, w_old = place8(depth + (knife_z * relative) * dt, points)
        share = table8(points.fraction, block, k_now, w_now)
        area = wp.cw_mul(whole, share)
        old_area = wp.cw_mul(whole, table8(points.fraction, block, k_old, w_old))
        growth = table8(points.width, block, k_now, w_now)
        rise = table8(points.centroid, block, k_now, w_now)
        r = wp.transpose(knife.R) * (arm + wp.matrix_from_rows(lanes(), lanes(), rise))
        between = one * parameters.knife[cut, Section.HALF_LENGTH] - wp.max(r[0], -r[0])
        between_area = where8(between, area, lanes())
        facing = outwards(knife.R, face)
        height = -r[2]
        y = (r[1] - one * now.blade[cut, 0]) * facing
        phi, n_y, n_h, at_edge = wedge8(y, height, share, cut, parameters)
        touching = where8(-phi, between_area, lanes())
        held = wp.cw_mul(anchor, touching)
        n = wp.outer(knife_y, n_y * facing) - wp.outer(knife_z, n_h)
        pressing = wp.cw_mul(stiffness, touching)
        apart = dot8(relative, n)
        elastic = -wp.cw_mul(pressing, phi)
        N = positive8(elastic - wp.cw_mul(pressing, apart) * (P[cut, Scalar.CONTACT_DAMPING] * dt))
        # The part grows at the edge, by what is as thick as the flank is there.
        grows = wp.cw_mul(phi, phi * real(0.5) - share * at_edge)
        down = wp.cw_mul(wp.cw_mul(stiffness, growth), grows) - wp.cw_mul(wp.cw_mul(N, n_h), share)
        normal_force = wp.outer(knife_y, wp.cw_mul(N, n_y) * facing)
        normal_force = normal_force + wp.outer(knife_z, where8(touching, down, lanes()))
        sliding = relative - scaled8(apart, n)
        extra = wp.max(P[cut, Scalar.STATIC_FRICTION] - P[cut, Scalar.FRICTION], real(0.0))
        mu = one * P[cut, Scalar.FRICTION]
        if extra > real(0.0):
            # By the knife's own speed: with the food's in it, friction that falls with the speed
            # would drive a vibration, the faster the shorter the step.
            speed = length8(moved - scaled8(dot8(moved, n), n))
            mu = mu + exp8(speed / -P[cut, Scalar.STRIBECK_VELOCITY]) * extra
        kept = wp.cw_div(old_area, where8(area, area, one))
        old = scaled8(wp.min(kept, one), slip)
        old = old - scaled8(dot8(old, n), n)
        limit = wp.cw_mul(wp.cw_mul(parameters.friction_scale[cut, block], mu), N)
        limit = limit + touching * P[cut, Scalar.ADHESION]
        damping = P[cut, Scalar.CONTACT_DAMPING]
        anchored, kept_slip, slid = slide8(old, sliding * dt, held, limit, damping)
        viscosity = touching * P[cut, Scalar.FLANK_VISCOSITY]
        if ALL or P[cut, Scalar.FLANK_VISCOSITY] > real(0.0):
            ratio = dot8(sliding, sliding) / (
                P[cut, Scalar.FLANK_SPEED] * P[cut, Scalar.FLANK_SPEED]
            )
            power = real(0.5) * (P[cut, Scalar.FLANK_EXPONENT] - real(1.0))
            viscosity = wp.cw_mul(viscosity, pow8(ratio + one * LINEAR, power))
        friction_force = -scaled8(held, anchored) - scaled8(viscosity, sliding)
        new_slip = scaled8(where8(touching, one, lanes()), kept_slip)
        # What the anchor stored, less what it stores when the part in contact has changed.
        stored = wp.cw_mul(wp.cw_mul(anchor, old_area), dot8(slip, slip))
        stored = stored - wp.cw_mul(held, dot8(old, old))
        lost = stored * real(0.5) + slid
        lost = lost + wp.cw_mul(viscosity, dot8(sliding, sliding)) * dt
        lost = lost + wp.cw_mul(elastic - N, apart) * dt
        return normal_force, friction_force, new_slip, lost, between_area

    @wp.func(inline=not gradients)
    def advance_points(
        cut: wp.int32,
        block: wp.int32,
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
        """Eight cut points, see `step_points`."""
        P = parameters.P
        one = lanes(real(1.0))
        xm = on_face8(now.x, cut, block, 0, points)
        xp = on_face8(now.x, cut, block, 1, points)
        vm = on_face8(now.v, cut, block, 0, points)
        vp = on_face8(now.v, cut, block, 1, points)
        knife = KnifePose(
            motion.R_CK[cut, k], motion.p_CK[cut, k], motion.v_CK[cut, k], motion.w_CK[cut, k]
        )
        knife_x = vec3(knife.R[0, 0], knife.R[1, 0], knife.R[2, 0])
        knife_y = vec3(knife.R[0, 1], knife.R[1, 1], knife.R[2, 1])
        knife_z = vec3(knife.R[0, 2], knife.R[1, 2], knife.R[2, 2])
        arm = (xm + xp) * real(0.5) - all8(knife.p)
        moved = all8(knife.v) + wp.skew(knife.w) * arm
        advance = (moved - (vm + vp) * real(0.5)) * dt
        A = points.area[block]
        toughness = parameters.toughness[cut, block]
        # s: depth of the edge below the point in the food at rest, whose displacement at the edge
        # is `at_front`; with the point's own one the T would not sum to the width. Nothing happens
        # beyond the ends of the blade.
        old_depth = now.edge_depth[cut, block]
        along_edge = knife_x * arm
        half = one * parameters.knife[cut, Section.HALF_LENGTH]
        within = half - wp.max(along_edge, -along_edge)
        rest = points.rest[block]
        at_front = one * now.front[cut, Front.SUNK] + rest[0] * now.front[cut, Front.SLOPE]
        s = where8(within, knife_z * (all8(knife.p) - rest) - at_front, old_depth)
        depth = wp.max(old_depth, s)
        after.edge_depth[cut, block] = depth
        k0, w0 = place8(old_depth, points)
        k1, w1 = place8(depth, points)
        D0 = table8(points.fraction, block, k0, w0)
        D = table8(points.fraction, block, k1, w1)

        # Bonds of the part that is not cut; its faces may also press on each other.
        gap = xp - xm
        opening = wp.matrix_from_rows(gap[0], positive8(gap[1]), gap[2])
        length = length8(opening)
        bond = P[cut, Scalar.BOND_STIFFNESS]
        onset = P[cut, Scalar.STRENGTH] / bond
        failure = toughness * (real(2.0) / P[cut, Scalar.STRENGTH])
        old_damage = now.cohesive_damage[cut, block]
        opens = wp.max(failure - one * onset, one * TINY)
        damage = wp.max(old_damage, share8(wp.cw_div(length - one * onset, opens)))
        after.cohesive_damage[cut, block] = damage
        intact = intact_fraction8(damage, onset, failure)
        by_edge = P[cut, Scalar.EDGE_SHARE]
        stiffness = wp.cw_mul(wp.cw_mul(A, one - D * by_edge), intact) * bond
        closing = wp.cw_mul(A, wp.min(gap[1], lanes())) * bond
        pull = scaled8(stiffness, opening) + wp.matrix_from_rows(lanes(), closing, lanes())
        spent = wp.cw_mul(one - D0 * by_edge, damage - old_damage)
        opening_loss = wp.cw_mul(wp.cw_mul(toughness, A), spent)

        # Edge: a force against the edge's direction d, elastic up to R T (d . n), where R is the
        # toughness that opening left less what the bonds that the edge cuts give up. d follows the
        # knife's own motion on its way in, past the drift of food that slides: with the local
        # velocity of the food in it, a drawn edge would feel less force the faster the food moves,
        # and chatter. Behind the deepest point the limit falls as the force does.
        along = moved - wp.outer(knife_y, knife_y * moved)
        along = along - wp.outer(knife_x, one * now.front[cut, Front.DRIFT_AHEAD])
        speed = length8(along)
        inwards = knife_z * along + speed * real(1.0e-3)
        travel = where8(inwards, speed * dt, lanes())
        old_direction = now.edge_direction[cut, block]
        keep = exp8(travel / -P[cut, Scalar.DIRECTION_LENGTH])
        follow = wp.cw_div((one - keep) * dt, where8(travel, travel, one))
        followed = scaled8(keep, old_direction) + scaled8(follow, along)
        in_plane = followed - wp.outer(knife_y, knife_y * followed)
        size = length8(in_plane)
        sized = size - one * real(1.0e-6)
        unit = scaled8(wp.cw_div(one, where8(sized, size, one)), in_plane)
        d = wp.matrix_from_rows(
            where8(sized, unit[0], old_direction[0]),
            where8(sized, unit[1], old_direction[1]),
            where8(sized, unit[2], old_direction[2]),
        )
        after.edge_direction[cut, block] = d
        bonded = wp.cw_mul(intact, wp.cw_mul(length, length)) * (real(0.5) * by_edge * bond)
        left = positive8(wp.cw_mul(toughness, one - damage) * by_edge - bonded)
        # The edge cuts what its direction has across it; pressing straight, all.
        across = positive8(knife_z * d)
        worth = one
        if ALL or P[cut, Scalar.SLICE_PUSH_EXPONENT] != real(1.0):
            exponent = real(2.0) * P[cut, Scalar.SLICE_PUSH_EXPONENT] - real(2.0)
            worth = pow8(wp.max(across, one * real(1.0e-3)), exponent)
        if ALL or P[cut, Scalar.RATE_EXPONENT] != real(0.0):
            relative_speed = wp.max(speed / P[cut, Scalar.REFERENCE_SPEED], one * real(1.0e-3))
            worth = wp.cw_mul(worth, pow8(relative_speed, P[cut, Scalar.RATE_EXPONENT]))
        if ALL or P[cut, Scalar.INITIATION] > real(0.0):
            below = positive8(points.depth[block] + depth)
            started = exp8(below / -P[cut, Scalar.INITIATION_DEPTH])
            left = left + started * P[cut, Scalar.INITIATION]
        width = table8(points.width, block, k1, w1)
        resistance = wp.cw_mul(left, width)
        due = wp.cw_mul(wp.cw_mul(left, A), D - D0)
        resistance = wp.cw_mul(wp.cw_mul(worth, across), resistance)
        spring = wp.max(parameters.unloading[cut, block], one * TINY)
        limit = positive8(
            resistance * (real(1.0) + now.front[cut, Front.RAISED]) - wp.cw_mul(spring, depth - s)
        )
        # A skin bends ahead of the front: it holds, and gives way, where the edge meets it. Of the
        # outline to the points beside counts what the edge has entered by up to the thickness. They
        # are taken to have moved as this one: a limit that lags behind drives a vibration.
        old_skin_depth = now.skin_depth[cut, block]
        below_skin = -(knife_z * arm)
        skin_depth = wp.max(old_skin_depth, where8(within, below_skin, old_skin_depth))
        after.skin_depth[cut, block] = skin_depth
        if ALL or P[cut, Scalar.SKIN_TOUGHNESS] > real(0.0):
            thickness = P[cut, Scalar.SKIN_THICKNESS]
            skin = lanes()
            for j in range(2):
                entered = points.lower[block, j] * thickness + (skin_depth - old_skin_depth)
                beside = number8(now.last_skin_depth, cut, points.beside[block, j]) + entered
                part = under8(old_skin_depth + entered, beside, thickness)
                skin = skin + wp.cw_mul(points.outline[block, j], part)
            skin = skin * (P[cut, Scalar.SKIN_TOUGHNESS] / thickness)
            due = due + wp.cw_mul(skin, wp.min(skin_depth - old_skin_depth, one * thickness))
            skin = wp.cw_mul(wp.cw_mul(worth, across), skin)
            resistance = resistance + skin
            # In this order of the two, a skin of nothing has the gradient of some.
            limit = limit + wp.max(lanes(), skin - wp.cw_mul(spring, skin_depth - below_skin))
        limit = where8(within, limit, lanes())
        q0 = now.edge_force[cut, block]
        step = dot8(d, advance)
        q = wp.min(positive8(q0 + wp.cw_mul(spring, step)), limit)
        after.edge_force[cut, block] = q
        edge = scaled8(q, d)
        returned = wp.cw_div(wp.cw_mul(q, q) - wp.cw_mul(q0, q0), spring) * real(0.5)
        cut_bonds = wp.cw_mul(wp.cw_mul(bonded, A), D - D0)
        paid = wp.cw_mul(q, step) - returned
        edge_loss = paid + cut_bonds

        # Flanks on the part that is cut.
        flank = parameters.flank_scale[cut, block] * P[cut, Scalar.FLANK_STIFFNESS]
        anchor = parameters.flank_scale[cut, block] * P[cut, Scalar.ANCHOR_STIFFNESS]
        normal_m, friction_m, slip_m, loss_m, area_m = flank_contact(
            cut, block, 0, xm, vm, knife, A, flank, anchor, dt, points, parameters, now
        )
        normal_p, friction_p, slip_p, loss_p, area_p = flank_contact(
            cut, block, 1, xp, vp, knife, A, flank, anchor, dt, points, parameters, now
        )
        after.slip[cut, block, 0] = slip_m
        after.slip[cut, block, 1] = slip_p

        half_edge = edge * real(0.5)
        forces.points[cut, block, 0] = half_edge + pull + normal_m + friction_m
        forces.points[cut, block, 1] = half_edge - pull + normal_p + friction_p

        normal = normal_m + normal_p
        friction = friction_m + friction_p
        drawn = (knife_x * (vm + vp)) * real(0.5)
        forces.at_points[cut, block, PointTotal.PUSH] = -(knife_y * (normal + friction))
        forces.at_points[cut, block, PointTotal.DRAWN] = wp.cw_mul(width, drawn)
        forces.at_points[cut, block, PointTotal.TRAVEL] = wp.cw_mul(width, travel)
        forces.at_points[cut, block, PointTotal.LIMIT] = resistance
        forces.at_points[cut, block, PointTotal.OWED] = wp.cw_mul(worth, due) - paid

        to_m = xm - all8(knife.p)
        to_p = xp - all8(knife.p)
        edge_moment = cross8(arm, edge)
        normal_moment = cross8(to_m, normal_m) + cross8(to_p, normal_p)
        friction_moment = cross8(to_m, friction_m) + cross8(to_p, friction_p)
        e = k / motion.substeps
        for c in range(3):
            sums.points[cut, e, block, PointSum.FORCES + c] += -edge[c]
            sums.points[cut, e, block, PointSum.FORCES + 3 + c] += -normal[c]
            sums.points[cut, e, block, PointSum.FORCES + 6 + c] += -friction[c]
            sums.points[cut, e, block, PointSum.MOMENTS + c] += -edge_moment[c]
            sums.points[cut, e, block, PointSum.MOMENTS + 3 + c] += -normal_moment[c]
            sums.points[cut, e, block, PointSum.MOMENTS + 6 + c] += -friction_moment[c]
        sums.points[cut, e, block, PointSum.EDGE_LOSS] += edge_loss
        sums.points[cut, e, block, PointSum.OPENING_LOSS] += opening_loss
        sums.points[cut, e, block, PointSum.FRICTION_LOSS] += loss_m + loss_p
        sums.points[cut, e, block, PointSum.CUT_AREA] = wp.cw_mul(A, D)
        b = scaled8(area_m, to_m) + scaled8(area_p, to_p)
        for c in range(3):
            sums.points[cut, e, block, PointSum.BURIED_MOMENT + c] = b[c] * real(0.5)
        sums.points[cut, e, block, PointSum.BURIED_AREA] = (area_m + area_p) * real(0.5)

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

        Advances the history of the points. Adds to `sums.points` forces on the knife, their
        moments about Ko and energies dissipated, and writes the area that is cut, the moment about
        Ko of the part of it above the edge, and that part; see `POINT_SUMS`."""
        cut, chunk = wp.tid()
        step = k + motion.done[0]
        for i in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, points.area.shape[0])):
            advance_points(cut, i, step, dt, points, parameters, motion, now, after, forces, sums)

    @wp.kernel(enable_backward=gradients, module=module)
    def place_points(
        k: wp.int32,
        points: Points,
        motion: Motion,
        after: State,
        forces: Forces,
        per_thread: wp.int32,
    ):
        """What each cut point adds to the place of the front, where sub-step k has moved it.

        A front that lags behind the nodes by a sub-step drives a vibration."""
        cut, chunk = wp.tid()
        R = motion.R_CK[cut, k + motion.done[0]]
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        for i in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, points.area.shape[0])):
            after.last_skin_depth[cut, i] = after.skin_depth[cut, i]
            k1, w1 = place8(after.edge_depth[cut, i], points)
            width = table8(points.width, i, k1, w1)
            middle = (
                on_face8(after.x, cut, i, 0, points) + on_face8(after.x, cut, i, 1, points)
            ) * real(0.5)
            sunk = knife_z * (middle - points.rest[i])
            weighted = wp.cw_mul(width, points.rest[i][0])
            forces.at_points[cut, i, PointTotal.WIDTH] = width
            forces.at_points[cut, i, PointTotal.PLACE] = weighted
            forces.at_points[cut, i, PointTotal.SQUARE] = wp.cw_mul(weighted, points.rest[i][0])
            forces.at_points[cut, i, PointTotal.SUNK] = wp.cw_mul(width, sunk)
            forces.at_points[cut, i, PointTotal.LEANT] = wp.cw_mul(weighted, sunk)

    @wp.kernel(enable_backward=False, module=module)
    def point_energy(
        points: Points, parameters: Parameters, motion: Motion, state: State, energies: Energies
    ):
        """Recoverable energy of each cut point, the knife at its pose in the first sub-step."""
        cut, block = wp.tid()
        P = parameters.P
        one = lanes(real(1.0))
        R = motion.R_CK[cut, 0]
        A = points.area[block]
        k0, w0 = place8(state.edge_depth[cut, block], points)
        D = table8(points.fraction, block, k0, w0)
        gap = on_face8(state.x, cut, block, 1, points) - on_face8(state.x, cut, block, 0, points)
        bond = P[cut, Scalar.BOND_STIFFNESS]
        onset = P[cut, Scalar.STRENGTH] / bond
        failure = parameters.toughness[cut, block] * (real(2.0) / P[cut, Scalar.STRENGTH])
        intact = intact_fraction8(state.cohesive_damage[cut, block], onset, failure)
        opening = wp.matrix_from_rows(gap[0], positive8(gap[1]), gap[2])
        closing = wp.min(gap[1], lanes())
        uncut = wp.cw_mul(one - D * P[cut, Scalar.EDGE_SHARE], intact)
        stretched = wp.cw_mul(uncut, dot8(opening, opening)) + wp.cw_mul(closing, closing)
        doubled = wp.cw_mul(A, stretched) * bond
        knife_z = vec3(R[0, 2], R[1, 2], R[2, 2])
        edge = state.edge_force[cut, block]
        spring = wp.max(parameters.unloading[cut, block], one * TINY)
        doubled = doubled + wp.cw_div(wp.cw_mul(edge, edge), spring)
        scale = parameters.flank_scale[cut, block]
        for face in range(2):
            arm = on_face8(state.x, cut, block, face, points) - all8(motion.p_CK[cut, 0])
            k1, w1 = place8(-(knife_z * arm), points)
            share = table8(points.fraction, block, k1, w1)
            rise = table8(points.centroid, block, k1, w1)
            r = wp.transpose(R) * (arm + wp.matrix_from_rows(lanes(), lanes(), rise))
            between = one * parameters.knife[cut, Section.HALF_LENGTH] - wp.max(r[0], -r[0])
            y = (r[1] - one * state.blade[cut, 0]) * outwards(R, face)
            phi, _n_y, _n_h, _at_edge = wedge8(y, -r[2], share, cut, parameters)
            held = state.slip[cut, block, face]
            touching = where8(-phi, where8(between, wp.cw_mul(A, share), lanes()), lanes())
            pressed = wp.cw_mul(phi, phi) * P[cut, Scalar.FLANK_STIFFNESS]
            pressed = pressed + dot8(held, held) * P[cut, Scalar.ANCHOR_STIFFNESS]
            doubled = doubled + wp.cw_mul(wp.cw_mul(scale, touching), pressed)
        energies.points[cut, block] = doubled * real(0.5)

    out = types.SimpleNamespace(
        step_points=step_points, place_points=place_points, point_energy=point_energy
    )
    if not gradients:
        return out

    @wp.kernel(enable_backward=False, module=module)
    def spread_adjoint(
        points: Points,
        adj_from_points: wp.array2d(dtype=vec3),
        adj_force: wp.array3d(dtype=Vectors),
    ):
        """Adjoint of the forces of the cut points, from those of the nodes that gather them."""
        cut, block = wp.tid()
        for face in range(2):
            adj_force[cut, block, face] = on_face8(adj_from_points, cut, block, face, points)

    out.spread_adjoint = spread_adjoint
    return out
