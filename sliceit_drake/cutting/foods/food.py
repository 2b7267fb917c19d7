"""A food as a user describes it, and the cut through it."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import (
    Box,
    Cylinder,
    Ellipsoid,
    HalfCylinder,
    MeshFile,
    PlainShape,
    Remainder,
    Tapered,
)
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import CutGeometry, make_cut_geometry
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import CuttingModel, Numerics, prepare_cut
from sliceit_drake.cutting.motion import Pose

__all__ = ["Food", "make_food_geometry", "make_food_model", "shape_facts", "start_pose"]


@dc.dataclass
class Food:
    """A food and the cut through it, in the food frame F.

    F: Fz up, origin on the board under the middle of the food, Fy along its long axis.
    """

    name: str = "cucumber"
    shape: Cylinder | HalfCylinder | Box | Ellipsoid | Tapered | MeshFile | Remainder = dc.field(
        default_factory=Cylinder
    )
    material: Material = dc.field(default_factory=Material)
    effects: Effects = dc.field(default_factory=Effects)
    cut_point: list[float] = quantity([0.0, 0.0, 0.0], "m", low=-0.5, high=0.5, size=3)
    """A point of the cut plane."""
    cut_normal: list[float] = quantity([0.0, 1.0, 0.0], "", low=-1.0, high=1.0, size=3)
    """Normal of the cut plane."""
    held_sides: str = choice("both", ("both", "minus", "plus", "none"))
    """Sides of the cut that are held; plus is the side that the normal points to."""
    hold_distance: float = quantity(0.0119, "m", low=0.0, high=1.0)
    """Held material is farther than this from the cut: where clamp, fingers or holder begin."""
    hold_distance_minus: float | None = quantity(None, "m", low=0.0, high=1.0)
    """The same on the minus side, where that is held; null: as `hold_distance`."""

    def look_beside(self, file: str | Path) -> None:
        """Lets a mesh be found beside the file that this food was read from."""
        if isinstance(self.shape, MeshFile):
            self.shape.look_beside(Path(file).parent)

    def plane(self) -> CutPlane:
        """The cut plane; the knife comes from above."""
        return CutPlane(
            np.array(self.cut_point, float), np.array(self.cut_normal, float), np.array([0, 0, 1.0])
        )

    def clamps(self) -> dict[str, float]:
        """Distance from the cut at which each side that is held begins to be, metres."""
        plus, minus = self.hold_distance, self.hold_distance_minus
        starts = {"minus": plus if minus is None else minus, "plus": plus}
        return {side: d for side, d in starts.items() if self.held_sides in ("both", side)}

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh of its shape; what has layers of elements gets more, up to where it is held."""
        shape, clamps = self.shape, self.clamps()
        if clamps and not isinstance(shape, Ellipsoid | MeshFile):
            far = abs(self.cut_point[1]) + max(clamps.values()) + 1e-9
            edge = (shape.body if isinstance(shape, Remainder) else shape).section_edge
            if far > max(shape.layers, default=0.0):
                near = [d for d in shape.layers if d < far - 0.5 * edge] or [0.0]
                more = int(np.ceil(0.5 * (far - near[-1]) / edge))
                rest = np.linspace(near[-1], far, more + 1)[1:].tolist()
                shape = dc.replace(shape, layers=near + rest)
        return shape.mesh(refinement)

    def held(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices that are held [V].

        Raises:
            ConfigurationError: The food ends before a clamp begins.
        """
        normal = np.array(self.cut_normal, float)
        distance = (mesh.vertices - self.cut_point) @ (normal / np.linalg.norm(normal))
        held = np.zeros(len(distance), bool)
        for side, start in self.clamps().items():
            away = distance if side == "plus" else -distance
            # A plane that misses the food is another error.
            if away.min() < 0.0 < away.max() <= start:
                own = side == "minus" and self.hold_distance_minus is not None
                raise ConfigurationError(
                    f"{start:.4g} m lies beyond the {side} end of the food, {away.max():.4g} m from"
                    " the cut: nothing is held there",
                    field="food.hold_distance" + ("_minus" if own else ""),
                    fix=f"Give less than {away.max():.4g}, or hold another side (food.held_sides).",
                )
            held |= away > start
        return held


def make_food_model(
    food: Food, knife: Knife, numerics: Numerics, refinement: float = 1.0
) -> CuttingModel:
    """The prepared cut of a food; see `make_food_geometry`.

    Raises:
        MeshError, ConfigurationError: As `make_cut_geometry`.
        TimeStepError: The step is beyond the limit and masses are not scaled.
    """
    geometry = make_food_geometry(food, refinement)
    return prepare_cut(geometry, food.material, knife, numerics, food.effects)


def make_food_geometry(food: Food, refinement: float = 1.0) -> CutGeometry:
    """The geometry of the cut of a food that rests on the board z = 0 of F.

    Args:
        food: The food.
        refinement: Elements along an edge, relative to the food's mesh.

    Raises:
        MeshError, ConfigurationError: As `make_cut_geometry`.
    """
    mesh = food.mesh(refinement)
    where = f"food.shape of {food.name}"
    if isinstance(food.shape, MeshFile):
        where += f" ({food.shape.path})"
    mesh.check(where)
    if isinstance(food.shape, MeshFile):
        mesh.check_solid(where)
    return make_cut_geometry(mesh, food.plane(), food.held(mesh), board_height=0.0)


def shape_facts(food: Food) -> tuple[str, list[float] | None]:
    """The shape of a food and its size, metres, as slice records say them (`FoodFacts`); "unknown"
    and None for a shape that records do not know."""
    shape = food.shape
    if isinstance(shape, PlainShape):
        return type(shape).__name__.lower(), shape.extent
    return "unknown", None


def start_pose(cut: CutGeometry, clearance: float, offset: float = 0.0) -> Pose:
    """Pose X_FK of the knife above the middle of the section, edge down, blade in the cut plane.

    Args:
        cut: The cut.
        clearance: Height of the edge above the section, metres.
        offset: Shift along the edge, metres.
    """
    points = cut.split.points
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max()) + offset
    p_C = np.array([middle, 0.0, cut.top + clearance])
    R = cut.X_FC_rotation
    return Pose(R @ np.diag([1.0, -1.0, -1.0]), cut.X_FC_position + R @ p_C)
