"""What is calibrated: a food as it is known beforehand, and the parameters that are searched."""

import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import (
    ConfigurationError,
    choice,
    did_you_mean,
    load_yaml,
    quantity,
)
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, HalfCylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.parameters import POINT_PARAMETERS, parameter_names
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import known_yaml

__all__ = ["CalibrationSetup", "Literature", "ParameterRange", "load_setup", "setup_of_record"]

FOLDER = "calibration/setups"


@dc.dataclass
class ParameterRange:
    """A parameter that is searched.

    Attributes:
        name: Dotted, as `cutting.parameters.parameter_names` lists them: material.toughness.
        why: Where the range comes from.
    """

    name: str = ""
    low: float = quantity(0.0, "", low=-1e12, high=1e12)
    """Least value, in the field's unit."""
    high: float = quantity(1.0, "", low=-1e12, high=1e12)
    """Greatest value."""
    scale: str = choice("log", ("log", "linear"))
    """In what the search is uniform."""
    why: str = ""

    def check(self, where: str) -> None:
        if self.high <= self.low or (self.scale == "log" and self.low <= 0.0):
            raise ConfigurationError(
                f"from {self.low:g} to {self.high:g} is no range on a {self.scale} scale",
                field=f"{where}.low",
                fix="Give low < high, and low > 0 on a log scale.",
            )


@dc.dataclass
class Literature:
    """What is published of a food that nobody recorded for us."""

    peak_force: list[float] = quantity([1.0, 100.0], "N", low=0.01, high=1e4, size=2)
    """Range of the largest force of a cut."""
    speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Of the simulated press cut."""
    source: str = ""

    def check(self, where: str) -> None:
        if self.peak_force[1] <= self.peak_force[0]:
            raise ConfigurationError(
                f"{self.peak_force} is no range",
                field=f"{where}.peak_force",
                fix="Give the least and the largest published value.",
            )


@dc.dataclass
class CalibrationSetup:
    """A food, what cuts it, and what is not known of it.

    What a record says of the food's size, its support and the knife replaces what stands here.
    Each record has parameters of its own beside: the height by which its knife stood lower than it
    says, and where its `unknown` lists `motion.speed` a factor on its speed.
    """

    food: Food = dc.field(default_factory=Food)
    knife: Knife = dc.field(default_factory=Knife)
    board: Board = dc.field(default_factory=Board)
    bench: BenchErrors = dc.field(default_factory=BenchErrors)
    """What sensor, tool, board, arm and mounting do otherwise; a diagnosis takes it."""
    numerics: Numerics = dc.field(default_factory=Numerics)
    parameters: list[ParameterRange] = dc.field(default_factory=list)
    height_offset: list[float] = quantity([-2e-3, 2e-3], "m", low=-0.02, high=0.02, size=2)
    """Range of each record's height."""
    speed_factor: list[float] = quantity([0.9, 1.2], "", low=0.2, high=5.0, size=2)
    """Range where a record's speed is unknown."""
    refinement: float = quantity(1.0, "", low=0.2, high=4.0)
    """Elements along an edge, relative to the food's mesh."""
    literature: Literature | None = None
    """For a food without records, see literature.py."""
    oscillation: list[float] | None = quantity(None, "Hz", low=0.1, high=250.0, size=2)
    """Frequencies of an oscillation of each record, see oscillation.py; null for none."""
    search_time_step: float = quantity(1e-3, "s", low=1e-6, high=1e-2)
    """Sub-step of the search; must divide 2 ms."""

    def check(self, where: str) -> None:
        names = [p.name for p in self.parameters]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise ConfigurationError(
                    f"{name} is there twice",
                    field=f"{where}.parameters[{k}].name",
                    fix="Remove one.",
                )
        for name in ("height_offset", "speed_factor", "oscillation"):
            if getattr(self, name) is None:
                continue
            low, high = getattr(self, name)
            if high <= low:
                raise ConfigurationError(
                    f"[{low:g}, {high:g}] is no range",
                    field=f"{where}.{name}",
                    fix="Give low < high.",
                )


SHAPES = {s.__name__.lower(): s for s in (Cylinder, HalfCylinder, Box, Ellipsoid)}
"""Of a food that only a record describes."""


def setup_of_record(record: SliceRecord) -> CalibrationSetup:
    """A setup for a food that none ships for: its shape and name as the record has them, a material
    of vegetables, and wide ranges.

    Raises:
        ConfigurationError: The record does not say shape or size.
    """
    facts = record.metadata.food
    if facts.shape not in SHAPES or facts.size is None:
        missing = "food.size" if facts.shape in SHAPES else "food.shape"
        raise ConfigurationError(
            "is not given, and without --food there is no other",
            source=record.source,
            field=missing,
            fix="Give it in the record's YAML file, or a setup by --food.",
        )
    material = Material(
        youngs_modulus=1e6,
        poisson_ratio=0.4,
        density=1000.0,
        toughness=300.0,
        strength=3e5,
        damping_time=5e-4,
        friction=0.2,
    )
    food = Food(
        name=facts.name,
        shape=SHAPES[facts.shape]().resized(facts.size),
        material=material,
        hold_distance=min(0.0119, 0.35 * facts.size[1]),
    )
    wide = "from soft gels to hard roots"
    return CalibrationSetup(
        food=food,
        numerics=Numerics(time_step=5e-4),
        parameters=[
            ParameterRange("material.toughness", 10.0, 4000.0, why=wide),
            ParameterRange("material.youngs_modulus", 5e4, 1e7, why=wide),
            ParameterRange("material.friction", 0.005, 1.0, why=wide),
        ],
        speed_factor=[0.7, 1.4],
    )


def load_setup(name: str | Path) -> CalibrationSetup:
    """Reads a setup and checks that its parameters exist.

    Args:
        name: A food that a setup ships for, or a YAML file.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    unknown = f"{name!r} is no food that a setup ships for:"
    otherwise = "Name one of them, or give a YAML file of a setup."
    file = known_yaml(name, FOLDER, unknown, "--food", otherwise)
    setup = load_yaml(CalibrationSetup, file)
    assert isinstance(setup, CalibrationSetup)
    setup.food.look_beside(file)
    try:
        model = make_food_model(setup.food, setup.knife, setup.numerics, setup.refinement)
    except MeshError as error:
        raise ConfigurationError(str(error), source=str(file), field="food.shape") from error
    known = [n for n in parameter_names(model) if n not in POINT_PARAMETERS]
    known += ["effects.skin.thickness"]
    for k, parameter in enumerate(setup.parameters):
        if parameter.name not in known:
            raise ConfigurationError(
                f"there is no parameter {parameter.name!r}",
                source=str(file),
                field=f"parameters[{k}].name",
                fix=did_you_mean(parameter.name, known, "See cutting/parameters.py."),
            )
    return setup
