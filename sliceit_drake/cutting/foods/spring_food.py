"""The food of the spring-only baseline: a button on a spring, from a measured force."""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np

from sliceit_drake.configuration import ConfigurationError, quantity

__all__ = ["SpringFood", "calibrate_spring"]

# Gazebo's and ODE's default error reduction parameter.
DEFAULT_ERP = 0.2


@dc.dataclass
class SpringFood:
    """A button that the knife's edge pushes down against a spring and a damper to the board.

    Its top is `height` above the board, which is also its travel. Gravity on the button is part of
    the spring's rest length. Defaults: a spring that reaches 16.6 N, the largest measured force on
    the cucumber, at full compression, with ODE's default ERP at a step of 1 ms.
    """

    height: float = quantity(0.027, "m", low=5e-3, high=0.3)
    """Height of the food: the travel."""
    diameter: float = quantity(0.027, "m", low=1e-3, high=0.3)
    """Diameter of the button."""
    stiffness: float = quantity(613.0, "N/m", low=1.0, high=1e6)
    """Force per compression."""
    damping: float = quantity(2.45, "Ns/m", low=0.0, high=1e4)
    """Force per compression rate."""
    mass: float = quantity(0.01, "kg", low=1e-6, high=10.0)
    """Mass of the button."""
    time_step: float = quantity(1e-3, "s", low=1e-6, high=0.02)
    """Longest inner step; also ODE's step, for which erp() and cfm() hold."""
    erp_noise: float = quantity(0.0, "", low=0.0, high=0.99)
    """Half width of the uniform relative noise on ERP at constant CFM; 0.3 in SliceIt!."""

    def check(self, where: str) -> None:
        if self.erp_noise > 0.0 and (1.0 + self.erp_noise) * self.erp() > 1.0:
            raise ConfigurationError(
                f"= {self.erp_noise} takes ERP, {self.erp():.3g}, beyond 1",
                field=f"{where}.erp_noise",
                fix=f"Give at most {1.0 / self.erp() - 1.0:.3g}, or more damping.",
            )

    def erp(self) -> float:
        """ODE's error reduction parameter of spring and damper, h k / (h k + c).

        ODE solves J v' + CFM f = -(ERP / h) x for the force f and the velocity v' after the step h:
        backward Euler for a spring and damper (Smith, Open Dynamics Engine user guide, "How to use
        ERP and CFM"). f is a force here, as in that guide; ODE divides CFM by h once more inside.
        """
        return self.time_step * self.stiffness * self.cfm()

    def cfm(self) -> float:
        """ODE's constraint force mixing of spring and damper, 1 / (h k + c), m/(Ns)."""
        return 1.0 / (self.time_step * self.stiffness + self.damping)

    def with_erp_cfm(self, erp: float, cfm: float) -> "SpringFood":
        """The same button with k = ERP / (h CFM) and c = (1 - ERP) / CFM.

        Raises:
            ConfigurationError: ERP is not within (0, 1] or CFM not above 0.
        """
        if not 0.0 < erp <= 1.0:
            raise ConfigurationError(f"{erp} is not within (0, 1]", field="erp", fix="Give 0.2.")
        if not cfm > 0.0:
            raise ConfigurationError(f"{cfm} is not above 0", field="cfm", fix="Give 0.3.")
        return dc.replace(self, stiffness=erp / (self.time_step * cfm), damping=(1.0 - erp) / cfm)


def calibrate_spring(force: Sequence[float] | np.ndarray, height: float) -> SpringFood:
    """The spring whose force at full compression is the largest of a measured profile, as SliceIt!.

    Its damping is that of `DEFAULT_ERP` at its time step.

    Args:
        force: Measured force over one slice [n], N.
        height: Height of the food, metres: the spring's travel.

    Raises:
        ConfigurationError: The profile has no force.
    """
    largest = float(np.max(force))
    if not (math.isfinite(largest) and largest > 0.0):
        raise ConfigurationError(
            f"the largest force is {largest} N", field="force", fix="Give a profile of a slice."
        )
    food = SpringFood(height=height)
    stiffness = largest / height
    return food.with_erp_cfm(DEFAULT_ERP, DEFAULT_ERP / (food.time_step * stiffness))
