"""Turns a station's poses, velocities and wrenches into a vector, for logging."""

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem
from scipy.spatial.transform import Rotation

__all__ = ["RowRecorder"]

_AXES = ("x", "y", "z")
_POSE_SIZE = 12


class RowRecorder(LeafSystem):
    """Abstract outputs of a station as one vector; a Multiplexer joins it to the vector outputs.

    The row holds Drake's own numbers, since it is computed at every exchange; `table` turns rows
    into columns that people read: position and quaternion of a pose, translational before
    rotational part of a velocity and of a wrench.

    Args:
        poses: Names of the RigidTransform input ports.
        velocities: Of the SpatialVelocity ports.
        wrenches: Of the SpatialForce ports.

    Output port:
        row: 3x4 matrices of the poses, coefficients of velocities and wrenches.

    Attributes:
        size: Of the row.
        columns: Names of the columns of `table`.
    """

    def __init__(
        self, poses: Sequence[str], velocities: Sequence[str], wrenches: Sequence[str]
    ) -> None:
        super().__init__()
        self._pose_count = len(poses)
        self._parts: list[tuple[InputPort, Callable[..., np.ndarray]]] = []
        self.columns: list[str] = []
        for name in poses:
            self._parts.append((self._declare(name, Value(RigidTransform())), _matrix))
            self.columns += [f"{name}_p_{a}" for a in _AXES] + [f"{name}_quat_{a}" for a in "wxyz"]
        for name in velocities:
            self._parts.append(
                (self._declare(name, Value(SpatialVelocity.Zero())), SpatialVelocity.get_coeffs)
            )
            self.columns += [f"{name}_{part}_{a}" for part in ("v", "w") for a in _AXES]
        for name in wrenches:
            self._parts.append(
                (self._declare(name, Value(SpatialForce.Zero())), SpatialForce.get_coeffs)
            )
            self.columns += [f"{name}_{part}_{a}" for part in ("f", "m") for a in _AXES]
        self.size = _POSE_SIZE * len(poses) + 6 * (len(velocities) + len(wrenches))
        self.DeclareVectorOutputPort("row", self.size, self._calc_row)

    def _declare(self, name: str, model: AbstractValue) -> InputPort:
        return self.DeclareAbstractInputPort(name, model)

    def _calc_row(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            np.concatenate([convert(port.Eval(context)) for port, convert in self._parts])
        )

    def table(self, rows: np.ndarray) -> np.ndarray:
        """Logged rows [n, size] as columns [n, len(columns)]."""
        split = _POSE_SIZE * self._pose_count
        parts = []
        for X in np.split(rows[:, :split], self._pose_count, axis=1):
            matrix = X.reshape(-1, 3, 4)
            quaternion = Rotation.from_matrix(matrix[:, :, :3]).as_quat(
                canonical=True, scalar_first=True
            )
            parts += [matrix[:, :, 3], quaternion]
        for spatial in np.split(rows[:, split:], (self.size - split) // 6, axis=1):
            parts += [spatial[:, 3:], spatial[:, :3]]
        return np.concatenate(parts, axis=1)


def _matrix(X: RigidTransform) -> np.ndarray:
    return X.GetAsMatrix34().ravel()
