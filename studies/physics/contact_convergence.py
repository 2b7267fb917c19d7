"""How far the force depends on the stiffness of the flanks' contact, and on the mesh at that
stiffness.

Presses of a cucumber and of a soft food, held on both sides of the cut and on one: as by default,
with a contact four and sixteen times as stiff, and with elements half as long at the same contact.
Takes two minutes.
"""

import argparse
import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from studies.pages import publish, render_and_store

__all__ = ["ContactForce", "add_arguments", "contact_force", "foods", "run", "table_rows"]

PERIOD = 2e-3
STEP = 2e-4
"""Longest sub-step, s: a stiff contact adds inertia, which is not what is asked here."""
DEPTH = (0.4, 0.7)
"""Part of the height over which forces are averaged."""
VARIANTS = ((1.0, 1.0), (4.0, 1.0), (16.0, 1.0), (1.0, 2.0))
"""Stiffness of the contact and elements along an edge, relative to the default."""


@dc.dataclass
class ContactForce:
    """Mean vertical force over `DEPTH`.

    Attributes:
        food, held: Name and held sides.
        stiffness, refinement: See `VARIANTS`.
        elements: That are computed.
        friction, total: Of the flanks, and with all else, N.
    """

    food: str
    held: str
    stiffness: float
    refinement: float
    elements: int
    friction: float
    total: float


def foods() -> list[Food]:
    """A cucumber and a soft fruit, on which the flanks' friction is a third to half of all."""
    return [
        Food(
            name="cucumber",
            shape=Cylinder(),
            material=Material(youngs_modulus=6e5, toughness=240.0, friction=0.3),
        ),
        Food(
            name="soft",
            shape=Cylinder(diameter=0.048, length=0.05),
            material=Material(youngs_modulus=2e5, poisson_ratio=0.3, toughness=200.0, friction=0.3),
        ),
    ]


def contact_force(food: Food, stiffness: float = 1.0, refinement: float = 1.0) -> ContactForce:
    """The force of a press at 20 mm/s to the end of `DEPTH`; see `ContactForce`."""
    numerics = Numerics(time_step=STEP)
    numerics.flank_length /= stiffness
    model = make_food_model(food, Knife(), numerics, refinement)
    height = model.top - model.bottom
    plan = MotionPlan([ConstantSpeed(distance=DEPTH[1] * height + 5e-4, speed=0.02)])
    motion = Motion(plan, start_pose(model, clearance=5e-4))
    result = simulate_slice(CuttingSolver(model, PERIOD), motion)
    depth = result.position[0, 2] - 5e-4 - result.position[:, 2]
    counts = depth > DEPTH[0] * height
    return ContactForce(
        food.name,
        food.held_sides,
        stiffness,
        refinement,
        model.element_count,
        float(result.friction[counts, 2].mean()),
        float(result.food_wrench[counts, 5].mean()),
    )


def table_rows(found: Sequence[ContactForce]) -> list[list[str]]:
    """Rows of the table, all variants of a food in one."""
    rows = []
    for first in range(0, len(found), len(VARIANTS)):
        default, *others = found[first : first + len(VARIANTS)]
        rows.append(
            [
                f"{default.food}, {default.held}",
                f"{default.total:.2f} ({default.friction:.2f})",
                *(
                    f"{100 * (each.total / default.total - 1):+.1f} % "
                    f"({100 * (each.friction / default.friction - 1):+.1f} %)"
                    for each in others
                ),
            ]
        )
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        help="page to write; none by default",
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    cases = [dc.replace(food, held_sides=held) for food in foods() for held in ("both", "plus")]
    found = [
        contact_force(food, *variant)
        for food, variant in tqdm([(food, v) for food in cases for v in VARIANTS])
    ]
    values = {"rows": table_rows(found)}
    publish(render_and_store("contact", options.output, values, found), options.output)
    return 0
