"""Force curves of any lab: time and force from a CSV file, and where in it a slice is."""

import csv
import dataclasses as dc
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.tables import finite_number, require_increasing, table_text

__all__ = ["UNITS", "ForceTable", "find_contact", "one_slice", "read_force_table"]

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
SECONDS |= dict.fromkeys(("second", "seconds"), 1.0) | dict.fromkeys(("µs", "μs"), 1e-6)
NEWTONS = {"n": 1.0, "newton": 1.0, "newtons": 1.0, "kn": 1e3, "dan": 10.0, "cn": 1e-2, "mn": 1e-3}
NEWTONS |= dict.fromkeys(("g", "gf"), 9.80665e-3) | dict.fromkeys(("kg", "kgf", "kp"), 9.80665)
NEWTONS |= dict.fromkeys(("lbf", "lbs", "lb"), 4.4482216)
UNITS = SECONDS | NEWTONS
"""Units of time and force by name, in small letters: s and N."""
NUMBER = r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?"
SPACED = re.compile(rf"{NUMBER}(\s+{NUMBER})+")
"""A line of numbers with decimal commas and spaces between."""
SLOWEST = 0.25
"""Rows further apart than this, s, are in another unit: a slice lasts a second or a few."""
LONG_AGO = 1e6
"""A table whose first time is later than this, s, has that of a clock, such as Unix time."""
EARLY, FEWEST, BEFORE = 10, 6, 0.25
"""Rows that tell whether a record begins in the air, where the force is level; of a slow sensor
fewer, as many as it has in this time, s: the knife may meet the food soon after."""
ONSET = 0.02
"""Fraction of the greatest force at which contact begins, where the noise is smaller."""
NOISES = 5.0
"""Standard deviations above the force in the air at which contact begins."""
LASTING = 5
"""Rows for which the force must stay above that."""
APART = 0.3
"""Time without force between two slices, s."""
TOUCHED, FREE = 0.25, 0.08
"""Fractions of the greatest force above which there is a slice, and below which there is none."""
LEAST = 8.0
"""Greatest force over the scatter of the first rows without which there was no contact."""


@dc.dataclass
class ForceTable:
    """A force over time, as a file has it, in SI units.

    Attributes:
        time: [n], s.
        force: [n, 1], or [n, 3] of three components, N.
        units: Of time and force in the file, where the file or the caller says them.
        start: Time in the file that is 0 here, s: of the first row where the file has the time of
            a clock.
    """

    time: np.ndarray
    force: np.ndarray
    units: tuple[str | None, str | None]
    start: float = 0.0


def read_force_table(
    file: str | Path, columns: Sequence[str] = (), units: Sequence[str] = ()
) -> ForceTable:
    """Reads time and force from a table with a comma, semicolon, tab or spaces between its cells.

    Rows before the first of numbers are a header. A decimal comma is understood beside any other
    separator. Units in brackets in the header, or in a row of units, are converted. Where the time
    is that of a clock, such as Unix time, it is counted from the first row.

    Args:
        columns: Names or numbers (from 1) of the time and of one or three columns of the force; by
            default the only two, or four, that there are.
        units: Of time and force, in place of the header's.

    Raises:
        ConfigurationError: Naming file, line and column.
    """
    rows = _rows(file)
    first = next((k for k, (_, cells) in enumerate(rows) if _is_data(cells)), len(rows))
    if first == len(rows) or len(rows[first][1]) < 2:
        raise ConfigurationError(
            "there are no two columns of numbers",
            source=str(file),
            fix="Give a table of time and force with a comma, semicolon, tab or spaces between.",
        )
    width = len(rows[first][1])
    header = [cells for _, cells in rows[:first] if len(cells) == width]
    names = header[0] if header else [str(k + 1) for k in range(width)]
    picked = _picked(file, names, columns)
    tables = (SECONDS, NEWTONS)
    known: list[str | None] = list(units)
    if not units:
        known = [_unit_of(file, header, *pair) for pair in zip(picked[:2], tables, strict=True)]
    for unit, table in zip(known, tables, strict=True):
        if unit is not None and unit.lower() not in table:
            raise ConfigurationError(
                f"{unit!r} is no unit of {_what(table)}",
                field="--units",
                fix=f"There are {', '.join(table)}.",
            )
    values = np.array([_numbers(file, row, names, picked) for row in rows[first:]])
    time = values[:, 0] * SECONDS[(known[0] or "s").lower()]
    start = float(time[0]) if time[0] > LONG_AGO else 0.0
    time = time - start
    require_increasing(time, file, names[picked[0]])
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if known[0] is None and period > SLOWEST:
        raise ConfigurationError(
            f"its rows are {period:.3g} s apart, which no slice can be read from",
            source=str(file),
            field=names[picked[0]],
            fix="Is it in ms? Give --units ms N; give --units s N if it is in seconds.",
        )
    force = values[:, 1:] * NEWTONS[(known[1] or "N").lower()]
    return ForceTable(time, force, (known[0], known[1]), start)


def find_contact(time: np.ndarray, force: np.ndarray, file: str = "") -> float | None:
    """Time at which the force begins, s; None where the record begins in the food.

    Args:
        time: [n], s.
        force: Its norm or one component, whose sign does not matter [n], N.

    Raises:
        ConfigurationError: There is no contact.
    """
    soon = int(np.searchsorted(time, time[0] + BEFORE, "right"))
    early = force[: max(FEWEST, min(EARLY, soon), len(force) // 50)]
    third = len(early) // 3
    steps = np.diff(early)
    # A force that rises from the first row on is no scatter.
    scatter = float(np.median(np.abs(steps - np.median(steps))))
    away = np.abs(force - np.median(early))
    # The quantile, for a faulty cable's rows are higher than any force.
    peak = float(np.quantile(away, 0.99))
    if peak <= LEAST * scatter:
        raise ConfigurationError(
            f"never rises: it stays within {peak:.2g} N of {np.median(force):.3g} N, and scatters "
            f"by {scatter:.2g} N from row to row",
            source=file,
            field="force",
            fix="Was there food under the knife? Give another file, or --between START END.",
        )
    least = max(ONSET * peak, NOISES * scatter)
    if abs(np.median(early[-third:]) - np.median(early[:third])) > least:
        return None
    lasting = np.convolve(away > least, np.ones(LASTING), "valid") == LASTING
    return float(time[np.argmax(lasting)]) if lasting.any() else None


def one_slice(time: np.ndarray, force: np.ndarray, file: str = "") -> None:
    """Refuses a file with several slices.

    Args:
        time: [n], s.
        force: Its norm or one component [n], N.

    Raises:
        ConfigurationError: With the times of the slices.
    """
    away = np.abs(force - np.median(force[: max(10, len(force) // 50)]))
    away = away / max(float(np.quantile(away, 0.99)), 1e-12)
    touched = np.flatnonzero(away > TOUCHED)
    slices: list[list[float]] = []
    for k in touched:
        if slices:
            between = (time > slices[-1][1]) & (time < time[k])
            quiet = between & (away < FREE)
            if quiet.any() and np.ptp(time[quiet]) > APART:
                slices.append([float(time[k])] * 2)
            slices[-1][1] = float(time[k])
        else:
            slices.append([float(time[k])] * 2)
    if len(slices) > 1:
        spans = ", ".join(f"{a:.3g} to {b:.3g} s" for a, b in slices)
        begin = max(float(time[0]), slices[0][0] - 1.0)
        end = 0.5 * (slices[0][1] + slices[1][0])
        raise ConfigurationError(
            f"holds {len(slices)} slices, {spans}",
            source=file,
            fix=f"Import each by itself, the first with --between {begin:.3g} {end:.3g}.",
        )


def _rows(file: str | Path) -> list[tuple[int, list[str]]]:
    """Cells of all lines that hold something, with their numbers."""
    lines = [
        (number, line.strip())
        for number, line in enumerate(table_text(file).splitlines(), start=1)
        if line.strip() and not line.startswith("#")
    ]
    body = [line for _, line in lines[len(lines) // 4 :]]
    separator = next((s for s in ";\t," if body and all(s in line for line in body)), None)
    if separator == "," and all(SPACED.fullmatch(line) for line in body):
        separator = None
    return [(number, _cells(line, separator)) for number, line in lines]


def _cells(line: str, separator: str | None) -> list[str]:
    """Cells of a line, in which a separator between quotation marks is none."""
    cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
    return [cell.strip().strip('"') for cell in cells]


def _number(cell: str) -> float:
    return float(cell.replace(",", "."))


def _is_data(cells: list[str]) -> bool:
    """Whether a row begins the table: its first cell is a number."""
    try:
        _number(cells[0])
    except ValueError:
        return False
    return True


def _numbers(
    file: str | Path, row: tuple[int, list[str]], names: list[str], picked: list[int]
) -> list[float]:
    number, cells = row
    texts = [cells[k] if k < len(cells) else "" for k in picked]
    return [
        finite_number(text, _number, f"{file}, line {number}", names[k])
        for k, text in zip(picked, texts, strict=True)
    ]


def _picked(file: str | Path, names: list[str], columns: Sequence[str]) -> list[int]:
    """Numbers of the columns of time and force."""
    if not columns and len(names) in (2, 4):
        return list(range(len(names)))
    out = []
    for column in columns:
        if column in names:
            out.append(names.index(column))
        elif column.isdigit() and 0 < int(column) <= len(names):
            out.append(int(column) - 1)
    if len(out) not in (2, 4) or len(out) != len(columns):
        raise ConfigurationError(
            f"has {len(names)} columns, {', '.join(names)}"
            + (f"; --columns {' '.join(columns)} are not among them" if columns else ""),
            source=str(file),
            field="--columns",
            fix="Name two, of time and force, or four, of time and the force along x, y and z "
            "(or their numbers, from 1).",
        )
    return out


def _what(table: dict[str, float]) -> str:
    """What a table of units is of."""
    return "time" if table is SECONDS else "force"


def _unit_of(
    file: str | Path, header: list[list[str]], column: int, table: dict[str, float]
) -> str | None:
    """A unit in brackets, or after an underscore or slash, or in a row of units below the names.

    Raises:
        ConfigurationError: Brackets hold something else, which may be a unit.
    """
    unknown = None
    for cells in header:
        bracketed = re.findall(r"[\[(]\s*([^\[\]()]+?)\s*[\])]", cells[column])
        behind = re.findall(r"[_/]\s*([^\W_]+)$", cells[column])
        alone = [cells[column]] if cells is not header[0] else []
        for text in (*bracketed, *behind, *alone):
            if text.lower() in table:
                return text
        if bracketed and unknown is None:
            unknown = bracketed[-1], cells[column]
    if unknown is None:
        return None
    raise ConfigurationError(
        f"{unknown[0]!r} is no known unit of {_what(table)}",
        source=str(file),
        field=unknown[1],
        fix=f"There are {', '.join(table)}. Convert the column, or say by --units TIME FORCE, as "
        "--units s N, what it holds.",
    )
