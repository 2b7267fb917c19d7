"""Bonds across the cut and a blade that presses them apart by penalty, integrated in time.

The cut is a column of rows, each with two faces that part by 2 y. A bond joins them whose traction
rises to its strength at a fifth of the length at which it is gone and falls in a straight line
(damage: it unloads to the origin); its area is the toughness R. Behind a face stands the slab, a
spring and a dashpot. The blade's half thickness h over its height is a convex section with a bevel,
and where a face is nearer than h it is pressed by stiffness times penetration, along the section's
normal, with Stribeck's friction:

    c y' + k y + T(2 y) = k_p max(0, h - y)

Springs across a cut that soften linearly, a blade as a signed distance with a penalty force and
friction between rest and sliding are what DiSECt describes (Heiden et al. 2021); equations and code
are ours. Along the edge faces are dragged by friction over a small way, which opens the bonds
further. All of the section gives as a spring before it is cut.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.stand_in.protocol import Specimen
from studies.benches.law_world import Cut, Heading
from studies.benches.section import Section

__all__ = ["Bonds"]

PENALTY = 1e12
"""k_p, Pa/m: a bond at its strongest lets the blade sink in by some micrometres."""
PEAK = 0.2
"""Opening at which a bond is strongest, over that at which it is gone."""
ROUNDING = 2.5e-4
"""Over which the section of the blade is averaged: more than a row, metres."""


@dc.dataclass(frozen=True)
class Bonds:
    """Constants; `drawn` says where they come from."""

    toughness: float = 200.0
    """R, J/m^2."""
    length: float = 3e-4
    """Opening at which a bond is gone, metres."""
    slab: float = 6e6
    """k, Pa/m."""
    memory: float = 0.1
    """c / k, s."""
    stiffness: float = 6e3
    """Of the whole section under the edge, N/m."""
    settling: float = 0.03
    """Time in which that follows, s."""
    friction: float = 0.15
    """Sliding."""
    at_rest: float = 1.5
    """Friction at rest over it."""
    stribeck: float = 0.01
    """Speed between the two, m/s."""
    turn: float = 4e-4
    """Way over which friction turns round, metres."""
    drag: float = 1e-4
    """Way by which a draw drags the faces, metres."""
    bevel_slope: float = 0.27
    """Half thickness of the bevel over its height."""
    bevel: float = 1e-3
    """Height of the bevel, metres."""
    slope: float = 0.03
    """Of the flanks above it."""
    aside: float = 0.0
    """Share of the flanks' pressure that one side has more than the other."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Bonds":
        """Constants of a food and a knife.

        Toughness and friction as in `slice_push`, less what the bevel's friction adds to the work:
        it is the sum that was measured. Length: 2 R / strength, with 0.1 to 1 MPa of crisp
        vegetables in tension (calibration/setups), but no more than a bevel opens. Friction at
        rest: 0.5 over sliding at transition speeds is in DiSECt's contact. The slab's time:
        relaxation of vegetables in tenths of seconds (Mechanics & Industry 21:404, 2020, finds rate
        dependence of up to 54 %). First stiffness: 4 to 5 kN/m in the measured curves, taken as 3
        to 10. Slab, drag: no source, wide. Knives: 7 to 15 degrees to a side, above it 1 to 2.
        """
        return cls(
            toughness=float(rng.uniform(80.0, 250.0)),
            length=float(rng.uniform(2e-4, 4e-4)),
            slab=float(np.exp(rng.uniform(np.log(1.5e6), np.log(1.2e7)))),
            memory=float(np.exp(rng.uniform(np.log(0.03), np.log(0.4)))),
            stiffness=float(rng.uniform(3e3, 1e4)),
            settling=float(rng.uniform(0.02, 0.06)),
            friction=float(rng.uniform(0.08, 0.25)),
            at_rest=float(rng.uniform(1.0, 2.0)),
            stribeck=float(rng.uniform(3e-3, 3e-2)),
            turn=float(rng.uniform(3e-4, 8e-4)),
            drag=float(rng.uniform(5e-5, 2.5e-4)),
            bevel_slope=float(rng.uniform(0.15, 0.28)),
            bevel=float(rng.uniform(1e-3, 1.6e-3)),
            slope=float(rng.uniform(0.015, 0.035)),
            aside=float(rng.uniform(-0.01, 0.01)),
        )

    def begin(self, section: Section, specimen: Specimen, x: float, z: float) -> Cut:
        """See `Law`."""
        return _BondsCut(self, section, specimen, x, z)


class _BondsCut(Cut):
    def __init__(
        self, law: Bonds, section: Section, specimen: Specimen, x: float, z: float
    ) -> None:
        self.law, self.section = law, section
        self._area = section.width * section.row
        toughness = law.toughness * specimen.toughness * section.toughness.mean(1)
        self._strength = 2.0 * toughness / law.length
        self._slab = law.slab * specimen.stiffness * section.stiffness.mean(1)
        self._stiffness = law.stiffness * specimen.stiffness
        self._friction = law.friction * specimen.friction
        self._heading = Heading(law.turn)
        self._at = np.array([x, z])
        self._given = 0.0
        self.half = np.zeros(len(section.z))
        self.opened = np.zeros(len(section.z))
        self._up = np.linspace(-2.0 * ROUNDING, section.top + 0.02, 2000)
        sharp = np.minimum(law.bevel_slope * self._up, law.bevel_slope * law.bevel)
        sharp += law.slope * np.maximum(self._up - law.bevel, 0.0)
        window = np.hanning(max(3, round(2.0 * ROUNDING / (self._up[1] - self._up[0]))))
        padded = np.pad(np.maximum(sharp, 0.0), len(window), mode="edge")
        smooth = np.convolve(padded, window / window.sum(), mode="same")
        self._blade = smooth[len(window) : -len(window)]
        self._slope = np.gradient(self._blade, self._up)

    def traction(self, opening: np.ndarray, strength: np.ndarray) -> np.ndarray:
        """Of bonds at openings that they have not seen before [ROWS], Pa."""
        length = self.law.length
        rises = opening / (PEAK * length)
        falls = (length - opening) / ((1.0 - PEAK) * length)
        return np.asarray(strength * np.clip(np.minimum(rises, falls), 0.0, None))

    def advance(
        self, period: float, x: float, z: float, toughness: float, friction: float
    ) -> np.ndarray:
        law, section, at = self.law, self.section, np.array([x, z])
        step, self._at = at - self._at, at
        forces = np.zeros((3, 3))
        if z >= section.top and self._given == 0.0 and not self.opened.any():
            return forces
        self._heading.move(step)
        up = section.z - (z + self._given)
        blade = np.interp(up, self._up, self._blade)
        slope = np.interp(up, self._up, self._slope) * (blade > 0.0)
        drag = law.drag * abs(float(self._heading.vector[0])) * (blade > 0.0)
        # The bond's secant at the opening that the blade imposes.
        wide = np.maximum(self.opened, np.hypot(2.0 * blade, drag))
        wide = np.maximum(wide, 1e-9)
        secant = self.traction(wide, toughness * self._strength) / wide
        dashpot = law.memory * self._slab / period
        resists = dashpot + self._slab + 2.0 * secant
        free = dashpot * self.half / resists
        pressed = (dashpot * self.half + PENALTY * blade) / (resists + PENALTY)
        self.half = np.where(free < blade, pressed, free)
        touching = self.half < blade
        pressure = PENALTY * np.maximum(blade - self.half, 0.0)
        self.opened = np.where(
            touching, np.maximum(self.opened, np.hypot(2.0 * self.half, drag)), self.opened
        )
        pressing = pressure * self._area
        bonds = 2.0 * secant * self.half / np.maximum(self._slab * self.half, 1e-12)
        share = bonds / (1.0 + bonds)
        forces[0, 2] = 2.0 * float(pressing @ (slope * share))
        forces[1, 2] = 2.0 * float(pressing @ (slope * (1.0 - share)))
        total = float(pressing.sum())
        forces[1, 1] = law.aside * total
        speed = float(np.hypot(*step)) / period
        slips = 1.0 + (law.at_rest - 1.0) * np.exp(-((speed / law.stribeck) ** 2))
        rubs = -2.0 * self._friction * friction * slips * total * self._heading.vector
        forces[2] = [rubs[0], 0.0, rubs[1]]
        self.middle = 0.5 * (section.at(section.left, z) + section.at(section.right, z))
        # The food gives under the edge as a whole, which rides on what is not cut yet. Implicit: as
        # it gives, the force falls along what has been opened.
        stiff = PENALTY * resists / (resists + PENALTY) * touching * slope * self._area
        rubbing = self._friction * friction * slips * abs(float(self._heading.vector[1]))
        falls = 2.0 * float(stiff @ (slope + rubbing)) / self._stiffness
        follow = -np.expm1(-period / law.settling)
        lacks = max(float(forces[:, 2].sum()), 0.0) / self._stiffness - self._given
        self._given += follow * lacks / (1.0 + follow * falls)
        if abs(self._given) < 1e-9:
            self._given = 0.0
        return forces
