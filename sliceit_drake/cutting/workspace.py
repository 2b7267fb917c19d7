"""Device arrays of one or many cuts of one mesh, and the launches that advance them."""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.kernels import layouts
from sliceit_drake.cutting.kernels.precision import kernels
from sliceit_drake.cutting.kernels.types import GATHER, LANES, PARAMETERS
from sliceit_drake.cutting.model import CuttingModel, TimeStepError
from sliceit_drake.cutting.warp_start import start_warp

__all__ = ["LAUNCH_LOCK", "Workspace", "parameter_row"]

LAUNCH_LOCK = threading.RLock()
"""Held while kernels are made, in a capture, which takes in the launches of all threads, and in
launches outside of one."""


class Workspace:
    """Advances cuts that share a mesh by `coupling_steps` coupling steps a launch.

    Each cut C has parameters, motion and state of its own. A state is one row of `state_size`
    numbers: positions, velocities, history of the cut points, friction anchors, relaxation, blade.

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
        with LAUNCH_LOCK:
            start_warp()
            self.kernels = kernels(self.real, gradients)
        self.device = _device(model.numerics.device)
        self.model = model
        self._gradients = gradients
        self._graph: Any = None
        self._energy_graph: Any = None
        self._views: dict[tuple, np.ndarray] = {}
        # What is allocated during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            self._make_arrays()
        self._skin_thickness = model.effects.skin.thickness
        self.set_models(models)

    def array(self, shape: int | tuple[int, ...], dtype: Any = None) -> wp.array:
        """Zeros on the device, with room for their adjoint if gradients are kept."""
        dtype = dtype or self.real
        return wp.zeros(shape, dtype=dtype, device=self.device, requires_grad=self._gradients)

    def _view(
        self, rows: wp.array, start: int, dtype: Any, shape: tuple[int, ...], step: int = 0
    ) -> wp.array:
        """A view of rows of numbers [C, size] as an array [C, *shape].

        Args:
            rows: The rows.
            start: First number in a row.
            dtype: Type of the array.
            shape: Its shape without the first axis.
            step: Numbers from one entry to the next; an entry's own by default.
        """
        item = wp.types.type_size_in_bytes(rows.dtype)
        last = step * item or wp.types.type_size_in_bytes(dtype)
        inner = np.cumprod([last, *shape[:0:-1]])[::-1].tolist()
        return wp.array(
            ptr=rows.ptr + start * item,
            dtype=dtype,
            shape=(self.cuts, *shape),
            strides=(rows.strides[0], *inner),
            device=self.device,
            grad=None if rows.grad is None else self._view(rows.grad, start, dtype, shape, step),
        )

    def _rows(
        self, kind: Any, shapes: Mapping[str, tuple[int, ...]], dtype: Any = None
    ) -> tuple[wp.array, Any, dict[str, slice]]:
        """Rows of numbers [C, size] that hold the named arrays of a struct side by side.

        Args:
            kind: The struct.
            shapes: Shapes of the arrays without the first axis.
            dtype: Type of the numbers, the kernels' by default.

        Returns:
            The rows, a struct of views of them, and where each array stands in a row.
        """
        item = wp.types.type_size_in_bytes(dtype or self.real)
        layout, end = {}, 0
        for name, shape in shapes.items():
            width = wp.types.type_size_in_bytes(kind.vars[name].type.dtype) // item
            layout[name] = slice(end, end := end + int(np.prod(shape)) * width)
        rows, struct = self.array((self.cuts, end), dtype), kind()
        for name, shape in shapes.items():
            view = self._view(rows, layout[name].start, kind.vars[name].type.dtype, shape)
            setattr(struct, name, view)
        return rows, struct, layout

    def _constants(self, kind: Any, **values: Any) -> Any:
        """A struct of constant arrays and numbers."""
        struct = kind()
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                dtype = kind.vars[name].type.dtype
                value = wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)
            setattr(struct, name, value)
        return struct

    def _make_arrays(self) -> None:
        m, k, C, K = self.model, self.kernels, self.cuts, self.steps
        N, P, B, E = len(m.nodes), len(m.point_nodes), len(m.blocks), self.coupling_steps
        M = len(m.relaxing)

        element_start, element_entry = _element_gather(m.blocks, m.element_count, N)
        point_start, point_entry, point_weight = _point_gather(m.point_nodes, m.point_weights, N)
        self.mesh = self._constants(
            k.Mesh,
            nodes=m.blocks.astype(np.int32),
            shape=m.shape,
            moving=m.moving.astype(np.int32),
            element_start=element_start,
            element_entry=element_entry,
            point_start=point_start,
            point_entry=point_entry,
            point_weight=point_weight,
            board_area=m.board_area,
            board=m.board,
        )
        self.points = self._constants(
            k.Points,
            nodes=m.point_nodes.astype(np.int32),
            weights=m.point_weights,
            area=m.tables.area,
            width=m.tables.width,
            fraction=m.tables.fraction,
            centroid=m.tables.rise,
            outline=m.outline,
            depth=m.point_depth,
            reach=m.tables.reach,
            per_spacing=1.0 / m.tables.spacing,
        )
        parameters = {
            "P": (len(PARAMETERS),),
            "knife": (layouts.numbers(layouts.KNIFE),),
            "toughness": (P,),
            "flank_scale": (P,),
            "friction_scale": (P,),
            "unloading": (P,),
            "inverse_mass": (N,),
            "local_damping": (N,),
            "weight": (N,),
            "relaxing": (M,),
            "keep": (M,),
            "stiff_volume": (B,),
        }
        self.parameter_rows, self.parameters, self.parameter_layout = self._rows(
            k.Parameters, parameters
        )

        motion = dict.fromkeys(("R_CK", "p_CK", "v_CK", "w_CK"), (K,))
        self.motion_rows, self.motion, self.motion_layout = self._rows(k.Motion, motion)
        # At the ends of the coupling steps, as they are given.
        self.motion.R = wp.zeros((C, E + 1), dtype=wp.mat33d, device=self.device)
        self.motion.p = wp.zeros((C, E + 1), dtype=wp.vec3d, device=self.device)
        self.motion.substeps, self.motion.period = self.substeps, self.exchange_period

        state = {
            "x": (N,),
            "v": (N,),
            "edge_depth": (P,),
            "cohesive_damage": (P,),
            "edge_force": (P,),
            "edge_direction": (P,),
            "slip": (P, 2),
            "board_slip": (N,),
            "overstress": (M, N),
            "blade": (2,),
        }
        # With gradients, sub-step k reads slot k and writes slot k + 1; otherwise all are one.
        slots = [self._rows(k.State, state) for _ in range(K + 1 if self._gradients else 1)]
        self.states, self.slots = [slot[0] for slot in slots], [slot[1] for slot in slots]
        self.layout = slots[0][2]
        self.state_size = self.states[0].shape[1]
        for slot in self.slots:
            slot.ahead = self.array((C, N), k.vec4)

        # Padded with a row of zeros, which fills up the nodes' lists of entries.
        size = B * 12 * LANES
        self.force = wp.zeros((C, size + 3 * LANES), dtype=self.real, device=self.device)
        # With gradients, what each sub-step gave the nodes is kept.
        forces = k.Forces()
        forces.elements = self._view(self.force, 0, k.Vectors, (B, 4))
        forces.rows = self._view(self.force, 0, k.strided, (size + 1,), step=1)
        forces.points = self.array((C, P, 2), k.vec3)
        # The same as one list, two entries a point.
        forces.listed = forces.points.reshape((C, 2 * P))
        forces.lateral = self.array((C, P))
        self.forces = [k.Forces() for _ in range(K if self._gradients else 1)]
        for kept in self.forces:
            kept.assign(forces)
            kept.push = self.array(C)
            if self._gradients:
                kept.from_elements = self.array((C, N), k.vec3)
                kept.from_bulk = self.array((C, N), k.vec3) if M else kept.from_elements
                kept.from_points = self.array((C, N), k.vec3)
        sums = {
            "total": (E, P, layouts.ACCUMULATED),
            "immersed": (E, P),
            "blade": (E, layouts.numbers(layouts.BLADE_SUMS)),
            "board_force": (N,),
            "board_loss": (N,),
            "internal_work": (N,),
        }
        self.sum_rows, self.sums, self.sum_layout = self._rows(k.Sums, sums)
        self._result_type = layouts.results(E)
        shapes = {
            name: layouts.field_shape(self._result_type, name)
            for name in self._result_type.names or ()
        }
        self._result_rows, self._results, _ = self._rows(k.Results, shapes, wp.float64)
        self._energies = k.Energies()
        self._energies.elastic = self.array((C, B, LANES))
        self._energies.volume_ratio = self.array((C, B, LANES))
        self._energies.points = self.array((C, P))

    def set_models(self, models: Sequence[CuttingModel]) -> None:
        """Takes the parameters of other cuts of the same mesh, one for each row."""
        if len(models) != self.cuts:
            raise ValueError(f"{len(models)} models for {self.cuts} cuts")
        thickness = models[0].effects.skin.thickness
        for model in models:
            if (
                model.split is not self.model.split
                or len(model.relaxing) != len(self.model.relaxing)
                or model.effects.skin.thickness != thickness
            ):
                raise ValueError(
                    "the cuts must be derived from one model and have as many relaxation times and "
                    "the same thickness of skin"
                )
        if thickness != self._skin_thickness:
            self._skin_thickness = thickness
            with LAUNCH_LOCK:
                self.points.outline.assign(models[0].outline.astype(self.dtype))
        self.models = tuple(models)
        self.write(self.parameter_rows, np.array([parameter_row(m) for m in models]))

    def initial_state(self) -> np.ndarray:
        """The food at rest, to be cut downwards [state_size]."""
        state = np.zeros(self.state_size, self.dtype)
        state[self.layout["x"]] = self.model.nodes.ravel()
        state[self.layout["edge_depth"]] = -self.model.tables.reach
        state[self.layout["edge_direction"]].reshape(-1, 3)[:, 2] = -1.0
        return state

    def results(self) -> np.ndarray:
        """A copy of what the last launch gave, by name [C]; see `layouts.results`."""
        return self.read(self._result_rows).copy().view(self._result_type)[:, 0]

    def write(self, array: wp.array, values: np.ndarray) -> None:
        """Sets an array from host memory."""
        if self.device.is_cpu:
            self.read(array)[...] = values
        else:
            array.assign(values)

    def read(self, array: wp.array) -> np.ndarray:
        """An array in host memory; on the CPU a view, made once."""
        if not self.device.is_cpu:
            return array.numpy()
        key = (array.ptr, array.shape)
        if key not in self._views:
            self._views[key] = array.numpy()
        return self._views[key]

    def launch(self, kernel: Any, dim: int, inputs: list[Any]) -> None:
        """Launches `kernel` over cuts and `dim` entries of each."""
        wp.launch(kernel, dim=(self.cuts, dim), inputs=inputs, device=self.device)

    def launch_many(self, kernel: Any, count: int, inputs: list[Any]) -> None:
        """Launches `kernel` over cuts and `count` entries: on a CPU all in one thread.

        A thread's start, which copies the kernel's arguments, costs a CPU more than a node does.
        """
        threads, per_thread = self.threads(count)
        self.launch(kernel, threads, [*inputs, per_thread])

    def threads(self, count: int) -> tuple[int, int]:
        """Threads for `count` entries, and entries of each."""
        return (1, count) if self.device.is_cpu else (count, 1)

    def substep_time(self) -> Any:
        """The sub-step as the kernels take it, s."""
        return self.real(self.exchange_period / self.substeps)

    def look_ahead_arguments(self, k: int = 0) -> list[Any]:
        """Arguments of `look_ahead` from the first sub-step to the k-th."""
        return [self.slots[0], self.parameters, self.slots[k]]

    def launch_elements(self, k: int) -> None:
        """Forces of the elements at the beginning of sub-step k."""
        now, _, forces = self._substep(k)
        inputs = [now, self.mesh, self.parameters, forces.elements]
        self.launch_many(self.kernels.elements, len(self.model.blocks), inputs)

    def _substep(self, k: int) -> tuple[Any, Any, Any]:
        """State before and after sub-step k, and its forces."""
        if self._gradients:
            return self.slots[k], self.slots[k + 1], self.forces[k]
        return self.slots[0], self.slots[0], self.forces[0]

    def point_arguments(self, k: int, dt: Any) -> list[Any]:
        """Arguments of `step_points` in sub-step k."""
        given = [self.points, self.parameters, self.motion]
        return [k, dt, *given, *self._substep(k), self.sums]

    def relax_arguments(self, k: int) -> list[Any]:
        """Arguments of `relax_nodes` in sub-step k."""
        return [self.mesh, self.parameters, *self._substep(k)]

    def step_arguments(self, k: int) -> list[Any]:
        """Arguments of `step_nodes` in sub-step k."""
        given = [self.mesh, self.parameters]
        return [self.substep_time(), *given, *self._substep(k), self.sums]

    def blade_arguments(self, k: int) -> list[Any]:
        """Arguments of `bend_blade` in sub-step k."""
        head = [k // self.substeps, self.substep_time(), self.parameters]
        return [*head, *self._substep(k), self.sums]

    def launch_substep(self, k: int) -> None:
        """One sub-step."""
        kern, nodes = self.kernels, len(self.model.moving)
        now, _, forces = self._substep(k)
        self.launch_elements(k)
        points = self.point_arguments(k, self.substep_time())
        self.launch_many(kern.step_points, len(self.model.point_nodes), points)
        if self._gradients:
            self.launch_many(kern.gather, nodes, [self.mesh, forces])
            if len(self.model.relaxing):
                self.launch_many(kern.relax_nodes, nodes, self.relax_arguments(k))
            self.launch_many(kern.step_nodes, nodes, self.step_arguments(k))
        else:
            given = [self.substep_time(), self.mesh, self.parameters]
            self.launch_many(kern.move_nodes, nodes, [*given, now, forces, self.sums])
        for kernel, arguments in (
            (kern.push_blade, [forces]),
            (kern.bend_blade, self.blade_arguments(k)),
        ):
            wp.launch(kernel, dim=self.cuts, inputs=arguments, device=self.device)

    def capture(self) -> None:
        """Compiles the kernels, once a machine, and captures a launch as a graph."""
        if self._graph is not None:
            return
        with LAUNCH_LOCK:
            self._graph = self._captured()

    def _captured(self) -> Any:
        kern, C, E = self.kernels, self.cuts, self.coupling_steps
        wp.load_module(kern.module, device=self.device)
        with wp.ScopedCapture(device=self.device) as capture:
            self.sum_rows.zero_()
            self.launch(kern.move_knife, self.steps, [self.motion])
            # Later sub-steps need it for held nodes only, which never move.
            for k in range(len(self.slots)):
                nodes = len(self.model.nodes)
                self.launch(kern.look_ahead, nodes, self.look_ahead_arguments(k))
            for k in range(self.steps):
                self.launch_substep(k)
            wp.launch(
                kern.add_points,
                dim=(C, E, layouts.numbers(layouts.POINT_SUMS)),
                inputs=[self.sums, self._results],
                device=self.device,
            )
            numbers = layouts.numbers(layouts.NODE_SUMS)
            self.launch(kern.add_nodes, numbers, [self.sums, self._results])
            self.launch(kern.knife_wrenches, E, [self.sums, self.motion, self._results])
        return capture.graph

    def advance(self, states: np.ndarray, R: np.ndarray, p: np.ndarray) -> None:
        """Advances all cuts by the workspace's coupling steps.

        The new states are in `states[-1]`, the rest in `result`.

        Args:
            states: [C, state_size].
            R: Rotations of the knives in C at the ends of the coupling steps [C, E + 1, 3, 3].
            p: Positions of Ko there [C, E + 1, 3], metres.
        """
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
            with LAUNCH_LOCK:
                self._energy_graph = self._captured_energies()
        wp.capture_launch(self._energy_graph)
        elastic = self.read(self._energies.elastic)[0].sum(dtype=np.float64)
        ratio = self.read(self._energies.volume_ratio)[0].ravel()[: self.model.element_count].copy()
        interface = self.read(self._energies.points)[0].sum(dtype=np.float64)
        return float(elastic), ratio, float(interface)

    def _captured_energies(self) -> Any:
        kern, device, state = self.kernels, self.device, self.slots[0]
        elements = [state, self.mesh, self.parameters, self._energies]
        points = [self.points, self.parameters, self.motion, state, self._energies]
        dim = (self.cuts, len(self.model.blocks), LANES)
        wp.load_module(kern.module, device=device)
        with wp.ScopedCapture(device=device) as capture:
            wp.launch(kern.element_energy, dim=dim, inputs=elements, device=device)
            self.launch(kern.point_energy, len(self.model.point_nodes), points)
        return capture.graph

    def place_knife(
        self, R: Any, p: Any, v: Any = (0.0, 0.0, 0.0), w: Any = (0.0, 0.0, 0.0)
    ) -> None:
        """Gives all knives one pose in C, velocity of Ko and angular velocity."""
        for name, value in zip(("R_CK", "p_CK", "v_CK", "w_CK"), (R, p, v, w), strict=True):
            array = getattr(self.motion, name)
            self.write(array, np.broadcast_to(value, (*array.shape, *np.shape(value))))

    def point_forces(self) -> np.ndarray:
        """Forces on both faces at the cut points of the first cut [P, 2, 3], N."""
        # A step of no duration changes no history that another call reads.
        points = self.point_arguments(0, self.real(0.0))
        with LAUNCH_LOCK:
            self.launch_many(self.kernels.step_points, len(self.model.point_nodes), points)
        return np.array(self.forces[0].points.numpy()[0], np.float64)


def parameter_row(model: CuttingModel) -> np.ndarray:
    """The numbers that a model gives the kernels, in the order of `Workspace.parameter_layout`."""
    inverse_mass = np.zeros(len(model.nodes))
    inverse_mass[model.moving] = 1.0 / model.mass[model.moving]
    volume = model.in_blocks(model.element_volume).reshape(-1)
    volume = np.where(np.arange(len(volume)) < model.element_count, volume, 0.0)
    scales = model.point_scales
    return np.concatenate(
        [
            [model.parameters[name] for name in PARAMETERS],
            model.knife.parameters(),
            model.toughness,
            scales.flank_stiffness,
            scales.friction,
            model.unloading,
            inverse_mass,
            model.local_damping,
            model.weight.ravel(),
            model.relaxing,
            model.keep,
            volume,
        ]
    )


def _element_gather(
    blocks: np.ndarray, count: int, node_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places of each node's entries in the element forces, in rows of `GATHER`.

    Returns:
        First row of each node and the end [N + 1], and the rows [M, GATHER]; what is left of a row
        points behind the forces.
    """
    B = len(blocks)
    entry = (
        np.arange(B)[:, None, None] * 12 * LANES
        + np.arange(4)[None, :, None] * 3 * LANES
        + np.arange(LANES)[None, None, :]
    )
    real = (np.arange(B)[:, None, None] * LANES + np.arange(LANES)[None, None, :]) < count
    real = np.broadcast_to(real, blocks.shape)
    node, entry = blocks[real], entry[real]
    order = np.argsort(node, kind="stable")
    number = np.bincount(node, minlength=node_count)
    start = np.concatenate([[0], np.cumsum(-(-number // GATHER))])
    rank = np.arange(len(node)) - np.repeat(np.cumsum(number) - number, number)
    rows = np.full(start[-1] * GATHER, B * 12 * LANES)
    rows[start[node[order]] * GATHER + rank] = entry[order]
    return start.astype(np.int32), rows.reshape(-1, GATHER).astype(np.int32)


def _point_gather(
    point_nodes: np.ndarray, weights: np.ndarray, node_count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut-point forces (2 point + side) that act on each node, and their weights."""
    P = len(point_nodes)
    entry = 2 * np.arange(P)[:, None] + np.array([0, 0, 1, 1])
    weight = np.tile(weights, (1, 2))
    use = weight > 0.0
    node, entry, weight = point_nodes[use], entry[use], weight[use]
    order = np.argsort(node, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=node_count))])
    return start.astype(np.int32), entry[order].astype(np.int32), weight[order]


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
