"""Knives by name: a knife's measures and where each comes from, in files that scenarios load."""

import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError, load_yaml
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.resources import named_yaml, resource_path

__all__ = ["NamedKnife", "knife_names", "load_knife"]

FOLDER = "calibration/knives"


@dc.dataclass
class NamedKnife:
    """A knife and its sources.

    Attributes:
        knife: Measures of the knife.
        sources: Source of each measure, by the field's name; a measure without is chosen freely.
        note: What it cannot be used for.
    """

    knife: Knife = dc.field(default_factory=Knife)
    sources: dict[str, str] = dc.field(default_factory=dict)
    note: str = ""

    def check(self, where: str) -> None:
        fields = [field.name for field in dc.fields(Knife)]
        for name in self.sources:
            if name not in fields:
                raise ConfigurationError(
                    "is the source of nothing that a knife has",
                    field=f"{where}.sources.{name}",
                    fix=f"Known: {', '.join(fields)}.",
                )


def knife_names() -> list[str]:
    """Knives that ship."""
    return sorted(path.stem for path in resource_path(FOLDER).glob("*.yaml"))


def load_knife(name: str | Path, field: str = "knife_name") -> NamedKnife:
    """Reads a knife.

    Args:
        name: A knife of `knife_names`, or a YAML file.
        field: Dotted path of what names it, for errors.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    file = named_yaml(name, FOLDER)
    if file is None:
        raise ConfigurationError(
            f"there is no knife {str(name)!r}; there are {', '.join(knife_names())}",
            field=field,
            fix="Name one of them, or give a YAML file (docs/foods.md).",
        )
    knife = load_yaml(NamedKnife, file)
    assert isinstance(knife, NamedKnife)
    return knife
