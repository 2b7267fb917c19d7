"""Causes seen at the size that was found, instead of near where they are absent.

A column is a derivative over a cause's size. A law of the draw, (1 + xi^2)^-a, or a board that
stiffens, (F / F_0)^a, bends within a few sizes, so that a straight line from null asks for an
exponent that does not exist, and another cause may seem to explain more. Causes that gain are
simulated at what was found, and their columns are corrected so that they give what the simulation
did (Broyden, Math. Comp. 19, 1965).
"""

import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence
from sliceit_drake.diagnosis.evidence.sensitivity import Progress
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor

__all__ = ["AtSize"]

ROUNDS = 2
"""Times that a cause is simulated at most."""
CLOSE = 0.1
"""Share of a cause's numbers by which they may change without another simulation."""


class AtSize:
    """Corrects the columns of causes at what was found of them.

    Args:
        predictor: Of the records; the first meshing is that of the sensitivities.
        causes: All that are tested, by name.
        progress: Called with the number of simulated slices, and of those that must be.
    """

    def __init__(
        self,
        predictor: SlicePredictor,
        causes: Mapping[str, Cause],
        progress: Progress | None = None,
    ) -> None:
        self.predictor, self.causes, self.progress = predictor, causes, progress
        self._simulated: dict[CauseAtScan, list[np.ndarray]] = {}

    def __call__(
        self, problem: LinearProblem, found: Sequence[CauseEvidence]
    ) -> LinearProblem | None:
        """The problem with the columns of some causes corrected; None where none needs it: what is
        within a size, or was simulated near what was found."""
        steps = {}
        for e in found:
            step = self._step(problem, e)
            before = self._simulated.setdefault(e.cause, [])
            near = before and np.linalg.norm(step - before[-1]) < CLOSE * np.linalg.norm(step)
            if np.abs(step).max() > 1.0 and len(before) < ROUNDS and not near:
                steps[e.cause] = step
        if not steps:
            return None
        active = [self._active(problem, cause, step) for cause, step in steps.items()]
        points = [Point(), *(Point(causes=(cause,)) for cause in active)]
        null, *moved = self.predictor.predict(points, self.progress)
        records = []
        for r, record in enumerate(problem.found.records):
            series = [row[r] for row in (null, *moved)]
            wrenches = np.stack([s.wrench for s in series if s is not None], axis=2)
            seen = self.predictor.targets[r].compare(wrenches)
            columns = record.columns.astype(float)
            for k, (cause, step) in enumerate(steps.items(), 1):
                own = problem.found.of_causes([cause])
                missed = seen[:, :, k] - seen[:, :, 0] - columns[:, :, own] @ step
                # Of a slice that broke down the derivatives stay.
                if np.isfinite(missed).all():
                    columns[:, :, own] += missed[:, :, None] * step / (step @ step)
            records.append(dc.replace(record, columns=columns))
        for cause, step in steps.items():
            self._simulated[cause].append(step)
        return LinearProblem(
            dc.replace(problem.found, records=records), problem.noise, problem.variation
        )

    def _step(self, problem: LinearProblem, e: CauseEvidence) -> np.ndarray:
        """Numbers of a cause in their range, in its columns' sizes [n]."""
        of = {c.parameter: g for c, g in zip(e.columns, e.coefficients, strict=True)}
        kinds = [problem.found.columns[k] for k in problem.found.of_causes([e.cause])]
        inside = [np.clip(of.get(c.parameter, 0.0) * c.size, c.low, c.high) / c.size for c in kinds]
        return np.array(inside)

    def _active(self, problem: LinearProblem, at: CauseAtScan, step: np.ndarray) -> ActiveCause:
        name, scan = at
        cause = self.causes[name]
        values = cause.nulls(scan)
        for k, s in zip(problem.found.of_causes([at]), step, strict=True):
            column = problem.found.columns[k]
            values[column.parameter] += float(s) * column.size
        return ActiveCause(cause, values)
