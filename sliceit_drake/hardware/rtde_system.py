"""The robot as a Drake system: measured joints and wrench out, joint targets in."""

import time as clock
from collections.abc import Callable

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from sliceit_drake.hardware.edge_kinematics import flange_pose
from sliceit_drake.hardware.rtde_link import LinkStatus, RobotLink
from sliceit_drake.hardware.safety import Stop

__all__ = ["RtdeSystem"]

_JOINTS = 6
# Parts of the state.
_Q, _QD, _WRENCH = slice(0, 6), slice(6, 12), slice(12, 18)
_TIME, _PERIOD, _LATENESS, _ARRIVAL, _LATCHED, _MISSED = range(18, 24)
_SIZE = 24


class RtdeSystem(LeafSystem):
    """System in the place of plant and wrench sensor in a hardware station.

    Inputs and outputs beyond the diagram happen where the run loop says so and nowhere else:
    `receive` puts the newest measurement into the Context, `send` hands the newest target to the
    link's thread. Neither waits. All outputs follow from the Context (but `age`, which is about
    the wall clock), so a run's log shows what the controller of the diagram saw.

    Inputs:
        joint_positions_command: Targets [6], rad.

    Outputs:
        joint_positions, joint_velocities: Measured [6], rad and rad/s.
        sensor_wrench: SpatialForce of the environment on the tool, at the flange, in its axes (S).
        wrench_vector: The wrench as moment and force [6], Nm and N.
        period: Controller time between the last two states, s [1].
        lateness: Wall time between them less that, s [1].
        age: Controller time that would have passed since the state arrived, s [1].
        missed_cycles: Cycles of the controller without a state so far [1].
        latched: 1 if the safety layer has stopped the robot [1].
        stop_reason: Why, as text; empty while it has not.

    Args:
        link: Link to the robot.
        pace: Controller seconds in a second.
    """

    def __init__(self, link: RobotLink, pace: float = 1.0) -> None:
        super().__init__()
        self._link, self._pace = link, pace
        self._command = self.DeclareVectorInputPort("joint_positions_command", _JOINTS)
        self._state = self.DeclareDiscreteState(_SIZE)
        self._reason = self.DeclareAbstractState(Value(""))
        depends = {self.discrete_state_ticket(self._state)}
        for name, part in (("joint_positions", _Q), ("joint_velocities", _QD)):
            self.DeclareVectorOutputPort(name, _JOINTS, self._copier(part), depends)
        self.DeclareAbstractOutputPort(
            "sensor_wrench", lambda: Value(SpatialForce.Zero()), self._calc_wrench, depends
        )
        self.DeclareVectorOutputPort("wrench_vector", 6, self._copier(_WRENCH), depends)
        for name, index in (
            ("period", _PERIOD),
            ("lateness", _LATENESS),
            ("missed_cycles", _MISSED),
            ("latched", _LATCHED),
        ):
            part = slice(index, index + 1)
            self.DeclareVectorOutputPort(name, 1, self._copier(part), depends)
        age = self.DeclareVectorOutputPort("age", 1, self._calc_age, {self.all_sources_ticket()})
        age.disable_caching_by_default()
        self.DeclareAbstractOutputPort(
            "stop_reason",
            lambda: Value(""),
            lambda context, output: output.set_value(
                context.get_abstract_state(int(self._reason)).get_value()
            ),
            {self.abstract_state_ticket(self._reason)},
        )

    def receive(self, context: Context, status: LinkStatus | None = None) -> Stop | None:
        """Puts a measurement into the system's own context.

        Args:
            context: This system's context.
            status: The measurement; None for the link's newest.

        Returns:
            Why the safety layer is latched, or None.
        """
        status = status or self._link.latest()
        state = status.state
        x = context.get_mutable_discrete_state_vector().get_mutable_value()
        x[_Q], x[_QD] = state.q, state.qd
        pose = flange_pose(state.q)
        R_TB = np.array(pose[:9]).reshape(3, 3)  # The rotation's columns are its rows.
        force, torque = R_TB @ state.wrench[:3], R_TB @ state.wrench[3:]
        x[_WRENCH] = np.concatenate([torque, force])
        x[_TIME], x[_PERIOD], x[_LATENESS] = state.time, status.period, status.lateness
        x[_ARRIVAL], x[_MISSED] = status.arrival, status.missed
        if status.stop is not None and not x[_LATCHED]:
            context.get_mutable_abstract_state(int(self._reason)).set_value(str(status.stop))
        x[_LATCHED] = float(status.stop is not None)
        return status.stop

    def send(self, context: Context) -> None:
        """Hands the target at the input port to the link, as the answer to the measurement."""
        x = context.get_discrete_state_vector().value()
        self._link.put(self._command.Eval(context).tolist(), float(x[_TIME]))

    @staticmethod
    def _copier(part: slice) -> Callable[[Context, BasicVector], None]:
        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(context.get_discrete_state_vector().value()[part])

        return calc

    def _calc_wrench(self, context: Context, output: AbstractValue) -> None:
        wrench = context.get_discrete_state_vector().value()[_WRENCH]
        output.set_value(SpatialForce(wrench[:3], wrench[3:]))

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        arrival = context.get_discrete_state_vector().value()[_ARRIVAL]
        output.SetAtIndex(0, (clock.perf_counter() - arrival) * self._pace)
