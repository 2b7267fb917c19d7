"""Kernels of the tetrahedra: forces, their derivative, energy.

Elements come in strips that share nodes, and strips eight a thread with eight-wide vectors: on a
CPU both together take a quarter of the time of one element after the other.
"""

import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.lanes import lane_functions
from sliceit_drake.cutting.kernels.types import CORNERS, LANES, STRIP, Scalar, kernel_types

__all__ = ["element_kernels"]


def element_kernels(real: Any, module: str, gradients: bool) -> types.SimpleNamespace:
    """The kernels for scalars `real`, in the Warp module `module`, with adjoints if `gradients`."""
    t = kernel_types(real)
    vec3, vec4, mat33, lanes, padded = t.vec3, t.vec4, t.mat33, t.lanes, t.padded
    Vectors, Mesh, Parameters = t.Vectors, t.Mesh, t.Parameters
    State, Forces, Energies = t.State, t.Forces, t.Energies
    f = lane_functions(real)
    dot8, cross8, scaled8, sum8 = f.dot8, f.cross8, f.scaled8, f.sum8
    gathered8 = f.gathered8

    @wp.func
    def gradient8(
        o: Vectors,
        a: Vectors,
        b: Vectors,
        c: Vectors,
        mesh: Mesh,
        block: wp.int32,
        element: wp.int32,
    ):
        """Columns of the edges between corners o, a, b, c times the inverse rest edges."""
        u = a - o
        v = b - o
        w = c - o
        m = mesh.shape
        k = 9 * element
        return (
            scaled8(m[block, k], u) + scaled8(m[block, k + 3], v) + scaled8(m[block, k + 6], w),
            scaled8(m[block, k + 1], u) + scaled8(m[block, k + 4], v) + scaled8(m[block, k + 7], w),
            scaled8(m[block, k + 2], u) + scaled8(m[block, k + 5], v) + scaled8(m[block, k + 8], w),
        )

    @wp.func
    def add8(
        p0: Vectors,
        p1: Vectors,
        p2: Vectors,
        cut: wp.int32,
        block: wp.int32,
        element: wp.int32,
        mesh: Mesh,
        force: wp.array3d(dtype=Vectors),
    ):
        """Adds the nodal forces of the stress times minus the volume, with columns p0, p1, p2."""
        total = Vectors()
        m = mesh.shape
        for k in range(3):
            row = 9 * element + 3 * k
            g = scaled8(m[block, row], p0) + scaled8(m[block, row + 1], p1)
            g = g + scaled8(m[block, row + 2], p2)
            corner = element + k + 1
            total += g
            # The first that has a corner sets what others add to.
            if k == 2 or element == 0:
                force[cut, block, corner] = g
            else:
                force[cut, block, corner] = force[cut, block, corner] + g
        if element == 0:
            force[cut, block, element] = -total
        else:
            force[cut, block, element] = force[cut, block, element] - total

    @wp.kernel(enable_backward=False, module=module)
    def elements(
        state: State, mesh: Mesh, parameters: Parameters, forces: Forces, per_thread: wp.int32
    ):
        """Nodal forces of the elements: minus the gradient of the energy ahead.

        Evaluating at x + tau v is Kelvin-Voigt damping with viscosity tau times the tangent
        stiffness; invariant under translation, and under rotation to second order in tau times its
        rate.
        """
        cut, chunk = wp.tid()
        mu = parameters.P[cut, Scalar.MU]
        lam = parameters.P[cut, Scalar.LAM]
        x = forces.corners
        end = wp.min((chunk + 1) * per_thread, mesh.nodes.shape[0])
        for block in range(chunk * per_thread, end):
            for k in range(CORNERS):
                x[cut, chunk, k] = gathered8(state.ahead, cut, mesh.nodes[block, k])
            for e in range(STRIP):
                f0, f1, f2 = gradient8(
                    x[cut, chunk, e],
                    x[cut, chunk, e + 1],
                    x[cut, chunk, e + 2],
                    x[cut, chunk, e + 3],
                    mesh,
                    block,
                    e,
                )
                d0 = cross8(f1, f2)
                d1 = cross8(f2, f0)
                d2 = cross8(f0, f1)
                J = dot8(f0, d0)
                Ic = dot8(f0, f0) + dot8(f1, f1) + dot8(f2, f2)
                one = lanes(real(1.0))
                weight = -parameters.stiff_volume[cut, block, e]
                s = wp.cw_mul(weight, (one - wp.cw_div(one, Ic + one)) * mu)
                p = wp.cw_mul(weight, J * lam - one * (lam + real(0.75) * mu))
                p0 = scaled8(s, f0) + scaled8(p, d0)
                p1 = scaled8(s, f1) + scaled8(p, d1)
                p2 = scaled8(s, f2) + scaled8(p, d2)
                add8(p0, p1, p2, cut, block, e, mesh, forces.elements)

    @wp.kernel(enable_backward=gradients, module=module)
    def look_ahead(now: State, parameters: Parameters, after: State):
        """Positions at which the elements are evaluated, from positions and velocities now."""
        cut, i = wp.tid()
        time = parameters.P[cut, Scalar.DAMPING_TIME]
        after.ahead[cut, i] = padded(now.x[cut, i] + time * now.v[cut, i])

    @wp.kernel(enable_backward=False, module=module)
    def element_energy(state: State, mesh: Mesh, parameters: Parameters, energies: Energies):
        """Elastic energy and volume ratio J of each element."""
        cut, block = wp.tid()
        mu = parameters.P[cut, Scalar.MU]
        lam = parameters.P[cut, Scalar.LAM]
        alpha = real(1.0) + real(0.75) * mu / lam
        for i in range(LANES * STRIP):
            e, lane = i / LANES, i % LANES
            o = state.x[cut, mesh.nodes[block, e][lane]]
            a = state.x[cut, mesh.nodes[block, e + 1][lane]] - o
            b = state.x[cut, mesh.nodes[block, e + 2][lane]] - o
            c = state.x[cut, mesh.nodes[block, e + 3][lane]] - o
            M = mat33()
            for k in range(9):
                M[k // 3, k % 3] = mesh.shape[block, 9 * e + k][lane]
            F = wp.matrix_from_cols(a, b, c) * M
            Ic = wp.ddot(F, F)
            J = wp.determinant(F)
            psi = real(0.5) * (
                mu * (Ic - real(3.0))
                + lam * ((J - alpha) * (J - alpha) - (real(1.0) - alpha) * (real(1.0) - alpha))
                - mu * wp.log(real(0.25) * (Ic + real(1.0)))
            )
            volume = parameters.stiff_volume[cut, block, e][lane]
            energies.elastic[cut, block, e, lane] = volume * psi
            energies.volume_ratio[cut, block, e, lane] = J

    out = types.SimpleNamespace(
        elements=elements, look_ahead=look_ahead, element_energy=element_energy
    )
    if not gradients:
        return out

    @wp.func
    def strain8(
        x: wp.array2d(dtype=Any), cut: wp.int32, mesh: Mesh, block: wp.int32, element: wp.int32
    ):
        return gradient8(
            gathered8(x, cut, mesh.nodes[block, element]),
            gathered8(x, cut, mesh.nodes[block, element + 1]),
            gathered8(x, cut, mesh.nodes[block, element + 2]),
            gathered8(x, cut, mesh.nodes[block, element + 3]),
            mesh,
            block,
            element,
        )

    @wp.func
    def columns8(
        strain: wp.array4d(dtype=Vectors),
        cut: wp.int32,
        block: wp.int32,
        element: wp.int32,
        first: wp.int32,
    ):
        return (
            strain[cut, block, element, first],
            strain[cut, block, element, first + 1],
            strain[cut, block, element, first + 2],
        )

    # In three kernels: in one, the compiler finds no vectors any more, and it takes twice as long.
    @wp.kernel(enable_backward=False, module=module)
    def strains(
        x: wp.array2d(dtype=vec4),
        direction: wp.array2d(dtype=vec3),
        mesh: Mesh,
        strain: wp.array4d(dtype=Vectors),
    ):
        """Columns of the deformation gradients F [0:3] and of their change when the nodes move
        along `direction` [3:6]."""
        cut, block, e = wp.tid()
        f0, f1, f2 = strain8(x, cut, mesh, block, e)
        strain[cut, block, e, 0] = f0
        strain[cut, block, e, 1] = f1
        strain[cut, block, e, 2] = f2
        e0, e1, e2 = strain8(direction, cut, mesh, block, e)
        strain[cut, block, e, 3] = e0
        strain[cut, block, e, 4] = e1
        strain[cut, block, e, 5] = e2

    @wp.kernel(enable_backward=False, module=module)
    def stresses(
        parameters: Parameters,
        strain: wp.array4d(dtype=Vectors),
        factors: wp.array4d(dtype=lanes),
        adj_stiff_volume: wp.array3d(dtype=lanes),
        adj_mu: wp.array3d(dtype=real),
        adj_lam: wp.array3d(dtype=real),
    ):
        """Factors of the stress p = s F + p dJ/dF and of its change: s, ds, p, dp.

        Adds to the adjoints of the volumes and, for each eight elements, of the two moduli.
        """
        cut, block, e = wp.tid()
        mu = parameters.P[cut, Scalar.MU]
        lam = parameters.P[cut, Scalar.LAM]
        f0, f1, f2 = columns8(strain, cut, block, e, 0)
        e0, e1, e2 = columns8(strain, cut, block, e, 3)
        d0 = cross8(f1, f2)
        J = dot8(f0, d0)
        dJ = dot8(d0, e0) + dot8(cross8(f2, f0), e1) + dot8(cross8(f0, f1), e2)
        Ic = dot8(f0, f0) + dot8(f1, f1) + dot8(f2, f2)
        half_dIc = dot8(f0, e0) + dot8(f1, e1) + dot8(f2, e2)
        one = lanes(real(1.0))
        weight = -parameters.stiff_volume[cut, block, e]
        inverse = wp.cw_div(one, Ic + one)
        softened = one - inverse
        by_mu = wp.cw_mul(softened, half_dIc) - dJ * real(0.75)
        by_lam = wp.cw_mul(J - one, dJ)
        adj_mu[cut, block, e] = adj_mu[cut, block, e] + sum8(wp.cw_mul(weight, by_mu))
        adj_lam[cut, block, e] = adj_lam[cut, block, e] + sum8(wp.cw_mul(weight, by_lam))
        adj_stiff_volume[cut, block, e] = (
            adj_stiff_volume[cut, block, e] - by_mu * mu - by_lam * lam
        )
        factors[cut, block, e, 0] = wp.cw_mul(weight, softened * mu)
        change = wp.cw_mul(wp.cw_mul(inverse, inverse), half_dIc) * (real(2.0) * mu)
        factors[cut, block, e, 1] = wp.cw_mul(weight, change)
        factors[cut, block, e, 2] = wp.cw_mul(weight, J * lam - one * (lam + real(0.75) * mu))
        factors[cut, block, e, 3] = wp.cw_mul(weight, dJ * lam)

    @wp.func
    def stress_change8(
        f0: Vectors,
        f1: Vectors,
        f2: Vectors,
        e0: Vectors,
        e1: Vectors,
        e2: Vectors,
        factors: wp.array4d(dtype=lanes),
        cut: wp.int32,
        block: wp.int32,
        e: wp.int32,
    ):
        """Change of the first column of the stress; of the others with the columns rotated."""
        u = cross8(e1, f2)
        w = cross8(f1, e2)
        d = cross8(f1, f2)
        s = factors[cut, block, e, 0]
        ds = factors[cut, block, e, 1]
        p = factors[cut, block, e, 2]
        dp = factors[cut, block, e, 3]
        return scaled8(s, e0) + scaled8(ds, f0) + scaled8(p, u + w) + scaled8(dp, d)

    @wp.kernel(enable_backward=False, module=module)
    def elements_adjoint(
        mesh: Mesh,
        strain: wp.array4d(dtype=Vectors),
        factors: wp.array4d(dtype=lanes),
        change: wp.array3d(dtype=Vectors),
    ):
        """Adjoint of `elements`, with the adjoint of the nodal forces as direction of `strains`.

        The forces are a gradient, so their Jacobian is symmetric and the adjoint of x is the change
        of the forces when the nodes move along that direction.
        """
        cut, block = wp.tid()
        for e in range(STRIP):
            f0, f1, f2 = columns8(strain, cut, block, e, 0)
            e0, e1, e2 = columns8(strain, cut, block, e, 3)
            p0 = stress_change8(f0, f1, f2, e0, e1, e2, factors, cut, block, e)
            p1 = stress_change8(f1, f2, f0, e1, e2, e0, factors, cut, block, e)
            p2 = stress_change8(f2, f0, f1, e2, e0, e1, factors, cut, block, e)
            add8(p0, p1, p2, cut, block, e, mesh, change)

    out.strains, out.stresses, out.elements_adjoint = strains, stresses, elements_adjoint
    return out
