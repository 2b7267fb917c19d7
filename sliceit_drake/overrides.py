"""Values that replace single fields of a configuration, by their paths."""

import dataclasses as dc
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import yaml

from sliceit_drake.configuration import ConfigurationError, closest, merge_yaml

__all__ = [
    "assignments",
    "changed_fields",
    "path_that_is_meant",
    "set_field",
    "set_field_to_yaml",
]

EXAMPLE = "Give a path such as food.material.toughness or motion.segments.0.speed."
_PATH = r"\s*[A-Za-z_]\w*(?:\.\w+)*\s*="


def assignments(text: str) -> dict[str, str] | None:
    """The YAML texts of values by path, of `a.b=1, c=2`; None where a text is YAML itself.

    Raises:
        ConfigurationError: A path stands there without a value.
    """
    if re.fullmatch(r"\s*[A-Za-z_][\w.]*\s*", text):
        raise ConfigurationError(
            "is given without a value", field=text.strip(), fix=f"Write {text.strip()}=VALUE."
        )
    if not re.match(_PATH, text):
        return None
    pairs = (part.split("=", 1) for part in re.split(rf",(?={_PATH})", text))
    return {path.strip(): value.strip() for path, value in pairs}


def set_field(config: Any, path: str, value: Any, where: str) -> None:
    """Sets the field at a path of names, and of numbers of elements of lists.

    Args:
        config: Dataclass, changed in place and not validated.
        path: As `food.material.toughness` or `motion.segments.0.speed`.
        value: What the field shall hold.
        where: Dotted path of `config`, for errors.

    Raises:
        ConfigurationError: There is no such field.
    """
    at, last = _owner(config, path, where)
    if isinstance(at, list | np.ndarray):
        at[int(last)] = value
    else:
        setattr(at, last, value)


def set_field_to_yaml(config: Any, path: str, text: str, where: str, source: str) -> None:
    """As `set_field`, with the value as YAML text, checked against the field's type.

    Args:
        config, path, where: See `set_field`.
        text: The value; where it needs one with its tag, as "!Cylinder {diameter: 0.03}".
        source: Where the text comes from, for errors.

    Raises:
        ConfigurationError: There is no such field, or it cannot hold the value.
    """
    at, last = _owner(config, path, where)
    parent = path.rpartition(".")[0]
    if isinstance(at, list | np.ndarray):
        at[int(last)] = yaml.safe_load(text)
    else:
        merged = merge_yaml(at, f"{last}: {text}", source, f"{where}.{parent}".rstrip("."))
        setattr(at, last, getattr(merged, last))


def path_that_is_meant(config: Any, path: str) -> str | None:
    """The path of a field of a like name, the first of the shallowest; None where none is alike."""
    paths = sorted(_paths(config), key=lambda each: each.count("."))
    last = path.rpartition(".")[2]
    ends = {each.rpartition(".")[2]: each for each in reversed(paths)}
    like = closest(path, paths)
    return ends[last] if last in ends else like or ends.get(closest(last, ends) or "")


def changed_fields(before: Any, after: Any) -> list[str]:
    """Paths of the fields in which two configurations of a type differ."""
    changed = []
    for field in dc.fields(before):
        old, new = getattr(before, field.name), getattr(after, field.name)
        if dc.is_dataclass(old) and type(old) is type(new):
            changed += [f"{field.name}.{path}" for path in changed_fields(old, new)]
        elif old != new:
            changed.append(field.name)
    return changed


def _owner(config: Any, path: str, where: str) -> tuple[Any, str]:
    """What holds the field at a path, and the field's name or number in it."""
    *parents, last = path.split(".")
    at = config
    try:
        for part in parents:
            at = at[int(part)] if isinstance(at, list) else getattr(at, part)
        if isinstance(at, list | np.ndarray):
            at[int(last)]
        elif last not in {field.name for field in dc.fields(at)}:
            raise AttributeError(last)
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        like = path_that_is_meant(config, path)
        raise ConfigurationError(
            "there is no such field",
            field=f"{where}.{path}",
            fix=f'Did you mean "{like}"?' if like else EXAMPLE,
        ) from error
    return at, last


def _paths(config: Any, before: str = "") -> Iterator[str]:
    """Paths of all fields of a configuration and of what it holds."""
    if dc.is_dataclass(config):
        for field in dc.fields(config):
            yield before + field.name
            yield from _paths(getattr(config, field.name), f"{before}{field.name}.")
    elif isinstance(config, list):
        for k, each in enumerate(config):
            yield from _paths(each, f"{before}{k}.")
