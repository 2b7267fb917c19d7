"""Quasi-static cuts, bulk condensed or implicit, against the explicit solver: cost and error.

The bulk is small-strain elasticity, condensed onto the nodes that cut points and board touch (or
the whole bulk, linear or Neo-Hookean). Each step solves equilibrium with the laws of the explicit
kernels for bonds, edge, flanks, friction, board and bending blade, in backward Euler, for a
straight press; nothing has mass or viscosity. Times are processor time, the least of several runs.
That in linear algebra is told apart: a compiled version would keep it, the rest is Python. The
column "compiled" estimates such a version, see `compiled`.
"""

import argparse
import contextlib
import dataclasses as dc
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp
from scipy.linalg import cho_factor, lu_factor, lu_solve
from scipy.linalg.blas import dtrsv, strsv
from scipy.linalg.lapack import spotri
from scipy.sparse import block_diag, coo_matrix, csc_matrix, csr_matrix, diags_array
from scipy.sparse.linalg import splu
from tqdm import tqdm

from sliceit_drake.cutting.foods.food import Food, make_food_model
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.simulate import simulate_slice
from sliceit_drake.cutting.solver import CuttingSolver
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.resources import resource_path
from studies.pages import table
from studies.physics.cutting_speed import CLEARANCE, PERIOD, min_times, sub_step_time, through
from studies.physics.neo_hookean import first_piola_stress, small_strain_stiffness

__all__ = ["add_arguments", "run"]

SPEED = 0.02
DEPTH = 0.027
STEPS = (2e-3, 5e-3, 1e-2, 2e-2)
FINE = 5e-5
REFINEMENTS = (0.5, 1.0, 1.5, 2.0)
SOFT, SOFTER = 2e5, 1.5e5

POINT_COST = 3.0
"""Cost of a point's force and tangent over that of its force in the solver's kernel; assumed."""

TOLERANCE = 1e-3
"""Largest residual, relative to the force on the knife or to `MIN_FORCE`, N."""

MIN_FORCE = 0.1
MOST_ITERATIONS = 60
MOST_FAILURES = 10

DAMPED = 10
"""Iterations of a step after which corrections are halved."""

REFRESH = 25
"""Steps after which forces of a linear bulk are computed anew."""

SLOW = 0.3
"""Fraction of the residual that an iteration with an old factor may leave."""

CHANGED = 0.1
"""Fraction of an unknown's stiffness that a change must have to be part of a correction."""

RANK_LIMIT = 0.25
"""Largest rank of a correction over the unknowns."""

SYMMETRIC = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}


class Clock:
    """Seconds and calls of linear algebra by operation."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.entries = 0

    def total(self) -> float:
        """All of it, s."""
        return sum(self.seconds.values())

    @contextlib.contextmanager
    def of(self, name: str, entries: int = 0) -> Iterator[None]:
        """Times what is done inside; of a product with a sparse matrix, counts its `entries`."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start
        self.calls[name] += 1
        self.entries += entries


@dc.dataclass
class History:
    """What cut points and board remember.

    Attributes:
        s: Depth of the edge below the points at the last step, and the largest so far [2, P].
        parted: Fraction of the surface energy that opening spent [P].
        edge: Force of the edge [P], N.
        share: Fraction of the point's area above the edge, of both faces [P, 2].
        slip: From the friction anchors of both faces [P, 2, 3], metres.
        board_slip: [M, 3], metres.
    """

    s: np.ndarray
    passed: np.ndarray
    parted: np.ndarray
    edge: np.ndarray
    share: np.ndarray
    slip: np.ndarray
    board_slip: np.ndarray


class Contacts:
    """Laws of the cut points and of the board, as `point_kernels` and `node_kernels` have them.

    Args:
        model: The cut.
        number: Number of each computed node among the unknown nodes [N], -1 where held or free of
            contact.
        count: Unknown nodes.
        clock: For products with sparse matrices.
    """

    def __init__(self, model: CuttingModel, number: np.ndarray, count: int, clock: Clock) -> None:
        self.m, P = model, len(model.point_nodes)
        self.clock = clock
        self.rest = model.split.points
        self.board_nodes = np.flatnonzero((model.board_area > 0.0) & (number >= 0))
        self.board_rest = model.nodes[self.board_nodes]
        nodes, weights = number[model.point_nodes], np.tile(model.point_weights, 2)
        p, end, axis = np.meshgrid(np.arange(P), np.arange(4), np.arange(3), indexing="ij")
        used = (nodes[p, end] >= 0) & (weights[p, end] != 0.0)
        p, end, axis = p[used], end[used], axis[used]
        rows = [6 * p + 3 * (end // 2) + axis]
        columns, values = [3 * nodes[p, end] + axis], [weights[p, end]]
        j, side = np.meshgrid(np.arange(len(self.board_nodes)), np.arange(3), indexing="ij")
        rows.append((6 * P + 1 + 3 * j + side).ravel())
        columns.append((3 * number[self.board_nodes][j] + side).ravel())
        values.append(np.ones(j.size))
        self.faces = 6 * P
        size = 6 * P + 1 + j.size
        # The blade's deflection is the last unknown.
        rows.append(np.array([6 * P]))
        columns.append(np.array([3 * count]))
        values.append(np.ones(1))
        row, column = np.concatenate(rows), np.concatenate(columns)
        self.B = coo_matrix((np.concatenate(values), (row, column)), (size, 3 * count + 1)).tocsr()
        self.BT = self.B.T.tocsr()
        # Entries of the blocks, points first: their place in the interpolated unknowns.
        blade = np.full((P, 1), 6 * P)
        of_points = np.hstack([6 * np.arange(P)[:, None] + np.arange(6), blade])
        of_board = 6 * P + 1 + 3 * np.arange(len(self.board_nodes))[:, None] + np.arange(3)
        self.block_rows, self.block_columns = (
            np.concatenate([np.repeat(of_points, 7, 1).ravel(), np.repeat(of_board, 3, 1).ravel()]),
            np.concatenate([np.tile(of_points, 7).ravel(), np.tile(of_board, 3).ravel()]),
        )
        self._scatter()

    def _scatter(self) -> None:
        """Where the entries of the blocks go in the matrix of the unknowns, and by which weight."""
        B, n = self.B, self.B.shape[1]
        length = np.diff(B.indptr)
        pairs = length[self.block_rows] * length[self.block_columns]
        entry = np.repeat(np.arange(len(pairs)), pairs)
        within = np.arange(len(entry)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
        width = length[self.block_columns[entry]]
        i = B.indptr[self.block_rows[entry]] + within // np.maximum(width, 1)
        j = B.indptr[self.block_columns[entry]] + within % np.maximum(width, 1)
        flat = B.indices[i].astype(np.int64) * n + B.indices[j]
        self.places, where = np.unique(flat, return_inverse=True)
        shape = (len(self.places), len(pairs))
        self.G = csr_matrix((B.data[i] * B.data[j], (where, entry)), shape)
        self.rows, self.columns = self.places // n, self.places % n
        self._matrix = csr_matrix((np.ones(len(self.places)), (self.rows, self.columns)), (n, n))

    def displaced(self, u: np.ndarray) -> np.ndarray:
        """Displacements of faces, blade and board nodes."""
        with self.clock.of("sparse", self.B.nnz):
            return self.B @ u

    def gathered(self, force: np.ndarray) -> np.ndarray:
        """Their forces on the unknowns."""
        with self.clock.of("sparse", self.BT.nnz):
            return self.BT @ force

    def entries(self, blocks: np.ndarray) -> np.ndarray:
        """Entries of their tangent, at `rows` and `columns`."""
        with self.clock.of("sparse", self.G.nnz):
            return self.G @ blocks

    def product(self, entries: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Tangent times displacements."""
        with self.clock.of("sparse", self._matrix.nnz):
            self._matrix.data = entries
            return self._matrix @ u

    def start(self) -> History:
        P, M = len(self.rest), len(self.board_nodes)
        one = np.zeros(P)
        low = np.full(P, -1.0)
        zero = np.zeros((P, 2, 3))
        return History(low, low, one, one, zero[..., 0], zero, np.zeros((M, 3)))

    def table(self, values: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values of a table at s and their slopes [P]."""
        tables = self.m.tables
        u = (s + tables.reach) / tables.spacing
        k = np.clip(np.floor(u).astype(int), 0, values.shape[1] - 2)
        w = u - k
        rows = np.arange(len(s))
        a, b = values[rows, k], values[rows, k + 1]
        inside = (w > 0.0) & (w < 1.0)
        w = np.clip(w, 0.0, 1.0)
        return a + w * (b - a), np.where(inside, b - a, 0.0) / tables.spacing

    def evaluate(
        self, moved: np.ndarray, before: np.ndarray, h: History, edge_z: float, travel: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, History]:
        """Forces and tangent for displacements of the faces and board nodes.

        Args:
            moved, before: Displacements now and at the last step [B rows], metres.
            h: History at the last step.
            edge_z: Height of the edge in C now, metres.
            travel: How far it went down in the step, metres.

        Returns:
            Forces on the food as `moved`; entries of the tangent blocks; force on the knife [3];
            history at the end of the step.
        """
        m, P = self.m, self.m.parameters
        u = moved[: self.faces].reshape(-1, 2, 3)
        x = self.rest[:, None] + u
        du = u - before[: self.faces].reshape(-1, 2, 3)
        A, R = m.tables.area, m.toughness
        force = np.zeros_like(u)
        blocks = np.zeros((len(u), 7, 7))
        K = np.zeros((len(u), 2, 3, 2, 3))
        bend = moved[self.faces]

        s = 0.5 * (x[:, 0, 2] + x[:, 1, 2]) - edge_z
        passed = np.maximum(h.passed, s)
        D, _ = self.table(m.tables.fraction, passed)
        T, slope = self.table(m.tables.width, passed)

        # Bonds: the secant stiffness, which stays positive while they soften.
        gap = x[:, 1] - x[:, 0]
        opening = gap.copy()
        opening[:, 1] = np.maximum(gap[:, 1], 0.0)
        length = np.linalg.norm(opening, axis=1)
        bond = P["bond_stiffness"]
        onset, failure = P["strength"] / bond, 2.0 * R / P["strength"]
        parted = np.maximum(h.parted, np.clip((length - onset) / (failure - onset), 0.0, 1.0))
        intact = onset * (1.0 - parted) / (onset + parted * (failure - onset))
        k = bond * A * (1.0 - D) * intact
        stiff = np.repeat(k[:, None], 3, axis=1)
        stiff[:, 1] = np.where(gap[:, 1] < 0.0, bond * A, k)
        pull = stiff * gap
        force += np.stack([pull, -pull], axis=1)
        for a in range(3):
            K[:, 0, a, 0, a] += stiff[:, a]
            K[:, 1, a, 1, a] += stiff[:, a]
            K[:, 0, a, 1, a] -= stiff[:, a]
            K[:, 1, a, 0, a] -= stiff[:, a]

        left = np.maximum(R * (1.0 - parted) - 0.5 * bond * intact * length**2, 0.0)
        slack = np.maximum(passed - s - m.numerics.unloading_length, 0.0)
        limit = np.maximum(left * T - m.unloading * slack, 0.0)
        trial = h.edge + m.unloading * (s - h.s)
        # The first step has no step before it; the edge is above the food then.
        q = np.where(h.s > -1.0, np.clip(trial, 0.0, limit), 0.0)
        force[:, :, 2] -= 0.5 * q[:, None]
        # Where the resistance falls with depth the tangent would not be positive definite.
        rising = np.where(passed > h.passed, np.maximum(left * slope, 0.0), 0.0)
        elastic = (trial > 0.0) & (trial < limit)
        dq = np.where(elastic, m.unloading, np.where(q > 0.0, rising, 0.0))
        K[:, :, 2, :, 2] += 0.25 * dq[:, None, None]

        normal, friction, slip = np.zeros((3, *u.shape))
        stiffness = P["flank_stiffness"] * m.point_scales.flank_stiffness
        shares = np.zeros((len(u), 2))
        for f, side in enumerate((-1.0, 1.0)):
            below = x[:, f, 2] - edge_z
            share, _ = self.table(m.tables.fraction, below)
            growth, _ = self.table(m.tables.width, below)
            rise, _ = self.table(m.tables.rise, below)
            shares[:, f] = share
            height = below + rise
            phi, n = self._wedge(side * (x[:, f, 1] - bend), height, side)
            area = A * share
            active = (phi < 0.0) & (area > 0.0)
            c = np.where(active, stiffness * area, 0.0)
            N = -c * phi
            normal[:, f] = N[:, None] * n
            at_edge = stiffness * growth * phi * (0.5 * phi - n[:, 2] * height)
            normal[:, f, 2] -= np.where(active, at_edge, 0.0)
            sliding = du[:, f] + [0.0, before[self.faces] - bend, travel]
            kept = np.minimum(h.share[:, f] / np.maximum(share, 1e-12), 1.0)[:, None]
            anchor = h.slip[:, f] * kept + sliding
            anchor -= (anchor * n).sum(1, keepdims=True) * n
            size = np.linalg.norm(anchor, axis=1)
            reach = P["friction"] * m.point_scales.friction * np.abs(phi)
            sticks = size <= reach
            scale = np.where(sticks, 1.0, reach / np.maximum(size, 1e-30))
            slip[:, f] = np.where(active[:, None], scale[:, None] * anchor, 0.0)
            friction[:, f] = -c[:, None] * slip[:, f]
            t = np.where(sticks, 0.0, 1.0 / np.maximum(size, 1e-30))[:, None] * anchor
            block = n[:, :, None] * n[:, None, :]
            block = block + scale[:, None, None] * (np.eye(3) - block - t[:, :, None] * t[:, None])
            block *= c[:, None, None]
            K[:, f, :, f, :] += block
            blocks[:, 3 * f : 3 * f + 3, 6] = -block[:, :, 1]
            blocks[:, 6, 3 * f : 3 * f + 3] = -block[:, 1]
            blocks[:, 6, 6] += block[:, 1, 1]
        force += normal + friction
        blocks[:, :6, :6] = K.reshape(-1, 6, 6)

        w = moved[self.faces + 1 :].reshape(-1, 3)
        dw = w - before[self.faces + 1 :].reshape(-1, 3)
        n = m.board[:3]
        depth = m.board[3] - (self.board_rest + w) @ n
        c = np.where(depth > 0.0, P["board_stiffness"] * m.board_area[self.board_nodes], 0.0)
        anchor = h.board_slip + dw - (dw @ n)[:, None] * n
        size = np.linalg.norm(anchor, axis=1)
        scale = np.minimum(1.0, P["board_friction"] * np.abs(depth) / np.maximum(size, 1e-30))
        board_slip = np.where((depth > 0.0)[:, None], scale[:, None] * anchor, 0.0)
        on_board = (c * depth)[:, None] * n - c[:, None] * board_slip
        normals = np.outer(n, n)
        on_nodes = c[:, None, None] * (normals + scale[:, None, None] * (np.eye(3) - normals))

        knife = -(normal + friction).sum((0, 1)) + [0.0, 0.0, q.sum()]
        return (
            np.concatenate([force.ravel(), knife[1:2], on_board.ravel()]),
            np.concatenate([blocks.ravel(), on_nodes.ravel()]),
            knife,
            History(s, passed, parted, q, shares, slip, board_slip),
        )

    def _wedge(self, y: np.ndarray, height: np.ndarray, side: float) -> tuple:
        """Distance to flank or spine [P] and its gradient in C [P, 3]; see `point_kernels`."""
        knife = self.m.knife.parameters()
        y1, h1, y2, h2 = knife[2:6]
        flank = np.array([h2 - h1, y1 - y2])
        flank /= np.linalg.norm(flank)
        to_flank = flank[0] * (y - y1) + flank[1] * (np.maximum(height, h1) - h1)
        to_spine = height - h2
        n = np.zeros((len(y), 3))
        spine = to_spine > to_flank
        n[:, 1] = np.where(spine, 0.0, side * flank[0])
        n[:, 2] = np.where(spine, 1.0, flank[1])
        return np.maximum(to_flank, to_spine) - knife[6], n


def bulk_stiffness(model: CuttingModel) -> csc_matrix:
    """Small-strain stiffness of all computed nodes [3 N, 3 N], N/m."""
    gradients = np.concatenate([-model.inverse.sum(1, keepdims=True), model.inverse], axis=1)
    blocks = small_strain_stiffness(gradients, model.element_volume, *model.material.lame())
    dof = (3 * model.tetrahedra[:, :, None] + np.arange(3)).reshape(-1, 12)
    values = blocks.transpose(0, 1, 3, 2, 4).reshape(-1, 12, 12)
    rows, columns = np.repeat(dof, 12, axis=1), np.tile(dof, (1, 12))
    size = 3 * len(model.nodes)
    return coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (size, size)).tocsc()


class Bulk:
    """What equilibrium needs of the bulk and of what touches it; the blade is the last unknown.

    Attributes:
        weight: On the unknowns [n], N.
        contacts: Cut points, board, blade.
        clock: Time in linear algebra.
        linear: Whether forces of the bulk are a constant matrix times the displacements.
    """

    weight: np.ndarray
    contacts: Contacts
    clock: Clock
    linear = True
    S: Any

    def force(self, u: np.ndarray) -> np.ndarray:
        """Forces of the bulk at displacements `u` [n], N."""
        raise NotImplementedError


class Condensed(Bulk):
    """Linear bulk on the nodes in contact: held and inner nodes eliminated, stiffness S [n, n]."""

    def __init__(self, model: CuttingModel) -> None:
        start = time.process_time()
        held = np.ones(len(model.nodes), bool)
        held[model.moving] = False
        used = np.tile(model.point_weights, 2) != 0.0
        touched = model.board_area > 0.0
        touched[model.point_nodes[used]] = True
        outer, inner = np.flatnonzero(touched & ~held), np.flatnonzero(~touched & ~held)
        o, i = ((3 * nodes[:, None] + np.arange(3)).ravel() for nodes in (outer, inner))
        K = bulk_stiffness(model)
        Koi = K[o][:, i].toarray()
        inverse = splu(K[i][:, i].tocsc(), **SYMMETRIC)
        S = K[o][:, o].toarray() - Koi @ inverse.solve(Koi.T.copy())
        self.S = np.zeros((len(o) + 1, len(o) + 1))
        self.S[:-1, :-1] = 0.5 * (S + S.T)
        self.S[-1, -1] = model.parameters["blade_stiffness"]
        weight = model.weight.ravel()
        self.weight = np.append(weight[o] - Koi @ inverse.solve(weight[i]), 0.0)
        self.setup = time.process_time() - start
        self.clock = Clock()
        self.contacts = Contacts(model, numbered(model, outer), len(outer), self.clock)

    def force(self, u: np.ndarray) -> np.ndarray:
        with self.clock.of("product"):
            return self.S @ u


class Whole(Bulk):
    """All moving nodes of the bulk, its stiffness S sparse; linear, or stable Neo-Hookean."""

    def __init__(self, model: CuttingModel, linear: bool) -> None:
        start = time.process_time()
        self.model, self.linear = model, linear
        dof = (3 * model.moving[:, None] + np.arange(3)).ravel()
        K = bulk_stiffness(model)[dof][:, dof]
        self.S = block_diag([K, [[model.parameters["blade_stiffness"]]]], format="csc")
        self.weight = np.append(model.weight.ravel()[dof], 0.0)
        self.dof = dof
        self.setup = time.process_time() - start
        self.clock = Clock()
        number = numbered(model, model.moving)
        self.contacts = Contacts(model, number, len(model.moving), self.clock)

    def force(self, u: np.ndarray) -> np.ndarray:
        if self.linear:
            with self.clock.of("product"):
                return self.S @ u
        m = self.model
        x = m.nodes.ravel().copy()
        x[self.dof] += u[:-1]
        corners = x.reshape(-1, 3)[m.tetrahedra]
        F = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1) @ m.inverse
        stress = first_piola_stress(F, m.parameters["mu"], m.parameters["lam"])
        pull = m.element_volume[:, None, None] * (stress @ m.inverse.transpose(0, 2, 1))
        forces = np.concatenate([-pull.sum(2, keepdims=True), pull], 2).transpose(0, 2, 1)
        total = np.zeros(m.nodes.shape)
        np.add.at(total, m.tetrahedra, forces)
        return np.append(total.ravel()[self.dof], self.S[-1, -1] * u[-1])


def numbered(model: CuttingModel, nodes: np.ndarray) -> np.ndarray:
    number = np.full(len(model.nodes), -1)
    number[nodes] = np.arange(len(nodes))
    return number


class Newton:
    """Newton with a Cholesky factor of each tangent."""

    dtype: type = np.float64

    factor: Any = None
    values: np.ndarray

    def __init__(self, bulk: Bulk) -> None:
        self.bulk = bulk

    def prepare(self, blocks: np.ndarray, slow: bool, stuck: bool) -> bool:
        """Factors the tangent if that is due.

        Args:
            blocks: Of `Contacts.evaluate`.
            slow: Whether the residual fell too slowly in the last iteration.
            stuck: Whether the step takes many iterations.

        Returns:
            Whether it was due.
        """
        self.values = self.bulk.contacts.entries(blocks)
        self.factored()
        return True

    def factored(self) -> None:
        bulk = self.bulk
        with bulk.clock.of("tangent"):
            T: np.ndarray = bulk.S.astype(self.dtype)
            T.ravel()[bulk.contacts.places] += self.values
        with bulk.clock.of("factor"):
            # It is symmetric, so its transpose is it in LAPACK's order.
            self.factor = cho_factor(T.T, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, r: np.ndarray) -> np.ndarray:
        with self.bulk.clock.of("solve"):
            # LAPACK's own solve is three times slower with one right side.
            trsv, L = (dtrsv, strsv)[self.dtype is np.float32], self.factor[0]
            half = trsv(L, r.astype(self.dtype), lower=1, overwrite_x=1)
            return trsv(L, half, lower=1, trans=1, overwrite_x=1)

    def bulk_force(self, r: np.ndarray, du: np.ndarray) -> np.ndarray:
        """S du without that product, as (S + contacts) du = r."""
        return r - self.bulk.contacts.product(self.values, du)


class Reused(Newton):
    """Modified Newton: a factor in single precision, until residuals fall too slowly."""

    dtype = np.float32

    def prepare(self, blocks: np.ndarray, slow: bool, stuck: bool) -> bool:
        return (slow or self.factor is None) and super().prepare(blocks, slow, stuck)


class Sparse(Newton):
    """Modified Newton with a sparse factor."""

    def prepare(self, blocks: np.ndarray, slow: bool, stuck: bool) -> bool:
        return (slow or self.factor is None) and super().prepare(blocks, slow, stuck)

    def factored(self) -> None:
        bulk, c = self.bulk, self.bulk.contacts
        with bulk.clock.of("tangent"):
            T = bulk.S + csc_matrix((self.values, (c.rows, c.columns)), bulk.S.shape)
        with bulk.clock.of("factor"):
            self.factor = splu(T, **SYMMETRIC)

    def solve(self, r: np.ndarray) -> np.ndarray:
        with self.bulk.clock.of("solve"):
            return self.factor.solve(r)


class Woodbury(Newton):
    """Modified Newton: inverse of one tangent, corrected where contacts have changed since."""

    dtype = np.float32
    inverse: np.ndarray | None = None
    base: np.ndarray
    stiffness: np.ndarray

    def prepare(self, blocks: np.ndarray, slow: bool, stuck: bool) -> bool:
        if self.inverse is not None and not slow:
            return False
        c, clock = self.bulk.contacts, self.bulk.clock
        values = c.entries(blocks)
        if self.inverse is not None and not stuck:
            with clock.of("update"):
                change = values - self.base
                at = np.unique(c.rows[np.abs(change) > CHANGED * self.stiffness[c.rows]])
                if len(at) <= RANK_LIMIT * len(self.stiffness):
                    self.correct(at, change)
                    return True
        self.base = self.values = values
        self.factored()
        with clock.of("invert"):
            lower, _ = spotri(self.factor[0], lower=1, overwrite_c=1)
            self.inverse = np.tril(lower) + np.tril(lower, -1).T
            self.stiffness = 1.0 / self.inverse.diagonal()
            self.at = np.zeros(0, int)
        return True

    def correct(self, at: np.ndarray, change: np.ndarray) -> None:
        """Takes the change of the tangent at the unknowns `at` into account."""
        assert self.inverse is not None
        self.at, m, c = at, len(at), self.bulk.contacts
        place = np.full(len(self.stiffness), -1)
        place[at] = np.arange(m)
        i, j = place[c.rows], place[c.columns]
        both = (i >= 0) & (j >= 0)
        self.values = np.where(both, self.base + change, self.base)
        self.change = np.zeros((m, m), self.dtype)
        self.change[i[both], j[both]] = change[both]
        self.columns = np.asfortranarray(self.inverse[:, at])
        small = np.eye(m, dtype=self.dtype) + self.change @ self.columns[at]
        self.small = lu_factor(small, overwrite_a=True, check_finite=False)

    def solve(self, r: np.ndarray) -> np.ndarray:
        assert self.inverse is not None
        with self.bulk.clock.of("solve"):
            du = self.inverse @ r.astype(self.dtype)
            if len(self.at):
                inner = lu_solve(self.small, self.change @ du[self.at], check_finite=False)
                du -= self.columns @ inner
            return du


@dc.dataclass
class Cut:
    """A press cut.

    Attributes:
        times, forces: On the knife in C at the ends of the steps [n + 1], [n + 1, 3]; not a number
            from where too many steps had failed.
        wall: Of all steps, s.
        clock: What of it is linear algebra.
        iterations: Evaluations of the contacts.
        failures: Steps that did not reach the tolerance.
    """

    times: np.ndarray
    forces: np.ndarray
    wall: float
    clock: Clock
    iterations: int
    failures: int


def press(bulk: Bulk, linear: Newton, period: float, top: float, depth: float) -> Cut:
    """A press cut from `top`, `depth` down, in steps of `period`.

    Raises:
        LinAlgError: A tangent is not positive definite.
    """
    c = bulk.contacts
    bulk.clock = c.clock = Clock()
    size = len(bulk.weight)
    steps = int(np.ceil(depth / SPEED / period - 1e-9))
    times, forces = period * np.arange(steps + 1), np.zeros((steps + 1, 3))
    iterations = failures = 0
    history = c.start()
    before, last, inner_before, inner_last = np.zeros((4, size))
    moved_before = c.displaced(before)
    start = time.process_time()
    for step in range(1, steps + 1):
        z = top - SPEED * times[step]
        if bulk.linear and step % REFRESH == 0:
            # Extrapolation doubles the rounding of what follows from the solves in each step.
            inner_before, inner_last = bulk.force(before), bulk.force(last)
        # Displacements go on as in the last step; so does the force of a linear bulk.
        u = before + last
        inner = inner_before + inner_last if bulk.linear else bulk.force(u)
        norm = np.inf
        for iteration in range(MOST_ITERATIONS):
            iterations += 1
            moved = c.displaced(u)
            force, blocks, knife, new = c.evaluate(moved, moved_before, history, z, SPEED * period)
            r = bulk.weight - inner + c.gathered(force)
            old, norm = norm, float(np.linalg.norm(r))
            if norm < TOLERANCE * max(float(np.linalg.norm(knife)), MIN_FORCE):
                break
            stuck = iteration % DAMPED == DAMPED - 1
            if linear.prepare(blocks, norm > SLOW * old, stuck) and bulk.linear:
                exact = bulk.force(u)
                r += inner - exact
                inner = exact
            du = linear.solve(r)
            if iteration >= DAMPED:
                # Contacts that open and close in turn.
                r, du = 0.5 * r, 0.5 * du
            u = u + du
            inner = inner + linear.bulk_force(r, du) if bulk.linear else bulk.force(u)
        else:
            failures += 1
            if failures > MOST_FAILURES or not np.isfinite(norm):
                forces[step:] = np.nan
                break
        last, before, history, moved_before = u - before, u, new, moved
        inner_last, inner_before = inner - inner_before, inner
        forces[step] = knife
    return Cut(times, forces, time.process_time() - start, c.clock, iterations, failures)


def coupling_means(cut: Cut, count: int) -> np.ndarray:
    """Means of the force over the coupling steps [count, 3], N; it is linear between the steps."""
    ends = PERIOD * np.arange(count + 1)
    at = np.stack([np.interp(ends, cut.times, cut.forces[:, a]) for a in range(3)], axis=1)
    return 0.5 * (at[1:] + at[:-1])


def relative(force: np.ndarray, reference: np.ndarray) -> float:
    """RMS of the difference over that of the reference, in percent."""
    return 100.0 * float(np.sqrt(((force - reference) ** 2).sum() / (reference**2).sum()))


def kernel_time(solver: CuttingSolver, launch: Callable[[], None], count: int = 2000) -> float:
    """Time of one launch of a kernel within a captured graph, s."""
    with wp.ScopedCapture(device=solver._workspace.device) as capture:
        for _ in range(count):
            launch()
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        wp.capture_launch(capture.graph)
        best = min(best, time.process_time() - start)
    return best / count


def point_time(solver: CuttingSolver) -> float:
    """Time of all cut points in the solver's kernel, s."""
    return kernel_time(solver, lambda: solver._workspace.launch_part("step_points", 0))


def sparse_rate() -> float:
    """Time of each stored entry in a product with a large sparse matrix, s."""
    size = 20_000
    matrix = diags_array(np.ones((7, size)), offsets=range(7), shape=(size, size)).tocsr()
    x = np.ones(size)
    return min_times({"": lambda: matrix @ x}, 20)[""] / matrix.nnz


def compiled(cut: Cut, point: float, element: float, per_entry: float) -> float:
    """Time of a cut if nothing were Python, s.

    Dense and factored linear algebra as measured; products with small sparse matrices by their
    entries; each evaluation of the contacts as `POINT_COST` calls of the solver's kernel.
    """
    calls = cut.clock.total() - cut.clock.seconds["sparse"]
    return calls + cut.clock.entries * per_entry + cut.iterations * (POINT_COST * point + element)


def compare(name: str, model: CuttingModel, repeats: int) -> None:
    """Prints the table of one food."""
    hardness = model.material.youngs_modulus * model.element_size
    motion = through(model, DEPTH)
    solver = CuttingSolver(model, PERIOD)
    fine = model.derive(numerics=dc.replace(model.numerics, time_step=FINE))
    reference = simulate_slice(CuttingSolver(fine, PERIOD), motion)
    explicit = simulate_slice(solver, motion)
    sub_step = sub_step_time(solver, motion)
    point = point_time(solver)
    element = kernel_time(solver, lambda: solver._workspace.launch_part("elements", 0))
    per_entry = sparse_rate()

    condensed = Condensed(model)
    linear, hyperelastic = Whole(model, True), Whole(model, False)
    schemes = {
        "condensed, Newton": (condensed, Newton, STEPS),
        "condensed, factor reused": (condensed, Reused, STEPS),
        "condensed, Woodbury": (condensed, Woodbury, STEPS),
        "sparse, linear": (linear, Sparse, STEPS[2:3]),
        "sparse, Neo-Hookean": (hyperelastic, Sparse, STEPS[2:3]),
    }
    cuts: dict[tuple[str, float], Cut] = {}
    wall = np.inf
    for _ in tqdm(range(repeats), desc=name):
        begin = time.process_time()
        simulate_slice(solver, motion)
        wall = min(wall, time.process_time() - begin)
        for scheme, (bulk, newton, steps) in schemes.items():
            for step in steps:
                cut = press(bulk, newton(bulk), step, model.top + CLEARANCE, DEPTH + CLEARANCE)
                best = cuts.setdefault((scheme, step), cut)
                if cut.wall < best.wall:
                    cuts[scheme, step] = cut
    forces = [r.food_wrench[:, 3:] @ model.X_FC_rotation for r in (explicit, reference)]
    print(
        f"\n{name}: E = {model.material.youngs_modulus:g} Pa, toughness / (E h) = "
        f"{model.material.toughness / hardness:.3f}, {model.element_count} tetrahedra, "
        f"{3 * len(model.moving)} unknowns, {len(condensed.weight)} condensed in "
        f"{1e3 * condensed.setup:.0f} ms"
    )
    print(
        f"explicit sub-step {1e6 * sub_step:.1f} us; points {1e6 * point:.1f} us, elements "
        f"{1e6 * element:.1f} us; a stored entry {1e9 * per_entry:.2f} ns"
    )
    step_error = relative(*forces)
    whole = f"{wall:.3f}"
    rows: list[tuple[object, ...]] = [
        ("explicit", f"{1e3 * model.numerics.time_step:g}", whole, "", whole)
        + ("", "", "", "", f"{step_error:.2f} %")
    ]
    for (scheme, step), cut in cuts.items():
        means = coupling_means(cut, len(explicit.time))
        bare = compiled(cut, point, 0.0 if schemes[scheme][0].linear else element, per_entry)
        clock = cut.clock
        rows.append(
            (scheme, f"{1e3 * step:g}", f"{cut.wall:.3f}", f"{clock.total():.3f}")
            + (f"{bare:.3f}", f"{cut.iterations / (len(cut.times) - 1):.2f}")
            + (clock.calls["factor"] + clock.calls["update"], cut.failures)
            + tuple(f"{relative(means, force):.2f} %" for force in forces)
        )
    print(
        table(
            "scheme | step [ms] | slice [s] | of it linear algebra [s] | compiled (estimate) [s]"
            " | iterations a step | factors | not converged | error to default"
            " | error to 5e-5 s",
            rows,
        )
    )
    flops = len(condensed.weight) ** 3 / 3.0
    print("\nmean time of an operation [us] in steps of 2 ms:")
    for scheme in list(schemes)[:3]:
        clock = cuts[scheme, STEPS[0]].clock
        parts = (f"{k} {1e6 * v / clock.calls[k]:.0f}" for k, v in clock.seconds.items())
        rate = 1e-9 * flops * clock.calls["factor"] / clock.seconds["factor"]
        print(f"  {scheme}: " + ", ".join(parts) + f" (factor at {rate:.0f} GFLOP/s)")


def scaling(food: Food, scenario: Scenario, repeats: int) -> None:
    """Prints cost and error against the mesh."""
    rows = []
    per_entry = sparse_rate()
    for refinement in REFINEMENTS:
        model = make_food_model(food, scenario.knife, scenario.numerics, refinement)
        solver, motion = CuttingSolver(model, PERIOD), through(model, DEPTH)
        bulk = Condensed(model)
        point = point_time(solver)
        cuts: dict[float, Cut] = {}
        wall = condensing = np.inf
        for _ in tqdm(range(repeats), desc=f"{model.element_count} tetrahedra"):
            begin = time.process_time()
            explicit = simulate_slice(solver, motion)
            wall = min(wall, time.process_time() - begin)
            condensing = min(condensing, Condensed(model).setup)
            for step in (STEPS[0], STEPS[2]):
                cut = press(bulk, Reused(bulk), step, model.top + CLEARANCE, DEPTH + CLEARANCE)
                if step not in cuts or cut.wall < cuts[step].wall:
                    cuts[step] = cut
        force = explicit.food_wrench[:, 3:] @ model.X_FC_rotation
        costs = [
            c for cut in cuts.values() for c in (cut.wall, compiled(cut, point, 0.0, per_entry))
        ]
        errors = [relative(coupling_means(cut, len(force)), force) for cut in cuts.values()]
        rows.append(
            (model.element_count, len(bulk.weight), f"{condensing:.3f}", f"{wall:.3f}")
            + tuple(f"{c:.3f}" for c in costs)
            + tuple(f"{e:.2f} %" for e in errors)
        )
    head = (
        "tetrahedra | condensed unknowns | condensation [s] | explicit [s] | condensed [s], 2 ms"
        " | compiled | 10 ms | compiled | error, 2 ms | 10 ms"
    )
    print(f"\n{table(head, rows)}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--repeats", type=int, default=3, help="runs, of which the least counts")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenario = load_scenario(resource_path("scenarios/cucumber_measured.yaml"))
    food = scenario.food
    assert isinstance(food, Food)
    model = make_food_model(food, scenario.knife, scenario.numerics)
    soft = dc.replace(model.material, youngs_modulus=SOFT)
    compare("cucumber", model, options.repeats)
    compare("soft food", model.derive(material=soft), options.repeats)
    softer = dc.replace(model.material, youngs_modulus=SOFTER)
    compare("softer food", model.derive(material=softer), options.repeats)
    one_side = dc.replace(food, held_sides="minus")
    free = make_food_model(one_side, scenario.knife, scenario.numerics)
    compare("cucumber, held on one side", free, options.repeats)
    scaling(food, scenario, options.repeats)
    return 0
