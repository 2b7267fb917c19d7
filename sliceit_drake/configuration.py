"""Configuration dataclasses: units and ranges where a field is declared, validation, YAML.

A configuration is a plain dataclass whose fields carry their unit and range, declared with
`quantity` and `choice`, and their meaning in a docstring below. `validate` walks a configuration
and says where a value is wrong and what to do about it; `load_yaml` and `dump_yaml` read and write
it as YAML. The dataclass is the file format: there is no second schema.

Drake's YAML functions read the field types at run time, so a module that declares configuration
dataclasses must not use ``from __future__ import annotations``.
"""

import collections.abc
import copy
import dataclasses as dc
import difflib
import math
import types
import typing
from pathlib import Path
from typing import Any

import numpy as np

__all__ = [
    "ConfigurationError",
    "choice",
    "closest",
    "did_you_mean",
    "dump_yaml",
    "load_yaml",
    "merge_yaml",
    "quantity",
    "unit_of",
    "validate",
]

_METADATA_KEY = "sliceit_drake"

# Units in which a value is often given by mistake: (name, factor to the unit of the field).
_MISTAKEN_UNITS = {
    "m": (("mm", 1e-3), ("um", 1e-6)),
    "s": (("ms", 1e-3), ("us", 1e-6)),
    "m/s": (("mm/s", 1e-3),),
    "m/s2": (("mm/s2", 1e-3),),
    "rad": (("degrees", math.pi / 180), ("mrad", 1e-3)),
    "rad/s": (("degrees/s", math.pi / 180),),
    "kg": (("g", 1e-3),),
    "kg/m3": (("g/cm3", 1e3),),
    "N": (("mN", 1e-3), ("kN", 1e3)),
    "N/m": (("kN/m", 1e3), ("mN/m", 1e-3)),
    "Pa": (("kPa", 1e3), ("MPa", 1e6), ("GPa", 1e9), ("mPa", 1e-3)),
    "J/m2": (("kJ/m2", 1e3), ("mJ/m2", 1e-3)),
    "Hz": (("kHz", 1e3), ("mHz", 1e-3)),
}


class ConfigurationError(ValueError):
    """A configuration that cannot be used, with the place and the way out.

    Attributes:
        problem: What is wrong.
        field: Dotted path of the field, such as ``scenario.food.height``, if known.
        fix: What to do, if known.
        source: File (and line) that the value comes from, if known.
    """

    def __init__(
        self,
        problem: str,
        *,
        field: str | None = None,
        fix: str | None = None,
        source: str | None = None,
    ) -> None:
        self.problem = problem
        self.field = field
        self.fix = fix
        self.source = source
        text = ": ".join(part for part in (source, field, problem) if part)
        if fix:
            text = f"{text.rstrip('.')}. {fix}"
        super().__init__(text)


@dc.dataclass(frozen=True)
class _Quantity:
    """Unit and range of a numeric field."""

    unit: str
    low: float | None
    high: float | None
    size: int | None


@dc.dataclass(frozen=True)
class _Choice:
    """Allowed values of a text field."""

    options: tuple[str, ...]


def quantity(
    default: Any,
    unit: str,
    *,
    low: float | None = None,
    high: float | None = None,
    size: int | None = None,
) -> Any:
    """Declares a numeric dataclass field with its unit and range; what it means stands below it.

    Args:
        default: Number, list, tuple or array of numbers, or None for an optional field.
        unit: Unit of the value, SI, such as ``"m"`` or ``"N/m"``; ``""`` if it has none.
        low: Least allowed value of every element; None for no bound.
        high: Greatest allowed value of every element; None for no bound.
        size: Number of elements that a list or array must have; None for any.

    Returns:
        The field, for the right-hand side of a dataclass attribute.

    Raises:
        ValueError: If the declaration contradicts itself.
    """
    rule = _Quantity(unit, low, high, size)
    if default is not None:
        try:
            _check_quantity(default, rule, "default", is_integer=False)
        except ConfigurationError as error:
            raise ValueError(f"quantity(...): {error}") from None
    metadata = {_METADATA_KEY: rule}
    if isinstance(default, list | np.ndarray):
        return dc.field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return dc.field(default=default, metadata=metadata)


def choice(default: str, options: collections.abc.Sequence[str]) -> Any:
    """Declares a text dataclass field that takes one of a few values.

    Args:
        default: The value if none is given; one of `options`.
        options: Allowed values.

    Returns:
        The field, for the right-hand side of a dataclass attribute.

    Raises:
        ValueError: If the default is not among the options.
    """
    if default not in options:
        raise ValueError(f"choice(...): {default!r} is not in {options}")
    return dc.field(default=default, metadata={_METADATA_KEY: _Choice(tuple(options))})


def closest(name: str, options: collections.abc.Iterable[str]) -> str | None:
    """The option that is most alike to a name, or None where none is."""
    return next(iter(difflib.get_close_matches(name, list(options), n=1)), None)


def did_you_mean(name: str, options: collections.abc.Iterable[str], otherwise: str = "") -> str:
    """What to do about a name that is not known: the one that is meant, or those that there are.

    Args:
        name: As it was given.
        options: Names that are known.
        otherwise: What to say where none is alike; "" for a list of all.
    """
    options = list(options)
    if close := closest(name, options):
        return f'Did you mean "{close}"?'
    return otherwise or f"Known: {_listing(options)}."


def unit_of(config: Any, path: str) -> str:
    """Unit of the quantity, or of an element of it, at a dotted path in a configuration; "" where
    it has none."""
    *parents, last = path.split(".")
    if last.isdigit():
        *parents, last = parents
    for part in parents:
        config = config[int(part)] if isinstance(config, list) else getattr(config, part)
    if not dc.is_dataclass(config):
        return ""
    rules = {field.name: field.metadata.get(_METADATA_KEY) for field in dc.fields(config)}
    rule = rules.get(last)
    return rule.unit if isinstance(rule, _Quantity) else ""


def validate(config: Any, where: str) -> None:
    """Checks a configuration and everything nested in it.

    Every number must be finite, every `quantity` within its range and of its size, every `choice`
    among its options. A dataclass with a method ``check(where)`` then has it called with its own
    dotted path, for rules that involve several fields.

    Args:
        config: A dataclass instance, or a list, tuple or dict of such.
        where: Dotted path of `config`, such as ``"scenario.board"``; it begins the path in errors.

    Raises:
        ConfigurationError: At the first value that is wrong.
    """
    if dc.is_dataclass(config) and not isinstance(config, type):
        for field in dc.fields(config):
            _check_field(getattr(config, field.name), field, f"{where}.{field.name}")
        check = getattr(config, "check", None)
        if check is not None:
            check(where)
    elif isinstance(config, list | tuple):
        for index, item in enumerate(config):
            validate(item, f"{where}[{index}]")
    elif isinstance(config, dict):
        for key, item in config.items():
            validate(item, f"{where}.{key}")
    elif isinstance(config, float | np.ndarray):
        _check_quantity(config, _Quantity("", None, None, None), where, is_integer=False)


def _check_field(value: Any, field: dc.Field, where: str) -> None:
    if value is None:
        # YAML leaves a None out, so that one in a field with another default would not read back.
        if field.default is not None:
            raise ConfigurationError("is None", field=where, fix="Give a value.")
        return
    rule = field.metadata.get(_METADATA_KEY)
    if isinstance(rule, _Quantity):
        _check_quantity(value, rule, where, is_integer=field.type is int)
    elif isinstance(rule, _Choice):
        if value not in rule.options:
            raise ConfigurationError(
                f"{value!r} is not one of {_listing(rule.options)}",
                field=where,
                fix=did_you_mean(str(value), rule.options),
            )
    else:
        validate(value, where)


def _check_quantity(value: Any, rule: _Quantity, where: str, *, is_integer: bool) -> None:
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0):
        if rule.size is not None and len(value) != rule.size:
            raise ConfigurationError(
                f"has {len(value)} values", field=where, fix=f"Give {rule.size} values."
            )
        for index, item in enumerate(value):
            item_rule = dc.replace(rule, size=None)
            _check_quantity(item, item_rule, f"{where}[{index}]", is_integer=is_integer)
        return
    kind = "whole number" if is_integer else "number"
    expected = f"a {kind}" + (f" in {rule.unit}" if rule.unit else "")
    number = value.item() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise ConfigurationError(f"is {value!r}", field=where, fix=f"Give {expected}.")
    if not math.isfinite(number) or (is_integer and number != int(number)):
        raise ConfigurationError(
            f"is {number}", field=where, fix=f"Give {expected}{_range_text(rule, ', ')}."
        )
    if _in_range(number, rule):
        return
    unit = f" {rule.unit}" if rule.unit else ""
    fix = f"Give {expected}{_range_text(rule, ', ')}."
    for name, factor in _MISTAKEN_UNITS.get(rule.unit, ()):
        if _in_range(number * factor, rule):
            fix = f"Is it in {name}? Write {number * factor:.6g}."
            break
    raise ConfigurationError(
        f"{number:.6g}{unit} is not{_range_text(rule, ' ')}", field=where, fix=fix
    )


def _in_range(number: float, rule: _Quantity) -> bool:
    return (rule.low is None or number >= rule.low) and (rule.high is None or number <= rule.high)


def _range_text(rule: _Quantity, lead: str) -> str:
    unit = f" {rule.unit}" if rule.unit else ""
    if rule.low is None and rule.high is None:
        return ""
    if rule.high is None:
        return f"{lead}at least {rule.low:.6g}{unit}"
    if rule.low is None:
        return f"{lead}at most {rule.high:.6g}{unit}"
    return f"{lead}within [{rule.low:.6g}, {rule.high:.6g}]{unit}"


def load_yaml(
    schema: type,
    file: str | Path | None,
    defaults: Any = None,
    overrides_text: str | None = None,
    overrides_source: str = "overrides",
) -> Any:
    """Reads a configuration from a YAML file, and validates it.

    Args:
        schema: Dataclass to read.
        file: YAML file; None to start from the defaults alone.
        defaults: Instance of `schema` that holds the values for fields which the file leaves out;
            None for the defaults of `schema`.
        overrides_text: YAML text merged over the file, such as ``"{food: {height: 0.03}}"``. A
            list in it replaces the whole list.
        overrides_source: Where that text comes from, for errors.

    Returns:
        The validated configuration, an instance of `schema`. `defaults` is left unchanged.

    Raises:
        ConfigurationError: If a file is missing, or its text is not YAML, or names an unknown
            field or tag, or a value has the wrong type or is out of range.
    """
    config = schema() if defaults is None else copy.deepcopy(defaults)
    # Where each field was written, so that an error found after loading can name the line.
    origins: dict[str, str] = {}
    if file is not None:
        config = merge_yaml(config, _read_text(Path(file)), str(file), _root(config), origins)
    if overrides_text is not None and overrides_text.strip():
        config = merge_yaml(config, overrides_text, overrides_source, _root(config), origins)
    try:
        validate(config, _root(config))
    except ConfigurationError as error:
        source = origins.get(error.field or "", None if file is None else str(file))
        raise ConfigurationError(
            error.problem, field=error.field, fix=error.fix, source=source
        ) from None
    return config


def dump_yaml(config: Any, file: str | Path | None = None, *, defaults: Any = None) -> str:
    """Writes a configuration as YAML that `load_yaml` reads back to the same values.

    Args:
        config: Dataclass instance.
        file: If given, the text is also written there.
        defaults: If given, only what differs from this instance is written.

    Returns:
        The YAML text.
    """
    from pydrake.common.yaml import yaml_dump_typed

    text = yaml_dump_typed(config, schema=type(config), defaults=defaults)
    if file is not None:
        Path(file).write_text(text, encoding="utf-8")
    return text


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except FileNotFoundError:
        folder = file.parent
        names = sorted(item.name for item in folder.glob("*.y*ml"))
        fix = did_you_mean(file.name, names) if names else f"The folder {folder} has no YAML files."
        if not folder.is_dir():
            fix = f"There is no folder {folder} either."
        raise ConfigurationError("the file does not exist", source=str(file), fix=fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"the file cannot be read ({error})",
            source=str(file),
            fix="Give the path of a UTF-8 text file.",
        ) from error


def _root(config: Any) -> str:
    return type(config).__name__.lower()


def merge_yaml(
    config: Any, text: str, source: str, where: str, origins: dict[str, str] | None = None
) -> Any:
    """A configuration with YAML merged over it; types are checked, ranges are not.

    Args:
        config: Dataclass instance, which stays as it is.
        text: Fields and values.
        source: Where the text comes from, for errors.
        where: Dotted path of `config`, for errors.
        origins: Takes, by the path of each field, where it was written.

    Raises:
        ConfigurationError: The text is not YAML, or a field or type in it is wrong.
    """
    import yaml
    from pydrake.common.yaml import yaml_load_typed

    try:
        loader = yaml.SafeLoader(text)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigurationError(
            f"not valid YAML: the character #x{error.character:04x}",
            source=f"{source}, line {line}",
            fix="Save it as plain UTF-8 text.",
        ) from None
    try:
        node = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ConfigurationError(
            f"not valid YAML: {error.problem or error.context}",
            source=source if mark is None else f"{source}, line {mark.line + 1}",
            fix="Check brackets, quotes and indentation (spaces, no tabs) there.",
        ) from None
    finally:
        loader.dispose()
    if not isinstance(node, yaml.MappingNode):
        raise ConfigurationError(
            "the file holds no fields", source=source, fix='Write "field: value" lines.'
        )
    tree = _TreeCheck(loader, source, {} if origins is None else origins)
    tree.mapping(node, type(config), where, is_root=True)
    try:
        return yaml_load_typed(schema=type(config), data=text, defaults=config)
    except (RuntimeError, ValueError, TypeError) as error:
        # Fields of Drake's own bound types are checked by Drake alone.
        raise ConfigurationError(
            f"Drake does not accept it ({error})", source=source, fix="Correct this field."
        ) from error


class _TreeCheck:
    """Compares a YAML node tree with field types, as Drake would, but says where it disagrees."""

    def __init__(self, loader: Any, source: str, origins: dict[str, str]) -> None:
        self._loader = loader
        self._source = source
        self._origins = origins

    def _at(self, node: Any) -> str:
        return f"{self._source}, line {node.start_mark.line + 1}"

    def _fail(self, node: Any, where: str, problem: str, fix: str | None) -> typing.NoReturn:
        raise ConfigurationError(problem, field=where, fix=fix, source=self._at(node))

    def items(self, node: Any, where: str) -> dict[str, Any]:
        """Returns the entries of a mapping node; refuses a key that stands there twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key.value, str):
                self._fail(key, where, "a key is not a word", "Write 'field: value'.")
            if key.value in seen and key.value != "<<":
                self._fail(key, where, f"{key.value} is given twice", "Keep one of the two.")
            seen.add(key.value)
        self._loader.flatten_mapping(node)
        return {key.value: value for key, value in node.value}

    def mapping(self, node: Any, schema: Any, where: str, *, is_root: bool = False) -> None:
        fields = _field_types(schema)
        for name, value in self.items(node, where).items():
            if is_root and name.startswith("_"):
                continue
            if name not in fields:
                self._fail(
                    value,
                    f"{where}.{name}",
                    f"unknown field of {schema.__name__}",
                    did_you_mean(name, list(fields)),
                )
            self.value(value, fields[name], f"{where}.{name}")

    def value(self, node: Any, schema: Any, where: str) -> None:
        self._origins[where] = self._at(node)
        origin, args = typing.get_origin(schema), typing.get_args(schema)
        if origin in (typing.Union, types.UnionType):
            self._union(node, args, where)
        elif node.tag.startswith("!"):
            self._fail(node, where, f"the tag {node.tag} has no meaning here", "Remove the tag.")
        elif schema in (bool, int, float, str, Path):
            self._scalar(node, schema, where)
        elif origin is list or schema is np.ndarray:
            if node.id != "sequence":
                self._fail(node, where, "expected a list", 'Write "[a, b, c]".')
            for index, item in enumerate(node.value):
                nested = schema is np.ndarray and item.id == "sequence"
                item_schema = np.ndarray if nested else (args or (float,))[0]
                self.value(item, item_schema, f"{where}[{index}]")
        elif origin in (dict, collections.abc.Mapping):
            if node.id != "mapping":
                self._fail(node, where, "expected named entries", 'Write "name: value" lines.')
            for name, item in self.items(node, where).items():
                self.value(item, args[1], f"{where}.{name}")
        else:
            if node.id != "mapping":
                fields = _listing(list(_field_types(schema)))
                self._fail(node, where, "expected named fields", f"Fields: {fields}.")
            self.mapping(node, schema, where)

    def _union(self, node: Any, args: tuple[Any, ...], where: str) -> None:
        if node.tag == "tag:yaml.org,2002:null" and type(None) in args:
            return
        options = [option for option in args if option is not type(None)]
        if node.tag.startswith("!"):
            by_tag = {f"!{option.__name__}": option for option in options}
            if len(options) < 2 or node.tag not in by_tag:
                self._fail(
                    node, where, f"unknown tag {node.tag}", did_you_mean(node.tag, list(by_tag))
                )
            if node.id != "mapping":
                self._fail(node, where, "expected named fields", f'Write "{node.tag} {{...}}".')
            self.mapping(node, by_tag[node.tag], where)
            return
        scalars = [option for option in options if option in (bool, int, float, str)]
        if node.id == "scalar" and any(_scalar_fits(node, option) for option in scalars):
            return
        if len(options) > 1 and node.id == "mapping" and all(map(_has_fields, options)):
            self._check_untagged(node, options, where)
        self.value(node, options[0], where)

    def _check_untagged(self, node: Any, options: list[Any], where: str) -> None:
        """Refuses fields that the first option lacks, where the tag of another may be missing."""
        first, *others = options
        known = _field_types(first)
        for name, value in self.items(node, where).items():
            owners = [f"!{option.__name__}" for option in others if name in _field_types(option)]
            if name in known or not owners:
                continue
            tags = _listing([f"!{option.__name__}" for option in options])
            self._fail(
                value,
                f"{where}.{name}",
                f"unknown field of {first.__name__}",
                f"It is a field of {_listing(owners)}. Without a tag this is !{first.__name__}; "
                f"tags: {tags}.",
            )

    def _scalar(self, node: Any, schema: type, where: str) -> None:
        expected = {
            bool: "true or false",
            int: "a whole number",
            float: "a number",
            str: "text (in quotes if it looks like a number)",
            Path: "a path",
        }[schema]
        if node.id != "scalar" or not _scalar_fits(node, schema):
            found = {"sequence": "a list", "mapping": "named fields"}.get(node.id)
            given = found or (f"{node.value!r}" if node.value else "nothing")
            self._fail(node, where, f"is {given}", f"Give {expected}.")


def _scalar_fits(node: Any, schema: type) -> bool:
    kind = node.tag.rpartition(":")[2]
    if schema in (str, Path):
        return kind == "str"
    if schema is bool:
        return kind == "bool" or node.value in ("true", "false")
    if kind not in ("int", "float", "str"):
        return False
    try:
        # YAML 1.1 spells infinity and NaN with a leading dot, and reads 1e3 as text.
        number = float(node.value.replace("_", "").replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        return False
    return schema is float or number.is_integer()


def _has_fields(schema: Any) -> bool:
    return dc.is_dataclass(schema) or hasattr(schema, "__fields__")


def _field_types(schema: Any) -> dict[str, Any]:
    """Returns names and types of the fields of a dataclass or of a type bound by Drake."""
    fields = dc.fields(schema) if dc.is_dataclass(schema) else schema.__fields__
    return {field.name: field.type for field in fields}


def _listing(names: collections.abc.Sequence[str]) -> str:
    return ", ".join(names) if names else "none"
