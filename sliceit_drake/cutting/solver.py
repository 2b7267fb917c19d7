"""Advances the food through one coupling step: captured Warp graphs on a workspace, state in
NumPy."""

import threading
import typing

import numpy as np

from sliceit_drake.cutting.coupling_steps import CouplingSteps, Energies, run_coupling_steps
from sliceit_drake.cutting.driver import Driver
from sliceit_drake.cutting.kernels.layouts import Front, Planned
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.stepping import EVENT, IN_CUT, Frame, PlanRoom, Stepping
from sliceit_drake.cutting.workspace import Workspace, parameter_row

__all__ = ["NOT_FINITE", "CuttingError", "CuttingSolver", "SurfaceFactors"]


class CuttingError(RuntimeError):
    """The cut became unphysical; the message names time, element and cause."""


class SurfaceFactors(typing.NamedTuple):
    """Factors on the model's toughness and friction at all cut points, for the time of one call.

    For a caller whose food changes with time or speed. They are no part of the food's state.
    """

    toughness: float = 1.0
    friction: float = 1.0


UNCHANGED = SurfaceFactors()

NOT_FINITE = (
    "the knife's force is not finite: elements inverted or the step became unstable. "
    "Use a smaller numerics.time_step or a finer mesh near the cut."
)
"""Message of a cut that broke down."""


class CuttingSolver:
    """Steps the state of one `CuttingModel`.

    The state is one contiguous array [state_size]: positions, velocities, history of the cut
    points, friction anchors, blade deflection, stepping. A call copies it into the workspace that
    the captured graph is bound to and copies the result out; nothing is carried between calls.

    Args:
        model: The cut.
        exchange_period: Duration of one `coupling_step`, s; the time step must divide it.
        event: See `stepping.EVENT`.

    Raises:
        TimeStepError: The time step does not divide the coupling period.
    """

    def __init__(self, model: CuttingModel, exchange_period: float, event: float = EVENT) -> None:
        self.model = model
        self.exchange_period = exchange_period
        self.driver = Driver(exchange_period)
        self._workspace = Workspace([model], exchange_period)
        # By number of sub-steps.
        self._workspaces = {self._workspace.substeps: self._workspace}
        self._stepping = Stepping.of(model, self._workspace.substeps, event)
        self.state_size = self._workspace.state_size
        self.dtype = self._workspace.dtype
        self._lock = threading.Lock()
        # What workspaces hold, to write it only where it changes; each call says what it wants.
        self._held_factors: dict[Workspace, SurfaceFactors] = {}

    def initial_state(self) -> np.ndarray:
        """The food at rest, to be cut downwards [state_size]."""
        return self._workspace.initial_state()

    def _take_factors(self, ws: Workspace, factors: SurfaceFactors) -> None:
        """Gives a workspace, which the caller has locked, the model's surface times `factors`."""
        if factors == self._held_factors.get(ws, UNCHANGED):
            return
        row = parameter_row(ws.models[0])
        row[ws.parameter_layout["toughness"]] *= factors.toughness
        row[ws.parameter_layout["friction_scale"]] *= factors.friction
        # The retreat of a tougher edge must not return more energy than its advance took.
        row[ws.parameter_layout["unloading"]] *= max(1.0, factors.toughness)
        ws.write(ws.parameter_rows, row[None])
        self._held_factors[ws] = factors

    def positions(self, state: np.ndarray) -> np.ndarray:
        """Positions of the computed nodes in C [N, 3], metres."""
        return self.field(state, "x").reshape(-1, 3)

    def velocities(self, state: np.ndarray) -> np.ndarray:
        """Velocities of the computed nodes in C [N, 3], m/s."""
        return self.field(state, "v").reshape(-1, 3)

    def field(self, state: np.ndarray, name: str) -> np.ndarray:
        """A part of the state by name; see `State` in kernels/types.py."""
        return np.asarray(state[self._workspace.layout[name]])

    def compile(self) -> None:
        """Compiles the kernels, once a machine, and captures a coupling step as a graph.

        `coupling_step` does so at its first call; call this before to keep it out of a measured
        time."""
        with self._lock:
            # Those that a knife asks for that meets the food or the board or turns round, too.
            for finer in (1, 2, 4, 8, 16):
                self._stepped(finer * self._workspace.substeps).capture()

    def _stepped(self, number: int) -> Workspace:
        """The workspace for a number of sub-steps, with the lock held."""
        if number not in self._workspaces:
            model = self.model.with_step(self.exchange_period / number)
            self._workspaces[number] = Workspace([model], self.exchange_period)
        return self._workspaces[number]

    def coupling_step(
        self, state: np.ndarray, start: Pose, end: Pose, factors: SurfaceFactors = UNCHANGED
    ) -> CouplingSteps:
        """Advances the food while the knife moves from `start` to `end`.

        Args:
            state: The food's state [state_size]; not changed.
            start, end: Knife poses in C.
            factors: Factors on toughness and friction in this coupling step.

        Raises:
            CuttingError: A force is not finite, or the knife left the region that is modelled.
        """
        before, after = (np.column_stack([pose.R, pose.p]) for pose in (start, end))
        return self.move(state, self.plan(state, before, after), factors)

    def plan(
        self, state: np.ndarray, start: np.ndarray, end: np.ndarray, frame: Frame = IN_CUT
    ) -> PlanRoom:
        """Poses of the knife in C and number of sub-steps, until the next plan in this thread.

        Args:
            state: The food's state [state_size].
            start, end: Poses X_AK at the ends of a coupling step [3, 4].
            frame: A.
        """
        stepping = state[self._workspace.layout["stepping"]]
        room = self._stepping.room(1, stepping, self.exchange_period)
        room.X_AK[0], room.X_AK[1] = start, end
        room.run(frame)
        return room

    def move(
        self, state: np.ndarray, plan: PlanRoom, factors: SurfaceFactors = UNCHANGED
    ) -> CouplingSteps:
        """As `coupling_step`, by a plan; wrenches are in the axes of its frame."""
        stepping, wanted, number = plan.after[0], int(plan.numbers[0]), 0
        with self._lock:
            while number != wanted:
                number = wanted
                ws = self._stepped(number)
                self._take_factors(ws, factors)
                ws.take_axes(plan.frame.R_AC)
                (step,) = run_coupling_steps(ws, state[None], plan.R, plan.p)
                wanted = self._stepping.again(number, step.added_force.tolist(), stepping)
        if not step.finite:
            raise CuttingError(NOT_FINITE)
        step.state[self._workspace.layout["stepping"]] = stepping
        return step

    def _place(self, state: np.ndarray, pose: Pose, factors: SurfaceFactors = UNCHANGED) -> None:
        """Puts food and knife, at rest at `pose`, into the workspace for launches with k = 0."""
        ws = self._workspace
        self._take_factors(ws, factors)
        ws.write(ws.states[0], state[None])
        ws.place_knife(pose.R, pose.p)

    def energies(
        self, state: np.ndarray, pose: Pose, factors: SurfaceFactors = UNCHANGED
    ) -> Energies:
        """Energies of `state` with the knife at `pose`, after a coupling step with `factors`."""
        ws, m = self._workspace, self.model
        with self._lock:
            self._place(state, pose, factors)
            elastic, ratio, interface = ws.stored_energies()
        least = int(ratio.argmin())
        depth = np.maximum(m.board[3] - self.positions(state) @ m.board[:3], 0.0)
        anchor = self.field(state, "board_slip").reshape(-1, 3)
        rest = 0.5 * m.parameters["board_stiffness"] * m.board_area
        interface += float(rest @ (depth**2 + (anchor**2).sum(1)))
        # The inertia that was stepped last.
        last = float(self.field(state, "stepping")[Planned.SUB_STEP]) or m.numerics.time_step
        v = self.velocities(state)[m.moving].astype(float)
        deflection, rate = (float(b) for b in self.field(state, "blade"))
        interface += 0.5 * m.parameters["blade_stiffness"] * deflection**2
        toward = rate * float(np.sign(pose.R[1, 1]))
        kinetic = m.with_step(last).inertia.kinetic_energy(v, toward)
        true = m.true_mass[m.moving] @ (v**2).sum(1) + m.knife.lateral_mass() * rate**2
        front = self.field(state, "front")
        return Energies(
            elastic=elastic,
            interface=interface,
            kinetic=kinetic,
            added=kinetic - 0.5 * float(true),
            sub_step=last,
            debt=float(front[Front.DEBT]),
            slope=float(front[Front.SLOPE]),
            least_volume_ratio=float(ratio[least]),
            min_element=least,
        )
