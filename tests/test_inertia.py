"""The mass matrix that is stepped: what the bulk needs of it, and how that is found cheaply."""

import dataclasses as dc

import numpy as np
import pytest
from scipy.linalg import eigh

from sliceit_drake.cutting import model as model_module
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.inertia import Inertia
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.parameters import with_parameters

FOOD = Food(shape=Cylinder(rings=2, layers=[0.0, 4e-3, 12e-3]))
CHANGED = (
    "material.toughness",
    "material.youngs_modulus",
    "material.density",
    "material.damping_time",
    "material.poisson_ratio",
    "material.friction",
)


def base(**numerics: float) -> CuttingModel:
    return make_food_model(FOOD, Knife(), Numerics(**numerics))


def exact_share(model: CuttingModel) -> float:
    """By the dense stiffness matrix of linear elasticity, V (lam a b^T + mu b a^T + mu a.b I)."""
    mu, lam = model.material.lame()
    g = np.concatenate([-model.inverse.sum(1, keepdims=True), model.inverse], axis=1)
    half = 0.5 * model.numerics.time_step
    volume = (half**2 + half * model.parameters["damping_time"]) * model.element_volume
    stiffness = np.zeros((len(model.nodes), 3, len(model.nodes), 3))
    for t, gradients, v in zip(model.tetrahedra, g, volume, strict=True):
        for a, ga in zip(t, gradients, strict=True):
            for b, gb in zip(t, gradients, strict=True):
                block = lam * np.outer(ga, gb) + mu * np.outer(gb, ga) + mu * (ga @ gb) * np.eye(3)
                stiffness[a, :, b] += v * block
    moving = model.moving
    K = stiffness[moving][:, :, moving].reshape(3 * len(moving), -1)
    # The blade does not move the bulk: it follows where the nodes pull it.
    S = np.kron(Inertia(model._unraised_masses).of_nodes.toarray(), np.eye(3))
    return float(eigh(K, S, eigvals_only=True, subset_by_index=[len(K) - 1, len(K) - 1])[0])


@pytest.mark.parametrize("time_step", [1e-3, 2.5e-4])
def test_the_share_that_the_bulk_needs_is_that_of_the_dense_matrices(time_step):
    model = base(time_step=time_step)
    # The blade's entry couples to y alone, so that the other axes have the nodes' matrix.
    assert model._bulk_share == pytest.approx(exact_share(model), rel=1e-2)


@pytest.mark.parametrize("time_step", [1e-3, 2.5e-4])
def test_the_share_of_a_cut_that_differs_is_within_the_bound_by_the_first(time_step):
    rng, first = np.random.default_rng(1), base(time_step=1e-3)
    for _ in range(8):
        values = {name: first_value(first, name) * rng.uniform(0.8, 1.25) for name in CHANGED}
        values["material.poisson_ratio"] = rng.uniform(0.3, 0.42)
        other = with_parameters(first, values).with_step(time_step)
        bound = other._share_by(first)
        other._like = None
        assert other._bulk_share <= bound * (1.0 + 1e-2)


def first_value(model: CuttingModel, name: str) -> float:
    return float(getattr(model.material, name.split(".")[1]))


def test_a_cut_that_differs_a_little_needs_no_eigenvalue(monkeypatch):
    first = base()
    alone = make_food_model(
        dc.replace(
            FOOD, material=dc.replace(FOOD.material, toughness=1.05 * FOOD.material.toughness)
        ),
        Knife(),
        Numerics(),
    )
    expected = alone.inertia.matrix.toarray()
    assert first._bulk_share < 0.9
    monkeypatch.setattr(model_module, "largest_share", lambda *_: pytest.fail("computed"))
    changed = with_parameters(first, {"material.toughness": 1.05 * FOOD.material.toughness})
    np.testing.assert_allclose(changed.inertia.matrix.toarray(), expected, rtol=1e-12)
    stiffer = {"material.youngs_modulus": 20.0 * FOOD.material.youngs_modulus}
    with pytest.raises(pytest.fail.Exception, match="computed"):
        assert with_parameters(first, stiffer).inertia


def test_cuts_derived_one_from_another_keep_the_first_alone():
    first = base()
    last = first
    for k in range(5):
        last = with_parameters(last, {"material.toughness": 300.0 + k})
    assert last._like is first
