"""What goes with the number of the slice, whatever its form along the motion.

Slices of one condition are the same cut at other times of the session. Where their order does not
matter, exchanging them changes no statistic: the chance of a trend as strong as the one that was
measured is its rank among those of slices in random order (a permutation test).
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.effect_size import OwnError
from sliceit_drake.diagnosis.evidence.linear import LinearProblem

__all__ = ["Trend", "trend_of_slices"]


@dc.dataclass(frozen=True)
class Trend:
    """The strongest of a channel.

    Attributes:
        channel: Its name.
        p_value: Chance of one as strong, over all channels, where the order does not matter.
        size: Root mean square in contact, over the noise.
    """

    channel: str
    p_value: float
    size: float


def trend_of_slices(
    problem: LinearProblem, named: Sequence[CauseAtScan] = (), orders: int = 500, seed: int = 0
) -> Trend | None:
    """Tests whether what is left of the records goes with the number of the slice.

    Args:
        problem: The records.
        named: Causes in the model.
        orders: Random orders of the slices within their conditions.
        seed: Of these.

    Returns:
        None where no condition has slices of different numbers.
    """
    records, conditions = problem.found.records, problem.conditions.values()
    number = np.array([float(r.slice_index) for r in records])
    for members in conditions:
        number[members] -= number[members].mean()
    if not number.any():
        return None
    number /= np.sqrt(np.mean(number**2))
    wrong = OwnError.beside(problem, named)
    reduced = problem.reduced(wrong.model)
    Z = np.array(problem.shapes)
    noise = np.array([n.deviation for n in problem.noise])[problem.discrepancy.channel]
    # A trend is as large as the noise before the data, for a deviation of the slice's number.
    metric = np.mean([A[np.ix_(Z, Z)] for A in reduced], axis=0) * len(records)
    left = np.array([A[Z] @ wrong.left(r) for r, A in enumerate(reduced)])
    rng, drawn = np.random.default_rng(seed), np.tile(number, (orders + 1, 1))
    for members in conditions:
        drawn[1:, members] = rng.permuted(drawn[1:, members], axis=1)
    products = drawn @ left
    gains, found = [], []
    for c in range(len(problem.noise)):
        own = problem.discrepancy.channel == c
        inner = metric[np.ix_(own, own)] + np.diag(1.0 / noise[own] ** 2)
        t = np.linalg.solve(inner, products[:, own].T).T
        gain = (t * products[:, own]).sum(1)
        gains.append((gain - gain[1:].mean()) / max(gain[1:].std(), 1e-12))
        found.append(t[0])
    largest = np.max(gains, axis=0)
    best = int(np.argmax([g[0] for g in gains]))
    square = rows = 0.0
    for r, record in enumerate(records):
        inside = problem.shape_values[r][record.in_contact]
        square += float(((number[r] * inside @ found[best]) ** 2).sum())
        rows += len(inside)
    return Trend(
        channel=records[0].channels[best],
        p_value=float((1.0 + (largest[1:] >= largest[0]).sum()) / (orders + 1.0)),
        size=float(np.sqrt(square / max(rows, 1.0)) / problem.noise[best].deviation),
    )
