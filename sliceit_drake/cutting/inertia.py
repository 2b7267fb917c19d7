"""Mass matrix of the nodes that move and of the blade, and its factors.

Selective mass scaling (Olovsson, Simonsson and Unosson, Int. J. Numer. Meth. Eng. 63, 2005; Tkachuk
and Bischoff, Comput. Mech. 52, 2013) adds inertia to the relative motion of neighbouring nodes: to
the lumped true masses M a part of a bound K of the stiffness, S = M + (x / 2)^2 K. All frequencies
of S are then below 2 / x, while a translation and what deforms slowly keep their true masses.
Rotations do not. The blade is one of the neighbours: flanks and faces are light where they move
together. It has only y in truth; along x and z it follows the faces without a force.
"""

import dataclasses as dc
import functools
from collections.abc import Callable, Iterable

import numpy as np
from scipy.linalg.lapack import dpotri
from scipy.sparse import coo_array, csc_array, csr_array, tril
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

__all__ = ["WIDTH", "Factors", "Inertia", "assemble", "elimination_order", "largest_share"]

WIDTH = 32
"""Rows of an inverse that are multiplied at once."""
COST_OF_ROW = 10.0
"""Of a row in substitutions, forwards and backwards, over that of an entry."""
COST_OF_PRODUCT = 0.1
"""Of an entry of an inverse, over that of an entry in substitutions."""
LANCZOS = 8
"""Vectors of Lanczos's method: near the motion a round or two of them are enough."""


@dc.dataclass(frozen=True)
class Factors:
    """S = L D L', with a lower triangular L of unit diagonal, up to the last rows, in the order of
    elimination.

    What is left of S for the last E of the K + 1 rows, in which there are few zeros, is inverted
    instead. Entries of a row come in fours, filled up with zeros.

    Attributes:
        lower_start, lower_index, lower: Rows of L without the diagonal and the last E columns:
            first four of each and the end [K + 2], columns and values [Z, 4].
        upper_start, upper_index, upper: The same of L'.
        inverse_pivot: 1 / D before the last rows [K + 1 - E], 1/kg.
        inverse: Of what is left for the last rows, row by row, each filled up with zeros to a
            multiple of `WIDTH` [E * F], 1/kg.
    """

    lower_start: np.ndarray
    lower_index: np.ndarray
    lower: np.ndarray
    upper_start: np.ndarray
    upper_index: np.ndarray
    upper: np.ndarray
    inverse_pivot: np.ndarray
    inverse: np.ndarray


@dc.dataclass(frozen=True)
class Inertia:
    """Mass matrix of the moving nodes and of the blade, one for x, y and z alike.

    Attributes:
        matrix: S [K + 1, K + 1], kg, the nodes in their order of elimination, the blade last.
    """

    matrix: csc_array

    @functools.cached_property
    def factors(self) -> Factors:
        """Factors of the matrix. Where their entries stand depends on the mesh alone.

        Raises:
            ValueError: The matrix is not positive definite.
        """
        return self._factors(_first_inverted)

    @functools.cached_property
    def inverted(self) -> Factors:
        """`factors` in which all rows are inverted, for devices that multiply all at once.

        Raises:
            ValueError: The matrix is not positive definite.
        """
        return self._factors(lambda _: 0)

    def _factors(self, first_inverted: Callable[[np.ndarray], int]) -> Factors:
        lu = _factorized(self.matrix, "NATURAL")
        pivot = lu.U.diagonal()
        if (pivot <= 0.0).any() or (lu.perm_r != np.arange(len(pivot))).any():
            raise ValueError("the mass matrix is not positive definite")
        lower = tril(lu.L, -1).tocsc()
        first = first_inverted(np.diff(lower.indptr))
        cholesky = lower[first:, first:].toarray()
        np.fill_diagonal(cholesky, 1.0)
        half, _ = dpotri(cholesky * np.sqrt(pivot[first:]), lower=True)
        inverse = half + np.tril(half, -1).T
        inverse = np.pad(inverse, [(0, 0), (0, -len(inverse) % WIDTH)])
        lower.data[lower.indptr[first] :] = 0.0
        lower.eliminate_zeros()
        rows, columns = _by_fours(lower.tocsr(), 0), _by_fours(lower.T.tocsr(), -1)
        return Factors(*rows, *columns, 1.0 / pivot[:first], inverse.ravel())

    @functools.cached_property
    def of_nodes(self) -> csc_array:
        """That of the nodes alone, where no force acts on the blade [K, K], kg."""
        blade = self.matrix[:-1, [-1]]
        return csc_array(self.matrix[:-1, :-1] - blade @ blade.T / self.matrix[-1, -1])

    @functools.cached_property
    def _of_blade(self) -> tuple[csc_array, float]:
        """The blade's row without its own entry [1, K], and that entry, kg."""
        return self.matrix[[-1], :-1], self.matrix[-1, -1]

    def kinetic_energy(self, velocities: np.ndarray, blade: float | None = None) -> float:
        """Of velocities of the moving nodes in the matrix's order [K, 3] and of the blade along y,
        m/s; in J. Without the blade's, it follows the nodes."""
        v = np.asarray(velocities, np.float64)
        energy = 0.5 * (v * (self.of_nodes @ v)).sum()
        if blade is not None:
            to_blade, heavy = self._of_blade
            ahead = blade + float((to_blade @ v[:, 1])[0]) / heavy
            energy += 0.5 * heavy * ahead**2
        return float(energy)


def elimination_order(moves: np.ndarray, four: np.ndarray) -> np.ndarray:
    """The nodes that move in an order of minimum degree, in which factors have few entries [K].

    Args:
        moves: Whether a node moves [N].
        four: Nodes that act on each other [B, 4].
    """
    moving = np.flatnonzero(moves)
    blocks = np.tile(np.ones((4, 4)) + np.eye(4), (len(four), 1, 1))
    matrix = assemble(moving, [(four, blocks)], np.ones(len(moves)))
    return moving[np.argsort(_factorized(matrix, "MMD_AT_PLUS_A").perm_c)]


def assemble(
    moving: np.ndarray, parts: Iterable[tuple[np.ndarray, np.ndarray]], diagonal: np.ndarray
) -> csc_array:
    """Sum of small matrices and a diagonal on the nodes that move, in their order [K, K].

    Args:
        moving: Those nodes [K].
        parts: Nodes [B, n] and values [B, n, n] of small matrices.
        diagonal: By node [N].
    """
    place = np.full(len(diagonal), -1)
    place[moving] = np.arange(len(moving))
    rows, columns, values = [place[moving]], [place[moving]], [diagonal[moving]]
    for nodes, blocks in parts:
        at = place[nodes]
        rows.append(np.broadcast_to(at[:, :, None], blocks.shape).ravel())
        columns.append(np.broadcast_to(at[:, None, :], blocks.shape).ravel())
        values.append(blocks.ravel())
    row, column, value = (np.concatenate(each) for each in (rows, columns, values))
    free = (row >= 0) & (column >= 0)
    shape = (len(moving), len(moving))
    matrix = coo_array((value[free], (row[free], column[free])), shape).tocsc()
    # What happens to cancel keeps its place: factors have none for zeros.
    matrix.data[matrix.data == 0.0] = 1e-40
    return matrix


def largest_share(
    forces: Callable[[np.ndarray], np.ndarray], mass: csc_array, start: np.ndarray
) -> float:
    """Largest eigenvalue of linear, symmetric forces with respect to a mass matrix, to about 1 %.

    Args:
        forces: What gives them [K + 1, 3] for a motion of nodes and blade [K + 1, 3].
        mass: See `Inertia`.
        start: A motion near the one that is looked for [K + 1, 3].
    """
    factors, n = _factorized(mass, "NATURAL"), 3 * mass.shape[0]
    stiffness, inertia, inverse = (
        LinearOperator((n, n), lambda v, f=f: f(v.reshape(-1, 3)).ravel(), dtype=np.float64)
        for f in (forces, mass.__matmul__, factors.solve)
    )
    found = eigsh(
        stiffness,
        1,
        inertia,
        v0=start.ravel(),
        ncv=LANCZOS,
        tol=1e-2,
        Minv=inverse,
        return_eigenvectors=False,
    )
    return float(found[0])


def _first_inverted(entries: np.ndarray) -> int:
    """Row from which the rest is inverted: where the solve is fastest.

    Args:
        entries: Of L below the diagonal by column [K + 1].
    """
    rows = np.arange(len(entries))
    substituted = np.cumsum(entries + COST_OF_ROW) - entries - COST_OF_ROW
    return int((substituted + COST_OF_PRODUCT * (len(entries) - rows) ** 2).argmin())


def _by_fours(matrix: csr_array, fill: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First four of each row and the end [K + 1], columns [Z, 4] and values [Z, 4].

    Args:
        matrix: Sparse, square.
        fill: Column of the zeros that rows are filled up with.
    """
    matrix.sort_indices()
    count = np.diff(matrix.indptr)
    start = np.concatenate([[0], np.cumsum(-(-count // 4))])
    place = 4 * np.repeat(start[:-1], count) + np.arange(matrix.nnz)
    place -= np.repeat(matrix.indptr[:-1], count)
    columns, values = np.full(4 * start[-1], fill % len(count)), np.zeros(4 * start[-1])
    columns[place], values[place] = matrix.indices, matrix.data
    return start, columns.reshape(-1, 4), values.reshape(-1, 4)


def _factorized(matrix: csc_array, order: str) -> SuperLU:
    return splu(matrix, order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
