"""One draw of a bench: a law with its constants, a food, motions, a sensor; all from one seed."""

import copy
import dataclasses as dc
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    MotionPlan,
    PressAndDraw,
    Retract,
    Segment,
    Waypoints,
)
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.stand_in.effect import Effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import Condition, Protocol, Specimen, Variation
from sliceit_drake.stand_in.sensor_model import SensorModel
from sliceit_drake.stand_in.session import Session
from studies.benches.bonds import Bonds
from studies.benches.law_world import Law, LawWorld
from studies.benches.noise import Noise
from studies.benches.slice_push import SlicePush
from studies.benches.strips import Strips
from studies.benches.variation import SliceVariation
from studies.hidden_effects.quiet import without_noise

__all__ = ["FINITE_ELEMENTS", "LAWS", "PARTS", "RESERVED", "Draw", "seed_of"]

FINITE_ELEMENTS = "finite_elements"

FOREIGN: dict[str, Callable[[np.random.Generator], Law]] = {
    "slice_push": SlicePush.drawn,
    "bonds": Bonds.drawn,
    "strips": Strips.drawn,
}

LAWS = (FINITE_ELEMENTS, *FOREIGN)

RESERVED = "strips"
"""The law whose records nobody diagnoses before the rule is frozen."""

PARTS = ("training", "reporting")
"""Draws to set the rule by, and others to report of it."""

CLEARANCE, OVERTRAVEL = 3e-3, 2e-4
"""Of the edge over the food at the start, and its way into the board, metres."""


def seed_of(commit: str, part: str, law: str, number: int) -> int:
    """Seed of a draw.

    Args:
        commit: Hash of the commit that the draws belong to.
        part: One of `PARTS`.
        law: One of `LAWS`.
        number: Of the draw.
    """
    return int(hashlib.sha256(f"{commit} {part} {law} {number}".encode()).hexdigest()[:12], 16)


class Draw:
    """A bench.

    Args:
        law: One of `LAWS`.
        seed: All follows from it.

    Attributes:
        constants: Of a foreign law; None for the finite elements.
        settings: Mesh and step of the finite elements.
        protocol: Food, motions, variation of the material; without noise.
        noise: What the sensor adds.
        variation: Share by which slices differ.

    Raises:
        ConfigurationError: There is no such law.
    """

    def __init__(self, law: str, seed: int) -> None:
        if law not in LAWS:
            raise ConfigurationError(
                f"{law!r} is no law", field="--laws", fix=f"Give some of {', '.join(LAWS)}."
            )
        self.law, self.seed = law, seed
        rng = np.random.default_rng([seed, 0])
        self.constants = FOREIGN[law](rng) if law in FOREIGN else None
        self.settings = FiniteElementSettings(
            refinement=float(rng.uniform(0.85, 1.0)),
            time_step=2e-3 / int(rng.integers(7, 14)),
            travel=1.5e-4,
        )
        self.noise = Noise.drawn(rng)
        self.variation = float(rng.uniform(0.03, 0.12))
        self.protocol = _protocol(rng, law == FINITE_ELEMENTS, self.variation, self.noise.rate)

    @property
    def model(self) -> CalibratedFood:
        """What a user knows of the food before a calibration: its shape, and some vegetable."""
        food = dc.replace(copy.deepcopy(self.protocol.food), material=_material(400.0, 1.5e6, 0.15))
        return CalibratedFood(food=food, knife=self.protocol.knife)

    def session(
        self, effects: Sequence[Effect] = (), seed: int = 0, quiet: bool = False
    ) -> Session:
        """A session at the bench.

        Args:
            effects: What is hidden.
            seed: Of what differs from slice to slice, beside the draw's own.
            quiet: Whether all slices are alike.
        """
        protocol = without_noise(self.protocol) if quiet else self.protocol
        varied = [] if quiet else [SliceVariation(self.variation)]
        whole = (self.seed + 1_000_003 * seed) % 2**62
        session = Session(protocol, [*varied, *effects], seed=whole, settings=self.settings)
        if self.constants is not None:
            session.world = LawWorld(protocol, self.constants)
        return session

    def records(self, effects: Sequence[Effect] = (), seed: int = 0) -> list[SliceRecord]:
        """The noisy records of a session, in the order in which they were cut.

        Raises:
            CuttingError: A cut of the finite elements broke down.
        """
        session = self.session(effects, seed)
        return [
            self.noise.added_to(session.record(k), np.random.default_rng([self.seed, 2, seed, k]))
            for k in range(len(session))
        ]

    def write(self, folder: Path, effects: Sequence[Effect] = (), seed: int = 0) -> None:
        """Writes the folder of records that a robot would leave; see `records`."""
        folder.mkdir(parents=True, exist_ok=True)
        for record in self.records(effects, seed):
            write_record(record, folder / record.name)

    @functools.cached_property
    def middle(self) -> dict[str, int]:
        """By condition the number of its middle slice."""
        slices: dict[str, list[int]] = {c.label: [] for c in self.protocol.conditions}
        for specimen in self.session(quiet=True).specimens:
            slices[specimen.condition.label].append(specimen.index)
        return {label: numbers[len(numbers) // 2] for label, numbers in slices.items()}

    def quiet(
        self, effects: Sequence[Effect] = (), only: Sequence[int] | None = None, **own: float
    ) -> list[SliceRecord]:
        """Noise-free records of slices that are alike.

        Args:
            effects: What is hidden.
            only: Numbers of the slices; the middle one of each condition by default.
            own: Factors on the material's toughness, stiffness and friction, and the height by
                which the food is higher, metres, as in `Specimen`.
        """
        session = self.session(effects, quiet=True)
        for k, specimen in enumerate(session.specimens):
            session.specimens[k] = _changed(specimen, own)
        return [session.record(k) for k in (self.middle.values() if only is None else only)]


def _changed(specimen: Specimen, own: dict[str, float]) -> Specimen:
    return dc.replace(specimen, **own)  # type: ignore[arg-type]


def _material(toughness: float, modulus: float, friction: float) -> Material:
    return Material(
        youngs_modulus=modulus,
        poisson_ratio=0.37,
        density=950.0,
        toughness=toughness,
        friction=friction,
    )


def _protocol(rng: np.random.Generator, is_truth: bool, variation: float, rate: float) -> Protocol:
    """Food, motions and differences among slices. Sizes are those of cucumbers, carrots, courgettes
    and sticks of them; speeds a decade apart around the paper's 20 mm/s."""
    height = float(rng.uniform(0.022, 0.034))
    shape: Cylinder | Box = Cylinder(diameter=height)
    if rng.random() < 0.4:
        shape = Box(size=[float(rng.uniform(0.022, 0.034)), 0.12, height])
    constants = (
        float(rng.uniform(150.0, 450.0)),
        float(np.exp(rng.uniform(np.log(1e6), np.log(3e6)))),
        float(rng.uniform(0.05, 0.3)),
    )
    material = _material(*constants) if is_truth else _material(400.0, 1.5e6, 0.15)
    return Protocol(
        name="bench",
        food=Food(name="vegetable", shape=shape, material=material),
        exchange_period=2e-3,
        sensor=SensorModel(
            rate=rate, cutoff_frequency=0.0, delay=0.0, force_resolution=0.0, torque_resolution=0.0,
            force_noise=0.0, torque_noise=0.0, force_bias=0.0, torque_bias=0.0, force_drift=0.0,
            torque_drift=0.0,
        ),
        variation=Variation(
            toughness=variation, stiffness=variation, friction=variation, height=0.0
        ),
        conditions=_conditions(rng, height),
    )  # fmt: skip


def _conditions(rng: np.random.Generator, height: float) -> list[Condition]:
    way = height + CLEARANCE + OVERTRAVEL
    half = CLEARANCE + float(rng.uniform(0.4, 0.6)) * height
    rest = float(rng.uniform(1.5, 3.0))
    still, up = Hold(0.3, label="air"), float(rng.uniform(0.03, 0.08))

    def press(speed: float) -> MotionPlan:
        first, then = (
            ConstantSpeed(speed=speed, distance=d, acceleration=1.0, label="slice")
            for d in (half, way - half)
        )
        out = Retract(distance=way, speed=up, acceleration=2.0, label="retract")
        again = ConstantSpeed(
            speed=0.02, distance=0.85 * way, acceleration=2.0, label="second_pass"
        )
        back = Retract(distance=0.85 * way, speed=up, acceleration=2.0, label="retract")
        rests = Hold(rest, label="hold"), Hold(0.3, label="hold")
        return MotionPlan([still, first, rests[0], then, rests[1], out, still, again, back, still])

    def draw(ratio: float) -> Condition:
        cut = PressAndDraw(
            press_speed=0.02, distance=way, draw_ratio=ratio, acceleration=0.5, label="slice"
        )
        out = Retract(distance=way, speed=up, acceleration=2.0, label="retract")
        plan = MotionPlan([still, cut, Hold(0.3, label="hold"), out, still])
        return Condition(f"draw {ratio:.1f}", plan, offset=-0.5 * ratio * way)

    rests, turned = [[0.0] * 3] * 2, [[0.5, 0.0, 0.0]] * 2
    moves: list[Segment] = [
        Hold(0.5, label="air"),
        ConstantSpeed(speed=0.02, distance=0.02, acceleration=0.5, label="air"),
        Retract(distance=0.02, speed=0.06, acceleration=2.0, label="air"),
        Waypoints(times=[0.8, 1.6], positions=rests, rotations=turned, label="air"),
        ConstantSpeed(speed=0.06, distance=0.02, acceleration=2.0, label="air"),
    ]
    speeds = rng.uniform(0.005, 0.008), rng.uniform(0.015, 0.025), rng.uniform(0.05, 0.08)
    ratios = rng.uniform(0.6, 1.5), rng.uniform(2.0, 3.2)
    out = [Condition(f"press {1e3 * v:.0f} mm/s", press(float(v))) for v in speeds]
    out += [draw(float(ratio)) for ratio in ratios]
    out.append(Condition("air", MotionPlan(moves), clearance=0.08))
    if rng.random() < 0.5:
        down = ConstantSpeed(speed=0.02, distance=height - 0.02 + 4e-4, acceleration=0.5)
        down.label = "board_press"
        lift = Retract(distance=0.01, speed=0.02, acceleration=0.5, label="retract")
        plan = MotionPlan([still, down, Hold(1.0, label="board_press"), lift])
        out.append(Condition("board", plan, without_food=True, clearance=-0.02))
        hung: list[Segment] = [
            Hold(0.5, label="air"),
            Hold(1.0, label="weight"),
            Hold(0.3, label="air"),
        ]
        out.append(
            Condition("weight", MotionPlan(hung), without_food=True, clearance=0.08, weight=1.0)
        )
    return out
