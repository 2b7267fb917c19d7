"""The parts of docs/results/benches.md that follow from the reported runs alone."""

from collections.abc import Mapping, Sequence
from typing import Any

from studies.benches.draw import LAWS
from studies.benches.effects import HIDDEN
from studies.benches.runs import CALIBRATED_TO
from studies.benches.score import COLUMNS, Judged, judge, named_by
from studies.hidden_effects.score import NAMING
from studies.pages import table

__all__ = ["in_words", "newest_rates", "runs_by_rule"]

SHOWN = (
    "named rightly",
    "wrongly",
    "material beside",
    "locked to depth",
    "alarm, nothing hidden",
    "unlisted: no name",
    "no answer",
)
"""Columns of the score that the page has."""
WHO = ("diagnosis", "always the top", "oracle")

Reports = Sequence[Mapping[str, Any]]


def in_words(said: Mapping[str, Any]) -> str:
    """A diagnosis in a cell: what it names, or its verdict and what stands first."""
    if "failure" in said:
        return "no answer"
    if said["verdict"] in NAMING:
        return ", ".join(finding["cause"] for finding in said["findings"])
    return f"{said['verdict']}; {said['evidence'][0]['cause']} stands first"


def newest_rates(reports: Reports) -> str:
    """Hits and runs of the newest rule, by law, calibration and who answers.

    Args:
        reports: As `score.answers_of` reads what `bench_score --keep` wrote.
    """
    newest = [f for f in reports if f["commit"] == reports[-1]["commit"] and f["hidden"]]
    laws = [law for law in LAWS if any(f["case"]["law"] == law for f in newest)]
    rows = []
    for to in CALIBRATED_TO:
        for who in WHO:
            for law in [*laws, "all"] if who == "diagnosis" else ["all"]:
                of_law = [f for f in newest if law in ("all", f["case"]["law"])]
                judged = [judge(named_by(who, f, to), f["hidden"], to) for f in of_law]
                draws = len({(f["case"]["law"], f["case"]["draw"]) for f in of_law})
                rows.append((law, to, who, draws, *(_count(judged, title) for title in SHOWN)))
    head = " | ".join(["law", "food calibrated to", "who", "draws", *SHOWN])
    return table(head, rows, "   " + "r" * (1 + len(SHOWN)))


def _count(judged: Sequence[Judged], title: str) -> str:
    marks = [mark for j in judged if (mark := COLUMNS[title](j)) is not None]
    return f"{sum(map(bool, marks))} of {len(marks)}" if marks else ""


def runs_by_rule(reports: Reports) -> str:
    """A table of all runs for each rule, the newest first."""
    parts = []
    for commit in reversed(dict.fromkeys(facts["commit"] for facts in reports)):
        rows = [_row(f) for f in reports if f["commit"] == commit and "earlier" in f]
        head = "law | hidden | standardised size | calibrated to earlier records | to the affected"
        parts.append(f"### Rule {commit[:7]}\n\n{table(head, rows, '  r')}")
    return "\n\n".join(parts)


def _row(facts: Mapping[str, Any]) -> tuple[str, ...]:
    hidden = facts["hidden"]
    effect, size = hidden["effect"], f"{hidden['standardised']:.1f}"
    if effect and hidden["size"] > HIDDEN[effect].most:
        size += " *"
    answers = (in_words(facts[to]) for to in CALIBRATED_TO)
    return facts["case"]["law"], effect or "nothing", size if effect else "", *answers
