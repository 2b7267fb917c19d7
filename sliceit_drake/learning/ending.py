"""When a slice ends."""

import dataclasses as dc

import numpy as np

__all__ = ["Limits"]


@dc.dataclass(frozen=True)
class Limits:
    """What ends a slice before its goal.

    Attributes:
        force: Greatest force of each component at the sensor, N.
        torque: Greatest torque of each component there, Nm.
        workspace: Greatest errors to the final pose [3], m, m, rad.
    """

    force: float
    torque: float
    workspace: tuple[float, float, float]

    def end(
        self, at_goal: bool, time: float, until: float, wrench: np.ndarray, error: np.ndarray
    ) -> str:
        """Why a slice ends after a decision, or nothing if it goes on.

        It is the goal, a collision (force, torque, or shaking, which the station's monitor finds)
        or workspace.

        Args:
            at_goal: Whether the goal was held for long enough.
            time: Time of the simulation, s; before `until` where the station's monitor ended a run
                that shakes.
            until: Time to which it was to advance, s.
            wrench: Moment and force at the sensor [6].
            error: Error to the final pose [3], m, m, rad.
        """
        if at_goal:
            return "goal"
        if time < until - 1e-6:
            return "shaking"
        torque, force = np.abs(wrench).reshape(2, 3).max(axis=1)
        if force > self.force:
            return "force"
        if torque > self.torque:
            return "torque"
        return "workspace" if (np.abs(error) > self.workspace).any() else ""
