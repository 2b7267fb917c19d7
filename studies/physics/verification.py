"""All checks of the verification as plain numbers; docs/results/verification.md shows them."""

import dataclasses as dc
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.material import Material
from studies.physics import bulk_checks as bulk
from studies.physics import contact_checks, convergence
from studies.physics.measured_curves import MeasuredCut, MeasuredFood, cut_measured_food
from studies.results import plain

__all__ = [
    "CHECKS",
    "EDGE_CASES",
    "FRICTION_CASES",
    "Limit",
    "cucumber",
    "food_numbers",
    "limits",
    "run_verification",
]

EDGE_CASES = ((0, 0.0), (0, 3.0), (1, 0.0), (1, 1.0), (1, 3.0), (2, 0.0), (2, 3.0))
"""Mesh and draw ratio."""
FRICTION_CASES = ((4, 0.2, 0.0), (4, 0.2, 1.0), (8, 0.2, 0.0), (8, 0.2, 1.0))
"""Elements across the width, friction and draw ratio."""
REFINEMENTS = (0.5, 1.0, 2.0, 3.0)
DIVISORS = (1, 2, 4, 8, 32)
BEAM = (2, 4, 8)
DEPTH = 0.0265
COARSE = 0.5
"""Refinement of the first food's cut that a test repeats."""
REFERENCES = ("DiSECt", "spring")
"""Curves beside the measured one that its record holds, both by the paper's authors."""

CHECKS = 4 + len(EDGE_CASES) + len(FRICTION_CASES) + len(REFINEMENTS) + len(DIVISORS)
"""How often `run_verification` reports progress, besides once a food."""


def cucumber() -> Food:
    """The food whose whole cut is refined: that of scenarios/cucumber_measured.yaml."""
    return Food(material=Material(toughness=400.0, friction=0.05))


def run_verification(
    foods: list[MeasuredFood], progress: Callable[[], None] = lambda: None
) -> tuple[dict[str, Any], list[MeasuredCut]]:
    """Computes every number.

    Args:
        foods: To cut as they were measured.
        progress: Called after each of `CHECKS` parts and after each food.

    Returns:
        Results by check, of numbers, strings, lists and dictionaries, to six digits; and the cuts
        of `foods`.

    Raises:
        CuttingError: A food cannot be cut.
    """
    results = _check_physics(progress)
    results["coarse"] = food_numbers(foods[0], cut_measured_food(foods[0], COARSE))
    results["foods"] = []
    cuts = []
    for case in foods:
        cut = cut_measured_food(case)
        results["foods"].append(food_numbers(case, cut))
        cuts.append(cut)
        progress()
    return results, cuts


def _check_physics(progress: Callable[[], None]) -> dict[str, Any]:
    """The results that need no measured food; see `run_verification`."""

    def done(result: Any) -> Any:
        progress()
        if isinstance(result, list):
            return [dc.asdict(r) for r in result]
        return dc.asdict(result)

    results = {
        "patch": done(bulk.check_patch()),
        "beam": done(bulk.check_beam(BEAM)),
        "edge": [done(contact_checks.check_edge(*case)) for case in EDGE_CASES],
        "friction": [done(contact_checks.check_friction(*case)) for case in FRICTION_CASES],
        "hold": done(contact_checks.check_hold()),
        "gradient": done(contact_checks.check_gradient()),
        "mesh": dc.asdict(convergence.refine_mesh(cucumber(), DEPTH, REFINEMENTS, progress)),
        "step": dc.asdict(convergence.refine_step(cucumber(), DEPTH, DIVISORS, progress)),
    }
    numbers: dict[str, Any] = plain(results)
    return numbers


def food_numbers(case: MeasuredFood, cut: MeasuredCut) -> dict[str, Any]:
    """Parameters, curves and energy balance of one food.

    Each curve has its RMS error [N], peak [N] and apparent work [J/m^2]: force over travel through
    the whole record, over the whole round section.
    """
    profile, comparison = cut.profile, cut.comparison
    curves = {
        "measured": profile.force,
        **{name: profile.references[name] for name in REFERENCES},
        "ours": comparison.simulated,
    }
    speed = case.measurement.speed
    material = case.food.material
    budget = convergence.cut_budget(cut.result, cut.model.section_area, cut.model.element_count)
    numbers = {
        "name": case.food.name,
        "toughness": material.toughness,
        "youngs_modulus": material.youngs_modulus,
        "friction": material.friction,
        "skin": case.food.effects.skin.toughness,
        "contact_time": comparison.contact_time,
        "softness": material.toughness / (material.youngs_modulus * cut.model.element_size),
        "curves": {
            name: {
                "rms": float(np.sqrt(np.mean((force - profile.force) ** 2))),
                "peak": float(force.max()),
                "work": float(np.trapezoid(force, profile.time)) * speed / case.section,
            }
            for name, force in curves.items()
        },
        "budget": dc.asdict(budget),
    }
    rounded: dict[str, Any] = plain(numbers)
    return rounded


@dc.dataclass
class Limit:
    """A number that must not exceed a bound.

    Attributes:
        what: In words.
        value: Found.
        bound: Most that is accepted.
    """

    what: str
    value: float
    bound: float

    @property
    def holds(self) -> bool:
        """Whether the value is within the bound; not a number is not."""
        return self.value <= self.bound


def limits(results: Mapping[str, Any]) -> list[Limit]:
    """What the results must satisfy."""

    def off(rows: list[dict[str, Any]], *names: str) -> float:
        return max(abs(row[n] - 1.0) for row in rows for n in names if row[n] is not None)

    patch, edge, friction = results["patch"], results["edge"], results["friction"]
    finest = max(row["divisions"] for row in friction)
    fine = [row for row in friction if row["divisions"] == finest]
    parts = ("inside", "surface", "rigid", "one_body")
    mesh, step = results["mesh"], results["step"]
    default = mesh["size"].index(1.0)
    out = [
        Limit(
            "patch tests: force where it should be zero",
            max(r[p] for r in patch for p in parts),
            1e-9,
        ),
        Limit(
            "cantilever: 2 minus the order of convergence", 2.0 - results["beam"]["order"][-1], 0.5
        ),
        Limit("cantilever: error on the finest mesh", abs(results["beam"]["ratio"][-1] - 1.0), 0.1),
        Limit("edge: force against Atkins", off(edge, "vertical", "along"), 0.02),
        Limit("edge: ripple", max(row["ripple"] for row in edge), 0.05),
        Limit("edge: work against R A", off(edge, "work"), 0.02),
        Limit("flanks: friction of the wedge, finer mesh", off(fine, "vertical", "along"), 0.02),
        Limit("hold: drift of the force", abs(results["hold"]["drift"]), 0.01),
        Limit("hold: creep [m/s]", results["hold"]["creep"], 1e-6),
        Limit("gradients: adjoint against differences", results["gradient"]["largest"], 1e-4),
        Limit("mesh: error of the default, estimated", mesh["estimate"], 0.03),
        Limit("mesh: error of the default against the finest", mesh["error"][default], 0.03),
        Limit("step: error of the default, estimated", step["estimate"], 0.02),
    ]
    for food in results["foods"]:
        imbalance = abs(food["budget"]["imbalance"])
        out.append(Limit(f"{food['name']}: energy imbalance of the whole cut", imbalance, 0.02))
    return out
