"""What counts in the comparison of policies, fixed before any was trained.

The contact force is that of food and board on the knife, without the tool's weight and inertia. A
sample counts as contact from 0.5 N on. Ratios of two kinds of policies are of means over slices;
their intervals come from a bootstrap that draws policies first and slices second, for slices under
one policy are no replicates of the training.
"""

import dataclasses as dc

import numpy as np

__all__ = ["COMPLETE", "Ratio", "SliceMetrics", "bootstrap_ratio", "slice_metrics"]

CONTACT = 0.5
"""Force from which a sample counts as contact, N."""
COMPLETE = 0.999
"""Fraction of a section from which a slice counts as cut off."""


@dc.dataclass(frozen=True)
class SliceMetrics:
    """One slice.

    Attributes:
        median_force: Median of |F| over contact samples, N.
        peak_force: Greatest |F|, N.
        board_peak: Greatest force of the board, N.
        duration: From the start to the end of the slice, s.
        completed: Whether the section was cut through and the policy brought the slice to its end.
        cut: Fraction of the section that was cut.
        end: Why the slice ended: goal, force, torque, shaking, workspace, guard or time.
    """

    median_force: float
    peak_force: float
    board_peak: float
    duration: float
    completed: bool
    cut: float
    end: str


def slice_metrics(
    time: np.ndarray, food: np.ndarray, board: np.ndarray, cut: np.ndarray, end: str
) -> SliceMetrics:
    """Metrics of a slice that has ended.

    Args:
        time: [n], s.
        food: Force of the food on the knife [n, 3], N.
        board: Likewise of the board.
        cut: Fraction of the section that is cut [n].
        end: Why it ended.
    """
    force = np.linalg.norm(food + board, axis=1)
    contact = force[force >= CONTACT]
    share = float(cut[-1]) if len(cut) else 0.0
    return SliceMetrics(
        median_force=float(np.median(contact)) if len(contact) else 0.0,
        peak_force=float(force.max(initial=0.0)),
        board_peak=float(np.linalg.norm(board, axis=1).max(initial=0.0)),
        duration=float(time[-1] - time[0]) if len(time) else 0.0,
        completed=end == "goal" and share >= COMPLETE,
        cut=share,
        end=end,
    )


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
        return np.array(
            [values[np.ix_(p, s)].mean() for p, s in zip(policies, slices, strict=True)]
        )

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
