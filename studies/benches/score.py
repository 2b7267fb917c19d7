"""Judges the answers of `python -m studies benches`, law by law.

Right is a finding that holds a cause that is right, in a group of at most four that holds nothing
an oracle knowing the law could tell from it, with no other bench or sensor cause named. Rows for
naming nothing, for naming the first of the list, and for the oracle stand beside the diagnosis; the
oracle names all that nobody could tell apart wherever the effect's standardised size is 1 or more.
Intervals are bootstrap intervals of 90 % over draws.

Values are judged where a cause was named rightly whose parameter the hidden effect has as well (a
delay, a mass). The gain is the share of the removable error on left-out records that what
was named removes, over the share that the right cause would, as this diagnosis fits it.

--keep adds what a judgement needs of each run to a file, as a line of JSON. It is judged like the
folder, and `benches --kept FILE` goes on from it.

  python -m studies bench_score output/benches --output docs/results/benches_table.md
"""

import argparse
import dataclasses as dc
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from studies.benches.draw import LAWS
from studies.benches.effects import BENCH_CAUSES, DEPTH_CAUSES, HIDDEN
from studies.benches.runs import CALIBRATED_TO
from studies.hidden_effects.score import NAMING
from studies.pages import percent, publish, table

__all__ = ["Judged", "add_arguments", "answers_of", "judge", "kept", "named_by", "rates", "run"]

WHO = ("diagnosis", "always nothing", "always the top", "oracle")
LARGE = 1.8
"""Standardised size from which on targets hold, with what a size may be off by."""
SEEN = 1.0
"""Standardised size from which on the oracle sees an effect."""
GROUP = 4
"""Most causes of a finding."""
CLOSE = 0.2
"""Error of a value that counts as close."""
LEAST_GAIN = 0.05
"""Least gain of the right cause that others are compared with."""
RESAMPLES = 2000
SAID = ("verdict", "classes", "findings", "own_error", "misfit_over_noise", "gain", "failure")
"""What is kept of an answer, beside the cause with most evidence."""

Groups = list[list[str]]


@dc.dataclass(frozen=True)
class Judged:
    """How a run was answered.

    Attributes:
        kind: "listed", "depth", "nothing" or "unlisted".
        size: Standardised size of what was hidden.
        right: Whether a finding is right; of "nothing" and "unlisted" whether nothing was named
            that must not be.
        wrong: Whether something was named and nothing right.
        beside: Whether a material cause is named beside.
        failed: Whether there is no answer.
        close, covered: Whether the value is within 20 %, and within its interval; None where there
            is none to judge.
        gain: Of what was named, and of the right cause; None where that has none.
    """

    kind: str
    size: float
    right: bool
    wrong: bool
    beside: bool
    failed: bool = False
    close: bool | None = None
    covered: bool | None = None
    gain: tuple[float, float] | None = None


def answers_of(source: Path) -> list[dict[str, Any]]:
    """All runs that are done.

    Args:
        source: Folder of the study, or the file that --keep wrote.

    Raises:
        ConfigurationError: There are none.
    """
    if source.is_file():
        texts = source.read_text(encoding="utf-8").splitlines()
    else:
        files = sorted((source / "runs").glob("*.json"))
        texts = [file.read_text(encoding="utf-8") for file in files]
    if not texts:
        raise ConfigurationError(
            "holds no runs",
            source=str(source),
            fix="Give the --output of `python -m studies benches`, or what --keep wrote.",
        )
    return [json.loads(text) for text in texts]


def kept(facts: Mapping[str, Any]) -> dict[str, Any]:
    """What a judgement needs of a run."""
    out = {name: value for name, value in facts.items() if name not in CALIBRATED_TO}
    for to in (to for to in CALIBRATED_TO if to in facts):
        said = facts[to]
        out[to] = {name: said[name] for name in SAID if name in said}
        out[to]["evidence"] = said.get("evidence", [])[:1]
        out[to]["right_gain"] = _right_gain(said, facts["hidden"])
        out[to]["causes"] = [c for c in said.get("causes", []) if c["verdict"] == "supported"]
    return out


def _right_gain(said: Mapping[str, Any], hidden: Mapping[str, Any] | None) -> float:
    """Share of the removable error that the best of the right causes removes."""
    if not hidden or not hidden["effect"]:
        return 0.0
    if "right_gain" in said:
        return float(said["right_gain"])
    right = HIDDEN[hidden["effect"]].right
    shares = [e["held_out_share"] for e in said.get("evidence", []) if e["cause"] in right]
    return max((float(share) for share in shares if share is not None), default=0.0)


def measured(judged: Judged, said: Mapping[str, Any], hidden: Mapping[str, Any]) -> Judged:
    """With what the answer's values and its gain are worth.

    Args:
        judged: How the answer's names were judged.
        said: The diagnosis.
        hidden: Effect and size.
    """
    if not hidden["effect"] or "failure" in said:
        return judged
    kind, right_gain = HIDDEN[hidden["effect"]], _right_gain(said, hidden)
    close = covered = None
    if judged.right and kind.value:
        size = float(hidden["size"])
        limits = {c["cause"]: c["limits"] for c in said["causes"]}
        for finding in said["findings"]:
            if finding["cause"] in kind.right and kind.value in finding["values"]:
                low, high = limits[finding["cause"]][kind.value]
                close = abs(finding["values"][kind.value] - size) <= CLOSE * abs(size)
                covered = low <= size <= high
    gain = (said["gain"] or {}).get("share_removed", 0.0) if said["verdict"] in NAMING else 0.0
    reached = (gain, right_gain) if right_gain >= LEAST_GAIN else None
    return dc.replace(judged, close=close, covered=covered, gain=reached)


def named_by(who: str, facts: Mapping[str, Any], to: str) -> Groups | None:
    """Findings of one of `WHO` in a run, best first; None where the diagnosis broke down."""
    said, hidden = facts[to], facts["hidden"]
    if who == "oracle":
        return [hidden["group"]] if hidden["group"] and hidden["standardised"] >= SEEN else []
    if who == "always nothing":
        return []
    if "failure" in said:
        return None
    if who == "always the top":
        return [[said["evidence"][0]["cause"]]] if said["evidence"] else []
    return list(said["classes"]) if said["verdict"] in NAMING else []


def judge(named: Groups | None, hidden: Mapping[str, Any], to: str) -> Judged:
    """Judges the findings of a run.

    Args:
        named: Findings, each a group of causes; None where there is no answer.
        hidden: Effect, standardised size and the oracle's group.
        to: What the food is calibrated to, one of `CALIBRATED_TO`.
    """
    effect, size = hidden["effect"], float(hidden["standardised"])
    kind = "nothing"
    if effect:
        group = HIDDEN[effect].group
        kind = {"bench": "listed", "material": "listed"}.get(group, group)
    if named is None:
        return Judged(kind, size, False, False, False, True)
    causes = [set(finding) for finding in named]
    if kind in ("nothing", "unlisted"):
        bad = any(c & BENCH_CAUSES for c in causes) if kind == "nothing" else bool(causes)
        return Judged(kind, size, not bad, bad, any(not c & BENCH_CAUSES for c in causes))
    allowed = HIDDEN[effect].right | set(hidden["group"])
    if kind == "depth":
        allowed |= DEPTH_CAUSES
    hits = [c for c in causes if c & allowed and c <= allowed and len(c) <= GROUP]
    if kind == "listed":
        hits = [c for c in hits if c & HIDDEN[effect].right]
    others = [c for c in causes if c not in hits[:1]]
    bench = any(c & BENCH_CAUSES - allowed for c in others)
    right = bool(hits) and not bench
    # What cannot be seen in affected records need not be named there.
    if to == "affected" and not causes and size < SEEN:
        right = True
    return Judged(
        kind, size, right, bool(causes) and not right, any(not c & BENCH_CAUSES for c in others)
    )


Part = tuple[float, float] | bool | None
Columns = dict[str, Callable[[Judged], Part]]
"""By title: whether a run counts as a hit, or a part and the whole that it is of; None where it
does not belong to the column."""


def _of(kind: str, hit: Callable[[Judged], Part], low: float = 0.0, high: float = np.inf):  # type: ignore[no-untyped-def]
    return lambda j: hit(j) if j.kind == kind and low <= j.size < high else None


COLUMNS: Columns = {
    "named rightly": _of("listed", lambda j: j.right, LARGE),
    "wrongly": _of("listed", lambda j: j.wrong, LARGE),
    "material beside": _of("listed", lambda j: j.beside, LARGE),
    "locked to depth": _of("depth", lambda j: j.right, LARGE),
    "alarm, nothing hidden": _of("nothing", lambda j: j.wrong),
    "unlisted: no name": _of("unlisted", lambda j: j.right),
    "at 0.5": _of("listed", lambda j: j.right, 0.0, 0.75),
    "at 1": _of("listed", lambda j: j.right, 0.75, 1.5),
    "at 2": _of("listed", lambda j: j.right, 1.5, 3.0),
    "at 4": _of("listed", lambda j: j.right, 3.0),
    "value within 20 %": _of("listed", lambda j: j.close, LARGE),
    "value in its interval": _of("listed", lambda j: j.covered, LARGE),
    "of the right cause's gain": _of("listed", lambda j: j.gain, LARGE),
    "no answer": lambda j: j.failed,
}


def rates(
    judged: Mapping[int, Sequence[Judged]], rng: np.random.Generator
) -> dict[str, tuple[float, float, float, int]]:
    """By column the share of hits, its bootstrap interval over draws, and the number of runs.

    Args:
        judged: By draw.
        rng: For the bootstrap.
    """
    out = {}
    for title, hit in COLUMNS.items():
        marks = [[m for j in runs if (m := hit(j)) is not None] for runs in judged.values()]
        pairs = [[m if isinstance(m, tuple) else (float(m), 1.0) for m in d] for d in marks]
        counts = np.array([np.sum([(0.0, 0.0), *d], axis=0) for d in pairs])
        hits, whole = counts.sum(0)
        if not whole:
            continue
        drawn = counts[rng.integers(0, len(counts), (RESAMPLES, len(counts)))].sum(1)
        shares = drawn[drawn[:, 1] > 0]
        low, high = np.percentile(shares[:, 0] / shares[:, 1], [5.0, 95.0])
        out[title] = float(hits / whole), float(low), float(high), sum(map(len, marks))
    return out


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "runs",
        metavar="RUNS",
        nargs="+",
        type=Path,
        help="--output of `benches`, or what --keep wrote",
    )
    parser.add_argument(
        "--keep", metavar="FILE", type=Path, help="add all runs to it, a line for each"
    )
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    answers = [facts for source in options.runs for facts in answers_of(source)]
    if options.keep:
        before = answers_of(options.keep) if options.keep.exists() else []
        runs = {_key(facts): facts for facts in (*before, *map(kept, answers))}
        lines = (json.dumps(facts, sort_keys=True) + "\n" for facts in runs.values())
        options.keep.write_text("".join(lines), encoding="utf-8")
    rng, rows = np.random.default_rng(0), []
    for law in LAWS:
        # Without an effect that could be hidden there was no run.
        of_law = [f for f in answers if f["case"]["law"] == law and f["hidden"] is not None]
        for to in CALIBRATED_TO if of_law else ():
            for who in WHO:
                judged: dict[int, list[Judged]] = {}
                for facts in of_law:
                    verdict = judge(named_by(who, facts, to), facts["hidden"], to)
                    if who == "diagnosis":
                        verdict = measured(verdict, facts[to], facts["hidden"])
                    judged.setdefault(facts["case"]["draw"], []).append(verdict)
                found = rates(judged, rng)
                cells = ["" if title not in found else _cell(*found[title]) for title in COLUMNS]
                rows.append((law, to, who, len(judged), *cells))
    head = " | ".join(["law", "food calibrated to", "who", "draws", *COLUMNS])
    publish(table(head, rows), options.output)
    return 0


def _key(facts: Mapping[str, Any]) -> tuple[str, str, str, int, int]:
    case = facts["case"]
    return facts["commit"], facts["part"], case["law"], case["draw"], case["number"]


def _cell(share: float, low: float, high: float, runs: int) -> str:
    return f"{percent(share)} ({100 * low:.0f} to {100 * high:.0f}) of {runs}"
