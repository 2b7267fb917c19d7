"""Slices that have been cut off, as rigid bodies that fall, slide and come to rest."""

import dataclasses as dc
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    CollisionFilterDeclaration,
    Convex,
    FilterId,
    GeometrySet,
    ProximityProperties,
    TriangleSurfaceMesh,
)
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import CalcSpatialInertia, RigidBody, SpatialInertia
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.material import Material

__all__ = ["SLICE_ROW", "LooseSlices", "SliceBody", "slice_pose"]

SLICE_ROW = 14
"""Of a slice: 1 where it is off, quaternion, position, angular and linear velocity."""

KNIFE_MASS = 1e3
"""So heavy that no slice changes the motion that the knife is given, kg."""

MESH_SIZE = 5e-3
"""Of the pressure field in box and blade, metres; what is convex has its own corners."""

DIRECTIONS = 3000
LEAST_EDGE = 2e-4
"""Directions in which, and distance at which, the corners of a slice's hull are told apart, m."""

MIN_MODULUS = 1e6
"""Of the pressure in a slice, Pa: a softer food would flatten, a rigid body would sink in."""

DISSIPATION = 10.0
"""Of a slice's contacts, s/m: food does not bounce. Declared free; it changes no resting place."""

REST_SPEED = 2e-3
REST_RATE = 0.1
"""Speed, m/s, and rate, rad/s, below which a slice may be at rest."""
REST_TIME = 0.1
"""Time below both until it is at rest, s."""
NEAR = 1e-3
"""Distance of the blade, or of a slice that moves, that ends a slice's rest, metres."""


@dc.dataclass
class SliceBody:
    """A slice as a rigid body in its frame S, which before the cut is the food frame F.

    Attributes:
        surface: Closed surface at rest, outward oriented, metres.
        material: Its density, stiffness and friction on the blade.
        X_WS: Its pose before it is cut.
    """

    surface: TriangleSurfaceMesh
    material: Material
    X_WS: RigidTransform


class LooseSlices(LeafSystem):
    """The slices of a food once they are off: each is a rigid body on the board.

    A slice is taken over with the pose and the momentum that the finite elements give it when its
    section is cut. From then on weight, board, blade, the other slices and the rest of the food act
    on it, in a plant of its own whose step is the coupling step. The blade moves as the robot moves
    it: what a slice of some grams would do to the arm is left out. A slice at rest is held, at no
    cost, until the blade or a slice that moves comes near.

    All state is in the Context; the plant's own is filled from it at each step.

    Input ports:
        knife_pose: RigidTransform X_WK.
        knife_velocity: SpatialVelocity V_WK.
        cut_progress: Fraction of the section that is cut [1].
        food_index: Which slice is being cut [1].
        slice_pose: RigidTransform X_WS of that slice in the finite elements.
        slice_velocity: SpatialVelocity V_WS of it, at So.

    Output port:
        slices: For each slice 1 once it is off, else 0, and its free-body coordinates [14 N]:
            quaternion, position, angular and linear velocity.

    Args:
        slices: In the order in which they are cut.
        rest: Surface of what remains, in the last slice's S, or None to leave its contact out.
        blade: Surface of the blade in K.
        board: The board that the slices fall on.
        X_WF: Pose of the food frame, under which the board lies.
        friction: Of food on board and on food.
        pitch: How far the food moves along its y after each slice, metres; 0 where the knife does.
        period: Coupling step, s.
        complete: Progress from which a slice is off.
    """

    def __init__(
        self,
        slices: Sequence[SliceBody],
        rest: TriangleSurfaceMesh | None,
        blade: TriangleSurfaceMesh,
        board: Board,
        X_WF: RigidTransform,
        friction: float,
        pitch: float,
        period: float,
        complete: float,
    ) -> None:
        super().__init__()
        self._slices, self._pitch, self._complete = tuple(slices), pitch, complete
        self._period = period
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlant(
            MultibodyPlantConfig(
                time_step=period,
                contact_model="hydroelastic_with_fallback",
                discrete_contact_approximation="lagged",
                use_sampled_output_ports=False,
            ),
            builder,
        )
        plant = self._plant
        material = slices[0].material
        soft = ProximityProperties()
        AddContactMaterial(DISSIPATION, None, CoulombFriction(friction, friction), soft)
        modulus = max(material.youngs_modulus, MIN_MODULUS)
        AddCompliantHydroelasticProperties(MESH_SIZE, modulus, soft)
        x, y, thickness = board.size
        place = [*X_WF.translation()[:2], board.height - 0.5 * thickness]
        X_WB = RigidTransform(X_WF.rotation(), place)
        # A held body of its own: contact of free bodies with the world's geometry crashes while
        # others are held (Drake issue 24773).
        self._board = plant.AddRigidBody(
            "board",
            plant.AddModelInstance("board"),
            SpatialInertia.SolidBoxWithMass(1.0, x, y, thickness),
        )
        plant.RegisterCollisionGeometry(
            self._board, RigidTransform(), Box(x, y, thickness), "board", _hard(friction)
        )
        instance = plant.AddModelInstance("slices")
        self._bodies = []
        hulls = [_corners(each.surface) for each in slices]
        most = max(hull.shape[1] for hull in hulls)
        # With the last one again where a hull has fewer.
        self._corners = np.array(
            [np.pad(hull, ((0, 0), (0, most - hull.shape[1])), "edge") for hull in hulls]
        )
        for k, each in enumerate(slices):
            inertia = CalcSpatialInertia(each.surface, each.material.density)
            body = plant.AddRigidBody(f"slice_{k + 1}", instance, inertia)
            plant.RegisterCollisionGeometry(
                body, RigidTransform(), Convex(hulls[k], "slice"), f"slice_{k + 1}", soft
            )
            self._bodies.append(body)
        self._rest: RigidBody | None = None
        if rest is not None:
            inertia = CalcSpatialInertia(rest, material.density)
            self._rest = plant.AddRigidBody("rest", plant.AddModelInstance("rest"), inertia)
            plant.RegisterCollisionGeometry(
                self._rest, RigidTransform(), Convex(_corners(rest), "rest"), "rest", soft
            )
        slip = _paired(material.friction, friction)
        self._knife = plant.AddRigidBody(
            "knife",
            plant.AddModelInstance("knife"),
            SpatialInertia.SolidSphereWithMass(KNIFE_MASS, 0.1),
        )
        corners = np.array(blade.vertices()).T
        plant.RegisterCollisionGeometry(
            self._knife, RigidTransform(), Convex(corners, "blade"), "blade", _hard(slip)
        )
        self._blade_low, self._blade_high = corners.min(1), corners.max(1)
        plant.set_gravity_enabled(self._knife.model_instance(), False)
        plant.Finalize()
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._scratch = plant.GetMyMutableContextFromRoot(self._root)
        plant.SetFreeBodyPose(self._scratch, self._board, X_WB)
        for body in (self._board, self._rest):
            if body is not None:
                body.Lock(self._scratch)
        self._filters = scene_graph.collision_filter_manager(
            scene_graph.GetMyMutableContextFromRoot(self._root)
        )
        self._filter: FilterId | None = None
        self._awake = np.ones(len(slices), bool)

        self._knife_pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._knife_velocity = self.DeclareAbstractInputPort(
            "knife_velocity", Value(SpatialVelocity.Zero())
        )
        self._progress = self.DeclareVectorInputPort("cut_progress", 1)
        self._food_index = self.DeclareVectorInputPort("food_index", 1)
        self._slice_pose = self.DeclareAbstractInputPort("slice_pose", Value(RigidTransform()))
        self._slice_velocity = self.DeclareAbstractInputPort(
            "slice_velocity", Value(SpatialVelocity.Zero())
        )
        state = np.zeros((len(slices), SLICE_ROW))
        for k, each in enumerate(slices):
            state[k, 1:8] = _coordinates(each.X_WS)
        self._state = self.DeclareDiscreteState(state.ravel())
        self._quiet = self.DeclareDiscreteState(len(slices))
        self.DeclareStateOutputPort("slices", self._state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def is_off(self, context: Context) -> np.ndarray:
        """Which slices are off [N]."""
        return np.asarray(self._table(context)[:, 0] > 0.0)

    def pose(self, context: Context, index: int) -> RigidTransform:
        """X_WS of a slice that is off."""
        return slice_pose(self._table(context)[index])

    def _table(self, context: Context) -> np.ndarray:
        """A row a slice: 1 where it is off, position, velocity [N, 14]."""
        return context.get_discrete_state(self._state).value().reshape(-1, SLICE_ROW)

    def _update(self, context: Context, new: DiscreteValues) -> EventStatus:
        table = self._table(context).copy()
        index = int(self._food_index.Eval(context)[0])
        cut = table[index, 0] == 0.0 and self._progress.Eval(context)[0] >= self._complete
        if cut:
            V_WS = self._slice_velocity.Eval(context)
            table[index, 0] = 1.0
            table[index, 1:8] = _coordinates(self._slice_pose.Eval(context))
            table[index, 8:] = np.concatenate([V_WS.rotational(), V_WS.translational()])
        off = table[:, 0] > 0.0
        if not off.any():
            return EventStatus.DidNothing()
        X_WK = self._knife_pose.Eval(context)
        quiet = context.get_discrete_state(self._quiet).value() + self._period
        quiet[self._stirred(table, X_WK)] = 0.0
        if cut:
            quiet[index] = 0.0
        new.set_value(self._quiet, quiet)
        awake = off & (quiet < REST_TIME)
        table[~awake, 8:] = 0.0
        if awake.any():
            self._step(context, table, index, X_WK, awake)
        new.set_value(self._state, table.ravel())
        return EventStatus.Succeeded()

    def _stirred(self, table: np.ndarray, X_WK: RigidTransform) -> np.ndarray:
        """Which slices move, or might be touched by the blade or by a slice that moves [N]."""
        rate, speed = (np.linalg.norm(table[:, k : k + 3], axis=1) for k in (8, 11))
        moves = (rate > REST_RATE) | (speed > REST_SPEED)
        if moves[table[:, 0] > 0.0].all():
            return np.asarray(moves)
        R_WS = Rotation.from_quat(table[:, 1:5], scalar_first=True).as_matrix()
        p_W = R_WS @ self._corners + table[:, 5:8, None]
        p_K = X_WK.rotation().matrix().T @ (p_W - X_WK.translation()[:, None])
        at_blade = _near(p_K.min(2), p_K.max(2), self._blade_low, self._blade_high)
        low, high = p_W.min(2), p_W.max(2)
        touched = _near(low[:, None], high[:, None], low, high) & moves
        return np.asarray(moves | at_blade | touched.any(1))

    def _step(
        self,
        context: Context,
        table: np.ndarray,
        index: int,
        X_WK: RigidTransform,
        awake: np.ndarray,
    ) -> None:
        """Advances the slices that are awake, rows of `table`, by a step of the plant."""
        plant, scratch = self._plant, self._scratch
        self._hold_all_but(awake)
        for k in np.flatnonzero(table[:, 0] == 0.0).tolist():
            table[k, 1:8] = _coordinates(self._standing(k, index))
        instance = self._bodies[0].model_instance()
        plant.SetPositions(scratch, instance, table[:, 1:8].ravel())
        plant.SetVelocities(scratch, instance, table[:, 8:].ravel())
        if self._rest is not None:
            last = len(self._bodies) - 1
            plant.SetFreeBodyPose(scratch, self._rest, self._standing(last, index))
        plant.SetFreeBodyPose(scratch, self._knife, X_WK)
        plant.SetFreeBodySpatialVelocity(scratch, self._knife, self._knife_velocity.Eval(context))
        after = plant.EvalUniquePeriodicDiscreteUpdate(scratch)
        scratch.get_mutable_discrete_state().SetFrom(after)
        q = plant.GetPositions(scratch, instance).reshape(-1, 7)
        v = plant.GetVelocities(scratch, instance).reshape(-1, 6)
        table[awake, 1:8], table[awake, 8:] = q[awake], v[awake]

    def _hold_all_but(self, awake: np.ndarray) -> None:
        """Holds the other slices; what is held takes no time to meet what is held."""
        if self._filter is not None and (awake == self._awake).all():
            return
        self._awake = awake
        still = [self._board, self._knife] + ([] if self._rest is None else [self._rest])
        for body, free in zip(self._bodies, awake.tolist(), strict=True):
            if free:
                body.Unlock(self._scratch)
            else:
                body.Lock(self._scratch)
                still.append(body)
        if self._filter is not None:
            self._filters.RemoveDeclaration(self._filter)
        shapes = [g for body in still for g in self._plant.GetCollisionGeometriesForBody(body)]
        self._filter = self._filters.ApplyTransient(
            CollisionFilterDeclaration().ExcludeWithin(GeometrySet(shapes))
        )

    def _standing(self, k: int, index: int) -> RigidTransform:
        """X_WS of slice `k` in the food while slice `index` is cut."""
        return self._slices[k].X_WS @ RigidTransform([0.0, (k - index) * self._pitch, 0.0])


def slice_pose(row: np.ndarray) -> RigidTransform:
    """X_WS of a slice from its row [14] of the port `slices` of `LooseSlices`."""
    return RigidTransform(Quaternion(row[1:5] / np.linalg.norm(row[1:5])), row[5:8])


def _near(low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray) -> Any:
    """Whether boxes of corners [..., 3] come closer to each other than `NEAR`."""
    return ((low - NEAR < other_high) & (high + NEAR > other_low)).all(-1)


def _coordinates(X: RigidTransform) -> np.ndarray:
    """Position coordinates of a free body [7]: quaternion and position."""
    return np.concatenate([X.rotation().ToQuaternion().wxyz(), X.translation()])


def _paired(wanted: float, other: float) -> float:
    """The coefficient of friction that has `wanted` together with `other`, or comes closest.

    Drake takes 2 a b / (a + b) of two surfaces, so it is less than twice the other.
    """
    room = 2.0 * other - wanted
    return wanted * other / room if room > 1e-3 * wanted else 1e3 * wanted


def _hard(friction: float) -> ProximityProperties:
    """Contact of what does not give."""
    properties = ProximityProperties()
    AddContactMaterial(0.0, None, CoulombFriction(friction, friction), properties)
    AddRigidHydroelasticProperties(MESH_SIZE, properties)
    return properties


def _corners(surface: TriangleSurfaceMesh) -> np.ndarray:
    """Corners of the convex hull of a surface [3, V]: its farthest points in many directions.

    So no three are in line and no two close together, as where a cut meets the edges of a mesh:
    elements of the pressure field would be degenerate.
    """
    points = np.array(surface.vertices())
    # A spiral about z covers the directions evenly.
    share = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    angle, z = np.pi * (1.0 + np.sqrt(5.0)) * DIRECTIONS * share, 1.0 - 2.0 * share
    across = np.sqrt(1.0 - z * z)
    directions = np.array([across * np.cos(angle), across * np.sin(angle), z])
    found = points[np.unique((points @ directions).argmax(0))]
    close = cKDTree(found).query_pairs(LEAST_EDGE)
    return np.delete(found, [second for _, second in close], axis=0).T
