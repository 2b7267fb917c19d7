"""Confirms a diagnosis by simulation: the named causes are put into the simulator itself.

The statistics rest on derivatives. Here slices are simulated once more with the causes and base
parameters at the values that were found, these are corrected by a Gauss-Newton step from there, and
simulated again. The derivatives are corrected by what the last step did (Broyden, Math. Comp. 19,
1965): a toughness that goes with the speed lets a held edge relax when it falls, and does nothing
there when it rises. What the causes are worth is then what the simulator does with them.
"""

import dataclasses as dc
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import MESH, Column
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, fit_shared
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor

__all__ = ["Confirmation", "confirm", "predicted_at"]

ROUNDS = 3
WORTH = 0.5
"""Least fraction of the gain that the derivatives promise which a simulation must show."""


@dc.dataclass
class Confirmation:
    """What simulations with the causes in them say.

    Attributes:
        problem: The moments with the predictions of those simulations.
        values: Of the causes' parameters, by cause and name.
        factors: Of the base parameters, by name.
        promised, gained: Twice the gain in log-likelihood, by derivatives and as simulated.
    """

    problem: LinearProblem
    values: dict[str, dict[str, float]]
    factors: dict[str, float]
    promised: float
    gained: float

    @property
    def holds(self) -> bool:
        """Whether the simulation bears out what the derivatives promise."""
        return self.gained >= WORTH * self.promised


def confirm(
    problem: LinearProblem,
    predictor: SlicePredictor,
    causes: Sequence[tuple[Cause, Mapping[str, float]]],
    progress: Callable[[int, int], None] | None = None,
) -> Confirmation:
    """Simulates all records with causes in the simulator.

    Args:
        problem: Of the records, at the base model.
        predictor: Of the same records; the first meshing is that of the sensitivities.
        causes: At the values that were found. Those with values for each record act as they were
            found, linearly, and are left out here.
        progress: Called with the simulations done and in all.
    """
    found = problem.found
    causes = [(cause, values) for cause, values in causes if not cause.per_record]
    shared = found.of_causes(
        [(c.name, None if c.scan is None else values.get(c.scan.name)) for c, values in causes]
    )
    columns = [*problem.base, *shared]
    _, start = _fit(problem, problem.base, [])
    step, end = _fit(problem, columns, shared)
    promised = start - end
    at = {cause.name: dict(values) for cause, values in causes}
    logs = {k: float(x) * found.columns[k].size for k, x in zip(problem.base, step, strict=False)}
    model = predictor.model_with_food
    assert model is not None
    calibrated = {k: float(get_parameter(model, found.columns[k].name)) for k in logs}
    rounds: list[tuple[float, LinearProblem, dict[str, dict[str, float]], dict[int, float]]] = []
    last, place = problem, np.zeros(len(columns))
    for _ in range(ROUNDS):
        base = {found.columns[k].name: calibrated[k] * float(np.exp(x)) for k, x in logs.items()}
        active = tuple(ActiveCause(cause, at[cause.name]) for cause, _ in causes)
        moved = predicted_at(Point(values=base, causes=active), problem, predictor, progress)
        here = _place(columns, found.columns, logs, at, {c.name: c for c, _ in causes})
        moved = _corrected(last, moved, columns, here - place)
        last, place = moved, here
        step, _ = _fit(moved, columns, shared)
        # As it is there: what a further step promises is not simulated.
        _, chi_square = _fit(moved, problem.base, [])
        rounds.append((chi_square, moved, {n: dict(v) for n, v in at.items()}, dict(logs)))
        for k, change in zip(columns, step, strict=True):
            column = found.columns[k]
            if k in logs:
                logs[k] += float(np.clip(change, -3.0, 3.0)) * column.size
                continue
            cause = next(c for c, _ in causes if c.name == column.name)
            value = at[column.name][column.parameter] + float(change) * column.size
            at[column.name][column.parameter] = cause.parameter(column.parameter).within(value)
    chi_square, moved, at, logs = min(rounds, key=lambda each: each[0])
    return Confirmation(
        problem=moved,
        values=at,
        factors={found.columns[k].name: float(np.exp(x)) for k, x in logs.items()},
        promised=promised,
        gained=start - chi_square,
    )


def _place(
    columns: Sequence[int],
    kinds: Sequence[Column],
    logs: Mapping[int, float],
    at: Mapping[str, Mapping[str, float]],
    causes: Mapping[str, Cause],
) -> np.ndarray:
    """Where a simulation is: distances from the base model, in the columns' sizes [n]."""
    out = []
    for k in columns:
        c = kinds[k]
        if k in logs:
            out.append(logs[k] / c.size)
        else:
            null = causes[c.name].parameter(c.parameter).null
            out.append((at[c.name][c.parameter] - null) / c.size)
    return np.array(out)


def _corrected(
    last: LinearProblem, moved: LinearProblem, columns: Sequence[int], step: np.ndarray
) -> LinearProblem:
    """A problem with the derivatives of the last, corrected so that they give what a step between
    the two did, in the columns' sizes [n]."""
    if not step.any():
        return moved
    records = [
        dc.replace(after, columns=before.columns).corrected(
            columns, step, after.predicted - before.predicted
        )
        for before, after in zip(last.found.records, moved.found.records, strict=True)
    ]
    # Made anew: where a force jumps is where the simulation now has it.
    found = dc.replace(moved.found, records=records)
    out = LinearProblem(found, *moved.slice_levels)
    out.near = moved.near
    return out


def _fit(problem: LinearProblem, columns: list[int], causes: list[int]) -> tuple[np.ndarray, float]:
    """Coefficients of columns [n], and twice the negative logarithm of the restricted likelihood
    but for a constant, at the sizes of the discrepancy that are best with the columns."""
    named = [k for k in columns if k in causes]
    sizes, value = problem.fitted_sizes(named, problem.sizes)
    model = problem.with_causes(named)
    theta, _ = fit_shared(problem.weighted(model, sizes).total, model)
    at = [model.shared.index(k) for k in columns]
    return np.asarray(theta[at]), -2.0 * value


def predicted_at(
    point: Point,
    problem: LinearProblem,
    predictor: SlicePredictor,
    progress: Callable[[int, int], None] | None = None,
) -> LinearProblem:
    """The problem with what slices simulated at a point predict."""
    (row,) = predictor.predict([point], progress)
    # Also where an error is known, and the column is fitted no more.
    mesh = problem.found.index("numerical", MESH.name)
    moved = []
    for record, target, series in zip(problem.found.records, predictor.targets, row, strict=True):
        assert series is not None
        seen = target.compare(series.wrench)
        # Of the finer mesh, as the prediction is; its difference is taken from the base model.
        moved.append(seen - record.columns[:, :, mesh].sum(2))
    return problem.predicting(moved)
