"""Elastic mounting between a prescribed motion and the cut: arm and holder."""

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.effects import Effects

__all__ = ["Mounting"]

ATTEMPTS = 40
"""Most evaluations of a coupling step; what is left is made up for by the next, which starts
anew."""


class Mounting:
    """Displacements of knife and food, in balance with the mean force of each coupling step.

    Arm and holder are springs without mass. A force that answers a displacement more stiffly than
    the spring makes any scheme unstable that takes the force of the coupling step before; a cut
    does, by friction on its flanks up to 1e6 N/m. So each coupling step is computed until its force
    and the springs' agree: a quasi-Newton search for the displacements (rise of the knife,
    displacement of the food along Cx); where only one gives, it is bracketed.

    Args:
        effects: Those of the cut: compliances of knife (vertical) and food (along the edge), slip.
        tolerance: Tolerance of the balance of forces, relative to 1 N and the force.

    Attributes:
        given: Rise of the knife and displacement of the food, metres [2].
    """

    def __init__(self, effects: Effects, tolerance: float = 1e-4) -> None:
        self._arm, self._holder = effects.compliance.arm, effects.compliance.holder
        self._slip, self._tolerance = effects.slip, tolerance
        self.given = np.zeros(2)
        # How far the food has slipped along Cx, and whether it slips.
        self._slipped, self._slipping = 0.0, False
        self._slope = np.zeros((2, 2))
        self._begin()

    def _begin(self) -> None:
        self._tried: tuple[np.ndarray, np.ndarray] | None = None
        self._attempts = 0
        self._between = np.array([[-np.inf] * 2, [np.inf] * 2])

    @property
    def rigid(self) -> bool:
        """Whether nothing gives."""
        return self._arm == 0.0 and self._holder == 0.0

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
        gives = np.array([self._arm > 0.0, self._holder > 0.0])
        excess = np.where(gives, force - held, 0.0)
        self._attempts += 1
        small = self._tolerance * np.maximum(1.0, np.abs(force))
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
        if self._arm > 0.0:
            held[0], stiffness[0] = rise / self._arm, 1.0 / self._arm
            if board is not None and height + rise < board.height:
                held[0] -= board.stiffness * (board.height - height - rise)
                stiffness[0] += board.stiffness
        if self._holder > 0.0:
            held[1], stiffness[1] = (shift - self._slipped) / self._holder, 1.0 / self._holder
            if abs(held[1]) > self._limit():
                held[1] = np.sign(held[1]) * self._limit()
                # Not zero, so that the search has a slope where the cut has none.
                stiffness[1] *= 1e-3
        return held, stiffness

    def _limit(self) -> float:
        """Force at which the food slips along the edge, N."""
        if self._slip.resistance is None:
            return np.inf
        return self._slip.resistance * (self._slip.remaining if self._slipping else 1.0)

    def _settle(self) -> None:
        """Takes what was found: the food slips, or holds again."""
        if self._holder > 0.0:
            shift, limit = float(self.given[1]), self._limit()
            pull = (shift - self._slipped) / self._holder
            self._slipping = abs(pull) >= limit
            if self._slipping:
                self._slipped = shift - self._holder * float(np.sign(pull)) * limit
        self._begin()
