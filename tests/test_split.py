"""The split: volume, mass, section and bodies over 1,000 planes, and planes through vertices."""

import functools

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from split_measures import area_of_section, material_volumes

from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.generators import box_mesh, cylinder_mesh, ellipsoid_mesh
from sliceit_drake.cutting.mesh.manifold import bodies
from sliceit_drake.cutting.mesh.split import CutPlane, split_mesh
from sliceit_drake.cutting.mesh.tetrahedra import MeshError, TetrahedralMesh
from sliceit_drake.cutting.model import Numerics, prepare_cut

BODIES = ("box", "cylinder", "ellipsoid")
PLANES = 334


@functools.cache
def body(name: str) -> TetrahedralMesh:
    if name == "box":
        return box_mesh(
            np.linspace(-0.02, 0.02, 4), np.linspace(-0.03, 0.03, 5), np.linspace(0.0, 0.025, 4)
        )
    if name == "cylinder":
        return cylinder_mesh(0.03, np.array([-0.03, -0.01, 0.0, 0.01, 0.03]), 3)
    return ellipsoid_mesh((0.05, 0.04, 0.03), 2)


def random_plane(mesh: TetrahedralMesh, rng: np.random.Generator) -> CutPlane:
    """A plane through a point in the body's bounding ball, which may miss the body."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    normal = rng.normal(size=3)
    up = np.cross(normal, rng.normal(size=3))
    return CutPlane(rng.uniform(low, high), normal / np.linalg.norm(normal), up)


def hull_section_area(mesh: TetrahedralMesh, plane: CutPlane) -> float:
    """Area in which the plane meets a convex body: the hull of where it meets the mesh's edges."""
    pairs = mesh.tetrahedra[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    p, q = mesh.vertices[pairs[:, 0]], mesh.vertices[pairs[:, 1]]
    hp, hq = (p - plane.point) @ plane.normal, (q - plane.point) @ plane.normal
    crosses = (hp * hq <= 0.0) & (hp != hq)
    share = (hp[crosses] / (hp[crosses] - hq[crosses]))[:, None]
    on_plane = p[crosses] + share * (q[crosses] - p[crosses])
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    return ConvexHull(on_plane @ axes.T).volume


def test_the_bodies_are_convex_and_so_their_sections_can_be_checked():
    for name in BODIES:
        mesh = body(name)
        assert ConvexHull(mesh.vertices).volume == pytest.approx(mesh.volumes().sum(), rel=1e-12)


@pytest.mark.parametrize("name", BODIES)
def test_random_planes_conserve_volume_and_section_and_give_two_bodies(name):
    mesh, rng = body(name), np.random.default_rng(len(name))
    whole = mesh.volumes().sum()
    size = mesh.mean_edge_length()
    done = 0
    while done < PLANES:
        plane = random_plane(mesh, rng)
        height = (mesh.vertices - plane.point) @ plane.normal
        if height.min() > -1e-4 * size or height.max() < 1e-4 * size:
            continue
        done += 1
        split = split_mesh(mesh, plane)
        assert material_volumes(split).sum() == pytest.approx(whole, rel=1e-12)
        assert area_of_section(split) == pytest.approx(
            hull_section_area(mesh, plane), rel=1e-6, abs=1e-4 * size**2
        )
        assert np.unique(bodies(split.tetrahedra)).size == 2
        assert (split.fraction > 0.0).all() and (split.fraction <= 1.0 + 1e-12).all()


@pytest.mark.parametrize("name", BODIES)
def test_each_side_holds_the_volume_and_centroid_of_the_clipped_body(name):
    mesh, rng = body(name), np.random.default_rng(7)
    for _ in range(20):
        plane = random_plane(mesh, rng)
        plane.point = mesh.vertices.mean(0)
        split = split_mesh(mesh, plane)
        volume = material_volumes(split)
        corners = split.nodes[split.tetrahedra]
        centroid = (corners * split.centroid[..., None]).sum(1)
        side = split.node_side[split.tetrahedra[:, 0]]
        for k, sign in ((0, -1.0), (1, 1.0)):
            own = split.vertex_position[sign * split.vertex_position[:, 1] >= 0.0]
            hull = ConvexHull(np.concatenate([own, split.points]))
            assert volume[side == k].sum() == pytest.approx(hull.volume, rel=1e-9)
            # Centroid of the hull from cones over its faces.
            inner = hull.points[hull.vertices].mean(0)
            faces = hull.points[hull.simplices]
            cones = np.abs(np.linalg.det(faces - inner)) / 6.0
            expected = cones @ (0.75 * faces.mean(1) + 0.25 * inner) / cones.sum()
            found = volume[side == k] @ centroid[side == k] / volume[side == k].sum()
            np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("hold", [False, True])
def test_mass_and_weight_are_those_of_the_body(name, hold):
    mesh, rng = body(name), np.random.default_rng(11)
    material = Material(density=1100.0)
    for _ in range(5):
        plane = random_plane(mesh, rng)
        plane.point = mesh.vertices.mean(0)
        height = (mesh.vertices - plane.point) @ plane.normal
        held = height < (-0.6 * np.ptp(height) / 2 if hold else -np.inf)
        up = rng.normal(size=3)
        geometry = make_cut_geometry(mesh, plane, held, up, board_height=None)
        model = prepare_cut(geometry, material, Knife(), Numerics())
        # Elements of which every corner is held are not computed.
        computed = ~held[mesh.tetrahedra].all(1)
        volume = mesh.volumes()[computed].sum()
        assert model.true_mass.sum() == pytest.approx(1100.0 * volume, rel=1e-12)
        weight = model.weight.sum(0) @ model.X_FC_rotation.T
        expected = -1100.0 * volume * 9.81 * up / np.linalg.norm(up)
        np.testing.assert_allclose(weight, expected, atol=1e-12 + 1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("name", BODIES)
def test_cut_points_of_both_sides_coincide_on_the_plane(name):
    mesh, rng = body(name), np.random.default_rng(5)
    for _ in range(20):
        plane = random_plane(mesh, rng)
        plane.point = mesh.vertices.mean(0)
        split = split_mesh(mesh, plane)
        np.testing.assert_allclose(split.point_weights.sum(1), 1.0, rtol=1e-15)
        assert (split.point_weights >= 0.0).all()
        embedded = np.einsum("pe,psex->psx", split.point_weights, split.nodes[split.point_nodes])
        np.testing.assert_allclose(embedded[:, 0], embedded[:, 1], atol=1e-15)
        np.testing.assert_allclose(embedded[:, 0], split.points, atol=1e-15)
        np.testing.assert_allclose(split.points[:, 1], 0.0, atol=1e-6 * mesh.mean_edge_length())
        assert (split.node_side[split.point_nodes] == [[[0], [1]]]).all()
        sign = np.where(split.node_side == 1, 1.0, -1.0)
        clear = np.abs(split.nodes[:, 1]) > 1e-6 * mesh.mean_edge_length()
        np.testing.assert_array_equal(
            split.node_is_material[clear], (sign * split.nodes[:, 1] > 0.0)[clear]
        )
        assert split.node_is_material[~clear].all()
        # The section faces the plus side.
        a, b, c = (split.points[split.triangles[:, k]] for k in range(3))
        assert (np.cross(b - a, c - a)[:, 1] > 0.0).all()


def test_plane_through_a_layer_of_faces_copies_nothing():
    mesh = body("box")
    split = split_mesh(
        mesh, CutPlane(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1.0]))
    )
    assert len(split.tetrahedra) == len(mesh.tetrahedra)
    np.testing.assert_array_equal(split.fraction, 1.0)
    assert area_of_section(split) == pytest.approx(0.04 * 0.025, rel=1e-12)
    assert len(split.points) == 16 and (split.point_weights == [1.0, 0.0]).all()
    assert np.unique(bodies(split.tetrahedra)).size == 2


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("through", ["vertex", "edge", "face"])
def test_planes_exactly_through_vertices_edges_and_faces_split_cleanly(name, through):
    mesh, rng = body(name), np.random.default_rng(13)
    size = mesh.mean_edge_length()
    for _ in range(25):
        corners = mesh.vertices[rng.choice(mesh.tetrahedra.ravel())]
        t = mesh.vertices[rng.permuted(mesh.tetrahedra[rng.integers(len(mesh.tetrahedra))])]
        if through == "vertex":
            point, normal = corners, rng.normal(size=3)
        elif through == "edge":
            point, normal = t[0], np.cross(t[1] - t[0], rng.normal(size=3))
        else:
            point, normal = t[0], np.cross(t[1] - t[0], t[2] - t[0])
        normal = normal / np.linalg.norm(normal)
        height = (mesh.vertices - point) @ normal
        if height.min() > -1e-3 * size or height.max() < 1e-3 * size:
            continue
        plane = CutPlane(point, normal, np.cross(normal, rng.normal(size=3)))
        split = split_mesh(mesh, plane)
        assert material_volumes(split).sum() == pytest.approx(mesh.volumes().sum(), rel=1e-5)
        assert area_of_section(split) == pytest.approx(hull_section_area(mesh, plane), rel=1e-5)
        assert np.unique(bodies(split.tetrahedra)).size == 2
        np.testing.assert_allclose(split.points[:, 1], 0.0, atol=2e-6 * size)


def test_a_plane_that_misses_says_how_far_and_what_to_do():
    plane = CutPlane(np.array([0.0, 0.05, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1.0]))
    with pytest.raises(MeshError, match=r"misses the food.*-0\.08 to -0\.02 m.*Move the plane"):
        split_mesh(body("box"), plane)


@pytest.mark.parametrize(
    ("normal", "up", "message"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], "normal .* has no direction"),
        ([0.0, 0.0, 2.0], [0.0, 0.0, 1.0], "parallel to the normal"),
    ],
)
def test_a_plane_without_direction_is_refused(normal, up, message):
    with pytest.raises(MeshError, match=message):
        split_mesh(body("box"), CutPlane(np.zeros(3), np.array(normal), np.array(up)))
