"""Puts what a study measured into a hand-written page, between two lines that mark the place."""

import argparse
import dataclasses as dc
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from studies.pages import render_and_store

__all__ = ["Place"]


@dc.dataclass(frozen=True)
class Place:
    """The part of a page between <!-- NAME --> and <!-- end of NAME -->.

    Attributes:
        name: Of the marks.
    """

    name: str

    @property
    def begin(self) -> str:
        """The line before it."""
        return f"<!-- {self.name} -->"

    @property
    def end(self) -> str:
        """The line after it."""
        return f"<!-- end of {self.name} -->"

    def add_argument(self, parser: argparse.ArgumentParser) -> None:
        """Adds --output, the page that the table goes into."""
        parser.add_argument(
            "--output",
            metavar="FILE",
            type=Path,
            help=f"Markdown file with the lines {self.begin} and {self.end}, between which the"
            " table goes",
        )

    def put(self, page: str, text: str, source: str) -> str:
        """A page with other text there.

        Args:
            page: The whole.
            text: What is to stand there.
            source: Name of the page, for the error.

        Raises:
            ConfigurationError: The page has not both lines, once each and in this order.
        """
        before, begin, rest = page.partition(self.begin)
        _, end, after = rest.partition(self.end)
        if not (begin and end) or self.begin in rest or self.end in before + after:
            raise ConfigurationError(
                f"{source} has not the lines {self.begin} and {self.end} once each, in this order: "
                "no place for the table",
                fix="Write them where it belongs.",
            )
        return f"{before}{begin}\n{text}\n{end}{after}"

    def check(self, file: Path | None) -> None:
        """Refuses a page without the place, before anything is measured for it; None is no page.

        Raises:
            ConfigurationError: As `put`.
        """
        if file is not None:
            self.put(file.read_text(encoding="utf-8"), "", str(file))

    def write(self, file: Path | None, text: str) -> None:
        """Puts text there; None is no page.

        Raises:
            ConfigurationError: As `put`.
        """
        if file is not None:
            page = self.put(file.read_text(encoding="utf-8"), text, str(file))
            file.write_text(page, encoding="utf-8")

    def show(self, file: Path | None, text: str) -> None:
        """Prints text and puts it there; None is no page.

        Raises:
            ConfigurationError: As `put`.
        """
        print(text)
        self.write(file, text)

    def publish(self, file: Path | None, **values: object) -> None:
        """Shows the template of this name with values, and stores these beside the page.

        Raises:
            ConfigurationError: As `put`.
        """
        text = render_and_store(self.name, file, values, whole=False)
        self.show(file, text.rstrip("\n"))
