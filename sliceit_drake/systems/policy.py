"""A policy that decides at 20 Hz how the knife's target moves: its port, and a scripted one.

The port is the smallest that a controller of a station needs (docs/reference/ports.md): a target
pose that moves at decided speeds, and the stiffness and gains of the compliance controller, which a
policy may leave alone. What a policy may do at most stands in the scenario, so that a run can be
checked before it begins, whatever the policy decides.
"""

import dataclasses as dc
import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, DiscreteValues

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Segment
from sliceit_drake.systems.declare import PlainSystem, declare_output, where_and_when

__all__ = [
    "Policy",
    "PolicyAction",
    "PolicyConfig",
    "PolicyObservation",
    "PolicySystem",
    "PressByForce",
    "envelope",
    "envelope_time",
]

# Parts of the motion since the last decision.
_OFFSET, _SPEED, _WANTED, _SINCE = slice(0, 2), slice(2, 4), slice(4, 6), 6

_Corners = Sequence[tuple[float, float]]


class PolicyObservation(NamedTuple):
    """Observation of a policy.

    Attributes:
        time: Since the start, s.
        offset: Offset of the target from the start, along Kx (draw) and Kz (press) there [2], m.
        wrenches: Sensor wrench at this decision and those before, moment and force at So in S, the
            newest last [history, 6], Nm and N; zero before the first.
    """

    time: float
    offset: np.ndarray
    wrenches: np.ndarray


class PolicyAction(NamedTuple):
    """A decision of a policy, which holds until the next.

    Attributes:
        draw, press: Speeds of the target along Kx and Kz of the start, m/s.
        stiffness: Stiffness of the compliance controller [6], N/m and Nm/rad; None for the
            configured one.
        p_gains: Its proportional gains [6]; None for the configured ones.
    """

    draw: float
    press: float
    stiffness: np.ndarray | None = None
    p_gains: np.ndarray | None = None


class Policy(Protocol):
    """Decides; a configuration dataclass, whose fields are its parameters."""

    def decide(self, observation: PolicyObservation) -> PolicyAction:
        """Returns the action until the next decision; the same for the same observation."""


@dc.dataclass
class PressByForce:
    """Presses the slower the more force it meets, then lifts. Scripted, for tests and to compare.

    The speed falls from `fastest` in the air to zero where the mean of the force's history is
    `force`, and turns round beyond.
    """

    fastest: float = quantity(0.03, "m/s", low=1e-4, high=0.5)
    """Speed without force."""
    force: float = quantity(30.0, "N", low=0.1, high=200.0)
    """Force at which it stands still."""
    draw_ratio: float = quantity(0.0, "", low=-10.0, high=10.0)
    """Draw over press."""
    cut_time: float = quantity(2.0, "s", low=0.05, high=600.0)
    """When it begins to lift."""
    lift_speed: float = quantity(0.05, "m/s", low=1e-4, high=0.5)
    """Speed of lifting."""

    def decide(self, observation: PolicyObservation) -> PolicyAction:
        if observation.time >= self.cut_time:
            return PolicyAction(0.0, -self.lift_speed)
        force = float(np.linalg.norm(observation.wrenches[:, 3:], axis=1).mean())
        press = self.fastest * (1.0 - force / self.force)
        return PolicyAction(self.draw_ratio * press, press)


@dc.dataclass
class PolicyConfig:
    """A policy in a scenario, how often it decides, and what it may do at most."""

    decide: PressByForce = dc.field(default_factory=PressByForce)
    """The policy, by its parameters; one that a network decides is an `AgentConfig`."""
    period: float = quantity(0.05, "s", low=0.002, high=1.0)
    """Time between two decisions."""
    history: int = quantity(3, "", low=1, high=100)
    """Wrenches that it sees, one a decision."""
    duration: float = quantity(3.0, "s", low=0.05, high=600.0)
    """Duration of the run."""
    press: float = quantity(0.0372, "m", low=1e-3, high=0.5)
    """Farthest that the target goes down from the start."""
    draw: float = quantity(0.0, "m", low=0.0, high=0.2)
    """Farthest that it goes along the edge, either way."""
    speed: float = quantity(0.05, "m/s", low=1e-4, high=0.5)
    """Greatest speed of the target."""
    acceleration: float = quantity(0.5, "m/s2", low=0.01, high=20.0)
    """With which the speed follows a decision."""

    def check(self, where: str) -> None:
        least = envelope_time(self._corners(), self.speed)
        if self.duration < least:
            raise ConfigurationError(
                f"{self.duration:.4g} s is less than the way through all that the policy may do "
                f"takes at its greatest speed, {least:.4g} s",
                field=f"{where}.duration",
                fix="Lengthen it, or give press and draw less room.",
            )

    def envelope(self) -> MotionPlan:
        """A motion of the run's duration through all corners of where the target may go."""
        return envelope(self._corners(), self.speed, self.duration, "policy")

    def describe(self) -> str:
        """Who decides and what it may do at most, for an operator to read."""
        return (
            f"{type(self.decide).__name__} decides every {self.period:g} s, at most "
            f"{1e3 * self.press:.1f} mm down, {1e3 * self.draw:.1f} mm along the edge, "
            f"{1e3 * self.speed:g} mm/s"
        )

    def _corners(self) -> list[tuple[float, float]]:
        corners = [(0.0, self.press), (self.draw, self.press), (-self.draw, self.press)]
        return corners + [(-self.draw, 0.0), (self.draw, 0.0)] if self.draw > 0.0 else corners


def envelope(corners: _Corners, speed: float, duration: float, label: str) -> MotionPlan:
    """The motion through all places where a policy may take the knife, for checks before a run.

    Straight from corner to corner, then at rest.

    Args:
        corners: x and z in the knife frame at the start, m; the start before the first.
        speed: Speed between the corners, m/s.
        duration: Duration of the whole motion, s.
        label: Label of its segments.
    """
    way: list[Segment] = [
        ConstantSpeed(speed, [dx / distance, 0.0, dz / distance], distance, label=label)
        for dx, dz, distance in _legs(corners)
    ]
    left = duration - envelope_time(corners, speed)
    return MotionPlan([*way, Hold(left, label=label)] if left > 1e-9 else way)


def envelope_time(corners: _Corners, speed: float) -> float:
    """Duration of the path through the corners, s; arguments as for `envelope`."""
    return sum(distance for *_, distance in _legs(corners)) / speed


def _legs(corners: _Corners) -> list[tuple[float, float, float]]:
    legs = []
    for (x, z), (a, b) in itertools.pairwise([(0.0, 0.0), *corners]):
        distance = math.hypot(a - x, b - z)
        if distance > 0.0:
            legs.append((a - x, b - z, distance))
    return legs


class PolicySystem(PlainSystem):
    """A policy as what drives a station.

    It decides at multiples of its period, without a delay in the diagram's time; what it takes of
    the wall clock counts on a robot alone, where `watch` sees it. Each decision changes the speeds
    of the target, within the scenario's bounds; the target goes on at them until the next.

    Inputs:
        sensor_wrench: SpatialForce at So, in S.

    Outputs:
        target_pose: RigidTransform X_WK.
        target_offset: Offset of the target from the start, along Kx and Kz there [2], m.
        stiffness, p_gains: Settings of the compliance controller [6].

    Args:
        config: Policy and bounds.
        X_WK: Pose of the knife at the start.
        stiffness, p_gains: What holds where the policy leaves them alone [6].

    Attributes:
        watch: Entered around each decision.
    """

    def __init__(
        self, config: PolicyConfig, X_WK: RigidTransform, stiffness: object, p_gains: object
    ) -> None:
        super().__init__()
        self._config, self._X_WK = config, X_WK
        self._far = np.array([[-config.draw, 0.0], [config.draw, config.press]])
        self._configured = np.array(stiffness, float), np.array(p_gains, float)
        self.watch: Callable[[], AbstractContextManager] = nullcontext
        wrench = Value(SpatialForce.Zero())
        self._wrench = self.DeclareAbstractInputPort("sensor_wrench", wrench)
        self._motion = self.DeclareDiscreteState(7)
        self._wrenches = self.DeclareDiscreteState(6 * config.history)
        self._settings = [self.DeclareDiscreteState(values) for values in self._configured]
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._decide)
        moving = {self.time_ticket(), self.discrete_state_ticket(self._motion)}
        declare_output(self, "target_pose", Value(RigidTransform()), self._target_pose, moving)
        declare_output(self, "target_offset", 2, lambda context: self._moved(context)[0], moving)
        for name, state in zip(("stiffness", "p_gains"), self._settings, strict=True):
            self.DeclareStateOutputPort(name, state)

    def _decide(self, context: Context, discrete_state: DiscreteValues) -> None:
        config = self._config
        offset, speed = self._moved(context)
        wrench = self._wrench.Eval(context).get_coeffs()
        seen = context.get_discrete_state(self._wrenches).value().reshape(-1, 6)
        history = np.vstack([seen[1:], wrench])
        with self.watch():
            action = config.decide.decide(PolicyObservation(context.get_time(), offset, history))
        if not isinstance(action, PolicyAction):
            raise RuntimeError(
                f"{where_and_when(self, context)} {type(config.decide).__name__}.decide returned "
                f"{action!r}, and no PolicyAction."
            )
        wanted = np.array([action.draw, action.press], float)
        if not np.isfinite(wanted).all():
            raise RuntimeError(
                f"{where_and_when(self, context)} the policy decided for speeds of {wanted} m/s."
            )
        wanted *= min(1.0, config.speed / max(1e-12, math.hypot(*wanted)))
        motion = [*offset, *speed, *wanted, context.get_time()]
        discrete_state.set_value(self._motion, motion)
        discrete_state.set_value(self._wrenches, history.ravel())
        for state, name, old in zip(
            self._settings, ("stiffness", "p_gains"), self._configured, strict=True
        ):
            new = getattr(action, name)
            new = old if new is None else np.asarray(new, float)
            if new.shape != (6,) or not np.isfinite(new).all():
                raise RuntimeError(
                    f"{where_and_when(self, context)} the policy's {name} are {new}, and not six "
                    "numbers."
                )
            discrete_state.set_value(state, new)

    def _moved(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Offset [2], m, and speeds [2], m/s, at the context's time."""
        x = context.get_discrete_state(self._motion).value()
        t, before, change = context.get_time() - x[_SINCE], x[_SPEED], x[_WANTED] - x[_SPEED]
        duration = math.hypot(*change) / self._config.acceleration
        ramp = min(t, duration)
        speed = before + change * (ramp / duration if duration > 0.0 else 0.0)
        offset = x[_OFFSET] + 0.5 * (before + speed) * ramp + speed * (t - ramp)
        inside = np.clip(offset, *self._far)
        return inside, np.where(inside == offset, speed, 0.0)

    def _target_pose(self, context: Context) -> RigidTransform:
        (x, z), _ = self._moved(context)
        return self._X_WK @ RigidTransform([x, 0.0, z])
