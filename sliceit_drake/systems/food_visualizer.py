"""Draws the deforming food and its slices in Meshcat, live and in a recording."""

import dataclasses as dc
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from sliceit_drake.cutting.mesh.surface import FoodSurface
from sliceit_drake.systems.food_look import ColouredMesh, FoodScene
from sliceit_drake.systems.loose_slices import SLICE_ROW

__all__ = ["FoodVisualizer", "frame_size"]

PATH = "/drake/food"


def frame_size(surfaces: Sequence[FoodSurface]) -> float:
    """Bytes that one frame takes in a replay, of the largest of the surfaces."""
    # Positions and colours of vertices and corners of triangles, 4 bytes each, in base 64.
    return max(
        sum(24 * len(corners) + 12 * len(triangles) for corners, triangles in surface.halves)
        for surface in surfaces
    ) * (4.0 / 3.0)


@dc.dataclass
class _Kept:
    """What a recording shows at a path from one frame on, until another where it is not None."""

    path: str
    begin: float
    end: float | None = None


class FoodVisualizer(LeafSystem):
    """Publishes the food's surface at a fixed rate: skin, and cut faces coloured by their damage.

    The halves on the two sides of the cut are drake/food/minus and drake/food/plus: hiding one in
    Meshcat's tree shows the cut face of the other. A slice that is off is `slice_01` and so on; it
    keeps the shape that it had when it came off.

    Meshcat's recordings animate transforms and properties, not vertices, so while a recording is on
    each frame of a half is a mesh of its own that is visible for one frame. An I/O system: what is
    drawn lies in the Meshcat instance.

    Input ports:
        surface_vertices: The port of the `CuttingSystem` [3 V], metres, in W.
        surface_damage: The port of the `CuttingSystem` [V].
        food_index: The port of the `CuttingSystem` [1].
        slice_pose: The port of the `CuttingSystem`, X_WS.
        slices: The port of `LooseSlices` [14 N]; optional.

    Args:
        scene: The food's parts.
        corners: Most corners that a surface of it has.
        slices: Slices that may come off.
        meshcat: Viewer.
        period: Time between frames, s.
    """

    def __init__(
        self,
        scene: FoodScene,
        corners: int,
        slices: int,
        meshcat: Meshcat,
        period: float,
    ) -> None:
        super().__init__()
        self._scene, self._meshcat = scene, meshcat
        self.DeclareVectorInputPort("surface_vertices", 3 * corners)
        self.DeclareVectorInputPort("surface_damage", corners)
        self.DeclareVectorInputPort("food_index", 1)
        self.DeclareAbstractInputPort("slice_pose", Value(RigidTransform()))
        self.DeclareVectorInputPort("slices", SLICE_ROW * slices)
        self._recording = False
        self._kept: dict[str, _Kept] = {}
        self._past: list[_Kept] = []
        self._shown: set[str] = set()
        self._frame = 0
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def StartRecording(self) -> None:
        """Keeps every frame from now on, for `Meshcat.StaticHtml`."""
        self._recording = True
        self._kept, self._past, self._shown, self._frame = {}, [], set(), 0
        self._meshcat.Delete(PATH)

    def PublishRecording(self) -> None:
        """Writes when each kept mesh is visible into the recording, and stops keeping them."""
        animation = self._meshcat.get_mutable_recording()
        for kept in [*self._past, *self._kept.values()]:
            begin = animation.frame(kept.begin)
            if begin > 0:
                animation.SetProperty(0, kept.path, "visible", False)
            animation.SetProperty(begin, kept.path, "visible", True)
            if kept.end is not None:
                animation.SetProperty(animation.frame(kept.end), kept.path, "visible", False)
        self._recording = False

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()

        def port(name: str) -> Any:
            found = self.GetInputPort(name)
            return found.Eval(context) if found.HasValue(context) else np.zeros(0)

        parts = self._scene.parts(port)
        for gone in self._shown - {part.name for part in parts}:
            self._end(gone, time)
        for part in parts:
            deforms = not part.name.startswith("slice")
            if deforms or part.name not in self._shown:
                self._draw(part.name, part.mesh, time)
            if not deforms:
                path = f"{PATH}/{part.name}"
                self._meshcat.SetTransform(path, part.X_WP, time if self._recording else None)
        self._shown = {part.name for part in parts}
        self._frame += 1
        return EventStatus.Succeeded()

    def _draw(self, name: str, mesh: ColouredMesh, time: float) -> None:
        path = f"{PATH}/{name}"
        if self._recording:
            self._end(name, time)
            path += f"/frame_{self._frame:04d}"
            self._kept[name] = _Kept(path, time)
        self._meshcat.SetTriangleColorMesh(
            path,
            np.asfortranarray(mesh.points.T),
            np.asfortranarray(mesh.triangles.T, dtype=np.int32),
            np.asfortranarray(mesh.colours.T),
        )

    def _end(self, name: str, time: float) -> None:
        """Takes away what is shown of a part."""
        if not self._recording:
            self._meshcat.Delete(f"{PATH}/{name}")
        elif name in self._kept:
            kept = self._kept.pop(name)
            self._past.append(dc.replace(kept, end=time))
            # A live viewer shows the newest frame alone.
            self._meshcat.SetProperty(kept.path, "visible", False)
