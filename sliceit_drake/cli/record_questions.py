"""What a force curve does not say, from options, or asked at the terminal one by one."""

import argparse
import dataclasses as dc
import json
import operator
import sys
from typing import TYPE_CHECKING

from sliceit_drake.configuration import ConfigurationError

if TYPE_CHECKING:
    from sliceit_drake.records.metadata import SliceMetadata

__all__ = ["add_question_options", "asked", "complete_facts"]

UNKNOWN = "unknown"


@dc.dataclass(frozen=True)
class _Question:
    """A fact that a file does not have.

    Attributes:
        option: Without dashes.
        field: Of the metadata.
        text: What is asked.
        numbers: How many numbers the answer has; 0 for a word, or for any text.
        needed: Whether there is no record without it.
    """

    option: str
    field: str
    text: str
    numbers: int = 0
    needed: bool = False


QUESTIONS = (
    _Question("food", "food.name", "what was cut, as cucumber"),
    _Question(
        "shape",
        "food.shape",
        "its shape: cylinder (lying), halfcylinder (on its flat side), box or ellipsoid",
        needed=True,
    ),
    _Question(
        "size",
        "food.size",
        "its size in m along the edge, across the blade, and its height, as 0.027 0.12 0.027",
        3,
        needed=True,
    ),
    _Question("speed", "motion.speed", "speed of the knife in m/s, as 0.02", 1),
    _Question(
        "support",
        "food.support",
        "clamped_slab if it was held on both sides of the cut, end_slice if the slice could part",
    ),
    _Question("slice-thickness", "food.slice_thickness", "thickness of the slice in m", 1),
    _Question("spine-thickness", "knife.spine_thickness", "thickness of the knife's spine in m", 1),
    _Question("provenance", "provenance", "where the curve is from, and who may use it"),
)


def add_question_options(parser: argparse.ArgumentParser) -> None:
    """Adds an option for each question."""
    group = parser.add_argument_group(
        "what a force FILE does not say", "Asked at a terminal; the word unknown leaves one open."
    )
    for question in QUESTIONS:
        group.add_argument(
            f"--{question.option}",
            metavar="VALUE",
            nargs=3 if question.numbers == 3 else None,
            help=question.text,
        )


def complete_facts(metadata: "SliceMetadata", options: argparse.Namespace) -> "SliceMetadata":
    """Facts with what options or the user at the terminal say; the rest is listed as unknown.

    Raises:
        ConfigurationError: An option is wrong, or without a terminal one is missing.
    """
    missing = []
    for question in QUESTIONS:
        given = getattr(options, question.option.replace("-", "_"))
        if given is not None:
            text = " ".join(given) if isinstance(given, list) else given
            metadata = _answered(metadata, question, text)
        elif _is_open(metadata, question):
            if sys.stdin.isatty():
                metadata = _ask(metadata, question)
            elif question.needed:
                missing.append(question)
            else:
                metadata = _answered(metadata, question, UNKNOWN)
    if missing:
        raise ConfigurationError(
            "is not given: " + "; ".join(q.text for q in missing),
            field=" and ".join(f"--{q.option}" for q in missing),
            fix="Give these options or --metadata YAML; at a terminal the command asks.",
        )
    return metadata


def asked(text: str, option: str) -> str:
    """The answer at the terminal, for which an option could stand.

    Raises:
        ConfigurationError: The input ends, as by Ctrl-D.
    """
    try:
        return input(text).strip()
    except EOFError:
        print()
        raise ConfigurationError(
            "is not given: the input ended", field=f"--{option}", fix="Answer, or give the option."
        ) from None


def _is_open(metadata: "SliceMetadata", question: _Question) -> bool:
    value = operator.attrgetter(question.field)(metadata)
    return value in (None, "", UNKNOWN) and question.field not in metadata.unknown


def _ask(metadata: "SliceMetadata", question: _Question) -> "SliceMetadata":
    """Asks until the answer can be used; Enter alone says that it is not known."""
    while True:
        hint = "" if question.needed else " (Enter: not known)"
        text = f"{question.text[0].upper()}{question.text[1:]}{hint}: "
        answer = asked(text, question.option)
        if not answer and question.needed:
            continue
        try:
            return _answered(metadata, question, answer or UNKNOWN)
        except ConfigurationError as error:
            print(f"  {error}")


def _answered(metadata: "SliceMetadata", question: _Question, text: str) -> "SliceMetadata":
    from sliceit_drake.configuration import load_yaml
    from sliceit_drake.records.metadata import SliceMetadata

    if text == UNKNOWN and not question.needed:
        unknown = [*(n for n in metadata.unknown if n != question.field), question.field]
        return dc.replace(metadata, unknown=unknown)
    value: object = text
    if question.numbers:
        try:
            numbers = [float(part) for part in text.replace(",", " ").split()]
        except ValueError:
            numbers = []
        if len(numbers) != question.numbers:
            raise ConfigurationError(
                f"{text!r} is not {question.numbers} number{'s' * (question.numbers > 1)}",
                field=f"--{question.option}",
                fix=f"Give the {question.text}.",
            )
        value = numbers if question.numbers > 1 else numbers[0]
    for name in reversed(question.field.split(".")):
        value = {name: value}
    return load_yaml(SliceMetadata, None, metadata, json.dumps(value), f"--{question.option}")
