"""Effects of what holds knife and food: board, arm, wrist, holder, slips."""

import numpy as np

from sliceit_drake.stand_in.effect import Effect, Now, Series, SliceTruth

__all__ = [
    "ArmCompliance",
    "BoardHeight",
    "BoardLaw",
    "FoodSlip",
    "HolderCompliance",
    "MagneticBoard",
    "WarmWrist",
]

STIFFEST = 3e6
"""Greatest stiffness that arm and holder can meet, N/m."""
FORGET = 0.8
"""Fraction of the last estimate of that below which the next does not fall."""


class BoardHeight(Effect):
    """Board and food that lie higher by `size` than was measured."""

    cause = "board"
    unit = "m"
    typical = 2e-4

    def drive(self, now: Now) -> None:
        now.knife_shift[2] -= self.size


class BoardLaw(Effect):
    """A board that stiffens as it gives: its force F becomes F (1 + size ((F / F_0)^0.5 - 1)), the
    root of the force for the share `size` (a Hertzian contact goes with d^1.5)."""

    cause = "board"
    typical = 0.2
    reference = 1.5

    def respond(self, series: Series) -> None:
        force = np.abs(series.board[:, 5])
        factor = 1.0 + self.size * (np.sqrt(force / self.reference) - 1.0)
        series.board *= np.maximum(factor, 0.0)[:, None]


class ArmCompliance(Effect):
    """An arm that gives by `size` per vertical force: two thirds in `fast`, the rest in `slow`.

    The encoders do not see it.
    """

    cause = "compliance"
    unit = "m/N"
    typical = 5e-5
    least = 0.0
    every_coupling_step = True
    fast, slow = 0.03, 0.6

    _given = np.zeros(2)
    _force = _stiffness = _place = _before = 0.0

    def _yield(self, force: float, commanded: float, period: float) -> float:
        """How far it has given at the end of a stretch.

        Args:
            force: Force on what gives, in the stretch before, N.
            commanded: Place along the direction in which it gives, at the end, metres.
            period: Duration of the stretch, s.
        """
        # Force answers the place with a stiffness, estimated from the last two stretches. With it
        # taken into account a stiff contact does not chatter, and the balance is the same.
        moved = abs(self._place - self._before)
        stiffness = abs(force - self._force) / moved if moved > 1e-9 else 0.0
        self._stiffness = max(min(stiffness, STIFFEST), FORGET * self._stiffness)
        compliance = self.size * np.array([2.0 / 3.0, 1.0 / 3.0])
        follow = -np.expm1(-period / np.array([self.fast, self.slow]))
        given = (follow * (compliance * force - self._given)).sum()
        given /= 1.0 + self._stiffness * (follow * compliance).sum()
        force_then = force - self._stiffness * given
        self._given = self._given + follow * (compliance * force_then - self._given)
        total = float(self._given.sum())
        self._force, self._before, self._place = force, self._place, commanded + total
        return total

    def drive(self, now: Now) -> None:
        height = float(now.position[2])
        now.knife_shift[2] += self._yield(float(now.force[2]), height, now.period)


class HolderCompliance(ArmCompliance):
    """A holder of the food that gives by `size` per force along the edge, as the arm does."""

    def drive(self, now: Now) -> None:
        place = -float(now.position[0])
        now.food_shift[0] += self._yield(-float(now.force[0]), place, now.period)


class FoodSlip(Effect):
    """Food that slips along the edge by `size` and drops by a twentieth of that, at a depth of the
    first cut that differs from slice to slice; in one slice out of four it does not."""

    cause = "slip of the food"
    unit = "m"
    typical = 3e-3
    least = 0.0
    duration = 0.02

    def begin(self, facts: SliceTruth, rng: np.random.Generator) -> None:
        super().begin(facts, rng)
        self._depth = rng.uniform(0.25, 0.9) * facts.height
        self._side = rng.choice((-1.0, 1.0))
        self._slips = bool(rng.random() < 0.75 and facts.height > 0.0)
        self._since: float | None = None

    def drive(self, now: Now) -> None:
        if self._since is None and self._slips and now.press > 0.0 and now.depth > self._depth:
            self._since = now.time
        if self._since is not None:
            done = -np.expm1(-(now.time + now.period - self._since) / self.duration)
            now.food_shift += self.size * done * np.array([self._side, 0.0, -0.05])

    def respond(self, series: Series) -> None:
        if self._since is not None:
            late = series.time - self._since
            knock = np.where(late > 0.0, np.exp(-np.maximum(late, 0.0) / 0.05), 0.0)
            # The blade is knocked sideways, in proportion to how far the food slipped.
            series.other[:, 4] += 500.0 * self.size * self._side * knock


class MagneticBoard(Effect):
    """A magnet under the board pulls at the blade, `size` at the board, less by the square of
    the distance over `reach`, and a third of that sideways."""

    unit = "N"
    typical = 2.5
    reach = 0.012

    def respond(self, series: Series) -> None:
        above = np.maximum(series.p_true[:, 2], 0.0)
        pull = self.size / (1.0 + above / self.reach) ** 2
        series.other[:, 5] -= pull
        series.other[:, 4] += pull / 3.0


class WarmWrist(Effect):
    """A wrist that leans the more slices were cut: a sideways force of `size` times the square of
    the slice's number over ten, while anything presses."""

    unit = "N"
    typical = 0.4

    def respond(self, series: Series) -> None:
        pressed = np.tanh(np.abs(series.force[:, 2]) / 2.0)
        series.other[:, 4] += self.size * (0.1 * self.facts.index) ** 2 * pressed
