"""The finite-element food as a Drake system."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteStateIndex, State

from sliceit_drake.cutting.contact_response import contact_responses
from sliceit_drake.cutting.kernels.layouts import BALANCE
from sliceit_drake.cutting.mesh.surface import FoodBody, food_body, food_surface
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.simulate import (
    COMPLETE,
    LATERAL_LIMIT,
    check_clear,
    check_energies,
    check_in_plane,
)
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.cutting.stepping import Frame
from sliceit_drake.systems.cut_report import Columns, FoodBodyFrame
from sliceit_drake.systems.declare import declare_output
from sliceit_drake.systems.food_look import OTHER, FoodLook, FoodScene
from sliceit_drake.systems.food_visualizer import FoodVisualizer, frame_size
from sliceit_drake.systems.knife_force import KEPT, LAST_POSE, KnifeForceSystem

__all__ = ["BALANCE_NAMES", "COUPLED_EVENT", "ENERGY_NAMES", "CuttingSystem"]

BALANCE_NAMES = BALANCE.names or ()
ENERGY_NAMES = ("elastic", "interface", "kinetic", "largest_energy_ratio", "least_volume_ratio")

MECHANISMS = ("edge", "opening", "friction", "board_friction", "blade")
"""Where the work of cutting goes for good."""

NO_ENERGY = (0.0, 0.0, 0.0, 0.0, 1.0)

# Parts of the state behind those of all cutting systems.
_COMPONENTS = slice(KEPT, KEPT + 9)
_BALANCE = slice(_COMPONENTS.stop, _COMPONENTS.stop + len(BALANCE_NAMES))
_ENERGY = slice(_BALANCE.stop, _BALANCE.stop + len(ENERGY_NAMES))
_FOOD_INDEX = _ENERGY.stop
_SPENT_BEFORE = _FOOD_INDEX + 1  # Dissipated when this food was taken, J.

_SPENT = slice(
    _BALANCE.start + BALANCE_NAMES.index("edge"),
    _BALANCE.start + BALANCE_NAMES.index("friction") + 1,
)
_PARTS = {
    "force_components": _COMPONENTS,
    "balance": _BALANCE,
    "energy": _ENERGY,
    "food_index": slice(_FOOD_INDEX, _FOOD_INDEX + 1),
}
"""Output ports of parts of the state."""

INDEXED = 5e-4
"""Distance of the blade from the next cut plane at which the knife counts as indexed, metres."""


COUPLED_EVENT = 0.1
"""`stepping.EVENT` of a food that a robot cuts: the blade hangs on an arm that gives, and swings
sideways where it turns round at the board (docs/results/stepping.md)."""


class CuttingSystem(KnifeForceSystem):
    """A finite-element food as a cutting system, with sub-steps of its own in each coupling step.

    All state is in the Context: the food's nodes and history as one discrete vector, the rest, with
    the index of the food that is cut, as another. The solvers hold only workspaces that each update
    fills and empties, so contexts do not disturb each other.

    In a sequence the prepared foods are what successive slices leave of one body. The next is taken
    into the Context, at rest and undeformed, at the first coupling step where the section of the
    last is cut, the whole edge is above the next section, and the blade is in its plane. Wrench,
    progress and energy are then the new food's; energy balance and coupling error run on over the
    slices.

    Further output ports:
        force_components: Forces on the knife by edge, flank pressure, friction [9], N, in W.
        balance: Cumulative work and dissipation [8], J, see `BALANCE_NAMES`.
        food_index: Index of the prepared food that is cut [1].
        energy: Energies of this food at the last check [5], see `ENERGY_NAMES`, J.
        surface_vertices: Corners of the food's surface [3 V], metres, in W, padded with zeros.
        surface_damage: Fraction of the toughness that is spent there [V], padded with zeros.
        slice_pose: RigidTransform X_WS of the half that comes off, were it rigid; S is F at rest.
        slice_velocity: SpatialVelocity V_WS of that half, at So.

    Args:
        solvers: Prepared foods with one coupling period.
        X_WF: Pose of the food frame, or one for each of the foods.
        check_period: Interval of the energy and inversion checks, s.
        in_sequence: Whether each food follows the one before it once that is cut.
        look: Colours.

    Attributes:
        solvers, surfaces, food_poses: Solver, surface and X_WF of each of the prepared foods.
    """

    def __init__(
        self,
        solvers: Sequence[CuttingSolver],
        X_WF: RigidTransform | Sequence[RigidTransform],
        check_period: float = 0.05,
        in_sequence: bool = False,
        look: FoodLook = OTHER,
    ) -> None:
        # Behind the rest, how far each branch of `effects.resting` has come.
        branches = max(len(s.model.effects.resting.shares) for s in solvers)
        further = np.zeros(_SPENT_BEFORE + 1 - KEPT + branches)
        further[_ENERGY.start - KEPT : _ENERGY.stop - KEPT] = NO_ENERGY
        super().__init__(solvers[0].exchange_period, further)
        self.solvers = tuple(solvers)
        self.surfaces = tuple(food_surface(s.model) for s in solvers)
        self._in_sequence, self._look, self._branches = in_sequence, look, branches
        self.food_poses = (
            (X_WF,) * len(solvers) if isinstance(X_WF, RigidTransform) else tuple(X_WF)
        )
        self._frames, self._X_WC = [], []
        for solver, X in zip(self.solvers, self.food_poses, strict=True):
            R_WC = X.rotation().matrix() @ solver.model.X_FC_rotation
            p_WC = X.multiply(solver.model.X_FC_position)
            self._X_WC.append(RigidTransform(RotationMatrix(R_WC), p_WC))
            self._frames.append(Frame(self._X_WC[-1].inverse().GetAsMatrix34(), R_WC))
        self._check_every = max(1, round(check_period / self.exchange_period))
        size = max(s.state_size for s in self.solvers)
        food = self.DeclareDiscreteState(self._padded(self.solvers[0].initial_state(), size))
        self._food = int(food)
        for name, part in _PARTS.items():
            self._declare_part(name, part)
        corners = self._corners = max(len(surface.ends) for surface in self.surfaces)
        state = {
            self.discrete_state_ticket(food),
            self.discrete_state_ticket(DiscreteStateIndex(self._kept)),
        }
        declare_output(self, "surface_vertices", 3 * corners, self._surface_vertices, state)
        declare_output(self, "surface_damage", corners, self._surface_damage, state)
        declare_output(self, "slice_pose", Value(RigidTransform()), self._slice_pose, state)
        declare_output(
            self, "slice_velocity", Value(SpatialVelocity.Zero()), self._slice_velocity, state
        )

    def recorded(self) -> dict[str, list[str]]:
        parts = ("edge", "flank", "friction")
        return {
            "force_components": [f"{part}_f_{a}" for part in parts for a in "xyz"],
            "balance": [f"energy_{name}" for name in BALANCE_NAMES],
            "energy": [f"energy_{name}" for name in ENERGY_NAMES],
            "coupling_work_error": ["coupling_work_error"],
            "food_index": ["food_index"],
        }

    def state_columns(self) -> list[str]:
        recorded = self.recorded()
        further = [column for name in _PARTS for column in recorded[name]]
        faded = [f"_faded_{k}" for k in range(self._branches)]
        return [*super().state_columns(), *further, "_spent_before", *faded]

    def _middle_model(self) -> CuttingModel:
        """The cut; of a sequence, its middle slice, which stands for all."""
        return self.solvers[len(self.solvers) // 2].model

    def describe(self) -> str:
        model = self._middle_model()
        m, dt = model.material, model.numerics.time_step
        return (
            f"E = {m.youngs_modulus:.3g} Pa, toughness {m.toughness:.3g} J/m², flank "
            f"friction {m.friction:.2g}; {model.element_count} tetrahedra, sub-step "
            f"{1e3 * dt:.3g} ms."
        )

    def summary(self, record: Columns) -> dict[str, Any]:
        model = self._middle_model()
        work = float(record["energy_work"][-1])
        area = sum(self.section_areas()[: int(record["food_index"][-1]) + 1])
        return {
            "warnings": sorted({text for s in self.solvers for text in s.model.warnings}),
            "elements": model.element_count,
            "cut_points": len(model.point_nodes),
            "sub_step_s": model.numerics.time_step,
            "mass_ratio": model.mass_ratio,
            "section_area_mm2": 1e6 * area,
            "work_of_cutting_J": work,
            "work_by_mechanism_J": {
                name: float(record[f"energy_{name}"][-1]) for name in MECHANISMS
            },
            "work_per_area_J_m2": work / area,
            "energy_imbalance_J": _imbalance(record),
            "energy_ratio": float(record["energy_largest_energy_ratio"].max()),
            "least_volume_ratio": float(record["energy_least_volume_ratio"].min()),
            "coupling_work_error_J": float(record["coupling_work_error"][-1]),
        }

    def section_areas(self) -> list[float]:
        return [solver.model.section_area for solver in self.solvers]

    def body(self, context: Context) -> FoodBodyFrame:
        index, solver = self.food_index(context), self.solver(context)
        body, rest = self._bodies[index]
        nodes = solver.positions(self.food_state(context))
        return FoodBodyFrame(
            index,
            _in_world(self.X_WF(context), body.positions(solver.model, nodes)),
            rest,
            body.tetrahedra,
            body.damage(solver.model, *self._damage(context)),
            body.side,
        )

    @functools.cached_property
    def _bodies(self) -> list[tuple[FoodBody, np.ndarray]]:
        """The solid of each prepared food, and its corners at rest in W [V, 3], metres."""
        found = []
        for solver, X_WF in zip(self.solvers, self.food_poses, strict=True):
            body = food_body(solver.model)
            rest = body.positions(solver.model, solver.model.nodes)
            found.append((body, _in_world(X_WF, rest)))
        return found

    def contact_responses(self, offset: float) -> list[np.ndarray]:
        """Responses of the food with the largest section; see `ReportingSystem`."""
        solver = max(self.solvers, key=lambda each: each.model.section_area)
        return contact_responses(solver, offset)

    def frame_size(self) -> float:
        return frame_size(self.surfaces)

    def scene(self) -> FoodScene:
        """The food's parts for drawing, none of them seen yet."""
        models = [solver.model for solver in self.solvers]
        return FoodScene(self.surfaces, models, self._look)

    def add_visualizer(
        self, builder: DiagramBuilder, meshcat: Meshcat, period: float
    ) -> FoodVisualizer:
        count = len(self.solvers)
        visualizer = builder.AddNamedSystem(
            "food_visualizer",
            FoodVisualizer(self.scene(), self._corners, count, meshcat, period),
        )
        for name in ("surface_vertices", "surface_damage", "food_index", "slice_pose"):
            builder.Connect(self.GetOutputPort(name), visualizer.GetInputPort(name))
        return visualizer

    @staticmethod
    def _padded(values: np.ndarray, size: int) -> np.ndarray:
        out = np.zeros(size)
        out[: len(values)] = values
        return out

    def food_index(self, context: Context) -> int:
        """Which prepared food this context cuts."""
        return int(self.kept(context)[_FOOD_INDEX])

    def food_state(self, context: Context) -> np.ndarray:
        """State of the food as its solver reads it."""
        size = self.solvers[self.food_index(context)].state_size
        return context.get_discrete_state(self._food).value()[:size]

    def solver(self, context: Context) -> CuttingSolver:
        """Solver of the food that this context cuts."""
        return self.solvers[self.food_index(context)]

    def X_WF(self, context: Context) -> RigidTransform:
        """Pose of the frame of the food that this context cuts."""
        return self.food_poses[self.food_index(context)]

    def SetFood(self, context: Context, index: int) -> None:
        """Puts the uncut food of an index into the context.

        Raises:
            IndexError: There is no such food.
        """
        if not 0 <= index < len(self.solvers):
            raise IndexError(f"food {index}: {len(self.solvers)} foods are prepared.")
        size = len(context.get_discrete_state(self._food).value())
        state = self._padded(self.solvers[index].initial_state(), size)
        context.SetDiscreteState(self._food, state)
        # A new food has given no force and cost no work yet.
        self.set_to_zero(context)
        kept = self.kept(context).copy()
        kept[KEPT:] = 0.0
        kept[_ENERGY], kept[_FOOD_INDEX] = NO_ENERGY, index
        context.SetDiscreteState(self._kept, kept)

    def randomize_context(self, context: Context, rng: np.random.Generator) -> None:
        """Puts an uncut food, drawn from the prepared ones, into the context."""
        self.SetFood(context, int(rng.integers(len(self.solvers))))

    def _in_cut_frame(self, index: int, X_WK: np.ndarray) -> Pose:
        """X_CK from X_WK [3, 4]."""
        X_CW = self._frames[index].X_CA
        X_CK = X_CW[:, :3].dot(X_WK)
        return Pose(X_CK[:, :3], X_CK[:, 3] + X_CW[:, 3])

    def _index_to_cut(self, context: Context, index: int, X_WK: np.ndarray) -> int:
        """The food of a sequence that is cut now: this, or the next if the knife is there now.

        Raises:
            CuttingError: The knife is in the next plane and has not cut the last section through.
        """
        if index + 1 == len(self.solvers):
            return index
        model = self.solvers[index + 1].model
        # The coupling step goes from the last pose to this one; tables blur by one spacing.
        clear = model.top + model.tables.spacing
        poses = (self.last_pose(context), X_WK)
        for following in (self._in_cut_frame(index + 1, X) for X in poses):
            lowest = following.p[2] - 0.5 * model.knife.length * abs(following.R[2, 0])
            if lowest <= clear or abs(following.p[1]) > INDEXED:
                return index
        progress = self.progress(context)
        if progress >= COMPLETE:
            return index + 1
        if abs(self._in_cut_frame(index, poses[1]).p[1]) > INDEXED:
            raise _not_parted(context, index, progress)
        return index

    def _is_beside(self, context: Context, X_CK: Pose) -> bool:
        """Whether the blade has left a section of a sequence that it cut, on the slice's side.

        It then touches the slice alone, which is off, and the food stays as the blade left it.

        Raises:
            CuttingError: It leaves a section that it has not cut through.
        """
        if X_CK.p[1] > -INDEXED:
            return False
        progress = self.progress(context)
        if progress < COMPLETE and X_CK.p[1] < -LATERAL_LIMIT:
            raise _not_parted(context, self.food_index(context), progress)
        return progress >= COMPLETE

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        index = self.food_index(context)
        self.solvers[index].compile()
        try:
            check_clear(self.solvers[index].model, self._in_cut_frame(index, X_WK.GetAsMatrix34()))
        except CuttingError as error:
            if self.progress(context) == 0.0:
                raise
            raise CuttingError(
                "this context is in the middle of a cut, which no start can come from. To go on "
                "with it, call Simulator.Initialize("
                "InitializeParams(suppress_initialization_events=True)) first."
            ) from error

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        x, time = state.get_mutable_discrete_state(), context.get_time()
        kept, now = x.get_mutable_value(self._kept), X_WK.GetAsMatrix34()
        index = before = int(kept[_FOOD_INDEX])
        if self._in_sequence:
            index = self._index_to_cut(context, before, now)
        solver = self.solvers[index]
        food = x.get_mutable_value(self._food)[: solver.state_size]
        if index != before:
            food[:] = solver.initial_state()
            kept[_FOOD_INDEX], kept[_ENERGY] = index, NO_ENERGY
            kept[_SPENT_BEFORE] = kept[_SPENT].sum()
            kept[_SPENT_BEFORE + 1 :] = 0.0
        last = kept[LAST_POSE].reshape(3, 4)
        plan = solver.plan(food, last, now, self._frames[index])
        pose = Pose(plan.R[0, 1], plan.p[0, 1])
        if self._in_sequence and self._is_beside(context, pose):
            kept[_COMPONENTS] = 0.0
            return np.zeros(6), self.progress(context)
        check_in_plane(solver.model, pose, time)
        try:
            step = solver.move(food, plan)
        except CuttingError as error:
            raise CuttingError(f"at {time:.4g} s {error}") from error
        food[:] = step.state
        wrench, parts, effects = step.wrench, step.wrenches, solver.model.effects
        if effects.changes_force:
            faded = kept[_SPENT_BEFORE + 1 :][: len(effects.resting.shares)]
            speed = np.linalg.norm(now[None, :, 3] - last[:, 3], axis=1) / self.exchange_period
            parts, faded[:] = effects.changed(
                parts, now[None, :, 0], speed, self.exchange_period, faded
            )
            wrench = parts[-1].sum(0)
        kept[_COMPONENTS].reshape(3, 3)[:] = parts[-1, :, 3:]
        kept[_BALANCE] += step.works
        if round(time / self.exchange_period) % self._check_every == 0:
            energies = solver.energies(step.state, pose)
            spent = float(kept[_SPENT].sum() - kept[_SPENT_BEFORE])
            ratio = check_energies(energies, spent, solver.model, time, step.progress)
            *_, largest_ratio, least_volume_ratio = kept[_ENERGY].tolist()
            stored = energies.elastic, energies.interface, energies.kinetic
            largest = max(ratio, largest_ratio)
            least = min(energies.least_volume_ratio, least_volume_ratio)
            # In the order of `ENERGY_NAMES`.
            kept[_ENERGY] = [*stored, largest, least]
        return wrench, step.progress

    def _surface_vertices(self, context: Context) -> np.ndarray:
        surface, solver = self.surfaces[self.food_index(context)], self.solver(context)
        nodes = solver.positions(self.food_state(context))
        p_W = _in_world(self.X_WF(context), surface.positions(solver.model, nodes))
        return self._padded(p_W.ravel(), 3 * self._corners)

    def _surface_damage(self, context: Context) -> np.ndarray:
        surface, model = self.surfaces[self.food_index(context)], self.solver(context).model
        return self._padded(surface.damage(model, *self._damage(context)), self._corners)

    def _damage(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Edge depth and cohesive damage at the food's cut points, as the solver has them."""
        solver, state = self.solver(context), self.food_state(context)
        return solver.field(state, "edge_depth"), solver.field(state, "cohesive_damage")

    def _slice_motion(self, context: Context) -> tuple[np.ndarray, ...]:
        """`CuttingModel.rigid_motion` of the half that comes off, in C."""
        solver, state = self.solver(context), self.food_state(context)
        return solver.model.rigid_motion(solver.positions(state), solver.velocities(state))

    def _slice_pose(self, context: Context) -> RigidTransform:
        X_WC = self._X_WC[self.food_index(context)]
        R, p, _, _ = self._slice_motion(context)
        return X_WC @ RigidTransform(RotationMatrix(R), p) @ X_WC.inverse() @ self.X_WF(context)

    def _slice_velocity(self, context: Context) -> SpatialVelocity:
        X_WC = self._X_WC[self.food_index(context)]
        _, _, w_C, v_C = self._slice_motion(context)
        w, v = (X_WC.rotation().multiply(vector) for vector in (w_C, v_C))
        arm = self._slice_pose(context).translation() - X_WC.translation()
        return SpatialVelocity(w, v + np.cross(w, arm))


def _not_parted(context: Context, index: int, progress: float) -> CuttingError:
    return CuttingError(
        f"at {context.get_time():.4g} s the knife goes on to the next slice, but the cut of slice "
        f"{index + 1} has parted {100 * progress:.2f} % of its section. Cut deeper "
        "(sequence.overtravel), or wait at the board (sequence.hold)."
    )


def _in_world(X_WF: RigidTransform, p_F: np.ndarray) -> np.ndarray:
    """Points [V, 3] from F to W."""
    return np.asarray(p_F @ X_WF.rotation().matrix().T + X_WF.translation())


def _imbalance(record: Columns) -> float:
    """Work put into the food less everything that it went into, at the end of the record, J.

    What a food holds when the next takes its place stays in it.
    """
    last = {name: float(record[f"energy_{name}"][-1]) for name in BALANCE_NAMES}
    ends = np.append(np.flatnonzero(np.diff(record["food_index"])), -1)
    elastic, interface, kinetic = (
        float(record[f"energy_{name}"][ends].sum()) for name in ENERGY_NAMES[:3]
    )
    damping = -last["internal"] - elastic
    spent = sum(last[name] for name in MECHANISMS)
    return last["work"] + last["gravity"] - elastic - interface - kinetic - spent - damping
