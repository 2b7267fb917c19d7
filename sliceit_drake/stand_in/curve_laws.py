"""Laws of the worlds of measured curves: force of the food on the knife, step by step.

The force over depth is a recorded one (calibration/measured), stretched over the height of the
food. Around it stand laws of a few lines: a power of the speed (`RATE`), Atkins' draw
(F_V / (1 + xi^2), F_H = xi F_V), a logarithmic fading in a hold, flanks that rub on what is buried,
and no force of the edge where the cut is open. `curve_world` makes slice records by them on
prescribed paths, `curve_cutter` is a food of a station.
"""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.resources import resource_path

__all__ = ["CURVES", "CutState", "EllipticSection", "FoodCurve", "food_forces", "measured_curve"]

CURVES = {name: f"calibration/measured/sliceit_real_{name}_force.csv" for name in
          ("cucumber", "potato", "tomato")}  # fmt: skip
CURVE_SPEED = 0.02
"""Speed at which the curves were recorded (calibration/measured/README.md), m/s."""
CONTACT = 0.3
"""Force at which a curve begins, N."""
RATE = 0.07
"""Exponent of the speed."""
MIN_SPEED = 2e-3
"""Below which the force falls no further, m/s."""
FLANK_SHARE, WEDGE_SHARE = 0.15, 0.03
"""Friction and pressure of the flanks, fully buried, over the curve's largest force."""
HOLD_FADE, HOLD_ONSET = 0.06, 0.03
"""Share that a force loses in a hold with each tenfold of the time over the onset; the onset, s."""
RELOAD = 4e-4
"""Travel after which a force that faded, or was let go, is there again, metres."""
TURN = 1e-4
"""Travel over which friction turns round, metres."""
STILL = 1e-9
"""Move in a coupling step below which the knife is held, on a prescribed path, metres."""
LARGEST_RATIO = 1e3


@dc.dataclass(frozen=True)
class FoodCurve:
    """Force of a press at `CURVE_SPEED` over depth.

    Attributes:
        share: Depths as fractions of the food's height, from 0 to 1, increasing [n].
        force: Upward force on the knife [n], N.
    """

    share: np.ndarray
    force: np.ndarray

    def scaled(self, factor: float) -> "FoodCurve":
        """The same with another force."""
        return FoodCurve(self.share, self.force * factor)


def measured_curve(name: str) -> FoodCurve:
    """The measured curve of a food, from its first contact to its end.

    Raises:
        ConfigurationError: There is no curve of this food.
    """
    if name not in CURVES:
        raise ConfigurationError(
            f"there is no measured curve of {name!r}",
            field="food.name",
            fix=f"Take one of {', '.join(CURVES)}, or the world finite_elements.",
        )
    profile = load_force_profile(resource_path(CURVES[name]))
    begin = int(np.argmax(profile.force > CONTACT))
    share = profile.time[begin:] - profile.time[begin]
    return FoodCurve(share / share[-1], profile.force[begin:])


class EllipticSection:
    """An elliptic section, and how much of it lies above a depth.

    Args:
        width, height: Size of the food along the edge and vertically, metres.

    Attributes:
        area: Area of the section, m^2.
        depth: Depths at which the section is tabulated, from its top [n], metres.
        up: Heights over the middle there, over half the section's height [n].
        half: Half the width there [n], metres.
    """

    def __init__(self, width: float, height: float) -> None:
        a, b = 0.5 * width, 0.5 * height
        self.a, self.b = a, b
        self.height = height
        self.area = np.pi * a * b
        self.depth = np.linspace(0.0, height, 121)
        self.up = 1.0 - self.depth / b
        self.half = a * np.sqrt(np.maximum(1.0 - self.up**2, 0.0))
        angle = np.arccos(np.clip(self.up, -1.0, 1.0))
        self._above = (angle - np.sin(angle) * np.cos(angle)) / np.pi

    def above(self, depth: float) -> float:
        """Fraction of the section above a depth, metres."""
        return float(np.interp(depth, self.depth, self._above))


@dc.dataclass
class CutState:
    """State of a slice along the knife's path. Lengths in metres, in F.

    Attributes:
        place: Position of the knife relative to the food [3].
        heading: Direction of motion, as friction has turned to it [3].
        course: Motion along the edge and down, over the motion, as the edge has turned to it [2].
        depth, deepest: Depth of the edge below the food's top, now and ever; negative above it.
        travel: Path of the edge in the food.
        swept: Area that the flanks have swept, m^2.
        speed: Speed of the edge, m/s.
        ratio: Draw over press, xi.
        rest: Time for which the knife is held, s.
        faded: Fraction of the forces that a hold has left.
    """

    place: np.ndarray
    heading: np.ndarray = dc.field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    course: np.ndarray = dc.field(default_factory=lambda: np.array([0.0, 1.0]))
    depth: float = -1.0
    deepest: float = 0.0
    travel: float = 0.0
    swept: float = 0.0
    speed: float = 0.0
    ratio: float = 0.0
    rest: float = 0.0
    faded: float = 1.0

    SIZE = 16

    def vector(self) -> np.ndarray:
        """All of it [SIZE]; for a Context."""
        return np.concatenate([np.atleast_1d(getattr(self, f.name)) for f in dc.fields(self)])

    @classmethod
    def of_vector(cls, values: np.ndarray) -> "CutState":
        """The state that `vector` gave."""
        place, heading, course = values[:3].copy(), values[3:6].copy(), values[6:8].copy()
        return cls(place, heading, course, *values[8:].tolist())

    def advance(
        self,
        period: float,
        along: np.ndarray,
        place: np.ndarray,
        height: float,
        still: float = STILL,
        turn: float = 0.0,
    ) -> None:
        """Advances to the end of a stretch of the path.

        Args:
            period: Duration of the stretch, s.
            along: Direction of the edge in F [3].
            place: Position of the knife in F relative to the food [3], metres.
            height: Height of the food, metres.
            still: Move below which the knife is held, metres.
            turn: Travel over which the edge's ratio turns to that of the motion, metres; 0: at
                once. A motion that a controller makes shakes; what it rises then does not count,
                for that unloads the edge. Friction turns over it too, if it is more than `TURN`.
        """
        step, self.place = place - self.place, place
        moved = float(np.linalg.norm(step))
        self.depth = height - float(place[2])
        self.deepest = max(self.deepest, self.depth)
        if moved > still:
            self.speed = moved / period
            self._turn(float(step @ along), -float(step[2]), moved, turn)
            self.rest = 0.0
            self.faded = min(1.0, self.faded + moved / RELOAD)
        else:
            self.rest += period
            loss = HOLD_FADE * np.log10(1.0 + self.rest / HOLD_ONSET)
            self.faded = min(self.faded, 1.0 - loss)
        if self.depth > 0.0 and moved > still:
            keep = np.exp(-moved / max(turn, TURN))
            self.heading = keep * self.heading + (1.0 - keep) * step / moved
            self.travel += moved
            self.swept += 2.0 * moved * min(self.depth, 0.03)

    def _turn(self, drawn: float, sunk: float, moved: float, turn: float) -> None:
        if turn == 0.0:
            self.ratio = drawn / sunk if sunk > STILL else 0.0
            return
        keep = float(np.exp(-moved / turn))
        share = np.array([drawn, max(sunk, 0.0)]) / moved
        self.course = keep * self.course + (1.0 - keep) * share
        drawn, sunk = self.course.tolist()
        self.ratio = drawn / max(sunk, abs(drawn) / LARGEST_RATIO, STILL)

    @property
    def loaded(self) -> float:
        """Fraction of the edge's force that is there: none in a cut that is open."""
        behind = (self.deepest - self.depth) / RELOAD
        return max(0.0, 1.0 - behind) * self.faded


def food_forces(
    state: CutState,
    curve: FoodCurve,
    section: EllipticSection,
    toughness: float = 1.0,
    friction: float = 1.0,
    more: float = 0.0,
) -> np.ndarray:
    """Force of the food on the knife by mechanism: edge, flanks' pressure, friction [3, 3], N.

    In F, for an edge along Fx.

    Args:
        state: The slice at the end of the stretch.
        curve: Curve of this slice.
        section: Section of this slice.
        toughness, friction: Factors on the edge's force and on the flanks'.
        more: What the edge meets beyond the curve at this depth, N.
    """
    out = np.zeros((3, 3))
    if state.depth <= 0.0:
        return out
    flanks = float(curve.force.max()) * section.above(state.depth)
    share = state.depth / section.height
    whole = float(np.interp(share, curve.share, curve.force))
    edge = max(whole - (FLANK_SHARE + WEDGE_SHARE) * flanks, 0.0)
    edge = max(edge + more, 0.0) if share < 1.0 else 0.0
    speed = max(state.speed, MIN_SPEED)
    edge *= toughness * (speed / CURVE_SPEED) ** RATE * state.loaded
    xi = state.ratio
    out[0] = [-xi * edge / (1.0 + xi**2), 0.0, edge / (1.0 + xi**2)]
    out[1, 2] = WEDGE_SHARE * flanks * state.faded
    out[2] = -FLANK_SHARE * flanks * friction * state.faded * state.heading
    return out
