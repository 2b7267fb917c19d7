"""Draws the button on its spring in Meshcat, live and in a recording."""

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from sliceit_drake.cutting.foods.spring_food import SpringFood

__all__ = ["SpringVisualizer"]

PLATES = 8
THICKNESS = 1.5e-3
SPRING = Rgba(0.24, 0.52, 0.20, 0.45)
BUTTON = Rgba(0.24, 0.52, 0.20, 1.0)


class SpringVisualizer(LeafSystem):
    """Publishes a stack of plates between board and button that closes as the spring is compressed.

    An I/O system: what is drawn lies in the Meshcat instance.

    Input port:
        compression: The port of the `SpringCutter` [2], m and m/s.

    Args:
        food: The spring.
        X_WF: Pose of the food frame.
        meshcat: Viewer.
        period: Time between frames, s.
        path: Path in Meshcat's tree.
    """

    def __init__(
        self,
        food: SpringFood,
        X_WF: RigidTransform,
        meshcat: Meshcat,
        period: float,
        path: str = "/drake/food",
    ) -> None:
        super().__init__()
        self._height = food.height
        self._X_WF = X_WF
        self._meshcat = meshcat
        self._paths = [f"{path}/plate_{k}" for k in range(1, PLATES + 1)]
        for plate in self._paths:
            colour = BUTTON if plate is self._paths[-1] else SPRING
            meshcat.SetObject(plate, Cylinder(0.5 * food.diameter, THICKNESS), colour)
        self._compression = self.DeclareVectorInputPort("compression", 2)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> None:
        top = self._height - self._compression.Eval(context)[0]
        heights = np.arange(1, PLATES + 1) * top / PLATES - 0.5 * THICKNESS
        for plate, z in zip(self._paths, heights, strict=True):
            X_WP = self._X_WF @ RigidTransform([0.0, 0.0, z])
            self._meshcat.SetTransform(plate, X_WP, context.get_time())
