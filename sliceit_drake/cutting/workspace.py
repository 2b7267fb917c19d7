"""Device arrays of one or many cuts of one mesh, and the launches that advance them."""

import threading
from collections.abc import Sequence
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

PER_POINT = ("toughness", "flank_scale", "friction_scale", "unloading")
"""Parameters that each cut point has for itself, in the order of the kernels' arguments."""


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
        self._views: dict[int, np.ndarray] = {}
        # What is allocated during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            self._make_arrays()
        self._skin_thickness = model.effects.skin.thickness
        self.set_models(models)

    def array(self, shape: int | tuple[int, ...]) -> wp.array:
        """Zeros on the device, with room for their adjoint if gradients are kept."""
        return wp.zeros(shape, dtype=self.real, device=self.device, requires_grad=self._gradients)

    def _constant(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def _rows(
        self, base: wp.array, fields: Sequence[tuple[str, tuple[int, ...], Any, int]]
    ) -> tuple[dict[str, wp.array], dict[str, slice]]:
        """Splits rows of numbers [C, size] into named arrays [C, ...] of vectors.

        Args:
            base: Array [C, size].
            fields: Name, shape without the first axis, type and numbers in one of that type.

        Returns:
            The arrays, and where each stands in a row.
        """
        item = wp.types.type_size_in_bytes(base.dtype)
        arrays, layout, start = {}, {}, 0
        for name, shape, dtype, width in fields:
            strides = [width * item]
            for extent in shape[:0:-1]:
                strides.insert(0, strides[0] * extent)

            def view(values: wp.array, grad: wp.array | None) -> wp.array:
                return wp.array(
                    ptr=values.ptr + start * item,  # noqa: B023
                    dtype=dtype,  # noqa: B023
                    shape=(self.cuts, *shape),  # noqa: B023
                    strides=(values.strides[0], *strides),  # noqa: B023
                    device=self.device,
                    grad=grad,
                )

            arrays[name] = view(base, None if base.grad is None else view(base.grad, None))
            size = int(np.prod(shape)) * width
            layout[name] = slice(start, start + size)
            start += size
        assert start == base.shape[1]
        return arrays, layout

    def _make_arrays(self) -> None:
        m, k, C, K = self.model, self.kernels, self.cuts, self.steps
        N, P, B, E = len(m.nodes), len(m.point_nodes), len(m.blocks), self.coupling_steps
        M = len(m.relaxing)
        real, vec3 = self.real, k.vec3

        fields = [
            ("x", (N,), vec3, 3),
            ("v", (N,), vec3, 3),
            ("edge_depth", (P,), real, 1),
            ("cohesive_damage", (P,), real, 1),
            ("edge_force", (P,), real, 1),
            ("edge_direction", (P,), vec3, 3),
            ("slip", (P, 2), vec3, 3),
            ("board_slip", (N,), vec3, 3),
            ("overstress", (M, N), vec3, 3),
            ("blade", (2,), real, 1),
        ]
        self.state_size = sum(int(np.prod(shape)) * width for _, shape, _, width in fields)
        # With gradients, sub-step k reads slot k and writes slot k + 1; otherwise all are one.
        slots = K + 1 if self._gradients else 1
        self.states = [self.array((C, self.state_size)) for _ in range(slots)]
        split = [self._rows(state, fields) for state in self.states]
        self.slots = [arrays for arrays, _ in split]
        self.layout = split[0][1]
        kept = K + 1 if self._gradients else 1
        self.ahead = [self._vectors(N, k.vec4) for _ in range(kept)]
        # What each sub-step's nodes got from elements, bulk (elements after relaxation) and points.
        self.from_elements, self.from_bulk, self.from_points = (
            [self._vectors(N, vec3) for _ in range(K if self._gradients else 0)] for _ in range(3)
        )

        if M == 0:
            self.from_bulk = self.from_elements

        self.motion = self.array((C, 18 * K))
        motion = [("R_CK", k.mat33, 9), ("p_CK", vec3, 3), ("v_CK", vec3, 3), ("w_CK", vec3, 3)]
        self.w, self.motion_layout = self._rows(
            self.motion, [(name, (K,), dtype, width) for name, dtype, width in motion]
        )
        # At the ends of the coupling steps, as they are given.
        self.w["R"] = wp.zeros((C, E + 1), dtype=wp.mat33d, device=self.device)
        self.w["p"] = wp.zeros((C, E + 1), dtype=wp.vec3d, device=self.device)
        # Padded with a row of zeros, which fills up the nodes' lists of entries.
        self.force = wp.zeros((C, (B * 12 + 3) * LANES), dtype=real, device=self.device)
        item = np.dtype(self.dtype).itemsize
        row = self.force.strides[0]
        self.w["element_force"] = wp.array(
            ptr=self.force.ptr,
            dtype=k.lanes,
            shape=(C, B, 12),
            strides=(row, 12 * LANES * item, LANES * item),
            device=self.device,
        )
        self.w["node_force"] = wp.array(
            ptr=self.force.ptr,
            dtype=k.strided,
            shape=(C, B * 12 * LANES + 1),
            strides=(row, item),
            device=self.device,
        )
        sums = [
            ("total", (E, P, layouts.ACCUMULATED), real, 1),
            ("immersed", (E, P), k.vec4, 4),
            ("blade_sums", (E, layouts.numbers(layouts.BLADE_SUMS)), real, 1),
            ("board_force", (N,), vec3, 3),
            ("board_loss", (N,), real, 1),
            ("internal_work", (N,), real, 1),
        ]
        size = sum(int(np.prod(shape)) * width for _, shape, _, width in sums)
        self.sums = self.array((C, size))
        arrays, self.sum_layout = self._rows(self.sums, sums)
        self.w |= arrays
        double = wp.float64
        self._result_type = layouts.results(E)
        size = layouts.numbers(self._result_type)
        self._result_rows = wp.zeros((C, size), dtype=double, device=self.device)
        arrays, _ = self._rows(
            self._result_rows,
            [
                (name, layouts.field_shape(self._result_type, name), double, 1)
                for name in self._result_type.names or ()
            ],
        )
        self.w |= arrays
        self.w["point_force"] = wp.zeros(
            (C, P, 2), dtype=vec3, device=self.device, requires_grad=self._gradients
        )
        # The same as one list, two entries a point.
        self.w["listed_force"] = self.w["point_force"].reshape((C, 2 * P))
        self.w["lateral"] = self.array((C, P))
        self.push = [self.array(C) for _ in range(K if self._gradients else 1)]
        self.w["energy"] = wp.zeros((C, B, LANES), dtype=real, device=self.device)
        self.w["volume_ratio"] = wp.zeros((C, B, LANES), dtype=real, device=self.device)
        self.w["point_energy"] = wp.zeros((C, P), dtype=real, device=self.device)

        element_start, element_entry = _element_gather(m.blocks, m.element_count, N)
        point_start, point_entry, point_weight = _point_gather(m.point_nodes, m.point_weights, N)
        constants: dict[str, tuple[np.ndarray, Any]] = {
            "nodes": (m.blocks.astype(np.int32), k.indices),
            "shape": (m.shape, k.lanes),
            "moving": (m.moving.astype(np.int32), wp.int32),
            "element_start": (element_start, wp.int32),
            "element_entry": (element_entry, k.entries),
            "point_start": (point_start, wp.int32),
            "point_entry": (point_entry, wp.int32),
            "point_weight": (point_weight, real),
            "board_area": (m.board_area, real),
            "board": (m.board, real),
            "point_nodes": (m.point_nodes.astype(np.int32), wp.int32),
            "point_weights": (m.point_weights, k.vec2),
            "area": (m.tables.area, real),
            "width": (m.tables.width, real),
            "fraction": (m.tables.fraction, real),
            "centroid": (m.tables.rise, real),
            "outline": (m.outline, real),
            "surface": (m.point_depth, real),
        }
        for name, (values, dtype) in constants.items():
            self.w[name] = self._constant(values, dtype)
        parameters = [
            ("P", (len(PARAMETERS),), real, 1),
            ("knife", (layouts.numbers(layouts.KNIFE),), real, 1),
            *((name, (P,), real, 1) for name in PER_POINT),
            ("inverse_mass", (N,), real, 1),
            ("local_damping", (N,), real, 1),
            ("weight", (N,), vec3, 3),
            ("relaxing", (M,), real, 1),
            ("keep", (M,), real, 1),
            ("stiff_volume", (B,), k.lanes, LANES),
        ]
        size = sum(int(np.prod(shape)) * width for _, shape, _, width in parameters)
        self.parameters = self.array((C, size))
        arrays, self.parameter_layout = self._rows(self.parameters, parameters)
        self.w |= arrays

    def _vectors(self, count: int, dtype: Any) -> wp.array:
        return wp.zeros(
            (self.cuts, count), dtype=dtype, device=self.device, requires_grad=self._gradients
        )

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
                self.w["outline"].assign(models[0].outline.astype(self.dtype))
        self.models = tuple(models)
        self.write(self.parameters, np.array([parameter_row(m) for m in models]))

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
        view = self._views.get(array.ptr)
        if view is None:
            view = self._views[array.ptr] = array.numpy()
        return view

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
        return [self.slots[0]["x"], self.slots[0]["v"], self.w["P"], self.ahead[k]]

    def launch_elements(self, k: int) -> None:
        """Forces of the elements at the beginning of sub-step k."""
        w, ahead = self.w, self.ahead[k if self._gradients else 0]
        inputs = [ahead, w["nodes"], w["shape"], w["stiff_volume"], w["P"], w["element_force"]]
        self.launch_many(self.kernels.elements, len(self.model.blocks), inputs)

    def point_arguments(self, k: int, dt: Any) -> list[Any]:
        """Arguments of `points` in sub-step k."""
        w, tables = self.w, self.model.tables
        now, after = self._slots(k)
        history = ("edge_depth", "cohesive_damage", "edge_force", "edge_direction", "slip")
        return (
            [now["x"], now["v"], w["point_nodes"], w["point_weights"]]
            + [w[name] for name in ("area", "width", "fraction", "centroid", "outline", "surface")]
            + [self.real(tables.reach), self.real(1.0 / tables.spacing)]
            + [w[name] for name in PER_POINT]
            + [w["P"], w["knife"], k, k // self.substeps, dt]
            + [w[name] for name in ("R_CK", "p_CK", "v_CK", "w_CK")]
            + [now["blade"], *(now[name] for name in history)]
            + [after[name] for name in history]
            + [w["point_force"], w["lateral"], w["immersed"], w["total"]]
        )

    def _slots(self, k: int) -> tuple[dict[str, wp.array], dict[str, wp.array]]:
        return (self.slots[k], self.slots[k + 1]) if self._gradients else (self.slots[0],) * 2

    def _push(self, k: int) -> wp.array:
        return self.push[k if self._gradients else 0]

    def relax_arguments(self, k: int) -> list[Any]:
        """Arguments of `relax_nodes` in sub-step k."""
        w = self.w
        now, after = self._slots(k)
        head = [w["moving"], self.from_elements[k], w["relaxing"], w["keep"]]
        return [*head, now["overstress"], after["overstress"], self.from_bulk[k]]

    def step_arguments(self, k: int) -> list[Any]:
        """Arguments of `step_nodes` in sub-step k."""
        w = self.w
        now, after = self._slots(k)
        return (
            [now["x"], now["v"], w["moving"], self.from_bulk[k], self.from_points[k]]
            + [
                w["inverse_mass"],
                w["local_damping"],
                w["weight"],
                w["board_area"],
                w["board"],
                w["P"],
            ]
            + [self.substep_time(), now["board_slip"], after["board_slip"]]
            + [w["board_force"], w["board_loss"], w["internal_work"]]
            + [after["x"], after["v"], self.ahead[k + 1]]
        )

    def blade_arguments(self, k: int) -> list[Any]:
        """Arguments of `bend_blade` in sub-step k."""
        w = self.w
        now, after = self._slots(k)
        head = [self._push(k), w["P"], k // self.substeps, self.substep_time()]
        return [*head, now["blade"], after["blade"], w["blade_sums"]]

    def launch_substep(self, k: int) -> None:
        """One sub-step."""
        w, kern, m, C = self.w, self.kernels, self.model, self.cuts
        self.launch_elements(k)
        points = self.point_arguments(k, self.substep_time())
        self.launch_many(kern.points, len(m.point_nodes), points)
        gathered = [w["node_force"], w["element_start"], w["element_entry"], w["listed_force"]]
        gathered += [w["point_start"], w["point_entry"], w["point_weight"]]
        if self._gradients:
            outputs = [self.from_elements[k], self.from_points[k]]
            self.launch_many(kern.gather, len(m.moving), [w["moving"], *gathered, *outputs])
            if len(m.relaxing):
                self.launch_many(kern.relax_nodes, len(m.moving), self.relax_arguments(k))
            self.launch_many(kern.step_nodes, len(m.moving), self.step_arguments(k))
        else:
            now = self.slots[0]
            self.launch_many(
                kern.move_nodes,
                len(m.moving),
                [now["x"], now["v"], w["moving"], *gathered]
                + [w["inverse_mass"], w["local_damping"], w["weight"], w["relaxing"], w["keep"]]
                + [w["board_area"], w["board"], w["P"], self.substep_time()]
                + [now["overstress"], now["board_slip"]]
                + [w["board_force"], w["board_loss"], w["internal_work"], self.ahead[0]],
            )
        for kernel, arguments in (
            (kern.push_blade, [w["lateral"], self._push(k)]),
            (kern.bend_blade, self.blade_arguments(k)),
        ):
            wp.launch(kernel, dim=C, inputs=arguments, device=self.device)

    def capture(self) -> None:
        """Compiles the kernels, once a machine, and captures a launch as a graph."""
        if self._graph is not None:
            return
        with LAUNCH_LOCK:
            self._graph = self._captured()

    def _captured(self) -> Any:
        wp.load_module(self.kernels.module, device=self.device)
        with wp.ScopedCapture(device=self.device) as capture:
            self.sums.zero_()
            self._launch_motion()
            # Later sub-steps need it for held nodes only, which never move.
            for k in range(len(self.ahead)):
                arguments = self.look_ahead_arguments(k)
                self.launch(self.kernels.look_ahead, len(self.model.nodes), arguments)
            for k in range(self.steps):
                self.launch_substep(k)
            self._launch_results()
        return capture.graph

    def _timing(self) -> list[Any]:
        return [self.substeps, wp.float64(self.exchange_period)]

    def _launch_motion(self) -> None:
        """The knife's motion, from its poses at the ends of the coupling steps."""
        w, motion = self.w, [self.w[name] for name in ("R_CK", "p_CK", "v_CK", "w_CK")]
        self.launch(self.kernels.move_knife, self.steps, [w["R"], w["p"], *self._timing(), *motion])

    def _launch_results(self) -> None:
        """Launches the sums of the coupling steps."""
        w, kern, C, E = self.w, self.kernels, self.cuts, self.coupling_steps
        outputs = [w["blade"], w["wrenches"], w["work"]]
        wp.launch(
            kern.add_points,
            dim=(C, E, layouts.numbers(layouts.POINT_SUMS)),
            inputs=[w["total"], w["immersed"], w["point_sums"]],
            device=self.device,
        )
        at_nodes = [w["board_force"], w["board_loss"], w["internal_work"], w["node_sums"]]
        self.launch(kern.add_nodes, layouts.numbers(layouts.NODE_SUMS), at_nodes)
        sums = [w["point_sums"], w["blade_sums"], w["R"], w["p"]]
        self.launch(kern.knife_wrenches, E, [*sums, *self._timing(), *outputs])

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
        self.write(self.w["R"], R)
        self.write(self.w["p"], p)
        wp.capture_launch(self._graph)

    def stored_energies(self) -> tuple[float, np.ndarray, float]:
        """Elastic energy, volume ratios [T] and energy of the cut points of the first cut, J."""
        if self._energy_graph is None:
            with LAUNCH_LOCK:
                self._energy_graph = self._captured_energies()
        wp.capture_launch(self._energy_graph)
        elastic = self.read(self.w["energy"])[0].sum(dtype=np.float64)
        ratio = self.read(self.w["volume_ratio"])[0].ravel()[: self.model.element_count].copy()
        interface = self.read(self.w["point_energy"])[0].sum(dtype=np.float64)
        return float(elastic), ratio, float(interface)

    def _captured_energies(self) -> Any:
        w, now, tables, C = self.w, self.slots[0], self.model.tables, self.cuts
        B, P = len(self.model.blocks), len(self.model.point_nodes)
        elements = [now["x"], w["nodes"], w["shape"], w["stiff_volume"], w["P"]]
        elements += [w["energy"], w["volume_ratio"]]
        points = (
            [now["x"], w["point_nodes"], w["point_weights"], w["area"], w["fraction"]]
            + [w["centroid"], self.real(tables.reach), self.real(1.0 / tables.spacing)]
            + [w["toughness"], w["flank_scale"], w["unloading"], w["P"], w["knife"]]
            + [w["R_CK"], w["p_CK"], 0, now["blade"]]
            + [now[name] for name in ("edge_depth", "cohesive_damage", "edge_force", "slip")]
            + [w["point_energy"]]
        )
        energy, device = self.kernels.element_energy, self.device
        wp.load_module(self.kernels.module, device=device)
        with wp.ScopedCapture(device=device) as capture:
            wp.launch(energy, dim=(C, B, LANES), inputs=elements, device=device)
            self.launch(self.kernels.point_energy, P, points)
        return capture.graph

    def point_forces(self) -> np.ndarray:
        """Forces on both faces at the cut points of the first cut [P, 2, 3], N."""
        # A step of no duration changes no history that another call reads.
        points = self.point_arguments(0, self.real(0.0))
        with LAUNCH_LOCK:
            self.launch_many(self.kernels.points, len(self.model.point_nodes), points)
        return np.array(self.w["point_force"].numpy()[0], np.float64)


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
