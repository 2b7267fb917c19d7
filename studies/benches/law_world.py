"""A world that cuts by a foreign law; it shares no code with the cutting simulator.

A law says what force the food answers with to the way of an edge through a section. Of the package
it has the stand-in's interface of worlds and effects and the sampling of the prescribed path, and
no solver, model, mesh or kernel (`tests/test_benches.py` looks at the imports).
"""

import abc
import dataclasses as dc
from collections.abc import Sequence
from typing import Protocol as Interface

import numpy as np

from sliceit_drake.cutting.motion import Pose
from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth
from sliceit_drake.stand_in.protocol import Protocol, Specimen, section_size
from sliceit_drake.stand_in.world import Path, Run, pushed
from sliceit_drake.tables import interpolated
from studies.benches.section import Section

__all__ = ["Cut", "Heading", "Law", "LawWorld"]

TRAVEL, LONGEST = 4e-5, 5
"""Most motion, metres, and most coupling steps that are computed as one."""


class Heading:
    """The direction in which the food slides along the blade; it turns over `travel`, as bristles
    (Dahl 1968) do, and stays while nothing moves.

    Attributes:
        vector: Along x and z [2], at most of length 1.
    """

    def __init__(self, travel: float) -> None:
        self._travel = travel
        self.vector = np.zeros(2)

    def move(self, step: np.ndarray) -> None:
        """Moves on by a step of the blade along x and z [2], metres."""
        way = float(np.hypot(*step))
        if way > 1e-10:
            keep = float(np.exp(-way / self._travel))
            self.vector = keep * self.vector + (1.0 - keep) * step / way


class Cut(abc.ABC):
    """One slice while it is cut.

    Attributes:
        middle: Where along the edge the edge's force acts, x in F, metres.
    """

    middle = 0.0

    @abc.abstractmethod
    def advance(
        self, period: float, x: float, z: float, toughness: float, friction: float
    ) -> np.ndarray:
        """Moves the edge on.

        Args:
            period: Duration of the motion, s.
            x, z: Where the edge then is relative to the food, in F, metres.
            toughness, friction: Factors on the material's.

        Returns:
            Force on the knife by mechanism: edge, flanks' pressure, friction [3, 3], in F, N.
        """


class Law(Interface):
    """Constants of a law.

    Attributes:
        toughness: J/m^2, for what is hidden in terms of it.
    """

    @property
    def toughness(self) -> float: ...

    def begin(self, section: Section, specimen: Specimen, x: float, z: float) -> Cut:
        """An uncut slice, with the edge over it at x, z, metres."""
        ...


class LawWorld:
    """Cuts the slices of a protocol by a law.

    Args:
        protocol: What is cut.
        law: How.
    """

    def __init__(self, protocol: Protocol, law: Law) -> None:
        self.protocol, self.law = protocol, law

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        """Cuts one slice; see `World`."""
        protocol, condition = self.protocol, specimen.condition
        width, height = section_size(protocol.food, condition.width_scale)
        toughness = self.law.toughness
        facts = SliceTruth(specimen.index, condition.peeled, height, width, toughness)
        for effect in effects:
            effect.begin(facts, rng)
        is_round = type(protocol.food.shape).__name__ == "Cylinder"
        place = np.array([condition.offset, 0.0, height + condition.clearance])
        path = Path.of(protocol, condition, Pose(np.diag([1.0, -1.0, -1.0]), place))
        section = Section(width, height, is_round, effects)
        return _LawRun(path, specimen, facts, effects, self, section).cut()


@dc.dataclass
class _LawRun(Run):
    """One slice by a law."""

    world: LawWorld
    section: Section

    def __post_init__(self) -> None:
        self._place = self.path.p[0].copy()
        x, _, z = self._place
        self._has_food = not self.specimen.condition.without_food
        self._cut = self.world.law.begin(self.section, self.specimen, float(x), float(z))
        self._travel = self._swept = 0.0
        self._deepest = self.section.top

    def reached(self) -> tuple[float, float, float]:
        return self.section.top - float(self._place[2]), self._travel, self._swept

    def advance(self, now: Now, row: int) -> tuple[np.ndarray, float]:
        p = self.path.p[row] + now.knife_shift
        place = p - now.food_shift
        step, self._place = place - self._place, place
        forces = np.zeros((4, 3))
        if self._has_food:
            x, _, z = place.tolist()
            forces[:3] = self._cut.advance(now.period, x, z, now.toughness, now.friction)
            if z < self.section.top:
                moved = float(np.linalg.norm(step))
                self._travel += moved
                self._swept += 2.0 * moved * self.section.at(self.section.width, z)
            self._deepest = min(self._deepest, z)
        forces[3, 0] = self._cut.middle + now.food_shift[0]
        self.force = forces[:3].sum(0) + [0.0, 0.0, self._board(p[2], now.press)]
        return forces, self.section.above(self._deepest) / self.section.area

    def _board(self, height: float, press: float) -> float:
        # As the user knows it: a bench on which nothing is hidden differs by its food alone.
        board = self.world.protocol.board
        factor = max(0.0, 1.0 + board.dissipation * press)
        return board.stiffness * max(-height, 0.0) * factor

    def cut(self) -> Series:
        """Cuts the slice."""
        path, section = self.path, self.section
        stretches, parts, cut, shifts = self.drive(TRAVEL, LONGEST, 0.0)
        time, ends = path.time[1:], path.period * stretches[:, 1]
        force = interpolated(time, ends, parts)
        knife, food = np.moveaxis(interpolated(time, ends, shifts), 1, 0)
        p_true = path.p[1:] + knife
        height = (p_true - food)[:, 2]
        depth = section.top - height
        buried = np.array([section.above(z) for z in height]) * self._has_food
        return self.series(
            p_true,
            depth=depth,
            flank=2.0 * buried,
            cut=interpolated(time, ends, cut),
            board=self.pressed(p_true, knife, self._board),
            **pushed(force, force[:, 3, 0] - p_true[:, 0], depth),
        )
