"""The ports that every cutting system has; a subclass says what force the food gives."""

from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteStateIndex, EventStatus, LeafSystem, State

from sliceit_drake.cutting.motion import small_turn
from sliceit_drake.systems.cut_report import ReportingSystem
from sliceit_drake.systems.declare import declare_output

__all__ = ["AppliedForce", "CuttingSetup", "KnifeForceSystem"]


class CuttingSetup(Protocol):
    """Where and how often a food is cut, as a scenario says."""

    exchange_period: float

    def X_WF(self) -> RigidTransform:
        """Pose of the food frame, whose origin is on the board."""
        ...


class KnifeForceSystem(ReportingSystem):
    """A cutting system: coupling steps pose for force with a knife, once per `exchange_period`.

    At t_k the update takes the knife's pose and velocity and holds the wrench that `advance`
    returns over [t_k, t_{k+1}). It is an unrestricted update, so it runs before the discrete
    updates of controller and plant at the same time, and they see the new wrench without a further
    delay.

    Input ports:
        knife_pose: RigidTransform X_WK.
        knife_velocity: SpatialVelocity V_WK.

    Output ports:
        food_wrench: SpatialForce F_K_W of the food on the knife, at Ko, in W.
        food_wrench_vector: `food_wrench` as moment and force [6].
        cut_progress: Fraction of the section that is cut [1].
        coupling_work_error: Work that the held wrench did on the knife minus work that the food did
            on it [1], J; it comes from the delay of one coupling step.

    Args:
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(self, exchange_period: float) -> None:
        super().__init__()
        self.exchange_period = exchange_period
        self._pose_input = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._velocity_input = self.DeclareAbstractInputPort(
            "knife_velocity", Value(SpatialVelocity.Zero())
        )
        self._wrench = self.DeclareDiscreteState(6)
        self._progress = self.DeclareDiscreteState(1)
        self._coupling = self.DeclareDiscreteState(1)
        self._last_pose = self.DeclareDiscreteState(12)
        self._start_time = self.DeclareDiscreteState(1)
        declare_output(
            self,
            "food_wrench",
            Value(SpatialForce.Zero()),
            lambda context: SpatialForce(self.wrench(context)),
            {self.discrete_state_ticket(self._wrench)},
        )
        self.DeclareStateOutputPort("food_wrench_vector", self._wrench)
        self.DeclareStateOutputPort("cut_progress", self._progress)
        self.DeclareStateOutputPort("coupling_work_error", self._coupling)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        # An offset of one period would round k + 1 periods otherwise than the plant's steps do, and
        # so see the plant a step ahead at some coupling steps.
        self.DeclarePeriodicUnrestrictedUpdateEvent(exchange_period, 0.0, self._update)

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        """Called once at initialization; a subclass may check the start and set its state."""

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        """Advances the food to the context's time.

        Args:
            context: Context before the update; its `knife_velocity` is that of the knife now.
            state: State to write to.
            X_WK: Pose of the knife now.

        Returns:
            Wrench F_K_W on the knife, moment and force [6], and the share that is cut.
        """
        raise NotImplementedError

    def knife_velocity(self, context: Context) -> SpatialVelocity:
        """V_WK now."""
        return self._velocity_input.Eval(context)

    def last_pose(self, context: Context) -> np.ndarray:
        """X_WK at the previous coupling step, as [3, 4]."""
        return context.get_discrete_state(self._last_pose).value().reshape(3, 4)

    def wrench(self, context: Context) -> np.ndarray:
        """The held wrench F_K_W, moment and force [6]."""
        return context.get_discrete_state(self._wrench).value()

    def set_to_zero(self, context: Context, *parts: DiscreteStateIndex) -> None:
        """Sets wrench, progress, coupling error and a subclass's parts in the context to zero."""
        for part in (self._wrench, self._progress, self._coupling, *parts):
            context.SetDiscreteState(part, np.zeros(context.get_discrete_state(part).size()))

    def _initialize(self, context: Context, state: State) -> None:
        X_WK = self._pose_input.Eval(context)
        self._set(state, self._last_pose, X_WK.GetAsMatrix34().ravel())
        self._set(state, self._start_time, [context.get_time()])
        self.start(context, state, X_WK)

    def _update(self, context: Context, state: State) -> EventStatus | None:
        x = context.get_discrete_state()
        if context.get_time() <= x.value(self._start_time)[0]:
            return EventStatus.DidNothing()
        X_WK = self._pose_input.Eval(context)
        wrench, progress = self.advance(context, state, X_WK)
        last, now = x.value(self._last_pose).reshape(3, 4), X_WK.GetAsMatrix34()
        turn = small_turn(last[:, :3], now[:, :3])
        moved = np.concatenate([turn, now[:, 3] - last[:, 3]])
        error = x.value(self._coupling)[0] + (x.value(self._wrench) - wrench).dot(moved)
        new = state.get_mutable_discrete_state()
        new.set_value(self._coupling, [error])
        new.set_value(self._wrench, wrench)
        new.set_value(self._progress, [progress])
        new.set_value(self._last_pose, now.ravel())
        return None

    @staticmethod
    def _set(state: State, index: int, value: np.ndarray | list[float]) -> None:
        state.get_mutable_discrete_state().set_value(index, value)


class AppliedForce(LeafSystem):
    """Applies the food's wrench to the knife's body in the plant.

    Input port:
        food_wrench: SpatialForce F_K_W of the food on the knife, at Ko, in W.

    Output port:
        applied_force: The same as a list of one ExternallyAppliedSpatialForce.

    Args:
        knife_body: Index of the knife's body, whose frame is K.
    """

    def __init__(self, knife_body: BodyIndex) -> None:
        super().__init__()
        self._knife_body = knife_body
        self._wrench = self.DeclareAbstractInputPort("food_wrench", Value(SpatialForce.Zero()))
        forces = Value[list[ExternallyAppliedSpatialForce]]()
        declare_output(self, "applied_force", forces, self._forces, {self._wrench.ticket()})

    def _forces(self, context: Context) -> list[ExternallyAppliedSpatialForce]:
        force = ExternallyAppliedSpatialForce()
        force.body_index = self._knife_body
        force.p_BoBq_B = np.zeros(3)
        force.F_Bq_W = self._wrench.Eval(context)
        return [force]
