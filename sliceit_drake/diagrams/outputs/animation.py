"""Pictures of a run as a camera would see it, drawn without a display or a browser."""

import base64
import contextlib
import dataclasses as dc
import functools
import importlib
import json
import math
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryId,
    GeometryInstance,
    InMemoryMesh,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.sensors import CameraInfo

from sliceit_drake.diagrams.outputs.figures import SIMULATED
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.systems.cut_report import FoodPicture
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.food_look import ColouredMesh, FoodScene, Part

__all__ = ["NEEDED", "Film", "Frame", "add_force", "can_draw", "write_gif"]

SIZE = (640, 480)
STRIP = 100
"""Height of the plot of the force below the picture, pixels."""
PERIOD = 0.08
"""Time between the frames of a run, s; a multiple of it where there would be too many."""
MOST_FRAMES = 90
REST = 1500
"""How long an animation shows its last picture, ms."""
BACKGROUND = np.array([0.93, 0.95, 0.97])
RENDERER = "camera"
NEEDED = (
    "drawing without a display needs EGL and Mesa: on Debian and Ubuntu the packages libegl1, "
    "libegl-mesa0 and libgl1-mesa-dri"
)
# Direction in the camera's frame, which has x to the right, y down and z forward; and intensity.
LIGHTS = (([-0.2, 0.35, 1.0], 2.1), ([0.7, 0.9, 0.5], 1.0), ([-1.0, 0.2, 0.5], 0.6))

TRIAL = """
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo
scene_graph = SceneGraph()
scene_graph.AddRenderer("trial", MakeRenderEngineVtk(RenderEngineVtkParams()))
core = RenderCameraCore("trial", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1.0), RigidTransform())
query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
query.RenderColorImage(ColorRenderCamera(core), scene_graph.world_frame_id(), RigidTransform())
"""
"""Draws nothing, once."""


@dc.dataclass
class Frame:
    """What there is to see at one instant.

    Attributes:
        time: s.
        joints: Positions of the plant, rad.
        parts: The food's.
    """

    time: float
    joints: np.ndarray
    parts: list[Part]


class Film:
    """Frames of a run, kept as it goes and drawn afterwards.

    Args:
        station: What is seen; a food that is no `CuttingSystem` is left out.
        duration: Of the run, s.

    Attributes:
        period: Time between frames, s.
    """

    def __init__(self, station: SimulatedStation, duration: float) -> None:
        self._station = station
        self.period = PERIOD * max(1, math.ceil(duration / (PERIOD * MOST_FRAMES)))
        self.frames: list[Frame] = []
        self._root: Context | None = None
        cutting = station.cutting
        self._scene: FoodScene | None = (
            cutting.scene() if isinstance(cutting, CuttingSystem) else None
        )

    def look(self, root_context: Context) -> None:
        """Keeps what there is to see now, if it is time for a frame."""
        if root_context.get_time() > len(self.frames) * self.period - 1e-9:
            self.frames.append(self.frame(root_context))

    def frame(self, root_context: Context) -> Frame:
        """What there is to see now."""
        if self._root is None:
            self._root = root_context.Clone()
        station = self._station
        plant_context = station.plant.GetMyContextFromRoot(root_context)

        def port(name: str) -> Any:
            system = station.slices if name == "slices" else station.cutting
            if system is None:
                return np.zeros(0)
            return system.GetOutputPort(name).Eval(system.GetMyContextFromRoot(root_context))

        if self._scene is not None:
            parts = self._scene.parts(port)
        else:
            parts = _pictured(
                station.cutting.picture(station.cutting.GetMyContextFromRoot(root_context))
            )
        joints = station.plant.GetPositions(plant_context).copy()
        return Frame(root_context.get_time(), joints, parts)

    @property
    def times(self) -> np.ndarray:
        """Of the frames, s."""
        return np.array([frame.time for frame in self.frames])

    def draw(self, frames: Iterable[Frame]) -> Iterator[np.ndarray]:
        """Draws frames of its own one by one: [H, W, 3], red, green, blue, 0 to 255.

        Call it only where `can_draw`.
        """
        assert self._root is not None, "the frames are of another film"
        # The LLVM in Triton, which PyTorch imports, crashes if it is loaded after the one in Mesa.
        with contextlib.suppress(ImportError):
            importlib.import_module("triton")
        root = self._root.Clone()
        scene_graph = self._station.scene_graph
        context = scene_graph.GetMyMutableContextFromRoot(root)
        lights = [
            LightParameter(type="directional", direction=direction, intensity=intensity)
            for direction, intensity in LIGHTS
        ]
        engine = MakeRenderEngineVtk(
            RenderEngineVtkParams(default_clear_color=BACKGROUND, lights=lights)
        )
        scene_graph.AddRenderer(context, RENDERER, engine)
        camera = ColorRenderCamera(
            RenderCameraCore(
                RENDERER, CameraInfo(*SIZE, 0.6), ClippingRange(0.01, 10.0), RigidTransform()
            ),
            False,
        )
        drawn = _Drawn(self._station, context)
        X_WC = self._station.camera_pose()
        plant = self._station.plant
        for frame in frames:
            plant.SetPositions(plant.GetMyMutableContextFromRoot(root), frame.joints)
            drawn.show(frame.parts)
            query = scene_graph.get_query_output_port().Eval(context)
            image = query.RenderColorImage(camera, scene_graph.world_frame_id(), X_WC)
            yield image.data[:, :, :3].copy()


@functools.cache
def can_draw() -> bool:
    """Whether this machine can draw without a display, tried in another process.

    Without a library for it Drake's renderer does not raise an error: it ends the process.
    """
    tried = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, check=False)
    return tried.returncode == 0


def add_force(pictures: Sequence[np.ndarray], times: np.ndarray, record: Record) -> None:
    """Draws the force on the knife up to each picture's time along the pictures' lower edge.

    Args:
        pictures: [H, W, 3], changed in place.
        times: Of the pictures, s.
        record: The run.
    """
    import matplotlib.figure
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    force = np.linalg.norm(record.vector("food_wrench_f"), axis=1)
    width, height, dpi = SIZE[0], STRIP, 100
    figure = matplotlib.figure.Figure(figsize=(width / dpi, height / dpi), dpi=dpi)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.09, 0.32, 0.88, 0.58))
    axes.set_xlim(0.0, record["time"][-1])
    axes.set_ylim(0.0, 1.1 * max(float(force.max()), 1.0))
    axes.set_xlabel("time [s]", fontsize=7, labelpad=1)
    axes.set_ylabel("force [N]", fontsize=7)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    (line,) = axes.plot(record["time"], force, color="0.82", lw=1.5)
    strips = []
    for colour in ("0.82", SIMULATED):
        line.set_color(colour)
        canvas.draw()
        strips.append(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    ahead, past = strips
    left, right = axes.transData.transform([(0.0, 0.0), (record["time"][-1], 0.0)])[:, 0]
    for picture, time in zip(pictures, times, strict=True):
        now = round(left + (right - left) * time / record["time"][-1])
        picture[-height:, :now] = past[:, :now]
        picture[-height:, now:] = ahead[:, now:]


def write_gif(file: Path, pictures: Sequence[np.ndarray], period: float) -> None:
    """Writes pictures [H, W, 3], one each `period`, s, as an endless animation."""
    from PIL import Image

    first, *others = [
        Image.fromarray(picture).quantize(128, dither=Image.Dither.NONE) for picture in pictures
    ]
    durations = [round(1e3 * period)] * (len(pictures) - 1) + [REST]
    first.save(file, save_all=True, append_images=others, duration=durations, loop=0)


def _pictured(food: FoodPicture | None) -> list[Part]:
    """The surface that a system of the user's own shows."""
    if food is None:
        return []
    colours = np.where(food.is_cut_face[:, None], food.flesh, food.skin).repeat(3, axis=0)
    points = food.triangles.reshape(-1, 3)
    mesh = ColouredMesh(points, np.arange(len(points)).reshape(-1, 3), colours)
    return [Part("food", mesh, food.X_WF)]


class _Drawn:
    """The food's parts as geometries in a scene graph's context."""

    def __init__(self, station: SimulatedStation, context: Context) -> None:
        self._scene_graph, self._context = station.scene_graph, context
        self._source = station.plant.get_source_id()
        self._known: dict[str, tuple[GeometryId, Part]] = {}

    def show(self, parts: Sequence[Part]) -> None:
        """Shows these parts and no others."""
        scene_graph, context, source = self._scene_graph, self._context, self._source
        for name in self._known.keys() - {part.name for part in parts}:
            scene_graph.RemoveGeometry(context, source, self._known.pop(name)[0])
        for part in parts:
            if part.name not in self._known:
                instance = GeometryInstance(RigidTransform(), _gltf(part), part.name)
                properties = PerceptionProperties()
                properties.AddProperty("label", "id", RenderLabel.kDontCare)
                instance.set_perception_properties(properties)
                found = scene_graph.RegisterGeometry(
                    context, source, scene_graph.world_frame_id(), instance
                )
            else:
                found, last = self._known[part.name]
                if part.mesh is not last.mesh or not part.X_WP.IsExactlyEqualTo(last.X_WP):
                    scene_graph.ChangeShape(context, source, found, _gltf(part))
            self._known[part.name] = found, part


def _gltf(part: Part) -> Mesh:
    """The surface in W as a glTF file in memory, shaded flat, with a colour at each corner."""
    mesh = part.mesh.seen_from(part.X_WP)
    corners = mesh.triangles.ravel()
    points = mesh.points[corners]
    a, b, c = points[0::3], points[1::3], points[2::3]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # A glTF's y points up.
    turned = [np.column_stack([v[:, 0], v[:, 2], -v[:, 1]]) for v in (points, normals.repeat(3, 0))]
    arrays = [np.ascontiguousarray(v, "<f4") for v in (*turned, mesh.colours[corners])]
    size = arrays[0].nbytes
    content = base64.b64encode(b"".join(v.tobytes() for v in arrays)).decode()
    names = ("POSITION", "NORMAL", "COLOR_0")
    text = json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [
                {
                    "primitives": [
                        {"attributes": dict(zip(names, range(3), strict=True)), "material": 0}
                    ]
                }
            ],
            "materials": [
                {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.7}}
            ],
            "buffers": [
                {
                    "byteLength": 3 * size,
                    "uri": "data:application/octet-stream;base64," + content,
                }
            ],
            "bufferViews": [
                {"buffer": 0, "byteOffset": k * size, "byteLength": size} for k in range(3)
            ],
            "accessors": [
                {
                    "bufferView": k,
                    "componentType": 5126,
                    "count": len(points),
                    "type": "VEC3",
                    "min": v.min(0).tolist(),
                    "max": v.max(0).tolist(),
                }
                for k, v in enumerate(arrays)
            ],
        }
    )
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".gltf", "food")))
