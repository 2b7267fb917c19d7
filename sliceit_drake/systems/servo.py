"""How a UR controller's ``servoj`` turns streamed joint targets into a motion of the arm."""

import dataclasses as dc

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, LinearSystem
from scipy.linalg import expm

from sliceit_drake.configuration import ConfigurationError, quantity

__all__ = ["JOINTS", "Servo", "ServoConfig", "ServoLaw"]

JOINTS = 6


@dc.dataclass
class ServoConfig:
    """Parameters of ``servoj``: `lookahead_time` and `gain` have its names, ranges 0.03 to 0.2 s
    and 100 to 2000. Values outside are allowed here, for studies.

    The defaults are the fastest tracking that the real command allows, and those of Universal
    Robots' own client library (`UrDriver`).
    """

    lookahead_time: float = quantity(0.03, "s", low=1e-3, high=1.0)
    """How far ahead the arm's own motion is projected."""
    gain: float = quantity(2000.0, "1/s2", low=1.0, high=4e6)
    """Acceleration per unit of the projected error."""
    delay: float = quantity(0.0, "s", low=0.0, high=0.1)
    """Transport delay of the targets before the servo."""

    @property
    def lag(self) -> float:
        """Time by which the arm trails a target that moves at constant speed, seconds."""
        return self.lookahead_time + self.delay


class ServoLaw:
    """The law of ``servoj``, integrated over periods in which the targets are held. No Drake in it.

    The state [2 + n, J] of J joints is their positions, their velocities, and the targets of the
    last n periods, the oldest first, which are still on their way.

    It is integrated exactly.

    Args:
        config: Its parameters.
        period: Time between states, seconds: a plant's time step, or a controller's cycle.

    Attributes:
        A: Matrix [2 + n, 2 + n] from the state to the next, the same for each joint.
        B: Matrix [2 + n, 1] from the targets to the next state.

    Raises:
        ConfigurationError: If the delay is not a whole number of periods.
    """

    def __init__(self, config: ServoConfig, period: float) -> None:
        n = round(config.delay / period)
        if abs(n * period - config.delay) > 1e-6 * period:
            raise ConfigurationError(
                f"{config.delay:.6g} s is not a whole number of plant steps of {period:.6g} s",
                field="servo.delay",
                fix=f"Write {n * period:.6g}.",
            )
        g, t = config.gain, config.lookahead_time
        step = expm(period * np.array([[0.0, 1.0, 0.0], [-g, -g * t, g], [0.0, 0.0, 0.0]]))
        motion, push = step[:2, :2], step[:2, 2:]
        self.A = np.zeros((2 + n, 2 + n))
        self.B = np.zeros((2 + n, 1))
        self.A[:2, :2] = motion
        if n == 0:
            self.B[:2] = push
        else:
            self.A[:2, 2:3] = push
            self.A[2:-1, 3:] = np.eye(n - 1)
            self.B[-1] = 1.0

    def state_at_rest(self, positions: ArrayLike) -> np.ndarray:
        """State [2 + n, J] of joints at rest at `positions` [J], rad, their targets there too."""
        q = np.asarray(positions, float)
        return np.vstack([q, np.zeros_like(q), np.tile(q, (len(self.A) - 2, 1))])

    def step(self, state: np.ndarray, targets: ArrayLike) -> np.ndarray:
        """State [2 + n, J] a period later, with `targets` [J], rad, held meanwhile."""
        return self.A @ state + self.B * np.asarray(targets, float)


class Servo(Diagram):
    """Second-order tracking of the joint targets, each joint alone.

    Universal Robots describe ``servoj`` in words: the gain acts as the P term of a PID controller
    on the error of the current position, which the lookahead time projects forward with the current
    velocity; a short lookahead time makes it fast, a long one prevents overshoot
    (universal-robots.com, "ServoJ command"). The simplest law that says this is::

        a = gain (q_command - (q + lookahead_time v))

    It trails a ramp by `lookahead_time` whatever the gain, and its damping ratio is
    ``lookahead_time sqrt(gain) / 2``. This agrees with what users measure: with 0.03 s and gain
    1200 a UR10e trails by 34 ms at 500 Hz, of which 4 to 6 ms are the way to the controller and
    back (UniversalRobots/Universal_Robots_Client_Library issue 86); with the ROS 2 driver a UR5
    trails by 35 ms (Universal_Robots_ROS2_Driver issue 1311). The law itself, and that the gain is
    in 1/s2, are our reading; Universal Robots publish no equation.

    The law (`ServoLaw`) is integrated exactly between the plant's steps. The motion it asks for
    carries its velocity and acceleration, so that the arm's own controller adds no lag to it, as
    on a real UR. Measured here (tests; docs/explanation/servo.md has a table): lag behind a ramp
    `ServoConfig.lag` within a plant step; a step at the defaults overshoots by 5.8 % and stays
    within 2 % after 0.14 s. Speed and acceleration are not limited.

    Inputs:
        joint_positions_command: Targets [6], rad; held between the controller's cycles.

    Outputs:
        desired_state: Positions and velocities asked of the arm [12], rad and rad/s.
        desired_acceleration: Mean acceleration until the next step [6], rad/s2; depends directly on
            the targets.

    Args:
        config, period: As for `ServoLaw`; the period is the plant's time step, seconds.
        initial_positions: Where targets and motion rest in the default context [6], rad.

    Raises:
        ConfigurationError: If the delay is not a whole number of periods.
    """

    def __init__(self, config: ServoConfig, period: float, initial_positions: ArrayLike) -> None:
        super().__init__()
        self._law = ServoLaw(config, period)
        # Each joint alone; Drake's state is the law's, row by row.
        A, B = np.kron(self._law.A, np.eye(JOINTS)), np.kron(self._law.B, np.eye(JOINTS))
        velocity = np.kron(np.eye(2, A.shape[0] // JOINTS)[1:], np.eye(JOINTS))
        C = np.vstack([np.eye(2 * JOINTS, A.shape[0]), velocity @ (A - np.eye(len(A))) / period])
        D = np.vstack([np.zeros((2 * JOINTS, JOINTS)), velocity @ B / period])
        builder = DiagramBuilder()
        self._tracking = builder.AddNamedSystem("tracking", LinearSystem(A, B, C, D, period))
        self._tracking.configure_default_state(self._law.state_at_rest(initial_positions).ravel())
        outputs = builder.AddNamedSystem("outputs", Demultiplexer([2 * JOINTS, JOINTS]))
        builder.Connect(self._tracking.get_output_port(), outputs.get_input_port())
        builder.ExportInput(self._tracking.get_input_port(), "joint_positions_command")
        builder.ExportOutput(outputs.get_output_port(0), "desired_state")
        builder.ExportOutput(outputs.get_output_port(1), "desired_acceleration")
        builder.BuildInto(self)

    def set_positions(self, context: Context, positions: ArrayLike) -> None:
        """Sets targets and motion at rest at `positions` [6], rad, in the root context."""
        state = self._tracking.GetMyMutableContextFromRoot(context)
        state.SetDiscreteState(self._law.state_at_rest(positions).ravel())
