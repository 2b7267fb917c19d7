"""Stability of a station in contact: the linear loop, and how much stiffer the contact could be.

At rest everything in a station is discrete and, for small motions, linear. `ContactLoop` writes
down one cycle of arm, servo, sensor, compliance control and a contact, in the order in which the
station's events run, with the same periods:

- coupling step: the food takes the knife's pose x = J q and holds its force ``f = -G x`` on the
  knife;
- controller: ``q_c = q + h v``, ``v <- 0.9 (v + h H^-1 J^T s p e)``, with e the net force of the
  mode, the spring's part at the pose of the last command, f as the sensor read it;
- servo: ``a_d = gain (q_c - q_d - lookahead v_d)``;
- joint control and plant: ``M (a - a_d) = P (q_d - q) + D (v_d - v) + I + J^T f``, with I the
  integral of ``reset P (q_d - q)``, one symplectic step;
- board: a spring in the plant's own step, ``f_b = -K_b J (q + h v_next)``, as the plant's contact
  solver has it;
- sensor: mean of ``f + f_b + tilt of the tool's weight - M_tool J a`` over the coupling step,
  filtered, sampled and late.

The loop is stable if the matrix of a cycle has no eigenvalue outside the unit circle.

Poses and wrenches are translations first, rotations in the axes of W, at Ko.

At a start-up the prepared food is pressed, on the side, by the blade; small motions in six
directions then give its response, coupling step by coupling step, with the blade's bending in it.
Put into the loop, that response times a factor leaves it stable up to the margin.
"""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import VectorToSkewSymmetric
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.linalg import block_diag, expm

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, edge_contact_positions
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.systems.servo import JOINTS
from sliceit_drake.systems.ur5e_kinematics import make_virtual_model, ur5e_chain

__all__ = [
    "MIN_MARGIN",
    "ContactLoop",
    "ContactMargin",
    "Mode",
    "board_stiffness",
    "check_contact_margin",
]

# Eigenvalues of free drift are 1 up to rounding; a growth of 1e-6 a cycle takes 2,000 s for e.
NEUTRAL = 1e-6
GREATEST_MARGIN = 20.0
MIN_MARGIN = 2.0
DIRECTIONS = ("x", "y", "z", "rotation x", "rotation y", "rotation z")

# The state: q, v, q_d, v_d, integral, command, virtual velocity, error, reading, food's wrench;
# then past poses, targets and readings on their way.
_PARTS = 10
_POSITIONS = (0, 2, 5)


@dc.dataclass(frozen=True)
class Mode:
    """The least stable mode of a loop.

    Attributes:
        growth: Factor on its amplitude in one cycle; unstable above 1.
        frequency: Hz.
    """

    growth: float
    frequency: float

    @property
    def stable(self) -> bool:
        """Whether it does not grow."""
        return self.growth <= 1.0 + NEUTRAL


class ContactLoop:
    """The linear loop of a station at its start, for contacts to be put into it.

    Attributes:
        period: Duration of a cycle, s: the least common multiple of coupling step and controller
            period.
        virtual_mobility: J H^-1 J^T of the virtual model [6, 6], 1/kg, 1/(kg m), 1/(kg m2).
    """

    def __init__(self, station: SimulatedStation, *, tracking: str = "arm") -> None:
        """Linearises a station about rest at its start.

        Args:
            station: Its scenario's controller gives mode and gains.
            tracking: "arm" as the station is; "servo" for an arm that follows the servo and yields
                to no force; "ideal" for one that reaches each command at the plant's next step.
        """
        scenario = station.scenario
        self._config = scenario.controller
        self._tracking = tracking
        plant, robot, q = station.plant, station.robot, station.start_joints
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, robot.arm, q)
        K, W = robot.knife.body_frame(), plant.world_frame()
        J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, K, np.zeros(3), W, W)
        self._J = _swap(J)
        self._M = plant.CalcMassMatrix(context)

        R_WK = plant.EvalBodyPoseInWorld(context, robot.knife).rotation().matrix()
        welded = plant.GetBodiesWeldedTo(robot.knife)
        tool = [body.index() for body in welded if body.model_instance() != robot.arm]
        inertia = plant.CalcSpatialInertia(context, K, tool)
        R = block_diag(R_WK, R_WK)
        self._tool = R @ _swap(_swap(inertia.CopyToFullMatrix6()).T) @ R.T
        weight = inertia.get_mass() * plant.gravity_field().gravity_vector()
        arm_K = R_WK @ inertia.get_com()
        # The sensor turns with the tool: a turn by w changes the weight it sees by -w x weight.
        tilt = np.zeros((6, 6))
        tilt[:3, 3:] = VectorToSkewSymmetric(weight)
        tilt[3:, 3:] = VectorToSkewSymmetric(arm_K) @ VectorToSkewSymmetric(weight)
        self._tilt = tilt

        self._linearise_controller(scenario, q, R_WK)
        servo, control = scenario.robot.servo, scenario.robot.joint_control
        self._step = h = scenario.robot.plant_time_step
        g, t = servo.gain, servo.lookahead_time
        self._servo = expm(h * np.array([[0.0, 1.0, 0.0], [-g, -g * t, g], [0.0, 0.0, 0.0]]))[:2]
        self._delay_steps = round(servo.delay / h)
        self._P, self._D = np.array(control.stiffness), np.array(control.damping)
        self._reset = control.reset_rate
        self._coupling_steps = round(scenario.exchange_period / h)
        self._control_steps = round(self._config.period / h)
        sensor = scenario.sensor
        self._reading_steps = max(self._coupling_steps, round(sensor.sample_period / h))
        self._cycle_steps = math.lcm(self._reading_steps, self._control_steps)
        self.period = self._cycle_steps * h
        self._readings_late = sensor.delay / scenario.exchange_period
        self._line = math.ceil(round(self._readings_late, 9)) + 1
        if self._line == 1 and self._reading_steps == self._coupling_steps:
            self._line = 0
        turn = 2.0 * math.pi * sensor.cutoff_frequency * scenario.exchange_period
        self._filter_share = -math.expm1(-turn) if turn > 0.0 else 1.0

    def _linearise_controller(self, scenario: Scenario, q: np.ndarray, R_WK: np.ndarray) -> None:
        config, robot = self._config, scenario.robot
        model = make_virtual_model(ur5e_chain(robot.X_TK()), config.link_mass)
        context = model.CreateDefaultContext()
        model.SetPositions(context, q)
        E, B = model.GetFrameByName("end_effector"), model.world_frame()
        J = model.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, E, np.zeros(3), B, B)
        J_B = _swap(J)
        R = robot.X_WB().rotation().matrix().T
        R_BW = block_diag(R, R)
        R_BK = R_BW @ block_diag(R_WK, R_WK)
        spring = R_BK @ np.diag(config.stiffness) @ R_BK.T
        force = np.eye(6)
        if config.mode == "motion":
            spring, force = np.eye(6), np.zeros((6, 6))
        elif config.mode == "force":
            spring = np.zeros((6, 6))
        elif config.mode == "parallel":
            selection = np.diag(config.selection)
            spring, force = selection @ spring, np.eye(6) - selection
        joint_acceleration = np.linalg.solve(model.CalcMassMatrix(context), J_B.T)
        self.virtual_mobility = R_BW.T @ (J_B @ joint_acceleration) @ R_BW
        self._virtual_acceleration = joint_acceleration
        self._of_pose = -spring @ J_B
        self._of_reading = force @ R_BW

    def least_stable_mode(
        self, response: np.ndarray | None = None, board: np.ndarray | None = None
    ) -> Mode:
        """The mode that grows fastest.

        Args:
            response: What the food does after a unit step of the knife that lasts one coupling step
                [n, 6, 6]: less the mean wrench over each coupling step from the step on, N/m and so
                on, constant after the last; a stiffness [6, 6] for a spring; None for no food.
            board: Stiffness [6, 6] of a contact in the plant; None for none.
        """
        values = np.linalg.eigvals(self.cycle(response, board))
        last = values[np.abs(values).argmax()]
        frequency = abs(np.angle(last)) / (2.0 * np.pi * self.period)
        return Mode(float(np.abs(last)), float(frequency))

    def displaced(self, direction: Sequence[float]) -> np.ndarray:
        """The loop's state at rest, without food, a unit away from the target along `direction`."""
        joints = np.linalg.solve(self._J, np.asarray(direction, float))
        rest = [joints if part in _POSITIONS else 0.0 * joints for part in range(_PARTS)]
        line = np.zeros(self._line * JOINTS)
        return np.concatenate([*rest, *[joints] * self._delay_steps, line])

    def displacement(self, state: np.ndarray) -> np.ndarray:
        """How far the knife is from the target in a state [6]."""
        return self._J @ state[:JOINTS]

    def margin(self, response: np.ndarray | None = None, board: np.ndarray | None = None) -> float:
        """Factor on both contacts at which the loop becomes unstable.

        Returns:
            0 if it is unstable without contact; at most `GREATEST_MARGIN`.
        """
        if not self.least_stable_mode().stable:
            return 0.0

        def stable(factor: float) -> bool:
            G = None if response is None else factor * response
            K = None if board is None else factor * board
            return self.least_stable_mode(G, K).stable

        low, high = 0.0, 1.0
        while stable(high):
            if high >= GREATEST_MARGIN:
                return GREATEST_MARGIN
            low, high = high, min(2.0 * high, GREATEST_MARGIN)
        while high > 1.05 * low + 1e-2:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if stable(middle) else (low, middle)
        return low

    def cycle(
        self, response: np.ndarray | None = None, board: np.ndarray | None = None
    ) -> np.ndarray:
        """Matrix of one cycle on the loop's state; arguments as `least_stable_mode`."""
        G = np.zeros((1, 6, 6)) if response is None else np.reshape(response, (-1, 6, 6))
        h, J = self._step, self._J
        history, delay = len(G) - 1, self._delay_steps
        parts = _PARTS + history + delay + self._line
        size = parts * JOINTS
        # Rows of the identity: each part as a linear function of the state at the cycle's start.
        state = np.eye(size).reshape(parts, JOINTS, size)
        q, v, q_d, v_d, torque, command, v_c, error, reading, wrench = state[:_PARTS]
        queues = list(state[_PARTS:])
        poses, targets = queues[:history], queues[history : history + delay]
        line = queues[history + delay :]

        total = 0.0 * reading  # A cycle ends with a coupling step.
        mass = self._M
        if board is not None:
            mass = mass + h * h * J.T @ board @ J
        inverse = np.linalg.inv(mass)
        for i in range(self._cycle_steps):
            if i % self._coupling_steps == 0:
                past = [J @ q, *poses]
                wrench = -G[-1] @ past[-1]
                for j in range(history):
                    wrench = wrench - G[j] @ (past[j] - past[j + 1])
                poses = past[:history]
            # From here on all parts change at one instant, from their values before it.
            target = targets[0] if targets else command
            targets = [*targets[1:], command] if targets else []
            rows, torque_next = self._servo, torque
            q_d_next = rows[0, 0] * q_d + rows[0, 1] * v_d + rows[0, 2] * target
            v_d_next = rows[1, 0] * q_d + rows[1, 1] * v_d + rows[1, 2] * target
            if self._tracking == "ideal":
                q_next, v_next, felt = target, 0.0 * v, wrench
            elif self._tracking == "servo":
                q_next, v_next, felt = q_d_next, v_d_next, wrench
            else:
                off = self._P[:, None] * (q_d - q)
                effort = off + self._D[:, None] * (v_d - v) + torque
                torque_next = torque + h * self._reset * off
                push = self._M @ (v + v_d_next - v_d) + h * (effort + J.T @ wrench)
                if board is not None:
                    push = push - h * J.T @ (board @ (J @ q))
                v_next = inverse @ push
                q_next = q + h * v_next
                felt = wrench + self._tilt @ (J @ q) - self._tool @ (J @ ((v_next - v) / h))
                if board is not None:
                    felt = felt - board @ (J @ q_next)
            shown, total_next, reading_next = self._shown(reading, line), total + felt, reading
            if i % self._coupling_steps == self._coupling_steps - 1:
                mean = total_next / self._coupling_steps
                reading_next = reading + self._filter_share * (mean - reading)
                is_new = (i + 1) % self._reading_steps == 0
                line = [reading_next if is_new else line[0], *line[:-1]] if line else []
                total_next = 0.0 * total
            if i % self._control_steps == 0:
                command, v_c, error = self._control(q, command, v_c, error, shown)
            q, v, q_d, v_d, torque = q_next, v_next, q_d_next, v_d_next, torque_next
            total, reading = total_next, reading_next
        parts_after = [q, v, q_d, v_d, torque, command, v_c, error, reading, wrench]
        return np.concatenate([*parts_after, *poses, *targets, *line])

    def _shown(self, reading: np.ndarray, line: list[np.ndarray]) -> np.ndarray:
        """What the controller reads: the sensor's reading, sampled and late."""
        if not line:
            return reading
        part = round(self._readings_late, 9) % 1.0
        return line[-1] if part == 0.0 else line[-2] + part * (line[-1] - line[-2])

    def _control(
        self,
        q: np.ndarray,
        command: np.ndarray,
        v: np.ndarray,
        last_error: np.ndarray,
        reading: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Command, virtual velocity and error after an update of the controller."""
        config = self._config
        dt = config.virtual_time_step
        p = config.error_scale * np.array(config.p_gains)[:, None]
        d = config.error_scale * np.array(config.d_gains)[:, None] / dt
        pose = command
        for _ in range(1 if config.mode == "force" else config.iterations):
            error = self._of_pose @ pose + self._of_reading @ reading
            u = p * error + d * (error - last_error)
            q = q + dt * v
            v = config.damping_factor * (v + dt * self._virtual_acceleration @ u)
            pose, last_error = q, error
        return q, v, last_error


@dc.dataclass(frozen=True)
class ContactMargin:
    """Margins of a station at rest in contact.

    Attributes:
        food: Factor on the food's response at which the loop becomes unstable; None where the
            response is not known. At most `GREATEST_MARGIN`.
        board: The same for the board's stiffness.
        stiffness: The food's stiffness along and about the axes of K [6], N/m and Nm/rad, the
            greatest of all depths; empty where it is not known.
    """

    food: float | None
    board: float
    stiffness: tuple[float, ...]


def check_contact_margin(station: SimulatedStation) -> ContactMargin:
    """Margins of a station at its start; one that is too close to instability is refused.

    Raises:
        ConfigurationError: The margin of the food is below `MIN_MARGIN`.
    """
    loop, scenario = ContactLoop(station), station.scenario
    R_WK = station.start_pose.rotation().matrix()
    board = loop.margin(board=board_stiffness(scenario.board, scenario.knife, R_WK))
    responses = station.cutting.contact_responses(scenario.start.offset)
    if not responses:
        return ContactMargin(None, board, ())
    turn = np.kron(np.eye(2), R_WK)
    food = min(loop.margin(turn @ response @ turn.T) for response in responses)
    stiffness = np.max([np.diag(response[-1]) for response in responses], axis=0)
    if food < MIN_MARGIN:
        names = ", ".join(
            f"{name} {value:.3g}" for name, value in zip(DIRECTIONS, stiffness, strict=True)
        )
        raise ConfigurationError(
            f"knife and food would shake each other: the loop is stable up to {food:.2g} "
            f"times the food's stiffness ({names} N/m and Nm/rad in the knife's axes), at least "
            f"{MIN_MARGIN:g} is asked",
            field="scenario.exchange_period, scenario.controller and scenario.knife",
            fix="Shorten exchange_period, lower controller.error_scale or controller.p_gains, or "
            "lower knife.lateral_stiffness (the blade's bending).",
        )
    return ContactMargin(food, board, tuple(float(k) for k in stiffness))


def board_stiffness(board: Board, knife: Knife, R_WK: np.ndarray) -> np.ndarray:
    """Stiffness [6, 6] of the board under the whole edge, about Ko in W, translations first."""
    x = edge_contact_positions(knife)
    up = np.array([0.0, 0.0, 1.0])
    rows = np.column_stack([np.tile(up, (len(x), 1)), np.cross(np.outer(x, R_WK[:, 0]), up)])
    return board.stiffness / len(x) * rows.T @ rows


def _swap(matrix: np.ndarray) -> np.ndarray:
    """Rows with rotations first, as Drake has them, to translations first."""
    return np.concatenate([matrix[3:], matrix[:3]])
