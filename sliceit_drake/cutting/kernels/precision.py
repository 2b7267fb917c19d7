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
from sliceit_drake.cutting.warp_start import CPU_FLAGS

__all__ = ["kernels"]


def kernels(real: Any, gradients: bool = False) -> types.SimpleNamespace:
    """The kernels for `real` = wp.float32 or wp.float64, with adjoints if `gradients`."""
    return _kernels(real, gradients)


# One set for each variant: kernels that are made while another thread loads their module miss it.
@functools.cache
def _kernels(real: Any, gradients: bool) -> types.SimpleNamespace:
    # Modules for each variant, so that using several compiles none twice. The points take the
    # compiler as long as all else, and two modules compile side by side.
    variant = f"{__name__}.{real.__name__}{'.gradients' if gradients else ''}"
    modules = points, others = (f"{variant}.points", f"{variant}.others")
    for module in modules:
        wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS}, wp.get_module(module))
    return types.SimpleNamespace(
        modules=modules,
        **vars(kernel_types(real)),
        **vars(element_kernels(real, others, gradients)),
        **vars(point_kernels(real, points, gradients)),
        **vars(node_kernels(real, others, gradients)),
        **vars(coupling_kernels(real, others)),
    )
