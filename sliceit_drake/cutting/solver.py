"""Advances the food through one exchange: captured Warp graphs on a workspace, state in NumPy."""

import dataclasses as dc
import threading
from typing import Any

import numpy as np
import warp as wp

from sliceit_drake.cutting.kernels import ACCUMULATED, GATHER, LANES, PARAMETERS, kernels
from sliceit_drake.cutting.model import CuttingModel, TimeStepError
from sliceit_drake.cutting.motion import Pose

__all__ = ["CuttingError", "CuttingSolver", "Energies", "Exchange"]


class CuttingError(RuntimeError):
    """The cut became unphysical; the message names time, element and cause."""


@dc.dataclass
class Exchange:
    """What one exchange gives. Wrenches act on the knife, at Ko at the end of the exchange, in C.

    Attributes:
        state: The food's new state.
        wrench: Mean moment about Ko and force [6], Nm and N.
        edge, normal, friction: The same, by mechanism; they sum to `wrench`.
        work: Work done by the knife on the food, J.
        edge_dissipation, opening_dissipation, friction_dissipation: J, each never negative.
        internal_work: Work of the bulk's forces (elastic and damping) on the nodes, J.
        blade_dissipation: In the bending blade, J.
        board_force: Mean force of the board on the food [3], N.
        board_dissipation: Friction and damping of the food on the board, J.
        gravity_work: Work of the weight, J.
        cut: Share of the section that the edge has passed.
    """

    state: np.ndarray
    wrench: np.ndarray
    edge: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    work: float
    edge_dissipation: float
    opening_dissipation: float
    friction_dissipation: float
    internal_work: float
    blade_dissipation: float
    board_force: np.ndarray
    board_dissipation: float
    gravity_work: float
    cut: float


@dc.dataclass
class Energies:
    """Energies of a state, J.

    Attributes:
        elastic: Of the bulk.
        interface: Of bonds, contacts, friction anchors and the edge's unloading.
        kinetic: Of the stepped (scaled) mass.
        least_volume_ratio: Smallest J of all elements.
        least_element: Its element.
    """

    elastic: float
    interface: float
    kinetic: float
    least_volume_ratio: float
    least_element: int


class CuttingSolver:
    """Steps the state of one `CuttingModel`.

    The state is one contiguous array [state_size]: positions, velocities, history of the cut
    points, friction anchors, blade deflection. A call copies it into the workspace that the
    captured graph is bound to and copies the result out; nothing is carried between calls.

    Args:
        model: The cut.
        exchange_period: Duration of one `exchange`, s; the time step must divide it.

    Raises:
        TimeStepError: The time step does not divide the exchange period.
    """

    def __init__(self, model: CuttingModel, exchange_period: float) -> None:
        self.model = model
        self.exchange_period = exchange_period
        dt = model.numerics.time_step
        self.substeps = max(1, round(exchange_period / dt))
        if abs(self.substeps * dt - exchange_period) > 1e-6 * exchange_period:
            raise TimeStepError(
                f"numerics.time_step = {dt:g} s does not divide the exchange period "
                f"{exchange_period:g} s. Give {exchange_period / self.substeps:g}."
            )
        self.real = wp.float32 if model.numerics.precision == "float32" else wp.float64
        self.dtype = np.float32 if model.numerics.precision == "float32" else np.float64
        self._kernels = kernels(self.real)
        self._device = wp.get_device(model.numerics.device)
        self._lock = threading.Lock()
        self._graph: Any = None
        self._views: dict[int, np.ndarray] = {}
        self._build()

    def _array(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _build(self) -> None:
        m, k = self.model, self._kernels
        N, P, n = len(m.nodes), len(m.point_nodes), self.substeps
        real, vec3 = k.real, k.vec3

        fields = [
            ("x", N, vec3, 3),
            ("v", N, vec3, 3),
            ("passed", P, real, 1),
            ("parted", P, real, 1),
            ("edge_force", P, real, 1),
            ("heading", P, vec3, 3),
            ("slip", 2 * P, vec3, 3),
            ("board_slip", N, vec3, 3),
            ("blade", 2, real, 1),
        ]
        self._layout, offset = {}, 0
        for name, count, _, width in fields:
            self._layout[name] = slice(offset, offset + count * width)
            offset += count * width
        self.state_size = offset
        self._state = wp.zeros(offset, dtype=real, device=self._device)
        self._w = {
            name: self._view(self._state, self._layout[name].start, dtype, count)
            for name, count, dtype, _ in fields
        }
        self._w["slip"] = self._w["slip"].reshape((P, 2))

        motion = [("R_CK", k.mat33, 9), ("p_CK", vec3, 3), ("v_CK", vec3, 3), ("w_CK", vec3, 3)]
        self._motion = wp.zeros(n * sum(w for _, _, w in motion), dtype=real, device=self._device)
        start = 0
        for name, dtype, width in motion:
            self._w[name] = self._view(self._motion, start, dtype, n)
            start += n * width

        B = len(m.blocks)
        # Padded with a row of zeros, which fills up the nodes' lists of entries.
        self._force = wp.zeros((B * 12 + 3) * LANES, dtype=real, device=self._device)
        self._w["element_force"] = self._view(self._force, 0, k.lanes, B * 12).reshape((B, 12))
        self._w["node_force"] = wp.array(
            ptr=self._force.ptr,
            dtype=k.strided,
            shape=(B * 12 * LANES + 1,),
            strides=(np.dtype(self.dtype).itemsize,),
            device=self._device,
        )
        # Sums over an exchange, contiguous so that one call clears and one call reads them.
        sums = [
            ("total", P * ACCUMULATED, real, 1),
            ("board_force", N, vec3, 3),
            ("board_loss", N, real, 1),
            ("internal_work", N, real, 1),
            ("blade_sums", 3, real, 1),
        ]
        self._sums = wp.zeros(sum(c * w for _, c, _, w in sums), dtype=real, device=self._device)
        start = 0
        self._sum_layout = {}
        for name, count, dtype, width in sums:
            self._w[name] = self._view(self._sums, start, dtype, count)
            self._sum_layout[name] = slice(start, start + count * width)
            start += count * width
        self._w["total"] = self._w["total"].reshape((P, ACCUMULATED))

        self._w["ahead"] = wp.zeros(N, dtype=vec3, device=self._device)
        self._w["point_force"] = wp.zeros((P, 2), dtype=vec3, device=self._device)
        self._w["lateral"] = wp.zeros(P, dtype=real, device=self._device)
        self._w["energy"] = wp.zeros((B, LANES), dtype=real, device=self._device)
        self._w["volume_ratio"] = wp.zeros((B, LANES), dtype=real, device=self._device)
        self._w["point_energy"] = wp.zeros(P, dtype=real, device=self._device)

        inverse_mass = np.zeros(N)
        inverse_mass[m.moving] = 1.0 / m.mass[m.moving]
        element_start, element_entry = _element_gather(m.blocks, m.element_count, N)
        point_start, point_entry, point_weight = _point_gather(m.point_nodes, m.point_weights, N)
        arrays: dict[str, tuple[np.ndarray, Any]] = {
            "nodes": (m.blocks.astype(np.int32), k.indices),
            "moving": (m.moving.astype(np.int32), wp.int32),
            "element_start": (element_start, wp.int32),
            "element_entry": (element_entry, k.entries),
            "point_start": (point_start, wp.int32),
            "point_entry": (point_entry, wp.int32),
            "point_weight": (point_weight, real),
            "inverse_mass": (inverse_mass, real),
            "weight": (m.weight, vec3),
            "board_area": (m.board_area, real),
            "board": (m.board, real),
            "point_nodes": (m.point_nodes.astype(np.int32), wp.int32),
            "point_weights": (m.point_weights, k.vec2),
            "area": (m.tables.area, real),
            "toughness": (m.toughness, real),
            "width": (m.tables.width, real),
            "fraction": (m.tables.fraction, real),
            "centroid": (m.tables.rise, real),
            "unloading": (m.unloading, real),
            "P": (np.array([m.parameters[name] for name in PARAMETERS]), real),
            "knife": (m.knife.parameters(), real),
        }
        for name, (values, dtype) in arrays.items():
            self._w[name] = self._array(values, dtype)
        # Rows of `shape` are eight-wide vectors.
        self._w["shape"] = self._array(m.shape, k.lanes)
        self._weight = m.weight.ravel().astype(self.dtype)
        self._ones = np.ones(N)
        self._share = np.arange(1, n + 1)[:, None] / n

    def _view(self, base: wp.array, start: int, dtype: Any, count: int) -> wp.array:
        return wp.array(
            ptr=base.ptr + start * np.dtype(self.dtype).itemsize,
            dtype=dtype,
            shape=(count,),
            device=self._device,
        )

    def initial_state(self) -> np.ndarray:
        """The food at rest, to be cut downwards [state_size]."""
        state = np.zeros(self.state_size, self.dtype)
        state[self._layout["x"]] = self.model.nodes.ravel()
        state[self._layout["passed"]] = -self.model.tables.reach
        state[self._layout["heading"]].reshape(-1, 3)[:, 2] = -1.0
        return state

    def positions(self, state: np.ndarray) -> np.ndarray:
        """Positions of the computed nodes in C [N, 3], metres."""
        return np.asarray(state[self._layout["x"]]).reshape(-1, 3)

    def velocities(self, state: np.ndarray) -> np.ndarray:
        """Velocities of the computed nodes in C [N, 3], m/s."""
        return np.asarray(state[self._layout["v"]]).reshape(-1, 3)

    def field(self, state: np.ndarray, name: str) -> np.ndarray:
        """A part of the state by name: x, v, passed, parted, edge_force, heading, slip, board_slip,
        blade."""
        return state[self._layout[name]]

    def _launch_substep(self, k: int) -> None:
        w, kern, m = self._w, self._kernels, self.model
        dt = self.real(self.exchange_period / self.substeps)
        self._launch_elements()
        self._launch_points(k, dt)
        self._launch(
            kern.move_nodes,
            len(m.moving),
            [w["x"], w["v"], w["moving"], w["node_force"], w["element_start"], w["element_entry"]]
            + [w["point_force"].flatten(), w["point_start"], w["point_entry"], w["point_weight"]]
            + [w["inverse_mass"], w["weight"], w["board_area"], w["board"], w["P"], dt]
            + [w["board_slip"], w["board_force"], w["board_loss"], w["internal_work"]]
            + [w["x"], w["v"], w["ahead"]],
        )
        blade = [w["lateral"], w["P"], dt, w["blade"], w["blade_sums"]]
        self._launch(kern.bend_blade, 1, blade)

    def _launch(self, kernel: Any, dim: int | tuple[int, int], inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)

    def _launch_look_ahead(self) -> None:
        w = self._w
        inputs = [w["x"], w["v"], w["P"], w["ahead"]]
        self._launch(self._kernels.look_ahead, len(self.model.nodes), inputs)

    def _launch_elements(self) -> None:
        w = self._w
        inputs = [w["ahead"], w["nodes"], w["shape"], w["P"], w["element_force"]]
        self._launch(self._kernels.elements, len(self.model.blocks), inputs)

    def _launch_points(self, k: int, dt: Any) -> None:
        w, tables = self._w, self.model.tables
        self._launch(
            self._kernels.points,
            len(self.model.point_nodes),
            [w["x"], w["v"], w["point_nodes"], w["point_weights"], w["area"], w["toughness"]]
            + [w["width"], w["fraction"], w["centroid"], w["unloading"]]
            + [self.real(tables.reach), self.real(1.0 / tables.spacing)]
            + [w["P"], w["knife"], k, dt]
            + [w[name] for name in ("R_CK", "p_CK", "v_CK", "w_CK")]
            + [w["blade"], w["passed"], w["parted"], w["edge_force"], w["heading"], w["slip"]]
            + [w["point_force"], w["lateral"], w["total"]],
        )

    def _place(self, pose: Pose) -> None:
        """Puts the knife at rest at `pose` for launches with k = 0."""
        n = self.substeps
        motion = np.zeros(18 * n, self.dtype)
        motion[:9] = pose.R.ravel()
        motion[9 * n : 9 * n + 3] = pose.p
        self._write(self._motion, motion)

    def _write(self, array: wp.array, values: np.ndarray) -> None:
        if self._device.is_cpu:
            self._read(array)[:] = values
        else:
            array.assign(values.astype(self.dtype))

    def _read(self, array: wp.array) -> np.ndarray:
        """The workspace array in host memory; on the CPU a view, made once."""
        if not self._device.is_cpu:
            return array.numpy()
        view = self._views.get(array.ptr)
        if view is None:
            view = self._views[array.ptr] = array.numpy()
        return view

    def compile(self) -> None:
        """Compiles the kernels, once a machine, and captures an exchange as a graph.

        `exchange` does so at its first call; call this before to keep it out of a measured time.
        """
        with self._lock:
            self._capture()

    def _capture(self) -> None:
        if self._graph is not None:
            return
        wp.load_module(self._kernels.elements.module, device=self._device)
        with wp.ScopedCapture(device=self._device) as capture:
            self._launch_look_ahead()
            for k in range(self.substeps):
                self._launch_substep(k)
        self._graph = capture.graph

    def exchange(self, state: np.ndarray, start: Pose, end: Pose) -> Exchange:
        """Advances the food while the knife moves from `start` to `end`.

        Args:
            state: The food's state [state_size]; not changed.
            start: Knife pose in C at the beginning.
            end: Knife pose in C at the end.

        Raises:
            CuttingError: A force is not finite, or the knife left the region that is modelled.
        """
        m, n, T = self.model, self.substeps, self.exchange_period
        motion, v, w = self._interpolate(start, end)
        with self._lock:
            self._capture()
            self._write(self._state, state)
            self._write(self._motion, motion)
            self._sums.zero_()
            wp.capture_launch(self._graph)
            new = self._read(self._state).copy()
            sums = self._read(self._sums).astype(np.float64)
        total = sums[self._sum_layout["total"]].reshape(-1, ACCUMULATED).sum(0)
        if not np.isfinite(total).all():
            raise CuttingError(
                "the knife's force is not finite: elements inverted or the step became unstable. "
                "Use a smaller numerics.time_step or a finer mesh near the cut."
            )
        impulse = total[:18] / n
        wrenches = [
            np.concatenate([impulse[9 + 3 * i : 12 + 3 * i], impulse[3 * i : 3 * i + 3]])
            for i in range(3)
        ]
        # The flanks push the blade, and the blade's spring and damper the knife's body. The
        # difference acts at the middle of the buried flanks.
        blade_loss, to_body, from_flanks = sums[self._sum_layout["blade_sums"]]
        lateral = (to_body - from_flanks) / n * end.R[:, 1]
        if total[22] > 0.0:
            x, y, z = (total[23:26] / total[22]).tolist()
            fx, fy, fz = lateral.tolist()
            wrenches[1][:3] += (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)
        wrenches[1][3:] += lateral
        wrench = wrenches[0] + wrenches[1] + wrenches[2]
        # Moments are about Ko at each sub-step; the mean position of Ko is half a period back.
        work = -float(wrench[3:] @ v + wrench[:3] @ w) * T
        nodes = self._layout["x"]
        return Exchange(
            state=new,
            wrench=wrench,
            edge=wrenches[0],
            normal=wrenches[1],
            friction=wrenches[2],
            work=work,
            edge_dissipation=float(total[18]),
            opening_dissipation=float(total[19]),
            friction_dissipation=float(total[20]),
            internal_work=float(sums[self._sum_layout["internal_work"]].sum()),
            blade_dissipation=float(blade_loss),
            board_force=self._ones @ sums[self._sum_layout["board_force"]].reshape(-1, 3) / n,
            board_dissipation=float(sums[self._sum_layout["board_loss"]].sum()),
            gravity_work=float(self._weight @ (new[nodes] - state[nodes])),
            cut=float(total[21]) / m.section_area,
        )

    def _interpolate(self, start: Pose, end: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Knife poses at the ends of the sub-steps, constant velocity and rotation rate.

        Rotation matrices are interpolated linearly: for a turn of angle a between exchanges they
        are orthonormal to a^2 / 8, 1e-6 at 1 rad/s and 2 ms.

        Returns:
            The kernels' motion buffer, velocity [3] of Ko and rotation rate [3].
        """
        n, T = self.substeps, self.exchange_period
        v = (end.p - start.p) / T
        R0, R1 = start.R, end.R
        dR = R1 @ R0.T
        w = np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]]) * (0.5 / T)
        motion = np.empty(18 * n, self.dtype)
        share = self._share
        motion[: 9 * n].reshape(n, 9)[:] = R0.ravel() + share * (R1 - R0).ravel()
        motion[9 * n : 12 * n].reshape(n, 3)[:] = start.p + share * (v * T)
        motion[12 * n : 15 * n].reshape(n, 3)[:] = v
        motion[15 * n : 18 * n].reshape(n, 3)[:] = w
        return motion, v, w

    def energies(self, state: np.ndarray, pose: Pose) -> Energies:
        """Energies of `state` with the knife at `pose`."""
        w, kern, m = self._w, self._kernels, self.model
        with self._lock:
            self._write(self._state, state)
            self._place(pose)
            self._launch(
                kern.element_energy,
                (len(m.blocks), LANES),
                [w["x"], w["nodes"], w["shape"], w["P"], w["energy"], w["volume_ratio"]],
            )
            self._launch(
                kern.point_energy,
                len(m.point_nodes),
                [w["x"], w["point_nodes"], w["point_weights"], w["area"], w["toughness"]]
                + [w["fraction"], w["centroid"], w["unloading"]]
                + [self.real(m.tables.reach), self.real(1.0 / m.tables.spacing)]
                + [w["P"], w["knife"], w["R_CK"], w["p_CK"], 0, w["blade"]]
                + [w["passed"], w["parted"], w["edge_force"], w["slip"], w["point_energy"]],
            )
            elastic = w["energy"].numpy().astype(np.float64).sum()
            ratio = w["volume_ratio"].numpy().ravel()[: m.element_count]
            least = int(ratio.argmin())
            least_ratio = float(ratio[least])
            interface = w["point_energy"].numpy().astype(np.float64).sum()
        depth = np.maximum(m.board[3] - self.positions(state) @ m.board[:3], 0.0)
        anchor = self.field(state, "board_slip").reshape(-1, 3)
        rest = 0.5 * m.parameters["board_stiffness"] * m.board_area
        interface += float(rest @ (depth**2 + (anchor**2).sum(1)))
        deflection, rate = (float(b) for b in self.field(state, "blade"))
        interface += 0.5 * m.parameters["blade_stiffness"] * deflection**2
        interface += 0.5 * m.parameters["blade_mass"] * rate**2
        v2 = (self.velocities(state)[m.moving].astype(np.float64) ** 2).sum(1)
        return Energies(
            elastic=float(elastic),
            interface=float(interface),
            kinetic=float(0.5 * m.mass[m.moving] @ v2),
            least_volume_ratio=least_ratio,
            least_element=least,
        )

    def held_reaction(self, state: np.ndarray, pose: Pose) -> np.ndarray:
        """Force of what holds the food on the food [3], N, in C, with the knife at `pose`."""
        w, m = self._w, self.model
        with self._lock:
            self._write(self._state, state)
            self._place(pose)
            self._launch_look_ahead()
            self._launch_elements()
            # A step of no duration changes no history; what it writes stays in the workspace.
            self._launch_points(0, self.real(0.0))
            forces = self._force.numpy()[: len(m.blocks) * 12 * LANES].astype(np.float64)
            point_forces = w["point_force"].numpy().astype(np.float64)
        held = np.ones(len(m.nodes), bool)
        held[m.moving] = False
        at_held = held[m.blocks]
        on_held = (forces.reshape(-1, 4, 3, LANES) * at_held[:, :, None, :]).sum((0, 1, 3))
        share = (held[m.point_nodes].reshape(-1, 2, 2) * m.point_weights[:, None, :]).sum(2)
        on_held += (point_forces * share[:, :, None]).sum((0, 1)) + m.weight[held].sum(0)
        return -on_held


def _element_gather(
    blocks: np.ndarray, count: int, node_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """For each node, where its entries stand in the element forces, in rows of `GATHER`.

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
    """For each node, the cut-point forces (2 point + side) that act on it and their weights."""
    P = len(point_nodes)
    entry = 2 * np.arange(P)[:, None] + np.array([0, 0, 1, 1])
    weight = np.tile(weights, (1, 2))
    use = weight > 0.0
    node, entry, weight = point_nodes[use], entry[use], weight[use]
    order = np.argsort(node, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=node_count))])
    return start.astype(np.int32), entry[order].astype(np.int32), weight[order]
