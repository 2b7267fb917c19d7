"""Which slices to cut next, so that causes that the records at hand cannot tell apart part.

For each motion of a menu the sensitivities of the causes of a class are computed for a planned
record, and joined with those of the records at hand: what is shared stays shared, what is each
slice's own is integrated out. If cause A of the class is true, with the size that these records
give it, and B is fitted in its place, the expected loss of twice the log-likelihood is

    D = |A|^2 sin^2(angle),

both over old and new slices together, with the angle of A to all that B can do. Two causes part
where the angle is above that of a class in both directions, and D is what a test at the verdict's
level needs to find it nine times in ten (`proposal.POWER`). Every slice adds to D, so this gives
the number of slices.
"""

import dataclasses as dc
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.cutting.foods.shapes import MeshFile, Remainder, Tapered
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import USUAL, LinearProblem, beside
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening
from sliceit_drake.diagnosis.evidence.sensitivity import Progress, sensitivities
from sliceit_drake.diagnosis.evidence.verdict import CLASS_ANGLE, LAW, DecisionRule
from sliceit_drake.diagnosis.experiments.designs import menu
from sliceit_drake.diagnosis.experiments.planned_record import (
    experiment_of_record,
    next_knife_slice,
    planned_record,
    planned_slice,
    scale_of,
    template_of,
)
from sliceit_drake.diagnosis.experiments.proposal import MARGIN, NEEDED, NextExperiment, Pair, Step
from sliceit_drake.diagnosis.result import Diagnosis
from sliceit_drake.prediction.discrepancy import Weighted
from sliceit_drake.prediction.placement import is_bare
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["next_experiment"]

SLICE_COST, HAND_COST = 1.0, 5.0
"""What a slice, and handwork, must bring: degrees nearer to `WANTED`, over all pairs."""
MOST_SLICES = 12
"""More slices of one motion are not proposed."""
MOST_STEPS = 3
"""More motions are not proposed."""
ALIKE_GAIN = 0.35
"""A cause whose gain falls short of the largest by no more than this share may be the one that
acts: what it gains depends on how well the form that is assumed for it fits."""
EXPLORING = ("tour", "draw_3", "draw_1", "air")
"""Motions for what no cause explains: what differs most from one another."""
_CauseClass = tuple[list[CauseEvidence], Screening, bool]
"""Evidence for causes to be told apart, the screening that it is from, and whether they are to be
told from the simulation's own law as well."""


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


class _Search:
    """The motions of a menu against classes that are to be told apart; see `next_experiment`."""

    def __init__(
        self,
        diagnosis: Diagnosis,
        steps: list[Step],
        classes: list[_CauseClass],
        records: Sequence[SliceRecord],
        cache: Path | None,
        workers: Workers,
        progress: Progress | None,
    ) -> None:
        self.menu, self.classes = steps, classes
        setup, template = diagnosis.setup, template_of(records)
        first = 1 + max(r.metadata.slice_index for r in records)
        planned = [planned_record(step.plan, setup, template, first) for step in steps]
        found = diagnosis.problem.found
        # What every record has a little of is fitted beside.
        names = {e.name for evidence, _, _ in classes for e in evidence} | {
            name for name, _ in USUAL
        }
        names |= {name for _, screening, _ in classes for name, _ in screening.assumed}
        causes = [diagnosis.causes[n] for n in found.causes if n in names]
        new = sensitivities(setup, planned, causes, cache=cache, workers=workers, progress=progress)
        self.problem = _joined(diagnosis.problem, new, names)
        # As large as without any cause: what was found may be the simulation's own law. Of a force
        # that the records did not have, as of one along the edge, it is as wrong as of those.
        sizes, forces = diagnosis.problem.sizes, diagnosis.problem.forces
        channel = sizes.channel.copy()
        channel[forces] = channel[forces].max()
        self.sizes = dc.replace(sizes, channel=channel)
        self.count = len(found.records)
        self._before = self._angles(*self._totals({}))

    def _totals(self, counts: Mapping[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrices of all columns with the discrepancy integrated out and without one, of the
        records at hand and slices of experiments, by the number of the experiment."""
        problem = self.problem
        reduced = problem.reduced(problem.with_causes())
        weights = [1] * self.count + [counts.get(k, 0) for k in range(len(self.menu))]
        grams = [
            np.sum([weights[r] * reduced[r] for r in members], axis=0)
            for members in problem.conditions.values()
        ]
        return Weighted(problem.discrepancy, grams, self.sizes).total, np.sum(grams, axis=0)

    def _projected(self, total: np.ndarray, assumed: Sequence[CauseAtScan]) -> np.ndarray:
        """What is left of a summed Gram matrix beside what is fitted in any case."""
        problem = self.problem
        baseline = dict.fromkeys([*problem.baseline, *problem.found.of_causes(assumed)])
        return beside(total, list(baseline), problem.prior())

    def _angles(self, total: np.ndarray, plain: np.ndarray) -> list[tuple[str, str, float, float]]:
        """Angle, degrees, and expected gain of each ordered pair of causes, from Gram matrices of
        all columns with the discrepancy integrated out and without one."""
        out = []

        def square_of(effect: CauseEvidence, G: np.ndarray) -> float:
            own, e = self.problem.found.of_causes([effect.cause]), np.array(effect.coefficients)
            return float(e @ G[np.ix_(own, own)] @ e)

        for evidence, before, with_law in self.classes:
            screening = dc.replace(before, projected=self._projected(total, before.assumed))
            for a, b in itertools.permutations(evidence, 2):
                square = square_of(a, screening.projected)
                angle = screening.angle_to(self.problem, a, b.name) if square > 0.0 else 0.0
                gain = square * float(np.sin(np.radians(angle))) ** 2
                out.append((a.name, b.name, angle, gain))
            for a in evidence if with_law else ():
                # What an error of the law, which is alike in all cuts, leaves of the cause.
                left = max(square_of(a, screening.projected), 0.0)
                whole = max(square_of(a, self._projected(plain, before.assumed)), 1e-12)
                angle = float(np.degrees(np.arcsin(np.sqrt(min(left / whole, 1.0)))))
                out.append((a.name, LAW, angle, left))
        return out

    def pairs(self, counts: Mapping[int, int]) -> list[Pair]:
        """What slices of experiments do, by the number of the experiment."""
        totals = self._totals(counts)
        return [
            Pair(a, b, was, angle, gain, (gain - start) / max(sum(counts.values()), 1))
            for (a, b, was, start), (_, _, angle, gain) in zip(
                self._before, self._angles(*totals), strict=True
            )
        ]

    def _further(self, choice: _Choice) -> _Choice:
        """The best with one experiment more."""
        choices = []
        for number, step in enumerate(self.menu):
            if number in choice.counts:
                continue
            by_hand = choice.by_hand + bool(step.experiment.by_hand)
            for slices in range(DecisionRule.replicates, MOST_SLICES + 1):
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
        classes = "; ".join(
            "{" + ", ".join(e.name for e in own) + "}" for own, _, _ in self.classes
        )
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
    return LinearProblem(found, *problem.slice_levels)


def next_experiment(
    diagnosis: Diagnosis,
    records: Sequence[SliceRecord],
    cache: Path | None = None,
    workers: Workers = None,
    progress: Progress | None = None,
) -> NextExperiment:
    """What to cut next, after the diagnosis of these records.

    Args:
        diagnosis: What was found in the records.
        records: At hand.
        cache: Folder for finished simulations; None for none.
        workers: What simulates.
        progress: See `sensitivity.Progress`.
    """
    verdict = diagnosis.verdict
    if verdict.kind == "too_few_replicates":
        return _repeat(diagnosis, records)
    # What is in the air as well is not told apart by cuts alone.
    in_air = verdict.mostly[0][1] == "any"
    if verdict.kind == "unknown" and (in_air or not verdict.findings):
        reason = (
            "no cause of the list explains what is wrong; what it depends on shows where speed, "
            "draw and pose differ most"
        )
        return NextExperiment("explore", reason, _exploring(diagnosis, records))
    classes = _classes(diagnosis)
    if not classes:
        return _nothing(diagnosis, records)
    steps = _menu(diagnosis, records)
    search = _Search(diagnosis, steps, classes, records, cache, workers, progress)
    return search.result()


def _repeat(diagnosis: Diagnosis, records: Sequence[SliceRecord]) -> NextExperiment:
    """The motions at hand once more."""
    count = diagnosis.verdict.slices_needed
    conditions: dict[str, list[SliceRecord]] = {}
    for record in records:
        conditions.setdefault(record.metadata.condition or record.name, []).append(record)
    template, knife = template_of(records), next_knife_slice(records)
    steps = []
    for members in conditions.values():
        missing = DecisionRule.replicates - len(members)
        if missing > 0:
            own = template if is_bare(members[0]) else members[0]
            experiment = experiment_of_record(members[0], diagnosis.setup)
            plan = planned_slice(experiment, diagnosis.setup, own, knife)
            steps.append(Step(experiment, plan, missing))
    reason = (
        f"too few slices to tell variation from effect: {count} more of each condition, by the "
        "same motions"
    )
    return NextExperiment("repeat", reason, steps)


def _nothing(diagnosis: Diagnosis, records: Sequence[SliceRecord]) -> NextExperiment:
    """Nothing to split: what these records would not have shown, and motions that may show it."""
    verdict, screening = diagnosis.verdict, diagnosis.verdict.screening
    if verdict.kind != "nothing":
        names = " and ".join(f.evidence.name for f in verdict.findings)
        return NextExperiment("none", f"nothing to split: nothing else looks like {names}")
    blind = [
        name
        for name, visible in zip(screening.names, screening.visible, strict=True)
        if visible**2 < NEEDED
    ]
    if not blind:
        reason = "nothing to split; every cause of plausible size would have shown"
        return NextExperiment("none", reason)
    reason = (
        "nothing to split; these records would not have shown, at a plausible size, "
        f"{', '.join(blind)}: motions that may"
    )
    return NextExperiment("explore", reason, _exploring(diagnosis, records))


def _exploring(diagnosis: Diagnosis, records: Sequence[SliceRecord]) -> list[Step]:
    choice = {step.plan.name: step for step in _menu(diagnosis, records)}
    names = [n for n in EXPLORING if n in choice]
    if "draw_3" in names:
        names.remove("draw_1")
    return [choice[n] for n in names]


def _menu(diagnosis: Diagnosis, records: Sequence[SliceRecord]) -> list[Step]:
    setup, template, knife = diagnosis.setup, template_of(records), next_knife_slice(records)
    fixed = isinstance(setup.food.shape, MeshFile | Remainder | Tapered)
    return [
        Step(e, planned_slice(e, setup, template, knife))
        for e in menu(scale_of(setup, records))
        if e.size == 1.0 or not fixed
    ]


def _classes(diagnosis: Diagnosis) -> list[_CauseClass]:
    """What is to be told apart: of each finding those that the verdict names with it, and those
    that are nearly so, or would be taken for it if they were the ones that act."""
    verdict, problem = diagnosis.verdict, diagnosis.problem
    out = []
    for finding in verdict.findings:
        best = finding.evidence
        screening = next(s for s in verdict.screenings if any(e is best for e in s.causes))
        if not best.per_record:
            alike = [
                e.name
                for e in screening.causes
                if e.name not in finding.names
                and not e.per_record
                and e.gain >= (1.0 - ALIKE_GAIN) * best.gain
                and min(
                    screening.angle_to(problem, e, best.name),
                    screening.angle_to(problem, best, e.name),
                )
                < CLASS_ANGLE + MARGIN
            ]
            names = [n for n in (*finding.names, *alike) if n != LAW]
            if len(names) > 1:
                evidence = [_within_range(diagnosis, screening.evidence(n)) for n in names]
                out.append((evidence, screening, LAW in finding.names))
    return out


def _within_range(diagnosis: Diagnosis, evidence: CauseEvidence) -> CauseEvidence:
    """Evidence whose coefficients give values that the cause may have."""
    coefficients = []
    for column, x in zip(evidence.columns, evidence.coefficients, strict=True):
        p = diagnosis.causes[evidence.name].parameter(column.parameter)
        coefficients.append((p.within(p.null + x * column.size) - p.null) / column.size)
    return dc.replace(evidence, coefficients=coefficients)
