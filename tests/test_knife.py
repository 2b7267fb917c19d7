"""The knife: signed distance against brute force, refusals, mass of the blade."""

import numpy as np
import pytest
from scipy.spatial import HalfspaceIntersection

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.knife import Knife, section_distance, signed_distance

KNIVES = {
    "default": Knife(),
    "rounded": Knife(edge_radius=2e-5),
    # A wedge with visible bevel and radius, so that every corner matters.
    "blunt": Knife(
        spine_thickness=6e-3,
        edge_thickness=2e-3,
        height=8e-3,
        tip_height=1.5e-3,
        length=0.03,
        edge_radius=5e-4,
    ),
}


def outline(knife: Knife, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The section drawn in by the edge radius, from half planes alone.

    Returns:
        Points of its boundary at most `spacing` apart [N, 2], and half planes n . p + d <= 0 as
        (n, d) [6, 3].
    """
    e, s = 0.5 * knife.edge_thickness, 0.5 * knife.spine_thickness
    top = knife.tip_height + knife.height
    corners = [(0.0, 0.0), (e, knife.tip_height), (s, top), (-s, top), (-e, knife.tip_height)]
    planes = []
    for k, p in enumerate(corners):
        q = corners[(k + 1) % len(corners)]
        normal = np.array([q[1] - p[1], p[0] - q[0]]) / np.hypot(q[0] - p[0], q[1] - p[1])
        planes.append([*normal, -(normal @ p) + knife.edge_radius])
    inner = HalfspaceIntersection(np.array(planes), np.array([0.0, 0.9 * top])).intersections
    around = np.arctan2(inner[:, 0], inner[:, 1] - 0.9 * top)
    inner = inner[np.argsort(around)]
    sides = []
    for p, q in zip(inner, np.roll(inner, -1, axis=0), strict=True):
        count = max(2, int(np.ceil(np.linalg.norm(q - p) / spacing)))
        sides.append(p + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (q - p))
    return np.concatenate(sides), np.array(planes)


def brute_force(knife: Knife, points: np.ndarray, spacing: float) -> np.ndarray:
    """Signed distance to the section of points [N, 2]."""
    boundary, planes = outline(knife, spacing)
    nearest = np.array([np.linalg.norm(boundary - p, axis=1).min() for p in points])
    inside = (points @ planes[:, :2].T + planes[:, 2]).max(1) <= 0.0
    return np.where(inside, -nearest, nearest) - knife.edge_radius


def section_points(knife: Knife, seed: int = 1, count: int = 400) -> np.ndarray:
    """Points about the whole section and, half of them, close to the edge [N, 2]."""
    rng = np.random.default_rng(seed)
    top = knife.tip_height + knife.height
    wide = rng.uniform(
        [-knife.spine_thickness, -0.3 * top], [knife.spine_thickness, 1.3 * top], (count, 2)
    )
    near = 4.0 * max(knife.edge_thickness, knife.tip_height)
    return np.concatenate([wide, rng.uniform(-near, near, (count, 2))])


@pytest.mark.parametrize("name", KNIVES)
def test_section_distance_is_the_distance_to_the_outline(name):
    knife = KNIVES[name]
    points = section_points(knife)
    spacing = 2e-5
    distance = section_distance(knife, points[:, 0], points[:, 1])
    expected = brute_force(knife, points, spacing)
    assert (expected < -1e-5).sum() > 20 and (expected > 1e-5).sum() > 20
    # The nearest sample lies at most half a spacing from the nearest point of the boundary.
    to_outline = np.abs(distance + knife.edge_radius)
    tolerance = np.hypot(to_outline, 0.5 * spacing) - to_outline + 1e-12
    assert (np.abs(distance - expected) <= tolerance).all()


def prism_distance(knife: Knife, p: np.ndarray) -> np.ndarray:
    """Signed distance of points [N, 3] to the prism from sampled ends and the section's samples."""
    section = brute_force(knife, np.stack([p[:, 1], -p[:, 2]], axis=1), 2e-5)
    along = np.linspace(-0.5, 0.5, 4001) * knife.length
    end = np.abs(p[:, 0, None] - along).min(1)
    beyond = np.abs(p[:, 0]) > 0.5 * knife.length
    inside_length = 0.5 * knife.length - np.abs(p[:, 0])
    outside = np.where(beyond, np.hypot(end, np.maximum(section, 0.0)), section)
    return np.where(~beyond & (section < 0.0), np.maximum(section, -inside_length), outside)


@pytest.mark.parametrize("name", ["rounded", "blunt"])
def test_signed_distance_is_that_of_a_prism_of_the_given_length(name):
    knife = KNIVES[name]
    points = section_points(knife, seed=2, count=300)
    x = np.random.default_rng(3).uniform(-0.6, 0.6, len(points)) * knife.length
    x[::3] = np.sign(x[::3]) * 0.5 * knife.length + 0.1 * x[::3]
    p_KP = np.stack([x, points[:, 0], -points[:, 1]], axis=1)
    distance = signed_distance(knife, p_KP)
    np.testing.assert_allclose(distance, prism_distance(knife, p_KP), atol=1e-5)


def test_half_section_of_a_sharp_knife_is_tip_shoulder_and_spine():
    knife = Knife()
    expected = [[0.0, 0.0], [4e-5, 4e-5], [1.75e-3, 59.04e-3]]
    np.testing.assert_allclose(knife.half_section(), expected, rtol=1e-12)


def test_largest_radius_that_is_accepted_keeps_bevel_and_flank():
    for edge_thickness, tip_height in ((8e-5, 4e-5), (2e-3, 1e-3), (3e-4, 1e-3), (1e-3, 1e-4)):
        knife = Knife(edge_thickness=edge_thickness, tip_height=tip_height)
        knife.edge_radius = 0.5 * min(edge_thickness, tip_height, 2.0 * 5e-4)
        validate(knife, "knife")
        section = knife.half_section()
        assert (np.diff(section[:, 0]) > 0.0).all() and (np.diff(section[:, 1]) > 0.0).all()
        inner, _ = outline(knife, 1.0)
        for corner in section:
            assert np.linalg.norm(inner - corner, axis=1).min() < 1e-9


def test_rounding_keeps_the_flanks_and_moves_the_edge_up():
    sharp, rounded = Knife(), Knife(edge_radius=2e-5)
    y = np.full(50, 3e-3)
    height = np.linspace(5e-3, 50e-3, 50)
    np.testing.assert_allclose(
        section_distance(rounded, y, height), section_distance(sharp, y, height), atol=1e-12
    )
    below = section_distance(rounded, np.zeros(1), np.array([-1e-3]))[0]
    # The bevel's half angle is 45 degrees: a disc in its corner stands off by (sqrt(2) - 1) r.
    assert below - 1e-3 == pytest.approx((np.sqrt(2.0) - 1.0) * 2e-5, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edge_thickness": 1e-3, "spine_thickness": 1e-3}, r"knife\.edge_thickness.*not below"),
        ({"edge_radius": 3e-5}, r"knife\.edge_radius.*does not fit.*2e-05"),
        ({"tip_height": 5e-3}, r"knife\.tip_height.*convex"),
        ({"length": 150.0}, r"knife\.length.*Is it in mm\? Write 0\.15"),
    ],
)
def test_a_knife_that_cannot_be_is_refused_by_field(change, message):
    with pytest.raises(ConfigurationError, match=message):
        validate(Knife(**change), "knife")


def test_lateral_mass_is_a_quarter_of_the_blades():
    knife = Knife()
    y = np.linspace(-2e-3, 2e-3, 801)
    height = np.linspace(-1e-3, 61e-3, 1241)
    inside = section_distance(knife, *(g.ravel() for g in np.meshgrid(y, height))) < 0.0
    blade = 7800.0 * knife.length * inside.sum() * (y[1] - y[0]) * (height[1] - height[0])
    # Rayleigh's 33/140 of a cantilever's mass moves with its end.
    assert knife.lateral_mass() == pytest.approx(33.0 / 140.0 * blade, rel=0.02)
