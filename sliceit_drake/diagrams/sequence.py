"""Slices in a row: what each leaves of the body, where it lies, and the knife's motion over all."""

import dataclasses as dc
import math

from pydrake.math import RigidTransform

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.foods.shapes import Ellipsoid, MeshFile, Remainder
from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Retract, Segment

__all__ = ["SliceSequence"]

FALL = 0.4
"""Time in which the last slice comes to lie, s."""


@dc.dataclass
class SliceSequence:
    """Slices cut from the free end of a body whose other end is held.

    The body's free end is at least y in its frame; slice k is cut `trim` + (k + 1) `thickness` from
    it. The knife cuts down to the board, retracts to `start.clearance` above the higher of this
    section and the next, indexes, and comes down at `travel_speed` to `start.clearance` above the
    next section. Each slice starts from the undeformed remainder: what the one before left in it of
    strain is forgotten.
    """

    count: int = quantity(5, "", low=1, high=200)
    """Slices to cut."""
    thickness: float = quantity(5e-3, "m", low=5e-4, high=0.1)
    """Of every slice."""
    trim: float = quantity(0.0, "m", low=0.0, high=0.5)
    """Length that has been cut off the free end before."""
    indexing: str = choice("knife", ("knife", "food"))
    """What moves by the thickness between two slices. knife: the knife, towards the holder; food:
    the holder pushes the food while the knife waits above it."""
    slice_speed: float = quantity(0.02, "m/s", low=1e-4, high=1.0)
    """Of the knife, downwards."""
    travel_speed: float = quantity(0.15, "m/s", low=1e-3, high=1.0)
    """Of retracting, indexing and approaching."""
    acceleration: float = quantity(1.0, "m/s2", low=1e-2, high=20.0)
    """Of all ramps."""
    overtravel: float = quantity(2e-4, "m", low=0.0, high=5e-3)
    """Depth of the knife's target below the board's top."""
    hold: float = quantity(0.1, "s", low=1e-3, high=60.0)
    """Rest at the board."""
    push: float = quantity(0.0, "m", low=0.0, high=0.1)
    """How far the knife pushes each slice away before it retracts, so that the slice falls over."""
    push_height: float = quantity(0.65, "", low=0.0, high=1.0)
    """Height of the edge as it pushes, over that of the section."""
    push_speed: float = quantity(0.08, "m/s", low=1e-3, high=1.0)
    """Of the knife, sideways."""
    slice_layers: int = quantity(2, "", low=1, high=20)
    """Layers of elements in a slice."""
    layers: list[float] = quantity([2.8e-3, 6.4e-3, 12e-3], "m", low=1e-4, high=0.5)
    """Distances of the element layers behind the cut; takes the place of food.shape's."""

    def foods(self, food: Food) -> list[Food]:
        """The food of each slice: what the slices before it have left."""
        shape = food.shape
        assert not isinstance(shape, MeshFile | Remainder), "check_food() has made sure"
        return [
            dc.replace(
                food, shape=Remainder(shape, y, self.thickness, self.slice_layers, self.layers)
            )
            for y in self.positions(food)
        ]

    def poses(self, food: Food, X_WF: RigidTransform) -> list[RigidTransform]:
        """Where the food of each slice lies.

        Args:
            food: The whole body.
            X_WF: Pose of its frame when the first slice is cut.
        """
        positions = self.positions(food)
        if self.indexing == "food":
            positions = positions[:1] * self.count
        return [X_WF @ RigidTransform([0.0, y, 0.0]) for y in positions]

    def motion(self, tops: list[float], clearance: float) -> MotionPlan:
        """The knife's motion from `clearance` above the first section to that above the last.

        Args:
            tops: Height of each section's top above the board, metres.
            clearance: Height of the edge above the sections, metres.
        """
        speed, acceleration = self.travel_speed, self.acceleration
        segments: list[Segment] = []
        for k, top in enumerate(tops):
            down = top + clearance + self.overtravel
            segments += [
                ConstantSpeed(
                    self.slice_speed, distance=down, acceleration=acceleration, label="slice"
                ),
                Hold(self.hold, label="hold"),
            ]
            following = tops[k + 1] if k + 1 < len(tops) else top
            lower = max(top - following, 0.0)
            up = down + max(following - top, 0.0)
            if self.push > 0.0:
                lift = self.push_height * top + self.overtravel
                segments.append(Retract(lift, speed, acceleration, label="lift"))
                segments.append(self._across(self.push, self.push_speed, "push"))
                up -= lift
            segments.append(Retract(up, speed, acceleration, label="retract"))
            if k + 1 == len(tops):
                fall = FALL if self.push > 0.0 else 0.0
                segments.append(Hold(self.hold + fall, label="end"))
                break
            back = self.push + (self.thickness if self.indexing == "knife" else 0.0)
            if back > 0.0:
                segments.append(self._across(-back, speed, "index"))
            else:
                segments.append(Hold(self.thickness / speed + speed / acceleration, label="index"))
            if lower > 1e-6:
                segments.append(
                    ConstantSpeed(
                        speed, distance=lower, acceleration=acceleration, label="approach"
                    )
                )
        return MotionPlan(segments)

    def _across(self, distance: float, speed: float, label: str) -> ConstantSpeed:
        """To the side of the slices, or back where `distance` is negative."""
        # The knife's y is opposite to the body's: its edge points down.
        direction = [0.0, math.copysign(1.0, distance), 0.0]
        return ConstantSpeed(
            speed, direction, distance=abs(distance), acceleration=self.acceleration, label=label
        )

    def check_food(self, food: object, where: str) -> None:
        """Refuses a food that cannot be sliced so.

        Args:
            food: `scenario.food`.
            where: Dotted path of the scenario.

        Raises:
            ConfigurationError: Naming field and fix.
        """
        if not isinstance(food, Food) or isinstance(food.shape, MeshFile | Remainder):
            raise ConfigurationError(
                "has no body that a sequence can slice",
                field=f"{where}.food",
                fix="Give a finite-element food with a Cylinder, HalfCylinder, Box, Ellipsoid or "
                "Tapered.",
            )
        if food.held_sides != "plus":
            raise ConfigurationError(
                f"is {food.held_sides!r}; in a sequence the slice is free and the rest is held",
                field=f"{where}.food.held_sides",
                fix='Write "held_sides: plus".',
            )
        if any(food.cut_point) or food.cut_normal != [0.0, 1.0, 0.0]:
            raise ConfigurationError(
                "places a cut of its own; a sequence cuts across y, at trim and thickness; planes "
                "that are oblique or not parallel are not supported in it",
                field=f"{where}.food.cut_point and {where}.food.cut_normal",
                fix="Leave both out, or cut one slice without a sequence.",
            )
        length, end = self._length(food), -self._length(food) / 2.0 + self.trim
        if end < -food.shape.reach - 1e-9:
            raise ConfigurationError(
                f"{1e3 * self.trim:.4g} mm leaves a pointed end; slices need a flat one",
                field=f"{where}.sequence.trim",
                fix=f"Give at least {0.5 * length - food.shape.reach:.4g} m.",
            )
        needed = self.trim + self.count * self.thickness + food.hold_distance
        available = 0.5 * length + food.shape.reach
        if needed >= available:
            most = int((available - needed) / self.thickness + self.count - 1e-9)
            fix = f"Give at most {most}" if most > 0 else "Give a thinner slice"
            raise ConfigurationError(
                f"{self.count} slices of {1e3 * self.thickness:.4g} mm, {1e3 * self.trim:.4g} mm of"
                f" trim and {1e3 * food.hold_distance:.4g} mm to the holder need "
                f"{1e3 * needed:.4g} mm; the body gives {1e3 * available:.4g} mm",
                field=f"{where}.sequence.count",
                fix=f"{fix}, or a longer food.shape.",
            )
        for each in self.foods(food):
            assert isinstance(each.shape, Remainder)
            try:
                each.shape.check("")
            except ConfigurationError as error:
                name = (error.field or "").removeprefix(".")
                raise ConfigurationError(
                    error.problem, field=f"{where}.sequence.{name}", fix=error.fix
                ) from None

    @staticmethod
    def _length(food: Food) -> float:
        """Length of the body along y, metres."""
        shape = food.shape
        assert not isinstance(shape, MeshFile | Remainder), "check_food() has made sure"
        return shape.diameters[1] if isinstance(shape, Ellipsoid) else 2.0 * shape.reach

    def positions(self, food: Food) -> list[float]:
        """y of each cut in the frame of the whole body, metres."""
        first = -0.5 * self._length(food) + self.trim
        return [first + (k + 1) * self.thickness for k in range(self.count)]
