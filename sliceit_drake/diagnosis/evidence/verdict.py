"""From evidence to a verdict: one for each cause, and how wrong the simulation is by itself."""

import dataclasses as dc
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.special import ndtri

from sliceit_drake.diagnosis.evidence.at_size import AtSize
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.effect_size import OwnError, standardised_size
from sliceit_drake.diagnosis.evidence.held_out import foretells
from sliceit_drake.diagnosis.evidence.linear import (
    PLAUSIBLE,
    LinearProblem,
    angle_to,
    beside,
    fitted_covariance,
)
from sliceit_drake.diagnosis.evidence.scatter import scatter_of_replicates
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening, gain_alone, screen
from sliceit_drake.diagnosis.evidence.trends import Trend, trend_of_slices

__all__ = [
    "CLASS_ANGLE",
    "LAW",
    "LOCKED_TO_DEPTH",
    "STRONG",
    "CauseVerdict",
    "DecisionRule",
    "Finding",
    "Verdict",
    "reach_verdict",
]

CLASS_ANGLE = 15.0
"""Causes that can do what was found to within this, degrees, are one group."""
STRONG = 6.0
"""From this difference of gains on, of twice the log-likelihood, evidence is called strong (Kass
and Raftery, J. Am. Stat. Assoc. 90, 1995)."""
ALIKE_ANGLE = 60.0
"""Causes that can do a quarter of the mean square of what was found, to within this angle, degrees,
are of its group as well where the evidence between them is not strong."""
LOCKED_TO_DEPTH = ("section_shape", "core", "skin")
"""Causes that are locked to depth alone, as the simulation's own law is."""
OF_THE_BOARD = ("board_height", "board_stiffness")
"""Causes of which one is named: a board that lies higher is pressed to where its law was not
measured, and then seems to be of another stiffness as well."""
RIVAL = 0.5
"""Least share of the largest gain from which on the other cause of the board is simulated too."""
INSIDE = 0.99
"""Share of a number's range from which it counts as at the end."""
HALF = 0.5
"""Least share of the simulation's own error that a cause can do which is said to be near."""
LIKE_LAW = (("in", "shared"), ("any", "shared"))
"""Phases and parts of the simulation's own error that may be its law."""
LAW = "law"
"""Name of the simulation's own law in a group."""


@dc.dataclass(frozen=True)
class DecisionRule:
    """When a cause is named.

    Attributes:
        alarm: Greatest chance that a simulation as wrong as this one, with nothing else wrong,
            gives a gain as large as the largest.
        gain: Least gain, twice in log-likelihood, for each record, times what the simulation is
            wrong by beside the cause over the noise: where it is wrong in a form that the prior
            does not have, causes gain up to this. The factor is at least `right`; 1 in the air.
        right: What the simulation is taken to be wrong by over the noise where it is less.
        beside: As `gain`, of a cause beside others that are named: these too may be of another
            form. Here, and where the food's file knows an error, `right` is 1.
        left: Least share of its gain alone that a cause keeps beside others. Less is what a form of
            theirs leaves: of a saw-tooth, waves at the frequency that it has at one speed.
        size: Least size of an effect, over the noise and what the simulation gets wrong by itself,
            where it acts. Sensors and foods that do not follow the simulation's law look like
            causes of up to this size.
        size_by_record: The same of an effect that differs from record to record, over the noise
            alone: no own error does that.
        size_instead: The same of an effect in whose place another would be named, of less evidence
            and with nothing to gain beside it.
        size_known: The same where the food's file knows what the simulation gets wrong.
        size_usual: The same of what every sensor has a little of, as a delay, which has to gain
            beyond that.
        limit: Level of the intervals of the causes' numbers.
        replicates: Slices of a condition from which variation can be told from an effect.
        presence: Share of the records in which a cause shows that has numbers of its own in each.
        unknown: Size of the simulation's own error over the noise in contact from which on records
            that no cause explains are called unknown.
        trend: The same of what goes with the number of the slice.
        scatter: Where the food's file knows what the simulation gets wrong, greatest chance of a
            cause's gain by how slices scatter that are cut alike.
        most: Greatest number of findings.
    """

    alarm: float = 0.02
    gain: float = 1.1
    right: float = 0.5
    beside: float = 3.0
    left: float = 0.05
    size: float = 0.9
    size_by_record: float = 0.5
    size_instead: float = 0.5
    size_known: float = 0.7
    size_usual: float = 0.5
    limit: float = 0.1
    replicates: int = 3
    presence: float = 0.4
    unknown: float = 1.0
    trend: float = 0.4
    scatter: float = 0.002
    most: int = 3

    def least_size(self, problem: LinearProblem, e: CauseEvidence) -> float:
        """Of a cause that is named."""
        if e.per_record:
            return self.size_by_record
        if problem.found.known_from:
            return self.size_known
        usual = set(problem.usual) & {*problem.found.of_causes([e.cause])}
        return self.size_usual if usual else self.size


@dc.dataclass
class Finding:
    """A cause that is supported, with those that these records cannot tell from it.

    Attributes:
        evidence: Of the cause that explains most.
        size: What a refit of the base leaves of its effect where it acts, over noise and own error.
        share: Of the mean square there that it explains.
        others: Names of the causes that would explain as much.
    """

    evidence: CauseEvidence
    size: float
    share: float
    others: list[str]

    @property
    def names(self) -> list[str]:
        """The group: the cause first."""
        return [self.evidence.name, *self.others]


@dc.dataclass(frozen=True)
class CauseVerdict:
    """What the records say of one cause.

    Attributes:
        name: Of the cause.
        kind: supported, possible, excluded or not visible.
        why: In a few words.
        limits: Interval of each of its numbers, by name; for one that is excluded what is left.
    """

    name: str
    kind: str
    why: str
    limits: dict[str, tuple[float, float]]


@dc.dataclass
class Verdict:
    """What the records allow to say.

    Attributes:
        kind: nothing, cause, causes, unknown, or too_few_replicates.
        findings: Of the causes, the one with most evidence first; of `unknown` the one that comes
            nearest where what is left is locked to depth.
        screenings: The evidence that each rests on, and that for what is left.
        causes: A verdict for each cause.
        own_error: How wrong the simulation is by itself beside the findings: RMS of the discrepancy
            in contact, over that of the force.
        misfit: The same over the noise.
        mostly: Where that is: channel, phase and part of the discrepancy with their share of its
            mean square, the largest first.
        reason: In a sentence.
        problem: The records, with causes as they were seen.
        slices_needed: Replicates of each condition that are missing.
        trend: What goes with the number of the slice beside the findings; None for nothing.
    """

    kind: str
    findings: list[Finding]
    screenings: list[Screening]
    causes: list[CauseVerdict]
    own_error: float
    misfit: float
    mostly: list[tuple[str, str, str, float]]
    reason: str
    problem: LinearProblem
    slices_needed: int = 0
    trend: Trend | None = None

    @property
    def screening(self) -> Screening:
        """The evidence before anything is named."""
        return self.screenings[0]

    @property
    def named(self) -> list[CauseAtScan]:
        """The causes of the findings."""
        return [f.evidence.cause for f in self.findings]

    @property
    def names(self) -> list[list[str]]:
        """Groups that are named."""
        return [f.names for f in self.findings] if self.kind != "unknown" else []


def reach_verdict(
    problem: LinearProblem,
    replicates: int = 200,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
    rule: DecisionRule | None = None,
    at_size: AtSize | None = None,
    refuted: Mapping[str, str] | None = None,
) -> Verdict:
    """Screens, names the cause with most evidence that may be named, and goes on beside it.

    Args:
        problem: The records.
        replicates, seed: Of the draws of what chance gives.
        progress: Called with a number of replicates each time that these are done.
        rule: When a cause is named.
        at_size: What sees causes at the size that is found; without one by derivatives alone.
        refuted: Causes that simulations do not bear out, by name, with the reason: they are not
            named, and others are judged beside them.
    """
    refuted = refuted or {}
    rule = rule or DecisionRule()
    counts = [len(m) for m in problem.conditions.values()]
    needed = rule.replicates - max(counts) if max(counts) < rule.replicates else 0
    findings: list[Finding] = []
    screenings: list[Screening] = []
    judged: list[Screening] = []
    refused: dict[str, str] = {}
    # What would be named but for its bounds, or for being refuted: others are judged beside it, and
    # may not stand for it.
    aside: list[CauseEvidence] = []
    while True:
        assumed = [e.cause for e in (*(f.evidence for f in findings), *aside)]
        screening = screen(problem, replicates, seed + len(findings), assumed, progress)
        if at_size is not None and screening.p_value <= rule.alarm:
            corrected = _at_size(problem, screening, at_size)
            if corrected is not None:
                problem = corrected
                continue
        screenings.append(screening)
        # Beside what is only set aside nothing is excluded.
        if not aside:
            judged.append(screening)
        beside_it = "".join(f", beside {o.name}: {refused[o.name]}" for o in aside)
        if screening.p_value > rule.alarm or len(findings) == rule.most:
            if aside:
                why = f"gains no more than chance gives{beside_it}"
                refused = dict.fromkeys((e.name for e in screening.causes), why) | refused
            break
        # What has more evidence than one that is named, and would be named but for its size.
        smaller: list[CauseEvidence] = []
        for e in sorted(screening.causes, key=lambda e: -e.gain):
            why = _refusal(problem, screening, e, rule) or _beside(e, assumed)
            if not why and e.name not in refuted:
                for other in smaller:
                    also = [*assumed, other.cause]
                    beside = screen(problem, replicates, seed + len(findings), also, progress)
                    if _refusal(problem, beside, beside.evidence(e.name), rule):
                        e = other
                        del refused[e.name]
                        break
                findings.append(Finding(e, e.size, e.share, _others(problem, screening, e)))
                break
            if e.size < rule.least_size(problem, e) and e.name not in refuted:
                instead = dc.replace(rule, size=rule.size_instead)
                if not (_refusal(problem, screening, e, instead) or _beside(e, assumed)):
                    smaller.append(e)
            refused[e.name] = f"{why or refuted[e.name]}{beside_it}"
            if not why or why == _at_bound(e):
                aside.append(e)
                break
        else:
            break
    if len(findings) > 1:
        findings = _lasting(problem, findings, [e.cause for e in aside], rule)
    named = bool(findings)
    named_causes = [f.evidence.cause for f in findings]
    wrong, misfit, mostly = _own_error(OwnError.beside(problem, named_causes))
    causes = _verdicts(judged, findings, refused, rule)
    if not named and misfit >= rule.unknown and mostly[0][1:3] in LIKE_LAW:
        findings = _nearest(problem, screenings[0])
    trend = trend_of_slices(problem, [f.evidence.cause for f in findings if named], seed=seed)
    if trend is not None and (trend.p_value > rule.alarm or trend.size < rule.trend):
        trend = None
    own = wrong, misfit, mostly
    kind, reason = _in_words(findings, named, needed, own, trend, rule)
    return Verdict(
        kind,
        findings,
        screenings,
        causes,
        wrong,
        misfit,
        mostly,
        reason,
        problem,
        max(needed, 0),
        trend,
    )


def _at_size(problem: LinearProblem, screening: Screening, at_size: AtSize) -> LinearProblem | None:
    """The problem with the columns of what gains most corrected, and of its rival where both are of
    the board: which of them it is shows where the board is only just touched, and there the column
    of a height is the mean of what it does up and down. None where none has to be."""
    first, *rest = sorted(screening.causes, key=lambda e: -e.gain)
    likely = [first]
    if first.name in OF_THE_BOARD:
        likely += [e for e in rest if e.name in OF_THE_BOARD and e.gain >= RIVAL * first.gain]
    for e in likely:
        if e.score > 0.0 and not e.per_record:
            corrected = at_size(problem, e, contested=len(likely) > 1)
            if corrected is not None:
                return corrected
    return None


def _in_words(
    findings: Sequence[Finding],
    named: bool,
    needed: int,
    own_error: tuple[float, float, list[tuple[str, str, str, float]]],
    trend: Trend | None,
    rule: DecisionRule,
) -> tuple[str, str]:
    """Kind of a verdict, and its reason in a sentence.

    Args:
        findings: With the one that comes nearest where none is named.
        named: Whether they are named.
        needed: Replicates of each condition that are missing.
        own_error: As `_own_error`.
        trend: As in `Verdict`.
        rule: When a cause is named.
    """
    wrong, misfit, mostly = own_error
    shown = f"the simulation is wrong by {100 * wrong:.1f} % of the force by itself"
    few = f"no condition has {rule.replicates} slices, so that"
    if named and not needed:
        kind = "cause" if len(findings) == 1 else "causes"
        return kind, f"{_named(findings)}; beside that {shown}, mostly {_words(mostly)}"
    if needed and findings:
        return "too_few_replicates", f"{few} an effect cannot be told from how slices vary"
    if needed and misfit >= rule.unknown:
        return "nothing", f"{few} what is left cannot be told from how slices vary"
    if misfit >= rule.unknown:
        reason = f"{shown}, mostly {_words(mostly)}, "
        if not findings:
            return "unknown", reason + "and no cause of the list explains it"
        reason += "which may be its law as well as shape, core or skin"
        more = [n for n in findings[0].others if n not in (*LOCKED_TO_DEPTH, LAW)]
        return "unknown", reason + "".join(f", or {name}" for name in more)
    if trend is not None:
        goes = f"{trend.channel} goes with the number of the slice"
        return "unknown", f"{goes}, in no form of the list"
    return "nothing", "nothing beyond the noise and what the simulation is unsure of"


def _named(findings: Sequence[Finding]) -> str:
    """The findings in words."""
    words = []
    for f in findings:
        if LAW in f.others:
            words.append("something locked to depth: shape, core, skin or law")
        else:
            words.append(" or ".join(f.names))
    return " and ".join(words)


def _words(mostly: Sequence[tuple[str, str, str, float]]) -> str:
    """Where the simulation is wrong by itself."""
    channel, phase, part, share = mostly[0]
    along = {
        "in": "along depth on the way in",
        "rest": "at rest",
        "out": "on the way out",
        "again": "in the open cut",
        "board": "in the board",
        "any": "with the height of the knife, in the air as well",
    }[phase]
    goes = {
        "shared": "alike in all cuts",
        "speed": "with the speed",
        "draw": "with the draw",
        "condition": "in another way in each condition",
    }[part]
    return f"{channel} {along}, {goes} ({100 * share:.0f} % of it)"


def _refusal(
    problem: LinearProblem, screening: Screening, e: CauseEvidence, rule: DecisionRule
) -> str:
    """Why a cause is not named; "" for one that may be."""
    by_chance = (1.0 + (screening.largest >= e.deviations).sum()) / (len(screening.largest) + 1.0)
    if e.score <= 0.0 or by_chance > rule.alarm:
        return "gains no more than chance gives"
    if _may_be_law(problem, e):
        # What the simulation may be wrong by is of the group itself: it is not what this is beside.
        own = problem.found.of_causes([e.cause])
        size = standardised_size(problem, own, np.array(e.coefficients))
        if size >= rule.least_size(problem, e) and e.gain >= max(
            other.gain for other in screening.causes
        ):
            return _at_bound(e)
    if e.size < rule.least_size(problem, e):
        return f"its effect is {e.size:.2f} of the noise and the simulation's own error"
    if e.presence < rule.presence:
        return f"shows in {100 * e.presence:.0f} % of the records that could show it"
    if _at_bound(e):
        return _at_bound(e)
    before = [*screening.assumed]
    if problem.found.known_from and not e.per_record:
        scatter = scatter_of_replicates(problem, e, before)
        numbers = max(int(np.count_nonzero(e.coefficients)), 1)
        if scatter.freedom == 0.0:
            return "no slices are cut alike, which would show how they scatter"
        if scatter.chance(e.gain, numbers) > rule.scatter:
            times = f"{scatter.factor:.1f} times as much as the model of their differences allows"
            return f"gains {e.gain:.0f}, but replicate slices scatter {times}"
    # A law cannot be wrong in the air.
    inside = 1.0 if e.per_record else _share_in_contact(problem, e)
    wrong = OwnError.beside(problem, [*before, e.cause])
    least_wrong = 1.0 if before or problem.found.known_from else rule.right
    misfit = _own_error(wrong)[1]
    wrong_by = 1.0 + inside * (max(misfit, least_wrong) - 1.0)
    least = (rule.beside if before else rule.gain) * len(problem.found.records) * wrong_by
    if e.gain < least:
        return f"gains {e.gain:.0f}, where a law as wrong as this may give {least:.0f}"
    if e.name in LOCKED_TO_DEPTH and misfit >= rule.unknown:
        first = max((o for o in screening.causes if not o.per_record), key=lambda o: o.gain)
        if first.gain > e.gain:
            return f"is locked to depth, as a law as wrong as this may be; {first.name} gains more"
    if before and e.gain < rule.left * (alone := gain_alone(problem, e.cause)):
        return f"gains {e.gain:.0f}, but {alone:.0f} without {', '.join(n for n, _ in before)}"
    if not e.per_record and not foretells(problem, e.cause, before, wrong):
        return "does not foretell records that were left out"
    return ""


def _share_in_contact(problem: LinearProblem, e: CauseEvidence) -> float:
    """Share of the mean square of a cause's doing, over the noise, where the knife touches."""
    columns, inside, whole = problem.found.of_causes([e.cause]), 0.0, 0.0
    for record in problem.found.records:
        effect = record.columns[:, :, columns] @ np.array(e.coefficients) / problem.noise_of(record)
        squares = (effect**2).sum(1)
        inside += float(squares[record.in_contact].sum())
        whole += float(squares.sum())
    return inside / max(whole, 1e-300)


def _beside(e: CauseEvidence, named: Sequence[CauseAtScan]) -> str:
    """Why a cause is not named beside others; "" for one that may be."""
    other = next((n for n, _ in named if n in OF_THE_BOARD), None)
    if other is not None and e.name in OF_THE_BOARD:
        return f"may be of {other}: press the bare board"
    return ""


def _at_bound(e: CauseEvidence) -> str:
    """Numbers of a cause that are where they cannot be, or at the end of their range, in words."""
    found = [
        c.parameter
        for c, g in zip(e.columns, e.coefficients, strict=True)
        if g != 0.0 and not INSIDE * c.low < g * c.size < INSIDE * c.high
    ]
    return f"{', '.join(found)} would be at a bound" if found else ""


def _may_be_law(problem: LinearProblem, e: CauseEvidence) -> bool:
    """Whether a law that is wrong along depth, alike in all cuts, could do what was found."""
    if e.name not in LOCKED_TO_DEPTH:
        return False
    model = problem.with_causes()
    G = beside(problem.reduced(model).sum(0), model.shared, model.prior)
    own = problem.found.of_causes([e.cause])
    return angle_to(G, own, np.array(e.coefficients), [problem.shapes]) <= CLASS_ANGLE


def _others(problem: LinearProblem, screening: Screening, best: CauseEvidence) -> list[str]:
    """Causes that could do what was found, or a part of it on evidence that is hardly weaker."""
    if best.per_record:
        return []
    out = [
        e.name
        for e in screening.causes
        if e.name != best.name
        and not e.per_record
        and screening.angle_to(problem, best, e.name)
        <= (ALIKE_ANGLE if abs(best.gain - e.gain) < STRONG else CLASS_ANGLE)
    ]
    if _may_be_law(problem, best):
        locked = [n for n in LOCKED_TO_DEPTH if n != best.name and n in screening.names]
        out = [*dict.fromkeys([*out, *locked]), LAW]
    return out


def _nearest(problem: LinearProblem, screening: Screening) -> list[Finding]:
    """Where the simulation is wrong along depth, alike in all cuts, the cause locked to depth that
    can do most of it, with the others, the law, and what else can do as much in these records:
    which it is an experiment tells. None where none that is locked to depth can do half of it."""
    wrong = OwnError.beside(problem, [])
    reduced = problem.reduced(wrong.model)
    F, Z = wrong.model.shared, problem.shapes
    K = [values.sum(0).ravel() for values in wrong.coefficients]
    G = reduced.sum(0)
    b = np.sum([A[:, Z] @ k for A, k in zip(reduced, K, strict=True)], axis=0)
    square = sum(float(k @ A[np.ix_(Z, Z)] @ k) for A, k in zip(reduced, K, strict=True))
    covariance = fitted_covariance(G, F, wrong.model.prior)
    square -= float(b[F] @ covariance @ b[F])
    b = b - G[:, F] @ covariance @ b[F]
    G = beside(G, F, wrong.model.prior)
    shares: dict[str, float] = {}
    for name in (e.name for e in screening.causes if not e.per_record):
        for scan in problem.found.scans(name):
            own = problem.found.index("cause", name, scan)
            inner = G[np.ix_(own, own)] + np.eye(len(own)) / PLAUSIBLE**2
            found = float(b[own] @ np.linalg.solve(inner, b[own])) / max(square, 1e-12)
            shares[name] = max(found, shares.get(name, 0.0))
    locked = sorted((n for n in LOCKED_TO_DEPTH if n in shares), key=lambda n: -shares[n])
    if not locked or shares[locked[0]] <= HALF:
        return []
    others = [n for n, share in shares.items() if share >= shares[locked[0]] and n not in locked]
    e = screening.evidence(locked[0])
    return [Finding(e, e.size, e.share, [*locked[1:], *others, LAW])]


def _lasting(
    problem: LinearProblem,
    findings: Sequence[Finding],
    aside: Sequence[CauseAtScan],
    rule: DecisionRule,
) -> list[Finding]:
    """Findings that still gain beside those after them, and beside what was set aside: what was
    named first may only have stood for what was named later."""
    left = list(findings)
    for finding in findings[:-1]:
        e = finding.evidence
        named = [f.evidence.cause for f in left if f is not finding]
        others = problem.found.of_causes([*named, *aside])
        without, low = problem.fitted_sizes(others, e.sizes)
        own = problem.found.of_causes([e.cause])
        sizes, high = problem.fitted_sizes([*others, *own], without)
        wrong = OwnError(problem, problem.with_causes([*others, *own]), sizes)
        if e.per_record:
            size = finding.size
        else:
            size = standardised_size(problem, own, np.array(e.coefficients), wrong, beside=others)
        if 2.0 * (high - low) <= e.limit or size < rule.least_size(problem, e):
            left.remove(finding)
    return left


def _own_error(
    wrong: OwnError,
) -> tuple[float, float, list[tuple[str, str, str, float]]]:
    """Of the simulation with what is named: relative to the force, to the noise, and where."""
    problem = wrong.problem
    squares, force, over, rows = 0.0, 0.0, 0.0, 0
    for record, values in zip(problem.found.records, wrong.values, strict=True):
        inside = record.in_contact
        squares += float((values[inside][:, problem.forces] ** 2).sum())
        force += float((record.measured[inside][:, problem.forces] ** 2).sum())
        over += float(((values / problem.apart_by(record))[inside] ** 2).mean(1).sum())
        rows += int(inside.sum())
    parts = wrong.by_part()
    total = max(sum(parts.values()), 1e-30)
    ordered = sorted(parts.items(), key=lambda item: -item[1])[:5]
    return (
        float(np.sqrt(squares / max(force, 1e-12))),
        float(np.sqrt(over / max(rows, 1))),
        [(*key, value / total) for key, value in ordered],
    )


def _verdicts(
    screenings: Sequence[Screening],
    findings: Sequence[Finding],
    refused: dict[str, str],
    rule: DecisionRule,
) -> list[CauseVerdict]:
    """One for each cause, those with most evidence first."""
    wide = ndtri(1.0 - 0.5 * rule.limit)
    named = {f.evidence.name: f.evidence for f in findings}
    last = {e.name: e for s in screenings for e in s.causes} | named
    out = []
    for e in sorted(last.values(), key=lambda e: (e.name not in named, -e.score)):
        limits = {}
        seen = []
        for c, g, error in zip(e.columns, e.coefficients, e.errors, strict=True):
            low, high = ((g + s * wide * error) * c.size for s in (-1.0, 1.0))
            limits[c.parameter] = (low, high)
            seen.append(np.isfinite(error) and error * wide < 1.0)
        if e.name in named:
            kind, why = "supported", f"gains {e.gain:.0f}, by chance {e.limit:.0f}"
        elif e.score > 0.0:
            kind, why = "possible", refused.get(e.name, "gains beside what is named")
        elif any(seen):
            kind, why = "excluded", "beyond these limits"
        else:
            kind, why = "not visible", "these records would not show a plausible size of it"
        out.append(CauseVerdict(e.name, kind, why, limits))
    return out
