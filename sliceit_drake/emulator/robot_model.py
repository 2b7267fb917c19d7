"""The arm behind the emulated controller: its interface, and an arm without dynamics."""

import dataclasses as dc
import functools
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.systems.servo import JOINTS, ServoConfig, ServoLaw

if TYPE_CHECKING:
    from sliceit_drake.diagrams.scenario import Scenario

__all__ = ["CYCLE", "START", "ArmState", "KinematicRobot", "RobotModel", "SimulationStopped"]

CYCLE = 0.002
"""Controller time of one cycle of an e-Series controller, s."""

START = (1.3524, -1.5555, 1.7697, -1.7785, -1.5644, 1.3493)
"""Joints at the start of SliceIt!, rad."""


class SimulationStopped(RuntimeError):
    """The model cannot go on; its state stays as it is."""


@dc.dataclass
class ArmState:
    """An arm at the end of a cycle.

    Attributes:
        positions: Measured joint positions [6], rad.
        velocities: Measured joint velocities [6], rad/s.
        wrench: What the sensor at the flange feels [6]: force, N, and moment about the flange, Nm,
            of all beyond it on the arm, in the flange's axes.
        torques: Torques of the joints [6], Nm.
        zero: What the sensor has subtracted from `wrench` [6], the same way.
    """

    positions: np.ndarray
    velocities: np.ndarray
    wrench: np.ndarray
    torques: np.ndarray
    zero: np.ndarray = dc.field(default_factory=lambda: np.zeros(6))


class RobotModel(Protocol):
    """An arm that follows joint targets, one cycle at a time.

    Attributes:
        state: State at the end of the last cycle.
        gravity: Acceleration of gravity in the robot's base [3], m/s2.
        warnings: What the model could not do as asked, in words; the controller tells its clients.
    """

    state: ArmState
    gravity: np.ndarray
    warnings: list[str]

    def step(self, targets: ArrayLike, servo: ServoConfig | None) -> ArmState:
        """Advances one cycle; returns the state afterwards.

        Args:
            targets: Joint positions [6], rad.
            servo: Parameters of the ``servoj`` that gave them; None if they are points of a motion
                that the controller itself has planned.

        Raises:
            SimulationStopped: There is no state afterwards.
        """

    def zero_sensor(self) -> None:
        """Subtracts what the sensor feels now from all that follows."""

    def put_fresh_food(self, scenario: "Scenario | None" = None) -> None:
        """Puts an uncut food in the place of the one that is there; the arm stays as it is.

        Food, numerics and placement on the board are those of a scenario, or the same again.

        Raises:
            ConfigurationError, MeshError, TimeStepError: It cannot be put there.
        """


class KinematicRobot:
    """An arm without mass: planned motions are followed exactly, ``servoj`` with its lag.

    It begins at rest at `START`. The sensor feels nothing.
    """

    def __init__(self) -> None:
        none = np.zeros(JOINTS)
        self.state = ArmState(np.array(START), none, np.zeros(6), none)
        self.gravity = np.array([0.0, 0.0, -9.81])
        self.warnings: list[str] = []

    def step(self, targets: ArrayLike, servo: ServoConfig | None) -> ArmState:
        q, v = self.state.positions, self.state.velocities
        if servo is None:
            target = np.array(targets, float)
            q, v = target, (target - q) / CYCLE
        else:
            q, v = _servo_law(servo.lookahead_time, servo.gain).step(np.vstack([q, v]), targets)
        self.state = dc.replace(self.state, positions=q, velocities=v)
        return self.state

    def zero_sensor(self) -> None:
        pass

    def put_fresh_food(self, scenario: "Scenario | None" = None) -> None:
        raise ConfigurationError(
            "there is none under an arm alone",
            field="fresh_food",
            fix="Start the emulator with a scenario.",
        )


@functools.lru_cache(maxsize=32)
def _servo_law(lookahead_time: float, gain: float) -> ServoLaw:
    return ServoLaw(ServoConfig(lookahead_time=lookahead_time, gain=gain), CYCLE)
