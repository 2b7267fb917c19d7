"""From evidence to a verdict: nothing, causes, a class of causes, unknown, or too little data."""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.held_out import HeldOutGain
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening, screen

__all__ = [
    "ALARM",
    "CLASS_ANGLE",
    "MIN_REPLICATES",
    "Finding",
    "Verdict",
    "checked_out_of_sample",
    "effect_in_noise",
    "reach_verdict",
]

ALARM = 0.02
"""Greatest p-value of the largest gain."""
MIN_SIZE = 0.7
"""Least effect against the in-contact noise that is called one: below, the simulation's own errors
are as large."""
MIN_MISFIT = 0.25
"""Least misfit against the in-contact noise that calls for a cause."""
MISFIT_FACTOR = 1.5
"""Least gain by a free correction that calls for a cause, of that where nothing is wrong: the noise
itself is only known to within its replicates."""
ONE_CONDITION_MISFIT = 0.55
ONE_CONDITION_FACTOR = 2.5
"""The same where all cuts are of one condition, whose only depth profile the simulation has to
meet: where nothing is wrong up to 0.9 of the noise is left (docs/results/hidden_effects.jsonl)."""
TOLERATED = 0.4
"""Misfit against the in-contact noise that the simulation leaves where nothing is wrong."""
EXPLAINED = 0.6
"""Least fraction of what could be gained that a named cause explains."""
SECOND_SHARE = 0.15
"""Least fraction of a second cause in the squares of the sizes of both."""
SECOND_GAIN = 0.1
"""Least fraction of a second cause in what both gain."""
OF_THE_REST = 0.5
"""Least fraction of what the first cause leaves that a second one explains."""
MIN_REMOVED = 0.8
"""Least fraction of the reducible held-out error that what is named must remove, at the upper end
of its interval: a flexible cause may explain each record and foretell none."""
MIN_COUNTED = 0.5
"""Least fraction of a cause's doing at the rows that this error counts, for it to be judged so."""
PRESENCE = 0.4
"""Least fraction of the records in which a cause shows that has numbers of its own in each."""
CLASS_ANGLE = 15.0
"""Causes that can do what was found to within this, degrees, are one class."""
ONE_CONDITION_ANGLE = 22.0
"""The same where all cuts are of one condition: what one motion shows depends more on the form that
a cause is given here."""
CLASS_GAIN = 0.2
"""A member of the class is kept where its gain falls short by less than this share."""
ONE_CONDITION_GAIN = 0.05
"""The same where all cuts are of one condition: where more causes are near, what they gain has to
tell them apart."""
MIN_REPLICATES = 3
"""Slices of a condition from which variation can be told from an effect."""
CANDIDATES = 8
"""Causes that are looked at more closely, those with most evidence."""


@dc.dataclass
class Finding:
    """A cause that is supported, with those that these records cannot tell from it.

    Attributes:
        evidence: Of the cause that explains most.
        size: What is left of its effect after a refit of all else, over the in-contact noise.
        spread: The same without what is each slice's own being refitted: an effect that differs
            between records as slices may differ is large here alone. Of a cause with numbers of
            its own in each record at least as large as its gain is.
        share: Of what could be gained that it explains.
        others: Names of the causes that would explain as much.
    """

    evidence: CauseEvidence
    size: float
    spread: float
    share: float
    others: list[str]

    @property
    def names(self) -> list[str]:
        """The class: the cause first."""
        return [self.evidence.name, *self.others]


@dc.dataclass
class Verdict:
    """What the records allow to say.

    Attributes:
        kind: nothing, cause, causes, unknown, or too_few_replicates.
        findings: Of the causes; of `unknown` the one that comes nearest, if any.
        screening: The evidence that it rests on.
        second: Evidence once the first finding is part of the model, or None.
        misfit: All that could be gained, as an effect over the in-contact noise.
        reason: In a sentence.
        slices_needed: Replicates of each condition that are missing.
    """

    kind: str
    findings: list[Finding]
    screening: Screening
    second: Screening | None
    misfit: float
    reason: str
    slices_needed: int = 0

    @property
    def named(self) -> list[CauseAtScan]:
        """The causes of the findings."""
        return [f.evidence.cause for f in self.findings]

    @property
    def names(self) -> list[list[str]]:
        """Classes that are named."""
        named = self.kind in ("cause", "causes", "too_few_replicates")
        return [f.names for f in self.findings] if named else []


def checked_out_of_sample(verdict: Verdict, gain: HeldOutGain, problem: LinearProblem) -> Verdict:
    """The verdict once its causes were tried on records that were left out: unknown where they
    remove less of the error than causes that are the right ones.

    Causes that have numbers of their own in each record foretell nothing, and are left out; so are
    errors that are no larger than the noise, and causes such as a delay whose doing is where the
    force jumps, which that error does not count.
    """
    named = verdict.kind in ("cause", "causes")
    if not named or any(f.evidence.per_record for f in verdict.findings):
        return verdict
    # Where hardly anything is above the noise, a fraction of it says nothing.
    if gain.before <= gain.floor or gain.interval[1] >= MIN_REMOVED:
        return verdict
    if any(_counted(problem, f.evidence) < MIN_COUNTED for f in verdict.findings):
        return verdict
    names = " and ".join(f.evidence.name for f in verdict.findings)
    reason = (
        f"{names} explains each record best, and removes {100 * gain.share:.0f} % of the reducible "
        "error of records that were left out"
    )
    return dc.replace(verdict, kind="unknown", reason=reason)


def _counted(problem: LinearProblem, evidence: CauseEvidence) -> float:
    """Fraction of a cause's doing, squared, at the rows that the held-out error counts."""
    columns = problem.found.of_causes([evidence.cause])
    inside = counted = 0.0
    for record in problem.found.records:
        change = record.columns[:, problem.forces][:, :, columns] @ np.array(evidence.coefficients)
        squares = (change**2).sum(1)
        inside += float(squares[record.in_contact].sum())
        counted += float(squares[problem.calm(record)].sum())
    return counted / max(inside, 1e-12)


def reach_verdict(
    problem: LinearProblem,
    replicates: int = 200,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Verdict:
    """Screens, and decides; see `screen`."""
    first = screen(problem, replicates, seed, progress=progress)
    counts = [len(m) for m in problem.conditions.values()]
    needed = max(0, MIN_REPLICATES - min(counts)) if max(counts) < MIN_REPLICATES else 0
    unexplained = max(first.misfit - first.expected_misfit, 0.0)
    findings = [_finding(problem, first, e, unexplained) for e in first.causes[:CANDIDATES]]
    misfit = float(np.sqrt(unexplained / _gain_of_unit(problem, findings)))
    large = [f for f in findings if f.spread >= MIN_SIZE and f.evidence.presence >= PRESENCE]
    if first.p_value > ALARM or not large:
        several = len(problem.conditions) > 1
        least = MIN_MISFIT if several else ONE_CONDITION_MISFIT
        factor = MISFIT_FACTOR if several else ONE_CONDITION_FACTOR
        wrong = misfit >= least and first.misfit >= factor * first.expected_misfit
        if first.misfit_p_value <= ALARM and wrong:
            reason = "the records differ from the simulation, but no cause of the list explains it"
            return Verdict("unknown", [], first, None, misfit, reason, needed)
        reason = "nothing beyond the noise and what the simulation itself is unsure of"
        return Verdict("nothing", [], first, None, misfit, reason, needed)
    best = max(large, key=lambda f: f.evidence.score)
    second = screen(problem, replicates, seed + 1, [best.evidence.cause], progress)
    gain = max(best.evidence.gain - best.evidence.expected, 0.0)
    left = max(
        second.misfit - second.expected_misfit, *(e.gain - e.expected for e in second.causes), 0.0
    )
    # All that could be gained: what the cause explains, and what is left then beyond that which is
    # left where nothing is wrong.
    left = max(left - TOLERATED**2 * _gain_of_unit(problem, findings), 0.0)
    total = gain + left
    best = dc.replace(best, share=gain / total)
    added = [
        _finding(problem, second, e, total)
        for e in second.causes[:CANDIDATES]
        if e.name not in best.names
    ]
    added = [
        f
        for f in added
        if f.spread >= MIN_SIZE
        and f.spread**2 >= SECOND_SHARE * (f.spread**2 + best.size**2)
        and f.evidence.gain - f.evidence.expected >= OF_THE_REST * left
        # Fast waves gain out of proportion: beside them all else is little.
        and (f.share >= SECOND_GAIN or best.evidence.per_record)
        and f.evidence.presence >= PRESENCE
        and f.evidence.score > 0.0
        and second.p_value <= ALARM
    ]
    other = max(added, key=lambda f: f.evidence.score, default=None)
    explained = best.share + (other.share if other else 0.0)
    if explained < EXPLAINED:
        reason = (
            f"the cause that comes nearest, {best.evidence.name}, explains {100 * explained:.0f} % "
            "of what the simulation gets wrong"
        )
        return Verdict("unknown", [best], first, second, misfit, reason, needed)
    found = [best] if other is None else [best, other]
    if needed:
        reason = (
            f"no condition has {MIN_REPLICATES} slices, so that an effect cannot be told from "
            "how slices vary"
        )
        return Verdict("too_few_replicates", found, first, second, misfit, reason, needed)
    reason = f"explains {100 * min(explained, 1.0):.0f} % of what the simulation gets wrong"
    return Verdict("cause" if other is None else "causes", found, first, second, misfit, reason)


def _finding(
    problem: LinearProblem, screening: Screening, evidence: CauseEvidence, total: float
) -> Finding:
    columns = problem.found.of_causes([evidence.cause])
    coefficients = np.array(evidence.by_record if evidence.per_record else evidence.coefficients)
    size, _ = effect_in_noise(problem, columns, coefficients)
    spread, _ = effect_in_noise(problem, columns, coefficients, refit_slices=False)
    if evidence.per_record:
        # An event is short: in the mean over all samples it is less than it is.
        spread = max(spread, _size_of_gain(problem, evidence.gain - evidence.expected))
    share = max(evidence.gain - evidence.expected, 0.0) / max(total, 1e-9)
    several = len(problem.conditions) > 1
    angle = CLASS_ANGLE if several else ONE_CONDITION_ANGLE
    floor = evidence.score - (CLASS_GAIN if several else ONE_CONDITION_GAIN) * evidence.gain
    others = [
        e.name
        for e in screening.causes
        if e.name != evidence.name
        and not (evidence.per_record or e.per_record)
        and screening.angle_to(problem, evidence, e.name) <= angle
        and e.score >= floor
    ]
    return Finding(evidence, size, spread, share, others)


def effect_in_noise(
    problem: LinearProblem,
    columns: list[int],
    coefficients: np.ndarray,
    refit_slices: bool = True,
) -> tuple[float, np.ndarray]:
    """Root mean square of what is left of an effect over the in-contact noise.

    Base parameters and what is each record's own are refitted to the noise-free effect, weighted as
    to data; what they cannot take is left. The mean is over all in-contact samples and channels.

    Args:
        problem: The records' moments.
        columns: Numbers of the effect's columns [n].
        coefficients: Of the columns [n], or of each record [R, n].
        refit_slices: Whether what is each record's own is refitted as well. Without, an effect that
            differs between records as slices may differ keeps its size.

    Returns:
        The ratio, and that of each record [R].
    """
    own = problem.own
    variance = problem.variation**2 if refit_slices else np.full(len(own), 1e-12)
    base = problem.base
    moments = problem.moments.gram
    coefficients = np.broadcast_to(coefficients, (len(moments), len(columns)))
    factors, A, b = [], np.zeros((len(base), len(base))), np.zeros(len(base))
    targets = [G[:, columns] @ g for G, g in zip(moments, coefficients, strict=True)]
    for G, target in zip(moments, targets, strict=True):
        factor = cho_factor(G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12)))
        factors.append(factor)
        inner = cho_solve(factor, np.column_stack([G[np.ix_(own, base)], target[own]]))
        A += G[np.ix_(base, base)] - G[np.ix_(base, own)] @ inner[:, :-1]
        b += target[base] - G[np.ix_(base, own)] @ inner[:, -1]
    shared = np.linalg.lstsq(A, b, rcond=1e-10)[0] if base else b
    deviation = np.array([noise.deviation for noise in problem.noise])
    squares, counts = np.zeros(len(moments)), np.zeros(len(moments))
    for r, record in enumerate(problem.found.records):
        G, target = moments[r], targets[r]
        of_own = cho_solve(factors[r], target[own] - G[np.ix_(own, base)] @ shared)
        rest = record.columns[:, :, columns] @ coefficients[r]
        rest = rest - record.columns[:, :, base] @ shared - record.columns[:, :, own] @ of_own
        inside = rest[record.in_contact] / deviation
        squares[r], counts[r] = float((inside**2).sum()), inside.size
    by_record = np.sqrt(squares / np.maximum(counts, 1))
    return float(np.sqrt(squares.sum() / max(counts.sum(), 1.0))), by_record


def _size_of_gain(problem: LinearProblem, gain: float) -> float:
    """Effect over the noise that would give such a gain if its samples were independent a
    correlation time apart."""
    samples = 0.0
    for record in problem.found.records:
        step = float(np.median(np.diff(record.time)))
        inside = float(record.in_contact.sum())
        for noise in problem.noise:
            share = noise.ar**2 / noise.deviation**2
            samples += inside / (1.0 + share * 2.0 * noise.tau / step)
    return float(np.sqrt(max(gain, 0.0) / max(samples, 1.0)))


def _gain_of_unit(problem: LinearProblem, findings: list[Finding]) -> float:
    """Gain by an effect as large as the noise."""
    rates = [f.evidence.gain / f.size**2 for f in findings if f.size > 1e-3]
    return float(np.median(rates)) if rates else 1.0 / _size_of_gain(problem, 1.0) ** 2
