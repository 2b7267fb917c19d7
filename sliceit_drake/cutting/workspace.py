"""Device arrays of one or many cuts of one mesh, and the launches that advance them."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp
from scipy.sparse import coo_array

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.inertia import Factors
from sliceit_drake.cutting.kernels import layouts
from sliceit_drake.cutting.kernels.precision import kernels
from sliceit_drake.cutting.kernels.types import CORNERS, GATHER, LANES, PARAMETERS, STRIP
from sliceit_drake.cutting.model import CuttingModel, TimeStepError
from sliceit_drake.cutting.stepping import STEPPING
from sliceit_drake.cutting.warp_start import LAUNCH_LOCK, load_modules, start_warp

__all__ = ["Workspace", "in_lanes", "parameter_row"]

POINT_NUMBERS = {
    "toughness",
    "flank_scale",
    "friction_scale",
    "unloading",
    "edge_depth",
    "skin_depth",
    "last_skin_depth",
    "cohesive_damage",
    "edge_force",
}
"""Arrays with a number for each cut point."""
GPU_BLOCK = 64
"""Threads of a block on a GPU: those of elements and points need most of a multiprocessor's
registers, so that larger blocks leave others without work."""


class Workspace:
    """Advances cuts that share a mesh by `coupling_steps` coupling steps a launch.

    Each cut C has parameters, motion and state of its own. A state is one row of `state_size`
    numbers: positions, velocities, history of the cut points, friction anchors, relaxation, blade,
    stepping.

    Args:
        models: The cuts; all derived from one model.
        exchange_period: Duration of a coupling step, s; the time step must divide it.
        coupling_steps: Coupling steps that one launch advances.
        gradients: Whether each sub-step keeps its state, for an adjoint.

    Raises:
        TimeStepError: The time step does not divide the coupling period.
    """

    def __init__(
        self,
        models: Sequence[CuttingModel],
        exchange_period: float,
        coupling_steps: int = 1,
        gradients: bool = False,
    ) -> None:
        model = models[0]
        dt = model.numerics.time_step
        self.cuts, self.coupling_steps = len(models), coupling_steps
        self.exchange_period = exchange_period
        self.substeps = max(1, round(exchange_period / dt))
        if abs(self.substeps * dt - exchange_period) > 1e-6 * exchange_period:
            raise TimeStepError(
                f"numerics.time_step = {dt:g} s does not divide the coupling period "
                f"{exchange_period:g} s. Give {exchange_period / self.substeps:g}."
            )
        self.steps = self.substeps * coupling_steps
        single = model.numerics.precision == "float32"
        self.real: Any = wp.float32 if single else wp.float64
        self.dtype: Any = np.float32 if single else np.float64
        self.dt = self.real(exchange_period / self.substeps)
        with LAUNCH_LOCK:
            start_warp()
            self.kernels = kernels(self.real, gradients)
        self.device = _device(model.numerics.device)
        self._on_host = bool(self.device.is_cpu)
        self.model = model
        self.models: tuple[CuttingModel, ...] = ()
        self._gradients = gradients
        self._graph: Any = None
        self._energy_graph: Any = None
        self._views: dict[tuple, np.ndarray] = {}
        # What is allocated during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            self._make_arrays()
        # With gradients, what the nodes get is kept.
        load = ("gather", "sum_forces") if gradients else ("load_nodes",)
        self.node_parts = (*load, "solve", "step_nodes")
        self.set_models(models)

    def _array(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Zeros on the device, with room for their adjoint if gradients are kept."""
        return wp.zeros(shape, dtype=dtype, device=self.device, requires_grad=self._gradients)

    def _view(
        self, rows: wp.array, start: int, kind: Any, shape: tuple[int, ...], step: int = 0
    ) -> wp.array:
        """A view of rows of numbers [C, size] as an array [C, ...].

        Args:
            start: First number in a row.
            kind: Type of the array, as a field of a struct declares it.
            shape: Its shape without the first axis, in numbers.
            step: Numbers from one entry to the next; an entry's own by default.
        """
        item = wp.types.type_size_in_bytes(rows.dtype)
        shape = shape[: kind.ndim - 1]
        last = step * item or wp.types.type_size_in_bytes(kind.dtype)
        inner = np.cumprod([last, *shape[:0:-1]])[::-1].tolist()
        return wp.array(
            ptr=rows.ptr + start * item,
            dtype=kind.dtype,
            shape=(self.cuts, *shape),
            strides=(rows.strides[0], *inner),
            device=self.device,
            grad=None if rows.grad is None else self._view(rows.grad, start, kind, shape, step),
        )

    def _rows(
        self, struct: Any, shapes: Mapping[str, tuple[int, ...]], dtype: Any = None
    ) -> tuple[wp.array, dict[str, slice]]:
        """Rows of numbers [C, size], with arrays of a struct as views of them side by side.

        Args:
            shapes: Shapes of the arrays without the first axis, in numbers.
            dtype: Type of the numbers, the kernels' by default.

        Returns:
            The rows, and where each array stands in a row.
        """
        layout, end = {}, 0
        for name, shape in shapes.items():
            layout[name] = slice(end, end := end + math.prod(shape))
        rows = self._array((self.cuts, end), dtype or self.real)
        for name, shape in shapes.items():
            kind = struct._cls.vars[name].type
            setattr(struct, name, self._view(rows, layout[name].start, kind, shape))
        return rows, layout

    def _without_fill(self, layout: dict[str, slice]) -> dict[str, slice]:
        """The same with numbers by cut point up to the last point."""
        count = len(self.model.point_nodes)
        layout = dict(layout)
        for name in POINT_NUMBERS & layout.keys():
            layout[name] = slice(layout[name].start, layout[name].start + count)
        return layout

    def _set(self, struct: Any, **values: Any) -> None:
        """Sets constant arrays and numbers of a struct."""
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                kind = struct._cls.vars[name].type
                value = wp.array(value, dtype=kind.dtype, device=self.device)
            setattr(struct, name, value)

    def _allocate(self, struct: Any, **shapes: tuple[int, ...]) -> None:
        """Gives a struct arrays of zeros, of these shapes without the first axis."""
        for name, shape in shapes.items():
            dtype = struct._cls.vars[name].type.dtype
            setattr(struct, name, self._array((self.cuts, *shape), dtype))

    def _make_arrays(self) -> None:
        m, k, C, K = self.model, self.kernels, self.cuts, self.steps
        N, P, B, E = len(m.nodes), len(m.point_nodes), len(m.blocks), self.coupling_steps

        self.point_blocks = -(-P // LANES)
        self.mesh, self.points = k.Mesh(), k.Points()
        self._set(
            self.mesh,
            nodes=m.blocks,
            shape=m.shape,
            moving=m.moving,
            board_area=m.board_area,
            board=m.board,
            **_element_gather(m),
            **_point_gather(m.point_nodes, m.point_weights, N),
        )
        self._set(
            self.points,
            nodes=in_lanes(m.point_nodes),
            weights=in_lanes(m.point_weights),
            area=in_lanes(m.tables.area, 0.0),
            width=_filled(m.tables.width, 0.0),
            fraction=_filled(m.tables.fraction, 0.0),
            centroid=_filled(m.tables.rise, 0.0),
            beside=in_lanes(m.tables.beside),
            outline=in_lanes(m.tables.outline, 0.0),
            lower=in_lanes(m.tables.lower),
            depth=in_lanes(m.point_depth),
            rest=in_lanes(m.split.points),
            reach=m.tables.reach,
            per_spacing=1.0 / m.tables.spacing,
        )
        self.parameters, values = k.Parameters(), _parameter_arrays(m)
        self.parameter_rows, layout = self._rows(self.parameters, _shapes(values))
        self.parameter_layout = self._without_fill(layout)
        self.inertia, factors = k.Inertia(), self._factors(m)
        places = ("lower_start", "lower_index", "upper_start", "upper_index")
        self._set(self.inertia, **{name: getattr(factors, name) for name in places})
        for name in FACTORS:
            dtype = k.Inertia.vars[name].type.dtype
            rows = wp.zeros((C, len(getattr(factors, name))), dtype, device=self.device)
            setattr(self.inertia, name, rows)
        self._allocate(self.inertia, last=(len(m.moving) + 1 - len(factors.inverse_pivot),))

        self.motion = k.Motion()
        self.motion.done = wp.zeros(2, dtype=wp.int32, device=self.device)
        self._rounds_left = wp.zeros(2, dtype=wp.int32, device=self.device)
        self.motion.substeps, self.motion.period = self.substeps, self.exchange_period
        # At the ends of the coupling steps, as they are given.
        self._allocate(self.motion, R_AC=(), R=(E + 1,), p=(E + 1,))
        self._axes: Any = None
        self.take_axes(np.eye(3))
        motion = {"R_CK": (K, 9), "p_CK": (K, 3), "v_CK": (K, 3), "w_CK": (K, 3)}
        self.motion_rows, self.motion_layout = self._rows(self.motion, motion)

        values = _initial_arrays(m)
        self._initial_state = _row(values).astype(self.dtype)
        self.state_size = len(self._initial_state)
        # With gradients, sub-step k reads slot k and writes slot k + 1; otherwise all are one.
        self.slots = [k.State() for _ in range(K + 1 if self._gradients else 1)]
        self.states = []
        for slot in self.slots:
            rows, layout = self._rows(slot, _shapes(values))
            self.layout = self._without_fill(layout)
            self.states.append(rows)
            self._allocate(slot, ahead=(N,))

        # Padded with a row of zeros, which fills up the nodes' lists of entries.
        size = B * CORNERS * 3 * LANES
        self.force = wp.zeros((C, size + 3 * LANES), dtype=self.real, device=self.device)
        forces, kinds = k.Forces(), k.Forces.vars
        forces.elements = self._view(self.force, 0, kinds["elements"].type, (B, CORNERS))
        forces.rows = self._view(self.force, 0, kinds["rows"].type, (size + 1,), step=1)
        self._at_points = self._array((C, self.point_blocks * 6 * LANES), self.real)
        forces.points = self._view(self._at_points, 0, kinds["points"].type, (self.point_blocks, 2))
        size = self._at_points.shape[1] - 2 * LANES
        forces.point_rows = self._view(
            self._at_points, 0, kinds["point_rows"].type, (size,), step=1
        )
        totals = (layouts.numbers(layouts.POINT_TOTALS),)
        self._allocate(forces, corners=(B, CORNERS), at_points=(self.point_blocks, *totals))
        # With gradients, what the nodes got in each sub-step is kept.
        self.forces = [k.Forces() for _ in range(K if self._gradients else 1)]
        for kept in self.forces:
            kept.assign(forces)
            moving = (len(m.moving) + 1,)
            self._allocate(
                kept, totals=totals, from_bulk=(N,), resultant=moving, acceleration=moving
            )
            if self._gradients:
                self._allocate(kept, from_elements=(N,), from_points=(N,))

        self.sums, self._results, self._energies = k.Sums(), k.Results(), k.Energies()
        sums = {
            "points": (E, self.point_blocks, layouts.numbers(layouts.POINT_SUMS), LANES),
            "blade": (E, layouts.numbers(layouts.BLADE_SUMS)),
            "board_force": (N, 3),
            "board_loss": (N,),
            "internal_work": (N,),
        }
        self.sum_rows, self.sum_layout = self._rows(self.sums, sums)
        results = layouts.results(E)
        shapes = {name: layouts.field_shape(results, name) for name in results.names or ()}
        self.result_rows, self.result_layout = self._rows(self._results, shapes, wp.float64)
        by_element = (B, STRIP, LANES)
        self._allocate(self._energies, elastic=by_element, volume_ratio=by_element)
        self._allocate(self._energies, points=(self.point_blocks,))

    def set_models(self, models: Sequence[CuttingModel]) -> None:
        """Takes the parameters of other cuts of the same mesh, one for each row."""
        if len(models) != self.cuts:
            raise ValueError(f"{len(models)} models for {self.cuts} cuts")
        for model in models:
            if model.split is not self.model.split or len(model.relaxing) != len(
                self.model.relaxing
            ):
                raise ValueError(
                    "the cuts must be derived from one model and have as many relaxation times"
                )
        self.write(self.parameter_rows, np.array([parameter_row(m) for m in models]))
        inertia = [model.inertia for model in models]
        if [id(each) for each in inertia] != [id(model.inertia) for model in self.models]:
            for name in FACTORS:
                values = np.array([getattr(self._factors(m), name) for m in models])
                if values.size:
                    self.write(getattr(self.inertia, name), values)
        self.models = tuple(models)

    def _factors(self, model: CuttingModel) -> Factors:
        """Of the mass matrix, as `solve` needs them."""
        return model.inertia.factors if self._on_host else model.inertia.inverted

    def take_axes(self, R_AC: np.ndarray) -> None:
        """Gives wrenches in the axes of a frame A from now on; R_AC [3, 3] is not to be changed."""
        if R_AC is not self._axes:
            self._axes = R_AC
            self.write(self.motion.R_AC, np.tile(R_AC, (self.cuts, 1, 1)))

    def initial_state(self) -> np.ndarray:
        """The food at rest, to be cut downwards [state_size]."""
        return self._initial_state.copy()

    def write(self, array: wp.array, values: np.ndarray) -> None:
        """Sets an array from host memory."""
        if self._on_host:
            self.read(array)[...] = values
        else:
            array.assign(values)

    def read(self, array: wp.array) -> np.ndarray:
        """An array in host memory; on the CPU a view, made once."""
        key = (array.ptr, array.shape)
        if (view := self._views.get(key)) is None:
            view = array.numpy()
            if self._on_host:
                self._views[key] = view
        return view

    def launch(
        self, kernel: Any, shape: tuple[int, ...], inputs: list[Any], adjoint: bool = False
    ) -> None:
        """Launches `kernel`, or its adjoint, over cuts and what else `shape` counts."""
        # An empty struct stands for the adjoints that arrays bring along.
        empty = [type(a)() if hasattr(a, "assign") else None for a in inputs]
        wp.launch(
            kernel,
            dim=shape,
            inputs=inputs,
            adj_inputs=empty if adjoint else [],
            adjoint=adjoint,
            device=self.device,
            block_dim=None if self._on_host else GPU_BLOCK,
        )

    def launch_look_ahead(self, k: int = 0, adjoint: bool = False) -> None:
        """Launches where the elements are evaluated in sub-step k, from the first state."""
        inputs = [self.slots[0], self.parameters, self.slots[k]]
        self.launch(self.kernels.look_ahead, self.slots[k].x.shape, inputs, adjoint)

    def launch_part(self, part: str, k: int, dt: Any = None, adjoint: bool = False) -> None:
        """Launches a kernel of sub-step k, or its adjoint.

        On a CPU all entries of a cut are in one thread: its start, which copies the kernel's
        arguments, costs more than a node does.

        Args:
            part: The kernel's name.
            k: The sub-step.
            dt: Its duration; the workspace's by default.
            adjoint: Whether the kernel's adjoint is launched.
        """
        m, mesh, parameters, sums = self.model, self.mesh, self.parameters, self.sums
        now, after, forces = self.slots[0], self.slots[0], self.forces[0]
        if self._gradients:
            now, after, forces = self.slots[k], self.slots[k + 1], self.forces[k]
        dt = self.dt if dt is None else dt
        if part == "solve":
            self.solve(forces.resultant, forces.acceleration)
            return
        states = [now, after, forces, sums]
        entries, inputs = {
            "elements": (len(m.blocks), [now, mesh, parameters, forces]),
            "step_points": (
                self.point_blocks,
                [k, dt, self.points, parameters, self.motion, *states],
            ),
            "load_nodes": (len(m.moving), [dt, mesh, parameters, now, forces, sums]),
            "gather": (len(m.moving), [mesh, forces]),
            "sum_forces": (len(m.moving), [dt, mesh, parameters, *states]),
            "weigh_added_inertia": (0, [k, parameters, self.motion, forces, self._results]),
            "step_nodes": (len(m.moving), [dt, mesh, parameters, *states]),
            "gather_adjoint": (len(m.moving), [mesh, forces, now.ahead.grad]),
            "place_points": (
                self.point_blocks,
                [k, self.points, self.motion, after, forces],
            ),
            "total_points": (0, [forces]),
            "push_blade": (0, [k, parameters, self.motion, now, forces]),
            "step_blade_and_front": (0, [k, dt, parameters, self.motion, *states]),
        }[part]
        shape: tuple[int, ...] = (self.cuts,)
        if entries:
            threads, per_thread = (1, entries) if self.device.is_cpu else (entries, 1)
            shape, inputs = (self.cuts, threads), [*inputs, per_thread]
        self.launch(getattr(self.kernels, part), shape, inputs, adjoint)

    def solve(self, b: wp.array, y: wp.array) -> None:
        """Solves S y = b [C, K + 1] with the mass matrices S: by substitution with a thread for
        each cut, or on a GPU by the inverse with a thread for each row."""
        inputs = [self.inertia, b, y]
        if self._on_host:
            self.launch(self.kernels.solve, (self.cuts,), inputs)
        else:
            self.launch(self.kernels.multiply, b.shape, inputs)

    def launch_substep(self, k: int) -> None:
        """One sub-step."""
        for part in (
            "elements",
            "step_points",
            "push_blade",
            *self.node_parts,
            "place_points",
            "total_points",
            "step_blade_and_front",
        ):
            self.launch_part(part, k)

    def captured(self, launch: Callable[[], None]) -> Any:
        """Graph of the launches that `launch` makes; compiles the kernels, once a machine."""
        with LAUNCH_LOCK:
            block = None if self._on_host else GPU_BLOCK
            load_modules(self.kernels.modules, self.device, block)
            with wp.ScopedCapture(device=self.device) as capture:
                launch()
        return capture.graph

    def capture(self) -> None:
        """Compiles the kernels, once a machine, and captures a launch as a graph."""
        if self._graph is None:
            self._graph = self.captured(self._launch_coupling_steps)

    def _launch_coupling_steps(self) -> None:
        kern, sums, results = self.kernels, self.sums, self._results
        self.sum_rows.zero_()
        self.launch(kern.move_knife, self.motion.R_CK.shape, [self.motion])
        weights = [self.parameters, results]
        self.launch(kern.weigh, (self.cuts,), [wp.float64(-1.0), self.slots[0], *weights])
        # Later sub-steps need it for held nodes only, which never move.
        for k in range(len(self.slots)):
            self.launch_look_ahead(k)
        if self._on_host and not self._gradients:
            # A loop is captured faster.
            self._launch_loop(1, self.coupling_steps, self._launch_coupling_step)
            self.motion.done.zero_()
        else:
            for k in range(self.steps):
                self.launch_substep(k)
                if (k + 1) % self.substeps == 0:
                    self.launch_part("weigh_added_inertia", k)
        self.launch(kern.add_points, results.point_sums.shape, [sums, results])
        self.launch(kern.knife_wrenches, results.work.shape, [sums, self.motion, results])
        self.launch(kern.weigh, (self.cuts,), [wp.float64(1.0), self.slots[-1], *weights])
        self.launch(kern.add_up, (self.cuts,), [sums, self.motion, results])

    def _launch_coupling_step(self) -> None:
        self._launch_loop(0, self.substeps, lambda: self.launch_substep(0))
        # That of the last sub-step that is done.
        self.launch_part("weigh_added_inertia", -1)

    def _launch_loop(self, loop: int, rounds: int, launch: Callable[[], None]) -> None:
        """Launches a loop, within a graph, which counts its rounds in `motion.done`."""
        left = self._rounds_left[loop : loop + 1]

        def launch_round() -> None:
            launch()
            counters = [loop, self._rounds_left, self.motion.done]
            self.launch(self.kernels.count, (1,), counters)

        left.fill_(rounds)
        wp.capture_while(left, launch_round)

    def advance(self, states: np.ndarray, R: np.ndarray, p: np.ndarray) -> None:
        """Advances all cuts by the workspace's coupling steps.

        The new states are in `states[-1]`, the rest in `result_rows`.

        Args:
            states: [C, state_size].
            R: Rotations of the knives in C at the ends of the coupling steps [C, E + 1, 3, 3].
            p: Positions of Ko there [C, E + 1, 3], metres.
        """
        if self._graph is None:
            self.capture()
        # Held nodes are never written, so every slot needs them.
        for state in self.states:
            self.write(state, states)
        self.write(self.motion.R, R)
        self.write(self.motion.p, p)
        wp.capture_launch(self._graph)

    def stored_energies(self) -> tuple[float, np.ndarray, float]:
        """Elastic energy, volume ratios [T] and energy of the cut points of the first cut, J."""
        if self._energy_graph is None:
            self._energy_graph = self.captured(self._launch_energies)
        wp.capture_launch(self._energy_graph)
        elastic = self.read(self._energies.elastic)[0].sum(dtype=np.float64)
        ratio = self.read(self._energies.volume_ratio)[0].ravel()[self.model.element_place]
        interface = self.read(self._energies.points)[0].sum(dtype=np.float64)
        return float(elastic), ratio, float(interface)

    def _launch_energies(self) -> None:
        kern, state, energies = self.kernels, self.slots[0], self._energies
        elements = [state, self.mesh, self.parameters, energies]
        self.launch(kern.element_energy, (self.cuts, len(self.model.blocks)), elements)
        points = [self.points, self.parameters, self.motion, state, energies]
        self.launch(kern.point_energy, (self.cuts, self.point_blocks), points)

    def place_knife(
        self, R: Any, p: Any, v: Any = (0.0, 0.0, 0.0), w: Any = (0.0, 0.0, 0.0)
    ) -> None:
        """Gives all knives one pose in C, velocity of Ko and angular velocity."""
        for name, value in zip(("R_CK", "p_CK", "v_CK", "w_CK"), (R, p, v, w), strict=True):
            array = getattr(self.motion, name)
            if self._on_host:
                self.write(array, value)
            else:
                self.write(array, np.broadcast_to(value, (*array.shape, *np.shape(value))))


FACTORS = ("lower", "upper", "inverse_pivot", "inverse")
"""Arrays of `inertia.Factors` in which cuts of one mesh differ."""


def parameter_row(model: CuttingModel) -> np.ndarray:
    """The numbers that a model gives the kernels, in the order of `Workspace.parameter_layout`."""
    return _row(_parameter_arrays(model))


def _parameter_arrays(model: CuttingModel) -> dict[str, np.ndarray]:
    volume = np.zeros((len(model.blocks), STRIP, LANES))
    volume.ravel()[model.element_place] = model.element_volume
    return {
        "P": np.array([model.parameters[name] for name in PARAMETERS]),
        "knife": model.knife.parameters(),
        "toughness": in_lanes(model.toughness),
        "flank_scale": in_lanes(model.flank_scale),
        "friction_scale": in_lanes(model.point_scales.friction),
        "unloading": in_lanes(model.unloading),
        "weight": model.weight,
        "relaxing": model.relaxing,
        "keep": model.keep,
        "mass": model.true_mass[model.moving],
        "stiff_volume": volume,
    }


def _initial_arrays(model: CuttingModel) -> dict[str, np.ndarray]:
    N, blocks = len(model.nodes), -(-len(model.point_nodes) // LANES)
    return {
        "x": model.nodes,
        "v": np.zeros((N, 3)),
        "edge_depth": np.full((blocks, LANES), -model.tables.reach),
        "skin_depth": np.full((blocks, LANES), -1.0),
        "last_skin_depth": np.full((blocks, LANES), -1.0),
        "cohesive_damage": np.zeros((blocks, LANES)),
        "edge_force": np.zeros((blocks, LANES)),
        "edge_direction": np.tile([[0.0], [0.0], [-1.0]], (blocks, 1, LANES)),
        "slip": np.zeros((blocks, 2, 3, LANES)),
        "board_slip": np.zeros((N, 3)),
        "overstress": np.zeros((len(model.relaxing), N, 3)),
        "blade": np.zeros(2),
        "front": np.zeros(layouts.numbers(layouts.FRONT)),
        "stepping": np.zeros(STEPPING),
    }


def _filled(values: np.ndarray, fill: float | None = None) -> np.ndarray:
    """Values by point [P, ...], filled up to whole blocks; with the last one by default."""
    more = np.full((-len(values) % LANES, *values.shape[1:]), values[-1] if fill is None else fill)
    return np.concatenate([values, more])


def in_lanes(values: np.ndarray, fill: float | None = None) -> np.ndarray:
    """Values by point [P, ...] as the kernels have them [B, ..., LANES]."""
    values = _filled(values, fill)
    return np.moveaxis(values.reshape(-1, LANES, *values.shape[1:]), 1, -1)


def _row(arrays: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([array.ravel() for array in arrays.values()])


def _shapes(arrays: dict[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in arrays.items()}


def _element_gather(model: CuttingModel) -> dict[str, np.ndarray]:
    """Places of each node's entries in the element forces, in rows of `GATHER`.

    Returns:
        First row of each node and the end [N + 1], and the rows [M, GATHER]; what is left of a row
        points behind the forces.
    """
    blocks = model.blocks
    row = np.arange(blocks.size // LANES).reshape(*blocks.shape[:2], 1)
    entry = 3 * LANES * row + np.arange(LANES)
    # What fills up strips and blocks has no force.
    used = np.zeros((len(blocks), STRIP, LANES), bool)
    used.ravel()[model.element_place] = True
    at = np.zeros(blocks.shape, bool)
    for k in range(STRIP):
        at[:, k : k + 4] |= used[:, k : k + 1]
    node, entry = blocks[at], entry[at]
    order = np.argsort(node, kind="stable")
    number = np.bincount(node, minlength=len(model.nodes))
    start = np.concatenate([[0], np.cumsum(-(-number // GATHER))])
    rank = np.arange(len(node)) - np.repeat(np.cumsum(number) - number, number)
    rows = np.full(start[-1] * GATHER, blocks.size * 3)
    rows[start[node[order]] * GATHER + rank] = entry[order]
    return {"element_start": start, "element_entry": rows.reshape(-1, GATHER)}


def _point_gather(
    point_nodes: np.ndarray, weights: np.ndarray, node_count: int
) -> dict[str, np.ndarray]:
    """Places of the cut-point forces that act on each node, and their weights."""
    block, lane = np.divmod(np.arange(len(point_nodes)), LANES)
    entry = (2 * block[:, None] + np.array([0, 0, 1, 1])) * 3 * LANES + lane[:, None]
    weight = np.tile(weights, (1, 2))
    use = weight > 0.0
    by_node = coo_array((weight[use], (point_nodes[use], entry[use]))).tocsr()
    by_node.resize(node_count, by_node.shape[1])
    return {
        "point_start": by_node.indptr,
        "point_entry": by_node.indices,
        "point_weight": by_node.data,
    }


def _device(name: str) -> Any:
    """The device of Warp's.

    Raises:
        ConfigurationError: There is none of that name on this machine.
    """
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        there = ", ".join(str(device) for device in wp.get_devices())
        raise ConfigurationError(
            f"there is no device {name!r} on this machine",
            field="numerics.device",
            fix=f"Give one of: {there}. A GPU needs NVIDIA's driver.",
        ) from error
