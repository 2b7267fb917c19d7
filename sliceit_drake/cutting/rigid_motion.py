"""The rigid motion that comes closest to that of one half of a food."""

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.model import CuttingModel

__all__ = ["rigid_motion"]


def rigid_motion(
    model: CuttingModel, positions: np.ndarray, velocities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose and velocity of the half at y < 0 as if it were rigid.

    The pose is the least-squares fit to its nodes, weighted by their true masses; the velocity has
    their momentum and angular momentum.

    Args:
        positions, velocities: Of the computed nodes in C [N, 3], metres and m/s.

    Returns:
        R [3, 3] and p [3] in C, so that a point at x at rest is now at R x + p; the angular
        velocity [3] in C, rad/s; and the velocity [3] of the point now at the origin of C, m/s.
    """
    mine = model.split.node_side[model.computed] == 0
    mass = model.true_mass[mine]
    rest, now, v = model.nodes[mine], positions[mine], velocities[mine]
    centre, here = mass @ rest / mass.sum(), mass @ now / mass.sum()
    R = Rotation.align_vectors(now - here, rest - centre, mass)[0].as_matrix()
    r = now - here
    inertia = np.einsum("i,ijk->jk", mass, (r * r).sum(1)[:, None, None] * np.eye(3))
    inertia -= np.einsum("i,ij,ik->jk", mass, r, r)
    spin = np.linalg.solve(inertia, mass @ np.cross(r, v))
    return R, here - R @ centre, spin, mass @ v / mass.sum() - np.cross(spin, here)
