"""How many sub-steps a coupling step takes: more where the knife or the food changes its velocity.

Inertia that is added to the relative motion of nodes (`inertia`) errs where they accelerate. Food
at the blade follows a knife that stops or turns over some tenths of a millimetre of its way, or
some milliseconds. So each of two points of the edge has a velocity that the food has settled to,
which follows its own, and sub-steps are the shorter the more the two differ.

What the food does by itself, as when a skin gives way, is not known before. A coupling step at
whose end the added inertia takes much force is repeated from its beginning with shorter sub-steps.
Where the food does no such thing the knife's motion alone decides: the same steps are taken
whatever the food's parameters, so that differences of two slices have no steps in them. A gradient
goes back by the steps of its slice.

Inertia grows with the sub-step, and what still swings when it grows swings with more energy. So
sub-steps get longer by a factor of two at a time, some coupling steps after they could.
"""

import math
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from sliceit_drake.cutting.kernels.layouts import PLANNED, Planned, numbers
from sliceit_drake.cutting.kernels.precision import kernels
from sliceit_drake.cutting.kernels.types import mat34d
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.warp_start import LAUNCH_LOCK, load_modules, shared, start_warp

__all__ = ["EVENT", "IN_CUT", "STEPPING", "Frame", "PlanRoom", "Stepping"]

STEPPING = numbers(PLANNED)
"""How many numbers `PLANNED` has."""

TRAVEL = 4e-5
"""Most way of the knife in a sub-step, metres."""
CHANGE = 1.6e-9
"""Most of: the velocity that food has not settled to times the square of a sub-step, m s."""
EVENT = 0.25
"""Most force of the added inertia, over the mean force to cut through the section."""
SETTLING_WAY = 1e-3
"""Way of the knife over which the food settles to a new velocity, metres."""
SETTLING_TIME = 10e-3
"""Time in which it settles, s."""
FINEST = 64
"""Most sub-steps of a coupling step."""
SLACK = 0.8
"""Part of the longest sub-step that food which settles allows, to which one may be doubled."""
CALM = 5
"""Coupling steps in which a sub-step could be twice as long before it is."""


class _Rooms(threading.local):
    """Rooms of a thread, by number of coupling steps and scalar of the kernels."""

    def __init__(self) -> None:
        self.by_size: dict[tuple[int, Any], PlanRoom] = {}


_ROOMS = _Rooms()


class Frame(NamedTuple):
    """A frame A in which poses are given, and in whose axes wrenches are.

    Attributes:
        X_CA: Its pose in C [3, 4], m.
        R_AC: Its rotation's inverse [3, 3].
    """

    X_CA: np.ndarray
    R_AC: np.ndarray


IN_CUT = Frame(np.eye(3, 4), np.eye(3))
"""C itself."""


class PlanRoom:
    """Room for the plan of some coupling steps; each use fills it before it reads anything.

    Attributes:
        rule: Input: numbers of `Stepping`, and the duration of a coupling step, s [5].
        held: The `Stepping` whose numbers they are.
        frame: Input: that of the poses.
        X_AK: Input: poses at the steps' ends [E + 1, 3, 4], m.
        stepping: Input: see `PLANNED`, before them.
        R, p: Poses X_CK [1, E + 1, 3, 3] and [1, E + 1, 3], m.
        numbers: Of sub-steps [E].
        after: `stepping` after each [E, STEPPING].
    """

    def __init__(self, coupling_steps: int, real: Any) -> None:
        ends = coupling_steps + 1
        limits = TRAVEL, CHANGE, SETTLING_WAY, SETTLING_TIME, FINEST, SLACK, CALM
        self._limits = np.array(limits, float)
        self.rule, self.stepping = np.zeros(5), np.zeros(STEPPING)
        self.held: Stepping | None = None
        self.frame, self.X_AK = IN_CUT, np.zeros((ends, 3, 4))
        self._X_CA = IN_CUT.X_CA.copy()
        self.R, self.p = np.zeros((1, ends, 3, 3)), np.zeros((1, ends, 3))
        self.numbers = np.zeros(coupling_steps, np.int32)
        self.after = np.zeros((coupling_steps, STEPPING))
        # What is launched during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            start_warp()
            found = kernels(real)
            load_modules(found.modules[1:], "cpu")
            # The graph holds addresses alone.
            self._arrays = [
                *(shared(values) for values in (self._limits, self.rule)),
                *(shared(values, mat34d) for values in (self._X_CA[None], self.X_AK)),
                shared(self.stepping),
                shared(self.R[0], wp.mat33d),
                shared(self.p[0], wp.vec3d),
                shared(self.numbers, wp.int32),
                shared(self.after),
            ]
            with wp.ScopedCapture(device="cpu") as capture:
                wp.launch(found.plan_steps, dim=1, inputs=self._arrays, device="cpu")
        self._graph = capture.graph

    def run(self, frame: Frame) -> None:
        """Plans, from what was put in and poses in a frame."""
        if frame is not self.frame:
            self.frame, self._X_CA[:] = frame, frame.X_CA
        wp.capture_launch(self._graph)


class Stepping(NamedTuple):
    """The rule for one cut.

    Attributes:
        half_span: Half the width of the section, at whose ends the edge's points are, metres.
        top: Height in C above which the knife touches nothing, metres.
        coarsest: Sub-steps of a coupling step where nothing changes.
        by_need: `numerics.step_by_need`.
        force: Most force of the added inertia, N.
        real: Scalar of the cut's kernels, among which `plan_steps` is.
    """

    half_span: float
    top: float
    coarsest: int
    by_need: bool
    force: float
    real: Any

    @classmethod
    def of(cls, model: CuttingModel, coarsest: int, event: float = EVENT) -> "Stepping":
        """The rule for a cut, its number of sub-steps where nothing changes, and `EVENT`."""
        low, high = model.span
        # Tables blur by one spacing.
        top = model.top + model.tables.spacing
        force = event * model.work_through / (model.top - model.bottom)
        numerics = model.numerics
        real = wp.float32 if numerics.precision == "float32" else wp.float64
        return cls(0.5 * (high - low), top, coarsest, numerics.step_by_need, force, real)

    def plan(
        self,
        stepping: np.ndarray,
        R: np.ndarray,
        p: np.ndarray,
        period: float,
        given: Sequence[int] | None = None,
    ) -> tuple[list[int], list[list[float]]]:
        """Numbers of sub-steps of coupling steps in a row.

        Args:
            stepping: See `PLANNED`, before them.
            R, p: Poses X_CK at their ends [E + 1, 3, 3] and [E + 1, 3], metres.
            period: Duration of each, s.
            given: Numbers [E] that are taken instead, those of a run from which this one differs a
                little; None for none.

        Returns:
            The numbers [E], the coarsest one times powers of two, and `stepping` after each
            [E, STEPPING].
        """
        room = self.room(len(p) - 1, stepping, period)
        room.X_AK[:, :, :3], room.X_AK[:, :, 3] = R, p
        room.run(IN_CUT)
        taken, after = room.numbers.tolist(), room.after.tolist()
        if given is not None:
            taken = list(given)
            for row, number in zip(after, taken, strict=True):
                row[Planned.SUB_STEP] = period / number
        return taken, after

    def room(self, coupling_steps: int, stepping: np.ndarray, period: float) -> PlanRoom:
        """This thread's room for a plan of so many steps, all but the poses put in; see `plan`."""
        key = coupling_steps, self.real
        room = _ROOMS.by_size.get(key)
        if room is None:
            room = _ROOMS.by_size[key] = PlanRoom(coupling_steps, self.real)
        if room.held is not self or room.rule[-1] != period:
            room.held = self
            room.rule[:] = self.half_span, self.top, self.coarsest, self.by_need, period
        room.stepping[:] = stepping
        return room

    def again(self, number: int, added: Sequence[float], stepping: list[float]) -> int:
        """Number of sub-steps with which a coupling step is to be repeated; its own if it is not.

        Args:
            number: Its own.
            added: Force of the added inertia at its end, or of each of several with that number,
                N; see `CouplingSteps`.
            stepping: What `plan` gave after it; gets what follows from the force.
        """
        need = 0.0
        for force in added:
            # What broke down does so however short the steps.
            if self.by_need and math.isfinite(force):
                need = max(need, number * math.sqrt(force / max(self.force, 1e-6)))
        if number > self.coarsest and 2.0 * need >= number:
            stepping[Planned.CALM] = 0.0
        more = number
        while more < min(need, FINEST):
            more *= 2
        if more > number:
            stepping[Planned.SUB_STEP] *= number / more
        return more
