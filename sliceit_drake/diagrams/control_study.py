"""Stability of compliance control against a stiff contact: the linear loop of one axis.

Each cycle the compliance controller starts at the measured position x and, with the force f that
the
sensor reported, takes one virtual step: q = x + v h, v <- 0.9 (v + g s p (K (target - T) + f) h),
with T the position after its last step, h the virtual step, g the mobility of the virtual model
along the axis and s p the error scale times the gain. The servo follows q with its lag, and the
contact answers f = -k x one exchange later. The loop is stable if the map of one cycle has no
eigenvalue outside the unit circle.
"""

import copy
import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, State
from pydrake.systems.primitives import LogVectorOutput
from scipy.linalg import expm

from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.station import MakeSlicingStation, SlicingStation
from sliceit_drake.systems.analytic_cutter import AnalyticFood
from sliceit_drake.systems.compliance_controller import (
    ComplianceControllerConfig,
    make_virtual_model,
)
from sliceit_drake.systems.knife_force import KnifeForceSystem
from sliceit_drake.systems.servo import ServoConfig
from sliceit_drake.systems.ur5e_kinematics import ur5e_chain

__all__ = [
    "ContactLoop",
    "SpringContact",
    "contact_stiffness_limit",
    "plot_stability_map",
    "servo_with_lag",
    "station_growth",
    "vertical_mobility",
]

GREATEST_STIFFNESS = 1e7
MOBILITY = 0.767
"""1/kg, of the virtual UR5e along the vertical at SliceIt!'s start (Scherzinger's J H^-1 J^T)."""


def servo_with_lag(lag: float) -> ServoConfig | None:
    """A critically damped servo with the given lag, s; None for perfect tracking."""
    return None if lag == 0.0 else ServoConfig(lookahead_time=lag, gain=4.0 / lag**2)


@dc.dataclass
class ContactLoop:
    """One axis in contact.

    Attributes:
        scaled_gain: Error scale times P gain.
        stiffness: Of the compliance spring, N/m.
        servo: The joint servo; None for perfect tracking.
        mobility: Of the virtual model along the axis, 1/kg.
        plant_steps: Of the plant in a cycle.
    """

    scaled_gain: float
    stiffness: float = 500.0
    servo: ServoConfig | None = None
    mobility: float = MOBILITY
    plant_steps: int = 2

    def cycle(self, contact_stiffness: float) -> np.ndarray:
        """Matrix of one cycle on (x, x', command, v, T, last x) [6, 6].

        Args:
            contact_stiffness: k, N/m.
        """
        config = ComplianceControllerConfig()
        h, damping = config.virtual_time_step, config.damping_factor
        x, rate, command, v, T, last = np.eye(6)
        error = -self.stiffness * T - contact_stiffness * last
        new_command = x + h * v
        new_v = damping * (v + h * self.mobility * self.scaled_gain * error)
        follow = self._servo_step(config.period / self.plant_steps)
        measured = x
        for step in range(self.plant_steps):
            # Servo and controller update at one instant, so the first step has the old command.
            target = command if step == 0 else new_command
            if follow is None:
                x, rate = target, rate * 0.0
            else:
                x, rate = (row[0] * x + row[1] * rate + row[2] * target for row in follow)
        return np.array([x, rate, new_command, new_v, new_command, measured])

    def _servo_step(self, period: float) -> np.ndarray | None:
        """Rows of (x, x') after `period` in terms of (x, x', target) [2, 3]."""
        if self.servo is None:
            return None
        g, T = self.servo.gain, self.servo.lookahead_time
        A = np.array([[0.0, 1.0, 0.0], [-g, -g * T, g], [0.0, 0.0, 0.0]])
        return expm(A * period)[:2]

    def growth(self, contact_stiffness: float) -> float:
        """Largest magnitude of an eigenvalue of one cycle; the loop is stable below 1."""
        return float(np.abs(np.linalg.eigvals(self.cycle(contact_stiffness))).max())


def contact_stiffness_limit(loop: ContactLoop) -> float:
    """Contact stiffness above which the loop is unstable, N/m; 0 if it is in free air."""
    low, high = 0.0, GREATEST_STIFFNESS
    if loop.growth(low) >= 1.0:
        return 0.0
    if loop.growth(high) < 1.0:
        return high
    while high > 1.001 * low + 1e-6:
        middle = np.sqrt(max(low, 1.0) * high)
        low, high = (middle, high) if loop.growth(middle) < 1.0 else (low, middle)
    return float(low)


class SpringContact(KnifeForceSystem):
    """A linear spring on the knife along Wz: the contact of the linear loop."""

    def __init__(
        self, stiffness: float, height: float, knife_body: BodyIndex, exchange_period: float
    ) -> None:
        super().__init__(knife_body, exchange_period)
        self._stiffness = stiffness
        self._height = height

    def advance(
        self, context: Context, state: State, X_WK: RigidTransform, V_WK: SpatialVelocity
    ) -> tuple[np.ndarray, float]:
        force = -self._stiffness * (X_WK.translation()[2] - self._height)
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, force]), 0.0


def vertical_mobility(station: SlicingStation) -> float:
    """Element zz of J H^-1 J^T of the virtual model at the station's start, 1/kg."""
    robot = station.scenario.robot
    plant = make_virtual_model(ur5e_chain(robot.X_TK()), station.scenario.controller.link_mass)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, station.start_joints)
    E, world = plant.GetFrameByName("end_effector"), plant.world_frame()
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, E, np.zeros(3), world, world
    )
    vertical = robot.X_WB().rotation().matrix()[2] @ J[3:]
    return float(vertical @ np.linalg.solve(plant.CalcMassMatrix(context), vertical))


def station_growth(
    scenario: Scenario, scaled_gain: float, contact_stiffness: float, duration: float = 3.0
) -> float:
    """Growth of a vertical vibration of the simulated station against a spring.

    The knife rests where the spring is slack; a step of the target by 20 um sets it off.

    Args:
        scenario: Robot and controller; the food is replaced by the spring.
        scaled_gain: Error scale times P gain, for all translations.
        contact_stiffness: N/m.
        duration: Simulated time, s.

    Returns:
        RMS of the knife's velocity in the last quarter over that in the second quarter: below 1 if
        the vibration dies out.
    """
    scenario = copy.deepcopy(scenario)
    scenario.food = AnalyticFood()
    scenario.controller.mode = "compliance"
    scenario.controller.dead_zones = False
    scenario.controller.error_scale = 1.0
    scenario.controller.p_gains = [scaled_gain] * 3 + [1.5] * 3
    builder = DiagramBuilder()
    height = scenario.board.height + AnalyticFood().diameter + scenario.start.clearance
    station = builder.AddNamedSystem(
        "station",
        MakeSlicingStation(
            scenario,
            make_cutting=lambda knife: SpringContact(
                contact_stiffness, height, knife.index(), scenario.exchange_period
            ),
        ),
    )
    builder.ExportInput(station.GetInputPort("target_pose"), "target_pose")
    log = LogVectorOutput(
        station.GetOutputPort("joint_velocities"), builder, publish_period=scenario.exchange_period
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    station.SetStart(context)
    target = RigidTransform([0.0, 0.0, -2e-5]) @ station.start_pose
    diagram.GetInputPort("target_pose").FixValue(context, target)
    simulator.AdvanceTo(duration)
    rates = log.FindLog(context).data()
    n = rates.shape[1]
    early, late = rates[:, n // 4 : n // 2], rates[:, 3 * n // 4 :]
    return float(np.sqrt(np.mean(late**2) / np.mean(early**2)))


def plot_stability_map(
    gains: np.ndarray, lags: Sequence[float], file: Path
) -> dict[float, np.ndarray]:
    """Draws the limit of the contact's stiffness over error scale times gain, for servo lags.

    Args:
        gains: Error scale times P gain [n].
        lags: Of the servo, s.
        file: PNG to write.

    Returns:
        The limits [n], N/m, by lag.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    limits = {
        lag: np.array(
            [contact_stiffness_limit(ContactLoop(g, servo=servo_with_lag(lag))) for g in gains]
        )
        for lag in lags
    }
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    styles = ["-", "--", "-.", ":"]
    colours = ["#000000", "#0072B2", "#D55E00", "#009E73"]
    for k, (lag, limit) in enumerate(limits.items()):
        label = f"servo lag {1e3 * lag:g} ms"
        axes.loglog(gains, limit, styles[k % 4], color=colours[k % 4], label=label)
    axes.axhspan(4e3, 5e3, color="#009E73", alpha=0.2, lw=0)
    axes.text(gains[0], 4.4e3, " vegetables", va="center", fontsize=8)
    axes.axhspan(1e5, 1e6, color="#E69F00", alpha=0.2, lw=0)
    axes.text(gains[0], 3e5, " cutting boards", va="center", fontsize=8)
    axes.set_xlabel("error scale x P gain [1]")
    axes.set_ylabel("largest stable contact stiffness [N/m]")
    axes.set_title("Compliance control in contact, vertical axis", loc="left", fontsize=11)
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False, fontsize=8.5)
    figure.savefig(file, dpi=150)
    return limits
