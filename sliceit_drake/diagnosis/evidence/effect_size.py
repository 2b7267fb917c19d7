"""How large an effect is against the noise, once all else is refitted to it."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sliceit_drake.diagnosis.evidence.linear import LinearProblem

__all__ = ["effect_in_noise"]


def effect_in_noise(
    problem: LinearProblem,
    columns: list[int],
    coefficients: np.ndarray,
    refit_slices: bool = True,
) -> tuple[float, np.ndarray]:
    """Root mean square of what is left of an effect over the in-contact noise.

    Base parameters and what is each record's own are refitted to the noise-free effect, weighted as
    to data; what they cannot take is left. The mean is over all in-contact samples and channels.

    Args:
        problem: The records' moments.
        columns: Numbers of the effect's columns [n].
        coefficients: Of the columns [n], or of each record [R, n].
        refit_slices: Whether what is each record's own is refitted as well. Without, an effect that
            differs between records as slices may differ keeps its size.

    Returns:
        The ratio, and that of each record [R].
    """
    own = problem.own
    variance = problem.variation**2 if refit_slices else np.full(len(own), 1e-12)
    base = problem.base
    moments = problem.moments.gram
    coefficients = np.broadcast_to(coefficients, (len(moments), len(columns)))
    factors, A, b = [], np.zeros((len(base), len(base))), np.zeros(len(base))
    targets = [G[:, columns] @ g for G, g in zip(moments, coefficients, strict=True)]
    for G, target in zip(moments, targets, strict=True):
        factor = cho_factor(G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12)))
        factors.append(factor)
        inner = cho_solve(factor, np.column_stack([G[np.ix_(own, base)], target[own]]))
        A += G[np.ix_(base, base)] - G[np.ix_(base, own)] @ inner[:, :-1]
        b += target[base] - G[np.ix_(base, own)] @ inner[:, -1]
    shared = np.linalg.lstsq(A, b, rcond=1e-10)[0] if base else b
    deviation = np.array([noise.deviation for noise in problem.noise])
    squares, counts = np.zeros(len(moments)), np.zeros(len(moments))
    for r, record in enumerate(problem.found.records):
        G, target = moments[r], targets[r]
        of_own = cho_solve(factors[r], target[own] - G[np.ix_(own, base)] @ shared)
        rest = record.columns[:, :, columns] @ coefficients[r]
        rest = rest - record.columns[:, :, base] @ shared - record.columns[:, :, own] @ of_own
        inside = rest[record.in_contact] / deviation
        squares[r], counts[r] = float((inside**2).sum()), inside.size
    by_record = np.sqrt(squares / np.maximum(counts, 1))
    return float(np.sqrt(squares.sum() / max(counts.sum(), 1.0))), by_record
