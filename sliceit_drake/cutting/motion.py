"""Prescribed motions of the knife: configuration dataclasses, and poses as functions of time.

A `MotionPlan` lists segments; each begins where the one before it ended, and is described in the
knife frame K at its own start: x along the edge (draw), z from spine to edge (press), y normal to
the blade. `Motion` places a plan at a start pose in the world W and gives pose and velocity at any
time. A segment with an `acceleration` starts and stops at rest with ramps of that acceleration;
without one its velocity steps, which is exact for a prescribed motion and shakes a robot.
"""

import bisect
import dataclasses as dc
import itertools
import math
import typing
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError, choice, quantity, validate
from sliceit_drake.tables import read_columns, require_increasing

__all__ = [
    "ConstantSpeed",
    "Hold",
    "Motion",
    "MotionPlan",
    "Pose",
    "PressAndDraw",
    "Recorded",
    "Retract",
    "Segment",
    "Velocity",
    "Waypoints",
    "small_motion",
]

OVERTRAVEL = 2e-4
"""Way into the board at the end of a cut through the food, metres; see `SliceSequence`."""
ACCELERATION = 0.5
"""Of the ramps of such a cut, m/s^2."""
SHORT_HOLD = 0.1
"""Time of rest at its end in a food that clamps the blade, s."""

_NO_TURN = np.eye(3)
_NO_TURN.setflags(write=False)

_POSITION_COLUMNS = ("p_WK_x", "p_WK_y", "p_WK_z")
_QUATERNION_COLUMNS = ("quat_WK_w", "quat_WK_x", "quat_WK_y", "quat_WK_z")


class Pose(typing.NamedTuple):
    """Pose of a frame B in a frame A.

    Attributes:
        R: Rotation matrix R_AB, float array [3, 3].
        p: Position of B's origin in A, float array [3], m.
    """

    R: np.ndarray
    p: np.ndarray


class Velocity(typing.NamedTuple):
    """Spatial velocity of a frame B in a frame A, expressed in A.

    Attributes:
        w: Angular velocity, float array [3], rad/s.
        v: Velocity of B's origin, float array [3], m/s.
    """

    w: np.ndarray
    v: np.ndarray


def small_motion(X0: np.ndarray, X1: np.ndarray) -> list[float]:
    """Motion from a pose [3, 4] to another in their common frame.

    Returns:
        Axis times sine of the angle of the turn [3], rad, and displacement of the origin [3], m.
    """
    (ax, ay, az, au), (bx, by, bz, bu), (cx, cy, cz, cu) = X0.tolist()
    (dx, dy, dz, du), (ex, ey, ez, eu), (fx, fy, fz, fu) = X1.tolist()
    # Elements of R1 R0^T less those opposite.
    x = (fx * bx + fy * by + fz * bz) - (ex * cx + ey * cy + ez * cz)
    y = (dx * cx + dy * cy + dz * cz) - (fx * ax + fy * ay + fz * az)
    z = (ex * ax + ey * ay + ez * az) - (dx * bx + dy * by + dz * bz)
    return [0.5 * x, 0.5 * y, 0.5 * z, du - au, eu - bu, fu - cu]


@dc.dataclass
class ConstantSpeed:
    """Straight motion at constant speed, over a distance or for a duration (give one of them)."""

    speed: float = quantity(0.02, "m/s", low=1e-6, high=2.0)
    """Speed between the ramps; not reached on a path too short for them."""
    direction: list[float] = quantity([0.0, 0.0, 1.0], "", size=3)
    """Direction in K at the start; its length does not matter."""
    distance: float | None = quantity(None, "m", low=1e-6, high=1.0)
    """Distance to travel."""
    duration: float | None = quantity(None, "s", low=1e-6, high=3600.0)
    """Duration of the segment, ramps included."""
    acceleration: float | None = quantity(None, "m/s2", low=1e-3, high=100.0)
    """Acceleration of the ramps at start and stop; if not given, the velocity steps."""
    label: str = "slice"

    def check(self, where: str) -> None:
        if np.linalg.norm(self.direction) < 1e-9:
            raise ConfigurationError(
                f"{self.direction} has no direction",
                field=f"{where}.direction",
                fix="Give a vector such as [0, 0, 1], which presses.",
            )
        if (self.distance is None) == (self.duration is None):
            given = "both are given" if self.distance is not None else "neither is given"
            raise ConfigurationError(
                f"needs one of distance and duration; {given}",
                field=where,
                fix="Give distance in m or duration in s.",
            )
        ramps = 2.0 * _ramp_time(self.speed, self.acceleration)
        if self.duration is not None and self.duration < ramps:
            raise ConfigurationError(
                f"{self.duration:.6g} s is shorter than the ramps to and from the speed,"
                f" {ramps:.6g} s",
                field=f"{where}.duration",
                fix="Lengthen it, raise acceleration, or give distance.",
            )

    def build(self) -> "_Translation":
        """Returns the motion as a function of time."""
        ramp = _ramp_time(self.speed, self.acceleration)
        if self.distance is not None:
            ideal_duration = self.distance / self.speed
        else:
            assert self.duration is not None, "check() has made sure that one is given"
            ideal_duration = self.duration - ramp
        return _line(self.direction, self.speed, ideal_duration, ramp)


@dc.dataclass
class PressAndDraw:
    """Press at constant speed, with a draw along the edge in a fixed ratio, a sinusoid, or both.

    With tau the time since the start (slowed during the ramps), the knife is at
    z = press_speed tau and x = draw_ratio z + amplitude sin(2 pi frequency tau).
    """

    press_speed: float = quantity(0.02, "m/s", low=1e-6, high=2.0)
    """Speed along z."""
    distance: float = quantity(0.03, "m", low=1e-6, high=1.0)
    """Distance to travel along z."""
    draw_ratio: float = quantity(0.0, "", low=-100.0, high=100.0)
    """Draw over press speed, xi, of the steady draw."""
    amplitude: float = quantity(0.0, "m", low=0.0, high=0.5)
    """Amplitude of the sinusoid."""
    frequency: float = quantity(1.0, "Hz", low=1e-3, high=50.0)
    """Frequency of the sinusoid."""
    acceleration: float | None = quantity(None, "m/s2", low=1e-3, high=100.0)
    """Acceleration of the ramps at start and stop; if not given, the velocity steps."""
    label: str = "slice"

    def build(self) -> "_Translation":
        """Returns the motion as a function of time."""
        omega = 2.0 * math.pi * self.frequency

        def position(tau: float) -> np.ndarray:
            z = self.press_speed * tau
            x = self.draw_ratio * z + self.amplitude * math.sin(omega * tau)
            return np.array([x, 0.0, z])

        def derivative(tau: float) -> np.ndarray:
            draw = self.amplitude * omega * math.cos(omega * tau)
            return np.array([self.draw_ratio * self.press_speed + draw, 0.0, self.press_speed])

        # The sinusoid starts at its fastest, so that the ramps see the greatest speed.
        draw_speed = abs(self.draw_ratio) * self.press_speed + self.amplitude * omega
        ramp = _ramp_time(math.hypot(draw_speed, self.press_speed), self.acceleration)
        return _Translation(position, derivative, self.distance / self.press_speed, ramp)


@dc.dataclass
class Hold:
    """Rest at the pose where the segment before it ended."""

    duration: float = quantity(0.2, "s", low=1e-6, high=3600.0)
    """Duration."""
    label: str = "hold"

    def build(self) -> "_Translation":
        """Returns the motion as a function of time."""
        return _line([0.0, 0.0, 1.0], 0.0, self.duration, 0.0)


@dc.dataclass
class Retract:
    """Straight withdrawal against the cutting direction."""

    distance: float = quantity(0.05, "m", low=1e-6, high=1.0)
    """Distance to travel along -z."""
    speed: float = quantity(0.05, "m/s", low=1e-6, high=2.0)
    """Speed between the ramps; not reached on a path too short for them."""
    acceleration: float | None = quantity(None, "m/s2", low=1e-3, high=100.0)
    """Acceleration of the ramps at start and stop; if not given, the velocity steps."""
    label: str = "retract"

    def build(self) -> "_Translation":
        """Returns the motion as a function of time."""
        ramp = _ramp_time(self.speed, self.acceleration)
        return _line([0.0, 0.0, -1.0], self.speed, self.distance / self.speed, ramp)


@dc.dataclass
class Waypoints:
    """Motion from the start through given poses, each reached at its time."""

    times: list[float] = quantity([1.0], "s", low=1e-6, high=3600.0)
    """Time since the start of each waypoint, increasing."""
    positions: list[list[float]] = quantity([[0.0, 0.0, 0.0]], "m", low=-2.0, high=2.0)
    """Position of each waypoint in K at start."""
    rotations: list[list[float]] = quantity([], "rad", low=-np.pi, high=np.pi)
    """Roll, pitch, yaw of each waypoint relative to K at start (about fixed x, y, z in this order);
    empty for none."""
    interpolation: str = choice("smooth", ("smooth", "linear"))
    """smooth: each leg starts and ends at rest (minimum jerk); linear: at constant speed."""
    label: str = "move"

    def check(self, where: str) -> None:
        count = len(self.times)
        if count == 0:
            raise ConfigurationError("is empty", field=f"{where}.times", fix="Give a time.")
        for index in range(1, count):
            if self.times[index] <= self.times[index - 1]:
                raise ConfigurationError(
                    f"{self.times[index]} s does not come after {self.times[index - 1]} s",
                    field=f"{where}.times[{index}]",
                    fix="Sort the waypoints by time.",
                )
        for name, rows in (("positions", self.positions), ("rotations", self.rotations)):
            if len(rows) != count and (name == "positions" or rows):
                raise ConfigurationError(
                    f"has {len(rows)} entries for {count} times",
                    field=f"{where}.{name}",
                    fix="Give one [a, b, c] for each time.",
                )
            for index, row in enumerate(rows):
                if len(row) != 3:
                    raise ConfigurationError(
                        f"has {len(row)} values",
                        field=f"{where}.{name}[{index}]",
                        fix="Give 3 values.",
                    )

    def build(self) -> "_Legs":
        """Returns the motion as a function of time."""
        angles = np.array(self.rotations) if self.rotations else np.zeros((len(self.times), 3))
        rotations = Rotation.from_euler("xyz", np.vstack([np.zeros(3), angles]))
        positions = np.vstack([np.zeros(3), self.positions])
        times = np.array([0.0, *self.times])
        return _Legs(times, positions, rotations, smooth=self.interpolation == "smooth")


@dc.dataclass
class Recorded:
    """Motion read from a CSV file, interpolated linearly between its rows.

    The columns are time (s), p_WK_x, p_WK_y, p_WK_z (m) and quat_WK_w, quat_WK_x, quat_WK_y,
    quat_WK_z; others are ignored.
    """

    file: str = ""
    placement: str = choice("start", ("start", "world"))
    """start: moved so that its first pose is where the segment starts; world: as recorded, which
    only the first segment can be."""
    label: str = "recorded"

    def check(self, where: str) -> None:
        if not self.file:
            raise ConfigurationError(
                "is empty", field=f"{where}.file", fix="Give the path of a CSV file."
            )

    def build(self) -> "_Legs":
        """Returns the motion as a function of time.

        Raises:
            ConfigurationError: If the file is not a record of a motion.
        """
        times, positions, rotations = self._read()
        inverse = rotations[0].inv()
        return _Legs(
            times - times[0],
            inverse.apply(positions - positions[0]),
            inverse * rotations,
            smooth=False,
        )

    def first_pose(self) -> Pose:
        """Returns the pose X_WK of the first row.

        Raises:
            ConfigurationError: If the file is not a record of a motion.
        """
        _, positions, rotations = self._read()
        return Pose(rotations[0].as_matrix(), positions[0])

    def _read(self) -> tuple[np.ndarray, np.ndarray, Rotation]:
        columns = read_columns(self.file, ("time", *_POSITION_COLUMNS, *_QUATERNION_COLUMNS))
        times = columns["time"]
        if len(times) < 2:
            raise ConfigurationError(
                "the record has one row", source=self.file, fix="Give at least two."
            )
        require_increasing(times, self.file, "time")
        positions = np.column_stack([columns[name] for name in _POSITION_COLUMNS])
        far = np.argwhere(np.abs(positions) > 10.0)
        if far.size:
            row, axis = far[0]
            raise ConfigurationError(
                f"row {row + 1} has {positions[row, axis]:.6g} m, beyond any arm's reach",
                source=self.file,
                field=_POSITION_COLUMNS[axis],
                fix=f"Is it in mm? Write {positions[row, axis] / 1000.0:.6g}.",
            )
        quaternions = np.column_stack([columns[name] for name in _QUATERNION_COLUMNS])
        norms = np.linalg.norm(quaternions, axis=1)
        wrong = np.flatnonzero(np.abs(norms - 1.0) > 1e-3)
        if wrong.size:
            raise ConfigurationError(
                f"row {wrong[0] + 1} has a quaternion of length {norms[wrong[0]]:.6g}",
                source=self.file,
                field=", ".join(_QUATERNION_COLUMNS),
                fix="Give unit quaternions, w first.",
            )
        return times, positions, Rotation.from_quat(quaternions, scalar_first=True)


Segment = ConstantSpeed | PressAndDraw | Hold | Retract | Waypoints | Recorded


@dc.dataclass
class MotionPlan:
    """A sequence of segments, each of which begins where the one before it ended.

    A scenario that gives none cuts through its food, whatever its height.
    """

    segments: list[Segment] = dc.field(
        default_factory=lambda: [
            ConstantSpeed(distance=0.03, acceleration=0.5),
            Hold(),
            Retract(acceleration=0.5),
        ]
    )

    def check(self, where: str) -> None:
        if not self.segments:
            raise ConfigurationError(
                "is empty", field=f"{where}.segments", fix="Give at least one, such as !Hold {}."
            )
        for index, segment in enumerate(self.segments[1:], start=1):
            if isinstance(segment, Recorded) and segment.placement == "world":
                raise ConfigurationError(
                    "would jump to where it was recorded",
                    field=f"{where}.segments[{index}].placement",
                    fix='Put it first, or write "placement: start".',
                )

    def or_cut_through(self, height: float, clamps: bool) -> "MotionPlan":
        """These segments; where none were given, those of one cut through the food.

        The knife then comes up again, but not out of a food that clamps the blade, which would
        shake.

        Args:
            height: Of the edge over the board at the start, metres.
            clamps: Whether the food clamps the blade, as one that is held on both sides does.
        """
        if self != MotionPlan():
            return self
        way = height + OVERTRAVEL
        down = ConstantSpeed(distance=way, acceleration=ACCELERATION)
        if clamps:
            return MotionPlan([down, Hold(SHORT_HOLD)])
        return MotionPlan([down, Hold(), Retract(way, acceleration=ACCELERATION)])


class Motion:
    """A plan placed at a start pose: pose and velocity of the knife at any time.

    Before the start the knife rests at the start, after the end at the end.

    Args:
        plan: The segments.
        start: Pose X_WK at the start. A first segment that is placed in the world as it was
            recorded starts from its own first pose instead.

    Attributes:
        duration: Time from start to end, s.

    Raises:
        ConfigurationError: If the plan is invalid, or a record in it is.
        ValueError: If `start` is not a pose.
    """

    def __init__(self, plan: MotionPlan, start: Pose) -> None:
        validate(plan, "motion")
        first = plan.segments[0]
        if isinstance(first, Recorded) and first.placement == "world":
            start = first.first_pose()
        pose = Pose(np.array(start.R, float), np.array(start.p, float))
        if pose.R.shape != (3, 3) or pose.p.shape != (3,) or not np.isfinite(pose.p).all():
            raise ValueError(f"start is not a pose: R of shape [3, 3] and finite p [3]: {start}")
        if not np.allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-6) or np.linalg.det(pose.R) < 0.0:
            raise ValueError(f"start.R is not a rotation matrix: {start.R}")
        self._labels = [segment.label for segment in plan.segments]
        self._paths = [segment.build() for segment in plan.segments]
        durations = (path.duration for path in self._paths)
        self._begins = list(itertools.accumulate(durations, initial=0.0))
        self._starts = [pose]
        for path in self._paths:
            self._starts.append(_compose(self._starts[-1], path.pose(path.duration)))
        for at_rest in self._starts:  # These are handed out by pose(), and must not change.
            at_rest.R.setflags(write=False)
            at_rest.p.setflags(write=False)
        self.duration = self._begins[-1]

    def pose(self, t: float) -> Pose:
        """Returns the pose X_WK at the time `t`, s."""
        if t >= self.duration:
            return self._starts[-1]
        if t <= 0.0:
            return self._starts[0]
        index = bisect.bisect_right(self._begins, t) - 1
        return _compose(self._starts[index], self._paths[index].pose(t - self._begins[index]))

    def velocity(self, t: float) -> Velocity:
        """Returns the velocity V_WK at the time `t`, s; at a step, its value after the step."""
        if t < 0.0 or t >= self.duration:
            return Velocity(np.zeros(3), np.zeros(3))
        index = self._index(t)
        R_WS = self._starts[index].R
        V_SK = self._paths[index].velocity(t - self._begins[index])
        return Velocity(R_WS @ V_SK.w, R_WS @ V_SK.v)

    def sample(
        self, times: Sequence[float] | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns the motion at times [N], s.

        Returns:
            R_WK [N, 3, 3], p_WK [N, 3] in m, angular velocity w_WK [N, 3] in rad/s and velocity of
            the origin v_WK [N, 3] in m/s, all in W.
        """
        poses = [self.pose(t) for t in times]
        velocities = [self.velocity(t) for t in times]
        return (
            np.array([pose.R for pose in poses]).reshape(-1, 3, 3),
            np.array([pose.p for pose in poses]).reshape(-1, 3),
            np.array([velocity.w for velocity in velocities]).reshape(-1, 3),
            np.array([velocity.v for velocity in velocities]).reshape(-1, 3),
        )

    def phase_at(self, t: float) -> str:
        """Returns the label of the segment at the time `t`, s: the first before, the last after."""
        return self._labels[self._index(t)]

    @property
    def phases(self) -> list[tuple[str, float, float]]:
        """Label, begin and end (s) of every segment in order."""
        return list(zip(self._labels, self._begins[:-1], self._begins[1:], strict=True))

    def _index(self, t: float) -> int:
        index = bisect.bisect_right(self._begins, t) - 1
        return min(max(index, 0), len(self._paths) - 1)


class _Translation:
    """Translation along a path given by position and derivative as functions of tau.

    tau is the time of the path without ramps. Its rate rises linearly from 0 to 1 during `ramp` and
    falls likewise at the end; on a path too short for that it turns back at half way.
    """

    def __init__(
        self,
        position: Callable[[float], np.ndarray],
        derivative: Callable[[float], np.ndarray],
        ideal_duration: float,
        ramp: float,
    ) -> None:
        self._position, self._derivative = position, derivative
        self._ideal_duration = ideal_duration
        self._slope = np.inf if ramp == 0.0 else 1.0 / ramp
        self._ramp = min(ramp, math.sqrt(ideal_duration * ramp))
        self._peak = 1.0 if ramp == 0.0 else self._ramp / ramp
        self.duration = ideal_duration / self._peak + self._ramp

    def pose(self, t: float) -> Pose:
        tau, _ = self._at(t)
        return Pose(_NO_TURN, self._position(tau))

    def velocity(self, t: float) -> Velocity:
        tau, rate = self._at(t)
        return Velocity(np.zeros(3), rate * self._derivative(tau))

    def _at(self, t: float) -> tuple[float, float]:
        """Returns tau and its rate at the time `t` in [0, duration]."""
        left = self.duration - t
        if t < self._ramp:
            return 0.5 * self._slope * t * t, self._slope * t
        if left < self._ramp:
            return self._ideal_duration - 0.5 * self._slope * left * left, self._slope * left
        return self._peak * (t - 0.5 * self._ramp), self._peak


class _Legs:
    """Legs between poses: straight lines, and rotations about the fixed axis of each leg."""

    def __init__(
        self, times: np.ndarray, positions: np.ndarray, rotations: Rotation, *, smooth: bool
    ) -> None:
        self._times: list[float] = times.tolist()
        self.duration = self._times[-1]
        self._p = positions
        self._dp = np.diff(positions, axis=0)
        self._R = rotations.as_matrix()
        # Rotation vector of each leg, in the axes at the beginning of the leg.
        self._angle = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
        self._smooth = smooth

    def pose(self, t: float) -> Pose:
        leg, share, _ = self._at(t)
        turn = Rotation.from_rotvec(share * self._angle[leg]).as_matrix()
        return Pose(self._R[leg] @ turn, self._p[leg] + share * self._dp[leg])

    def velocity(self, t: float) -> Velocity:
        leg, _, rate = self._at(t)
        return Velocity(rate * (self._R[leg] @ self._angle[leg]), rate * self._dp[leg])

    def _at(self, t: float) -> tuple[int, float, float]:
        """Returns the leg at the time `t`, the fraction of it that is done, and the share's
        rate."""
        leg = bisect.bisect_right(self._times, t) - 1
        leg = min(max(leg, 0), len(self._dp) - 1)
        period = self._times[leg + 1] - self._times[leg]
        u = (t - self._times[leg]) / period
        if not self._smooth:
            return leg, u, 1.0 / period
        # The quintic with zero velocity and acceleration at both ends has the least jerk.
        return leg, u**3 * (10.0 - 15.0 * u + 6.0 * u * u), 30.0 * (u * (1.0 - u)) ** 2 / period


def _line(
    direction: Sequence[float], speed: float, ideal_duration: float, ramp: float
) -> _Translation:
    velocity = speed * np.array(direction, float) / np.linalg.norm(direction)
    return _Translation(lambda tau: velocity * tau, lambda tau: velocity, ideal_duration, ramp)


def _ramp_time(speed: float, acceleration: float | None) -> float:
    return 0.0 if acceleration is None else speed / acceleration


def _compose(X_AB: Pose, X_BC: Pose) -> Pose:
    R_AC = X_AB.R if X_BC.R is _NO_TURN else X_AB.R @ X_BC.R
    return Pose(R_AC, X_AB.p + X_AB.R.dot(X_BC.p))
