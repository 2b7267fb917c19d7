"""Types, constants and small functions that the kernels share."""

import functools
import types
from typing import Any

import warp as wp

__all__ = ["GATHER", "LANES", "PARAMETERS", "kernel_types"]

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
    "rate_exponent",
    "reference_speed",
    "slice_push_exponent",
    "skin_toughness",
    "adhesion",
    "flank_viscosity",
    "flank_exponent",
    "flank_speed",
    "initiation",
    "initiation_depth",
    "edge_share",
)
"""Scalars of a cut that the kernels read, in the order of their array."""


@functools.cache
def kernel_types(real: Any) -> types.SimpleNamespace:
    """Types for `real` = wp.float32 or wp.float64, `slide`, `padded`, `place`, `table`."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    tiny = wp.constant(real(1.0e-20))

    @wp.func
    def slide(slip: vec3, step: vec3, stiffness: real, limit: real):
        """Coulomb friction with an elastic anchor, returned to the limit.

        Args: slip from the anchor so far, its increment, tangential stiffness, largest force.
        Returns: new slip, energy lost by sliding.
        """
        trial = slip + step
        length = wp.length(trial)
        reach = limit / wp.max(stiffness, tiny)
        new_slip = trial
        lost = real(0.0)
        if length > reach:
            new_slip = trial * (reach / length)
            change = new_slip - slip
            lost = wp.dot(new_slip, trial - new_slip) + real(0.5) * wp.dot(change, change)
        return new_slip, stiffness * lost

    @wp.func
    def padded(a: vec3):
        return vec4(a[0], a[1], a[2], real(0.0))

    @wp.func
    def place(s: real, reach: real, per_spacing: real, size: wp.int32):
        """Interval of a table with `size` entries over [-reach, reach] and the fraction of its
        end."""
        u = (s + reach) * per_spacing
        k = wp.clamp(wp.int32(wp.floor(u)), 0, size - 2)
        return k, wp.clamp(u - real(k), real(0.0), real(1.0))

    @wp.func
    def table(values: wp.array2d(dtype=real), row: wp.int32, k: wp.int32, w: real):
        return values[row, k] * (real(1.0) - w) + values[row, k + 1] * w

    return types.SimpleNamespace(
        real=real,
        vec2=wp.types.vector(2, real),
        vec3=vec3,
        vec4=vec4,
        mat33=wp.types.matrix((3, 3), real),
        lanes=wp.types.vector(LANES, real),
        indices=wp.types.vector(LANES, wp.int32),
        # From the x component of a nodal force in `elements` to its z component.
        strided=wp.types.vector(2 * LANES + 1, real),
        entries=wp.types.vector(GATHER, wp.int32),
        TINY=tiny,
        slide=slide,
        padded=padded,
        place=place,
        table=table,
        **{name.upper(): wp.constant(k) for k, name in enumerate(PARAMETERS)},
    )
