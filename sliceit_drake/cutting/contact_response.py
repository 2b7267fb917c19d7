"""How a food answers small motions of a blade that rests in it, coupling step by coupling step."""

import contextlib

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.foods.food import start_pose
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver

__all__ = ["contact_responses"]

# The food is cut at this speed to these fractions of its height, where the blade rests and is
# moved. A lower one is taken where the food's elements do not bear it.
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


def contact_responses(solver: CuttingSolver, offset: float) -> list[np.ndarray]:
    """How the food answers small motions of a blade in it, shifted along its edge by `offset`, m.

    Returns:
        For each of several depths, less the mean wrench over each coupling step from the motion's
        on, per unit [RESPONSE, 6, 6], along and about the axes of K at Ko, translations first. The
        last is the mean of the last `SETTLED`, over the period in which the food rings. Empty if
        the food cannot be cut at any of `APPROACH_SPEEDS`.
    """
    for speed in APPROACH_SPEEDS:
        with contextlib.suppress(CuttingError):
            return _responses(solver, speed, offset)
    return []


def _responses(solver: CuttingSolver, speed: float, offset: float) -> list[np.ndarray]:
    """Those of a blade that enters at a speed, m/s, and then rests.

    It moves within one coupling step. Of both senses of a direction, that which the food resists
    more counts: pressed further an edge cuts, drawn back it unloads.

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
            state, pose = solver.coupling_step(state, pose, end).state, end
        depth = share * height
        for _ in range(REST):
            state = solver.coupling_step(state, pose, pose).state
        responses.append(_response(solver, state, pose))
    return responses


def _response(solver: CuttingSolver, state: np.ndarray, pose: Pose) -> np.ndarray:
    def wrenches(end: Pose) -> np.ndarray:
        now, start, found = state, pose, []
        for _ in range(RESPONSE):
            coupling_step = solver.coupling_step(now, start, end)
            now, start = coupling_step.state, end
            found.append(np.concatenate([coupling_step.wrench[3:], coupling_step.wrench[:3]]))
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
