"""Slices that have been cut off, as rigid bodies that fall, slide and come to rest."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Convex,
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
REST_TIME = 0.2
"""Time below both until it is at rest, s."""
NEAR = 1e-3
"""Distance of the blade that ends a slice's rest, metres."""


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
    it: what a slice of some grams would do to the arm is left out. Slices at rest cost nothing.

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
        self._plant, _ = AddMultibodyPlant(
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
        self._corners = [_corners(each.surface) for each in slices]
        for k, each in enumerate(slices):
            inertia = CalcSpatialInertia(each.surface, each.material.density)
            body = plant.AddRigidBody(f"slice_{k + 1}", instance, inertia)
            plant.RegisterCollisionGeometry(
                body, RigidTransform(), Convex(self._corners[k], "slice"), f"slice_{k + 1}", soft
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
        self._board.Lock(self._scratch)

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
        self._quiet = self.DeclareDiscreteState(1)
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
        quiet = context.get_discrete_state(self._quiet).value()[0] + self._period
        if cut or self._moves(table[off]) or self._is_near(X_WK, table):
            quiet = 0.0
        new.set_value(self._quiet, [quiet])
        if quiet < REST_TIME:
            self._step(context, table, index, X_WK)
        new.set_value(self._state, table.ravel())
        return EventStatus.Succeeded()

    @staticmethod
    def _moves(table: np.ndarray) -> bool:
        rate = np.linalg.norm(table[:, 8:11], axis=1)
        speed = np.linalg.norm(table[:, 11:], axis=1)
        return bool((rate > REST_RATE).any() or (speed > REST_SPEED).any())

    def _is_near(self, X_WK: RigidTransform, table: np.ndarray) -> bool:
        """Whether the blade might touch a slice that is off."""
        X_KW = X_WK.inverse()
        for k in np.flatnonzero(table[:, 0]):
            p_K = (X_KW @ slice_pose(table[k])).multiply(self._corners[k])
            low, high = p_K.min(1) - NEAR, p_K.max(1) + NEAR
            if (low < self._blade_high).all() and (high > self._blade_low).all():
                return True
        return False

    def _step(self, context: Context, table: np.ndarray, index: int, X_WK: RigidTransform) -> None:
        """Advances the slices that are off, rows of `table`, by a step of the plant."""
        plant, scratch = self._plant, self._scratch
        for k, body in enumerate(self._bodies):
            if table[k, 0] == 0.0:
                table[k, 1:8] = _coordinates(self._standing(k, index))
            _hold(body, scratch, table[k, 0] == 0.0)
        instance = self._bodies[0].model_instance()
        plant.SetPositions(scratch, instance, table[:, 1:8].ravel())
        plant.SetVelocities(scratch, instance, table[:, 8:].ravel())
        if self._rest is not None:
            _hold(self._rest, scratch, True)
            last = len(self._bodies) - 1
            plant.SetFreeBodyPose(scratch, self._rest, self._standing(last, index))
        plant.SetFreeBodyPose(scratch, self._knife, X_WK)
        plant.SetFreeBodySpatialVelocity(scratch, self._knife, self._knife_velocity.Eval(context))
        after = plant.EvalUniquePeriodicDiscreteUpdate(scratch)
        scratch.get_mutable_discrete_state().SetFrom(after)
        q = plant.GetPositions(scratch, instance).reshape(-1, 7)
        v = plant.GetVelocities(scratch, instance).reshape(-1, 6)
        off = table[:, 0] > 0.0
        table[off, 1:8], table[off, 8:] = q[off], v[off]

    def _standing(self, k: int, index: int) -> RigidTransform:
        """X_WS of slice `k` in the food while slice `index` is cut."""
        return self._slices[k].X_WS @ RigidTransform([0.0, (k - index) * self._pitch, 0.0])


def slice_pose(row: np.ndarray) -> RigidTransform:
    """X_WS of a slice from its row [14] of the port `slices` of `LooseSlices`."""
    return RigidTransform(Quaternion(row[1:5] / np.linalg.norm(row[1:5])), row[5:8])


def _hold(body: RigidBody, context: Context, held: bool) -> None:
    if body.is_locked(context) != held:
        body.Lock(context) if held else body.Unlock(context)


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
