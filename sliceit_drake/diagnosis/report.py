"""Figures of a diagnosis, and HTML pages: text, with figures in it.

They take the diagnosis's parts, so that the result can call them.
"""

import base64
import html
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.diagnosis.evidence.held_out import HeldOutGain, fitted_changes
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.screen import Screening
from sliceit_drake.diagnosis.evidence.verdict import Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["evidence_figure", "html_page", "image", "records_figure", "report_html"]

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
    bars.barh(places, [max(e.gain, 0.1) for e in causes], color=PREDICTED, label="these records")
    bars.plot([e.limit for e in causes], places, "k|", ms=9, label="95 % where nothing is wrong")
    bars.set_yticks(places, [e.name for e in causes], fontsize=7)
    bars.set_xscale("log")
    bars.set_xlabel("twice the gain in log-likelihood")
    bars.legend(frameon=False, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    shown = matrix.imshow(screening.angles, vmin=0.0, vmax=90.0, cmap="viridis")
    ticks = np.arange(len(screening.names))
    matrix.set_xticks(ticks, screening.names, rotation=90, fontsize=6)
    matrix.set_yticks(ticks, screening.names, fontsize=6)
    matrix.set_title("angle between causes [degrees]", fontsize=9)
    figure.colorbar(shown, ax=matrix, shrink=0.8)
    return figure


def report_html(
    table: str, problem: LinearProblem, verdict: Verdict, gain: HeldOutGain | None
) -> str:
    """The report as one self-contained page: the result as text, figures, and the error on records
    that were left out, if anything is named."""
    parts = [
        "<h1>What the simulation gets wrong</h1>",
        f"<pre>{html.escape(table)}</pre>",
        "<h2>Measured and simulated</h2>",
        image(records_figure(problem, verdict)),
        "<h2>Evidence</h2>",
        image(evidence_figure(verdict.screening)),
    ]
    if gain is not None:
        held_out = [f"{'record':20}{'condition':20}{'before N':>10}{'after N':>10}"]
        for record, (before, after) in zip(problem.found.records, gain.by_record, strict=True):
            held_out.append(f"{record.name:20}{record.condition:20}{before:10.3f}{after:10.3f}")
        text = html.escape("\n".join(held_out))
        parts += ["<h2>Error on records that were left out</h2>", f"<pre>{text}</pre>"]
    return html_page("Diagnosis", parts)
