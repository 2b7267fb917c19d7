"""The motion through all places where a policy may take the knife, for checks before a run."""

import itertools
import math
from collections.abc import Sequence

from sliceit_drake.cutting.motion import ConstantSpeed, Hold, MotionPlan, Segment

__all__ = ["envelope", "envelope_time"]

_Corners = Sequence[tuple[float, float]]


def envelope(corners: _Corners, speed: float, duration: float, label: str) -> MotionPlan:
    """Straight from corner to corner, then at rest.

    Args:
        corners: x and z in the knife frame at the start, m; the start before the first.
        speed: Speed between the corners, m/s.
        duration: Duration of the whole motion, s.
        label: Label of its segments.
    """
    way: list[Segment] = [
        ConstantSpeed(speed, [dx / distance, 0.0, dz / distance], distance, label=label)
        for dx, dz, distance in _legs(corners)
    ]
    left = duration - envelope_time(corners, speed)
    return MotionPlan([*way, Hold(left, label=label)] if left > 1e-9 else way)


def envelope_time(corners: _Corners, speed: float) -> float:
    """Duration of the path through the corners, s; arguments as for `envelope`."""
    return sum(distance for *_, distance in _legs(corners)) / speed


def _legs(corners: _Corners) -> list[tuple[float, float, float]]:
    legs = []
    for (x, z), (a, b) in itertools.pairwise([(0.0, 0.0), *corners]):
        distance = math.hypot(a - x, b - z)
        if distance > 0.0:
            legs.append((a - x, b - z, distance))
    return legs
