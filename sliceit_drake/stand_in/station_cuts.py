"""The cuts of a protocol as scenarios of a station, simulated or hardware."""

import copy
import dataclasses as dc

from sliceit_drake.configuration import validate
from sliceit_drake.diagrams.scenario import Preparation, Scenario, Start
from sliceit_drake.stand_in.protocol import Protocol, Specimen, scaled_food, section_size
from sliceit_drake.systems.analytic_cutter import no_food

__all__ = ["scenario_of_cut"]


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
            peeled=condition.peeled,
            weight=condition.weight,
            knife_slices=protocol.knife_slices,
        ),
    )
    scenario.sensor.seed = specimen.index
    validate(scenario, f"scenario of {condition.label}")
    return scenario
