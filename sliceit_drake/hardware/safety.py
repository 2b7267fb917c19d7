"""The safety layer: every joint target passes here before it goes out, or stops the robot.

Plain Python, no input or output, no clock but the controller's. It is not a safety function in the
sense of ISO 13849 or ISO 10218: the robot's own safety system is (docs/how_to/hardware.md).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.hardware.client import (
    PLAYING,
    RUNNING,
    RUNTIME_STATES,
    SAFE_BITS,
    RobotState,
    safety_text,
)
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics, EdgePose, singular_margin
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.hardware.readings import ReadingCheck

__all__ = ["Decision", "LatchedError", "SafetyLayer", "Stop", "robot_fault"]

# Differences of the controller's times and of targets carry rounding errors of this order.
_ROUNDING = 1e-9
_REACH = 1.6  # Of the tool's farthest point from the first joint's axis, m, generously.
# What a payload, kg, and its centre, m, may differ by and still be the same.
_SAME_PAYLOAD = 1e-3
_REST_SPEED = 0.02  # A joint slower than this counts as at rest, rad/s.


Nearest = Callable[[Sequence[float], float], tuple[float, str] | None]


class Stop(NamedTuple):
    """Why the layer stopped.

    Attributes:
        limit: Name of the limit, as in `SafetyLimits`, or of the fault.
        detail: A sentence for the operator.
        value: What was found; NaN where a number does not tell.
        bound: What was allowed; NaN likewise.
        time: Time of the controller, s.
        sends: Whether targets go on out, to brake and hold; after a fault of the link or of the
            robot's program nothing does, so that nothing moves when it comes back.
    """

    limit: str
    detail: str
    value: float
    bound: float
    time: float
    sends: bool

    def __str__(self) -> str:
        return f"{self.limit} at controller time {self.time:.3f} s: {self.detail}"


class Decision(NamedTuple):
    """Decision of one cycle.

    Attributes:
        q: Target to send [6], rad; None to send nothing.
        stop: Why the layer is latched; None while it is not.
    """

    q: list[float] | None
    stop: Stop | None


class LatchedError(RuntimeError):
    """The layer is latched, for good; a new run begins with a new one."""


class SafetyLayer:
    """Passes targets that keep every limit; at the first that does not, stops and stays stopped.

    What counts is what goes out: each target is judged against the one sent before, at the
    controller's times of both. A target is passed only if the arm, braked from it, also comes to
    rest within the limits; braking goes along the line of the last motion in joint space, each
    joint within its acceleration. So all that is sent keeps the limits, the stop included.

    A command that comes a cycle late is carried on at the speed of the commands to the time of its
    sending, or the targets would stall and jump. What then still asks for too much acceleration is
    moved, by at most `SafetyLimits.deviation`. Nothing else is changed on the way out.

    Args:
        limits: What is allowed.
        kinematics: Where the knife's edge is.
        board_height: Height of the board's surface in the world, m.
        start: Joint positions around which `SafetyLimits.joint_window` lies [6], rad.
        period: Period of the controller, s.
        food_top: Height of the food's top in the world, m; None where there is no food.
        nearest: Least distance of bodies that must not touch, m, and their names, at joint
            positions [6], rad; None where it is more than its second argument, m.

    Raises:
        ConfigurationError: A limit is out of its range, or a number is none.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        kinematics: EdgeKinematics,
        board_height: float,
        start: Sequence[float],
        period: float = 0.002,
        food_top: float | None = None,
        nearest: Nearest | None = None,
    ) -> None:
        # A NaN would be a limit that nothing breaks, wherever it came from.
        validate(limits, "limits")
        if len(start) != 6 or not all(map(math.isfinite, (*start, board_height))):
            raise ConfigurationError(
                f"start {list(start)} or board height {board_height} are not known",
                fix="Give 6 finite numbers and one.",
            )
        self.limits, self.period, self._food_top = limits, period, food_top
        self._readings: ReadingCheck | None = None
        self._kinematics, self._nearest = kinematics, nearest
        window = limits.joint_window
        self._lower = [max(a, s - window) for a, s in zip(limits.joint_lower, start, strict=True)]
        self._upper = [min(b, s + window) for b, s in zip(limits.joint_upper, start, strict=True)]
        self._speed = list(limits.joint_speed)
        self._acceleration = list(limits.joint_acceleration)
        self._low, self._high = list(limits.workspace_lower), list(limits.workspace_upper)
        self._floor = board_height - limits.board_depth
        self._down = math.cos(limits.tilt)
        self._stop: Stop | None = None
        self._armed = False
        self._q = [0.0] * 6
        self._v = [0.0] * 6
        self._edge = kinematics.edge(self._q)
        self._last: RobotState | None = None
        self._payload: tuple[float, ...] | None = None
        self._time = -math.inf  # Of the last state.
        self._sent_time = -math.inf
        # The newest command that was judged.
        self._command, self._command_time = self._q, -math.inf
        self._command_speed = [0.0] * 6

    @property
    def is_still(self) -> bool:
        """Whether the target sent last repeats the one before it."""
        return not any(self._v)

    @property
    def stop(self) -> Stop | None:
        """Why the layer is latched, or None."""
        return self._stop

    def arm(self, state: RobotState) -> Stop | None:
        """Takes the arm's actual position, at rest, as the target sent last.

        Returns:
            Why the layer latched instead: the robot is not in a state to start from.

        Raises:
            LatchedError: If it is latched already.
        """
        if self._stop is not None:
            raise LatchedError(f"The safety layer is latched ({self._stop}); start a new run.")
        self._armed, self._payload, self._readings = False, None, None
        stop = robot_fault(state) or self._measurement_fault(state)
        if stop is None:
            self._q, self._v = [float(x) for x in state.q], [0.0] * 6
            self._last, self._payload = state, state.payload
            self._time = self._sent_time = self._command_time = state.time
            self._command, self._command_speed = self._q, [0.0] * 6
            edge = self._kinematics.edge(self._q)
            stop = self._position_fault(self._q, edge, "the arm's actual position", state.time)
            self._edge = edge
            fastest = max(map(abs, state.qd))
            if stop is None and fastest > _REST_SPEED:
                stop = self._breach(
                    "at rest", "a joint moves at the start", fastest, _REST_SPEED, "rad/s",
                    state.time,
                )  # fmt: skip
        if stop is None:
            self._readings = ReadingCheck(self.limits, self._kinematics, self._food_top, state)
            stop = self._doubt(state)
        if stop is not None:
            self._stop = stop
            return stop
        self._armed = True
        return None

    def look(self, state: RobotState) -> Stop | None:
        """What a state alone says against a robot to which nothing is sent; latches nothing."""
        return robot_fault(state) or self._measurement_fault(state)

    def latch(
        self,
        limit: str,
        detail: str,
        value: float = math.nan,
        bound: float = math.nan,
        *,
        sends: bool = False,
    ) -> Stop:
        """Stops for what another part found; arguments as in `Stop`.

        Returns:
            The first stop, which may be an earlier one; it sends no more if this one does not.
        """
        if self._stop is None:
            self._stop = Stop(limit, detail, value, bound, self._time, sends)
        elif not sends:
            self._stop = self._stop._replace(sends=False)
        return self._stop

    def step(
        self, state: RobotState, command: Sequence[float] | None, command_time: float
    ) -> Decision:
        """Judges one cycle, or a command that comes later in it.

        One target goes out in a cycle; further commands in it are left out.

        Args:
            state: Data of the controller; the same object again for a later command in its cycle.
            command: The target wanted [6], rad; None where there is none that was not judged yet.
            command_time: Controller time of the measurement that the newest command answers, s.
        """
        stop, sent_before = self._stop, self._sent_time
        if stop is None:
            stop = self._stop = self._fault(state, command, command_time)
            if stop is None:
                is_taken = command is not None and self._sent_time != sent_before
                return Decision(self._q[:] if is_taken else None, None)
        else:
            if not stop.sends:
                return Decision(None, stop)
            if state is not self._last:
                fault = robot_fault(state) or self._clock_fault(state)
                if fault is not None:
                    stop = self._stop = stop._replace(sends=False)
                else:
                    self._last, self._time = state, state.time
        if not stop.sends or state.time <= self._sent_time:
            return Decision(None, stop)
        return Decision(self._brake(state.time), stop)

    def _fault(
        self, state: RobotState, command: Sequence[float] | None, command_time: float
    ) -> Stop | None:
        """The first limit that a cycle breaks; None if none, and then the command is taken."""
        if not self._armed:
            return Stop(
                "not armed", "the layer was never armed", math.nan, math.nan, state.time, False
            )
        limits, time = self.limits, state.time
        if state is not self._last:
            stop = robot_fault(state) or self._clock_fault(state)
            if stop is not None:
                return stop
            before, self._last, self._time = self._last, state, time
            stop = self._measurement_fault(state)
            if stop is not None:
                return self._doubted(stop, state)
            for j in range(6):
                error = abs(self._q[j] - state.q[j])
                if not error <= limits.tracking_error:
                    return self._breach(
                        "tracking_error", f"joint {j + 1} is off its target", error,
                        limits.tracking_error, "rad", time,
                    )  # fmt: skip
            stop = self._motion_fault(state, before) or self._doubt(state)
            if stop is not None:
                return stop
        age = time - command_time
        if age < -_ROUNDING:
            detail = f"the command answers a measurement {-age:.4g} s ahead of the newest"
            return Stop("command_age", detail, age, 0.0, time, True)
        if not age <= limits.command_age + _ROUNDING:
            return self._breach(
                "command_age", "no new command in time", age, limits.command_age, "s", time
            )
        if command is None or time <= self._sent_time:
            return None
        return self._take(command, command_time, time)

    def _clock_fault(self, state: RobotState) -> Stop | None:
        gap = state.time - self._time
        if 0.0 < gap <= self.limits.state_age + _ROUNDING:
            return None
        if gap > 0.0:
            detail = f"no data for {gap:.4g} s of controller time"
        else:
            detail = f"the controller's clock went from {self._time:.6g} to {state.time:.6g} s"
        return Stop("state_age", detail, gap, self.limits.state_age, state.time, False)

    def _measurement_fault(self, state: RobotState) -> Stop | None:
        total = sum(state.q) + sum(state.qd) + sum(state.wrench) + state.time
        sizes = len(state.q), len(state.qd), len(state.wrench)
        if sizes != (6, 6, 6) or not math.isfinite(total):
            detail = "the robot's data are no 6 finite numbers each"
            return Stop("measurement", detail, math.nan, math.nan, state.time, True)
        fx, fy, fz, tx, ty, tz = state.wrench
        force, torque = math.hypot(fx, fy, fz), math.hypot(tx, ty, tz)
        if force > self.limits.force:
            return self._breach(
                "force", "the tool meets a force", force, self.limits.force, "N", state.time
            )
        if torque > self.limits.torque:
            return self._breach(
                "torque", "the tool meets a torque", torque, self.limits.torque, "Nm", state.time
            )
        return self._payload_fault(state)

    def _motion_fault(self, state: RobotState, before: RobotState | None) -> Stop | None:
        """The measured edge and speeds, with a margin: the limits of commands alone bound neither.

        The limits of force and torque, and those of the joints, hold for what is measured as well.
        """
        limits, time, factor = self.limits, state.time, self.limits.measured_speed
        for j in range(6):
            speed, most = abs(state.qd[j]), factor * self._speed[j]
            if speed > most:
                return self._breach(
                    "measured_speed", f"joint {j + 1} is measured to move", speed, most, "rad/s",
                    time,
                )  # fmt: skip
        edge = self._kinematics.edge(state.q)
        if before is not None and time > before.time:
            last, dt = self._kinematics.edge(before.q), time - before.time
            speed = max(math.dist(edge[0], last[0]), math.dist(edge[1], last[1])) / dt
            if speed > factor * limits.knife_speed:
                return self._breach(
                    "measured_speed", "the knife is measured to move", speed,
                    factor * limits.knife_speed, "m/s", time,
                )  # fmt: skip
        margin = -limits.measured_margin
        return self._edge_fault(
            edge, "the measured arm", time, margin, -limits.tracking_error
        ) or self._clearance_fault(state.q, time, max(0.0, limits.clearance + margin))

    def _doubt(self, state: RobotState) -> Stop | None:
        """A reading that cannot be true; the arm then brakes by what was sent, and holds."""
        assert self._readings is not None
        doubt = self._readings.doubt(state, self._q)
        return None if doubt is None else Stop(*doubt, state.time, True)

    def _doubted(self, stop: Stop, state: RobotState) -> Stop:
        """A stop by the force, or the reason not to believe that force: it decides what is offered
        to the operator then."""
        if stop.limit not in ("force", "torque"):
            return stop
        assert self._readings is not None
        doubt = self._readings.doubt(state, self._q) or self._readings.disagreement(state)
        if doubt is None:
            return stop
        return Stop(doubt.limit, f"{doubt.detail}; {stop.detail}", *doubt[2:], state.time, True)

    def _payload_fault(self, state: RobotState) -> Stop | None:
        """The force readings jump with the payload that the controller subtracts."""
        before, now = self._payload, state.payload
        if before is None:
            return None
        if now is None or len(now) != len(before):
            detail = "the controller's payload is not in its data any more"
            return Stop("payload", detail, math.nan, before[0], state.time, True)
        if all(abs(a - b) <= _SAME_PAYLOAD for a, b in zip(now, before, strict=True)):
            return None
        detail = (
            f"the controller's payload was changed during the run: {_payload_text(before)} at its "
            f"start, now {_payload_text(now)}"
        )
        return Stop("payload", detail, now[0], before[0], state.time, True)

    def _take(self, command: Sequence[float], command_time: float, time: float) -> Stop | None:
        """Judges a command against the target sent before; takes it if it keeps the limits."""
        try:
            q = [float(x) for x in command]
        except (TypeError, ValueError):
            q = []
        if len(q) != 6:
            detail = "the command is no list of 6 numbers"
            return Stop("command", detail, len(q), 6, time, True)
        q = self._carried_on(q, command_time, time)
        dt = time - self._sent_time
        limits, before, speed_before = self.limits, self._q, self._v
        v, brake_time, way = [0.0] * 6, 0.0, 0.0
        for j in range(6):
            change = q[j] - before[j]
            # Written so that a NaN fails.
            if not abs(change) <= limits.joint_step:
                if not math.isfinite(change):
                    detail = f"joint {j + 1} of the command is {q[j]}"
                    return Stop("command", detail, q[j], math.nan, time, True)
                return self._breach(
                    "joint_step", f"joint {j + 1} would jump", abs(change), limits.joint_step,
                    "rad", time,
                )  # fmt: skip
            way += abs(change)
            v[j] = speed = change / dt
            if abs(speed) > self._speed[j]:
                return self._breach(
                    "joint_speed", f"joint {j + 1} would move", abs(speed), self._speed[j],
                    "rad/s", time,
                )  # fmt: skip
            most = self._acceleration[j]
            excess = abs(speed - speed_before[j]) - most * dt
            if excess > 0.0:
                if excess * dt > limits.deviation:
                    return self._breach(
                        "joint_acceleration", f"joint {j + 1} would accelerate",
                        most + excess / dt, most, "rad/s2", time,
                    )  # fmt: skip
                speed += excess if speed < speed_before[j] else -excess
                v[j], q[j] = speed, before[j] + dt * speed
            if abs(speed) > most * brake_time:
                brake_time = abs(speed) / most
        edge = self._kinematics.edge(q)
        fastest = max(math.dist(edge[0], self._edge[0]), math.dist(edge[1], self._edge[1])) / dt
        if fastest > limits.knife_speed:
            return self._breach(
                "knife_speed", "the knife would move", fastest, limits.knife_speed, "m/s", time
            )
        stop, rest = self._position_fault(q, edge, "the command", time), q
        if stop is None and brake_time > 0.0:
            # In steps the way is less than v T / 2, by half a step. On it a point leaves the
            # straight line by at most reach / 8 times the square of the angles turned.
            share = 0.5 * brake_time
            rest = [q[j] + share * v[j] for j in range(6)]
            turned = way * share / dt
            stop = self._position_fault(
                rest,
                self._kinematics.edge(rest),
                "where the arm could stop",
                time,
                _REACH / 8.0 * turned * turned,
            )
        stop = stop or self._clearance_fault(rest, time, limits.clearance)
        if stop is None:
            self._q, self._v, self._edge, self._sent_time = q, v, edge, time
        return stop

    def _clearance_fault(self, q: Sequence[float], time: float, least: float) -> Stop | None:
        if self._nearest is None:
            return None
        found = self._nearest(q, least)
        if found is None or found[0] >= least:
            return None
        return self._breach(
            "clearance", f"{found[1]} would come near each other", found[0], least, "m", time
        )

    def _carried_on(self, q: list[float], command_time: float, time: float) -> list[float]:
        """Where commands that go on as fast as the last two will be at the time of sending."""
        before, between = self._command, command_time - self._command_time
        if between > _ROUNDING:
            self._command_speed = [(a - b) / between for a, b in zip(q, before, strict=True)]
            self._command, self._command_time = q, command_time
        late = time - command_time
        if late <= _ROUNDING:
            return q[:]
        return [a + late * v for a, v in zip(q, self._command_speed, strict=True)]

    def _position_fault(
        self, q: Sequence[float], edge: EdgePose, what: str, time: float, margin: float = 0.0
    ) -> Stop | None:
        for j in range(6):
            if q[j] > self._upper[j]:
                return self._breach(
                    "joint_upper", f"joint {j + 1} of {what}", q[j], self._upper[j], "rad", time
                )
            if q[j] < self._lower[j]:
                return self._breach(
                    "joint_lower", f"joint {j + 1} of {what}", q[j], self._lower[j], "rad", time
                )
        distance = singular_margin(q)
        if distance < self.limits.singular_margin:
            return self._breach(
                "singular_margin", f"the distance from a singularity of {what}", distance,
                self.limits.singular_margin, "", time,
            )  # fmt: skip
        return self._edge_fault(edge, what, time, margin, margin)

    def _edge_fault(
        self, edge: EdgePose, what: str, time: float, margin: float, tilt_margin: float
    ) -> Stop | None:
        """Limits of the edge, all narrower by a margin, m, and of the tilt (in its cosine)."""
        heel, tip, down = edge
        low, high = self._low, self._high
        for k in range(3):
            a, b = (heel[k], tip[k]) if heel[k] < tip[k] else (tip[k], heel[k])
            if a < low[k] + margin:
                return self._breach(
                    "workspace_lower", f"the edge's {'xyz'[k]} at {what}", a, low[k], "m", time
                )
            if b > high[k] - margin:
                return self._breach(
                    "workspace_upper", f"the edge's {'xyz'[k]} at {what}", b, high[k], "m", time
                )
        lowest = min(heel[2], tip[2])
        if lowest < self._floor + margin:
            return self._breach(
                "board_depth", f"the edge's height at {what}", lowest, self._floor, "m", time
            )
        if down < self._down + tilt_margin:
            angle = math.acos(max(-1.0, min(1.0, down)))
            return self._breach(
                "tilt", f"the blade's tilt at {what}", angle, self.limits.tilt, "rad", time
            )
        return None

    def _brake(self, time: float) -> list[float]:
        """The next target of a stop: slower along the last motion, then the same."""
        v, dt = self._v, time - self._sent_time
        brake_time = max(abs(v[j]) / self._acceleration[j] for j in range(6))
        share = 0.0 if brake_time <= dt else 1.0 - dt / brake_time
        v = [share * x for x in v]
        self._q = [self._q[j] + dt * v[j] for j in range(6)]
        self._v, self._sent_time = v, time
        return self._q[:]

    @staticmethod
    def _breach(
        limit: str, detail: str, value: float, bound: float, unit: str, time: float
    ) -> Stop:
        text = f"{detail}: {value:.6g} {unit}, allowed {bound:.6g}"
        return Stop(limit, text, value, bound, time, True)


def robot_fault(state: RobotState) -> Stop | None:
    """Why nothing may be sent to a robot: safety status, mode, or a program that does not play."""
    bits = state.safety_bits
    if bits & ~SAFE_BITS or not bits & SAFE_BITS:
        detail = f"the robot reports {safety_text(bits)}"
        return Stop("safety_status", detail, bits, SAFE_BITS, state.time, False)
    if state.robot_mode not in (None, RUNNING):
        detail = f"the robot's mode is {state.robot_mode}, wanted {RUNNING} (running)"
        return Stop("robot_mode", detail, float(state.robot_mode), RUNNING, state.time, False)
    runtime = state.runtime_state
    if runtime != PLAYING:
        known = 0 <= runtime < len(RUNTIME_STATES)
        name = RUNTIME_STATES[runtime] if known else "in an unknown state"
        detail = f"the robot's program is {name}"
        return Stop("program", detail, runtime, PLAYING, state.time, False)
    return None


def _payload_text(payload: Sequence[float]) -> str:
    centre = ", ".join(f"{1e3 * x:.1f}" for x in payload[1:])
    return f"{payload[0]:.3f} kg at ({centre}) mm"
