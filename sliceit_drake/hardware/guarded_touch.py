"""Finds the board with the knife: slowly down until it meets a force, and back up.

The height of contact is where the force would be zero: a line through force and height on the way
down, and one on the way up. A delay between the two readings shifts them apart, so their mean is
free of it, and half their distance says how well it is known.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import TouchConfig
from sliceit_drake.hardware.rtde_link import LinkStatus, RobotLink
from sliceit_drake.interruption import raise_if_interrupted

__all__ = ["GuardedTouch", "Touch", "TouchError", "contact_of"]

ACCELERATION = 0.5
"""Acceleration of the knife, m/s2."""
BASELINE = 25
"""States before the motion whose mean force is zero."""
CONFIRMED = 3
"""States in a row over the threshold that make a contact: one may be noise."""
CLEAR = 1e-3
"""Distance from the board beyond which the knife goes faster, m."""
SETTLED = 0.1
"""Time at the start again, before it ends, s."""
NO_DATA = 1.0
"""How long the robot may be silent, s."""
MIN_SAMPLES = 3
PERIOD = 0.002
"""Period of an e-Series controller, s."""


class TouchError(RuntimeError):
    """The board was not found; the message says why."""


class Touch(NamedTuple):
    """Where the board was found.

    Attributes:
        height: Height of its surface under the edge's lowest point, in the world, m.
        uncertainty: Half width, m: the distance of a cycle, half the difference between down and
            up, and what the force's noise makes of the height.
        stiffness: Stiffness of board, knife and arm together, N/m.
        peak_force: Greatest force, N.
    """

    height: float
    uncertainty: float
    stiffness: float
    peak_force: float


class GuardedTouch:
    """Drives a touch over a link: `run` once.

    Args:
        link: A started link, not armed; its safety layer has the limits of the touch.
        path: Joint positions [6], rad, as a function of the distance below the start, m.
        depth: Greatest distance below the start, m.
        kinematics: Where the knife's edge is.
        config: Speeds and threshold.
        pace: Controller seconds in a second.
    """

    def __init__(
        self,
        link: RobotLink,
        path: Callable[[float], np.ndarray],
        depth: float,
        kinematics: EdgeKinematics,
        config: TouchConfig,
        pace: float = 1.0,
    ) -> None:
        self._link, self._path, self._depth = link, path, depth
        self._kinematics, self._config, self._pace = kinematics, config, pace
        self._way = self._speed = 0.0
        self._rows: list[tuple[float, float]] = []  # Height and force.

    def run(self) -> Touch:
        """Touches, goes back to where it began, and evaluates.

        Raises:
            TouchError: Nothing was touched, or the safety layer stopped the robot.
        """
        status, rows = self._link.latest(), []
        for _ in range(BASELINE):
            status = self._next(status)
            rows.append(status.state.wrench[:3])
        forces = np.array(rows)
        zero = forces.mean(axis=0)
        noise = float(np.std(np.linalg.norm(forces - zero, axis=1)))
        stop = self._link.arm()
        if stop is not None:
            raise TouchError(str(stop))
        status = self._link.latest()
        offset = np.array(status.state.q) - self._path(0.0)
        in_contact, ending = 0, math.inf
        is_up, left_at = False, None
        while status.state.time < ending:
            status = self._next(status)
            state = status.state
            force = float(np.linalg.norm(np.array(state.wrench[:3]) - zero))
            heel, tip, _ = self._kinematics.edge(state.q)
            self._rows.append((min(heel[2], tip[2]), force))
            in_contact = in_contact + 1 if force > self._config.force else 0
            if not is_up and (in_contact >= CONFIRMED or self._way >= self._depth):
                is_up = True
            if is_up and left_at is None and force < 0.25 * self._config.force:
                left_at = self._way
            is_clear = left_at is not None and self._way < left_at - CLEAR
            self._move(is_up, is_clear, status.period)
            if is_up and self._way <= 0.0 and ending == math.inf:
                ending = state.time + SETTLED
            self._link.put((self._path(self._way) + offset).tolist(), state.time)
        return contact_of(np.array(self._rows), noise, self._config)

    def _move(self, is_up: bool, is_clear: bool, dt: float) -> None:
        """Advances distance and speed by a time step, s."""
        config = self._config
        wanted = config.speed
        if is_up:
            fastest = config.retract_speed if is_clear else config.speed
            # Slow enough to end where the touch began.
            wanted = -min(fastest, math.sqrt(2.0 * ACCELERATION * max(0.0, self._way)))
        change = ACCELERATION * dt
        self._speed = min(max(wanted, self._speed - change), self._speed + change)
        self._way = self._way + dt * self._speed
        if is_up and self._way < 1e-6:
            self._way, self._speed = 0.0, 0.0

    def _next(self, status: LinkStatus) -> LinkStatus:
        """The next state of the robot."""
        while True:
            raise_if_interrupted()
            newer = self._link.wait(status, NO_DATA / self._pace)
            if newer is None:
                raise TouchError("no data from the robot")
            if newer.stop is not None:
                raise TouchError(str(newer.stop))
            if newer.state is not status.state:
                return newer
            status = newer


def contact_of(rows: np.ndarray, noise: float, config: TouchConfig) -> Touch:
    """Evaluates a touch.

    Args:
        rows: Height of the edge's lowest point, m, and force, N [n, 2], in the order of time.
        noise: Standard deviation of the force, N.
        config: Speed and threshold.

    Raises:
        TouchError: There was no contact, or it was too short to tell.
    """
    height, force = rows.T
    peak = float(force.max())
    if peak <= config.force:
        raise TouchError(
            f"nothing was touched down to {height.min():.4f} m: the greatest force was "
            f"{peak:.2f} N, the threshold is {config.force:g} N"
        )
    at_peak = int(force.argmax())
    low, high = max(0.2 * config.force, 3.0 * noise), max(config.force, 0.7 * peak)
    if low >= high:
        raise TouchError(
            f"the force scatters by {noise:.2g} N, too much to tell a contact of {peak:.2g} N: "
            "find what shakes, or give touch.force a greater value"
        )
    heights, compliances = [], []
    for way in (slice(at_peak, None, -1), slice(at_peak, None)):
        z, f = _one_contact(height[way], force[way], low, high)
        if len(f) < MIN_SAMPLES or np.ptp(f) < 0.2 * config.force:
            raise TouchError(
                f"the contact was too short to tell the height ({len(f)} readings over {low:.2g} "
                "N): give touch.speed a lower value"
            )
        slope, intercept = np.polyfit(f, z, 1)
        heights.append(intercept)
        compliances.append(max(0.0, -slope))
    compliance = float(np.mean(compliances))
    cycle = config.speed * PERIOD
    uncertainty = cycle + 0.5 * abs(heights[0] - heights[1]) + noise * compliance
    stiffness = 1.0 / compliance if compliance > 0.0 else math.inf
    return Touch(float(np.mean(heights)), float(uncertainty), stiffness, peak)


def _one_contact(
    height: np.ndarray, force: np.ndarray, low: float, high: float
) -> tuple[np.ndarray, np.ndarray]:
    """Readings from the peak of the force to the end of the contact, between two forces.

    Beside the peak the knife turns round, and a delay of the force would bend the line.
    """
    left = np.flatnonzero(force <= low)
    end = int(left[0]) if len(left) else len(force)
    begin = int(np.flatnonzero(force[:end] > high)[-1]) + 1
    return height[begin:end], force[begin:end]
