"""What the benches hide: effects in forms that no cause of the diagnosis has, and what is right.

Each has the names of the causes of which one has to be named (`right`; none where the effect stands
in no list), and its `group`: "bench" for what sits in sensor, robot, board and holder, "material",
and "depth" for what is locked to depth alone, which no such slices can tell from the law itself.
What goes with speed, draw,
slice number or height is a `trend`. `runs.oracle_group` adds the causes whose
effects an oracle that knows the law could not tell from it in the slices of a draw.
"""

import numpy as np
from scipy.signal import cont2discrete, lfilter

from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth, Tissue
from sliceit_drake.stand_in.world import GRAVITY
from sliceit_drake.tables import interpolated

__all__ = ["BENCH_CAUSES", "DEPTH_CAUSES", "HIDDEN", "CrossTalk", "HiddenEffect"]

BENCH_CAUSES = frozenset(
    "board_height board_stiffness arm_compliance holder_compliance slip sensor_zero sensor_gain "
    "sensor_tilt sensor_delay tool_weight vibration stick_slip".split()
)
"""Causes in sensor, robot, board and holder; all others are in the material."""

DEPTH_CAUSES = frozenset({"skin", "core", "section_shape", "law"})
"""What is locked to depth alone."""


class HiddenEffect(Effect):
    """An effect of the benches.

    Attributes:
        right: Causes of which one has to be named.
        group: "bench", "material", "depth" or "unlisted".
        trend: Whether slices may differ in the same way, by what goes with speed, draw, number or
            height.
        by_slice: Whether slices of one condition differ by it.
        value: Parameter of a right cause that stands for `size`; "" where none does.
        most: Largest size that has a meaning; a relaxation of more than all of a force is none.
    """

    right: frozenset[str] = frozenset()
    group = "bench"
    trend = False
    by_slice = False
    value = ""
    most = np.inf


class StretchedRelaxation(HiddenEffect):
    """All of the food's force fades while the knife rests, by size (1 - exp(-sqrt(t / 0.3 s))), and
    is back in a straight line over 0.6 mm."""

    right, group = frozenset({"viscoelasticity"}), "material"
    typical, least, most = 0.2, 0.0, 0.8
    time, way = 0.3, 6e-4

    def respond(self, series: Series) -> None:
        speed = np.linalg.norm(series.v, axis=1)
        rested, lost, left = 0.0, 0.0, np.ones(len(speed))
        for k in np.flatnonzero(series.depth > 0.0):
            if speed[k] < 2e-4:
                rested += series.period
                lost = max(lost, self.size * -np.expm1(-np.sqrt(rested / self.time)))
            else:
                rested = 0.0
                lost = max(lost - self.size * speed[k] * series.period / self.way, 0.0)
            left[k] = 1.0 - lost
        for part in (series.edge, series.normal, series.friction):
            part *= left[:, None]


class SaturatingRate(HiddenEffect):
    """Toughness 1 + size tanh(ln(v / v0) / 1.2), which a rest keeps."""

    right, group, trend = frozenset({"toughness_rate"}), "material", True
    typical, most = 0.15, 0.6
    _speed = 0.02

    def drive(self, now: Now) -> None:
        self._speed = now.speed if now.speed > 1e-4 else self._speed
        now.toughness *= 1.0 + self.size * np.tanh(
            np.log(self._speed / self.facts.reference_speed) / 1.2
        )


class SlowFriction(HiddenEffect):
    """Friction higher by size / (1 + (v / 8 mm/s)^2)."""

    right, group = frozenset({"static_friction"}), "material"
    typical, least, most = 1.0, 0.0, 4.0

    def drive(self, now: Now) -> None:
        now.friction *= 1.0 + self.size / (1.0 + (now.speed / 8e-3) ** 2)


class TackyFlanks(HiddenEffect):
    """On the way out wet flanks pull with a stress of size (v / 20 mm/s)^0.3 that is there after
    1 mm."""

    right, group = frozenset({"adhesion"}), "material"
    unit, typical, least = "Pa", 2000.0, 0.0

    def respond(self, series: Series) -> None:
        out = np.maximum(series.v[:, 2], 0.0)
        way = np.cumsum(out) * series.period
        since = way - np.maximum.accumulate(np.where(out > 1e-5, 0.0, way))
        pull = self.size * (out / 0.02) ** 0.3 * -np.expm1(-since / 3e-4) * series.flank
        series.other[:, 5] -= pull


class SkinRing(HiddenEffect):
    """A ring of 0.8 mm, half as much again below, that is tougher by the share size."""

    right, group = frozenset({"skin"}), "depth"
    typical, least = 1.0, 0.0

    def toughness(self, at: Tissue) -> np.ndarray | float:
        low = 1.0 - at.height / max(self.facts.height, 1e-9)
        return 1.0 + self.size * (at.distance < 8e-4 * (1.0 + 0.5 * np.clip(low, 0.0, 1.0)))


class BluntStart(HiddenEffect):
    """An edge that takes more to begin, by the share size, less in a straight line over 5 mm of its
    path."""

    right, group = frozenset({"bluntness"}), "material"
    typical, least, most = 0.5, 0.0, 2.0

    def drive(self, now: Now) -> None:
        now.toughness *= 1.0 + self.size * max(0.0, 1.0 - now.travel / 5e-3)


class WornEdge(HiddenEffect):
    """An edge that takes more of all of the cut with the slices n, by size (1 - exp(-n / 8))."""

    right, group = frozenset({"dulling"}), "material"
    trend = by_slice = True
    typical, least, most = 0.3, 0.0, 1.0

    def drive(self, now: Now) -> None:
        now.toughness *= 1.0 + self.size * -np.expm1(-self.facts.index / 8.0)


class ShyDraw(HiddenEffect):
    """A draw that helps less, by size (1 - exp(-xi))."""

    right, group, trend = frozenset({"slice_push_law"}), "material", True
    typical, most = 0.4, 1.5

    def drive(self, now: Now) -> None:
        if now.press > 1e-6:
            now.toughness *= 1.0 + self.size * -np.expm1(-abs(now.draw) / now.press)


class SaggingBelly(HiddenEffect):
    """A section that bulges in its lower third, by the share size."""

    right, group = frozenset({"section_shape"}), "depth"
    typical, most = 0.15, 0.5

    def reshape(self, p: np.ndarray) -> np.ndarray:
        up = p[:, 2] / max(self.facts.height, 1e-9)
        return p * np.column_stack(
            [1.0 + self.size * np.exp(-(((up - 0.28) / 0.16) ** 2)), np.ones((len(p), 2))]
        )


class SeedCavity(HiddenEffect):
    """An ellipse of seeds beside the middle, less tough by the share size, and half as much
    softer."""

    right, group = frozenset({"core"}), "depth"
    typical, most = 0.4, 0.9

    def _inside(self, at: Tissue) -> np.ndarray:
        width, height = max(self.facts.width, 1e-9), max(self.facts.height, 1e-9)
        x, z = at.x / width - 0.08, at.height / height - 0.46
        return (x / 0.27) ** 2 + (z / 0.2) ** 2 < 1.0

    def toughness(self, at: Tissue) -> np.ndarray | float:
        return 1.0 - self.size * self._inside(at)

    def stiffness(self, at: Tissue) -> np.ndarray | float:
        return 1.0 - 0.5 * self.size * self._inside(at)


class TiltedBoard(HiddenEffect):
    """Board and food that lie higher by size, and 1 % of a slope more where the knife is drawn
    to."""

    right, trend = frozenset({"board_height"}), True
    unit, typical, most = "m", 4e-4, 1.5e-3

    def drive(self, now: Now) -> None:
        now.knife_shift[2] -= self.size * (1.0 + 8.0 * now.position[0])


class SoftMat(HiddenEffect):
    """A mat on the board that gives more the more it is pressed: F / (1 + size (F / 10 N)^0.7)."""

    right = frozenset({"board_stiffness"})
    typical, least, most = 0.5, 0.0, 3.0

    def respond(self, series: Series) -> None:
        force = np.abs(series.board[:, 5:])
        series.board /= 1.0 + self.size * (force / 10.0) ** 0.7


class ArmPlay(HiddenEffect):
    """An arm that gives by size at 10 N and ever less beyond, within 40 ms; encoders do not see
    it."""

    right, every_coupling_step = frozenset({"arm_compliance"}), True
    unit, typical, least, most = "m", 5e-4, 0.0, 2e-3
    _given = 0.0

    def _follows(self, force: float, period: float) -> float:
        wanted = self.size * force / (10.0 + 0.5 * abs(force)) * 1.5
        self._given += -np.expm1(-period / 0.04) * (wanted - self._given)
        return self._given

    def drive(self, now: Now) -> None:
        now.knife_shift[2] += self._follows(float(now.force[2]), now.period)


class SlidingHolder(ArmPlay):
    """A holder of the food that gives along the edge in the same way."""

    right = frozenset({"holder_compliance"})
    unit, typical, most = "m", 2e-3, 5e-3

    def drive(self, now: Now) -> None:
        now.food_shift[0] -= self._follows(float(now.force[0]), now.period)


class FoodKnock(HiddenEffect):
    """Food that knocks at the blade at some depth of each slice: half a sine of 60 ms."""

    right, by_slice = frozenset({"slip"}), True
    unit, typical, least = "N", 2.0, 0.0

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._depth, self._side = rng.uniform(0.2, 0.85), rng.choice((-1.0, 1.0))

    def respond(self, series: Series) -> None:
        if (
            self.facts.height > 0.0
            and (deep := series.depth > self._depth * self.facts.height).any()
        ):
            since = (series.time - series.time[int(deep.argmax())]) / 0.06
            pulse = np.sin(np.pi * np.clip(since, 0.0, 1.0))
            series.other[:, 3:] += self.size * pulse[:, None] * [0.3, self._side, -0.4]


class SettlingZero(HiddenEffect):
    """A zero that wanders off by size (1 - exp(-t / 4 s)) in a slice, less in later ones."""

    right, by_slice = frozenset({"sensor_zero"}), True
    unit, typical = "N", 0.6

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        out = wrench.copy()
        wander = self.size * np.exp(-self.facts.index / 25.0) * -np.expm1(-series.time / 4.0)
        out[:, 3:] += np.outer(wander, [0.6, -0.25, 0.75])
        return out


class AxisGain(HiddenEffect):
    """A gain that is off by the share size in the press, and by a quarter of it along the edge."""

    right = frozenset({"sensor_gain"})
    typical, most = 0.12, 0.6

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        share = np.array([0.25, 1.0, 0.25, 0.25, 0.25, 1.0])
        return wrench * (1.0 + self.size * share)


class CrossTalk(HiddenEffect):
    """The press shows in the two lateral forces, which turn nothing: it is no rotation."""

    right = frozenset({"sensor_tilt"})
    typical, most = 0.08, 0.5

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        out = wrench.copy()
        out[:, 3:5] += self.size * np.outer(wrench[:, 5], [0.7, -0.7])
        return out


class PureDelay(HiddenEffect):
    """Readings that come late by size."""

    right = frozenset({"sensor_delay"})
    value = "delay"
    unit, typical, least, most = "s", 0.02, 0.0, 0.05

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        return np.asarray(interpolated(series.time - self.size, series.time, wrench))


class RingingFilter(HiddenEffect):
    """A filter of second order with a damping of 0.5, late by size on the mean."""

    right = frozenset({"sensor_delay"})
    value = "delay"
    unit, typical, least, most = "s", 0.02, 0.0, 0.05

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        if self.size == 0.0:
            return wrench
        # The mean delay of 1 / (1 + 2 d s / w + s^2 / w^2) is 2 d / w.
        w = 1.0 / self.size
        # A bilinear one would ring at half of the rate where it is much faster than that.
        b, a, _ = cont2discrete(([w * w], [1.0, w, w * w]), series.period, "foh")
        state = np.zeros((2, 6))
        rest = wrench[:1] * np.array([[1.0 - b[0, 0]], [b[0, 2] - a[2]]])
        out, _ = lfilter(b[0], a, wrench, axis=0, zi=state + rest)
        return np.asarray(out)


class SideMass(HiddenEffect):
    """A part of the tool of mass size beside the blade's axis that nothing takes off; tared at the
    start."""

    right = frozenset({"tool_weight"})
    value = "mass"
    unit, typical, most = "kg", 0.2, 0.5

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        acceleration = np.gradient(series.v, series.period, axis=0)
        acceleration[:, 2] += GRAVITY
        force = -self.size * np.einsum("nji,nj->ni", series.R, acceleration)
        added = np.concatenate([np.cross([0.03, 0.012, -0.06], force), force], axis=1)
        return wrench + added - added[:1]


class SpeedHum(HiddenEffect):
    """Drives that hum with size at 9 Hz and 2 Hz more for each cm/s, in any phase."""

    right, by_slice = frozenset({"vibration"}), True
    unit, typical, least = "N", 0.5, 0.0

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 3)

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        speed = np.linalg.norm(series.v, axis=1)
        angle = 2.0 * np.pi * np.cumsum(9.0 + 200.0 * speed) * series.period
        wave = np.sin(angle[:, None] + self._phase) * [0.4, 0.6, 1.0]
        out = wrench.copy()
        out[:, 3:] += self.size * wave * (speed > 1e-3)[:, None]
        return out


class Chatter(HiddenEffect):
    """Food that sticks and lets go about once in a millimetre, as teeth that rise ever more
    slowly."""

    right, by_slice = frozenset({"stick_slip"}), True
    unit, typical, least = "N", 0.6, 0.0

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._ends = np.cumsum(1.1e-3 * (1.0 + 0.1 * rng.normal(size=400)).clip(0.5, 1.5))

    def respond(self, series: Series) -> None:
        speed = np.linalg.norm(series.v, axis=1)
        sliding = (series.flank > 0.0) & (speed > 1e-6)
        path = np.cumsum(speed * sliding) * series.period
        tooth = np.interp(path, np.append(0.0, self._ends), np.arange(len(self._ends) + 1.0)) % 1.0
        wave = -np.expm1(-3.0 * tooth) - 0.683
        series.other[:, 5] += self.size * sliding * wave * np.sign(series.press)


class Cable(HiddenEffect):
    """The sensor's cable is a spring: size for 3 cm up and for 3 cm along the edge."""

    group = "unlisted"
    unit, typical = "N", 0.8

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        pull = -self.size / 0.03 * (series.p - series.p[:1]) * [1.0, 0.0, 1.0]
        out = wrench.copy()
        out[:, 3:] += np.einsum("nji,nj->ni", series.R, pull)
        return out


class SensorPlay(HiddenEffect):
    """A sensor whose reading of the press follows with a play of size (Prandtl's operator)."""

    group = "unlisted"
    unit, typical, least = "N", 0.8, 0.0

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        out, shown = wrench.copy(), 0.0
        for k, force in enumerate(wrench[:, 5].tolist()):
            shown = min(max(shown, force - 0.5 * self.size), force + 0.5 * self.size)
            out[k, 5] = shown
        return out


class Cogging(HiddenEffect):
    """A joint whose teeth show in the press, once in 7 mm of height, at rest as well."""

    group = "unlisted"
    unit, typical = "N", 0.5

    def measure(self, series: Series, wrench: np.ndarray) -> np.ndarray:
        height = 2.0 * np.pi * series.p[:, 2] / 7e-3
        out = wrench.copy()
        out[:, 5] += self.size * (np.sin(height) - np.sin(height[0]))
        return out


class LeaningBlade(HiddenEffect):
    """A blade that leans on one side, by size times the cube of the depth over the height."""

    group = "unlisted"
    unit, typical = "N", 1.5

    def respond(self, series: Series) -> None:
        deep = np.clip(series.depth / max(self.facts.height, 1e-9), 0.0, 1.2)
        series.other[:, 4] += self.size * deep**3 * (series.flank > 0.0)


HIDDEN: dict[str, type[HiddenEffect]] = {
    "stretched_relaxation": StretchedRelaxation,
    "saturating_rate": SaturatingRate,
    "slow_friction": SlowFriction,
    "tacky_flanks": TackyFlanks,
    "skin_ring": SkinRing,
    "blunt_start": BluntStart,
    "worn_edge": WornEdge,
    "shy_draw": ShyDraw,
    "sagging_belly": SaggingBelly,
    "seed_cavity": SeedCavity,
    "tilted_board": TiltedBoard,
    "soft_mat": SoftMat,
    "arm_play": ArmPlay,
    "sliding_holder": SlidingHolder,
    "food_knock": FoodKnock,
    "settling_zero": SettlingZero,
    "axis_gain": AxisGain,
    "cross_talk": CrossTalk,
    "pure_delay": PureDelay,
    "ringing_filter": RingingFilter,
    "side_mass": SideMass,
    "speed_hum": SpeedHum,
    "chatter": Chatter,
    "cable": Cable,
    "sensor_play": SensorPlay,
    "cogging": Cogging,
    "leaning_blade": LeaningBlade,
}
"""By name."""
