"""Recognises a contact that compliance control, or its coupling to the food, makes oscillate."""

import dataclasses as dc

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus

from sliceit_drake.configuration import quantity
from sliceit_drake.systems.declare import PlainSystem, declare_output
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig

__all__ = ["UNSTABLE_GAINS", "ContactMonitor", "ContactMonitorConfig"]

UNSTABLE_GAINS = "unstable gains"
"""First words of the message of a run that the monitor ended."""

_AXES = 6
# Parts of the state; the first six are vectors of six, moment first.
_PARTS = ("direction", "reach", "turning_value", "turning_time", "count", "record")
_ALARM = _AXES * len(_PARTS)
_STATE_SIZE = _ALARM + 1

# A swing of at least this fraction of the greatest before it, which itself is forgotten by this
# factor a swing, does not die out: oscillations with a damping ratio above about 1 % do.
_LASTING = 0.9
_FORGETTING = 0.97
# Swings that suffice if the last is above the force limit: an impact has one or two.
_FEW = 3
# The readings of a minute of normal noise span less than this many standard deviations.
_NOISE_SWING = 9.0


@dc.dataclass
class ContactMonitorConfig:
    """When a contact counts as unstable.

    A swing is what lies between a maximum and the next minimum of a component of the sensor's
    wrench. Swings below `force_swing` and `moment_swing` do no harm and are not counted, nor are
    such as the sensor's noise alone makes.
    """

    enabled: bool = True
    """Whether an unstable contact ends the run."""
    force_swing: float = quantity(5.0, "N", low=0.01, high=1e3)
    """Least swing that counts."""
    moment_swing: float = quantity(1.0, "Nm", low=0.01, high=1e3)
    """Least swing that counts."""
    swings: int = quantity(8, "", low=4, high=1000)
    """Swings in a row that make an alarm."""
    longest_swing: float = quantity(0.1, "s", low=0.01, high=1.0)
    """Slower swings end the row: 0.1 s is 5 Hz."""
    force_limit: float = quantity(150.0, "N", low=1.0, high=1e5)
    """A swing above it makes an alarm with two others before it; UR arms let a user limit the force
    to about 100 to 250 N."""


class ContactMonitor(PlainSystem):
    """Ends a simulation whose contact force oscillates without dying out.

    A stable contact answers a disturbance, such as the knife's arrival on the board, with swings
    that become smaller. Too stiff a contact for the gains, the servo's lag and the coupling step
    makes them grow until torque limits or lost contact bound them. The monitor follows each
    component of the wrench from one turning point to the next; a reversal by less than the least
    swing is no turning point, so noise and the ripple of cutting do not count. The alarm is raised
    by

    - `swings` in a row, none longer than `longest_swing`, the last of which is not smaller than
      those before it, or
    - three such swings of a force, the last above `force_limit`.

    The update that raises the alarm and each one after it return ``ReachedTermination`` with a
    message that begins with `UNSTABLE_GAINS`, which `Simulator.AdvanceTo` reports in its status
    (a Gymnasium environment sees a terminated episode, not an error). A policy that itself shakes
    the target at more than 5 Hz in contact is not told from an unstable loop.

    Input ports:
        sensor_wrench_vector: The sensor's moment and force [6].

    Output ports:
        unstable_gains: 1 after the alarm, else 0 [1].

    Args:
        config: Thresholds.
        period: Time between the wrench's readings, s.
        sensor: What measures the wrench; swings that its noise alone makes do not count.
    """

    def __init__(
        self, config: ContactMonitorConfig, period: float, sensor: WrenchSensorConfig
    ) -> None:
        super().__init__()
        self._config = config
        least = [
            max(config.moment_swing, _NOISE_SWING * sensor.moment_noise),
            max(config.force_swing, _NOISE_SWING * sensor.force_noise),
        ]
        self._scale = (1.0 / np.repeat(least, 3)).tolist()
        self._wrench = self.DeclareVectorInputPort("sensor_wrench_vector", _AXES)
        initial = np.zeros(_STATE_SIZE)
        initial[:_AXES] = 1.0
        self._state = self.DeclareDiscreteState(initial)
        declare_output(
            self, "unstable_gains", 1, self._alarm, {self.discrete_state_ticket(self._state)}
        )
        if config.enabled:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus | None:
        x = discrete_state.get_mutable_value()
        if not x[_ALARM]:
            # Upwards and downwards alike: how far each signal is, and has been, in its direction.
            # Plain numbers: of so few, an operation on arrays costs more than all of them.
            directions, reaches = x[:_AXES].tolist(), x[_AXES : 2 * _AXES].tolist()
            wrench = self._wrench.Eval(context).tolist()
            for axis, component in enumerate(wrench):
                s = component * self._scale[axis] * directions[axis]
                if s > reaches[axis]:
                    x[_AXES + axis] = s
                elif reaches[axis] - s > 1.0:
                    self._turn(x, axis, s, context.get_time())
        if x[_ALARM]:
            return EventStatus.ReachedTermination(self, self._message(x))
        return None

    def _turn(self, x: np.ndarray, axis: int, value: float, time: float) -> None:
        """Takes the reach of a component as a turning point; `value` is in its old direction."""
        config = self._config
        parts = x[:_ALARM].reshape(len(_PARTS), _AXES)[:, axis]
        direction, reach, turning_value, turning_time, count, record = parts
        extreme = direction * reach
        swing = abs(extreme - turning_value)
        if time - turning_time > config.longest_swing:
            count, record = 0.0, 0.0
        count += 1.0
        lasts = swing >= _LASTING * record
        is_great = axis >= 3 and swing > config.force_limit * self._scale[axis]
        if lasts and count >= (_FEW if is_great else config.swings):
            x[_ALARM] = time
        parts[:] = -direction, -value, extreme, time, count, max(swing, _FORGETTING * record)

    def _message(self, x: np.ndarray) -> str:
        parts = x[:_ALARM].reshape(len(_PARTS), _AXES)
        axis = int((parts[5] * (parts[4] >= _FEW)).argmax())
        swing = parts[5, axis] / self._scale[axis]
        name = ("moment", "force")[axis // 3] + " " + "xyz"[axis % 3]
        return (
            f"{UNSTABLE_GAINS} at t = {x[_ALARM]:.4g} s: {name} of the sensor swings by "
            f"{swing:.3g} {('Nm', 'N')[axis // 3]} and does not die out ({parts[4, axis]:.0f} "
            "swings). Lower controller.error_scale or its gains, or soften the contact."
        )

    def _alarm(self, context: Context) -> list[float]:
        return [float(context.get_discrete_state(self._state).value()[_ALARM] > 0.0)]
