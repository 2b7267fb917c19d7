"""Shapes of foods: roots and half cylinders against the closed form, and what slices leave of each
shape."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from split_measures import area_of_section, material_volumes

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import (
    Box,
    Cylinder,
    Ellipsoid,
    HalfCylinder,
    Remainder,
    Tapered,
)
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.manifold import bodies
from sliceit_drake.cutting.mesh.split import CutPlane, split_mesh
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.sequence import SliceSequence

CARROT = Tapered(diameters=[0.014, 0.030], length=0.12)
HALF = HalfCylinder(radius=0.018, length=0.09, rings=4)
UP = np.array([0.0, 0.0, 1.0])

SHAPES = {
    "cylinder": Cylinder(diameter=0.03, length=0.08),
    "half cylinder": HALF,
    "box": Box(size=[0.03, 0.08, 0.02], divisions=[6, 4]),
    "ellipsoid": Ellipsoid(diameters=[0.04, 0.08, 0.03], refinements=2),
    "tapered": Tapered(diameters=[0.015, 0.03], length=0.08),
}


def section_area(shape, y: float) -> float:
    """In closed form, m^2."""
    if isinstance(shape, Cylinder):
        return 0.25 * np.pi * shape.diameter**2
    if isinstance(shape, HalfCylinder):
        return 0.5 * np.pi * shape.radius**2
    if isinstance(shape, Box):
        return shape.size[0] * shape.size[2]
    if isinstance(shape, Ellipsoid):
        a, b, c = 0.5 * np.array(shape.diameters)
        return np.pi * a * c * (1.0 - (y / b) ** 2)
    small, large = shape.diameters
    return 0.25 * np.pi * (small + (large - small) * (y / shape.length + 0.5)) ** 2


def frustum(shape: Tapered) -> float:
    """Volume of a cone's frustum, m^3."""
    d, D = shape.diameters
    return np.pi * shape.length * (d * d + d * D + D * D) / 12.0


@pytest.mark.parametrize("refinement", [0.5, 1.0, 2.0])
def test_a_tapered_food_has_the_volume_and_the_sections_of_its_cone(refinement):
    mesh = CARROT.mesh(refinement)
    mesh.check()
    mesh.check_solid()
    assert mesh.volumes().min() > 0.0
    # Polygons of the circles' areas, on straight sides: at every refinement.
    assert mesh.volumes().sum() == pytest.approx(frustum(CARROT), rel=1e-12)
    for y in (-0.05, 1e-3, 0.03):
        split = split_mesh(mesh, CutPlane(np.array([0.0, y, 0.0]), np.array([0, 1.0, 0]), UP))
        assert area_of_section(split) == pytest.approx(section_area(CARROT, y), rel=1e-9)


def test_a_tapered_food_lies_on_the_board_along_its_whole_length():
    mesh = CARROT.mesh()
    for y in np.unique(mesh.vertices[:, 1]):
        section = mesh.vertices[mesh.vertices[:, 1] == y]
        assert section[:, 2].min() == pytest.approx(0.0, abs=3e-4 * CARROT.diameter_at(y))
        assert np.abs(section[:, 0].mean()) < 1e-12
        assert section[:, 2].max() == pytest.approx(CARROT.diameter_at(y), rel=0.01)


def test_the_outline_of_a_tapered_food_converges_with_the_square_of_its_rings():
    D = CARROT.diameter_at(0.0)
    errors = []
    for refinement in (1.0, 2.0, 4.0):
        v = CARROT.mesh(refinement).vertices
        hull = ConvexHull(v[v[:, 1] == 0.0][:, [0, 2]])
        # In two dimensions the hull's "area" is the length of its outline.
        errors.append(hull.area / (np.pi * D) - 1.0)
    assert errors[0] < 5e-3
    ratios = np.array(errors[:-1]) / errors[1:]
    np.testing.assert_allclose(ratios, 4.0, rtol=0.05)


def test_a_pointed_tapered_food_is_refused_with_the_thinnest_end_that_it_can_have():
    with pytest.raises(ConfigurationError, match=r"shape\.diameters\[1\].*too thin.*least 0\.009"):
        validate(Tapered(diameters=[0.03, 0.006]), "shape")


@pytest.mark.parametrize("refinement", [0.5, 1.0, 2.0])
def test_a_half_cylinder_has_the_volume_and_the_sections_of_half_a_cylinder(refinement):
    mesh = HALF.mesh(refinement)
    mesh.check()
    mesh.check_solid()
    exact = section_area(HALF, 0.0)
    assert mesh.volumes().sum() == pytest.approx(exact * HALF.length, rel=1e-12)
    for y in (-0.03, 1e-3, 0.04):
        split = split_mesh(mesh, CutPlane(np.array([0.0, y, 0.0]), np.array([0, 1.0, 0]), UP))
        assert area_of_section(split) == pytest.approx(exact, rel=1e-9)
    # On its flat side, as wide as twice its height.
    v, r = mesh.vertices, HALF.radius
    assert v[:, 2].min() == pytest.approx(0.0, abs=1e-15)
    assert np.ptp(v[v[:, 2] < 1e-12, 0]) == pytest.approx(2.0 * r, rel=0.025)
    assert v[:, 2].max() == pytest.approx(r, rel=0.025)


def quality(mesh: TetrahedralMesh) -> np.ndarray:
    """Volume over that of a regular tetrahedron with the same mean square edge [T]."""
    corners = mesh.vertices[mesh.tetrahedra]
    square = ((corners[:, :, None] - corners[:, None]) ** 2).sum((1, 2, 3)) / 12.0
    return 6.0 * np.sqrt(2.0) * mesh.volumes() / square**1.5


def test_elements_of_a_half_cylinder_are_as_good_as_those_of_a_whole_one():
    whole = Cylinder(2.0 * HALF.radius, HALF.length, HALF.rings, HALF.layers)
    half, full = quality(HALF.mesh()), quality(whole.mesh())
    assert len(full) == 2 * len(half)
    np.testing.assert_allclose(np.sort(np.tile(half, 2)), np.sort(full), rtol=0.05)
    # Beside the cut; the layers behind it are thick.
    assert np.median(half) > 0.1


def test_pressing_through_the_half_cylinder_of_a_scenario_takes_toughness_times_its_area():
    shape = "!HalfCylinder {radius: 0.012, length: 0.06, rings: 4}"
    scenario = load_scenario(
        "cucumber_measured",
        f"{{food: {{shape: {shape}, material: {{friction: 0.0}}, effects: {{}}}}}}",
    )
    assert isinstance(scenario.food, Food)
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    plan = MotionPlan([ConstantSpeed(distance=model.top + 1e-3, speed=0.02)])
    result = simulate_slice(CuttingSolver(model, 2e-3), Motion(plan, start_pose(model, 5e-4)))
    assert result.cut[-1] > 0.999
    needed = scenario.food.material.toughness * 0.5 * np.pi * 0.012**2
    assert result.balance.edge + result.balance.opening == pytest.approx(needed, rel=0.02)


@pytest.mark.parametrize(
    ("tag", "fix"),
    [
        ("!Half_Cylinder", 'Did you mean "!HalfCylinder"'),
        ("!Elipsoid", 'Did you mean "!Ellipsoid"'),
        ("!Plate", "Known: !Cylinder, !HalfCylinder, !Box"),
    ],
)
def test_a_shape_that_is_not_known_is_refused_with_the_one_that_is_meant(tag, fix):
    with pytest.raises(ConfigurationError, match=rf"food\.shape: unknown tag {tag}\. {fix}"):
        load_scenario("cucumber_measured", f"{{food: {{shape: {tag} {{}}}}}}")


def sliced(name: str) -> tuple[SliceSequence, Food]:
    shape = SHAPES[name]
    trim = 0.01 if isinstance(shape, Ellipsoid) else 0.0
    food = Food(name=name, shape=shape, held_sides="plus")
    sequence = SliceSequence(count=4, thickness=6e-3, trim=trim)
    sequence.check_food(food, "scenario")
    return sequence, food


@pytest.mark.parametrize("name", SHAPES)
def test_each_slice_takes_its_volume_from_what_is_left_and_has_its_section(name):
    sequence, food = sliced(name)
    left = []
    for body in (each.shape for each in sequence.foods(food)):
        mesh = body.mesh()
        mesh.check()
        split = split_mesh(mesh, CutPlane(np.zeros(3), np.array([0.0, 1.0, 0.0]), UP))
        exact = section_area(food.shape, body.position)
        assert area_of_section(split) == pytest.approx(exact, rel=1e-9)
        volume = material_volumes(split)
        side = split.node_side[split.tetrahedra[:, 0]]
        left.append((volume[side == 0].sum(), volume[side == 1].sum()))
        ends = (section_area(food.shape, body.position - sequence.thickness), exact)
        # Simpson's rule is exact for sections that are quadratic in y.
        middle = section_area(food.shape, body.position - 0.5 * sequence.thickness)
        slab = sequence.thickness * (ends[0] + 4.0 * middle + ends[1]) / 6.0
        assert left[-1][0] == pytest.approx(slab, rel=5e-3)
    for (_, before), (cut_off, after) in zip(left, left[1:], strict=False):
        assert cut_off + after == pytest.approx(before, rel=5e-3)


def test_slices_of_a_tapered_food_take_toughness_times_their_growing_areas():
    small = Tapered(diameters=[0.010, 0.018], length=0.05, rings=3)
    food = Food(shape=small, held_sides="plus", material=Material(toughness=400.0, friction=0.0))
    sequence = SliceSequence(count=2, thickness=6e-3, slice_layers=1, layers=[4e-3, 12e-3])
    work, area = [], []
    for each in sequence.foods(food):
        model = make_food_model(each, Knife(), Numerics())
        plan = MotionPlan([ConstantSpeed(distance=model.top + 1e-3, speed=0.04)])
        result = simulate_slice(CuttingSolver(model, 2e-3), Motion(plan, start_pose(model, 5e-4)))
        assert result.cut[-1] > 0.999
        work.append(result.balance.edge + result.balance.opening)
        area.append(section_area(small, each.shape.position))
    np.testing.assert_allclose(work, 400.0 * np.array(area), rtol=0.03)
    assert area[1] > 1.1 * area[0]


def test_what_slices_left_can_be_cut_once_more_obliquely():
    remainder = Remainder(SHAPES["tapered"], position=-0.02, thickness=0.008)
    normal = np.array([0.3, 1.0, 0.0])
    mesh: TetrahedralMesh = remainder.mesh()
    split = split_mesh(mesh, CutPlane(np.zeros(3), normal, UP))
    assert material_volumes(split).sum() == pytest.approx(mesh.volumes().sum(), rel=1e-12)
    assert np.unique(bodies(split.tetrahedra)).size == 2


@pytest.mark.parametrize(
    ("divisions", "field"), [([8], "shape.divisions"), ([8, 0], r"shape.divisions\[1\]")]
)
def test_divisions_of_a_box_that_make_no_mesh_are_refused(divisions, field):
    with pytest.raises(ConfigurationError, match=f"{field}: .*Give"):
        validate(Box(divisions=divisions), "shape")
