"""A protocol: the slices of one session at the bench, in YAML, and in which order they are cut."""

import copy
import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError, load_yaml, quantity, validate
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, Ellipsoid, HalfCylinder, PlainShape
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.motion import MotionPlan
from sliceit_drake.diagrams.scenario import Placement, Preparation, Scenario, Start
from sliceit_drake.stand_in.sensor_model import SensorModel
from sliceit_drake.systems.analytic_cutter import is_no_food, no_food

__all__ = [
    "Condition",
    "Protocol",
    "Specimen",
    "Variation",
    "load_protocol",
    "protocol_of_scenario",
    "scaled_food",
    "scenario_of_cut",
    "schedule",
    "section_size",
]


@dc.dataclass
class Condition:
    """One kind of cut, made `replicates` times."""

    label: str = "press"
    motion: MotionPlan = dc.field(default_factory=MotionPlan)
    """Where none is given one cut through the food. Labels of segments that are those of records
    (air, slice, hold, retract, second_pass, board_press, weight, ...) become phases; others become
    "other"."""
    replicates: int = quantity(3, "", low=1, high=1000)
    """How often."""
    clearance: float = quantity(3e-3, "m", low=-0.05, high=0.5)
    """Height of the edge above the food at the start."""
    offset: float = quantity(0.0, "m", low=-0.2, high=0.2)
    """Shift of the edge's middle along the edge at the start."""
    without_food: bool = False
    """The bare board; the clearance is over where the food's top would be."""
    peeled: bool = False
    """The skin is off."""
    width_scale: float = quantity(1.0, "", low=0.3, high=3.0)
    """Size of the section against the food's."""
    weight: float = quantity(0.0, "kg", low=0.0, high=20.0)
    """Mass hung on the knife at Ko in segments "weight"."""

    def check(self, where: str) -> None:
        if not self.label:
            raise ConfigurationError(
                "is empty", field=f"{where}.label", fix="Give the condition a name."
            )


@dc.dataclass
class Variation:
    """How slices differ. Relative values are spreads of logarithms; neighbours resemble each other
    by `correlation`."""

    toughness: float = quantity(0.05, "", low=0.0, high=0.5)
    """Relative spread."""
    stiffness: float = quantity(0.05, "", low=0.0, high=0.5)
    """Relative spread."""
    friction: float = quantity(0.05, "", low=0.0, high=0.5)
    """Relative spread."""
    height: float = quantity(3e-4, "m", low=0.0, high=0.01)
    """Spread of the food's height."""
    correlation: float = quantity(0.3, "", low=0.0, high=0.99)
    """Correlation of neighbouring slices."""


@dc.dataclass
class Protocol:
    """A session at the bench: food, knife, board, sensor, and what is cut how often.

    The food is the one that a user would describe; a world adds to it what it hides.
    """

    name: str = "session"
    food: Food = dc.field(default_factory=Food)
    knife: Knife = dc.field(default_factory=Knife)
    board: Board = dc.field(default_factory=Board)
    placement: Placement = dc.field(default_factory=Placement)
    exchange_period: float = quantity(2e-3, "s", low=2.5e-4, high=0.02)
    """Between two values of the true wrench."""
    sensor: SensorModel = dc.field(default_factory=SensorModel)
    variation: Variation = dc.field(default_factory=Variation)
    conditions: list[Condition] = dc.field(default_factory=list)
    random_order: bool = True
    """Whether the slices are cut in random order; else as listed, replicate by replicate."""
    knife_slices: int = quantity(0, "", low=0, high=10**6)
    """Slices since sharpening before the first."""

    def check(self, where: str) -> None:
        if not self.conditions:
            raise ConfigurationError(
                "is empty", field=f"{where}.conditions", fix="Give at least one condition."
            )
        labels = [condition.label for condition in self.conditions]
        for k, label in enumerate(labels):
            if label in labels[:k]:
                raise ConfigurationError(
                    f"{label!r} is there twice",
                    field=f"{where}.conditions[{k}].label",
                    fix="Give each condition a name of its own, and replicates for repeats.",
                )
        steps = 1.0 / (self.sensor.rate * self.exchange_period)
        if steps < 1.0 - 1e-9 or abs(steps - round(steps)) > 1e-6 * steps:
            nearest = 1.0 / (max(1, round(steps)) * self.exchange_period)
            raise ConfigurationError(
                f"= {self.sensor.rate:g} Hz: readings are not whole coupling step periods of "
                f"{self.exchange_period:g} s apart",
                field=f"{where}.sensor.rate",
                fix=f"Give {nearest:.6g}, or another exchange_period.",
            )
        if self.food.effects != Effects():
            raise ConfigurationError(
                "is for the simulator; a stand-in has effects of its own",
                field=f"{where}.food.effects",
                fix="Leave it out, and name effects by --effect.",
            )


@dc.dataclass(frozen=True)
class Specimen:
    """One slice to be cut: its condition and how it differs from the mean slice.

    Attributes:
        index: Order in the session, from 0.
        condition: What is done.
        toughness, stiffness, friction: Factors.
        height: Height by which the food is higher, metres.
    """

    index: int
    condition: Condition
    toughness: float = 1.0
    stiffness: float = 1.0
    friction: float = 1.0
    height: float = 0.0


def schedule(protocol: Protocol, rng: np.random.Generator) -> list[Specimen]:
    """The slices of a session, in the order in which they are cut."""
    longest = max(condition.replicates for condition in protocol.conditions)
    rounds = [[c for c in protocol.conditions if c.replicates > k] for k in range(longest)]
    cuts = [condition for conditions in rounds for condition in conditions]
    if protocol.random_order:
        cuts = [cuts[k] for k in rng.permutation(len(cuts))]
    v = protocol.variation
    deviation = rng.normal(size=(len(cuts), 4))
    for k in range(1, len(cuts)):
        fresh = np.sqrt(1.0 - v.correlation**2) * deviation[k]
        deviation[k] = v.correlation * deviation[k - 1] + fresh
    spread = np.array([v.toughness, v.stiffness, v.friction])
    specimens = []
    for k, condition in enumerate(cuts):
        toughness, stiffness, friction = np.exp(spread * deviation[k, :3]).tolist()
        height = v.height * float(deviation[k, 3])
        specimens.append(Specimen(k, condition, toughness, stiffness, friction, height))
    return specimens


def scaled_food(food: Food, scale: float) -> Food:
    """A food of another size of section.

    Raises:
        ConfigurationError: It has no shape that can be scaled.
    """
    return food if scale == 1.0 else dc.replace(food, shape=_plain_shape(food).scaled(scale))


def section_size(food: Food, scale: float = 1.0) -> tuple[float, float]:
    """Width and height of a food's section through its middle, metres.

    Raises:
        ConfigurationError: It has no shape that says so.
    """
    return _plain_shape(food).scaled(scale).section


def _plain_shape(food: Food) -> Cylinder | HalfCylinder | Box | Ellipsoid:
    if isinstance(food.shape, PlainShape):
        return food.shape
    raise ConfigurationError(
        "is no cylinder, half cylinder, box or ellipsoid",
        field="protocol.food.shape",
        fix="Describe the food by one of these shapes.",
    )


def load_protocol(file: str) -> Protocol:
    """Reads and validates a protocol.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    return load_yaml(Protocol, file)


def protocol_of_scenario(scenario: Scenario, replicates: int = 1) -> Protocol:
    """The one cut of a scenario as a protocol; robot, controller, sensor and the food's effects are
    left out. An analytic food of no toughness, which the station's knife does not feel, is none.

    Raises:
        ConfigurationError: It has no food to cut, or a sequence or policy moves the knife.
    """
    food, prepared = scenario.food, scenario.preparation or Preparation()
    without_food = is_no_food(food)
    if is_no_food(food):
        food = Food(name="none", shape=Cylinder(diameter=food.diameter))
    refused = [name for name in ("sequence", "policy") if getattr(scenario, name) is not None]
    if not isinstance(food, Food) or refused:
        raise ConfigurationError(
            "has no single cut through a finite-element food on a prescribed motion",
            field=f"scenario.{(refused or ['food'])[0]}",
            fix="Give a scenario with one cut, or a protocol with a list of conditions.",
        )
    protocol = Protocol(
        name=scenario.name,
        food=dc.replace(food, effects=Effects()),
        knife=scenario.knife,
        board=scenario.board,
        placement=scenario.placement,
        exchange_period=scenario.exchange_period,
        conditions=[
            Condition(
                label=scenario.name,
                motion=scenario.motion,
                replicates=replicates,
                clearance=scenario.start.clearance,
                offset=scenario.start.offset,
                without_food=without_food,
                peeled=prepared.peeled,
                weight=prepared.weight,
            )
        ],
        knife_slices=prepared.knife_slices,
    )
    validate(protocol, "protocol")
    return protocol


def scenario_of_cut(protocol: Protocol, specimen: Specimen, station: Scenario) -> Scenario:
    """One cut of a session as a scenario.

    Args:
        protocol: The session whose food, knife, board and placement are used.
        specimen: The slice; its deviations from the mean slice go into the simulated material (a
            deviation of height does not). A real food brings its own, and they change nothing.
        station: What the protocol does not say: robot, controller, sensor, numerics.

    Raises:
        ConfigurationError: The cut makes no scenario.
    """
    condition = specimen.condition
    food = scaled_food(protocol.food, condition.width_scale)
    _, height = section_size(food)
    material = dc.replace(
        food.material,
        toughness=food.material.toughness * specimen.toughness,
        youngs_modulus=food.material.youngs_modulus * specimen.stiffness,
        friction=food.material.friction * specimen.friction,
    )
    food = dc.replace(food, material=material)
    if condition.peeled:
        food.effects.skin.toughness = 0.0
    scenario = dc.replace(
        copy.deepcopy(station),
        name=condition.label,
        knife=protocol.knife,
        board=copy.deepcopy(protocol.board),
        placement=protocol.placement,
        exchange_period=protocol.exchange_period,
        # What offers no resistance stands for no food: the start is over where its top would be.
        food=no_food(height) if condition.without_food else food,
        calibration=None,
        start=Start(clearance=condition.clearance, offset=condition.offset),
        motion=condition.motion,
        measurement=None,
        sequence=None,
        preparation=Preparation(
            peeled=condition.peeled, weight=condition.weight, knife_slices=protocol.knife_slices
        ),
    )
    scenario.sensor.seed = specimen.index
    validate(scenario, f"scenario of {condition.label}")
    return scenario
