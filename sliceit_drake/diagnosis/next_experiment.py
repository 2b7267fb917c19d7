"""Which slices to cut next, so that causes that the records at hand cannot tell apart part.

For each motion of a menu the sensitivities of the causes of a class are computed for a planned
record, and joined with those of the records at hand: what is shared stays shared, what is each
slice's own is integrated out. If cause A of the class is true, with the size that these records
give it, and B is fitted in its place, the expected loss of twice the log-likelihood is

    D = |A|^2 sin^2(angle),

both over old and new slices together, with the angle of A to all that B can do. Two causes part
where the angle is above that of a class in both directions, and D is what a test at the verdict's
level needs to find it with `POWER`. Every slice adds to D, so this gives the number of slices.
"""

import dataclasses as dc
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import norm

from sliceit_drake.cutting.food import MeshFile, Remainder
from sliceit_drake.diagnosis.experiment_scenario import (
    experiment_of_record,
    planned_record,
    scale_of,
    scenario_of,
    template_of,
)
from sliceit_drake.diagnosis.linear import LinearProblem, integrate_out, scaled_inverse
from sliceit_drake.diagnosis.motion_menu import Experiment, menu
from sliceit_drake.diagnosis.screen import CauseEvidence, Screening
from sliceit_drake.diagnosis.sensitivity import RecordSensitivity, Sensitivities, sensitivities
from sliceit_drake.diagnosis.verdict import ALARM, CLASS_ANGLE, LEAST_REPLICATES
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.records.slice_record import SliceRecord

if TYPE_CHECKING:
    from sliceit_drake.diagnosis.diagnose import Diagnosis

__all__ = ["NextExperiment", "Pair", "Step", "next_experiment"]

POWER = 0.9
"""Probability with which slices shall tell two causes apart."""
NEEDED = float((norm.ppf(1.0 - ALARM) + norm.ppf(POWER)) ** 2)
"""Expected gain that a test at the verdict's level finds with `POWER`."""
MARGIN = 5.0
"""By which the angle shall exceed that of a class, degrees: sizes were estimated."""
WANTED = CLASS_ANGLE + 10.0
"""Angle beyond which more is no better, degrees."""
SLICE_COST, HAND_COST = 1.0, 5.0
"""What a slice, and handwork, must bring: degrees nearer to `WANTED`, over all pairs."""
ALIKE_GAIN = 0.35
"""A cause whose gain falls short of the largest by no more than this share may be the one that
acts: what it gains depends on how well the form that is assumed for it fits."""
MOST_SLICES = 12
"""More slices of one motion are not proposed."""
MOST_STEPS = 3
"""More motions are not proposed."""
EXPLORING = ("tour", "draw_3", "draw_1", "air")
"""Motions for what no cause explains: what differs most from one another."""
USUAL = ("sensor_delay", "sensor_zero")
"""Causes that every record has a little of; they are fitted beside."""


@dc.dataclass(frozen=True)
class Pair:
    """How two causes of a class part.

    Attributes:
        true, fitted: The one that acts, and the one that is blamed.
        before, after: Angle of the one to all that the other can do, degrees, by the records at
            hand and with the new slices.
        gain: Expected difference of twice the log-likelihood with the new slices.
        gain_per_slice: What one of them adds to it, on average over all of them.
    """

    true: str
    fitted: str
    before: float
    after: float
    gain: float
    gain_per_slice: float

    @property
    def parts(self) -> bool:
        """Whether the one is no longer taken for the other."""
        return bool(self.after >= CLASS_ANGLE + MARGIN and self.gain >= NEEDED)

    @property
    def missing(self) -> float:
        """By how much it is short of `WANTED`, degrees; an angle that noise hides counts less."""
        seen = self.after * min(self.gain / NEEDED, 1.0)
        return max(WANTED - seen, 0.0)


@dc.dataclass
class Step:
    """A motion and how many slices of it.

    Attributes:
        experiment: What is done.
        scenario: As the station runs it.
        slices: How many.
        file: Where it was written; None before.
    """

    experiment: Experiment
    scenario: Scenario
    slices: int
    file: Path | None = None


@dc.dataclass
class NextExperiment:
    """What to cut next, and what to expect of it.

    Attributes:
        kind: split, explore, repeat or none.
        reason: In a sentence.
        steps: Motions, in order; each for slices of its own.
        pairs: Of the class; empty if there is none to split.
    """

    kind: str
    reason: str
    steps: list[Step] = dc.field(default_factory=list)
    pairs: list[Pair] = dc.field(default_factory=list)

    def lines(self) -> list[str]:
        """For people."""
        out = [f"Next experiment: {self.reason}"]
        for step in self.steps:
            at = f" ({step.file})" if step.file else ""
            out.append(
                f"  {step.slices} slices of {step.scenario.name}{at}: {step.experiment.what}"
            )
            if step.experiment.by_hand:
                out.append(f"    By hand: {step.experiment.by_hand}")
        if self.pairs and self.steps:
            out.append(
                f"  {'acts':20}{'blamed':20}{'angle now':>10}{'then':>6}{'gain a slice':>14}"
            )
            out += [
                f"  {p.true:20}{p.fitted:20}{p.before:10.0f}{p.after:6.0f}{p.gain_per_slice:14.1f}"
                + ("" if p.parts else "  not parted")
                for p in self.pairs
            ]
        return out

    def facts(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "kind": self.kind,
            "reason": self.reason,
            "steps": [
                {
                    "name": s.scenario.name,
                    "what": s.experiment.what,
                    "by_hand": s.experiment.by_hand,
                    "slices": s.slices,
                    "file": None if s.file is None else str(s.file),
                }
                for s in self.steps
            ],
            "pairs": [{**dc.asdict(p), "parts": p.parts} for p in self.pairs],
            "gain_needed": NEEDED,
        }

    def write(self, file: Path) -> list[Path]:
        """Writes the scenarios: FILE, and FILE_2, FILE_3 beside it for further motions.

        Returns:
            The files; none where there is nothing to cut.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        for k, step in enumerate(self.steps):
            step.file = file if k == 0 else file.with_name(f"{file.stem}_{k + 1}{file.suffix}")
        for step in self.steps:
            assert step.file is not None
            step.file.write_text(self._text(step), encoding="utf-8")
        return [step.file for step in self.steps if step.file is not None]

    def _text(self, step: Step) -> str:
        from sliceit_drake.configuration import dump_yaml

        head = [
            f"Next experiment of a diagnosis: {self.reason}",
            f"What: {step.experiment.what}.",
            f"By hand: {step.experiment.by_hand or 'nothing but a fresh cut for each slice'}.",
            f"Slices: {step.slices}.",
        ]
        if len(self.steps) > 1:
            head.append(f"Together with {', '.join(str(s.file) for s in self.steps if s != step)}.")
        for p in self.pairs:
            head.append(
                f"If {p.true} acts and {p.fitted} is blamed: {p.before:.0f} degrees apart by the "
                f"records at hand, {p.after:.0f} with these slices; a slice adds "
                f"{p.gain_per_slice:.1f} to the gain by telling them apart, "
                f"{NEEDED:.0f} are needed."
            )
        head += [
            f"Station:  sliceit simulate {step.file}",
            f"Stand-in: sliceit record {step.file} --replicates {step.slices} --output NEW",
            "Then:     sliceit diagnose OLD NEW --model FOOD --output DIR",
        ]
        text = dump_yaml(step.scenario, defaults=Scenario())
        return "".join(f"# {line}\n" for line in head) + text


Progress = Callable[[int, int], None]
"""Called with the number of simulated slices, and of those that must be."""


def next_experiment(
    diagnosis: "Diagnosis",
    records: Sequence[SliceRecord],
    cache: Path | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> NextExperiment:
    """What to cut next.

    Args:
        diagnosis: Of the records.
        records: The records at hand.
        cache: Folder for finished simulations.
        workers: Threads.
        progress: See `Progress`.
    """
    verdict = diagnosis.verdict
    if verdict.kind == "too_few_replicates":
        return _repeat(diagnosis, records)
    if verdict.kind == "unknown":
        reason = (
            "no cause of the list explains what is wrong; what it depends on shows where speed, "
            "draw and pose differ most"
        )
        return NextExperiment("explore", reason, _exploring(diagnosis, records))
    classes = _classes(diagnosis)
    if not classes:
        return _nothing(diagnosis, records)
    return _Search(diagnosis, classes, records, cache, workers, progress).result()


def _repeat(diagnosis: "Diagnosis", records: Sequence[SliceRecord]) -> NextExperiment:
    """The motions at hand once more."""
    count = diagnosis.verdict.slices_needed
    conditions: dict[str, list[SliceRecord]] = {}
    for record in records:
        conditions.setdefault(record.metadata.condition or record.name, []).append(record)
    template, knife = template_of(records), _next_knife_slice(records)
    steps = []
    for members in conditions.values():
        missing = LEAST_REPLICATES - len(members)
        if missing > 0:
            own = members[0] if members[0].metadata.food.name != "none" else template
            experiment = experiment_of_record(members[0], diagnosis.setup)
            scenario = scenario_of(experiment, diagnosis.setup, own, knife)
            steps.append(Step(experiment, scenario, missing))
    reason = (
        f"too few slices to tell variation from effect: {count} more of each condition, by the "
        "same motions"
    )
    return NextExperiment("repeat", reason, steps)


def _nothing(diagnosis: "Diagnosis", records: Sequence[SliceRecord]) -> NextExperiment:
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


def _exploring(diagnosis: "Diagnosis", records: Sequence[SliceRecord]) -> list[Step]:
    choice = {e.name: e for e in _menu(diagnosis, records)}
    names = [n for n in EXPLORING if n in choice]
    if "draw_3" in names:
        names.remove("draw_1")
    template, knife = template_of(records), _next_knife_slice(records)
    return [
        Step(choice[n], scenario_of(choice[n], diagnosis.setup, template, knife), LEAST_REPLICATES)
        for n in names
    ]


def _menu(diagnosis: "Diagnosis", records: Sequence[SliceRecord]) -> list[Experiment]:
    shape = diagnosis.setup.food.shape
    fixed = isinstance(shape, MeshFile | Remainder)
    return [e for e in menu(scale_of(diagnosis.setup, records)) if e.size == 1.0 or not fixed]


def _next_knife_slice(records: Sequence[SliceRecord]) -> int:
    """Slices that the knife has cut since it was sharpened."""
    return 1 + max(
        r.metadata.slice_index if r.metadata.knife_slices is None else r.metadata.knife_slices
        for r in records
    )


@dc.dataclass(frozen=True)
class _Class:
    """Causes to be told apart, their evidence, and what is in the model beside."""

    evidence: list[CauseEvidence]
    screening: Screening
    assumed: tuple[tuple[str, float | None], ...]


def _classes(diagnosis: "Diagnosis") -> list[_Class]:
    """What is to be told apart: of each finding those that the verdict names with it, and those
    that are nearly so, or would be taken for it if they were the ones that act."""
    verdict, problem = diagnosis.verdict, diagnosis.problem
    out = []
    assumed: tuple[tuple[str, float | None], ...] = ()
    for finding, screening in zip(
        verdict.findings, (verdict.screening, verdict.second), strict=False
    ):
        best = finding.evidence
        if screening is not None and not best.per_record:
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
            names = [*finding.names, *alike]
            if len(names) > 1:
                evidence = [_within_range(diagnosis, screening.evidence(n)) for n in names]
                out.append(_Class(evidence, screening, assumed))
        assumed = (*assumed, (best.name, best.scan))
    return out


def _within_range(diagnosis: "Diagnosis", evidence: CauseEvidence) -> CauseEvidence:
    """Evidence whose coefficients give values that the cause may have."""
    by_name = {p.name: p for p in diagnosis.causes[evidence.name].parameters}
    coefficients = []
    for name, x, size in zip(
        evidence.parameters, evidence.coefficients, evidence.sizes, strict=True
    ):
        p = by_name[name]
        coefficients.append(float(np.clip(p.null + x * size, p.low, p.high) - p.null) / size)
    return dc.replace(evidence, coefficients=coefficients)


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
    """The motions of the menu against the classes of a verdict."""

    def __init__(
        self,
        diagnosis: "Diagnosis",
        classes: list[_Class],
        records: Sequence[SliceRecord],
        cache: Path | None,
        workers: int | None,
        progress: Progress | None,
    ) -> None:
        self.experiments, self.classes = _menu(diagnosis, records), classes
        setup, template = diagnosis.setup, template_of(records)
        knife = _next_knife_slice(records)
        self.scenarios = [scenario_of(e, setup, template, knife) for e in self.experiments]
        first = 1 + max(r.metadata.slice_index for r in records)
        planned = [
            planned_record(s, setup, template, f"planned {s.name}", first) for s in self.scenarios
        ]
        found = diagnosis.problem.found
        names = {e.name for c in self.classes for e in c.evidence} | set(USUAL)
        names |= {name for c in self.classes for name, _ in c.assumed}
        causes = [diagnosis.causes[n] for n in found.causes if n in names]
        new = sensitivities(
            setup,
            planned,
            causes,
            cache=cache,
            workers=workers,
            progress=progress,
        )
        self.warnings = new.warnings
        self.problem = _joined(diagnosis.problem, new, names)
        own, variance = self.problem.own_prior()
        reduced = [integrate_out(G, own, variance) for G in self.problem.moments.gram]
        count = len(found.records)
        self.old = np.sum(reduced[:count], axis=0)
        self.new = reduced[count:]
        self._before = self._angles(self.old)

    def _projected(self, total: np.ndarray, assumed: Sequence[tuple[str, float | None]]) -> Any:
        """What is left of a summed Gram matrix beside what is fitted in any case."""
        problem = self.problem
        null = [*problem.base, *problem.numerical, *problem.spline, *problem.usual]
        for name, scan in assumed:
            null += problem.found.index("cause", name, scan)
        null = list(dict.fromkeys(null))
        inverse = scaled_inverse(total[np.ix_(null, null)] + np.diag(problem.prior()[null]))
        return total - total[:, null] @ inverse @ total[null]

    def _angles(self, total: np.ndarray) -> list[tuple[str, str, float, float]]:
        """Of each ordered pair the angle, degrees, and the expected gain."""
        out = []
        for members in self.classes:
            screening = dc.replace(
                members.screening, projected=self._projected(total, members.assumed)
            )
            for a, b in itertools.permutations(members.evidence, 2):
                own = self.problem.found.index("cause", a.name, a.scan)
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
            Pair(a, b, was, angle, gain, (gain - start) / sum(counts.values()))
            for (a, b, was, start), (_, _, angle, gain) in zip(
                self._before, self._angles(total), strict=True
            )
        ]

    def _further(self, choice: _Choice) -> _Choice:
        """The best with one experiment more."""
        choices = []
        for number, experiment in enumerate(self.experiments):
            if number in choice.counts:
                continue
            by_hand = choice.by_hand + bool(experiment.by_hand)
            for slices in range(LEAST_REPLICATES, MOST_SLICES + 1):
                counts = {**choice.counts, number: slices}
                choices.append(_Choice(counts, self.pairs(counts), by_hand))
        return min(choices, key=lambda c: c.key)

    def result(self) -> NextExperiment:
        """The motions that part most with least."""
        choice = _Choice(
            {}, [Pair(a, b, angle, angle, gain, 0.0) for a, b, angle, gain in self._before], 0
        )
        while len(choice.counts) < MOST_STEPS and not all(p.parts for p in choice.pairs):
            further = self._further(choice)
            if further.cost >= choice.cost:
                break
            choice = further
        counts, pairs = choice.counts, choice.pairs
        steps = [Step(self.experiments[k], self.scenarios[k], n) for k, n in counts.items()]
        classes = "; ".join("{" + ", ".join(e.name for e in c.evidence) + "}" for c in self.classes)
        if all(p.parts for p in pairs) and not steps:
            reason = f"nothing to split: the records at hand part {classes}"
            return NextExperiment("none", reason, [], pairs)
        if not steps:
            number, angle = self._largest()
            reason = (
                f"no motion of the menu parts more of {classes} at the sizes found; the largest "
                f"least angle, {angle:.0f} degrees, is that of {self.experiments[number].name}"
            )
            return NextExperiment("none", reason, [], self.pairs({number: MOST_SLICES}))
        left = sorted({tuple(sorted((p.true, p.fitted))) for p in pairs if not p.parts})
        reason = f"to split {classes}"
        if left:
            reason += "; not parted: " + ", ".join(f"{a} from {b}" for a, b in left)
        return NextExperiment("split", reason, steps, pairs)

    def _largest(self) -> tuple[int, float]:
        """The experiment of the largest least angle."""
        angles = [
            min(p.after for p in self.pairs({k: MOST_SLICES})) for k in range(len(self.experiments))
        ]
        best = int(np.argmax(angles))
        return best, angles[best]


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
    elements = max(old.elements, new.elements)
    joint = LinearProblem(Sensitivities(columns, records, [], elements), noise=problem.noise)
    joint.variation, joint.variation_samples = problem.variation, problem.variation_samples
    return joint
