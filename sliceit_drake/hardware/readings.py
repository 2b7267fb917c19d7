"""Whether a robot's readings can be true: against those before, each other, and what was sent.

Plain Python, no clock but the controller's. A reading that cannot be true is a fault of
measurement: what the limits of force, depth and speed are held against is then not known.
"""

import collections
import math
from collections.abc import Sequence
from typing import NamedTuple

from sliceit_drake.hardware.client import RobotState
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics, flange_pose
from sliceit_drake.hardware.hardware_config import SafetyLimits

__all__ = ["Doubt", "ReadingCheck", "pose_difference", "weight_in_flange"]

PERIOD = 0.002
"""Shortest time between two readings of an e-Series controller, s."""
FULL_SPEED = 0.999
TURN = 0.02
"""Most that the robot's flange may be turned from where its joints have it, rad."""
LAG = 0.03
"""Time by which a servo's own targets trail those that it is sent, s: least lookahead."""
FELT_TIME = 0.1
"""Time over which the force is averaged that a food must be felt by, s."""
FELT_NOISE = 5.0
"""Least of that force, in its standard deviations by noise."""
STILL = 1e-3
"""Way of a joint's target on which its encoder shows something, rad."""


class Doubt(NamedTuple):
    """Why a reading cannot be true: name of the limit, a sentence, and what was found and allowed.

    Attributes:
        limit: As in `SafetyLimits`.
        detail: What was seen, and what to look at.
        value: What was found; NaN where a number does not tell.
        bound: What was allowed; NaN likewise.
    """

    limit: str
    detail: str
    value: float = math.nan
    bound: float = math.nan


class ReadingCheck:
    """Compares the readings of a run, one by one, in the order of time.

    What a robot does not show (None in `RobotState`) is not compared, unless it did at the start.

    Args:
        limits: What is allowed.
        kinematics: Where the knife's edge is.
        food_top: Height in the world under which the knife must feel a food, m; None for no food.
        state: The first reading, of an arm at rest.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        kinematics: EdgeKinematics,
        food_top: float | None,
        state: RobotState,
    ) -> None:
        self._limits, self._kinematics = limits, kinematics
        self._food_top = -math.inf if food_top is None else food_top
        self._first = self._last = state
        self._force_since = self._shown_since = self._joints_since = state.time
        self._joints_target = state.q
        self._raw_zero = self._raw_difference(state)
        self._raw_since = state.time
        # Mean force over the food, of how many readings; change of the force since and mean square
        # of what comes and goes in a cycle, both averaged; lowest height where a food was felt.
        self._over, self._readings_over = list(state.wrench[:3]), 1
        self._felt, self._noise, self._felt_down_to = [0.0] * 3, 0.0, self._food_top
        self._sent = collections.deque([(state.time, state.q)])
        if state.target_q is not None:
            self._sent.append((state.time, state.target_q))

    def doubt(self, state: RobotState, sent: Sequence[float] | None = None) -> Doubt | None:
        """The first reason not to believe a state, or None.

        Args:
            state: The newest.
            sent: The target that went out before it [6], rad; None where the robot moves by itself.
        """
        doubt = (
            self._missing(state)
            or self._force(state)
            or self._raw(state)
            or pose_difference(state, self._limits.kinematics)
            or self._joints(state, state.target_q if sent is None else sent)
            or self._read_back(state, sent)
            or self._speed(state)
        )
        self._last = state
        return doubt

    def disagreement(self, state: RobotState) -> Doubt | None:
        """Whether the force that counts is not what the sensor shows, be it for a cycle."""
        now, zero = self._raw_difference(state), self._raw_zero
        if now is None or zero is None:
            return None
        off = math.dist(now, zero)
        if off <= self._limits.raw_force:
            return None
        detail = f"the raw force and the force that counts have come {off:.3g} N apart"
        return Doubt("raw_force", detail, off, self._limits.raw_force)

    def _missing(self, state: RobotState) -> Doubt | None:
        for name in ("target_q", "raw_wrench", "tcp_pose", "speed", "robot_mode"):
            if getattr(self._first, name) is not None and getattr(state, name) is None:
                return Doubt("measurement", f"{name} is not in the robot's data any more")
        return None

    def _force(self, state: RobotState) -> Doubt | None:
        limits, wrench = self._limits, state.wrench
        if not any(wrench):
            return Doubt(
                "force_age", "all force readings are exactly 0: does the sensor work?", 0.0
            )
        if wrench != self._last.wrench:
            self._force_since = state.time
        still = state.time - self._force_since
        if still > limits.force_age:
            detail = f"the force readings are the same to the last digit for {still:.3g} s"
            return Doubt("force_age", detail, still, limits.force_age)
        # A sensor that stands: the force that counts goes on with the arm's posture.
        if state.raw_wrench is None or state.raw_wrench != self._last.raw_wrench:
            self._shown_since = state.time
        stood = state.time - self._shown_since
        if stood > limits.force_age:
            detail = f"the sensor's raw readings are the same to the last digit for {stood:.3g} s"
            return Doubt("force_age", detail, stood, limits.force_age)
        gap = max(PERIOD, state.time - self._last.time)
        step = math.dist(wrench[:3], self._last.wrench[:3])
        if step > limits.force_rate * gap:
            detail = f"the force jumps by {step:.3g} N in {1e3 * gap:.3g} ms"
            return Doubt("force_rate", detail, step / gap, limits.force_rate)
        return self._unfelt(state, gap)

    def _unfelt(self, state: RobotState, gap: float) -> Doubt | None:
        """Whether the edge has gone on in a food without any force; noise alone is none."""
        wrench, last = state.wrench, self._last.wrench
        heel, tip, _ = self._kinematics.edge(state.q)
        lowest, share = min(heel[2], tip[2]), min(1.0, gap / FELT_TIME)
        jump = sum((wrench[k] - last[k]) ** 2 for k in range(3)) / 6.0
        self._noise += share * (jump - self._noise)
        if lowest > self._food_top:
            self._readings_over += 1
            for k in range(3):
                self._over[k] += (wrench[k] - self._over[k]) / self._readings_over
            return None
        for k in range(3):
            self._felt[k] += share * (wrench[k] - self._over[k] - self._felt[k])
        felt, now, least = math.hypot(*self._felt), math.dist(wrench[:3], self._over), []
        for averaged in (0.5 * share, 1.0):
            variance = self._noise * (averaged + 1.0 / self._readings_over)
            least.append(max(self._limits.felt_force, FELT_NOISE * math.sqrt(variance)))
        if felt >= least[0] or now >= least[1]:
            self._felt_down_to = min(self._felt_down_to, lowest)
        way = self._felt_down_to - lowest
        if way <= self._limits.blind_depth:
            return None
        deep = 1e3 * (self._food_top - lowest)
        detail = (
            f"the edge is {deep:.1f} mm in the food and has felt {felt:.3g} N for {1e3 * way:.1f} "
            f"mm, at least {least[0]:.3g} expected: is there a food, and does the sensor feel it?"
        )
        return Doubt("felt_force", detail, felt, least[0])

    def _raw_difference(self, state: RobotState) -> list[float] | None:
        """The flange's raw force less its weight and less the force that counts [3], N."""
        if state.raw_wrench is None or state.payload is None:
            return None
        weight = weight_in_flange(state, self._kinematics)
        X, force = flange_pose(state.q), state.wrench
        return [
            state.raw_wrench[k]
            - weight[k]
            - sum(X[3 * k + axis] * force[axis] for axis in range(3))
            for k in range(3)
        ]

    def _raw(self, state: RobotState) -> Doubt | None:
        doubt = self.disagreement(state)
        if doubt is None:
            self._raw_since = state.time
        return doubt if state.time - self._raw_since > self._limits.force_age else None

    def _joints(self, state: RobotState, target: Sequence[float] | None) -> Doubt | None:
        if target is None:
            return None
        if state.q != self._last.q or state is self._last:
            self._joints_since, self._joints_target = state.time, list(target)
            return None
        way = max(abs(a - b) for a, b in zip(target, self._joints_target, strict=True))
        if way > STILL:
            still = state.time - self._joints_since
            detail = (
                f"the joints are the same to the last digit for {still:.3g} s while their target "
                f"moves by {way:.3g} rad"
            )
            return Doubt("measurement", detail, way, STILL)
        return None

    def _read_back(self, state: RobotState, sent: Sequence[float] | None) -> Doubt | None:
        limits, target, line = self._limits, state.target_q, self._sent
        if target is None or sent is None:
            return None
        line.append((state.time, list(sent)))
        oldest = state.time - limits.state_age - limits.command_age - LAG
        while len(line) > 2 and line[1][0] < oldest:
            line.popleft()
        for j in range(6):
            angles = [q[j] for _, q in line]
            off = max(min(angles) - target[j], target[j] - max(angles))
            # Written so that a NaN fails.
            if not off <= limits.read_back:
                detail = (
                    f"the robot's own target of joint {j + 1} is {off:.3g} rad from all that was "
                    f"sent in the last {state.time - line[0][0]:.3g} s: commands come late or "
                    "changed"
                )
                return Doubt("read_back", detail, off, limits.read_back)
        return None

    def _speed(self, state: RobotState) -> Doubt | None:
        # Of a NaN, too, nobody knows how fast the arm goes.
        if state.speed is None or state.speed >= FULL_SPEED:
            return None
        detail = f"the robot's speed is scaled to {100.0 * state.speed:.3g} %, wanted 100"
        return Doubt("speed_scaling", detail, state.speed, 1.0)


def pose_difference(state: RobotState, allowed: float) -> Doubt | None:
    """Compares the robot's own tool centre point with the flange of the nominal kinematics.

    Args:
        state: Its pose and its joints are of the same cycle.
        allowed: Greatest distance, m; by the rotation it is `TURN`.
    """
    if state.tcp_pose is None:
        return None
    X, (x, y, z, rx, ry, rz) = flange_pose(state.q), state.tcp_pose
    off = math.dist(X[9:], (x, y, z))
    angle = math.hypot(rx, ry, rz)
    u, v, w = (rx / angle, ry / angle, rz / angle) if angle > 0.0 else (1.0, 0.0, 0.0)
    s, c = math.sin(angle), math.cos(angle)
    t = 1.0 - c
    R = (
        (c + u * u * t, v * u * t + w * s, w * u * t - v * s)
        + (u * v * t - w * s, c + v * v * t, w * v * t + u * s)
        + (u * w * t + v * s, v * w * t - u * s, c + w * w * t)
    )
    # The distance of two rotations as matrices is sqrt(8) sin(half their angle).
    half = min(1.0, math.dist(X[:9], R) / math.sqrt(8.0))
    turn = 2.0 * math.asin(half)
    if off <= allowed and turn <= TURN:
        return None
    detail = (
        f"the robot has its tool centre point {1e3 * off:.2f} mm and {turn:.4f} rad from where its "
        f"joints have the flange, allowed {1e3 * allowed:g} and {TURN:g}: the tool centre point is "
        "not the flange, or the arm's calibration is far from the nominal kinematics"
    )
    return Doubt("kinematics", detail, off, allowed)


def weight_in_flange(state: RobotState, kinematics: EdgeKinematics) -> list[float]:
    """Weight of the payload that the controller subtracts, in the flange's axes [3], N."""
    assert state.payload is not None
    X, down = flange_pose(state.q), kinematics.gravity
    return [
        state.payload[0] * sum(X[3 * k + axis] * down[axis] for axis in range(3)) for k in range(3)
    ]
