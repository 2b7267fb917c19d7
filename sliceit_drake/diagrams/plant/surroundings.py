"""What stands around the robot: table, cutting board and the clamp that holds the food."""

import numpy as np
from pydrake.geometry import Box, Cylinder, Shape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from sliceit_drake.cutting.board import EDGE_CONTACTS, Board
from sliceit_drake.diagrams.plant.knife_body import contact_properties

__all__ = ["add_board", "add_holder", "add_table"]

TABLE_SIZE = (1.10, 1.30, 0.03)

TABLE = np.array([0.70, 0.66, 0.60, 1.0])
BOARD = np.array([0.93, 0.91, 0.85, 1.0])
BOARD_FEET = np.array([0.25, 0.25, 0.26, 1.0])
HOLDER = np.array([0.55, 0.57, 0.60, 1.0])
HOLDER_PADS = np.array([0.10, 0.10, 0.11, 1.0])


def add_board(plant: MultibodyPlant, board: Board, X_WF: RigidTransform) -> None:
    """Adds the cutting board to the world, with contact on its upper side.

    Args:
        plant: Plant, not finalized, registered with a scene graph.
        board: Size and contact law.
        X_WF: Pose of the food frame: the board lies centred and aligned under it. Its height is
            not used: the top surface is at ``board.height``.
    """
    x, y, thickness = board.size
    X_WB = _standing_at(X_WF, board.height - 0.5 * thickness)
    box = Box(x, y, thickness)
    plant.RegisterCollisionGeometry(
        plant.world_body(), X_WB, box, "board", contact_properties(board, EDGE_CONTACTS)
    )
    _draw(plant, X_WB, box, "board", BOARD)
    underside = board.height - thickness
    if underside > 0.0:
        feet = Box(0.8 * x, 0.8 * y, underside)
        _draw(plant, _standing_at(X_WF, 0.5 * underside), feet, "board_feet", BOARD_FEET)


def add_table(plant: MultibodyPlant, centre: tuple[float, float]) -> None:
    """Draws a table top at the height of the world's origin.

    Args:
        plant: Plant, not finalized, registered with a scene graph.
        centre: Middle of the table in the world, x and y, metres.
    """
    X_WT = RigidTransform([*centre, -0.5 * TABLE_SIZE[2]])
    _draw(plant, X_WT, Box(*TABLE_SIZE), "table", TABLE)


def add_holder(
    plant: MultibodyPlant,
    X_WF: RigidTransform,
    food_width: float,
    food_height: float,
    distance: float,
) -> None:
    """Draws the clamp that holds the food on the board: two jaws that close along Fx.

    It has neither mass nor contact: what it does to the food is a boundary condition of the food.

    Args:
        plant: Plant, not finalized, registered with a scene graph.
        X_WF: Pose of the food frame, on the board.
        food_width: Extent of the food along Fx between the jaws, metres.
        food_height: Height of the food, metres.
        distance: From the cut plane Fy = 0 to the near side of the jaws, along +Fy, metres.
    """
    jaw = Box(0.008, 0.040, 0.75 * food_height + 0.012)
    y = distance + 0.5 * jaw.depth()
    pad, foot = Box(0.004, jaw.depth(), 0.6 * food_height), Box(0.045, jaw.depth(), 0.008)
    for part, shape, beside, z, colour in (
        ("pad", pad, 0.002, 0.5 * pad.height() + 0.003, HOLDER_PADS),
        ("jaw", jaw, 0.008, 0.5 * jaw.height(), HOLDER),
        ("foot", foot, 0.034, 0.004, HOLDER),
    ):
        for side, name in ((-1.0, "left"), (1.0, "right")):
            X_FG = RigidTransform([side * (0.5 * food_width + beside), y, z])
            _draw(plant, X_WF @ X_FG, shape, f"holder_{part}_{name}", colour)
    # The screw that closes the jaws passes behind the food.
    screw = Cylinder(0.004, food_width + 0.09)
    X_FS = RigidTransform(RotationMatrix.MakeYRotation(np.pi / 2), [0.0, y + 0.025, 0.010])
    _draw(plant, X_WF @ X_FS, screw, "holder_screw", HOLDER)


def _standing_at(X_WF: RigidTransform, height: float) -> RigidTransform:
    """Returns X_WF moved along Wz to `height`."""
    return RigidTransform(X_WF.rotation(), [*X_WF.translation()[:2], height])


def _draw(
    plant: MultibodyPlant, X_WG: RigidTransform, shape: Shape, name: str, colour: np.ndarray
) -> None:
    plant.RegisterVisualGeometry(plant.world_body(), X_WG, shape, name, colour)
