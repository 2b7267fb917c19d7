"""The force/torque sensor between the robot's flange and its tool."""

import dataclasses as dc
import functools
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import WeldJoint
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.bench_errors import SensorErrors, filter_share
from sliceit_drake.systems.declare import PlainSystem, declare_output

__all__ = ["WrenchSensor", "WrenchSensorConfig", "wrench_shift"]

# Parts of the state beside the reading, one vector so that an update fetches it once.
_SUM = slice(0, 6)  # Sum of the plant's reactions since the last coupling step.
_COUNT = 6  # How many are in the sum.
_FILTERED = slice(7, 13)  # Wrench behind the low-pass filter.
_ZERO = slice(13, 19)  # What is subtracted: the tare less the bias.
_READINGS = 19  # How many there have been.
_STATE_SIZE = 20  # Without drift (6 more) and delay (6 more for each reading on its way).

_NOISE_BLOCK = 1024  # Readings whose noise is drawn at once.
_READOUT, _WALK = 0, 1  # Independent streams of random numbers.


@dc.dataclass
class WrenchSensorConfig:
    """Imperfections that the sensor adds to the true wrench. The defaults are an ideal sensor.

    What makers publish gives sizes, not spectra, so there are no named sensors here:

    * UR5e, built in (Universal Robots' technical specifications): range 50 N and 10 Nm, precision
      3.5 N and 0.2 Nm, accuracy 4.0 N and 0.3 Nm, at the 500 Hz of its controller. Precision and
      accuracy are not defined further; an accuracy is a bound of bias and drift together.
    * Robotiq FT 300-S (roboticscenter.ai, "Force/Torque Sensor Selection Guide"): 300 N, resolution
      0.1 N, 100 readings a second, hence `sample_period` 0.01.
    * UR5 without a sensor of its own, from the joints' currents (forum.universal-robots.com, topic
      229): +-10 N and 5 Nm; ten weighings of one mass spread by 3.6 N, an FT 300's by 0.6 N.

    None of them states a noise density or a drift with time. Both are quickly measured on the tool
    at rest: the standard deviation of the readings is `force_noise`; with D(t) the differences of
    readings t seconds apart, averaged so that the noise is small, `force_drift` is std(D) / sqrt(t)
    and `force_drift_rate` mean(D) / t.

    Attributes:
        tare_at_start: Whether the first reading is subtracted from all, as zeroing a UR's sensor
            does.
    """

    tare_at_start: bool = True
    force_bias: list[float] = quantity([0.0, 0.0, 0.0], "N", low=-100.0, high=100.0, size=3)
    """Zero error left after taring."""
    moment_bias: list[float] = quantity([0.0, 0.0, 0.0], "Nm", low=-10.0, high=10.0, size=3)
    """Zero error left after taring."""
    force_noise: float = quantity(0.0, "N", low=0.0, high=100.0)
    """Standard deviation of a reading's force, each axis."""
    moment_noise: float = quantity(0.0, "Nm", low=0.0, high=10.0)
    """Standard deviation of a reading's moment, each axis."""
    cutoff_frequency: float = quantity(0.0, "Hz", low=0.0, high=1e4)
    """First-order low-pass filter; 0 for none."""
    force_drift: float = quantity(0.0, "N/s^0.5", low=0.0, high=10.0)
    """Random walk since taring: its spread after 1 s."""
    moment_drift: float = quantity(0.0, "Nm/s^0.5", low=0.0, high=1.0)
    """Random walk since taring: its spread after 1 s."""
    force_drift_rate: list[float] = quantity([0.0, 0.0, 0.0], "N/s", low=-1.0, high=1.0, size=3)
    """Steady drift since taring."""
    moment_drift_rate: list[float] = quantity([0.0, 0.0, 0.0], "Nm/s", low=-0.1, high=0.1, size=3)
    """Steady drift since taring."""
    force_resolution: float = quantity(0.0, "N", low=0.0, high=10.0)
    """Step of the shown forces; 0 for none."""
    moment_resolution: float = quantity(0.0, "Nm", low=0.0, high=1.0)
    """Step of the shown moments; 0 for none."""
    sample_period: float = quantity(0.0, "s", low=0.0, high=1.0)
    """Time between new readings; 0 for the coupling period."""
    delay: float = quantity(0.0, "s", low=0.0, high=0.2)
    """Time a reading takes to arrive; parts are interpolated."""
    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of noise and random walk."""


class WrenchSensor(PlainSystem):
    """Measures the wrench that the environment exerts on the robot beyond the sensor.

    The plant reports the reaction F_C_Jc of the weld: the force of the arm *on the tool* C, at the
    origin of the weld's frame Jc on the tool, in Jc. The tool obeys ``F_environment + F_gravity +
    F_reaction = M A``, so ``-F_reaction = F_environment + F_gravity - M A``: the sensor shows the
    environment's force, the tool's weight and its inertia, as a real one does. It is moved to the
    sensor's frame S (the weld's frame on the arm). With `tare_at_start` the first reading is
    subtracted from all; what appears of the weight when the tool is then tilted is not compensated.

    A reading is the mean over the coupling step before it, the plant's impulse divided by the
    period. It is then filtered, tared, given bias, drift and noise, rounded, sampled and delayed,
    in this order, and held until the next coupling step. It is zero until the end of the first
    coupling step; filter and delay start as if the first wrench had always been there. Noise of
    standard deviation sigma at the period h has the one-sided density 2 sigma^2 h up to 1/(2 h); it
    is not filtered, and stands for what is left behind the filter. A random walk of spread s has
    the density s^2 / (2 pi^2 f^2) far below 1/h. Like the plant's own state at the end of a step,
    it is set by the discrete update at the beginning of the coupling step's last plant step:
    whatever reads it at the coupling step, in an unrestricted or a discrete update, finds it.

    What `errors` say acts on the wrench before it is filtered and tared; bias and drift are added
    after taring.

    Inputs:
        reaction_forces: The plant's port of that name.

    Outputs:
        sensor_wrench: SpatialForce at So, in S; held over each coupling step. No direct
            feedthrough.
        sensor_wrench_vector: The same as moment and force [6].

    Parameters:
        0: Seed of noise and random walk [1].

    Args:
        plant: Finalized discrete plant, whose reaction forces will be connected.
        weld: Joint between the arm (parent) and the tool (child).
        exchange_period: Period of the readings, seconds; a multiple of the plant's time step.
        config: The sensor's imperfections.
        errors: What it shows otherwise, in the knife's axes about Ko.
        X_SK: Pose of the knife in the sensor's frame.

    Raises:
        ConfigurationError: If the periods do not fit, or the plant's ports are sampled.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        weld: WeldJoint,
        exchange_period: float,
        config: WrenchSensorConfig,
        errors: SensorErrors | None = None,
        X_SK: RigidTransform | None = None,
    ) -> None:
        super().__init__()
        self._hold = max(1, round(config.sample_period / exchange_period))
        if config.sample_period > 0.0 and (
            abs(self._hold * exchange_period - config.sample_period) > 1e-9
        ):
            raise ConfigurationError(
                f"{config.sample_period:.6g} s is not a whole number of coupling step periods of "
                f"{exchange_period:.6g} s",
                field="sensor.sample_period",
                fix=f"Write {self._hold * exchange_period:.6g}.",
            )
        step = plant.time_step()
        steps = round(exchange_period / step) if step > 0.0 else 0
        if steps < 1 or abs(steps * step - exchange_period) > 1e-9:
            raise ConfigurationError(
                f"coupling period {exchange_period:.6g} s is not a whole number of plant steps of "
                f"{step:.6g} s",
                field="exchange_period and robot.plant_time_step",
                fix="Change one of the two.",
            )
        if plant.has_sampled_output_ports():
            raise ConfigurationError(
                "the plant's output ports are sampled: their reaction forces are a step old",
                fix="Set use_sampled_output_ports to false, as add_plant does "
                "(diagrams.plant.robot_plant).",
            )
        self._index = int(weld.index())
        self._steps = steps
        # From the sum of reactions on the tool, at Jc in Jc, to the mean on the arm, at So in S.
        self._on_arm = wrench_shift(weld.X_FM()) / -steps
        self._bias = np.concatenate([config.moment_bias, config.force_bias])
        self._noise = np.repeat([config.moment_noise, config.force_noise], 3)
        self._is_noisy = bool(self._noise.any())
        self._walk = np.repeat([config.moment_drift, config.force_drift], 3)
        self._walk *= math.sqrt(exchange_period)
        self._is_walking = bool(self._walk.any())
        rate = np.concatenate([config.moment_drift_rate, config.force_drift_rate])
        # Filters in a row, each of its state.
        self._late_share, stages = 1.0, 0
        if errors is not None and errors != SensorErrors():
            to_sensor = wrench_shift(X_SK or RigidTransform())
            turned = np.kron(np.eye(2), errors.matrix())
            self._on_arm = to_sensor @ turned @ np.linalg.inv(to_sensor) @ self._on_arm
            self._bias = self._bias + to_sensor[:, 3:] @ errors.force_bias
            rate = rate + to_sensor[:, 3:] @ errors.force_drift_rate
            self._late_share = filter_share(errors, exchange_period)
            stages = errors.delay_stages if errors.delay > 0.0 else 0
        self._drift_step = rate * exchange_period
        self._resolution = np.repeat([config.moment_resolution, config.force_resolution], 3)
        self._is_coarse = bool(self._resolution.any())
        # Behind the rest of the state, if they are wanted: the drift; the readings on their way,
        # the newest first.
        size = _STATE_SIZE
        self._drift = slice(size, size)
        if self._is_walking or rate.any():
            self._drift = slice(size, size + 6)
            size += 6
        # A part of a period too small to matter is rounding of the quotient.
        on_the_way = round(config.delay / exchange_period, 9)
        self._late_part = on_the_way % 1.0
        self._line = slice(size, size + 6 * (math.ceil(on_the_way) + 1) if on_the_way else size)
        self._late = slice(self._line.stop, self._line.stop + 6 * stages)
        self._size = self._late.stop
        self._is_imperfect = (
            self._is_noisy or self._is_coarse or self._hold > 1 or self._line.stop > _STATE_SIZE
        )
        self._tare_at_start = config.tare_at_start
        turn = 2.0 * math.pi * config.cutoff_frequency * exchange_period
        self._filter_share = -math.expm1(-turn) if turn > 0.0 else 1.0

        self._reactions = self.DeclareAbstractInputPort(
            "reaction_forces", Value[list[SpatialForce]]()
        )
        self._seed = self.DeclareNumericParameter(BasicVector([float(config.seed)]))
        reading = self.DeclareDiscreteState(6)
        # Plain numbers: Drake's indices would be made such in each call.
        self._reading, self._state = int(reading), int(self.DeclareDiscreteState(self._size))
        declare_output(
            self,
            "sensor_wrench",
            Value(SpatialForce.Zero()),
            lambda context: SpatialForce(context.get_discrete_state().value(self._reading)),
            {self.discrete_state_ticket(reading)},
        )
        self.DeclareStateOutputPort("sensor_wrench_vector", reading)
        self.DeclarePeriodicDiscreteUpdateEvent(step, 0.0, self._update)

    def randomize_context(self, context: Context, rng: np.random.Generator) -> None:
        """Draws a new seed of noise and random walk."""
        context.get_mutable_numeric_parameter(self._seed).SetAtIndex(0, rng.integers(2**31))

    def tare(self, context: Context) -> None:
        """Zeroes the sensor: what it senses now, drift included, is subtracted from now on.

        The bias stays, and readings on their way arrive as they are. Without effect on a sensor
        that has not read yet. The context is the sensor's own.
        """
        x = context.get_mutable_discrete_state().get_mutable_value(self._state)
        if x[_READINGS] > 0.0:
            x[_ZERO] = x[_FILTERED] - self._bias
            x[self._drift] = 0.0

    def zero(self, context: Context) -> np.ndarray:
        """What is subtracted from each reading: moment and force [6]; of its own context."""
        return context.get_discrete_state(self._state).value()[_ZERO]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        # The whole list crosses into Python for the one wrench wanted; no port gives less.
        reaction = self._reactions.Eval(context)[self._index].get_coeffs()
        x = discrete_state.get_mutable_value(self._state)
        count = x[_COUNT] + 1.0
        if count > 1.0:
            reaction = reaction + x[_SUM]
        if count < self._steps:
            x[_SUM], x[_COUNT] = reaction, count
            return
        x[_COUNT] = 0.0
        self._read(context, x, self._on_arm.dot(reaction), discrete_state)

    def _read(
        self, context: Context, x: np.ndarray, wrench: np.ndarray, discrete_state: DiscreteValues
    ) -> None:
        reading = discrete_state.get_mutable_value(self._reading)
        x[_READINGS] += 1.0
        is_first = x[_READINGS] == 1.0
        for start in range(self._late.start, self._late.stop, 6):
            late = x[start : start + 6]
            late += (1.0 if is_first else self._late_share) * (wrench - late)
            wrench = late
        if is_first:
            x[_ZERO] = wrench * self._tare_at_start - self._bias
        elif self._filter_share < 1.0:
            wrench = x[_FILTERED] + self._filter_share * (wrench - x[_FILTERED])
        x[_FILTERED] = wrench
        shown = wrench - x[_ZERO]
        if self._is_imperfect:
            shown = self._spoil(context, x, shown, reading)
        reading[:] = shown

    def _spoil(
        self, context: Context, x: np.ndarray, shown: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        """Adds drift and noise to the tared wrench [6], rounds, samples and delays it.

        `last` is the reading before.
        """
        readings = int(x[_READINGS])
        is_first = readings == 1
        seed = int(context.get_numeric_parameter(self._seed)[0])
        block, row = divmod(readings, _NOISE_BLOCK)
        drift = x[self._drift]
        if drift.size:
            if not is_first:
                drift += self._drift_step
                if self._is_walking:
                    drift += self._walk * _standard_noise(seed, block, _WALK)[row]
            shown = shown + drift
        if self._is_noisy:
            shown = shown + self._noise * _standard_noise(seed, block, _READOUT)[row]
        if self._is_coarse:
            step = self._resolution
            shown = np.where(step > 0.0, np.rint(shown / np.where(step, step, 1.0)) * step, shown)
        line = x[self._line]
        if (readings - 1) % self._hold:
            shown = (line[:6] if line.size else last).copy()
        if line.size:
            line[6:] = line[:-6].copy()
            line[:6] = shown
            if is_first:
                line[:] = np.tile(shown, line.size // 6)
            if self._late_part:
                return line[-12:-6] + self._late_part * (line[-6:] - line[-12:-6])
            return line[-6:]
        return shown


@functools.lru_cache(maxsize=16)
def _standard_noise(seed: int, block: int, stream: int) -> np.ndarray:
    """Standard normal numbers [_NOISE_BLOCK, 6] that follow from the arguments alone.

    A counter-based generator needs no state in the Context; making one is slow, hence blocks.
    """
    generator = np.random.Generator(np.random.Philox(key=seed, counter=[0, block, stream, 0]))
    return generator.standard_normal((_NOISE_BLOCK, 6))


def wrench_shift(X_SJ: RigidTransform) -> np.ndarray:
    """Matrix [6, 6] that turns a wrench at Jo in J into the same at So in S, moment first."""
    R, p = X_SJ.rotation().matrix(), X_SJ.translation()
    cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    return np.block([[R, cross @ R], [np.zeros((3, 3)), R]])
