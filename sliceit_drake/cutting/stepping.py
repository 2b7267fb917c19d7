"""How many sub-steps a coupling step takes: more where the knife or the food changes its velocity.

Inertia that is added to the relative motion of nodes (`inertia`) errs where they accelerate. Food
at the blade follows a knife that stops or turns over some tenths of a millimetre of its way, or
some milliseconds. So each of two points of the edge has a velocity that the food has settled to,
which follows its own, and sub-steps are the shorter the more the two differ.

What the food does by itself, as when a skin gives way, is not known before. A coupling step at
whose end the added inertia takes much force is repeated from its beginning with shorter sub-steps.
Where the food does no such thing the knife's motion alone decides: the same steps are taken
whatever the food's parameters, so that differences of two slices have no steps in them. A gradient
goes back by the steps of its slice.

Inertia grows with the sub-step, and what still swings when it grows swings with more energy. So
sub-steps get longer by a factor of two at a time, some coupling steps after they could.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sliceit_drake.cutting.model import CuttingModel

__all__ = ["EVENT", "STEPPING", "Stepping"]

STEPPING = 8
"""Numbers that a state holds: the velocities of the edge's two points that the food has settled to,
in C, m/s; its last sub-step, s, or 0; coupling steps in which it could have been twice as long."""

TRAVEL = 4e-5
"""Most way of the knife in a sub-step, metres."""
CHANGE = 1.6e-9
"""Most of: the velocity that food has not settled to times the square of a sub-step, m s."""
EVENT = 0.25
"""Most force of the added inertia, over the mean force to cut through the section."""
SETTLING_WAY = 1e-3
"""Way of the knife over which the food settles to a new velocity, metres."""
SETTLING_TIME = 10e-3
"""Time in which it settles, s."""
FINEST = 64
"""Most sub-steps of a coupling step."""
SLACK = 0.8
"""Part of the longest sub-step that is allowed to which one may be doubled."""
CALM = 5
"""Coupling steps in which a sub-step could be twice as long before it is."""


class Stepping(NamedTuple):
    """The rule for one cut.

    Attributes:
        half_span: Half the width of the section, at whose ends the edge's points are, metres.
        top: Height in C above which the knife touches nothing, metres.
        coarsest: Sub-steps of a coupling step where nothing changes.
        by_need: `numerics.step_by_need`.
        force: Most force of the added inertia, N.
    """

    half_span: float
    top: float
    coarsest: int
    by_need: bool
    force: float

    @classmethod
    def of(cls, model: CuttingModel, coarsest: int, event: float = EVENT) -> "Stepping":
        """The rule for a cut, its number of sub-steps where nothing changes, and `EVENT`."""
        low, high = model.span
        # Tables blur by one spacing.
        top = model.top + model.tables.spacing
        force = event * model.work_through / (model.top - model.bottom)
        return cls(0.5 * (high - low), top, coarsest, model.numerics.step_by_need, force)

    def plan(
        self, stepping: np.ndarray, R: np.ndarray, p: np.ndarray, period: float
    ) -> tuple[list[int], list[list[float]]]:
        """Numbers of sub-steps of coupling steps in a row.

        Args:
            stepping: See `STEPPING`, before them.
            R, p: Poses X_CK at their ends [E + 1, 3, 3] and [E + 1, 3], metres.
            period: Duration of each, s.

        Returns:
            The numbers [E], the coarsest one times powers of two, and `stepping` after each
            [E, STEPPING].
        """
        places, h = p.tolist(), self.half_span
        ends = [
            (x - h * a, y - h * b, z - h * c, x + h * a, y + h * b, z + h * c)
            for (x, y, z), (a, b, c) in zip(places, R[:, :, 0].tolist(), strict=True)
        ]
        *settled, last, calm = stepping.tolist()
        number = self.coarsest
        if last > 0.0:
            number = max(number, 2 ** round(math.log2(period / last / number)) * number)
        numbers, after = [], []
        for k in range(len(p) - 1):
            v = [(b - a) / period for a, b in zip(ends[k], ends[k + 1], strict=True)]
            speed = max(math.hypot(*v[:3]), math.hypot(*v[3:]))
            # What nothing touches is at rest.
            in_air = min(places[k][2], places[k + 1][2]) > self.top
            if in_air:
                settled = [0.0] * 6
            # Rounded, so that it is the same whether a state in single precision came between.
            off = [b - round(a, 6) for a, b in zip(settled, v, strict=True)]
            change = max(math.hypot(*off[:3]), math.hypot(*off[3:]))
            least = period * max(speed / TRAVEL, math.sqrt(change / CHANGE))
            least = min(least, FINEST) if self.by_need and not in_air else 0.0
            calm = calm + 1 if number > self.coarsest and 2.0 * least < SLACK * number else 0
            if calm > CALM:
                number, calm = number // 2, 0
            while number < least:
                number *= 2
            keep = math.exp(-speed * period / SETTLING_WAY - period / SETTLING_TIME)
            settled = [b - keep * d for b, d in zip(v, off, strict=True)]
            last = period / number
            numbers.append(number)
            after.append([*settled, last, calm])
        return numbers, after

    def again(self, number: int, added: Sequence[float], stepping: list[float]) -> int:
        """Number of sub-steps with which a coupling step is to be repeated; its own if it is not.

        Args:
            number: Its own.
            added: Force of the added inertia at its end, or of each of several with that number,
                N; see `CouplingSteps`.
            stepping: What `plan` gave after it; gets what follows from the force.
        """
        need = 0.0
        for force in added:
            # What broke down does so however short the steps.
            if self.by_need and math.isfinite(force):
                need = max(need, number * math.sqrt(force / max(self.force, 1e-6)))
        if number > self.coarsest and 2.0 * need >= number:
            stepping[-1] = 0.0
        more = number
        while more < min(need, FINEST):
            more *= 2
        stepping[-2] *= number / more
        return more
