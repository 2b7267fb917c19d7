"""Figure of a fitted slice, and the report on it as one HTML page."""

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.diagnosis.one_slice.slice_evidence import LEVEL
from sliceit_drake.diagnosis.report import html_page, image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sliceit_drake.diagnosis.one_slice.slice_result import OneSlice

__all__ = ["report_html", "slice_figure"]

MEASURED, FITTED, LEFT_OUT, CAUSE = "#111827", "#2563eb", "#c2410c", "#047857"


def slice_figure(results: Sequence["OneSlice"], titles: Sequence[str]) -> "Figure":
    """Force over depth, what the fit leaves, and what is left of depth that was left out: a column
    for each result of one slice, by simulations that differ."""
    from matplotlib.figure import Figure

    count = len(results)
    figure = Figure(figsize=(5.6 * count + 0.6, 6.4), layout="constrained")
    axes = figure.subplots(
        2, count, squeeze=False, sharex="col", sharey="row", height_ratios=(3.0, 2.0)
    )
    for (top, bottom), result, title in zip(axes.T, results, titles, strict=True):
        record, channel = result.record, result.record.shown
        depth = 1e3 * record.depth
        measured = record.measured[:, channel]
        top.plot(depth, measured, color=MEASURED, lw=1.8, label="measured")
        top.plot(
            depth, result.fit.predicted[:, channel], "--", color=FITTED, lw=1.6, label="fitted"
        )
        fit = result.fit
        rests = [
            (fit.predicted, "--", FITTED, 1.4, "fitted to all depth ({:.2f} N RMS)"),
            (fit.held_out, "-", LEFT_OUT, 1.4, "each block left out ({:.2f} N)"),
        ]
        for best in result.supported[:1]:
            own = result.fits[best.name].held_out
            rests.append((own, ":", CAUSE, 1.8, f"left out, with {best.name} ({{:.2f}} N)"))
        bottom.axhline(0.0, color="0.6", lw=0.8)
        for axis in (top, bottom):
            _blocks(axis, result)
            axis.grid(alpha=0.25)
        for predicted, style, color, width, label in rests:
            label = label.format(result.error(predicted))
            left = measured - predicted[:, channel]
            bottom.plot(depth, left, style, color=color, lw=width, label=label)
        top.set_title(title, loc="left", fontsize=11)
        bottom.set_xlabel("depth of the edge, as the record says [mm]")
        top.legend(frameon=False, fontsize=9, loc="upper left")
        bottom.legend(frameon=False, fontsize=9, loc="lower left")
    rest = np.concatenate(
        [
            (r.record.measured - p)[:, r.record.shown]
            for r in results
            for p in (r.fit.predicted, r.fit.held_out)
        ]
    )
    low, high = float(rest.min()), float(rest.max())
    # Room for the legend below the curves.
    axes[1, 0].set_ylim(low - 0.55 * (high - low), high + 0.1 * (high - low))
    what = "force" if results[0].record.channels[0] == "force_norm" else "vertical force"
    axes[0, 0].set_ylabel(f"{what} [N]")
    axes[1, 0].set_ylabel("measured - simulated [N]")
    return figure


def _blocks(axis: "Axes", result: "OneSlice") -> None:
    """Shades every other block of depth."""
    depth = 1e3 * result.record.depth
    for k in np.unique(result.block)[1::2]:
        rows = result.block == k
        axis.axvspan(depth[rows].min(), depth[rows].max(), color="0.5", alpha=0.10, lw=0)


def report_html(result: "OneSlice", table: str) -> str:
    """The report as one self-contained page, with the result as text."""
    parts = [
        "<h1>What the simulation gets wrong in one slice</h1>",
        "<p>This describes one slice. It is no diagnosis: how slices vary is unknown, so that what"
        f" is found may be this slice's own. p is that of a gain as large, by any cause, where"
        f" nothing is wrong; below {LEVEL:g} it counts.</p>",
        f"<pre>{html.escape(table)}</pre>",
        "<h2>Measured and simulated</h2>",
        image(slice_figure([result], [result.record.name])),
    ]
    return html_page("One slice", parts)
