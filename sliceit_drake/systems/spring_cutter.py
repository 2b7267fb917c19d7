"""The spring-only baseline of SliceIt!: the food is a button on a spring, and nothing is cut."""

import math

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, State

from sliceit_drake.cutting.foods.spring_food import SpringFood
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.systems.cut_report import FoodPicture
from sliceit_drake.systems.food_look import LOOKS
from sliceit_drake.systems.knife_force import KnifeForceSystem

__all__ = ["SpringCutter", "SpringVisualizer"]

PLATES = 8
THICKNESS = 1.5e-3
SPRING = Rgba(0.24, 0.52, 0.20, 0.45)
BUTTON = Rgba(0.24, 0.52, 0.20, 1.0)


class SpringCutter(KnifeForceSystem):
    """The knife on the button; see `KnifeForceSystem` and `SpringFood`.

    The edge pushes at its point nearest to the button's axis, as far as the button reaches, and
    never pulls; a rising knife leaves the button behind, which follows at the spring's own pace.
    Within a coupling step the edge goes straight from its last pose to this one in steps of at most
    `time_step`, and the button by backward Euler as in ODE, its contact solved exactly: stable at
    any stiffness, with half a step times the stiffness of damping on top. An impact is without
    rebound: the button's momentum goes into one step.
    `cut_progress` is the largest compression so far over the travel.

    Further output port:
        compression: Compression of the button, m, and its rate, m/s [2].

    Args:
        food: The spring.
        knife: The knife whose edge pushes.
        X_WF: Pose of the food frame: the button's axis is Fz, the board is at its origin.
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(
        self,
        food: SpringFood,
        knife: Knife,
        X_WF: RigidTransform,
        exchange_period: float,
    ) -> None:
        super().__init__(exchange_period)
        self.food = food
        self._X_WF = X_WF
        self._half_edge = 0.5 * knife.length
        self._p_WT = X_WF.translation() + [0.0, 0.0, food.height]
        self._steps = math.ceil(exchange_period / food.time_step - 1e-9)
        self._button = self.DeclareDiscreteState(2)
        self._spring = self.DeclareNumericParameter(BasicVector([food.stiffness, food.damping]))
        self.DeclareStateOutputPort("compression", self._button)

    def add_visualizer(self, builder: DiagramBuilder, meshcat: Meshcat, period: float) -> None:
        plates = builder.AddNamedSystem(
            "spring_visualizer", SpringVisualizer(self.food, self._X_WF, meshcat, period)
        )
        builder.Connect(self.GetOutputPort("compression"), plates.GetInputPort("compression"))

    def picture(self, context: Context) -> FoodPicture:
        """A drum between board and button."""
        height = self.food.height - context.get_discrete_state(self._button).value()[0]
        angle = np.linspace(0.0, 2.0 * np.pi, 33)
        rim = (
            0.5 * self.food.diameter * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
        )
        low, top = rim, rim + [0.0, 0.0, height]
        middle = np.broadcast_to([0.0, 0.0, height], low[1:].shape)
        sides = [
            (low[:-1], low[1:], top[1:]),
            (low[:-1], top[1:], top[:-1]),
            (top[:-1], top[1:], middle),
        ]
        triangles = np.concatenate([np.stack(corners, axis=1) for corners in sides])
        is_top = np.arange(len(triangles)) >= 2 * len(middle)
        look = LOOKS["cucumber"]
        return FoodPicture(self._X_WF, triangles, is_top, look.flesh, look.skin)

    def spring(self, context: Context) -> tuple[float, float]:
        """Stiffness, N/m, and damping, Ns/m, in this context."""
        stiffness, damping = context.get_numeric_parameter(self._spring).value().tolist()
        return stiffness, damping

    def SetSpring(self, context: Context, stiffness: float, damping: float) -> None:
        """Puts a released button with another spring into the context; N/m and Ns/m."""
        context.get_mutable_numeric_parameter(self._spring).SetFromVector([stiffness, damping])
        self.set_to_zero(context, self._button)

    def randomize_context(self, context: Context, rng: np.random.Generator) -> None:
        """Puts a released button into the context, ERP drawn within `erp_noise` at constant CFM.

        A relative noise: ODE's default ERP of 0.2 less an absolute 0.3 would be no spring.
        """
        food = self.food
        erp = food.erp() * (1.0 + food.erp_noise * rng.uniform(-1.0, 1.0))
        drawn = food.with_erp_cfm(erp, food.cfm())
        self.SetSpring(context, drawn.stiffness, drawn.damping)

    def start(self, context: Context, state: State, X_WK: RigidTransform) -> None:
        depth, _ = self._contact(X_WK.GetAsMatrix34())
        self._set(state, self._button, [max(depth, 0.0), 0.0])

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform
    ) -> tuple[np.ndarray, float]:
        stiffness, damping = self.spring(context)
        mass, h = self.food.mass, self.exchange_period / self._steps
        compression, rate = context.get_discrete_state(self._button).value().tolist()
        begin, _ = self._contact(self.last_pose(context))
        end, arm = self._contact(X_WK.GetAsMatrix34())
        impulse = 0.0
        deepest = self.progress(context)
        for k in range(1, self._steps + 1):
            # An edge that was beside the button has no depth to come from.
            edge = end if begin == -math.inf else begin + (end - begin) * k / self._steps
            edge = min(edge, self.food.height)
            free = (mass * rate - h * stiffness * compression) / (
                mass + h * damping + h * h * stiffness
            )
            reached = max(compression + h * free, 0.0)
            pushed = edge > reached
            if pushed:
                reached = edge
            new_rate = (reached - compression) / h
            if pushed:
                push = stiffness * reached + damping * new_rate + mass * (new_rate - rate) / h
                impulse += push * h
            # The stop at the top takes the button's momentum.
            compression, rate = reached, new_rate if reached > 0.0 else 0.0
            deepest = max(deepest, compression / self.food.height)
        self._set(state, self._button, [compression, rate])
        force = impulse / self.exchange_period
        moment_x, moment_y = arm[1] * force, -arm[0] * force
        return np.array([moment_x, moment_y, 0.0, 0.0, 0.0, force]), min(deepest, 1.0)

    def _contact(self, X_WK: np.ndarray) -> tuple[float, tuple[float, float]]:
        """Depth of the edge below the button's released top, metres, and the arm from Ko to it.

        Returns:
            Depth, -inf where the edge passes beside the button, and the arm along Wx and Wy.
        """
        ax, ay, az = X_WK[:, 0].tolist()
        dx, dy, dz = (self._p_WT - X_WK[:, 3]).tolist()
        level = ax * ax + ay * ay
        s = (ax * dx + ay * dy) / level if level > 0.0 else 0.0
        s = min(max(s, -self._half_edge), self._half_edge)
        if math.hypot(dx - s * ax, dy - s * ay) > 0.5 * self.food.diameter:
            return -math.inf, (s * ax, s * ay)
        return dz - s * az, (s * ax, s * ay)


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
    """

    def __init__(
        self, food: SpringFood, X_WF: RigidTransform, meshcat: Meshcat, period: float
    ) -> None:
        super().__init__()
        self._height = food.height
        self._X_WF = X_WF
        self._meshcat = meshcat
        self._paths = [f"/drake/food/plate_{k}" for k in range(1, PLATES + 1)]
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
