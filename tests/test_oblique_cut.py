"""Oblique cuts: against cuts along faces of the same body, held alike, and against the ellipse."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh
from sliceit_drake.cutting.model import CuttingModel, Numerics, prepare_cut
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

HOLD = 0.012
PLANES = {
    "between layers": ([0.0, 1.0, 0.0], [0.0, 0.3e-3, 0.0]),
    "tilted": ([0.1, 1.0, 0.06], [0.0, 0.0, 0.0]),
    "turned and off the layer": ([0.2, 1.0, 0.0], [0.0, 1e-3, 0.0]),
}


def meshes(
    normal: list[float], point: list[float], refinement: float
) -> tuple[TetrahedralMesh, TetrahedralMesh, np.ndarray]:
    """A cylinder, the same with its middle layer bent onto the plane, and what is held of both."""
    mesh = Cylinder().mesh(refinement)
    v = mesh.vertices
    slope = np.array(normal) / normal[1]
    onto_plane = np.dot(slope, point) - slope[0] * v[:, 0] - slope[2] * v[:, 2]
    share = np.clip(1.0 - np.abs(v[:, 1]) / HOLD, 0.0, 1.0)
    bent = v + np.outer(onto_plane * share, [0.0, 1.0, 0.0])
    held = np.abs(v[:, 1]) > HOLD - 1e-5
    return mesh, TetrahedralMesh(bent, mesh.tetrahedra), held


def press(
    mesh: TetrahedralMesh,
    held: np.ndarray,
    normal: list[float],
    point: list[float],
    distance: float,
    numerics: Numerics | None = None,
) -> tuple[CuttingModel, SliceResult]:
    plane = CutPlane(np.array(point), np.array(normal), np.array([0.0, 0.0, 1.0]))
    geometry = make_cut_geometry(mesh, plane, held)
    model = prepare_cut(geometry, Food().material, Knife(), numerics or Numerics())
    plan = MotionPlan([ConstantSpeed(distance=distance, speed=0.02)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    return model, simulate_slice(CuttingSolver(model, 2e-3), motion)


def norms(result: SliceResult) -> np.ndarray:
    return np.linalg.norm(result.food_wrench[:, 3:], axis=1)


def relative_rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))


@pytest.mark.parametrize("name", PLANES)
def test_a_cut_through_elements_needs_the_force_of_a_cut_along_faces(name):
    normal, point = PLANES[name]
    across, along, held = meshes(normal, point, 1.0)
    through, virtual = press(across, held, normal, point, 0.027)
    between, aligned = press(along, held, normal, point, 0.027)
    assert len(through.point_nodes) > 2 * len(between.point_nodes)
    assert through.section_area == pytest.approx(between.section_area, rel=1e-6)
    # The discretization error of either mesh is about 1 %.
    assert relative_rms(norms(virtual), norms(aligned)) < 0.02


def test_corners_of_material_far_smaller_than_their_elements_do_not_invert():
    normal, point = [0.0, 1.0, 0.15], [0.0, -1e-3, 0.0]
    across, _, held = meshes(normal, point, 1.5)
    model, result = press(across, held, normal, point, 0.006)
    assert model.split.fraction.min() < 1e-4
    assert result.energies.least_volume_ratio > 0.5
    assert result.cut[-1] > 0.1


def test_true_masses_are_stable_at_the_limit_however_the_plane_cuts():
    normal, point = PLANES["tilted"]
    mesh, _, held = meshes(normal, point, 0.5)
    plane = CutPlane(np.array(point), np.array(normal), np.array([0.0, 0.0, 1.0]))
    geometry = make_cut_geometry(mesh, plane, held)
    limit = prepare_cut(geometry, Food().material, Knife(), Numerics()).critical_time_step
    step = 2e-3 / np.ceil(2e-3 / limit)
    model, true = press(
        mesh, held, normal, point, 0.004, Numerics(time_step=step, mass_scaling=False)
    )
    _, scaled = press(mesh, held, normal, point, 0.004)
    # Only slivers are made heavier.
    assert model.mass_ratio < 1.01
    assert true.energy_ratio < 1e-3
    assert relative_rms(norms(scaled), norms(true)) < 0.02


ELLIPSES = {
    "across": [0.0, 1.0, 0.0],
    "turned": [0.5, 1.0, 0.0],
    "tilted": [0.0, 1.0, 0.3],
    "both": [0.4, 1.0, -0.2],
}


def oblique(name: str, held_sides: str = "both") -> tuple[Food, CuttingModel]:
    food = Food(
        shape=Cylinder(diameter=0.02, length=0.07, rings=3, layers=[0.0, 0.004, 0.012]),
        material=Material(toughness=400.0, friction=0.0),
        cut_normal=ELLIPSES[name],
        held_sides=held_sides,
    )
    return food, make_food_model(food, Knife(), Numerics())


def ellipse(name: str) -> float:
    """Area in which a plane meets the cylinder of 20 mm, m^2."""
    normal = np.array(ELLIPSES[name])
    return np.pi * 0.01**2 * float(np.linalg.norm(normal)) / normal[1]


@pytest.mark.parametrize("name", ELLIPSES)
def test_an_oblique_section_of_a_cylinder_is_its_ellipse_and_no_mass_is_lost(name):
    food, model = oblique(name, held_sides="none")
    assert model.section_area == pytest.approx(ellipse(name), rel=1e-9)
    volume = np.pi * 0.01**2 * 0.07
    assert model.true_mass.sum() == pytest.approx(food.material.density * volume, rel=1e-9)
    angle = np.linspace(0.0, np.pi, 181)
    widths = np.ptp(
        model.split.points[:, [0, 2]] @ np.stack([np.cos(angle), np.sin(angle)]), axis=0
    )
    # Long along the slope of the plane, as wide as the cylinder across it; a polygon of 18 sides.
    assert widths.max() / widths.min() == pytest.approx(ellipse(name) / ellipse("across"), rel=0.02)


@pytest.mark.parametrize("name", ELLIPSES)
def test_pressing_through_an_oblique_plane_takes_toughness_times_its_ellipse(name):
    food, model = oblique(name)
    plan = MotionPlan([ConstantSpeed(distance=model.top - model.bottom + 1e-3, speed=0.04)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    result = simulate_slice(CuttingSolver(model, 2e-3), motion)
    assert result.cut[-1] > 0.999
    # The knife's work from forces and path alone, less what is stored or goes elsewhere.
    moved = np.diff(np.vstack([motion.pose(0.0).p, result.position]), axis=0)
    work = -float((result.food_wrench[:, 3:] * moved).sum())
    balance, energies = result.balance, result.energies
    stored = energies.elastic + energies.interface + energies.kinetic
    elsewhere = balance.opening + balance.friction + balance.board_friction + balance.blade
    net = work + balance.gravity - stored - elsewhere - balance.damping(energies)
    assert net == pytest.approx(food.material.toughness * ellipse(name), rel=0.01)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"cut_point": [0.0, 0.06, 0.0]}, MeshError, r"misses the food.*Move the plane's point"),
        ({"hold_distance": 0.0}, ConfigurationError, r"food\.hold.*farther from the cut plane"),
        ({"cut_normal": [0.0, 0.0, 1.0]}, MeshError, r"parallel to the normal.*cannot cut along"),
    ],
)
def test_an_oblique_plane_that_cannot_be_cut_is_refused(change, error, words):
    food, _ = oblique("turned")
    with pytest.raises(error, match=words):
        make_food_model(dc.replace(food, **change), Knife(), Numerics())
