"""DiSECt's reference case here: its parameters per area, the case's runs, one difference at a time.

Numbers of DiSECt are those of calibration/disect, with their source.
"""

import copy
import dataclasses as dc
import math

import numpy as np

from sliceit_drake.configuration import load_yaml, quantity
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Box
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.resources import resource_path
from studies.disect.contact_sums import contact_sums

__all__ = [
    "MIDDLE",
    "Case",
    "CaseResult",
    "EnteredFood",
    "Reference",
    "ReferenceRun",
    "Springs",
    "as_run",
    "break_opening",
    "intact_fraction",
    "load_case",
    "load_reference",
    "opening_law",
    "refined",
    "rotation_stress",
    "run_case",
    "small_strain_moduli",
    "spring_count",
    "translation_pressure",
    "with_contact",
    "with_material",
]

FOLDER = "calibration/disect"
MIDDLE = 0.0151
"""Height of the edge above the ground at which DiSECt's force half way was noted, metres."""


@dc.dataclass
class Springs:
    """What DiSECt sets for the faces of the cut: a spring with two contacts on each cut edge."""

    count: int = quantity(113, "", low=1, high=100000)
    """Springs in the section."""
    stiffness: float = quantity(200.0, "N/m", low=0.0, high=1e6)
    """Stiffness of a spring."""
    rest_length: float = quantity(5e-5, "m", low=0.0, high=1e-2)
    """Opening it begins to pull at."""
    contact_stiffness: float = quantity(1430.0, "N/m", low=0.0, high=1e6)
    """Contact stiffness of the knife on each face of a spring."""
    section: float = quantity(1.08e-3, "m2", low=1e-6, high=1.0)
    """Area that they share."""
    friction: float = quantity(0.5, "", low=0.0, high=2.0)
    """Its coefficient at high speed."""
    transition_speed: float = quantity(50.0, "m/s", low=1e-3, high=1e4)
    """Its contact friction stiffness, which is a speed."""

    def per_area(self, stiffness: float) -> float:
        """Stiffness per area of a stiffness per spring, Pa/m."""
        return self.count * stiffness / self.section

    def friction_at(self, speed: float) -> float:
        """Its friction coefficient at a speed, m/s; sliding and static one are equal there."""
        return self.friction * math.tanh(4.0 * speed / self.transition_speed)


@dc.dataclass
class ReferenceRun:
    """One run of DiSECt: what differs from the nominal run, and what came out."""

    name: str = "nominal"
    speed: float = quantity(0.05, "m/s", low=1e-4, high=1.0)
    """Speed of the knife."""
    time_step: float = quantity(1e-5, "s", low=1e-7, high=1e-3)
    """Its sub-step."""
    spring_factor: float = quantity(1.0, "", low=0.0, high=1e3)
    """On the springs' stiffness."""
    contact_factor: float = quantity(1.0, "", low=0.0, high=1e3)
    """On the contact's."""
    sum_peak: float = quantity(0.0, "N", low=0.0, high=1e6)
    """Largest sum of norms."""
    vertical_peak: float = quantity(0.0, "N", low=0.0, high=1e6)
    """Largest vertical resultant."""
    broken: int = quantity(0, "", low=0, high=100000)
    """Springs without stiffness at the end."""
    mean_stiffness: float = quantity(0.0, "N/m", low=0.0, high=1e6)
    """Mean of all springs at the end."""
    sum_middle: float | None = quantity(None, "N", low=0.0, high=1e6)
    """Sum of norms with the edge 15.1 mm above the ground."""
    sum_end: float | None = quantity(None, "N", low=0.0, high=1e6)
    """Sum of norms at the end."""
    vertical_end: float | None = quantity(None, "N", low=0.0, high=1e6)
    """Vertical resultant at the end."""
    break_delay: float | None = quantity(None, "s", low=0.0, high=100.0)
    """Mean time of a spring from first contact to none left."""


@dc.dataclass
class EnteredFood:
    """Moduli of a food as SliceIt! enters them into DiSECt."""

    name: str = ""
    youngs_modulus: float = quantity(2.6e6, "Pa", low=1e3, high=1e9)
    """As entered."""
    poisson_ratio: float = quantity(0.37, "", low=0.0, high=0.49)
    """As entered."""


@dc.dataclass
class Reference:
    """DiSECt's reference case, the nominal run first, and the foods that it was calibrated for."""

    springs: Springs = dc.field(default_factory=Springs)
    runs: list[ReferenceRun] = dc.field(default_factory=list)
    foods: list[EnteredFood] = dc.field(default_factory=list)


@dc.dataclass
class Case:
    """A cut on a prescribed motion."""

    name: str = ""
    food: Food = dc.field(default_factory=Food)
    knife: Knife = dc.field(default_factory=Knife)
    numerics: Numerics = dc.field(default_factory=Numerics)
    clearance: float = quantity(2e-3, "m", low=0.0, high=0.1)
    """Height of the edge above the food at the start."""
    motion: MotionPlan = dc.field(default_factory=MotionPlan)
    period: float = quantity(5e-3, "s", low=1e-5, high=0.1)
    """Between recorded forces; the sum of norms is sampled."""

    def model(self) -> CuttingModel:
        """The prepared cut.

        Raises:
            MeshError, TimeStepError, ConfigurationError: As `make_food_model`.
        """
        return make_food_model(self.food, self.knife, self.numerics)


@dc.dataclass
class CaseResult:
    """A run of a case.

    Attributes:
        height: Of the edge above the ground [n], metres.
        norms: Sum of the norms of all contact forces, sampled [n], N.
        resultant, vertical: Norm of the resultant and its vertical part, means of periods [n], N.
        broken: Fraction of the cut points whose bond is gone at the end.
        intact: Mean stiffness of the bonds at the end over that at the start.
        slope, offset: Opening of the faces at the end, a line over the height above the edge:
            its slope and its value at the edge, metres.
        opening_energy: Dissipated by opening, J.
        model, result: The cut.
    """

    height: np.ndarray
    norms: np.ndarray
    resultant: np.ndarray
    vertical: np.ndarray
    broken: float
    intact: float
    slope: float
    offset: float
    opening_energy: float
    model: CuttingModel
    result: SliceResult

    def at(self, height: float, values: np.ndarray) -> float:
        """Interpolates `values` [n] to the time at which the edge passed a height."""
        return float(np.interp(-height, -self.height, values))

    def work(self, values: np.ndarray) -> float:
        """Integral of `values` [n] over the descent, J."""
        return -float(np.trapezoid(values, self.height))


def load_reference() -> Reference:
    """What DiSECt gives."""
    reference = load_yaml(Reference, resource_path(f"{FOLDER}/reference.yaml"))
    assert isinstance(reference, Reference)
    return reference


def load_case(name: str) -> Case:
    """A variant of the reference case: opening_alone or full_model."""
    case = load_yaml(Case, resource_path(f"{FOLDER}/{name}.yaml"))
    assert isinstance(case, Case)
    return case


def small_strain_moduli(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """E [Pa] and nu that DiSECt's food has at small strain, for those that are entered.

    It puts Lame's mu and lambda into the stable Neo-Hookean energy as they are: shear modulus
    3/4 mu and bulk modulus lambda - mu/8.
    """
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    lam = 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
    G, K = 0.75 * mu, lam - mu / 8.0
    return 9.0 * K * G / (3.0 * K + G), (3.0 * K - 2.0 * G) / (2.0 * (3.0 * K + G))


def break_opening(
    springs: Springs, nominal: ReferenceRun, run: ReferenceRun, offset: float, slope: float
) -> tuple[float, float]:
    """When a spring breaks in a run, from when it does in the nominal one.

    In each sub-step in which the knife touches, a spring loses softness times its opening u beyond
    the rest length; the faces open by `slope` times the knife's path. So the integral of u over
    time at the break goes with stiffness and step.

    Args:
        springs: Their rest length.
        nominal: With its delay.
        run: What differs.
        offset: Opening of the faces at the edge, metres.
        slope: Their opening over the height above it.

    Returns:
        Time since the contact, s, and u then, metres.
    """
    first = max(offset - springs.rest_length, 0.0)

    def rate(case: ReferenceRun) -> float:
        return slope * case.speed

    assert nominal.break_delay is not None
    spent = first * nominal.break_delay + 0.5 * rate(nominal) * nominal.break_delay**2
    spent *= run.spring_factor / nominal.spring_factor * run.time_step / nominal.time_step
    last = math.sqrt(first**2 + 2.0 * rate(run) * spent)
    return (last - first) / rate(run), last


def opening_law(springs: Springs, opened: float, factor: float = 1.0) -> tuple[float, float]:
    """Toughness [J/m2] and strength [Pa] of springs that weaken as they open.

    Opened at a constant rate, a spring has k (1 - (u / U)^2) left and is gone at u = U, so that it
    takes k U^2 / 4. The bilinear law here of this stiffness and energy has the largest strength
    that it can, half of sqrt(2 R k).

    Args:
        springs: Their stiffness.
        opened: U, metres.
        factor: On the stiffness.
    """
    stiffness = springs.per_area(factor * springs.stiffness)
    toughness = 0.25 * stiffness * opened**2
    return toughness, 0.5 * math.sqrt(2.0 * toughness * stiffness)


def as_run(
    case: Case, springs: Springs, nominal: ReferenceRun, run: ReferenceRun, shape: CaseResult
) -> Case:
    """The case with what a run of DiSECt has other than the nominal one.

    Args:
        case: As the nominal run.
        springs: As there.
        nominal, run: The runs.
        shape: Of the nominal run, for how far the faces open.
    """
    _, opened = break_opening(springs, nominal, run, shape.offset, shape.slope)
    toughness, strength = opening_law(springs, opened, run.spring_factor)
    friction = springs.friction_at(run.speed)
    new = with_material(case, toughness=toughness, strength=strength, friction=friction)
    bonds = run.spring_factor * new.numerics.bond_stiffness
    new = dc.replace(new, numerics=dc.replace(new.numerics, bond_stiffness=bonds))
    return _at_speed(with_contact(new, run.contact_factor), run.speed)


def intact_fraction(parted: np.ndarray, onset: float, failure: np.ndarray) -> np.ndarray:
    """Secant stiffness of bilinear bonds [P] over that at the start."""
    return onset * (1.0 - parted) / (onset + parted * (failure - onset))


def _opening_of_faces(
    model: CuttingModel, solver: CuttingSolver, result: SliceResult
) -> np.ndarray:
    """Height above the edge and opening of all cut points at the end [P, 2], metres."""
    x, w = solver.positions(result.state)[model.point_nodes], model.point_weights[:, :, None]
    minus, plus = (x[:, :2] * w).sum(1), (x[:, 2:] * w).sum(1)
    return np.stack([0.5 * (minus + plus)[:, 2] - result.pose.p[2], (plus - minus)[:, 1]], axis=1)


def run_case(case: Case, whole_copies: bool = False) -> CaseResult:
    """Cuts.

    Args:
        case: The cut.
        whole_copies: Both copies of each split element have all of its volume and stiffness, as
            in DiSECt.

    Raises:
        CuttingError: The cut became unphysical.
    """
    model = case.model()
    if whole_copies:
        model = _with_whole_copies(model)
    solver = CuttingSolver(model, case.period)
    motion = Motion(case.motion, start_pose(model, case.clearance))
    result = simulate_slice(solver, motion)
    parted = np.asarray(solver.field(result.state, "cohesive_damage"), float)
    p = model.parameters
    failure = 2.0 * model.toughness / p["strength"]
    shares = intact_fraction(parted, p["strength"] / p["bond_stiffness"], failure)
    # What the edge has passed it has cut.
    passed = result.cut[-1] * model.effects.edge.share
    above, opening = _opening_of_faces(model, solver, result).T
    slope, offset = np.polyfit(above, opening, 1)
    return CaseResult(
        height=result.position[:, 2],
        norms=contact_sums(solver, motion),
        resultant=np.linalg.norm(result.food_wrench[:, 3:], axis=1),
        vertical=result.food_wrench[:, 5],
        broken=float(1.0 - (1.0 - passed) * np.mean(parted < 1.0)),
        intact=float((1.0 - passed) * shares.mean()),
        slope=float(slope),
        offset=float(offset),
        opening_energy=result.balance.opening,
        model=model,
        result=result,
    )


def _with_whole_copies(model: CuttingModel) -> CuttingModel:
    """Both copies of each split element with all of its volume and stiffness, as in DiSECt."""
    whole = 1.0 / (6.0 * np.linalg.det(model.inverse))
    node_volume = np.zeros(len(model.nodes))
    np.add.at(node_volume, model.tetrahedra, np.repeat(0.25 * whole[:, None], 4, axis=1))
    return dc.replace(model, stiff_volume=whole, node_volume=node_volume)


def with_contact(case: Case, factor: float) -> Case:
    """The flanks' contact as stiff as it is times a factor."""
    length = case.numerics.flank_length / factor
    return dc.replace(case, numerics=dc.replace(case.numerics, flank_length=length))


def with_material(case: Case, **values: float) -> Case:
    """Other properties of the material; what `Numerics` gives in units of E stays in Pa/m."""
    material = dc.replace(case.food.material, **values)
    ratio = case.food.material.youngs_modulus / material.youngs_modulus
    other = dc.replace(case, food=dc.replace(case.food, material=material))
    return with_contact(_rescaled(other, ratio), ratio)


def refined(case: Case, factor: int) -> Case:
    """Elements of a block `factor` times as small, `factor` odd.

    What is in E/h stays the same in Pa/m, and the same vertices are held.
    """
    shape = case.food.shape
    assert isinstance(shape, Box)
    old = np.array(shape.layers)
    cell = 2.0 * old[0] / factor
    finer = dc.replace(
        copy.deepcopy(shape),
        divisions=[factor * n for n in shape.divisions],
        layers=[float(y) for y in cell * (0.5 + np.arange(round(old[-1] / cell + 0.5)))],
    )
    first_held = float(old[old > case.food.hold_distance].min())
    food = dc.replace(case.food, shape=finer, hold_distance=first_held - 0.1 * cell)
    new = dc.replace(case, food=food)
    return _rescaled(new, new.model().element_size / case.model().element_size)


def _rescaled(case: Case, ratio: float) -> Case:
    names = ("bond_stiffness", "board_stiffness")
    changed = {name: ratio * getattr(case.numerics, name) for name in names}
    return dc.replace(case, numerics=dc.replace(case.numerics, **changed))


def spring_count(cells_along: int, cells_high: int) -> int:
    """Springs of DiSECt in a section of its grid: an edge across and a diagonal on each face."""
    a, b = cells_along, cells_high
    return (a + 1) * (b + 1) + a * (b + 1) + b * (a + 1)


def rotation_stress(angle: float, youngs_modulus: float, poisson_ratio: float) -> float:
    """Largest stress of DiSECt's elasticity in a body that is turned but not strained, Pa.

    It takes the invariant tr(F^T F) of the energy from the diagonal of F alone:
    P = mu (1 - 1 / (F11^2 + F22^2 + F33^2 + 1)) F + lambda (J - alpha) dJ/dF, stress-free at rest.

    Args:
        angle: Of the turn, rad.
        youngs_modulus: Pa, as entered.
        poisson_ratio: As entered.
    """
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    lam = 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
    alpha = 1.0 + 0.75 * mu / lam
    c, s = math.cos(angle), math.sin(angle)
    F = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    diagonal = float((np.diag(F) ** 2).sum())
    # The cofactors of a rotation are itself.
    P = (mu * (1.0 - 1.0 / (diagonal + 1.0)) + lam * (1.0 - alpha)) * F
    return float(np.abs(P).max())


def translation_pressure(viscosity: float, speed: float, height: float) -> float:
    """Largest pressure of DiSECt's volumetric damping in an element that moves as a whole, Pa.

    It takes the velocities of three of the four nodes as they are, so a translation at v counts as
    a rate of volume of v over the element's height on the fourth node.

    Args:
        viscosity: Of the volumetric part, Pa s.
        speed: m/s.
        height: Metres.
    """
    return viscosity * speed / height


def _at_speed(case: Case, speed: float) -> Case:
    """The same cut at another speed."""
    (segment,) = case.motion.segments
    assert isinstance(segment, ConstantSpeed)
    plan = dc.replace(case.motion, segments=[dc.replace(segment, speed=speed)])
    return dc.replace(case, motion=plan)
