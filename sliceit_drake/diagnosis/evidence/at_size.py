"""Causes seen at the size that was found, instead of near where they are absent.

A column is a derivative over a cause's size. A law of the draw, (1 + xi^2)^-a, or a board that
stiffens, (F / F_0)^a, bends within a few sizes, so that a straight line from null asks for an
exponent that does not exist, and another cause may seem to explain more. So does the press of an
arm that gives on a stiff board, which falls less and less with what it gives. A cause that gains is
simulated at what was found, and its columns are corrected so that they give what the simulation
did.
"""

from collections.abc import Mapping

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence
from sliceit_drake.diagnosis.evidence.sensitivity import Progress
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor, changes_at

__all__ = ["AtSize"]

ROUNDS = 4
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
        self, problem: LinearProblem, e: CauseEvidence, contested: bool = False
    ) -> LinearProblem | None:
        """The problem with the columns of a cause corrected; None where that is not needed: what is
        within a size of a derivative, unless another explains nearly as much, or was simulated near
        what was found. A column of one side is no derivative but what its whole size does."""
        step, before = self._step(problem, e), self._simulated.setdefault(e.cause, [])
        near = before and np.linalg.norm(step - before[-1]) < CLOSE * np.linalg.norm(step)
        own = problem.found.of_causes([e.cause])
        one_sided = np.array([problem.found.columns[k].one_sided for k in own])
        within = not contested and np.abs(step).max() <= 1.0 and not step[one_sided].any()
        if within or len(before) == ROUNDS or near:
            return None
        before.append(step)
        change = self._change(problem, e.cause, step)
        # What a number at its end does beside the others is seen from there too.
        beside = {}
        for i in np.flatnonzero(one_sided & (step == 0.0)):
            column, further = problem.found.columns[own[i]], step.copy()
            further[i] = min(np.abs(step).max(), column.high / column.size)
            beside[own[i]] = further[i], self._change(problem, e.cause, further)
        records = []
        for number, record in enumerate(problem.found.records):
            there = change[number]
            if there is not None:
                record = record.corrected(own, step, there)
                for k, (by, changes) in beside.items():
                    if (moved := changes[number]) is not None:
                        record.columns[:, :, k] = (moved - there) / by
            # Of a slice that broke down the derivatives stay.
            records.append(record)
        return problem.correcting(records, own)

    def _step(self, problem: LinearProblem, e: CauseEvidence) -> np.ndarray:
        """Numbers of a cause in their range, in its columns' sizes [n]."""
        of = {c.parameter: g for c, g in zip(e.columns, e.coefficients, strict=True)}
        kinds = [problem.found.columns[k] for k in problem.found.of_causes([e.cause])]
        inside = [np.clip(of.get(c.parameter, 0.0) * c.size, c.low, c.high) / c.size for c in kinds]
        return np.array(inside)

    def _change(
        self, problem: LinearProblem, at: CauseAtScan, step: np.ndarray
    ) -> list[np.ndarray | None]:
        """Of the prediction of each record by a step of a cause [m, c], N and Nm."""
        point = Point(causes=(self._active(problem, at, step),))
        return changes_at(point, self.predictor, self.progress)

    def _active(self, problem: LinearProblem, at: CauseAtScan, step: np.ndarray) -> ActiveCause:
        name, scan = at
        cause = self.causes[name]
        values = cause.nulls(scan)
        for k, s in zip(problem.found.of_causes([at]), step, strict=True):
            column = problem.found.columns[k]
            values[column.parameter] += float(s) * column.size
        return ActiveCause(cause, values)
