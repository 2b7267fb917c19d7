"""The knife's poses at the coupling steps of a slice, and how arm and holder give under its
force."""

import typing

import numpy as np

from sliceit_drake.cutting.board import Board, board_wrenches
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.mounting import Mounting

__all__ = ["CHECK_TRAVEL", "KnifePath", "PosedMotion"]

CHECK_TRAVEL = 1e-3
"""Travel of the knife between two checks of the energies, metres."""
BLOCK = 10
"""Coupling steps that are advanced at once where nothing stands against it."""


class PosedMotion(typing.Protocol):
    """A motion of the knife: poses X_FK at times from 0 to `duration`, s; as `Motion` is."""

    @property
    def duration(self) -> float: ...

    def pose(self, t: float) -> Pose: ...


class KnifePath:
    """Poses of the knife at the coupling steps, in F and relative to the food in C.

    Attributes:
        model: The cut.
        coupling_steps: Their number E.
        R_FK, p_FK: [E + 1, 3, 3] and [E + 1, 3].
        R_CK, p_CK: The same in C; where the mounting gives, relative to the food.
        rigid: Whether it does not give.
    """

    def __init__(self, model: CuttingModel, motion: PosedMotion, period: float) -> None:
        self._period = period
        self.coupling_steps = max(1, round(motion.duration / period))
        poses = [motion.pose(k * period) for k in range(self.coupling_steps + 1)]
        self.R_FK = np.array([X_FK.R for X_FK in poses])
        self.p_FK = np.array([X_FK.p for X_FK in poses])
        self._commands = self.p_FK.copy()
        self.model = model
        self.R_CK = model.X_FC_rotation.T @ self.R_FK
        self.p_CK = model.to_cut_frame(self.p_FK)
        self._mounting = Mounting(model.effects)
        self.rigid = self._mounting.rigid

    def pose(self, k: int) -> Pose:
        """X_CK after k coupling steps."""
        return Pose(self.R_CK[k], self.p_CK[k])

    def board_wrenches(self, board: Board | None) -> np.ndarray:
        """Wrench of the board, its height in F, on the knife at the end of each coupling step
        [E, 6], in F."""
        if board is None:
            return np.zeros((self.coupling_steps, 6))
        return board_wrenches(board, self.model.knife, self.R_FK, self.p_FK, self._period)

    def block(self, k: int) -> int:
        """How many coupling steps from the k-th can be advanced at once, without a check."""
        if not self.rigid or k + BLOCK > self.coupling_steps:
            return 1
        steps = np.diff(self.p_FK[k : k + BLOCK + 1], axis=0)
        return BLOCK if float(np.linalg.norm(steps, axis=1).sum()) < CHECK_TRAVEL else 1

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
        at = k + 1 if done else k
        if at <= self.coupling_steps:
            rise, shift = self._mounting.given.tolist()
            self.p_FK[at] = self._commands[at] + [0.0, 0.0, rise]
            self.p_CK[at] = self.model.to_cut_frame(self.p_FK[at])
            self.p_CK[at, 0] -= shift
        return done
