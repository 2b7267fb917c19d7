"""Gradients of a slice agree with finite differences, through contact, friction and damage."""

import dataclasses as dc

import numpy as np
import pytest

from sliceit_drake.cutting.foods.effects import (
    Adhesion,
    Bluntness,
    Centre,
    Compliance,
    Core,
    Effects,
    Entry,
    Outside,
    Relaxation,
    Section,
    Skin,
    SlicePush,
    Slip,
    ToughnessRate,
    Underside,
)
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.gradient import SliceAdjoint, SliceGradient, SliceRun
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.parameters import (
    POINT_PARAMETERS,
    get_parameter,
    parameter_names,
    parameter_step,
    pull_back,
    with_parameters,
)
from sliceit_drake.cutting.solver import CuttingSolver

PERIOD = 2e-3
STEPS = (1e-4, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7)
NOT_RESOLVED = {
    "material.density",
    "effects.adhesion.exponent",
    "effects.adhesion.reference_speed",
    "effects.bluntness.dulling_exponent",
    "effects.centre.transition",
    "effects.core.transition",
    "knife.length",
    "numerics.board_damping_time",
    "numerics.board_friction",
    "numerics.board_stiffness",
    "numerics.direction_length",
    "numerics.numerical_damping",
    "numerics.unloading_length",
    "effects.resting.travel",
}
"""What this slice hardly depends on: below 1e-3 of the largest scaled sensitivity."""

EFFECTS = Effects(
    toughness_rate=ToughnessRate(0.1),
    relaxation=Relaxation([0.2, 0.1], [0.02, 0.3]),
    skin=Skin(0.5),
    core=Core(4e-3, 1e-3, 0.7, 0.8),
    centre=Centre(8e-3, 2e-3, 1.5),
    underside=Underside(8e-3, 4e-3, 0.7),
    bluntness=Bluntness(50.0, 2e-3),
    adhesion=Adhesion(300.0, 3000.0, 0.6),
    slice_push=SlicePush(0.8),
    section=Section(0.1, 0.1),
    outside=Outside(0.5, 2e-3),
    entry=Entry(50.0, 2e-3, 50.0, 3e-3, 0.5, 5),
)


def cut(effects: Effects | None = None, precision: str = "float64") -> CuttingModel:
    """A coarse cucumber; its bonds part ahead of the edge, so that damage is spent by both."""
    food = Food(
        shape=Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3]),
        material=Material(
            friction=0.1,
            static_friction=0.2,
            stribeck_velocity=0.1,
            strength=1e5,
            damping_time=1.1e-3,
        ),
        effects=effects or Effects(),
    )
    return make_food_model(food, Knife(), Numerics(time_step=5e-4, precision=precision))


def path(model: CuttingModel, count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """A draw through the whole section, swaying and rocking a little, and out again."""
    k = np.arange(count + 1)
    depth = np.where(k < 70, 4.2e-4 * k, 4.2e-4 * (70 - 0.7 * (k - 70)))
    p = np.array([0.0, 0.0, model.top + 1e-4]) + np.stack(
        [1e-4 * k, 7e-5 * np.sin(0.07 * k), -depth], axis=1
    )
    a = 0.01 * np.sin(0.05 * k)
    R = np.zeros((count + 1, 3, 3))
    R[:, 0, 0], R[:, 0, 2] = np.cos(a), np.sin(a)
    R[:, 2, 0], R[:, 2, 2] = np.sin(a), -np.cos(a)
    R[:, 1, 1] = -1.0
    return R, p


@dc.dataclass
class Case:
    model: CuttingModel
    adjoint: SliceAdjoint
    R: np.ndarray
    p: np.ndarray
    weights: np.ndarray
    run: SliceRun
    gradient: SliceGradient

    def value(
        self, model: CuttingModel | None = None, R=None, p=None, same_inertia: bool = True
    ) -> float:
        model = model or self.model
        if same_inertia and model is not self.model:
            model = model.derive(inertia_of=self.model)
        R, p = self.R if R is None else R, self.p if p is None else p
        run = self.adjoint.run(R, p, model, substeps=self.run.substeps)
        return float((self.weights * run.wrenches).sum())


def case(model: CuttingModel, count: int = 90) -> Case:
    R, p = path(model, count)
    weights = np.random.default_rng(0).normal(size=(len(p) - 1, 6))
    weights[:, :3] *= 30.0
    adjoint = SliceAdjoint(model, PERIOD)
    run = adjoint.run(R, p)
    return Case(model, adjoint, R, p, weights, run, adjoint.gradient(run, weights))


@pytest.fixture(scope="module")
def everything() -> Case:
    return case(cut(EFFECTS))


def plateau(differences: list[float]) -> tuple[float, float]:
    """Middle and spread of the four neighbouring difference quotients that agree best."""
    spans = [np.ptp(differences[i : i + 4]) for i in range(len(differences) - 3)]
    best = int(np.argmin(spans))
    return float(np.median(differences[best : best + 4])), float(spans[best])


def quotients(values) -> list[float]:
    return [(values(h) - values(-h)) / (2.0 * h) for h in STEPS]


def test_gradients_by_all_parameters_are_those_of_differences(everything):
    names = [n for n in parameter_names(everything.model) if get_parameter(everything.model, n)]
    by_name = pull_back(everything.model, everything.gradient, names)
    sizes = {n: parameter_step(everything.model, n) for n in names}
    largest = max(abs(by_name[n] * sizes[n]) for n in names)
    small, wrong = [], []
    for name in names:
        x = get_parameter(everything.model, name)

        def value(h: float, name: str = name, x: float = x) -> float:
            return everything.value(with_parameters(everything.model, {name: x + h * sizes[name]}))

        middle, spread = plateau(quotients(value))
        exact = by_name[name] * sizes[name]
        if abs(exact) < 1e-3 * largest and abs(middle) < 1e-3 * largest:
            small.append(name)
        elif abs(exact - middle) > 1e-4 * abs(exact) + spread:
            wrong.append(f"{name}: {exact:.8g}, differences {middle:.8g} +- {spread:.2g}")
    assert not wrong
    assert len(names) - len(small) >= 25
    assert set(small) <= NOT_RESOLVED


def test_gradients_hold_where_the_skin_gives_way():
    name = "effects.skin.toughness"
    model = cut(Effects(skin=Skin(1.0)))
    depth = 4e-5 * np.arange(76)
    p = np.array([0.0, 0.0, model.top + 1e-4]) - np.outer(depth, [0.0, 0.0, 1.0])
    R = np.tile(np.diag([1.0, -1.0, -1.0]), (len(p), 1, 1))
    adjoint = SliceAdjoint(model, PERIOD)
    run = adjoint.run(R, p)
    assert max(run.substeps[20:]) >= 16
    weights = np.zeros((len(p) - 1, 6))
    weights[:, 5] = 1.0
    gradient = adjoint.gradient(run, weights)
    snap = Case(model, adjoint, R, p, weights, run, gradient)
    x, size = get_parameter(model, name), parameter_step(model, name)
    middle, spread = plateau(
        quotients(lambda h: snap.value(with_parameters(model, {name: x + h * size})))
    )
    exact = pull_back(model, gradient, [name])[name] * size
    assert spread < 0.01 * abs(middle)
    assert exact == pytest.approx(middle, rel=1e-3, abs=spread)


@pytest.mark.parametrize("name", ["material.youngs_modulus", "material.toughness"])
def test_the_added_inertia_that_gradients_hold_fast_matters_little(everything, name):
    # On the way down: it turns round at 0.2 m/s, which half a millisecond does not resolve.
    weights = np.zeros_like(everything.weights)
    weights[:65, 5] = 1.0
    upward = dc.replace(everything, weights=weights)
    gradient = upward.adjoint.gradient(upward.run, upward.weights)
    exact = pull_back(upward.model, gradient, [name])[name]
    size = parameter_step(upward.model, name)

    def value(h: float) -> float:
        x = get_parameter(upward.model, name) + h * size
        return upward.value(with_parameters(upward.model, {name: x}), same_inertia=False)

    middle, _ = plateau(quotients(value))
    assert exact * size == pytest.approx(middle, rel=0.02)


def test_gradients_hold_where_arm_and_holder_give():
    elastic = case(cut(Effects(compliance=Compliance(1e-5, 1e-5))), count=30)
    names = ["effects.compliance.arm", "effects.compliance.holder", "material.toughness"]
    by_name = pull_back(elastic.model, elastic.gradient, names)
    for name in names:
        x, size = get_parameter(elastic.model, name), parameter_step(elastic.model, name)

        def value(h: float, name: str = name, x: float = x, size: float = size) -> float:
            return elastic.value(with_parameters(elastic.model, {name: x + h * size}))

        middle, spread = plateau(quotients(value))
        exact = by_name[name] * size
        assert abs(exact - middle) <= 1e-4 * abs(exact) + spread


def test_gradients_hold_where_the_blade_takes_soft_food_along():
    model = cut()
    soft = dc.replace(model.material, youngs_modulus=2e5, toughness=100.0)
    model = model.derive(material=soft, numerics=dc.replace(model.numerics, edge_spread=1e-3))
    R, p = path(model, 40)
    p[:, 0] = 3e-4 * np.sin(0.7 * np.arange(41))
    weights = np.random.default_rng(0).normal(size=(40, 6))
    weights[:, :3] *= 30.0
    adjoint = SliceAdjoint(model, PERIOD)
    run = adjoint.run(R, p)
    sawn = Case(model, adjoint, R, p, weights, run, adjoint.gradient(run, weights))
    names = ["material.toughness", "material.youngs_modulus", "material.friction"]
    by_name = pull_back(model, sawn.gradient, names)
    for name in names:
        x, size = get_parameter(model, name), parameter_step(model, name)

        def value(h: float, name: str = name, x: float = x, size: float = size) -> float:
            return sawn.value(with_parameters(model, {name: x + h * size}))

        middle, spread = plateau(quotients(value))
        exact = by_name[name] * size
        assert spread < 1e-3 * abs(middle)
        assert abs(exact - middle) <= 1e-4 * abs(exact) + spread


@pytest.mark.parametrize("name", POINT_PARAMETERS)
def test_gradients_by_cut_point_are_those_of_differences(everything, name):
    model = everything.model
    exact = pull_back(model, everything.gradient, [name])[name]
    assert exact.shape == (len(model.point_nodes),)
    for i in np.argsort(-np.abs(exact))[[0, 4, 8]]:

        def value(h: float, i: int = i) -> float:
            scale = get_parameter(model, name).copy()
            scale[i] += h
            return everything.value(with_parameters(model, {name: scale}))

        middle, spread = plateau(quotients(value))
        assert abs(exact[i] - middle) <= 1e-4 * abs(exact[i]) + spread


def test_gradients_by_the_path_are_those_of_differences(everything):
    for k in (40, 69):
        for c in range(3):

            def value(h: float, k: int = k, c: int = c) -> float:
                p = everything.p.copy()
                p[k, c] += 1e-4 * h
                return everything.value(p=p)

            middle, spread = plateau(quotients(value))
            exact = 1e-4 * everything.gradient.position[k, c]
            assert abs(exact - middle) <= 1e-4 * abs(exact) + spread
        for entry in ((0, 1), (2, 1), (0, 2), (2, 0)):

            def value(h: float, k: int = k, entry: tuple[int, int] = entry) -> float:
                R = everything.R.copy()
                R[k][entry] += 1e-2 * h
                return everything.value(R=R)

            middle, spread = plateau(quotients(value))
            exact = 1e-2 * everything.gradient.rotation[k][entry]
            assert abs(exact - middle) <= 1e-4 * abs(exact) + spread


def test_the_gradient_by_the_initial_height_is_that_of_differences(everything):
    def value(h: float) -> float:
        return everything.value(p=everything.p + [0.0, 0.0, 1e-3 * h])

    middle, spread = plateau(quotients(value))
    exact = 1e-3 * everything.gradient.position.sum(0)[2]
    assert abs(exact - middle) <= 1e-4 * abs(exact) + spread


def test_an_effect_that_is_off_has_the_gradient_of_switching_it_on():
    base = case(cut())
    for name in ("effects.skin.toughness", "effects.toughness_rate.exponent"):
        exact = pull_back(base.model, base.gradient, [name])[name] * parameter_step(
            base.model, name
        )

        def value(h: float, name: str = name) -> float:
            step = h * parameter_step(base.model, name)
            return base.value(with_parameters(base.model, {name: step}))

        # One-sided where the parameter has a bound, and so with an error of the step's order.
        slope = (value(1e-5) - value(0.0)) / 1e-5
        assert exact == pytest.approx(slope, rel=1e-3)


def test_single_precision_gradients_are_within_one_percent(everything):
    single = case(cut(EFFECTS, "float32"))
    names = [n for n in parameter_names(everything.model) if get_parameter(everything.model, n)]
    exact = pull_back(everything.model, everything.gradient, names)
    rough = pull_back(everything.model, single.gradient, names)
    sizes = {n: parameter_step(everything.model, n) for n in names}
    largest = max(abs(exact[n] * sizes[n]) for n in names)
    for n in names:
        if abs(exact[n] * sizes[n]) > 1e-2 * largest:
            assert rough[n] == pytest.approx(exact[n], rel=1e-2), n


def test_the_slice_with_gradients_is_the_slice_without(everything):
    solver, run = CuttingSolver(everything.model, PERIOD), everything.run
    for k in (0, 60):
        start, end = (Pose(run.R[j], run.p[j]) for j in (k, k + 1))
        result = solver.coupling_step(run.states[k], start, end)
        np.testing.assert_array_equal(result.wrench, run.wrenches[k])
        np.testing.assert_array_equal(result.state, run.states[k + 1])


def test_memory_does_not_grow_with_the_number_of_sub_steps_kept(everything):
    # Between coupling steps only the state is kept.
    kept = sum(state.nbytes for state in everything.run.states)
    assert kept == (len(everything.p)) * everything.run.states[0].nbytes


def test_a_food_that_slips_is_refused():
    model = cut(Effects(compliance=Compliance(0.0, 1e-5), slip=Slip(5.0)))
    with pytest.raises(ValueError, match="slip"):
        SliceAdjoint(model, PERIOD).run(*path(model))
