"""A second UR5e that holds the food, as on the robot platform of SliceIt!; it stands still."""

import numpy as np
from pydrake.geometry import GeometryInstance, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.start_joints import solve_start_joints
from sliceit_drake.resources import add_package_map

__all__ = ["FINGERTIPS", "HoldingArm", "add_holding_arm"]

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
        parser = Parser(self.plant)
        add_package_map(parser)
        (arm,) = parser.AddModelsFromUrl("package://sliceit_drake_models/ur5e/ur5e.urdf")
        (gripper,) = parser.AddModelsFromUrl("package://sliceit_drake_models/gripper/gripper.sdf")
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


def add_holding_arm(plant: MultibodyPlant, X_WF: RigidTransform, grip: np.ndarray) -> HoldingArm:
    """Draws a second arm that holds the food.

    It has neither mass nor contact nor joints in `plant`: what it does to the food is a boundary
    condition of the food, and the plant keeps the joints of the cutting arm alone.

    Args:
        plant: Plant, not finalized, registered with a scene graph.
        X_WF: Pose of the food frame.
        grip: Point between the fingertips in F [3], metres.

    Raises:
        ConfigurationError: The arm cannot reach the grip.
    """
    arm = HoldingArm(X_WF, grip)
    context = arm.plant.CreateDefaultContext()
    arm.plant.SetPositions(context, arm.joints)
    inspector = arm.scene_graph.model_inspector()
    for index in arm.plant.GetBodyIndices(arm.plant.GetModelInstanceByName("ur5e")) + (
        arm.plant.GetBodyIndices(arm.plant.GetModelInstanceByName("gripper"))
    ):
        body = arm.plant.get_body(index)
        X_WL = arm.plant.EvalBodyPoseInWorld(context, body)
        for k, geometry in enumerate(arm.plant.GetVisualGeometriesForBody(body)):
            X_WG = X_WL @ inspector.GetPoseInFrame(geometry)
            name = f"holding_{body.name()}_{k}"
            drawn = GeometryInstance(X_WG, inspector.GetShape(geometry), name)
            drawn.set_illustration_properties(inspector.GetIllustrationProperties(geometry))
            plant.RegisterVisualGeometry(plant.world_body(), drawn)
    return arm
