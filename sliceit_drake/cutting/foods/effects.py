"""What the base model leaves out: parameter groups whose default changes nothing.

Forms and their signatures in measured forces are those of docs/explanation/physics.md, "Effects".
"""

import dataclasses as dc
from collections.abc import Mapping
from typing import Self

import numpy as np

from sliceit_drake.configuration import ConfigurationError, quantity

__all__ = [
    "LINEAR_BELOW",
    "Adhesion",
    "Bluntness",
    "Centre",
    "Compliance",
    "Core",
    "Edge",
    "Effects",
    "Entry",
    "Outside",
    "Relaxation",
    "Resting",
    "Section",
    "Skin",
    "SlicePush",
    "Slip",
    "ToughnessRate",
    "Underside",
]


LINEAR_BELOW = 0.1
"""Fraction of its reference speed below which adhesion goes linearly with the speed."""


@dc.dataclass
class ToughnessRate:
    """Toughness that goes with the speed v of the edge: R (v / reference_speed)^exponent.

    v is not taken below a thousandth of the reference: an edge at rest has a force left.
    """

    exponent: float = quantity(0.0, "", low=-1.0, high=1.0)
    """0 for none."""
    reference_speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Speed at which the toughness is the material's."""


@dc.dataclass
class Relaxation:
    """Viscoelastic bulk: Maxwell branches in parallel with a spring (Prony series).

    E is the instantaneous modulus; a fraction of it relaxes with each time.
    """

    shares: list[float] = dc.field(default_factory=list)
    """Fraction of E that each branch relaxes; empty for none."""
    times: list[float] = dc.field(default_factory=list)
    """Relaxation times, s."""

    def joined(self, branches: Mapping[float, float]) -> Self:
        """The same with further branches: shares by time, s."""
        shares = [*self.shares, *branches.values()]
        return dc.replace(self, shares=shares, times=[*self.times, *branches])

    def check(self, where: str) -> None:
        if len(self.shares) != len(self.times):
            raise ConfigurationError(
                f"has {len(self.shares)} shares and {len(self.times)} times",
                field=f"{where}.times",
                fix="Give one time for each share.",
            )
        shares, times = np.array(self.shares), np.array(self.times)
        if not (np.isfinite(shares).all() and (shares >= 0.0).all() and shares.sum() < 0.99):
            raise ConfigurationError(
                f"= {self.shares} is no split of the modulus",
                field=f"{where}.shares",
                fix="Give fractions of at least 0 that sum to less than 0.99.",
            )
        if not (np.isfinite(times).all() and (times > 0.0).all()):
            raise ConfigurationError(
                f"= {self.times} s holds a time that is not positive",
                field=f"{where}.times",
                fix="Give times above 0 s.",
            )


RESTING = 2e-4
"""Speed below which a knife rests, m/s."""


@dc.dataclass
class Resting(Relaxation):
    """Force on a knife that rests in the food: around an edge at rest the food flows, where one
    that moves always meets fresh food.

    Each share of the food's force fades with its time while the knife rests, and comes back over
    `travel`. A decade apart, branches together follow a power law of time within a few per cent.
    """

    travel: float = quantity(5e-4, "m", low=1e-6, high=0.1)
    """Way of the knife over which a force that faded comes back to 1 - 1/e."""

    def faded(
        self, held: np.ndarray, speed: np.ndarray, touches: np.ndarray, period: float
    ) -> np.ndarray:
        """How far each branch has come [N, M] at the ends of coupling steps.

        Args:
            held: The same before the first step [M].
            speed: Of the knife in each step [N], m/s.
            touches: Whether it touches food in each step [N].
            period: Of the steps, s.
        """
        rests = touches & (speed < RESTING)
        times, way = np.array(self.times, float), speed * period / self.travel
        out = np.empty((len(speed), len(times)))
        ends = [*np.flatnonzero(rests[1:] != rests[:-1]) + 1, len(speed)]
        for begin, end in zip([0, *ends], ends, strict=False):
            if rests[begin]:
                spent = period * np.arange(1.0, end - begin + 1.0)
                out[begin:end] = 1.0 - (1.0 - held) * np.exp(-spent[:, None] / times)
            else:
                out[begin:end] = held * np.exp(-np.cumsum(way[begin:end]))[:, None]
            held = out[end - 1]
        return out


@dc.dataclass
class Section:
    """A section that is wider below, or in the middle, than its shape says: cut points stand for
    more of it, or less."""

    taper: float = quantity(0.0, "", low=-0.5, high=0.5)
    """Share by which it is wider at the bottom, and less wide at the top."""
    belly: float = quantity(0.0, "", low=-0.5, high=0.5)
    """Twice the share by which it is wider in the middle, and less wide at top and bottom."""

    def width(self, up: np.ndarray) -> np.ndarray:
        """Factor on the width at heights from -1, the bottom, to 1, the top."""
        up = np.clip(up, -1.0, 1.0)
        return np.asarray(1.0 - self.taper * up + self.belly * (0.5 - up**2))


@dc.dataclass
class Outside:
    """Food that is tougher towards the outside by exp(-distance / thickness): all that parts there,
    by the edge or ahead of it, where `Skin` is cut by the edge alone."""

    toughness: float = quantity(0.0, "J/m", low=0.0, high=100.0)
    """Energy per length of outline, more than the food's."""
    thickness: float = quantity(1e-3, "m", low=5e-5, high=2e-2)
    """Distance from the outside over which it falls to 1/e."""


@dc.dataclass
class Entry:
    """Food that is harder to begin to cut: all that parts near the top is tougher, by the edge or
    ahead of it, where `Bluntness` is of the edge alone and of each place of the outside.

    The excess is that of a blunt edge, and after n slices that of one that has dulled.
    """

    initiation: float = quantity(0.0, "J/m2", low=0.0, high=1e5)
    """Excess over R where the edge enters the food."""
    depth: float = quantity(2e-3, "m", low=1e-4, high=0.05)
    """Depth over which it falls to 1/e."""
    dulling: float = quantity(0.0, "J/m2", low=0.0, high=1e5)
    """Growth of the excess by ten slices."""
    dulling_depth: float = quantity(2e-3, "m", low=1e-4, high=0.05)
    """Depth over which that falls to 1/e."""
    dulling_exponent: float = quantity(1.0, "", low=0.1, high=3.0)
    """Exponent of the slice number."""
    slices: int = quantity(0, "", low=0, high=100000)
    """Slices cut since sharpening; a record that gives them takes the place of this."""

    def excesses(self) -> list[tuple[float, float]]:
        """Excess at the top, J/m^2, and depth, metres, of each of the two."""
        grown = self.dulling * (self.slices / 10.0) ** self.dulling_exponent
        return [(self.initiation, self.depth), (grown, self.dulling_depth)]


@dc.dataclass
class Skin:
    """A skin around the section, cut on the way in and on the way out.

    It is punctured where the edge presses on it with its `line_load`: a round soft food gives way
    around the blade until then.
    """

    toughness: float = quantity(0.0, "J/m", low=0.0, high=100.0)
    """Energy per length of skin: its toughness x thickness."""
    thickness: float = quantity(3e-4, "m", low=5e-5, high=5e-3)
    """Depth of the edge over which a level skin is cut."""

    @property
    def line_load(self) -> float:
        """Force per length of edge that punctures it, N/m."""
        return self.toughness / self.thickness


@dc.dataclass
class Core:
    """An inner part of another toughness and stiffness, as of seeds or gel."""

    rind: float = quantity(5e-3, "m", low=0.0, high=0.1)
    """Distance from the outside at which the core begins."""
    transition: float = quantity(1e-3, "m", low=1e-5, high=0.05)
    """Width of the transition."""
    toughness_ratio: float = quantity(1.0, "", low=0.01, high=10.0)
    """Core over rind."""
    stiffness_ratio: float = quantity(1.0, "", low=0.01, high=10.0)
    """Core over rind."""
    offset: list[float] = quantity([0.0, 0.0], "m", low=-0.1, high=0.1, size=2)
    """How far off the middle, along the edge and upwards (x and z of the cut's frame C)."""

    def check(self, where: str) -> None:
        _check_offset(self.offset, self.rind, "rind", where)

    def share(self, distance: np.ndarray) -> np.ndarray:
        """How much of the core is at a distance from the outside: 0 outside, 1 inside."""
        return _inside(distance, self.rind, self.transition)


@dc.dataclass
class Centre:
    """A middle of another toughness, as of the columella between a tomato's chambers."""

    distance: float = quantity(0.018, "m", low=0.0, high=0.1)
    """From the outside to where the middle begins."""
    transition: float = quantity(1e-3, "m", low=1e-5, high=0.05)
    """Width of the transition."""
    toughness_ratio: float = quantity(1.0, "", low=0.01, high=100.0)
    """Middle over what is around it."""
    offset: list[float] = quantity([0.0, 0.0], "m", low=-0.1, high=0.1, size=2)
    """How far off the food's middle, along the edge and upwards (x and z of the cut's frame C)."""

    def check(self, where: str) -> None:
        _check_offset(self.offset, self.distance, "distance", where)

    def share(self, distance: np.ndarray) -> np.ndarray:
        """How much of the middle is at a distance from the outside: 0 outside, 1 inside."""
        return _inside(distance, self.distance, self.transition)


@dc.dataclass
class Underside:
    """A bottom of another toughness, as of the last wall of a fruit, which parts by itself where it
    is pressed on the board."""

    height: float = quantity(8e-3, "m", low=0.0, high=0.1)
    """From the food's lowest point to where the bottom ends."""
    transition: float = quantity(1e-3, "m", low=1e-5, high=0.05)
    """Width of the transition."""
    toughness_ratio: float = quantity(1.0, "", low=0.01, high=10.0)
    """Bottom over what is above it."""

    def share(self, up: np.ndarray) -> np.ndarray:
        """How much of the bottom is at a height above the food's lowest point: 1 below, 0 above."""
        return _inside(self.height - np.asarray(up), 0.0, self.transition)


def _check_offset(offset: list[float], around: float, name: str, where: str) -> None:
    """Refuses an inner part that is moved out of the food."""
    if np.linalg.norm(offset) > around:
        raise ConfigurationError(
            f"{offset} m moves it out of the food, of which {name} leaves {around:g} m around it",
            field=f"{where}.offset",
            fix=f"Give an offset of at most {around:g} m, or a greater {where}.{name}.",
        )


def _inside(distance: np.ndarray, start: float, width: float) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(2.0 * (np.asarray(distance) - start) / width))


@dc.dataclass
class Bluntness:
    """A blunt edge needs more to begin a cut: an excess over R that decays with the edge's depth.

    After n slices the excess at the surface is `initiation` + `dulling` n^`dulling_exponent`.
    """

    initiation: float = quantity(0.0, "J/m2", low=0.0, high=1e5)
    """Excess over R where the edge enters the food."""
    depth: float = quantity(2e-3, "m", low=1e-4, high=0.05)
    """Depth over which the excess falls to 1/e."""
    dulling: float = quantity(0.0, "J/m2", low=0.0, high=1e5)
    """Growth of the excess, a slice."""
    dulling_exponent: float = quantity(1.0, "", low=0.1, high=3.0)
    """Exponent of the slice number."""
    slices: int = quantity(0, "", low=0, high=100000)
    """Slices cut since sharpening."""

    @property
    def grown(self) -> float:
        """Excess at the surface by now, J/m^2."""
        return self.initiation + self.dulling * float(self.slices) ** self.dulling_exponent

    def excess(self, depth: np.ndarray) -> np.ndarray:
        """Excess over R at depths below the outside, J/m^2."""
        return self.grown * np.exp(-np.asarray(depth) / self.depth)


@dc.dataclass
class Adhesion:
    """Shear of food that sticks to the flanks where it touches them, however light the pressure.

    It holds like friction up to `stress`, then slides; while it slides at speed v, `viscosity` adds
    viscosity reference_speed (v / reference_speed)^exponent. Adhesion between soft solids grows
    with a power of about a half of the speed (Maugis and Barquins, J. Phys. D 11, 1989, 1978: 0.6).
    Below a tenth of the reference it is linear, so that it has a slope at rest.
    """

    stress: float = quantity(0.0, "Pa", low=0.0, high=1e6)
    """Shear at which it slides."""
    viscosity: float = quantity(0.0, "Pa s/m", low=0.0, high=1e7)
    """Stress per sliding speed, at the reference."""
    exponent: float = quantity(1.0, "", low=0.1, high=1.0)
    """Exponent of the speed; 1 for linear."""
    reference_speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Speed at which the viscosity is meant."""

    @property
    def steepest(self) -> float:
        """Largest slope of the stress by the speed, over the viscosity."""
        return float(LINEAR_BELOW ** (self.exponent - 1.0))


@dc.dataclass
class SlicePush:
    """How much a draw helps: the vertical force is R w / (1 + xi^2)^exponent; Atkins: 1."""

    exponent: float = quantity(1.0, "", low=0.0, high=3.0)
    """1 for Atkins' law; 0 where a draw does not help."""
    pull: float = quantity(0.0, "", low=-1.0, high=1.0)
    """Share by which the edge pulls along itself more than xi times the press."""


@dc.dataclass
class Compliance:
    """Elasticity of what holds knife and food, on a prescribed motion without a robot."""

    arm: float = quantity(0.0, "m/N", low=0.0, high=1e-3)
    """The knife's, vertically."""
    holder: float = quantity(0.0, "m/N", low=0.0, high=1e-3)
    """The food's, along the edge."""


@dc.dataclass
class Slip:
    """The food slips along the edge when the knife draws it harder than its holder resists.

    While it slips, `remaining` of the resistance is left, until the draw asks for less. Needs
    `Compliance.holder` > 0, which holds it before.
    """

    resistance: float | None = quantity(None, "N", low=0.0, high=1e4)
    """null: never slips."""
    remaining: float = quantity(0.5, "", low=0.0, high=1.0)
    """Fraction of the resistance while it slips."""


@dc.dataclass
class Edge:
    """How much of the surface the edge parts where it passes; the rest is left to opening.

    At 0 the edge cuts nothing: bonds last behind it until the flanks have torn them, as in DiSECt.
    """

    share: float = quantity(1.0, "", low=0.0, high=1.0)
    """Fraction of toughness and bonds; 0 for opening alone."""


@dc.dataclass
class Effects:
    """Extensions of the base model, a group each; the defaults are the base model."""

    edge: Edge = dc.field(default_factory=Edge)
    toughness_rate: ToughnessRate = dc.field(default_factory=ToughnessRate)
    relaxation: Relaxation = dc.field(default_factory=Relaxation)
    resting: Resting = dc.field(default_factory=Resting)
    section: Section = dc.field(default_factory=Section)
    outside: Outside = dc.field(default_factory=Outside)
    entry: Entry = dc.field(default_factory=Entry)
    skin: Skin = dc.field(default_factory=Skin)
    core: Core = dc.field(default_factory=Core)
    centre: Centre = dc.field(default_factory=Centre)
    underside: Underside = dc.field(default_factory=Underside)
    bluntness: Bluntness = dc.field(default_factory=Bluntness)
    adhesion: Adhesion = dc.field(default_factory=Adhesion)
    slice_push: SlicePush = dc.field(default_factory=SlicePush)
    compliance: Compliance = dc.field(default_factory=Compliance)
    slip: Slip = dc.field(default_factory=Slip)

    def check(self, where: str) -> None:
        if self.slip.resistance is not None and self.compliance.holder == 0.0:
            raise ConfigurationError(
                "needs a holder that is elastic before the food slips",
                field=f"{where}.slip.resistance",
                fix=f"Give {where}.compliance.holder, as 2e-5 m/N.",
            )

    @property
    def changes_force(self) -> bool:
        """Whether the force of the cut is changed once more, by `changed`."""
        return bool(self.slice_push.pull or any(self.resting.shares))

    def of_cut(self) -> "Effects":
        """Those that act in the cut itself, without what `changed` does to its force."""
        if not self.changes_force:
            return self
        push = dc.replace(self.slice_push, pull=0.0)
        return dc.replace(self, slice_push=push, resting=Resting())

    def changed(
        self,
        parts: np.ndarray,
        edge: np.ndarray,
        speed: np.ndarray,
        period: float,
        held: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The wrenches of a cut with what changes its force.

        Args:
            parts: By edge, flank pressure, friction, moment about Ko and force, of coupling steps
                [N, 3, 6], in any axes.
            edge: Direction of the edge Kx in these axes [N, 3].
            speed: Of Ko [N], m/s.
            period: Of the coupling steps, s.
            held: How far each branch of `resting` has come before [M]; not at all by default.

        Returns:
            The wrenches [N, 3, 6], and how far each branch has come [M].
        """
        along = np.einsum("nc,nc->n", parts[:, 0, 3:], edge)
        out = parts.copy()
        out[:, 0, 3:] += self.slice_push.pull * along[:, None] * edge
        held = np.zeros(len(self.resting.shares)) if held is None else held
        if any(self.resting.shares) and len(parts):
            touches = np.abs(parts[:, :, 3:]).max((1, 2)) > 1e-9
            came = self.resting.faded(held, speed, touches, period)
            out -= (came @ np.array(self.resting.shares))[:, None, None] * parts
            held = came[-1]
        return out, held
