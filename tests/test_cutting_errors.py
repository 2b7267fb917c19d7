"""What cannot be cut is refused with what is wrong, where, and what to do."""

import numpy as np
import pytest

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.coupling_steps import Energies
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, MeshFile, Remainder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.generators import box_mesh
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh
from sliceit_drake.cutting.model import Numerics, TimeStepError
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan, Pose, Waypoints
from sliceit_drake.cutting.simulate import (
    check_clear,
    check_energies,
    check_in_plane,
    simulate_slice,
)
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver

SMALL = Box(size=[0.02, 0.06, 0.02], divisions=[3, 3], layers=[0.0, 4e-3, 12e-3])


def cut(numerics: Numerics | None = None, **food) -> CuttingSolver:
    config = Food(shape=SMALL, **food)
    return CuttingSolver(make_food_model(config, Knife(), numerics or Numerics()), 2e-3)


def grid() -> TetrahedralMesh:
    axis = np.linspace(0.0, 0.02, 3)
    return box_mesh(axis, axis, axis)


def test_the_mesh_that_the_refusals_start_from_is_accepted():
    grid().check()


def not_finite(mesh: TetrahedralMesh) -> None:
    mesh.vertices[5, 1] = np.nan


def out_of_range(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra[7, 2] = 27


def negative_index(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra[7, 2] = -1


def inverted(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra[4] = mesh.tetrahedra[4, [1, 0, 2, 3]]


def degenerate(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra[6, 3] = mesh.tetrahedra[6, 0]


def flat(mesh: TetrahedralMesh) -> None:
    mesh.vertices[:, 2] = 0.0


def duplicated(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra = np.concatenate([mesh.tetrahedra, mesh.tetrahedra[:1]])


def overlapping(mesh: TetrahedralMesh) -> None:
    # A new vertex on top of a face that already has an element on either side.
    faces = np.sort(mesh.tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3))
    found, count = np.unique(faces, axis=0, return_counts=True)
    face = found[count == 2][0]
    a, b, c = mesh.vertices[face]
    apex = (a + b + c) / 3.0 + 0.01 * np.cross(b - a, c - a) / np.linalg.norm(
        np.cross(b - a, c - a)
    )
    mesh.tetrahedra = np.concatenate([mesh.tetrahedra, [[*face, len(mesh.vertices)]]])
    mesh.vertices = np.concatenate([mesh.vertices, [apex]])


def unused(mesh: TetrahedralMesh) -> None:
    mesh.vertices = np.concatenate([mesh.vertices, [[0.01, 0.01, 0.01]]])


def millimetres(mesh: TetrahedralMesh) -> None:
    mesh.vertices *= 1000.0


def huge(mesh: TetrahedralMesh) -> None:
    mesh.vertices *= 1e6


def triangles(mesh: TetrahedralMesh) -> None:
    mesh.tetrahedra = mesh.tetrahedra[:, :3]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (not_finite, r"food: vertex 5 .*nan.*not a finite position"),
        (out_of_range, r"food: tetrahedron 7 refers to .*27.*but there are 27 \(counted from 0\)"),
        (negative_index, r"food: tetrahedron 7 refers to .*-1.*but there are 27"),
        (inverted, r"food: 1 inverted tetrahedra, first 4 with vertices.*Swap two"),
        (degenerate, r"food: 1 degenerate tetrahedra, first 6 with vertices.*Remesh or merge"),
        (flat, r"food: 48 degenerate tetrahedra, first 0.*Remesh"),
        (duplicated, r"food: 1 tetrahedra are repeated, such as 48 with vertices.*Remove them"),
        (overlapping, r"food: .* faces are shared by more than two tetrahedra.*overlap"),
        (unused, r"food: 1 vertices belong to no tetrahedron, first 27\. Remove them"),
        (millimetres, r"food: the mesh measures 20 m.*millimetres\? Scale it by 0\.001"),
        (huge, r"food: the mesh measures 2e\+04 m; foods are 0\.001 to 1 m"),
        (triangles, r"food: needs vertices \[N, 3\] and at least one tetrahedron.*\(48, 3\)"),
    ],
)
def test_a_mesh_that_cannot_be_used_is_refused_by_element(spoil, message):
    mesh = grid()
    spoil(mesh)
    with pytest.raises(MeshError, match=message):
        mesh.check("food")


def test_a_repeated_tetrahedron_is_refused_even_where_its_faces_are_free():
    mesh = TetrahedralMesh(0.02 * np.eye(4, 3, -1), np.array([[0, 1, 2, 3]]))
    mesh.check("food")
    mesh.tetrahedra = np.concatenate([mesh.tetrahedra, [[1, 2, 0, 3]]])
    with pytest.raises(MeshError, match=r"food: 1 tetrahedra are repeated, such as 1"):
        mesh.check("food")


def test_a_mesh_file_in_millimetres_names_food_and_factor(tmp_path):
    import meshio

    mesh = grid()
    path = tmp_path / "food.vtk"
    meshio.Mesh(1000.0 * mesh.vertices, [("tetra", mesh.tetrahedra)]).write(path)
    food = Food(name="radish", shape=MeshFile(path=str(path)), cut_point=[0.0, 0.01, 0.0])
    food.held_sides = "none"
    with pytest.raises(MeshError, match=r"food\.shape of radish.*millimetres\? Scale it by 0\.001"):
        make_food_model(food, Knife(), Numerics())
    food.shape.scale = 1e-3
    assert make_food_model(food, Knife(), Numerics()).section_area == pytest.approx(4e-4)
    food.shape.path = str(tmp_path / "none.vtk")
    with pytest.raises(MeshError, match=r"none\.vtk cannot be read as a mesh: there is no"):
        make_food_model(food, Knife(), Numerics())


def test_a_plane_that_misses_the_food_says_where_the_food_is():
    with pytest.raises(
        MeshError, match=r"misses the food.*-0\.07 to -0\.01 m from the plane.*Move"
    ):
        cut(cut_point=[0.0, 0.04, 0.0])


@pytest.mark.parametrize("distance", [0.0, 1e-3])
def test_holding_everything_at_the_cut_is_refused(distance):
    with pytest.raises(ConfigurationError, match=r"food\.hold.*held.*farther from the cut plane"):
        cut(cut_point=[0.0, 2e-3, 0.0], hold_distance=distance)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"hold_distance": 0.04}, r"food\.hold_distance: 0\.04 m.*minus end.*less than 0\.03,"),
        (
            {"held_sides": "plus", "hold_distance": 0.05},
            r"food\.hold_distance: 0\.05 m.*plus end.*less than 0\.03, or hold another side",
        ),
        (
            {"hold_distance_minus": 0.03},
            r"food\.hold_distance_minus: 0\.03 m.*minus end of",
        ),
    ],
)
def test_a_clamp_beyond_the_end_of_the_food_is_refused(changes, words):
    with pytest.raises(ConfigurationError, match=words):
        cut(**changes)


def test_each_side_is_held_from_its_own_distance_on():
    food = Food(shape=SMALL, hold_distance=0.010, hold_distance_minus=0.02)
    y = (mesh := SMALL.mesh()).vertices[:, 1]
    assert np.array_equal(food.held(mesh), (y > 0.010) | (y < -0.02))
    food.held_sides = "minus"
    assert np.array_equal(food.held(mesh), y < -0.02)
    food.hold_distance_minus = None
    assert np.array_equal(food.held(mesh), y < -0.010)


@pytest.mark.parametrize(
    "shape",
    [
        Cylinder(diameter=0.03, length=0.1, rings=3),
        SMALL,
        Remainder(Cylinder(diameter=0.03, length=0.1, rings=3), position=-0.03),
    ],
)
@pytest.mark.parametrize("refinement", [1.0, 2.0])
def test_a_food_is_held_where_it_is_said_also_beyond_its_layers(shape, refinement):
    for distance in (0.0119, 0.0122, 0.0197, 0.025):
        food = Food(shape=shape, held_sides="plus", hold_distance=distance)
        mesh = food.mesh(refinement)
        mesh.check()
        y = mesh.vertices[:, 1]
        first = y[food.held(mesh)].min()
        assert distance < first < distance + 2e-4
        # No element is a sliver, and none is long, from the cut to the clamp.
        steps = np.diff(np.unique(y[(y >= 0.0) & (y < first + 1e-9)]))
        assert 1e-3 < steps.min() and steps.max() < 0.0145 / refinement
    near = Food(shape=shape, held_sides="plus", hold_distance=0.0119)
    assert np.array_equal(near.mesh().vertices, shape.mesh().vertices)


def test_a_food_that_nothing_holds_is_warned_of():
    slippery = Numerics(board_friction=0.0)
    (warning,) = cut(slippery, held_sides="none").model.warnings
    assert "board_friction = 0: nothing holds the food" in warning
    assert not cut(held_sides="none").model.warnings
    assert not cut(slippery, held_sides="minus").model.warnings


def test_a_step_beyond_the_limit_names_the_limit_and_the_ways_out():
    with pytest.raises(
        TimeStepError, match=r"time_step = 0\.001 s.*limit.*mass_scaling: true"
    ) as e:
        cut(Numerics(mass_scaling=False))
    advised = float(str(e.value).split("Give at most ")[1].split(",")[0])
    food = Food(shape=SMALL)
    taken = Numerics(mass_scaling=False, time_step=advised)
    assert make_food_model(food, Knife(), taken).critical_time_step >= advised


def test_a_step_that_does_not_divide_the_coupling_step_is_refused():
    with pytest.raises(
        TimeStepError, match=r"0\.0003 s does not divide.*0\.002 s\. Give 0\.000285"
    ):
        cut(Numerics(time_step=3e-4))


def in_cut_frame(solver: CuttingSolver, clearance: float) -> Pose:
    model = solver.model
    pose = start_pose(model, clearance)
    return Pose(model.X_FC_rotation.T @ pose.R, model.to_cut_frame(pose.p))


def test_a_knife_that_starts_in_the_food_is_told_how_far_to_rise():
    solver = cut()
    plan = MotionPlan([ConstantSpeed(distance=0.01)])
    inside = Motion(plan, start_pose(solver.model, -3e-3))
    with pytest.raises(
        CuttingError, match=r"starts inside the food: its edge is 0\.003 m below.*clearance"
    ):
        simulate_slice(solver, inside)
    check_clear(solver.model, in_cut_frame(solver, 1e-4))


def turned(pose: Pose, axis: int, angle: float) -> Pose:
    vector = np.zeros(3)
    vector[axis] = angle
    x, y, z = vector
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) / angle * skew + (1 - np.cos(angle)) / angle**2 * skew @ skew
    return Pose(turn @ pose.R, pose.p)


def test_a_blade_off_the_plane_of_the_cut_is_refused_once_it_is_in_the_food():
    solver = cut()
    model, inside = solver.model, in_cut_frame(solver, -5e-3)
    check_in_plane(model, inside, 0.0)
    off = Pose(inside.R, inside.p + [0.0, 4e-3, 0.0])
    with pytest.raises(
        CuttingError, match=r"at 0\.3 s the blade is 4 mm off.*Give the knife's path"
    ):
        check_in_plane(model, off, 0.3)
    with pytest.raises(CuttingError, match=r"leans 0\.1[89]\d* rad.*up to 3 mm and 0\.15 rad"):
        check_in_plane(model, turned(inside, 0, 0.19), 0.3)
    with pytest.raises(CuttingError, match=r"turned 0\.1[89]\d* rad about the vertical"):
        check_in_plane(model, turned(inside, 2, 0.19), 0.3)
    # Rocking about the blade's normal stays in the plane; and above the food anything goes.
    check_in_plane(model, turned(inside, 1, 0.19), 0.3)
    check_in_plane(model, Pose(off.R, off.p + [0.0, 0.0, 6e-3]), 0.3)


def test_a_slice_along_a_slanted_path_stops_with_its_time():
    solver = cut()
    path = Waypoints(times=[0.5], positions=[[0.0, 0.01, 0.01]], interpolation="linear")
    motion = Motion(MotionPlan([path]), start_pose(solver.model, 1e-3))
    with pytest.raises(
        CuttingError, match=r"at 0\.15\d* s the blade is 3\.0\d* mm off the cut plane"
    ):
        simulate_slice(solver, motion)


def test_very_soft_food_stops_with_time_element_and_cause():
    soft = Material(youngs_modulus=5e3, poisson_ratio=0.2, toughness=1e5, strength=1e7)
    solver = cut(Numerics(time_step=2.5e-4), material=soft, hold_distance=0.0119)
    motion = Motion(
        MotionPlan([ConstantSpeed(distance=0.025, speed=0.05)]), start_pose(solver.model, 1e-3)
    )
    with pytest.raises(
        CuttingError,
        match=r"at \d.* s (element \d+ is inverted|the knife's force).*Use a .*finer mesh",
    ):
        simulate_slice(solver, motion, check_period=2e-3)


@pytest.mark.parametrize(
    ("height", "cut_through", "cause"),
    [
        (59e-3, 1.0, "the edge deforms"),
        (0.01, 0.9, "the edge deforms"),
        (0.01, 1.0, r"10 of [\d.]+ mm"),
    ],
)
def test_food_that_inverts_over_the_spine_of_a_low_blade_is_told_from_food_at_its_edge(
    height, cut_through, cause
):
    model = make_food_model(Food(shape=SMALL), Knife(height=height), Numerics())
    energies = Energies(0.1, 0.0, 0.0, 0.0, 1e-3, 0.0, 0.0, -0.1, 7)
    with pytest.raises(
        CuttingError, match=rf"element 7 is inverted \(volume ratio -0\.1\): .*{cause}"
    ):
        check_energies(energies, 0.1, model, 1.0, cut_through)


def test_a_slice_too_fast_for_its_mass_scaling_is_refused():
    # The edge meets the flat top all at once.
    solver = cut(Numerics(step_by_need=False))
    motion = Motion(
        MotionPlan([ConstantSpeed(distance=0.025, speed=0.2)]), start_pose(solver.model, 1e-3)
    )
    with pytest.raises(
        CuttingError, match=r"kinetic energy is .* % of the internal.*smaller numerics\.time_step"
    ):
        simulate_slice(solver, motion, check_period=2e-3)
