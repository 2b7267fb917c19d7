"""The bulk's law in closed form, against which the kernels of the elements are held."""

import numpy as np

__all__ = ["energy_density", "first_piola_stress", "small_strain_stiffness"]


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
