"""What checks of a slice record find, and the collector that they report to."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.records.slice_record import SliceTable

__all__ = ["KINDS", "MIN_ROWS", "Findings", "RecordFinding", "runs"]

MIN_ROWS = 10
"""A table with fewer is no record of a slice."""
KINDS = {
    "missing column": ("error", "Add it."),
    "gap": ("error", "Remove these rows, or cut the record off before them."),
    "no reading": (
        "warning",
        "Leave them if nothing happened then; else cut the record off before.",
    ),
    "short": ("error", f"Give at least {MIN_ROWS} rows."),
    "time": ("error", "Remove repeated rows; split the record where the clock was set back."),
    "quaternion": ("error", "Write a unit quaternion, w first."),
    "unknown name": ("warning", "Name a field, as food.size."),
    "missing fact": ("warning", "Give a value, or list the name under unknown."),
    "phases": ("warning", "Give times of the record."),
    "millimetres": ("error", "Is it in mm? Divide p_WK_x, p_WK_y, p_WK_z by 1000 to give metres."),
    "milliseconds": ("error", "Is it in ms? Divide the column by 1000 to give seconds."),
    "degrees": ("error", "Is it in degrees? Multiply q_1 .. q_6 by pi / 180."),
    "jump": ("error", "Remove the wrong rows, or cut the record off before them."),
    "dropout": ("warning", "Leave it if nothing happened then; else cut the record off before."),
    "velocity": (
        "warning",
        "Give velocities of Ko in W, or remove the columns: they are then derived.",
    ),
    "upside down": (
        "error",
        "Check --tcp-to-knife (rad; z of K points from the spine to the edge), or correct quat_WK.",
    ),
    "below board": ("warning", "Correct board_height, or the knife's pose on the tool."),
    "constant": ("error", "Record the sensor, not its command."),
    "negative norm": ("error", "Give the components force_x..z, or the norm."),
    "no air phase": (
        "warning",
        "Label the time before contact as air; record half a second of it.",
    ),
    "no tare": ("warning", "Apply the step tare, which subtracts that mean."),
    "drift": (
        "warning",
        "Let the sensor warm up, record air before and after the slice, and repeat it.",
    ),
    "force unit": ("error", "Is it in mN, or in counts of the sensor? Convert it to newtons."),
    "great work": (
        "warning",
        "Is the force in g, or in counts of the sensor? Convert it to newtons.",
    ),
    "kilonewtons": (
        "error",
        "Is it in kN? Multiply the force and torque columns by 1000 to give N and Nm.",
    ),
    "flipped sign": ("error", "Correct wrench.sign, or wrench.frame."),
    "frame": ("warning", "Check wrench.frame, and the placement of the knife on the tool."),
    "clipped": (
        "warning",
        "A calibration leaves these rows out; repeat the slice with a sensor of greater range.",
    ),
    "level end": ("warning", "Did the knife stand, or leave the food? End the slice before that."),
    "frozen": ("warning", "Check the sensor's connection; leave these rows out."),
}
"""What is looked for: how bad it is, and what to do where the record does not tell it better."""


@dc.dataclass(frozen=True)
class RecordFinding:
    """Something about a record that a user should know.

    Attributes:
        severity: "error" if the record cannot be used, "warning" if with care.
        kind: Short name of what was found, such as "millimetres".
        column: The column, or the field of the YAML file, or "".
        lines: First and last line of the file concerned, or None for the file as a whole.
        problem: What is wrong and what was expected.
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
        table: The table whose rows `add` counts.
        found: The findings so far.
    """

    def __init__(self, table: SliceTable) -> None:
        self.table = table
        self.found: list[RecordFinding] = []

    def add(
        self,
        kind: str,
        column: str,
        problem: str,
        rows: tuple[int, int] | None = None,
        fix: str | None = None,
        file: str | None = None,
    ) -> None:
        """Reports something about the table; `rows` are first and last index."""
        severity, usual = KINDS[kind]
        lines = self.table.lines
        place = None if rows is None else (int(lines[rows[0]]), int(lines[rows[1]]))
        self.found.append(
            RecordFinding(
                severity, kind, file or self.table.file, column, place, problem, fix or usual
            )
        )

    def fact(self, kind: str, field: str, problem: str, fix: str | None = None) -> None:
        """Reports something about a field of the YAML file."""
        file = str(Path(self.table.file).with_suffix(".yaml"))
        self.add(kind, field, problem, fix=fix, file=file)

    def has(self, *kinds: str) -> bool:
        """Whether something of these kinds was found."""
        return any(finding.kind in kinds for finding in self.found)


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of True in a bool array [n]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
