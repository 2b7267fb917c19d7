"""Gradients of a slice: of any function of the force by parameters, motion and initial state.

Reverse mode. The forward run keeps the food's state at each coupling step; going back, a coupling
step is computed once more with the state of each sub-step kept, and its sub-steps are gone through
in reverse by the kernels' adjoints. Memory is that of one coupling step and of one state per
coupling step."""

import dataclasses as dc
import typing
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from sliceit_drake.cutting.coupling_steps import run_coupling_steps
from sliceit_drake.cutting.driver import Driver
from sliceit_drake.cutting.kernels.layouts import BladeSum, PointSum
from sliceit_drake.cutting.kernels.types import LANES, PARAMETERS
from sliceit_drake.cutting.knife_path import Mounting
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.solver import NOT_FINITE, CuttingError
from sliceit_drake.cutting.stepping import Stepping
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["SliceAdjoint", "SliceGradient", "SliceRun"]


@dc.dataclass
class SliceGradient:
    """Derivatives of a function of the wrenches of a slice.

    Attributes:
        rows: Derivatives by what the kernels read, in the order of `Workspace.parameter_layout`, by
            the sub-step in which they read it, s.
        position: Derivatives by the commanded position of Ko at each coupling step [E + 1, 3], 1/m.
        rotation: Derivatives by the entries of its rotation matrix [E + 1, 3, 3].
        state: Derivatives by the initial state of the food [state_size].
        compliance: Derivatives by the compliances of arm and holder [2], N/m.
        layout: Where each array stands in a row.
    """

    rows: dict[float, np.ndarray]
    position: np.ndarray
    rotation: np.ndarray
    state: np.ndarray
    compliance: np.ndarray
    layout: dict[str, slice]

    def by(self, name: str) -> np.ndarray:
        """Derivatives by an array of the kernels: "toughness" [P], "P" (see `PARAMETERS`), ..."""
        return np.asarray(sum(row[self.layout[name]] for row in self.rows.values()))


@dc.dataclass
class SliceRun:
    """A slice with what its gradient needs.

    Attributes:
        model: The cut.
        wrenches: Mean of each coupling step on the knife, moment about Ko and force in C [E, 6].
        substeps: Of each coupling step [E].
        states: The food at the ends of the coupling steps [E + 1] of [state_size].
        R, p: Poses of the knife in C there [E + 1, 3, 3] and [E + 1, 3], metres; where arm and
            holder give, relative to the food.
    """

    model: CuttingModel
    wrenches: np.ndarray
    substeps: list[int]
    states: list[np.ndarray]
    R: np.ndarray
    p: np.ndarray


class _Back(typing.NamedTuple):
    """Adjoints of the state before a coupling step, of Ko's positions and the knife's rotations at
    its ends [2, 3] and [2, 3, 3], and of what the kernels read."""

    state: np.ndarray
    p: np.ndarray
    R: np.ndarray
    row: np.ndarray


class SliceAdjoint:
    """Forces of slices on prescribed motions, and their gradients.

    Nothing but the device's arrays is kept between calls.

    Args:
        model: The cut, or one that others are derived from.
        exchange_period: Duration of a coupling step, s.
    """

    def __init__(self, model: CuttingModel, exchange_period: float) -> None:
        self.model = model
        self.exchange_period = exchange_period
        self._driver = Driver(exchange_period)
        # By number of sub-steps.
        self._workspaces: dict[int, Workspace] = {}
        self._backward: dict[int, Any] = {}
        ws = self._driver.workspace([model])
        by_element = ws.parameters.stiff_volume.shape
        self._strain = wp.zeros((*by_element, 6), dtype=ws.kernels.Vectors, device=ws.device)
        self._factors = wp.zeros((*by_element, 4), dtype=ws.kernels.lanes, device=ws.device)
        self._adj_mu, self._adj_lam = (
            wp.zeros(by_element, dtype=ws.real, device=ws.device) for _ in range(2)
        )

    def run(
        self,
        R: np.ndarray,
        p: np.ndarray,
        model: CuttingModel | None = None,
        state: np.ndarray | None = None,
        substeps: Sequence[int] | None = None,
    ) -> SliceRun:
        """Simulates a slice.

        Args:
            R: Rotations of the knife in C at the ends of the coupling steps [E + 1, 3, 3].
            p: Positions of Ko in C there [E + 1, 3], metres.
            model: A cut derived from that of the constructor; None for that.
            state: The food before; None for at rest.
            substeps: Numbers that are taken instead of those by need, one a coupling step [E]: for
                differences of slices, which must not differ in them.

        Raises:
            CuttingError: A force is not finite.
            ValueError: The food may slip, which has no gradient.
        """
        model = model or self.model
        _give(model)
        ws = self._driver.workspace([model])
        rule, stepping = Stepping.of(model, ws.substeps), ws.layout["stepping"]
        mounting = Mounting(model.effects, tolerance=1e-12)
        state = ws.initial_state() if state is None else np.asarray(state, ws.dtype)
        count = len(p) - 1
        run = SliceRun(model, np.empty((count, 6)), [], [state], np.array(R), np.array(p))
        for e in range(count):
            before, at = run.states[e], slice(e, e + 2)
            given = None if substeps is None else substeps[e : e + 1]
            (number,), (after,) = rule.plan(
                before[stepping], R[at], p[at], self.exchange_period, given
            )
            balanced = False
            while not balanced:
                ws = self._driver.workspace([model], substeps=number)
                rise, shift = mounting.given.tolist()
                run.p[e + 1] = p[e + 1] + [-shift, 0.0, rise]
                poses = run.R[None, e : e + 2], run.p[None, e : e + 2]
                (step,) = run_coupling_steps(ws, before[None], *poses)
                if not step.finite:
                    raise CuttingError(f"at {(e + 1) * self.exchange_period:.4g} s {NOT_FINITE}")
                run.wrenches[e] = step.wrenches[0].sum(0)
                draw, _, rise = (-run.wrenches[e, 3:]).tolist()
                balanced = mounting.rigid or mounting.balanced(-rise, draw, 0.0, None)
                if balanced and substeps is None:
                    wanted = rule.again(number, step.added_force.tolist(), after)
                    if wanted != number:
                        number, balanced = wanted, False
                        mounting.undo()
            run.substeps.append(number)
            run.states.append(step.state)
            step.state[stepping] = after
        return run

    def gradient(self, run: SliceRun, weights: np.ndarray) -> SliceGradient:
        """Gradient of sum(weights * wrenches) of what `run` returned; weights [E, 6]."""
        count, give = len(run.wrenches), _give(run.model)
        for number in set(run.substeps):
            model = run.model.with_step(self.exchange_period / number)
            if number not in self._workspaces:
                self._workspaces[number] = Workspace([model], self.exchange_period, gradients=True)
            self._workspaces[number].set_models([model])
        ws = self._workspaces[run.substeps[0]]
        adj_state = np.zeros(ws.state_size)
        rows = {number: np.zeros(ws.parameter_rows.shape[1]) for number in run.substeps}
        adj_p, adj_R = np.zeros_like(run.p), np.zeros_like(run.R)
        of_give, axes = np.zeros(3), np.flatnonzero(give)
        for e in reversed(range(count)):
            ws = self._workspaces[run.substeps[e]]
            ws.advance(run.states[e][None], run.R[None, e : e + 2], run.p[None, e : e + 2])
            back = self._adjoint_of_coupling_step(run, e, weights[e], adj_state)
            if len(axes):
                # Ko's position p holds the force F(p) that it gives: p = command + give F(p). With
                # b the adjoint of p at constant give F, that of the command is b + (dF/dp)' give
                # times itself.
                force = np.zeros((len(axes), 6))
                force[np.arange(len(axes)), 3 + axes] = 1.0
                slopes = [self._adjoint_of_coupling_step(run, e, w, 0.0 * adj_state) for w in force]
                b = (adj_p[e + 1] + back.p[1])[axes]
                dF = np.array([slope.p[1, axes] for slope in slopes])
                command = np.linalg.solve(np.eye(len(axes)) - dF.T * give[axes], b)
                of_give[axes] += run.wrenches[e, 3 + axes] * command
                for slope, share in zip(slopes, give[axes] * command, strict=True):
                    back = _Back(*(a + share * c for a, c in zip(back, slope, strict=True)))
            adj_state = back.state
            adj_p[e : e + 2] += back.p
            adj_R[e : e + 2] += back.R
            rows[run.substeps[e]] += back.row
        by_step = {self.exchange_period / number: row for number, row in rows.items()}
        return SliceGradient(by_step, adj_p, adj_R, adj_state, of_give[[2, 0]], ws.parameter_layout)

    def _adjoint_of_coupling_step(
        self, run: SliceRun, e: int, weights: np.ndarray, adj_state: np.ndarray
    ) -> _Back:
        """Back through coupling step e of a slice, whose sub-steps the workspace holds.

        Args:
            weights: Adjoint of its wrench [6].
            adj_state: Adjoint of the state at its end.
        """
        n, T = run.substeps[e], self.exchange_period
        ws = self._workspaces[n]
        share = np.arange(1, n + 1) / n
        adj_p, adj_R = np.zeros((2, 3)), np.zeros((2, 3, 3))
        adj_sums, adj_R[1, :, 1] = self._adjoint_of_sums(ws, weights, run.R[e + 1])
        if n not in self._backward:
            self._backward[n] = ws.captured(lambda: self._launch_backward(ws))
        ws.write(ws.states[-1].grad, adj_state[None])
        ws.write(ws.sum_rows.grad, adj_sums[None])
        wp.capture_launch(self._backward[n])
        motion = ws.read(ws.motion_rows.grad)[0].astype(np.float64)
        by = {name: motion[where].reshape(n, -1) for name, where in ws.motion_layout.items()}
        of_velocity = by["v_CK"].sum(0) / T
        adj_p[1] = share @ by["p_CK"] + of_velocity
        adj_p[0] = (1.0 - share) @ by["p_CK"] - of_velocity
        a, b, c = by["w_CK"].sum(0) * (0.5 / T)
        of_turn = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
        adj_R[1] += (share @ by["R_CK"]).reshape(3, 3) + of_turn @ run.R[e]
        adj_R[0] = ((1.0 - share) @ by["R_CK"]).reshape(3, 3) + of_turn.T @ run.R[e + 1]
        row = ws.read(ws.parameter_rows.grad)[0].astype(np.float64)
        scalars = ws.parameter_layout["P"].start
        for name, adjoint in (("mu", self._adj_mu), ("lam", self._adj_lam)):
            row[scalars + PARAMETERS.index(name)] += ws.read(adjoint).astype(np.float64).sum()
        return _Back(ws.read(ws.states[0].grad)[0].astype(np.float64), adj_p, adj_R, row)

    def _adjoint_of_sums(
        self, ws: Workspace, weights: np.ndarray, R: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adjoint of `knife_wrenches`: of the sums as the workspace holds them, and of Ky."""
        n = ws.substeps
        of_moment, of_force = weights[:3], weights[3:]
        result, at = ws.read(ws.result_rows)[0], ws.result_layout
        sums, (_, on_knife, on_blade) = result[at["point_sums"]], result[at["blade"]].tolist()
        push, area = on_knife - on_blade, float(sums[PointSum.BURIED_AREA])
        lateral = push / n * R[:, 1]
        buried = slice(PointSum.BURIED_MOMENT, PointSum.BURIED_MOMENT + 3)
        middle = sums[buried] / area if area > 0.0 else np.zeros(3)
        of_lateral = of_force + _cross(of_moment, middle)
        of_middle = _cross(lateral, of_moment)
        total = np.zeros(len(sums))
        total[PointSum.FORCES : PointSum.FORCES + 9].reshape(3, 3)[:] = of_force / n
        total[PointSum.MOMENTS : PointSum.MOMENTS + 9].reshape(3, 3)[:] = of_moment / n
        if area > 0.0:
            total[buried] = of_middle / area
            total[PointSum.BURIED_AREA] = -(of_middle @ middle) / area
        adjoint = np.zeros(ws.sum_rows.shape[1])
        adjoint[ws.sum_layout["points"]].reshape(ws.point_blocks, -1, LANES)[:] = total[:, None]
        along = float(of_lateral @ R[:, 1]) / n
        blade = ws.sum_layout["blade"].start
        adjoint[blade + BladeSum.ON_KNIFE], adjoint[blade + BladeSum.ON_BLADE] = along, -along
        return adjoint, of_lateral * push / n

    def _launch_backward(self, ws: Workspace) -> None:
        for array in (*ws.states[:-1], *(slot.ahead for slot in ws.slots), ws.motion_rows):
            array.grad.zero_()
        for array in (ws.parameter_rows.grad, self._adj_mu, self._adj_lam):
            array.zero_()
        for k in reversed(range(ws.steps)):
            self._launch_substep_adjoint(ws, k)
        ws.launch_look_ahead(adjoint=True)

    def _launch_substep_adjoint(self, ws: Workspace, k: int) -> None:
        kern, forces = ws.kernels, ws.forces[k]
        for name in (
            "at_points",
            "totals",
            "from_elements",
            "from_bulk",
            "from_points",
            "acceleration",
        ):
            getattr(forces, name).grad.zero_()
        for part in ("step_blade_and_front", "total_points", "place_points", "step_nodes"):
            ws.launch_part(part, k, adjoint=True)
        # By hand: the adjoint of a symmetric solve is the solve of the adjoint.
        ws.solve(forces.acceleration.grad, forces.resultant.grad)
        ws.launch_part("push_blade", k, adjoint=True)
        ws.launch_part("sum_forces", k, adjoint=True)
        spread = [ws.points, forces.from_points.grad, forces.points.grad]
        ws.launch(kern.spread_adjoint, forces.at_points.shape[:2], spread)
        ws.launch_part("step_points", k, adjoint=True)
        strain, factors, direction = self._strain, self._factors, forces.from_elements.grad
        adjoints = [ws.parameters.stiff_volume.grad, self._adj_mu, self._adj_lam]
        by_element = ws.parameters.stiff_volume.shape
        ws.launch(kern.strains, by_element, [ws.slots[k].ahead, direction, ws.mesh, strain])
        ws.launch(kern.stresses, by_element, [ws.parameters, strain, factors, *adjoints])
        changes = [ws.mesh, strain, factors, forces.elements]
        ws.launch(kern.elements_adjoint, by_element[:2], changes)
        ws.launch_part("gather_adjoint", k)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors [3], without NumPy's overhead for stacks of them."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _give(model: CuttingModel) -> np.ndarray:
    """Displacement of the knife relative to the food per force on it [3], m/N; see `Mounting`.

    Raises:
        ValueError: The food may slip.
    """
    effects = model.effects
    if effects.slip.resistance is not None:
        raise ValueError("effects.slip has no gradient: slipping is an event. Set it to null.")
    return np.array([effects.compliance.holder, 0.0, effects.compliance.arm])
