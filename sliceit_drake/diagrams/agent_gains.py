"""The gains that the SliceIt! agent chooses from, and the factor on its error."""

import dataclasses as dc

from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig

__all__ = ["ERROR_FACTOR", "AgentGains"]

ERROR_FACTOR = 0.1
"""Factor on the agent's error scale, simulated and on hardware (docs/explanation/control.md)."""


@dc.dataclass(frozen=True)
class AgentGains:
    """A point in the box of the SliceIt! agent, as its code sends it: doubled.

    Attributes:
        stiffness_x: N/m, 1,000 to 10,000.
        stiffness_ry: Nm/rad, 40 to 200.
        p_z: 0.02 to 0.1.
        p_ry: 0.2 to 3.
        error_scale: 1.5 far from the target to 2.5 at it, before the factor.
    """

    stiffness_x: float = 5500.0
    stiffness_ry: float = 120.0
    p_z: float = 0.06
    p_ry: float = 1.6
    error_scale: float = 2.0

    def controller(self, factor: float = ERROR_FACTOR) -> ComplianceControllerConfig:
        """The controller in parallel mode, its error scale times `factor`."""
        return ComplianceControllerConfig(
            mode="parallel",
            error_scale=factor * self.error_scale,
            stiffness=[self.stiffness_x, 2000.0, 2000.0, 80.0, self.stiffness_ry, 80.0],
            p_gains=[0.2, 0.2, self.p_z, 2.0, self.p_ry, 2.0],
            selection=[1.0, 1.0, 0.5, 1.0, 0.5, 1.0],
        )
