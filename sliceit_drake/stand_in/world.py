"""The interface of a world, and what all share: the knife's path, and how a slice follows it."""

import abc
import dataclasses as dc
import typing
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from sliceit_drake.cutting.motion import Motion, Pose
from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth
from sliceit_drake.stand_in.protocol import Condition, Protocol, Specimen

__all__ = ["GRAVITY", "Path", "Run", "World", "pushed"]

GRAVITY = 9.81
"""m/s2."""


class World(typing.Protocol):
    """Cuts slices."""

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        """Cuts one slice.

        Args:
            specimen: The slice.
            effects: What is hidden; fresh copies, which the world begins.
            rng: Random numbers for what differs from slice to slice.
        """
        ...


@dc.dataclass
class Path:
    """A prescribed motion, sampled every coupling step; row 0 is the start.

    Attributes:
        period: Time between two poses, s.
        time: [E + 1], s.
        R, p: Pose of the knife in F [E + 1, 3, 3] and [E + 1, 3], metres.
        phase: Label of the segment that leads to each row but the first [E].
        span: First row of that segment and the row at its end [E, 2].
    """

    period: float
    time: np.ndarray
    R: np.ndarray
    p: np.ndarray
    phase: list[str]
    span: np.ndarray

    @classmethod
    def of(cls, protocol: Protocol, condition: Condition, start: Pose) -> "Path":
        """Samples the motion of a condition from a start pose in F."""
        clamps = not condition.without_food and protocol.food.held_sides == "both"
        plan = condition.motion.or_cut_through(float(start.p[2]), clamps)
        motion, period = Motion(plan, start), protocol.exchange_period
        count = max(2, round(motion.duration / period))
        time = period * np.arange(count + 1)
        poses = [motion.pose(t) for t in time]
        ends = np.array([end for _, _, end in motion.phases])
        middle = time[1:] - 0.5 * period
        segment = np.minimum(np.searchsorted(ends, middle), len(ends) - 1)
        first = np.searchsorted(segment, segment, side="left")
        last = np.searchsorted(segment, segment, side="right")
        return cls(
            period,
            time,
            np.array([X.R for X in poses]),
            np.array([X.p for X in poses]),
            [motion.phases[s][0] for s in segment],
            np.column_stack([first, last]),
        )

    def __len__(self) -> int:
        return len(self.time) - 1

    @property
    def v(self) -> np.ndarray:
        """Mean velocity of Ko over each coupling step [E, 3], m/s."""
        return np.diff(self.p, axis=0) / self.period

    def stretches(self, travel: float, longest: int, reach: float) -> Iterator[tuple[int, int]]:
        """Cuts the path into stretches [a, b) of coupling steps, short where the knife is fast.

        A stretch is longer than one coupling step only where the knife moves less than `travel` in
        it, and short before the end of a segment and still more so after its beginning, where food
        and effects settle.

        Args:
            travel: metres.
            longest: Coupling steps.
            reach: Half the length of the edge, for turns, metres.
        """
        moved = np.linalg.norm(np.diff(self.p, axis=0), axis=1)
        turned = np.linalg.norm(np.diff(self.R, axis=0), axis=(1, 2)) * reach
        done = np.concatenate([[0.0], np.cumsum(moved + turned)])
        a = 0
        while a < len(self):
            first, last = (int(k) for k in self.span[a])
            most = min(longest, 1 + (a - first) // 8, 1 + (last - a) // 3)
            b = int(np.searchsorted(done, done[a] + travel * (1.0 + 1e-9), side="right")) - 1
            b = min(max(b, a + 1), a + max(most, 1))
            yield a, b
            a = b


def pushed(forces: np.ndarray, along: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    """Those fields of `Series` that say where the food pushes the knife, and how: the edge at its
    place in the food, the flanks above that in the middle of what is buried.

    Args:
        forces: Of edge, flanks' pressure and friction, in F [N, 3, 3], N.
        along: From Ko to the middle of the food, along Fx [N], metres.
        depth: Of the edge below the top of the food [N], metres.
    """
    arm = np.zeros((len(along), 3))
    arm[:, 0] = along
    raised = arm + np.array([0.0, 0.0, 0.5]) * np.maximum(depth, 0.0)[:, None]
    edge, normal, friction = (
        np.concatenate([np.cross(r, forces[:, k]), forces[:, k]], axis=1)
        for k, r in enumerate((arm, raised, raised))
    )
    return {"flank_arm": raised, "edge": edge, "normal": normal, "friction": friction}


@dc.dataclass
class Run(abc.ABC):
    """One slice while it is cut, stretch by stretch of the knife's path.

    Attributes:
        path: Of the knife.
        specimen, facts: The slice.
        effects: What is hidden; they have begun.
        force: Force of food and board on the knife in the last stretch, in F [3], N.
    """

    path: Path
    specimen: Specimen
    facts: SliceTruth
    effects: Sequence[Effect]
    force: np.ndarray = dc.field(init=False, default_factory=lambda: np.zeros(3))

    @abc.abstractmethod
    def reached(self) -> tuple[float, float, float]:
        """Depth, travel and swept area so far, see `Now`."""

    @abc.abstractmethod
    def advance(self, now: Now, row: int) -> tuple[np.ndarray, float]:
        """Advances food and board through a stretch, and sets `force`.

        Args:
            now: The stretch, as effects have changed it.
            row: Row of the path at its end.

        Returns:
            Forces or wrenches by mechanism, in F [3, ...], and how far the cut has come.
        """

    def drive(
        self, travel: float, longest: int, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Drives the knife along the path.

        Args:
            travel, longest, reach: See `Path.stretches`; effects may want each coupling step.

        Returns:
            Rows of the path where the stretches begin and end [M, 2]; what `advance` returned of
            each [M, 3, ...] and [M]; shifts of knife and food in each [M, 2, 3], metres.
        """
        path = self.path
        if any(effect.every_coupling_step for effect in self.effects):
            longest = 1
        stretches = list(path.stretches(travel, longest, reach))
        parts, cuts, shifts = [], [], []
        for a, b in stretches:
            period = path.period * (b - a)
            v = (path.p[b] - path.p[a]) / period
            depth, travelled, swept = self.reached()
            now = Now(
                time=float(path.time[a]),
                period=period,
                position=path.p[b],
                press=-float(v[2]),
                draw=float(v @ path.R[b][:, 0]),
                depth=depth,
                travel=travelled,
                swept=swept,
                force=self.force,
            )
            for effect in self.effects:
                effect.drive(now)
            if self.facts.height > 0.0:
                # A slice that is taller lies on the board as well.
                over = max(float(path.p[b, 2]) / self.facts.height, 0.0)
                now.food_shift[2] += over * self.specimen.height
            shifts.append(np.array([now.knife_shift, now.food_shift]))
            part, cut = self.advance(now, b)
            parts.append(part)
            cuts.append(cut)
        return np.array(stretches), np.array(parts), np.array(cuts), np.array(shifts)

    def pressed(
        self, p_true: np.ndarray, shift: np.ndarray, law: Callable[[float, float], float]
    ) -> np.ndarray:
        """Wrench of a board that pushes Ko up [N, 6], Nm and N.

        Args:
            p_true: True positions of Ko after each coupling step [N, 3], metres.
            shift: Knife off its commanded position there [N, 3], metres.
            law: Its force, N, by the height of the edge, metres, and how fast it sinks, m/s.
        """
        heights = np.concatenate([self.path.p[:1, 2] + shift[:1, 2], p_true[:, 2]])
        sinking = -np.diff(heights) / self.path.period
        wrench = np.zeros((len(p_true), 6))
        wrench[:, 5] = [law(z, s) for z, s in zip(heights[1:], sinking, strict=True)]
        return wrench

    def series(self, p_true: np.ndarray, **own: np.ndarray) -> Series:
        """The slice.

        Args:
            p_true: True positions of Ko after each coupling step [N, 3], metres.
            own: Those fields of `Series` that are the world's own.
        """
        path = self.path
        other = np.zeros((len(path), 6))
        weighed = np.array([label == "weight" for label in path.phase])
        other[weighed, 5] -= GRAVITY * self.specimen.condition.weight
        return Series(
            slice=self.facts,
            time=path.time[1:],
            R=path.R[1:],
            p=path.p[1:],
            p_true=p_true,
            v=path.v,
            phase=path.phase,
            other=other,
            **own,
        )
