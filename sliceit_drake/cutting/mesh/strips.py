"""Strips of tetrahedra that share faces: the kernels load a node once for several of them."""

import heapq
import itertools

import numpy as np

from sliceit_drake.cutting.kernels.types import CORNERS, STRIP

__all__ = ["tetrahedron_strips"]


def tetrahedron_strips(tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Disjoint strips of up to `STRIP` tetrahedra, of which each four nodes in a row are one.

    Greedy: each strip starts at a tetrahedron with the fewest neighbours that are left and goes on
    to such a one. A strip that is too short goes on with permutations of its last tetrahedron.

    Args:
        tetrahedra: Nodes [T, 4].

    Returns:
        Nodes of the strips [S, CORNERS], and the place of each tetrahedron [T], counted along all
        strips.
    """
    left = _neighbours(tetrahedra)
    waiting = [(len(near), e) for e, near in enumerate(left)]
    heapq.heapify(waiting)
    place = np.full(len(tetrahedra), -1)
    strips: list[list[int]] = []
    while waiting:
        _, e = heapq.heappop(waiting)
        if place[e] >= 0:
            continue
        strip: list[int] = []
        while True:
            place[e] = STRIP * len(strips) + len(strip)
            strip.append(e)
            for near in left[e]:
                left[near].remove(e)
                heapq.heappush(waiting, (len(left[near]), near))
            if len(strip) == STRIP or not left[e]:
                break
            e = min(left[e], key=lambda near: (len(left[near]), near))
        strips.append(_nodes([set(tetrahedra[e].tolist()) for e in strip]))
    return np.array(strips), place


def _neighbours(tetrahedra: np.ndarray) -> list[set[int]]:
    """For each tetrahedron those that share a face with it."""
    faces = np.sort(tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    _, face, count = np.unique(
        faces.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(face.ravel(), kind="stable")
    shared = order[count[face.ravel()[order]] == 2]
    neighbours: list[set[int]] = [set() for _ in tetrahedra]
    for a, b in (shared.reshape(-1, 2) // 4).tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    return neighbours


def _nodes(strip: list[set[int]]) -> list[int]:
    """Nodes of a strip in order: those that leave, those of all its tetrahedra, those that come."""
    leaving = [node for a, b in itertools.pairwise(strip) for node in a - b]
    coming = [node for a, b in itertools.pairwise(strip) for node in b - a]
    nodes = leaving + sorted(set.intersection(*strip)) + coming
    while len(nodes) < CORNERS:
        nodes.append(nodes[-4])
    return nodes
