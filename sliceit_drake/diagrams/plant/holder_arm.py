"""A second UR5e that holds the food, as on the robot platform of SliceIt!; it stands still."""

import numpy as np
from pydrake.geometry import GeometryInstance, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.robot_plant import add_arm_and_gripper
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints

__all__ = ["FINGERTIPS", "HoldingArm"]

FINGERTIPS = 0.16
"""Distance of the grip from the gripper's mounting face, metres."""

LEAN = np.deg2rad(40.0)
"""Lean of the gripper from the vertical, away from the knife."""

BEHIND = 0.50
"""Distance of the arm's base from the grip along Fy, metres."""

POSTURE = np.array([0.0, -1.6, 1.9, -1.2, -1.57, 0.0])
"""Elbow up, from where the joint positions are solved, rad."""


class HoldingArm:
    """Arm and gripper in a plant of their own, posed so that the fingers are at the grip.

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
        """Draws arm and gripper in a plant that is not finalized, with a scene graph.

        They have neither mass nor contact nor joints there: what they do to the food is a boundary
        condition of the food, and the plant keeps the joints of the cutting arm alone.
        """
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
