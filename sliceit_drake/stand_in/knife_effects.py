"""Effects between knife and food: friction, adhesion, juice, a blunt, dulling or nicked edge."""

import numpy as np

from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth

__all__ = [
    "BluntEdge",
    "DullingEdge",
    "FlankAdhesion",
    "FlankFriction",
    "JuiceFilm",
    "SerratedEdge",
]


class FlankFriction(Effect):
    """More friction on the flanks, by the share `size`, with the memory of bristles (LuGre).

    The bristles' mean deflection b follows b' = |v| (g(v) - b) / travel, with g falling from
    `static` at rest to 1 (Stribeck), and a part goes with speed.
    """

    cause = "flank friction"
    typical = 1.0
    travel = 3e-4
    static = 1.4
    stribeck_speed = 8e-3
    viscous = 2.0

    _bristles = 0.0

    def drive(self, now: Now) -> None:
        speed = now.speed
        steady = 1.0 + (self.static - 1.0) * np.exp(-((speed / self.stribeck_speed) ** 2))
        follow = -np.expm1(-speed * now.period / self.travel)
        self._bristles += follow * (steady - self._bristles)
        now.friction *= 1.0 + self.size * (self._bristles + self.viscous * speed)


class FlankAdhesion(Effect):
    """Food that sticks to the flanks: `size` per area of flank in front of cut food, and as much
    again at `reference` speed, growing as its root.

    It opposes the last motion and turns round over `turn` of travel.
    """

    cause = "adhesion"
    unit = "Pa"
    typical = 600.0
    least = 0.0
    reference = 0.02
    turn = 5e-5

    def respond(self, series: Series) -> None:
        speed = np.linalg.norm(series.v, axis=1)
        direction = np.zeros(3)
        for k in np.flatnonzero(series.flank > 0.0):
            if speed[k] > 1e-9:
                keep = np.exp(-speed[k] * series.period / self.turn)
                direction = keep * direction + (1.0 - keep) * series.v[k] / speed[k]
            stress = self.size * (1.0 + np.sqrt(speed[k] / self.reference))
            force = -stress * series.flank[k] * direction
            series.other[k, :3] += np.cross(series.flank_arm[k], force)
            series.other[k, 3:] += force


class BluntEdge(Effect):
    """An edge that needs more to begin: the excess falls as 1 / (1 + (s / l)^2) with its path s in
    the food, so that a draw is soon through. `size` is the excess at the surface over the
    toughness."""

    cause = "blunt edge"
    typical = 0.8
    length = 2.5e-3

    def drive(self, now: Now) -> None:
        now.toughness *= 1.0 + self.size / (1.0 + (now.travel / self.length) ** 2)


class DullingEdge(BluntEdge):
    """An edge that grows blunt with the slices n, as n / (n + half): `size` is what it comes to."""

    cause = "dulling"
    typical = 1.2
    half = 6.0

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self.size *= facts.index / (facts.index + self.half)


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
