"""A scenario: everything about one simulated or real slice, and the YAML that holds it."""

import copy
import dataclasses as dc
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.spring_food import SpringFood
from sliceit_drake.cutting.knife import Knife, load_knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import MotionPlan
from sliceit_drake.diagrams.plant.robot_plant import RobotConfig
from sliceit_drake.diagrams.scenario_file import other_kind, scenario_file
from sliceit_drake.diagrams.sequence import SliceSequence
from sliceit_drake.overrides import Overrides, Replacements, field_names
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.compliance_controller import ComplianceControllerConfig
from sliceit_drake.systems.contact_monitor import ContactMonitorConfig
from sliceit_drake.systems.policy import PolicyConfig
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig

__all__ = ["Measurement", "Placement", "Preparation", "Scenario", "Start", "load_scenario"]

CLEAR_OF_FOOD = 1e-3
"""Least height of the knife over the food while it goes from one slice to the next, metres."""
NAMED = {"food": "calibration", "knife": "knife_name"}
"""Fields of a scenario that name what ships, by the fields that they replace."""


class _PutIn(str):
    """The name of a food or knife whose values a scenario has: they are not put in again, which
    would undo what was changed since."""


@dc.dataclass
class Placement:
    """Where the food lies on the board, in the world."""

    position: list[float] = quantity([0.026, -0.505], "m", low=-3.0, high=3.0, size=2)
    """Origin of F, x and y."""
    yaw: float = quantity(0.5 * np.pi, "rad", low=-6.3, high=6.3)
    """Direction of Fx, along the blade, about Wz."""


@dc.dataclass
class Start:
    """Where the knife starts, relative to the top of the cut."""

    clearance: float = quantity(0.01, "m", low=-0.05, high=0.5)
    """Height of the edge above the food."""
    offset: float = quantity(0.0, "m", low=-0.2, high=0.2)
    """Shift of the edge's middle along the edge."""


@dc.dataclass
class Measurement:
    """A measured force profile to compare with."""

    file: str = ""
    """CSV of `records.force_profile`, relative to the resources or to the working directory."""
    speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Downward speed of the record."""
    time_offset: float | None = quantity(None, "s", low=-10.0, high=10.0)
    """Record time at first contact; null: fitted."""


@dc.dataclass
class Preparation:
    """What a person does before the cut, as the record of it shall say.

    Attributes:
        peeled: Whether the skin is off; what the food has of one does not act.
    """

    peeled: bool = False
    weight: float = quantity(0.0, "kg", low=0.0, high=20.0)
    """Mass hung on the knife at Ko in segments "weight"; the simulated arm has none."""
    knife_slices: int = quantity(0, "", low=0, high=10**6)
    """Slices since sharpening before the first."""


def _tracking() -> ComplianceControllerConfig:
    """A controller that follows the motion, whatever force the food has against it."""
    return ComplianceControllerConfig(mode="motion", error_scale=1.0, p_gains=[200.0] * 6)


@dc.dataclass
class Scenario:
    """One slice: robot, controller, knife, food, board, motion."""

    name: str = "cucumber"
    seed: int = quantity(0, "", low=0, high=2**31 - 1)
    """Seed of everything random."""
    exchange_period: float = quantity(0.002, "s", low=2.5e-4, high=0.02)
    """Interval at which food and sensor update; the controller has its own, `controller.period`."""
    robot: RobotConfig = dc.field(default_factory=RobotConfig)
    sensor: WrenchSensorConfig = dc.field(default_factory=WrenchSensorConfig)
    controller: ComplianceControllerConfig = dc.field(default_factory=_tracking)
    """By default one that follows the motion; fields that are given replace that one's."""
    monitor: ContactMonitorConfig = dc.field(default_factory=ContactMonitorConfig)
    knife: Knife = dc.field(default_factory=Knife)
    knife_name: str | None = None
    """A knife by name (calibration/knives) or file; fields of `knife` beside it replace its."""
    board: Board = dc.field(default_factory=Board)
    bench: BenchErrors = dc.field(default_factory=BenchErrors)
    """What the bench does otherwise than the rest says; a food of a diagnosis has it."""
    food: Food | AnalyticFood | SpringFood = dc.field(default_factory=Food)
    calibration: str | None = None
    """A calibrated food, by name (calibration/foods) or file: its material and effects, and its
    `bench`. Fields of `food` and `bench` beside it replace its."""
    numerics: Numerics = dc.field(default_factory=Numerics)
    holder: str = choice("clamp", ("clamp", "arm"))
    """What is drawn where the food is held; arm: a second UR5e that stands still."""
    placement: Placement = dc.field(default_factory=Placement)
    start: Start = dc.field(default_factory=Start)
    motion: MotionPlan = dc.field(default_factory=MotionPlan)
    measurement: Measurement | None = None
    preparation: Preparation | None = None
    sequence: SliceSequence | None = None
    """Slices in a row; it places the cuts and makes the motion."""
    policy: PolicyConfig | AgentConfig | None = None
    """Decides how the knife moves, in the place of a motion."""

    def set_board_stiffness(self, stiffness: float) -> None:
        """Sets the board's stiffness, N/m, and steps of the plant that resolve a stiffer one."""
        board, robot, period = self.board, self.robot, self.exchange_period
        # As many plant steps in an impact, whose duration goes with the root of the stiffness.
        more = max(1.0, math.sqrt(stiffness / board.stiffness))
        robot.plant_time_step = period / math.ceil(period / robot.plant_time_step * more)
        board.stiffness = stiffness

    def check(self, where: str) -> None:
        if isinstance(self.food, Food):
            effects, rigid = self.food.effects, Effects()
            for name in ("compliance", "slip"):
                if getattr(effects, name) != getattr(rigid, name):
                    raise ConfigurationError(
                        "is for a prescribed motion; in a station the robot gives by itself and "
                        "the food's holder is rigid",
                        field=f"{where}.food.effects.{name}",
                        fix="Leave it out.",
                    )
        tool = self.bench.tool
        if tool.mass < 0.0 or (tool.mass == 0.0 and tool.moment != 0.0):
            raise ConfigurationError(
                f"{tool.mass:.4g} kg with a moment of {tool.moment:.4g} kg m is no part that an arm"
                " can carry",
                field=f"{where}.bench.tool",
                fix="Give a mass above 0, or leave it out and take less off the readings.",
            )
        if self.policy is not None:
            for name, default in (("motion", MotionPlan()), ("sequence", None)):
                if getattr(self, name) != default:
                    raise ConfigurationError(
                        "cannot stand beside a policy, which moves the knife",
                        field=f"{where}.{name}",
                        fix=f"Leave out one of {name} and policy.",
                    )
        if self.sequence is None:
            return
        self.sequence.check_food(self.food, where)
        if self.start.clearance < CLEAR_OF_FOOD:
            raise ConfigurationError(
                f"{self.start.clearance:.4g} m does not clear the food between two slices",
                field=f"{where}.start.clearance",
                fix=f"Give at least {CLEAR_OF_FOOD:g} m.",
            )
        for name, default in (("motion", MotionPlan()), ("measurement", None)):
            if getattr(self, name) != default:
                raise ConfigurationError(
                    "is of one slice and cannot stand beside a sequence",
                    field=f"{where}.{name}",
                    fix=f"Leave out one of {name} and sequence.",
                )

    def as_it_is(self) -> "Scenario":
        """The same with the board, and the food on it, as the bench has them; the knife starts
        where it did, and the board gives as it does together with the arm."""
        errors, board = self.bench.board, self.board
        stiffness = board.stiffness * (1.0 + errors.stiffness)
        stiffness /= 1.0 + self.bench.arm.compliance * stiffness
        board = dc.replace(board, height=board.height + errors.height, stiffness=stiffness)
        start = dc.replace(self.start, clearance=self.start.clearance - errors.height)
        return dc.replace(self, board=board, start=start)

    def not_simulated(self) -> list[str]:
        """What of the bench a station does not follow, in words."""
        if self.bench.board.exponent == 0.0:
            return []
        return [
            "bench.board.exponent is not in this station, whose board is linear; a diagnosis with"
            " --model takes it"
        ]

    def X_WF(self) -> RigidTransform:
        """Pose of the food frame: on the board's top surface."""
        p_WF = np.array([*self.placement.position, self.board.height])
        return RigidTransform(RotationMatrix.MakeZRotation(self.placement.yaw), p_WF)


def load_scenario(
    scenario: str | Path | Scenario,
    overrides: Overrides = None,
) -> Scenario:
    """A validated scenario: one that ships, one of a file, or a copy of another.

    Args:
        scenario: Name of one that ships, such as "cucumber"; a YAML file with one document of
            `Scenario` fields; or a `Scenario`, which stays as it is.
        overrides: Fields that replace those of the scenario: YAML text such as
            `{food: {material: {toughness: 400}}}`, text of paths such as
            `food.material.toughness=400, motion.segments.0.speed=0.05`, several such texts, or a
            dictionary, whose keys may be paths.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    replacements = Replacements(overrides, Scenario)
    if isinstance(scenario, Scenario):
        file, given = None, _put_in_named(scenario, copy.deepcopy)
    else:
        file, given = scenario_file(scenario), Scenario()
    loaded = _load(file, given, replacements)
    if isinstance(loaded.food, Food):
        if file is not None:
            loaded.food.look_beside(file)
        if loaded.preparation is not None and loaded.preparation.peeled:
            loaded.food.effects.skin.toughness = 0.0
    elif loaded.calibration is not None:
        raise ConfigurationError(
            "is of a food of finite elements",
            field="scenario.calibration",
            source="scenario" if file is None else str(file),
            fix="Leave it out, or give a food with a shape and a material.",
        )
    replacements.set_in(loaded, "scenario")
    return loaded


def _load(file: Path | None, given: Scenario, replacements: Replacements) -> Scenario:
    """The scenario of a file with what replaces whole fields of it."""
    try:
        loaded = replacements.load(file, given, _put_in_named)
    except ConfigurationError as error:
        _, _, name = (error.field or "").partition(".")
        if name in NAMED and error.problem == "expected named fields":
            raise ConfigurationError(
                error.problem,
                field=error.field,
                source=error.source,
                fix=f"{error.fix} One that has a name is given as {NAMED[name]}=NAME.",
            ) from None
        if file is None or not error.problem.startswith("unknown field of Scenario"):
            raise
        in_file = not str(error.source).startswith(replacements.source)
        other = other_kind(file, field_names(given)) if in_file else None
        if other is None:
            raise
        raise ConfigurationError(other[0], source=str(file), fix=other[1]) from None
    assert isinstance(loaded, Scenario)
    return loaded


def _put_in_named(scenario: Scenario, merge: Callable[[Scenario], Scenario]) -> Scenario:
    """Puts the named knife and the calibrated food in, where the scenario does not have them yet.

    What stands beside the names, which `merge` puts over them, wins.
    """
    knife, food = scenario.knife_name, scenario.calibration
    found: dict[str, Any] = {}
    names: dict[str, Any] = {}
    if knife is not None and not isinstance(knife, _PutIn):
        found["knife"] = load_knife(knife, "scenario.knife_name").knife
        names["knife_name"] = _PutIn(knife)
    if food is not None and not isinstance(food, _PutIn) and isinstance(scenario.food, Food):
        calibrated = load_calibrated_food(food)
        found["food"] = calibrated.apply_to(scenario.food)
        if calibrated.bench != BenchErrors():
            found["bench"] = calibrated.bench
        names["calibration"] = _PutIn(food)
    return dc.replace(merge(dc.replace(scenario, **found)), **names) if found else scenario
