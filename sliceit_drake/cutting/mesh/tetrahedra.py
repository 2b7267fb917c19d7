"""Tetrahedral meshes and their validation."""

import dataclasses as dc

import numpy as np
from scipy.spatial import cKDTree

from sliceit_drake.cutting.mesh.manifold import (
    bodies,
    folded_faces,
    pinched_edges,
    pinched_vertices,
    surface_crossings,
)

__all__ = ["EDGES", "MeshError", "TetrahedralMesh", "boundary_faces"]


EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
"""Corners of the edges of a tetrahedron."""


class MeshError(ValueError):
    """A mesh that the physics cannot use; the message names the element and the fix."""


@dc.dataclass
class TetrahedralMesh:
    """A tetrahedral mesh in the food frame F.

    Attributes:
        vertices: Positions [N, 3], metres.
        tetrahedra: Vertex indices [T, 4], positively oriented.
    """

    vertices: np.ndarray
    tetrahedra: np.ndarray

    def volumes(self) -> np.ndarray:
        """Signed volumes [T], m^3."""
        return np.linalg.det(self.edges()) / 6.0

    def edges(self) -> np.ndarray:
        """Edge matrices [T, 3, 3], columns x1 - x0, x2 - x0, x3 - x0, metres."""
        x = self.vertices[self.tetrahedra]
        return np.stack([x[:, k] - x[:, 0] for k in (1, 2, 3)], axis=-1)

    def lumped(self, volume: np.ndarray) -> np.ndarray:
        """Volumes of the tetrahedra [T] lumped to the vertices [N]."""
        at_vertices = np.zeros(len(self.vertices))
        np.add.at(at_vertices, self.tetrahedra, np.repeat(0.25 * volume[:, None], 4, axis=1))
        return at_vertices

    def mean_edge_length(self) -> float:
        """Mean edge length over all tetrahedra, metres."""
        v = self.vertices[self.tetrahedra]
        return float(np.mean([np.linalg.norm(v[:, i] - v[:, j], axis=1) for i, j in EDGES]))

    def check(self, where: str = "mesh") -> None:
        """Refuses what the physics cannot use.

        Raises:
            MeshError: Non-finite vertices, indices out of range, inverted, degenerate or repeated
                elements, faces shared by more than two elements, size out of the plausible range
                (1 mm to 1 m), vertices that no element uses.
        """
        v, t = self.vertices, self.tetrahedra
        if v.ndim != 2 or v.shape[1] != 3 or t.ndim != 2 or t.shape[1] != 4 or len(t) == 0:
            raise MeshError(
                f"{where}: needs vertices [N, 3] and at least one tetrahedron [T, 4]; got "
                f"{v.shape} and {t.shape}."
            )
        bad = np.flatnonzero(~np.isfinite(v).all(1))
        if len(bad):
            raise MeshError(f"{where}: vertex {bad[0]} is {v[bad[0]]}: not a finite position.")
        bad = np.flatnonzero(((t < 0) | (t >= len(v))).any(1))
        if len(bad):
            raise MeshError(
                f"{where}: tetrahedron {bad[0]} refers to vertices {t[bad[0]]}, but there are "
                f"{len(v)} (counted from 0)."
            )
        size = np.ptp(v, axis=0).max()
        if not 1e-3 <= size <= 1.0:
            unit = " Is it in millimetres? Scale it by 0.001." if 1.0 < size <= 1e3 else ""
            raise MeshError(
                f"{where}: the mesh measures {size:.4g} m; foods are 0.001 to 1 m.{unit}"
            )
        volume = self.volumes()
        scale = np.abs(self.edges()).max((1, 2)) ** 3
        for kind, wrong, fix in (
            ("inverted", volume < -1e-9 * scale, "Swap two of its vertices."),
            ("degenerate", volume <= 1e-9 * scale, "Remesh or merge its vertices."),
        ):
            bad = np.flatnonzero(wrong)
            if len(bad):
                raise MeshError(
                    f"{where}: {len(bad)} {kind} tetrahedra, first {bad[0]} with vertices "
                    f"{t[bad[0]]} and volume {volume[bad[0]]:.3g} m^3. {fix}"
                )
        _, first = np.unique(np.sort(t, axis=1), axis=0, return_index=True)
        if len(first) < len(t):
            again = np.setdiff1d(np.arange(len(t)), first)[0]
            raise MeshError(
                f"{where}: {len(t) - len(first)} tetrahedra are repeated, such as {again} with "
                f"vertices {t[again]}. Remove them."
            )
        _, count = np.unique(np.sort(_faces(t), axis=1), axis=0, return_counts=True)
        if count.max() > 2:
            raise MeshError(
                f"{where}: {np.count_nonzero(count > 2)} faces are shared by more than two "
                "tetrahedra; elements overlap. Remesh."
            )
        unused = np.setdiff1d(np.arange(len(v)), t)
        if len(unused):
            raise MeshError(
                f"{where}: {len(unused)} vertices belong to no tetrahedron, first {unused[0]}. "
                "Remove them."
            )

    def check_solid(self, where: str = "mesh") -> None:
        """Refuses what is not one solid body; of a mesh that `check` accepts.

        Our generators need no such check; a mesh from elsewhere does.

        Raises:
            MeshError: Fragments that share no vertex, elements on the same side of a face, parts
                that meet in an edge or a vertex alone, a surface that goes through itself.
        """
        v, t = self.vertices, self.tetrahedra
        body = bodies(t)
        if body.any():
            count = np.sort(np.bincount(body))[::-1]
            listed = ", ".join(str(n) for n in count[:5]) + (", ..." if len(count) > 5 else "")
            fix = "Keep one of them."
            first, others = np.unique(t[body == 0]), np.unique(t[body != 0])
            gap = cKDTree(v[first]).query(v[others])[0].min()
            if gap <= 1e-6 * self.mean_edge_length():
                fix = "They touch: merge the vertices that lie on each other when meshing."
            raise MeshError(
                f"{where}: {len(count)} fragments that share no vertex, of {listed} tetrahedra; a "
                f"food is one body. {fix}"
            )
        folded = folded_faces(_faces(t))
        if len(folded):
            raise MeshError(
                f"{where}: {len(folded)} faces have both of their tetrahedra on one side, first "
                f"that of vertices {folded[0]}; elements overlap. Remesh."
            )
        boundary, owner = boundary_faces(t)
        pinched = pinched_edges(boundary)
        if len(pinched):
            raise MeshError(
                f"{where}: not manifold: at {len(pinched)} edges parts meet in the edge alone, "
                f"first that of vertices {pinched[0]} at {v[pinched[0]].mean(0)} m. Join the parts "
                "by faces, or part them."
            )
        pinched = pinched_vertices(boundary)
        if len(pinched):
            raise MeshError(
                f"{where}: not manifold: at {len(pinched)} vertices parts meet in the vertex "
                f"alone, first {pinched[0]} at {v[pinched[0]]} m. Join the parts by faces, or part "
                "them."
            )
        crossings = surface_crossings(v, boundary)
        if len(crossings):
            one, other = owner[crossings[0]]
            raise MeshError(
                f"{where}: its surface goes through itself at {len(crossings)} places, first where "
                f"tetrahedra {one} and {other} overlap, at {v[t[one]].mean(0)} m. Repair the "
                "surface and mesh it again."
            )


def _faces(tetrahedra: np.ndarray) -> np.ndarray:
    """Faces [4 T, 3], outward oriented; face 4 t + k of tetrahedron t lies opposite vertex k."""
    return tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)


def boundary_faces(tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces that belong to one tetrahedron.

    Returns:
        Faces [B, 3], outward oriented, and the tetrahedron of each [B].
    """
    faces = _faces(tetrahedra)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = np.sort(first[count == 1])
    return faces[outer], outer // 4
