"""A still picture of knife and food, drawn without a display or a browser."""

import dataclasses as dc
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import Context

from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.station_interface import Station

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Snapshot", "add_picture", "take_snapshot"]

STEEL = (0.62, 0.66, 0.70)
SHOWN_LENGTH = 0.035


@dc.dataclass
class Snapshot:
    """Knife and food at one instant, in the food frame F.

    Attributes:
        time: s.
        depth: Of the edge below the top of the food, metres.
        triangles: Corners of the food's triangles [M, 3, 3], metres.
        is_cut_face: Whether each is on the cut [M].
        skin, flesh: Colours of the food outside and inside, red, green, blue.
        blade: Corners of the blade's faces, each [4, 3], metres.
    """

    time: float
    depth: float
    triangles: np.ndarray
    is_cut_face: np.ndarray
    skin: tuple[float, float, float]
    flesh: tuple[float, float, float]
    blade: list[np.ndarray]


def take_snapshot(station: Station, root_context: Context) -> Snapshot | None:
    """Knife and food in the context of the diagram; None for a food without a picture."""
    food = station.cutting.picture(station.cutting.GetMyContextFromRoot(root_context))
    if food is None:
        return None
    X_WK = station.GetOutputPort("knife_pose").Eval(station.GetMyContextFromRoot(root_context))
    X_FK = food.X_WF.inverse() @ X_WK
    return Snapshot(
        time=root_context.get_time(),
        depth=food.top - float(X_FK.translation()[2]),
        triangles=food.triangles,
        is_cut_face=food.is_cut_face,
        skin=food.skin,
        flesh=food.flesh,
        blade=[X_FK.multiply(face.T).T for face in _blade_faces(station.scenario.knife)],
    )


def _blade_faces(knife: Knife) -> list[np.ndarray]:
    """Flanks, spine and ends of the blade in K, in strips so that they sort by depth."""
    top = knife.tip_height + knife.height
    half, edge = 0.5 * knife.spine_thickness, 0.5 * knife.edge_thickness
    length = min(knife.length, 0.11)
    x = np.linspace(-0.5 * length, 0.5 * length, 23)
    heights = np.linspace(0.0, top, 13)
    faces = []
    for a, b in zip(x[:-1], x[1:], strict=True):
        for low, high in zip(heights[:-1], heights[1:], strict=True):
            for side in (-1.0, 1.0):
                y0, y1 = (side * (edge + (half - edge) * h / top) for h in (low, high))
                faces.append(
                    np.array([[a, y0, -low], [b, y0, -low], [b, y1, -high], [a, y1, -high]])
                )
        faces.append(
            np.array([[a, -half, -top], [b, -half, -top], [b, half, -top], [a, half, -top]])
        )
    for end in (x[0], x[-1]):
        faces.append(
            np.array([[end, -edge, 0], [end, edge, 0], [end, half, -top], [end, -half, -top]])
        )
    return faces


def add_picture(figure: "Figure", place: Any, picture: Snapshot | np.ndarray) -> None:
    """Adds a picture of knife and food to a figure.

    Args:
        figure: The figure.
        place: Its place in the grid of the figure.
        picture: A camera's picture [H, W, 3], or what matplotlib draws where there is no camera.
    """
    if isinstance(picture, Snapshot):
        axes = figure.add_subplot(place, projection="3d", computed_zorder=False)
        _draw_snapshot(axes, picture)
        return
    axes = figure.add_subplot(place)
    # Its middle, as high as it is wide.
    margin = (picture.shape[1] - picture.shape[0]) // 2
    axes.imshow(picture[:, margin : picture.shape[1] - margin])
    axes.set_axis_off()


def _draw_snapshot(axes: Any, snapshot: Snapshot) -> None:
    """Draws on matplotlib 3-D axes made with computed_zorder=False, millimetres, flat shading.

    Seen from the side y < 0: the far half, the blade and the near half are drawn in this order,
    which is exact because the cut plane parts them; matplotlib sorts faces only by their middles.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    triangles = snapshot.triangles.copy()
    triangles[..., 1] = np.clip(triangles[..., 1], -SHOWN_LENGTH, SHOWN_LENGTH)
    end = np.ptp(triangles[..., 1], axis=1) < 1e-6
    end &= np.abs(triangles[:, 0, 1]) > 0.99 * SHOWN_LENGTH
    flesh = snapshot.is_cut_face | end
    near = triangles[..., 1].mean(1) < 0.0
    inside, outside = snapshot.flesh, snapshot.skin
    layers: list[tuple[Sequence[np.ndarray], Sequence[tuple[float, float, float]]]] = [
        (triangles[~near], [inside if f else outside for f in flesh[~near]]),
        (snapshot.blade, [STEEL] * len(snapshot.blade)),
        (triangles[near], [inside if f else outside for f in flesh[near]]),
    ]
    light = np.array([0.45, -0.55, 0.75]) / np.linalg.norm([0.45, -0.55, 0.75])
    for order, (faces, base) in enumerate(layers):
        colours = []
        for face, colour in zip(faces, base, strict=True):
            normal = np.cross(face[1] - face[0], face[2] - face[0])
            size = np.linalg.norm(normal)
            shade = 0.6 + 0.5 * max(normal @ light, 0.0) / size if size > 0.0 else 1.0
            colours.append(np.clip(np.array(colour) * shade, 0.0, 1.0))
        axes.add_collection3d(
            Poly3DCollection(
                [1e3 * face for face in faces],
                facecolors=colours,
                edgecolors=colours,
                lw=0.3,
                zorder=order,
            )
        )
    axes.set_xlim(-45, 45)
    axes.set_ylim(-45, 45)
    axes.set_zlim(0, 80)
    axes.set_box_aspect((90, 90, 80), zoom=1.5)
    axes.view_init(elev=22.0, azim=-33.0)
    axes.set_axis_off()
    axes.set_title(f"edge {1e3 * snapshot.depth:.1f} mm below the top", fontsize=11, y=-0.04)
