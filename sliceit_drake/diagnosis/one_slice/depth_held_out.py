"""How well depth of a slice is predicted that was left out, by the linear problem."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.linear import scaled_inverse
from sliceit_drake.diagnosis.one_slice.slice_problem import SliceProblem

__all__ = ["HeldOutDepth"]


class HeldOutDepth:
    """Errors on blocks of depth that were left out, each predicted from the others, by ordinary
    least squares: what counts is newtons, wherever they are."""

    def __init__(self, problem: SliceProblem, block: np.ndarray, own: Sequence[int]) -> None:
        self.problem, self.block, self.own = problem, block, list(own)
        self.scale = max(float(np.sqrt(np.mean(problem.record.residual**2))), 1e-6)

    def error(self, options: Sequence[list[int]]) -> float:
        """RMS over all left-out rows, N; the rest chooses between the options of a cause."""
        record = self.problem.record
        left = np.zeros_like(record.residual)
        for k in np.unique(self.block):
            rows = self.block == k
            trials = [self._predicted(columns, rows) for columns in options]
            left[rows] = min(trials, key=lambda t: t[0])[1]
        return float(np.sqrt((left[:, record.forces] ** 2).sum(1).mean()))

    def _predicted(self, columns: list[int], rows: np.ndarray) -> tuple[float, np.ndarray]:
        """Squares on the other rows, and what is left on these."""
        problem = self.problem
        X = np.concatenate([problem.X, problem.C[:, :, columns]], axis=2)
        precision = np.concatenate([problem.precision, np.full(len(columns), 1e-6)])
        kinds = problem.found.columns
        bound = np.full(X.shape[2], -np.inf)
        for j, k in enumerate(columns):
            if kinds[k].one_sided:
                bound[problem.X.shape[2] + j] = 0.0
        everything = np.ones(len(rows), bool)
        theta = self._solve(X, precision, bound, everything, None)
        theta = self._solve(X, precision, bound, ~rows, theta)
        rest = problem.record.residual - X @ theta
        return float((rest[~rows] ** 2).sum()), rest[rows]

    def _solve(
        self,
        X: np.ndarray,
        precision: np.ndarray,
        bound: np.ndarray,
        rows: np.ndarray,
        fixed: np.ndarray | None,
    ) -> np.ndarray:
        y = self.problem.record.residual[rows].ravel()
        A = X[rows].reshape(len(y), -1)
        held = self.own if fixed is not None else []
        out = np.zeros(X.shape[2])
        if fixed is not None:
            out[held] = fixed[held]
        active = [k for k in range(X.shape[2]) if k not in held]
        while True:
            part = A[:, active]
            G = part.T @ part / self.scale**2 + np.diag(precision[active])
            own = scaled_inverse(G) @ (part.T @ (y - A[:, held] @ out[held]) / self.scale**2)
            wrong = [k for k, x in zip(active, own, strict=True) if x < bound[k]]
            if not wrong:
                out[active] = own
                return out
            active = [k for k in active if k not in wrong]
