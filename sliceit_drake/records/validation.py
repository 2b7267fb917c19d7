"""Checks of slice records: what is wrong, in which file, column and rows, and what to do."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.slice_record import SliceRecord, SliceTable

__all__ = ["Finding", "check_record", "check_table", "load_record", "load_records"]


@dc.dataclass(frozen=True)
class Finding:
    """Something about a record that a user should know.

    Attributes:
        severity: "error" if the record cannot be used, "warning" if with care.
        kind: Short name of what was found, such as "millimetres".
        file: The file.
        column: The column or field, or "".
        lines: First and last line of the file concerned, or None for the file as a whole.
        problem: What is wrong and what was expected.
        fix: What to do.
    """

    severity: str
    kind: str
    file: str
    column: str
    lines: tuple[int, int] | None
    problem: str
    fix: str

    @property
    def place(self) -> str:
        """File and lines."""
        if self.lines is None:
            return self.file
        first, last = self.lines
        return f"{self.file}, " + (f"line {first}" if first == last else f"lines {first} to {last}")

    def __str__(self) -> str:
        parts = [self.place, self.column, self.problem.rstrip(".")]
        return f"{self.severity}: {': '.join(part for part in parts if part)}. {self.fix}"


def load_record(file: str | Path) -> SliceRecord:
    """Reads a record and refuses one that cannot be used.

    Args:
        file: NAME.csv, NAME.yaml or NAME of the pair.

    Returns:
        The record; `check_record` has the warnings.

    Raises:
        ConfigurationError: If a file is missing or unreadable, or at the first error found.
    """
    table = fmt.read_table(file)
    for finding in check_table(table):
        if finding.severity == "error":
            raise ConfigurationError(
                finding.problem, source=finding.place, field=finding.column, fix=finding.fix
            )
    return fmt.record_from_table(table)


def load_records(folder: str | Path) -> list[SliceRecord]:
    """Reads all records of a folder.

    Args:
        folder: Folder with pairs NAME.csv and NAME.yaml.

    Returns:
        The records, by slice index, then name.

    Raises:
        ConfigurationError: If there are none, or one cannot be used.
    """
    files = sorted(Path(folder).glob("*.csv"))
    if not files:
        raise ConfigurationError(
            "there are no records", source=str(folder), fix="Give a folder with NAME.csv files."
        )
    records = [load_record(file) for file in files]
    return sorted(records, key=lambda record: (record.metadata.slice_index, record.name))


def check_record(record: SliceRecord) -> list[Finding]:
    """What is wrong with a record in memory; see `check_table`."""
    return check_table(record.table())


def check_table(table: SliceTable) -> list[Finding]:
    """What is wrong with a record as its files have it.

    Returns:
        Errors and warnings; if the series cannot be read as series, only those errors.
    """
    return _check_structure(table)


def _check_structure(table: SliceTable) -> list[Finding]:
    """Missing columns, gaps, time that does not increase, quaternions that are none."""
    found: list[Finding] = []

    def error(kind: str, column: str, rows: tuple[int, int] | None, text: str, fix: str) -> None:
        lines = None if rows is None else (int(table.lines[rows[0]]), int(table.lines[rows[1]]))
        found.append(Finding("error", kind, table.file, column, lines, text, fix))

    for name in (fmt.TIME, *fmt.POSITION, *fmt.QUATERNION):
        if name not in table.columns:
            error("missing column", name, None, "the column is missing", "Add it.")
    if not (table.has(fmt.FORCE) or fmt.FORCE_NORM in table.columns):
        names = ", ".join(fmt.FORCE)
        fix = f"Add {names}, or force_norm if only the norm is known."
        error("missing column", "force_x", None, "there is no force", fix)
    for group in (fmt.FORCE, fmt.TORQUE, fmt.VELOCITY, fmt.ANGULAR_VELOCITY, fmt.JOINTS):
        there = [name for name in group if name in table.columns]
        if there and len(there) < len(group):
            absent = next(name for name in group if name not in there)
            error("missing column", absent, None, f"is missing beside {there[0]}", "Add it.")
    for name, values in table.columns.items():
        for first, last in _runs(~np.isfinite(values)):
            count = last - first + 1
            error(
                "gap",
                name,
                (first, last),
                f"{count} of {len(values)} rows have no finite number",
                "Remove these rows, or cut the record off before them.",
            )
    if found:
        return found
    time = table.columns[fmt.TIME]
    if len(time) < 10:
        error("short", fmt.TIME, None, f"{len(time)} rows", "Give at least 10 rows.")
        return found
    wrong = np.flatnonzero(np.diff(time) <= 0.0) + 1
    if wrong.size:
        k = int(wrong[0])
        how = "repeats" if time[k] == time[k - 1] else "goes back from"
        more = f" ({wrong.size} such rows)" if wrong.size > 1 else ""
        error(
            "time",
            fmt.TIME,
            (k, k),
            f"{time[k]:.9g} s {how} {time[k - 1]:.9g} s{more}; time must increase",
            "Remove repeated rows; split the record where the clock was set back.",
        )
    length = np.linalg.norm(table.stack(fmt.QUATERNION), axis=1)
    for first, last in _runs(np.abs(length - 1.0) > 1e-3):
        error(
            "quaternion",
            fmt.QUATERNION[0],
            (first, last),
            f"the quaternion has length {length[first]:.4g}, expected 1",
            "Write a unit quaternion, w first.",
        )
    return found


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
