"""Kernels of nodes and blade: gather of forces, semi-implicit Euler step, board, relaxation."""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.layouts import BLADE_SUMS, first
from sliceit_drake.cutting.kernels.types import LANES, kernel_types

__all__ = ["node_kernels"]


def node_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec2, vec3, vec4, strided, entries = t.vec2, t.vec3, t.vec4, t.strided, t.entries
    slide, padded = t.slide, t.padded
    DAMPING_TIME, BOARD_STIFFNESS = t.DAMPING_TIME, t.BOARD_STIFFNESS
    BOARD_FRICTION, BOARD_DAMPING_TIME = t.BOARD_FRICTION, t.BOARD_DAMPING_TIME
    BLADE_STIFFNESS, BLADE_DAMPING, BLADE_MASS = t.BLADE_STIFFNESS, t.BLADE_DAMPING, t.BLADE_MASS

    LOSS, ON_KNIFE, ON_BLADE = map(wp.constant, first(BLADE_SUMS, "loss", "on_knife", "on_blade"))

    # Nodes slower than this, in m/s, count as at rest.
    REST = wp.constant(real(1.0e-5))

    @wp.func
    def gather_elements(
        cut: wp.int32,
        i: wp.int32,
        force: wp.array2d(dtype=strided),
        start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=entries),
    ):
        """Sum of the element forces on node i.

        Row k of `force` begins at the k-th number of the elements' forces. Entries come in fours,
        filled up with a row of zeros.
        """
        fx = real(0.0)
        fy = real(0.0)
        fz = real(0.0)
        for e in range(start[i], start[i + 1]):
            four = entry[e]
            a = force[cut, four[0]]
            b = force[cut, four[1]]
            c = force[cut, four[2]]
            d = force[cut, four[3]]
            fx += (a[0] + b[0]) + (c[0] + d[0])
            fy += (a[LANES] + b[LANES]) + (c[LANES] + d[LANES])
            fz += (a[2 * LANES] + b[2 * LANES]) + (c[2 * LANES] + d[2 * LANES])
        return vec3(fx, fy, fz)

    @wp.func
    def gather_points(
        cut: wp.int32,
        i: wp.int32,
        force: wp.array2d(dtype=vec3),
        start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=real),
    ):
        """Sum of the forces of the cut points on node i."""
        f = vec3()
        for e in range(start[i], start[i + 1]):
            f += force[cut, entry[e]] * weight[e]
        return f

    @wp.func
    def relax(
        cut: wp.int32,
        i: wp.int32,
        force: vec3,
        share: wp.array2d(dtype=real),
        keep: wp.array2d(dtype=real),
        overstress: wp.array3d(dtype=vec3),
        overstress_next: wp.array3d(dtype=vec3),
    ):
        """Force of the bulk on node i after relaxation, from that of the instantaneous moduli.

        Each Maxwell branch carries its fraction of the force less what has relaxed: `overstress`,
        the force filtered with the branch's time."""
        f = force
        for m in range(share.shape[1]):
            new_overstress = (
                keep[cut, m] * overstress[cut, m, i] + (real(1.0) - keep[cut, m]) * force
            )
            overstress_next[cut, m, i] = new_overstress
            f = f - share[cut, m] * new_overstress
        return f

    @wp.func
    def step_node(
        cut: wp.int32,
        i: wp.int32,
        internal: vec3,
        external: vec3,
        xi: vec3,
        vi: vec3,
        inverse_mass: real,
        local_damping: real,
        board_area: real,
        board: wp.array(dtype=real),
        P: wp.array2d(dtype=real),
        dt: real,
        board_slip: wp.array2d(dtype=vec3),
        board_slip_next: wp.array2d(dtype=vec3),
        board_force: wp.array2d(dtype=vec3),
        board_loss: wp.array2d(dtype=real),
        internal_work: wp.array2d(dtype=real),
    ):
        """Velocity after the sub-step; board contact, sums over the launch.

        A fraction of the unbalanced force opposes the node's motion (Cundall's local damping): none
        in equilibrium, however fast the motion, and the more the larger the inertia."""
        f = internal + external
        pressed = real(0.0)
        on_food = vec3()
        loss = real(0.0)
        n = vec3(board[0], board[1], board[2])
        if board_area > real(0.0):
            depth = board[3] - wp.dot(n, xi)
            stiffness = P[cut, BOARD_STIFFNESS] * board_area
            old = board_slip[cut, i]
            new_slip = vec3()
            loss = real(0.5) * stiffness * wp.dot(old, old)
            if depth > real(0.0):
                sliding = (vi - wp.dot(vi, n) * n) * dt
                limit = P[cut, BOARD_FRICTION] * stiffness * depth
                anchored, lost = slide(old, sliding, stiffness, limit)
                new_slip = anchored
                loss = lost
                pressed = stiffness * depth
                on_food = pressed * n - stiffness * anchored
            board_slip_next[cut, i] = new_slip
        resultant = f + on_food
        speed = wp.length(vi)
        drag = vec3()
        if speed > real(0.0):
            drag = vi * (-local_damping * wp.length(resultant) / (speed + REST))
        v1 = vi + (resultant + drag) * (inverse_mass * dt)
        if pressed > real(0.0):
            # The board damps the normal motion, implicitly, and does not pull.
            per_force = inverse_mass * dt
            damping = P[cut, BOARD_STIFFNESS] * board_area * P[cut, BOARD_DAMPING_TIME]
            normal = wp.dot(v1, n)
            damped = wp.max(
                normal / (real(1.0) + damping * per_force), normal - pressed * per_force
            )
            v1 = v1 + (damped - normal) * n
            force = (damped - normal) / per_force
            on_food = on_food + force * n
            moved = real(0.5) * (wp.dot(vi, n) + damped) * dt
            loss = loss + wp.max(-force * moved, real(0.0))
        if board_area > real(0.0):
            board_force[cut, i] += on_food
            board_loss[cut, i] += loss
        # Trapezoidal rule for the work along the path, summed by parts.
        internal_work[cut, i] += real(0.5) * wp.dot(internal + drag, vi + v1) * dt
        return v1

    @wp.kernel(enable_backward=False, module=module)
    def move_nodes(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        moving: wp.array(dtype=wp.int32),
        element_force: wp.array2d(dtype=strided),
        element_start: wp.array(dtype=wp.int32),
        element_entry: wp.array(dtype=entries),
        point_force: wp.array2d(dtype=vec3),
        point_start: wp.array(dtype=wp.int32),
        point_entry: wp.array(dtype=wp.int32),
        point_weight: wp.array(dtype=real),
        inverse_mass: wp.array2d(dtype=real),
        local_damping: wp.array2d(dtype=real),
        weight: wp.array2d(dtype=vec3),
        relaxing: wp.array2d(dtype=real),
        keep: wp.array2d(dtype=real),
        board_area: wp.array(dtype=real),
        board: wp.array(dtype=real),
        P: wp.array2d(dtype=real),
        dt: real,
        overstress: wp.array3d(dtype=vec3),
        board_slip: wp.array2d(dtype=vec3),
        board_force: wp.array2d(dtype=vec3),
        board_loss: wp.array2d(dtype=real),
        internal_work: wp.array2d(dtype=real),
        ahead: wp.array2d(dtype=vec4),
        per_thread: wp.int32,
    ):
        """Gathers the forces of each moving node and steps it in place, semi-implicit Euler."""
        cut, chunk = wp.tid()
        for entry in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, moving.shape[0])):
            i = moving[entry]
            force = gather_elements(cut, i, element_force, element_start, element_entry)
            internal = relax(cut, i, force, relaxing, keep, overstress, overstress)
            external = weight[cut, i] + gather_points(
                cut, i, point_force, point_start, point_entry, point_weight
            )
            xi = x[cut, i]
            v1 = step_node(
                cut,
                i,
                internal,
                external,
                xi,
                v[cut, i],
                inverse_mass[cut, i],
                local_damping[cut, i],
                board_area[i],
                board,
                P,
                dt,
                board_slip,
                board_slip,
                board_force,
                board_loss,
                internal_work,
            )
            x1 = xi + v1 * dt
            v[cut, i] = v1
            x[cut, i] = x1
            ahead[cut, i] = padded(x1 + P[cut, DAMPING_TIME] * v1)

    # Sums in loops have kernels of their own: an adjoint would not know their value after the loop.
    @wp.kernel(enable_backward=gradients, module=module)
    def push_blade(lateral: wp.array2d(dtype=real), push: wp.array(dtype=real)):
        """Force of the flanks on the blade."""
        cut = wp.tid()
        F = real(0.0)
        for i in range(lateral.shape[1]):
            F += lateral[cut, i]
        push[cut] = F

    @wp.kernel(enable_backward=gradients, module=module)
    def bend_blade(
        push: wp.array(dtype=real),
        P: wp.array2d(dtype=real),
        coupling_step: wp.int32,
        dt: real,
        blade: wp.array2d(dtype=real),
        blade_next: wp.array2d(dtype=real),
        blade_sums: wp.array3d(dtype=real),
    ):
        """Steps the blade's lateral deflection and its rate, pushed by the flanks.

        Adds to `blade_sums`, see `BLADE_SUMS`.
        """
        cut = wp.tid()
        F = push[cut]
        m = P[cut, BLADE_MASS]
        c = P[cut, BLADE_DAMPING]
        k = P[cut, BLADE_STIFFNESS]
        pushed = blade[cut, 1] + dt * (F - k * blade[cut, 0]) / m
        rate = pushed / (real(1.0) + dt * c / m)
        deflection = blade[cut, 0] + dt * rate
        blade_next[cut, 1] = rate
        blade_next[cut, 0] = deflection
        blade_sums[cut, coupling_step, LOSS] += c * rate * rate * dt
        blade_sums[cut, coupling_step, ON_KNIFE] += k * deflection + c * rate
        blade_sums[cut, coupling_step, ON_BLADE] += F

    out = types.SimpleNamespace(move_nodes=move_nodes, push_blade=push_blade, bend_blade=bend_blade)
    if not gradients:
        return out

    @wp.kernel(enable_backward=False, module=module)
    def gather(
        moving: wp.array(dtype=wp.int32),
        element_force: wp.array2d(dtype=strided),
        element_start: wp.array(dtype=wp.int32),
        element_entry: wp.array(dtype=entries),
        point_force: wp.array2d(dtype=vec3),
        point_start: wp.array(dtype=wp.int32),
        point_entry: wp.array(dtype=wp.int32),
        point_weight: wp.array(dtype=real),
        from_elements: wp.array2d(dtype=vec3),
        from_points: wp.array2d(dtype=vec3),
        per_thread: wp.int32,
    ):
        """Gathers the forces of each moving node, for `step_nodes`."""
        cut, chunk = wp.tid()
        for entry in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, moving.shape[0])):
            i = moving[entry]
            from_elements[cut, i] = gather_elements(
                cut, i, element_force, element_start, element_entry
            )
            from_points[cut, i] = gather_points(
                cut, i, point_force, point_start, point_entry, point_weight
            )

    @wp.kernel(enable_backward=gradients, module=module)
    def relax_nodes(
        moving: wp.array(dtype=wp.int32),
        from_elements: wp.array2d(dtype=vec3),
        relaxing: wp.array2d(dtype=real),
        keep: wp.array2d(dtype=real),
        overstress: wp.array3d(dtype=vec3),
        overstress_next: wp.array3d(dtype=vec3),
        internal: wp.array2d(dtype=vec3),
        per_thread: wp.int32,
    ):
        """Force of the bulk on each moving node after relaxation, for `step_nodes`."""
        cut, chunk = wp.tid()
        for entry in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, moving.shape[0])):
            i = moving[entry]
            force = from_elements[cut, i]
            internal[cut, i] = relax(cut, i, force, relaxing, keep, overstress, overstress_next)

    @wp.kernel(enable_backward=gradients, module=module)
    def step_nodes(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        moving: wp.array(dtype=wp.int32),
        from_bulk: wp.array2d(dtype=vec3),
        from_points: wp.array2d(dtype=vec3),
        inverse_mass: wp.array2d(dtype=real),
        local_damping: wp.array2d(dtype=real),
        weight: wp.array2d(dtype=vec3),
        board_area: wp.array(dtype=real),
        board: wp.array(dtype=real),
        P: wp.array2d(dtype=real),
        dt: real,
        board_slip: wp.array2d(dtype=vec3),
        board_slip_next: wp.array2d(dtype=vec3),
        board_force: wp.array2d(dtype=vec3),
        board_loss: wp.array2d(dtype=real),
        internal_work: wp.array2d(dtype=real),
        x_next: wp.array2d(dtype=vec3),
        v_next: wp.array2d(dtype=vec3),
        ahead_next: wp.array2d(dtype=vec4),
        per_thread: wp.int32,
    ):
        """Steps the nodes as `move_nodes` does, into other arrays, so that it has an adjoint."""
        cut, chunk = wp.tid()
        for entry in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, moving.shape[0])):
            i = moving[entry]
            internal = from_bulk[cut, i]
            external = weight[cut, i] + from_points[cut, i]
            xi = x[cut, i]
            v1 = step_node(
                cut,
                i,
                internal,
                external,
                xi,
                v[cut, i],
                inverse_mass[cut, i],
                local_damping[cut, i],
                board_area[i],
                board,
                P,
                dt,
                board_slip,
                board_slip_next,
                board_force,
                board_loss,
                internal_work,
            )
            x1 = xi + v1 * dt
            v_next[cut, i] = v1
            x_next[cut, i] = x1
            ahead_next[cut, i] = padded(x1 + P[cut, DAMPING_TIME] * v1)

    @wp.kernel(enable_backward=False, module=module)
    def gather_adjoint(
        moving: wp.array(dtype=wp.int32),
        change: wp.array2d(dtype=strided),
        element_start: wp.array(dtype=wp.int32),
        element_entry: wp.array(dtype=entries),
        adj_ahead: wp.array2d(dtype=vec4),
        per_thread: wp.int32,
    ):
        """Adds the elements' adjoints of `ahead` to those of moving nodes."""
        cut, chunk = wp.tid()
        for entry in range(chunk * per_thread, wp.min((chunk + 1) * per_thread, moving.shape[0])):
            i = moving[entry]
            adjoint = gather_elements(cut, i, change, element_start, element_entry)
            adj_ahead[cut, i] = adj_ahead[cut, i] + padded(adjoint)

    @wp.kernel(enable_backward=False, module=module)
    def spread_adjoint(
        nodes: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=vec2),
        adj_from_points: wp.array2d(dtype=vec3),
        adj_force: wp.array3d(dtype=vec3),
    ):
        """Adjoint of the forces of the cut points, from those of the nodes that gather them."""
        cut, i = wp.tid()
        w = weights[i]
        for side in range(2):
            adj_force[cut, i, side] = (
                adj_from_points[cut, nodes[i, 2 * side]] * w[0]
                + adj_from_points[cut, nodes[i, 2 * side + 1]] * w[1]
            )

    out.gather, out.relax_nodes, out.step_nodes = gather, relax_nodes, step_nodes
    out.gather_adjoint, out.spread_adjoint = gather_adjoint, spread_adjoint
    return out
