"""Draws named coordinate frames in Meshcat, live and in a recording."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, LeafSystem

__all__ = ["FrameVisualizer", "draw_over_everything"]

AXIS_RADIUS = 0.02  # Over its length.
AXIS_COLOURS = ((0.85, 0.15, 0.15), (0.10, 0.60, 0.20), (0.15, 0.30, 0.90))

# Letters as strokes on a grid two wide and two high.
STROKES: dict[str, list[list[tuple[float, float]]]] = {
    "W": [[(0, 2), (0.5, 0), (1, 1.4), (1.5, 0), (2, 2)]],
    "B": [[(0, 0), (0, 2), (1.2, 2), (1.5, 1.75), (1.5, 1.3), (1.2, 1.05), (0, 1.05)]]
    + [[(1.2, 1.05), (1.6, 0.75), (1.6, 0.3), (1.2, 0), (0, 0)]],
    "S": [[(1.5, 1.7), (1.1, 2), (0.4, 2), (0, 1.7), (0, 1.3), (0.4, 1.05), (1.1, 0.95)]]
    + [[(1.1, 0.95), (1.5, 0.7), (1.5, 0.3), (1.1, 0), (0.4, 0), (0, 0.3)]],
    "K": [[(0, 0), (0, 2)], [(1.5, 2), (0, 0.9)], [(0.45, 1.2), (1.5, 0)]],
    "F": [[(0, 0), (0, 2), (1.5, 2)], [(0, 1.05), (1.1, 1.05)]],
}
STROKE_WIDTH = 0.3


class FrameVisualizer(LeafSystem):
    """Publishes triads (x red, y green, z blue) with the letter of each frame at its origin.

    They are drawn over everything, also from inside of the food, and hidden at first: Meshcat's
    tree shows them, each at frames/LETTER. An I/O system: what is drawn lies in the Meshcat
    instance.

    Input ports:
        knife_pose: RigidTransform X_WK.

    Args:
        meshcat: Viewer.
        fixed: Pose X_WP and length of the axes, metres, of each frame fixed in W, by letter.
        carried: Pose X_KP and length, of each frame that moves with the knife.
        X_WK: Pose of the knife at the start, where its letters face the viewer.
        towards_viewer: Horizontal direction in which letters face [3], in W.
        period: Time between frames, s.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        fixed: Mapping[str, tuple[RigidTransform, float]],
        carried: Mapping[str, tuple[RigidTransform, float]],
        X_WK: RigidTransform,
        towards_viewer: np.ndarray,
        period: float,
    ) -> None:
        super().__init__()
        self._meshcat = meshcat
        self._carried = {f"/frames/{letter}": X_KP for letter, (X_KP, _) in carried.items()}
        self._pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        at_start = dict(fixed) | {k: (X_WK @ X_KP, length) for k, (X_KP, length) in carried.items()}
        for letter, (X_WP, length) in at_start.items():
            path = f"/frames/{letter}"
            _draw_triad(meshcat, path, length)
            _draw_letter(meshcat, path, letter, X_WP, towards_viewer, length)
            meshcat.SetTransform(path, X_WP)
        meshcat.SetProperty("/frames", "visible", False)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> None:
        X_WK = self._pose.Eval(context)
        for path, X_KP in self._carried.items():
            self._meshcat.SetTransform(path, X_WK @ X_KP, context.get_time())


def draw_over_everything(meshcat: Meshcat, path: str, order: int = 1) -> None:
    """Makes the object at a path visible also from inside and behind others of lower order."""
    meshcat.SetProperty(f"{path}/<object>", "material.depthTest", False)
    meshcat.SetProperty(f"{path}/<object>", "renderOrder", float(order))


def _draw_triad(meshcat: Meshcat, path: str, length: float) -> None:
    turns = (RotationMatrix.MakeYRotation(np.pi / 2), RotationMatrix.MakeXRotation(-np.pi / 2))
    for k, (R, colour) in enumerate(zip((*turns, RotationMatrix()), AXIS_COLOURS, strict=True)):
        axis = f"{path}/{'xyz'[k]}"
        meshcat.SetObject(axis, Cylinder(AXIS_RADIUS * length, length), Rgba(*colour))
        meshcat.SetTransform(axis, RigidTransform(R, 0.5 * length * np.eye(3)[k]))
        draw_over_everything(meshcat, axis)


def _draw_letter(
    meshcat: Meshcat,
    path: str,
    letter: str,
    X_WP: RigidTransform,
    towards_viewer: np.ndarray,
    length: float,
) -> None:
    """Draws flat strokes that face the viewer, near the origin where no axis is."""
    corners: list[np.ndarray] = []
    triangles: list[tuple[int, int, int]] = []
    for stroke in STROKES[letter]:
        points = np.array(stroke, float)
        for a, b in zip(points[:-1], points[1:], strict=True):
            along = (b - a) / np.linalg.norm(b - a) * 0.5 * STROKE_WIDTH
            across = np.array([-along[1], along[0]])
            first = len(corners)
            corners += [a - along - across, b + along - across, b + along + across]
            corners += [a - along + across]
            triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    flat = np.array(corners) - [0.8, 1.0]
    up = np.array([0.0, 0.0, 1.0])
    facing = towards_viewer / np.linalg.norm(towards_viewer)
    size = 0.11 * length
    right = np.cross(up, facing)
    p_W = size * (flat[:, :1] * right + flat[:, 1:] * up) + 0.13 * length * right
    p_P = p_W @ X_WP.rotation().matrix() - 0.18 * length
    meshcat.SetTriangleMesh(
        f"{path}/name",
        np.asfortranarray(p_P.T),
        np.asfortranarray(np.array(triangles).T, dtype=np.int32),
        Rgba(0.1, 0.1, 0.1),
    )
    draw_over_everything(meshcat, f"{path}/name")
