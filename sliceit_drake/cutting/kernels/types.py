"""Types, constants and small functions that the kernels share."""

import enum
import functools
import types
from typing import Any

import warp as wp

__all__ = [
    "CORNERS",
    "GATHER",
    "LANES",
    "PARAMETERS",
    "STRIP",
    "Scalar",
    "kernel_types",
    "mat34d",
    "origin_of",
    "rotation_of",
]

LANES = 8
"""Strips of elements that a thread handles side by side."""

STRIP = 3
"""Elements of a strip; see `tetrahedron_strips`."""

CORNERS = STRIP + 3
"""Nodes of a strip; those of its k-th element begin at the k-th."""

GATHER = 4
"""Element forces that a node adds at a time."""

mat34d: Any = wp.types.matrix((3, 4), wp.float64)
"""A pose: rotation and, as the last column, position."""


@wp.func
def rotation_of(X: mat34d):
    """R_AB of a pose X_AB."""
    return wp.mat33d(
        X[0, 0], X[0, 1], X[0, 2], X[1, 0], X[1, 1], X[1, 2], X[2, 0], X[2, 1], X[2, 2]
    )


@wp.func
def origin_of(X: mat34d):
    """p_AB of a pose X_AB, metres."""
    return wp.vec3d(X[0, 3], X[1, 3], X[2, 3])


PARAMETERS = (
    "mu",
    "lam",
    "damping_time",
    "bond_stiffness",
    "strength",
    "flank_stiffness",
    "anchor_stiffness",
    "contact_damping",
    "friction",
    "static_friction",
    "stribeck_velocity",
    "direction_length",
    "debt_length",
    "drift_rate",
    "drift_lead",
    "board_stiffness",
    "board_friction",
    "board_damping_time",
    "blade_stiffness",
    "blade_damping",
    "rate_exponent",
    "reference_speed",
    "slice_push_exponent",
    "skin_toughness",
    "skin_thickness",
    "adhesion",
    "flank_viscosity",
    "flank_exponent",
    "flank_speed",
    "initiation",
    "initiation_depth",
    "edge_share",
)
"""Scalars of a cut that the kernels read, in the order of their array."""

Scalar = enum.IntEnum("Scalar", [name.upper() for name in PARAMETERS], start=0)
"""Places of the scalars in their array."""


@functools.cache
def kernel_types(real: Any) -> types.SimpleNamespace:
    """Types, structs and functions for `real` = wp.float32 or wp.float64, by name.

    The first index of arrays is the cut, but for what belongs to the mesh.
    """
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    mat33 = wp.types.matrix((3, 3), real)
    lanes, indices = wp.types.vector(LANES, real), wp.types.vector(LANES, wp.int32)
    # From the x component of a force in `Vectors` to its z component.
    strided = wp.types.vector(2 * LANES + 1, real)
    entries = wp.types.vector(GATHER, wp.int32)
    # A vector in each lane, by component.
    Vectors = wp.types.matrix((3, LANES), real)
    TINY = wp.constant(real(1.0e-20))

    @wp.struct
    class Mesh:
        """Elements in blocks of `LANES` strips, and what acts on each node; see `Workspace`."""

        nodes: wp.array2d(dtype=indices)
        shape: wp.array2d(dtype=lanes)
        moving: wp.array(dtype=wp.int32)
        element_start: wp.array(dtype=wp.int32)
        element_entry: wp.array(dtype=entries)
        point_start: wp.array(dtype=wp.int32)
        point_entry: wp.array(dtype=wp.int32)
        point_weight: wp.array(dtype=real)
        board_area: wp.array(dtype=real)
        board: wp.array(dtype=real)

    @wp.struct
    class Points:
        """The cut points in blocks of `LANES`, and their tables over [-reach, reach] and outline;
        see `EdgeTables`. What fills up the last block has no area."""

        nodes: wp.array2d(dtype=indices)
        weights: wp.array2d(dtype=lanes)
        area: wp.array(dtype=lanes)
        width: wp.array2d(dtype=real)
        fraction: wp.array2d(dtype=real)
        centroid: wp.array2d(dtype=real)
        beside: wp.array2d(dtype=indices)
        outline: wp.array2d(dtype=lanes)
        lower: wp.array2d(dtype=lanes)
        depth: wp.array(dtype=lanes)
        rest: wp.array(dtype=Vectors)
        reach: real
        per_spacing: real

    @wp.struct
    class Parameters:
        """What cuts of one mesh may differ in; see `parameter_row`."""

        P: wp.array2d(dtype=real)
        knife: wp.array2d(dtype=real)
        toughness: wp.array2d(dtype=lanes)
        flank_scale: wp.array2d(dtype=lanes)
        friction_scale: wp.array2d(dtype=lanes)
        unloading: wp.array2d(dtype=lanes)
        weight: wp.array2d(dtype=vec3)
        relaxing: wp.array2d(dtype=real)
        keep: wp.array2d(dtype=real)
        mass: wp.array2d(dtype=real)
        stiff_volume: wp.array3d(dtype=lanes)

    @wp.struct
    class Inertia:
        """Factors of the mass matrix of each cut, see `inertia.Factors`; and room for what is
        multiplied with the inverse."""

        lower_start: wp.array(dtype=wp.int32)
        lower_index: wp.array(dtype=entries)
        upper_start: wp.array(dtype=wp.int32)
        upper_index: wp.array(dtype=entries)
        lower: wp.array2d(dtype=vec4)
        upper: wp.array2d(dtype=vec4)
        inverse_pivot: wp.array2d(dtype=real)
        inverse: wp.array2d(dtype=real)
        last: wp.array2d(dtype=vec4)

    @wp.struct
    class Motion:
        """Poses of the knife at the ends of the coupling steps, and in each sub-step its pose at
        the end, velocity of Ko and angular velocity; axes in which wrenches are given; and how many
        sub-steps and coupling steps a launch that loops has done so far [2]."""

        R_AC: wp.array(dtype=wp.mat33d)
        R: wp.array2d(dtype=wp.mat33d)
        p: wp.array2d(dtype=wp.vec3d)
        R_CK: wp.array2d(dtype=mat33)
        p_CK: wp.array2d(dtype=vec3)
        v_CK: wp.array2d(dtype=vec3)
        w_CK: wp.array2d(dtype=vec3)
        done: wp.array(dtype=wp.int32)
        substeps: wp.int32
        period: wp.float64

    @wp.struct
    class State:
        """The food.

        Positions, velocities; at the cut points the largest depth of the edge below the point in
        the food at rest; that where the point is, for the skin, and the same before the sub-step,
        for the points beside; the fraction of the surface energy spent by opening, the edge's force
        on the food, its direction, and the slip from the friction anchors of both faces; that of
        the nodes on the board; the force that each Maxwell branch has relaxed; the blade's
        deflection and its rate; the front of the cut, see `FRONT`.
        `stepping` is not for the kernels, see `stepping`.
        `ahead` holds the positions at which the elements are evaluated, padded to fours, which are
        loaded faster than threes.
        """

        x: wp.array2d(dtype=vec3)
        v: wp.array2d(dtype=vec3)
        edge_depth: wp.array2d(dtype=lanes)
        skin_depth: wp.array2d(dtype=lanes)
        last_skin_depth: wp.array2d(dtype=lanes)
        cohesive_damage: wp.array2d(dtype=lanes)
        edge_force: wp.array2d(dtype=lanes)
        edge_direction: wp.array2d(dtype=Vectors)
        slip: wp.array3d(dtype=Vectors)
        board_slip: wp.array2d(dtype=vec3)
        overstress: wp.array3d(dtype=vec3)
        blade: wp.array2d(dtype=real)
        front: wp.array2d(dtype=real)
        stepping: wp.array2d(dtype=real)
        ahead: wp.array2d(dtype=vec4)

    @wp.struct
    class Forces:
        """Forces in a sub-step: of the elements on the corners of their strips, also as the rows in
        which a node finds its entries, and where those corners are; on both faces at the cut
        points, also as such rows; what the points add to the totals, and these, see `POINT_TOTALS`.
        By node: from the bulk (elements after relaxation); of those that move, in their order, the
        resultant, and the acceleration that it gives. With gradients, what each node got from
        elements and points."""

        corners: wp.array3d(dtype=Vectors)
        elements: wp.array3d(dtype=Vectors)
        rows: wp.array2d(dtype=strided)
        points: wp.array3d(dtype=Vectors)
        point_rows: wp.array2d(dtype=strided)
        at_points: wp.array3d(dtype=lanes)
        totals: wp.array2d(dtype=real)
        from_bulk: wp.array2d(dtype=vec3)
        resultant: wp.array2d(dtype=vec4)
        acceleration: wp.array2d(dtype=vec4)
        from_elements: wp.array2d(dtype=vec3)
        from_points: wp.array2d(dtype=vec3)

    @wp.struct
    class Sums:
        """What the sub-steps add up at points and nodes and of the blade; see `layouts`."""

        points: wp.array4d(dtype=lanes)
        blade: wp.array3d(dtype=real)
        board_force: wp.array2d(dtype=vec3)
        board_loss: wp.array2d(dtype=real)
        internal_work: wp.array2d(dtype=real)

    @wp.struct
    class Results:
        """See `layouts.results`."""

        point_sums: wp.array3d(dtype=wp.float64)
        blade: wp.array3d(dtype=wp.float64)
        wrenches: wp.array4d(dtype=wp.float64)
        wrench: wp.array3d(dtype=wp.float64)
        work: wp.array2d(dtype=wp.float64)
        cut: wp.array2d(dtype=wp.float64)
        board_force: wp.array2d(dtype=wp.float64)
        balance: wp.array2d(dtype=wp.float64)
        added_force: wp.array2d(dtype=wp.float64)

    @wp.struct
    class Energies:
        """Elastic energy and volume ratio of the elements, recoverable energy of the points."""

        elastic: wp.array4d(dtype=real)
        volume_ratio: wp.array4d(dtype=real)
        points: wp.array2d(dtype=lanes)

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
    def forwards(index: wp.int32):
        """An index that is not negative, known as such: Warp counts a negative one from the end."""
        return index & 0x7FFFFFFF

    @wp.func
    def padded(a: vec3):
        return vec4(a[0], a[1], a[2], real(0.0))

    return types.SimpleNamespace(**locals())
