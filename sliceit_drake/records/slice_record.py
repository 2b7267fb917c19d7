"""The slice record: a slice as series over time and what is known (docs/reference/records.md).

On disk a record is a pair NAME.csv and NAME.yaml. `SliceTable` is that pair as it stands in the
files; `SliceRecord` is what the rest of the project works with: poses as matrices, velocities, and
the wrench on the knife about Ko in W, whatever frame, sign and point the files have.
`sliceit_drake.records.validation.load_record` reads and checks.
"""

import copy
import dataclasses as dc
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml
from sliceit_drake.records.metadata import Phase, ProcessingStep, SliceMetadata
from sliceit_drake.tables import read_rows

__all__ = [
    "COLUMNS",
    "SliceRecord",
    "SliceTable",
    "columns_of",
    "read_table",
    "record_from_table",
    "record_pair",
    "sensor_rotation",
    "velocities",
    "write_record",
]

TIME = "time"
POSITION = ("p_WK_x", "p_WK_y", "p_WK_z")
QUATERNION = ("quat_WK_w", "quat_WK_x", "quat_WK_y", "quat_WK_z")
VELOCITY = ("v_WK_x", "v_WK_y", "v_WK_z")
ANGULAR_VELOCITY = ("w_WK_x", "w_WK_y", "w_WK_z")
FORCE = ("force_x", "force_y", "force_z")
TORQUE = ("torque_x", "torque_y", "torque_z")
FORCE_NORM = "force_norm"
FORCE_VERTICAL = "force_vertical"
JOINTS = ("q_1", "q_2", "q_3", "q_4", "q_5", "q_6")

COLUMNS = (
    TIME,
    *POSITION,
    *QUATERNION,
    *VELOCITY,
    *ANGULAR_VELOCITY,
    *FORCE,
    *TORQUE,
    FORCE_NORM,
    FORCE_VERTICAL,
    *JOINTS,
)
"""Columns of the CSV file, in the order in which they are written. Others are refused."""


@dc.dataclass
class SliceTable:
    """A record as its files have it.

    Attributes:
        metadata: The YAML file.
        columns: Columns of the CSV file [n] by name; NaN where a cell is empty.
        file: The CSV file, or a name for errors if there is none.
        lines: Line of the file that each row stands on, int array [n].
    """

    metadata: SliceMetadata
    columns: dict[str, np.ndarray]
    file: str
    lines: np.ndarray

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether all these columns are there."""
        return all(name in self.columns for name in names)

    def stack(self, names: tuple[str, ...]) -> np.ndarray:
        """These columns side by side [n, len(names)]."""
        return np.column_stack([self.columns[name] for name in names])


@dc.dataclass
class SliceRecord:
    """A slice over time, SI units, all vectors in the world W.

    Attributes:
        metadata: What is known besides the series; `metadata.wrench` describes `force` and
            `torque` as they are here: on the knife, in W, about Ko.
        time: Increasing times [n], s.
        position: p_WK, positions of Ko, the middle of the edge [n, 3], m.
        rotation: R_WK [n, 3, 3].
        velocity: v_WK of Ko [n, 3], m/s.
        angular_velocity: w_WK [n, 3], rad/s.
        force: Force on the knife [n, 3], N; None if not all of its components are known.
        torque: Torque on the knife about Ko [n, 3], Nm; None if not known.
        force_norm: Norm of the force [n], N, where that is all that is known; None otherwise.
        force_vertical: The same of its component along Wz.
        joints: Joint angles [n, 6], rad; None if not known.
        file: The CSV file that it was read from, or a name for errors.
    """

    metadata: SliceMetadata
    time: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    force: np.ndarray | None = None
    torque: np.ndarray | None = None
    force_norm: np.ndarray | None = None
    force_vertical: np.ndarray | None = None
    joints: np.ndarray | None = None
    file: str = ""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """The record's name."""
        return self.metadata.name

    @property
    def source(self) -> str:
        """The file, or the name, for errors."""
        return self.file or self.name

    @property
    def force_magnitude(self) -> np.ndarray:
        """Norm of what is known of the force [n], N, from the components where they are known."""
        if self.force_norm is not None:
            return self.force_norm
        return np.linalg.norm(self.measured_force, axis=1)

    @property
    def force_columns(self) -> tuple[str, ...]:
        """What is known of the force: its components, its norm or the vertical one."""
        if self.force is not None:
            return FORCE
        return (FORCE_NORM,) if self.force_norm is not None else (FORCE_VERTICAL,)

    @property
    def known_force(self) -> str:
        """The same in words."""
        if self.force is not None:
            return "the components of the force"
        return f"the {'norm of the' if self.force_norm is not None else 'vertical'} force alone"

    @property
    def measured_force(self) -> np.ndarray:
        """Values of `force_columns` [n, 3] or [n, 1], N."""
        if self.force is not None:
            return self.force
        known = self.force_vertical if self.force_norm is None else self.force_norm
        assert known is not None, "a record has force, force_norm or force_vertical"
        return known[:, None]

    def phase(self, *labels: str) -> np.ndarray:
        """Bool mask [n] of the rows in phases with any of these labels."""
        return self._rows_of([p for p in self.metadata.motion.phases if p.label in labels])

    @property
    def cut_rows(self) -> np.ndarray:
        """Bool mask [n] of the rows in which the knife cuts; all where no phase is labelled."""
        if not self.metadata.motion.phases:
            return np.ones(len(self), bool)
        return self.phase("slice", "second_pass")

    @property
    def is_of_air(self) -> bool:
        """Whether all of its phases are in the air."""
        labels = {phase.label for phase in self.metadata.motion.phases}
        return labels == {"air"}

    def first_phase(self, label: str) -> np.ndarray:
        """Bool mask [n] of the rows in the first phase with this label; none if there is none."""
        return self._rows_of([p for p in self.metadata.motion.phases if p.label == label][:1])

    def _rows_of(self, phases: list[Phase]) -> np.ndarray:
        mask = np.zeros(len(self), bool)
        for phase in phases:
            last = (self.time == phase.end) & (phase.end >= self.time[-1])
            mask |= (self.time >= phase.start) & (self.time < phase.end) | last
        return mask

    def rows(self, select: np.ndarray | slice) -> "SliceRecord":
        """The rows that a mask [n], indices or a slice selects; metadata are copied."""
        chosen = dc.replace(self, metadata=copy.deepcopy(self.metadata))
        for name, series in vars(self).items():
            if isinstance(series, np.ndarray):
                setattr(chosen, name, series[select])
        return chosen

    def between(self, start: float, end: float) -> "SliceRecord":
        """The rows with start <= time <= end, s."""
        return self.rows((self.time >= start) & (self.time <= end))

    def table(self) -> SliceTable:
        """The record as columns of the file format."""
        quaternion = Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True)
        columns = {TIME: self.time} | columns_of(
            {
                POSITION: self.position,
                QUATERNION: quaternion,
                VELOCITY: self.velocity,
                ANGULAR_VELOCITY: self.angular_velocity,
                FORCE: self.force,
                TORQUE: self.torque,
                JOINTS: self.joints,
            }
        )
        if self.force is None:
            columns[self.force_columns[0]] = self.measured_force[:, 0]
        lines = np.arange(2, len(self) + 2)
        return SliceTable(self.metadata, columns, self.source, lines)


def columns_of(series: Mapping[tuple[str, ...], np.ndarray | None]) -> dict[str, np.ndarray]:
    """Columns [n] by name, from series [n, k] by the names of their columns, but for None."""
    known = ((names, values.T) for names, values in series.items() if values is not None)
    return {name: column for pair in known for name, column in zip(*pair, strict=True)}


def record_pair(file: str | Path) -> tuple[Path, Path]:
    """NAME.csv and NAME.yaml, of either or of NAME."""
    path = Path(file)
    base = path.with_suffix("") if path.suffix in (".csv", ".yaml", ".yml") else path
    return base.with_name(f"{base.name}.csv"), base.with_name(f"{base.name}.yaml")


def read_table(file: str | Path) -> SliceTable:
    """Reads the two files of a record as they are, given NAME.csv, NAME.yaml or NAME.

    Raises:
        ConfigurationError: If a file cannot be read, a name is unknown, or a cell holds text.
    """
    table, facts = record_pair(file)
    if not table.is_file() and not facts.is_file():
        raise ConfigurationError(
            "there is no such record", source=str(table), fix="Check the path."
        )
    if not facts.is_file():
        raise ConfigurationError(
            f"has no {facts.name} beside it, which says what was cut and how",
            source=str(table),
            fix="Write one as docs/reference/records.md has it; of a table in another format make "
            f"both: sliceit records import force {table} --metadata FACTS.yaml --output records.",
        )
    metadata = load_yaml(SliceMetadata, facts)
    metadata.name = metadata.name or table.stem
    columns, lines = _read_csv(table)
    return SliceTable(metadata, columns, str(table), lines)


def _read_csv(file: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    rows = read_rows(file)
    if len(rows) < 2:
        raise ConfigurationError(
            "the table has no rows", source=str(file), fix="Add rows of numbers under the names."
        )
    header = rows[0][1]
    for name in header:
        if name not in COLUMNS or header.count(name) > 1:
            problem = "is there twice" if name in COLUMNS else "is not a column of a slice record"
            raise ConfigurationError(
                problem,
                source=f"{file}, line {rows[0][0]}",
                field=name,
                fix=f"Columns: {', '.join(COLUMNS)}.",
            )
    values = np.full((len(rows) - 1, len(header)), np.nan)
    for k, (number, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ConfigurationError(
                f"has {len(row)} cells under {len(header)} names",
                source=f"{file}, line {number}",
                fix="Give one cell for each column; leave a cell empty where there is no reading.",
            )
        for j, text in enumerate(row):
            if text:
                try:
                    values[k, j] = float(text)
                except ValueError:
                    raise ConfigurationError(
                        f"is {text!r}, which is not a number",
                        source=f"{file}, line {number}",
                        field=header[j],
                        fix="Write a decimal point, no unit, no thousands separator.",
                    ) from None
    lines = np.array([number for number, _ in rows[1:]])
    return dict(zip(header, values.T, strict=True)), lines


def sensor_rotation(metadata: SliceMetadata) -> np.ndarray | None:
    """R_KS, axes of the sensor in the knife frame [3, 3]; None if not known."""
    angles = metadata.sensor.rotation
    return None if angles is None else Rotation.from_euler("xyz", angles).as_matrix()


def record_from_table(table: SliceTable) -> SliceRecord:
    """Turns the columns of a table without errors (`validation.check_table`) into series in W.

    The wrench becomes that on the knife, in W, about Ko; if sign, frame or point changed, the
    metadata say so in `processing`. A torque about an unknown point is dropped. Velocities that are
    not there are derived from the poses.

    Raises:
        ConfigurationError: If the frame or the point of the wrench needs a fact that is not given.
    """
    metadata = copy.deepcopy(table.metadata)
    time, position = table.columns[TIME], table.stack(POSITION)
    rotation = Rotation.from_quat(table.stack(QUATERNION), scalar_first=True).as_matrix()
    v, w = velocities(time, position, rotation)
    if table.has(VELOCITY):
        v = table.stack(VELOCITY)
    if table.has(ANGULAR_VELOCITY):
        w = table.stack(ANGULAR_VELOCITY)
    force = table.stack(FORCE) if table.has(FORCE) else None
    torque = table.stack(TORQUE) if force is not None and table.has(TORQUE) else None
    vertical = None
    if force is None and FORCE_NORM not in table.columns:
        vertical = (-1.0 if metadata.wrench.sign == "by_knife" else 1.0) * table.columns[
            FORCE_VERTICAL
        ]
        metadata.wrench.sign = "on_knife"
    if force is not None:
        force, torque = _wrench_on_knife(table, rotation, force, torque)
        facts, was = metadata.wrench, copy.deepcopy(metadata.wrench)
        facts.sign, facts.frame, facts.point = "on_knife", "W", "Ko"
        if facts != was:
            note = f"from {was.sign} in {was.frame} about {was.point} to on_knife in W about Ko"
            metadata.processing.append(ProcessingStep("express_wrench", note=note))
    return SliceRecord(
        metadata=metadata,
        time=time,
        position=position,
        rotation=rotation,
        velocity=v,
        angular_velocity=w,
        force=force,
        torque=torque,
        force_norm=table.columns.get(FORCE_NORM) if force is None else None,
        force_vertical=vertical,
        joints=table.stack(JOINTS) if table.has(JOINTS) else None,
        file=table.file,
    )


def velocities(
    time: np.ndarray, position: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocities by central differences of poses, one-sided at the ends.

    Args:
        time: Increasing times [n], s, n >= 2.
        position: p_WK [n, 3], m.
        rotation: R_WK [n, 3, 3].

    Returns:
        v_WK of the origin [n, 3], m/s, and w_WK [n, 3], rad/s, in W.
    """
    before = np.maximum(np.arange(len(time)) - 1, 0)
    after = np.minimum(np.arange(len(time)) + 1, len(time) - 1)
    span = (time[after] - time[before])[:, None]
    turn = Rotation.from_matrix(rotation[after] @ rotation[before].transpose(0, 2, 1))
    return (position[after] - position[before]) / span, turn.as_rotvec() / span


def _wrench_on_knife(
    table: SliceTable, R_WK: np.ndarray, force: np.ndarray, torque: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Force and torque about Ko on the knife in W."""
    facts, sensor = table.metadata.wrench, table.metadata.sensor
    where = str(Path(table.file).with_suffix(".yaml"))
    if facts.sign == "by_knife":
        force, torque = -force, None if torque is None else -torque
    if facts.frame == "K":
        R_WE = R_WK
    elif facts.frame == "S":
        R_KS = sensor_rotation(table.metadata)
        if R_KS is None:
            raise _missing_fact(where, "sensor.rotation", "wrench.frame is S", "its axes in K")
        R_WE = R_WK @ R_KS
    elif facts.frame == "F":
        if table.metadata.food.yaw is None:
            raise _missing_fact(where, "food.yaw", "wrench.frame is F", "its turn in W")
        R_WE = Rotation.from_euler("z", table.metadata.food.yaw).as_matrix()[None]
    else:
        R_WE = np.eye(3)[None]
    force = (R_WE @ force[:, :, None])[:, :, 0]
    if torque is None or facts.point == "unknown":
        return force, None
    torque = (R_WE @ torque[:, :, None])[:, :, 0]
    if facts.point == "So":
        if sensor.position is None:
            raise _missing_fact(where, "sensor.position", "wrench.point is So", "p_KoSo_K in m")
        torque = torque + np.cross(R_WK @ np.array(sensor.position), force)
    return force, torque


def _missing_fact(file: str, field: str, why: str, what: str) -> ConfigurationError:
    return ConfigurationError(
        f"is not given, but {why}", source=file, field=field, fix=f"Give {what}."
    )


def write_record(record: SliceRecord, file: str | Path) -> Path:
    """Writes a record as NAME.csv and NAME.yaml; `read_table` reads them back.

    Args:
        record: The record.
        file: NAME, NAME.csv or NAME.yaml; the folder is made if it is not there.

    Returns:
        The CSV file.
    """
    output, facts = record_pair(file)
    output.parent.mkdir(parents=True, exist_ok=True)
    table = record.table()
    names = [name for name in COLUMNS if name in table.columns]
    # Where the time is that of a clock, its steps are far smaller than itself.
    late = np.abs(record.time).max() / max(np.ptp(record.time), 1e-9)
    digits = min(16, 10 + int(np.ceil(np.log10(max(late, 1.0)))))
    np.savetxt(
        output,
        np.column_stack([table.columns[name] for name in names]),
        fmt=[f"%.{digits if name == TIME else 10}g" for name in names],
        delimiter=",",
        header=",".join(names),
        comments="",
    )
    dump_yaml(record.metadata, facts)
    return output
