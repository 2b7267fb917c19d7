"""The force/torque sensor between the robot's flange and its tool."""

import dataclasses as dc
import functools
import math
from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import WeldJoint
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
)

from sliceit_drake.configuration import ConfigurationError, quantity

__all__ = ["WrenchSensor", "WrenchSensorConfig"]

# Parts of the state, one vector so that an update fetches it once.
_SUM = slice(0, 6)  # Sum of the plant's reactions since the last exchange.
_COUNT = 6  # How many are in the sum.
_READING = slice(7, 13)
_FILTERED = slice(13, 19)  # Wrench behind the low-pass filter.
_ZERO = slice(19, 25)  # What is subtracted: the tare less the bias.
_READINGS = 25  # How many there have been.
_STATE_SIZE = 26

_NOISE_BLOCK = 1024  # Readings whose noise is drawn at once.


@dc.dataclass
class WrenchSensorConfig:
    """What the sensor adds to the true wrench. The defaults are an ideal sensor.

    Attributes:
        tare_at_start: Whether the first reading is subtracted from all, as zeroing a UR's sensor
            does.
    """

    tare_at_start: bool = True
    force_bias: list[float] = quantity(
        [0.0, 0.0, 0.0], "N", low=-100.0, high=100.0, size=3, doc="Zero error left after taring."
    )
    moment_bias: list[float] = quantity(
        [0.0, 0.0, 0.0], "Nm", low=-10.0, high=10.0, size=3, doc="Zero error left after taring."
    )
    force_noise: float = quantity(
        0.0, "N", low=0.0, high=100.0, doc="Standard deviation of a reading's force, each axis."
    )
    moment_noise: float = quantity(
        0.0, "Nm", low=0.0, high=10.0, doc="Standard deviation of a reading's moment, each axis."
    )
    cutoff_frequency: float = quantity(
        0.0, "Hz", low=0.0, high=1e4, doc="First-order low-pass filter; 0 for none."
    )
    seed: int = quantity(0, "", low=0, high=2**31 - 1, doc="Seed of the noise.")


class WrenchSensor(LeafSystem):
    """Measures the wrench that the environment exerts on the robot beyond the sensor.

    The plant reports the reaction F_C_Jc of the weld: the force of the arm *on the tool* C, at the
    origin of the weld's frame Jc on the tool, in Jc. The tool obeys ``F_environment + F_gravity +
    F_reaction = M A``, so ``-F_reaction = F_environment + F_gravity - M A``: the sensor shows the
    environment's force, the tool's weight and its inertia, as a real one does. It is moved to the
    sensor's frame S (the weld's frame on the arm). With `tare_at_start` the first reading is
    subtracted from all; what appears of the weight when the tool is then tilted is not compensated.

    A reading is the mean over the exchange before it, the plant's impulse divided by the period.
    It is then filtered, tared, and given bias and noise, and held until the next exchange. It is
    zero until the end of the first exchange. Like the plant's own state at the end of a step, it is
    set by the discrete update at the beginning of the exchange's last plant step: whatever reads
    it at the exchange, in an unrestricted or a discrete update, finds it.

    Inputs:
        reaction_forces: The plant's port of that name.

    Outputs:
        sensor_wrench: SpatialForce at So, in S; held over each exchange. No direct feedthrough.

    Parameters:
        0: Seed of the noise [1].
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        weld: WeldJoint,
        exchange_period: float,
        config: WrenchSensorConfig,
    ) -> None:
        """Declares a sensor at a weld of a plant.

        Args:
            plant: Finalized discrete plant, whose reaction forces will be connected.
            weld: Joint between the arm (parent) and the tool (child).
            exchange_period: Period of the readings, seconds; a multiple of the plant's time step.
            config: The sensor's imperfections.

        Raises:
            ConfigurationError: If the periods do not fit, or the plant's ports are sampled.
        """
        super().__init__()
        step = plant.time_step()
        steps = round(exchange_period / step) if step > 0.0 else 0
        if steps < 1 or abs(steps * step - exchange_period) > 1e-9:
            raise ConfigurationError(
                f"exchange period {exchange_period:.6g} s is not a whole number of plant steps of "
                f"{step:.6g} s",
                fix="Change one of the two.",
            )
        if plant.has_sampled_output_ports():
            raise ConfigurationError(
                "the plant's output ports are sampled: their reaction forces are a step old",
                fix="Set use_sampled_output_ports to false, as diagrams.robot.add_plant does.",
            )
        self._index = int(weld.index())
        self._steps = steps
        # From the sum of reactions on the tool, at Jc in Jc, to the mean on the arm, at So in S.
        self._on_arm = _shift_matrix(weld.X_FM()) / -steps
        self._bias = np.concatenate([config.moment_bias, config.force_bias])
        self._noise = np.repeat([config.moment_noise, config.force_noise], 3)
        self._is_noisy = bool(self._noise.any())
        self._tare_at_start = config.tare_at_start
        turn = 2.0 * math.pi * config.cutoff_frequency * exchange_period
        self._filter_share = -math.expm1(-turn) if turn > 0.0 else 1.0

        self._reactions = self.DeclareAbstractInputPort(
            "reaction_forces", Value[list[SpatialForce]]()
        ).get_index()
        self._seed = self.DeclareNumericParameter(BasicVector([float(config.seed)]))
        state = self.DeclareDiscreteState(np.zeros(_STATE_SIZE))
        self.DeclareAbstractOutputPort(
            "sensor_wrench",
            lambda: Value(SpatialForce.Zero()),
            self._calc_sensor_wrench,
            {self.xd_ticket()},
        )
        self.DeclareStateOutputPort("state", state)
        self.DeclarePeriodicDiscreteUpdateEvent(step, 0.0, self._update)

    @staticmethod
    def state_columns(reading: Sequence[str]) -> list[str]:
        """Names for the port `state`: `reading` [6] for the moment and force, others private."""
        names = [f"_sensor_{k}" for k in range(_STATE_SIZE)]
        names[_READING] = reading
        return names

    def randomize_context(self, context: Context, rng: np.random.Generator) -> None:
        """Draws a new seed of the noise."""
        context.get_mutable_numeric_parameter(self._seed).SetAtIndex(0, rng.integers(2**31))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        # The whole list crosses into Python for the one wrench wanted; no port gives less.
        reactions = self.EvalAbstractInput(context, self._reactions).get_value()
        x = discrete_state.get_mutable_value()
        total = x[_SUM]
        total += reactions[self._index].get_coeffs()
        x[_COUNT] += 1.0
        if x[_COUNT] == self._steps:
            self._read(context, x)

    def _read(self, context: Context, x: np.ndarray) -> None:
        wrench = self._on_arm.dot(x[_SUM])
        x[: _COUNT + 1] = 0.0
        x[_READINGS] += 1.0
        if x[_READINGS] == 1.0:
            x[_FILTERED] = wrench
            x[_ZERO] = wrench * self._tare_at_start - self._bias
        elif self._filter_share < 1.0:
            wrench = x[_FILTERED] + self._filter_share * (wrench - x[_FILTERED])
            x[_FILTERED] = wrench
        x[_READING] = wrench - x[_ZERO]
        if self._is_noisy:
            seed = int(context.get_numeric_parameter(self._seed)[0])
            block, row = divmod(int(x[_READINGS]), _NOISE_BLOCK)
            x[_READING] += self._noise * _standard_noise(seed, block)[row]

    def _calc_sensor_wrench(self, context: Context, output: AbstractValue) -> None:
        reading = context.get_discrete_state_vector().value()[_READING]
        output.set_value(SpatialForce(reading[:3], reading[3:]))


@functools.lru_cache(maxsize=16)
def _standard_noise(seed: int, block: int) -> np.ndarray:
    """Standard normal numbers [_NOISE_BLOCK, 6] that follow from seed and block alone.

    A counter-based generator needs no state in the Context; making one is slow, hence blocks.
    """
    generator = np.random.Generator(np.random.Philox(key=seed, counter=[0, block, 0, 0]))
    return generator.standard_normal((_NOISE_BLOCK, 6))


def _shift_matrix(X_SJ: RigidTransform) -> np.ndarray:
    """Matrix [6, 6] that turns a wrench at Jo in J into the same at So in S, moment first."""
    R, p = X_SJ.rotation().matrix(), X_SJ.translation()
    cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    return np.block([[R, cross @ R], [np.zeros((3, 3)), R]])
