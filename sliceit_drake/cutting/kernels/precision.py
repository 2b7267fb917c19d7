"""The Warp kernels of a sub-step, for a precision.

One source for CPU and GPU, single and double precision, with and without adjoints. The first index
of a launch is the cut: many cuts of one mesh, with parameters, motions and states of their own, run
side by side. All vectors are in the frame C of the cut: x along the edge, y normal to the cut, z
up.
"""

import functools
import types
from typing import Any

import warp as wp

from sliceit_drake.cutting.kernels.coupling_step import coupling_kernels
from sliceit_drake.cutting.kernels.elements import element_kernels
from sliceit_drake.cutting.kernels.nodes import node_kernels
from sliceit_drake.cutting.kernels.points import point_kernels
from sliceit_drake.cutting.kernels.types import kernel_types

__all__ = ["kernels"]

CPU_FLAGS = (
    "-march=native -ffp-contract=fast"
    " -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
)
"""Warp's own, with products and sums fused and the search for vectors as deep as Clang's own."""


@functools.cache
def kernels(real: Any, gradients: bool = False) -> types.SimpleNamespace:
    """The kernels for `real` = wp.float32 or wp.float64, with adjoints if `gradients`."""
    # A module for each variant, so that using several compiles none twice.
    module = f"{__name__}.{real.__name__}{'.gradients' if gradients else ''}"
    wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS}, wp.get_module(module))
    return types.SimpleNamespace(
        module=module,
        **vars(kernel_types(real)),
        **vars(element_kernels(real, module, gradients)),
        **vars(point_kernels(real, module, gradients)),
        **vars(node_kernels(real, module, gradients)),
        **vars(coupling_kernels(real, module)),
    )
