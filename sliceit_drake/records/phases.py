"""Phases of one straight slice, and its speed, from the motion of the knife."""

import numpy as np

from sliceit_drake.records.metadata import NominalMotion, Phase, SliceMetadata

__all__ = ["nominal_motion", "phases_from_motion"]

AT_REST = 0.05
"""Vertical speed below this fraction of its greatest is rest."""
MIN_HOLD = 0.02
"""A rest shorter than this is a turning point, s."""


def phases_from_motion(
    metadata: SliceMetadata, time: np.ndarray, height: np.ndarray
) -> list[Phase]:
    """Labels air, slice, hold and retract of a motion that goes down once and up once.

    Slicing begins when the edge is level with the food's top and ends when the knife stops.

    Args:
        metadata: Facts of the slice; without `food.size` and `food.position` nothing is labelled.
        time: Increasing times [n], s.
        height: p_WK_z, height of the edge [n], m.

    Returns:
        The phases; none if the knife does not start above the food and go below its top.
    """
    food = metadata.food
    if food.size is None or food.position is None:
        return []
    top = food.position[2] + food.size[2]
    below = np.flatnonzero(height <= top)
    if below.size == 0 or below[0] == 0:
        return []
    rate = np.gradient(height, time)
    least = AT_REST * float(np.abs(rate).max())
    contact = int(below[0])
    lowest = int(height.argmin())
    down = np.flatnonzero(rate[: lowest + 1] < -least)
    stop = int(down[-1]) if down.size else lowest
    up = np.flatnonzero(rate > least)
    up = up[up > stop]
    start_up = int(up[0]) if up.size else len(time) - 1
    marks = [("air", 0, contact), ("slice", contact, stop), ("hold", stop, start_up)]
    marks.append(("retract", start_up, len(time) - 1))
    if time[start_up] - time[stop] < MIN_HOLD:
        marks[2:] = [("retract", stop, len(time) - 1)] if up.size else []
        marks[1] = ("slice", contact, stop if up.size else len(time) - 1)
    return [
        Phase(label, float(time[first]), float(time[last]))
        for label, first, last in marks
        if time[last] > time[first]
    ]


def nominal_motion(
    phases: list[Phase], slicing: np.ndarray, press: np.ndarray, draw: np.ndarray
) -> NominalMotion:
    """The motion of a slice that was cut as planned.

    Args:
        phases: Of the motion.
        slicing: Rows in phases of slicing [n]; those in which the knife presses count.
        press, draw: Speeds into the food and along the edge [n], m/s.
    """
    motion = NominalMotion(phases=phases)
    slicing = slicing & (press > 1e-5)
    if slicing.any():
        speed = float(np.median(press[slicing]))
        motion.speed = round(speed, 6)
        motion.draw_ratio = round(float(np.median(draw[slicing])) / speed, 4)
    return motion
