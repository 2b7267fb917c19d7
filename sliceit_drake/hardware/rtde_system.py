"""The robot as a Drake system: measured joints and wrench out, joint targets in."""

import time as clock

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from sliceit_drake.hardware.edge_kinematics import flange_pose
from sliceit_drake.hardware.rtde_link import LinkStatus, RobotLink
from sliceit_drake.hardware.safety import Stop

__all__ = ["RtdeSystem"]

_JOINTS = 6
# Parts of the state that are outputs, and how many numbers they have.
_SHOWN = {
    "joint_positions": _JOINTS,
    "joint_velocities": _JOINTS,
    "sensor_wrench_vector": 6,
    "period": 1,
    "lateness": 1,
    "missed_cycles": 1,
    "latched": 1,
}


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
        sensor_wrench_vector: The wrench as moment and force [6], Nm and N.
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
        self._parts = {
            name: self.DeclareDiscreteState(size)
            for name, size in (_SHOWN | {"time": 1, "arrival": 1}).items()
        }
        for name in _SHOWN:
            self.DeclareStateOutputPort(name, self._parts[name])
        self.DeclareAbstractOutputPort(
            "sensor_wrench",
            lambda: Value(SpatialForce.Zero()),
            self._calc_wrench,
            {self.discrete_state_ticket(self._parts["sensor_wrench_vector"])},
        )
        age = self.DeclareVectorOutputPort("age", 1, self._calc_age, {self.all_sources_ticket()})
        age.disable_caching_by_default()
        self._reason = self.DeclareAbstractState(Value(""))
        self.DeclareStateOutputPort("stop_reason", self._reason)

    def receive(self, context: Context, status: LinkStatus | None = None) -> Stop | None:
        """Puts a measurement, by default the link's newest, into the system's own context.

        Returns:
            Why the safety layer is latched, or None.
        """
        status = status or self._link.latest()
        state = status.state
        pose = flange_pose(state.q)
        R_TB = np.array(pose[:9]).reshape(3, 3)  # The rotation's columns are its rows.
        force, torque = R_TB @ state.wrench[:3], R_TB @ state.wrench[3:]
        if status.stop is not None and not self._value(context, "latched")[0]:
            context.get_mutable_abstract_state(int(self._reason)).set_value(str(status.stop))
        for name, value in {
            "joint_positions": state.q,
            "joint_velocities": state.qd,
            "sensor_wrench_vector": np.concatenate([torque, force]),
            "period": [status.period],
            "lateness": [status.lateness],
            "missed_cycles": [status.missed],
            "latched": [status.stop is not None],
            "time": [state.time],
            "arrival": [status.arrival],
        }.items():
            context.SetDiscreteState(self._parts[name], value)
        return status.stop

    def send(self, context: Context) -> None:
        """Hands the target at the input port to the link, as the answer to the measurement."""
        time = float(self._value(context, "time")[0])
        self._link.put(self._command.Eval(context).tolist(), time)

    def _value(self, context: Context, part: str) -> np.ndarray:
        return context.get_discrete_state(self._parts[part]).value()

    def _calc_wrench(self, context: Context, output: AbstractValue) -> None:
        output.set_value(SpatialForce(self._value(context, "sensor_wrench_vector")))

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        arrival = self._value(context, "arrival")[0]
        output.SetAtIndex(0, (clock.perf_counter() - arrival) * self._pace)
