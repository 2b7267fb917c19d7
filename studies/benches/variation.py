"""How slices of a bench differ in size and texture; their material differs by the protocol."""

import numpy as np

from sliceit_drake.stand_in.effect import Effect, SliceTruth, Tissue

__all__ = ["LEVEL", "SliceVariation"]

LEVEL = 1.0 / 6.0
"""Of the differences in width, those in height: a user sees and measures it before a cut."""


class SliceVariation(Effect):
    """Slices that differ by the share `size` in width and texture, and by `LEVEL` of it in height.

    The texture is a factor on the toughness whose logarithm is a Gaussian process of the depth; its
    correlation falls by a Gaussian over `grain`.
    """

    typical = 0.06
    least = 0.0
    grain = 4e-3
    levels = 40

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._wider, self._higher = np.exp(self.size * rng.normal(size=2) * [1.0, LEVEL])
        self._heights = np.linspace(0.0, max(1.2 * facts.height, 1e-3), self.levels)
        apart = (self._heights[:, None] - self._heights) / self.grain
        values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
        waves = np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=self.levels)
        self._texture = np.exp(self.size * (vectors @ waves))

    def reshape(self, p: np.ndarray) -> np.ndarray:
        return p * [self._wider, 1.0, self._higher]

    def toughness(self, at: Tissue) -> np.ndarray | float:
        return np.interp(at.height, self._heights, self._texture)
