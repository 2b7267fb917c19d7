"""What checks of a slice record find, and the collector that they report to."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.records.slice_record import SliceTable

__all__ = ["Findings", "RecordFinding", "runs"]


@dc.dataclass(frozen=True)
class RecordFinding:
    """Something about a record that a user should know.

    Attributes:
        severity: "error" if the record cannot be used, "warning" if with care.
        kind: Short name of what was found, such as "millimetres".
        file: The file.
        column: The column, or the field of the YAML file, or "".
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


class Findings:
    """Collects findings about one table.

    Attributes:
        found: The findings so far.
    """

    def __init__(self, table: SliceTable) -> None:
        self._table = table
        self.found: list[RecordFinding] = []

    def error(
        self, kind: str, column: str, problem: str, fix: str, rows: tuple[int, int] | None = None
    ) -> None:
        """Reports what makes the record unusable; `rows` are first and last index."""
        self._add("error", kind, column, problem, fix, rows)

    def warning(
        self, kind: str, column: str, problem: str, fix: str, rows: tuple[int, int] | None = None
    ) -> None:
        """Reports what calls for care; `rows` are first and last index."""
        self._add("warning", kind, column, problem, fix, rows)

    def fact(self, severity: str, kind: str, field: str, problem: str, fix: str) -> None:
        """Reports something about a field of the YAML file."""
        file = str(Path(self._table.file).with_suffix(".yaml"))
        self.found.append(RecordFinding(severity, kind, file, field, None, problem, fix))

    def has(self, *kinds: str) -> bool:
        """Whether something of these kinds was found."""
        return any(finding.kind in kinds for finding in self.found)

    def _add(
        self,
        severity: str,
        kind: str,
        column: str,
        problem: str,
        fix: str,
        rows: tuple[int, int] | None,
    ) -> None:
        lines = self._table.lines
        place = None if rows is None else (int(lines[rows[0]]), int(lines[rows[1]]))
        self.found.append(
            RecordFinding(severity, kind, self._table.file, column, place, problem, fix)
        )


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of True in a bool array [n]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
