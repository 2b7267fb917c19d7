"""Meshes from files: read as they were written, refused by name where they are no solid body."""

import dataclasses as dc
import re
from pathlib import Path

import meshio
import numpy as np
import pytest

from sliceit_drake.calibration.setup import CalibrationSetup, load_setup
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, MeshFile
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.generators import box_mesh
from sliceit_drake.cutting.mesh.manifold import surface_crossings
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh, boundary_faces
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.diagrams.scenario import Scenario, load_scenario

FORMATS = {
    "gmsh 2.2": (".msh", "gmsh22"),
    "gmsh 4.1": (".msh", "gmsh"),
    "vtk": (".vtk", "vtk"),
    "vtu": (".vtu", "vtu"),
}


def write(path, mesh: TetrahedralMesh, file_format: str, scale: float = 1.0) -> str:
    """The mesh with the triangles of its surface, as a mesher writes it."""
    boundary = boundary_faces(mesh.tetrahedra)[0]
    cells = [("triangle", boundary), ("tetra", mesh.tetrahedra)]
    content = meshio.Mesh(scale * mesh.vertices, cells)
    if file_format == "gmsh":
        # Format 4.1 lists the vertices by the surface or the volume that they lie on.
        inner = ~np.isin(np.arange(len(mesh.vertices)), boundary)
        content.point_data["gmsh:dim_tags"] = np.stack([2 + inner, 1 + 0 * inner], axis=1)
        for tag in ("gmsh:geometrical", "gmsh:physical"):
            content.cell_data[tag] = [np.ones(len(c.data), int) for c in content.cells]
    meshio.write(path, content, file_format=file_format)
    return str(path)


def in_order(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] sorted by their coordinates."""
    return points[np.lexsort(points.round(9).T)]


def grid(n: int = 2, origin=(0.0, 0.0, 0.0), size: float = 0.02) -> TetrahedralMesh:
    return box_mesh(*(o + np.linspace(0.0, size, n + 1) for o in origin))


def joined(*meshes: TetrahedralMesh) -> TetrahedralMesh:
    """One mesh of several bodies, none of their vertices merged."""
    start = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    tetrahedra = [m.tetrahedra + s for m, s in zip(meshes, start, strict=True)]
    return TetrahedralMesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(tetrahedra))


def merged(mesh: TetrahedralMesh) -> TetrahedralMesh:
    """With vertices that lie on each other made one."""
    _, first, index = np.unique(
        mesh.vertices.round(9), axis=0, return_index=True, return_inverse=True
    )
    return TetrahedralMesh(mesh.vertices[first], index.ravel()[mesh.tetrahedra])


@pytest.mark.parametrize("name", FORMATS)
def test_a_mesh_comes_back_from_a_file_and_is_cut_like_the_generated_one(name, tmp_path):
    suffix, file_format = FORMATS[name]
    mesh = Cylinder(rings=2).mesh()
    path = write(tmp_path / f"food{suffix}", mesh, file_format, scale=1e3)
    read = MeshFile(path, scale=1e-3).mesh()
    np.testing.assert_allclose(in_order(read.vertices), in_order(mesh.vertices), atol=1e-12)
    centres = [in_order(m.vertices[m.tetrahedra].mean(1)) for m in (read, mesh)]
    np.testing.assert_allclose(*centres, atol=1e-12)
    food = Food(shape=MeshFile(path, scale=1e-3))
    cut = make_food_model(food, Knife(), Numerics())
    assert cut.section_area == pytest.approx(0.25 * np.pi * 0.027**2, rel=1e-9)


def test_points_that_no_tetrahedron_uses_are_left_out(tmp_path):
    mesh = grid()
    # As the centre of an arc, between the vertices.
    vertices = np.insert(mesh.vertices, 5, [0.5, 0.5, 0.5], axis=0)
    cells = mesh.tetrahedra + (mesh.tetrahedra >= 5)
    path = write(tmp_path / "food.msh", TetrahedralMesh(vertices, cells), "gmsh22")
    read = MeshFile(path).mesh()
    read.check()
    np.testing.assert_array_equal(read.tetrahedra, mesh.tetrahedra)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-12)


def test_a_mesh_from_a_file_is_refined_by_halving_its_edges_and_not_made_coarser(tmp_path):
    mesh = Cylinder(rings=2).mesh()
    shape = MeshFile(write(tmp_path / "food.vtu", mesh, "vtu"))
    fine = shape.mesh(2.0)
    fine.check()
    fine.check_solid()
    assert len(fine.tetrahedra) == 8 * len(mesh.tetrahedra)
    assert fine.volumes().sum() == pytest.approx(mesh.volumes().sum(), rel=1e-12)
    assert len(shape.mesh(1.25).tetrahedra) == len(mesh.tetrahedra)
    with pytest.raises(MeshError, match=r"food\.vtu cannot be made coarser by 0\.5"):
        shape.mesh(0.5)


def refusal(mesh: TetrahedralMesh, tmp_path) -> str:
    """What is said of a food whose shape this is, in a file."""
    path = write(tmp_path / "pear.vtu", mesh, "vtu")
    with pytest.raises(MeshError) as raised:
        make_food_model(Food(name="pear", shape=MeshFile(path)), Knife(), Numerics())
    message = str(raised.value)
    assert "food.shape of pear" in message and "pear.vtu" in message
    return message


def test_fragments_are_refused_with_their_sizes(tmp_path):
    apart = joined(grid(2), grid(1, origin=(0.05, 0.0, 0.0)))
    message = refusal(apart, tmp_path)
    assert "2 fragments that share no vertex, of 48, 6 tetrahedra" in message
    assert "Keep one of them" in message


def test_fragments_that_touch_are_told_to_merge_their_vertices(tmp_path):
    touching = joined(grid(1), grid(1, origin=(0.02, 0.0, 0.0)))
    assert "merge the vertices" in refusal(touching, tmp_path)
    merged(touching).check_solid()


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        ((0.02, 0.02, 0.0), r"at 1 edges parts meet in the edge alone"),
        ((0.02, 0.02, 0.02), r"at 1 vertices parts meet in the vertex alone, first \d+ at"),
    ],
)
def test_parts_that_meet_in_an_edge_or_a_vertex_are_refused(origin, words, tmp_path):
    pinched = merged(joined(grid(1), grid(1, origin=origin)))
    message = refusal(pinched, tmp_path)
    assert "not manifold" in message and re.search(words, message)


def folded() -> TetrahedralMesh:
    """Two tetrahedra on the same side of the face that they share."""
    vertices = 0.02 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.3, 0.3, 1]])
    return TetrahedralMesh(vertices, np.array([[0, 1, 2, 3], [0, 1, 2, 4]]))


def test_two_tetrahedra_on_one_side_of_a_face_are_refused(tmp_path):
    mesh = folded()
    mesh.check()
    assert "1 faces have both of their tetrahedra on one side" in refusal(mesh, tmp_path)


def snake(turn: float, cells: int = 40) -> TetrahedralMesh:
    """A bar bent to a ring through an angle; from a full turn on its ends overlap."""
    bar = box_mesh(np.linspace(0.01, 0.02, 3), np.linspace(0.0, 1.0, cells + 1), [0.0, 0.005, 0.01])
    x, s, z = bar.vertices.T
    return TetrahedralMesh(
        np.stack([x * np.cos(turn * s), x * np.sin(turn * s), z], axis=1), bar.tetrahedra
    )


def test_a_body_whose_ends_go_through_each_other_is_refused_where_they_do(tmp_path):
    snake(1.9 * np.pi).check_solid()
    mesh = snake(2.1 * np.pi)
    mesh.check()
    message = refusal(mesh, tmp_path)
    assert "surface goes through itself" in message
    # The tetrahedra that are named are of the two ends.
    words = message.split("tetrahedra ")[1].split(" overlap")[0].split(" and ")
    order = np.sort([mesh.tetrahedra[int(w)].mean() for w in words])
    assert order[0] < 0.15 * len(mesh.vertices) and order[1] > 0.85 * len(mesh.vertices)


@pytest.mark.parametrize("shift", [(0.01, 0.0, 0.0), (0.0137, 0.0021, 0.0), (0.005, 0.005, 0.005)])
def test_overlap_on_one_grid_or_off_it_is_found_and_contact_is_not(shift):
    first, second = grid(2), grid(2, origin=shift)
    overlapping = joined(first, second)
    boundary = boundary_faces(overlapping.tetrahedra)[0]
    assert len(surface_crossings(overlapping.vertices, boundary)) > 0
    for apart in ((0.02, 0.0, 0.0), (0.02, 0.005, 0.0), (0.05, 0.0, 0.0)):
        beside = joined(first, grid(2, origin=apart))
        boundary = boundary_faces(beside.tetrahedra)[0]
        assert len(surface_crossings(beside.vertices, boundary)) == 0


def test_crossings_are_those_of_all_pairs_of_edges_and_faces():
    rng = np.random.default_rng(3)
    body = Ellipsoid(refinements=1).mesh()
    other = TetrahedralMesh(body.vertices + rng.uniform(-0.03, 0.03, 3), body.tetrahedra)
    both = joined(body, other)
    boundary = boundary_faces(both.tetrahedra)[0]
    found = surface_crossings(both.vertices, boundary)
    sides = np.unique(np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    count = 0
    for p, q in both.vertices[sides]:
        a, b, c = (both.vertices[boundary[:, k]] for k in range(3))
        # x = p + u (q - p) = a + v (b - a) + w (c - a)
        M = np.stack([np.broadcast_to(p - q, a.shape), b - a, c - a], axis=-1)
        regular = np.abs(np.linalg.det(M)) > 1e-15
        u, v, w = np.linalg.solve(M[regular], (p - a[regular])[..., None])[..., 0].T
        count += np.count_nonzero((u > 1e-6) & (u < 1 - 1e-6) & (v > 0) & (w > 0) & (v + w < 1))
    assert len(found) == count > 20


@pytest.mark.parametrize("shape", [Cylinder(rings=3), Box(), Ellipsoid(refinements=2)])
def test_generated_shapes_are_solid_bodies(shape):
    shape.mesh().check_solid()


def test_a_surface_mesh_says_what_the_file_holds_instead(tmp_path):
    mesh = grid()
    path = tmp_path / "skin.vtk"
    meshio.Mesh(mesh.vertices, [("triangle", boundary_faces(mesh.tetrahedra)[0])]).write(path)
    with pytest.raises(MeshError, match=r"food\.shape\.path: .*no linear.*48 triangle.*volume"):
        MeshFile(str(path)).mesh()


@pytest.mark.parametrize("suffix", [".msh", ".vtk", ".vtu", ".xyz"])
def test_a_file_that_is_no_mesh_is_refused_whatever_the_reader_does(suffix, tmp_path):
    path = tmp_path / f"broken{suffix}"
    path.write_text("$MeshFormat\n4.1 0 8\nnonsense\n")
    with pytest.raises(MeshError, match=rf"broken\{suffix} cannot be read as a mesh.*Export"):
        MeshFile(str(path)).mesh()


def test_a_mesh_lies_beside_its_scenario_and_an_absent_one_is_looked_for_by_name(tmp_path):
    folder = tmp_path / "kitchen"
    folder.mkdir()
    write(folder / "pear.vtk", Cylinder(rings=2).mesh(), "vtk")
    scenario = dc.replace(Scenario(), food=Food(shape=MeshFile("pear.vtk")))
    dump_yaml(scenario, folder / "pear.yaml")
    loaded = load_scenario(folder / "pear.yaml")
    assert len(loaded.food.shape.mesh().tetrahedra) > 100
    # What is written from it is found from anywhere.
    dump_yaml(loaded, tmp_path / "again.yaml")
    assert load_scenario(tmp_path / "again.yaml").food.shape.mesh().vertices.shape[1] == 3
    setup = CalibrationSetup(food=Food(shape=MeshFile("pear.vtk")))
    dump_yaml(setup, folder / "setup.yaml")
    assert Path(load_setup(folder / "setup.yaml").food.shape.path) == folder / "pear.vtk"
    absent = load_scenario(folder / "pear.yaml", "{food: {shape: !MeshFile {path: pare.vtk}}}")
    with pytest.raises(MeshError, match=r"food\.shape\.path: pare\.vtk.*no such file.*Correct"):
        absent.food.shape.mesh()
