"""The force of a slice as a function that PyTorch differentiates."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.parameters import POINT_PARAMETERS, pull_back, with_parameters

__all__ = ["slice_force"]


class _SliceForce(torch.autograd.Function):
    """Wrenches of a slice by parameters and path, with the adjoint of `SliceAdjoint`."""

    @staticmethod
    def forward(  # type: ignore[override, unused-ignore]
        ctx: Any,
        adjoint: SliceAdjoint,
        names: Sequence[str],
        R: torch.Tensor,
        p: torch.Tensor,
        *values: torch.Tensor,
    ) -> torch.Tensor:
        given = {
            name: value.detach().numpy() if name in POINT_PARAMETERS else float(value)
            for name, value in zip(names, values, strict=True)
        }
        model = with_parameters(adjoint.model, given)
        run = adjoint.run(R.detach().double().numpy(), p.detach().double().numpy(), model)
        ctx.adjoint, ctx.run, ctx.names = adjoint, run, names
        ctx.types = [value.dtype for value in values]
        return torch.from_numpy(run.wrenches.copy())

    @staticmethod
    def backward(ctx: Any, weights: torch.Tensor) -> tuple[Any, ...]:  # type: ignore[override, unused-ignore]
        gradient = ctx.adjoint.gradient(ctx.run, weights.double().numpy())
        by_name = pull_back(ctx.run.model, gradient, ctx.names)
        values = [
            torch.as_tensor(np.asarray(by_name[name]), dtype=kind)
            for name, kind in zip(ctx.names, ctx.types, strict=True)
        ]
        path = [torch.from_numpy(gradient.rotation), torch.from_numpy(gradient.position)]
        return None, None, *path, *values


def slice_force(
    adjoint: SliceAdjoint, R: torch.Tensor, p: torch.Tensor, values: dict[str, torch.Tensor]
) -> torch.Tensor:
    """Mean wrench of each coupling step on the knife, about Ko and in C [E, 6], Nm and N.

    Differentiable by all tensors: parameters, and the path, from which a height, a speed or a time
    shift follow by torch.

    Args:
        adjoint: The cut on its device.
        R: Rotations of the knife in C at the ends of the coupling steps [E + 1, 3, 3], double.
        p: Positions of Ko in C there [E + 1, 3], metres, double.
        values: Parameters by name (`cutting.parameters`): scalars, or [P] for those of cut points.

    Raises:
        CuttingError: A force is not finite.
        KeyError: There is no such parameter.
        ValueError: The food may slip, which has no gradient.
    """
    out = _SliceForce.apply(adjoint, tuple(values), R, p, *values.values())
    assert isinstance(out, torch.Tensor)
    return out
