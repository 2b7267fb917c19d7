"""How near the robot's bodies come to each other and to what stands around, by SceneGraph."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometryId,
    GeometryInstance,
    GeometrySet,
    ProximityProperties,
    Role,
    SceneGraph,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from sliceit_drake.diagrams.plant.robot_plant import add_plant, add_robot
from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["Clearance"]

ARM = {"base_link", "shoulder_link", "upper_arm_link", "forearm_link"}
MOVING = {"forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link", "gripper", "handle"}
TOOL = {"gripper", "handle", "blade", "edge"}
BLADE = {"blade", "edge"}
"""The board may be touched by them; how deep is a limit of its own."""
BOARD = {"board", "board_feet"}


class Clearance:
    """Distances of tool and board, table or holder, of tool and arm, and of arm and surroundings.

    Bodies are the convex hulls of what is drawn. The food is none: the knife goes into it.

    Args:
        scenario: Whose robot and knife these are.
        plant: Of the scenario's station; its table, board and holder are copied.
        scene_graph: Of the same station.
    """

    def __init__(self, scenario: Scenario, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        builder = DiagramBuilder()
        self._plant, own = add_plant(builder, scenario.robot)
        self._arm = add_robot(self._plant, scenario.robot, scenario.knife, scenario.board).arm
        inspector = scene_graph.model_inspector()
        for shown in plant.GetVisualGeometriesForBody(plant.world_body()):
            copy = GeometryInstance(
                inspector.GetPoseInFrame(shown), inspector.GetShape(shown), inspector.GetName(shown)
            )
            copy.set_illustration_properties(inspector.GetIllustrationProperties(shown))
            self._plant.RegisterVisualGeometry(self._plant.world_body(), copy)
        self._plant.Finalize()
        self._names: dict[GeometryId, str] = {}
        self._declare_pairs(own)
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        self._query = own.get_query_output_port()
        self._query_context = own.GetMyContextFromRoot(self._context)

    def nearest(self, q: Sequence[float], within: float) -> tuple[float, str] | None:
        """The least distance at joint positions [6], rad, m, and the names of the two bodies.

        Args:
            q: Joint positions.
            within: Distance beyond which it is not looked for, m; then None.
        """
        self._plant.SetPositions(self._plant_context, self._arm, np.asarray(q, float))
        query = self._query.Eval(self._query_context)
        pairs = query.ComputeSignedDistancePairwiseClosestPoints(within)
        if not pairs:
            return None
        pair = min(pairs, key=lambda pair: pair.distance)
        return pair.distance, f"{self._names[pair.id_A]} and {self._names[pair.id_B]}"

    def _declare_pairs(self, scene_graph: SceneGraph) -> None:
        plant, inspector = self._plant, scene_graph.model_inspector()
        contacts = inspector.GetAllGeometryIds(Role.kProximity)
        parts: dict[str, GeometryId] = {}
        around = set()
        for index in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(index))
            for geometry in plant.GetVisualGeometriesForBody(body):
                scene_graph.AssignRole(plant.get_source_id(), geometry, ProximityProperties())
                name = inspector.GetName(geometry).rpartition("::")[2]
                if name == "Mesh":
                    name = body.name()
                parts[name] = geometry
                self._names[geometry] = name.removesuffix("_link").replace("_", " ")
                if body.index() == plant.world_body().index():
                    around.add(name)

        def these(names: set[str]) -> GeometrySet:
            return GeometrySet([parts[name] for name in sorted(names)])

        everything = GeometrySet([*contacts, *parts.values()])
        scene_graph.collision_filter_manager().Apply(
            CollisionFilterDeclaration()
            .ExcludeWithin(everything)
            .AllowBetween(these(MOVING), these(around))
            .AllowBetween(these(BLADE), these(around - BOARD))
            .AllowBetween(these(TOOL), these(ARM))
        )
