"""Worlds in which a trained agent is evaluated, and which no training sees.

A world gives the slices of a food, one scenario each. Two stand for reality:

- `StandInWorld`: finite elements, finer in mesh and step than a training's, with other parameters
  than the calibrated ones, which also differ from slice to slice, and with effects that no training
  has.
- `CurvesWorld`: measured curves of force over depth with laws of their own (`curve_cutter`). It
  shares no code with the finite elements or the spring; of a calibrated food it takes size and
  knife.

In both the food lies and the knife starts a millimetre or so from where training has it, food
differs in size, and the wrench sensor has noise, bias and delay. All of it follows from the world's
seed, the food and the slice's index alone. Both are simulated: a table made from them must say so.
"""

import abc
import copy
import dataclasses as dc
import typing
import zlib

import numpy as np

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood, load_calibrated_food
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.diagrams.agent_gains import AgentGains
from sliceit_drake.diagrams.prepared_food import CuttableFood
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
    "slice_size",
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
    cutting: CuttableFood | None

    @property
    def food(self) -> object:
        """What is cut."""
        return self.cutting or self.scenario.food


def _deviations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Standard normal numbers [count], cut off at `LARGEST`."""
    return np.clip(rng.normal(size=count), -LARGEST, LARGEST)


def slice_size(
    calibrated: CalibratedFood, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """Diameter of a slice, metres, and factors on its toughness and friction."""
    diameter = _diameter(calibrated, rng)
    tough, rub = np.exp(SPREAD * _deviations(rng, 2)).tolist()
    return diameter, (tough, rub)


def _diameter(calibrated: CalibratedFood, rng: np.random.Generator) -> float:
    shape = calibrated.food.shape
    assert isinstance(shape, Cylinder)
    return shape.diameter * float(np.exp(SIZE_SPREAD * _deviations(rng, 1)[0]))


SLICE, RUN = range(2)
"""Independent streams of random numbers."""


@dc.dataclass
class SlicingWorld(abc.ABC):
    """Gives slices to be cut."""

    name: typing.ClassVar[str]
    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of all deviations."""

    @abc.abstractmethod
    def _cut(
        self, scenario: Scenario, calibrated: CalibratedFood, rng: np.random.Generator
    ) -> CuttableFood | None:
        """Gives a scenario its food, or returns what is cut in its place."""

    def scenario(self, food: str, slice: int, board_stiffness: float | None = None) -> WorldSlice:
        """One slice; the same for the same food and index.

        Args:
            food: One of `SLICING_FOODS`.
            slice: Index of the slice, from 0.
            board_stiffness: N/m; None for the default board.

        Raises:
            ConfigurationError: The food or the index is none.
        """
        rng = self._random(food, slice, SLICE)
        calibrated = load_calibrated_food(food)
        start, placement = Start(), Placement()
        along, up = (PLACE_SPREAD * _deviations(rng, 2)).tolist()
        shifted = np.array(placement.position) + PLACE_SPREAD * _deviations(rng, 2)
        placement.position = shifted.tolist()
        bias = _deviations(rng, 6) * np.repeat([FORCE_BIAS, MOMENT_BIAS], 3)
        scenario = Scenario(
            name=f"{food}_{self.name}_{slice}",
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
            scenario.set_board_stiffness(board_stiffness)
        return WorldSlice(scenario, self._cut(scenario, calibrated, rng))

    def rng(self, food: str, slice: int) -> np.random.Generator:
        """Random numbers of a slice while it is cut, for `AgentStation.begin`."""
        return self._random(food, slice, RUN)

    def _random(self, food: str, slice: int, stream: int) -> np.random.Generator:
        paper_slices(food)
        if slice < 0:
            raise ConfigurationError(f"is {slice}", field="slice", fix="Give 0 or more.")
        names = (zlib.crc32(text.encode()) for text in (self.name, food))
        return np.random.default_rng([self.seed, *names, slice, stream])


@dc.dataclass
class StandInWorld(SlicingWorld):
    """Finite elements with hidden effects, finer than a training's."""

    name = "stand_in"
    refinement: float = quantity(1.25, "", low=0.3, high=4.0)
    """Elements along an edge, relative to the food's mesh."""
    time_step: float = quantity(1e-4, "s", low=1e-6, high=2e-3)
    """Sub-step of the food."""

    def _cut(
        self, scenario: Scenario, calibrated: CalibratedFood, rng: np.random.Generator
    ) -> None:
        scenario.numerics = Numerics(time_step=self.time_step)
        scenario.food = food = calibrated.held()
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
        # What no training has.
        effects.toughness_rate.exponent = 0.06
        effects.relaxation.shares, effects.relaxation.times = [0.15], [0.2]
        # 0.3 N on a cucumber's 11 cm^2 of flank, 1.1 N on a tomato's 36 cm^2.
        effects.adhesion.stress = 300.0
        effects.bluntness.initiation = 0.3 * material.toughness


@dc.dataclass
class CurvesWorld(SlicingWorld):
    """Measured curves in place of the scenario's food; see `curve_cutter`."""

    name = "curves"

    def _cut(
        self, scenario: Scenario, calibrated: CalibratedFood, rng: np.random.Generator
    ) -> CurveFood:
        diameter, (tough, rub) = slice_size(calibrated, rng)
        return CurveFood(calibrated.food.name, diameter, diameter, tough, rub)
