"""How stiff a spring along one direction the loop of compliance control bears."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagrams.stability import ContactLoop

__all__ = ["directional_stiffness", "stiffness_limit"]

GREATEST_STIFFNESS = 1e7
"""N/m."""


def directional_stiffness(direction: Sequence[float], stiffness: float) -> np.ndarray:
    """A spring [6, 6] that resists motion along one direction [6], translations first."""
    d = np.asarray(direction, float)
    return stiffness * np.outer(d, d)


def stiffness_limit(
    loop: ContactLoop, direction: Sequence[float], *, on_board: bool = False
) -> float:
    """Stiffness of a spring along a direction [6] above which the loop is unstable, N/m.

    Args:
        loop: Of a station.
        direction: Translations first, in W.
        on_board: Whether the spring is in the plant instead of beyond the coupling step.
    """
    if not loop.least_stable_mode().stable:
        return 0.0
    low = 100.0

    def stable(stiffness: float) -> bool:
        K = directional_stiffness(direction, stiffness)
        mode = loop.least_stable_mode(None, K) if on_board else loop.least_stable_mode(K)
        return mode.stable

    # Upwards in small steps: a loop can be unstable in a window of stiffness alone.
    while low < GREATEST_STIFFNESS and stable(high := 1.3 * low):
        low = high
    if low >= GREATEST_STIFFNESS:
        return GREATEST_STIFFNESS
    while high > 1.01 * low:
        middle = np.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return float(np.sqrt(low * high))
