"""Worlds in which a trained agent is evaluated, and which no training sees.

A world gives the slices of a food, one scenario each. Two stand for reality:

- `StandInWorld`: finite elements, finer in mesh and step than a training's, with other parameters
  than the calibrated ones, which also differ from slice to slice, and with effects that no training
  has (`HIDDEN`).
- `CurvesWorld`: measured curves of force over depth with laws of their own (`curve_cutter`). It
  shares no code with the finite elements or the spring; of a calibrated food it takes size and
  knife.

In both the food lies and the knife starts a millimetre or so from where training has it, food
differs in size, and the wrench sensor has noise, bias and delay. All of it follows from the world's
seed, the food and the slice's index alone. Both are simulated: a table made from them must say so.
"""

import copy
import dataclasses as dc
import math
import typing
import zlib

import numpy as np

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.diagrams.agent_gains import AgentGains
from sliceit_drake.diagrams.scenario import Placement, Scenario, Start
from sliceit_drake.stand_in.curve_cutter import CurveFood
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig

__all__ = [
    "SLICING_FOODS",
    "CurvesWorld",
    "SlicingWorld",
    "StandInWorld",
    "WorldSlice",
    "paper_slices",
]

PAPER_SLICES = {"cucumber": 15, "tomato": 5, "potato": 10, "carrot": 5}
SLICING_FOODS = tuple(PAPER_SLICES)

TOUGHNESS, MODULUS, FRICTION = 1.15, 1.1, 0.8
"""Means of the stand-in's parameters over the calibrated ones."""

SPREAD = 0.1
"""Spread of the logarithms of toughness, modulus and friction from slice to slice."""

SIZE_SPREAD = 0.02
"""Spread of the logarithm of the food's diameter."""

PLACE_SPREAD = 1e-3
"""Spread of the food's place on the board, with the cut, and of the start along the edge and in
height, metres. The cut stays on a layer of the mesh: off it, the tomato's thin elements invert in
its tough middle, with or without hidden effects."""

LARGEST = 2.5
"""Deviations go no further than this many spreads."""

FORCE_NOISE, MOMENT_NOISE = 0.2, 0.02
FORCE_BIAS, MOMENT_BIAS = 0.3, 0.02
"""The wrench sensor's, N and Nm: between an FT 300's resolution of 0.1 N and the 0.6 N by which
its weighings spread (`WrenchSensorConfig`). Biases differ from slice to slice, by this spread."""

DELAY = 4e-3
"""Delay of the wrench sensor, s: two coupling steps."""


@dc.dataclass(frozen=True)
class _Hidden:
    """Effects of the stand-in that no training has, in parameter groups of `cutting.foods.effects`.

    Attributes:
        rate: Exponent of the toughness by the edge's speed.
        relaxing, time: Fraction of the modulus that relaxes, and with which time, s.
        adhesion: Shear of food that sticks to the flanks, Pa; 300 Pa on a cucumber's 11 cm^2 of
            flank are 0.3 N, on a tomato's 36 cm^2 1.1 N.
        bluntness: Excess of the toughness where the edge enters, over the toughness.
    """

    rate: float = 0.06
    relaxing: float = 0.15
    time: float = 0.2
    adhesion: float = 300.0
    bluntness: float = 0.3


HIDDEN = _Hidden()


def paper_slices(food: str) -> int:
    """How many slices of a food the SliceIt! paper cuts in its evaluation.

    Raises:
        ConfigurationError: It cuts none.
    """
    if food not in PAPER_SLICES:
        raise ConfigurationError(
            f"{food!r} is not cut in the evaluation",
            field="foods",
            fix=f"Give one of {', '.join(SLICING_FOODS)}.",
        )
    return PAPER_SLICES[food]


class WorldSlice(typing.NamedTuple):
    """A slice of a world.

    Attributes:
        scenario: With the controller that the agent needs.
        cutting: What `MakeStation` shall cut in place of the scenario's food, or None.
    """

    scenario: Scenario
    cutting: CurveFood | None

    @property
    def food(self) -> object:
        """What is cut."""
        return self.cutting or self.scenario.food


class SlicingWorld(typing.Protocol):
    """Gives slices to be cut."""

    def scenario(self, food: str, slice: int, board_stiffness: float | None = None) -> WorldSlice:
        """One slice; the same for the same food and index.

        Args:
            food: One of `SLICING_FOODS`.
            slice: Index of the slice, from 0.
            board_stiffness: N/m; None for the default board.

        Raises:
            ConfigurationError: The food or the index is none.
        """
        ...

    def rng(self, food: str, slice: int) -> np.random.Generator:
        """Random numbers of a slice while it is cut, as of the sensor's noise: give them to
        `AgentStation.begin`."""
        ...


SLICE, RUN = range(2)
"""Independent streams of random numbers."""


def _rng(world: str, seed: int, food: str, slice: int, stream: int) -> np.random.Generator:
    paper_slices(food)
    if slice < 0:
        raise ConfigurationError(f"is {slice}", field="slice", fix="Give 0 or more.")
    names = (zlib.crc32(text.encode()) for text in (world, food))
    return np.random.default_rng([seed, *names, slice, stream])


def _deviations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Standard normal numbers [count], cut off at `LARGEST`."""
    return np.clip(rng.normal(size=count), -LARGEST, LARGEST)


def _scenario(
    name: str, calibrated: CalibratedFood, board_stiffness: float | None, rng: np.random.Generator
) -> Scenario:
    """All of a slice's scenario but its food."""
    start = Start()
    along, up = (PLACE_SPREAD * _deviations(rng, 2)).tolist()
    placement = Placement()
    shifted = np.array(placement.position) + PLACE_SPREAD * _deviations(rng, 2)
    placement.position = shifted.tolist()
    bias = _deviations(rng, 6) * np.repeat([FORCE_BIAS, MOMENT_BIAS], 3)
    scenario = Scenario(
        name=name,
        controller=AgentGains().controller(),
        knife=copy.deepcopy(calibrated.knife),
        placement=placement,
        start=Start(clearance=start.clearance + up, offset=start.offset + along),
        sensor=WrenchSensorConfig(
            force_bias=bias[:3].tolist(),
            moment_bias=bias[3:].tolist(),
            force_noise=FORCE_NOISE,
            moment_noise=MOMENT_NOISE,
            delay=DELAY,
            seed=int(rng.integers(2**31)),
        ),
    )
    if board_stiffness is not None:
        _set_board(scenario, board_stiffness)
    return scenario


def _set_board(scenario: Scenario, stiffness: float) -> None:
    """Gives a scenario a board, and the plant as many steps in an impact as the default has."""
    board, robot = scenario.board, scenario.robot
    # The duration of an impact goes with the root of the stiffness.
    steps = scenario.exchange_period / robot.plant_time_step
    steps *= max(1.0, math.sqrt(stiffness / board.stiffness))
    robot.plant_time_step = scenario.exchange_period / math.ceil(steps)
    board.stiffness = stiffness


def _diameter(calibrated: CalibratedFood, rng: np.random.Generator) -> float:
    shape = calibrated.food.shape
    assert isinstance(shape, Cylinder)
    return shape.diameter * float(np.exp(SIZE_SPREAD * _deviations(rng, 1)[0]))


@dc.dataclass
class StandInWorld:
    """Finite elements with hidden effects, finer than a training's; see `SlicingWorld`."""

    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of all deviations."""
    refinement: float = quantity(1.25, "", low=0.3, high=4.0)
    """Elements along an edge, relative to the food's mesh."""
    time_step: float = quantity(1e-4, "s", low=1e-6, high=2e-3)
    """Sub-step of the food."""

    def scenario(self, food: str, slice: int, board_stiffness: float | None = None) -> WorldSlice:
        """One slice; see `SlicingWorld`."""
        rng = _rng("stand_in", self.seed, food, slice, SLICE)
        calibrated = load_calibrated_food(food)
        scenario = _scenario(f"{food}_stand_in_{slice}", calibrated, board_stiffness, rng)
        scenario.numerics = Numerics(
            flank_stiffness=calibrated.flank_stiffness, time_step=self.time_step
        )
        scenario.food = self._food(calibrated, rng)
        return WorldSlice(scenario, None)

    def rng(self, food: str, slice: int) -> np.random.Generator:
        """See `SlicingWorld`."""
        return _rng("stand_in", self.seed, food, slice, RUN)

    def _food(self, calibrated: CalibratedFood, rng: np.random.Generator) -> Food:
        food = calibrated.apply_to(copy.deepcopy(calibrated.food))
        shape, material, effects = food.shape, food.material, food.effects
        assert isinstance(shape, Cylinder)
        shape.rings = round(self.refinement * shape.rings)
        count = round(self.refinement * (len(shape.layers) - 1)) + 1
        places = np.linspace(0.0, len(shape.layers) - 1.0, count)
        shape.layers = np.interp(places, np.arange(len(shape.layers)), shape.layers).tolist()
        shape.diameter = _diameter(calibrated, rng)
        tough, stiff, rub = np.exp(SPREAD * _deviations(rng, 3)).tolist()
        material.toughness *= TOUGHNESS * tough
        material.youngs_modulus *= MODULUS * stiff
        material.friction *= FRICTION * rub
        effects.toughness_rate.exponent = HIDDEN.rate
        effects.relaxation.shares, effects.relaxation.times = [HIDDEN.relaxing], [HIDDEN.time]
        effects.adhesion.stress = HIDDEN.adhesion
        effects.bluntness.initiation = HIDDEN.bluntness * material.toughness
        return food


@dc.dataclass
class CurvesWorld:
    """Measured curves in place of the scenario's food; see `SlicingWorld` and `curve_cutter`."""

    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of all deviations."""

    def scenario(self, food: str, slice: int, board_stiffness: float | None = None) -> WorldSlice:
        """One slice; see `SlicingWorld`."""
        rng = _rng("curves", self.seed, food, slice, SLICE)
        calibrated = load_calibrated_food(food)
        scenario = _scenario(f"{food}_curves_{slice}", calibrated, board_stiffness, rng)
        diameter = _diameter(calibrated, rng)
        tough, rub = np.exp(SPREAD * _deviations(rng, 2)).tolist()
        cut = CurveFood(food, diameter, diameter, tough, rub)

        return WorldSlice(scenario, cut)

    def rng(self, food: str, slice: int) -> np.random.Generator:
        """See `SlicingWorld`."""
        return _rng("curves", self.seed, food, slice, RUN)
