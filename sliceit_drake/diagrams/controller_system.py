"""What a controller of one's own starts from: the ports of one, and the kinematics of the arm."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.systems.declare import declare_cached, declare_output, where_and_when
from sliceit_drake.systems.ur5e_kinematics import make_virtual_model, ur5e_chain

__all__ = ["ControllerSystem"]


class ControllerSystem(LeafSystem):
    """A controller of the arm: once per coupling step `advance` says where the joints shall go.

    A station takes it in place of the compliance controller. At the start it commands the joint
    positions that are measured.

    Input ports:
        joint_positions: Measured [6], rad.
        sensor_wrench: SpatialForce of the environment on the robot, about So, in S.
        target_pose: RigidTransform X_WK that the knife shall reach.

    Further input ports are the other inputs of `ports.STATION_PORTS`; a controller uses those that
    it needs.

    Output ports:
        joint_positions_command: Commanded [6], rad.
        commanded_pose: RigidTransform X_WK at the command.

    Args:
        scenario: Of the station.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self._X_WB = scenario.robot.X_WB()
        arm = self._arm = make_virtual_model(ur5e_chain(scenario.robot.X_TK()), 1.0)
        self._knife = arm.GetFrameByName("end_effector")
        # Every use overwrites it first.
        self._scratch = declare_cached(
            self, "arm", lambda context: arm.CreateDefaultContext(), {self.nothing_ticket()}
        )
        self._measured = self.DeclareVectorInputPort("joint_positions", arm.num_positions())
        self.DeclareAbstractInputPort("sensor_wrench", Value(SpatialForce.Zero()))
        for port in STATION_PORTS:
            if port.direction != "input":
                continue
            if isinstance(port.type, int):
                self.DeclareVectorInputPort(port.name, port.type)
            else:
                self.DeclareAbstractInputPort(port.name, Value(port.type()))
        command = self._command = self.DeclareDiscreteState(arm.num_positions())
        self.DeclareStateOutputPort("joint_positions_command", command)
        declare_output(
            self,
            "commanded_pose",
            Value(RigidTransform()),
            lambda c: self.knife_pose(c, c.get_discrete_state(command).value()),
            {self.discrete_state_ticket(command)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(scenario.exchange_period, 0.0, self._update)

    def advance(self, context: Context, q: np.ndarray) -> np.ndarray:
        """What is commanded next.

        Args:
            context: Of this system, for its input ports.
            q: Joint positions that were commanded last [6], rad.

        Returns:
            Joint positions [6], rad.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method advance")

    def knife_pose(self, context: Context, q: np.ndarray) -> RigidTransform:
        """X_WK at joint positions [6], rad."""
        return self._X_WB @ self._knife.CalcPoseInWorld(self._at(context, q))

    def knife_jacobian(self, context: Context, q: np.ndarray) -> np.ndarray:
        """Velocity V_WK of the knife for each joint's speed [6, 6]; the first rows turn it."""
        base = self._arm.world_frame()
        J_B = self._arm.CalcJacobianSpatialVelocity(
            self._at(context, q), JacobianWrtVariable.kQDot, self._knife, np.zeros(3), base, base
        )
        return (self._X_WB.rotation().matrix() @ J_B.reshape(2, 3, -1)).reshape(6, -1)

    def _at(self, context: Context, q: np.ndarray) -> Context:
        """The arm at joint positions."""
        scratch = self._scratch.Eval(context)
        self._arm.SetPositions(scratch, q)
        return scratch

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._command, self._measured.Eval(context))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        q = context.get_discrete_state(self._command).value()
        command = np.asarray(self.advance(context, q), float)
        if command.shape != (6,) or not np.isfinite(command).all():
            raise RuntimeError(
                f"{where_and_when(self, context)} {type(self).__name__}.advance returned {command}."
                " It has to return the positions of six joints."
            )
        discrete_state.set_value(self._command, command)
