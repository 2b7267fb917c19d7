"""How the force of a slice changes with parameters, resolved in time."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Motion
from sliceit_drake.cutting.parameters import get_parameter, parameter_step, with_parameters
from sliceit_drake.cutting.solver import CuttingError

__all__ = ["force_sensitivity"]


def force_sensitivity(
    model: CuttingModel,
    motion: Motion,
    names: Sequence[str],
    exchange_period: float,
    board: Board | None = None,
    relative_step: float = 1e-4,
    workers: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Wrench of food and board on the knife, and its derivatives by parameters.

    Central differences of slices that run side by side, in double precision.

    Args:
        model: The cut.
        motion: Poses X_FK of the knife.
        names: Shared parameters, see `parameters.parameter_names`.
        exchange_period: s.
        board: Board under the knife, or None.
        relative_step: Step, relative to `parameters.parameter_step`.
        workers: Threads; the number of processors by default.

    Returns:
        Moment about Ko and force in F [n, 6], and its derivatives [n, 6, len(names)].

    Raises:
        CuttingError: A slice broke down.
    """
    exact = model.derive(numerics=dc.replace(model.numerics, precision="float64"))
    steps = [relative_step * parameter_step(exact, name) for name in names]
    cuts = [exact]
    for name, step in zip(names, steps, strict=True):
        value = get_parameter(exact, name)
        cuts += [with_parameters(exact, {name: value + sign * step}) for sign in (1.0, -1.0)]
    slices = simulate_batch(cuts, [motion], exchange_period, board, workers)
    for result, name in zip(slices, ["", *(n for n in names for _ in range(2))], strict=True):
        if result.failure is not None:
            varied = f" with {name} varied" if name else ""
            raise CuttingError(f"the slice{varied} broke down: {result.failure}")
    wrench = np.array([result.food_wrench + result.board_wrench for result in slices])
    slope = (wrench[1::2] - wrench[2::2]) / (2.0 * np.array(steps)[:, None, None])
    return wrench[0], np.moveaxis(slope, 0, -1)
