"""The cutting board and its contact law on a prescribed knife motion."""

import dataclasses as dc
import math

import numpy as np

from sliceit_drake.configuration import quantity
from sliceit_drake.cutting.knife import Knife

__all__ = [
    "EDGE_CONTACTS",
    "Board",
    "board_wrench",
    "board_wrenches",
    "edge_contact_positions",
    "impact_peak_loss",
]

EDGE_CONTACTS = 9
"""Points of the edge that share the contact with the board."""


@dc.dataclass
class Board:
    """The board: a horizontal top surface that the knife's edge and the food rest on.

    Stiffness and dissipation are those of the whole edge lying on the board, with all that gives
    under it, down to the table. Both are declared free: no measurement of the paper's board is
    published, nor did we find one of a blade on any board. The force of an impact measures what is
    assumed here; the default is as stiff as steps of 1 ms resolve (docs/explanation/physics.md).
    """

    height: float = quantity(0.05, "m", low=-1.0, high=2.0)
    """Top surface in the world frame."""
    size: list[float] = quantity([0.30, 0.20, 0.02], "m", low=1e-3, high=2.0, size=3)
    """Extent along x, y and thickness."""
    stiffness: float = quantity(3e4, "N/m", low=1e2, high=1e8)
    """Force over penetration of the whole edge."""
    dissipation: float = quantity(1.0, "s/m", low=0.0, high=100.0)
    """Hunt-Crossley dissipation: F = k d (1 + D d')."""


def edge_contact_positions(knife: Knife) -> np.ndarray:
    """Points on the edge that touch the board [EDGE_CONTACTS], x in the knife frame, metres."""
    return np.linspace(-0.5, 0.5, EDGE_CONTACTS) * knife.length


def impact_peak_loss(stiffness: float, mass: float, time_step: float) -> float:
    """Fraction of an impact's peak force that a plant loses to its steps.

    A plant takes the contact's spring at the end of its step h (backward Euler), so a free mass on
    it turns by atan(x) and shrinks by sqrt(1 + x^2) a step, x = h sqrt(k / m): over the quarter
    period to the peak the force falls to (1 + x^2)^(-pi / (4 atan x)), 1 - pi x / 4 for small x.

    Args:
        stiffness: The board's stiffness, N/m.
        mass: Mass that the knife carries into the board, kg.
        time_step: The plant's time step, s.
    """
    x = time_step * math.sqrt(stiffness / mass)
    return 1.0 - math.exp(-0.25 * math.pi * math.log1p(x * x) / math.atan(x))


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
        board, knife: What meets.
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


def board_wrenches(
    board: Board, knife: Knife, R: np.ndarray, p: np.ndarray, period: float
) -> np.ndarray:
    """Wrench of the board on the knife at the end of each coupling step [E, 6], in F.

    Args:
        board: The board, its height in F.
        knife: The knife.
        R: Rotations of the knife in F at the ends of the coupling steps [E + 1, 3, 3].
        p: Positions of Ko in F there [E + 1, 3], metres.
        period: Duration of a coupling step, s.
    """
    wrenches = np.zeros((len(p) - 1, 6))
    reach = 0.5 * knife.length * np.abs(R[1:, 2, 0])
    for k in np.flatnonzero(p[1:, 2] - reach < board.height):
        v = (p[k + 1] - p[k]) / period
        dR = R[k + 1] @ R[k].T
        turn = np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]])
        wrenches[k] = board_wrench(board, knife, R[k + 1], p[k + 1], v, turn * (0.5 / period))
    return wrenches
