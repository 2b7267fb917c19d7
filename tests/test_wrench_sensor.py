"""The wrench sensor against weights, forces and accelerations that are known."""

import dataclasses as dc

import numpy as np
import pytest
import scipy.signal
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia, WeldJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.plant.robot_plant import (
    Robot,
    RobotConfig,
    add_plant,
    add_robot,
    connect_arm_controller,
)
from sliceit_drake.systems.wrench_sensor import WrenchSensor, WrenchSensorConfig

STEP = 1e-3
EXCHANGE = 2e-3
GRAVITY = np.array([0.0, 0.0, -9.81])


class AppliedForce(LeafSystem):
    """Force on the knife at a point of it, a function of time; in W."""

    def __init__(self, robot: Robot, p_KQ: np.ndarray, wrench):
        super().__init__()
        self._force = ExternallyAppliedSpatialForce()
        self._force.body_index = robot.knife.index()
        self._force.p_BoBq_B = p_KQ
        self._wrench = wrench
        self.DeclareAbstractOutputPort(
            "force", lambda: AbstractValue.Make([self._force]), self._calc
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        wrench = self._wrench(context.get_time())
        self._force.F_Bq_W = SpatialForce(wrench[:3], wrench[3:])
        output.set_value([self._force])


class Reader(LeafSystem):
    """Records what a controller reads in its own update at each coupling step."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractInputPort("wrench", Value(SpatialForce.Zero()))
        self.times, self.readings = [], []
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(EXCHANGE, 0.0, self._update)

    def _update(self, context: Context, _) -> EventStatus:
        self.times.append(context.get_time())
        self.readings.append(self.get_input_port().Eval(context).get_coeffs())
        return EventStatus.Succeeded()


@dc.dataclass
class Rig:
    diagram: Diagram
    plant: MultibodyPlant
    robot: Robot
    sensor: WrenchSensor
    reader: Reader

    def run(self, duration: float, simulator: Simulator | None = None) -> Simulator:
        simulator = simulator or Simulator(self.diagram)
        simulator.AdvanceTo(duration)
        return simulator

    def reading(self, simulator: Simulator) -> SpatialForce:
        context = self.sensor.GetMyContextFromRoot(simulator.get_context())
        return self.sensor.GetOutputPort("sensor_wrench").Eval(context)

    def poses(self, simulator: Simulator) -> tuple[RigidTransform, RigidTransform]:
        """X_WS and X_WK."""
        context = self.plant.GetMyContextFromRoot(simulator.get_context())
        X_WS = self.plant.GetFrameByName("tool0").CalcPoseInWorld(context)
        return X_WS, self.robot.knife.EvalPoseInWorld(context)

    def tool(self, simulator: Simulator) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass of gripper and knife, position and velocity of their centre in W."""
        context = self.plant.GetMyContextFromRoot(simulator.get_context())
        instances = [self.plant.GetModelInstanceByName(name) for name in ("gripper", "knife")]
        mass = self.plant.CalcTotalMass(context, instances)
        centre = self.plant.CalcCenterOfMassPositionInWorld(context, instances)
        velocity = self.plant.CalcCenterOfMassTranslationalVelocityInWorld(context, instances)
        return mass, centre, velocity


def make_rig(
    sensor: WrenchSensorConfig | None = None,
    *,
    joints: list[float] | None = None,
    targets: PiecewisePolynomial | None = None,
    wrench=None,
    p_KQ: np.ndarray | None = None,
    step: float = STEP,
) -> Rig:
    config = RobotConfig(plant_time_step=step)
    if joints is not None:
        config.joint_positions = joints
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, config)
    robot = add_robot(plant, config, Knife(), Board())
    plant.Finalize()
    controller = connect_arm_controller(builder, plant, robot, config)
    source = ConstantVectorSource(config.joint_positions)
    if targets is not None:
        source = TrajectorySource(targets)
    builder.AddSystem(source)
    builder.Connect(source.get_output_port(), controller.GetInputPort("joint_positions_command"))
    if wrench is not None:
        point = np.zeros(3) if p_KQ is None else p_KQ
        force = builder.AddSystem(AppliedForce(robot, point, wrench))
        builder.Connect(force.get_output_port(), plant.get_applied_spatial_force_input_port())
    system = builder.AddNamedSystem(
        "wrench_sensor",
        WrenchSensor(plant, robot.sensor_weld, EXCHANGE, sensor or WrenchSensorConfig()),
    )
    builder.Connect(plant.get_reaction_forces_output_port(), system.get_input_port())
    reader = builder.AddSystem(Reader())
    builder.Connect(system.GetOutputPort("sensor_wrench"), reader.get_input_port())
    return Rig(builder.Build(), plant, robot, system, reader)


def coefficients(X_WS: RigidTransform, moment_W: np.ndarray, force_W: np.ndarray) -> np.ndarray:
    """A wrench at So given in W, in S."""
    R_SW = X_WS.rotation().inverse()
    return np.concatenate([R_SW @ moment_W, R_SW @ force_W])


POSTURES = [
    [1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493],
    [0.5, -1.2, 1.4, 0.3, 0.8, -2.0],
    [-2.0, -0.7, -1.1, 1.0, -0.6, 0.4],
    [0.0, -1.5708, 0.0, -1.5708, 0.0, 0.0],
]


@pytest.mark.parametrize("joints", POSTURES)
def test_without_taring_it_shows_the_tools_weight_in_every_orientation(joints):
    rig = make_rig(WrenchSensorConfig(tare_at_start=False), joints=joints)
    simulator = rig.run(0.05)
    X_WS, _ = rig.poses(simulator)
    mass, centre, _ = rig.tool(simulator)
    weight = mass * GRAVITY
    expected = coefficients(X_WS, np.cross(centre - X_WS.translation(), weight), weight)
    assert np.linalg.norm(expected[3:]) > 11.0
    np.testing.assert_allclose(rig.reading(simulator).get_coeffs(), expected, atol=1e-6)


def test_taring_removes_the_weight_where_it_was_done():
    rig = make_rig()
    simulator = rig.run(0.1)
    np.testing.assert_allclose(rig.reading(simulator).get_coeffs(), 0.0, atol=1e-7)


@pytest.mark.parametrize("joints", POSTURES[:3])
def test_a_force_of_the_environment_shows_one_to_one_with_its_moment_about_the_sensor(joints):
    pull = np.array([0.3, -0.2, 0.1, 7.0, -4.0, 12.0])
    p_KQ = np.array([0.06, 0.01, -0.02])

    def wrench(time: float) -> np.ndarray:
        return pull if time > 0.0195 else np.zeros(6)

    rig = make_rig(joints=joints, wrench=wrench, p_KQ=p_KQ)
    simulator = rig.run(0.6)
    X_WS, X_WK = rig.poses(simulator)
    arm = X_WK @ p_KQ - X_WS.translation()
    expected = coefficients(X_WS, pull[:3] + np.cross(arm, pull[3:]), pull[3:])
    np.testing.assert_allclose(rig.reading(simulator).get_coeffs(), expected, atol=2e-3)
    # The environment pushes up on the robot: the sensor's force points up.
    assert X_WS.rotation().multiply(rig.reading(simulator).translational())[2] > 11.9


def test_free_motion_shows_the_tools_inertia_alone_and_as_an_impulse_exactly():
    start = np.array(POSTURES[0])
    end = start + [0.25, -0.1, 0.15, 0.1, 0.0, 0.0]
    targets = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 0.15, 0.3], np.stack([start, 0.5 * (start + end), end], axis=1), True
    )
    rig = make_rig(WrenchSensorConfig(tare_at_start=False), targets=targets)
    simulator = rig.run(EXCHANGE)
    mass, _, after = rig.tool(simulator)
    largest = 0.0
    for k in range(2, 150):
        before = after
        rig.run(k * EXCHANGE, simulator)
        _, _, after = rig.tool(simulator)
        X_WS, _ = rig.poses(simulator)
        inertial = mass * (after - before) / EXCHANGE
        largest = max(largest, np.linalg.norm(inertial))
        rig.run(k * EXCHANGE + 1e-6, simulator)
        shown = X_WS.rotation() @ rig.reading(simulator).translational()
        # The sensor's frame turns by some milliradians within a coupling step.
        np.testing.assert_allclose(shown, mass * GRAVITY - inertial, atol=0.06)
    assert largest > 3.0


def test_a_reading_is_the_mean_over_the_plant_steps_of_the_coupling_step_before_it():
    def wrench(time: float) -> np.ndarray:
        # Ten newtons in the first step of each coupling step.
        first = round(time / STEP) % 2 == 0
        return np.array([0, 0, 0, 0, 0, 10.0 * first])

    rig = make_rig(WrenchSensorConfig(tare_at_start=False), wrench=wrench)
    rig.run(0.0205)
    still = make_rig(WrenchSensorConfig(tare_at_start=False))
    still.run(0.0205)
    difference = np.array(rig.reader.readings[2:]) - np.array(still.reader.readings[2:])
    # The arm gives way a little, at first.
    np.testing.assert_allclose(np.linalg.norm(difference[:, 3:], axis=1), 5.0, atol=0.6)


def test_a_controller_of_the_same_instant_reads_the_coupling_step_just_past():
    pushed = (0.0099, 0.0119)  # Within the coupling step from 10 to 12 ms.

    def wrench(time: float) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, 10.0 * (pushed[0] < time < pushed[1])])

    rig = make_rig(wrench=wrench)
    rig.run(0.0205)
    size = np.linalg.norm(np.array(rig.reader.readings)[:, 3:], axis=1)
    times = np.array(rig.reader.times)
    at = int(np.argmax(size))
    assert times[at] == pytest.approx(0.012)
    assert size[at] > 8.0
    np.testing.assert_allclose(size[:at], 0.0, atol=1e-6)
    # Afterwards only the arm's own motion is left.
    assert size[at + 1] < 2.0


def test_the_reading_is_held_between_coupling_steps_and_zero_before_the_first():
    rig = make_rig(WrenchSensorConfig(tare_at_start=False, force_noise=0.1))
    simulator = rig.run(0.001)
    np.testing.assert_array_equal(rig.reading(simulator).get_coeffs(), 0.0)
    held = []
    for k in range(2, 8):
        rig.run(k * STEP, simulator)
        held.append(rig.reading(simulator).get_coeffs().copy())
    assert np.linalg.norm(held[0]) > 11.0
    np.testing.assert_array_equal(held[0::2], held[1::2])
    assert np.abs(np.diff(held[0::2], axis=0)[:, 3:]).min() > 1e-6
    np.testing.assert_array_equal(rig.reader.readings[0], 0.0)
    np.testing.assert_array_equal(rig.reader.readings[1:], held[0:-1:2])


# Multiples of 0.1 ms round apart from those of 2 ms.
@pytest.mark.parametrize("step", [1e-4, 2e-3])
def test_it_counts_every_plant_step_once_whatever_the_ratio(step):
    rig = make_rig(WrenchSensorConfig(tare_at_start=False), step=step)
    rig.run(0.06)
    readings = np.array(rig.reader.readings[1:])
    assert np.linalg.norm(readings[0, 3:]) == pytest.approx(11.76, abs=0.01)
    np.testing.assert_allclose(readings, np.tile(readings[0], (len(readings), 1)), atol=1e-6)


def test_a_weld_with_an_offset_is_moved_to_the_sensors_frame():
    X_SJ = RigidTransform(RollPitchYaw(0.4, -0.8, 1.1), [0.03, -0.05, 0.11])
    plant = MultibodyPlant(STEP)
    plant.SetUseSampledOutputPorts(False)
    arm = plant.AddRigidBody("arm", SpatialInertia.SolidSphereWithMass(1.0, 0.05))
    slide = plant.AddJoint(
        PrismaticJoint("slide", plant.world_frame(), arm.body_frame(), [1.0, 0.0, 0.0])
    )
    mass, p_ToolCentre = 1.7, np.array([0.02, 0.04, -0.06])
    inertia = SpatialInertia.SolidSphereWithMass(mass, 0.03).Shift(-p_ToolCentre)
    tool = plant.AddRigidBody("tool", inertia)
    weld = plant.AddJoint(WeldJoint("weld", arm.body_frame(), tool.body_frame(), X_SJ))
    plant.Finalize()
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    sensor = builder.AddSystem(
        WrenchSensor(plant, weld, EXCHANGE, WrenchSensorConfig(tare_at_start=False))
    )
    builder.Connect(plant.get_reaction_forces_output_port(), sensor.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.01)
    assert slide.get_translation(plant.GetMyContextFromRoot(simulator.get_context())) == 0.0
    reading = sensor.GetOutputPort("sensor_wrench").Eval(
        sensor.GetMyContextFromRoot(simulator.get_context())
    )
    weight = mass * GRAVITY
    np.testing.assert_allclose(reading.translational(), weight, atol=1e-9)
    moment = np.cross(X_SJ @ p_ToolCentre, weight)
    np.testing.assert_allclose(reading.rotational(), moment, atol=1e-9)


# Imperfections ----------------------------------------------------------------------------------


def test_a_bias_stays_after_taring():
    config = WrenchSensorConfig(force_bias=[1.0, -2.0, 3.0], moment_bias=[0.1, 0.2, -0.3])
    rig = make_rig(config)
    simulator = rig.run(0.02)
    expected = [0.1, 0.2, -0.3, 1.0, -2.0, 3.0]
    np.testing.assert_allclose(rig.reading(simulator).get_coeffs(), expected, atol=1e-7)


def test_the_low_pass_filter_answers_a_step_with_its_time_constant():
    cutoff = 20.0

    def wrench(time: float) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, 10.0 * (time > 0.0999)])

    filtered = make_rig(WrenchSensorConfig(cutoff_frequency=cutoff), wrench=wrench)
    ideal = make_rig(wrench=wrench)
    filtered.run(0.15)
    ideal.run(0.15)
    share = 1.0 - np.exp(-2 * np.pi * cutoff * EXCHANGE)
    expected = np.zeros(6)
    for k, (shown, true) in enumerate(
        zip(filtered.reader.readings, ideal.reader.readings, strict=True)
    ):
        expected = expected + share * (true - expected) if k > 1 else true
        np.testing.assert_allclose(shown, expected, atol=1e-9)
    assert np.linalg.norm(expected[3:]) > 9.0


def noise_of(config: WrenchSensorConfig, duration: float = 0.6) -> np.ndarray:
    rig = make_rig(config)
    rig.run(duration)
    return np.array(rig.reader.readings[1:])


def test_noise_has_the_given_size_and_no_memory():
    readings = noise_of(WrenchSensorConfig(force_noise=0.5, moment_noise=0.02), duration=3.0)
    np.testing.assert_allclose(readings[:, 3:].std(axis=0), 0.5, rtol=0.08)
    np.testing.assert_allclose(readings[:, :3].std(axis=0), 0.02, rtol=0.08)
    np.testing.assert_allclose(readings[:, 3:].mean(axis=0), 0.0, atol=0.06)
    z = readings[:, 5]
    assert abs(np.corrcoef(z[:-1], z[1:])[0, 1]) < 0.1


def test_noise_follows_from_the_seed_in_the_context():
    config = WrenchSensorConfig(force_noise=0.5, seed=4)
    first = noise_of(config, 0.03)
    np.testing.assert_array_equal(first, noise_of(config, 0.03))
    assert np.abs(first - noise_of(dc.replace(config, seed=5), 0.03)).max() > 0.1

    rig = make_rig(config)
    simulator = Simulator(rig.diagram)
    context = rig.sensor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    rig.sensor.randomize_context(context, np.random.default_rng(1))
    rig.run(0.03, simulator)
    assert np.abs(first - np.array(rig.reader.readings[1:])).max() > 0.1


def test_two_contexts_of_one_diagram_do_not_disturb_each_other():
    config = WrenchSensorConfig(force_noise=0.5)
    alone = noise_of(config, 0.02)
    rig = make_rig(config)
    a, b = Simulator(rig.diagram), Simulator(rig.diagram)
    readings = []
    for k in range(1, 11):
        rig.run(k * EXCHANGE - 1e-6, a)
        rig.run(k * EXCHANGE + 0.04, b)
        rig.run(k * EXCHANGE, a)
        readings.append(rig.reading(a).get_coeffs().copy())
    np.testing.assert_array_equal(readings[: len(alone)], alone)


# Spectra, drift and delay, of the sensor alone ---------------------------------------------------


class Reactions(LeafSystem):
    """Gives the sensor the wrenches [N, 6] of the environment, one a coupling step."""

    def __init__(self, wrenches: np.ndarray):
        super().__init__()
        self._wrenches = wrenches
        self.DeclareAbstractOutputPort(
            "reaction_forces", lambda: AbstractValue.Make([SpatialForce.Zero()]), self._calc
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        wrench = -self._wrenches[round(context.get_time() / EXCHANGE)]
        output.set_value([SpatialForce(wrench[:3], wrench[3:])])


@dc.dataclass
class Bench:
    """A sensor that is driven by given wrenches, without a plant that moves."""

    sensor: WrenchSensor
    simulator: Simulator
    log: object
    coupling_steps: int

    def context(self) -> Context:
        return self.sensor.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def readings(self) -> np.ndarray:
        """Readings [N, 6], moment first, from the first."""
        self.simulator.AdvanceTo((self.coupling_steps - 0.5) * EXCHANGE)
        # The log shows at each coupling step what was read in the one before.
        return self.log.FindLog(self.simulator.get_context()).data()[:, 1:].T


def make_bench(config: WrenchSensorConfig, wrenches: np.ndarray) -> Bench:
    plant = MultibodyPlant(EXCHANGE)
    plant.SetUseSampledOutputPorts(False)
    tool = plant.AddRigidBody("tool", SpatialInertia.SolidSphereWithMass(1.0, 0.05))
    weld = plant.AddJoint(WeldJoint("w", plant.world_frame(), tool.body_frame(), RigidTransform()))
    plant.Finalize()
    builder = DiagramBuilder()
    source = builder.AddSystem(Reactions(wrenches))
    sensor = builder.AddSystem(WrenchSensor(plant, weld, EXCHANGE, config))
    builder.Connect(source.get_output_port(), sensor.get_input_port())
    log = LogVectorOutput(sensor.GetOutputPort("sensor_wrench_vector"), builder, EXCHANGE)
    return Bench(sensor, Simulator(builder.Build()), log, len(wrenches))


def read(config: WrenchSensorConfig, wrenches: np.ndarray) -> np.ndarray:
    return make_bench(config, wrenches).readings()


def nothing(coupling_steps: int) -> np.ndarray:
    return np.zeros((coupling_steps, 6))


def density(readings: np.ndarray, segment: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [M], Hz, without 0 and Nyquist; one-sided densities [M, 6]."""
    f, S = scipy.signal.welch(
        readings, 1.0 / EXCHANGE, nperseg=segment, detrend="linear", axis=0, scaling="density"
    )
    return f[1:-1], S[1:-1]


# A Welch estimate from K independent values scatters by 1/sqrt(K). 2^15 readings in segments of 256
# that overlap by half give some 130 in each of 127 bins; averaged over eight bins and three axes,
# with the window's correlation of neighbours, 2 to 3 %. The bounds below are four of these and the
# seeds are fixed: a wrong factor of two, slope or cutoff fails, another generator does not.
LONG, SEGMENT = 2**15, 256


def octave_means(f: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Means over bands of eight bins and the three axes of force and of moment [B, 2]."""
    usable = len(f) // 8 * 8
    return ratio[:usable].reshape(-1, 8, 2, 3).mean(axis=(1, 3))


def test_noise_is_white_with_the_density_of_its_standard_deviation():
    config = WrenchSensorConfig(force_noise=0.5, moment_noise=0.02, seed=1)
    f, S = density(read(config, nothing(LONG)), SEGMENT)
    expected = 2.0 * np.repeat([0.02, 0.5], 3) ** 2 * EXCHANGE
    np.testing.assert_allclose(octave_means(f, S / expected), 1.0, atol=0.10)
    np.testing.assert_allclose((S / expected).mean(), 1.0, atol=0.02)


def test_a_white_force_is_shown_with_the_density_of_the_low_pass_filter():
    cutoff, size = 20.0, 3.0
    wrenches = size * np.random.default_rng(2).standard_normal((LONG, 6))
    f, S = density(read(WrenchSensorConfig(cutoff_frequency=cutoff), wrenches), SEGMENT)
    pole = np.exp(-2 * np.pi * cutoff * EXCHANGE)
    gain = ((1 - pole) / np.abs(1 - pole * np.exp(-2j * np.pi * f * EXCHANGE))) ** 2
    assert np.interp(cutoff, f, gain) == pytest.approx(
        0.5, abs=0.03
    )  # As a filter in continuous time.
    ratio = S / (2.0 * size**2 * EXCHANGE * gain)[:, None]
    np.testing.assert_allclose(octave_means(f, ratio), 1.0, atol=0.10)
    np.testing.assert_allclose(ratio.mean(), 1.0, atol=0.02)


def test_drift_is_a_random_walk_with_the_density_of_its_spread():
    config = WrenchSensorConfig(force_drift=0.2, moment_drift=0.01, seed=3)
    f, S = density(read(config, nothing(LONG)), SEGMENT)
    spread = np.repeat([0.01, 0.2], 3)
    band = slice(3, 35)  # Above the window's first lobes, below where the steps show.
    expected = spread**2 / (2.0 * np.pi**2 * f[band, None] ** 2)
    steps = (np.sin(np.pi * f[band] * EXCHANGE) / (np.pi * f[band] * EXCHANGE)) ** -2
    np.testing.assert_allclose(
        octave_means(f[band], S[band] / (expected * steps[:, None])), 1.0, atol=0.12
    )
    slope = np.polyfit(np.log(f[band]), np.log((S[band] / steps[:, None]).mean(axis=1)), 1)[0]
    assert slope == pytest.approx(-2.0, abs=0.06)


def test_drift_spreads_with_the_square_root_of_time_and_has_no_direction():
    # 200 sensors of 6 axes, a tenth of a second each.
    ends = np.concatenate(
        [
            read(WrenchSensorConfig(force_drift=0.3, moment_drift=0.3, seed=seed), nothing(52))[-1]
            for seed in range(200)
        ]
    )
    expected = 0.3 * np.sqrt(50 * EXCHANGE)
    assert ends.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * ends.size))
    assert abs(ends.mean()) < 4 * expected / np.sqrt(ends.size)


def test_taring_takes_away_force_and_drift_and_leaves_bias():
    wrenches = np.tile([0.1, 0.2, 0.3, 1.0, 2.0, -12.0], (200, 1))
    wrenches[0] = 0.0
    config = WrenchSensorConfig(
        force_drift=0.5, force_drift_rate=[0.0, 0.0, 1.0], force_bias=[0.0, 0.0, 0.25]
    )
    bench = make_bench(config, wrenches)
    bench.simulator.AdvanceTo(100.5 * EXCHANGE)
    before = bench.sensor.GetOutputPort("sensor_wrench").Eval(bench.context()).get_coeffs()
    assert np.abs(before - wrenches[-1] - [0, 0, 0, 0, 0, 0.25])[3:].max() > 0.1
    bench.sensor.tare(bench.context())
    bench.simulator.AdvanceTo(101.5 * EXCHANGE)
    after = bench.sensor.GetOutputPort("sensor_wrench").Eval(bench.context()).get_coeffs()
    step = 0.5 * np.sqrt(EXCHANGE)
    np.testing.assert_allclose(after, [0, 0, 0, 0, 0, 0.25], atol=5 * step)
    np.testing.assert_allclose(after[:3], 0.0, atol=1e-12)


def test_a_steady_drift_grows_from_the_first_reading_on():
    config = WrenchSensorConfig(
        force_drift_rate=[0.0, 0.5, -1.0], moment_drift_rate=[0.1, 0.0, 0.0]
    )
    readings = read(config, nothing(100))
    times = EXCHANGE * np.arange(len(readings))
    expected = times[:, None] * [0.1, 0.0, 0.0, 0.0, 0.5, -1.0]
    np.testing.assert_allclose(readings, expected, atol=1e-12)


WRENCHES = np.random.default_rng(5).standard_normal((60, 6))


def test_a_delay_of_whole_coupling_steps_moves_the_readings_and_changes_nothing_else():
    prompt = read(WrenchSensorConfig(force_noise=0.1), WRENCHES)
    late = read(WrenchSensorConfig(force_noise=0.1, delay=3 * EXCHANGE), WRENCHES)
    np.testing.assert_array_equal(late[3:], prompt[:-3])
    # As if the first wrench had always been there.
    np.testing.assert_array_equal(late[:3], np.tile(prompt[0], (3, 1)))


def test_a_delay_between_coupling_steps_is_interpolated():
    prompt = read(WrenchSensorConfig(), WRENCHES)
    late = read(WrenchSensorConfig(delay=1.25 * EXCHANGE), WRENCHES)
    np.testing.assert_allclose(late[2:], 0.75 * prompt[1:-1] + 0.25 * prompt[:-2], atol=1e-12)
    ramp = np.outer(np.arange(60), np.ones(6))
    late = read(WrenchSensorConfig(delay=1.25 * EXCHANGE, tare_at_start=False), ramp)
    np.testing.assert_allclose(late[2:], ramp[2:-1] - 1.25, atol=1e-12)


def test_readings_are_multiples_of_the_resolution_next_to_the_wrench():
    config = WrenchSensorConfig(force_resolution=0.1, tare_at_start=False)
    readings = read(config, WRENCHES)
    steps = readings[:, 3:] / 0.1
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert np.abs(readings - WRENCHES[:-1])[:, 3:].max() == pytest.approx(0.05, abs=2e-3)
    np.testing.assert_allclose(readings[:, :3], WRENCHES[:-1, :3], atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 2 * EXCHANGE])
def test_a_slow_sensor_holds_each_reading_for_its_sample_period(delay):
    prompt = read(WrenchSensorConfig(delay=delay), WRENCHES)
    slow = read(WrenchSensorConfig(delay=delay, sample_period=5 * EXCHANGE), WRENCHES)
    lag = round(delay / EXCHANGE)
    held = lag + (np.arange(lag, len(prompt)) - lag) // 5 * 5
    np.testing.assert_array_equal(slow[lag:], prompt[held])


ALL = WrenchSensorConfig(
    force_noise=0.5,
    moment_noise=0.02,
    cutoff_frequency=50.0,
    force_drift=0.3,
    moment_drift=0.01,
    force_drift_rate=[0.1, 0.0, 0.0],
    force_resolution=0.01,
    sample_period=2 * EXCHANGE,
    delay=1.5 * EXCHANGE,
    seed=7,
)


def test_every_imperfection_follows_from_the_seed_and_differs_with_it():
    first = read(ALL, WRENCHES)
    np.testing.assert_array_equal(first, read(ALL, WRENCHES))
    assert np.abs(first - read(dc.replace(ALL, seed=8), WRENCHES)).max() > 0.1
    walk = WrenchSensorConfig(force_drift=0.3, moment_drift=0.3, seed=7)
    noise = WrenchSensorConfig(force_noise=0.3, moment_noise=0.3, seed=7)
    steps = np.diff(read(walk, nothing(400)), axis=0).ravel()
    assert abs(np.corrcoef(steps, read(noise, nothing(400))[1:].ravel())[0, 1]) < 0.1


def test_two_contexts_with_every_imperfection_do_not_disturb_each_other():
    alone = read(ALL, WRENCHES)
    bench = make_bench(ALL, WRENCHES)
    diagram = bench.simulator.get_system()
    a, b = Simulator(diagram), Simulator(diagram)
    port = bench.sensor.GetOutputPort("sensor_wrench")
    for k in range(40):
        a.AdvanceTo((k + 0.5) * EXCHANGE)
        b.AdvanceTo((k + 15.5) * EXCHANGE)
        context = bench.sensor.GetMyContextFromRoot(a.get_context())
        np.testing.assert_array_equal(port.Eval(context).get_coeffs(), alone[k])


def state_size(sensor: WrenchSensor) -> int:
    return sum(part.size() for part in sensor.AllocateDiscreteVariables().get_data())


def test_an_ideal_sensor_keeps_no_drift_and_no_delay_line():
    plain = make_bench(WrenchSensorConfig(), nothing(2)).sensor
    late = make_bench(WrenchSensorConfig(delay=2.5 * EXCHANGE), nothing(2)).sensor
    walking = make_bench(WrenchSensorConfig(force_drift=0.1), nothing(2)).sensor
    size = state_size(plain)
    assert state_size(late) == size + 4 * 6
    assert state_size(walking) == size + 6


# Refusals ---------------------------------------------------------------------------------------


def test_an_coupling_step_between_plant_steps_is_refused():
    rig = make_rig()
    with pytest.raises(ConfigurationError, match=r"0.0025 s is not a whole number of plant steps"):
        WrenchSensor(rig.plant, rig.robot.sensor_weld, 2.5e-3, WrenchSensorConfig())


def test_a_plant_with_sampled_ports_is_refused():
    plant = MultibodyPlant(STEP)
    body = plant.AddRigidBody("tool", SpatialInertia.SolidSphereWithMass(1.0, 0.05))
    weld = plant.AddJoint(
        WeldJoint("weld", plant.world_frame(), body.body_frame(), RigidTransform())
    )
    plant.Finalize()
    with pytest.raises(ConfigurationError, match="sampled.*Set use_sampled_output_ports to false"):
        WrenchSensor(plant, weld, EXCHANGE, WrenchSensorConfig())


def test_negative_noise_is_refused():
    with pytest.raises(ConfigurationError, match=r"sensor.force_noise: -1 N is not within"):
        validate(WrenchSensorConfig(force_noise=-1.0), "sensor")


def test_a_sample_period_between_coupling_steps_is_refused():
    with pytest.raises(ConfigurationError, match=r"sensor.sample_period: 0.005 s .*Write 0.004"):
        make_bench(WrenchSensorConfig(sample_period=5e-3), nothing(2))
