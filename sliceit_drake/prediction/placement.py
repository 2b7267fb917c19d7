"""The knife's poses relative to the food of a record, and which food and knife these are."""

import copy
import dataclasses as dc

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import Food, start_pose
from sliceit_drake.cutting.foods.shapes import PlainShape
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["food_of", "is_bare", "knife_of", "poses_in_food"]

ONSET = 0.02
"""Fraction of a record's greatest force at which contact begins, its height unknown."""
CROPPED = 0.05
"""Fraction of a record's greatest force above which it begins in the food, its height unknown."""
DEEPEST = 5e-3
"""Depth in the food at which such a record may begin, metres."""


def poses_in_food(
    record: SliceRecord, model: CuttingModel
) -> tuple[Rotation, Rotation, np.ndarray]:
    """Poses of the knife in a record of n rows, relative to the food that it cuts.

    Where food or heights are unknown, contact begins at the top of the cut when the force does.

    Returns:
        R_FW, R_FK [n], p_FK [n, 3], metres.
    """
    facts = record.metadata.food
    R_FW = Rotation.from_euler("z", -(facts.yaw or 0.0))
    p = record.position.copy()
    home = start_pose(model, 0.0)
    unknown = set(record.metadata.unknown)
    rotation = R_FW * Rotation.from_matrix(record.rotation)
    if facts.position is None:
        p = R_FW.apply(p - p[0]) + home.p
        rotation = Rotation.from_matrix(home.R) * (rotation[0].inv() * rotation)
    else:
        p = R_FW.apply(p - np.array(facts.position))
    if facts.position is None or "p_WK_z" in unknown or "food.position" in unknown:
        # Height is measured from where the force begins.
        p[:, 2] += home.p[2] - _contact_height(record.force_magnitude, p[:, 2])
    return R_FW, rotation, p


def _contact_height(force: np.ndarray, height: np.ndarray) -> float:
    """Height of the edge [n], metres, where its force [n], N, begins.

    A record that begins in the food is taken back in a straight line to where there was none.
    """
    first = max(3, len(force) // 50)
    quiet = float(force[:first].max())
    early = slice(3 * first)
    way = height[0] - height[early].min()
    if force[0] > CROPPED * force.max() and way > 0.0:
        slope, level = np.polyfit(height[early], force[early], 1)
        if -slope * way > ONSET * force.max():
            return float(np.clip(-level / slope, height[0], height[0] + DEEPEST))
    return float(height[np.argmax(force > quiet + ONSET * force.max())])


def food_of(food: Food, record: SliceRecord) -> Food:
    """The food with what the record says of its size and support.

    Raises:
        ConfigurationError: The record is of another shape than the food.
    """
    facts = record.metadata.food
    food = copy.deepcopy(food)
    if facts.support != "unknown":
        food.held_sides = "both" if facts.support == "clamped_slab" else "plus"
    if facts.size is None or facts.shape == "unknown":
        return food
    shape, kind = food.shape, type(food.shape).__name__.lower()
    if kind != facts.shape or not isinstance(shape, PlainShape):
        raise ConfigurationError(
            f"is a {facts.shape}, the food of the setup is a {kind}",
            source=record.source,
            field="food.shape",
            fix="Calibrate it with a setup of that shape (--food FILE.yaml).",
        )
    food.shape = shape.resized(facts.size)
    return food


def knife_of(knife: Knife, record: SliceRecord) -> Knife:
    """The knife with what the record says of it."""
    facts, measures = vars(record.metadata.knife), {f.name for f in dc.fields(Knife)}
    known = {k: v for k, v in facts.items() if k in measures and v is not None}
    return dc.replace(knife, **known)


def is_bare(record: SliceRecord) -> bool:
    """Whether a record says that there is no food under the knife."""
    return record.metadata.food.name == "none"
