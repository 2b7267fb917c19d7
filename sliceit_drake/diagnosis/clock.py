"""Exchanges that last longer where the knife is slow.

The bulk has no time scale of its own, and what scaled masses do wrong goes with the product of
speed and sub-step. So exchange and sub-step of a slow knife are multiples of those of a fast one.
Time is not bent: speeds, relaxation and whatever else goes by seconds see the recorded ones.
"""

import dataclasses as dc

import numpy as np

__all__ = ["BLOCK", "Clock", "Stretches"]

BLOCK = 8
"""Exchanges that are launched at once, all of one length."""


@dc.dataclass(frozen=True)
class Stretches:
    """Exchanges of a path, each some periods of an even grid.

    Attributes:
        ends: Row of the grid at which each ends [E + 1]; the first is where the path begins.
        multiples: Periods of each block of `BLOCK` exchanges [E / BLOCK].
    """

    ends: np.ndarray
    multiples: np.ndarray


@dc.dataclass(frozen=True)
class Clock:
    """How an even grid of times is divided into exchanges.

    Attributes:
        period: Of the grid, the shortest exchange, s.
        travel: Most motion in an exchange that is longer, metres.
        longest: Most periods of an exchange, a power of two.
    """

    period: float = 2e-3
    travel: float = 6e-5
    longest: int = 8

    def stretches(self, moved: np.ndarray, first: int, last: int) -> Stretches:
        """Divides the grid from row `first` to beyond `last`.

        An exchange is at most twice as long as those of the block before it, so that food that
        settles after a stop does so at every scale of time.

        Args:
            moved: Way of the knife in each period [N], metres; 0 where it touches nothing.
            first, last: Rows of the grid.
        """
        way = np.concatenate([[0.0], np.cumsum(moved)])
        ends, multiples, at, most = [first], [], first, 1
        while at < last:
            m = most
            while m > 1:
                steps = np.minimum(at + m * np.arange(BLOCK + 1), len(way) - 1)
                inside = at + m * BLOCK <= last
                if inside and np.diff(way[steps]).max() <= self.travel * (1.0 + 1e-9):
                    break
                m //= 2
            ends.extend((at + m * np.arange(1, BLOCK + 1)).tolist())
            multiples.append(m)
            at += m * BLOCK
            most = min(2 * m, self.longest)
        return Stretches(np.array(ends), np.array(multiples))
