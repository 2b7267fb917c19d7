"""Writes Markdown pages: templates filled with results, and tables."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from studies.results import plain, write_json

__all__ = ["RESULTS", "percent", "publish", "render", "render_and_store", "table"]

TEMPLATES = Path(__file__).parent / "templates"
RESULTS = "data"
"""Folder beside the pages, for the values that they show."""


def table(head: str, rows: Iterable[Iterable[object]], align: str = "") -> str:
    """A Markdown table.

    Args:
        head: Titles of the columns, with " | " between them.
        rows: Cells of each row, as they are to be shown.
        align: "r" for each column to the right; empty: all to the left.
    """
    titles = head.split(" | ")
    marks = ["---:" if side == "r" else "---" for side in align.ljust(len(titles))]
    lines = [_row(titles), f"|{'|'.join(marks)}|", *map(_row, rows)]
    return "\n".join(lines)


def _row(cells: Iterable[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def percent(share: float) -> str:
    """A share in percent, to two digits."""
    return f"{100.0 * share:.2g} %" if abs(share) < 0.1 else f"{100.0 * share:.0f} %"


def _formatted(value: object, form: str) -> str:
    """A value as `format` writes it; of one that is missing the name is said."""
    return format(str(value) if isinstance(value, StrictUndefined) else value, form)


def _environment() -> Environment:
    """Where templates are; they know `table`, `| percent`, and `| f(".2f")` for other numbers."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals["table"] = table
    environment.filters |= {"f": _formatted, "percent": percent}
    return environment


ENVIRONMENT = _environment()


def render(name: str, **values: object) -> str:
    """A page: studies/templates/NAME.md with values filled in.

    Raises:
        jinja2.UndefinedError: The template asks for a value that is not given.
    """
    return ENVIRONMENT.get_template(f"{name}.md").render(values)


def render_and_store(
    name: str,
    page: Path | None,
    values: Mapping[str, object],
    results: object = None,
    whole: bool = True,
) -> str:
    """A page as `render`, or a part of one, whose values are stored as RESULTS/NAME.json.

    `python -m studies pages` renders it anew from that file.

    Args:
        name: Of the template.
        page: File that the text is for; None to store nothing.
        values: Of the template, see `results.plain`.
        results: What the values were made from, to be stored beside them; None for nothing.
        whole: Whether the text is the page; if not, it has a marked place there.
    """
    shown = plain(values)
    if page is not None:
        facts = {"page": page.name, "whole": whole, "values": shown}
        facts |= {} if results is None else {"results": results}
        write_json(page.parent / RESULTS / f"{name}.json", facts)
    return render(name, **shown)


def publish(text: str, file: Path | None, results: object = None) -> None:
    """Prints a page and writes it, with its results as JSON beside it.

    Args:
        text: The page.
        file: To write; its folder is made. None for none.
        results: What the page shows, see `results.plain`; None for nothing beside it.
    """
    print(text)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
        if results is not None:
            write_json(file.with_suffix(".json"), results)
