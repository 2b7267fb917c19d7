"""A second world, of measured curves: it shares no code with the finite elements.

The food's forces are those of `curve_laws`: a measured curve over depth, speed, draw, hold and
flanks. With them goes a board of Hunt and Crossley's law with Hertz's exponent.

Of `cutting` it has the knife's motion and the configuration that a protocol is written in (size of
the food, board), and no solver, model, mesh or kernel: `tests/test_stand_in.py` looks at what it
imports. Effects act on it as on the finite elements, but those on the modulus.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.cutting.motion import Pose
from sliceit_drake.stand_in.curve_laws import CutState, EllipticSection, food_forces, measured_curve
from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth, Tissue
from sliceit_drake.stand_in.protocol import Protocol, Specimen, section_size
from sliceit_drake.stand_in.world import Path, Run, pushed
from sliceit_drake.tables import interpolated

__all__ = ["CurveWorld"]

BOARD_DEPTH = 3e-4
"""Depth at which the board is as stiff as the protocol's, metres."""
TRAVEL, LONGEST = 4e-5, 50


class CurveWorld:
    """Cuts slices by a measured curve.

    Args:
        protocol: The session, whose food's name chooses the curve.

    Raises:
        ConfigurationError: There is no curve of this food.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.curve = measured_curve(protocol.food.name)

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        """Cuts one slice; see `World`."""
        protocol, condition = self.protocol, specimen.condition
        width, height = section_size(protocol.food, condition.width_scale)
        facts = SliceTruth(
            index=specimen.index,
            peeled=condition.peeled,
            height=height,
            width=width,
            toughness=float(np.mean(self.curve.force)) / (0.25 * np.pi * width),
        )
        for effect in effects:
            effect.begin(facts, rng)
        x, y, _ = protocol.food.cut_point
        start = Pose(
            np.diag([1.0, -1.0, -1.0]),
            np.array([x + condition.offset, y, height + condition.clearance]),
        )
        path = Path.of(protocol, condition, start)
        return _CurveRun(path, specimen, facts, effects, self).cut()


@dc.dataclass
class _CurveRun(Run):
    """One slice by a measured curve."""

    world: CurveWorld

    def __post_init__(self) -> None:
        facts, specimen = self.facts, self.specimen
        self._protocol = self.world.protocol
        self._section = EllipticSection(facts.width, facts.height)
        size = facts.width / section_size(self._protocol.food, 1.0)[0]
        self._curve = self.world.curve.scaled(specimen.toughness).scaled(size)
        self._excess = _edge_excess(self._section, facts, self.effects)
        self._state = CutState(self.path.p[0])
        self._has_food = not specimen.condition.without_food

    def reached(self) -> tuple[float, float, float]:
        return self._state.depth, self._state.travel, self._state.swept

    def advance(self, now: Now, row: int) -> tuple[np.ndarray, float]:
        p, state = self.path.p[row] + now.knife_shift, self._state
        state.advance(now.period, self.path.R[row][:, 0], p - now.food_shift, self.facts.height)
        forces = np.zeros((3, 3))
        if self._has_food:
            more = float(np.interp(state.depth, self._section.depth, self._excess))
            factors = now.toughness, now.friction
            forces = food_forces(state, self._curve, self._section, *factors, more)
            forces[2] *= self.specimen.friction
        self.force = forces.sum(0) + [0.0, 0.0, self._board(p[2], now.press)]
        return forces, state.depth

    def _board(self, height: float, press: float) -> float:
        board = self._protocol.board
        depth = max(-height, 0.0)
        law = board.stiffness / np.sqrt(BOARD_DEPTH) * depth**1.5
        return float(law * max(0.0, 1.0 + 1.5 * board.dissipation * press))

    def cut(self) -> Series:
        """Cuts the slice."""
        path, section = self.path, self._section
        stretches, forces, depths, shifts = self.drive(TRAVEL, LONGEST, 0.0)
        time, ends = path.time[1:], path.period * stretches[:, 1]
        force = interpolated(time, ends, forces)
        knife, food = np.moveaxis(interpolated(time, ends, shifts), 1, 0)
        p_true = path.p[1:] + knife
        depth = interpolated(time, ends, depths)
        buried = np.array([section.above(d) for d in depth]) * self._has_food
        along = self._protocol.food.cut_point[0] + food[:, 0] - p_true[:, 0]
        return self.series(
            p_true,
            depth=depth,
            flank=2.0 * section.area * buried,
            cut=np.maximum.accumulate(buried),
            board=self.pressed(p_true, knife, self._board),
            **pushed(force, along, depth),
        )


def _edge_excess(
    section: EllipticSection, facts: SliceTruth, effects: Sequence[Effect]
) -> np.ndarray:
    """Force that effects add to the edge's at the depths of a section [n], N."""
    a, b, up, half = section.a, section.b, section.up, section.half
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
    return facts.toughness * 2.0 * half * (factor.mean(1) * stretch - 1.0)
