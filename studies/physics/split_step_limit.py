"""Step limit of cuts by random planes: how far the split lowers it, and through which term.

Each plane through a box, a cylinder or an ellipsoid gives a cutting model; its limit with the true
masses (`CuttingModel.critical_time_step`) is compared with that of the whole, uncut body. Terms are
told apart by computing the limit with the bulk and one of them alone.
"""

import argparse
import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import Numerics, prepare_cut
from studies.figures import ORANGE, add_figure_argument, new_figure, save_figure
from studies.physics.neo_hookean import small_strain_stiffness

BODIES: dict[str, Box | Cylinder | Ellipsoid] = {
    "box": Box(divisions=[4, 4]),
    "cylinder": Cylinder(rings=2),
    "ellipsoid": Ellipsoid(refinements=2),
}
TERMS = ("bond", "flank", "edge", "board")
NONE = 1e-12


def whole_body_limit(mesh: TetrahedralMesh, material: Material, numerics: Numerics) -> float:
    """Gershgorin limit of the uncut mesh, bulk alone, s."""
    x = mesh.vertices[mesh.tetrahedra]
    inverse = np.linalg.inv(np.stack([x[:, k] - x[:, 0] for k in (1, 2, 3)], axis=-1))
    gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)
    volume = mesh.volumes()
    blocks = small_strain_stiffness(gradients, volume, *material.lame())
    norms = np.linalg.norm(blocks, ord=2, axis=(-2, -1)).sum(-1)
    stiffness, mass = np.zeros((2, len(mesh.vertices)))
    np.add.at(stiffness, mesh.tetrahedra, norms)
    np.add.at(mass, mesh.tetrahedra, 0.25 * material.density * volume[:, None])
    stiffness *= 1.0 + 2.0 * numerics.numerical_damping
    return numerics.stability_margin * float(np.sqrt(4.0 * mass / stiffness).min())


def limits(
    mesh: TetrahedralMesh, plane: CutPlane, material: Material, names: tuple[str, ...]
) -> dict[str, float]:
    """Limits of the `names`: "all" terms, "bulk" alone, or the bulk and one of `TERMS`, s."""
    geometry = make_cut_geometry(mesh, plane, held=np.zeros(len(mesh.vertices), bool))
    every = Numerics(mass_scaling=True)
    none = dc.replace(every, bond_stiffness=NONE, flank_length=1.0 / NONE, board_stiffness=NONE)
    soft = dc.replace(material, toughness=0.0)
    cases = {
        "all": (every, material),
        "bulk": (none, soft),
        "bond": (dc.replace(none, bond_stiffness=every.bond_stiffness), soft),
        "flank": (dc.replace(none, flank_length=every.flank_length), soft),
        "edge": (none, material),
        "board": (dc.replace(none, board_stiffness=every.board_stiffness), soft),
    }
    chosen = {name: cases[name] for name in names}
    return {
        name: prepare_cut(geometry, m, Knife(), n).critical_time_step
        for name, (n, m) in chosen.items()
    }


def random_planes(mesh: TetrahedralMesh, count: int, seed: int) -> list[CutPlane]:
    """Planes of any direction through points of the body's bounding box, that meet the body."""
    rng = np.random.default_rng(seed)
    planes: list[CutPlane] = []
    while len(planes) < count:
        normal = rng.normal(size=3)
        point = rng.uniform(mesh.vertices.min(0), mesh.vertices.max(0))
        height = (mesh.vertices - point) @ normal
        if height.min() < 0.0 < height.max():
            planes.append(CutPlane(point, normal, np.cross(normal, rng.normal(size=3))))
    return planes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--planes", type=int, default=1000, help="random planes in total")
    add_figure_argument(parser, "split_step_limit")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    material = Material()

    relative: dict[str, dict[str, np.ndarray]] = {}
    print("Limit relative to the uncut body: least, 1 %, median over the planes")
    for index, (name, shape) in enumerate(BODIES.items()):
        mesh = shape.mesh()
        uncut = whole_body_limit(mesh, material, Numerics())
        middle = CutPlane(mesh.vertices.mean(0), np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1.0]))
        aligned = limits(mesh, middle, material, ("all",))["all"]
        count = (options.planes + len(BODIES) - 1 - index) // len(BODIES)
        planes = random_planes(mesh, count, seed=index)
        rows = [limits(mesh, plane, material, ("all", "bulk")) for plane in planes]
        relative[name] = {key: np.array([row[key] for row in rows]) / uncut for key in rows[0]}
        print(f"{name}: uncut {uncut:.3g} s, aligned plane {aligned / uncut:.2f}, {count} planes")
        for key, values in relative[name].items():
            least, low, median = np.percentile(values, [0.0, 1.0, 50.0])
            print(f"  {key:6s} {least:.3f} {low:.3f} {median:.3f}")
        for worst in np.argsort(relative[name]["all"])[:3]:
            term = limits(mesh, planes[worst], material, TERMS)
            shares = ", ".join(f"{key} {value / uncut:.3f}" for key, value in term.items())
            print(
                f"  plane {worst}: all {relative[name]['all'][worst]:.3f}; with one term: {shares}"
            )

    draw(relative, options.output)
    return 0


def draw(relative: dict[str, dict[str, np.ndarray]], output: Path) -> None:
    """Histogram of the limits: all terms and bulk alone."""
    figure = new_figure(6.4, 3.8)
    axes = figure.subplots()
    bins = np.linspace(0.3, 1.1, 41).tolist()
    styles = {"all": ("0.35", "all terms"), "bulk": (ORANGE, "bulk alone")}
    for key, (colour, label) in styles.items():
        values = np.concatenate([body[key] for body in relative.values()])
        axes.hist(
            values, bins=bins, color=colour, alpha=0.75, label=f"{label}, least {values.min():.2f}"
        )
    axes.set_xlabel("step limit / limit of the uncut body")
    axes.set_ylabel("planes")
    count = sum(len(body["all"]) for body in relative.values())
    axes.set_title(f"Step limit of {count} random cuts, relative to the uncut body")
    axes.legend(loc="upper left")
    save_figure(figure, output, 160)
