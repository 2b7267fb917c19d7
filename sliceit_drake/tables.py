"""Tables of numbers: CSV files, with errors that name file, row and column, and interpolation."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError, closest

__all__ = [
    "finite_number",
    "interpolated",
    "read_columns",
    "read_rows",
    "require_increasing",
    "table_text",
]


def table_text(file: str | Path) -> str:
    """The text of a table, UTF-8, with or without the mark that some programs begin it with.

    Raises:
        ConfigurationError: If the file cannot be read.
    """
    fix = "Check the path."
    try:
        return Path(file).read_text(encoding="utf-8-sig")
    except OSError as error:
        problem = str(error)
    except UnicodeDecodeError as error:
        problem, fix = (
            f"it is not UTF-8: {error}",
            "Save it as UTF-8, which spreadsheets call CSV UTF-8.",
        )
    raise ConfigurationError(f"the table cannot be read ({problem})", source=str(file), fix=fix)


def read_rows(file: str | Path) -> list[tuple[int, list[str]]]:
    """Reads the rows of a CSV file, UTF-8, that have cells, each with the number of its line.

    The first row is that of the names; spaces about cells are left out.

    Raises:
        ConfigurationError: If the file cannot be read.
    """
    rows = enumerate(csv.reader(io.StringIO(table_text(file), newline="")), start=1)
    try:
        return [(number, [cell.strip() for cell in row]) for number, row in rows if row]
    except csv.Error as error:
        raise ConfigurationError(
            f"the table cannot be read ({error})",
            source=str(file),
            fix="Is there a quotation mark too many, or none of a pair? Remove it.",
        ) from error


def read_columns(file: str | Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Reads named columns of a CSV file whose first row holds the column names.

    Args:
        file: CSV file, UTF-8. Columns that are not asked for are ignored.
        columns: Names of the columns to read.

    Returns:
        For each name a float array [N], N >= 1, all finite.

    Raises:
        ConfigurationError: If the file cannot be read, lacks a column or rows, or has a cell that
            is not a finite number.
    """
    rows = read_rows(file)
    header = rows[0][1] if rows else []
    for name in columns:
        if name not in header:
            close = closest(name, [other for other in header if other not in columns])
            fix = f'Rename "{close}"?' if close else "Add it."
            raise ConfigurationError(
                f'there is no column "{name}"; the first row has: {", ".join(header) or "nothing"}',
                source=str(file),
                fix=fix,
            )
    if len(rows) < 2:
        raise ConfigurationError(
            "the table has no rows", source=str(file), fix="Add rows of numbers under the names."
        )
    result = {}
    for name in columns:
        index = header.index(name)
        values = []
        for number, row in rows[1:]:
            text = row[index] if index < len(row) else ""
            values.append(finite_number(text, float, f"{file}, line {number}", name))
        result[name] = np.array(values)
    return result


def finite_number(text: str, convert: Callable[[str], float], source: str, column: str) -> float:
    """The number in a cell.

    Args:
        text: Of the cell.
        convert: What turns it into a number, or raises ValueError.
        source: File and line, for the error.
        column: Name of the column, for the error.

    Raises:
        ConfigurationError: If it is none, or not finite.
    """
    try:
        value = convert(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ConfigurationError(
            f"is {text!r}, which is not a finite number",
            source=source,
            field=column,
            fix="Correct the cell or remove the row.",
        )
    return value


def require_increasing(values: np.ndarray, file: str | Path, column: str) -> None:
    """Refuses a column that does not increase from row to row.

    Args:
        values: Float array [N], in the order of the file.
        file: The file, for the error.
        column: Name of the column, for the error.

    Raises:
        ConfigurationError: At the first value that is not greater than the one before it.
    """
    wrong = np.flatnonzero(np.diff(values) <= 0.0)
    if wrong.size:
        index = int(wrong[0]) + 1
        raise ConfigurationError(
            f"row {index + 1} has {values[index]:.9g} after {values[index - 1]:.9g}",
            source=str(file),
            field=column,
            fix="Sort the rows so that it increases, and remove repeated ones.",
        )


def interpolated(at: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rows [n, ...] at some places [n], linearly between rows [m, ...] at increasing places [m]."""
    columns = values.reshape(len(values), -1).T
    rows = np.column_stack([np.interp(at, known, column) for column in columns])
    return rows.reshape(len(at), *values.shape[1:])
