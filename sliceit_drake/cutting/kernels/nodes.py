"""Kernels of nodes and blade: gather of forces, semi-implicit Euler step, board, relaxation."""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.lanes import lane_functions
from sliceit_drake.cutting.kernels.layouts import BladeSum
from sliceit_drake.cutting.kernels.types import LANES, Scalar, kernel_types

__all__ = ["node_kernels"]


def node_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec3, vec4, slide, padded, forwards = t.vec3, t.vec4, t.slide, t.padded, t.forwards
    sum8 = lane_functions(real).sum8
    Mesh, Parameters, State, Forces, Sums = t.Mesh, t.Parameters, t.State, t.Forces, t.Sums

    # Nodes slower than this, in m/s, count as at rest.
    REST = wp.constant(real(1.0e-5))

    @wp.func
    def gather_elements(cut: wp.int32, i: wp.int32, mesh: Mesh, forces: Forces):
        """Sum of the element forces on node i.

        Row k of `forces.rows` begins at the k-th number of the elements' forces. Entries come in
        fours, filled up with a row of zeros.
        """
        fx = real(0.0)
        fy = real(0.0)
        fz = real(0.0)
        for e in range(mesh.element_start[i], mesh.element_start[i + 1]):
            four = mesh.element_entry[e]
            a = forces.rows[cut, forwards(four[0])]
            b = forces.rows[cut, forwards(four[1])]
            c = forces.rows[cut, forwards(four[2])]
            d = forces.rows[cut, forwards(four[3])]
            fx += (a[0] + b[0]) + (c[0] + d[0])
            fy += (a[LANES] + b[LANES]) + (c[LANES] + d[LANES])
            fz += (a[2 * LANES] + b[2 * LANES]) + (c[2 * LANES] + d[2 * LANES])
        return vec3(fx, fy, fz)

    @wp.func
    def gather_points(cut: wp.int32, i: wp.int32, mesh: Mesh, forces: Forces):
        """Sum of the forces of the cut points on node i."""
        f = vec3()
        for e in range(mesh.point_start[i], mesh.point_start[i + 1]):
            a = forces.point_rows[cut, forwards(mesh.point_entry[e])]
            f += vec3(a[0], a[LANES], a[2 * LANES]) * mesh.point_weight[e]
        return f

    @wp.func
    def relax(
        cut: wp.int32, i: wp.int32, force: vec3, parameters: Parameters, now: State, after: State
    ):
        """Force of the bulk on node i after relaxation, from that of the instantaneous moduli.

        Each Maxwell branch carries its fraction of the force less what has relaxed: `overstress`,
        the force filtered with the branch's time."""
        f = force
        for m in range(parameters.relaxing.shape[1]):
            overstress = (
                parameters.keep[cut, m] * now.overstress[cut, m, i]
                + (real(1.0) - parameters.keep[cut, m]) * force
            )
            after.overstress[cut, m, i] = overstress
            f = f - parameters.relaxing[cut, m] * overstress
        return f

    @wp.func
    def step_node(
        cut: wp.int32,
        i: wp.int32,
        internal: vec3,
        external: vec3,
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        sums: Sums,
    ):
        """One node, semi-implicit Euler; board contact, sums over the launch.

        A fraction of the unbalanced force opposes the node's motion (Cundall's local damping): none
        in equilibrium, however fast the motion, and the more the larger the inertia."""
        P = parameters.P
        xi = now.x[cut, i]
        vi = now.v[cut, i]
        inverse_mass = parameters.inverse_mass[cut, i]
        board_area = mesh.board_area[i]
        f = internal + external
        pressed = real(0.0)
        on_food = vec3()
        loss = real(0.0)
        n = vec3(mesh.board[0], mesh.board[1], mesh.board[2])
        if board_area > real(0.0):
            depth = mesh.board[3] - wp.dot(n, xi)
            stiffness = P[cut, Scalar.BOARD_STIFFNESS] * board_area
            old = now.board_slip[cut, i]
            new_slip = vec3()
            loss = real(0.5) * stiffness * wp.dot(old, old)
            if depth > real(0.0):
                sliding = (vi - wp.dot(vi, n) * n) * dt
                limit = P[cut, Scalar.BOARD_FRICTION] * stiffness * depth
                anchored, lost = slide(old, sliding, stiffness, limit)
                new_slip = anchored
                loss = lost
                pressed = stiffness * depth
                on_food = pressed * n - stiffness * anchored
            after.board_slip[cut, i] = new_slip
        resultant = f + on_food
        speed = wp.length(vi)
        drag = vec3()
        if speed > real(0.0):
            damping = parameters.local_damping[cut, i]
            drag = vi * (-damping * wp.length(resultant) / (speed + REST))
        v1 = vi + (resultant + drag) * (inverse_mass * dt)
        if pressed > real(0.0):
            # The board damps the normal motion, implicitly, and does not pull.
            per_force = inverse_mass * dt
            viscosity = (
                P[cut, Scalar.BOARD_STIFFNESS] * board_area * P[cut, Scalar.BOARD_DAMPING_TIME]
            )
            normal = wp.dot(v1, n)
            damped = wp.max(
                normal / (real(1.0) + viscosity * per_force), normal - pressed * per_force
            )
            v1 = v1 + (damped - normal) * n
            force = (damped - normal) / per_force
            on_food = on_food + force * n
            moved = real(0.5) * (wp.dot(vi, n) + damped) * dt
            loss = loss + wp.max(-force * moved, real(0.0))
        if board_area > real(0.0):
            sums.board_force[cut, i] += on_food
            sums.board_loss[cut, i] += loss
        # Trapezoidal rule for the work along the path, summed by parts.
        sums.internal_work[cut, i] += real(0.5) * wp.dot(internal + drag, vi + v1) * dt
        x1 = xi + v1 * dt
        after.v[cut, i] = v1
        after.x[cut, i] = x1
        after.ahead[cut, i] = padded(x1 + P[cut, Scalar.DAMPING_TIME] * v1)

    @wp.kernel(enable_backward=False, module=module)
    def move_nodes(
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        state: State,
        forces: Forces,
        sums: Sums,
        per_thread: wp.int32,
    ):
        """Gathers the forces of each moving node and steps it in place."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            force = gather_elements(cut, i, mesh, forces)
            internal = relax(cut, i, force, parameters, state, state)
            external = parameters.weight[cut, i] + gather_points(cut, i, mesh, forces)
            step_node(cut, i, internal, external, dt, mesh, parameters, state, state, sums)

    # Sums in loops have kernels of their own: an adjoint would not know their value after the loop.
    @wp.kernel(enable_backward=gradients, module=module)
    def push_blade(forces: Forces):
        """Force of the flanks on the blade."""
        cut = wp.tid()
        F = real(0.0)
        for i in range(forces.lateral.shape[1]):
            F += sum8(forces.lateral[cut, i])
        forces.push[cut] = F

    @wp.kernel(enable_backward=gradients, module=module)
    def bend_blade(
        coupling_step: wp.int32,
        dt: real,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
    ):
        """Steps the blade's lateral deflection and its rate, pushed by the flanks.

        Adds to `sums.blade`, see `BLADE_SUMS`.
        """
        cut = wp.tid()
        F = forces.push[cut]
        m = parameters.P[cut, Scalar.BLADE_MASS]
        c = parameters.P[cut, Scalar.BLADE_DAMPING]
        k = parameters.P[cut, Scalar.BLADE_STIFFNESS]
        pushed = now.blade[cut, 1] + dt * (F - k * now.blade[cut, 0]) / m
        rate = pushed / (real(1.0) + dt * c / m)
        deflection = now.blade[cut, 0] + dt * rate
        after.blade[cut, 1] = rate
        after.blade[cut, 0] = deflection
        sums.blade[cut, coupling_step, BladeSum.LOSS] += c * rate * rate * dt
        sums.blade[cut, coupling_step, BladeSum.ON_KNIFE] += k * deflection + c * rate
        sums.blade[cut, coupling_step, BladeSum.ON_BLADE] += F

    out = types.SimpleNamespace(move_nodes=move_nodes, push_blade=push_blade, bend_blade=bend_blade)
    if not gradients:
        return out

    @wp.kernel(enable_backward=False, module=module)
    def gather(mesh: Mesh, forces: Forces, per_thread: wp.int32):
        """Gathers the forces of each moving node, for `step_nodes`."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            forces.from_elements[cut, i] = gather_elements(cut, i, mesh, forces)
            forces.from_points[cut, i] = gather_points(cut, i, mesh, forces)

    @wp.kernel(enable_backward=gradients, module=module)
    def relax_nodes(
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
        per_thread: wp.int32,
    ):
        """Force of the bulk on each moving node after relaxation, for `step_nodes`."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            force = forces.from_elements[cut, i]
            forces.from_bulk[cut, i] = relax(cut, i, force, parameters, now, after)

    @wp.kernel(enable_backward=gradients, module=module)
    def step_nodes(
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
        per_thread: wp.int32,
    ):
        """Steps the nodes as `move_nodes` does, into other arrays, so that it has an adjoint."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            internal = forces.from_bulk[cut, i]
            external = parameters.weight[cut, i] + forces.from_points[cut, i]
            step_node(cut, i, internal, external, dt, mesh, parameters, now, after, sums)

    @wp.kernel(enable_backward=False, module=module)
    def gather_adjoint(
        mesh: Mesh, forces: Forces, adj_ahead: wp.array2d(dtype=vec4), per_thread: wp.int32
    ):
        """Adds the elements' adjoints of `ahead`, in `forces`, to those of moving nodes."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            adjoint = gather_elements(cut, i, mesh, forces)
            adj_ahead[cut, i] = adj_ahead[cut, i] + padded(adjoint)

    out.gather, out.relax_nodes = gather, relax_nodes
    out.step_nodes, out.gather_adjoint = step_nodes, gather_adjoint
    return out
