"""The food as two solid bodies for drawing: each side's tetrahedra, clipped at the cut plane."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.mesh.surface import CornerList, FoodCorners
from sliceit_drake.cutting.model import CuttingModel

__all__ = ["FoodBody", "food_body"]


@dc.dataclass
class FoodBody(FoodCorners):
    """Tetrahedra between corners.

    Attributes:
        tetrahedra: Corners [M, 4], of positive volume at rest; none joins both sides.
    """

    tetrahedra: np.ndarray


def food_body(model: CuttingModel) -> FoodBody:
    """The solid of both halves, at rest as large as the food.

    A tetrahedron that the plane crosses belongs to both sides, with all of its nodes; of its copy
    on each side only the part with material on that side is drawn.
    """
    split = model.split
    corners = CornerList(split)
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
    x = body.positions(model, model.nodes)[cells]
    volume = np.linalg.det(x[:, 1:] - x[:, :1])
    cells[volume < 0.0] = cells[volume < 0.0][:, [0, 2, 1, 3]]
    return body


def _wedge(bottom: list[int], top: list[int]) -> list[tuple[int, ...]]:
    """The prism between two triangles as three tetrahedra; flat ones where corners coincide."""
    (a, b, c), (d, e, f) = bottom, top
    return [(a, b, c, f), (a, b, f, e), (a, e, f, d)]
