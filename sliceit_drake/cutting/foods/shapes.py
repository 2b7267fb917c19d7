"""Shapes of foods, and the meshes that they are computed on."""

import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.mesh.generators import (
    box_mesh,
    cylinder_mesh,
    ellipsoid_mesh,
    halved_mesh,
)
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh
from sliceit_drake.resources import file_or_resource

__all__ = [
    "Box",
    "Cylinder",
    "Ellipsoid",
    "HalfCylinder",
    "MeshFile",
    "PlainShape",
    "Remainder",
    "Tapered",
]

MIN_END_RADIUS = 0.3
"""Least radius of a flat end over the greatest, of sliced ellipsoids and tapered foods: towards a
tip the elements of a layer shrink to nothing."""

MIN_LAYER = 0.2
"""Least thickness of a slice's element layer over the edge length in the section: stiffness across
the layer, and with it the scaled mass, grow with the inverse square."""


class _Body:
    """A shape that is meshed in layers along y, graded towards y = 0."""

    layers: list[float]

    @property
    def reach(self) -> float:
        """Greatest y of a section that can be meshed, metres."""
        raise NotImplementedError

    @property
    def section_edge(self) -> float:
        """Edge length of the elements in the greatest section, metres."""
        raise NotImplementedError

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        """The part between the first and the last of the mesh layers `y` [L], metres."""
        raise NotImplementedError

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F, with `refinement` times as many elements along each edge, rounded."""
        near = _refined([d for d in self.layers if d < self.reach - 1e-6], refinement)
        one_side = np.concatenate([near, [self.reach]])
        return self.between(np.unique(np.concatenate([-one_side, one_side])), refinement)


class PlainShape(_Body):
    """A shape that its extents describe."""

    @property
    def extent(self) -> list[float]:
        """Extents along x, y and z of F [3], metres."""
        raise NotImplementedError

    def resized(self, extent: Sequence[float]) -> Self:
        """The same shape with other extents along x, y and z of F [3], metres."""
        raise NotImplementedError

    @property
    def reach(self) -> float:
        return 0.5 * self.extent[1]

    @property
    def section(self) -> tuple[float, float]:
        """Width and height of the section through the middle, metres."""
        return self.extent[0], self.extent[2]

    def scaled(self, scale: float) -> Self:
        """The same shape with another size of section."""
        x, y, z = self.extent
        return self.resized([scale * x, y, scale * z])


@dc.dataclass
class Cylinder(PlainShape):
    """A cylinder along Fy that lies on the board, meshed in rings and graded layers."""

    diameter: float = quantity(0.027, "m", low=5e-3, high=0.3)
    """Diameter."""
    length: float = quantity(0.12, "m", low=1e-2, high=1.0)
    """Length."""
    rings: int = quantity(4, "", low=2, high=40)
    """Rings of elements across the radius."""
    layers: list[float] = quantity([0.0, 6e-3, 9.5e-3, 12e-3], "m", low=0.0, high=0.5)
    """Distances of the element layers from y = 0, on both sides; the rest is one layer, and layers
    beyond the food's end are left out."""

    @property
    def extent(self) -> list[float]:
        return [self.diameter, self.length, self.diameter]

    def resized(self, extent: Sequence[float]) -> "Cylinder":
        return dc.replace(self, length=extent[1], diameter=extent[2])

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        return cylinder_mesh(self.diameter, y, max(2, round(self.rings * refinement)))

    @property
    def section_edge(self) -> float:
        return 0.5 * self.diameter / self.rings


@dc.dataclass
class HalfCylinder(PlainShape):
    """Half a cylinder along Fy, on its flat side, meshed in rings and graded layers."""

    radius: float = quantity(0.025, "m", low=2.5e-3, high=0.15)
    """Radius, which is its height."""
    length: float = quantity(0.1, "m", low=1e-2, high=1.0)
    """Length."""
    rings: int = quantity(6, "", low=2, high=40)
    """Rings of elements across the radius."""
    layers: list[float] = quantity([0.0, 6e-3, 9.5e-3, 12e-3], "m", low=0.0, high=0.5)
    """Distances of the element layers from y = 0, on both sides; the rest is one layer, and layers
    beyond the food's end are left out."""

    @property
    def extent(self) -> list[float]:
        return [2.0 * self.radius, self.length, self.radius]

    def resized(self, extent: Sequence[float]) -> "HalfCylinder":
        return dc.replace(self, length=extent[1], radius=extent[2])

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        rings = max(2, round(self.rings * refinement))
        return cylinder_mesh(2.0 * self.radius, y, rings, half=True)

    @property
    def section_edge(self) -> float:
        return self.radius / self.rings


@dc.dataclass
class Box(PlainShape):
    """A box or plate with axes of F, centred in x, meshed on a grid."""

    size: list[float] = quantity([0.027, 0.12, 0.027], "m", low=2e-3, high=1.0, size=3)
    """Extent along x, y, z."""
    divisions: list[int] = quantity([8, 8], "", low=1, high=1000, size=2)
    """Elements along x and along z."""
    layers: list[float] = quantity([0.0, 6e-3, 9.5e-3, 12e-3], "m", low=0.0, high=0.5)
    """Distances of the element layers from y = 0, on both sides; the rest is one layer, and layers
    beyond the food's end are left out."""

    @property
    def extent(self) -> list[float]:
        return list(self.size)

    def resized(self, extent: Sequence[float]) -> "Box":
        return dc.replace(self, size=list(extent))

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        half, height = 0.5 * self.size[0], self.size[2]
        nx, nz = (max(1, round(n * refinement)) for n in self.divisions)
        return box_mesh(np.linspace(-half, half, nx + 1), y, np.linspace(0.0, height, nz + 1))

    @property
    def section_edge(self) -> float:
        return max(self.size[0] / self.divisions[0], self.size[2] / self.divisions[1])


@dc.dataclass
class Ellipsoid(PlainShape):
    """An ellipsoid with axes of F, standing on the board."""

    diameters: list[float] = quantity([0.05, 0.05, 0.048], "m", low=5e-3, high=0.5, size=3)
    """Extent along x, y, z."""
    refinements: int = quantity(3, "", low=0, high=5)
    """Halvings of the 20 tetrahedra of an icosahedron."""

    @property
    def extent(self) -> list[float]:
        return list(self.diameters)

    def resized(self, extent: Sequence[float]) -> "Ellipsoid":
        return dc.replace(self, diameters=list(extent))

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F; `refinement` is rounded to a power of two."""
        steps = self.refinements + round(np.log2(refinement))
        x, y, z = self.diameters
        return ellipsoid_mesh((x, y, z), max(0, steps))

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        # Sections of 2^refinements rings of elements, each scaled to the ellipsoid's.
        half_x, half_y, half_z = 0.5 * np.array(self.diameters)
        unit = cylinder_mesh(2.0, y, max(2, round(2**self.refinements * refinement)))
        p = unit.vertices - [0.0, 0.0, 1.0]
        p[:, [0, 2]] *= np.sqrt(1.0 - (p[:, 1:2] / half_y) ** 2) * [half_x, half_z]
        return TetrahedralMesh(p + [0.0, 0.0, half_z], unit.tetrahedra)

    @property
    def reach(self) -> float:
        return 0.5 * self.diameters[1] * float(np.sqrt(1.0 - MIN_END_RADIUS**2))

    @property
    def section_edge(self) -> float:
        return 0.5 * max(self.diameters[0], self.diameters[2]) / max(2, 2**self.refinements)


@dc.dataclass
class Tapered(_Body):
    """A straight tapered root along Fy, as a carrot: a cone's frustum, in rings and graded layers.

    It lies on the board along one line of its side. Each section y is a circle above that line, so
    that its axis rises with the radius. Those of a right cone on its side are ellipses, higher than
    wide by 1 / sqrt(1 - t^2), where t is the slope of its side to its axis: 0.2 % for the default.
    """

    diameters: list[float] = quantity([0.015, 0.030], "m", low=5e-3, high=0.3, size=2)
    """At least and at greatest y."""
    length: float = quantity(0.12, "m", low=1e-2, high=1.0)
    """Length."""
    rings: int = quantity(4, "", low=2, high=40)
    """Rings of elements across the radius."""
    layers: list[float] = quantity([0.0, 6e-3, 9.5e-3, 12e-3], "m", low=0.0, high=0.5)
    """Distances of the element layers from y = 0, on both sides; the rest is one layer, and layers
    beyond the food's end are left out."""

    def check(self, where: str) -> None:
        thin = int(np.argmin(self.diameters))
        least = MIN_END_RADIUS * max(self.diameters)
        if self.diameters[thin] < least:
            raise ConfigurationError(
                f"{self.diameters[thin]:g} m is too thin an end beside {max(self.diameters):g} m",
                field=f"{where}.diameters[{thin}]",
                fix=f"Give at least {least:.4g} m; the elements of a thinner tip are too small.",
            )

    def between(self, y: np.ndarray, refinement: float) -> TetrahedralMesh:
        unit = cylinder_mesh(2.0, y, max(2, round(self.rings * refinement)))
        p, ends = unit.vertices, y[[0, -1]]
        radius = np.interp(p[:, 1], ends, [0.5 * self.diameter_at(float(end)) for end in ends])
        p[:, [0, 2]] *= radius[:, None]
        return unit

    def diameter_at(self, y: float) -> float:
        """Diameter of the section at `y`, metres."""
        return float(np.interp(y, [-self.reach, self.reach], self.diameters))

    @property
    def reach(self) -> float:
        return 0.5 * self.length

    @property
    def section_edge(self) -> float:
        return 0.5 * max(self.diameters) / self.rings


@dc.dataclass
class MeshFile:
    """A tetrahedral mesh in a file that meshio reads, with axes and origin of F, in metres."""

    path: str = ""
    """Relative to the scenario that names it, to the working directory, or to the resources."""
    scale: float = quantity(1.0, "", low=1e-6, high=1e6)
    """Factor to metres."""

    def check(self, where: str) -> None:
        if not self.path:
            raise ConfigurationError(
                "names no file", field=f"{where}.path", fix="Give a .msh, .vtk or .vtu file."
            )

    def look_beside(self, folder: Path) -> None:
        """Turns a relative path into that of a file below `folder`, if there is one."""
        if self.path and (folder / self.path).is_file():
            self.path = str((folder / self.path).resolve())

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F, without vertices that no tetrahedron uses.

        Args:
            refinement: Rounded to a power of two, by which each edge is divided; the body stays.

        Raises:
            MeshError: The file is absent, unreadable or holds no tetrahedra, or was to be coarser.
        """
        import meshio

        steps = round(np.log2(refinement))
        if steps < 0:
            raise MeshError(
                f"food.shape.path: {self.path} cannot be made coarser by {refinement:g}; a mesh "
                "from a file can only be refined. Export a coarser one."
            )
        file = file_or_resource(self.path)
        if file is None:
            raise MeshError(
                f"food.shape.path: {self.path} cannot be read as a mesh: there is no such file, "
                f"neither beside the scenario, nor in {Path.cwd()}, nor among the resources. "
                "Correct the path."
            )
        # meshio's readers end on a broken file with whatever went wrong first, some with an exit.
        try:
            content = meshio.read(file)
        except (Exception, SystemExit) as error:
            reason = str(error) or type(error).__name__
            raise MeshError(
                f"food.shape.path: {self.path} cannot be read as a mesh ({reason}). Export it as "
                ".msh, .vtk or .vtu."
            ) from error
        cells = np.asarray(content.get_cells_type("tetra"), np.int64)
        if len(cells) == 0:
            held = ", ".join(f"{len(c.data)} {c.type}" for c in content.cells) or "no cells"
            raise MeshError(
                f"food.shape.path: {self.path} holds no linear tetrahedra but {held}; export a "
                "volume mesh of first order."
            )
        points = self.scale * np.asarray(content.points, float)[:, :3]
        # gmsh writes the points that a geometry is drawn with, such as the centres of its arcs.
        used = np.unique(cells)
        if used[0] >= 0 and used[-1] < len(points):
            points, cells = points[used], np.searchsorted(used, cells)
        mesh = TetrahedralMesh(points, cells)
        if steps:
            mesh.check(f"food.shape.path: {self.path}")
        for _ in range(steps):
            mesh = halved_mesh(mesh)
        return mesh


@dc.dataclass
class Remainder:
    """What slices have left of a body, from its free end over the next cut to its far end.

    Its frame F has the axes of the body's and its origin on the board under the next cut, so that
    the cut is the plane y = 0 and the next slice lies on the side y < 0.
    """

    body: Cylinder | HalfCylinder | Box | Ellipsoid | Tapered = dc.field(default_factory=Cylinder)
    position: float = quantity(0.0, "m", low=-0.5, high=0.5)
    """Place of the next cut, y in the frame of the whole body."""
    thickness: float = quantity(5e-3, "m", low=5e-4, high=0.5)
    """Thickness of the next slice, from the free end to the cut."""
    slice_layers: int = quantity(2, "", low=1, high=20)
    """Layers of elements in the slice."""
    layers: list[float] = quantity([2.8e-3, 6.4e-3, 12e-3], "m", low=1e-4, high=0.5)
    """Distances of the element layers behind the cut; takes the place of the body's own."""

    def check(self, where: str) -> None:
        reach = self.body.reach
        if self.position >= reach or self.position - self.thickness < -reach - 1e-9:
            raise ConfigurationError(
                f"the slice from {1e3 * (self.position - self.thickness):.4g} to "
                f"{1e3 * self.position:.4g} mm does not lie in the body, which can be sliced from "
                f"{-1e3 * reach:.4g} to {1e3 * reach:.4g} mm of its middle",
                field=f"{where}.position",
                fix="Move the cut, or make the slice thinner.",
            )
        least = MIN_LAYER * self.body.section_edge * self.slice_layers
        if self.thickness < least:
            raise ConfigurationError(
                f"{1e3 * self.thickness:.4g} mm in {self.slice_layers} layers is too thin for "
                f"elements of {1e3 * self.body.section_edge:.4g} mm in the section, which hold at "
                f"least {1e3 * least:.4g} mm",
                field=f"{where}.thickness",
                fix="Give a thicker slice, fewer slice_layers, or a finer section of the body.",
            )

    def mesh(self, refinement: float = 1.0) -> TetrahedralMesh:
        """The mesh in F, with `refinement` times as many elements along each edge, rounded."""
        far = self.body.reach - self.position
        slab = np.linspace(-self.thickness, 0.0, max(1, round(self.slice_layers * refinement)) + 1)
        near = _refined([0.0, *(d for d in self.layers if d < far - 1e-6)], refinement)
        # The rest is held and only drawn: one layer where it is straight.
        rest = np.linspace(near[-1], far, 7 if isinstance(self.body, Ellipsoid) else 2)
        y = np.unique(np.concatenate([slab, near, rest]))
        mesh = self.body.between(self.position + y, refinement)
        return TetrahedralMesh(mesh.vertices - [0.0, self.position, 0.0], mesh.tetrahedra)


def _refined(distances: list[float], refinement: float) -> np.ndarray:
    """Grading of layers kept, with `refinement` times as many."""
    if len(distances) < 2 or refinement == 1.0:
        return np.asarray(distances, float)
    count = max(2, round((len(distances) - 1) * refinement) + 1)
    index = np.linspace(0.0, len(distances) - 1.0, count)
    return np.interp(index, np.arange(len(distances)), distances)
