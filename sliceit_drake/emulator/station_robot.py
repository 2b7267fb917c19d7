"""The simulated station as the robot behind the emulated controller."""

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import Simulator, SimulatorStatus

from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeSlicingStation
from sliceit_drake.emulator.joint_targets import JointTargets
from sliceit_drake.emulator.robot_model import CYCLE, RobotState, SimulationStopped
from sliceit_drake.systems.servo import ServoConfig

__all__ = ["StationRobot"]


class StationRobot:
    """Arm, knife, food, board and sensor of a scenario, as `sliceit simulate` has them.

    Only the compliance controller is missing: that is the client's. All targets go through the
    scenario's servo, planned motions too, which therefore lag by `ServoConfig.lag`.

    Attributes:
        payload: Mass of all beyond the flange, kg.
        payload_cog: Its centre in the flange [3], m.
        is_zeroed: Whether the sensor starts at zero, the tool's weight included.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Builds the station and puts the arm at the scenario's start.

        Raises:
            ConfigurationError, MeshError, TimeStepError: The scenario cannot be built.
        """
        self._station = station = MakeSlicingStation(
            scenario, make_controller=lambda s: JointTargets(s.robot)
        )
        assert isinstance(station.controller, JointTargets)
        self._targets = station.controller
        self._servo = scenario.robot.servo
        self._simulator = Simulator(station)
        context = self._simulator.get_mutable_context()
        station.SetStart(context)
        self._simulator.Initialize()
        arm_controller = station.GetSubsystemByName("arm_controller")
        self._torques = arm_controller.GetOutputPort("joint_torques")
        self._arm_context = arm_controller.GetMyContextFromRoot(context)
        self._plant_context = station.plant.GetMyContextFromRoot(context)
        self._sensor_context = station.sensor.GetMyMutableContextFromRoot(context)
        tool = station.plant.CalcSpatialInertia(
            self._plant_context,
            station.robot.sensor_weld.frame_on_parent(),
            [station.robot.sensor_weld.child_body().index(), station.robot.knife.index()],
        )
        self.payload = float(tool.get_mass())
        x, y, z = tool.get_com().tolist()
        self.payload_cog = (x, y, z)
        self.is_zeroed = scenario.sensor.tare_at_start
        self._cycles = 0
        self._other_servo: ServoConfig | None = None
        self.gravity = (
            scenario.robot.X_WB()
            .rotation()
            .inverse()
            .multiply(station.plant.gravity_field().gravity_vector())
        )
        self.warnings: list[str] = []
        self.state = self._read()

    def step(self, targets: ArrayLike, servo: ServoConfig | None) -> RobotState:
        """See `robot_model.RobotModel`."""
        self._check_servo(servo)
        self._targets.set_targets(self._simulator.get_mutable_context(), targets)
        self._cycles += 1
        try:
            status = self._simulator.AdvanceTo(self._cycles * CYCLE)
        except CuttingError as error:
            raise SimulationStopped(str(error)) from error
        if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
            raise SimulationStopped(status.message())
        self.state = self._read()
        return self.state

    def zero_sensor(self) -> None:
        """See `robot_model.RobotModel`."""
        self._station.sensor.tare(self._sensor_context)

    def _read(self) -> RobotState:
        plant, arm = self._station.plant, self._station.robot.arm
        port = self._station.sensor.GetOutputPort("sensor_wrench")
        wrench = port.Eval(self._sensor_context)
        return RobotState(
            plant.GetPositions(self._plant_context, arm),
            plant.GetVelocities(self._plant_context, arm),
            np.concatenate([wrench.translational(), wrench.rotational()]),
            self._torques.Eval(self._arm_context),
        )

    def _check_servo(self, servo: ServoConfig | None) -> None:
        """Says once that the station's servo is not what a client asks for."""
        if servo is None or servo == self._other_servo:
            return
        ours = self._servo
        if (servo.lookahead_time, servo.gain) != (ours.lookahead_time, ours.gain):
            self._other_servo = servo
            self.warnings.append(
                f"servoj asks for lookahead {servo.lookahead_time:g} s and gain {servo.gain:g}; "
                f"the scenario's servo has {ours.lookahead_time:g} s and {ours.gain:g}, which stay"
            )
