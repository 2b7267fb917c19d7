"""Writes Markdown pages: templates filled with results, and tables."""

from collections.abc import Iterable
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from studies.results import write_json

__all__ = ["percent", "publish", "render", "table"]

TEMPLATES = Path(__file__).parent / "templates"


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
    environment.filters |= {"f": format, "percent": percent}
    return environment


ENVIRONMENT = _environment()


def render(name: str, **values: object) -> str:
    """A page: studies/templates/NAME.md with values filled in.

    Raises:
        jinja2.UndefinedError: The template asks for a value that is not given.
    """
    return ENVIRONMENT.get_template(f"{name}.md").render(values)


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
