"""What a slice record says of the knife and of the food's shape, from their descriptions."""

from sliceit_drake.cutting.foods.food import Box, Cylinder, Ellipsoid, Food
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.records.metadata import KnifeFacts

__all__ = ["food_support", "knife_facts", "shape_facts"]


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


def shape_facts(food: Food) -> tuple[str, list[float] | None]:
    """`FoodFacts.shape` and `FoodFacts.size` of a food, metres; "unknown" and None for
    a shape that records do not know."""
    shape = food.shape
    if isinstance(shape, Cylinder):
        return "cylinder", [shape.diameter, shape.length, shape.diameter]
    if isinstance(shape, Box):
        return "box", list(shape.size)
    if isinstance(shape, Ellipsoid):
        return "ellipsoid", list(shape.diameters)
    return "unknown", None


def food_support(food: Food) -> str:
    """`FoodFacts.support` of a food."""
    return "clamped_slab" if food.held_sides == "both" else "end_slice"
