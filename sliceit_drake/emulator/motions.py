"""Motions that a UR controller plans itself, as generators of one joint target a cycle."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sliceit_drake.emulator.kinematics import forward, inverse
from sliceit_drake.emulator.robot_model import CYCLE

__all__ = ["Scale", "ScriptError", "joint_motion", "line_motion", "slow_down"]

Scale = Callable[[], float]
"""Fraction of the planned speed that the speed slider allows now."""

_AT_REST = 1e-6
_MIN_ROTATION_RADIUS = 0.1


class ScriptError(Exception):
    """A robot program cannot go on; the controller stops it and says why."""


def joint_motion(
    start: ArrayLike, end: ArrayLike, speed: float, acceleration: float, scale: Scale
) -> Iterator[np.ndarray]:
    """``movej``: all joints in step, the one that has farthest to go with a trapezoid of speed.

    Args:
        start, end: Joint positions [6], rad.
        speed, acceleration: Of the leading joint, rad/s and rad/s2.
        scale: Speed slider.

    Raises:
        ScriptError: Speed or acceleration is not positive.
    """
    q0, q1 = np.array(start, float), np.array(end, float)
    distance = float(np.abs(q1 - q0).max())
    for share in _trapezoid(distance, speed, acceleration, scale):
        yield q0 + share * (q1 - q0)


def line_motion(
    start: ArrayLike,
    end: np.ndarray,
    X_FT: np.ndarray,
    speed: float,
    acceleration: float,
    scale: Scale,
) -> Iterator[np.ndarray]:
    """``movel``: the tool goes along a straight line, and turns about one axis.

    Args:
        start: Joint positions [6], rad.
        end: Pose of the tool in the base [4, 4].
        X_FT: Tool in the flange [4, 4].
        speed, acceleration: Of the tool, m/s and m/s2.
        scale: Speed slider.

    Raises:
        ScriptError: No joint positions reach a pose on the way, or speed or acceleration is not
            positive.
    """
    q = np.array(start, float)
    X0 = forward(q, X_FT)
    turn = Rotation.from_matrix(end[:3, :3] @ X0[:3, :3].T).as_rotvec()
    # A turn on the spot goes as fast as a point 0.1 m from its axis: our choice.
    distance = max(
        float(np.linalg.norm(end[:3, 3] - X0[:3, 3])),
        _MIN_ROTATION_RADIUS * float(np.linalg.norm(turn)),
    )
    for share in _trapezoid(distance, speed, acceleration, scale):
        X = np.eye(4)
        X[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ X0[:3, :3]
        X[:3, 3] = X0[:3, 3] + share * (end[:3, 3] - X0[:3, 3])
        found = inverse(X, q, X_FT)
        if found is None:
            raise ScriptError("movel: no joint positions reach a pose on the way")
        q = found
        yield q


def slow_down(
    positions: ArrayLike, velocities: ArrayLike, deceleration: float
) -> Iterator[np.ndarray]:
    """Comes to rest from a motion, all joints in step, the fastest with `deceleration`, rad/s2.

    Raises:
        ScriptError: The deceleration is not positive.
    """
    if not deceleration > 0.0:
        raise ScriptError(f"a deceleration of {deceleration:.6g} rad/s2 stops nothing")
    q, v = np.array(positions, float), np.array(velocities, float)
    fastest = float(np.abs(v).max())
    while fastest > _AT_REST:
        slower = max(0.0, fastest - deceleration * CYCLE)
        mean = 0.5 * (fastest + slower) / fastest
        q = q + mean * CYCLE * v
        v = v * (slower / fastest)
        fastest = slower
        yield q


def _trapezoid(distance: float, speed: float, acceleration: float, scale: Scale) -> Iterator[float]:
    """Fraction of a distance that is done after each cycle, up to 1."""
    if not (speed > 0.0 and acceleration > 0.0):
        raise ScriptError(
            f"speed {speed:.6g} and acceleration {acceleration:.6g} of a motion must be positive"
        )
    if distance <= 0.0:
        return
    ramp = min(speed / acceleration, (distance / acceleration) ** 0.5)
    top = acceleration * ramp
    end = distance / top + ramp
    time = 0.0
    while time < end:
        time = min(end, time + CYCLE * scale())
        if time < ramp:
            done = 0.5 * acceleration * time**2
        elif time < end - ramp:
            done = top * (time - 0.5 * ramp)
        else:
            done = distance - 0.5 * acceleration * (end - time) ** 2
        yield done / distance
