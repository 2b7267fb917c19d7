"""Edge, flanks, holds and gradients against what they must be; docs/results/verification.md."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, Motion, MotionPlan
from sliceit_drake.cutting.parameters import get_parameter, pull_back, with_parameters
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver

__all__ = [
    "EdgeCheck",
    "FrictionCheck",
    "GradientCheck",
    "HoldCheck",
    "check_edge",
    "check_friction",
    "check_gradient",
    "check_hold",
]

PERIOD = 2e-3
"""Length of a coupling step, s."""
SPEED = 0.02
"""Speed of the press, m/s."""


def _press(
    food: Food,
    distance: float,
    draw_ratio: float = 0.0,
    knife: Knife | None = None,
    hold: float = 0.0,
    numerics: Numerics | None = None,
) -> tuple[CuttingSolver, SliceResult]:
    """A cut with a steady draw that goes `distance` down from 0.5 mm above the food."""
    model = make_food_model(food, knife or Knife(length=0.4), numerics or Numerics())
    speed = SPEED * float(np.hypot(1.0, draw_ratio))
    direction = [draw_ratio, 0.0, 1.0]
    plan = MotionPlan([ConstantSpeed(speed=speed, direction=direction, duration=distance / SPEED)])
    if hold:
        plan.segments.append(Hold(duration=hold))
    start = start_pose(model, clearance=5e-4, offset=-0.5 * draw_ratio * distance)
    solver = CuttingSolver(model, PERIOD)
    return solver, simulate_slice(solver, Motion(plan, start))


@dc.dataclass
class EdgeCheck:
    """Force of the edge in steady cutting, over that of Atkins, Xu and Jeronimidis (2004).

    Attributes:
        divisions: Elements across the width.
        draw_ratio: xi, draw over press speed.
        vertical: Mean vertical force over R w / (1 + xi^2).
        along: Mean force along the edge over xi R w / (1 + xi^2); None for a press.
        ripple: Standard deviation of the vertical force over its mean.
        work: Dissipated by the edge over R w times the depth.
    """

    divisions: int
    draw_ratio: float
    vertical: float
    along: float | None
    ripple: float
    work: float


EDGE_MESHES = (
    ([5, 6], [0.0, 4e-3, 12e-3]),
    ([9, 11], [0.0, 2.5e-3, 5.5e-3, 12e-3]),
    ([13, 16], [0.0, 1.7e-3, 3.7e-3, 6.5e-3, 12e-3]),
)
"""Divisions and layers."""


def check_edge(mesh: int, draw_ratio: float) -> EdgeCheck:
    """A bar cut by a blade so thin that its wedge does not open the cut, without friction.

    Args:
        mesh: Index into `EDGE_MESHES`.
        draw_ratio: xi.
    """
    toughness, width, height = 300.0, 0.024, 0.030
    divisions, layers = EDGE_MESHES[mesh]
    food = Food(
        shape=Box(size=[width, 0.1, height], divisions=divisions, layers=layers),
        material=Material(youngs_modulus=2e6, toughness=toughness, friction=0.0),
    )
    knife = Knife(length=0.4, spine_thickness=4e-4)
    _, result = _press(food, 0.026, draw_ratio, knife, numerics=Numerics(time_step=2e-4))
    depth = height - result.position[:, 2]
    steady = (depth > 0.25 * height) & (depth < 0.75 * height)
    vertical, along = result.edge[steady, 2], -result.edge[steady, 0]
    expected = toughness * width / (1.0 + draw_ratio**2)
    return EdgeCheck(
        divisions=divisions[0],
        draw_ratio=draw_ratio,
        vertical=float(vertical.mean() / expected),
        along=float(along.mean() / (draw_ratio * expected)) if draw_ratio else None,
        ripple=float(vertical.std() / vertical.mean()),
        work=result.balance.edge / (toughness * width * float(depth[-1])),
    )


@dc.dataclass
class FrictionCheck:
    """Forces of the flanks in steady sliding, against the wedge of half angle theta.

    With the pressing force N of a flank, the wedge's normal force is N sin theta and its friction
    mu N, along the sliding direction in the flank, of which xi goes along the edge.

    Attributes:
        divisions: Elements across the width.
        friction: mu.
        draw_ratio: xi.
        vertical: Vertical friction over that of the wedge.
        along: Friction along the edge over that of the wedge; None for a press.
        share: Friction over normal force, vertical: what the wedge's friction is to its splitting.
    """

    divisions: int
    friction: float
    draw_ratio: float
    vertical: float
    along: float | None
    share: float


def check_friction(divisions: int, friction: float, draw_ratio: float) -> FrictionCheck:
    """A bar without toughness, 15 to 20 mm deep, so that only the flanks act."""
    food = Food(
        shape=Box(
            size=[0.02, 0.1, 0.03],
            divisions=[divisions, 3 * divisions // 2],
            layers=np.linspace(0.0, 0.012, divisions // 2 + 1).tolist(),
        ),
        material=Material(toughness=0.0, friction=friction),
    )
    solver, result = _press(food, 0.0205, draw_ratio)
    knife = solver.model.knife
    slope = 0.5 * (knife.spine_thickness - knife.edge_thickness) / knife.height
    cosine = 1.0 / float(np.hypot(1.0, slope))
    sine = slope * cosine
    deep = result.position[:, 2] < 0.03 - 0.015
    pressing = float(result.normal[deep, 2].mean()) / sine
    sliding = float(np.hypot(draw_ratio, cosine))
    vertical = friction * pressing * cosine * cosine / sliding
    along = friction * pressing * draw_ratio / sliding
    found = result.friction[deep].mean(0)
    return FrictionCheck(
        divisions=divisions,
        friction=friction,
        draw_ratio=draw_ratio,
        vertical=float(found[2] / vertical),
        along=float(-found[0] / along) if draw_ratio else None,
        share=float(found[2] / (pressing * sine)),
    )


@dc.dataclass
class HoldCheck:
    """A knife that stops in the food and stays.

    Attributes:
        force: Vertical, at the stop, N.
        drift: Its change from 0.1 s after the stop to the end of the hold, relative.
        creep: Fastest mean speed of a node over the last half of the hold, m/s.
        duration: Of the hold, s.
    """

    force: float
    drift: float
    creep: float
    duration: float


def check_hold(duration: float = 1.0) -> HoldCheck:
    """A cucumber of the default material, 12 mm deep."""
    food = Food(shape=Cylinder(rings=3, layers=[0.0, 4e-3, 12e-3]))
    solver, result = _press(food, 0.0125, hold=0.5 * duration)
    pressed = int(np.argmax(result.time > 0.0125 / SPEED))
    vertical = result.food_wrench[:, 5]
    state, X = result.state, result.pose
    before = solver.positions(state).astype(float)
    forces = []
    for _ in range(round(0.5 * duration / PERIOD)):
        step = solver.coupling_step(state, X, X)
        state = step.state
        forces.append(step.wrench[5])
    moved = np.abs(solver.positions(state) - before).max()
    early = float(vertical[pressed + 50])
    return HoldCheck(
        force=float(vertical[pressed]),
        drift=float(forces[-1]) / early - 1.0,
        creep=float(moved / (0.5 * duration)),
        duration=duration,
    )


@dc.dataclass
class GradientCheck:
    """Adjoint against central differences, of a random function of the wrenches of a cut.

    Attributes:
        parameters: How many.
        coupling_steps: Of the cut.
        largest: Largest relative difference.
        worst: Its parameter.
    """

    parameters: int
    coupling_steps: int
    largest: float
    worst: str


GRADIENT_PARAMETERS = (
    "material.youngs_modulus",
    "material.poisson_ratio",
    "material.toughness",
    "material.strength",
    "material.friction",
    "material.density",
    "knife.spine_thickness",
    "knife.edge_thickness",
    "effects.skin.toughness",
    "effects.adhesion.stress",
    "effects.toughness_rate.exponent",
    "numerics.bond_stiffness",
)


def check_gradient(coupling_steps: int = 100) -> GradientCheck:
    """A press of a cucumber with skin and adhesion in double precision, at 50 mm/s.

    The mass matrix stays that of the cucumber, as in the adjoint.
    """
    food = Food(
        shape=Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3]),
        material=Material(friction=0.1, damping_time=1e-5),
    )
    food.effects.skin.toughness = 0.5
    food.effects.adhesion.stress = 300.0
    model = make_food_model(food, Knife(), Numerics(precision="float64"))
    start = np.array([0.0, 0.0, model.top + 1e-4])
    velocity = np.array([0.01, 0.0, -0.05])
    p = start + PERIOD * np.arange(coupling_steps + 1)[:, None] * velocity
    R = np.tile(np.diag([1.0, -1.0, -1.0]), (len(p), 1, 1))
    weights = np.random.default_rng(0).normal(size=(coupling_steps, 6))
    adjoint = SliceAdjoint(model, PERIOD)
    exact = pull_back(model, adjoint.gradient(adjoint.run(R, p), weights), GRADIENT_PARAMETERS)

    def value(name: str, given: float) -> float:
        changed = with_parameters(model, {name: given}, inertia_of=model)
        return float((weights * adjoint.run(R, p, changed).wrenches).sum())

    differences = {}
    for name in GRADIENT_PARAMETERS:
        at = float(get_parameter(model, name))
        step = 1e-5 * (abs(at) or 1.0)
        slope = (value(name, at + step) - value(name, at - step)) / (2.0 * step)
        differences[name] = abs(float(exact[name]) / slope - 1.0)
    worst = max(differences, key=lambda name: differences[name])
    return GradientCheck(len(differences), coupling_steps, differences[worst], worst)
