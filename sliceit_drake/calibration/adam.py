"""Adam (Kingma and Ba 2015, algorithm 1)."""

import dataclasses as dc

import numpy as np

__all__ = ["Adam"]

DECAYS = (0.9, 0.999)


@dc.dataclass
class Adam:
    """Running means of a gradient, and the steps from them.

    Attributes:
        m: Mean of the gradient [d].
        v: Mean of its square [d].
    """

    m: np.ndarray
    v: np.ndarray

    @classmethod
    def of(cls, size: int) -> "Adam":
        """Before the first gradient of `size` parameters."""
        return cls(np.zeros(size), np.zeros(size))

    def descent(self, gradient: np.ndarray, step: int, least: float) -> np.ndarray:
        """Takes a gradient [d], and returns which way to go, about 1 long in each parameter [d].

        Args:
            gradient: At this step.
            step: Which it is, from 0.
            least: Gradients that are smaller than this are taken for none.
        """
        self.m = DECAYS[0] * self.m + (1.0 - DECAYS[0]) * gradient
        self.v = DECAYS[1] * self.v + (1.0 - DECAYS[1]) * gradient**2
        mean = self.m / (1.0 - DECAYS[0] ** (step + 1))
        spread = np.sqrt(self.v / (1.0 - DECAYS[1] ** (step + 1)))
        return -mean / (spread + least)
