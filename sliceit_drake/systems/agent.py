"""The SliceIt! agent as a Drake system: what it observes, and what its six numbers do.

The same system serves training, where the action is an input port, and deployment, where a network
decides inside it. Facts of the original: Beltran-Hernandez et al., SliceIt! (2024), and its code.
What differs, and why:

- The authors double stiffness and gains before they send them. The ranges here are doubled, too.
- They map [0, 1], not [-1, 1], to a range, so that half of each action does nothing. Here the whole
  range is used (`mapping: whole`); `upper` is theirs.
- Their increments of the rotation about y are off in the cutting configuration (greatest rate 0).
  Here that action moves the target's depth. With a fixed target at the board the vertical spring
  (2,000 N/m) pulls with less than a food resists over the last millimetres, so that no policy could
  end a slice in either simulator.
- The error is to the final pose, with the edge on the board. The agent also observes how far its
  actions have moved the target from there.
- A slice that still holds at 2 mm is not cut. The goal asks for 0.2 mm over the board, and sets no
  lower bound, because a board gives. On the scale of the observed error 0.2 mm is 0.003, and the
  slice ends when the edge has been there for long enough. Two more numbers are observed: the height
  within 2 mm, and the fraction of the decisions at the goal that end a slice.
"""

import dataclasses as dc
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, DiscreteStateIndex, DiscreteValues

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.motion import MotionPlan
from sliceit_drake.systems.agent_rule import PROGRESS, AgentRule
from sliceit_drake.systems.declare import (
    PlainSystem,
    declare_cached,
    declare_output,
    where_and_when,
)
from sliceit_drake.systems.policy import envelope, envelope_time

__all__ = ["ACTIONS", "ERROR", "AgentConfig", "AgentSystem", "Decide", "observation_names"]

ACTIONS = ("stiffness_x", "stiffness_ry", "p_z", "p_ry", "draw", "press")
"""What the numbers of an action decide."""

Decide = Callable[[np.ndarray], np.ndarray]
"""Function from an observation to an action [6], each within [-1, 1]."""

ERROR = np.array([0.1, 0.06, 0.785])
"""Scales of the observed error, m, m, rad, as those below SliceIt!'s."""
VELOCITY = np.array([0.5, 0.5, 0.785])
JERK = 500.0
WRENCH = np.array([50.0, 50.0, 10.0])
NEAR = 2e-3
"""Scale of the height over the board where it is small, metres; ours."""

FELT = 4
"""Newest readings whose mean is the force that a rule feels."""

ENVELOPE_SPEED = 0.05
"""Speed on the path through all places where the knife may go, m/s."""


@dc.dataclass
class AgentConfig:
    """The SliceIt! agent in a scenario: its network, and what it may do."""

    network: str = ""
    """Exported network (`sliceit train`), relative to the resources or to the working directory."""
    rule: AgentRule | None = None
    """Decides in the place of a network; with one, the network corrects what it decides."""
    descent: float = quantity(0.037, "m", low=1e-3, high=0.5)
    """Height of the edge over the board at the start."""
    duration: float = quantity(8.0, "s", low=0.05, high=600.0)
    """Duration of the run."""
    period: float = quantity(0.05, "s", low=0.002, high=1.0)
    """Time between two decisions."""
    history: int = quantity(12, "", low=1, high=100)
    """Force/torque readings that it sees."""
    reading_period: float = quantity(0.01, "s", low=0.002, high=1.0)
    """Time between two of these readings."""
    mapping: str = choice("whole", ("whole", "upper"))
    """Part of [-1, 1] that spans the ranges of stiffness and gains; upper: [0, 1], as in SliceIt!'s
    code."""
    stiffness_x: list[float] = quantity([1000.0, 10000.0], "N/m", low=0.0, high=1e5, size=2)
    """Range, along the edge."""
    stiffness_ry: list[float] = quantity([40.0, 200.0], "Nm/rad", low=0.0, high=1e4, size=2)
    """Range, about Ky."""
    p_z: list[float] = quantity([0.02, 0.1], "", low=0.0, size=2)
    """Range of the gain, down."""
    p_ry: list[float] = quantity([0.2, 3.0], "", low=0.0, size=2)
    """Range of the gain about Ky."""
    error_scale: list[float] = quantity([0.15, 0.25], "", low=0.0, size=2)
    """Error scale far from the final pose, and at it; its factor: docs/explanation/control.md."""
    draw_increment: float = quantity(2e-3, "m", low=0.0, high=0.05)
    """Greatest move of the target along Kx in a decision."""
    press_increment: float = quantity(2e-3, "m", low=0.0, high=0.05)
    """Greatest move of the target down in a decision."""
    draw: float = quantity(0.035, "m", low=0.0, high=0.2)
    """Farthest that the target goes along Kx, either way."""
    overtravel: float = quantity(0.03, "m", low=0.0, high=0.1)
    """Farthest that the target goes below the board."""
    lead: float = quantity(0.8, "", low=0.01, high=1.0)
    """Fraction of the way to the target that a decision aims at."""
    goal: list[float] = quantity([0.04, 2e-4, 0.04], "m, m, rad", low=0.0, size=3)
    """Error along Kx, height over the board and error about Ky within which the slice ends."""
    goal_decisions: int = quantity(10, "", low=0, high=1000)
    """Decisions within the goal, after which the slice ends."""
    goal_lost: float = quantity(2e-3, "m", low=0.0, high=0.1)
    """Height over the board above which they are counted anew. Up to it the count stands still: the
    edge rises by some tenths of a millimetre where a draw turns round."""
    lift_speed: float = quantity(0.05, "m/s", low=1e-3, high=0.5)
    """Speed of the target upwards once the slice has ended."""

    def check(self, where: str) -> None:
        ratio = self.period / self.reading_period
        if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
            raise ConfigurationError(
                f"{self.reading_period:g} s does not divide the period of {self.period:g} s",
                field=f"{where}.reading_period",
                fix=f"Give {self.period:g} over a whole number.",
            )
        for name in ("stiffness_x", "stiffness_ry", "p_z", "p_ry"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ConfigurationError(
                    f"{low:g} to {high:g} is no range", field=f"{where}.{name}", fix="Swap them."
                )
        least = envelope_time(self._corners(), ENVELOPE_SPEED)
        if self.duration < least:
            raise ConfigurationError(
                f"{self.duration:.4g} s is less than the {least:.4g} s of the way through all "
                f"places where the knife may go, at {1e3 * ENVELOPE_SPEED:g} mm/s",
                field=f"{where}.duration",
                fix="Lengthen it, or give draw less room.",
            )

    def observation_size(self) -> int:
        """How many numbers an observation has."""
        return len(observation_names(self.history))

    def describe(self) -> str:
        """Who decides and what it may do at most, for an operator to read."""
        who = f"the network {self.network}" if self.network else ""
        if self.rule is not None:
            rule = f"a rule that keeps to {self.rule.level:g} N"
            who = f"{rule}, corrected by {who}," if who else rule
        return (
            f"{who} decides every {self.period:g} s how compliant the knife "
            f"is, at most {1e3 * self.descent:.1f} mm down, {1e3 * self.draw:.1f} mm along the "
            f"edge; its target lies up to {1e3 * self.overtravel:g} mm below the board"
        )

    def envelope(self) -> MotionPlan:
        """A motion of the run's duration through the corners of where the knife may go.

        The target may lie below the board; the knife stays on it.
        """
        return envelope(self._corners(), ENVELOPE_SPEED, self.duration, "agent")

    def _corners(self) -> list[tuple[float, float]]:
        draw, down = self.draw, self.descent
        return [(0.0, down), (draw, down), (-draw, down), (-draw, 0.0), (draw, 0.0)]


def observation_names(history: int) -> list[str]:
    """Names of an observation's numbers, in order; all are scaled as SliceIt! scales them."""
    axes = ("x", "z", "ry")
    names = [f"{part}_{axis}" for part in ("error", "velocity", "jerk") for axis in axes]
    names += [f"last_{name}" for name in ACTIONS] + ["target_x", "target_z"]
    names += ["near", "at_goal"]
    return names + [
        f"{axis}_{k}" for k in range(1 - history, 1) for axis in ("force_x", "force_z", "moment_y")
    ]


class AgentSystem(PlainSystem):
    """Decides at multiples of its period how compliant the knife is and where its target lies.

    Errors and offsets are along and about the axes of K as it was at the start: x along the edge,
    z down; readings along and about those of K itself. Once the goal is reached the target goes up
    to the start.

    Inputs:
        sensor_wrench: SpatialForce at So, in S.
        knife_pose: RigidTransform X_WK.
        action: [6], each within [-1, 1]; where no network decides. With a rule it corrects that.

    Outputs:
        target_pose: RigidTransform X_WK.
        target_offset: Offset of the target from the start, along Kx and Kz there [2], m.
        stiffness, p_gains, error_scale: Settings of the compliance controller [6], [6], [1].
        observation: What a decision at this instant would be taken by, see `observation_names`.
        error: Distance to the final pose, along Kx and Kz and about Ky [3], m and rad.
        wrench: Mean of the readings seen: force along Kx and Kz, moment about Ky at Ko [3].
        at_goal: Decisions within the goal since the knife was last lifted from it [1].

    Args:
        config: What the agent may do.
        X_WK: Pose of the knife at the start.
        X_KS: Pose of the sensor in the knife's frame.
        stiffness, p_gains: What it leaves alone of the controller's [6].
        decide: Function from observation to action; None to read the port `action`.

    Attributes:
        watch: Entered around each decision.
    """

    def __init__(
        self,
        config: AgentConfig,
        X_WK: RigidTransform,
        X_KS: RigidTransform,
        stiffness: object,
        p_gains: object,
        decide: Decide | None = None,
    ) -> None:
        super().__init__()
        self._config, self._X_WK, self._X_KW = config, X_WK, X_WK.inverse()
        self._decide_action = decide
        # From moment and force at So, in S, to the force along Kx and Kz and the moment about Ky at
        # Ko, which grows by the force's arm.
        R = X_KS.rotation().matrix()
        about_Ko = np.hstack([R, np.cross(X_KS.translation(), R.T).T])
        self._of_wrench = np.array([[0, 0, 0, *R[0]], [0, 0, 0, *R[2]], about_Ko[1]])
        self.watch: Callable[[], AbstractContextManager] = nullcontext
        self._wrench_in = self.DeclareAbstractInputPort("sensor_wrench", Value(SpatialForce.Zero()))
        self._pose_in = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._action_in = None
        if decide is None:
            self._action_in = self.DeclareVectorInputPort("action", len(ACTIONS))
        # Errors at the last three decisions, the newest first; the action, and the offset of the
        # target from the final pose that all actions have added up to; the target's place.
        self._errors = self.DeclareDiscreteState(np.tile([0.0, config.descent, 0.0], 3))
        self._action = self.DeclareDiscreteState(len(ACTIONS))
        self._offset = self.DeclareDiscreteState(2)
        self._place = self.DeclareDiscreteState(2)
        self._stiffness = self.DeclareDiscreteState(np.array(stiffness, float))
        self._p_gains = self.DeclareDiscreteState(np.array(p_gains, float))
        self._error_scale = self.DeclareDiscreteState([config.error_scale[0]])
        self._at_goal = self.DeclareDiscreteState(1)
        # When the slice ended and the target began to rise; negative before.
        self._lift_time = self.DeclareDiscreteState([-1.0])
        # Least height over the board, by steps of `PROGRESS`, and the time since it was reached.
        self._lowest = self.DeclareDiscreteState([config.descent, 0.0])
        # The oldest of the readings is dropped when the newest is taken, so one fewer is kept.
        self._readings = self.DeclareDiscreteState(np.zeros(3 * (config.history - 1)))
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._decide)
        self.DeclarePeriodicDiscreteUpdateEvent(config.reading_period, 0.0, self._read)
        held = {self.discrete_state_ticket(each) for each in (self._place, self._lift_time)}
        moving = held | {self.time_ticket()}
        # Until the knife is lifted the target moves at decisions alone, but is read far more often.
        self._waiting = declare_cached(
            self,
            "target until the lift",
            lambda context: None if self.is_done(context) else self._pose_there(context),
            held,
        )
        declare_output(self, "target_pose", Value(RigidTransform()), self._target_pose, moving)
        declare_output(self, "target_offset", 2, self._target, moving)
        for name, state in (
            ("stiffness", self._stiffness),
            ("p_gains", self._p_gains),
            ("error_scale", self._error_scale),
            ("at_goal", self._at_goal),
        ):
            self.DeclareStateOutputPort(name, state)
        seen = {self.xd_ticket(), self._wrench_in.ticket(), self._pose_in.ticket()}
        for name, size, calc in (
            ("observation", config.observation_size(), self.observe),
            ("error", 3, self._error),
            ("wrench", 3, lambda context: self._history(context).mean(axis=0)),
        ):
            declare_output(self, name, size, calc, seen)

    def observe(self, context: Context) -> np.ndarray:
        """The observation in this context, float64."""
        config, T = self._config, self._config.period
        e = np.vstack([self._error(context), self._value(context, self._errors).reshape(3, 3)])
        velocity = (e[1] - e[0]) / T
        jerk = -(e[0] - 3.0 * e[1] + 3.0 * e[2] - e[3]) / T**3
        reach = np.maximum([config.draw, config.overtravel], 1e-9)
        at_goal = self._value(context, self._at_goal)[0] / max(config.goal_decisions, 1)
        return np.concatenate(
            [
                e[0] / ERROR,
                velocity / VELOCITY,
                jerk / JERK,
                self._value(context, self._action),
                self._value(context, self._offset) / reach,
                [np.clip(e[0, 1] / NEAR, -1.0, 1.0), at_goal],
                (self._history(context) / WRENCH).ravel(),
            ]
        )

    def is_done(self, context: Context) -> bool:
        """Whether the goal has been reached and the knife is lifted."""
        return bool(self._value(context, self._lift_time)[0] >= 0.0)

    @staticmethod
    def _value(context: Context, state: DiscreteStateIndex) -> np.ndarray:
        return context.get_discrete_state(state).value()

    def _error(self, context: Context) -> np.ndarray:
        X = (self._X_KW @ self._pose_in.Eval(context)).GetAsMatrix34()
        angle = math.atan2(X[0, 2], X[2, 2])
        return np.array([-X[0, 3], self._config.descent - X[2, 3], -angle])

    def _history(self, context: Context) -> np.ndarray:
        before = self._value(context, self._readings).reshape(-1, 3)
        return np.vstack([before, self._of_wrench @ self._wrench_in.Eval(context).get_coeffs()])

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> None:
        # Wherever the knife is, it rests there: no velocity or jerk comes of the way from X_WK.
        discrete_state.set_value(self._errors, np.tile(self._error(context), 3))

    def _read(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._readings, self._history(context)[1:].ravel())

    def _decide(self, context: Context, discrete_state: DiscreteValues) -> None:
        config, error = self._config, self._error(context)
        if not self.is_done(context):
            self._act(context, discrete_state, error)
            is_beside = bool((np.abs(error[[0, 2]]) > np.array(config.goal)[[0, 2]]).any())
            is_lost = is_beside or error[1] > max(config.goal_lost, config.goal[1])
            count = 0.0 if is_lost else self._value(context, self._at_goal)[0]
            if not is_beside and error[1] <= config.goal[1]:
                count += 1.0
            discrete_state.set_value(self._at_goal, [count])
            if count > config.goal_decisions:
                discrete_state.set_value(self._lift_time, [context.get_time()])
                discrete_state.set_value(self._place, [-error[0], config.descent - error[1]])
        lowest, waited = self._value(context, self._lowest)
        lower = error[1] <= lowest - PROGRESS
        waits = [error[1], 0.0] if lower else [lowest, waited + config.period]
        discrete_state.set_value(self._lowest, waits)
        before = self._value(context, self._errors)
        discrete_state.set_value(self._errors, np.concatenate([error, before[:6]]))

    def _act(self, context: Context, discrete_state: DiscreteValues, error: np.ndarray) -> None:
        config = self._config
        if self._decide_action is not None:
            with self.watch():
                action = np.asarray(self._decide_action(self.observe(context)), float)
        else:
            assert self._action_in is not None
            action = self._action_in.Eval(context)
        if action.shape != (len(ACTIONS),) or not np.isfinite(action).all():
            raise RuntimeError(
                f"{where_and_when(self, context)} the policy decided for {action}; {len(ACTIONS)} "
                f"finite numbers are needed ({', '.join(ACTIONS)})."
            )
        action = np.clip(action, -1.0, 1.0)
        if config.rule is not None:
            by_rule = self._by_rule(config.rule, context, error)
            action = np.clip(by_rule + config.rule.correction * action, -1.0, 1.0)
        share = 0.5 * (action[:4] + 1.0) if config.mapping == "whole" else np.maximum(action[:4], 0)
        ranges = np.array([config.stiffness_x, config.stiffness_ry, config.p_z, config.p_ry])
        chosen = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        stiffness, p_gains = (
            self._value(context, state).copy() for state in (self._stiffness, self._p_gains)
        )
        stiffness[[0, 4]], p_gains[[2, 4]] = chosen[:2], chosen[2:]
        far, near = config.error_scale
        distance = math.hypot(error[0], error[1])
        scale = far + (near - far) * (1.0 - math.tanh(100.0 * distance))
        moved = self._value(context, self._offset) + action[4:] * [
            config.draw_increment,
            config.press_increment,
        ]
        offset = np.clip(moved, [-config.draw, 0.0], [config.draw, config.overtravel])
        place = np.array([-error[0], config.descent - error[1]])
        final = offset + [0.0, config.descent]
        for state, value in (
            (self._action, action),
            (self._offset, offset),
            (self._place, place + config.lead * (final - place)),
            (self._stiffness, stiffness),
            (self._p_gains, p_gains),
            (self._error_scale, [scale]),
        ):
            discrete_state.set_value(state, value)

    def _by_rule(self, rule: AgentRule, context: Context, error: np.ndarray) -> np.ndarray:
        force = float(np.hypot(*self._history(context)[-FELT:, :2].mean(axis=0)))
        place = self._value(context, self._offset)[0] / max(self._config.draw, 1e-9)
        way = self._value(context, self._action)[ACTIONS.index("draw")]
        speed = (self._value(context, self._errors)[1] - error[1]) / self._config.period
        waited = self._value(context, self._lowest)[1]
        return rule.action(
            float(error[1]), float(speed), force, float(place), float(way), float(waited)
        )

    def _target(self, context: Context) -> np.ndarray:
        """The target's place from the start, along Kx and Kz [2], m."""
        place = self._value(context, self._place)
        if not self.is_done(context):
            return place
        lift_time = self._value(context, self._lift_time)[0]
        risen = self._config.lift_speed * (context.get_time() - lift_time)
        return np.array([place[0], max(place[1] - risen, 0.0)])

    def _target_pose(self, context: Context) -> RigidTransform:
        return self._waiting.Eval(context) or self._pose_there(context)

    def _pose_there(self, context: Context) -> RigidTransform:
        x, z = self._target(context)
        return self._X_WK @ RigidTransform([x, 0.0, z])
