"""A slice that is yet to be cut, as plain data: stations, stand-ins and diagnoses understand it."""

import dataclasses as dc

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.motion import MotionPlan

__all__ = ["PlannedSlice"]


@dc.dataclass
class PlannedSlice:
    """A slice that is yet to be cut.

    Attributes:
        name: Name of the slice.
        food: What is cut; None for the bare board.
        height: Height of the food's section, metres; of the bare board where its top would be.
        knife: The knife.
        board: What the food lies on; the top is its height in the world.
        position: Origin of F in the world [3], metres; None if any place will do.
        yaw: Direction of Fx in the world, rad.
        clearance: Height of the edge above the food at the start, metres.
        offset: Shift of the edge's middle along the edge at the start, metres.
        motion: Motion of the knife.
        peeled: Whether the skin is taken off before.
        weight: Mass hung on the knife in segments "weight", kg.
        knife_slices: Slices that the knife has cut since it was sharpened.
    """

    name: str
    food: Food | None
    height: float
    knife: Knife
    board: Board
    position: list[float] | None
    yaw: float
    clearance: float
    offset: float
    motion: MotionPlan
    peeled: bool = False
    weight: float = 0.0
    knife_slices: int = 0
