"""What a named cause is worth: error on records that were left out, before and after."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.linear import LinearProblem, integrate_out

__all__ = ["HeldOutGain", "held_out_gain"]

FORCES = ("force_x", "force_y", "force_z", "force_norm")
BOOTSTRAP = 1000


@dc.dataclass
class HeldOutGain:
    """Errors of the force on records that were left out, in contact.

    Each record in turn is predicted from a fit to the others; what is its own (its toughness, its
    height) is taken from itself, in all fits alike.

    Attributes:
        before: Root mean square error with the base parameters alone, N.
        after: With the causes as well, N.
        floor: Of the noise, N.
        by_record: Error of each record before and after [R, 2], N.
        share: Of what is above the floor in the mean square, that the causes remove.
        interval: 90 % interval of the share, from records drawn anew.
    """

    before: float
    after: float
    floor: float
    by_record: np.ndarray
    share: float
    interval: tuple[float, float]


def held_out_gain(
    problem: LinearProblem, causes: Sequence[tuple[str, float | None]], seed: int = 0
) -> HeldOutGain:
    """Leaves out each record in turn, with and without causes.

    Args:
        problem: The records' moments.
        causes: Names and values of the scan.
        seed: For the interval.
    """
    found = problem.found
    shared: list[int] = []
    own: list[int] = []
    for name, scan in causes:
        columns = found.index("cause", name, scan)
        (own if found.columns[columns[0]].per_record else shared).extend(columns)
    squares = np.array([_errors(problem, s, o) for s, o in (([], []), (shared, own))])
    counts = np.array([int(r.in_contact.sum()) for r in found.records])
    forces = [k for k, c in enumerate(found.records[0].channels) if c in FORCES]
    noise = float(sum(problem.noise[k].deviation ** 2 for k in forces))
    rng = np.random.default_rng(seed)
    touched = np.flatnonzero(counts > 0)
    shares = []
    for _ in range(BOOTSTRAP):
        pick = rng.choice(touched, len(touched))
        shares.append(_share(squares[:, pick].sum(1) / counts[pick].sum(), noise))
    mean = squares.sum(1) / max(counts.sum(), 1)
    low, high = np.quantile(shares, [0.05, 0.95]).tolist()
    return HeldOutGain(
        before=float(np.sqrt(mean[0])),
        after=float(np.sqrt(mean[1])),
        floor=float(np.sqrt(noise)),
        by_record=np.sqrt(squares / np.maximum(counts, 1)).T,
        share=_share(mean, noise),
        interval=(low, high),
    )


def _share(mean: np.ndarray, noise: float) -> float:
    return float((mean[0] - mean[1]) / max(mean[0] - noise, 1e-12))


def _errors(problem: LinearProblem, shared: list[int], own_causes: list[int]) -> np.ndarray:
    """Sum of squared force errors in contact of each record when it is left out [R], N^2."""
    y = problem.size
    columns = [*problem.base, *problem.numerical, *problem.usual, *shared]
    prior = problem.prior()[columns]
    own = [*problem.own, *problem.usual_own, *own_causes]
    variance = np.concatenate(
        [
            problem.variation**2,
            np.array(list(problem.usual_own.values())) ** 2,
            np.full(len(own_causes), 1e4),
        ]
    )
    reduced = np.array([integrate_out(G, own, variance) for G in problem.moments.gram])
    total = reduced.sum(0)
    forces = [k for k, c in enumerate(problem.found.records[0].channels) if c in FORCES]
    out = np.zeros(len(reduced))
    for r, record in enumerate(problem.found.records):
        rest = total - reduced[r]
        A = rest[np.ix_(columns, columns)] + np.diag(prior)
        scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
        inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-10, hermitian=True)
        theta = inverse @ (rest[columns, y] / scale) / scale
        G = problem.moments.gram[r]
        inner = G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12))
        alpha = np.linalg.solve(inner, G[own, y] - G[np.ix_(own, columns)] @ theta)
        left = record.residual - record.columns[:, :, columns] @ theta
        left = left - record.columns[:, :, own] @ alpha
        out[r] = float((left[record.in_contact][:, forces] ** 2).sum())
    return out
