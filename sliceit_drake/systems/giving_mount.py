"""Arm and holder that give: the knife's pose as the food meets it, which no encoder sees."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues

from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.systems.declare import PlainSystem, declare_output

__all__ = ["GivingMount"]

STIFFEST = 3e6
"""Greatest stiffness with which a food is taken to answer, N/m: stuck friction on the flanks."""
FORGET = 0.8
"""Share of the last estimate of that below which the next does not fall."""

# Parts of the state; each has the arm first, upwards, and the holder, along the edge.
_AT_ONCE, _CREPT, _FORCE, _PLACE, _STIFFNESS = (slice(k, k + 2) for k in range(0, 10, 2))


class GivingMount(PlainSystem):
    """Shifts the knife along the vertical and along its edge as what holds it and the food gives.

    A force that answers the shift more stiffly than the springs would swing ever wider if each
    shift took the force of the coupling step before. So the answer's stiffness is estimated from
    the last two, and the shift is the one at which the force, changed by it, is held.

    Input ports:
        knife_pose: RigidTransform X_WK, as the joints have it.
        food_wrench_vector: F_K_W of the food on the knife, moment and force [6].

    Output port:
        met_pose: RigidTransform X_WK, as the food meets it.

    Args:
        bench: With compliances of arm and mounting.
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(self, bench: BenchErrors, exchange_period: float) -> None:
        super().__init__()
        self._compliance = np.array([bench.arm.compliance, bench.mounting.compliance])
        self._creep = np.array([bench.arm.creep, 0.0])
        self._follow = -np.expm1(-exchange_period / bench.arm.creep_time)
        self._pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._wrench = self.DeclareVectorInputPort("food_wrench_vector", 6)
        state = self.DeclareDiscreteState(10)
        declare_output(
            self,
            "met_pose",
            Value(RigidTransform()),
            self._met_pose,
            {self._pose.ticket(), self.discrete_state_ticket(state)},
        )
        # After the food's unrestricted update at the same time, whose force it takes.
        self.DeclarePeriodicDiscreteUpdateEvent(exchange_period, 0.0, self._update)

    @staticmethod
    def _axes(X_WK: RigidTransform) -> np.ndarray:
        """Directions in which it gives [2, 3]: upwards, and along the edge."""
        return np.array([[0.0, 0.0, 1.0], X_WK.rotation().col(0)])

    def _met_pose(self, context: Context) -> RigidTransform:
        X_WK, x = self._pose.Eval(context), context.get_discrete_state(0).value()
        shift = (x[_AT_ONCE] + x[_CREPT]) @ self._axes(X_WK)
        return RigidTransform(X_WK.rotation(), X_WK.translation() + shift)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        X_WK, x = self._pose.Eval(context), discrete_state.get_mutable_value(0)
        axes = self._axes(X_WK)
        force = axes @ self._wrench.Eval(context)[3:]
        given = x[_AT_ONCE] + x[_CREPT]
        place = axes @ X_WK.translation() + given
        moved = np.abs(place - x[_PLACE])
        answer = np.abs(force - x[_FORCE]) / np.maximum(moved, 1e-9)
        answer = np.where(moved > 1e-9, np.minimum(answer, STIFFEST), 0.0)
        stiffness = np.maximum(answer, FORGET * x[_STIFFNESS])
        # What the springs would take, less what the force loses by that.
        at_once = self._compliance * force - x[_AT_ONCE]
        creep = self._follow * (self._creep * np.maximum(force, 0.0) - x[_CREPT])
        total = self._compliance + self._follow * self._creep
        change = (at_once + creep) / (1.0 + stiffness * total)
        held = force - stiffness * change
        x[_CREPT] += self._follow * (self._creep * np.maximum(held, 0.0) - x[_CREPT])
        x[_AT_ONCE] = self._compliance * held
        x[_FORCE], x[_PLACE], x[_STIFFNESS] = force, place, stiffness
