"""A run as a time series for ParaView: the deformed food, the knife, and the force on it.

frames = FoodFrames(run, 30.0)
run.advance()
write_series(frames, Path("output/cucumber/paraview"))
"""

import dataclasses as dc
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from pydrake.systems.framework import Context, EventStatus
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.plant.knife_body import blade_surface
from sliceit_drake.diagrams.run import Run
from sliceit_drake.systems.cut_report import FoodBodyFrame

__all__ = ["FORMATS", "FoodFrames", "write_series"]

FORMATS = ("vtu", "xdmf")

WRENCHES = ("food", "board", "sensor")


class FoodFrames:
    """Keeps the food's body at a fixed rate while a run is simulated.

    Frames are at coupling steps, as the rows of the record are. Keeping them changes nothing of the
    run.

    Args:
        run: Prepared, not yet simulated.
        rate: Frames a second, at most one a coupling step.

    Raises:
        ConfigurationError: The food has no body, or the rate is not positive.
    """

    def __init__(self, run: Run, rate: float) -> None:
        self.run = run
        self._times: list[float] = []
        self._bodies: list[FoodBodyFrame] = []
        if self._body(run.simulator.get_context()) is None:
            raise ConfigurationError(
                "this food has no body to show; one of finite elements has",
                field="scenario.food",
                fix="Simulate a scenario whose food is one.",
            )
        if not rate > 0.0:
            raise ConfigurationError(f"is {rate:g}", field="--fps", fix="Give frames a second.")
        coupling_step = run.scenario.exchange_period
        self._period = max(1, round(1.0 / rate / coupling_step)) * coupling_step
        run.simulator.set_monitor(self._keep)
        self._keep(run.simulator.get_context())

    def _body(self, root: Context) -> FoodBodyFrame | None:
        cutting = self.run.station.cutting
        return cutting.body(cutting.GetMyContextFromRoot(root))

    def _keep(self, root: Context) -> EventStatus:
        time = root.get_time()
        if time >= len(self) * self._period - 1e-9:
            body = self._body(root)
            assert body is not None
            self._times.append(time)
            self._bodies.append(body)
        return EventStatus.DidNothing()

    def end(self, time: float) -> None:
        """Drops the frames after a time, s."""
        while self._times and self._times[-1] > time + 1e-9:
            self._times.pop()
            self._bodies.pop()

    def __len__(self) -> int:
        return len(self._times)

    @property
    def times(self) -> np.ndarray:
        """Times of the frames [n], s."""
        return np.array(self._times)

    @property
    def bodies(self) -> list[FoodBodyFrame]:
        """Bodies of the food, one a frame."""
        return self._bodies


def write_series(frames: FoodFrames, directory: Path, kind: str = "vtu") -> list[Path]:
    """Writes what was kept, after the run.

    The series are `food` (tetrahedra of both halves; at the corners `displacement`, m, `damage`, 0
    intact to 1 cut, `side`, 0 or 1, and `food`, the slice of a sequence), `knife` (the blade) and
    `force` (a vertex at Ko with the forces, N, and moments about Ko, Nm, of food and board on the
    knife and what the sensor reads, in W, and the axes Kx, Kz). All in W, metres, times in s.

    Args:
        frames: With the run simulated.
        directory: Made if absent.
        kind: "vtu" for files of each frame with run.pvd, which lists them; "xdmf" for one file a
            series, in which the food and the knife are at rest and move by `displacement`.

    Returns:
        The files to open.

    Raises:
        ConfigurationError: There is no such kind; in an XDMF file the mesh cannot change, as it
            does from slice to slice of a sequence.
    """
    if kind not in FORMATS:
        raise ConfigurationError(
            f"{kind!r} is no format", field="--format", fix=f"Give one of {', '.join(FORMATS)}."
        )
    if kind == "xdmf" and len({body.food for body in frames.bodies}) > 1:
        raise ConfigurationError(
            "the mesh changes from slice to slice, which an XDMF series cannot hold",
            field="--format",
            fix="Give vtu.",
        )
    # Whether the very end of a run is logged depends on how its time is rounded.
    frames.end(float(frames.run.record()["time"][-1]))
    directory.mkdir(parents=True, exist_ok=True)
    return (_write_vtu if kind == "vtu" else _write_xdmf)(frames, directory)


@dc.dataclass
class _Part:
    """A mesh of one frame: corners now and at rest [V, 3], cells, and values at the corners."""

    points: np.ndarray
    rest: np.ndarray
    cells: dict[str, np.ndarray]
    values: dict[str, np.ndarray]


class _Parts:
    """The parts of a frame by name."""

    def __init__(self, frames: FoodFrames) -> None:
        self._frames = frames
        self._record: Record = frames.run.record()
        blade = blade_surface(frames.run.scenario.knife)
        self._blade = np.array(blade.vertices())
        self._triangles = np.array(
            [[t.vertex(i) for i in range(3)] for t in blade.triangles()], dtype=np.int64
        )

    def of(self, k: int) -> Mapping[str, _Part]:
        """Those of frame k."""
        body, time = self._frames.bodies[k], self._frames.times[k]
        row = int(np.abs(self._record["time"] - time).argmin())
        X_WK, first = self._pose(row), self._pose(0)
        origin = X_WK[:, 3][None]
        return {
            "food": _Part(
                body.points,
                body.rest,
                {"tetra": body.tetrahedra},
                {
                    "damage": body.damage,
                    "side": body.side.astype(float),
                    "food": np.full(len(body.points), float(body.food)),
                },
            ),
            "knife": _Part(
                self._blade @ X_WK[:, :3].T + X_WK[:, 3],
                self._blade @ first[:, :3].T + first[:, 3],
                {"triangle": self._triangles},
                {},
            ),
            "force": _Part(
                origin,
                first[:, 3][None],
                {"vertex": np.zeros((1, 1), dtype=np.int64)},
                {
                    f"{name}_{what}": self._record.vector(f"{name}_wrench_{letter}")[row][None]
                    for name in WRENCHES
                    for what, letter in (("force", "f"), ("moment", "m"))
                }
                | {"K_x": X_WK[:, 0][None], "K_z": X_WK[:, 2][None]},
            ),
        }

    def _pose(self, row: int) -> np.ndarray:
        """X_WK [3, 4] of a row of the record."""
        names = [f"knife_pose_quat_{a}" for a in "wxyz"]
        quaternion = [self._record[name][row] for name in names]
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        return np.column_stack([R, self._record.vector("knife_pose_p")[row]])


def _write_vtu(frames: FoodFrames, directory: Path) -> list[Path]:
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    parts = _Parts(frames)
    for k, time in enumerate(frames.times):
        for number, (name, part) in enumerate(parts.of(k).items()):
            file = directory / f"{name}_{k:04d}.vtu"
            values = {"displacement": part.points - part.rest} | part.values
            meshio.Mesh(part.points, part.cells, point_data=values).write(file)
            ET.SubElement(
                collection,
                "DataSet",
                timestep=f"{time:.9g}",
                part=str(number),
                name=name,
                file=file.name,
            )
    ET.indent(root)
    main = directory / "run.pvd"
    ET.ElementTree(root).write(main, encoding="utf-8", xml_declaration=True)
    return [main]


def _write_xdmf(frames: FoodFrames, directory: Path) -> list[Path]:
    parts = _Parts(frames)
    shown = [parts.of(k) for k in range(len(frames))]
    files = []
    for name, first in shown[0].items():
        files.append(directory / f"{name}.xdmf")
        # As text: HDF5 would need another package, and raw files lie where the program runs.
        writer: Any = meshio.xdmf.TimeSeriesWriter(files[-1], data_format="XML")
        with writer:
            writer.write_points_cells(first.rest, list(first.cells.items()))
            for time, frame in zip(frames.times.tolist(), shown, strict=True):
                part = frame[name]
                values = {"displacement": part.points - part.rest} | part.values
                writer.write_data(time, point_data=values)
    return files
