"""The start-up check of contact: how much stiffer food and board could be before the loop shakes.

The prepared food is pressed, on the side, by the blade; small motions in six directions then give
its response, coupling step by coupling step, with the blade's bending in it. Put into the linear
loop of the station (`contact_loop`), that response times a factor leaves the loop stable up to the
margin."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, edge_contact_positions
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.stability.contact_loop import ContactLoop

__all__ = [
    "MIN_MARGIN",
    "ContactMargin",
    "board_stiffness",
    "check_contact_margin",
    "contact_margin",
]

MIN_MARGIN = 2.0
DIRECTIONS = ("x", "y", "z", "rotation x", "rotation y", "rotation z")


@dc.dataclass(frozen=True)
class ContactMargin:
    """Margins of a station at rest in contact.

    Attributes:
        food: Factor on the food's response at which the loop becomes unstable; None where the
            response is not known. At most `contact_loop.GREATEST_MARGIN`.
        board: The same for the board's stiffness.
        stiffness: The food's stiffness along and about the axes of K [6], N/m and Nm/rad, the
            greatest of all depths; empty where it is not known.
    """

    food: float | None
    board: float
    stiffness: tuple[float, ...]


def check_contact_margin(station: SimulatedStation) -> ContactMargin:
    """Computes the margins of a station and refuses one that is too close to instability.

    Raises:
        ConfigurationError: The margin of the food is below `MIN_MARGIN`.
    """
    margin = contact_margin(station)
    if margin.food is not None and margin.food < MIN_MARGIN:
        names = ", ".join(
            f"{name} {value:.3g}" for name, value in zip(DIRECTIONS, margin.stiffness, strict=True)
        )
        raise ConfigurationError(
            f"knife and food would shake each other: the loop is stable up to {margin.food:.2g} "
            f"times the food's stiffness ({names} N/m and Nm/rad in the knife's axes), at least "
            f"{MIN_MARGIN:g} is asked",
            field="scenario.exchange_period, scenario.controller and scenario.knife",
            fix="Shorten exchange_period, lower controller.error_scale or controller.p_gains, or "
            "lower knife.lateral_stiffness (the blade's bending).",
        )
    return margin


def contact_margin(station: SimulatedStation) -> ContactMargin:
    """The margins of a station at its start posture, with the configured gains."""
    loop = ContactLoop(station)
    scenario = station.scenario
    R_WK = station.start_pose.rotation().matrix()
    board = loop.margin(board=board_stiffness(scenario.board, scenario.knife, R_WK))
    turn = np.kron(np.eye(2), R_WK)
    responses = station.cutting.contact_responses(scenario.start.offset)
    if not responses:
        return ContactMargin(None, board, ())
    margins, stiffness = [], []
    for response in responses:
        margins.append(loop.margin(turn @ response @ turn.T))
        stiffness.append(np.diag(response[-1]))
    greatest = np.max(stiffness, axis=0)
    return ContactMargin(min(margins), board, tuple(float(k) for k in greatest))


def board_stiffness(board: Board, knife: Knife, R_WK: np.ndarray) -> np.ndarray:
    """Stiffness [6, 6] of the board under the whole edge, about Ko in W, translations first."""
    x = edge_contact_positions(knife)
    up = np.array([0.0, 0.0, 1.0])
    rows = np.column_stack([np.tile(up, (len(x), 1)), np.cross(np.outer(x, R_WK[:, 0]), up)])
    return board.stiffness / len(x) * rows.T @ rows
