"""Joint targets from outside a station, in place of its compliance controller."""

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from sliceit_drake.diagrams.plant.robot_plant import RobotConfig
from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.emulator.kinematics import forward
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.systems.servo import JOINTS

__all__ = ["JointTargets"]


class JointTargets(LeafSystem):
    """Passes on the joint targets that `set_targets` has put into the context.

    It has the ports of the compliance controller, and takes new targets at the instants at which
    that one updates: a client that computes the same commands gets the same motion.

    Inputs:
        joint_positions: Measured [6], rad; the targets start there.
        sensor_wrench, and those of the station's contract: not used.

    Outputs:
        joint_positions_command: [6], rad; held over each cycle.
        commanded_pose: X_WK at the command.
    """

    def __init__(self, config: RobotConfig) -> None:
        super().__init__()
        self._X_WB, self._X_TK = config.X_WB(), config.X_TK()
        self._measured = self.DeclareVectorInputPort("joint_positions", JOINTS)
        self.DeclareAbstractInputPort("sensor_wrench", Value(SpatialForce.Zero()))
        for port in STATION_PORTS:
            if port.direction == "input":
                if isinstance(port.type, int):
                    self.DeclareVectorInputPort(port.name, port.type)
                else:
                    self.DeclareAbstractInputPort(port.name, Value[port.type]())
        self._command = self.DeclareDiscreteState(JOINTS)
        self._next = self.DeclareDiscreteState(JOINTS)
        self.DeclareStateOutputPort("joint_positions_command", self._command)
        self.DeclareAbstractOutputPort(
            "commanded_pose",
            lambda: Value(RigidTransform()),
            self._calc_commanded_pose,
            {self.discrete_state_ticket(self._command)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(CYCLE, 0.0, self._update)

    def set_targets(self, root_context: Context, targets: ArrayLike) -> None:
        """Gives the targets [6], rad, of the cycle that comes."""
        context = self.GetMyMutableContextFromRoot(root_context)
        context.SetDiscreteState(self._next, np.asarray(targets, float))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        positions = self._measured.Eval(context)
        discrete_state.set_value(self._command, positions)
        discrete_state.set_value(self._next, positions)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._command, context.get_discrete_state(self._next).value())

    def _calc_commanded_pose(self, context: Context, output: AbstractValue) -> None:
        q = context.get_discrete_state(self._command).value()
        output.set_value(self._X_WB @ RigidTransform(forward(q)) @ self._X_TK)
