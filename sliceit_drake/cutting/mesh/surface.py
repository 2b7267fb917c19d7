"""The food's surface for drawing: outer skin and cut faces, following the computed nodes."""

import dataclasses as dc
import functools

import numpy as np

from sliceit_drake.cutting.mesh.split import SplitMesh
from sliceit_drake.cutting.mesh.tetrahedra import boundary_faces
from sliceit_drake.cutting.model import CuttingModel

__all__ = ["FoodCorners", "FoodSurface", "food_surface", "heights_over_cut"]


@dc.dataclass
class FoodCorners:
    """Points of the food that follow the computed nodes: weighted pairs of nodes.

    Attributes:
        ends: Nodes of the split mesh at each corner [V, 2].
        weights: Their weights [V, 2].
        side: Side of the cut: 0 minus, 1 plus [V].
        cut_point: Cut point that each corner is, -1 elsewhere [V].
    """

    ends: np.ndarray
    weights: np.ndarray
    side: np.ndarray
    cut_point: np.ndarray

    @functools.cached_property
    def is_cut_face(self) -> np.ndarray:
        """Whether each corner belongs to the cut rather than the skin [V]."""
        return self.cut_point >= 0

    def positions(self, model: CuttingModel, computed: np.ndarray) -> np.ndarray:
        """Corners in the food frame [V, 3], metres.

        Args:
            model: The cut.
            computed: Positions of the computed nodes in C [N, 3].
        """
        nodes = model.split.nodes.copy()
        nodes[model.computed] = computed
        corners = (nodes[self.ends] * self.weights[..., None]).sum(1)
        return corners @ model.X_FC_rotation.T + model.X_FC_position

    def damage(
        self, model: CuttingModel, edge_depth: np.ndarray, cohesive_damage: np.ndarray
    ) -> np.ndarray:
        """Fraction of the toughness that is spent at each corner [V]: 0 intact and skin, 1 cut.

        The edge has spent the cut fraction D of a point and opening the share phi of the rest:
        1 - (1 - D) (1 - phi).

        Args:
            model: The cut.
            edge_depth: Largest depth of the edge below each cut point [P], metres.
            cohesive_damage: phi of each cut point [P].
        """
        tables = model.tables
        grid = np.clip(
            (edge_depth + tables.reach) / tables.spacing, 0.0, tables.fraction.shape[1] - 1
        )
        low = np.minimum(grid.astype(int), tables.fraction.shape[1] - 2)
        rows, part = np.arange(len(grid)), grid - low
        cut = (1.0 - part) * tables.fraction[rows, low] + part * tables.fraction[rows, low + 1]
        spent = 1.0 - (1.0 - cut) * (1.0 - cohesive_damage)
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


def heights_over_cut(split: SplitMesh) -> np.ndarray:
    """Height of each original vertex over the cut plane [V], metres; 0 if it counts as on it."""
    y = split.vertex_position[:, 1].copy()
    single = split.point_weights[:, 1] == 0.0
    y[split.node_source[split.point_nodes[single, 0, 0]]] = 0.0
    return np.asarray(y)


def food_surface(model: CuttingModel) -> FoodSurface:
    """The drawable surface of both halves.

    Outer faces that the plane crosses are clipped, so that each side keeps its own part.
    """
    split = model.split
    node_of: dict[tuple[int, int], int] = {
        (int(v), int(s)): i
        for i, (v, s) in enumerate(zip(split.node_source, split.node_side, strict=True))
    }
    y = heights_over_cut(split)
    ends = split.point_nodes
    single = split.point_weights[:, 1] == 0.0

    corner_ends: list[tuple[int, int]] = []
    corner_weights: list[tuple[float, float]] = []
    sides: list[int] = []
    cut_point: list[int] = []
    triangles: list[tuple[int, int, int]] = []
    known: dict[tuple, int] = {}

    def corner(a: int, b: int, side: int, point: int = -1) -> int:
        key = (min(a, b), max(a, b), side, point)
        if key not in known:
            w = 1.0 if a == b else y[b] / (y[b] - y[a])
            known[key] = len(corner_ends)
            corner_ends.append((node_of[a, side], node_of[b, side]))
            corner_weights.append((w, 1.0 - w))
            sides.append(side)
            cut_point.append(point)
        return known[key]

    faces, _ = boundary_faces(split.source_tetrahedra)
    for face in faces.tolist():
        for side, sign in ((0, -1.0), (1, 1.0)):
            height = [sign * y[v] for v in face]
            if max(height) <= 0.0:
                continue
            polygon = []
            for k in range(3):
                a, b = face[k], face[(k + 1) % 3]
                ha, hb = height[k], height[(k + 1) % 3]
                if ha >= 0.0:
                    polygon.append(corner(a, a, side))
                if ha * hb < 0.0:
                    polygon.append(corner(a, b, side))
            triangles += [
                (polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)
            ]

    source = split.node_source[ends[:, 0, :]]
    for triangle in split.triangles.tolist():
        for side in (0, 1):
            p, q, r = (
                corner(int(source[i, 0]), int(source[i, 1 if not single[i] else 0]), side, i)
                for i in triangle
            )
            # Section triangles face +y, which is outward on the minus side.
            triangles.append((p, q, r) if side == 0 else (p, r, q))
    return FoodSurface(
        ends=np.array(corner_ends),
        weights=np.array(corner_weights),
        side=np.array(sides),
        cut_point=np.array(cut_point),
        triangles=np.array(triangles),
    )
