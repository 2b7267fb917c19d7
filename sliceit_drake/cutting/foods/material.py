"""Bulk material: stable Neo-Hookean elasticity with the E and nu of small strain."""

import dataclasses as dc

from sliceit_drake.configuration import quantity

__all__ = ["Material"]


@dc.dataclass
class Material:
    """Bulk and cut-surface properties of a food.

    The cut surface dissipates `toughness` per area, by the edge that passes or by opening,
    whichever comes first (docs/explanation/physics.md).
    """

    youngs_modulus: float = quantity(2.6e6, "Pa", low=1e3, high=1e9)
    """Young's modulus at small strain."""
    poisson_ratio: float = quantity(0.37, "", low=0.0, high=0.49)
    """Poisson's ratio."""
    density: float = quantity(950.0, "kg/m3", low=50.0, high=3000.0)
    """True density."""
    damping_time: float = quantity(4e-6, "s", low=0.0, high=0.1)
    """Kelvin-Voigt viscosity over stiffness; the viscous stress is that of the strain rate."""
    toughness: float = quantity(350.0, "J/m2", low=0.0, high=1e5)
    """Energy to part one unit of cut surface."""
    strength: float = quantity(3e5, "Pa", low=1e2, high=1e8)
    """Traction at which the uncut faces begin to part; a mesh may allow less, and says so."""
    friction: float = quantity(0.1, "", low=0.0, high=2.0)
    """Sliding friction on the flanks."""
    static_friction: float = quantity(0.0, "", low=0.0, high=2.0)
    """Friction at rest (Stribeck); values below `friction` mean no Stribeck effect."""
    stribeck_velocity: float = quantity(1e-2, "m/s", low=1e-6, high=10.0)
    """Speed over which static falls to sliding friction."""

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
