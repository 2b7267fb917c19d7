"""Kernels of nodes and blade: gather of forces, semi-implicit Euler step, board, relaxation."""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.inertia import WIDTH
from sliceit_drake.cutting.kernels.lanes import lane_functions
from sliceit_drake.cutting.kernels.layouts import BladeSum, Front, PointTotal
from sliceit_drake.cutting.kernels.types import LANES, Scalar, kernel_types

__all__ = ["node_kernels"]

LEAST_SPREAD = 5e-4
"""Half width below which the food at the front of a cut counts as level, metres."""


def node_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec3, vec4, slide, padded, forwards = t.vec3, t.vec4, t.slide, t.padded, t.forwards
    sum8 = lane_functions(real).sum8
    Mesh, Parameters, State, Forces, Sums = t.Mesh, t.Parameters, t.State, t.Forces, t.Sums
    Inertia, Results, entries = t.Inertia, t.Results, t.entries
    real_name = "float" if real is wp.float32 else "double"
    LEAST_WIDTH, LEAST_FORCE = wp.constant(real(1.0e-6)), wp.constant(real(1.0e-9))
    LEVER = wp.constant(real(LEAST_SPREAD**2))
    Motion = t.Motion

    @wp.func_native(
        f"""
        typedef {real_name} Real;
        const int *start = mesh.element_start.data, *at = (const int*)mesh.element_entry.data;
        const Real* F = (const Real*)((const char*)forces.rows.data + cut * forces.rows.strides[0]);
        Real x = 0, y = 0, z = 0;
        for (int e = 4 * start[i]; e < 4 * start[i + 1]; e += 4) {{
            const Real *a = F + at[e], *b = F + at[e + 1], *c = F + at[e + 2], *d = F + at[e + 3];
            x += (a[0] + b[0]) + (c[0] + d[0]);
            y += (a[{LANES}] + b[{LANES}]) + (c[{LANES}] + d[{LANES}]);
            z += (a[{2 * LANES}] + b[{2 * LANES}]) + (c[{2 * LANES}] + d[{2 * LANES}]);
        }}
        return {{x, y, z}};
        """
    )
    def gather_elements(cut: wp.int32, i: wp.int32, mesh: Mesh, forces: Forces) -> vec3:
        """Sum of the element forces on node i.

        Row k of `forces.rows` begins at the k-th number of the elements' forces. Entries come in
        fours, filled up with a row of zeros.
        """
        ...

    @wp.func
    def gather_points(cut: wp.int32, i: wp.int32, mesh: Mesh, forces: Forces):
        """Sum of the forces of the cut points on node i."""
        f = vec3()
        for e in range(mesh.point_start[i], mesh.point_start[i + 1]):
            a = forces.point_rows[cut, forwards(mesh.point_entry[e])]
            f += vec3(a[0], a[LANES], a[2 * LANES]) * mesh.point_weight[e]
        return f

    @wp.func
    def on_board(
        cut: wp.int32,
        i: wp.int32,
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        sums: Sums,
    ):
        """Force of the board on node i: pressure with damping that never pulls, and friction."""
        P = parameters.P
        force = vec3()
        area = mesh.board_area[i]
        if area > real(0.0):
            n = vec3(mesh.board[0], mesh.board[1], mesh.board[2])
            v = now.v[cut, i]
            depth = mesh.board[3] - wp.dot(n, now.x[cut, i])
            stiffness = P[cut, Scalar.BOARD_STIFFNESS] * area
            old = now.board_slip[cut, i]
            new_slip = vec3()
            loss = real(0.5) * stiffness * wp.dot(old, old)
            if depth > real(0.0):
                rising = wp.dot(v, n)
                elastic = stiffness * depth
                viscosity = stiffness * P[cut, Scalar.BOARD_DAMPING_TIME]
                pressure = wp.max(elastic - viscosity * rising, real(0.0))
                limit = P[cut, Scalar.BOARD_FRICTION] * pressure
                anchored, lost = slide(old, (v - rising * n) * dt, stiffness, limit)
                new_slip = anchored
                force = pressure * n - stiffness * anchored
                loss = lost + wp.max((elastic - pressure) * rising * dt, real(0.0))
            after.board_slip[cut, i] = new_slip
            sums.board_force[cut, i] += force
            sums.board_loss[cut, i] += loss
        return force

    @wp.func
    def load(
        cut: wp.int32,
        entry: wp.int32,
        elements: vec3,
        points: vec3,
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
    ):
        """Forces on a moving node, from those of elements, by instantaneous moduli, and cut points.

        Each Maxwell branch carries its fraction of the elements' less what has relaxed:
        `overstress`, the force filtered with the branch's time."""
        i = forwards(mesh.moving[entry])
        internal = elements
        for m in range(parameters.relaxing.shape[1]):
            overstress = (
                parameters.keep[cut, m] * now.overstress[cut, m, i]
                + (real(1.0) - parameters.keep[cut, m]) * elements
            )
            after.overstress[cut, m, i] = overstress
            internal = internal - parameters.relaxing[cut, m] * overstress
        external = parameters.weight[cut, i] + points
        external += on_board(cut, i, dt, mesh, parameters, now, after, sums)
        forces.from_bulk[cut, i] = internal
        forces.resultant[cut, entry] = padded(internal + external)

    @wp.kernel(enable_backward=False, module=module)
    def load_nodes(
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        state: State,
        forces: Forces,
        sums: Sums,
        per_thread: wp.int32,
    ):
        """Gathers the forces on each moving node."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            elements = gather_elements(cut, i, mesh, forces)
            points = gather_points(cut, i, mesh, forces)
            load(cut, entry, elements, points, dt, mesh, parameters, state, state, forces, sums)

    # By hand: in Warp's own language its four sums do not become vectors, and take twice as long.
    @wp.func_native(
        f"""
        typedef {real_name} Real;
        const int* begin = start.data;
        const int* at = (const int*)index.data;
        const Real* L = (const Real*)((const char*)values.data + cut * values.strides[0]);
        const Real* D = (const Real*)((const char*)scale.data + cut * scale.strides[0]);
        const Real* B = (const Real*)((const char*)b.data + cut * b.strides[0]);
        Real* Y = (Real*)((char*)y.data + cut * y.strides[0]);
        const int count = backwards ? scale.shape[1] : y.shape[1];
        for (int k = 0; k < count; ++k) {{
            const int row = backwards ? count - 1 - k : k;
            const Real factor = backwards ? D[row] : Real(1);
            Real s0[4], s1[4] = {{0, 0, 0, 0}}, s2[4] = {{0, 0, 0, 0}}, s3[4] = {{0, 0, 0, 0}};
            for (int c = 0; c < 4; ++c) s0[c] = factor * B[4 * row + c];
            for (int e = 4 * begin[row]; e < 4 * begin[row + 1]; e += 4) {{
                const Real *y0 = Y + 4 * at[e], *y1 = Y + 4 * at[e + 1];
                const Real *y2 = Y + 4 * at[e + 2], *y3 = Y + 4 * at[e + 3];
                for (int c = 0; c < 4; ++c) {{
                    s0[c] -= L[e] * y0[c];
                    s1[c] -= L[e + 1] * y1[c];
                    s2[c] -= L[e + 2] * y2[c];
                    s3[c] -= L[e + 3] * y3[c];
                }}
            }}
            for (int c = 0; c < 4; ++c) Y[4 * row + c] = (s0[c] + s1[c]) + (s2[c] + s3[c]);
        }}
        """
    )
    def substitute(
        cut: wp.int32,
        backwards: wp.bool,
        start: wp.array(dtype=wp.int32),
        index: wp.array(dtype=entries),
        values: wp.array2d(dtype=vec4),
        scale: wp.array2d(dtype=real),
        b: wp.array2d(dtype=vec4),
        y: wp.array2d(dtype=vec4),
    ): ...

    # Sums of as many as a vector holds, by component.
    @wp.func_native(
        f"""
        typedef {real_name} Real;
        const int count = S.last.shape[1], before = y.shape[1] - count;
        const int stride = S.inverse.shape[1] / count;
        const Real* W = (const Real*)((const char*)S.inverse.data + cut * S.inverse.strides[0]);
        Real* B = (Real*)((char*)S.last.data + cut * S.last.strides[0]);
        Real* Y = (Real*)((char*)y.data + cut * y.strides[0]) + 4 * before;
        for (int k = 0; k < 4 * count; ++k) B[k] = Y[k];
        for (int i = 0; i < count; i += {WIDTH}) {{
            Real s0[{WIDTH}] = {{0}}, s1[{WIDTH}] = {{0}}, s2[{WIDTH}] = {{0}};
            for (int j = 0; j < count; ++j) {{
                const Real* w = W + j * stride + i;
                for (int c = 0; c < {WIDTH}; ++c) s0[c] += w[c] * B[4 * j];
                for (int c = 0; c < {WIDTH}; ++c) s1[c] += w[c] * B[4 * j + 1];
                for (int c = 0; c < {WIDTH}; ++c) s2[c] += w[c] * B[4 * j + 2];
            }}
            const int rows = count - i < {WIDTH} ? count - i : {WIDTH};
            for (int c = 0; c < rows; ++c) {{
                Y[4 * (i + c)] = s0[c];
                Y[4 * (i + c) + 1] = s1[c];
                Y[4 * (i + c) + 2] = s2[c];
            }}
        }}
        """
    )
    def multiply_last(cut: wp.int32, S: Inertia, y: wp.array2d(dtype=vec4)):
        """Multiplies the last rows of y with their inverse, which is symmetric."""
        ...

    # Sums of four, which become vectors.
    @wp.func_native(
        f"""
        typedef {real_name} Real;
        const Real* M = (const Real*)((const char*)mass.data + cut * mass.strides[0]);
        const Real* B = (const Real*)((const char*)b.data + cut * b.strides[0]);
        const Real* Y = (const Real*)((const char*)y.data + cut * y.strides[0]);
        Real sum[4] = {{0, 0, 0, 0}};
        for (int k = 0; k < mass.shape[1]; ++k)
            for (int c = 0; c < 4; ++c) {{
                const Real force = B[4 * k + c] - M[k] * Y[4 * k + c];
                sum[c] += force < Real(0) ? -force : force;
            }}
        return sum[0] + sum[1] + sum[2];
        """
    )
    def sum_added(
        cut: wp.int32,
        mass: wp.array2d(dtype=real),
        b: wp.array2d(dtype=vec4),
        y: wp.array2d(dtype=vec4),
    ) -> real: ...

    @wp.kernel(enable_backward=False, module=module)
    def weigh_added_inertia(
        k: wp.int32, parameters: Parameters, motion: Motion, forces: Forces, results: Results
    ):
        """Sums the forces of the inertia that is added to the true masses, S a - M a."""
        cut = wp.tid()
        total = sum_added(cut, parameters.mass, forces.resultant, forces.acceleration)
        results.added_force[cut, (k + motion.done[0]) / motion.substeps] = wp.float64(total)

    @wp.kernel(enable_backward=False, module=module)
    def solve(S: Inertia, b: wp.array2d(dtype=vec4), y: wp.array2d(dtype=vec4)):
        """Solves S y = b by the factors of S, which is symmetric: its own adjoint."""
        cut = wp.tid()
        d = S.inverse_pivot
        substitute(cut, False, S.lower_start, S.lower_index, S.lower, d, b, y)
        multiply_last(cut, S, y)
        substitute(cut, True, S.upper_start, S.upper_index, S.upper, d, y, y)

    @wp.kernel(enable_backward=False, module=module)
    def multiply(S: Inertia, b: wp.array2d(dtype=vec4), y: wp.array2d(dtype=vec4)):
        """Solves S y = b where all rows of S are inverted: a thread for each row, on a GPU."""
        cut, row = wp.tid()
        stride = S.inverse.shape[1] // b.shape[1]
        total = vec4()
        for k in range(b.shape[1]):
            total += S.inverse[cut, k * stride + row] * b[cut, k]
        y[cut, row] = total

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
        """Semi-implicit Euler step of each moving node."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            a = forces.acceleration[cut, entry]
            vi = now.v[cut, i]
            v1 = vi + dt * vec3(a[0], a[1], a[2])
            x1 = now.x[cut, i] + dt * v1
            # Trapezoidal rule for the work along the path, summed by parts.
            internal = forces.from_bulk[cut, i]
            sums.internal_work[cut, i] += real(0.5) * wp.dot(internal, vi + v1) * dt
            after.v[cut, i] = v1
            after.x[cut, i] = x1
            after.ahead[cut, i] = padded(x1 + parameters.P[cut, Scalar.DAMPING_TIME] * v1)

    @wp.func
    def along_y(motion: Motion, cut: wp.int32, k: wp.int32):
        """Whether Ky is along y of C or against it: to the cosine of the blade's lean, which the
        model bounds, they are the same direction."""
        across = motion.R_CK[cut, k + motion.done[0]][1, 1]
        return wp.where(across < real(0.0), real(-1.0), real(1.0))

    @wp.func
    def follow_front(
        cut: wp.int32,
        dt: real,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
    ):
        """Steps the front of the cut, see `FRONT`, from the totals over the points."""
        P = parameters.P
        width = forces.totals[cut, PointTotal.WIDTH]
        slope = now.front[cut, Front.SLOPE]
        sunk = now.front[cut, Front.SUNK]
        old_drift = now.front[cut, Front.DRIFT]
        drift = old_drift
        if width > LEAST_WIDTH:
            # The straight line that is nearest to the displacements.
            place = forces.totals[cut, PointTotal.PLACE] / width
            spread = forces.totals[cut, PointTotal.SQUARE] / width - place * place
            mean = forces.totals[cut, PointTotal.SUNK] / width
            leant = forces.totals[cut, PointTotal.LEANT] / width - place * mean
            slope = leant / (wp.max(spread, real(0.0)) + LEVER)
            sunk = mean - slope * place
            drawn = forces.totals[cut, PointTotal.DRAWN] / width
            travel = forces.totals[cut, PointTotal.TRAVEL] / width
            kept = wp.exp(-travel * P[cut, Scalar.DRIFT_RATE])
            drift = drawn + kept * (old_drift - drawn)
        after.front[cut, Front.SLOPE] = slope
        after.front[cut, Front.SUNK] = sunk
        after.front[cut, Front.DRIFT] = drift
        lead = P[cut, Scalar.DRIFT_LEAD] * (drift - old_drift) / dt
        after.front[cut, Front.DRIFT_AHEAD] = drift + lead
        debt = now.front[cut, Front.DEBT] + forces.totals[cut, PointTotal.OWED]
        after.front[cut, Front.DEBT] = debt
        least = wp.max(forces.totals[cut, PointTotal.LIMIT], LEAST_FORCE)
        raised = debt / (P[cut, Scalar.DEBT_LENGTH] * least)
        after.front[cut, Front.RAISED] = wp.clamp(raised, real(-0.5), real(1.0))

    # Sums in loops have kernels of their own: an adjoint would not know their value after the loop.
    @wp.kernel(enable_backward=gradients, module=module)
    def push_blade(
        k: wp.int32,
        parameters: Parameters,
        motion: Motion,
        now: State,
        forces: Forces,
    ):
        """Force of the flanks on the blade, and its resultant with spring and damper along y."""
        cut = wp.tid()
        F = real(0.0)
        for i in range(forces.at_points.shape[1]):
            F += sum8(forces.at_points[cut, i, PointTotal.PUSH])
        forces.totals[cut, PointTotal.PUSH] = F
        F -= parameters.P[cut, Scalar.BLADE_STIFFNESS] * now.blade[cut, 0]
        F -= parameters.P[cut, Scalar.BLADE_DAMPING] * now.blade[cut, 1]
        last = forces.resultant.shape[1] - 1
        F *= along_y(motion, cut, k)
        forces.resultant[cut, last] = vec4(real(0.0), F, real(0.0), real(0.0))

    @wp.kernel(enable_backward=gradients, module=module)
    def total_points(forces: Forces):
        """Totals over the cut points but for the push, which `push_blade` needs before."""
        cut = wp.tid()
        for j in range(wp.static(PointTotal.PUSH + 1), wp.static(len(PointTotal))):
            total = real(0.0)
            for i in range(forces.at_points.shape[1]):
                total += sum8(forces.at_points[cut, i, j])
            forces.totals[cut, j] = total

    @wp.kernel(enable_backward=gradients, module=module)
    def step_blade_and_front(
        k: wp.int32,
        dt: real,
        parameters: Parameters,
        motion: Motion,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
    ):
        """Steps the blade's lateral deflection and its rate, pushed by the flanks, and the front.

        Adds to `sums.blade`, see `BLADE_SUMS`.
        """
        cut = wp.tid()
        F = forces.totals[cut, PointTotal.PUSH]
        c = parameters.P[cut, Scalar.BLADE_DAMPING]
        stiffness = parameters.P[cut, Scalar.BLADE_STIFFNESS]
        last = forces.acceleration.shape[1] - 1
        a = forces.acceleration[cut, last]
        rate = now.blade[cut, 1] + dt * a[1] * along_y(motion, cut, k)
        deflection = now.blade[cut, 0] + dt * rate
        after.blade[cut, 1] = rate
        after.blade[cut, 0] = deflection
        e = (k + motion.done[0]) / motion.substeps
        sums.blade[cut, e, BladeSum.LOSS] += c * rate * rate * dt
        sums.blade[cut, e, BladeSum.ON_KNIFE] += stiffness * deflection + c * rate
        sums.blade[cut, e, BladeSum.ON_BLADE] += F
        follow_front(cut, dt, parameters, now, after, forces)

    out = types.SimpleNamespace(
        load_nodes=load_nodes,
        push_blade=push_blade,
        solve=solve,
        multiply=multiply,
        weigh_added_inertia=weigh_added_inertia,
        step_nodes=step_nodes,
        total_points=total_points,
        step_blade_and_front=step_blade_and_front,
    )
    if not gradients:
        return out

    @wp.kernel(enable_backward=False, module=module)
    def gather(mesh: Mesh, forces: Forces, per_thread: wp.int32):
        """Gathers the forces of elements and points on each moving node, for `sum_forces`."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            forces.from_elements[cut, i] = gather_elements(cut, i, mesh, forces)
            forces.from_points[cut, i] = gather_points(cut, i, mesh, forces)

    @wp.kernel(enable_backward=gradients, module=module)
    def sum_forces(
        dt: real,
        mesh: Mesh,
        parameters: Parameters,
        now: State,
        after: State,
        forces: Forces,
        sums: Sums,
        per_thread: wp.int32,
    ):
        """With `gather` what `load_nodes` does, into other arrays, so that it has an adjoint."""
        cut, chunk = wp.tid()
        end = wp.min((chunk + 1) * per_thread, mesh.moving.shape[0])
        for entry in range(chunk * per_thread, end):
            i = forwards(mesh.moving[entry])
            elements, points = forces.from_elements[cut, i], forces.from_points[cut, i]
            load(cut, entry, elements, points, dt, mesh, parameters, now, after, forces, sums)

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

    out.gather, out.sum_forces, out.gather_adjoint = gather, sum_forces, gather_adjoint
    return out
