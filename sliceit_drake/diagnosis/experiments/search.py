"""The search for the motions that part the causes of a class with the fewest slices."""

import dataclasses as dc
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import (
    CauseAtScan,
    RecordSensitivity,
    Sensitivities,
)
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, scaled_inverse
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening
from sliceit_drake.diagnosis.evidence.sensitivity import Progress, sensitivities
from sliceit_drake.diagnosis.evidence.verdict import MIN_REPLICATES
from sliceit_drake.diagnosis.experiments.planned_record import (
    planned_record,
    template_of,
)
from sliceit_drake.diagnosis.experiments.proposal import NextExperiment, Pair, Step
from sliceit_drake.diagnosis.result import Diagnosis
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["CauseClass", "ExperimentSearch"]

SLICE_COST, HAND_COST = 1.0, 5.0
"""What a slice, and handwork, must bring: degrees nearer to `WANTED`, over all pairs."""
MOST_SLICES = 12
"""More slices of one motion are not proposed."""
MOST_STEPS = 3
"""More motions are not proposed."""
USUAL = ("sensor_delay", "sensor_zero")
"""Causes that every record has a little of; they are fitted beside."""


@dc.dataclass(frozen=True)
class CauseClass:
    """Causes to be told apart, their evidence, and what is in the model beside."""

    evidence: list[CauseEvidence]
    screening: Screening
    assumed: tuple[CauseAtScan, ...]


@dc.dataclass
class _Choice:
    """Slices of experiments, by the number of the experiment, and what they do."""

    counts: dict[int, int]
    pairs: list[Pair]
    by_hand: int

    @property
    def cost(self) -> float:
        """What is missing and what it takes, degrees."""
        missing = sum(p.missing for p in self.pairs)
        return missing + SLICE_COST * sum(self.counts.values()) + HAND_COST * self.by_hand

    @property
    def key(self) -> tuple[float, float]:
        """The smaller the better."""
        return self.cost, -min(p.after for p in self.pairs)


class ExperimentSearch:
    """The motions of a menu against classes that are to be told apart; see `next_experiment`."""

    def __init__(
        self,
        diagnosis: Diagnosis,
        menu: list[Step],
        classes: list[CauseClass],
        records: Sequence[SliceRecord],
        cache: Path | None,
        workers: Workers,
        progress: Progress | None,
    ) -> None:
        self.menu, self.classes = menu, classes
        setup, template = diagnosis.setup, template_of(records)
        first = 1 + max(r.metadata.slice_index for r in records)
        planned = [planned_record(step.plan, setup, template, first) for step in menu]
        found = diagnosis.problem.found
        names = {e.name for c in self.classes for e in c.evidence} | set(USUAL)
        names |= {name for c in self.classes for name, _ in c.assumed}
        causes = [diagnosis.causes[n] for n in found.causes if n in names]
        new = sensitivities(setup, planned, causes, cache=cache, workers=workers, progress=progress)
        self.problem = _joined(diagnosis.problem, new, names)
        reduced = self.problem.reduced(*self.problem.own_prior())
        count = len(found.records)
        self.old, self.new = np.sum(reduced[:count], axis=0), reduced[count:]
        self._before = self._angles(self.old)

    def _projected(self, total: np.ndarray, assumed: Sequence[CauseAtScan]) -> np.ndarray:
        """What is left of a summed Gram matrix beside what is fitted in any case."""
        problem = self.problem
        baseline = list(dict.fromkeys([*problem.baseline, *problem.found.of_causes(assumed)]))
        inverse = scaled_inverse(
            total[np.ix_(baseline, baseline)] + np.diag(problem.prior()[baseline])
        )
        return np.asarray(total - total[:, baseline] @ inverse @ total[baseline])

    def _angles(self, total: np.ndarray) -> list[tuple[str, str, float, float]]:
        """Angle, degrees, and expected gain of each ordered pair of causes."""
        out = []
        for members in self.classes:
            screening = dc.replace(
                members.screening, projected=self._projected(total, members.assumed)
            )
            for a, b in itertools.permutations(members.evidence, 2):
                own = self.problem.found.of_causes([a.cause])
                e = np.array(a.coefficients)
                square = float(e @ screening.projected[np.ix_(own, own)] @ e)
                angle = screening.angle_to(self.problem, a, b.name) if square > 0.0 else 0.0
                gain = square * float(np.sin(np.radians(angle))) ** 2
                out.append((a.name, b.name, angle, gain))
        return out

    def pairs(self, counts: Mapping[int, int]) -> list[Pair]:
        """What slices of experiments do, by the number of the experiment."""
        total = self.old + np.sum([n * self.new[k] for k, n in counts.items()], axis=0)
        return [
            Pair(a, b, was, angle, gain, (gain - start) / max(sum(counts.values()), 1))
            for (a, b, was, start), (_, _, angle, gain) in zip(
                self._before, self._angles(total), strict=True
            )
        ]

    def _further(self, choice: _Choice) -> _Choice:
        """The best with one experiment more."""
        choices = []
        for number, step in enumerate(self.menu):
            if number in choice.counts:
                continue
            by_hand = choice.by_hand + bool(step.experiment.by_hand)
            for slices in range(MIN_REPLICATES, MOST_SLICES + 1):
                counts = {**choice.counts, number: slices}
                choices.append(_Choice(counts, self.pairs(counts), by_hand))
        return min(choices, key=lambda c: c.key)

    def result(self) -> NextExperiment:
        """The motions that part most with least."""
        choice = _Choice({}, self.pairs({}), 0)
        while len(choice.counts) < MOST_STEPS and not all(p.parts for p in choice.pairs):
            further = self._further(choice)
            if further.cost >= choice.cost:
                break
            choice = further
        counts, pairs = choice.counts, choice.pairs
        steps = [dc.replace(self.menu[k], slices=n) for k, n in counts.items()]
        classes = "; ".join("{" + ", ".join(e.name for e in c.evidence) + "}" for c in self.classes)
        if all(p.parts for p in pairs) and not steps:
            reason = f"nothing to split: the records at hand part {classes}"
            return NextExperiment("none", reason, [], pairs)
        if not steps:
            least = [
                min(p.after for p in self.pairs({k: MOST_SLICES})) for k in range(len(self.menu))
            ]
            number = int(np.argmax(least))
            name = self.menu[number].plan.name
            reason = (
                f"no motion of the menu parts more of {classes} at the sizes found; the largest "
                f"least angle, {least[number]:.0f} degrees, is that of {name}"
            )
            return NextExperiment("none", reason, [], self.pairs({number: MOST_SLICES}))
        left = sorted({tuple(sorted((p.true, p.fitted))) for p in pairs if not p.parts})
        reason = f"to split {classes}"
        if left:
            reason += "; not parted: " + ", ".join(f"{a} from {b}" for a, b in left)
        return NextExperiment("split", reason, steps, pairs)


def _joined(problem: LinearProblem, new: Sensitivities, names: set[str]) -> LinearProblem:
    """The problem of old and new records, with the noise and the variation of the old."""
    old = problem.found
    kept = [k for k, c in enumerate(old.columns) if c.kind != "cause" or c.name in names]
    columns = [old.columns[k] for k in kept]
    place = {column: k for k, column in enumerate(new.columns)}
    at = [place.get(column) for column in columns]

    def picked(values: np.ndarray) -> np.ndarray:
        # What differs where something is not known, as a speed, is known of a planned record.
        absent = np.zeros((*values.shape[:2], 1), values.dtype)
        padded = np.concatenate([values, absent], axis=2)
        return padded[:, :, [-1 if k is None else k for k in at]]

    records: list[RecordSensitivity] = [
        dc.replace(r, columns=r.columns[:, :, kept], even=r.even[:, :, kept]) for r in old.records
    ]
    records += [dc.replace(r, columns=picked(r.columns), even=picked(r.even)) for r in new.records]
    found = Sensitivities(columns, records, [], max(old.elements, new.elements))
    return LinearProblem(found, problem.noise, problem.variation)
