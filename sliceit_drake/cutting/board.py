"""The cutting board and its contact law on a prescribed knife motion."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import quantity
from sliceit_drake.cutting.knife import Knife

__all__ = ["Board", "board_wrench", "edge_contact_positions"]

EDGE_CONTACTS = 9


@dc.dataclass
class Board:
    """The board: a horizontal top surface that the knife's edge and the food rest on.

    Stiffness and dissipation are those of the whole edge lying on the board (docs/physics.md); no
    measurement of the paper's board is published, so both are declared free.
    """

    height: float = quantity(0.05, "m", low=-1.0, high=2.0, doc="Top surface in the world frame.")
    size: list[float] = quantity(
        [0.30, 0.20, 0.02], "m", low=1e-3, high=2.0, doc="Extent along x, y and thickness."
    )
    stiffness: float = quantity(
        1e5, "N/m", low=1e2, high=1e8, doc="Force over penetration of the whole edge."
    )
    dissipation: float = quantity(
        1.0, "s/m", low=0.0, high=100.0, doc="Hunt-Crossley dissipation: F = k d (1 + D d')."
    )


def edge_contact_positions(knife: Knife) -> np.ndarray:
    """Points on the edge that touch the board [EDGE_CONTACTS], x in the knife frame, metres."""
    return np.linspace(-0.5, 0.5, EDGE_CONTACTS) * knife.length


def board_wrench(
    board: Board,
    knife: Knife,
    R_WK: np.ndarray,
    p_WK: np.ndarray,
    v_WK: np.ndarray,
    w_WK: np.ndarray,
) -> np.ndarray:
    """Wrench of the board on a knife that moves on a prescribed path, frictionless.

    Args:
        board: The board.
        knife: The knife.
        R_WK: Rotation of the knife frame [3, 3].
        p_WK: Position of the edge's middle [3], metres.
        v_WK: Velocity of that point [3], m/s.
        w_WK: Angular velocity [3], rad/s.

    Returns:
        Moment about Ko and force in W [6], Nm and N, each contact F = k d max(0, 1 + D d')
        (Hunt and Crossley 1975 with exponent 1, as Drake's point contact).
    """
    arm = edge_contact_positions(knife)[:, None] * R_WK[:, 0]
    penetration = np.maximum(board.height - (p_WK[2] + arm[:, 2]), 0.0)
    speed = -(v_WK + np.cross(w_WK, arm))[:, 2]
    force = np.zeros_like(arm)
    force[:, 2] = (
        board.stiffness
        / EDGE_CONTACTS
        * penetration
        * np.maximum(0.0, 1.0 + board.dissipation * speed)
    )
    return np.concatenate([np.cross(arm, force).sum(0), force.sum(0)])
