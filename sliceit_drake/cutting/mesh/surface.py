"""The food for drawing, following the computed nodes: its surface of outer skin and cut faces, and
the solids of both sides."""

import dataclasses as dc
import functools
import itertools

import numpy as np

from sliceit_drake.cutting.mesh.cut_geometry import CutGeometry
from sliceit_drake.cutting.mesh.split import SplitMesh
from sliceit_drake.cutting.mesh.tetrahedra import boundary_faces

__all__ = ["END", "SKIN", "FoodBody", "FoodCorners", "FoodSurface", "food_body", "food_surface"]

SKIN, END = -1, -2
"""Of a corner that is no cut point: it lies on the skin, or on a flat end of the food across y."""


@dc.dataclass
class FoodCorners:
    """Points of the food that follow the computed nodes: weighted pairs of nodes.

    Attributes:
        ends: Nodes of the split mesh at each corner [V, 2].
        weights: Their weights [V, 2].
        side: Side of the cut: 0 minus, 1 plus [V].
        cut_point: Cut point that each corner is, `SKIN` or `END` elsewhere [V].
    """

    ends: np.ndarray
    weights: np.ndarray
    side: np.ndarray
    cut_point: np.ndarray

    @functools.cached_property
    def is_cut_face(self) -> np.ndarray:
        """Whether each corner belongs to the cut that is computed [V]."""
        return self.cut_point >= 0

    def positions(self, cut: CutGeometry, computed: np.ndarray) -> np.ndarray:
        """Corners in F [V, 3], from positions of the computed nodes in C [N, 3], metres."""
        nodes = cut.split.nodes.copy()
        nodes[cut.computed] = computed
        corners = (nodes[self.ends] * self.weights[..., None]).sum(1)
        return corners @ cut.X_FC_rotation.T + cut.X_FC_position

    def damage(
        self, cut: CutGeometry, edge_depth: np.ndarray, cohesive_damage: np.ndarray
    ) -> np.ndarray:
        """Fraction of the toughness that is spent at each corner [V]: 0 intact and skin, 1 cut.

        The edge has spent the cut fraction D of a point and opening the share phi of the rest:
        1 - (1 - D) (1 - phi).

        Args:
            edge_depth: Largest depth of the edge below each cut point [P], metres.
            cohesive_damage: phi of each cut point [P].
        """
        tables = cut.tables
        grid = np.clip(
            (edge_depth + tables.reach) / tables.spacing, 0.0, tables.fraction.shape[1] - 1
        )
        low = np.minimum(grid.astype(int), tables.fraction.shape[1] - 2)
        rows, part = np.arange(len(grid)), grid - low
        passed = (1.0 - part) * tables.fraction[rows, low] + part * tables.fraction[rows, low + 1]
        spent = 1.0 - (1.0 - passed) * (1.0 - cohesive_damage)
        return np.where(self.is_cut_face, spent[self.cut_point], 0.0)


@dc.dataclass
class FoodSurface(FoodCorners):
    """Triangles between corners.

    Attributes:
        triangles: Corners [M, 3], outward oriented; none joins both sides.
    """

    triangles: np.ndarray

    @functools.cached_property
    def halves(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Corners [V_s] of each side and its triangles [M_s, 3], which index into those."""
        halves = []
        for side in (0, 1):
            corners = np.flatnonzero(self.side == side)
            number = np.full(len(self.side), -1)
            number[corners] = np.arange(len(corners))
            mine = self.side[self.triangles[:, 0]] == side
            halves.append((corners, number[self.triangles[mine]]))
        return tuple(halves)


@dc.dataclass
class FoodBody(FoodCorners):
    """Tetrahedra between corners.

    Attributes:
        tetrahedra: Corners [M, 4], of positive volume at rest; none joins both sides.
    """

    tetrahedra: np.ndarray


class _CornerList:
    """Corners of a drawing, each once, in the order in which they are asked for.

    Attributes:
        heights: Height of each original vertex over the cut plane [V], metres; 0 if it counts as
            on it.
    """

    def __init__(self, split: SplitMesh) -> None:
        self._split = split
        self._number: dict[tuple[int, int, int], int] = {}
        self._rows: list[tuple[int, int, int]] = []
        self.heights = split.vertex_position[:, 1].copy()
        single = split.point_weights[:, 1] == 0.0
        self.heights[split.node_source[split.point_nodes[single, 0, 0]]] = 0.0

    def number(self, a: int, b: int, cut_point: int = -1) -> int:
        """Number of the corner at a node a = b, or on the plane between two nodes."""
        key = (min(a, b), max(a, b), cut_point)
        if key not in self._number:
            self._number[key] = len(self._rows)
            self._rows.append((a, b, cut_point))
        return self._number[key]

    def fields(self) -> dict[str, np.ndarray]:
        """The fields of `FoodCorners`."""
        rows = np.array(self._rows)
        ends, cut_point = rows[:, :2], rows[:, 2]
        y = self.heights[self._split.node_source[ends]]
        apart = ends[:, 0] != ends[:, 1]
        w = np.divide(y[:, 1], y[:, 1] - y[:, 0], out=np.ones(len(rows)), where=apart)
        weights = np.stack([w, 1.0 - w], axis=1)
        side = self._split.node_side[ends[:, 0]]
        return {"ends": ends, "weights": weights, "side": side, "cut_point": cut_point}


def food_surface(cut: CutGeometry) -> FoodSurface:
    """The drawable surface of both halves.

    Outer faces that the plane crosses are clipped, so that each side keeps its own part.
    """
    split = cut.split
    corners = _CornerList(split)
    y = corners.heights.tolist()
    sides = zip(split.node_source.tolist(), split.node_side.tolist(), strict=True)
    node_of = {vertex_and_side: node for node, vertex_and_side in enumerate(sides)}
    triangles: list[tuple[int, ...]] = []
    along = split.vertex_position[:, 1]
    ends_at = along.min(), along.max()
    faces, _ = boundary_faces(split.source_tetrahedra)
    for face in faces.tolist():
        flat = any(np.allclose(along[face], end, rtol=0.0, atol=1e-9) for end in ends_at)
        kind = END if flat else SKIN
        for side, sign in ((0, -1.0), (1, 1.0)):
            if max(sign * y[v] for v in face) <= 0.0:
                continue
            polygon = []
            for a, b in zip(face, [*face[1:], face[0]], strict=True):
                if sign * y[a] >= 0.0:
                    polygon.append(corners.number(node_of[a, side], node_of[a, side], kind))
                if y[a] * y[b] < 0.0:
                    polygon.append(corners.number(node_of[a, side], node_of[b, side], kind))
            triangles += [(polygon[0], *pair) for pair in itertools.pairwise(polygon[1:])]

    minus, plus = split.point_nodes.transpose(1, 0, 2).tolist()
    for triangle in split.triangles.tolist():
        for side, ends in enumerate((minus, plus)):
            p, q, r = (corners.number(ends[i][0], ends[i][1], i) for i in triangle)
            # Section triangles face +y, which is outward on the minus side.
            triangles.append((p, q, r) if side == 0 else (p, r, q))
    return FoodSurface(**corners.fields(), triangles=np.array(triangles))


def food_body(cut: CutGeometry) -> FoodBody:
    """The solid of both halves, at rest as large as the food.

    A tetrahedron that the plane crosses belongs to both sides, with all of its nodes; of its copy
    on each side only the part with material on that side is drawn.
    """
    split = cut.split
    corners = _CornerList(split)
    y = corners.heights[split.node_source]
    point_of = {
        (min(ends), max(ends)): k
        for k, sides in enumerate(split.point_nodes.tolist())
        for ends in sides
    }
    tetrahedra: list[tuple[int, ...]] = []

    def corner(a: int, b: int) -> int:
        ends = min(a, b), max(a, b)
        return corners.number(*ends, point_of.get(ends, -1))

    for nodes in split.tetrahedra.tolist():
        sign = 1.0 if split.node_side[nodes[0]] else -1.0
        inside = [n for n in nodes if sign * y[n] > 0.0]
        beyond = [n for n in nodes if sign * y[n] < 0.0]
        level = [n for n in nodes if y[n] == 0.0]
        if not beyond:
            tetrahedra.append(tuple(corner(n, n) for n in nodes))
            continue
        # From each node inside, its edges to the others, which end at the plane.
        ways = [
            [corner(n, n), *(corner(n, b) for b in beyond), *(corner(c, c) for c in level)]
            for n in inside
        ]
        if len(inside) == 1:
            tetrahedra.append(tuple(ways[0]))
        elif len(inside) == 2:
            tetrahedra += _wedge(*ways)
        else:
            tops = [way[0] for way in ways]
            tetrahedra += _wedge(tops, [way[1] for way in ways])
    cells = np.array([t for t in tetrahedra if len(set(t)) == 4])
    body = FoodBody(**corners.fields(), tetrahedra=cells)
    x = body.positions(cut, cut.nodes)[cells]
    volume = np.linalg.det(x[:, 1:] - x[:, :1])
    cells[volume < 0.0] = cells[volume < 0.0][:, [0, 2, 1, 3]]
    return body


def _wedge(bottom: list[int], top: list[int]) -> list[tuple[int, ...]]:
    """The prism between two triangles as three tetrahedra; flat ones where corners coincide."""
    (a, b, c), (d, e, f) = bottom, top
    return [(a, b, c, f), (a, b, f, e), (a, e, f, d)]
