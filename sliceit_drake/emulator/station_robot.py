"""The simulated station as the robot behind the emulated controller."""

import dataclasses as dc

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.plant.robot_plant import RobotConfig
from sliceit_drake.diagrams.ports import STATION_PORTS
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.emulator.kinematics import forward
from sliceit_drake.emulator.robot_model import CYCLE, ArmState, SimulationStopped
from sliceit_drake.systems.analytic_cutter import is_no_food
from sliceit_drake.systems.declare import declare_output
from sliceit_drake.systems.servo import JOINTS, ServoConfig

__all__ = ["JointTargets", "StationRobot"]


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
        held = {self.discrete_state_ticket(self._command)}
        declare_output(self, "commanded_pose", Value(RigidTransform()), self._commanded_pose, held)
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

    def _commanded_pose(self, context: Context) -> RigidTransform:
        q = context.get_discrete_state(self._command).value()
        return self._X_WB @ RigidTransform(forward(q)) @ self._X_TK


class StationRobot:
    """Arm, knife, food, board and sensor of a scenario, as `sliceit simulate` has them.

    A `RobotModel`. Only the compliance controller is missing: that is the client's. All targets go
    through the scenario's servo, planned motions too, which therefore lag by `ServoConfig.lag`.

    Attributes:
        payload: Mass of all beyond the flange, kg.
        payload_cog: Its centre in the flange [3], m.
        is_zeroed: Whether the sensor starts at zero, the tool's weight included.

    Raises:
        ConfigurationError, MeshError, TimeStepError: The scenario cannot be built.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        station = _station_of(scenario)
        simulator = Simulator(station)
        station.SetStart(simulator.get_mutable_context())
        simulator.Initialize()
        self._use(station, simulator)
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
        R_BW = scenario.robot.X_WB().rotation().inverse()
        self.gravity = R_BW.multiply(station.plant.gravity_field().gravity_vector())
        self.warnings: list[str] = []
        self.state = self._read()

    def step(self, targets: ArrayLike, servo: ServoConfig | None) -> ArmState:
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
        self._station.sensor.tare(self._sensor_context)

    def put_fresh_food(self, scenario: Scenario | None = None) -> None:
        old = self._scenario
        if scenario is not None:
            if scenario.knife != old.knife:
                raise ConfigurationError(
                    "is another than the one on the arm",
                    field="fresh_food.knife",
                    fix="Start an emulator with this knife.",
                )
            scenario = dc.replace(
                old,
                food=scenario.food,
                placement=scenario.placement,
                numerics=scenario.numerics,
                sequence=scenario.sequence,
                start=scenario.start,
                policy=None,
                motion=scenario.motion,
            )
        scenario = scenario or old
        station = _station_of(scenario)
        self._check_room(station)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        context.SetTime(self._simulator.get_context().get_time())
        self._copy_arm(station, context)
        try:
            simulator.Initialize()
        except CuttingError as error:
            raise ConfigurationError(
                str(error), field="fresh_food", fix="Put it elsewhere, or move the knife first."
            ) from error
        # Initialization has put the targets to where the arm is.
        self._copy_arm(station, context)
        self._use(station, simulator)
        self._scenario = scenario
        self.state = self._read()

    def _check_room(self, station: SimulatedStation) -> None:
        """Whether the knife is over the food of a station."""
        food, start = station.scenario.food, station.scenario.start
        if is_no_food(food):
            return
        top = float(station.start_pose.translation()[2]) - start.clearance
        robot = self._scenario.robot
        X_BT = RigidTransform(forward(self.state.positions))
        X_WK = robot.X_WB().multiply(X_BT).multiply(robot.X_TK())
        reach = 0.5 * self._scenario.knife.length
        lowest = min(float((X_WK @ np.array([x, 0.0, 0.0]))[2]) for x in (-reach, reach))
        if lowest < top:
            raise ConfigurationError(
                f"the knife is {1e3 * (top - lowest):.1f} mm below the top of the food",
                field="fresh_food",
                fix="Lift it first.",
            )

    def _copy_arm(self, station: SimulatedStation, context: Context) -> None:
        """Copies all but the food from this robot's station to another."""
        old, source = self._station, self._simulator.get_context()
        for system in station.GetSystems():
            # Geometry and bodies are the station's own: plants differ in what is drawn at the food.
            if isinstance(system, SceneGraph | MultibodyPlant) or system is station.cutting:
                continue
            before = old.GetSubsystemByName(system.get_name()).GetMyContextFromRoot(source)
            system.GetMyMutableContextFromRoot(context).SetStateAndParametersFrom(before)
        x = old.plant.GetPositionsAndVelocities(self._plant_context, old.robot.arm)
        plant = station.plant
        plant.SetPositionsAndVelocities(
            plant.GetMyMutableContextFromRoot(context), station.robot.arm, x
        )

    def _use(self, station: SimulatedStation, simulator: Simulator) -> None:
        """Goes on with a station in a simulator, initialized."""
        assert isinstance(station.controller, JointTargets)
        self._station, self._simulator, self._targets = station, simulator, station.controller
        context = simulator.get_mutable_context()
        arm_controller = station.GetSubsystemByName("arm_controller")
        self._torques = arm_controller.GetOutputPort("joint_torques")
        self._arm_context = arm_controller.GetMyContextFromRoot(context)
        self._plant_context = station.plant.GetMyContextFromRoot(context)
        self._sensor_context = station.sensor.GetMyMutableContextFromRoot(context)

    def _read(self) -> ArmState:
        plant, arm = self._station.plant, self._station.robot.arm
        port = self._station.sensor.GetOutputPort("sensor_wrench")
        wrench = port.Eval(self._sensor_context)
        zero = self._station.sensor.zero(self._sensor_context)
        return ArmState(
            plant.GetPositions(self._plant_context, arm),
            plant.GetVelocities(self._plant_context, arm),
            np.concatenate([wrench.translational(), wrench.rotational()]),
            self._torques.Eval(self._arm_context),
            np.concatenate([zero[3:], zero[:3]]),
        )

    def _check_servo(self, servo: ServoConfig | None) -> None:
        """Says once that the station's servo is not what a client asks for."""
        if servo is None or servo == self._other_servo:
            return
        ours = self._scenario.robot.servo
        if (servo.lookahead_time, servo.gain) != (ours.lookahead_time, ours.gain):
            self._other_servo = servo
            self.warnings.append(
                f"servoj asks for lookahead {servo.lookahead_time:g} s and gain {servo.gain:g}; "
                f"the scenario's servo has {ours.lookahead_time:g} s and {ours.gain:g}, which stay"
            )


def _station_of(scenario: Scenario) -> SimulatedStation:
    return MakeStation(scenario, controller=lambda s: JointTargets(s.robot))
