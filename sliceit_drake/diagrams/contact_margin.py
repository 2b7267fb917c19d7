"""The start-up check of contact: how much stiffer food and board could be before the loop shakes.

The prepared food is pressed, on the side, by the blade; small motions in six directions then give
its response, exchange by exchange, with the blade's bending in it. Put into the linear loop of the
station (`contact_loop`), that response times a factor leaves the loop stable up to the margin.
"""

import contextlib
import dataclasses as dc

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, edge_contact_positions
from sliceit_drake.cutting.foods.food import start_pose
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.diagrams.contact_loop import ContactLoop
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.systems.cutting_system import CuttingSystem

__all__ = [
    "LEAST_MARGIN",
    "ContactMargin",
    "board_stiffness",
    "check_contact_margin",
    "contact_margin",
]

LEAST_MARGIN = 2.0
DIRECTIONS = ("x", "y", "z", "rotation x", "rotation y", "rotation z")

# The food is cut at this speed to these shares of its height, where the blade rests and is moved.
# A lower one is taken where the food's elements do not bear it.
APPROACH_SPEEDS = (0.5, 0.1, 0.02)
DEPTHS = (0.5, 0.9)
REST = 8
RESPONSE = 8
SETTLED = 4
# Friction and edge hold up to a force: they resist a motion of micrometres a hundredfold more than
# one of a tenth of a millimetre, but then an oscillation stays as small. This is the amplitude of
# one that matters, a few newtons.
DISPLACEMENT = 1e-4
ANGLE = 1e-3


@dc.dataclass(frozen=True)
class ContactMargin:
    """Margins of a station at rest in contact.

    Attributes:
        food: Factor on the food's response at which the loop becomes unstable; None for a food
            without elements, or one that cannot be cut at any `APPROACH_SPEEDS`. At most
            `contact_loop.GREATEST_MARGIN`.
        board: The same for the board's stiffness.
        stiffness: The food's stiffness along and about the axes of K [6], N/m and Nm/rad, the
            greatest of all depths; empty without elements.
    """

    food: float | None
    board: float
    stiffness: tuple[float, ...]


def check_contact_margin(station: SimulatedStation) -> ContactMargin:
    """Computes the margins of a station and refuses one that is too close to instability.

    Raises:
        ConfigurationError: The margin of the food is below `LEAST_MARGIN`.
    """
    margin = contact_margin(station)
    if margin.food is not None and margin.food < LEAST_MARGIN:
        names = ", ".join(
            f"{name} {value:.3g}" for name, value in zip(DIRECTIONS, margin.stiffness, strict=True)
        )
        raise ConfigurationError(
            f"knife and food would shake each other: the loop is stable up to {margin.food:.2g} "
            f"times the food's stiffness ({names} N/m and Nm/rad in the knife's axes), at least "
            f"{LEAST_MARGIN:g} is asked",
            field="scenario.exchange_period, scenario.controller and scenario.knife",
            fix="Shorten exchange_period, lower controller.error_scale or controller.p_gains, or "
            "lower knife.lateral_stiffness (the blade's bending).",
        )
    return margin


def contact_margin(station: SimulatedStation) -> ContactMargin:
    """The margins of a station at its start posture, with the configured gains.

    Of the foods of a sequence the one with the largest section counts.
    """
    loop = ContactLoop(station)
    scenario = station.scenario
    R_WK = station.start_pose.rotation().matrix()
    board = loop.margin(board=board_stiffness(scenario.board, scenario.knife, R_WK))
    if not isinstance(station.cutting, CuttingSystem):
        return ContactMargin(None, board, ())
    solver = max(station.cutting.solvers, key=lambda each: each.model.section_area)
    turn = np.kron(np.eye(2), R_WK)
    responses = _bearable_response(solver, scenario.start.offset)
    if responses is None:
        return ContactMargin(None, board, ())
    margins, stiffness = [], []
    for response in responses:
        margins.append(loop.margin(turn @ response @ turn.T))
        stiffness.append(np.diag(response[-1]))
    greatest = np.max(stiffness, axis=0)
    return ContactMargin(min(margins), board, tuple(float(k) for k in greatest))


def _bearable_response(solver: CuttingSolver, offset: float) -> list[np.ndarray] | None:
    for speed in APPROACH_SPEEDS:
        with contextlib.suppress(CuttingError):
            return _food_response(solver, speed, offset)
    return None


def board_stiffness(board: Board, knife: Knife, R_WK: np.ndarray) -> np.ndarray:
    """Stiffness [6, 6] of the board under the whole edge, about Ko in W, translations first."""
    x = edge_contact_positions(knife)
    up = np.array([0.0, 0.0, 1.0])
    rows = np.column_stack([np.tile(up, (len(x), 1)), np.cross(np.outer(x, R_WK[:, 0]), up)])
    return board.stiffness / len(x) * rows.T @ rows


def _food_response(solver: CuttingSolver, speed: float, offset: float = 0.0) -> list[np.ndarray]:
    """How the food answers small motions of the blade in it, at several depths.

    The blade moves within one exchange and then rests. Of both senses of a direction, that which
    the food resists more counts: pressed further an edge cuts, drawn back it unloads.

    Args:
        solver: The food.
        speed: At which the blade enters it, m/s.
        offset: Shift of the knife along its edge, metres.

    Returns:
        For each depth, less the mean wrench over each exchange from the motion's on, per unit
        [RESPONSE, 6, 6], along and about the axes of K at Ko, translations first. The last is
        the mean of the last `SETTLED`, over the period in which the food rings.

    Raises:
        CuttingError: The food cannot be cut at this speed.
    """
    model = solver.model
    X_FK = start_pose(model, 0.0, offset)
    R = model.X_FC_rotation.T @ X_FK.R
    p = model.X_FC_rotation.T @ (X_FK.p - model.X_FC_position)
    state = solver.initial_state()
    height = p[2] - model.bottom
    step = speed * solver.exchange_period
    responses, depth, pose = [], -step, Pose(R, p + [0.0, 0.0, step])
    for share in DEPTHS:
        count = max(1, int(np.ceil((share * height - depth) / step)))
        for target in np.linspace(depth, share * height, count + 1)[1:]:
            end = Pose(R, p - [0.0, 0.0, target])
            state, pose = solver.exchange(state, pose, end).state, end
        depth = share * height
        for _ in range(REST):
            state = solver.exchange(state, pose, pose).state
        responses.append(_response(solver, state, pose))
    return responses


def _response(solver: CuttingSolver, state: np.ndarray, pose: Pose) -> np.ndarray:
    def wrenches(end: Pose) -> np.ndarray:
        now, start, found = state, pose, []
        for _ in range(RESPONSE):
            exchange = solver.exchange(now, start, end)
            now, start = exchange.state, end
            found.append(np.concatenate([exchange.wrench[3:], exchange.wrench[:3]]))
        found[-1] = np.mean(found[-SETTLED:], axis=0)
        return np.array(found)

    at_rest = wrenches(pose)
    response = np.empty((RESPONSE, 6, 6))
    R = pose.R
    for k in range(6):
        best = -np.inf
        for sense in (1.0, -1.0):
            if k < 3:
                amount = sense * DISPLACEMENT
                moved = Pose(R, pose.p + amount * R[:, k])
            else:
                amount = sense * ANGLE
                turn = Rotation.from_rotvec(amount * R[:, k - 3]).as_matrix()
                moved = Pose(turn @ R, pose.p)
            in_C = (at_rest - wrenches(moved)) / amount
            in_K = np.concatenate([in_C[:, :3] @ R, in_C[:, 3:] @ R], axis=1)
            if in_K[-1, k] > best:
                best = in_K[-1, k]
                response[:, :, k] = in_K
    return response
