"""Arithmetic on eight numbers or vectors side by side, which a CPU does at once."""

import functools
import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.types import LANES, kernel_types

__all__ = ["lane_functions"]


@functools.cache
def lane_functions(real: Any) -> types.SimpleNamespace:
    """The functions for scalars `real`. What is chosen by `where8` has derivatives on both sides,
    also where it is not chosen."""
    t = kernel_types(real)
    vec3, lanes, indices, Vectors = t.vec3, t.lanes, t.indices, t.Vectors
    forwards = t.forwards

    @wp.func
    def dot8(a: Vectors, b: Vectors):
        products = wp.cw_mul(a, b)
        return products[0] + products[1] + products[2]

    @wp.func
    def cross8(a: Vectors, b: Vectors):
        return wp.matrix_from_rows(
            wp.cw_mul(a[1], b[2]) - wp.cw_mul(a[2], b[1]),
            wp.cw_mul(a[2], b[0]) - wp.cw_mul(a[0], b[2]),
            wp.cw_mul(a[0], b[1]) - wp.cw_mul(a[1], b[0]),
        )

    @wp.func
    def scaled8(k: lanes, a: Vectors):
        return wp.matrix_from_rows(wp.cw_mul(k, a[0]), wp.cw_mul(k, a[1]), wp.cw_mul(k, a[2]))

    @wp.func
    def sum8(a: lanes):
        total = real(0.0)
        for lane in range(LANES):
            total += a[lane]
        return total

    @wp.func
    def length8(a: Vectors):
        out = lanes()
        for lane in range(LANES):
            out[lane] = wp.length(vec3(a[0, lane], a[1, lane], a[2, lane]))
        return out

    @wp.func
    def exp8(a: lanes):
        out = lanes()
        for lane in range(LANES):
            out[lane] = wp.exp(a[lane])
        return out

    @wp.func
    def pow8(a: lanes, power: real):
        out = lanes()
        for lane in range(LANES):
            out[lane] = wp.pow(a[lane], power)
        return out

    @wp.func
    def where8(positive: lanes, a: lanes, b: lanes):
        """a where `positive` is above zero, b elsewhere."""
        out = lanes()
        for lane in range(LANES):
            out[lane] = wp.where(positive[lane] > real(0.0), a[lane], b[lane])
        return out

    @wp.func
    def gathered8(x: wp.array2d(dtype=Any), cut: wp.int32, node: indices):
        a = lanes()
        b = lanes()
        c = lanes()
        for lane in range(LANES):
            p = x[cut, forwards(node[lane])]
            a[lane] = p[0]
            b[lane] = p[1]
            c[lane] = p[2]
        return wp.matrix_from_rows(a, b, c)

    return types.SimpleNamespace(
        dot8=dot8,
        cross8=cross8,
        scaled8=scaled8,
        sum8=sum8,
        length8=length8,
        exp8=exp8,
        pow8=pow8,
        where8=where8,
        gathered8=gathered8,
    )
