"""Checks of slice records: what is wrong, in which file, column and rows, and what to do."""

import dataclasses as dc
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError, did_you_mean
from sliceit_drake.records import slice_record as fmt
from sliceit_drake.records.findings import MIN_ROWS, Findings, RecordFinding, runs
from sliceit_drake.records.force_checks import check_force
from sliceit_drake.records.motion_checks import check_motion
from sliceit_drake.records.slice_record import SliceRecord, SliceTable

__all__ = [
    "check_record",
    "check_table",
    "load_record",
    "load_records",
    "load_sessions",
    "record_files",
]

KEY_FACTS = (
    "provenance",
    "food.name",
    "food.shape",
    "food.size",
    "food.support",
    "food.slice_thickness",
    "food.position",
    "food.yaw",
    "board_height",
    "knife.spine_thickness",
    "motion.speed",
    "sensor.rate",
)
"""Facts that the simulation of a slice needs: given, or listed as unknown."""
MOST_LOST = 0.1
"""Fraction of the rows that may lack a finite number of the wrench: they are left out."""


def load_record(file: str | Path) -> SliceRecord:
    """Reads a record and refuses one that cannot be used; `check_record` has the warnings.

    Args:
        file: NAME.csv, NAME.yaml or NAME of the pair.

    Raises:
        ConfigurationError: If a file is missing or unreadable, or at the first error found.
    """
    table = fmt.read_table(file)
    for finding in check_table(table):
        if finding.severity == "error":
            raise ConfigurationError(
                finding.problem, source=finding.place, field=finding.column, fix=finding.fix
            )
    return fmt.record_from_table(_with_readings(table))


def load_records(folder: str | Path) -> list[SliceRecord]:
    """Reads all records of a folder with pairs NAME.csv and NAME.yaml, by slice index, then name.

    Raises:
        ConfigurationError: If there are none, or one cannot be used.
    """
    records = [load_record(file) for file in record_files(Path(folder))]
    return sorted(records, key=lambda record: (record.metadata.slice_index, record.name))


def load_sessions(folders: Sequence[str | Path]) -> list[SliceRecord]:
    """Reads the records of folders, in the order of the sessions that they are, as one.

    Slices are numbered through; of several folders a record's name has its folder's before it.

    Raises:
        ConfigurationError: As `load_records`, or a folder is there twice.
    """
    paths = [Path(folder) for folder in folders]
    for k, path in enumerate(paths):
        if path.resolve() in [p.resolve() for p in paths[:k]]:
            raise ConfigurationError(
                "is there twice",
                source=str(path),
                fix="Name each folder once: a slice counted twice would look like two.",
            )
    if len(paths) == 1:
        return load_records(paths[0])
    names = [path.resolve().name for path in paths]
    out: list[SliceRecord] = []
    first = 0
    for k, path in enumerate(paths):
        prefix = names[k] if names.count(names[k]) == 1 else f"{k + 1}_{names[k]}"
        records = load_records(path)
        for record in records:
            record.metadata.name = f"{prefix}/{record.name}"
            record.metadata.slice_index += first
        first = 1 + max(record.metadata.slice_index for record in records)
        out += records
    return out


def record_files(path: Path) -> list[Path]:
    """The CSV files of the records in a folder, or the file itself.

    Raises:
        ConfigurationError: If a folder has none.
    """
    if path.suffix in (".csv", ".yaml", ".yml"):
        return [path.with_suffix(".csv")]
    files = sorted(path.glob("*.csv"))
    if not files:
        raise ConfigurationError(
            "there are no records", source=str(path), fix="Give a folder with NAME.csv files."
        )
    return files


def check_record(record: SliceRecord) -> list[RecordFinding]:
    """Errors and warnings of a record in memory; see `check_table`."""
    return check_table(record.table())


def check_table(table: SliceTable) -> list[RecordFinding]:
    """Errors and warnings of a record as its files have it, or in memory.

    If the columns cannot be read as series, only the errors that say so.
    """
    findings = Findings(table)
    whole, table = table, _with_readings(table)
    if lost := len(whole.lines) - len(table.lines):
        rows = np.flatnonzero(~np.isin(whole.lines, table.lines))
        text = f"{lost} of {len(whole.lines)} rows have no finite wrench and are left out"
        findings.add("no reading", "", text, (rows[0], rows[-1]))
        findings.table = table
    _check_structure(table, findings)
    if any(finding.severity == "error" for finding in findings.found):
        return findings.found
    try:
        record = fmt.record_from_table(table)
    except ConfigurationError as error:
        findings.fact("missing fact", error.field or "", error.problem, error.fix)
        return [dc.replace(finding, severity="error") for finding in findings.found]
    _check_facts(table, findings)
    check_motion(table, record, findings)
    # Work and power need metres and seconds.
    if not findings.has("millimetres", "milliseconds"):
        check_force(table, record, findings)
    return findings.found


def _with_readings(table: SliceTable) -> SliceTable:
    """The table without the rows in which the sensor has no finite number, where these are few."""
    names = (*fmt.FORCE, *fmt.TORQUE, fmt.FORCE_NORM, fmt.FORCE_VERTICAL)
    series = [table.columns[name] for name in names if name in table.columns]
    kept = np.isfinite(series).all(0) if series else np.ones(len(table.lines), bool)
    if kept.all() or kept.mean() < 1.0 - MOST_LOST:
        return table
    columns = {name: values[kept] for name, values in table.columns.items()}
    return dc.replace(table, columns=columns, lines=table.lines[kept])


def _check_structure(table: SliceTable, findings: Findings) -> None:
    """Missing columns, gaps, time that does not increase, quaternions that are none."""
    for name in (fmt.TIME, *fmt.POSITION, *fmt.QUATERNION):
        if name not in table.columns:
            findings.add("missing column", name, "the column is missing")
    if not (table.has(fmt.FORCE) or {fmt.FORCE_NORM, fmt.FORCE_VERTICAL} & set(table.columns)):
        fix = f"Add {', '.join(fmt.FORCE)}, or force_norm or force_vertical if no more is known."
        findings.add("missing column", fmt.FORCE[0], "there is no force", fix=fix)
    for group in (fmt.FORCE, fmt.TORQUE, fmt.VELOCITY, fmt.ANGULAR_VELOCITY, fmt.JOINTS):
        absent = [name for name in group if name not in table.columns]
        if 0 < len(absent) < len(group):
            beside = next(name for name in group if name in table.columns)
            text = f"the column is missing beside {beside}"
            findings.add("missing column", absent[0], text)
    for name, values in table.columns.items():
        for first, last in runs(~np.isfinite(values)):
            text = f"{last - first + 1} of {len(values)} rows have no finite number"
            findings.add("gap", name, text, (first, last))
    if findings.has("missing column", "gap"):
        return
    time = table.columns[fmt.TIME]
    if len(time) < MIN_ROWS:
        findings.add("short", fmt.TIME, f"the table has {len(time)} rows")
        return
    wrong = np.flatnonzero(np.diff(time) <= 0.0) + 1
    if wrong.size:
        k = int(wrong[0])
        how = "repeats" if time[k] == time[k - 1] else "goes back from"
        more = f" ({wrong.size} such rows)" if wrong.size > 1 else ""
        text = f"{time[k]:.9g} s {how} {time[k - 1]:.9g} s{more}; time must increase"
        findings.add("time", fmt.TIME, text, (k, k))
    length = np.linalg.norm(table.stack(fmt.QUATERNION), axis=1)
    for first, last in runs(np.abs(length - 1.0) > 1e-3):
        text = f"the quaternion has length {length[first]:.4g}, expected 1"
        findings.add("quaternion", fmt.QUATERNION[0], text, (first, last))


def _check_facts(table: SliceTable, findings: Findings) -> None:
    """Facts that were forgotten, unknowns that name nothing, phases beside the record."""
    metadata = table.metadata
    names = _field_names(metadata)
    for name in metadata.unknown:
        if name not in names and name not in fmt.COLUMNS:
            fix = did_you_mean(name, [*names, *fmt.COLUMNS], "Name a field, as food.size.")
            text = f"{name!r} is no field and no column"
            findings.fact("unknown name", "unknown", text, fix)
    phases = metadata.motion.phases
    # A record of the air, the board or a weight has no food.
    is_slice = not phases or any(phase.label == "slice" for phase in phases)
    values = operator.attrgetter(*KEY_FACTS)(metadata) if is_slice else ()
    given = zip(KEY_FACTS, values, strict=False)
    missing = [name for name, value in given if value in (None, "", "unknown")]
    forgotten = [name for name in missing if name not in metadata.unknown]
    if forgotten:
        findings.fact("missing fact", ", ".join(forgotten), "not given")
    if table.has(fmt.TORQUE) and metadata.wrench.point == "unknown":
        text = "is unknown, so that the torque is not used"
        findings.fact("missing fact", "wrench.point", text, "Give Ko or So.")
    time = table.columns[fmt.TIME]
    if not phases:
        text = "no phase is labelled, so that the whole record counts as slice"
        fix = "Give label, start and end of the phases, in the time of the record."
        findings.fact("phases", "motion.phases", text, fix)
    for k, phase in enumerate(phases):
        if phase.start >= time[-1] or phase.end <= time[0]:
            text = f"{phase.label} from {phase.start:g} to {phase.end:g} s is beside the record,"
            text += f" which has {time[0]:g} to {time[-1]:g} s"
            findings.fact("phases", f"motion.phases[{k}]", text)


def _field_names(config: Any, lead: str = "") -> list[str]:
    """Dotted names of all fields."""
    names = []
    for field in dc.fields(config):
        value = getattr(config, field.name)
        names.append(lead + field.name)
        if dc.is_dataclass(value):
            names += _field_names(value, f"{lead}{field.name}.")
    return names
