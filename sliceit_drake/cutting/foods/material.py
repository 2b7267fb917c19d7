"""Bulk material: stable Neo-Hookean elasticity with the E and nu of small strain."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import quantity

__all__ = ["Material", "energy_density", "first_piola_stress", "small_strain_stiffness"]


@dc.dataclass
class Material:
    """Bulk and cut-surface properties of a food.

    The cut surface dissipates `toughness` per area, by the edge that passes or by opening,
    whichever comes first (docs/physics.md).
    """

    youngs_modulus: float = quantity(
        2.6e6, "Pa", low=1e3, high=1e9, doc="Young's modulus at small strain."
    )
    poisson_ratio: float = quantity(0.37, "", low=0.0, high=0.49, doc="Poisson's ratio.")
    density: float = quantity(950.0, "kg/m3", low=50.0, high=3000.0, doc="True density.")
    damping_time: float = quantity(
        4e-6,
        "s",
        low=0.0,
        high=0.1,
        doc="Kelvin-Voigt viscosity over stiffness; the viscous stress is that of the strain rate.",
    )
    toughness: float = quantity(
        350.0, "J/m2", low=0.0, high=1e5, doc="Energy to part one unit of cut surface."
    )
    strength: float = quantity(
        3e5,
        "Pa",
        low=1e2,
        high=1e8,
        doc="Traction at which the uncut faces begin to part; a mesh may allow less, and says so.",
    )
    friction: float = quantity(0.1, "", low=0.0, high=2.0, doc="Sliding friction on the flanks.")
    static_friction: float = quantity(
        0.0,
        "",
        low=0.0,
        high=2.0,
        doc="Friction at rest (Stribeck); values below `friction` mean no Stribeck effect.",
    )
    stribeck_velocity: float = quantity(
        1e-2, "m/s", low=1e-6, high=10.0, doc="Speed over which static falls to sliding friction."
    )

    def lame(self) -> tuple[float, float]:
        """Lame's small-strain moduli (mu, lambda), Pa."""
        E, nu = self.youngs_modulus, self.poisson_ratio
        return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))

    def stable_neo_hookean(self) -> tuple[float, float]:
        """Moduli of the stable Neo-Hookean energy whose small-strain limit is `lame()`, Pa.

        Smith, De Goes, Kim 2018, eq. 14 and section 3.4, where mu_s = 4/3 mu and
        lambda_s = lambda + 5/6 mu.
        """
        mu, lam = self.lame()
        return 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu


def _rest_volume_ratio(mu: float, lam: float) -> float:
    return 1.0 + 0.75 * mu / lam


def energy_density(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Stable Neo-Hookean energy per rest volume (Smith et al. 2018, eq. 14), zero at rest.

    Args:
        F: Deformation gradients [..., 3, 3].
        mu: First modulus of `Material.stable_neo_hookean`, Pa.
        lam: Second modulus, Pa.

    Returns:
        Energy density [...], J/m^3.
    """
    alpha = _rest_volume_ratio(mu, lam)
    Ic = (F * F).sum((-1, -2))
    J = np.linalg.det(F)
    at_rest = 0.5 * lam * (1.0 - alpha) ** 2 - 0.5 * mu * np.log(4.0)
    return (
        0.5 * mu * (Ic - 3.0) + 0.5 * lam * (J - alpha) ** 2 - 0.5 * mu * np.log(Ic + 1.0) - at_rest
    )


def first_piola_stress(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Derivative of `energy_density` by F [..., 3, 3], Pa (Smith et al. 2018, eq. 18)."""
    alpha = _rest_volume_ratio(mu, lam)
    Ic = (F * F).sum((-1, -2))[..., None, None]
    J = np.linalg.det(F)[..., None, None]
    columns = [F[..., :, k] for k in range(3)]
    dJ = np.stack([np.cross(columns[(k + 1) % 3], columns[(k + 2) % 3]) for k in range(3)], axis=-1)
    return mu * (1.0 - 1.0 / (Ic + 1.0)) * F + lam * (J - alpha) * dJ


def small_strain_stiffness(
    gradients: np.ndarray, volume: np.ndarray, mu: float, lam: float
) -> np.ndarray:
    """Stiffness blocks of linear tetrahedra at rest.

    Args:
        gradients: Shape function gradients [T, 4, 3], 1/m.
        volume: Material volumes [T], m^3.
        mu: Lame's mu, Pa.
        lam: Lame's lambda, Pa.

    Returns:
        Blocks [T, 4, 4, 3, 3], N/m.
    """
    gi, gj = gradients[:, :, None, :, None], gradients[:, None, :, None, :]
    outer = gi * gj
    inner = np.einsum("tia,tja->tij", gradients, gradients)[..., None, None]
    blocks = lam * outer + mu * np.swapaxes(outer, -1, -2) + mu * inner * np.eye(3)
    return blocks * volume[:, None, None, None, None]
