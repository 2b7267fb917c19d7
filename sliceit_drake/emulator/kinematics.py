"""Kinematics of the UR5e as its controller computes them: poses in UR's "Base", as 6 numbers.

A pose [6] is the position, m, and the rotation vector (axis times angle), rad. This is written from
the published Denavit-Hartenberg parameters, apart on purpose from the model that the simulation
moves (`systems.ur5e_kinematics`) and from the safety layer's (`hardware.edge_kinematics`): a
controller has a kinematics of its own, and a wrong length or sign in one of the three is found by
the tests that hold it against another, not shared by all.
"""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

__all__ = ["Posture", "forward", "inverse", "matrix_of_pose", "pose_of_matrix"]

# d [m], a [m], alpha [rad] of each joint: Universal Robots, "DH parameters for calculations of
# kinematics and dynamics", UR5e.
_DH = (
    (0.1625, 0.0, 0.5 * math.pi),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, 0.5 * math.pi),
    (0.0997, 0.0, -0.5 * math.pi),
    (0.0996, 0.0, 0.0),
)
_ITERATIONS = 60
_TOLERANCE = 1e-9
_DAMPING = 1e-8
_LARGEST_STEP = 0.5


def matrix_of_pose(pose: ArrayLike) -> np.ndarray:
    """Homogeneous matrix [4, 4] of a pose [6]."""
    p = np.asarray(pose, float)
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(p[3:]).as_matrix()
    X[:3, 3] = p[:3]
    return X


def pose_of_matrix(X: np.ndarray) -> np.ndarray:
    """Pose [6] of a homogeneous matrix [4, 4]."""
    return np.concatenate([X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_rotvec()])


class Posture:
    """The arm at joint positions `q` [6], rad.

    Attributes:
        X_BF: Pose of the flange in the base [4, 4].
    """

    def __init__(self, q: ArrayLike) -> None:
        # Frames of base, links and flange; joint i turns about the z axis of frame i.
        self._frames = [np.eye(4)]
        for (d, a, alpha), angle in zip(_DH, np.asarray(q, float).tolist(), strict=True):
            c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
            step = np.array(
                [
                    [c, -s * ca, s * sa, a * c],
                    [s, c * ca, -c * sa, a * s],
                    [0.0, sa, ca, d],
                    [0.0, 0.0, 0.0, 1.0],
                ]
            )
            self._frames.append(self._frames[-1] @ step)
        self.X_BF = self._frames[-1]

    def jacobian(self, p_B: np.ndarray) -> np.ndarray:
        """From joint velocities to velocity of a point p_B [3] and angular velocity, in the base.

        A matrix [6, 6]; the point is of the tool, in the base, m.
        """
        origins = np.array([X[:3, 3] for X in self._frames[:-1]])
        axes = np.array([X[:3, 2] for X in self._frames[:-1]])
        return np.vstack([np.cross(axes, p_B - origins).T, axes.T])


def forward(q: ArrayLike, X_FT: np.ndarray | None = None) -> np.ndarray:
    """Pose X_BT [4, 4] at joint positions [6], rad, of a tool at X_FT, or of the flange itself."""
    X = Posture(q).X_BF
    return X if X_FT is None else X @ X_FT


def inverse(X_BT: np.ndarray, q: ArrayLike, X_FT: np.ndarray | None = None) -> np.ndarray | None:
    """Joint positions near `q` that put the tool at a pose, by damped Newton steps.

    Args:
        X_BT: Wanted pose of the tool [4, 4].
        q: Joint positions to start from [6], rad.
        X_FT: Tool in the flange [4, 4]; None for the flange itself.

    Returns:
        Joint positions [6], rad; None where the steps do not arrive.
    """
    q = np.array(q, float)
    for _ in range(_ITERATIONS):
        posture = Posture(q)
        X = posture.X_BF if X_FT is None else posture.X_BF @ X_FT
        turn = Rotation.from_matrix(X_BT[:3, :3] @ X[:3, :3].T).as_rotvec()
        error = np.concatenate([X_BT[:3, 3] - X[:3, 3], turn])
        if np.abs(error).max() < _TOLERANCE:
            return q
        J = posture.jacobian(X[:3, 3])
        step = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), error)
        q += step * min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
    return None
