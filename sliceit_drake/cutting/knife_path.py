"""The knife's poses at the coupling steps of a slice, and how arm and holder give under its
force."""

import typing

import numpy as np

from sliceit_drake.cutting.board import Board, board_wrenches
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose

__all__ = ["CHECK_TRAVEL", "KnifePath", "Mounting", "PosedMotion", "sample_poses"]

CHECK_TRAVEL = 1e-3
"""Travel of the knife between two checks of the energies, metres."""
BLOCKS = (25, 10, 5)
"""Numbers of coupling steps that are advanced at once where nothing stands against it."""
ATTEMPTS = 40
"""Most evaluations of a coupling step; what is left is made up for by the next, which starts
anew."""


class PosedMotion(typing.Protocol):
    """A motion of the knife: poses X_FK at times from 0 to `duration`, s; as `Motion` is."""

    @property
    def duration(self) -> float: ...

    def pose(self, t: float) -> Pose: ...


def sample_poses(motion: PosedMotion, period: float) -> tuple[np.ndarray, np.ndarray]:
    """R_FK [E + 1, 3, 3] and p_FK [E + 1, 3], metres, at the coupling steps of a motion.

    Args:
        period: Of a coupling step, s.
    """
    steps = max(1, round(motion.duration / period))
    poses = [motion.pose(k * period) for k in range(steps + 1)]
    return np.array([X_FK.R for X_FK in poses]), np.array([X_FK.p for X_FK in poses])


class KnifePath:
    """Poses of the knife at the coupling steps, in F and relative to the food in C.

    Args:
        model: The cut.
        motion: Of the knife.
        period: Of a coupling step, s.
        poses: What `sample_poses` gives for the motion, where it is known.

    Attributes:
        model: The cut.
        coupling_steps: Their number E.
        R_FK, p_FK: [E + 1, 3, 3] and [E + 1, 3].
        R_CK, p_CK: The same in C; where the mounting gives, relative to the food.
        rigid: Whether it does not give.
    """

    def __init__(
        self,
        model: CuttingModel,
        motion: PosedMotion,
        period: float,
        poses: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self._period = period
        self.R_FK, self._commands = poses or sample_poses(motion, period)
        self.p_FK = self._commands.copy()
        self.coupling_steps = len(self.p_FK) - 1
        self.model = model
        self.R_CK = model.X_FC_rotation.T @ self.R_FK
        self.p_CK = model.to_cut_frame(self.p_FK)
        self._commanded_p_CK = self.p_CK.copy()
        self._mounting = Mounting(model.effects)
        self.rigid = self._mounting.rigid
        steps = np.linalg.norm(np.diff(self.p_FK, axis=0), axis=1)
        self._travel = np.concatenate([[0.0], np.cumsum(steps)])

    def pose(self, k: int) -> Pose:
        """X_CK after k coupling steps."""
        return Pose(self.R_CK[k], self.p_CK[k])

    def poses(
        self, first: int, count: int, commanded: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """R_CK and p_CK at the ends of `count` coupling steps from the first [count + 1, ...].

        A knife whose motion is over rests at its end. As `commanded` nothing gives.
        """
        rows = np.minimum(np.arange(first, first + count + 1), self.coupling_steps)
        p = self._commanded_p_CK if commanded else self.p_CK
        return self.R_CK[rows], p[rows]

    def board_wrenches(self, board: Board | None) -> np.ndarray:
        """Wrench of the board, its height in F, on the knife at the end of each coupling step
        [E, 6], in F."""
        if board is None:
            return np.zeros((self.coupling_steps, 6))
        return board_wrenches(board, self.model.knife, self.R_FK, self.p_FK, self._period)

    def in_food(self, wrenches: np.ndarray) -> np.ndarray:
        """Wrenches by mechanism [E, 3, 6] in F from those of the cut in C, with the effects that
        change its force."""
        turned = wrenches.reshape(-1, 3, 2, 3) @ self.model.X_FC_rotation.T
        parts = turned.reshape(-1, 3, 6)
        if self.model.effects.changes_force:
            n = len(parts)
            speed = np.diff(self._travel[: n + 1]) / self._period
            edge = self.R_FK[1 : n + 1, :, 0]
            parts, _ = self.model.effects.changed(parts, edge, speed, self._period)
        return parts

    def block(self, k: int) -> int:
        """How many coupling steps from the k-th can be advanced at once, without a check."""
        ends = np.array(BLOCKS) + k
        fits = self.rigid & (ends <= self.coupling_steps)
        start, *at = self._travel[np.minimum([k, *ends], self.coupling_steps)]
        travel = np.array(at) - start
        # To rounding: a constant speed that is a whole number of mm/s fits as a rule.
        fits &= travel < CHECK_TRAVEL + 1e-9
        return BLOCKS[int(fits.argmax())] if fits.any() else 1

    def balanced(self, k: int, force: np.ndarray, board: Board | None) -> bool:
        """Whether arm and holder hold the force on the knife [3], N, in C, of the k-th coupling
        step.

        If not, they have given, and the coupling step that ends at the k-th pose is to be repeated.
        """
        if self.rigid or k > self.coupling_steps:
            return True
        rise = float((self.model.X_FC_rotation @ force)[2])
        height = float(self._commands[k, 2])
        done = self._mounting.balanced(rise, -float(force[0]), height, board)
        self._give(k + 1 if done else k)
        return done

    def undo(self, k: int) -> None:
        """Takes back that the mounting holds the k-th coupling step, which is to be repeated."""
        if not self.rigid and k <= self.coupling_steps:
            self._mounting.undo()
            self._give(k)

    def _give(self, k: int) -> None:
        if k <= self.coupling_steps:
            rise, shift = self._mounting.given.tolist()
            self.p_FK[k] = self._commands[k] + [0.0, 0.0, rise]
            self.p_CK[k] = self.model.to_cut_frame(self.p_FK[k])
            self.p_CK[k, 0] -= shift


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
        self._before = self._start

    def _begin(self) -> None:
        self._start = self.given, self._slipped, self._slipping, self._slope
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

    def undo(self) -> None:
        """Goes back to what the coupling step that was balanced last began with."""
        self.given, self._slipped, self._slipping, self._slope = self._before
        self._begin()

    def _settle(self) -> None:
        """Takes what was found: the food slips, or holds again."""
        self._before = self._start
        if self._holder > 0.0:
            shift, limit = float(self.given[1]), self._limit()
            pull = (shift - self._slipped) / self._holder
            self._slipping = abs(pull) >= limit
            if self._slipping:
                self._slipped = shift - self._holder * float(np.sign(pull)) * limit
        self._begin()
