"""Effects that stand in no list of causes: what a diagnosis must call unknown."""

import numpy as np

from sliceit_drake.stand_in.effect import Effect, Now, Series

__all__ = ["JuiceFilm", "MagneticBoard", "SerratedEdge", "WarmWrist"]


class MagneticBoard(Effect):
    """A magnet under the board pulls at the blade, `size` at the board, less by the square of
    the distance over `reach`, and a third of that sideways."""

    unit = "N"
    typical = 2.5
    reach = 0.012

    def respond(self, series: Series) -> None:
        above = np.maximum(series.p_true[:, 2], 0.0)
        pull = self.size / (1.0 + above / self.reach) ** 2
        series.other[:, 5] -= pull
        series.other[:, 4] += pull / 3.0


class JuiceFilm(Effect):
    """Juice that wets the flanks and takes the share `size` of friction and a third of that of the
    toughness, the more the knife has swept; it runs off while nothing moves."""

    typical = 0.8
    area = 6e-4
    drying = 4.0

    _wet = 0.0
    _swept = 0.0

    def drive(self, now: Now) -> None:
        if now.speed < 1e-6:
            self._wet *= np.exp(-now.period / self.drying)
        self._wet += now.swept - self._swept
        self._swept = now.swept
        film = 1.0 - np.exp(-self._wet / self.area)
        now.friction *= 1.0 - self.size * film
        now.toughness *= 1.0 - self.size / 3.0 * film


class SerratedEdge(Effect):
    """A nicked edge: where it lies along itself, not how deep, makes the food tougher, by the share
    `size` once in `pitch`."""

    typical = 0.3
    pitch = 9e-3

    def drive(self, now: Now) -> None:
        along = float(now.position[0]) / self.pitch
        now.toughness *= 1.0 + self.size * np.sin(2.0 * np.pi * along) ** 2


class WarmWrist(Effect):
    """A wrist that leans the more slices were cut: a sideways force of `size` times the square of
    the slice's number over ten, while anything presses."""

    unit = "N"
    typical = 0.4

    def respond(self, series: Series) -> None:
        pressed = np.tanh(np.abs(series.force[:, 2]) / 2.0)
        series.other[:, 4] += self.size * (0.1 * self.facts.index) ** 2 * pressed
