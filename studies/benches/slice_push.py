"""Slice-push with wedge and friction: fracture work per area, a spring before it, flanks that rub.

The end of the cut lags behind the edge by u = (u_x, u_z), which the food's stiffness k per width
resists: F = k w (s u_x, u_z). The end moves on along u at the speed v at which the work of the
force is that of the fracture, F . u/|u| = R w u_z/|u| (v / v_0)^m. In a steady cut u has the
direction of the motion, and with s = 1 this is Atkins' F_V = R w / (1 + xi^2), F_H = xi F_V
(Atkins, Xu, Jeronimidis 2004; Atkins 2016, Interface Focus, PMC4843631). Toughness as a power of
the crack's speed is Williams' (Fracture Mechanics of Polymers, 1984), and makes a held edge relax,
F ~ t^-(m/(1-m)). A spring before the fracture is the elastic loading before initiation of
Moreno-Mateos and Steinmann (arXiv 2507.13565). The flanks are pressed over a contact length that
grows with depth up to a limit, and a bevel of half angle beta with its own pressure wedges
(Williams and Patel 2016, Interface Focus).
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.stand_in.protocol import Specimen
from studies.benches.law_world import Cut, Heading
from studies.benches.section import Section

__all__ = ["SlicePush"]

CRACK_SPEED = 0.02
"""v_0, m/s."""
LAYER = 5e-3
"""Height of the uncut rest at which the board under it doubles its stiffness, metres."""
OPENED = 5e-3
"""Way up over which a cut takes its set, metres."""


@dc.dataclass(frozen=True)
class SlicePush:
    """Constants; `drawn` says where they come from."""

    toughness: float = 400.0
    """R, J/m^2."""
    stiffness: float = 2.5e5
    """k, of the food under the edge per width, N/m^2."""
    rate: float = 0.07
    """m."""
    shear: float = 1.0
    """s, of the stiffness along the edge over that down."""
    pressure: float = 5e3
    """Of the food on the flanks, Pa."""
    contact: float = 0.02
    """Greatest length of contact on the flanks, metres."""
    friction: float = 0.25
    """Coulomb's."""
    turn: float = 3e-4
    """Way over which friction turns round, metres."""
    bevel_angle: float = 0.2
    """Half angle beta, rad."""
    bevel_pressure: float = 4e4
    """Pa."""
    bevel: float = 1e-3
    """Height of the bevel, metres."""
    set: float = 0.2
    """Share of the pressure that an opened cut has lost."""
    aside: float = 0.0
    """Share of the flanks' pressure that one side has more than the other."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "SlicePush":
        """Constants of a food and a knife.

        Toughness: apparent work of cutting 467 to 644 J/m^2 in the measured curves (friction
        included), 1,230 to 1,350 of potatoes at fracture (Schoorl and Holt 1983). Stiffness: 0.6 to
        3 MPa of vegetables (configurations of DiSECt and SliceIt!) times 0.1 to 0.2, the stiffness
        of a half space under a strip. Rate: forces in cheese, bacon and vegetables go up or hardly
        with speed (Brown 2005; Singh, Das and Das 2016), N(0.05, 0.1) cut to 0.02 to 0.2. Friction:
        0.1 to 0.5, none is published for wet vegetables on steel; it is a constant share of the
        force (Brown 2005), from which the pressure. Bevel 7 to 15 degrees to a side, as knives are
        sold. What has no source is wide: shear, contact length, set.
        """
        return cls(
            toughness=float(rng.uniform(150.0, 600.0)),
            stiffness=float(np.exp(rng.uniform(np.log(1e5), np.log(5e5)))),
            rate=float(np.clip(rng.normal(0.05, 0.1), 0.02, 0.2)),
            shear=float(rng.uniform(0.5, 1.0)),
            pressure=float(np.exp(rng.uniform(np.log(1.5e3), np.log(8e3)))),
            contact=float(rng.uniform(6e-3, 0.03)),
            friction=float(rng.uniform(0.1, 0.5)),
            turn=float(rng.uniform(1e-4, 5e-4)),
            bevel_angle=float(rng.uniform(0.12, 0.26)),
            bevel_pressure=float(rng.uniform(1e4, 6e4)),
            bevel=float(rng.uniform(5e-4, 1.5e-3)),
            set=float(rng.uniform(0.0, 0.4)),
            aside=float(rng.uniform(-0.01, 0.01)),
        )

    def begin(self, section: Section, specimen: Specimen, x: float, z: float) -> Cut:
        """See `Law`."""
        return _SlicePushCut(self, section, specimen, x, z)


class _SlicePushCut(Cut):
    def __init__(
        self, law: SlicePush, section: Section, specimen: Specimen, x: float, z: float
    ) -> None:
        self.law, self.section = law, section
        self._friction = 2.0 * law.friction * specimen.friction
        self._toughness = (
            law.toughness * specimen.toughness * section.width * section.toughness.mean(1)
        )
        self._stiffness = (
            law.stiffness * specimen.stiffness * section.width * section.stiffness.mean(1)
        )
        self._pressure = law.pressure * specimen.stiffness
        self._heading = Heading(law.turn)
        self._at = np.array([x, z])
        self._end = np.array([x, section.top])
        self._opened = 0.0

    def advance(
        self, period: float, x: float, z: float, toughness: float, friction: float
    ) -> np.ndarray:
        law, section, at = self.law, self.section, np.array([x, z])
        step, self._at = at - self._at, at
        forces = np.zeros((3, 3))
        if z >= section.top:
            return forces
        self._heading.move(step)
        self._opened += max(float(step[1]), 0.0) / OPENED
        self.middle = 0.5 * (section.at(section.left, z) + section.at(section.right, z))
        pressure = self._pressure * (1.0 - law.set * -np.expm1(-self._opened))
        edge = self._edge(period, toughness)
        forces[0] = [edge[0], 0.0, edge[1]]
        flanks = pressure * (section.above(z) - section.above(z + law.contact))
        # Below the food there is none on the bevel.
        width = section.at(section.width, z) * (z > section.bottom)
        bevel = law.bevel_pressure * law.bevel * width * pressure / max(law.pressure, 1e-12)
        forces[1] = [0.0, law.aside * flanks, 2.0 * bevel * np.sin(law.bevel_angle)]
        rubs = -self._friction * friction * (flanks + bevel) * self._heading.vector
        forces[2] = [rubs[0], 0.0, rubs[1]]
        return forces

    def _edge(self, period: float, toughness: float) -> np.ndarray:
        """Force of what is not cut yet, along x and up [2], N."""
        law, section = self.law, self.section
        lag = self._at - self._end
        height = self._end[1] - section.bottom
        if lag[1] >= 0.0 or height <= 0.0:
            # In an open cut the edge meets nothing.
            self._end[0] = self._at[0]
            return np.zeros(2)
        length = float(np.hypot(*lag))
        along = lag / length
        soft = section.at(self._stiffness, self._end[1]) * (1.0 + LAYER / height)
        stiffness = soft * np.array([law.shear, 1.0])
        resists = toughness * section.at(self._toughness, self._end[1]) * -along[1]
        critical = resists / float(stiffness @ along**2)
        left = critical * _lag(length / critical, period * CRACK_SPEED / critical, law.rate)
        self._end += (length - left) * along
        self._end[1] = max(self._end[1], section.bottom)
        return np.asarray(-stiffness * left * along)


def _lag(lag: float, way: float, rate: float) -> float:
    """y of y + way y^(1 / rate) = lag: the lag, over the critical one, when the end has moved."""
    if rate < 1e-3:
        return min(lag, 1.0)
    power = 1.0 / rate
    # Convex, and both are bounds from above: Newton's method comes down to the root.
    y = min(lag, (lag / way) ** rate)
    for _ in range(50):
        grown = way * y**power
        change = (y + grown - lag) / (1.0 + power * grown / y)
        y -= change
        if change < 1e-10 * y:
            break
    return y
