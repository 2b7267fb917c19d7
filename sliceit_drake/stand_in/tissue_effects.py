"""Effects in the food: where it is tougher, how it goes with speed and time, how it is shaped."""

import numpy as np
from scipy.signal import fftconvolve

from sliceit_drake.stand_in.effect import Effect, Now, Series, Tissue

__all__ = [
    "BulkRelaxation",
    "CoreToughness",
    "RateToughness",
    "SectionShape",
    "SkinToughness",
    "SlicePushLaw",
    "Stiffness",
    "Toughness",
]


class BulkRelaxation(Effect):
    """Viscoelastic bulk with a power-law memory, G(t) = (1 + t / t0)^-size.

    What the flanks press (and with it their friction) is the hereditary integral of the elastic
    force (Fung's quasi-linear form). The edge's force is what the food is pressed on it with: at
    the toughness while it cuts, it fades by G once the edge has stopped, and comes back with the
    food's stiffness when the knife goes on.
    """

    cause = "viscoelastic bulk"
    typical = 0.06
    least = 0.0
    onset = 0.02
    reload_stiffness = 8e3

    def respond(self, series: Series) -> None:
        time = series.time - series.time[0]
        memory = (1.0 + time / self.onset) ** -self.size
        pressure = np.linalg.norm(series.normal[:, 3:], axis=1)
        rise = np.diff(pressure, prepend=0.0)
        remembered = fftconvolve(rise, memory)[: len(rise)]
        share = np.divide(remembered, pressure, out=np.ones_like(rise), where=pressure > 1e-6)
        # A flank in contact presses; it never pulls, and never more than its elastic force.
        share = np.clip(share, 0.0, 1.0)[:, None]
        series.normal *= share
        series.friction *= share
        series.edge *= self._edge_share(series)[:, None]

    def _edge_share(self, series: Series) -> np.ndarray:
        advancing = series.press > 1e-6
        elastic = np.linalg.norm(series.edge[:, 3:], axis=1)
        share = np.ones(len(elastic))
        at_stop, since, missing = 1.0, 0.0, 0.0
        for k in np.flatnonzero(elastic > 1e-6):
            if not advancing[k]:
                if advancing[k - 1]:
                    at_stop, since = 1.0 - missing / elastic[k], series.time[k]
                share[k] = at_stop * (1.0 + (series.time[k] - since) / self.onset) ** -self.size
                missing = (1.0 - share[k]) * elastic[k]
            else:
                moved = series.press[k] * series.period
                missing = min(max(missing - self.reload_stiffness * moved, 0.0), elastic[k])
                share[k] = 1.0 - missing / elastic[k]
        return share


class RateToughness(Effect):
    """Toughness 1 + size ln(v / v0), never below a fifth."""

    cause = "toughness by speed"
    typical = 0.08
    min_speed = 1e-4

    def drive(self, now: Now) -> None:
        speed = max(now.speed, self.min_speed)
        now.toughness *= max(0.2, 1.0 + self.size * np.log(speed / self.facts.reference_speed))


class Toughness(Effect):
    """Toughness that is simply another by the share `size`."""

    cause = "toughness"
    typical = 0.15

    def drive(self, now: Now) -> None:
        now.toughness *= 1.0 + self.size


class Stiffness(Effect):
    """Bulk that is softer by the share `size` (0 to 0.9)."""

    cause = "modulus"
    typical = 0.3

    def stiffness(self, at: Tissue) -> np.ndarray | float:
        return 1.0 - self.size


class SkinToughness(Effect):
    """Tougher towards the outside, without a border; nothing where the food is peeled.

    The excess falls as exp(-(d / t)^2) with the distance d from the outline; its integral over d is
    `size`.
    """

    cause = "skin"
    unit = "J/m"
    typical = 0.8
    thickness = 1.2e-3

    def toughness(self, at: Tissue) -> np.ndarray | float:
        if self.facts.peeled:
            return 1.0
        layer = 0.5 * np.sqrt(np.pi) * self.thickness
        peak = self.size / layer / self.facts.toughness
        return np.asarray(1.0 + peak * np.exp(-((at.distance / self.thickness) ** 2)))


class CoreToughness(Effect):
    """A middle that is gradually less tough, by the share `size`, and half as much softer."""

    cause = "core"
    typical = 0.3

    def _inside(self, at: Tissue) -> np.ndarray:
        half = 0.5 * min(self.facts.height, self.facts.width)
        return np.sin(0.5 * np.pi * np.clip(at.distance / half, 0.0, 1.0)) ** 2

    def toughness(self, at: Tissue) -> np.ndarray | float:
        return 1.0 - self.size * self._inside(at)

    def stiffness(self, at: Tissue) -> np.ndarray | float:
        return 1.0 - 0.5 * self.size * self._inside(at)


class SectionShape(Effect):
    """A section that is wider below and narrower above than was measured, by the share `size`."""

    cause = "shape of the section"
    typical = 0.12

    def reshape(self, p: np.ndarray) -> np.ndarray:
        up = np.clip(2.0 * p[:, 2] / max(self.facts.height, 1e-9) - 1.0, -1.0, 1.0)
        out = p.copy()
        out[:, 0] *= 1.0 - self.size * np.sin(0.5 * np.pi * up)
        return out


class SlicePushLaw(Effect):
    """A draw that helps less than work per area says, by size xi / (1 + xi), and pulls less along
    the edge than xi times the press."""

    cause = "slice-push law"
    typical = 0.5

    def drive(self, now: Now) -> None:
        if now.press > 0.0:
            ratio = abs(now.draw) / now.press
            now.toughness *= 1.0 + self.size * ratio / (1.0 + ratio)

    def respond(self, series: Series) -> None:
        press = np.maximum(series.press, 1e-9)
        ratio = np.where(series.press > 1e-9, np.abs(series.draw) / press, 0.0)
        along = series.R[:, :, 0]
        part = np.einsum("nc,nc->n", series.edge[:, 3:], along)
        less = 0.5 * self.size * ratio / (1.0 + ratio)
        series.edge[:, 3:] -= np.clip(less, 0.0, 1.0)[:, None] * part[:, None] * along
