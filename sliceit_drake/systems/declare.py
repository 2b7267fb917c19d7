"""A base class of systems; ports and cached values by functions that return the value; errors."""

from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    CacheEntry,
    Context,
    DependencyTicket,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

__all__ = ["PlainSystem", "declare_cached", "declare_output", "where_and_when"]


class PlainSystem(LeafSystem):
    """A system without witness functions.

    After each unrestricted update Drake asks all systems for theirs, and pydrake looks for a method
    of this name in each: one that is absent costs an exception each time, one that is not written
    in Python is looked for once.
    """

    DoGetWitnessFunctions = LeafSystem.GetWitnessFunctions


def declare_output(
    system: LeafSystem,
    name: str,
    example: AbstractValue | int,
    calc: Callable[[Context], Any],
    prerequisites: set[DependencyTicket],
) -> OutputPort:
    """Declares an output port.

    Args:
        system, name: What has the port, and the port's name.
        example: A value of the port's type; of a vector port its size.
        calc: From the system's context to the port's value.
        prerequisites: What the value depends on.
    """
    if isinstance(example, int):
        return system.DeclareVectorOutputPort(
            name,
            example,
            lambda context, output: output.SetFromVector(calc(context)),
            prerequisites,
        )
    return system.DeclareAbstractOutputPort(
        name, example.Clone, lambda context, output: output.set_value(calc(context)), prerequisites
    )


def declare_cached(
    system: LeafSystem,
    name: str,
    calc: Callable[[Context], object],
    prerequisites: set[DependencyTicket],
) -> CacheEntry:
    """Declares a value of any type that is computed when it is asked for after a change.

    Arguments as for `declare_output`.
    """
    producer = ValueProducer(
        allocate=lambda: Value(object()),
        calc=lambda context, value: value.set_value(calc(context)),
    )
    return system.DeclareCacheEntry(name, producer, prerequisites)


def where_and_when(system: LeafSystem, context: Context) -> str:
    """Path of a system and its context's time, with which the message of an error begins."""
    return f"{system.GetSystemPathname()}: at t = {context.get_time():.6g} s"
