"""A food as a user describes it, and the cut through it."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.effects import Effects
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.material import Material
from sliceit_drake.cutting.mesh import (
    MeshError,
    TetrahedralMesh,
    box_mesh,
    cylinder_mesh,
    ellipsoid_mesh,
)
from sliceit_drake.cutting.model import CuttingModel, Numerics, make_cutting_model
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.split import CutPlane

__all__ = ["Box", "Cylinder", "Ellipsoid", "Food", "MeshFile", "make_food_model", "start_pose"]


@dc.dataclass
class Cylinder:
    """A cylinder along Fy that lies on the board, meshed in rings and graded layers."""

    diameter: float = quantity(0.027, "m", low=5e-3, high=0.3, doc="Diameter.")
    length: float = quantity(0.12, "m", low=1e-2, high=1.0, doc="Length.")
    rings: int = quantity(4, "", low=2, high=40, doc="Rings of elements across the radius.")
    layers: list[float] = quantity(
        [0.0, 2.8e-3, 6.4e-3, 12e-3],
        "m",
        low=0.0,
        high=0.5,
        doc="Distances of the element layers from y = 0, on both sides; the rest is one layer.",
    )

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F, with `refinement` times as many elements along each edge, rounded."""
        layers = _both_sides(self.layers, 0.5 * self.length, refinement)
        return cylinder_mesh(self.diameter, layers, max(2, round(self.rings * refinement)))


@dc.dataclass
class Box:
    """A box with axes of F, centred in x, meshed on a grid."""

    size: list[float] = quantity(
        [0.027, 0.12, 0.027], "m", low=2e-3, high=1.0, size=3, doc="Extent along x, y, z."
    )
    divisions: list[int] = dc.field(default_factory=lambda: [8, 8])
    layers: list[float] = quantity(
        [0.0, 2.8e-3, 6.4e-3, 12e-3],
        "m",
        low=0.0,
        high=0.5,
        doc="Distances of the element layers from y = 0, on both sides; the rest is one layer.",
    )

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F, with `refinement` times as many elements along each edge, rounded."""
        half = 0.5 * np.array(self.size)
        layers = _both_sides(self.layers, half[1], refinement)
        nx, nz = (max(1, round(n * refinement)) for n in self.divisions)
        return box_mesh(
            np.linspace(-half[0], half[0], nx + 1), layers, np.linspace(0.0, self.size[2], nz + 1)
        )


@dc.dataclass
class Ellipsoid:
    """An ellipsoid with axes of F, standing on the board."""

    diameters: list[float] = quantity(
        [0.05, 0.05, 0.048], "m", low=5e-3, high=0.5, size=3, doc="Extent along x, y, z."
    )
    refinements: int = quantity(
        3, "", low=0, high=5, doc="Halvings of the 20 tetrahedra of an icosahedron."
    )

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F; `refinement` is rounded to a power of two."""
        steps = self.refinements + round(np.log2(refinement))
        x, y, z = self.diameters
        return ellipsoid_mesh((x, y, z), max(0, steps))


@dc.dataclass
class MeshFile:
    """A tetrahedral mesh in a file that meshio reads, with axes and origin of F, in metres."""

    path: str = ""
    scale: float = quantity(1.0, "", low=1e-6, high=1e6, doc="Factor to metres.")

    def check(self, where: str) -> None:
        if not self.path:
            raise ConfigurationError(
                "names no file", field=f"{where}.path", fix="Give a .msh, .vtk or .vtu file."
            )

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F. A file cannot be refined.

        Raises:
            MeshError: The file is absent, unreadable or holds no tetrahedra.
        """
        import meshio

        if refinement != 1.0:
            raise MeshError(f"{self.path}: a mesh from a file cannot be refined.")
        try:
            content = meshio.read(self.path)
        except (OSError, meshio.ReadError, SystemExit) as error:
            raise MeshError(f"{self.path}: cannot be read as a mesh ({error}).") from error
        cells = content.get_cells_type("tetra")
        if len(cells) == 0:
            raise MeshError(f"{self.path}: holds no linear tetrahedra; export a volume mesh.")
        return TetrahedralMesh(self.scale * np.asarray(content.points, float)[:, :3], cells)


def _both_sides(distances: list[float], half: float, refinement: float) -> np.ndarray:
    """Layer coordinates from -half to half, mirrored in 0, with the given grading near it."""
    near = _refined([d for d in distances if d < half - 1e-6], refinement)
    one_side = np.concatenate([near, [half]])
    return np.unique(np.concatenate([-one_side, one_side]))


def _refined(distances: list[float], refinement: float) -> np.ndarray:
    """Grading of layers kept, with `refinement` times as many."""
    if len(distances) < 2 or refinement == 1.0:
        return np.asarray(distances, float)
    count = max(2, round((len(distances) - 1) * refinement) + 1)
    index = np.linspace(0.0, len(distances) - 1.0, count)
    return np.interp(index, np.arange(len(distances)), distances)


@dc.dataclass
class Food:
    """A food and the cut through it, in the food frame F.

    F: Fz up, origin on the board under the middle of the food, Fy along its long axis.
    """

    name: str = "cucumber"
    shape: Cylinder | Box | Ellipsoid | MeshFile = dc.field(default_factory=Cylinder)
    material: Material = dc.field(default_factory=Material)
    effects: Effects = dc.field(default_factory=Effects)
    cut_point: list[float] = quantity(
        [0.0, 0.0, 0.0], "m", low=-0.5, high=0.5, size=3, doc="A point of the cut plane."
    )
    cut_normal: list[float] = quantity(
        [0.0, 1.0, 0.0], "", low=-1.0, high=1.0, size=3, doc="Normal of the cut plane."
    )
    held_sides: str = choice(
        "both",
        ("both", "minus", "plus", "none"),
        doc="Sides of the cut that are held; plus is the side that the normal points to.",
    )
    hold_distance: float = quantity(
        0.0119, "m", low=0.0, high=1.0, doc="Held material is farther than this from the cut."
    )

    def plane(self) -> CutPlane:
        """The cut plane; the knife comes from above."""
        return CutPlane(
            np.array(self.cut_point, float), np.array(self.cut_normal, float), np.array([0, 0, 1.0])
        )

    def held(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices that are held [V]."""
        normal = np.array(self.cut_normal, float)
        distance = (mesh.vertices - self.cut_point) @ (normal / np.linalg.norm(normal))
        held = np.zeros(len(distance), bool)
        if self.held_sides in ("both", "minus"):
            held |= distance < -self.hold_distance
        if self.held_sides in ("both", "plus"):
            held |= distance > self.hold_distance
        return held


def make_food_model(
    food: Food, knife: Knife, numerics: Numerics, refinement: float = 1.0
) -> CuttingModel:
    """The prepared cut of a food that rests on the board z = 0 of F.

    Args:
        food: The food.
        knife: The knife.
        numerics: Discretisation.
        refinement: Elements along an edge, relative to the food's mesh.

    Raises:
        MeshError, TimeStepError, ConfigurationError: As `make_cutting_model`.
    """
    mesh = food.shape.mesh(refinement)
    mesh.check(f"food.shape of {food.name}")
    return make_cutting_model(
        mesh,
        food.plane(),
        food.held(mesh),
        food.material,
        knife,
        numerics,
        food.effects,
        board_height=0.0,
    )


def start_pose(model: CuttingModel, clearance: float, offset: float = 0.0) -> Pose:
    """Pose X_FK of the knife above the middle of the section, edge down, blade in the cut plane.

    Args:
        model: The cut.
        clearance: Height of the edge above the section, metres.
        offset: Shift along the edge, metres.
    """
    points = model.split.points
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max()) + offset
    p_C = np.array([middle, 0.0, model.top + clearance])
    R = model.X_FC_rotation
    return Pose(R @ np.diag([1.0, -1.0, -1.0]), model.X_FC_position + R @ p_C)
