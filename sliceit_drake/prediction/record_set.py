"""Whether records belong together and to the food that is compared with them."""

from collections.abc import Sequence
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.prediction.placement import is_bare
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["check_foods", "check_same_slice", "facts_file", "one_of_each"]

UNNAMED = ("", "unknown")


def facts_file(record: SliceRecord) -> str:
    """The YAML file of a record."""
    return str(Path(record.source).with_suffix(".yaml"))


def one_of_each(records: Sequence[SliceRecord]) -> list[SliceRecord]:
    """The first record of each condition, and those of none."""
    first: dict[str, SliceRecord] = {}
    for record in records:
        first.setdefault(record.metadata.condition or record.name, record)
    return list(first.values())


def check_same_slice(records: Sequence[SliceRecord]) -> None:
    """Refuses the same measurement twice, which looks like a slice that repeats itself without any
    noise, and two records of one name.

    Raises:
        ConfigurationError: Naming both files.
    """
    seen: dict[bytes, SliceRecord] = {}
    names: dict[str, SliceRecord] = {}
    for record in records:
        force = record.measured_force
        content = (record.time - record.time[0]).round(9).tobytes() + force.tobytes()
        if content in seen:
            raise ConfigurationError(
                f"holds the same measurement as {seen[content].source}",
                source=record.source,
                field="force",
                fix="Remove one: a slice counted twice would look like two that agree.",
            )
        if record.name in names:
            raise ConfigurationError(
                f"is {record.name!r}, as in {facts_file(names[record.name])}",
                source=facts_file(record),
                field="name",
                fix="Give each record a name of its own, or leave the field out: then it is that"
                " of the file.",
            )
        seen[content] = names[record.name] = record


def check_foods(
    records: Sequence[SliceRecord], food: str, what: str, fix: str, other_food: bool = False
) -> None:
    """Refuses records of no food, of several, or of another than they are compared with.

    Args:
        records: All.
        food: Name of the food that they are compared with.
        what: What has that name, such as "model".
        fix: How to give that of another food, {}.
        other_food: Whether records of a food of another name are meant.

    Raises:
        ConfigurationError: Naming file, field and fix.
    """
    cut = [r for r in records if not is_bare(r)]
    if not cut:
        raise ConfigurationError(
            "in none of the records is there food",
            source=records[0].source,
            field="food.name",
            fix="Add records of slices; those of air, board and weight go with them.",
        )
    foods: dict[str, list[SliceRecord]] = {}
    for record in cut:
        foods.setdefault(record.metadata.food.name, []).append(record)
    if len(foods) > 1:
        few = min(foods, key=lambda name: len(foods[name]))
        counts = ", ".join(f"{len(own)} of {name}" for name, own in foods.items())
        raise ConfigurationError(
            f"the records are of different foods: {counts}",
            source=facts_file(foods[few][0]),
            field="food.name",
            fix="Put each food into a folder of its own and take them one by one; correct the"
            " field if it is one food under two names.",
        )
    (name,) = foods
    named = not {name, food} & {*UNNAMED}
    if named and name.lower() != food.lower() and not other_food:
        raise ConfigurationError(
            f"the records are of {name}, the {what} is of {food}",
            source=facts_file(foods[name][0]),
            field="food.name",
            fix=f"{fix.format(name)}, or say --other-food if you mean it.",
        )
