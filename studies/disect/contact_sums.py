"""Sums of the norms of all contact forces on the knife, which DiSECt records as its force."""

import numpy as np

from sliceit_drake.cutting.driver import Launch
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.motion import Motion, Pose, small_motion
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.cutting.warp_start import LAUNCH_LOCK
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["contact_forces", "contact_sums", "point_forces"]


def contact_forces(solver: CuttingSolver, state: np.ndarray, start: Pose, end: Pose) -> np.ndarray:
    """Forces on the knife at the end of a coupling step, by cut point and face [P, 2, 3], N, in C.

    Half of the edge's force, the flank's pressure and its friction. Their sum is the resultant.

    Args:
        solver: The cut.
        state: The food's state after the coupling step [state_size].
        start, end: Knife poses in C between which it moved.
    """
    T, ws = solver.exchange_period, solver._workspace

    ws.write(ws.states[0], state[None])
    motion = np.array(small_motion(np.column_stack(start), np.column_stack(end))) / T
    ws.place_knife(*end, motion[3:], motion[:3])
    both = point_forces(ws)
    # What is left with the knife beyond the food are the bonds, in the same state.
    ws.place_knife(end.R, end.p + 10.0 * end.R[:, 0])
    return point_forces(ws) - both


def point_forces(ws: Workspace) -> np.ndarray:
    """Forces on both faces at the cut points of the first cut [P, 2, 3], N."""
    # A step of no duration changes no history that another call reads.
    with LAUNCH_LOCK:
        ws.launch_part("step_points", 0, ws.real(0.0))
    forces = np.array(ws.forces[0].points.numpy()[0], np.float64)
    return forces.transpose(0, 3, 1, 2).reshape(-1, 2, 3)[: len(ws.model.point_nodes)]


def contact_sums(solver: CuttingSolver, motion: Motion) -> np.ndarray:
    """Sum of the norms of `contact_forces` at the end of each coupling step of a slice [n], N."""
    path = KnifePath(solver.model, motion, solver.exchange_period)
    launches = (Launch(k, 1) for k in range(path.coupling_steps))
    forces = [
        contact_forces(solver, step.state, path.pose(k), path.pose(k + 1))
        for (k, _, _), (step,) in solver.driver.run([path], launches)
    ]
    return np.linalg.norm(forces, axis=-1).sum((1, 2))
