"""Figures of a diagnosis, and HTML pages: text, with figures in it.

The first figure and a sentence say it all; they take the result. The others take its parts.
"""

import base64
import dataclasses as dc
import html
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan
from sliceit_drake.diagnosis.evidence.held_out import HeldOutGain, fitted_changes
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.screen import Screening
from sliceit_drake.diagnosis.evidence.verdict import Finding, Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "Result",
    "evidence_figure",
    "html_page",
    "image",
    "overview_figure",
    "records_figure",
    "report_html",
    "sentence",
]

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#111827;
max-width:62rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
pre{background:#f3f4f6;padding:1rem;overflow-x:auto;font-size:13px}
img{max-width:100%}
"""


def html_page(title: str, parts: Sequence[str]) -> str:
    """A page with a title and parts, which are HTML."""
    head = f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title>"
    return "\n".join([head, f"<style>{STYLE}</style>", *parts, "</html>", ""])


def image(figure: "Figure") -> str:
    """A figure as an element of a page."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    code = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="figure" src="data:image/png;base64,{code}">'


MEASURED, PREDICTED, EXTENDED = "#111827", "#2563eb", "#c2410c"
SHOWN = 8
CALM = 0.3
"""Jump of the prediction, N, near which what is left does not set the scale of a plot."""
SHIFT = 0.1
"""Logarithm of a shift of a base parameter from which on the first sentence names it."""
OTHER_FOOD = 0.4
"""The same from which on it advises to calibrate, whatever else was found."""


class Result(Protocol):
    """What a report needs of a `result.Diagnosis`."""

    problem: LinearProblem
    verdict: Verdict
    causes: dict[str, Cause]
    gain: HeldOutGain | None
    extension: LinearProblem | None
    shifts: dict[str, tuple[float, float]]

    def values(self, finding: Finding) -> dict[str, float]:
        """Parameters of a finding's cause."""
        ...

    def table(self) -> str:
        """The result in a minute."""
        ...


PHASES = {
    "air": "#ffffff",
    "weight": "#ffffff",
    "slice": "#dbeafe",
    "second_pass": "#e0e7ff",
    "hold": "#fef3c7",
    "retract": "#dcfce7",
    "board_press": "#f3e8ff",
}
"""Shades of the phases of a slice."""
CHANNELS = {
    "force_x": "force along the edge",
    "force_y": "force across the blade",
    "force_z": "vertical force",
    "torque_y": "torque about Fy",
    "force_norm": "magnitude of the force",
}
RANKED = 6
"""Causes whose evidence the first figure shows."""
CLOSE_UP = 0.4
"""Time that it shows of a cause with numbers of its own in each slice, s."""
NORMAL_90 = 1.645
"""Half of a normal distribution's 90 % interval, in its standard deviations."""


@dc.dataclass
class _Place:
    """Where a cause shows, or the misfit where none is named.

    Attributes:
        record, channel: Numbers.
        rows: First and last of the phase.
        simulated, extended: Channel of the record [m], by the food and by the extended food as they
            are, nothing fitted to this slice; of a cause that no file holds, both fitted. Where no
            cause is named the second is None, and the first fitted.
    """

    record: int
    channel: int
    rows: tuple[int, int]
    simulated: np.ndarray
    extended: np.ndarray | None


def _place(result: Result) -> _Place:
    """The record, channel and phase in which the extension changes most, in the noise; without one
    in which what is left is largest. Of replicates the one that is met best."""
    problem, named = result.problem, _shown(result)
    records = problem.found.records
    plain, extended = ([r.predicted for r in records], [r.measured for r in records])
    if named and result.extension is not None:
        extended = [record.predicted for record in result.extension.found.records]
    else:
        plain, fitted = (
            [r.predicted + x for r, x in zip(records, fitted_changes(problem, causes), strict=True)]
            for causes in ((), named)
        )
        extended = fitted if named else extended
    best, found = -1.0, (0, 0, (0, 0))
    for r, record in enumerate(records):
        calm = record.kinks() < CALM
        for c, noise in enumerate(problem.noise):
            away = (extended[r][:, c] - plain[r][:, c]) / noise.deviation
            for first, last in _phases(record.phase):
                inside = away[first : last + 1][calm[first : last + 1, c]]
                if inside.size > 5 and (size := float(np.mean(inside**2))) > best:
                    best, found = size, (r, c, (first, last))
    r, c, rows = found
    alike = problem.conditions[records[r].condition or records[r].name]
    if named and all(len(records[k].time) == len(records[r].time) for k in alike):
        r = min(alike, key=lambda k: np.mean((records[k].measured - extended[k])[:, c] ** 2))
    return _Place(r, c, rows, plain[r][:, c], extended[r][:, c] if named else None)


def _shown(result: Result) -> list[CauseAtScan]:
    """The causes that are named; none where it is only said which comes nearest."""
    return [] if result.verdict.kind == "unknown" else result.verdict.named


def _phases(labels: np.ndarray) -> list[tuple[int, int]]:
    """First and last row of each phase."""
    starts = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist()]
    return list(zip(starts, [k - 1 for k in starts[1:]] + [len(labels) - 1], strict=True))


def overview_figure(result: Result) -> "Figure":
    """What one sees first: where the cause shows most, measured, simulated, and simulated by the
    extended food, with phases shaded; what is left; evidence and interval of each cause."""
    from matplotlib.figure import Figure

    place = _place(result)
    record, named = result.problem.found.records[place.record], _shown(result)
    noise = result.problem.noise[place.channel].deviation
    time, measured = record.time, record.measured[:, place.channel]
    unit = "Nm" if record.channels[place.channel].startswith("torque") else "N"
    what = " and ".join(name for name, _ in named)
    label = f"simulated with {what}" + ("" if result.extension else ", fitted to this slice")
    figure = Figure(figsize=(12.0, 6.2), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=[3.6, 1.0, 1.2], height_ratios=[1.6, 1.0])
    upper = figure.add_subplot(grid[0, 0])
    lower = figure.add_subplot(grid[1, 0], sharex=upper)
    bars = figure.add_subplot(grid[:, 1])
    intervals = figure.add_subplot(grid[:, 2], sharey=bars)
    upper.plot(time, measured, color=MEASURED, lw=1.6, label="measured")
    plain = "simulated" if named else "simulated, with this slice's own toughness and height"
    upper.plot(time, place.simulated, "--", color=PREDICTED, lw=1.5, label=plain)
    lower.axhspan(-2.0 * noise, 2.0 * noise, color="#9ca3af", alpha=0.35, lw=0.0)
    lower.plot(time, measured - place.simulated, "--", color=PREDICTED, lw=1.2)
    if place.extended is not None:
        upper.plot(time, place.extended, color=EXTENDED, lw=1.5, label=label)
        lower.plot(time, measured - place.extended, color=EXTENDED, lw=1.2)
    # Where the force jumps a row too early is a peak that would dwarf all else.
    calm = record.kinks()[:, place.channel] < CALM
    away = np.abs(measured - place.simulated)[calm]
    reach = 1.25 * max(float(away.max(initial=0.0)), 3.0 * noise)
    lower.set_ylim(-reach, reach)
    lower.text(
        0.01,
        0.97,
        "grey: noise (2 sd)",
        fontsize=8,
        va="top",
        color="#374151",
        transform=lower.transAxes,
    )
    _shade(upper, lower, record.time, record.phase, place.rows)
    if place.extended is not None and result.extension is None:
        # Waves and knocks are too short to be seen in the whole.
        first, last = place.rows
        change = np.abs(place.extended - place.simulated)[first : last + 1]
        middle = time[first + int(np.argmax(change))]
        low = min(
            max(middle - 0.5 * CLOSE_UP, time[first]), max(time[last] - CLOSE_UP, time[first])
        )
        upper.set_xlim(low, low + CLOSE_UP)
    upper.set_ylabel(f"{CHANNELS[record.channels[place.channel]]} [{unit}]")
    lower.set_ylabel(f"measured - simulated [{unit}]")
    lower.set_xlabel("time [s]")
    upper.set_title(record.condition or record.name, loc="left", fontsize=11)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=9)
    for axis in (upper, lower):
        axis.grid(alpha=0.25)
    intervals.tick_params(left=False, labelleft=False)
    upper.tick_params(labelbottom=False)
    _evidence_panels(bars, intervals, result)
    return figure


def _shade(
    upper: "Axes", lower: "Axes", time: np.ndarray, labels: np.ndarray, shown: tuple[int, int]
) -> None:
    """Shades the phases, names them, and frames the one in which the cause shows."""
    upper.set_xlim(time[0], time[-1])
    span = time[-1] - time[0]
    low, high = upper.get_ylim()
    upper.set_ylim(low, high + 0.1 * (high - low))
    for first, last in _phases(labels):
        ends = time[first], time[min(last + 1, len(time) - 1)]
        for axis in (upper, lower):
            axis.axvspan(*ends, color=PHASES.get(str(labels[first]), "#f3f4f6"), lw=0.0, zorder=0)
        name = str(labels[first]).replace("_", " ")
        if ends[1] - ends[0] > 0.013 * len(name) * span:
            bold = "bold" if (first, last) == shown else "normal"
            upper.text(
                np.mean(ends),
                0.98,
                name,
                fontsize=8,
                ha="center",
                va="top",
                weight=bold,
                clip_on=True,
                transform=upper.get_xaxis_transform(),
            ).set_in_layout(False)
        if (first, last) == shown:
            for axis in (upper, lower):
                axis.axvspan(*ends, fill=False, edgecolor="#6b7280", lw=1.2, zorder=1)


LEAST_LIMIT = 1.0
"""What chance gives at most, at least: twice the gain in log-likelihood. A cause that the bootstrap
never liked would have infinite evidence."""
PLAIN = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}


def _evidence_panels(bars: "Axes", intervals: "Axes", result: Result) -> None:
    """Evidence of the causes that have most, and the interval of each one's first number."""
    ranked = result.verdict.screening.causes[:RANKED]
    names = [e.name for e in ranked]
    named = {name for name, _ in _shown(result)}
    known = {f.evidence.name: result.values(f) for f in result.verdict.findings if named}
    group = {name for f in result.verdict.findings for name in f.names if named}
    places = np.arange(len(ranked))[::-1]
    for e, y in zip(ranked, places, strict=True):
        color = EXTENDED if e.name in named else "#fdba74" if e.name in group else "#9ca3af"
        bars.barh(y, e.gain / max(e.limit, LEAST_LIMIT), color=color, height=0.55)
        best = int(np.argmax(np.abs(e.coefficients) / np.maximum(e.errors, 1e-12)))
        column, cause = e.columns[best], result.causes[e.name]
        null = cause.parameter(column.parameter).null
        value, error = e.coefficients[best], NORMAL_90 * e.errors[best]
        if e.name in known and not e.per_record:
            value = (known[e.name][column.parameter] - null) / column.size
        intervals.errorbar(value, y, xerr=error, fmt="o", color=color, ms=5, capsize=3)
        unit = f" {column.unit}" if column.unit else ""
        middle, half = null + value * column.size, abs(error * column.size)
        text = f"{column.parameter} {_short(middle)} ± {_short(half, 2)}{unit}"
        across = intervals.get_yaxis_transform()
        intervals.text(0.03, y + 0.16, text, fontsize=8, va="bottom", transform=across, bbox=PLAIN)
    bars.axvline(1.0, color=MEASURED, lw=1.0)
    bars.set_yticks(places, names, fontsize=9)
    bars.set_xscale("symlog", linthresh=1.0)
    bars.set_xlim(left=0.0)
    bars.set_xlabel("evidence, in what chance\ngives at most (95 %)", fontsize=9)
    bars.set_title("evidence", loc="left", fontsize=10)
    intervals.axvline(0.0, color=MEASURED, lw=1.0)
    intervals.set_xlabel("size, in what would matter\n(0: absent; 90 % interval)", fontsize=9)
    intervals.set_title("size", loc="left", fontsize=10)
    intervals.margins(x=0.2)
    bars.set_ylim(-0.6, len(ranked) - 0.2)


def _short(value: float, digits: int = 3) -> str:
    """A number to some digits, without an exponent where that is short."""
    return f"{value:.0f}" if 1e2 <= abs(value) < 1e6 else f"{value:.{digits}g}"


def sentence(result: Result) -> str:
    """What was found, in a few sentences for people who know robots and no statistics."""
    moved = _moved(result, OTHER_FOOD)
    if result.verdict.kind == "nothing" or not moved:
        return _found(result)
    return f"{_found(result)} But calibrate first: the file's food needs {', '.join(moved)}."


def _moved(result: Result, least: float) -> list[str]:
    """Base parameters that are off by a logarithm of at least this much, and by how much."""
    return [
        f"{name.rpartition('.')[2].replace('_', ' ')} times {factor:.2f}"
        for name, (factor, error) in result.shifts.items()
        if abs(np.log(factor)) > max(least, 2.0 * error)
    ]


def _found(result: Result) -> str:
    verdict, gain = result.verdict, result.gain
    place = _place(result)
    record = result.problem.found.records[place.record]
    phase = str(record.phase[place.rows[0]]).replace("_", " ") or "record"
    where = f"the {CHANNELS[record.channels[place.channel]]}, phase {phase}"
    where += f", of {record.condition or record.name}"
    names = " and ".join(name for name, _ in verdict.named)
    if verdict.kind == "nothing":
        moved = _moved(result, SHIFT)
        so = f"With its {', '.join(moved)} the" if moved else "The"
        return (
            f"{so} simulation is as close to these records as noise and slices that differ allow"
            " to tell."
        )
    if verdict.trend is not None and not names:
        channel = CHANNELS[verdict.trend.channel]
        return f"The {channel} goes with the number of the slice, and no known cause explains it."
    if not names:
        return (
            f"The simulation is wrong, most in {where}, and none of the known causes explains it."
        )
    says = "; ".join(result.causes[name].signature for name, _ in verdict.named)
    worth = ""
    if gain is not None:
        worth = (
            f" With it, slices that it was not fitted to are predicted to {gain.after:.2g} N, in"
            f" place of {gain.before:.2g} N (the noise alone: {gain.floor:.2g} N)."
        )
    if verdict.kind == "unknown":
        text = f"The simulation is wrong, most in {where}; the known cause that comes nearest is"
        return f"{text} {names} ({says}), and it does not explain enough to be named."
    others = sorted({name for f in verdict.findings for name in f.others})
    also = f" These slices cannot tell it from {', '.join(others)}." if others else ""
    return f"The simulation lacks {names} ({says}). It shows most in {where}.{worth}{also}"


def records_figure(problem: LinearProblem, verdict: Verdict) -> "Figure":
    """One record of each condition: vertical force measured and predicted, and what is left."""
    from matplotlib.figure import Figure

    found = problem.found
    picked = [members[0] for members in problem.conditions.values()][:SHOWN]
    channel = found.records[0].shown
    figure = Figure(figsize=(11.0, 2.6 * len(picked)), layout="constrained")
    axes = figure.subplots(len(picked), 2, squeeze=False)
    changes = fitted_changes(problem, verdict.named)
    what = "refitted with the causes" if verdict.named else "refitted"
    label = f"what the model changes, {what}"
    for (left, right), r in zip(axes, picked, strict=True):
        record = found.records[r]
        measured, predicted = record.measured[:, channel], record.predicted[:, channel]
        left.plot(record.time, measured, color=MEASURED, lw=1.0, label="measured")
        left.plot(record.time, predicted, "--", color=PREDICTED, lw=1.0, label="simulated")
        left.set_ylabel("vertical force [N]")
        left.set_title(record.condition or record.name, loc="left", fontsize=10)
        right.plot(record.time, record.residual[:, channel], color=MEASURED, lw=0.8)
        right.plot(record.time, changes[r][:, channel], color=EXTENDED, lw=1.2, label=label)
        right.set_ylabel("measured - simulated [N]")
        # Where the force jumps a row too early is a peak that would dwarf all else.
        calm = record.residual[record.kinks()[:, channel] < CALM, channel]
        if calm.size:
            low, high = float(calm.min()), float(calm.max())
            right.set_ylim(low - 0.15 * (high - low) - 0.05, high + 0.25 * (high - low) + 0.05)
        for axis in (left, right):
            axis.grid(alpha=0.25)
            axis.set_xlabel("time [s]")
    for axis in axes[0]:
        axis.legend(frameon=False, fontsize=8)
    return figure


def evidence_figure(screening: Screening) -> "Figure":
    """Gain of each cause against chance, and angles between causes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    bars, matrix = figure.subplots(1, 2)
    causes = screening.causes[::-1]
    places = np.arange(len(causes))
    bars.barh(places, [e.gain for e in causes], color=PREDICTED, label="these records")
    bars.plot([e.limit for e in causes], places, "k|", ms=9, label="95 % where nothing is wrong")
    bars.set_yticks(places, [e.name for e in causes], fontsize=7)
    bars.set_xscale("symlog", linthresh=1.0)
    bars.set_xlim(left=0.0)
    bars.set_xlabel("twice the gain in log-likelihood")
    bars.legend(frameon=False, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    shown = matrix.imshow(screening.angles, vmin=0.0, vmax=90.0, cmap="viridis")
    ticks = np.arange(len(screening.names))
    matrix.set_xticks(ticks, screening.names, rotation=90, fontsize=6)
    matrix.set_yticks(ticks, screening.names, fontsize=6)
    matrix.set_title("angle between causes [degrees]", fontsize=9)
    figure.colorbar(shown, ax=matrix, shrink=0.8)
    return figure


def report_html(result: Result) -> str:
    """The report as one self-contained page: a picture, a sentence, then all that was found, as
    text and figures, and the error on records that were left out, if anything is named."""
    parts = [
        "<h1>What the simulation gets wrong</h1>",
        image(overview_figure(result)),
        f"<p><strong>{html.escape(sentence(result))}</strong></p>",
        f"<pre>{html.escape(result.table())}</pre>",
        "<h2>Measured and simulated</h2>",
        image(records_figure(result.problem, result.verdict)),
        "<h2>Evidence</h2>",
        image(evidence_figure(result.verdict.screening)),
    ]
    if result.gain is not None:
        held_out = [f"{'record':20}{'condition':20}{'before N':>10}{'after N':>10}"]
        records = zip(result.problem.found.records, result.gain.by_record, strict=True)
        for record, (before, after) in records:
            held_out.append(f"{record.name:20}{record.condition:20}{before:10.3f}{after:10.3f}")
        text = html.escape("\n".join(held_out))
        parts += ["<h2>Error on records that were left out</h2>", f"<pre>{text}</pre>"]
    return html_page("Diagnosis", parts)
