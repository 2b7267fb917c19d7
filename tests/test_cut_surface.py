"""Edge tables: partition of the section's width, area of each point, monotone cut fraction."""

import numpy as np
import pytest
from split_measures import area_of_section

from sliceit_drake.cutting.mesh.cut_surface import EdgeTables, edge_tables
from sliceit_drake.cutting.mesh.generators import box_mesh, cylinder_mesh, ellipsoid_mesh
from sliceit_drake.cutting.mesh.split import CutPlane, SplitMesh, split_mesh
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh

MESHES = {
    "box": box_mesh(
        np.linspace(-0.02, 0.02, 4), np.linspace(-0.03, 0.03, 5), np.linspace(0.0, 0.025, 4)
    ),
    "cylinder": cylinder_mesh(0.03, np.array([-0.03, -0.01, 0.0, 0.01, 0.03]), 3),
    "ellipsoid": ellipsoid_mesh((0.05, 0.04, 0.03), 2),
}
ALIGNED = CutPlane(np.array([0.0, 0.0, 0.0125]), np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1.0]))


def planes(name: str) -> list[CutPlane]:
    rng = np.random.default_rng(3)
    tilted = [
        CutPlane(
            MESHES[name].vertices.mean(0) + rng.uniform(-2e-3, 2e-3, 3),
            np.array([0.0, 1.0, 0.0]) + rng.uniform(-0.6, 0.6, 3),
            rng.normal(size=3),
        )
        for _ in range(8)
    ]
    return [ALIGNED, *tilted]


def cut(
    mesh: TetrahedralMesh, plane: CutPlane, spread: float = 0.0
) -> tuple[SplitMesh, EdgeTables]:
    split = split_mesh(mesh, plane)
    groups = split.nearest_vertex
    return split, edge_tables(split.points[:, [0, 2]], split.triangles, spread, groups)


def section_width(mesh: TetrahedralMesh, plane: CutPlane, heights: np.ndarray) -> np.ndarray:
    """Width of a convex body's section along Cx at heights in C, clipped from its own tetrahedra.

    The line at a height runs through a tetrahedron where all four barycentric coordinates, linear
    along it, are positive.
    """
    R = plane.rotation()
    corners = ((mesh.vertices - plane.point) @ R)[mesh.tetrahedra]
    inverse = np.linalg.inv(np.stack([corners[:, k] - corners[:, 0] for k in (1, 2, 3)], axis=-1))
    widths = []
    for z in heights:
        start = np.array([0.0, 0.0, z]) - corners[:, 0]
        at_zero = np.einsum("tij,tj->ti", inverse, start)
        at_zero = np.column_stack([1.0 - at_zero.sum(1), at_zero])
        rate = np.column_stack([-inverse[:, :, 0].sum(1), inverse[:, :, 0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -at_zero / rate
        low = np.where(rate > 0.0, crossing, -np.inf).max(1)
        high = np.where(rate < 0.0, crossing, np.inf).min(1)
        outside = ((rate == 0.0) & (at_zero < 0.0)).any(1)
        met = (low < high) & ~outside
        widths.append(high[met].max() - low[met].min() if met.any() else 0.0)
    return np.array(widths)


def interpolated(tables: EdgeTables, values: np.ndarray, s: np.ndarray) -> np.ndarray:
    grid = np.linspace(-tables.reach, tables.reach, values.shape[1])
    return np.array([np.interp(d, grid, row) for d, row in zip(s, values, strict=True)])


@pytest.mark.parametrize("name", MESHES)
def test_the_points_share_the_sections_width_at_every_height(name):
    for plane in planes(name):
        split, tables = cut(MESHES[name], plane)
        z = split.points[:, 2]
        # Tables average over a grid cell: near a horizontal side the width steps within it.
        heights = np.linspace(z.min() + 2 * tables.spacing, z.max() - 2 * tables.spacing, 41) + 1e-7
        carried = np.array([interpolated(tables, tables.width, z - h).sum() for h in heights])
        width = section_width(MESHES[name], plane, heights)
        assert width.max() > 5e-3
        np.testing.assert_allclose(carried, width, atol=0.012 * width.max())
        assert abs(carried.sum() / width.sum() - 1.0) < 1e-3


@pytest.mark.parametrize("name", MESHES)
def test_each_point_carries_its_area_and_never_pulls(name):
    for plane in planes(name):
        split, tables = cut(MESHES[name], plane)
        assert (tables.width >= 0.0).all()
        cells = 0.5 * (tables.width[:, 1:] + tables.width[:, :-1]) * tables.spacing
        np.testing.assert_allclose(cells.sum(1), tables.area, rtol=1e-12)
        # A third of each triangle about the point, and together the section.
        a, b, c = (split.points[split.triangles[:, k]] for k in range(3))
        share = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
        expected = np.zeros(len(split.points))
        for triangle, third in zip(split.triangles, share, strict=True):
            expected[triangle] += third
        np.testing.assert_allclose(tables.area, expected, rtol=1e-9, atol=1e-18)
        assert tables.area.sum() == pytest.approx(area_of_section(split), rel=1e-12)


@pytest.mark.parametrize("name", MESHES)
def test_spread_tables_keep_the_areas_and_the_sections_width(name):
    for plane in planes(name)[:3]:
        _, sharp = cut(MESHES[name], plane)
        split, tables = cut(MESHES[name], plane, 6e-3)
        assert tables.spacing == pytest.approx(sharp.spacing, rel=1e-12)
        assert (tables.width >= 0.0).all()
        cells = 0.5 * (tables.width[:, 1:] + tables.width[:, :-1]) * tables.spacing
        np.testing.assert_allclose(cells.sum(1), sharp.area, rtol=1e-9)
        np.testing.assert_allclose(tables.fraction[:, -1], 1.0, rtol=1e-9)
        # Each point is loaded over more of the way, and less at a time.
        inner = sharp.area > 0.5 * sharp.area.max()
        assert (tables.width.max(1)[inner] < sharp.width.max(1)[inner]).all()
        z = split.points[:, 2]
        heights = np.linspace(z.min(), z.max(), 61)[3:-3] + 1e-7
        both = [
            np.array([interpolated(t, t.width, z - h).sum() for h in heights])
            for t in (sharp, tables)
        ]
        np.testing.assert_allclose(both[1], both[0], atol=0.03 * both[0].max())
        above = interpolated(tables, tables.width, z - z.max() - 4.0 * tables.spacing)
        assert (above < 1e-12).all()


@pytest.mark.parametrize("name", MESHES)
def test_cut_fraction_grows_from_nothing_to_all(name):
    for plane in planes(name):
        _, tables = cut(MESHES[name], plane)
        assert (tables.fraction[:, 0] == 0.0).all()
        np.testing.assert_allclose(tables.fraction[:, -1], 1.0, rtol=1e-12)
        assert (np.diff(tables.fraction, axis=1) >= 0.0).all()
        # Fraction is the integral of width over area.
        slope = np.diff(tables.fraction, axis=1) / tables.spacing
        middle = 0.5 * (tables.width[:, 1:] + tables.width[:, :-1])
        np.testing.assert_allclose(slope * tables.area[:, None], middle, atol=1e-15)


def test_one_triangle_carries_its_hat_functions():
    # Edge at height h: the chord is 1 - h; the apex's hat is h on all of it.
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.3, 1.0]])
    tables = edge_tables(points, np.array([[0, 1, 2]]), grid=401)
    h = np.linspace(0.05, 0.95, 19)
    s = points[:, 1][:, None] - h
    carried = interpolated(tables, tables.width, s)
    np.testing.assert_allclose(carried[2], (1.0 - h) * h, atol=2e-3)
    np.testing.assert_allclose(carried[0], 0.5 * (1.0 - h) ** 2, atol=2e-3)
    np.testing.assert_allclose(carried[1], 0.5 * (1.0 - h) ** 2, atol=2e-3)
    cut_at = interpolated(tables, tables.fraction, s)
    # The edge comes from above: the apex's point is cut by 1 - h^2 (3 - 2 h) of its area.
    np.testing.assert_allclose(cut_at[2], 1.0 - h**2 * (3.0 - 2.0 * h), atol=5e-3)


def test_a_point_too_thin_for_the_grid_is_cut_all_the_same():
    thin = 1e-7
    points = np.array([[0.0, 0.0], [1e-2, 0.0], [0.0, 1e-2], [1e-2, -thin], [2e-2, -0.4 * thin]])
    triangles = np.array([[0, 1, 2], [3, 4, 1]])
    tables = edge_tables(points, triangles)
    np.testing.assert_allclose(tables.fraction[:, -1], 1.0, rtol=1e-12)
    cells = 0.5 * (tables.width[:, 1:] + tables.width[:, :-1]) * tables.spacing
    np.testing.assert_allclose(cells.sum(1), tables.area, rtol=1e-12)
    assert tables.area[4] > 0.0
