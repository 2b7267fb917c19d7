"""The ports that every cutting system has; a subclass says what force the food gives."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteStateIndex, EventStatus, State

from sliceit_drake.cutting.motion import small_motion
from sliceit_drake.systems.cut_report import ReportingSystem
from sliceit_drake.systems.declare import PlainSystem, declare_output, where_and_when

__all__ = ["KEPT", "LAST_POSE", "AppliedForce", "CuttingSetup", "KnifeForceSystem"]

# Parts of the state beside the wrench, one vector so that an update fetches it once.
_PROGRESS = 0
_COUPLING = 1
LAST_POSE = slice(2, 14)
"""X_WK at the last coupling step, row by row."""
_START_TIME = 14
KEPT = 15
"""Numbers that every cutting system keeps; those of a subclass stand behind them."""
TINY = 1e-6
"""What rounding may put a fraction out of its range."""


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
        state: What is kept from one coupling step to the next, see `state_columns`.

    Args:
        exchange_period: Duration of a coupling step, s.
        further: Initial values of the numbers that a subclass keeps behind those of all.
    """

    def __init__(self, exchange_period: float, further: Sequence[float] | np.ndarray = ()) -> None:
        super().__init__()
        self.exchange_period = exchange_period
        self._pose_input = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._velocity_input = self.DeclareAbstractInputPort(
            "knife_velocity", Value(SpatialVelocity.Zero())
        )
        # Plain numbers: Drake's indices would be made such in each call.
        wrench = self.DeclareDiscreteState(6)
        self._wrench = int(wrench)
        self._kept = int(self.DeclareDiscreteState(np.concatenate([np.zeros(KEPT), further])))
        declare_output(
            self,
            "food_wrench",
            Value(SpatialForce.Zero()),
            lambda context: SpatialForce(self.wrench(context)),
            {self.discrete_state_ticket(wrench)},
        )
        self.DeclareStateOutputPort("food_wrench_vector", wrench)
        self._declare_part("cut_progress", slice(_PROGRESS, _PROGRESS + 1))
        self._declare_part("coupling_work_error", slice(_COUPLING, _COUPLING + 1))
        self.DeclareStateOutputPort("state", DiscreteStateIndex(self._kept))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        # An offset of one period would round k + 1 periods otherwise than the plant's steps do, and
        # so see the plant a step ahead at some coupling steps.
        self.DeclarePeriodicUnrestrictedUpdateEvent(exchange_period, 0.0, self._update)

    def _declare_part(self, name: str, part: slice) -> None:
        """Declares a part of the kept numbers as an output port."""
        declare_output(
            self,
            name,
            part.stop - part.start,
            lambda context: self.kept(context)[part],
            {self.discrete_state_ticket(DiscreteStateIndex(self._kept))},
        )

    def state_columns(self) -> list[str]:
        """Names for the port `state`, as in a record.

        What no record shows has a name that begins with an underscore.
        """
        past = [f"_past_{k}" for k in range(LAST_POSE.start, KEPT)]
        return ["cut_progress", "coupling_work_error", *past]

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
        raise NotImplementedError(f"{type(self).__name__} has no method advance")

    def knife_velocity(self, context: Context) -> SpatialVelocity:
        """V_WK now."""
        return self._velocity_input.Eval(context)

    def kept(self, context: Context) -> np.ndarray:
        """The numbers that are kept from one coupling step to the next; a view."""
        return context.get_discrete_state().value(self._kept)

    def last_pose(self, context: Context) -> np.ndarray:
        """X_WK at the previous coupling step, as [3, 4]."""
        return self.kept(context)[LAST_POSE].reshape(3, 4)

    def wrench(self, context: Context) -> np.ndarray:
        """The held wrench F_K_W, moment and force [6]."""
        return context.get_discrete_state().value(self._wrench)

    def progress(self, context: Context) -> float:
        """The fraction of the section that is cut."""
        return float(self.kept(context)[_PROGRESS])

    def set_to_zero(self, context: Context, *parts: DiscreteStateIndex) -> None:
        """Sets wrench, progress, coupling error and a subclass's parts in the context to zero."""
        kept = self.kept(context).copy()
        kept[: _COUPLING + 1] = 0.0
        context.SetDiscreteState(self._kept, kept)
        for part in (self._wrench, *parts):
            context.SetDiscreteState(part, np.zeros(context.get_discrete_state(part).size()))

    def _initialize(self, context: Context, state: State) -> None:
        X_WK = self._pose_input.Eval(context)
        kept = state.get_mutable_discrete_state().get_mutable_value(self._kept)
        kept[LAST_POSE] = X_WK.GetAsMatrix34().ravel()
        kept[_START_TIME] = context.get_time()
        self.start(context, state, X_WK)

    def _update(self, context: Context, state: State) -> EventStatus | None:
        x = state.get_mutable_discrete_state()
        kept = x.get_mutable_value(self._kept)
        if context.get_time() <= kept[_START_TIME]:
            return EventStatus.DidNothing()
        X_WK = self._pose_input.Eval(context)
        found = self.advance(context, state, X_WK)
        try:
            new, progress = found
            # A sum with a NaN or an infinity in it is none either.
            is_right = len(new) == 6 and math.isfinite(sum(new)) and -TINY <= progress <= 1.0 + TINY
        except (TypeError, ValueError):
            is_right = False
        if not is_right:
            raise RuntimeError(
                f"{where_and_when(self, context)} {type(self).__name__}.advance returned {found!r}."
                " It has to return the wrench on the knife, six finite numbers, and the fraction "
                "that is cut, within 0 and 1."
            )
        last, now = kept[LAST_POSE].reshape(3, 4), X_WK.GetAsMatrix34()
        wrench = x.get_mutable_value(self._wrench)
        kept[_COUPLING] += (wrench - new).dot(small_motion(last, now))
        kept[_PROGRESS] = progress
        last[:] = now
        wrench[:] = new
        return None

    @staticmethod
    def _set(state: State, index: int, value: np.ndarray | list[float]) -> None:
        state.get_mutable_discrete_state().set_value(index, value)


class AppliedForce(PlainSystem):
    """Applies the food's wrench to the knife's body in the plant.

    Input port:
        food_wrench_vector: F_K_W of the food on the knife, at Ko, in W: moment and force [6].

    Output port:
        applied_force: The wrench as a list of one ExternallyAppliedSpatialForce.

    Args:
        knife_body: Index of the knife's body, whose frame is K.
    """

    def __init__(self, knife_body: BodyIndex) -> None:
        super().__init__()
        self._no_force = ExternallyAppliedSpatialForce()
        self._no_force.body_index = knife_body
        self._no_force.p_BoBq_B = np.zeros(3)
        self._wrench = self.DeclareVectorInputPort("food_wrench_vector", 6)
        forces = Value[list[ExternallyAppliedSpatialForce]]()
        declare_output(self, "applied_force", forces, self._forces, {self._wrench.ticket()})

    def _forces(self, context: Context) -> list[ExternallyAppliedSpatialForce]:
        force = self._no_force.__copy__()
        force.F_Bq_W = SpatialForce(self._wrench.Eval(context))
        return [force]
