"""A run as a time series for ParaView: the deformed food, the knife, and the force on it.

frames = FoodFrames(run, 30.0)
run.advance()
write_series(frames, Path("output/cucumber/paraview"))
"""

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import meshio
import numpy as np
from pydrake.systems.framework import Context, EventStatus
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.plant.knife_body import blade_surface
from sliceit_drake.diagrams.run import Run, prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.systems.cut_report import FoodBodyFrame
from sliceit_drake.tables import read_columns

__all__ = ["FoodFrames", "run_again", "write_series"]

AGREES = 1e-6
"""Difference of the force from the record's up to which the run is the same, N, or as a fraction of
a peak above 1 N: the record is printed with eight digits."""


class FoodFrames:
    """Keeps the food's body at a fixed rate while a run is simulated.

    Frames are at coupling steps, as the rows of the record are. Keeping them changes nothing of the
    run.

    Args:
        run: Prepared, not yet simulated.
        rate: Frames a second, at most one a coupling step.

    Raises:
        ConfigurationError: The food has no body, or the rate is not positive.

    Attributes:
        run: The run.
        times: Times of the frames [n], s.
        bodies: Bodies of the food, one a frame.
    """

    def __init__(self, run: Run, rate: float) -> None:
        self.run = run
        self.times: list[float] = []
        self.bodies: list[FoodBodyFrame] = []
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
            self.times.append(time)
            self.bodies.append(body)
        return EventStatus.DidNothing()

    def __len__(self) -> int:
        return len(self.times)


def write_series(
    frames: FoodFrames, directory: Path, kind: Literal["vtu", "xdmf"] = "vtu"
) -> list[Path]:
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
        ConfigurationError: In an XDMF file the mesh cannot change, as it does from slice to slice
            of a sequence.
    """
    if kind == "xdmf" and len({body.food for body in frames.bodies}) > 1:
        raise ConfigurationError(
            "the mesh changes from slice to slice, which an XDMF series cannot hold",
            field="--format",
            fix="Give vtu.",
        )
    # Whether the very end of a run is logged depends on how its time is rounded.
    end = float(frames.run.record()["time"][-1]) + 1e-9
    count = int(np.searchsorted(frames.times, end, side="right"))
    del frames.times[count:], frames.bodies[count:]
    directory.mkdir(parents=True, exist_ok=True)
    return (_write_vtu if kind == "vtu" else _write_xdmf)(frames, directory)


def _meshes(frames: FoodFrames) -> Iterator[dict[str, meshio.Mesh]]:
    """Food, knife and force at each frame."""
    record = frames.run.record()
    p_WK = record.vector("knife_pose_p")
    quaternions = record.vector("knife_pose_quat", "wxyz")
    R_WK = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    wrenches = {
        f"{name}_{what}": record.vector(f"{name}_wrench_{letter}")
        for name in ("food", "board", "sensor")
        for what, letter in (("force", "f"), ("moment", "m"))
    }
    surface = blade_surface(frames.run.scenario.knife)
    vertices = np.array(surface.vertices())
    triangles = np.array([[t.vertex(i) for i in range(3)] for t in surface.triangles()])
    rest = vertices @ R_WK[0].T + p_WK[0]
    for time, body in zip(frames.times, frames.bodies, strict=True):
        row = int(np.abs(record["time"] - time).argmin())
        R, p = R_WK[row], p_WK[row]
        yield {
            "food": _mesh(
                body.points,
                body.rest,
                {"tetra": body.tetrahedra},
                damage=body.damage,
                side=body.side.astype(float),
                food=np.full(len(body.points), float(body.food)),
            ),
            "knife": _mesh(vertices @ R.T + p, rest, {"triangle": triangles}),
            "force": _mesh(
                p[None],
                p_WK[:1],
                {"vertex": np.zeros((1, 1), dtype=np.int64)},
                **{name: values[row][None] for name, values in wrenches.items()},
                K_x=R[:, 0][None],
                K_z=R[:, 2][None],
            ),
        }


def _mesh(
    points: np.ndarray, rest: np.ndarray, cells: dict[str, np.ndarray], **values: np.ndarray
) -> meshio.Mesh:
    return meshio.Mesh(points, cells, point_data={"displacement": points - rest} | values)


def _write_vtu(frames: FoodFrames, directory: Path) -> list[Path]:
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for k, (time, meshes) in enumerate(zip(frames.times, _meshes(frames), strict=True)):
        for number, (name, mesh) in enumerate(meshes.items()):
            file = directory / f"{name}_{k:04d}.vtu"
            mesh.write(file)
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
    shown = list(_meshes(frames))
    files = []
    for name, first in shown[0].items():
        files.append(directory / f"{name}.xdmf")
        # As text: HDF5 would need another package, and raw files lie where the program runs.
        writer: Any = meshio.xdmf.TimeSeriesWriter(files[-1], data_format="XML")
        with writer:
            # The knife is at rest in the first frame.
            rest = frames.bodies[0].rest if name == "food" else first.points
            writer.write_points_cells(rest, first.cells)
            for time, meshes in zip(frames.times, shown, strict=True):
                writer.write_data(time, point_data=meshes[name].point_data)
    return files


def run_again(
    folder: Path, fps: float, progress: Callable[[float, float], None] | None = None
) -> tuple[FoodFrames, float | None]:
    """Simulates the scenario of a saved run for as long as its record is.

    Args:
        folder: Folder of the run, with scenario.yaml and record.csv.
        fps: Frames a second.
        progress: Called with the simulated time and the duration, s.

    Returns:
        Shapes of the food, and the greatest difference of its vertical force from the record, N;
        None where the run is that of the record.

    Raises:
        ConfigurationError: The folder is not of a run, or the scenario cannot start.
    """
    for name in ("scenario.yaml", "record.csv"):
        if not (folder / name).is_file():
            raise ConfigurationError(
                f"there is no {name}",
                source=str(folder),
                fix="Give the folder that `sliceit simulate --output FOLDER` wrote.",
            )
    summary = folder / "summary.json"
    own = json.loads(summary.read_text(encoding="utf-8")).get("own") if summary.is_file() else None
    if own:
        raise ConfigurationError(
            f"the run had the user's own {' and '.join(own)}, which its folder does not have",
            source=str(folder),
            fix="Take the shapes in your program: FoodFrames and write_series of "
            "sliceit_drake.diagrams.outputs.paraview.",
        )
    kept = read_columns(folder / "record.csv", ["time", "food_wrench_f_z"])
    run = prepare_run(load_scenario(folder / "scenario.yaml"))
    frames, duration = FoodFrames(run, fps), float(kept["time"][-1])

    def show(time: float, _: float) -> None:
        if progress is not None:
            progress(time, duration)

    run.advance(duration, show)
    force = run.record()["food_wrench_f_z"]
    count = min(len(force), len(kept["time"]))
    difference = float(np.abs(force[:count] - kept["food_wrench_f_z"][:count]).max())
    agrees = difference <= AGREES * max(1.0, float(np.abs(force).max()))
    return frames, None if agrees else difference
