"""What an edge does to foods that are soft for their mesh, and what helps.

Presses boxes and cylinders of growing toughness over Young's modulus and edge length: as they are,
with a mesh that is graded towards the cut, and with the edge's force spread in depth; and one food
on finer and finer meshes. Nothing is refused. Takes four minutes.
"""

import argparse
import dataclasses as dc
from collections.abc import Mapping
from pathlib import Path
from time import thread_time

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan, PressAndDraw, Segment
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from studies.figures import BLUE, GREEN, ORANGE, new_figure, save_figure, tidy
from studies.pages import publish, render_and_store

__all__ = ["SoftCut", "add_arguments", "press", "run", "saw"]

PERIOD = 2e-3
SPEED = 0.02
WIDTH, HEIGHT, DIAMETER = 0.024, 0.030, 0.036
MODULUS = 2e5
SOFTNESS = (0.45, 0.67, 1.0)
"""Toughness over Young's modulus and mean edge length of the mesh that is not graded, R / (E h)."""
SPACINGS = (5e-3, 3e-3, 2e-3)
VARIANTS = ("as it is", "graded", "spread")
PART = (0.35, 0.85)
"""Part of the height in which the force is compared with its trend."""
EVERY = 10
"""Coupling steps between two looks at the elements."""
FINEST = 1.5e-3
AMPLITUDES = (3e-4, 5e-3)
"""Of sawing, metres."""
SHOWN = ("box", 3e-3, 0.67, MODULUS)
"""Kind, spacing, R / (E h) and modulus of the press that is drawn."""
LENGTH = 3e-3
"""R / E of the food on finer and finer meshes, metres."""


@dc.dataclass
class SoftCut:
    """What came of one press.

    Attributes:
        elements: That are computed.
        size: Their mean edge length, metres.
        toughness: R, J/m^2.
        ripple: Greatest deviation of the edge's force from its trend over its mean.
        work: Of the edge over R A.
        least_volume_ratio: Of all elements at all times.
        seconds: Processor time.
        depth, force: Of the edge below the top, metres, and vertical on the knife, N.
    """

    elements: int
    size: float
    toughness: float
    ripple: float
    work: float
    least_volume_ratio: float
    seconds: float
    depth: list[float]
    force: list[float]


def _food(kind: str, spacing: float, toughness: float, modulus: float, graded: bool) -> Food:
    layers = [0.0, spacing, 3.0 * spacing]
    if graded:
        layers = [0.0, 0.25 * spacing, 0.5 * spacing, spacing, 2.0 * spacing, 3.0 * spacing]
    box = Box([WIDTH, 0.1, HEIGHT], [round(WIDTH / spacing), round(HEIGHT / spacing)], layers)
    cylinder = Cylinder(DIAMETER, 0.1, round(0.5 * DIAMETER / spacing), layers)
    material = Material(youngs_modulus=modulus, toughness=toughness, friction=0.0)
    return Food(shape=box if kind == "box" else cylinder, material=material)


def press(
    kind: str,
    spacing: float,
    variant: str,
    softness: float = 0.0,
    modulus: float = MODULUS,
    length: float = 0.0,
) -> SoftCut | None:
    """A press through a food with a blade that is too thin to wedge it open.

    Args:
        kind: "box" or "cylinder".
        spacing: Of the mesh in the section, metres.
        variant: Of `VARIANTS`.
        softness: R / (E h), or 0.
        modulus: Young's modulus, Pa.
        length: R / E where `softness` is 0, metres.

    Returns:
        None if the force is not finite any more.
    """
    knife = Knife(length=0.4, spine_thickness=4e-4)
    if softness > 0.0:
        plain = make_food_model(_food(kind, spacing, 300.0, modulus, False), knife, Numerics())
        length = softness * plain.element_size
    numerics = Numerics(edge_spread=2.0 * length if variant == "spread" else 0.0)
    food = _food(kind, spacing, length * modulus, modulus, variant == "graded")
    model = make_food_model(food, knife, numerics)
    down = ConstantSpeed(distance=model.top - model.bottom + 8e-3, speed=SPEED)
    return _cut(model, down, 3 if kind == "box" else 5)


def _cut(model: CuttingModel, segment: Segment, degree: int) -> SoftCut | None:
    """A cut along one segment, and a polynomial trend of `degree`."""
    height = model.top - model.bottom
    path = KnifePath(model, Motion(MotionPlan([segment]), start_pose(model, 5e-4)), PERIOD)
    solver = CuttingSolver(model, PERIOD)
    solver.compile()
    state, began = solver.initial_state(), thread_time()
    least, work, vertical = 1.0, 0.0, []
    for k in range(path.coupling_steps):
        try:
            step = solver.coupling_step(state, path.pose(k), path.pose(k + 1))
        except CuttingError:
            return None
        state = step.state
        work += step.balance.edge
        vertical.append(step.wrenches.reshape(3, 2, 3)[:, 1, 2])
        if k % EVERY == 0:
            ratio = solver.energies(state, path.pose(k + 1)).least_volume_ratio
            least = min(least, ratio)
    seconds = thread_time() - began
    force = np.array(vertical)
    depth = path.p_FK[0, 2] - path.p_FK[1:, 2] - 5e-4
    rows = (depth > PART[0] * height) & (depth < PART[1] * height)
    trend = np.polyfit(depth[rows], force[rows, 0], degree)
    rest = force[rows, 0] - np.polyval(trend, depth[rows])
    return SoftCut(
        model.element_count,
        model.element_size,
        model.material.toughness,
        float(np.abs(rest).max() / force[rows, 0].mean()),
        work / model.work_through,
        least,
        seconds,
        depth.tolist(),
        force.sum(1).tolist(),
    )


def saw(length: float, amplitude: float, ratio: float, numerics: Numerics) -> list[str]:
    """Sawing through a box of 0.2 MPa, pressing at 5 mm/s.

    Args:
        length: R / E, metres.
        amplitude: Of the strokes, metres.
        ratio: Greatest draw ratio.
        numerics: Of the cut.

    Returns:
        Vertical force of the edge over that of a stiff food, and work over R A.
    """
    food = _food("box", SPACINGS[0], length * MODULUS, MODULUS, False)
    model = make_food_model(food, Knife(length=0.4, spine_thickness=4e-4), numerics)
    speed = 5e-3
    frequency = ratio * speed / (2.0 * np.pi * amplitude)
    strokes = PressAndDraw(speed, HEIGHT + 6e-3, amplitude=amplitude, frequency=frequency)
    cut = _cut(model, strokes, 3)
    if cut is None:
        return ["-", "-"]
    depth, force = np.array(cut.depth) / HEIGHT, np.array(cut.force)
    mean = force[(depth > PART[0]) & (depth < PART[1])].mean()
    draw = ratio * np.cos(np.linspace(0.0, np.pi, 2001))
    exact = length * MODULUS * WIDTH * (1.0 / (1.0 + draw**2)).mean()
    return [f"{mean / exact:.2f}", f"{cut.work:.3f}"]


def _cell(cut: SoftCut | None) -> str:
    if cut is None:
        return "breaks down"
    return (
        f"{100 * cut.ripple:.1f} %, {cut.work:.3f}, {cut.least_volume_ratio:.2f}, "
        f"{cut.seconds:.1f} s"
    )


def _error(coarse: SoftCut | None, fine: SoftCut | None) -> str:
    """RMS difference of the forces over that of the fine mesh's, where the edge is in the food."""
    if coarse is None or fine is None:
        return "-"
    depth, force = np.array(fine.depth), np.array(fine.force)
    inside = depth > 0.0
    difference = np.interp(depth, coarse.depth, coarse.force) - force
    return f"{100 * np.sqrt((difference[inside] ** 2).mean() / (force[inside] ** 2).mean()):.1f} %"


def _figure(cuts: Mapping[str, SoftCut | None]) -> Figure:
    figure = new_figure(7.5, 3.2)
    axes = figure.subplots()
    for (name, cut), colour in zip(cuts.items(), (ORANGE, GREEN, BLUE), strict=True):
        if cut is not None:
            axes.axhline(cut.toughness * WIDTH, color="k", lw=0.8, ls="--")
            axes.plot(1e3 * np.array(cut.depth), cut.force, color=colour, lw=1.2, label=name)
    axes.set(xlabel="depth of the edge [mm]", ylabel="force on the knife [N]")
    axes.legend(frameon=False, fontsize=9)
    tidy(axes, "dashed: toughness times width")
    return figure


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FILE", type=Path, help="page to write; none by default"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    kinds = ("box", "cylinder")
    cases = [(kind, d, s, MODULUS) for kind in kinds for d in SPACINGS[:2] for s in SOFTNESS]
    cases += [(kind, 3e-3, 0.67, modulus) for kind in kinds for modulus in (1e5, 1e7)]
    rows, finer, stored = [], [], []
    shown: dict[str, SoftCut | None] = {}
    for kind, spacing, softness, modulus in tqdm(cases):
        cuts = [press(kind, spacing, variant, softness, modulus) for variant in VARIANTS]
        name = f"{kind}, {1e3 * spacing:g} mm, {1e-6 * modulus:g} MPa"
        rows.append([name, f"{softness:g}", *map(_cell, cuts)])
        if (kind, spacing, softness, modulus) == SHOWN:
            shown = dict(zip(VARIANTS, cuts, strict=True))
        stored += cuts
    for kind in kinds:
        finest = press(kind, FINEST, "spread", length=LENGTH)
        finer.append([f"{kind}, spread, {1e3 * FINEST:g} mm", "-", _cell(finest)])
        for variant in ("as it is", "spread"):
            for spacing in SPACINGS[::-1]:
                cut = press(kind, spacing, variant, length=LENGTH)
                name = f"{kind}, {variant}, {1e3 * spacing:g} mm"
                finer.append([name, _error(cut, finest), _cell(cut)])
                stored.append(cut)
        stored.append(finest)
    sawn = [
        [
            *(f"{1e3 * length:g}", f"{1e3 * amplitude:g}", f"{ratio:g}"),
            *saw(length, amplitude, ratio, Numerics()),
            *saw(length, amplitude, ratio, Numerics(direction_length=2e-5)),
            *saw(length, amplitude, ratio, Numerics(edge_spread=2.0 * length)),
        ]
        for length in (3e-5, 1.5e-4, 5e-4, 1.5e-3, 3e-3, 5e-3)
        for amplitude in AMPLITUDES
        for ratio in (1.0, 2.0, 5.0)
    ]
    if options.output is not None:
        save_figure(_figure(shown), options.output.parent / "figures" / "soft_foods.png", dpi=100)
    values = {"rows": rows, "finer": finer, "sawn": sawn}
    raw = [cut and dc.replace(cut, depth=[], force=[]) for cut in stored]
    publish(render_and_store("soft_foods", options.output, values, raw), options.output)
    return 0
