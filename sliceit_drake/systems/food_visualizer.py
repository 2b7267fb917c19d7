"""Draws the deforming food in Meshcat, live and in a recording."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, LeafSystem

from sliceit_drake.cutting.mesh.surface import FoodSurface

__all__ = ["FLESH", "INTACT", "SKIN", "FoodVisualizer", "damage_colours", "frame_size"]

SKIN = (0.24, 0.52, 0.20)
FLESH = (0.84, 0.91, 0.68)
INTACT = (0.42, 0.09, 0.36)
HALF_CUT = (0.93, 0.47, 0.22)

PATH = "/drake/food"
HALVES = ("minus", "plus")


def damage_colours(damage: np.ndarray) -> np.ndarray:
    """Colours of the cut surface [3, V]: plum where intact, orange half cut, pale where cut.

    Brightness rises all the way, so that the map is readable in greyscale and colour blindness.

    Args:
        damage: Fraction of the toughness that is spent [V], 0 to 1.
    """
    stops = np.array([INTACT, HALF_CUT, FLESH])
    return np.array([np.interp(damage, (0.0, 0.5, 1.0), channel) for channel in stops.T])


def frame_size(surfaces: Sequence[FoodSurface]) -> float:
    """Bytes that one frame takes in a replay, of the largest of the surfaces."""
    # Positions and colours of vertices and corners of triangles, 4 bytes each, in base 64.
    return max(
        sum(24 * len(corners) + 12 * len(triangles) for corners, triangles in surface.halves)
        for surface in surfaces
    ) * (4.0 / 3.0)


class FoodVisualizer(LeafSystem):
    """Publishes the food's surface at a fixed rate: skin, and cut faces coloured by their damage.

    The halves on the two sides of the cut are drake/food/minus and drake/food/plus: hiding one in
    Meshcat's tree shows the cut face of the other.

    Meshcat's recordings animate transforms and properties, not vertices, so while a recording is on
    each frame is a mesh of its own that is visible for one frame. An I/O system: what is drawn lies
    in the Meshcat instance.

    Where one food follows another, the slice that was cut off, the minus half of the last food,
    stays as it was last seen; not where the next food comes to its place.

    Input ports:
        surface_vertices: The port of the `CuttingSystem` [3 V], metres, in W.
        surface_damage: The port of the `CuttingSystem` [V].
        food_index: The port of the `CuttingSystem` [1].

    Args:
        surfaces: Surfaces of the prepared foods.
        slices_stay: Whether each food lies beside the one before it.
        meshcat: Viewer.
        period: Time between frames, s.
    """

    def __init__(
        self, surfaces: Sequence[FoodSurface], slices_stay: bool, meshcat: Meshcat, period: float
    ) -> None:
        super().__init__()
        self._surfaces, self._slices_stay = tuple(surfaces), slices_stay
        self._meshcat = meshcat
        size = max(len(surface.ends) for surface in surfaces)
        self._vertices = self.DeclareVectorInputPort("surface_vertices", 3 * size)
        self._damage = self.DeclareVectorInputPort("surface_damage", size)
        self._food_index = self.DeclareVectorInputPort("food_index", 1)
        self._recording = False
        self._frames: list[float] = []
        self._foods: list[int] = []
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def StartRecording(self) -> None:
        """Keeps every frame from now on, for `Meshcat.StaticHtml`."""
        self._recording = True
        self._frames, self._foods = [], []
        self._meshcat.Delete(PATH)

    def PublishRecording(self) -> None:
        """Writes when each kept frame is visible into the recording, and stops keeping them."""
        animation = self._meshcat.get_mutable_recording()
        for k, time in enumerate(self._frames):
            frame = animation.frame(time)
            for half in HALVES:
                path = self._frame_path(half, k)
                animation.SetProperty(0, path, "visible", k == 0)
                animation.SetProperty(frame, path, "visible", True)
                if k + 1 < len(self._frames) and not self._stays(half, k):
                    end = animation.frame(self._frames[k + 1])
                    animation.SetProperty(end, path, "visible", False)
        self._recording = False

    def _frame_path(self, half: str, k: int) -> str:
        return f"{PATH}/{half}/frame_{k:04d}"

    def _live_path(self, half: str, food: int) -> str:
        slices = half == "minus" and self._slices_stay
        return f"{PATH}/{half}" + (f"/slice_{food + 1:02d}" if slices else "")

    def _stays(self, half: str, k: int) -> bool:
        """Whether frame `k` shows a slice that has been cut off by frame k + 1."""
        return half == "minus" and self._slices_stay and self._foods[k + 1] > self._foods[k]

    def _publish(self, context: Context) -> None:
        vertices = self._vertices.Eval(context).reshape(-1, 3)
        food = int(self._food_index.Eval(context)[0])
        surface = self._surfaces[food]
        damage = self._damage.Eval(context)[: len(surface.ends)]
        skin = np.array(SKIN)[:, None]
        colours = np.where(surface.is_cut_face, damage_colours(damage), skin)
        k = len(self._frames)
        if self._recording:
            self._frames.append(context.get_time())
            self._foods.append(food)
        for half, (corners, triangles) in zip(HALVES, surface.halves, strict=True):
            path = self._frame_path(half, k) if self._recording else self._live_path(half, food)
            self._meshcat.SetTriangleColorMesh(
                path,
                np.asfortranarray(vertices[corners].T),
                np.asfortranarray(triangles.T, dtype=np.int32),
                np.asfortranarray(colours[:, corners]),
            )
            if self._recording and k > 0 and not self._stays(half, k - 1):
                # A live viewer shows the newest frame alone.
                self._meshcat.SetProperty(self._frame_path(half, k - 1), "visible", False)
