"""What a slice record says of knife and food, from their descriptions."""

import numpy as np

from sliceit_drake.cutting.foods.food import Food, shape_facts
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.records.metadata import FoodFacts, KnifeFacts

__all__ = ["food_facts", "knife_facts"]


def knife_facts(knife: Knife) -> KnifeFacts:
    """The measures of a knife's section."""
    return KnifeFacts(
        name="straight double bevel",
        length=knife.length,
        height=knife.height,
        spine_thickness=knife.spine_thickness,
        edge_thickness=knife.edge_thickness,
        tip_height=knife.tip_height,
        edge_radius=knife.edge_radius,
    )


def food_facts(food: Food, peeled: bool, position: np.ndarray, yaw: float) -> FoodFacts:
    """Size, support and place of a food; `position` [3], m, and `yaw`, rad, are those of F in W."""
    shape, size = shape_facts(food)
    return FoodFacts(
        name=food.name,
        shape=shape,
        size=size,
        support="clamped_slab" if food.held_sides == "both" else "end_slice",
        peeled=peeled,
        position=position.tolist(),
        yaw=yaw,
    )
