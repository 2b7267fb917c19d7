"""Volume and section of a split mesh."""

import numpy as np

from sliceit_drake.cutting.mesh.split import SplitMesh
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh


def material_volumes(split: SplitMesh) -> np.ndarray:
    """Material volumes of the elements [T], m^3."""
    return TetrahedralMesh(split.nodes, split.tetrahedra).volumes() * split.fraction


def area_of_section(split: SplitMesh) -> float:
    """Area of the cut, m^2."""
    a, b, c = (split.points[split.triangles[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
