"""Generators of tetrahedral meshes, graded towards the cut."""

import numpy as np

from sliceit_drake.cutting.mesh.tetrahedra import EDGES, TetrahedralMesh

__all__ = ["box_mesh", "cylinder_mesh", "ellipsoid_mesh", "halved_mesh"]


def _oriented(vertices: np.ndarray, tetrahedra: np.ndarray) -> TetrahedralMesh:
    flip = TetrahedralMesh(vertices, tetrahedra).volumes() < 0.0
    tetrahedra = tetrahedra.copy()
    tetrahedra[flip] = tetrahedra[flip][:, [0, 2, 1, 3]]
    return TetrahedralMesh(vertices, tetrahedra)


def _extruded(section: np.ndarray, triangles: np.ndarray, layers: np.ndarray) -> TetrahedralMesh:
    """Prisms over triangles [M, 3] between increasing `layers` along y [L], of three tetrahedra.

    The section's points are (x, z) [P, 2].
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


def cylinder_mesh(
    diameter: float, layers: np.ndarray, rings: int, half: bool = False
) -> TetrahedralMesh:
    """A cylinder along y that lies on z = 0.

    Args:
        diameter: Diameter, metres.
        layers: Increasing y coordinates of the mesh layers [L], metres; grade them towards the cut.
        rings: Concentric rings of the section; edges are about diameter / (2 rings).
        half: Whether only its upper half, on its flat side.
    """
    section, triangles = _disc(rings)
    # The polygon has the circle's area: its corners stand out as much as its sides cut in.
    corners = 6 * rings
    radius = 0.5 * diameter * np.sqrt(np.pi / (0.5 * corners * np.sin(2.0 * np.pi / corners)))
    if half:
        # Three of the six sectors, which begin along x once both axes are exchanged.
        section = section[:, ::-1]
        upper = triangles[section[triangles, 1].mean(1) > 0.0]
        used, triangles = np.unique(upper, return_inverse=True)
        section, triangles = radius * section[used], triangles.reshape(-1, 3)
    else:
        section = radius * (section + [0.0, 1.0])
    return _extruded(section, triangles, np.asarray(layers, float))


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
    edges = np.sort(tetrahedra[:, EDGES].reshape(-1, 2), axis=1)
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
