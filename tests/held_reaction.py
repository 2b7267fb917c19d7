"""What holds the food, for tests of the balance of forces; read from the solver's own workspace."""

import numpy as np

from sliceit_drake.cutting.kernels.types import CORNERS, LANES
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingSolver, SurfaceFactors
from sliceit_drake.cutting.warp_start import LAUNCH_LOCK
from studies.disect.contact_sums import point_forces


def held_reaction(solver: CuttingSolver, state: np.ndarray, pose: Pose) -> np.ndarray:
    """Force of what holds the food on the food [3], N, in C, with the knife at `pose`."""
    m, ws = solver.model, solver._workspace
    solver._place(state, pose, SurfaceFactors())
    with LAUNCH_LOCK:
        ws.launch_look_ahead()
        ws.launch_part("elements", 0)
        at_points = point_forces(ws)
    forces = ws.force.numpy()[0, : m.blocks.size * 3].astype(np.float64)
    held = np.ones(len(m.nodes), bool)
    held[m.moving] = False
    at_held = held[m.blocks]
    on_held = (forces.reshape(-1, CORNERS, 3, LANES) * at_held[:, :, None, :]).sum((0, 1, 3))
    # Forces of the bulk sum to zero, so that those on held nodes relax as those on the others.
    lag = solver.field(state, "overstress").reshape(len(m.relaxing), len(m.nodes), 3)[:, m.moving]
    on_held += m.relaxing @ lag.sum(1, dtype=float)
    share = (held[m.point_nodes].reshape(-1, 2, 2) * m.point_weights[:, None, :]).sum(2)
    on_held += (at_points * share[:, :, None]).sum((0, 1)) + m.weight[held].sum(0)
    return -on_held
