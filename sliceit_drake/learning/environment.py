"""The slicing station as a Gymnasium environment.

A plain `gymnasium.Env` around a Drake Simulator, not `pydrake.gym.DrakeGymEnv`: that one turns a
RuntimeError into a truncated step of reward 0, from which an agent learns to fail, and lets all
other errors end the process (1.51).
"""

import copy
import dataclasses as dc
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.agent_station import AgentStation
from sliceit_drake.diagrams.live_view import make_meshcat, viewing_instructions
from sliceit_drake.diagrams.outputs.animation import NEEDED, Film, can_draw
from sliceit_drake.learning.reward import (
    TERMS,
    failed_potential,
    reward_potential,
    reward_terms,
    reward_weights,
)
from sliceit_drake.learning.task import TaskConfig, make_agent_station

__all__ = ["SlicingEnv"]

JERK = slice(6, 9)
VARIANT_SEED = 1


class SlicingEnv(gymnasium.Env):
    """A Gymnasium environment: one slice an episode.

    Observation and action are those of `systems.agent.AgentSystem`.

    `step` returns in `info`: `reward_terms` (before their weights), `shaping` (the reward that the
    potential gives), `cut_progress`, `height` of the edge over the board, m, `force`: the norm of
    food's and board's force on the knife at the decision, N, and at an episode's end `end`: goal,
    a collision (force, torque or shaking), workspace, guard or time. A guard of the simulation that
    ends an episode (an inverted element, say) is `guard_error`, its kind.

    A seed given to `reset` fixes all that follows. The stations and the variants of the foods come
    from a seed of their own, the same in every environment of a task.

    A copy, or what comes out of a pickle, is at the same moment of the same episode: it has
    repeated the actions. The mode "human" shows the station in Meshcat, in real time at most, and
    says on the terminal where; "rgb_array" draws it without a display.

    Args:
        task: What to cut, and how.
        simulator: In place of the task's, see `TaskConfig`.
        food: The only food, in place of the task's; name or file of a calibrated one.
        render_mode: "human", "rgb_array", or None to draw nothing.

    Attributes:
        progress: Fraction of the training that is done, for the reward's schedule.

    Raises:
        ConfigurationError: `simulator` is none, or this machine cannot draw.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}

    def __init__(
        self,
        task: TaskConfig | None = None,
        *,
        simulator: str | None = None,
        food: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.task = task or TaskConfig()
        if simulator is not None:
            self.task = dc.replace(self.task, simulator=simulator)
        if food is not None:
            self.task = dc.replace(self.task, foods=[food])
        validate(self.task, "task")
        if render_mode == "rgb_array" and not can_draw():
            raise ConfigurationError(NEEDED, field="render_mode")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": 1.0 / self.task.agent.period}
        self.progress = 0.0
        size = self.task.agent.observation_size()
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self._built: dict[tuple[str, int], tuple[AgentStation, Simulator]] = {}
        self._current: tuple[AgentStation, Simulator] | None = None
        self._decisions = 0
        self._potential = 0.0
        self._moment: dict[str, Any] = {}
        self._ended = False
        self._pictures: dict[AgentStation, Iterator[np.ndarray]] = {}
        self._meshcat = make_meshcat() if render_mode == "human" else None
        if self._meshcat is not None:
            print(viewing_instructions(self._meshcat.port()), flush=True)

    def __getstate__(self) -> dict[str, Any]:
        # What Drake and Warp hold cannot be copied; it is built and run again.
        names = ("task", "progress", "render_mode", "spec", "_moment")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["task"], render_mode=state["render_mode"])  # type: ignore[misc]
        self.progress, self.spec = state["progress"], state["spec"]
        if state["_moment"]:
            self.return_to(state["_moment"])

    def render(self) -> np.ndarray | None:
        """In the mode "rgb_array" a picture [480, 640, 3] of arm, knife and food, 0 to 255.

        Raises:
            RuntimeError: The environment was not reset.
        """
        if self._current is None:
            raise RuntimeError("render() before reset(): call reset() first.")
        if self.render_mode != "rgb_array":
            return None
        station, simulator = self._current
        if station not in self._pictures:
            film, context = Film(station.station, 1.0), simulator.get_context()
            film.frame(context)
            self._pictures[station] = film.draw(iter(lambda: film.frame(context), None))
        return next(self._pictures[station])

    def moment(self) -> dict[str, Any]:
        """Where the episode is, for `return_to`, as plain data: how it began, the actions since.

        Raises:
            RuntimeError: The environment was not reset.
        """
        if not self._moment:
            raise RuntimeError("moment() before reset(): call reset() first.")
        return copy.deepcopy(self._moment)

    def return_to(self, moment: dict[str, Any]) -> np.ndarray:
        """Repeats an episode up to a moment of it; all goes on from there as it did then.

        The moment may be of another environment with the same task. Returns the observation.
        """
        self.np_random.bit_generator.state = copy.deepcopy(moment["random"])
        observation, _ = self.reset(options=moment["options"])
        for action in moment["actions"]:
            observation, *_ = self.step(action)
        return observation

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins a slice.

        Args:
            seed: Seed of all random numbers from here on.
            options: "food": one of the task's foods, instead of a random one.

        Raises:
            ValueError: The task has no such food, or there is no such option. All stays as it was.
        """
        foods, randomization = self.task.foods, self.task.randomization
        if unknown := set(options or {}) - {"food"}:
            raise ValueError(f"there is no option {sorted(unknown)}; there is food.")
        if options and options["food"] not in foods:
            raise ValueError(
                f"the task has no food {options['food']!r}; it has {', '.join(foods)}."
            )
        super().reset(seed=seed)
        rng = self.np_random
        state = copy.deepcopy(rng.bit_generator.state)
        self._moment = {"random": state, "options": options, "actions": []}
        self._ended = False
        food = foods[int(rng.integers(len(foods)))]
        low, high = randomization.height
        up = float(rng.uniform(low, high))
        along = float(rng.uniform(-1.0, 1.0)) * randomization.offset
        turn = float(rng.uniform(-1.0, 1.0)) * randomization.tilt
        which = int(rng.integers(randomization.stations))
        food = (options or {}).get("food", food)
        self._current = station, simulator = self._station(food, which)
        shift = RigidTransform(RotationMatrix.MakeYRotation(turn), [along, 0.0, -up])
        station.begin(simulator, rng, shift)
        self._decisions = 0
        self._potential = reward_potential(self.task.reward, *self._come())
        return self._observation(), {"food": food}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes a decision and advances by its period.

        Raises:
            ValueError: The action is not six finite numbers.
            RuntimeError: The environment was not reset, or the slice has ended.
        """
        if self._current is None or self._ended:
            when = "after the slice has ended" if self._ended else "before reset()"
            raise RuntimeError(f"step() {when}: call reset() first.")
        action = np.asarray(action, float)
        if action.shape != (6,) or not np.isfinite(action).all():
            raise ValueError(f"an action is six finite numbers within [-1, 1]; this is {action}.")
        station, simulator = self._current
        context = simulator.get_mutable_context()
        station.GetInputPort("action").FixValue(context, action)
        self._moment["actions"].append(action.tolist())
        self._decisions += 1
        config, end, guard, message = self.task.reward, "", "", ""
        try:
            simulator.AdvanceTo(self._decisions * self.task.agent.period)
        except CuttingError as failure:
            end, guard, message = "guard", type(failure).__name__, str(failure)
        observation = self._observation()
        error, wrench = self._output("error"), self._output("wrench")
        terms = reward_terms(config, float(error[1]), wrench[:2], observation[JERK])
        reward = float(reward_weights(config, self.progress) @ terms)
        end = end or self._end(context.get_time(), error)
        before, self._potential = self._potential, reward_potential(config, *self._come())
        if end == "goal":
            self._potential = 0.0
            reward += config.goal
        elif end:
            self._potential = failed_potential(config, *self._come())
            reward += config.collision
        shaping = config.discount * self._potential - before
        reward += shaping
        food, board = self._output("food_wrench_vector"), self._output("board_wrench_vector")
        info: dict[str, Any] = {
            "reward_terms": dict(zip(TERMS, terms.tolist(), strict=True)),
            "shaping": shaping,
            "cut_progress": float(self._output("cut_progress")[0]),
            "height": float(error[1]),
            "force": float(np.linalg.norm(food[3:] + board[3:])),
        }
        if guard:
            info["guard_error"], info["guard_message"] = guard, message
        truncated = not end and self._decisions >= self.task.decisions
        self._ended = bool(end) or truncated
        if end or truncated:
            info["end"] = end or "time"
            info["is_success"] = end == "goal"
        return observation, reward, bool(end), truncated, info

    def _station(self, food: str, which: int) -> tuple[AgentStation, Simulator]:
        if (food, which) not in self._built:
            rng = np.random.default_rng([VARIANT_SEED, self.task.foods.index(food), which])
            station = make_agent_station(self.task, food, rng, self._meshcat, which)
            simulator = Simulator(station)
            if self.render_mode == "human":
                simulator.set_target_realtime_rate(1.0)
            self._built[food, which] = station, simulator
        return self._built[food, which]

    def _output(self, port: str) -> Any:
        """Value of an output port of the station."""
        assert self._current is not None
        station, simulator = self._current
        return station.GetOutputPort(port).Eval(simulator.get_context())

    def _observation(self) -> np.ndarray:
        return self._output("observation").astype(np.float32)

    def _come(self) -> tuple[float, float]:
        """Height over the board, m, and fraction of the decisions at the goal."""
        share = float(self._output("at_goal")[0]) / max(self.task.agent.goal_decisions, 1)
        return float(self._output("error")[1]), share

    def _end(self, time: float, error: np.ndarray) -> str:
        """Why the episode ends, or nothing."""
        agent = self.task.agent
        at_goal = self._output("at_goal")[0] > agent.goal_decisions
        wrench = self._output("sensor_wrench").get_coeffs()
        return self.task.limits().end(at_goal, time, self._decisions * agent.period, wrench, error)
