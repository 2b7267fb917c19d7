"""What an agent is trained on: foods, how they vary, the robot, the reward."""

import copy
import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.agent_gains import AgentGains
from sliceit_drake.diagrams.agent_station import AgentStation
from sliceit_drake.diagrams.scenario import Scenario, Start
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.learning.reward import RewardConfig
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig

__all__ = [
    "Limits",
    "RandomizationConfig",
    "TaskConfig",
    "check_task",
    "make_agent_station",
    "station_scenario",
]

MODULUS = "material.youngs_modulus"
VARIED = ("material.toughness", MODULUS, "material.friction")
STIFFER = 1.01
"""By which a food is stiffer than one whose skin would fold around the edge."""


@dc.dataclass(frozen=True)
class Limits:
    """What ends a slice before its goal.

    Attributes:
        force: Greatest force of each component at the sensor, N.
        torque: Greatest torque of each component there, Nm.
        workspace: Greatest errors to the final pose [3], m, m, rad.
    """

    force: float
    torque: float
    workspace: tuple[float, float, float]

    def end(
        self, at_goal: bool, time: float, until: float, wrench: np.ndarray, error: np.ndarray
    ) -> str:
        """Why a slice ends after a decision, or nothing if it goes on.

        It is the goal, a collision (force, torque, or shaking, which the station's monitor finds)
        or workspace.

        Args:
            at_goal: Whether the goal was held for long enough.
            time: Time of the simulation, s; before `until` where the station's monitor ended a run
                that shakes.
            until: Time to which it was to advance, s.
            wrench: Moment and force at the sensor [6].
            error: Error to the final pose [3], m, m, rad.
        """
        if at_goal:
            return "goal"
        if time < until - 1e-6:
            return "shaking"
        torque, force = np.abs(wrench).reshape(2, 3).max(axis=1)
        if force > self.force:
            return "force"
        if torque > self.torque:
            return "torque"
        return "workspace" if (np.abs(error) > self.workspace).any() else ""


@dc.dataclass
class RandomizationConfig:
    """How episodes differ."""

    foods: str = choice("posterior", ("posterior", "uniform", "none"))
    """Where a food's parameters are drawn from: its calibration, a uniform relative noise on
    toughness, modulus and friction, or nowhere. The spring's ERP has its own noise."""
    variants: int = quantity(8, "", low=1, high=1000)
    """Draws prepared of each food, in equal parts on its stations; an episode takes one."""
    noise: float = quantity(0.3, "", low=0.0, high=0.9)
    """Half width of the uniform noise, and of that on ERP."""
    height: list[float] = quantity([0.0, 0.01], "m", low=-0.01, high=0.1, size=2)
    """Range of the start, above its place."""
    offset: float = quantity(0.01, "m", low=0.0, high=0.05)
    """Half width of the start's place along the edge."""
    tilt: float = quantity(0.01, "rad", low=0.0, high=0.1)
    """Half width of the blade's turn about Ky."""
    toughness: list[float] = quantity([0.5, 2.0], "", low=0.1, high=10.0, size=2)
    """Range of a factor on a drawn food's toughness, uniform in its logarithm."""
    modulus: list[float] = quantity([0.5, 2.0], "", low=0.1, high=10.0, size=2)
    """Likewise, on its Young's modulus."""
    stations: int = quantity(3, "", low=1, high=100)
    """Stations prepared of each food, each with a board, sensor and servo of its own; an episode
    takes one."""
    board: list[float] = quantity([0.1, 10.0], "", low=1e-2, high=100.0, size=2)
    """Range of a factor on the board's stiffness, uniform in its logarithm."""
    force_bias: float = quantity(0.3, "N", low=0.0, high=10.0)
    """Standard deviation of the sensor's bias, each axis; 0.6 N is the spread of an FT 300's
    weighings (`WrenchSensorConfig`)."""
    moment_bias: float = quantity(0.02, "Nm", low=0.0, high=1.0)
    """Likewise, of the moment."""
    delay: list[float] = quantity([0.0, 8e-3], "s", low=0.0, high=0.2, size=2)
    """Range of what is added to the sensor's delay."""
    servo_delay: list[float] = quantity([0.0, 4e-3], "s", low=0.0, high=0.1, size=2)
    """Range of the servo's transport delay, in whole steps of the plant."""

    def check(self, where: str) -> None:
        for name in ("height", "toughness", "modulus", "board", "delay", "servo_delay"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ConfigurationError(
                    f"{[low, high]} is no range", field=f"{where}.{name}", fix="Swap the two."
                )


@dc.dataclass
class TaskConfig:
    """A training's task; the same but for `simulator` for an agent and its baseline."""

    simulator: str = choice("cutting", ("cutting", "spring"))
    """cutting: finite elements. spring: the spring-only baseline of SliceIt!."""
    foods: list[str] = dc.field(default_factory=lambda: ["cucumber", "tomato", "potato"])
    """Calibrated foods, by name or file; an episode takes one."""
    randomization: RandomizationConfig = dc.field(default_factory=RandomizationConfig)
    refinement: float = quantity(0.75, "", low=0.3, high=4.0)
    """Elements along an edge, relative to the food's mesh."""
    time_step: float = quantity(2e-3 / 12, "s", low=1e-6, high=2e-3)
    """Longest sub-step of the food, s."""
    work_error: float = quantity(0.1, "", low=0.0, high=0.5)
    """See `Numerics.work_error`. Where an agent turns round or saws, the food moves with the knife,
    and the edge does up to 8 % less work: little beside what foods differ by."""
    board: Board = dc.field(default_factory=Board)
    sensor: WrenchSensorConfig = dc.field(
        default_factory=lambda: WrenchSensorConfig(force_noise=0.2, moment_noise=0.02)
    )
    """Its noise is between an FT 300's resolution and the spread of its weighings."""
    start: Start = dc.field(default_factory=Start)
    agent: AgentConfig = dc.field(default_factory=AgentConfig)
    """`descent` follows from the food and `start`, and `network` and `duration` are not used."""
    reward: RewardConfig = dc.field(default_factory=RewardConfig)
    decisions: int = quantity(500, "", low=1, high=100_000)
    """Most in an episode."""
    workspace: list[float] = quantity([0.05, 0.1, 0.1745], "m, m, rad", low=0.0, size=3)
    """Errors that end an episode."""
    force_limit: float = quantity(50.0, "N", low=0.1)
    """Greatest force of each component; more ends an episode."""
    torque_limit: float = quantity(10.0, "Nm", low=0.1)
    """Greatest torque, likewise."""

    def limits(self) -> Limits:
        """What ends an episode before its goal."""
        x, z, angle = self.workspace
        return Limits(self.force_limit, self.torque_limit, (x, z, angle))

    def check(self, where: str) -> None:
        if not self.foods:
            raise ConfigurationError(
                "names no food", field=f"{where}.foods", fix='Write "[cucumber]".'
            )


def station_scenario(task: TaskConfig, calibrated: CalibratedFood, food: str) -> Scenario:
    """The scenario of a food's station.

    Raises:
        ConfigurationError: The food has no spring, and the task asks for one.
    """
    scenario = Scenario(
        name=f"{food}_{task.simulator}",
        controller=AgentGains().controller(),
        knife=copy.deepcopy(calibrated.knife),
        board=copy.deepcopy(task.board),
        sensor=copy.deepcopy(task.sensor),
        start=copy.deepcopy(task.start),
        numerics=Numerics(time_step=task.time_step, work_error=task.work_error),
    )
    if task.simulator == "cutting":
        food_model = calibrated.held()
        shape = food_model.shape
        if isinstance(shape, Cylinder):
            shape = dc.replace(shape, rings=max(2, round(shape.rings * task.refinement)))
        scenario.food = dc.replace(food_model, shape=shape)
        return scenario
    if calibrated.spring is None:
        raise ConfigurationError(
            f"the calibration of {food} has no spring", field="task.foods", fix="Calibrate it."
        )
    noise = task.randomization.noise if task.randomization.foods != "none" else 0.0
    scenario.food = dc.replace(calibrated.spring, erp_noise=noise)
    return scenario


def make_agent_station(
    task: TaskConfig,
    food: str,
    rng: np.random.Generator,
    meshcat: Meshcat | None = None,
    which: int = 0,
) -> AgentStation:
    """The station `which` of one of a task's foods, with its part of the variants, and the agent.

    Board, sensor, servo and variants are drawn by `rng`. It is shown in `meshcat`, if there is one.

    Raises:
        ConfigurationError: The food cannot be loaded or cut.
    """
    calibrated = load_calibrated_food(food)
    scenario = station_scenario(task, calibrated, food)
    _vary_bench(task.randomization, scenario, rng, which)
    cutting = None
    if task.simulator == "cutting":
        models = _variants(task, calibrated, scenario, rng)
        solvers = [CuttingSolver(model, scenario.exchange_period) for model in models]
        cutting = CuttingSystem(solvers, scenario.X_WF())

    station = MakeStation(scenario, meshcat, cutting=cutting)
    return AgentStation(station, dc.replace(task.agent, descent=station.descent()))


def check_task(task: TaskConfig) -> None:
    """Builds each food's station with one variant, so that what is wrong is said at once.

    Raises:
        ConfigurationError, MeshError, TimeStepError: A food cannot be loaded or cut, or its start
            not be reached.
    """
    few = dc.replace(task, randomization=dc.replace(task.randomization, variants=1))
    for food in task.foods:
        make_agent_station(few, food, np.random.default_rng(0))


def _between(limits: Sequence[float], share: np.ndarray) -> np.ndarray:
    """Numbers between positive limits, uniform in the logarithm of what is uniform in 0 to 1."""
    low, high = limits
    return low * (high / low) ** share


def _spread(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random numbers from 0 to 1 [count], one in each of as many equal parts, in random order."""
    return (rng.permutation(count) + rng.uniform(size=count)) / count


def _vary_bench(
    randomization: RandomizationConfig, scenario: Scenario, rng: np.random.Generator, which: int
) -> None:
    """Draws a scenario's board, sensor and servo."""
    # Few stations fill the range of boards, each a part of it.
    share = (which + rng.uniform(size=1)) / randomization.stations
    factor = float(_between(randomization.board, share)[0])
    scenario.set_board_stiffness(scenario.board.stiffness * factor)
    sensor, robot = scenario.sensor, scenario.robot
    sensor.force_bias = (sensor.force_bias + randomization.force_bias * rng.normal(size=3)).tolist()
    moments = sensor.moment_bias + randomization.moment_bias * rng.normal(size=3)
    sensor.moment_bias = moments.tolist()
    low, high = randomization.delay
    sensor.delay += rng.uniform(low, high)
    low, high = randomization.servo_delay
    steps = round(rng.uniform(low, high) / robot.plant_time_step)
    robot.servo.delay = steps * robot.plant_time_step


def _variants(
    task: TaskConfig, calibrated: CalibratedFood, scenario: Scenario, rng: np.random.Generator
) -> list:
    assert isinstance(scenario.food, Food)
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    draws = _draws(task.randomization, calibrated, scenario.food, rng)
    for k, variant in enumerate(with_parameters(model, draw) for draw in draws):
        if variant.skin_fold > 1.0:
            stiff = STIFFER * variant.skin_fold * variant.material.youngs_modulus
            draws[k] = {**draws[k], MODULUS: stiff}
    spread = max(with_parameters(model, draw).wide_spread for draw in draws)
    scenario.numerics.edge_spread = spread
    model = make_food_model(scenario.food, scenario.knife, scenario.numerics)
    return [with_parameters(model, draw) for draw in draws]


def _draws(
    randomization: RandomizationConfig,
    calibrated: CalibratedFood,
    food: Food,
    rng: np.random.Generator,
) -> list[dict[str, float]]:
    """Parameters of the variants of a station's food."""
    if randomization.foods == "none":
        return [{}]
    count = math.ceil(randomization.variants / randomization.stations)
    at = {name: getattr(food.material, name.split(".")[1]) for name in VARIED}
    if randomization.foods == "posterior":
        draws = list(calibrated.distribution.draw(rng, count))
    else:
        factors = 1.0 + randomization.noise * rng.uniform(-1.0, 1.0, (count, len(VARIED)))
        rows = (factors * list(at.values())).tolist()
        draws = [dict(zip(VARIED, row, strict=True)) for row in rows]
    for name, limits in zip(VARIED, (randomization.toughness, randomization.modulus), strict=False):
        factors = _between(limits, _spread(rng, count))
        draws = [
            draw | {name: draw.get(name, at[name]) * float(factor)}
            for draw, factor in zip(draws, factors, strict=True)
        ]
    return draws
