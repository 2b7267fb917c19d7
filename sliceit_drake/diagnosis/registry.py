"""Causes by name, and causes that a user wrote."""

import importlib.util
import inspect
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis.cause import Cause, check_cause
from sliceit_drake.diagnosis.causes import BUILT_IN

__all__ = ["ENTRY_POINTS", "all_causes", "causes_as_markdown", "load_cause", "open_causes"]

ENTRY_POINTS = "sliceit_drake.causes"
"""Group of entry points that name classes of causes."""


def all_causes() -> list[Cause]:
    """The causes that come with the package, and those of installed packages.

    Raises:
        ConfigurationError: An installed cause is incomplete, or a name is there twice.
    """
    causes = [kind() for kind in BUILT_IN]
    for point in entry_points(group=ENTRY_POINTS):
        cause = point.load()()
        check_cause(cause, f"entry point {point.name}")
        causes.append(cause)
    _check_names(causes)
    return causes


def open_causes(base: Sequence[str], extra: Sequence[Cause] = ()) -> list[Cause]:
    """All causes that are more than a shift of a base parameter, and some of a user's.

    Args:
        base: Names of the free base parameters.
        extra: A user's.

    Raises:
        ConfigurationError: A name is there twice.
    """
    causes = [*all_causes(), *extra]
    _check_names(causes)
    return [c for c in causes if not set(c.absorbed_by) & set(base)]


def _check_names(causes: Sequence[Cause]) -> None:
    names = [cause.name for cause in causes]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise ConfigurationError(
                f"there are two causes {name!r}", field="cause", fix="Rename one."
            )


def load_cause(file: str | Path) -> Cause:
    """The cause in a user's file.

    Raises:
        ConfigurationError: There is no such file, it does not hold one cause, or that is
            incomplete.
    """
    file = Path(file)
    spec = importlib.util.spec_from_file_location(f"sliceit_cause_{file.stem}", file)
    if spec is None or spec.loader is None or not file.is_file():
        raise ConfigurationError(
            "there is no such file", source=str(file), field="--cause", fix="Check the path."
        )
    module = importlib.util.module_from_spec(spec)
    # Where the source of a class is looked up.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    kinds = [
        kind
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, Cause) and kind.__module__ == module.__name__
    ]
    if len(kinds) != 1:
        raise ConfigurationError(
            f"holds {len(kinds)} causes",
            source=str(file),
            fix="Write one subclass of sliceit_drake.diagnosis.cause.Cause in it (docs/causes.md).",
        )
    cause = kinds[0]()
    check_cause(cause, str(file))
    return cause


def causes_as_markdown(causes: Sequence[Cause]) -> str:
    """A table of causes."""
    lines = [
        "| row | cause | parameters (size, range) | scanned | signature | revealed by |",
        "|---|---|---|---|---|---|",
    ]
    for cause in causes:
        numbers = "; ".join(
            f"{p.name} {p.size:g} {p.unit}".strip() + f" ({p.low:g} to {p.high:g})"
            for p in cause.parameters
        )
        scanned = ""
        if cause.scan is not None:
            values = ", ".join(f"{v:g}" for v in cause.scan.values)
            scanned = f"{cause.scan.name}: {values} {cause.scan.unit}".strip()
        row = str(cause.row or "")
        lines.append(
            f"| {row} | `{cause.name}` | {numbers} | {scanned} | {cause.signature} "
            f"| {cause.experiment} |"
        )
    return "\n".join(lines)
