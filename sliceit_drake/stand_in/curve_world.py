"""A second world, of measured curves: it shares no code with the finite elements.

The force over depth is a recorded one (calibration/measured), stretched over the height of the
food. Around it stand laws of a few lines: a power of the speed (`RATE`), Atkins' draw
(F_V / (1 + xi^2), F_H = xi F_V), a logarithmic fading in a hold, flanks that rub on what is buried,
and a board of Hunt and Crossley's law with Hertz's exponent.

Of `cutting` it has the knife's motion and the configuration that a protocol is written in (size of
the food, board), and no solver, model, mesh or kernel: `tests/test_stand_in.py` looks at what it
imports. Effects act on it by the same hooks as on the finite elements; a factor on the modulus has
nothing to act on.
"""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.records.force_profile import load_force_profile
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceFacts, Tissue
from sliceit_drake.stand_in.protocol import Protocol, Specimen, section_size
from sliceit_drake.stand_in.world import GRAVITY, Path, resampled

__all__ = ["CurveWorld"]

CURVES = {name: f"calibration/measured/sliceit_real_{name}_force.csv" for name in
          ("cucumber", "potato", "tomato")}  # fmt: skip
CURVE_SPEED = 0.02
"""At which the curves were recorded (calibration/measured/README.md), m/s."""

CONTACT = 0.3
"""Force at which a curve begins, N."""

RATE = 0.07
"""Exponent of the speed."""

LEAST_SPEED = 2e-3
"""Below which the force falls no further, m/s."""

FLANK_SHARE, WEDGE_SHARE = 0.15, 0.03
"""Friction and pressure of the flanks, fully buried, over the curve's largest force."""

HOLD_FADE, HOLD_ONSET = 0.06, 0.03
"""In a hold a force loses this share with each tenfold of the time over the onset, s."""

RELOAD = 4e-4
"""Travel after which a force that faded, or was let go, is there again, metres."""

BOARD_DEPTH = 3e-4
"""Depth at which the board is as stiff as the protocol's, metres."""

TURN = 1e-4
"""Travel over which friction turns round, metres."""

TRAVEL, LONGEST = 4e-5, 50


class CurveWorld:
    """Cuts slices by a measured curve.

    Args:
        protocol: Its food's name chooses the curve.

    Raises:
        ConfigurationError: There is no curve of this food.
    """

    def __init__(self, protocol: Protocol) -> None:
        name = protocol.food.name
        if name not in CURVES:
            raise ConfigurationError(
                f"there is no measured curve of {name!r}",
                field="food.name",
                fix=f"Take one of {', '.join(CURVES)}, or the world finite_elements.",
            )
        profile = load_force_profile(resource_path(CURVES[name]))
        begin = int(np.argmax(profile.force > CONTACT))
        share = profile.time[begin:] - profile.time[begin]
        self.protocol = protocol
        self._share = share / share[-1]
        self._force = profile.force[begin:]

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        """Cuts one slice; see `World`."""
        protocol, condition = self.protocol, specimen.condition
        width, height = section_size(protocol.food, condition.width_scale)
        facts = SliceFacts(
            index=specimen.index,
            peeled=condition.peeled,
            height=height,
            width=width,
            toughness=float(np.mean(self._force)) / (0.25 * np.pi * width),
        )
        for effect in effects:
            effect.begin(facts, rng)
        x, y, _ = protocol.food.cut_point
        start = Pose(
            np.diag([1.0, -1.0, -1.0]),
            np.array([x + condition.offset, y, height + condition.clearance]),
        )
        path = Path.of(condition.motion, start, protocol.exchange_period)
        section = _Section(facts, effects)
        series = self._along(path, specimen, facts, section, effects)
        for effect in effects:
            effect.respond(series)
        return series

    def _along(
        self,
        path: Path,
        specimen: Specimen,
        facts: SliceFacts,
        section: "_Section",
        effects: Sequence[Effect],
    ) -> Series:
        timeless = not any(effect.every_exchange for effect in effects)
        stretches = np.array(list(path.stretches(TRAVEL, LONGEST if timeless else 1, 0.0)))
        size = facts.width / section_size(self.protocol.food, 1.0)[0]
        curve = self._force * specimen.toughness * size
        state = _State(path.p[0])
        forces = np.zeros((len(stretches), 3, 3))
        shifts = np.zeros((len(stretches), 2, 3))
        depths = np.zeros(len(stretches))
        for row, (a, b) in enumerate(stretches):
            period = path.period * float(b - a)
            v = (path.p[b] - path.p[a]) / period
            press, draw = -float(v[2]), float(v @ path.R[b][:, 0])
            now = Now(
                time=float(path.time[a]),
                period=period,
                position=path.p[b],
                press=press,
                draw=draw,
                depth=state.depth,
                travel=state.travel,
                swept=state.swept,
                force=state.force,
            )
            for effect in effects:
                effect.drive(now)
            now.food_shift[2] += specimen.height
            shifts[row] = now.knife_shift, now.food_shift
            place = path.p[b] + now.knife_shift - now.food_shift
            state.advance(now, path.R[b][:, 0], place, facts.height)
            depths[row] = state.depth
            if not specimen.condition.without_food:
                forces[row] = self._forces(state, now, facts, section, curve)
                forces[row, 2] *= specimen.friction
            board = self._board(path.p[b][2] + now.knife_shift[2], press)
            state.force = forces[row].sum(0) + [0.0, 0.0, board]
        return self._series(path, specimen, facts, section, stretches, forces, shifts, depths)

    def _forces(
        self,
        state: "_State",
        now: Now,
        facts: SliceFacts,
        section: "_Section",
        curve: np.ndarray,
    ) -> np.ndarray:
        """Force of edge, flanks' pressure and friction on the knife, in F [3, 3], N."""
        out = np.zeros((3, 3))
        if state.depth <= 0.0:
            return out
        buried = section.above(state.depth)
        flanks = float(curve.max()) * buried
        share = state.depth / facts.height
        whole = float(np.interp(share, self._share, curve))
        edge = max(whole - (FLANK_SHARE + WEDGE_SHARE) * flanks, 0.0)
        edge = max(edge + section.more(state.depth), 0.0) if share < 1.0 else 0.0
        speed = max(state.speed, LEAST_SPEED)
        edge *= now.toughness * (speed / CURVE_SPEED) ** RATE * state.loaded
        xi = state.ratio
        out[0] = [-xi * edge / (1.0 + xi**2), 0.0, edge / (1.0 + xi**2)]
        out[1, 2] = WEDGE_SHARE * flanks * state.faded
        out[2] = -FLANK_SHARE * flanks * now.friction * state.faded * state.heading
        return out

    def _board(self, height: float, press: float) -> float:
        board = self.protocol.board
        depth = max(-height, 0.0)
        law = board.stiffness / np.sqrt(BOARD_DEPTH) * depth**1.5
        return float(law * max(0.0, 1.0 + 1.5 * board.dissipation * press))

    def _series(
        self,
        path: Path,
        specimen: Specimen,
        facts: SliceFacts,
        section: "_Section",
        stretches: np.ndarray,
        forces: np.ndarray,
        shifts: np.ndarray,
        depths: np.ndarray,
    ) -> Series:
        T, time = path.period, path.time[1:]
        ends = T * stretches[:, 1]
        force = resampled(forces, ends, time)
        knife, food = np.moveaxis(resampled(shifts, ends, time), 1, 0)
        p_true = path.p[1:] + knife
        depth = resampled(depths, ends, time)
        there = not specimen.condition.without_food
        buried = np.array([section.above(d) for d in depth]) * there
        # The edge is pushed where the food is, the flanks in the middle of what is buried.
        arm = np.zeros((len(time), 3))
        arm[:, 0] = self.protocol.food.cut_point[0] + food[:, 0] - p_true[:, 0]
        raised = arm + np.array([0.0, 0.0, 0.5]) * np.maximum(depth, 0.0)[:, None]
        wrenches = [
            np.concatenate([np.cross(r, force[:, k]), force[:, k]], axis=1)
            for k, r in enumerate((arm, raised, raised))
        ]
        board, other = np.zeros((len(time), 6)), np.zeros((len(time), 6))
        heights = np.concatenate([path.p[:1, 2] + knife[:1, 2], p_true[:, 2]])
        sinking = -np.diff(heights) / T
        board[:, 5] = [self._board(z, s) for z, s in zip(heights[1:], sinking, strict=True)]
        weighed = np.array([label == "weight" for label in path.phase])
        other[weighed, 5] -= GRAVITY * specimen.condition.weight
        return Series(
            slice=facts,
            time=time,
            R=path.R[1:],
            p=path.p[1:],
            p_true=p_true,
            v=path.v,
            phase=path.phase,
            depth=depth,
            flank=2.0 * section.area * buried,
            flank_arm=raised,
            cut=np.maximum.accumulate(buried),
            edge=wrenches[0],
            normal=wrenches[1],
            friction=wrenches[2],
            board=board,
            other=other,
        )


class _Section:
    """An elliptic section: how much of it lies above a depth, and what effects do to it there."""

    def __init__(self, facts: SliceFacts, effects: Sequence[Effect]) -> None:
        a, b = 0.5 * facts.width, 0.5 * facts.height
        self.area = np.pi * a * b
        self._depth = np.linspace(0.0, facts.height, 121)
        up = 1.0 - self._depth / b
        half = a * np.sqrt(np.maximum(1.0 - up**2, 0.0))
        angle = np.arccos(np.clip(up, -1.0, 1.0))
        self._above = (angle - np.sin(angle) * np.cos(angle)) / np.pi
        across = np.linspace(-1.0, 1.0, 17)
        across = 0.5 * (across[1:] + across[:-1])
        x = np.outer(half, across).ravel()
        z = np.repeat(b * up, len(across))
        # Distance from an ellipse, to first order in its level function.
        level = np.sqrt((x / a) ** 2 + (z / b) ** 2)
        slope = np.sqrt((x / a**2) ** 2 + (z / b**2) ** 2) / np.maximum(level, 1e-9)
        distance = np.clip((1.0 - level) / np.maximum(slope, 1.0 / max(a, b)), 0.0, min(a, b))
        top = b * np.sqrt(np.maximum(1.0 - (x / a) ** 2, 0.0))
        tissue = Tissue(x=x, height=z + b, depth=np.maximum(top - z, 0.0), distance=distance)
        factor = np.ones((len(up), len(across)))
        for effect in effects:
            given = np.broadcast_to(np.asarray(effect.toughness(tissue), float), x.shape)
            factor *= given.reshape(factor.shape)
        sides = np.zeros((2 * len(half), 3))
        sides[:, 0] = np.concatenate([half, -half])
        sides[:, 2] = np.tile(b * up + b, 2)
        for effect in effects:
            sides = effect.reshape(sides)
        wide = 0.5 * (sides[: len(half), 0] - sides[len(half) :, 0])
        stretch = np.divide(wide, half, out=np.ones_like(half), where=half > 1e-6)
        self._more = facts.toughness * 2.0 * half * (factor.mean(1) * stretch - 1.0)

    def above(self, depth: float) -> float:
        """Share of the section above a depth."""
        return float(np.interp(depth, self._depth, self._above))

    def more(self, depth: float) -> float:
        """What effects add to the force of the edge at a depth, N."""
        return float(np.interp(depth, self._depth, self._more))


class _State:
    """What the slice remembers along the path."""

    def __init__(self, place: np.ndarray) -> None:
        self.place = place
        self.depth = -1.0
        self.deepest = 0.0
        self.travel = self.swept = 0.0
        self.speed = self.ratio = 0.0
        self.heading = np.array([0.0, 0.0, -1.0])
        self.force = np.zeros(3)
        self.rest = 0.0
        self.faded = 1.0

    def advance(self, now: Now, along: np.ndarray, place: np.ndarray, height: float) -> None:
        """To the end of a stretch.

        Args:
            now: The stretch.
            along: Direction of the edge in F [3].
            place: Of Ko in F relative to the food [3], metres.
            height: Of the food, metres.
        """
        step, self.place = place - self.place, place
        moved = float(np.linalg.norm(step))
        self.depth = height - float(place[2])
        self.deepest = max(self.deepest, self.depth)
        if moved > 1e-9:
            self.speed = moved / now.period
            sunk = -float(step[2])
            self.ratio = float(step @ along) / sunk if sunk > 1e-9 else 0.0
            self.rest = 0.0
            self.faded = min(1.0, self.faded + moved / RELOAD)
        else:
            self.rest += now.period
            loss = HOLD_FADE * np.log10(1.0 + self.rest / HOLD_ONSET)
            self.faded = min(self.faded, 1.0 - loss)
        if self.depth > 0.0 and moved > 1e-9:
            keep = np.exp(-moved / TURN)
            self.heading = keep * self.heading + (1.0 - keep) * step / moved
            self.travel += moved
            self.swept += 2.0 * moved * min(self.depth, 0.03)

    @property
    def loaded(self) -> float:
        """Share of the edge's force that is there: none in a cut that is open."""
        behind = (self.deepest - self.depth) / RELOAD
        return max(0.0, 1.0 - behind) * self.faded
