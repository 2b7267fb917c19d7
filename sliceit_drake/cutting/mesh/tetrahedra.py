"""Tetrahedral meshes: validation and graded generators."""

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

__all__ = [
    "MeshError",
    "TetrahedralMesh",
    "boundary_faces",
    "box_mesh",
    "cylinder_mesh",
    "ellipsoid_mesh",
    "halved_mesh",
    "tapered_mesh",
]


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
        return np.linalg.det(_edges(self.vertices, self.tetrahedra)) / 6.0

    def mean_edge_length(self) -> float:
        """Mean edge length over all tetrahedra, metres."""
        pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
        v = self.vertices[self.tetrahedra]
        return float(np.mean([np.linalg.norm(v[:, i] - v[:, j], axis=1) for i, j in pairs]))

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
        scale = np.abs(_edges(v, t)).max((1, 2)) ** 3
        bad = np.flatnonzero(volume < -1e-9 * scale)
        if len(bad):
            raise MeshError(
                f"{where}: {len(bad)} inverted tetrahedra, first {bad[0]} with vertices "
                f"{t[bad[0]]} and volume {volume[bad[0]]:.3g} m^3. Swap two of its vertices."
            )
        bad = np.flatnonzero(volume <= 1e-9 * scale)
        if len(bad):
            raise MeshError(
                f"{where}: {len(bad)} degenerate tetrahedra, first {bad[0]} with vertices "
                f"{t[bad[0]]} and volume {volume[bad[0]]:.3g} m^3. Remesh or merge its vertices."
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
            gap = _least_gap(v, t, body)
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


def _least_gap(vertices: np.ndarray, tetrahedra: np.ndarray, body: np.ndarray) -> float:
    """Least distance of a vertex of the first body to one of the others, metres."""
    first, others = np.unique(tetrahedra[body == 0]), np.unique(tetrahedra[body != 0])
    return float(cKDTree(vertices[first]).query(vertices[others])[0].min())


def _edges(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Edge matrices [T, 3, 3], columns x1 - x0, x2 - x0, x3 - x0."""
    x = vertices[tetrahedra]
    return np.stack([x[:, k] - x[:, 0] for k in (1, 2, 3)], axis=-1)


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


def _oriented(vertices: np.ndarray, tetrahedra: np.ndarray) -> TetrahedralMesh:
    flip = np.linalg.det(_edges(vertices, tetrahedra)) < 0.0
    tetrahedra = tetrahedra.copy()
    tetrahedra[flip] = tetrahedra[flip][:, [0, 2, 1, 3]]
    return TetrahedralMesh(vertices, tetrahedra)


def _extruded(section: np.ndarray, triangles: np.ndarray, layers: np.ndarray) -> TetrahedralMesh:
    """Prisms over `triangles` between the `layers` along y, three tetrahedra each.

    Args:
        section: Points of the section [P, 2], (x, z).
        triangles: Indices [M, 3].
        layers: Increasing y coordinates [L].
    """
    n = len(section)
    vertices = np.concatenate(
        [np.column_stack([section[:, 0], np.full(n, y), section[:, 1]]) for y in layers]
    )
    t = np.sort(triangles, axis=1)
    a, b, c = t[:, 0], t[:, 1], t[:, 2]
    one = np.concatenate(
        [
            np.stack([a, b, c, c + n], 1),
            np.stack([a, b, b + n, c + n], 1),
            np.stack([a, a + n, b + n, c + n], 1),
        ]
    )
    tetrahedra = np.concatenate([one + k * n for k in range(len(layers) - 1)])
    return _oriented(vertices, tetrahedra)


def _disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit disc of concentric rings: points [P, 2] and triangles [6 rings^2, 3]."""
    points = [(0.0, 0.0)]
    start = [0]
    for k in range(1, rings + 1):
        start.append(len(points))
        angle = 2.0 * np.pi * np.arange(6 * k) / (6 * k)
        points += [(k / rings * np.sin(a), k / rings * np.cos(a)) for a in angle]
    triangles = []
    for k in range(1, rings + 1):
        outer, inner = 6 * k, max(6 * (k - 1), 1)
        for sector in range(6):
            for j in range(k):
                o0 = start[k] + (sector * k + j) % outer
                o1 = start[k] + (sector * k + j + 1) % outer
                i0 = start[k - 1] + (sector * (k - 1) + j) % inner
                triangles.append((o0, o1, i0))
                if j < k - 1:
                    i1 = start[k - 1] + (sector * (k - 1) + j + 1) % inner
                    triangles.append((o1, i1, i0))
    return np.array(points), np.array(triangles)


def cylinder_mesh(diameter: float, layers: np.ndarray, rings: int) -> TetrahedralMesh:
    """A cylinder along y that lies on z = 0.

    Args:
        diameter: Diameter, metres.
        layers: Increasing y coordinates of the mesh layers [L], metres; grade them towards the cut.
        rings: Concentric rings of the section; edges are about diameter / (2 rings).
    """
    section, triangles = _disc(rings)
    # The polygon has the circle's area: its corners stand out as much as its sides cut in.
    corners = 6 * rings
    radius = 0.5 * diameter * np.sqrt(np.pi / (0.5 * corners * np.sin(2.0 * np.pi / corners)))
    section = radius * (section + [0.0, 1.0])
    return _extruded(section, triangles, np.asarray(layers, float))


def tapered_mesh(radii: tuple[float, float], layers: np.ndarray, rings: int) -> TetrahedralMesh:
    """A cone's frustum along y that lies on z = 0 along a line; each section y is a circle.

    Args:
        radii: Radii at the first and at the last layer, metres; linear between.
        layers: Increasing y coordinates of the mesh layers [L], metres.
        rings: Concentric rings of the section.
    """
    y = np.asarray(layers, float)
    unit = cylinder_mesh(2.0, y, rings)
    p = unit.vertices
    radius = np.interp(p[:, 1], y[[0, -1]], radii)
    return TetrahedralMesh(
        np.stack([radius * p[:, 0], p[:, 1], radius * p[:, 2]], axis=1), unit.tetrahedra
    )


def box_mesh(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> TetrahedralMesh:
    """A box meshed on a grid of increasing coordinates, metres, six tetrahedra a cell."""
    x, y, z = (np.asarray(c, float) for c in (x, y, z))
    section = np.array([(a, c) for a in x for c in z])
    index = np.arange(len(section)).reshape(len(x), len(z))
    triangles = []
    for i in range(len(x) - 1):
        for k in range(len(z) - 1):
            p, q = index[i, k], index[i + 1, k]
            r, s = index[i + 1, k + 1], index[i, k + 1]
            alternate = (i + k) % 2
            triangles += [(p, q, s), (q, r, s)] if alternate else [(p, q, r), (p, r, s)]
    return _extruded(section, np.array(triangles), y)


def ellipsoid_mesh(diameters: tuple[float, float, float], refinements: int) -> TetrahedralMesh:
    """An ellipsoid on z = 0 of 20 * 8^refinements tetrahedra.

    An icosahedron of 20 tetrahedra around its centre, each edge halved `refinements` times, then
    pushed radially to a ball and scaled to the three `diameters`, metres.
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    signs = [(a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners = np.array([np.roll([0.0, a, b], k) for k in range(3) for a, b in signs])
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    near = np.abs(distance - 2.0) < 1e-9
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    vertices = np.concatenate([corners, np.zeros((1, 3))])
    tetrahedra = np.array([(12, *face) for face in faces])
    for _ in range(refinements):
        vertices, tetrahedra = _halved(vertices, tetrahedra)
    outward = np.array([corners[list(face)].mean(0) for face in faces])
    outward /= (outward * outward).sum(1, keepdims=True)
    gauge = (vertices @ outward.T).max(1, keepdims=True)
    length = np.linalg.norm(vertices, axis=1, keepdims=True)
    ball = vertices * np.divide(gauge, length, out=np.ones_like(length), where=length > 0.0)
    half = 0.5 * np.asarray(diameters, float)
    return _oriented(ball * half + [0.0, 0.0, half[2]], tetrahedra)


def halved_mesh(mesh: TetrahedralMesh) -> TetrahedralMesh:
    """The same body with each edge halved: eight tetrahedra for one."""
    return _oriented(*_halved(mesh.vertices, mesh.tetrahedra))


def _halved(vertices: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each tetrahedron into four at its corners and four in the octahedron between them."""
    pairs = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
    edges = np.sort(tetrahedra[:, pairs].reshape(-1, 2), axis=1)
    edges, index = np.unique(edges, axis=0, return_inverse=True)
    m = len(vertices) + index.reshape(-1, 6)
    t = tetrahedra
    ab, ac, ad, bc, bd, cd = (m[:, k] for k in range(6))
    children = [
        (t[:, 0], ab, ac, ad),
        (ab, t[:, 1], bc, bd),
        (ac, bc, t[:, 2], cd),
        (ad, bd, cd, t[:, 3]),
        (ab, cd, ac, ad),
        (ab, cd, ad, bd),
        (ab, cd, bd, bc),
        (ab, cd, bc, ac),
    ]
    midpoints = vertices[edges].mean(1)
    return np.concatenate([vertices, midpoints]), np.concatenate([np.stack(c, 1) for c in children])
