"""Advances the food through one exchange: captured Warp graphs on a workspace, state in NumPy."""

import dataclasses as dc
import threading

import numpy as np

from sliceit_drake.cutting.kernel_types import LANES
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.workspace import Workspace, interpolate_motion, parameter_row

__all__ = [
    "NOT_FINITE",
    "CuttingError",
    "CuttingSolver",
    "Energies",
    "Exchange",
    "Exchanges",
    "knife_wrenches",
    "run_exchanges",
]


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
class Exchanges:
    """What E exchanges in a row give; see `Exchange`.

    Attributes:
        state: The food's new state.
        wrenches: By mechanism (edge, flank pressure, friction) [E, 3, 6].
        work: [E], J.
        dissipation: By edge, opening, friction, blade, board over all exchanges [5], J.
        internal_work, gravity_work: Over all exchanges, J.
        cut: Share of the section that the edge has passed [E].
    """

    state: np.ndarray
    wrenches: np.ndarray
    work: np.ndarray
    dissipation: np.ndarray
    internal_work: float
    gravity_work: float
    cut: np.ndarray


@dc.dataclass
class Energies:
    """Energies of a state, J.

    Attributes:
        elastic: Of the bulk.
        interface: Of bonds, contacts, friction anchors, the edge's unloading and the bent blade.
        kinetic: Of the stepped (scaled) mass.
        least_volume_ratio: Smallest J of all elements.
        least_element: Its element.
    """

    elastic: float
    interface: float
    kinetic: float
    least_volume_ratio: float
    least_element: int


NOT_FINITE = (
    "the knife's force is not finite: elements inverted or the step became unstable. "
    "Use a smaller numerics.time_step or a finer mesh near the cut."
)
"""What is said of a cut that broke down."""

YZX, ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])


def knife_wrenches(
    total: np.ndarray, blade: np.ndarray, buried: np.ndarray, R: np.ndarray, substeps: int
) -> np.ndarray:
    """Mean wrenches on the knife from the sums of an exchange.

    Args:
        total: Sums over the cut points [..., 22].
        blade: Sums of the blade [..., 3].
        buried: Area in front of the flanks with its moment about Ko, at the end [..., 4].
        R: Rotation of the knife at the end [..., 3, 3].
        substeps: Of the exchange.

    Returns:
        Moment about Ko and force by mechanism [..., 3, 6]: edge, flank pressure with the blade's
        bending, friction.
    """
    impulse = total[..., :18] / substeps
    parts = impulse.shape[:-1]
    wrenches = np.concatenate(
        [impulse[..., 9:18].reshape(*parts, 3, 3), impulse[..., :9].reshape(*parts, 3, 3)], axis=-1
    )
    # The flanks push the blade, and the blade's spring and damper the knife's body. The difference
    # acts at the middle of the buried flanks.
    lateral = ((blade[..., 1] - blade[..., 2]) / substeps)[..., None] * R[..., :, 1]
    area = buried[..., 3:]
    middle = np.divide(buried[..., :3], area, out=np.zeros_like(lateral), where=area > 0.0)
    # np.cross takes longer.
    moment = middle.take(YZX, -1) * lateral.take(ZXY, -1)
    moment -= middle.take(ZXY, -1) * lateral.take(YZX, -1)
    wrenches[..., 1, :3] += moment
    wrenches[..., 1, 3:] += lateral
    return wrenches


def run_exchanges(
    ws: Workspace, states: np.ndarray, R: np.ndarray, p: np.ndarray
) -> list[Exchanges]:
    """Advances all cuts of a workspace by its exchanges.

    Args:
        ws: Workspace of C cuts and E exchanges.
        states: [C, state_size].
        R: Rotations of the knives in C at the ends of the exchanges [C, E + 1, 3, 3].
        p: Positions of Ko there [C, E + 1, 3], metres.

    Returns:
        One result a cut; what is not finite is left so.
    """
    n, T = ws.substeps, ws.exchange_period
    motion = interpolate_motion(R, p, n, T)
    ws.advance(states, motion)
    new = ws.read(ws.states[0]).copy()
    total, blade = ws.sum("total", 2), ws.sum("blade_sums")
    wrenches = knife_wrenches(total, blade, ws.sum("buried", 2), R[:, 1:], n)
    both = wrenches.sum(2)
    K = ws.steps
    v, w = (
        motion[:, a * K : (a + 3) * K].reshape(ws.cuts, ws.exchanges, n, 3)[:, :, 0]
        for a in (12, 15)
    )
    # Moments are about Ko at each sub-step; its mean position is half a period back.
    work = -((both[..., 3:] * v).sum(-1) + (both[..., :3] * w).sum(-1)) * T
    internal, board = ws.sum("internal_work", 1), ws.sum("board_loss", 1)
    nodes = ws.layout["x"]
    return [
        Exchanges(
            state=new[c],
            wrenches=wrenches[c],
            work=work[c],
            dissipation=np.array([*total[c, :, 18:21].sum(0), blade[c, :, 0].sum(), board[c]]),
            internal_work=float(internal[c]),
            gravity_work=float(model.weight.ravel() @ (new[c, nodes] - states[c, nodes])),
            cut=total[c, :, 21] / model.section_area,
        )
        for c, model in enumerate(ws.models)
    ]


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
        self._workspace = Workspace([model], exchange_period)
        self.substeps = self._workspace.substeps
        self.state_size = self._workspace.state_size
        self.dtype = self._workspace.dtype
        self._lock = threading.Lock()
        self._long: Workspace | None = None

    def initial_state(self) -> np.ndarray:
        """The food at rest, to be cut downwards [state_size]."""
        return self._workspace.initial_state()

    def set_point_factors(self, toughness: float = 1.0, friction: float = 1.0) -> None:
        """Multiplies toughness and friction of all cut points in every `exchange` from now on.

        The factors stand beside the state and are not in it: for a caller who lets them go with
        time or speed and gives them anew.
        """
        ws, row = self._workspace, parameter_row(self.model)
        row[ws.parameter_layout["toughness"]] *= toughness
        row[ws.parameter_layout["friction_scale"]] *= friction
        # A retreat of a tougher edge must not gain anything.
        row[ws.parameter_layout["unloading"]] *= max(1.0, toughness)
        with self._lock:
            ws.write(ws.parameters, row[None])

    def positions(self, state: np.ndarray) -> np.ndarray:
        """Positions of the computed nodes in C [N, 3], metres."""
        return self.field(state, "x").reshape(-1, 3)

    def velocities(self, state: np.ndarray) -> np.ndarray:
        """Velocities of the computed nodes in C [N, 3], m/s."""
        return self.field(state, "v").reshape(-1, 3)

    def field(self, state: np.ndarray, name: str) -> np.ndarray:
        """A part of the state by name: x, v, passed, parted, edge_force, heading, slip, board_slip,
        lag, blade."""
        return np.asarray(state[self._workspace.layout[name]])

    def compile(self) -> None:
        """Compiles the kernels, once a machine, and captures an exchange as a graph.

        `exchange` does so at its first call; call this before to keep it out of a measured time.
        """
        with self._lock:
            self._workspace.capture()

    def exchange(self, state: np.ndarray, start: Pose, end: Pose) -> Exchange:
        """Advances the food while the knife moves from `start` to `end`.

        Args:
            state: The food's state [state_size]; not changed.
            start: Knife pose in C at the beginning.
            end: Knife pose in C at the end.

        Raises:
            CuttingError: A force is not finite, or the knife left the region that is modelled.
        """
        m, n, T, ws = self.model, self.substeps, self.exchange_period, self._workspace
        R, p = np.array([[start.R, end.R]]), np.array([[start.p, end.p]])
        motion = interpolate_motion(R, p, n, T)
        v, w = motion[0, 12 * n : 12 * n + 3], motion[0, 15 * n : 15 * n + 3]
        with self._lock:
            ws.advance(state[None], motion)
            new = ws.read(ws.states[0])[0].copy()
            total, buried = ws.sum("total", 2)[0, 0], ws.sum("buried", 2)[0, 0]
            blade = ws.sum("blade_sums")[0, 0]
            board_force = ws.sum("board_force", 1)[0]
            board_loss = float(ws.sum("board_loss", 1)[0])
            internal_work = float(ws.sum("internal_work", 1)[0])
        if not np.isfinite(total).all():
            raise CuttingError(NOT_FINITE)
        wrenches = knife_wrenches(total, blade, buried, end.R, n)
        wrench = wrenches.sum(0)
        nodes = ws.layout["x"]
        return Exchange(
            state=new,
            wrench=wrench,
            edge=wrenches[0],
            normal=wrenches[1],
            friction=wrenches[2],
            # Moments are about Ko at each sub-step; its mean position is half a period back.
            work=-float(wrench[3:] @ v + wrench[:3] @ w) * T,
            edge_dissipation=float(total[18]),
            opening_dissipation=float(total[19]),
            friction_dissipation=float(total[20]),
            internal_work=internal_work,
            blade_dissipation=float(blade[0]),
            board_force=board_force / n,
            board_dissipation=board_loss,
            gravity_work=float(m.weight.ravel() @ (new[nodes] - state[nodes])),
            cut=float(total[21]) / m.section_area,
        )

    def exchanges(self, state: np.ndarray, R: np.ndarray, p: np.ndarray) -> Exchanges:
        """Advances the food through several exchanges at once, on a motion that is known.

        Args:
            state: The food's state [state_size]; not changed.
            R: Rotations of the knife in C at the ends of the exchanges [E + 1, 3, 3].
            p: Positions of Ko in C there [E + 1, 3], metres.

        Raises:
            CuttingError: A force is not finite.
        """
        with self._lock:
            ws = self._workspace_for(len(p) - 1)
            result = run_exchanges(ws, state[None], R[None], p[None])
        if not np.isfinite(result[0].wrenches).all():
            raise CuttingError(NOT_FINITE)
        return result[0]

    def _workspace_for(self, exchanges: int) -> Workspace:
        if exchanges == 1:
            return self._workspace
        if self._long is None or self._long.exchanges != exchanges:
            self._long = Workspace([self.model], self.exchange_period, exchanges)
        return self._long

    def _place(self, state: np.ndarray, pose: Pose) -> None:
        """Puts food and knife, at rest at `pose`, into the workspace for launches with k = 0."""
        self._workspace.write(self._workspace.states[0], state[None])
        self._place_knife(pose, np.zeros(3), np.zeros(3))

    def _place_knife(self, pose: Pose, v: np.ndarray, w: np.ndarray) -> None:
        n = self.substeps
        motion = np.zeros((1, 18 * n))
        motion[0, :9] = pose.R.ravel()
        for k, vector in ((9, pose.p), (12, v), (15, w)):
            motion[0, k * n : k * n + 3] = vector
        self._workspace.write(self._workspace.motion, motion)

    def contact_forces(self, state: np.ndarray, start: Pose, end: Pose) -> np.ndarray:
        """Forces on the knife at the end of an exchange, by cut point and face [P, 2, 3], N, in C.

        Half of the edge's force, the flank's pressure and its friction. The sum of their norms is
        what DiSECt records as the knife's force; their sum is the resultant.

        Args:
            state: The food's state after the exchange [state_size].
            start, end: Knife poses in C between which it moved.
        """
        T, ws = self.exchange_period, self._workspace
        motion = interpolate_motion(
            np.array([[start.R, end.R]]), np.array([[start.p, end.p]]), 1, T
        )[0]
        away = end._replace(p=end.p + 10.0 * end.R[:, 0])
        with self._lock:
            self._place(state, end)
            self._place_knife(end, motion[12:15], motion[15:18])
            both = ws.point_forces()
            # What is left with the knife beyond the food are the bonds, in the same state.
            self._place_knife(away, np.zeros(3), np.zeros(3))
            bonds = ws.point_forces()
        return bonds - both

    def energies(self, state: np.ndarray, pose: Pose) -> Energies:
        """Energies of `state` with the knife at `pose`."""
        ws, m = self._workspace, self.model
        with self._lock:
            self._place(state, pose)
            elastic, ratio, interface = ws.stored_energies()
        least = int(ratio.argmin())
        depth = np.maximum(m.board[3] - self.positions(state) @ m.board[:3], 0.0)
        anchor = self.field(state, "board_slip").reshape(-1, 3)
        rest = 0.5 * m.parameters["board_stiffness"] * m.board_area
        interface += float(rest @ (depth**2 + (anchor**2).sum(1)))
        deflection, rate = (float(b) for b in self.field(state, "blade"))
        interface += 0.5 * m.parameters["blade_stiffness"] * deflection**2
        interface += 0.5 * m.parameters["blade_mass"] * rate**2
        v2 = (self.velocities(state)[m.moving].astype(np.float64) ** 2).sum(1)
        return Energies(
            elastic=elastic,
            interface=interface,
            kinetic=float(0.5 * m.mass[m.moving] @ v2),
            least_volume_ratio=float(ratio[least]),
            least_element=least,
        )

    def held_reaction(self, state: np.ndarray, pose: Pose) -> np.ndarray:
        """Force of what holds the food on the food [3], N, in C, with the knife at `pose`."""
        m = self.model
        with self._lock:
            self._place(state, pose)
            forces, point_forces = self._workspace.present_forces()
        held = np.ones(len(m.nodes), bool)
        held[m.moving] = False
        at_held = held[m.blocks]
        on_held = (forces.reshape(-1, 4, 3, LANES) * at_held[:, :, None, :]).sum((0, 1, 3))
        # Forces of the bulk sum to zero, so that those on held nodes relax as those on the others.
        lag = self.field(state, "lag").reshape(len(m.relaxing), len(m.nodes), 3)[:, m.moving]
        on_held += m.relaxing @ lag.sum(1, dtype=float)
        share = (held[m.point_nodes].reshape(-1, 2, 2) * m.point_weights[:, None, :]).sum(2)
        on_held += (point_forces * share[:, :, None]).sum((0, 1)) + m.weight[held].sum(0)
        return -on_held
