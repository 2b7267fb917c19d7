"""The finite-element world: the base model on a finer mesh, with effects coded beside it.

Of `cutting` it takes the base model alone, with all parameter groups of `cutting.foods.effects` at
null. What an effect changes, it changes from outside: places of the mesh's vertices, factors on
toughness and stiffness of the tissue, in each stretch of the path the knife's pose and factors on
toughness and friction, and at the end the forces by mechanism.

The base model has no time scale of its own, so where the knife is slow several coupling steps are
computed as one, with at most `travel` of motion; a hold takes a few steps and the air none.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.configuration import quantity
from sliceit_drake.cutting.board import board_wrench, board_wrenches
from sliceit_drake.cutting.foods.food import Food, start_pose
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.cut_surface import depth_below, distance_inside
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import CuttingModel, Numerics, PointScales, prepare_cut
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.simulate import check_clear, check_energies, check_in_plane
from sliceit_drake.cutting.solver import CuttingSolver, SurfaceFactors
from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth, Tissue
from sliceit_drake.stand_in.protocol import Protocol, Specimen, scaled_food, section_size
from sliceit_drake.stand_in.world import Path, Run
from sliceit_drake.tables import interpolated

__all__ = ["FiniteElementSettings", "FiniteElementWorld"]

CLEAR = 1e-3
"""Height of the edge over the food above which nothing is computed, metres."""
LONGEST = 50
"""Most coupling steps that are computed as one."""
CHECK_TRAVEL = 1e-3

SAMPLES = 5
"""Triangles are cut into the square of this many to average over a cut point's part of them."""


@dc.dataclass
class FiniteElementSettings:
    """Mesh and step of the world, other than what looks at its records."""

    refinement: float = quantity(0.85, "", low=0.3, high=3.0)
    """Elements along an edge, relative to the food's mesh."""
    time_step: float = quantity(2.5e-4, "s", low=1e-6, high=2e-3)
    """Sub-step."""
    travel: float = quantity(4e-5, "m", low=1e-6, high=1e-3)
    """Most motion in coupling steps computed as one."""


class _Section:
    """A cut's section as effects see it, from its geometry."""

    def __init__(self, model: CuttingModel) -> None:
        self.model = model
        points, triangles = model.split.points[:, [0, 2]], model.split.triangles
        corner = np.stack([1.0 - _BARYCENTRIC.sum(1), *_BARYCENTRIC.T], axis=1)
        places = np.einsum("mkc,sk->msc", points[triangles], corner)
        edges = points[triangles][:, 1:] - points[triangles][:, :1]
        area = 0.5 * np.abs(np.linalg.det(edges)) / len(corner)
        weight = (area[:, None, None] * corner).reshape(-1, 3)
        self._node = np.repeat(triangles, len(corner), axis=0)
        self._weight = weight
        self._total = np.maximum(self._sums(np.ones(len(weight))), 1e-18)
        self.surface = self._tissue(places.reshape(-1, 2))
        self.bulk = self._tissue(model.nodes[model.tetrahedra].mean(1)[:, [0, 2]])
        # Width of the section and area of the part above, by the edge's height.
        self._height = np.linspace(model.bottom - 1e-4, model.top + 1e-4, 241)
        tables, s = model.tables, points[:, 1, None] - self._height
        grid = np.linspace(-tables.reach, tables.reach, tables.width.shape[1])
        above = [np.interp(at, grid, row) for at, row in zip(s, tables.fraction, strict=True)]
        part = tables.area[:, None] * np.array(above)
        self._above = part.sum(0)
        self._middle = (points.T @ part / np.maximum(self._above, 1e-9)).T
        carried = [
            np.interp(at, grid, row, left=0.0, right=0.0)
            for at, row in zip(s, tables.width, strict=True)
        ]
        self._width = np.sum(carried, axis=0)

    def _tissue(self, places: np.ndarray) -> Tissue:
        m = self.model
        points, triangles = m.split.points[:, [0, 2]], m.split.triangles
        low, high = m.span
        return Tissue(
            x=places[:, 0] - 0.5 * (low + high),
            height=places[:, 1] - m.bottom,
            depth=depth_below(points, triangles, places),
            distance=distance_inside(points, triangles, places),
        )

    def _sums(self, values: np.ndarray) -> np.ndarray:
        sums = np.zeros(len(self.model.point_nodes))
        np.add.at(sums, self._node, self._weight * values[:, None])
        return sums

    def average(self, factor: np.ndarray | float) -> np.ndarray:
        """Mean of a factor on the surface over each cut point's part of it [P]."""
        values = np.broadcast_to(np.asarray(factor, float), self.surface.x.shape)
        return self._sums(values) / self._total

    def width(self, height: float) -> float:
        """Width of the section at a height in C, metres."""
        return float(np.interp(height, self._height, self._width, left=0.0, right=0.0))

    def above(self, height: np.ndarray) -> np.ndarray:
        """Area of the section above heights in C, m^2."""
        area = np.interp(height, self._height, self._above)
        return np.where(height < self.model.top, area, 0.0)

    def middle_above(self, height: np.ndarray) -> np.ndarray:
        """Middle of the section's part above heights in C [N], in F [N, 3], metres."""
        x, z = (np.interp(height, self._height, self._middle[:, k]) for k in range(2))
        p_C = np.stack([x, np.zeros_like(x), z], axis=1)
        return np.asarray(p_C @ self.model.X_FC_rotation.T + self.model.X_FC_position)


def _barycentric(n: int) -> np.ndarray:
    """Centroids of the n^2 triangles that a triangle is cut into, second and third coordinate."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    return np.array(up + down) / n


_BARYCENTRIC = _barycentric(SAMPLES)


class FiniteElementWorld:
    """Cuts slices with `cutting`'s base model.

    Args:
        protocol: Food, knife, board.
        settings: How finely.
    """

    def __init__(self, protocol: Protocol, settings: FiniteElementSettings | None = None) -> None:
        self.protocol = protocol
        self.settings = settings or FiniteElementSettings()
        self._numerics = Numerics(time_step=self.settings.time_step)
        self._cuts: dict[bytes, _Section] = {}

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        """Cuts one slice; see `World`.

        Raises:
            CuttingError: The motion is not one that can be computed, or the cut broke down.
        """
        protocol, condition = self.protocol, specimen.condition
        food = scaled_food(protocol.food, condition.width_scale)
        mesh = food.mesh(self.settings.refinement)
        nominal = self._section(food, mesh)
        low, high = nominal.model.span
        facts = SliceTruth(
            index=specimen.index,
            peeled=condition.peeled,
            height=nominal.model.top - nominal.model.bottom,
            width=high - low,
            toughness=food.material.toughness,
        )
        for effect in effects:
            effect.begin(facts, rng)
        start = start_pose(nominal.model, condition.clearance, condition.offset)
        if isinstance(food.shape, Box | Cylinder):
            # The clearance is over the food, not over a mesh that conserves its volume.
            start.p[2] = section_size(food)[1] + condition.clearance
        path = Path.of(protocol, condition, start)
        model, section = None, nominal
        if not condition.without_food:
            moved = mesh.vertices
            for effect in effects:
                moved = effect.reshape(moved)
            section = self._section(food, TetrahedralMesh(moved, mesh.tetrahedra))
            model = _with_tissue(section, specimen, effects)
            check_clear(model, Pose(*_in_cut(model, path.R[0], path.p[0])))
        return _FiniteElementRun(path, specimen, facts, effects, self, section, model).cut()

    def _section(self, food: Food, mesh: TetrahedralMesh) -> _Section:
        key = mesh.vertices.tobytes()
        if key not in self._cuts:
            geometry = make_cut_geometry(mesh, food.plane(), food.held(mesh))
            model = prepare_cut(geometry, food.material, self.protocol.knife, self._numerics)
            self._cuts[key] = _Section(model)
        return self._cuts[key]


def _in_cut(model: CuttingModel, R_F: np.ndarray, p_F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return model.X_FC_rotation.T @ R_F, model.to_cut_frame(p_F)


def _with_tissue(section: _Section, specimen: Specimen, effects: Sequence[Effect]) -> CuttingModel:
    """The cut with the slice's material and what effects do to its tissue."""
    base = section.model
    toughness = np.ones(len(base.point_nodes))
    stiffness = np.ones(base.element_count)
    for effect in effects:
        toughness = toughness * section.average(effect.toughness(section.surface))
        stiffness = stiffness * effect.stiffness(section.bulk)
    # Masses are scaled for the material's modulus, which must be the largest.
    most = float(stiffness.max())
    material = dc.replace(
        base.material,
        youngs_modulus=base.material.youngs_modulus * specimen.stiffness * most,
        toughness=base.material.toughness * specimen.toughness,
        friction=base.material.friction * specimen.friction,
    )
    scales = PointScales(toughness, np.ones_like(toughness), np.ones_like(toughness))
    model = base.derive(material=material, point_scales=scales)
    model.element_volume = model.element_volume * stiffness / most
    return model


@dc.dataclass
class _FiniteElementRun(Run):
    """One slice of finite elements; without `model` there is none on the board."""

    world: FiniteElementWorld
    section: _Section
    model: CuttingModel | None

    def __post_init__(self) -> None:
        path, model, protocol = self.path, self.model, self.world.protocol
        self.knife, self.board = protocol.knife, dc.replace(protocol.board, height=0.0)
        self.solver = None if model is None else CuttingSolver(model, path.period)
        self.state = np.zeros(0) if self.solver is None else self.solver.initial_state()
        self.fed = Pose(*_in_cut(self.section.model, path.R[0], path.p[0]))
        self.spent = self.since_check = 0.0
        self.cut_fraction = self.travel = self.swept = 0.0

    def reached(self) -> tuple[float, float, float]:
        return self.section.model.top - float(self.fed.p[2]), self.travel, self.swept

    def advance(self, now: Now, row: int) -> tuple[np.ndarray, float]:
        path, geometry = self.path, self.section.model
        shift = now.knife_shift - now.food_shift
        pose = Pose(*_in_cut(geometry, path.R[row], path.p[row] + shift))
        reach = 0.5 * self.knife.length * abs(float(pose.R[2, 0]))
        lowest = min(float(pose.p[2]), float(self.fed.p[2])) - reach
        parts = np.zeros((3, 6))
        if self.solver is not None and lowest < geometry.top + CLEAR:
            assert self.model is not None
            check_in_plane(self.model, pose, now.time + now.period)
            factors = SurfaceFactors(now.toughness, now.friction)
            step = self.solver.coupling_step(self.state, self.fed, pose, factors)
            self.state, self.cut_fraction = step.state, float(step.cut[-1])
            parts = (step.wrenches.reshape(3, 2, 3) @ geometry.X_FC_rotation.T).reshape(3, 6)
            self.spent += step.balance.edge + step.balance.opening + step.balance.friction
            moved = float(np.linalg.norm(pose.p - self.fed.p))
            self.since_check += moved
            if self.since_check > CHECK_TRAVEL:
                self.since_check = 0.0
                energies = self.solver.energies(self.state, pose, factors)
                check_energies(
                    energies, self.spent, self.model, now.time + now.period, self.cut_fraction
                )
            if pose.p[2] < geometry.top:
                self.travel += moved
                self.swept += 2.0 * moved * self.section.width(float(pose.p[2]))
        self.fed = pose
        self.force = parts[:, 3:].sum(0)
        p = path.p[row] + now.knife_shift
        if p[2] < reach:
            v, w = np.array([0.0, 0.0, -now.press]), np.zeros(3)
            self.force += board_wrench(self.board, self.knife, path.R[row], p, v, w)[3:]
        return parts, self.cut_fraction

    def cut(self) -> Series:
        """Cuts the slice."""
        path, model = self.path, self.model
        rates = model is not None and model.material.static_friction > model.material.friction
        longest = 1 if rates else LONGEST
        reach = 0.5 * self.knife.length
        stretches, parts, cut, shifts = self.drive(self.world.settings.travel, longest, reach)
        # Forces are means over stretches; shifts and cuts are those at their ends.
        T, time = path.period, path.time[1:]
        middle, ends = T * stretches.mean(1), T * stretches[:, 1]
        forces = interpolated(time - 0.5 * T, middle, parts)
        knife, food = np.moveaxis(interpolated(time, ends, shifts), 1, 0)
        p_true = path.p[1:] + knife
        geometry = self.section.model
        height = geometry.to_cut_frame(p_true - food)[:, 2]
        flank, arm = np.zeros(len(time)), np.zeros((len(time), 3))
        if model is not None:
            flank = 2.0 * self.section.above(height)
            arm = self.section.middle_above(height) + food - p_true
        p = np.concatenate([path.p[:1] + knife[:1], p_true])
        return self.series(
            p_true,
            depth=geometry.top - height,
            flank=flank,
            flank_arm=arm,
            cut=interpolated(time, ends, cut),
            edge=forces[:, 0],
            normal=forces[:, 1],
            friction=forces[:, 2],
            board=board_wrenches(self.board, self.knife, path.R, p, T),
        )
