"""Turns a station's poses, velocities and wrenches into a vector, for logging."""

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem

__all__ = ["RowRecorder"]

_AXES = ("x", "y", "z")


class RowRecorder(LeafSystem):
    """Abstract outputs of a station as one vector; a Multiplexer joins it to the vector outputs.

    Columns of a pose are position and quaternion, those of a velocity and of a wrench are the
    translational part, then the rotational one.

    Args:
        poses, velocities, wrenches: Names of the input ports.

    Output port:
        row: All columns [len(columns)].

    Attributes:
        columns: Names of the columns.
    """

    def __init__(
        self, poses: Sequence[str], velocities: Sequence[str], wrenches: Sequence[str]
    ) -> None:
        super().__init__()
        self.columns: list[str] = []
        self._parts: list[tuple[InputPort, Callable[[object], np.ndarray]]] = []
        for name in poses:
            columns = [f"{name}_p_{a}" for a in _AXES] + [f"{name}_quat_{a}" for a in "wxyz"]
            self._add(self._declare(name, Value(RigidTransform())), _pose, columns)
        for name in velocities:
            columns = [f"{name}_v_{a}" for a in _AXES] + [f"{name}_w_{a}" for a in _AXES]
            self._add(self._declare(name, Value(SpatialVelocity.Zero())), _halves_swapped, columns)
        for name in wrenches:
            columns = [f"{name}_f_{a}" for a in _AXES] + [f"{name}_m_{a}" for a in _AXES]
            self._add(self._declare(name, Value(SpatialForce.Zero())), _halves_swapped, columns)
        self.DeclareVectorOutputPort("row", len(self.columns), self._calc_row)

    def _declare(self, name: str, model: AbstractValue) -> InputPort:
        return self.DeclareAbstractInputPort(name, model)

    def _add(
        self, port: InputPort, convert: Callable[[object], np.ndarray], columns: Sequence[str]
    ) -> None:
        self._parts.append((port, convert))
        self.columns += columns

    def _calc_row(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            np.concatenate([convert(port.Eval(context)) for port, convert in self._parts])
        )


def _pose(X: RigidTransform) -> np.ndarray:
    return np.concatenate([X.translation(), X.rotation().ToQuaternion().wxyz()])


def _halves_swapped(quantity: SpatialVelocity | SpatialForce) -> np.ndarray:
    """Translational part first; Drake's coefficients have the rotational one first."""
    return np.roll(quantity.get_coeffs(), 3)
