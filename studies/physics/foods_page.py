"""Tables of foods and knives, for docs/reference/foods.md.

Foods and knives are read from calibration/foods and calibration/knives. --cut presses knives
through foods as well, without a robot, and --hold a knife through foods that are held at several
distances, each of which takes a minute. --output puts the tables into a Markdown file, and the
picture of --hold into docs/figures. The tables go between lines such as
  <!-- foods -->
  <!-- end of foods -->
"""

import argparse
import dataclasses as dc
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid
from sliceit_drake.cutting.knife import Knife, load_knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path, shipped_names
from studies.figures import BLUE, ORANGE, new_figure, save_guide_figures, tidy
from studies.marked_page import Place
from studies.pages import table

__all__ = [
    "HoldCut",
    "add_arguments",
    "cut_rows",
    "foods_table",
    "hold_cuts",
    "holds_figure",
    "knives_table",
    "run",
]

PERIOD, SPEED, CLEARANCE = 2e-3, 0.02, 1e-3
END = 5e-4
"""Way of the edge above the board over which the end force is the mean, metres."""
HELD_FOODS = {
    "cucumber": "{calibration: cucumber}",
    "plum tomato": "{calibration: tomato, food: {shape: !Ellipsoid {diameters: [0.048, 0.1, 0.048],"
    " refinements: 3}}}",
}
"""What the scenario cucumber_measured is changed to."""
HOLDS = [("none", 0.0)] + [(sides, d) for sides in ("plus", "both") for d in (0.012, 0.02, 0.04)]
HELD = {"none": "not held", "plus": "one side", "both": "both sides"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--cut", action="store_true", help="press knives through foods too")
    parser.add_argument("--hold", action="store_true", help="hold foods at several distances too")
    parser.add_argument("--output", type=Path, metavar="FILE", help="page to write into")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    cuts, holds = Place("cuts"), Place("holds")
    if options.cut:
        cuts.check(options.output)
    if options.hold:
        holds.check(options.output)
    for name, text in {"foods": foods_table(), "knives": knives_table()}.items():
        Place(name).show(options.output, text)
    if options.cut:
        cuts.publish(options.output, rows=cut_rows(), speed=SPEED, command=options.command)
    if options.hold:
        found = hold_cuts()
        rows = [cut.row() for cut in found]
        holds.publish(options.output, rows=rows, speed=SPEED, command=options.command)
        if options.output is not None:
            save_guide_figures({"holds": functools.partial(holds_figure, found)})
    return 0


def shape(food: Food) -> str:
    """Name and size of a food's shape, mm."""
    body = food.shape
    if isinstance(body, Cylinder):
        size = [body.diameter, body.length]
    elif isinstance(body, Box):
        size = body.size
    else:
        assert isinstance(body, Ellipsoid)
        size = body.diameters
    return f"{type(body).__name__.lower()} {' x '.join(f'{1e3 * s:.3g}' for s in size)}"


def foods_table() -> str:
    rows, notes = [], []
    for name in shipped_names("calibration/foods"):
        entry = load_calibrated_food(name)
        material = entry.food.material
        recorded = entry.rms_error is not None
        error = f"{entry.rms_error:.2f} N, {entry.held_out_error:.2f} N" if recorded else "unknown"
        rows.append(
            (
                name,
                shape(entry.food),
                f"{1e-6 * material.youngs_modulus:.3g}",
                material.poisson_ratio,
                f"{material.density:.0f}",
                f"{material.toughness:.0f}",
                f"{material.friction:.3g}",
                "a measured cut" if recorded else "**published values**",
                error,
            )
        )
        if not recorded:
            sources = "".join(f"\n  - {source}" for source in entry.records)
            notes.append(f"- **{name}**: {entry.note} Sources:{sources}")
    legend = "R: toughness. mu: friction on the blade. Error: RMS on the record, and held out."
    head = "food | shape [mm] | E [MPa] | nu | kg/m3 | R [J/m2] | mu | from | error"
    return "\n".join([table(head, rows), "", legend, "", *notes])


def knives_table() -> str:
    rows, notes = [], []
    for name in shipped_names("calibration/knives"):
        entry = load_knife(name)
        knife = entry.knife
        rows.append(
            (
                name,
                f"{1e3 * knife.spine_thickness:.3g}",
                f"{1e3 * knife.edge_thickness:.2g}",
                f"{1e3 * (knife.height + knife.tip_height):.3g}",
                f"{1e3 * knife.length:.3g}",
                f"{bevel(knife):.0f}",
            )
        )
        by_text: dict[str, list[str]] = {}
        for field, text in entry.sources.items():
            by_text.setdefault(text, []).append(field)
        sources = "".join(f"\n  - {', '.join(f)}: {text}" for text, f in by_text.items())
        notes.append(f"- **{name}**: {entry.note or 'one knife.'}{sources}")
    edge = "Edge: thickness where the bevel begins. Height: from the edge to the spine."
    head = "knife | spine [mm] | edge [mm] | height [mm] | length [mm] | degrees a side"
    return "\n".join([table(head, rows), "", edge, "", *notes])


def bevel(knife: Knife) -> float:
    """Angle of the edge's bevel to the blade, degrees."""
    return float(np.degrees(np.arctan2(0.5 * knife.edge_thickness, knife.tip_height)))


def cut_rows() -> list[tuple[str, ...]]:
    """What each knife does in foods that are held on one side and on both."""
    rows: list[tuple[str, ...]] = []
    for name in ("cucumber_measured", "cucumber_end_slice", "apple"):
        scenario = load_scenario(resource_path(f"scenarios/{name}.yaml"))
        food = scenario.food
        assert isinstance(food, Food)
        for sides in (food.held_sides,) if name != "apple" else ("plus", "both"):
            rows += _cuts(dc.replace(food, held_sides=sides), scenario.numerics)
    return rows


def _cuts(food: Food, numerics: Numerics) -> Sequence[tuple[str, ...]]:
    rows = []
    for name in shipped_names("calibration/knives"):
        knife = load_knife(name).knife
        model = make_food_model(food, knife, numerics)
        if knife.height < model.top - model.bottom:
            continue
        result = _pressed_through(model)
        force = np.linalg.norm(result.food_wrench[:, 3:], axis=1).max()
        work = result.balance.work
        held = "on both sides" if food.held_sides == "both" else "on one side"
        share = 100.0 * result.balance.friction / work
        cells = (f"{force:.1f}", f"{work / model.section_area:.0f}", f"{share:.0f} %")
        rows.append((food.name, held, name, *cells))
    return rows


def _pressed_through(model: CuttingModel) -> SliceResult:
    plan = MotionPlan([ConstantSpeed(distance=model.top + CLEARANCE, speed=SPEED)])
    motion = Motion(plan, start_pose(model, CLEARANCE))
    return simulate_slice(CuttingSolver(model, PERIOD), motion)


@dc.dataclass
class HoldCut:
    """A food that is held somewhere, pressed through.

    Attributes:
        food: Its name.
        sides, distance: `Food.held_sides`, and `Food.hold_distance`, metres.
        depth: Depth of the edge below the top of the food [n], metres.
        force: Vertical force of the food on the knife [n], N.
        ahead: How far the edge is below what is cut, in the shape at rest [n], metres.
        work: Of the knife, J.
    """

    food: str
    sides: str
    distance: float
    depth: np.ndarray
    force: np.ndarray
    ahead: np.ndarray
    work: float

    def row(self) -> tuple[str, ...]:
        """Cells of the table."""
        where = "" if self.sides == "none" else f", from {1e3 * self.distance:g} mm on"
        end = self.force[self.depth > self.depth[-1] - END].mean()
        values = f"{self.force.max():.1f}", f"{end:.1f}", f"{self.work:.3f}"
        return self.food, HELD[self.sides] + where, *values, f"{1e3 * self.ahead.max():.1f}"


def hold_cuts() -> list[HoldCut]:
    """A stiff and a soft food, held on no, one and both sides, near the cut and far from it."""
    found = []
    for name, changes in HELD_FOODS.items():
        scenario = load_scenario("cucumber_measured", changes)
        assert isinstance(scenario.food, Food)
        for sides, distance in HOLDS:
            food = dc.replace(scenario.food, held_sides=sides, hold_distance=distance)
            model = make_food_model(food, scenario.knife, scenario.numerics)
            result = _pressed_through(model)
            depth = model.top - result.position[:, 2]
            ahead = np.where(depth > 0.0, depth - _cut_depth(model, result.cut), 0.0)
            # Past the last cut point nothing is left to be ahead of.
            ahead[result.cut > 0.98] = 0.0
            force = result.food_wrench[:, 5]
            work = result.balance.work
            found.append(HoldCut(name, sides, distance, depth, force, ahead, work))
    return found


def _cut_depth(model: CuttingModel, cut: np.ndarray) -> np.ndarray:
    """Depth in the section at rest above which fractions [n] of it lie [n], metres."""
    tables, points = model.tables, model.split.points[:, 2]
    grid = np.linspace(-tables.reach, tables.reach, tables.width.shape[1])
    depth = np.linspace(0.0, model.top - model.bottom, 400)
    rows = zip(points, tables.fraction, tables.area, strict=True)
    above = sum(a * np.interp(z - model.top + depth, grid, row) for z, row, a in rows)
    return np.interp(cut, above / model.section_area, depth)


def holds_figure(cuts: Sequence[HoldCut]) -> Figure:
    """Force over depth of each food, by sides and distance."""
    figure = new_figure(9.6, 3.8)
    colours = {"none": "0.35", "plus": ORANGE, "both": BLUE}
    styles = {0.0: "-", 0.012: "-", 0.02: "--", 0.04: ":"}
    names = list(dict.fromkeys(cut.food for cut in cuts))
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for cut in (cut for cut in cuts if cut.food == name):
            where = "" if cut.sides == "none" else f", {1e3 * cut.distance:g} mm"
            style = {"color": colours[cut.sides], "ls": styles[cut.distance], "lw": 1.5}
            axes.plot(1e3 * cut.depth, cut.force, label=HELD[cut.sides] + where, **style)
        tidy(axes, name)
        axes.set(xlabel="depth of the edge [mm]", ylabel="force on the knife [N]", xlim=(0.0, None))
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, title="held from")
    return figure
