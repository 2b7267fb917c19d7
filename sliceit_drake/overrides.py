"""Values that replace single fields of a configuration: as YAML, or by their paths."""

import dataclasses as dc
import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml

from sliceit_drake.configuration import (
    ConfigurationError,
    closest,
    did_you_mean,
    load_yaml,
    merge_yaml,
    validate,
)

__all__ = [
    "Overrides",
    "Replacements",
    "changed_fields",
    "field_names",
    "load_overridden",
    "path_that_is_meant",
    "plain",
]

Overrides: TypeAlias = str | Sequence[str] | Mapping[str, Any] | None
"""What replaces fields, as YAML text, text of paths, several such texts, or a dictionary.

YAML is `{food: {material: {toughness: 400}}}`; a path is `food.material.toughness=400`, with a
comma before the next. Keys of a dictionary may be paths.
"""
_PATH = r"\s*[A-Za-z_]\w*(?:\.\w+)*\s*="


class Replacements:
    """What overrides say, for a configuration that is loaded in steps.

    Args:
        overrides: See `Overrides`.
        schema: Dataclass whose fields they replace.
        option: That gives them, for errors.

    Raises:
        ConfigurationError: A path stands there without a value.

    Attributes:
        texts: YAML of whole fields, to be merged in turn before `set_in`.
        source: Where they come from, for errors: the option, or "overrides" of a dictionary.
    """

    def __init__(self, overrides: Overrides, schema: type, option: str = "--set") -> None:
        self.texts: list[str] = []
        self.source = "overrides" if isinstance(overrides, Mapping) else option
        self._schema, self._option = schema, option
        self._values: dict[str, Any] = {}
        self._written: dict[str, str] = {}
        if isinstance(overrides, Mapping):
            self._values = {key: value for key, value in overrides.items() if "." in key}
            fields = {k: plain(value) for k, value in overrides.items() if k not in self._values}
            self.texts = [yaml.safe_dump(fields)] if fields else []
            return
        for text in [overrides] if isinstance(overrides, str) else overrides or ():
            paths = _assignments(text)
            if paths is None:
                self.texts.append(text)
                continue
            # What stands at the top may name a food or a knife, whose fields others replace.
            top = [path for path in paths if path in {f.name for f in dc.fields(schema)}]
            self.texts += [f"{path}: {paths[path]}" for path in top]
            self._written |= {path: value for path, value in paths.items() if path not in top}

    def load(
        self,
        file: Path | None,
        given: Any = None,
        put_in: Callable[[Any, Callable[[Any], Any]], Any] = lambda config, _: config,
    ) -> Any:
        """Reads a file and merges `texts` over it, see `load_yaml`.

        Args:
            file: None to start from what is given.
            given: Holds the values of fields that the file leaves out; None for the defaults.
            put_in: Puts into a configuration what the file or a text names in it. It also takes
                what merges the same file or text over a configuration once more.

        Raises:
            ConfigurationError: Naming file, field and fix.
        """
        layers = [(file, None), *((None, text) for text in self.texts)]
        loaded = given
        try:
            for layer in layers:
                merge = functools.partial(self._merge, *layer)
                loaded = put_in(merge(loaded), merge)
        except ConfigurationError as error:
            top, _, name = (error.field or "").partition(".")
            like = path_that_is_meant(self._schema() if given is None else given, name)
            if "." in name or not error.problem.startswith("unknown field") or "." not in str(like):
                raise
            write = f"Write it below {str(like).rpartition('.')[0]}."
            if str(error.source).startswith(self.source):
                write = f"Write it as a path: {self._option} {like}=VALUE."
            raise ConfigurationError(
                error.problem,
                field=error.field,
                source=error.source,
                fix=f'Did you mean "{like}"? {write}',
            ) from None
        return loaded

    def _merge(self, file: Path | None, text: str | None, config: Any) -> Any:
        """A file and a text over a configuration."""
        return load_yaml(self._schema, file, config, text, self.source)

    def set_in(self, config: Any, where: str) -> None:
        """Sets what was given by paths, and validates.

        Args:
            config: Changed in place.
            where: Dotted path of `config`, for errors.

        Raises:
            ConfigurationError: There is no such field, or it cannot hold the value.
        """
        for path, value in self._values.items():
            _set_field(config, path, plain(value), where, self.source)
        for path, text in self._written.items():
            _set_field_to_yaml(config, path.removeprefix(f"{where}."), text, where, self._option)
        validate(config, where)


def load_overridden(
    schema: type, file: str | Path | None, overrides: Overrides, option: str = "--set"
) -> Any:
    """Reads a configuration from a YAML file, with fields replaced, and validates it.

    Args:
        schema: Dataclass to read.
        file: None to start from the defaults.
        overrides, option: See `Replacements`.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    replacements = Replacements(overrides, schema, option)
    config = replacements.load(None if file is None else Path(file))
    replacements.set_in(config, schema.__name__.lower())
    return config


def plain(value: Any) -> Any:
    """What YAML has a form for, of arrays and numbers of NumPy."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _assignments(text: str) -> dict[str, str] | None:
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


def _set_field(config: Any, path: str, value: Any, where: str, source: str) -> None:
    """Sets the field at a path of names, and of numbers of elements of lists.

    Args:
        config: Dataclass, changed in place and not validated.
        path: As `food.material.toughness` or `motion.segments.0.speed`.
        value: What the field shall hold. What YAML has no form for is not checked.
        where: Dotted path of `config`, for errors.
        source: Where the value comes from, for errors.

    Raises:
        ConfigurationError: There is no such field, or it cannot hold the value.
    """
    try:
        text = yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n").strip()
    except yaml.YAMLError:
        text = None
    if text is not None:
        _set_field_to_yaml(config, path, text, where, source)
        return
    at, last = _owner(config, path, where)
    if isinstance(at, list | np.ndarray):
        at[int(last)] = value
    else:
        setattr(at, last, value)


def _set_field_to_yaml(config: Any, path: str, text: str, where: str, source: str) -> None:
    """As `_set_field`, with the value as YAML text, checked against the field's type.

    Args:
        config, path, where: See `_set_field`.
        text: The value; where it needs one with its tag, as "!Cylinder {diameter: 0.03}".
        source: Where the text comes from, for errors.

    Raises:
        ConfigurationError: There is no such field, or it cannot hold the value.
    """
    at, last = _owner(config, path, where)
    parent = path.rpartition(".")[0]
    if not isinstance(at, list | np.ndarray):
        merged = merge_yaml(at, f"{last}: {text}", source, f"{where}.{parent}".rstrip("."))
        setattr(at, last, getattr(merged, last))
        return
    # The type of an element is known to what holds its list.
    holder, name = _owner(config, parent, where)
    merged = merge_yaml(
        holder, f"{name}: [{text}]", source, f"{where}.{parent.rpartition('.')[0]}".rstrip(".")
    )
    at[int(last)] = getattr(merged, name)[0]


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


def field_names(config: Any) -> set[str]:
    """Names of all fields of a configuration and of what it holds."""
    return {path.rpartition(".")[2] for path in _paths(config)}


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
            fix=f'Did you mean "{like}"?' if like else did_you_mean("", vars(config)),
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
