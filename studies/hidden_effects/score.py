"""Judges the runs of the study: what was said against what was hidden."""

import dataclasses as dc
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis.evidence.verdict import LAW, LOCKED_TO_DEPTH
from studies.hidden_effects.cases import Case
from studies.hidden_effects.runner import TIMING, is_done
from studies.hidden_effects.study import CLASSES, NEAR, load_cases, read_facts
from studies.hidden_effects.truth import CAUSE_OF

__all__ = ["NAMING", "Judgement", "Rate", "judge", "judge_study", "rate"]

NAMING = ("cause", "causes", "too_few_replicates")
"""Verdicts that give a name to what is wrong."""
MIMIC_ANGLE = 20.0
"""Causes that can do what was hidden to within this, degrees, are its class."""
AS_WELL = 3.0
"""Difference of angles below which two causes explain an effect as well, degrees."""
NOT_ITSELF = 60.0
"""Angle from which on an effect has nothing in common with its cause's sensitivities, degrees."""
Near = Mapping[str, Mapping[str, Mapping[str, float]]]
Classes = Mapping[str, Mapping[str, Sequence[str]]]
Z = 1.6448536269514722
"""Normal quantile of a one-sided bound of 95 %."""


@dc.dataclass(frozen=True)
class Rate:
    """So many of so many."""

    hits: int
    runs: int

    @property
    def share(self) -> float:
        """Hits over runs; not a number without runs."""
        return self.hits / self.runs if self.runs else math.nan

    @property
    def lower(self) -> float:
        """Wilson's one-sided lower bound, 95 %."""
        return self._bound(-1.0)

    @property
    def upper(self) -> float:
        """Wilson's one-sided upper bound, 95 %."""
        return self._bound(1.0)

    def _bound(self, side: float) -> float:
        n, p = self.runs, self.share
        if not n:
            return math.nan
        middle = p + Z * Z / (2 * n)
        spread = Z * math.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
        return (middle + side * spread) / (1 + Z * Z / n)


@dc.dataclass(frozen=True)
class Judgement:
    """What a run came to.

    Attributes:
        case: The run.
        verdict: Of the diagnosis; "failed" where it broke down.
        classes: Classes of causes that it named.
        right: Whether it said what it should.
        wrong: Causes that it named and should not have.
        gain: Fraction of the reducible held-out error that it removed, or None.
        oracle: The same of the true cause, or None.
        resolved: Whether in the end, after the next experiment, the one cause was named; None but
            in the poor protocol.
        shifts: Factors and relative errors of base parameters.
        seconds: That the diagnosis took.
        code: Version of the package that made it.
    """

    case: Case
    verdict: str
    classes: list[list[str]]
    right: bool
    wrong: list[str]
    gain: float | None
    oracle: float | None
    resolved: bool | None
    shifts: dict[str, list[float]]
    seconds: float
    code: str = ""

    @property
    def effects(self) -> str:
        """What was hidden, in words."""
        return " and ".join(h.effect for h in self.case.hidden) or "nothing"


def judge(
    case: Case,
    facts: Mapping[str, Any] | None,
    near: Near,
    following: Mapping[str, Any] | None = None,
    seconds: float = math.nan,
    classes: Classes | None = None,
) -> Judgement:
    """Judges a run.

    Args:
        case: The run.
        facts: Of diagnosis.json; None where it broke down.
        near: By protocol and effect the angles to all causes, degrees (`sizes.angles_for`).
        following: The same of the diagnosis after the next experiment; None if none was made.
        seconds: That the diagnosis took.
        classes: By protocol and cause all that its slices cannot tell from it.
    """
    if facts is None:
        resolved = False if case.kind == "poor" else None
        return Judgement(case, "failed", [], False, [], None, None, resolved, {}, seconds)
    verdict, named = facts["verdict"], facts["classes"]
    truth = [CAUSE_OF[h.effect] for h in case.hidden if h.effect in CAUSE_OF]
    known = (classes or {}).get(case.protocol, {})
    allowed = {member for cause in truth for member in known.get(cause, [cause])}
    for h in case.hidden:
        angles = near.get(case.protocol, {}).get(h.effect, {})
        # What explains the effect as well as the cause itself, as it is modelled, is no other.
        own = angles.get(CAUSE_OF.get(h.effect, ""), 0.0)
        # One that looks for itself in the records has nothing to be near to here.
        least = own + AS_WELL if own < NOT_ITSELF else 0.0
        allowed |= {n for n, angle in angles.items() if angle <= max(MIMIC_ANGLE, least)}
    # What is locked to depth no records tell from the law, and so not from one another.
    if allowed & set(LOCKED_TO_DEPTH) and any(LAW in c for c in named):
        allowed |= {*LOCKED_TO_DEPTH, LAW}
    wrong = sorted({n for c in named for n in c} - allowed)
    gain = facts.get("gain")
    shares = {e["cause"]: e.get("held_out_share") for e in facts["evidence"]}
    oracle = shares.get(truth[0]) if len(truth) == 1 else None
    near_by = [[f["cause"], *f["others"]] for f in facts.get("findings", [])]
    return Judgement(
        case=case,
        verdict=verdict,
        classes=named,
        right=_is_right(case.kind, verdict, named, truth, allowed, near_by),
        wrong=wrong,
        gain=None if gain is None else float(gain["share_removed"]),
        oracle=None if oracle is None else float(oracle),
        resolved=_is_resolved(following or facts, truth) if case.kind == "poor" else None,
        shifts=facts["shifts"],
        seconds=seconds,
    )


def _is_right(
    kind: str,
    verdict: str,
    named: list[list[str]],
    truth: list[str],
    allowed: set[str],
    near_by: list[list[str]],
) -> bool:
    if kind in ("nothing", "base"):
        return bool(verdict == "nothing")
    if kind == "unknown":
        return bool(verdict == "unknown")
    if kind == "pairs":
        if verdict != "causes" or len(named) != 2:
            return False
        (a, b), (first, second) = truth, named
        return (a in first and b in second) or (a in second and b in first)
    if verdict == "unknown" and (truth[0] in LOCKED_TO_DEPTH or kind == "poor"):
        # "Which may be its law as well as shape, core or skin": no records tell these apart, and in
        # the poor protocol other causes are locked to depth as well.
        group = set(near_by[0]) if len(near_by) == 1 else set()
        return {truth[0], LAW} <= group <= allowed | {*LOCKED_TO_DEPTH, LAW}
    # One cause: no other may stand beside it, and nothing outside its class.
    return bool(
        verdict == "cause" and len(named) == 1 and truth[0] in named[0] and {*named[0]} <= allowed
    )


def _is_resolved(facts: Mapping[str, Any], truth: list[str]) -> bool:
    return bool(facts["verdict"] == "cause" and facts["classes"] == [truth])


def _shared(output: Path, name: str) -> dict[str, Any]:
    found = read_facts(output / name)
    if found is None:
        raise ConfigurationError(
            f"is no folder of a study: there is no {name}",
            source=str(output),
            fix="Give the --output of `python -m studies hidden`.",
        )
    return found


def judge_study(output: Path) -> list[Judgement]:
    """Judges all runs that are done.

    Raises:
        ConfigurationError: There is no study.
    """
    near = _shared(output, NEAR)
    found = _shared(output, CLASSES)
    classes = {name: facts["classes"] for name, facts in found.items()}
    out = []
    for case in load_cases(output):
        if is_done(output, case.name):
            folder = output / "runs" / case.name
            timing = read_facts(folder / TIMING) or {}
            judgement = judge(
                case,
                read_facts(folder / "diagnosis.json"),
                near,
                read_facts(folder / "diagnosis_next.json"),
                timing.get("diagnosis_s", math.nan),
                classes,
            )
            out.append(dc.replace(judgement, code=timing.get("code", "")))
    return out


def rate(judgements: Sequence[Judgement]) -> Rate:
    """How many are right."""
    return Rate(sum(j.right for j in judgements), len(judgements))
