"""The bulk material: stress from energy, small-strain moduli, invariance, stiffness at rest."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.foods.material import Material
from studies.physics.neo_hookean import energy_density, first_piola_stress, small_strain_stiffness

POISSON_RATIOS = [0.0, 0.1, 0.37, 0.49]


def material(nu: float = 0.37, E: float = 2.0) -> tuple[float, float]:
    return Material(youngs_modulus=E, poisson_ratio=nu).stable_neo_hookean()


def deformations(count: int, size: float, seed: int = 1) -> np.ndarray:
    return np.eye(3) + size * np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3, 3))


def derivative(function, at: np.ndarray, step: float) -> np.ndarray:
    """Central differences of `function` with respect to a matrix [3, 3]."""
    out = []
    for k in range(9):
        d = np.zeros(9)
        d[k] = step
        d = d.reshape(3, 3)
        out.append((function(at + d) - function(at - d)) / (2.0 * step))
    return np.stack(out, axis=-1).reshape(*np.shape(out[0]), 3, 3)


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_stress_is_the_derivative_of_the_energy_up_to_inversion(nu):
    moduli = material(nu)
    for F in [*deformations(20, 0.5), -np.eye(3), np.zeros((3, 3))]:
        expected = derivative(lambda G: energy_density(G, *moduli), F, 1e-5)
        stress = first_piola_stress(F, *moduli)
        np.testing.assert_allclose(stress, expected, atol=1e-8 * (1.0 + np.abs(stress).max()))


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_energy_and_stress_vanish_at_rest_and_nowhere_near_it(nu):
    moduli = material(nu)
    assert abs(energy_density(np.eye(3), *moduli)) < 1e-14
    np.testing.assert_allclose(first_piola_stress(np.eye(3), *moduli), 0.0, atol=1e-13)
    strained = deformations(200, 0.05)
    assert (energy_density(strained, *moduli) > 0.0).all()


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_small_strains_see_the_given_moduli(nu):
    E, strain = 2.0e6, 1e-6
    moduli = material(nu, E)
    uniaxial = np.diag([1.0 - nu * strain, 1.0 + strain, 1.0 - nu * strain])
    stress = first_piola_stress(uniaxial, *moduli) / strain
    np.testing.assert_allclose(stress, np.diag([0.0, E, 0.0]), atol=2e-5 * E)
    shear = np.eye(3)
    shear[0, 1] = strain
    stress = first_piola_stress(shear, *moduli) / strain
    assert stress[0, 1] == pytest.approx(E / (2.0 * (1.0 + nu)), rel=1e-5)
    assert stress[1, 0] == pytest.approx(E / (2.0 * (1.0 + nu)), rel=1e-5)


def test_rotations_store_no_energy_and_turn_the_stress():
    moduli = material()
    turns = Rotation.random(20, rng=np.random.default_rng(2)).as_matrix()
    np.testing.assert_allclose(energy_density(turns, *moduli), 0.0, atol=1e-14)
    F = deformations(20, 0.3)
    np.testing.assert_allclose(
        energy_density(turns @ F, *moduli), energy_density(F, *moduli), rtol=1e-12
    )
    np.testing.assert_allclose(
        first_piola_stress(turns @ F, *moduli), turns @ first_piola_stress(F, *moduli), atol=1e-12
    )
    # Isotropy: nor does it matter how the body lay before it was deformed.
    np.testing.assert_allclose(
        energy_density(F @ turns, *moduli), energy_density(F, *moduli), rtol=1e-12
    )


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_stiffness_blocks_are_the_hessian_of_the_energy_at_rest(nu):
    rng = np.random.default_rng(3)
    config = Material(youngs_modulus=2.0, poisson_ratio=nu)
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)]) + 0.2 * rng.uniform(-1, 1, (4, 3))
    edges = (corners[1:] - corners[0]).T
    inverse = np.linalg.inv(edges)
    gradients = np.concatenate([-inverse.sum(0, keepdims=True), inverse])
    volume = np.linalg.det(edges) / 6.0

    def forces(x: np.ndarray) -> np.ndarray:
        F = (x[1:] - x[0]).T @ inverse
        return volume * gradients @ first_piola_stress(F, *config.stable_neo_hookean()).T

    hessian = np.zeros((4, 4, 3, 3))
    for j in range(4):
        for b in range(3):
            d = np.zeros((4, 3))
            d[j, b] = 1e-6
            hessian[:, j, :, b] = (forces(corners + d) - forces(corners - d)) / 2e-6
    blocks = small_strain_stiffness(gradients[None], np.array([volume]), *config.lame())[0]
    np.testing.assert_allclose(blocks, hessian, atol=1e-8)
    # Translations cost nothing, and neither do small rotations.
    np.testing.assert_allclose(blocks.sum(1), 0.0, atol=1e-12)
    turned = np.cross([0.3, -0.2, 0.5], corners)
    np.testing.assert_allclose(np.einsum("ijab,jb->ia", blocks, turned), 0.0, atol=1e-12)


def test_lame_moduli_invert_to_the_given_constants():
    mu, lam = Material(youngs_modulus=5e5, poisson_ratio=0.3).lame()
    assert mu * (3.0 * lam + 2.0 * mu) / (lam + mu) == pytest.approx(5e5)
    assert 0.5 * lam / (lam + mu) == pytest.approx(0.3)


def test_incompressible_poisson_ratio_is_refused():
    with pytest.raises(ConfigurationError, match=r"food\.poisson_ratio.*0\.5 is not within"):
        validate(Material(poisson_ratio=0.5), "food")
