"""Ratio of the means of two kinds of policies, with an interval.

The bootstrap draws policies first and slices second, for slices under one policy are no replicates
of the training.
"""

import dataclasses as dc

import numpy as np

__all__ = ["Ratio", "bootstrap_ratio"]


@dc.dataclass(frozen=True)
class Ratio:
    """A ratio of two means, with a 95 % interval.

    Attributes:
        value: Ratio of the means.
        low, high: Ends of the interval.
    """

    value: float
    low: float
    high: float


def bootstrap_ratio(
    ours: np.ndarray, baseline: np.ndarray, rng: np.random.Generator, draws: int = 4000
) -> Ratio:
    """Ratio of the means of two kinds of policies.

    Args:
        ours: A number for each policy and slice [policies, slices].
        baseline: Likewise, of other policies on the same slices.
        rng: Draws policies of each kind, and slices, the same for both.
        draws: Draws of the bootstrap; a ratio is infinite where the baseline drawn is zero.
    """
    slices = rng.integers(ours.shape[1], size=(draws, ours.shape[1]))

    def means(values: np.ndarray) -> np.ndarray:
        policies = rng.integers(len(values), size=(draws, len(values)))
        drawn = values[policies[:, :, None], slices[:, None, :]]
        return drawn.reshape(draws, -1).mean(1)

    def over(above: np.ndarray, below: np.ndarray) -> np.ndarray:
        return np.divide(above, below, out=np.full(above.shape, np.inf), where=below > 0.0)

    ratios = over(means(ours), means(baseline))
    with np.errstate(invalid="ignore"):
        limits = np.quantile(ratios, [0.025, 0.975])
    # Between two infinite ratios NumPy finds none.
    low, high = np.where(np.isnan(limits), np.inf, limits).tolist()
    return Ratio(
        float(over(ours.mean(keepdims=True), baseline.mean(keepdims=True))[0, 0]), low, high
    )
