"""Checks that a mesh is one solid body: where its surface pinches or crosses itself."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

__all__ = ["bodies", "folded_faces", "pinched_edges", "pinched_vertices", "surface_crossings"]

BRUTE_FORCE = 4096
"""Pairs of boxes that are compared one by one, instead of halving the larger set once more."""

TOUCHING = 1e-4
"""Depth over the mean edge length by which a surface is drawn inwards before crossings are sought:
what only touches comes apart, and what overlaps by more than twice that does not."""

ROUNDING = 1e-6
"""Fraction of a face by which an edge may pass beside it and still counts as going through."""


def bodies(tetrahedra: np.ndarray) -> np.ndarray:
    """Number of the body of each tetrahedron [T]; two that share a vertex are of one body."""
    used, t = np.unique(tetrahedra, return_inverse=True)
    t = t.reshape(-1, 4)
    rows = np.repeat(t[:, 0], 3)
    graph = coo_matrix((np.ones(len(rows)), (rows, t[:, 1:].ravel())), [len(used)] * 2)
    return connected_components(graph, directed=False)[1][t[:, 0]]


def folded_faces(faces: np.ndarray) -> np.ndarray:
    """Faces [K, 3] that have both of their tetrahedra on one side.

    Of the faces of all tetrahedra, outward oriented [F, 3], each at most twice.
    """
    key, face, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    turn = np.zeros(len(key), int)
    # 1 where the vertices of a face stand in even order, else -1.
    a, b, c = faces.T
    np.add.at(turn, face.ravel(), np.sign(b - a) * np.sign(c - b) * np.sign(c - a))
    return key[(count == 2) & (turn != 0)]


def pinched_edges(boundary: np.ndarray) -> np.ndarray:
    """Edges [K, 2] of a closed surface [B, 3] in which more than two faces meet."""
    edges = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    key, count = np.unique(edges, axis=0, return_counts=True)
    return key[count > 2]


def pinched_vertices(boundary: np.ndarray) -> np.ndarray:
    """Vertices [K] at which parts of a closed surface [B, 3] meet that share no edge there."""
    # Each face is there once for each of its corners; it goes with its neighbour over an edge.
    fan = np.arange(boundary.size).reshape(-1, 3)
    sides = [[0, 1], [1, 2], [2, 0]]
    edges, fans = boundary[:, sides].reshape(-1, 2), fan[:, sides].reshape(-1, 2)
    turned = edges[:, 0] > edges[:, 1]
    edges[turned], fans[turned] = edges[turned, ::-1], fans[turned, ::-1]
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, fans = edges[order], fans[order]
    same = (edges[1:] == edges[:-1]).all(1)
    a, b = fans[:-1][same].ravel(), fans[1:][same].ravel()
    graph = coo_matrix((np.ones(len(a)), (a, b)), [boundary.size] * 2)
    label = connected_components(graph, directed=False)[1]
    parts = np.unique(np.stack([boundary.ravel(), label], axis=1), axis=0)
    vertex, count = np.unique(parts[:, 0], return_counts=True)
    return vertex[count > 1]


def surface_crossings(vertices: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """Where a surface of faces [B, 3] goes through itself: pairs (one by an edge of the other).

    Edge by edge against face by face, those apart that share a vertex. Surfaces that only touch
    do not count. Where each tetrahedron is positive, no face is folded and the body is one, a
    surface without crossings bounds each point at most once, so that no elements overlap.

    Returns:
        Indices [K, 2] of the faces: that the edge belongs to, and that it goes through.
    """
    sides = boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first = np.unique(np.sort(sides, axis=1), axis=0, return_index=True)
    edges = sides[first]
    vertices = _drawn_in(vertices, boundary)
    ends, corners = vertices[edges], vertices[boundary]
    e, f = _near(ends.min(1), ends.max(1), corners.min(1), corners.max(1))
    apart = (edges[e][:, :, None] != boundary[f][:, None, :]).all((1, 2))
    e, f = e[apart], f[apart]
    p, q = ends[e, 0], ends[e, 1]
    a, b, c = (corners[f, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    height_p = np.einsum("ij,ij->i", p - a, normal)
    height_q = np.einsum("ij,ij->i", q - a, normal)
    opposite = height_p * height_q < 0.0
    share = height_p / np.where(opposite, height_p - height_q, 1.0)
    x = p + share[:, None] * (q - p)
    inside = opposite
    for u, v in ((a, b), (b, c), (c, a)):
        # On the border counts: bodies on one grid cross along each other's edges.
        turn = np.einsum("ij,ij->i", np.cross(v - u, x - u), normal)
        inside = inside & (turn >= -ROUNDING * np.einsum("ij,ij->i", normal, normal))
    return np.stack([first[e[inside]] // 3, f[inside]], axis=1)


def _drawn_in(vertices: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """The vertices with those of the surface moved inwards by `TOUCHING`."""
    corners = vertices[boundary]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.zeros_like(vertices)
    np.add.at(outward, boundary, normal[:, None, :])
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    outward /= np.where(length > 0.0, length, 1.0)
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
    return np.asarray(vertices - TOUCHING * edge * outward)


def _near(
    low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the boxes of two sets that meet: halved along the longest side, until few."""
    found_a, found_b = [np.zeros(0, int)], [np.zeros(0, int)]
    waiting = [(np.arange(len(low_a)), np.arange(len(low_b)))]
    while waiting:
        a, b = waiting.pop()
        if len(a) * len(b) <= BRUTE_FORCE:
            meet = ((low_a[a][:, None] <= high_b[b]) & (low_b[b] <= high_a[a][:, None])).all(2)
            i, j = np.nonzero(meet)
            found_a.append(a[i])
            found_b.append(b[j])
            continue
        split_a = len(a) >= len(b)
        low, high, own = (low_a, high_a, a) if split_a else (low_b, high_b, b)
        middle = low[own] + high[own]
        axis = int(np.ptp(middle, axis=0).argmax())
        order = own[np.argsort(middle[:, axis], kind="stable")]
        for half in np.array_split(order, 2):
            least, most = low[half].min(0), high[half].max(0)
            if split_a:
                kept = b[((low_b[b] <= most) & (high_b[b] >= least)).all(1)]
                pair = (half, kept)
            else:
                kept = a[((low_a[a] <= most) & (high_a[a] >= least)).all(1)]
                pair = (kept, half)
            if len(kept):
                waiting.append(pair)
    return np.concatenate(found_a), np.concatenate(found_b)
