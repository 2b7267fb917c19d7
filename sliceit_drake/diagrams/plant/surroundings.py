"""What stands around the robot: table, cutting board, and the clamp or arm that holds the food.

All is added to a plant that is not finalized, registered with a scene graph. What holds the food
has neither mass nor contact there: what it does to the food is a boundary condition of the food.
"""

import numpy as np
from pydrake.geometry import Box, Cylinder, GeometryInstance, SceneGraph, Shape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import EDGE_CONTACTS, Board
from sliceit_drake.diagrams.plant.knife_body import contact_properties
from sliceit_drake.diagrams.plant.robot_plant import add_arm_and_gripper
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints

__all__ = ["FINGERTIPS", "HoldingArm", "add_board", "add_holder", "add_table"]

TABLE_SIZE = (1.10, 1.30, 0.03)

TABLE = np.array([0.50, 0.46, 0.42, 1.0])
BOARD = np.array([0.90, 0.80, 0.63, 1.0])
BOARD_FEET = np.array([0.25, 0.25, 0.26, 1.0])
HOLDER = np.array([0.55, 0.57, 0.60, 1.0])
HOLDER_PADS = np.array([0.10, 0.10, 0.11, 1.0])

FINGERTIPS = 0.16
"""Distance of the grip from the gripper's mounting face, metres."""

LEAN = np.deg2rad(40.0)
"""Lean of the gripper from the vertical, away from the knife."""

BEHIND = 0.50
"""Distance of the arm's base from the grip along Fy, metres."""

POSTURE = np.array([0.0, -1.6, 1.9, -1.2, -1.57, 0.0])
"""Elbow up, from where the joint positions are solved, rad."""


def add_board(plant: MultibodyPlant, board: Board, X_WF: RigidTransform) -> None:
    """Adds the cutting board to the world, with contact on its upper side.

    Args:
        plant: The plant.
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
        plant: The plant.
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

    Args:
        plant: The plant.
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


class HoldingArm:
    """A second UR5e that holds the food, as on the robot platform of SliceIt!, and stands still.

    Arm and gripper are in a plant of their own, posed so that the fingers are at the grip.

    Args:
        X_WF: Pose of the food frame; the fingers close along Fx.
        grip: Point between the fingertips in F [3], metres.

    Attributes:
        plant: Finalized; its only joints are the arm's.
        scene_graph: Its geometry.
        joints: Joint positions [6], rad.

    Raises:
        ConfigurationError: The arm cannot reach the grip.
    """

    def __init__(self, X_WF: RigidTransform, grip: np.ndarray) -> None:
        self.plant, self.scene_graph = MultibodyPlant(0.0), SceneGraph()
        self.plant.RegisterAsSourceForSceneGraph(self.scene_graph)
        arm, gripper = add_arm_and_gripper(self.plant)
        p_WG = X_WF.multiply(grip)
        away = X_WF.rotation().matrix()[:, 1]
        base = [*(p_WG + BEHIND * away)[:2], 0.0]
        # The base's x points at the food.
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(np.arctan2(-away[1], -away[0])), base)
        self.plant.WeldFrames(
            self.plant.world_frame(), self.plant.GetFrameByName("base_link", arm), X_WB
        )
        self.plant.WeldFrames(
            self.plant.GetFrameByName("tool0", arm), self.plant.GetFrameByName("gripper", gripper)
        )
        self.plant.Finalize()
        # The gripper's z leads to the fingertips, its y from finger to finger.
        z = -np.sin(LEAN) * away - np.cos(LEAN) * np.array([0.0, 0.0, 1.0])
        y = X_WF.rotation().matrix()[:, 0]
        R = RotationMatrix(np.column_stack([np.cross(y, z), y, z]))
        body = self.plant.GetBodyByName("gripper", gripper)
        try:
            self.joints = solve_start_joints(
                self.plant, body, RigidTransform(R, p_WG - FINGERTIPS * z), POSTURE
            )
        except ConfigurationError as error:
            raise ConfigurationError(
                f"the holding arm cannot grip the food at {np.round(p_WG, 4).tolist()} m",
                field="scenario.holder",
                fix='Shorten the food, or write "holder: clamp".',
            ) from error

    def draw(self, plant: MultibodyPlant) -> None:
        """Draws arm and gripper in a plant, which keeps the joints of the cutting arm alone."""
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, self.joints)
        inspector = self.scene_graph.model_inspector()
        for index in range(self.plant.num_bodies()):
            body = self.plant.get_body(BodyIndex(index))
            X_WL = self.plant.EvalBodyPoseInWorld(context, body)
            for k, geometry in enumerate(self.plant.GetVisualGeometriesForBody(body)):
                X_WG = X_WL @ inspector.GetPoseInFrame(geometry)
                name = f"holding_{body.name()}_{k}"
                drawn = GeometryInstance(X_WG, inspector.GetShape(geometry), name)
                drawn.set_illustration_properties(inspector.GetIllustrationProperties(geometry))
                plant.RegisterVisualGeometry(plant.world_body(), drawn)


def _standing_at(X_WF: RigidTransform, height: float) -> RigidTransform:
    """Returns X_WF moved along Wz to `height`."""
    return RigidTransform(X_WF.rotation(), [*X_WF.translation()[:2], height])


def _draw(
    plant: MultibodyPlant, X_WG: RigidTransform, shape: Shape, name: str, colour: np.ndarray
) -> None:
    plant.RegisterVisualGeometry(plant.world_body(), X_WG, shape, name, colour)
