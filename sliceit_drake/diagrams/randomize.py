"""Random contexts of diagrams with systems in Python."""

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.framework import Context, Diagram, System

__all__ = ["randomize"]


def randomize(diagram: Diagram, context: Context, rng: np.random.Generator) -> None:
    """Draws state and parameters of all systems of a diagram.

    Drake's `SetRandomContext` does so for systems in C++; of those in Python it calls no override
    (1.51), so each that has a method `randomize_context(context, rng)` is called afterwards, in the
    order in which they were added.

    Args:
        diagram: The whole.
        context: Its context; what is not random in it is put to its default.
        rng: Where all numbers come from.
    """
    diagram.SetRandomContext(context, RandomGenerator(int(rng.integers(2**31))))
    _randomize_parts(diagram, context, rng)


def _randomize_parts(system: System, context: Context, rng: np.random.Generator) -> None:
    draw = getattr(system, "randomize_context", None)
    if draw is not None:
        draw(context, rng)
    elif isinstance(system, Diagram):
        for part in system.GetSystems():
            _randomize_parts(part, system.GetMutableSubsystemContext(part, context), rng)
