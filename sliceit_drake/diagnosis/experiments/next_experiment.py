"""Which slices to cut next, so that causes that the records at hand cannot tell apart part.

For each motion of a menu the sensitivities of the causes of a class are computed for a planned
record, and joined with those of the records at hand: what is shared stays shared, what is each
slice's own is integrated out. If cause A of the class is true, with the size that these records
give it, and B is fitted in its place, the expected loss of twice the log-likelihood is

    D = |A|^2 sin^2(angle),

both over old and new slices together, with the angle of A to all that B can do. Two causes part
where the angle is above that of a class in both directions, and D is what a test at the verdict's
level needs to find it nine times in ten (`experiment_proposal.POWER`). Every slice adds to D, so
this gives the number of slices.
"""

import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

from sliceit_drake.cutting.foods.shapes import MeshFile, Remainder, Tapered
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence
from sliceit_drake.diagnosis.evidence.sensitivity import Progress
from sliceit_drake.diagnosis.evidence.verdict import CLASS_ANGLE, MIN_REPLICATES
from sliceit_drake.diagnosis.experiments.designs import menu
from sliceit_drake.diagnosis.experiments.planned_record import (
    experiment_of_record,
    next_knife_slice,
    planned_slice,
    scale_of,
    template_of,
)
from sliceit_drake.diagnosis.experiments.proposal import MARGIN, NEEDED, NextExperiment, Step
from sliceit_drake.diagnosis.experiments.search import CauseClass, ExperimentSearch
from sliceit_drake.diagnosis.result import Diagnosis
from sliceit_drake.prediction.placement import is_bare
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["next_experiment"]

ALIKE_GAIN = 0.35
"""A cause whose gain falls short of the largest by no more than this share may be the one that
acts: what it gains depends on how well the form that is assumed for it fits."""
EXPLORING = ("tour", "draw_3", "draw_1", "air")
"""Motions for what no cause explains: what differs most from one another."""


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
    if verdict.kind == "unknown":
        reason = (
            "no cause of the list explains what is wrong; what it depends on shows where speed, "
            "draw and pose differ most"
        )
        return NextExperiment("explore", reason, _exploring(diagnosis, records))
    classes = _classes(diagnosis)
    if not classes:
        return _nothing(diagnosis, records)
    steps = _menu(diagnosis, records)
    search = ExperimentSearch(diagnosis, steps, classes, records, cache, workers, progress)
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
        missing = MIN_REPLICATES - len(members)
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


def _classes(diagnosis: Diagnosis) -> list[CauseClass]:
    """What is to be told apart: of each finding those that the verdict names with it, and those
    that are nearly so, or would be taken for it if they were the ones that act."""
    verdict, problem = diagnosis.verdict, diagnosis.problem
    out = []
    assumed: tuple[CauseAtScan, ...] = ()
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
                out.append(CauseClass(evidence, screening, assumed))
        assumed = (*assumed, best.cause)
    return out


def _within_range(diagnosis: Diagnosis, evidence: CauseEvidence) -> CauseEvidence:
    """Evidence whose coefficients give values that the cause may have."""
    coefficients = []
    for column, x in zip(evidence.columns, evidence.coefficients, strict=True):
        p = diagnosis.causes[evidence.name].parameter(column.parameter)
        coefficients.append((p.within(p.null + x * column.size) - p.null) / column.size)
    return dc.replace(evidence, coefficients=coefficients)
