"""What a slice record says of the knife and of the food's support, from their descriptions."""

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.records.metadata import KnifeFacts

__all__ = ["food_support", "knife_facts"]


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


def food_support(food: Food) -> str:
    """`FoodFacts.support` of a food."""
    return "clamped_slab" if food.held_sides == "both" else "end_slice"
