"""Where the knife's edge is at given joint positions, fast enough for every cycle.

Closed forward kinematics of a UR, in plain floats: numpy's calls on six numbers cost more than the
arithmetic. The lengths are Universal Robots' nominal ones for the UR5e; a real arm differs from
them by its factory calibration, up to centimetres in position, and is refused where its own pose
says that it differs by much (`readings.pose_difference`). The board's height must
therefore be found with the same nominal kinematics (docs/how_to/hardware.md).

Apart on purpose from the model of the controller (`systems.ur5e_kinematics`, against which a test
holds it): what checks commands shares no mistake with what makes them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["EdgeKinematics", "EdgePose", "flange_pose", "singular_margin"]

# Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR5e, metres.
D1, A2, A3, D4, D5, D6 = 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996


class EdgePose(NamedTuple):
    """The edge in the world.

    Attributes:
        heel: One end, x y z, m.
        tip: The other end, x y z, m.
        down: Cosine of the angle between the blade, spine to edge, and down.
    """

    heel: tuple[float, float, float]
    tip: tuple[float, float, float]
    down: float


def flange_pose(q: Sequence[float]) -> tuple[float, ...]:
    """Pose of the flange in the base at joint positions `q` [6], rad.

    Returns:
        The columns of the rotation one after the other, then the position, m: 12 numbers.
    """
    q1, q2, q3, q4, q5, q6 = q
    q23 = q2 + q3
    q234 = q23 + q4
    s1, c1, s5, c5 = math.sin(q1), math.cos(q1), math.sin(q5), math.cos(q5)
    s6, c6, s, c = math.sin(q6), math.cos(q6), math.sin(q234), math.cos(q234)
    ux, uy, uz = s1 * s5 + c1 * c * c5, c * c5 * s1 - c1 * s5, c5 * s
    vx, vy, vz = -c1 * s, -s1 * s, c
    ax, ay, az = c5 * s1 - c1 * c * s5, -c1 * c5 - c * s1 * s5, -s * s5
    reach = A2 * math.cos(q2) + A3 * math.cos(q23) + D5 * s
    return (
        c6 * ux + s6 * vx,
        c6 * uy + s6 * vy,
        c6 * uz + s6 * vz,
        c6 * vx - s6 * ux,
        c6 * vy - s6 * uy,
        c6 * vz - s6 * uz,
        ax,
        ay,
        az,
        D6 * ax + D4 * s1 + c1 * reach,
        D6 * ay - D4 * c1 + s1 * reach,
        D1 + D6 * az + A2 * math.sin(q2) + A3 * math.sin(q23) - D5 * c,
    )


def singular_margin(q: Sequence[float]) -> float:
    """How far joint positions `q` [6], rad, are from the arm's three singularities.

    Returns:
        The least of |sin q5| (wrist), |sin q3| (elbow) and the distance, m, of the wrist from a
        plane through the first joint's axis (shoulder); 0 at a singularity.
    """
    q23 = q[1] + q[2]
    reach = A2 * math.cos(q[1]) + A3 * math.cos(q23) + D5 * math.sin(q23 + q[3])
    return min(abs(math.sin(q[4])), abs(math.sin(q[2])), abs(reach))


class EdgeKinematics:
    """The edge of a knife on a UR5e's flange.

    Args:
        X_WB: Pose of the arm's base in the world [3 or 4, 4].
        X_TK: Pose of the knife frame in the flange frame [3 or 4, 4].
        length: Length of the edge, m; its middle is Ko, Kx along it, Kz from spine to edge.

    Attributes:
        gravity: Acceleration of gravity in the arm's base [3], m/s2.
    """

    def __init__(self, X_WB: ArrayLike, X_TK: ArrayLike, length: float) -> None:
        base, tool = np.asarray(X_WB, float), np.asarray(X_TK, float)
        self._R = [tuple(row) for row in base[:3, :3].tolist()]
        self.gravity = (-9.81 * base[2, :3]).tolist()
        self._p = tuple(base[:3, 3].tolist())
        half = 0.5 * length * tool[:3, 0]
        self._heel = tuple((tool[:3, 3] - half).tolist())
        self._tip = tuple((tool[:3, 3] + half).tolist())
        self._down = tuple(tool[:3, 2].tolist())

    def edge(self, q: Sequence[float]) -> EdgePose:
        """The edge at joint positions `q` [6], rad."""
        nx, ny, nz, ox, oy, oz, ax, ay, az, px, py, pz = flange_pose(q)
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._R
        wx, wy, wz = self._p
        ends = []
        for x, y, z in (self._heel, self._tip):
            bx = px + nx * x + ox * y + ax * z
            by = py + ny * x + oy * y + ay * z
            bz = pz + nz * x + oz * y + az * z
            ends.append(
                (
                    wx + xx * bx + xy * by + xz * bz,
                    wy + yx * bx + yy * by + yz * bz,
                    wz + zx * bx + zy * by + zz * bz,
                )
            )
        x, y, z = self._down
        down = -(
            zx * (nx * x + ox * y + ax * z)
            + zy * (ny * x + oy * y + ay * z)
            + zz * (nz * x + oz * y + az * z)
        )
        return EdgePose(ends[0], ends[1], down)
