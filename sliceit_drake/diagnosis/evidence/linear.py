"""The linear problem of a diagnosis, reduced to moments: records, what they share, what is their
own.

A record r is y_r = F_r b + E_r a_r + D_r d + C_r g + noise: y_r measured less predicted, F_r the
base parameters, E_r what differs from slice to slice (a_r normal, its variance estimated), D_r the
discretisation and what else the model may be off by in a known measure (d normal, known variance),
C_r the causes. The noise is that of `noise_levels`. All that the statistics need of a record is its
Gram matrix weighted with the inverse of the noise's covariance.
"""

import copy
import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from sliceit_drake.diagnosis.evidence.columns import (
    MESH,
    RecordSensitivity,
    Sensitivities,
    replicates,
)
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise, differences, estimate_noise

__all__ = ["USUAL", "LinearProblem", "Moments", "integrate_out", "scaled_inverse"]

KNOT = 4e-3
"""Spacing of the splines of depth in which the discretisation's error is taken to vary, metres."""
PHASE_KNOTS = 20
"""Splines over the time of each condition's record, for the nonparametric correction."""
USUAL = {
    ("sensor_delay", "delay"): (1.5e-3, False),
    **{("sensor_zero", f"bias_{a}"): (0.1, True) for a in "xyz"},
    **{("sensor_zero", f"drift_{a}"): (0.02, True) for a in "xyz"},
}
"""What every sensor has, by cause and parameter: usual standard deviation in its unit, and whether
that differs from record to record. Only more than that is a finding, or what should differ and is
the same in all records."""
DISCRETISATION = 0.5
"""Standard deviation of the discretisation's error as a function of depth, in that of the mesh
column."""
FINE_MESH = 0.3
"""The same of each row by itself."""
SECOND_ORDER = 0.5
"""The same of a row by what is beyond the first order of a record's own values, in that."""
RIDGE = 1e-8
KEPT = 4
"""Sets of reduced Gram matrices that are kept."""


@dc.dataclass
class Moments:
    """Gram matrices of all records, each over [columns, splines of depth, correction, y].

    Attributes:
        gram: [R, K + 1, K + 1], y last. The correction's columns are of the record's condition.
        force_gram: Of the force's components without weights, where the knife touches and the force
            does not jump [R, K + 1, K + 1], N^2.
        force_rows: Number of such rows of each record [R].
    """

    gram: np.ndarray
    force_gram: np.ndarray
    force_rows: np.ndarray


class LinearProblem:
    """Moments of records, and the levels of noise and variation, which are estimated by default.

    Attributes:
        found: Sensitivities.
        noise: Of each channel.
        repeated: Whether the noise is from replicates.
        conditions: Numbers of the records of each condition.
        base, own, numerical: Numbers of columns.
        mesh: Number of the column of the mesh; None without one.
        usual: Numbers of columns of `USUAL` that all records share, and their standard deviations.
        usual_own: The same of those that are each record's own.
        spline: Numbers of the columns appended for the discretisation's error.
        discretisation: Standard deviations of their coefficients [len(spline)], N and Nm.
        correction: Numbers of the columns of each condition's nonparametric correction.
        size: Number of all columns; y stands there.
        moments: Of the records.
        forces: Numbers of the channels that are forces.
        variation: Standard deviations of what differs from slice to slice [len(own)], in the
            columns' sizes.
        variation_samples: Number of independent differences that they were estimated from.
    """

    def __init__(
        self,
        found: Sensitivities,
        noise: Sequence[ChannelNoise] | None = None,
        variation: np.ndarray | None = None,
    ) -> None:
        self.found = found
        self.base = found.index("base")
        self.own = found.index("record")
        self.numerical = found.index("numerical")
        self.mesh = next(iter(found.index("numerical", MESH.name)), None)
        self.conditions = replicates(found.records)
        if noise is None:
            self.noise, self.repeated = estimate_noise(found.records, self.own)
        else:
            self.noise, self.repeated = tuple(noise), True
        self._reduced: dict[tuple[tuple[int, ...], bytes], np.ndarray] = {}
        self.usual, self.usual_own = self._usual()
        self._make_moments()
        self.variation_samples = sum(len(g) - 1 for g in self.conditions.values())
        self.variation = self._estimate_variation() if variation is None else variation

    def _usual(self) -> tuple[dict[int, float], dict[int, float]]:
        shared: dict[int, float] = {}
        own: dict[int, float] = {}
        for k, column in enumerate(self.found.columns):
            if (column.name, column.parameter) in USUAL:
                deviation, differs = USUAL[column.name, column.parameter]
                (own if differs else shared)[k] = deviation / column.size
        return shared, own

    def _make_moments(self) -> None:
        found = self.found
        K = len(found.columns)
        channels = found.records[0].channels
        reach = max(float(r.depth.max()) for r in found.records)
        count = max(2, int(np.ceil(max(reach, KNOT) / KNOT)) + 1)
        S = count * len(channels)
        N = PHASE_KNOTS * len(channels)
        self.spline = list(range(K, K + S))
        self.correction = list(range(K + S, K + S + N))
        self.size = K + S + N
        self.discretisation = np.repeat(self._mesh_scale(len(channels)), count)
        gram = np.zeros((len(found.records), self.size + 1, self.size + 1))
        force_gram, force_rows = np.zeros_like(gram), np.zeros(len(found.records), int)
        self.forces = found.records[0].forces
        for r, record in enumerate(found.records):
            X = self._table(record)
            gram[r] = self._weighted(record.time, X, self.model_error(record))
            calm = self.calm(record)
            inside = X[calm][:, self.forces].reshape(-1, self.size + 1)
            force_gram[r] = inside.T @ inside
            force_rows[r] = int(calm.sum())
        self.moments = Moments(gram, force_gram, force_rows)

    def _table(self, record: RecordSensitivity) -> np.ndarray:
        """All columns and what is left of a record [m, c, K + 1]."""
        channels = len(record.channels)
        return np.concatenate(
            [
                record.columns,
                _depth_splines(record, len(self.spline) // channels, channels),
                _time_splines(record, channels),
                record.residual[:, :, None],
            ],
            axis=2,
        )

    def calm(self, record: RecordSensitivity) -> np.ndarray:
        """Rows in contact at which the force does not jump [m]."""
        deviation = np.array([noise.deviation for noise in self.noise])
        return np.asarray(record.in_contact & (record.kinks() < deviation).all(1))

    def predicting(self, predicted: Sequence[np.ndarray]) -> "LinearProblem":
        """The same problem, weights included, about another prediction of each record [m, c]."""
        out = copy.copy(self)
        out._reduced = {}
        gram, force_gram = self.moments.gram.copy(), self.moments.force_gram.copy()
        records = []
        for r, (record, values) in enumerate(zip(self.found.records, predicted, strict=True)):
            moved = dc.replace(
                record, predicted=values if record.bent is None else values + record.bent
            )
            records.append(moved)
            X, error, calm = self._table(moved), self.model_error(record), self.calm(record)
            b, inside = np.zeros(self.size + 1), X[calm][:, self.forces]
            for c, noise in enumerate(self.noise):
                b += X[:, c].T @ noise.solve(record.time, X[:, c, -1:], error[:, c])[:, 0]
            gram[r, -1], gram[r, :, -1] = b, b
            b = np.einsum("mck,mc->k", inside, inside[:, :, -1])
            force_gram[r, -1], force_gram[r, :, -1] = b, b
        out.found = dc.replace(self.found, records=records)
        out.moments = Moments(gram, force_gram, self.moments.force_rows)
        return out

    def reduced(self, own: Sequence[int], variance: np.ndarray) -> np.ndarray:
        """Gram matrices with normal coefficients of these columns [n], of variance [n], integrated
        out [R, K + 1, K + 1]."""
        key = (tuple(own), variance.tobytes())
        if key not in self._reduced:
            if len(self._reduced) > KEPT:
                self._reduced.clear()
            gram = self.moments.gram
            self._reduced[key] = np.array([integrate_out(G, list(own), variance) for G in gram])
        return self._reduced[key]

    def _mesh_scale(self, channels: int) -> np.ndarray:
        """Standard deviation of the discretisation's error by channel [c]."""
        if self.mesh is None:
            return np.full(channels, RIDGE)
        squares, count = np.zeros(channels), 0
        for record in self.found.records:
            inside = record.in_contact
            squares += (record.columns[inside][:, :, self.mesh] ** 2).sum(0)
            count += int(inside.sum())
        return DISCRETISATION * np.sqrt(squares / max(count, 1)) + RIDGE

    @property
    def baseline(self) -> list[int]:
        """Numbers of the columns that all records share and that are fitted in any case."""
        return [*self.base, *self.numerical, *self.spline, *self.usual]

    def own_prior(
        self, without: Sequence[int] = (), free: Mapping[int, float] | None = None
    ) -> tuple[list[int], np.ndarray]:
        """Numbers of the columns that are each record's own, and the variances of their
        coefficients.

        Args:
            without: Columns to leave out.
            free: Columns to add, and the variances of their coefficients.
        """
        free = free or {}
        usual = {k: deviation for k, deviation in self.usual_own.items() if k not in without}
        deviations = np.concatenate([self.variation, np.array(list(usual.values()))])
        return [*self.own, *usual, *free], np.concatenate([deviations**2, list(free.values())])

    def fit_shared(
        self, total: np.ndarray, columns: list[int], flat: Sequence[int] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of columns that all records share, and their covariance.

        Args:
            total: Sum of Gram matrices from which what is each record's own is integrated out.
            columns: Numbers [n].
            flat: Those of them of which nothing is taken for usual.
        """
        prior = self.prior()
        prior[list(flat)] = 0.0
        A = total[np.ix_(columns, columns)] + np.diag(prior[columns])
        covariance = scaled_inverse(A)
        return covariance @ total[columns, self.size], covariance

    def prior(self) -> np.ndarray:
        """Precision of the columns' coefficients before the data [K]: 0 where nothing is known."""
        out = np.zeros(self.size)
        out[self.numerical] = 1.0
        out[self.spline] = 1.0 / self.discretisation**2
        for k, deviation in self.usual.items():
            out[k] = 1.0 / deviation**2
        return out

    def _estimate_variation(self) -> np.ndarray:
        """Maximum likelihood of the variation, from differences within conditions alone."""
        if self.variation_samples == 0 or not self.own:
            return np.ones(len(self.own))
        grams: list[tuple[np.ndarray, float]] = []
        own = [*self.own, *self.usual_own]
        for group in self.conditions.values():
            n, members = len(group), [self.found.records[k] for k in group]
            error = self.model_error(members[0])
            for time, rest, columns in differences(members, own) if n > 1 else ():
                scaled = np.sqrt(n / (n - 1.0)) * rest
                X = np.concatenate([columns, scaled[:, :, None]], axis=2)
                # Of n deviations from their mean n - 1 are independent.
                grams.append((self._weighted(time, X, error[: len(time)]), (n - 1.0) / n))
        d = len(self.own)
        usual = np.array(list(self.usual_own.values()))

        def objective(log_s: np.ndarray) -> float:
            s2 = np.concatenate([np.exp(2.0 * log_s), usual**2])
            total = 0.0
            for G, weight in grams:
                inner = np.eye(len(s2)) + np.sqrt(np.outer(s2, s2)) * G[:-1, :-1]
                _, logdet = np.linalg.slogdet(inner)
                rest = integrate_out(G, list(range(len(s2))), s2)[-1, -1]
                total += weight * (logdet + rest)
            return float(total) + 0.05 * float((log_s**2).sum())

        fit = minimize(objective, np.zeros(d), method="L-BFGS-B", bounds=[(-4.0, 2.5)] * d)
        return np.exp(fit.x)

    def model_error(self, record: RecordSensitivity) -> np.ndarray:
        """Standard deviation of what the model is unsure of at each row by itself [m, c]: when a
        force jumps, and what a finer mesh still may change."""
        out = record.kinks()
        if self.mesh is not None:
            out = np.hypot(out, FINE_MESH * record.columns[:, :, self.mesh])
        if record.bent is not None:
            out = np.hypot(out, SECOND_ORDER * record.bent)
        return np.asarray(out)

    def _weighted(self, time: np.ndarray, X: np.ndarray, model_error: np.ndarray) -> np.ndarray:
        """Gram matrix of columns [m, c, k], weighted with noise and model error [k, k]."""
        G = np.zeros((X.shape[2], X.shape[2]))
        for c, noise in enumerate(self.noise):
            G += X[:, c].T @ noise.solve(time, X[:, c], model_error[:, c])
        return 0.5 * (G + G.T)


def scaled_inverse(A: np.ndarray, cutoff: float = 1e-10) -> np.ndarray:
    """Pseudo-inverse of a Gram matrix whose columns are of very different sizes."""
    scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=cutoff, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))


def integrate_out(G: np.ndarray, own: list[int], variance: np.ndarray) -> np.ndarray:
    """Gram matrix after normal coefficients of these columns are integrated out."""
    if not own:
        return G
    inner = G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12))
    factor = cho_factor(inner, check_finite=False)
    return np.asarray(G - G[:, own] @ cho_solve(factor, G[own], check_finite=False))


def _depth_splines(record: RecordSensitivity, count: int, channels: int) -> np.ndarray:
    """Hat functions of depth for each channel while the edge is in the food [m, c, c * count]."""
    knots = KNOT * np.arange(count)
    hats = np.maximum(1.0 - np.abs(record.depth[:, None] - knots) / KNOT, 0.0)
    hats[~record.in_contact | (record.depth <= 0.0)] = 0.0
    return _by_channel(hats, channels)


def _time_splines(record: RecordSensitivity, channels: int) -> np.ndarray:
    """Cubic splines over the time of a record for each channel [m, c, c * PHASE_KNOTS]."""
    inside = record.in_contact
    time = record.time
    low, high = (time[inside][[0, -1]] if inside.sum() > 10 else time[[0, -1]]).tolist()
    inner = np.linspace(low, high, PHASE_KNOTS - 2)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    basis = BSpline.design_matrix(np.clip(time, low, high), knots, 3).toarray()
    basis = basis[:, :PHASE_KNOTS]
    basis[(time < low) | (time > high)] = 0.0
    return _by_channel(basis, channels)


def _by_channel(shapes: np.ndarray, channels: int) -> np.ndarray:
    """Columns [m, k] for each channel by itself [m, c, c * k]."""
    return np.einsum("mk,cd->mcdk", shapes, np.eye(channels)).reshape(len(shapes), channels, -1)
