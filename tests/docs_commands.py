"""Finds the commands that README and docs tell a reader to type."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Command", "commands_of", "pages_of"]

PROGRAMS = r"(?:\.venv/bin/)?(?:sliceit|python3?|pip|pytest|dask|sphinx-build)"
STARTS = re.compile(rf"(?:[A-Z_]+=\S+ )*{PROGRAMS}\s")


@dataclass(frozen=True)
class Command:
    """A command as it stands on a page, on one line.

    Attributes:
        text: Without comments and line breaks; a chain by && is several commands.
        page: The page, relative to the checkout.
        line: Where it begins, from 1.
        typed: In a block, to be typed as it is; else within a sentence, where it may be cut short.
    """

    text: str
    page: str
    line: int
    typed: bool

    @property
    def words(self) -> list[str]:
        """As a shell takes it apart; "..." stands for whatever the reader has."""
        words = shlex.split(self.text)
        return [word.removesuffix("...") for word in words if word != "..."]


def pages_of(docs: Path) -> list[Path]:
    """The pages of docs but those that are written for the site."""
    return sorted(file for file in docs.rglob("*.md") if file.parent.name != "api")


def commands_of(file: Path, root: Path) -> list[Command]:
    """The commands of a page: of its blocks, and `within sentences`."""
    page, found = file.relative_to(root).as_posix(), []
    text = file.read_text(encoding="utf-8")
    for block in re.finditer(r"^ *```(?:bash|)\n(.*?)^ *```|(?:^ {4,}\S.*\n)+", text, re.M | re.S):
        for offset, line in _lines(block[1] if block[1] is not None else block[0]):
            number = text.count("\n", 0, block.start(1) if block[1] else block.start()) + offset + 1
            found += [Command(part, page, number, True) for part in line.split(" && ")]
    outside = re.sub(
        r"^ *```.*?^ *```$", lambda m: re.sub(r"[^\n]", "", m[0]), text, flags=re.M | re.S
    )
    for span in re.finditer(r"`([^`]+)`", outside):
        line = " ".join(span[1].split())
        found.append(Command(line, page, outside.count("\n", 0, span.start()) + 1, False))
    # What comes before a colon is a title.
    title = re.compile(r"[\w ]+:(\s|$)")
    return [c for c in found if STARTS.match(f"{c.text} ") and not title.match(c.text)]


def _lines(block: str) -> Iterator[tuple[int, str]]:
    """Commands of a block with the line where each begins; comments and explanations cut off."""
    held, start = "", 0
    for number, line in enumerate(block.splitlines()):
        start = number if not held else start
        line = re.split(r"\s+# |\s{3,}(?=\S)", line.strip())[0]
        held += line.removesuffix("\\").strip() + " " if line.endswith("\\") else line
        if not line.endswith("\\"):
            yield start, held
            held = ""
