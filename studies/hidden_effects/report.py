"""Judge the diagnoses of `python -m studies hidden`: what was said against what was hidden.

Prints rates with Wilson's bounds, what is asked for, rates by cause, detection curves and
what was said where it was not right. With --output FOLDER it also writes hidden_effects.md,
hidden_effects.json, hidden_effects.jsonl (the runs, from which the study can be judged again and
gone on with) and figures/hidden_effects.png there. A study that is not done is judged by what there
is. In place of its folder such a file of runs will do.

  python -m studies score output/hidden --output docs/results
  python -m studies score docs/results/hidden_effects.jsonl
"""

import argparse
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.figures import new_figure, save_figure
from studies.hidden_effects.archive import pack, unpack
from studies.hidden_effects.cases import KINDS
from studies.hidden_effects.score import NAMING, Judgement, Rate, judge_study, rate
from studies.hidden_effects.study import read_facts
from studies.hidden_effects.truth import BASE_OF
from studies.pages import publish, render

__all__ = ["add_arguments", "numbers", "plot_curves", "report", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("study", metavar="DIR", type=Path, help="folder of the study, or its runs")
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="also write the report there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    folder = options.output
    with tempfile.TemporaryDirectory() as unpacked:
        study = options.study
        if study.is_file():
            unpack(study, Path(unpacked))
            study = Path(unpacked)
        judgements, facts = judge_study(study), read_facts(study / "study.json")
        if folder is not None:
            pack(study, folder / "hidden_effects.jsonl")
    text = report(judgements, folder and "figures/hidden_effects.png", facts)
    found = numbers(judgements)
    publish(text, folder and folder / "hidden_effects.md", found)
    if folder is not None and found["curves"]:
        plot_curves(judgements, folder / "figures" / "hidden_effects.png")
    return 0


def numbers(judgements: Sequence[Judgement]) -> dict[str, Any]:
    """All numbers of the report as plain values."""
    out: dict[str, Any] = {"runs": len(judgements), "requirements": _requirements(judgements)}
    out["by_effect"] = {
        kind: {name: _rate_facts(rate(js)) for name, js in _by_effect(judgements, kind).items()}
        for kind in ("single", "unknown", "pairs", "poor", "base")
    }
    out["confusion"] = {name: dict(counts) for name, counts in _confusion(judgements).items()}
    out["curves"] = {
        effect: {f"{delta:g}": _rate_facts(r) for delta, r in points.items()}
        for effect, points in _curves(judgements, lambda j: j.right).items()
    }
    sizes = [len(c) for j in judgements for c in j.classes if j.case.kind == "single"]
    out["mean_class_size"] = float(np.mean(sizes)) if sizes else None
    return out


def _of(judgements: Sequence[Judgement], kind: str) -> list[Judgement]:
    return [j for j in judgements if j.case.kind == kind]


def _by_effect(judgements: Sequence[Judgement], kind: str) -> dict[str, list[Judgement]]:
    out: dict[str, list[Judgement]] = {}
    for j in _of(judgements, kind):
        out.setdefault(j.effects, []).append(j)
    return dict(sorted(out.items()))


def _rate_facts(r: Rate) -> dict[str, float | int | None]:
    share = None if math.isnan(r.share) else r.share
    return {
        "hits": r.hits,
        "runs": r.runs,
        "share": share,
        "lower_bound": r.lower if r.runs else None,
        "upper_bound": r.upper if r.runs else None,
    }


def _requirements(judgements: Sequence[Judgement]) -> list[dict[str, Any]]:
    """What is asked for, what was reached, and whether that is enough."""
    single, nothing = _of(judgements, "single"), _of(judgements, "nothing")
    unknown, poor = _of(judgements, "unknown"), _of(judgements, "poor")
    rows: list[dict[str, Any]] = []

    def add(
        what: str, asked: str, r: Rate, enough: bool, shown: str = "", few: bool = False
    ) -> None:
        facts = {"what": what, "asked": asked, "few": few, **_rate_facts(r)}
        rows.append(facts | {"shown": shown, "met": enough})

    r = rate(single)
    add(
        "one cause",
        ">= 95 % of >= 200, lower bound >= 90 %",
        r,
        r.runs >= 200 and r.share >= 0.95 and r.lower >= 0.90,
    )
    worst = min(
        ((rate(js), name) for name, js in _by_effect(judgements, "single").items()),
        key=lambda pair: pair[0].share,
        default=(Rate(0, 0), ""),
    )
    add(
        "one cause, effect with the worst result",
        ">= 7 of 10",
        worst[0],
        worst[0].runs >= 10 and worst[0].share >= 0.7,
        worst[1],
    )
    alarms = Rate(sum(j.verdict != "nothing" for j in nothing), len(nothing))
    add(
        "alarms where nothing is hidden",
        "<= 16 of >= 200",
        alarms,
        alarms.runs >= 200 and alarms.share <= 0.08,
        few=True,
    )
    r = rate(unknown)
    enough = r.runs >= 60 and r.share >= 0.90
    add("unknown effect, verdict unknown", ">= 90 % of >= 60", r, enough)
    named = Rate(sum(j.verdict in NAMING for j in unknown), len(unknown))
    enough = named.runs >= 60 and named.share <= 0.05
    add("unknown effect, verdict a cause", "<= 5 %", named, enough, few=True)
    r = rate(_of(judgements, "pairs"))
    add("two causes, both named", ">= 80 %", r, r.runs >= 40 and r.share >= 0.80)
    r = rate(poor)
    enough = r.runs >= 60 and r.share >= 0.90
    add("poor protocol, right class", ">= 90 % of >= 60", r, enough)
    followed = [j for j in poor if j.resolved is not None]
    r = Rate(sum(bool(j.resolved) for j in followed), len(followed))
    enough = r.runs >= 60 and r.share >= 0.90
    add("poor protocol, cause named after the next experiment", ">= 90 %", r, enough)
    both = [(j.gain or 0.0, j.oracle) for j in single if j.oracle is not None and j.oracle > 0.0]
    good = Rate(sum(g >= 0.9 * o for g, o in both), len(both))
    ratio = sum(g for g, _ in both) / sum(o for _, o in both) if both else math.nan
    add(
        "held-out gain relative to an oracle's",
        ">= 90 % on average",
        good,
        bool(both) and ratio >= 0.90,
        f"mean {100 * ratio:.0f} %" if both else "",
    )
    return rows


def _confusion(judgements: Sequence[Judgement]) -> dict[str, Counter[str]]:
    """For each effect what was said where that was not right."""
    out: dict[str, Counter[str]] = {}
    for j in judgements:
        if j.case.kind in ("curve", "pairs") or j.right:
            continue
        said = " + ".join("{" + ", ".join(c) + "}" for c in j.classes) or j.verdict
        out.setdefault(f"{j.case.kind}: {j.effects}", Counter())[said] += 1
    return dict(sorted(out.items()))


def _curves(
    judgements: Sequence[Judgement], hit: Callable[[Judgement], bool]
) -> dict[str, dict[float, Rate]]:
    found: dict[str, dict[float, list[bool]]] = {}
    for j in _of(judgements, "curve"):
        delta = j.case.hidden[0].delta
        assert delta is not None
        found.setdefault(j.effects, {}).setdefault(delta, []).append(hit(j))
    return {
        effect: {delta: Rate(sum(hits), len(hits)) for delta, hits in sorted(points.items())}
        for effect, points in sorted(found.items())
    }


def _shown(r: Rate) -> str:
    return f"{r.hits} of {r.runs}"


def _percent(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{100 * value:.0f} %"


def _command(judgements: Sequence[Judgement], options: Mapping[str, Any]) -> str:
    """What was run."""
    kinds = [kind for kind in KINDS if _of(judgements, kind)]
    words = ["python -m studies hidden --output output/hidden"]
    words += [f"--{name} {options[name]}" for name in ("seed", "replicates") if name in options]
    if len(kinds) < len(KINDS):
        words.append(f"--kinds {' '.join(kinds)}")
    return " ".join(words)


def report(
    judgements: Sequence[Judgement],
    figure: str | None,
    options: Mapping[str, Any] | None = None,
) -> str:
    """The report in Markdown.

    Args:
        judgements: All runs that are done.
        figure: Of the detection curves, relative to the report; None for none.
        options: Seed and replicates of the study, as its study.json has them.
    """
    sizes = [len(c) for j in _of(judgements, "single") for c in j.classes]
    seconds = [j.seconds for j in judgements if not math.isnan(j.seconds)]
    curves = _curves(judgements, lambda j: j.right)
    return render(
        "hidden_effects",
        command=_command(judgements, options or {}),
        runs=len(judgements),
        requirements=[_requirement_row(row) for row in _requirements(judgements)],
        class_size=np.mean(sizes) if sizes else None,
        seconds=np.median(seconds) if seconds else None,
        versions=len({j.code for j in judgements}),
        kinds={
            title: rows
            for kind, title in TITLES.items()
            if (rows := _effect_rows(judgements, kind))
        },
        shifts=_base_rows(judgements),
        deltas=[f"delta {delta:g}" for delta in _deltas(curves)],
        curves=_curve_rows(judgements, curves),
        figure=figure,
        confusion=[
            (name, said, n)
            for name, counts in _confusion(judgements).items()
            for said, n in counts.most_common()
        ],
    )


TITLES = {
    "single": "One cause",
    "nothing": "Nothing hidden",
    "unknown": "Unknown effects",
    "pairs": "Two causes",
    "poor": "The poor protocol",
}


def _requirement_row(row: Mapping[str, Any]) -> tuple[str, ...]:
    shown = f"{row['hits']} of {row['runs']}" + (f" ({row['shown']})" if row["shown"] else "")
    met = ("yes" if row["met"] else "no") if row["runs"] else "not run"
    sign, side = ("<=", "upper_bound") if row["few"] else (">=", "lower_bound")
    bound = f"{sign} {_percent(row[side])}" if row["runs"] else ""
    return (row["what"], row["asked"], shown, _percent(row["share"]), bound, met)


def _effect_rows(judgements: Sequence[Judgement], kind: str) -> Sequence[tuple[str, ...]]:
    groups: dict[tuple[str, str], list[Judgement]] = {}
    for j in _of(judgements, kind):
        groups.setdefault((j.effects, j.case.protocol), []).append(j)
    rows = []
    for (effects, protocol), js in sorted(groups.items()):
        verdicts = Counter(j.verdict for j in js).most_common()
        said = ", ".join(f"{v.replace('_', ' ')} {n}" for v, n in verdicts)
        rows.append((effects, protocol, _shown(rate(js)), said))
    return rows


def _base_rows(judgements: Sequence[Judgement]) -> Sequence[tuple[str, ...]]:
    """Shifts of base parameters against those of runs with nothing hidden: what the mesh shifts is
    in both."""
    rows = []
    for name, js in _by_effect(judgements, "base").items():
        parameter = BASE_OF[name]
        null = [
            math.log(j.shifts[parameter][0])
            for j in _of(judgements, "nothing")
            if j.case.protocol == js[0].case.protocol and parameter in j.shifts
        ]
        zero = float(np.mean(null)) if null else 0.0
        found = [math.log(j.shifts[parameter][0]) - zero for j in js if parameter in j.shifts]
        sign = -1.0 if name == "stiffness" else 1.0
        true = [math.log1p(sign * j.case.hidden[0].size) for j in js]
        if found:
            rows.append(
                (name, _shown(rate(js)), _change(float(np.mean(true))))
                + (_change(float(np.mean(found))), f"{100 * np.std(found):.0f} %")
            )
    return rows


def _change(log_factor: float) -> str:
    return f"{100 * math.expm1(log_factor):+.0f} %"


def _deltas(curves: Mapping[str, Mapping[float, Rate]]) -> list[float]:
    return sorted({delta for points in curves.values() for delta in points})


def _curve_rows(
    judgements: Sequence[Judgement], named: Mapping[str, Mapping[float, Rate]]
) -> list[list[str]]:
    alarms = _curves(judgements, lambda j: j.verdict != "nothing")
    return [
        [effect]
        + [
            f"{_shown(points[d])} ({alarms[effect][d].hits})" if d in points else ""
            for d in _deltas(named)
        ]
        for effect, points in named.items()
    ]


def plot_curves(judgements: Sequence[Judgement], file: Path) -> None:
    """Draws how often each effect is named rightly against its strength."""
    named = _curves(judgements, lambda j: j.right)
    figure = new_figure(6.4, 4.0)
    axes = figure.add_subplot()
    for k, (effect, points) in enumerate(named.items()):
        deltas = list(points)
        shares = [points[d].share for d in deltas]
        # Apart by a little, so that equal curves are both seen.
        shifted = [d * (1.0 + 0.02 * (k - 0.5 * len(named))) for d in deltas]
        axes.plot(shifted, shares, "osD^vP*X"[k % 8] + "-", label=effect, color=f"C{k}")
    axes.set_xscale("log")
    axes.set_xticks([0.5, 1.0, 2.0, 4.0], ["0.5", "1", "2", "4"])
    axes.minorticks_off()
    axes.set_xlabel("what a refit leaves of the effect, over the noise")
    axes.set_ylabel("fraction of runs with the right cause")
    axes.set_ylim(-0.05, 1.05)
    axes.set_title("One hidden cause in the rich protocol")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    save_figure(figure, file)
