"""DiSECt's reference case and its curves of the measured cuts, beside ours in both measures."""

import dataclasses as dc
import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from sliceit_drake.cutting.foods.effects import Edge, Effects
from sliceit_drake.cutting.foods.food import make_food_model
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.diagrams.outputs.measurement_comparison import compare_with_measurement
from studies.disect import case as disect
from studies.disect.case import Case, CaseResult, Reference, ReferenceRun
from studies.disect.contact_sums import contact_sums
from studies.physics.measured_curves import MeasuredFood
from studies.simulated_profiles import SimulatedProfile

__all__ = ["STEPS", "Curve", "Difference", "DisectStudy", "MeasuredCurves", "disect_study"]

STEPS = 20
"""How often `disect_study` reports progress, besides once a food."""
FINER = 3
MASS = 51.7e-3
"""Mass that moves in DiSECt's reference case, kg."""
SLAB_MASS = 18.5e-3
"""Mass of the food that moves there, kg."""
FLANK_RANGE = (0.01, 4.0)
"""Range of the contact stiffness that is fitted to DiSECt's curves, E/h."""
PERIOD = 5e-3


@dc.dataclass
class Difference:
    """A difference between the models.

    Attributes:
        what, disect, here, reason: In words.
        effect: Its size, in words and numbers.
    """

    what: str
    disect: str
    here: str
    reason: str
    effect: str


@dc.dataclass
class Curve:
    """A force over the time of a measured cut [n], N."""

    name: str
    measure: str
    force: np.ndarray


@dc.dataclass
class MeasuredCurves:
    """One measured cut.

    Attributes:
        food: Its name.
        profile: The record.
        speed: Of the knife, m/s.
        curves: Measured, DiSECt's, ours in both measures, the opening law's in both.
        flank_stiffness: That brings the opening law's sum of norms nearest to DiSECt's, E/h.
    """

    food: str
    profile: SimulatedProfile
    speed: float
    curves: list[Curve]
    flank_stiffness: float


@dc.dataclass
class DisectStudy:
    """All results.

    Attributes:
        reference: DiSECt's numbers.
        contact_stiffness: That gives the nominal run's last sum of norms, N/m a spring.
        runs: DiSECt's runs and ours of them, with its double volume at the cut.
        delays: Of the springs' break in these runs by the law of `break_opening`, s.
        laws: Toughness [J/m2] and strength [Pa] of the springs in these runs.
        opening, full: The two variants of the case.
        differences: Between the models.
        measured: The measured cuts.
    """

    reference: Reference
    contact_stiffness: float
    runs: list[tuple[ReferenceRun, CaseResult]]
    delays: list[float]
    laws: list[tuple[float, float]]
    opening: CaseResult
    full: CaseResult
    differences: list[Difference]
    measured: list[MeasuredCurves]


def disect_study(
    foods: list[MeasuredFood], progress: Callable[[], object] = lambda: None
) -> DisectStudy:
    """Runs everything.

    Args:
        foods: Of the measured cuts.
        progress: Called after each run of the case and after each food.

    Raises:
        CuttingError: A cut became unphysical.
    """

    def run(case: Case, whole_copies: bool = False) -> CaseResult:
        result = disect.run_case(case, whole_copies)
        progress()
        return result

    reference = disect.load_reference()
    springs, nominal = reference.springs, reference.runs[0]
    opening_case, full_case = (disect.load_case(name) for name in ("opening_alone", "full_model"))
    first = run(opening_case, True)
    fit = _contact_stiffness(opening_case, reference, first, run)
    runs, delays, laws = [], [], []
    for other in reference.runs:
        delay, opened = disect.break_opening(springs, nominal, other, first.offset, first.slope)
        case = disect.as_run(opening_case, springs, nominal, other, first)
        runs.append((other, run(case, True)))
        delays.append(delay)
        laws.append(disect.opening_law(springs, opened, other.spring_factor))
    opening, full = run(opening_case), run(full_case)
    differences = _differences(reference, opening_case, full_case, opening, full, laws, run)
    measured = []
    for food in foods:
        measured.append(_measured_curves(food, reference))
        progress()
    return DisectStudy(reference, fit, runs, delays, laws, opening, full, differences, measured)


def _contact_stiffness(
    case: Case, reference: Reference, first: CaseResult, run: Callable[[Case, bool], CaseResult]
) -> float:
    """By one secant of log force over log stiffness from the given one, N/m a spring."""
    target = reference.runs[0].sum_end
    assert target is not None
    step = 1.1
    other = run(disect.with_contact(case, step), True)
    power = math.log(other.norms[-1] / first.norms[-1]) / math.log(step)
    ratio = (target / float(first.norms[-1])) ** (1.0 / power)
    return reference.springs.contact_stiffness * ratio


def _differences(
    reference: Reference,
    case: Case,
    full_case: Case,
    opening: CaseResult,
    full: CaseResult,
    laws: list[tuple[float, float]],
    run: Callable[..., CaseResult],
) -> list[Difference]:
    springs = reference.springs
    last = float(opening.norms[-1])
    entered, nominal = reference.foods[0], reference.runs[0]

    def change(result: CaseResult) -> str:
        share = 100.0 * (float(result.norms[-1]) / last - 1.0)
        return f"{share:+.1f} %" if abs(share) >= 0.05 else "none (below 0.05 %)"

    def end(result: CaseResult, name: str = "norms") -> str:
        return f"{getattr(result, name)[-1]:.1f} N"

    whole = run(case, True)
    raw = run(
        disect.with_material(
            case, youngs_modulus=entered.youngs_modulus, poisson_ratio=entered.poisson_ratio
        )
    )
    heavy = run(disect.with_material(case, density=950.0 * MASS / SLAB_MASS))
    rubbed = run(disect.with_material(case, friction=springs.friction))
    tough = disect.with_material(
        case,
        toughness=full_case.food.material.toughness,
        strength=full_case.food.material.strength,
    )
    sharp = run(dc.replace(tough, food=dc.replace(tough.food, effects=Effects())))
    fine_case = disect.refined(case, FINER)
    fine = run(fine_case)
    shape = fine_case.food.shape
    more = disect.spring_count(*shape.divisions)  # type: ignore[union-attr]
    per_spring = run(disect.with_contact(fine_case, more / springs.count))
    nearer_food = dc.replace(fine_case.food, hold_distance=case.food.hold_distance)
    nearer = run(dc.replace(fine_case, food=nearer_food))
    numerics = dc.replace(case.numerics, time_step=1e-5, mass_scaling=False)
    true_mass = run(dc.replace(case, numerics=numerics))
    fine_full = run(disect.refined(full_case, FINER))

    middle = disect.MIDDLE
    wedge = math.atan(
        0.5 * (case.knife.spine_thickness - case.knife.edge_thickness) / case.knife.height
    )
    turned = [
        disect.rotation_stress(a, entered.youngs_modulus, entered.poisson_ratio)
        for a in (math.radians(10.0), wedge)
    ]
    damped = disect.translation_pressure(10.0, 0.05, 6e-3)
    norms, height = opening.norms, opening.height
    drift = 5e-5 * float((norms[-1] - norms[-2]) / (height[-2] - height[-1]))
    ratio = float(opening.norms[-1] / opening.vertical[-1])
    return [
        Difference(
            "measure of the force",
            "sum of the norms of all contact forces, sampled once in 500 sub-steps",
            "resultant with its moment, mean over the coupling step; the sum on request",
            "a sensor and a robot feel the resultant; the flanks' pressures cancel in it",
            f"{ratio:.1f} times the vertical force in the opening law's run, "
            f"{full.norms.max() / full.resultant.max():.1f} times (peaks) in the full model's",
        ),
        Difference(
            "the edge",
            "cuts nothing: springs weaken by opening alone",
            "dissipates the toughness R where it passes; `effects.edge.share` 0 turns that off",
            "a knife cuts what it does not wedge apart: the work of cutting is measured",
            f"half way the vertical force is {opening.at(middle, opening.vertical):.2f} N without, "
            f"{sharp.at(middle, sharp.vertical):.1f} N with R = "
            f"{full_case.food.material.toughness:g} J/m2",
        ),
        Difference(
            "friction",
            f"grows with speed over {springs.transition_speed:g} m/s: "
            f"{springs.friction_at(0.05):.3f} at 50 mm/s",
            "Coulomb with stick",
            "food sticks to a blade at any speed, and holds it at rest",
            f"with {springs.friction:g} the vertical force at the end is "
            f"{end(rubbed, 'vertical')}, not {opening.vertical[-1]:.2f} N",
        ),
        Difference(
            "damage",
            "per sub-step, without its duration",
            "of the opening alone, whatever speed and step",
            "an energy is spent, not a number of steps",
            "its springs take "
            + ", ".join(
                f"{law[0]:.2g} J/m2 ({other.name})"
                for other, law in zip(reference.runs, laws, strict=True)
                if other.contact_factor == other.spring_factor == 1.0
            ),
        ),
        Difference(
            "springs and contacts",
            "one stiffness for each edge of the mesh that is cut",
            "stiffness per area",
            "the force must not go with the mesh",
            f"2 mm cells have {more} springs for {springs.count}: the sum at the end goes from "
            f"{last:.1f} to {end(per_spring)} with their stiffness, to {end(fine)} with ours; "
            f"the full model's peak from {full.resultant.max():.1f} to "
            f"{fine_full.resultant.max():.1f} N",
        ),
        Difference(
            "where the knife touches",
            "at one point of each half of a cut edge, searched in 20 steps; the bevel counts",
            "on the part of each cut point's area that the edge has passed; the bevel does not",
            "the bevel's work is in R, and its steep normal would count it twice, in spikes",
            f"its vertical force peaks at {nominal.vertical_peak:g} N and ends at "
            f"{nominal.vertical_end:g} N; ours has both at {opening.vertical.max():.2f} N",
        ),
        Difference(
            "what is held",
            "every vertex farther than 10 mm from the cut",
            "the same",
            "a field of the food here, but the free slab ends at a layer of vertices in both",
            f"with 2 mm cells it is held from 11 mm on, not from 15 mm: {end(nearer)}, not "
            f"{end(fine)}",
        ),
        Difference(
            "volume at the cut",
            "both copies of a cut element have all of its volume",
            "each has its share",
            "mass and stiffness are those of the food",
            f"counting twice: {change(whole)} at the end",
        ),
        Difference(
            "mass",
            "a cell's mass at each vertex, also on the surface",
            "lumped from the volumes",
            "mass is that of the food, and matters only where it is fast",
            f"{MASS / SLAB_MASS:.1f} times the density: {change(heavy)}",
        ),
        Difference(
            "moduli",
            "Lame's pair put into the stable Neo-Hookean energy",
            "converted first (Smith et al. 2018)",
            "E and nu mean what a tensile test gives",
            f"{entered.youngs_modulus / 1e6:g} MPa and {entered.poisson_ratio:g} meant as such: "
            f"{change(raw)}",
        ),
        Difference(
            "elasticity under rotation",
            "the diagonal of F for the trace of its square",
            "invariant",
            "a body that turns is not strained",
            f"stress without strain, 10 degrees: {turned[0] / 1e3:.1f} kPa; turned by the wedge's "
            f"half angle {math.degrees(wedge):.2f} degrees: {turned[1] / 1e3:.2f} kPa",
        ),
        Difference(
            "damping under translation",
            "absolute velocities of three nodes of four",
            "strain rate",
            "moving food is not damped",
            f"{damped:.0f} Pa in an element of 6 mm that moves at 50 mm/s",
        ),
        Difference(
            "knife's position",
            "summed in single precision: 0.05 mm off after 66,200 sub-steps",
            "from the motion at each coupling step",
            "no drift",
            f"{drift:+.2f} N at the end",
        ),
        Difference(
            "step",
            "1e-5 s",
            f"{case.numerics.time_step:g} s with scaled masses",
            "cost; the force is quasi-static",
            f"with 1e-5 s and true masses: {change(true_mass)}",
        ),
    ]


def _measured_curves(case: MeasuredFood, reference: Reference) -> MeasuredCurves:
    """A measured cut with DiSECt's curve, the full model's, and the opening law's.

    The opening law's contact stiffness is the one that brings its sum of norms nearest to DiSECt's
    curve; each curve has the time of first contact that suits it best.

    Raises:
        CuttingError: The full model cannot be cut.
    """
    profile = case.profile()
    speed = case.measurement.speed

    def cut(food: MeasuredFood) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = make_food_model(food.food, Knife(), food.numerics)
        solver = CuttingSolver(model, PERIOD)
        motion = food.motion(model, profile)
        result = simulate_slice(solver, motion)
        force = np.linalg.norm(result.food_wrench[:, 3:], axis=1)
        return case.diameter - result.position[:, 2], force, contact_sums(solver, motion)

    def over_time(depth: np.ndarray, force: np.ndarray, contact: float) -> np.ndarray:
        return np.interp(speed * (profile.time - contact), depth, force, left=0.0)

    depth, force, norms = cut(case)
    contact = compare_with_measurement(profile, case.measurement, depth, force).contact_time
    curves = [
        Curve("measured", "norm of the resultant", profile.force),
        Curve("DiSECt, calibrated", "sum of norms", profile.references["DiSECt"]),
        Curve("full model", "resultant", over_time(depth, force, contact)),
        Curve("full model", "sum of norms", over_time(depth, norms, contact)),
    ]

    target = dc.replace(profile, force=profile.references["DiSECt"])
    entered = next(f for f in reference.foods if f.name == case.food.name)
    alone = _opening_alone(case, disect.small_strain_moduli(*_moduli(entered)), reference)
    edge = make_food_model(alone.food, Knife(), alone.numerics).element_size
    tried: list[tuple[float, float, Curve, Curve]] = []

    def error(log_stiffness: float) -> float:
        stiffness = float(math.exp(log_stiffness))
        numerics = dc.replace(alone.numerics, flank_length=edge / stiffness)
        try:
            depth, force, norms = cut(dc.replace(alone, numerics=numerics))
        except CuttingError:
            return 1e3
        found = compare_with_measurement(target, case.measurement, depth, norms)
        both, resultant = (
            Curve("opening law alone", name, over_time(depth, values, found.contact_time))
            for name, values in (("sum of norms", norms), ("resultant", force))
        )
        tried.append((found.rms, stiffness, both, resultant))
        return found.rms

    low, high = np.log(FLANK_RANGE)
    minimize_scalar(error, bounds=(low, high), method="bounded", options={"xatol": 0.03})
    _, stiffness, both, resultant = min(tried, key=lambda row: row[0])
    return MeasuredCurves(case.food.name, profile, speed, [*curves, both, resultant], stiffness)


def _moduli(food: disect.EnteredFood) -> tuple[float, float]:
    return food.youngs_modulus, food.poisson_ratio


def _opening_alone(
    case: MeasuredFood, moduli: tuple[float, float], reference: Reference
) -> MeasuredFood:
    """The food with DiSECt's moduli and friction and the springs of its reference case."""
    law = disect.load_case("opening_alone")
    material = dc.replace(
        law.food.material,
        youngs_modulus=moduli[0],
        poisson_ratio=moduli[1],
        density=case.food.material.density,
        friction=reference.springs.friction_at(case.measurement.speed),
    )
    food = dc.replace(case.food, material=material, effects=Effects(edge=Edge(share=0.0)))
    size = make_food_model(food, Knife(), case.numerics).element_size
    bond = reference.springs.per_area(reference.springs.stiffness) * size / moduli[0]
    numerics = dc.replace(case.numerics, bond_stiffness=float(np.clip(bond, 0.01, 1e3)))
    return dc.replace(case, food=food, numerics=numerics)
