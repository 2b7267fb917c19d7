"""Coupling steps that last longer where the knife is slow.

The bulk has no time scale of its own, and what a sub-step does wrong goes with the way of the knife
in it. So coupling step and sub-step of a slow knife are multiples of those of a fast one. Time is
not bent: speeds, relaxation and whatever else goes by seconds see the recorded ones.
"""

import dataclasses as dc

import numpy as np

__all__ = ["BLOCK", "EXCHANGE_PERIOD", "Clock", "Stretches"]

EXCHANGE_PERIOD = 2e-3
"""Between two forces of the food, s."""
BLOCK = 8
"""Coupling steps that are launched at once, all of one length."""


@dc.dataclass(frozen=True)
class Stretches:
    """Coupling steps of a path, each some periods of an even grid.

    Attributes:
        ends: Row of the grid at which each ends [E + 1]; the first is where the path begins.
        multiples: Periods of each block of `BLOCK` coupling steps [E / BLOCK].
    """

    ends: np.ndarray
    multiples: np.ndarray


@dc.dataclass(frozen=True)
class Clock:
    """How an even grid of times is divided into coupling steps.

    Attributes:
        period: Of the grid, the shortest coupling step, s.
        travel: Most motion in a coupling step that is longer, metres.
        longest: Most periods of a coupling step, a power of two.
        settling: Blocks of coupling steps that could be longer before they are. Masses grow with
            the step, so that what still swings when it grows would swing with more energy.
    """

    period: float = EXCHANGE_PERIOD
    travel: float = 6e-5
    longest: int = 8
    settling: int = 3

    def stretches(self, moved: np.ndarray, first: int, last: int) -> Stretches:
        """Divides the grid from row `first` to beyond `last`.

        A coupling step is at most twice as long as the one before it, and only after the motion has
        allowed it for more than `settling` blocks, so that food settles after a stop at every scale
        of time.

        Args:
            moved: Way of the knife in each period [N], metres; 0 where it touches nothing.
            first, last: Rows of the grid.
        """
        way = np.concatenate([[0.0], np.cumsum(moved)])

        def allowed(m: int) -> bool:
            if m == 1:
                return True
            rows = np.minimum(at + m * np.arange(BLOCK + 1), len(way) - 1)
            slow = np.diff(way[rows]).max() <= self.travel * (1.0 + 1e-9)
            return bool(slow and at + m * BLOCK <= last)

        ends, multiples, at, m, waited = [first], [], first, 1, 0
        while at < last:
            while not allowed(m):
                m, waited = m // 2, 0
            longer = m < self.longest and allowed(2 * m)
            waited = waited + 1 if longer else 0
            if waited > self.settling:
                m, waited = 2 * m, 0
            ends.extend((at + m * np.arange(1, BLOCK + 1)).tolist())
            multiples.append(m)
            at += m * BLOCK
        return Stretches(np.array(ends), np.array(multiples))
