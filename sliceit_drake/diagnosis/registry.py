"""Causes by name, and causes that a user wrote."""

import inspect
import traceback
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis.cause import Cause, check_cause
from sliceit_drake.diagnosis.causes import BUILT_IN
from sliceit_drake.diagnosis.rehearsal import dry_run
from sliceit_drake.resources import load_module

__all__ = [
    "ENTRY_POINTS",
    "all_causes",
    "is_users",
    "load_cause",
    "open_causes",
]

ENTRY_POINTS = "sliceit_drake.causes"
"""Group of entry points that name classes of causes."""


def all_causes() -> list[Cause]:
    """The causes that come with the package, and those of installed packages.

    Raises:
        ConfigurationError: An installed cause cannot be loaded or is incomplete, or a name is there
            twice.
    """
    causes = [kind() for kind in BUILT_IN]
    for point in entry_points(group=ENTRY_POINTS):
        try:
            cause = point.load()()
        except Exception as error:
            raise ConfigurationError(
                f"cannot be loaded: {type(error).__name__}: {error}",
                source=f"entry point {point.name} = {point.value}",
                field=ENTRY_POINTS,
                fix="Correct or uninstall the package that offers it.",
            ) from error
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
    return [c for c in causes if not c.absorbed(base)]


def is_users(cause: Cause) -> bool:
    """Whether a cause is a user's and not one of the package."""
    return type(cause) not in BUILT_IN


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
        ConfigurationError: There is no such file, it does not run or does not hold one cause, or
            that is incomplete or fails on a made-up slice.
    """
    file = Path(file)
    try:
        module = load_module(f"sliceit_cause_{file.stem}", file)
    except Exception as error:
        raise _broken(file, error, "cannot be read as Python") from error
    if module is None:
        raise ConfigurationError(
            "there is no such file", source=str(file), field="--cause", fix="Check the path."
        )
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
    try:
        cause = kinds[0]()
    except Exception as error:
        raise _broken(file, error, "cannot be made") from error
    check_cause(cause, str(file))
    try:
        dry_run(cause, str(file))
    except ConfigurationError:
        raise
    except Exception as error:
        raise _broken(file, error, "fails on a made-up slice") from error
    return cause


def _broken(file: Path, error: Exception, what: str) -> ConfigurationError:
    """An error in a user's file, with the line of that file where it happened."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(file)]
    line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    return ConfigurationError(
        f"{what}: {type(error).__name__}: {text}",
        source=f"{file}, line {line}" if line else str(file),
        field="--cause",
        fix="Correct the file (docs/causes.md has a complete example).",
    )
