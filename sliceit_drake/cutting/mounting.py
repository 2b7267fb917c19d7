"""What gives between a prescribed motion and the cut: arm and holder."""

import dataclasses as dc

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.effects import Effects

__all__ = ["Mounting"]


@dc.dataclass
class Mounting:
    """Displacements of knife and food by the force between them, one exchange late.

    Attributes:
        arm, holder: Compliances of knife (vertical) and food (along the edge), m/N.
        resistance: Force along the edge at which the food slips, N; None for never.
        remaining: Share of the resistance that is left while it slips.
        slipped: How far the food has slipped along Cx, metres.
        slipping: Whether it slips.
    """

    arm: float
    holder: float
    resistance: float | None
    remaining: float
    slipped: float = 0.0
    slipping: bool = False

    @classmethod
    def of(cls, effects: Effects) -> "Mounting":
        """The mounting of a cut at its start."""
        slip, compliance = effects.slip, effects.compliance
        return cls(compliance.arm, compliance.holder, slip.resistance, slip.remaining)

    @property
    def rigid(self) -> bool:
        """Whether nothing gives."""
        return self.arm == 0.0 and self.holder == 0.0

    def advance(self, force: np.ndarray) -> None:
        """Lets the food slip under the force of the food on the knife [3], N, in C."""
        if self.resistance is None:
            return
        draw = -float(force[0])
        held = self.remaining * self.resistance
        self.slipping = abs(draw) > (held if self.slipping else self.resistance)
        if self.slipping:
            # The holder's spring gives up what it carried beyond the rest.
            self.slipped += self.holder * (draw - np.sign(draw) * held)

    def knife(self, command: np.ndarray, force: np.ndarray, board: Board | None) -> np.ndarray:
        """Position of Ko [3], in frames with z up, when the food pushes the knife with `force`.

        The board's spring, much stiffer than the food's, is in balance with the arm's at once.
        """
        height = command[2] + self.arm * float(force[2])
        if board is not None and height < board.height:
            stiffness = self.arm * board.stiffness
            height = (height + stiffness * board.height) / (1.0 + stiffness)
        return np.array([command[0], command[1], height])

    def food(self, force: np.ndarray) -> float:
        """Displacement of the food along Cx under the force of the food on the knife, metres."""
        return self.slipped - self.holder * float(force[0])
