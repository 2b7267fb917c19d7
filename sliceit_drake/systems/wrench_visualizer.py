"""Draws the forces and moments on the knife in Meshcat, live and in a recording."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, LeafSystem

from sliceit_drake.systems.frame_visualizer import draw_over_everything

__all__ = ["NEWTONS_PER_METRE", "NEWTON_METRES_PER_METRE", "WrenchVisualizer"]

SHAFT_RADIUS = 0.0015
HEAD_RADIUS = 0.0042
HEAD_LENGTH = 0.012

NEWTONS_PER_METRE = 200.0
"""Force of an arrow of one metre, N/m."""
NEWTON_METRES_PER_METRE = 20.0
"""Moment of an arrow of one metre, N."""
MIN_FORCE, MIN_MOMENT = 0.2, 0.1
"""What is too small to draw, N and Nm."""

# From the palette of Okabe and Ito, distinct in colour blindness; moments are lighter.
COLOURS = {
    "food": (0.00, 0.45, 0.70),
    "board": (0.84, 0.37, 0.00),
    "sensor": (0.60, 0.25, 0.55),
}


class _Arrow:
    """One arrow from the origin of a path; its length changes by properties alone.

    That of a moment has two heads. It is drawn over arrows of lower order.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        path: str,
        colour: tuple[float, float, float],
        heads: int,
        order: int,
    ) -> None:
        self._meshcat = meshcat
        self._path = path
        self._heads = [f"{path}/head_{k}" for k in range(heads)]
        rgba = Rgba(*colour)
        meshcat.SetObject(f"{path}/shaft", Cylinder(SHAFT_RADIUS, 1.0), rgba)
        draw_over_everything(meshcat, f"{path}/shaft", order)
        cone = MeshcatCone(HEAD_LENGTH, HEAD_RADIUS, HEAD_RADIUS)
        upside_down = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
        for head in self._heads:
            # Meshcat's cones stand on their tips.
            meshcat.SetObject(f"{head}/cone", cone, rgba)
            meshcat.SetTransform(f"{head}/cone", RigidTransform(upside_down))
            draw_over_everything(meshcat, f"{head}/cone", order)
        meshcat.SetProperty(path, "visible", False)

    def set(self, point: np.ndarray, vector: np.ndarray, least: float, time: float) -> None:
        """Draws a vector [3], metres, in W from a point [3]; hidden if shorter than `least`."""
        meshcat = self._meshcat
        length = float(np.linalg.norm(vector))
        shown = length >= least
        meshcat.SetProperty(self._path, "visible", shown, time)
        if not shown:
            return
        R = RotationMatrix.MakeFromOneVector(vector, axis_index=2)
        meshcat.SetTransform(self._path, RigidTransform(R, point), time)
        # A short arrow has a smaller head.
        size = min(1.0, 0.5 * length / HEAD_LENGTH)
        shaft = length - size * HEAD_LENGTH
        meshcat.SetProperty(f"{self._path}/shaft", "position", [0.0, 0.0, 0.5 * shaft], time)
        meshcat.SetProperty(f"{self._path}/shaft", "scale", [size, size, shaft], time)
        for k, head in enumerate(self._heads):
            tip = length - 0.7 * k * size * HEAD_LENGTH
            meshcat.SetProperty(head, "position", [0.0, 0.0, tip], time)
            meshcat.SetProperty(head, "scale", [size, size, size], time)


class WrenchVisualizer(LeafSystem):
    """Publishes the wrenches on knife and sensor as arrows: one head a force, two a moment.

    Forces of food (blue) and board (orange) start at Ko and are those on the knife; the sensor's
    (purple) start at So; moments are about these points, lighter. All are drawn over everything,
    for Ko lies inside of the food. Arrows change by transforms and properties, so that recordings
    animate them. An I/O system: what is drawn lies in the Meshcat instance. Hide what you do not
    want in Meshcat's tree: wrench/food, wrench/board, wrench/sensor, each with force and moment.

    Input ports:
        knife_pose: RigidTransform X_WK.
        food_wrench: SpatialForce at Ko, in W.
        board_wrench: SpatialForce at Ko, in W.
        sensor_wrench: SpatialForce at So, in S.

    Args:
        meshcat: Viewer.
        X_KS: Pose of the sensor's frame in the knife's.
        period: Time between frames, s.
    """

    def __init__(self, meshcat: Meshcat, X_KS: RigidTransform, period: float) -> None:
        super().__init__()
        self._X_KS = X_KS
        self._pose = self.DeclareAbstractInputPort("knife_pose", Value(RigidTransform()))
        self._wrenches = {
            name: self.DeclareAbstractInputPort(f"{name}_wrench", Value(SpatialForce.Zero()))
            for name in COLOURS
        }
        self._arrows = {}
        # The arrow of the board over the food's, which is longer and starts where it does.
        for order, (name, colour) in enumerate(COLOURS.items(), start=2):
            light = (0.5 + 0.5 * colour[0], 0.5 + 0.5 * colour[1], 0.5 + 0.5 * colour[2])
            self._arrows[name] = (
                _Arrow(meshcat, f"/wrench/{name}/force", colour, 1, order),
                _Arrow(meshcat, f"/wrench/{name}/moment", light, 2, order),
            )
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> None:
        X_WK = self._pose.Eval(context)
        time = context.get_time()
        for name, (force, moment) in self._arrows.items():
            wrench = self._wrenches[name].Eval(context)
            f, m, point = wrench.translational(), wrench.rotational(), X_WK.translation()
            if name == "sensor":
                X_WS = X_WK @ self._X_KS
                f, m = X_WS.rotation() @ f, X_WS.rotation() @ m
                point = X_WS.translation()
            force.set(point, f / NEWTONS_PER_METRE, MIN_FORCE / NEWTONS_PER_METRE, time)
            least = MIN_MOMENT / NEWTON_METRES_PER_METRE
            moment.set(point, m / NEWTON_METRES_PER_METRE, least, time)
