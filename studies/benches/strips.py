"""Elastic strips side by side across the section, which tear from the top and relax.

Each strip stands on the board as a spring k = E dx b / (height left), with a Maxwell arm beside it
(a standard linear solid: Zener 1948) and shear springs to its neighbours. The edge presses down
those that it reaches; others are drawn along by their neighbours. A strip tears where the force on
it reaches its tearing force R dx, more to begin with than to go on (initiation above propagation,
as in the force-displacement curves of Moreno-Mateos and Steinmann, arXiv 2507.13565). A draw drags
the tops sideways, and the two forces add to the tear by

    f_z^2 + (f_x / beta)^2 = (R dx)^2,

an ellipse of mixed modes in place of Atkins' work per area. Flanks are pressed by what is buried,
the fresh part of it more, as it relaxes too (Brown 2005 measures friction in a second pass).
"""

import dataclasses as dc

import numpy as np
from scipy.linalg import solve_banded

from sliceit_drake.stand_in.protocol import Specimen
from studies.benches.law_world import Cut, Heading
from studies.benches.section import COLUMNS, Section

__all__ = ["Strips"]

COUNT = 64
"""Strips across the section; their cells are fewer."""


@dc.dataclass(frozen=True)
class Strips:
    """Constants; `drawn` says where they come from."""

    toughness: float = 400.0
    """R, J/m^2."""
    modulus: float = 1e6
    """E, Pa."""
    breadth: float = 0.012
    """b, of the strips across the blade, metres."""
    bed: float = 4e-3
    """Height of what gives under them, metres."""
    shear: float = 0.3
    """Stiffness to a neighbour, and of the tops along the edge, over that of a strip."""
    initiation: float = 0.4
    """Share that tearing takes more to begin with."""
    mixed: float = 0.8
    """beta."""
    relaxing: float = 0.3
    """Stiffness of the Maxwell arm over that of the strip."""
    relaxation: float = 0.6
    """Its time, s."""
    pressure: float = 4e3
    """On the flanks, relaxed, Pa."""
    fresh: float = 0.6
    """Share by which it is greater at first."""
    friction: float = 0.25
    """Coulomb's."""
    turn: float = 3e-4
    """Way over which friction turns round, metres."""
    wedge: float = 0.03
    """Slope of the flanks."""
    aside: float = 0.0
    """Share of the flanks' pressure that one side has more than the other."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Strips":
        """Constants of a food and a knife.

        Toughness, friction, pressure as in `slice_push`. Modulus: 0.6 to 3 MPa of vegetables
        (configurations of DiSECt and SliceIt!; apple 3.0, potato 2.0, cucumber 2.5 MPa). Relaxing
        share and time: potatoes' modulus varies by up to 54 % with the strain rate (Mechanics &
        Industry 21:404, 2020), tenths of seconds to seconds. Initiation: the first peak of skinned
        foods stands 0.1 to 0.8 above the plateau in the measured curves. Shear: 1 / (2 (1 + nu))
        and less. Breadth, bed, beta: no source, wide.
        """
        return cls(
            toughness=float(rng.uniform(150.0, 600.0)),
            modulus=float(np.exp(rng.uniform(np.log(6e5), np.log(3e6)))),
            breadth=float(rng.uniform(5e-3, 0.015)),
            bed=float(rng.uniform(2e-3, 8e-3)),
            shear=float(rng.uniform(0.1, 0.4)),
            initiation=float(rng.uniform(0.1, 0.8)),
            mixed=float(rng.uniform(0.4, 1.0)),
            relaxing=float(rng.uniform(0.1, 0.54)),
            relaxation=float(np.exp(rng.uniform(np.log(0.2), np.log(2.0)))),
            pressure=float(np.exp(rng.uniform(np.log(1.5e3), np.log(8e3)))),
            fresh=float(rng.uniform(0.2, 1.0)),
            friction=float(rng.uniform(0.1, 0.5)),
            turn=float(rng.uniform(1e-4, 5e-4)),
            wedge=float(rng.uniform(0.015, 0.035)),
            aside=float(rng.uniform(-0.01, 0.01)),
        )

    def begin(self, section: Section, specimen: Specimen, x: float, z: float) -> Cut:
        """See `Law`."""
        return _StripsCut(self, section, specimen, x, z)


class _StripsCut(Cut):
    def __init__(
        self, law: Strips, section: Section, specimen: Specimen, x: float, z: float
    ) -> None:
        self.law, self.section = law, section
        left, right = float(section.left.min()), float(section.right.max())
        self._dx = (right - left) / COUNT
        self.x = left + self._dx * (np.arange(COUNT) + 0.5)
        inside = (section.left[:, None] <= self.x) & (self.x <= section.right[:, None])
        inside[:, ~inside.any(0)] = False
        rows = np.arange(len(section.z))[:, None]
        lowest = np.where(inside, rows, len(rows)).min(0)
        highest = np.where(inside, rows, -1).max(0)
        self._bottom = section.bottom + section.row * lowest
        self._top = np.maximum(section.bottom + section.row * (highest + 1), self._bottom)
        self.end = self._top.copy()
        # Cells of the section are relative to its width in each row, strips are not.
        place = (self.x - section.left[:, None]) / np.maximum(section.width[:, None], 1e-9)
        cell = np.clip((place * COLUMNS).astype(int), 0, COLUMNS - 1)
        tear = law.toughness * specimen.toughness * self._dx
        self._tear = tear * np.take_along_axis(section.toughness, cell, 1)
        soft = np.take_along_axis(section.stiffness, cell, 1)
        self._modulus = (
            law.modulus * specimen.stiffness * (soft * inside).sum(0) / np.maximum(inside.sum(0), 1)
        )
        self._friction = 2.0 * law.friction * specimen.friction
        self._pressure = law.pressure * specimen.stiffness
        self._heading = Heading(law.turn)
        self._at = np.array([x, z])
        self._pushed = np.zeros(COUNT)
        self._dragged = np.zeros(COUNT)
        self._arm = np.zeros(COUNT)
        self._torn = np.zeros(COUNT, bool)
        self._buried, self._lately = 0.0, 0.0

    def advance(
        self, period: float, x: float, z: float, toughness: float, friction: float
    ) -> np.ndarray:
        law, section, at = self.law, self.section, np.array([x, z])
        step, self._at = at - self._at, at
        forces = np.zeros((3, 3))
        if z >= section.top:
            return forces
        self._heading.move(step)
        down, along = self._strips(period, float(step[0]), z, toughness)
        total = float(down.sum())
        forces[0] = [-float(along.sum()), 0.0, total]
        if total > 1e-9:
            self.middle = float(down @ self.x) / total
        buried = section.above(z)
        fade = float(np.exp(-period / law.relaxation))
        fresh = fade * self._lately + max(buried - self._buried, 0.0)
        self._lately, self._buried = min(fresh, buried), buried
        flanks = self._pressure * (buried + law.fresh * self._lately)
        forces[1] = [0.0, law.aside * flanks, 2.0 * law.wedge * flanks]
        rubs = -self._friction * friction * flanks * self._heading.vector
        forces[2] = [rubs[0], 0.0, rubs[1]]
        return forces

    def _strips(
        self, period: float, drawn: float, z: float, toughness: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Forces of the strips on the edge, up and against the draw [COUNT] each, N."""
        law = self.law
        height = np.maximum(self.end - self._bottom, 0.0)
        stiffness = self._modulus * self._dx * law.breadth / (height + law.bed) * (height > 0.0)
        touching = (self.end > z) & (height > 0.0)
        coupling = law.shear * float(stiffness.max(initial=0.0))
        neighbours = np.full(COUNT, 2.0)
        neighbours[[0, -1]] = 1.0
        diagonal = stiffness + coupling * neighbours + 1e-6
        pushed = self._pushed_by(touching, z, diagonal, coupling)
        keep = float(np.exp(-period / law.relaxation))
        arm = law.relaxing * stiffness
        rise = arm * (pushed - self._pushed) * (1.0 - keep) * law.relaxation / period
        self._arm = np.maximum(keep * self._arm + rise, 0.0) * touching
        beside = np.zeros(COUNT)
        beside[1:] += pushed[:-1]
        beside[:-1] += pushed[1:]
        down = np.maximum(diagonal * pushed - coupling * beside + self._arm, 0.0) * touching
        dragging = law.shear * stiffness
        self._dragged = (self._dragged + drawn) * touching
        along = dragging * self._dragged
        row = ((self.end - self.section.bottom) / self.section.row).astype(int) - 1
        row = np.clip(row, 0, len(self._tear) - 1)
        tear = toughness * self._tear[row, np.arange(COUNT)]
        tear = tear * np.where(self._torn, 1.0, 1.0 + law.initiation)
        load = np.hypot(down, along / law.mixed)
        tearing = (load > tear) & touching
        kept = np.where(tearing, tear / np.maximum(load, 1e-12), 1.0)
        # The top moves down until the strip carries what it can: all that it carries falls alike.
        gives = (1.0 - kept) * down / np.maximum(diagonal + arm, 1e-9)
        self.end = np.maximum(self.end - gives, np.maximum(self._bottom, np.minimum(z, self.end)))
        self._torn |= tearing
        self._arm *= kept
        self._dragged *= kept
        self._pushed = np.where(touching, np.maximum(self.end - z, 0.0), pushed)
        return kept * down, kept * along

    def _pushed_by(
        self, touching: np.ndarray, z: float, diagonal: np.ndarray, coupling: float
    ) -> np.ndarray:
        """How far each top is down: the edge's way where it touches, in balance elsewhere."""
        if not touching.any():
            return np.zeros(COUNT)
        bands = np.zeros((3, COUNT))
        bands[1] = np.where(touching, 1.0, diagonal)
        bands[0, 1:] = np.where(touching[:-1], 0.0, -coupling)
        bands[2, :-1] = np.where(touching[1:], 0.0, -coupling)
        return np.asarray(
            solve_banded((1, 1), bands, np.where(touching, self.end - z, 0.0), check_finite=False)
        )
