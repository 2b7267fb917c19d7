"""How a food looks in every picture: the colours of its skin and of what a cut shows."""

import dataclasses as dc
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from sliceit_drake.cutting.mesh.surface import END, FoodSurface
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.systems.loose_slices import SLICE_ROW, slice_pose

__all__ = [
    "INTACT",
    "LOOKS",
    "OTHER",
    "ColouredMesh",
    "FoodLook",
    "FoodScene",
    "Part",
    "damage_colours",
    "look_of",
]

Colour = tuple[float, float, float]

INTACT = (0.42, 0.09, 0.36)
HALF_CUT = (0.93, 0.47, 0.22)


@dc.dataclass(frozen=True)
class FoodLook:
    """Colours as red, green, blue.

    Attributes:
        skin: Outside.
        ring: Of the flesh below the skin, up to `ring_share` of the way to the middle.
        flesh: Of the rest.
        core: In the middle, from `core_share` of the way on.
        ring_share, core_share: 0 at the skin, 1 in the middle.
    """

    skin: Colour
    ring: Colour
    flesh: Colour
    core: Colour
    ring_share: float = 0.16
    core_share: float = 0.62

    def face(self, share: np.ndarray) -> np.ndarray:
        """Colours of a cut face [V, 3] at shares [V] of the way from the skin to the middle."""
        stops = np.array([0.0, self.ring_share, self.ring_share + 0.06, self.core_share, 1.0])
        colours = np.array([self.ring, self.ring, self.flesh, self.flesh, self.core])
        return np.column_stack([np.interp(share, stops, channel) for channel in colours.T])


LOOKS = {
    "cucumber": FoodLook(
        (0.13, 0.33, 0.11), (0.50, 0.70, 0.30), (0.82, 0.90, 0.66), (0.72, 0.82, 0.50)
    ),
    "tomato": FoodLook(
        (0.80, 0.09, 0.06), (0.86, 0.22, 0.14), (0.93, 0.42, 0.28), (0.95, 0.66, 0.36), 0.12, 0.45
    ),
    "potato": FoodLook(
        (0.58, 0.42, 0.24), (0.93, 0.84, 0.55), (0.96, 0.90, 0.66), (0.94, 0.87, 0.60), 0.05, 0.80
    ),
    "carrot": FoodLook(
        (0.88, 0.42, 0.08), (0.97, 0.56, 0.16), (0.97, 0.56, 0.16), (0.99, 0.75, 0.30), 0.10, 0.45
    ),
    "apple": FoodLook(
        (0.72, 0.10, 0.10), (0.98, 0.95, 0.82), (0.98, 0.95, 0.82), (0.86, 0.82, 0.58), 0.05, 0.75
    ),
}
OTHER = FoodLook(
    (0.66, 0.56, 0.40), (0.92, 0.86, 0.70), (0.95, 0.90, 0.77), (0.92, 0.86, 0.70), 0.05, 0.80
)


def look_of(name: str) -> FoodLook:
    """The look of a food by the name that begins its own: "cucumber" for "cucumber_end"."""
    return next((look for food, look in LOOKS.items() if name.startswith(food)), OTHER)


def damage_colours(damage: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Colours of a cut surface [V, 3]: plum where intact, orange half cut, then the food's own.

    Brightness rises all the way, so that the map is readable in greyscale and colour blindness.

    Args:
        damage: Fraction of the toughness that is spent [V], 0 to 1.
        cut: Colours where it is cut [V, 3].
    """
    low, high = np.array(INTACT), np.array(HALF_CUT)
    first, second = np.clip(2.0 * damage, 0.0, 1.0), np.clip(2.0 * damage - 1.0, 0.0, 1.0)
    colours = low + first[:, None] * (high - low)
    return np.asarray(colours + second[:, None] * (cut - colours))


@dc.dataclass
class ColouredMesh:
    """A surface with a colour at each corner.

    Attributes:
        points: Corners [V, 3], metres.
        triangles: Their corners [M, 3], outward oriented.
        colours: Red, green, blue of each corner [V, 3].
    """

    points: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray

    def seen_from(self, X_AB: RigidTransform) -> "ColouredMesh":
        """The same in A, of points in B."""
        return dc.replace(self, points=X_AB.multiply(self.points.T).T)


@dc.dataclass
class Part:
    """A part of a food as it is drawn.

    Attributes:
        name: "minus" and "plus", the halves beside the cut, or "slice_01" and so on.
        mesh: Its surface in its frame P; that of a slice stays the same.
        X_WP: Its pose.
    """

    name: str
    mesh: ColouredMesh
    X_WP: RigidTransform


class FoodScene:
    """The parts of a food at successive instants: the two halves, and slices as they came off.

    Args:
        surfaces: Of the prepared foods.
        models: Their cuts.
        look: The food's look.
    """

    def __init__(
        self,
        surfaces: Sequence[FoodSurface],
        models: Sequence[CuttingModel],
        look: FoodLook,
    ) -> None:
        self._surfaces, self._models, self._look = tuple(surfaces), tuple(models), look
        self._slices: dict[int, ColouredMesh] = {}

    @functools.cached_property
    def _colours(self) -> list[np.ndarray]:
        pairs = zip(self._surfaces, self._models, strict=True)
        return [_rest_colours(surface, model, self._look) for surface, model in pairs]

    def parts(self, port: Callable[[str], Any]) -> list[Part]:
        """The parts now.

        Args:
            port: Gives the value of an output port of `CuttingSystem`, and of `slices` of
                `LooseSlices`, which is empty where there are none.
        """
        food = int(port("food_index")[0])
        points = port("surface_vertices").reshape(-1, 3)
        halves = dict(
            zip(("minus", "plus"), self._halves(food, points, port("surface_damage")), strict=True)
        )
        parts = []
        rows = port("slices").reshape(-1, SLICE_ROW)
        free = ("minus", "plus")[self._models[food].free_side]
        for k in np.flatnonzero(rows[:, 0]).tolist():
            if k not in self._slices and k == food:
                self._slices[k] = halves[free].seen_from(port("slice_pose").inverse())
            elif k not in self._slices:
                self._slices[k] = self._at_rest(k)
            parts.append(Part(f"slice_{k + 1:02d}", self._slices[k], slice_pose(rows[k])))
        if len(rows) > 0 and rows[food, 0] > 0.0:
            del halves[free]
        return parts + [Part(name, mesh, RigidTransform()) for name, mesh in halves.items()]

    def _halves(
        self, food: int, points: np.ndarray, damage: np.ndarray
    ) -> tuple[ColouredMesh, ColouredMesh]:
        """Both halves, of corners [>= V, 3] in any frame and their damage [>= V]."""
        surface, rest = self._surfaces[food], self._colours[food]
        shown = damage_colours(damage[: len(rest)], rest)
        colours = np.where(surface.is_cut_face[:, None], shown, rest)
        minus, plus = (
            ColouredMesh(points[corners], triangles, colours[corners])
            for corners, triangles in surface.halves
        )
        return minus, plus

    def _at_rest(self, food: int) -> ColouredMesh:
        """A slice that was not seen when it came off, in S."""
        model, surface = self._models[food], self._surfaces[food]
        points = surface.positions(model, model.nodes)
        return self._halves(food, points, np.ones(len(points)))[model.free_side]


def _rest_colours(surface: FoodSurface, model: CuttingModel, look: FoodLook) -> np.ndarray:
    """Colours of the corners of a surface where it is cut [V, 3]."""
    rest = surface.positions(model, model.nodes)
    colours = np.tile(np.array(look.skin), (len(rest), 1))
    for faces in (surface.is_cut_face, surface.cut_point == END):
        # The sides of the cut lie on each other, the ends apart: each has a rim of its own.
        for side in (0, 1):
            corners = faces & (surface.side == side)
            share = _shares(rest, surface.triangles[corners[surface.triangles].all(1)])
            colours[corners] = look.face(share[corners])
    return colours


def _shares(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How far each point [V, 3] lies from the rim of flat triangles [M, 3], 1 for the farthest."""
    edges = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    )
    unique, count = np.unique(edges, axis=0, return_counts=True)
    rim = unique[count == 1]
    if len(rim) == 0:
        return np.zeros(len(points))
    along = np.linspace(0.0, 1.0, 8)[:, None, None]
    samples = (points[rim[:, 0]] * (1.0 - along) + points[rim[:, 1]] * along).reshape(-1, 3)
    distance = cKDTree(samples).query(points)[0]
    used = np.unique(triangles)
    return np.asarray(np.clip(distance / max(distance[used].max(), 1e-12), 0.0, 1.0))
