"""Elastic mounting between a prescribed motion and the cut: arm and holder."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.effects import Effects

__all__ = ["Mounting"]

ATTEMPTS = 40
"""Most evaluations of a coupling step; what is left is made up for by the next, which starts
anew."""


@dc.dataclass
class Mounting:
    """Displacements of knife and food, in balance with the mean force of each coupling step.

    Arm and holder are springs without mass. A force that answers a displacement more stiffly than
    the spring makes any scheme unstable that takes the force of the coupling step before; a cut
    does, by friction on its flanks up to 1e6 N/m. So each coupling step is computed until its force
    and the springs' agree: a quasi-Newton search for the displacements (rise of the knife,
    displacement of the food along Cx); where only one gives, it is bracketed.

    Attributes:
        arm, holder: Compliances of knife (vertical) and food (along the edge), m/N.
        resistance: Force along the edge at which the food slips, N; None for never.
        remaining: Fraction of the resistance that is left while it slips.
        tolerance: Tolerance of the balance of forces, relative to 1 N and the force.
        given: Rise of the knife and displacement of the food, metres [2].
        slipped: How far the food has slipped along Cx, metres.
        slipping: Whether it slips.
    """

    arm: float
    holder: float
    resistance: float | None
    remaining: float
    tolerance: float = 1e-4
    given: np.ndarray = dc.field(default_factory=lambda: np.zeros(2))
    slipped: float = 0.0
    slipping: bool = False
    _slope: np.ndarray = dc.field(default_factory=lambda: np.zeros((2, 2)))
    _tried: tuple[np.ndarray, np.ndarray] | None = None
    _between: np.ndarray = dc.field(default_factory=lambda: np.array([[-np.inf] * 2, [np.inf] * 2]))
    _attempts: int = 0

    @classmethod
    def of(cls, effects: Effects, tolerance: float = 1e-4) -> "Mounting":
        """The mounting of a cut at its start."""
        slip, compliance = effects.slip, effects.compliance
        return cls(
            compliance.arm, compliance.holder, slip.resistance, slip.remaining, tolerance=tolerance
        )

    @property
    def rigid(self) -> bool:
        """Whether nothing gives."""
        return self.arm == 0.0 and self.holder == 0.0

    def balanced(self, rise: float, draw: float, height: float, board: Board | None) -> bool:
        """Whether the springs hold the forces that a coupling step with `given` has answered.

        If not, `given` is the next try; if so, the food has slipped as it does, and `given` is what
        the next coupling step begins with.

        Args:
            rise: Upward force of the food on the knife, N.
            draw: Force of the knife on the food along Cx, N.
            height: Height of the knife without the arm's spring, z in F, metres.
            board: Board under the knife, its height in F; None for none.
        """
        force = np.array([rise, draw])
        held, stiffness = self._held(height, board)
        gives = np.array([self.arm > 0.0, self.holder > 0.0])
        excess = np.where(gives, force - held, 0.0)
        self._attempts += 1
        small = self.tolerance * np.maximum(1.0, np.abs(force))
        # Where the cut broke down there is nothing to balance. Where its force jumps, as when a
        # skin gives way, there is no balance, but a displacement at which it jumps.
        over = self._attempts >= ATTEMPTS or not np.isfinite(force).all()
        jump = (self._between[1] - self._between[0]) * stiffness < small
        if over or (jump | ~gives).all() or (np.abs(excess) <= small).all():
            self._settle()
            return True
        if self._tried is not None:
            moved, change = self.given - self._tried[0], force - self._tried[1]
            missed = np.where(gives, -change - self._slope @ moved, 0.0)
            self._slope = self._slope + np.outer(missed, moved) / max(float(moved @ moved), 1e-30)
            # A cut that gives way as it is pushed back is no slope to rely on.
            np.fill_diagonal(self._slope, np.maximum(np.diag(self._slope), 0.0))
        self._tried = self.given.copy(), force
        low, high = self._between
        low[excess > 0.0] = self.given[excess > 0.0]
        high[excess < 0.0] = self.given[excess < 0.0]
        total = self._slope + np.diag(stiffness)
        if np.linalg.det(total) < 1e-3 * np.diag(total).prod():
            total = np.diag(np.diag(total))
        after = self.given + np.linalg.solve(total, excess)
        if not gives.all():
            # Where both give, each moves what is too small or too large for the other.
            axis = int(gives.argmax())
            if not low[axis] < after[axis] < high[axis]:
                after[axis] = 0.5 * (low[axis] + high[axis])
        self.given = after
        return False

    def _held(self, height: float, board: Board | None) -> tuple[np.ndarray, np.ndarray]:
        """Forces that arm (with the board) and holder hold at `given`, and their slopes [2]."""
        rise, shift = self.given.tolist()
        held, stiffness = np.zeros(2), np.ones(2)
        if self.arm > 0.0:
            held[0], stiffness[0] = rise / self.arm, 1.0 / self.arm
            if board is not None and height + rise < board.height:
                held[0] -= board.stiffness * (board.height - height - rise)
                stiffness[0] += board.stiffness
        if self.holder > 0.0:
            held[1], stiffness[1] = (shift - self.slipped) / self.holder, 1.0 / self.holder
            if abs(held[1]) > self._limit():
                held[1] = np.sign(held[1]) * self._limit()
                # Not zero, so that the search has a slope where the cut has none.
                stiffness[1] *= 1e-3
        return held, stiffness

    def _limit(self) -> float:
        if self.resistance is None:
            return np.inf
        return self.resistance * (self.remaining if self.slipping else 1.0)

    def _settle(self) -> None:
        """Takes what was found: the food slips, or holds again."""
        if self.holder > 0.0:
            shift, limit = float(self.given[1]), self._limit()
            pull = (shift - self.slipped) / self.holder
            self.slipping = abs(pull) >= limit
            if self.slipping:
                self.slipped = shift - self.holder * float(np.sign(pull)) * limit
        self._tried, self._attempts = None, 0
        self._between = np.array([[-np.inf] * 2, [np.inf] * 2])
