"""The measured cuts beside other simulators and ours: comparison, and a quick fit of five numbers.

The fit is a small search whose result is written down, not the calibration: it says what the model
can follow, in sample, with parameters that one press cut hardly tells apart.
"""

import dataclasses as dc
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml, quantity
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel, Numerics
from sliceit_drake.cutting.motion import ConstantSpeed, Motion, MotionPlan
from sliceit_drake.cutting.simulate import SliceResult, simulate_slice
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.diagrams.outputs.measurement_comparison import (
    Comparison,
    compare_with_measurement,
)
from sliceit_drake.diagrams.scenario import Measurement
from sliceit_drake.resources import resource_path
from studies.simulated_profiles import SimulatedProfile, load_simulated_profile

__all__ = [
    "FITTED",
    "STARTS",
    "MeasuredCut",
    "MeasuredFood",
    "MeasuredFoods",
    "cut_measured_food",
    "fit_measured_food",
    "load_measured_foods",
    "save_measured_foods",
]

PERIOD = 2e-3
CLEARANCE = 5e-4
CHECK_PERIOD = 0.02
"""Interval at which the largest energy ratio is looked for, s."""

FITTED = {
    "material.toughness": (30.0, 1500.0),
    "material.youngs_modulus": (4e4, 3e6),
    "material.friction": (0.02, 1.0),
    "effects.skin.toughness": (1e-3, 3.0),
}
"""Parameters of the fit and their bounds, searched in their logarithm; the time of first contact is
the fifth."""

STARTS = ((2e6, 0.05), (5e5, 0.3))
"""Young's modulus and friction from which the fit starts: stiff with little friction, and soft with
more, between which one press cut hardly tells."""
STEPS = 5
"""Most steps from each start."""
STEP = 0.02
"""Step of the finite differences, relative to the logarithm of the bounds."""


@dc.dataclass
class MeasuredFood:
    """A food whose cut was measured, with fitted parameters."""

    food: Food = dc.field(default_factory=Food)
    numerics: Numerics = dc.field(default_factory=Numerics)
    measurement: Measurement = dc.field(default_factory=Measurement)
    fit_refinement: float = quantity(1.0, "", low=0.1, high=4.0)
    """Elements along an edge in the fit, relative to the mesh."""

    def check(self, where: str) -> None:
        if not isinstance(self.food.shape, Cylinder):
            raise ConfigurationError(
                "is not a cylinder",
                field=f"{where}.food.shape",
                fix="Give a !Cylinder: apparent work is taken over a round section.",
            )

    @property
    def diameter(self) -> float:
        """Diameter of the section, metres."""
        assert isinstance(self.food.shape, Cylinder)
        return self.food.shape.diameter

    @property
    def section(self) -> float:
        """Area, m^2."""
        return 0.25 * np.pi * self.diameter**2

    def profile(self) -> SimulatedProfile:
        """The measured force.

        Raises:
            ConfigurationError: As `load_simulated_profile`.
        """
        return load_simulated_profile(resource_path(self.measurement.file))

    def motion(self, model: CuttingModel, profile: SimulatedProfile) -> Motion:
        """Straight down at the record's speed, as deep as it goes where it begins at contact."""
        speed = self.measurement.speed
        above = model.top - self.diameter + CLEARANCE
        distance = speed * float(profile.time[-1] - profile.time[0]) + above
        plan = MotionPlan([ConstantSpeed(distance=distance, speed=speed)])
        return Motion(plan, start_pose(model, CLEARANCE))


@dc.dataclass
class MeasuredFoods:
    """The foods of the verification."""

    foods: list[MeasuredFood] = dc.field(default_factory=list)


@dc.dataclass
class MeasuredCut:
    """A simulated cut beside the measured one.

    Attributes:
        comparison: With the time of first contact fitted.
        profile: The record.
        result: The simulated cut.
        model: Its model.
    """

    comparison: Comparison
    profile: SimulatedProfile
    result: SliceResult
    model: CuttingModel


def load_measured_foods(file: str | Path) -> MeasuredFoods:
    """Reads the foods of the verification.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    foods = load_yaml(MeasuredFoods, file)
    assert isinstance(foods, MeasuredFoods)
    return foods


def save_measured_foods(foods: MeasuredFoods, file: str | Path, command: str) -> None:
    """Writes the foods, with the command that fitted them."""
    text = (
        f"# Written by `{command}`, which fits toughness, Young's modulus, friction and skin to\n"
        "# the measured curves (and the time of first contact, which every comparison fits anew).\n"
        "# One press cut does not tell E from friction: these are no material constants.\n"
    )
    Path(file).write_text(text + dump_yaml(foods), encoding="utf-8")


def cut_measured_food(case: MeasuredFood, refinement: float = 1.0) -> MeasuredCut:
    """Cuts the food as it was measured.

    Raises:
        CuttingError: The cut became unphysical.
    """
    profile = case.profile()
    model = make_food_model(case.food, Knife(), case.numerics, refinement)
    solver = CuttingSolver(model, PERIOD)
    result = simulate_slice(solver, case.motion(model, profile), check_period=CHECK_PERIOD)
    comparison = compare_with_measurement(
        profile,
        case.measurement,
        case.diameter - result.position[:, 2],
        np.linalg.norm(result.food_wrench[:, 3:], axis=1),
    )
    return MeasuredCut(comparison, profile, result, model)


def fit_measured_food(
    case: MeasuredFood, progress: Callable[[int], object] | None = None
) -> MeasuredFood:
    """Fits `FITTED` to the record, by least squares from each of `STARTS`.

    Args:
        case: Food and record.
        progress: Called with 1 after each start.

    Raises:
        CuttingError: The food cannot be cut with what was found.
    """
    found = []
    # Processes, for what a cut spends in Python.
    with worker_processes(os.cpu_count() or 1) as pool:
        for result in pool.map(_fit_from, [case] * len(STARTS), STARTS):
            found.append(result)
            if progress is not None:
                progress(1)
    failure = CuttingError(f"{case.food.name}: no start of the fit could be cut")
    for _, fitted in sorted(found, key=lambda result: result[0]):
        try:
            cut_measured_food(fitted)
        except CuttingError as error:
            failure = error
            continue
        return fitted
    raise failure


def _fit_from(case: MeasuredFood, start: tuple[float, float]) -> tuple[float, MeasuredFood]:
    """RMS error on the mesh of the fit [N] and the food, from a start."""
    low, high = np.log(np.array(list(FITTED.values()))).T
    profile = case.profile()
    travel = case.measurement.speed * float(np.trapezoid(profile.force, profile.time))
    best = (np.inf, case)

    def at(x: np.ndarray) -> MeasuredFood:
        return _with_values(case, np.exp(low + x * (high - low)).tolist())

    def difference(x: np.ndarray) -> np.ndarray:
        nonlocal best
        candidate = at(x)
        try:
            comparison = cut_measured_food(candidate, case.fit_refinement).comparison
        except CuttingError:
            # Worse than no force at all: the search turns back.
            return 2.0 * profile.force
        if comparison.rms < best[0]:
            best = (comparison.rms, candidate)
        return comparison.simulated - profile.force

    # Of the apparent work, friction takes some.
    given = np.log([0.8 * travel / case.section, *start, 1e-2])
    least_squares(
        difference,
        np.clip((given - low) / (high - low), 0.02, 0.98),
        bounds=(0.0, 1.0),
        diff_step=STEP,
        max_nfev=STEPS,
    )
    return best


def _with_values(case: MeasuredFood, values: list[float]) -> MeasuredFood:
    """The food with other values of `FITTED`, to four digits."""
    toughness, modulus, friction, skin = (float(f"{value:.4g}") for value in values)
    food = case.food
    material = dc.replace(
        food.material, toughness=toughness, youngs_modulus=modulus, friction=friction
    )
    effects = dc.replace(food.effects, skin=dc.replace(food.effects.skin, toughness=skin))
    return dc.replace(case, food=dc.replace(food, material=material, effects=effects))
