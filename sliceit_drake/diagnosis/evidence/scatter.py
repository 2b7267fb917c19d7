"""How far slices that are cut alike scatter in the direction of a cause, as against their model.

A model of how slices differ has few numbers, and slices differ in more. What a cause gains is a
square over a variance, so that a variance that is too small makes causes of chance. Replicates show
it: of the products s_r of a cause's doing with what is left of record r, the mean square about the
mean of its condition, over that which the model has, is the factor by which the variance is too
small in that direction (the sandwich of White 1980, by clusters as in Liang and Zeger 1986). Its
degrees of freedom are those of Satterthwaite (1946).
"""

import dataclasses as dc

import numpy as np
from scipy.special import chdtrc

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, fit_shared, wider
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence

__all__ = ["Scatter", "scatter_of_replicates"]

MANY = 1e3
"""Degrees of freedom of what is known."""
FACTORS = np.geomspace(1.0, 1e5, 4000)
"""What factors may be."""


@dc.dataclass(frozen=True)
class Scatter:
    """Of replicates in the direction of a cause.

    Attributes:
        factor: Of the variance, as against the model.
        freedom: Degrees of freedom of it; 0 where no condition that shows the cause has replicates.
    """

    factor: float
    freedom: float

    def chance(self, gain: float, numbers: int) -> float:
        """That a cause of so many numbers gains as much; 1 with no replicates.

        The mean over what the factor may be after the replicates, where any logarithm of it from 0
        on was as likely before: slices do not differ by less than their model has. Where the factor
        is large this is the F distribution.
        """
        if self.freedom == 0.0:
            return 1.0
        of_log = -0.5 * self.freedom * (np.log(FACTORS) + self.factor / FACTORS)
        weights = np.exp(of_log - of_log.max())
        return float(weights @ chdtrc(numbers, gain / FACTORS) / weights.sum())


def scatter_of_replicates(
    problem: LinearProblem, e: CauseEvidence, beside: list[CauseAtScan]
) -> Scatter:
    """Scatter in the direction of a cause that all records share.

    Args:
        problem: The records.
        e: Evidence of the cause.
        beside: Causes that are in the model before.
    """
    own, g = problem.found.of_causes([e.cause]), np.array(e.coefficients)
    model = problem.with_causes([*problem.found.of_causes(beside), *own])
    theta, _ = fit_shared(problem.weighted(model, e.sizes).total, model)
    left = np.zeros(problem.size + 1)
    left[-1], left[model.shared] = 1.0, -theta
    reduced = problem.reduced(model)
    along = np.einsum("rij,j->ri", reduced[:, :, own], g)
    products, variances = along @ left, along[:, own] @ g
    # Slices that an error is known from scattered as well.
    wide = wider(len(reduced), known) ** 2 if (known := problem.found.known_from) else 1.0
    found, expected, of_freedom = 0.0, 0.0, 0.0
    for members, level in zip(problem.conditions.values(), problem.levels, strict=True):
        s, n, within = products[members], len(members), float(variances[members].sum())
        if not level.any():
            # Where nothing is cut only the sensor's noise is there, which is known.
            found += within
        elif n > 1:
            within *= (n - 1.0) / n
            found += wide * float(((s - s.mean()) ** 2).sum())
            of_freedom += within**2 / (n - 1.0)
        else:
            continue
        expected += within
    if expected < 1e-12:
        return Scatter(1.0, 0.0)
    return Scatter(found / expected, min(expected**2 / max(of_freedom, 1e-300), MANY))
