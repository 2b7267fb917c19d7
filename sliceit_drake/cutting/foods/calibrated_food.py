"""Calibrated foods: what a calibration leaves, in files that scenarios load by name."""

import copy
import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import load_yaml, quantity
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.foods.distribution import ParameterDistribution
from sliceit_drake.cutting.foods.effects import Compliance
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.known_error import KnownError
from sliceit_drake.cutting.foods.spring_food import SpringFood
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.resources import known_yaml

__all__ = ["CalibratedFood", "load_calibrated_food"]

FOLDER = "calibration/foods"


@dc.dataclass
class CalibratedFood:
    """A food with the parameters that a calibration found, and how sure it is of them.

    Attributes:
        food: The food with the calibrated values; its shape is that of the records.
        knife: The knife that the records were taken with, as far as known.
        distribution: Joint distribution of the parameters; randomisation draws from it.
        spring: The spring-only baseline from the same records, or null.
        bench: What the bench of the records does otherwise than is assumed.
        known_error: What the simulation gets wrong by itself in the records, or null.
        records: Records that it was calibrated on, or the sources of a food without records.
        date, command: When and how it was calibrated.
        note: What it cannot be used for.
    """

    food: Food = dc.field(default_factory=Food)
    knife: Knife = dc.field(default_factory=Knife)
    distribution: ParameterDistribution = dc.field(default_factory=ParameterDistribution)
    spring: SpringFood | None = None
    bench: BenchErrors = dc.field(default_factory=BenchErrors)
    known_error: KnownError | None = None
    rms_error: float | None = quantity(None, "N", low=0.0, high=1e6)
    """On the records."""
    held_out_error: float | None = quantity(None, "N", low=0.0, high=1e6)
    """On blocks of depth that were held out, each in turn."""
    records: list[str] = dc.field(default_factory=list)
    date: str = ""
    command: str = ""
    note: str = ""

    @property
    def is_measured(self) -> bool:
        """Whether records of cuts stand behind it; else its values are published or chosen."""
        return self.rms_error is not None

    def apply_to(self, food: Food) -> Food:
        """A food of the given shape with the calibrated material and effects.

        The compliance of arm and holder is left out: it belongs to the robot of the records.
        """
        effects = dc.replace(copy.deepcopy(self.food.effects), compliance=Compliance())
        return dc.replace(food, material=copy.deepcopy(self.food.material), effects=effects)

    def held(self) -> Food:
        """A copy of the food for a robot that draws: held on both sides where it was cut unheld,
        for a round food that nothing holds rolls under a draw."""
        food = self.apply_to(copy.deepcopy(self.food))
        return dc.replace(food, held_sides="both") if food.held_sides == "none" else food


def load_calibrated_food(name: str | Path) -> CalibratedFood:
    """Reads a food that ships calibrated, or a YAML file.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    unknown = f"{name!r} is not calibrated; there are"
    otherwise = "Name one of them, or give the food.yaml of a calibration."
    file = known_yaml(name, FOLDER, unknown, "calibration", otherwise)
    food: CalibratedFood = load_yaml(CalibratedFood, file)
    food.food.look_beside(file)
    return food
