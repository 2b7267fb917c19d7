"""How large an effect is, over the noise and over what the simulation gets wrong by itself."""

import functools
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.linear import (
    LinearProblem,
    Model,
    fit_shared,
    integrate_out,
    scaled_inverse,
)
from sliceit_drake.prediction.discrepancy import PARTS, PHASES, Sizes

__all__ = ["OwnError", "size_by_record", "standardised_size"]

ACTS, GREAT = 0.1, 99.0
"""An effect acts in a row and channel from this share of this percentile of its changes on: a few
rows in which the force jumps are not all of it."""


class OwnError:
    """The discrepancy as it was found: its mean after the data.

    Args:
        problem: The records.
        model: What is fitted beside it.
        sizes: Of the discrepancy.

    Attributes:
        problem, model, sizes: As given.
        coefficients: Of the shapes in each record, by part and channel [R, 4, c, n].
        values: At the rows of each record [m, c], N and Nm.
    """

    def __init__(self, problem: LinearProblem, model: Model, sizes: Sizes) -> None:
        self.problem, self.model, self.sizes = problem, model, sizes
        self._weighted = weighted = problem.weighted(model, sizes)
        theta, self._covariance = fit_shared(weighted.total, model)
        self._fitted = np.zeros(len(weighted.total))
        self._fitted[-1], self._fitted[model.shared] = 1.0, -theta
        shape = len(PARTS), len(problem.noise), -1
        found = [parts.reshape(shape) for parts in weighted.found(self._fitted)]
        self.coefficients = [found[k] for k in problem.condition_of]
        self.values = [
            values @ parts.sum(0).T
            for values, parts in zip(problem.shape_values, self.coefficients, strict=True)
        ]

    @classmethod
    def beside(cls, problem: LinearProblem, causes: Sequence[CauseAtScan]) -> "OwnError":
        """The discrepancy beside causes, its sizes estimated with them in the model."""
        columns = problem.found.of_causes(causes)
        sizes = problem.fitted_sizes(columns, problem.sizes)[0] if columns else problem.sizes
        return cls(problem, problem.with_causes(columns), sizes)

    def left(self, number: int) -> np.ndarray:
        """The combination of all columns, the residual last, that is left of a record beside what
        all share and the discrepancy [K + 1]."""
        problem = self.problem
        out = np.zeros(problem.size + 1)
        out[problem.discrepancy.others] = self._fitted
        out[problem.shapes] = -self.coefficients[number].sum(0).ravel()
        return out

    @functools.cached_property
    def covariances(self) -> np.ndarray:
        """Of the shapes' coefficients in each condition and channel, after the data, where what is
        fitted is unsure as well: a part of them may have been taken for a cause [C, c, n, n]."""
        channels = len(self.problem.noise)
        found = self._weighted.covariances(self.model.shared, self._covariance)
        blocks = np.array(found).reshape(
            len(found), channels, -1, channels, len(found[0]) // channels
        )
        return np.einsum("kcicj->kcij", blocks)

    def scales(self, found: bool = False) -> list[np.ndarray]:
        """Root mean square at the rows of each record in its channel and phase of the motion, over
        all records, where the knife touches; 0 elsewhere [m, c], N and Nm.

        Of what was found and of how unsure that is; with `found` of what was found alone.
        """
        values = np.concatenate(self.values)
        out = np.zeros_like(values)
        for rows, products in zip(
            self.problem.rows_by_phase, self.problem.shape_products, strict=True
        ):
            square = (values[rows] ** 2).mean(0)
            if not found:
                square += np.einsum("kcij,kij->c", self.covariances, products)
            out[rows] = np.sqrt(square)
        return np.split(out, np.cumsum([len(v) for v in self.values])[:-1])

    def over_scales(self) -> np.ndarray:
        """Gram matrices of the columns of each record, the residual last, over noise, own error and
        what the model is unsure of at each row [R, K + 1, K + 1]; 0 for the shapes."""
        problem = self.problem
        out = np.zeros_like(problem.moments.gram)
        at = problem.discrepancy.others
        for G, record, scale in zip(
            out, problem.found.records, _scales(problem, self), strict=True
        ):
            columns = np.concatenate([record.columns, record.residual[:, :, None]], axis=2)
            columns = columns / scale[:, :, None]
            X = columns.reshape(-1, len(at))
            G[np.ix_(at, at)] = X.T @ X
        return out

    def by_part(self) -> dict[tuple[str, str, str], float]:
        """Mean square in contact over the noise's, by channel, phase and part."""
        problem, names = self.problem, self.problem.found.records[0].channels
        of_phase = problem.discrepancy.phase[: problem.shape_values[0].shape[1]]
        out = {(c, f, p): 0.0 for c in names for f in PHASES for p in PARTS}
        rows = 0
        for record, shapes, coefficients in zip(
            problem.found.records, problem.shape_values, self.coefficients, strict=True
        ):
            inside = shapes[record.in_contact]
            rows += len(inside)
            for f, phase in enumerate(PHASES):
                chosen = of_phase == f
                values = np.einsum("mn,pcn->pcm", inside[:, chosen], coefficients[:, :, chosen])
                for part, of_part in zip(PARTS, (values**2).sum(2), strict=True):
                    for name, square in zip(names, of_part, strict=True):
                        out[name, phase, part] += float(square)
        noise = {c: n.deviation**2 for c, n in zip(names, problem.noise, strict=True)}
        return {key: value / noise[key[0]] / max(rows, 1) for key, value in out.items()}


def standardised_size(
    problem: LinearProblem,
    columns: Sequence[int],
    coefficients: np.ndarray,
    wrong: OwnError | None = None,
    found: bool = False,
    beside: Sequence[int] = (),
) -> float:
    """Root mean square of an effect over sqrt(noise^2 + discrepancy^2), in the rows and channels in
    which it acts, once the base parameters, and causes that are in the model before, are refitted
    to it. The noise is with what the model is unsure of at each row (`LinearProblem.model_error`),
    as when exactly a force jumps.

    Args:
        problem: The records.
        columns: Numbers of the effect's columns [n].
        coefficients: Of the columns [n], or of each record [R, n].
        wrong: The discrepancy beside the effect; None for an effect that differs by record.
        found: Whether only what was found of it counts, not what it may be.
        beside: Numbers of the columns of those causes.
    """
    records, kinds = problem.found.records, problem.found.columns
    base = [*problem.base, *(k for k in beside if not kinds[k].per_record)]
    coefficients = np.broadcast_to(coefficients, (len(records), len(columns)))
    scales = _scales(problem, wrong, found)
    effects, free = [], []
    for record, scale, g in zip(records, scales, coefficients, strict=True):
        effects.append((record.columns[:, :, list(columns)] @ g / scale).ravel())
        free.append((record.columns[:, :, base] / scale[:, :, None]).reshape(-1, len(base)))
    effect, X = np.concatenate(effects), np.concatenate(free)
    left = effect - X @ (scaled_inverse(X.T @ X) @ (X.T @ effect)) if base else effect
    acts = _acts(effect)
    return float(np.sqrt(np.mean(left[acts] ** 2))) if acts.any() else 0.0


def size_by_record(
    problem: LinearProblem, columns: Sequence[int], coefficients: np.ndarray
) -> float:
    """Size of an effect that differs from record to record: `standardised_size` over the noise, or
    the same over the noise at the effect's own frequencies, whichever is more.

    A wave of 20 Hz shows plainly under noise that wanders within a second and has more variance.
    Whitened by the covariance of the noise, both have the same power at all frequencies.

    Args:
        problem: The records.
        columns: Numbers of the effect's columns [n].
        coefficients: Of the columns in each record [R, n], 0 where it does not show.
    """
    own, base = list(columns), problem.base
    gram, effects = np.zeros((len(base) + 1, len(base) + 1)), []
    of_slice = problem.uneven.reshape(len(problem.noise), -1)
    records = zip(
        problem.found.records,
        problem.shape_values,
        problem.levels[problem.condition_of],
        problem.scales,
        problem.errors,
        coefficients,
        strict=True,
    )
    for record, shapes, level, scale, error, g in records:
        uneven = (level[:, None] * of_slice) ** 2
        effect = record.columns[:, :, own] @ g
        effects.append((effect / scale).ravel())
        X = np.concatenate([record.columns[:, :, base], effect[:, :, None]], axis=2).astype(float)
        for c, noise in enumerate(problem.noise):
            all_of_it = np.column_stack([shapes, X[:, c]])
            G = all_of_it.T @ noise.solve(record.time, all_of_it, error[:, c], record.near)
            random = np.flatnonzero(uneven[c])
            fitted = shapes.shape[1]
            G = integrate_out(0.5 * (G + G.T), random.tolist(), uneven[c][random])
            gram += G[fitted:, fitted:]
    product = gram[:-1, -1]
    square = gram[-1, -1] - product @ scaled_inverse(gram[:-1, :-1]) @ product
    rows = int(_acts(np.concatenate(effects)).sum())
    whitened = float(np.sqrt(max(square, 0.0) / rows)) if rows else 0.0
    return max(whitened, standardised_size(problem, columns, coefficients))


def _scales(
    problem: LinearProblem, wrong: OwnError | None, found: bool = False
) -> list[np.ndarray]:
    """What an effect is compared with at the rows of each record, own error of the simulation
    included where one is given, each [m, c]."""
    if wrong is None:
        return problem.scales
    scales = zip(problem.variances, wrong.scales(found), strict=True)
    return [np.sqrt(own**2 + variance) for variance, own in scales]


def _acts(effect: np.ndarray) -> np.ndarray:
    """Rows and channels in which an effect acts."""
    whole = np.abs(effect)
    changed = whole[whole > 1e-3 * whole.max(initial=1e-12)]
    if not changed.size:
        return np.zeros(len(whole), bool)
    return np.asarray(whole > ACTS * np.percentile(changed, GREAT))
