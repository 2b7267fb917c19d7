"""Tables of foods and knives, for docs/reference/foods.md.

Foods and knives are read from calibration/foods and calibration/knives. --cut presses knives
through foods as well, without a robot, which takes a minute. --output puts the tables into a
Markdown file, between lines such as
  <!-- foods -->
  <!-- end of foods -->
"""

import argparse
import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid
from sliceit_drake.cutting.knife import Knife, load_knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path, shipped_names
from studies.marked_page import Place
from studies.pages import table

__all__ = ["add_arguments", "cut_rows", "foods_table", "knives_table", "run"]

PERIOD, SPEED, CLEARANCE = 2e-3, 0.02, 1e-3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--cut", action="store_true", help="press knives through foods too")
    parser.add_argument("--output", type=Path, metavar="FILE", help="page to write into")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    cuts = Place("cuts")
    if options.cut:
        cuts.check(options.output)
    for name, text in {"foods": foods_table(), "knives": knives_table()}.items():
        Place(name).show(options.output, text)
    if options.cut:
        cuts.publish(options.output, rows=cut_rows(), speed=SPEED, command=options.command)
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
        plan = MotionPlan([ConstantSpeed(distance=model.top + CLEARANCE, speed=SPEED)])
        motion = Motion(plan, start_pose(model, CLEARANCE))
        result = simulate_slice(CuttingSolver(model, PERIOD), motion)
        force = np.linalg.norm(result.food_wrench[:, 3:], axis=1).max()
        work = result.balance.work
        held = "on both sides" if food.held_sides == "both" else "on one side"
        share = 100.0 * result.balance.friction / work
        cells = (f"{force:.1f}", f"{work / model.section_area:.0f}", f"{share:.0f} %")
        rows.append((food.name, held, name, *cells))
    return rows
