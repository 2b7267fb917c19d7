"""When a slice ends."""

import dataclasses as dc

import numpy as np

__all__ = ["Limits"]


@dc.dataclass(frozen=True)
class Limits:
    """What ends a slice before its goal.

    Attributes:
        force: Of each component at the sensor, N.
        torque: Likewise, Nm.
        workspace: Errors to the final pose [3], m, m, rad.
    """

    force: float
    torque: float
    workspace: tuple[float, float, float]

    def broken(self, wrench: np.ndarray, error: np.ndarray) -> str:
        """What is broken: collision, workspace, or nothing.

        Args:
            wrench: Moment and force at the sensor [6].
            error: To the final pose [3], m, m, rad.
        """
        torque, force = np.abs(wrench).reshape(2, 3).max(axis=1)
        if torque > self.torque or force > self.force:
            return "collision"
        return "workspace" if (np.abs(error) > self.workspace).any() else ""
