"""Virtual-node split of a tetrahedral mesh by a plane, with material fractions.

Each tetrahedron with material on one side of the plane gets a copy for that side, which refers to
that side's copies of its vertices and holds the fraction of the volume on its side (Molino, Bao and
Fedkiw 2004; Sifakis, Der and Fedkiw 2007). Nothing is moved, so volume, mass and section are
conserved for any plane. A vertex within `SNAP` of the plane counts as on it. No sliver is merged:
its bulk stiffness and its mass shrink alike, but the stiffness of bonds, flanks and edge at its
surface does not, nor does the force of the edge on it; `model.SLIVER` and `geometry.MIN_SHARE`
say what becomes of it, studies/physics/split_step_limit.py what that leaves of the step limit.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.mesh.tetrahedra import EDGES, MeshError, TetrahedralMesh

__all__ = ["CutPlane", "SplitMesh", "split_mesh"]

SNAP = 1e-6
"""Fraction of the mean edge length by which a vertex may be off the plane and counts as on it."""


@dc.dataclass
class CutPlane:
    """The cut plane with the frame C of the cut.

    Attributes:
        point: A point of the plane in F [3], metres: the origin Co.
        normal: Unit normal in F [3]: Cy.
        up: Direction from which the knife comes, projected into the plane: Cz. Cx = Cy x Cz runs
            along the edge.
    """

    point: np.ndarray
    normal: np.ndarray
    up: np.ndarray

    def rotation(self) -> np.ndarray:
        """R_FC [3, 3].

        Raises:
            MeshError: The normal is zero or `up` is parallel to it.
        """
        n = np.asarray(self.normal, float)
        length = np.linalg.norm(n)
        if not np.isfinite(length) or length < 1e-12:
            raise MeshError(f"cut plane: normal {self.normal} has no direction.")
        n = n / length
        up = np.asarray(self.up, float)
        up = up - (up @ n) * n
        length = np.linalg.norm(up)
        if not np.isfinite(length) or length < 1e-6:
            raise MeshError(
                f"cut plane: the knife's direction {self.up} is parallel to the normal "
                f"{self.normal}; the knife cannot cut along it."
            )
        up = up / length
        return np.column_stack([np.cross(n, up), n, up])


@dc.dataclass
class SplitMesh:
    """Two half bodies in the frame C of the cut (y = 0 is the cut plane).

    Sides: 0 is y < 0 (minus), 1 is y > 0 (plus).

    Attributes:
        nodes: Positions [N, 3], metres.
        node_side: Side of each node [N].
        node_source: Vertex of the original mesh [N].
        node_is_material: Whether the node lies in its side's material, not beyond the plane [N].
        tetrahedra: Node indices [T, 4].
        fraction: Fraction of each tetrahedron that is material [T].
        centroid: Barycentric coordinates of the centroid of that share [T, 4].
        point_nodes: Nodes of each cut point [P, 2, 2]: side, end.
        point_weights: Their weights [P, 2], same for both sides; they sum to 1.
        points: Positions of the cut points [P, 3].
        triangles: Section triangulated by cut points [M, 3].
        vertex_position: All original vertices in C [V, 3], for drawing what is not computed.
        source_tetrahedra: Original tetrahedra [T0, 4].
    """

    nodes: np.ndarray
    node_side: np.ndarray
    node_source: np.ndarray
    node_is_material: np.ndarray
    tetrahedra: np.ndarray
    fraction: np.ndarray
    centroid: np.ndarray
    point_nodes: np.ndarray
    point_weights: np.ndarray
    points: np.ndarray
    triangles: np.ndarray
    vertex_position: np.ndarray
    source_tetrahedra: np.ndarray

    @property
    def nearest_vertex(self) -> np.ndarray:
        """Vertex of the original mesh to which each cut point is the nearest along its edge [P]."""
        end = self.point_weights.argmax(1)
        return np.asarray(self.node_source[self.point_nodes[np.arange(len(end)), 0, end]])


def _minority_part(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Volume share and barycentric centroid of the part above 0 of tetrahedra [K, 4].

    The part is a union of small tetrahedra in barycentric coordinates: one corner above gives one,
    two corners above give a wedge of three.
    """
    share = np.zeros(len(height))
    moment = np.zeros((len(height), 4))

    def add(rows: np.ndarray, corners: list[np.ndarray]) -> None:
        matrix = np.stack(corners, axis=1)
        part = np.abs(np.linalg.det(matrix))
        share[rows] += part
        moment[rows] += part[:, None] * matrix.mean(1)

    order = np.argsort(-height, axis=1)
    count = (height > 0.0).sum(1)
    unit = np.eye(4)

    def corner(rows: np.ndarray, k: int) -> np.ndarray:
        return unit[order[rows, k]]

    def crossing(rows: np.ndarray, i: int, j: int) -> np.ndarray:
        hi = height[rows, order[rows, i]]
        hj = height[rows, order[rows, j]]
        t = (hi / (hi - hj))[:, None]
        return (1.0 - t) * corner(rows, i) + t * corner(rows, j)

    one = np.flatnonzero(count == 1)
    add(one, [corner(one, 0)] + [crossing(one, 0, j) for j in (1, 2, 3)])
    two = np.flatnonzero(count == 2)
    a, b = corner(two, 0), corner(two, 1)
    a2, a3 = crossing(two, 0, 2), crossing(two, 0, 3)
    b2, b3 = crossing(two, 1, 2), crossing(two, 1, 3)
    add(two, [a, a2, a3, b])
    add(two, [a2, a3, b, b3])
    add(two, [a2, b, b2, b3])
    centroid = np.divide(
        moment, share[:, None], out=np.full_like(moment, 0.25), where=share[:, None] > 0
    )
    return share, centroid


def _side_parts(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share and centroid of the part above 0 for any number of corners above."""
    count = (height > 0.0).sum(1)
    flip = count == 3
    share, centroid = _minority_part(np.where(flip[:, None], -height, height))
    complement = 1.0 - share
    other = (0.25 - share[:, None] * centroid) / np.where(complement > 0.0, complement, 1.0)[
        :, None
    ]
    share = np.where(flip, complement, share)
    centroid = np.where(flip[:, None], other, centroid)
    whole = np.all(height >= 0.0, axis=1)
    return np.where(whole, 1.0, share), np.where(whole[:, None], 0.25, centroid)


def split_mesh(mesh: TetrahedralMesh, plane: CutPlane) -> SplitMesh:
    """Splits a mesh, checked, by a plane in its frame.

    Raises:
        MeshError: The plane misses the mesh.
    """
    R_FC = plane.rotation()
    vertices = (mesh.vertices - np.asarray(plane.point, float)) @ R_FC
    t0 = mesh.tetrahedra
    y = vertices[:, 1].copy()
    y[np.abs(y) <= SNAP * mesh.mean_edge_length()] = 0.0
    h = y[t0]
    if not (y > 0.0).any() or not (y < 0.0).any():
        raise MeshError(
            f"cut plane through {np.asarray(plane.point)} with normal {np.asarray(plane.normal)} "
            f"misses the food: its vertices lie {y.min():.4g} to {y.max():.4g} m from the plane. "
            "Move the plane's point into the food."
        )

    parents, fractions, centroids, sides = [], [], [], []
    for which, outward in ((0, -1.0), (1, 1.0)):
        rows = np.flatnonzero((outward * h > 0.0).any(1))
        share, centroid = _side_parts(outward * h[rows])
        parents.append(rows)
        fractions.append(share)
        centroids.append(centroid)
        sides.append(np.full(len(rows), which))
    parent = np.concatenate(parents)

    key = 2 * t0[parent] + np.concatenate(sides)[:, None]
    used, tetrahedra = np.unique(key, return_inverse=True)
    tetrahedra = tetrahedra.reshape(-1, 4)
    node_of = np.full(2 * len(vertices), -1)
    node_of[used] = np.arange(len(used))
    source, node_side = used // 2, used % 2
    sign = np.where(node_side == 1, 1.0, -1.0)

    ends, triangles = _section(t0, h)
    first, second = ends[:, 0], ends[:, 1]
    span = y[first] - y[second]
    w_first = np.where(first == second, 1.0, -y[second] / np.where(span == 0.0, 1.0, span))
    weights = np.stack([w_first, 1.0 - w_first], axis=1)
    point_nodes = np.stack([node_of[2 * ends], node_of[2 * ends + 1]], axis=1)
    points = (vertices[ends] * weights[..., None]).sum(1)

    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1]
    triangles = np.where((normal < 0.0)[:, None], triangles[:, [0, 2, 1]], triangles)
    return SplitMesh(
        nodes=vertices[source],
        node_side=node_side,
        node_source=source,
        node_is_material=sign * y[source] >= 0.0,
        tetrahedra=tetrahedra,
        fraction=np.concatenate(fractions),
        centroid=np.concatenate(centroids),
        point_nodes=point_nodes,
        point_weights=weights,
        points=points,
        triangles=triangles,
        vertex_position=vertices,
        source_tetrahedra=t0,
    )


def _section(t0: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut points and triangles of the section.

    Args:
        t0: Tetrahedra [T0, 4].
        h: Signed heights of their vertices [T0, 4], 0 on the plane.

    Returns:
        End vertices of each cut point [P, 2], equal for a vertex on the plane; triangles [M, 3].
    """
    vertex_count = int(t0.max()) + 1
    corners: list[np.ndarray] = []

    def key(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.minimum(a, b).astype(np.int64) * vertex_count + np.maximum(a, b)

    # Faces that lie in the plane, between two whole tetrahedra.
    below = (h <= 0.0).all(1) & ((h == 0.0).sum(1) == 3)
    above = (h >= 0.0).all(1) & ((h == 0.0).sum(1) == 3)

    def faces(rows: np.ndarray) -> np.ndarray:
        return np.sort(np.where(h[rows] == 0.0, t0[rows], vertex_count), axis=1)[:, :3]

    low, high = faces(np.flatnonzero(below)), faces(np.flatnonzero(above))
    if len(low) and len(high):
        joined = np.concatenate([np.unique(low, axis=0), np.unique(high, axis=0)])
        face, count = np.unique(joined, axis=0, return_counts=True)
        face = face[count == 2]
        corners.append(np.stack([key(face[:, k], face[:, k]) for k in range(3)], axis=1))

    through = np.flatnonzero((h > 0.0).any(1) & (h < 0.0).any(1))
    t, height = t0[through], h[through]
    crossed = height[:, EDGES[:, 0]] * height[:, EDGES[:, 1]] < 0.0
    edge_key = key(t[:, EDGES[:, 0]], t[:, EDGES[:, 1]])
    corner_key = np.concatenate([key(t, t), edge_key], axis=1)
    present = np.concatenate([height == 0.0, crossed], axis=1)
    number = present.sum(1)
    three = number == 3
    corners.append(corner_key[three][present[three]].reshape(-1, 3))
    rows = np.flatnonzero(number == 4)
    if len(rows):
        # Two corners above (a, b) and two below (c, d): the polygon runs ac, ad, bd, bc.
        order = np.argsort(-height[rows], axis=1)
        a, b, c, d = (np.take_along_axis(t[rows], order[:, [k]], 1)[:, 0] for k in range(4))
        quad = np.stack([key(a, c), key(a, d), key(b, d), key(b, c)], axis=1)
        corners.append(quad[:, [0, 1, 2]])
        corners.append(quad[:, [0, 2, 3]])
    used, triangles = np.unique(np.concatenate(corners), return_inverse=True)
    ends = np.stack([used // vertex_count, used % vertex_count], axis=1)
    return ends, triangles.reshape(-1, 3)
