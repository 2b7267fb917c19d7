"""The bench of the study: its world, and what is given to who diagnoses its records."""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect import Effect, Series
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import Protocol, Specimen, load_protocol
from sliceit_drake.stand_in.session import Session
from sliceit_drake.stand_in.world import World
from studies.hidden_effects.quiet import records_of_conditions, without_noise

__all__ = [
    "DIAGNOSIS_REFINEMENT",
    "PROTOCOLS",
    "WORLD",
    "QuietBench",
    "model_food",
    "protocol_named",
]

PROTOCOLS = ("poor", "rich", "full")

DIAGNOSIS_REFINEMENT = 0.75
"""Refinement of the diagnosis's mesh. On a mesh of half the elements a skin does what a core or
another section does, and is 38 degrees from the stand-in's where all cuts are alike; here 11."""

WORLD = FiniteElementSettings(refinement=0.85, time_step=2e-4, travel=2e-4)
"""Mesh and step of the stand-in, which differ from those of the diagnosis."""

PER_SLICE = ("dulling_edge", "food_slip", "warm_wrist")
"""Effects that differ between slices of one condition."""


def protocol_named(name: str) -> Protocol:
    """A protocol that ships.

    Raises:
        ConfigurationError: There is none of that name.
    """
    return load_protocol(str(resource_path(f"calibration/protocols/{name}.yaml")))


def model_food(protocol: Protocol) -> CalibratedFood:
    """The calibrated food that a user would have of a protocol's: without anything hidden."""
    return CalibratedFood(food=copy.deepcopy(protocol.food), knife=protocol.knife)


class QuietBench:
    """Noise-free slices of a protocol, all alike but for what is hidden.

    Slices of one condition are cut once, unless the effect tells them apart; an effect that acts on
    forces or readings alone acts on the forces of that cut.

    Args:
        protocol: What is cut.
        seed: Of the order of slices; that of a session with noise gives the same.
        settings: How finely the world is computed.
    """

    def __init__(
        self, protocol: Protocol, seed: int, settings: FiniteElementSettings = WORLD
    ) -> None:
        self.protocol = without_noise(protocol, force_resolution=0.0, torque_resolution=0.0)
        self.seed, self.settings = seed, settings
        self._untouched: dict[str, Series] = {}

    def records(
        self, names: Sequence[str] = (), effects: Sequence[Effect] = ()
    ) -> list[SliceRecord]:
        """All slices.

        Args:
            names: Of the effects.
            effects: What is hidden.

        Raises:
            CuttingError: The cut broke down.
        """
        session = Session(self.protocol, effects, seed=self.seed, settings=self.settings)
        if all(_acts_afterwards(effect) for effect in effects):
            session.world = _Replay(session.world, self._untouched)
        return records_of_conditions(session, once=not set(names) & set(PER_SLICE))


def _acts_afterwards(effect: Effect) -> bool:
    """Whether an effect changes nothing of the cut itself."""
    hooks = ("reshape", "toughness", "stiffness", "drive")
    return all(getattr(type(effect), hook) is getattr(Effect, hook) for hook in hooks)


class _Replay:
    """A world that cuts each condition once, with nothing hidden, and then lets effects act on the
    forces."""

    def __init__(self, world: World, cuts: dict[str, Series]) -> None:
        self._world, self._cuts = world, cuts

    def cut(
        self, specimen: Specimen, effects: Sequence[Effect], rng: np.random.Generator
    ) -> Series:
        label = specimen.condition.label
        if label not in self._cuts:
            self._cuts[label] = self._world.cut(specimen, (), rng)
        series = copy.deepcopy(self._cuts[label])
        series.slice = dc.replace(series.slice, index=specimen.index)
        for effect in effects:
            effect.begin(series.slice, rng)
        return series
