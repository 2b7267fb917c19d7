"""Draws the deforming food in Meshcat, live and in a recording."""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from sliceit_drake.systems.cutting_system import CuttingSystem

__all__ = ["FoodVisualizer"]

SKIN = (0.24, 0.52, 0.20)
FLESH = (0.84, 0.91, 0.68)


class FoodVisualizer(LeafSystem):
    """Publishes the food's surface at a fixed rate.

    Meshcat's recordings animate transforms and properties, not vertices, so while a recording is on
    each frame is a mesh of its own that is visible for one frame. An I/O system: what is drawn lies
    in the Meshcat instance.

    Input ports:
        surface_vertices: Of the `CuttingSystem` [3 V], metres, in W.
        food_index: Of the `CuttingSystem` [1].

    Args:
        cutting: Where the triangles come from.
        meshcat: Viewer.
        period: Between frames, s.
        path: In Meshcat's tree.
    """

    def __init__(
        self, cutting: CuttingSystem, meshcat: Meshcat, period: float, path: str = "/drake/food"
    ) -> None:
        super().__init__()
        self._cutting = cutting
        self._meshcat = meshcat
        self._path = path
        size = cutting.GetOutputPort("surface_vertices").size()
        self._vertices = self.DeclareVectorInputPort("surface_vertices", size)
        self._food_index = self.DeclareVectorInputPort("food_index", 1)
        self._recording = False
        self._frames: list[float] = []
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def StartRecording(self) -> None:
        """Keeps every frame from now on, for `Meshcat.StaticHtml`."""
        self._recording = True
        self._frames = []
        self._meshcat.Delete(self._path)

    def PublishRecording(self) -> None:
        """Writes when each kept frame is visible into the recording, and stops keeping them."""
        animation = self._meshcat.get_mutable_recording()
        for k, time in enumerate(self._frames):
            path = self._frame_path(k)
            frame = animation.frame(time)
            animation.SetProperty(0, path, "visible", k == 0)
            animation.SetProperty(frame, path, "visible", True)
            if k + 1 < len(self._frames):
                animation.SetProperty(animation.frame(self._frames[k + 1]), path, "visible", False)
        self._recording = False

    def _frame_path(self, k: int) -> str:
        return f"{self._path}/frame_{k:04d}"

    def _publish(self, context: Context) -> EventStatus:
        values = self._vertices.Eval(context).reshape(-1, 3)
        surface = self._cutting.surfaces[int(self._food_index.Eval(context)[0])]
        path = self._path
        if self._recording:
            path = self._frame_path(len(self._frames))
            self._frames.append(context.get_time())
        vertices = np.ascontiguousarray(values[: len(surface.ends)].T)
        colours = np.where(surface.is_cut_face, np.array(FLESH)[:, None], np.array(SKIN)[:, None])
        self._meshcat.SetTriangleColorMesh(
            path, vertices, surface.triangles.T.astype(np.int32), colours
        )
        return EventStatus.Succeeded()
