"""Generalised least squares of one record, the noise taken from that record alone."""

import numpy as np
from scipy.optimize import minimize

from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.evidence.linear import scaled_inverse
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.prediction.noise import MarkovCovariance

__all__ = ["SliceProblem", "bounded_gain", "estimate_slice_noise"]


def estimate_slice_noise(
    time: np.ndarray, rest: np.ndarray, X: np.ndarray, precision: np.ndarray
) -> ChannelNoise:
    """Restricted maximum likelihood of an autocorrelated process in one series.

    What the simulation gets wrong is in it, too, as long as no cause takes it: evidence against it
    is evidence against a model error without a shape of its own.

    Args:
        time: Of the rows [m], s.
        rest: Measured less predicted [m].
        X: Columns that are fitted beside [m, n].
        precision: Of their coefficients before the data [n].
    """
    gap = np.diff(time)
    scale = max(float(rest.std()), 1e-3)
    # A column that does nothing here has no say in the likelihood.
    used = np.abs(X).max(0) > 1e-9
    X, prior = X[:, used], precision[used]

    def objective(x: np.ndarray) -> float:
        ar, tau, white = np.exp(x)
        V = MarkovCovariance(gap, ar, tau, white)
        XV = V.solve(X)
        A = X.T @ XV + np.diag(prior)
        b = XV.T @ rest
        _, log_det = np.linalg.slogdet(A)
        square = float(rest @ V.solve(rest[:, None])[:, 0] - b @ scaled_inverse(A) @ b)
        return V.log_det() + float(log_det) + square

    step, span = float(np.median(gap)), float(time[-1] - time[0])
    bounds = [
        (np.log(0.02 * scale), np.log(20.0 * scale)),
        (np.log(step), np.log(0.5 * span)),
        (np.log(0.01 * scale), np.log(3.0 * scale)),
    ]
    fits = [
        minimize(
            objective,
            np.log([scale, tau, 0.1 * scale]),
            method="L-BFGS-B",
            bounds=bounds,
        )
        for tau in (5.0 * step, 0.05 * span)
    ]
    ar, tau, white = np.exp(min(fits, key=lambda f: f.fun).x).tolist()
    return ChannelNoise(ar, tau, white)


class SliceProblem:
    """Generalised least squares of one record: what the free columns leave of causes and of y."""

    def __init__(
        self,
        found: Sensitivities,
        X: np.ndarray,
        precision: np.ndarray,
        noise: tuple[ChannelNoise, ...],
    ) -> None:
        self.found, self.X, self.precision, self.noise = found, X, precision, noise
        (self.record,) = found.records
        self.C = self.record.columns.astype(float)
        self.XV = self._weighted(X)
        self.CV = self._weighted(self.C)
        self.inverse = scaled_inverse(_product(X, self.XV) + np.diag(precision))
        self.cross = _product(X, self.CV)
        # Of all columns with each other, beside the free ones.
        self.gram = _product(self.C, self.CV) - self.cross.T @ self.inverse @ self.cross
        gap = np.diff(self.record.time)
        self._draws = [MarkovCovariance(gap, n.ar, n.tau, n.white) for n in noise]

    def _weighted(self, columns: np.ndarray) -> np.ndarray:
        time = self.record.time
        return np.stack([n.solve(time, columns[:, c]) for c, n in enumerate(self.noise)], axis=1)

    def with_y(self, y: np.ndarray) -> np.ndarray:
        """Scalar products of all columns with a residual [m, c], beside the free ones [K]."""
        b = np.tensordot(self.CV, y, ((0, 1), (0, 1)))
        return np.asarray(
            b - self.cross.T @ (self.inverse @ np.tensordot(self.XV, y, ((0, 1), (0, 1))))
        )

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """A residual where nothing is wrong [m, c]: the process, and what is free or known but for
        a spread as it may be."""
        y = np.column_stack([V.sample(rng) for V in self._draws])
        deviation = 1.0 / np.sqrt(self.precision)
        return np.asarray(y + self.X @ (deviation * rng.normal(size=len(deviation))))


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.tensordot(a, b, ((0, 1), (0, 1))))


def bounded_gain(A: np.ndarray, b: np.ndarray, one_sided: list[bool]) -> tuple[float, np.ndarray]:
    """Gain in the quadratic form where one-sided coefficients are not negative, and these."""
    n = len(b)
    full = (1 << n) - 1
    best, at = 0.0, np.zeros(n)
    for bits in range(1, full + 1) if any(one_sided) else [full]:
        active = [k for k in range(n) if bits >> k & 1 and A[k, k] > 1e-9]
        if not active:
            continue
        g = scaled_inverse(A[np.ix_(active, active)], 1e-8) @ b[active]
        if all(x >= 0.0 or not one_sided[k] for k, x in zip(active, g, strict=True)):
            gain = float(b[active] @ g)
            if gain > best:
                best, at = gain, np.zeros(n)
                at[active] = g
    return best, at
