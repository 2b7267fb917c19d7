"""What one slice shows, as a result: what follows from it, its table, and its files."""

import dataclasses as dc
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliceit_drake.diagnosis.cause import EXPERIMENTS, Cause
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule
from sliceit_drake.diagnosis.experiments.identifiability import (
    SHOWS,
    Identifiability,
    classes,
    short,
)
from sliceit_drake.diagnosis.one_slice.slice_evidence import LEVEL, CauseInSlice, SliceEvidence
from sliceit_drake.diagnosis.one_slice.slice_fit import SliceFit
from sliceit_drake.diagnosis.registry import is_users
from sliceit_drake.diagnosis.report import html_page, image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["KIND", "MIN_GAIN", "OneSlice", "report_html", "slice_figure"]

MEASURED, FITTED, LEFT_OUT, CAUSE = "#111827", "#2563eb", "#c2410c", "#047857"

KIND = "one_slice"
"""The verdict on a single record, whatever it shows."""
MIN_GAIN = 0.1
"""Least fraction of the error on left-out depth that a supported cause removes."""


@dc.dataclass
class OneSlice:
    """What one slice shows; prints as a table, plots itself, saves to a folder.

    Attributes:
        record: Measured, and predicted by the fit, with sensitivities there.
        evidence: Of all causes.
        fit: Without a cause.
        fits: With those that were confirmed, by name.
        block: Number of each row's block of depth.
        angles: Between causes, from projected sensitivities.
        causes: All that were tested, by name.
        remarks: What a reader must know.
        elements: Tetrahedra of the food.
    """

    record: RecordSensitivity
    evidence: SliceEvidence
    fit: SliceFit
    fits: dict[str, SliceFit]
    block: np.ndarray
    angles: Identifiability
    causes: dict[str, Cause]
    remarks: list[str]
    elements: int = 0

    @property
    def supported(self) -> list[CauseInSlice]:
        """Causes that explain more than chance would, and predict depth that was left out."""
        before = self.error(self.fit.held_out)
        return [
            c
            for c in self.evidence.causes
            if c.p_value <= LEVEL
            and c.confirmed is not None
            and c.confirmed <= (1.0 - MIN_GAIN) * before
            and c.without_best <= 1.0 - MIN_GAIN
        ]

    def error(self, predicted: np.ndarray, rows: np.ndarray | None = None) -> float:
        """RMS error of the forces of a prediction, N."""
        rest = (self.record.measured - predicted)[:, self.record.forces]
        rest = rest if rows is None else rest[rows]
        return float(np.sqrt((rest**2).sum(1).mean())) if len(rest) else 0.0

    def by_depth(self) -> list[tuple[str, int, float, float, float]]:
        """Rows of a table, for the air and each block of depth: name, number of rows, mean and RMS
        residual of the fit, RMS residual where the block was left out, N."""
        record, out = self.record, []
        depth = record.depth
        parts = [("before contact", ~record.in_contact & (depth <= 0.0))]
        for k in range(int(self.block.max()) + 1):
            rows = (self.block == k) & record.in_contact
            if rows.any():
                low, high = 1e3 * depth[rows].min(), 1e3 * depth[rows].max()
                parts.append((f"{low:.1f} to {high:.1f} mm", rows))
        for name, rows in parts:
            if rows.any():
                rest = (record.measured - self.fit.predicted)[rows, record.shown]
                errors = self.error(self.fit.predicted, rows), self.error(self.fit.held_out, rows)
                out.append((name, int(rows.sum()), float(rest.mean()), *errors))
        return out

    @property
    def supported_classes(self) -> list[list[str]]:
        """Those causes with what this slice cannot tell from each; one that is in the class of
        another has none of its own."""
        out: list[list[str]] = []
        for c in self.supported:
            if not any(c.name in group for group in out):
                out.append([c.name, *c.others])
        return out

    @property
    def verdict(self) -> str:
        """In a sentence."""
        found = self.supported
        if not found:
            untried = [
                c.name for c in self.evidence.causes if c.p_value <= LEVEL and c.confirmed is None
            ]
            return (
                "in this slice no cause that was fitted explains more of what is left than chance"
                " would and predicts depth that was left out"
                + (f" (not fitted by simulation: {', '.join(untried)})" if untried else "")
            )
        names = "; ".join(" or ".join(map(short, group)) for group in self.supported_classes)
        return f"this slice is described better with {names}; another slice may show otherwise"

    @property
    def classes(self) -> list[list[str]]:
        """What this motion cannot tell apart; they may overlap."""
        groups = classes(self.angles)
        return [g for g in groups if not any(set(g) < set(other) for other in groups)]

    @property
    def drowned(self) -> list[str]:
        """Causes that could show, but not above what this simulation gets wrong in this slice."""
        small = [c.name for c in self.evidence.causes if c.shows < SHOWS]
        return sorted(set(small) - set(self.hidden))

    @property
    def hidden(self) -> list[str]:
        """Causes that such a slice could not show at their plausible size, were all else right."""
        names = self.angles.names
        return [
            names[k] for k in range(self.angles.shifts, len(names)) if not self.angles.visible[k]
        ]

    def experiments(self) -> list[str]:
        """Experiments that part what this slice cannot tell apart or does not show, those that
        serve most causes first."""
        names = {n for group in self.classes for n in group} | set(self.hidden)
        asked = [self.causes[n].experiment for n in sorted(names) if n in self.causes]
        asked += ["repeats"] * len(self.supported)
        return sorted(set(asked), key=lambda e: (-asked.count(e), e))

    def table(self) -> str:
        """The result in a minute."""
        lines = [
            f"1 record: {self.record.name}",
            f"Verdict: {KIND.replace('_', ' ')}, no diagnosis: {self.verdict}",
            f"Error of the fit {self.error(self.fit.predicted):.3f} N, on depth that was left out "
            f"{self.error(self.fit.held_out):.3f} N; "
            + ", ".join(
                f"{k} {v:.3g}"
                for k, v in (self.fit.values("base") | self.fit.values("own")).items()
            ),
            "",
            f"{'depth':>18}{'rows':>6}{'mean left N':>13}{'RMS N':>8}{'left out N':>12}",
        ]
        for name, rows, mean, rms, out in self.by_depth():
            lines.append(f"{name:>18}{rows:6d}{mean:13.2f}{rms:8.2f}{out:12.2f}")
        lines += ["", f"{'cause':20}{'gain':>8}{'p':>8}{'left out N':>12}{'by simulation':>15}"]
        mine = [c for c in self.evidence.causes[10:] if is_users(self.causes[c.name])]
        for c in (*self.evidence.causes[:10], *mine):
            own = "" if c.confirmed is None else f"{c.confirmed:.3f}"
            lines.append(f"{c.name:20}{c.gain:8.1f}{c.p_value:8.3f}{c.held_out:12.3f}{own:>15}")
        lines.append(
            f"{'without a cause':20}{'':16}{self.evidence.held_out:12.3f}"
            f"{self.error(self.fit.held_out):15.3f}"
        )
        lines.append("")
        for group in self.classes:
            lines.append(f"Not told apart by such a slice: {', '.join(map(short, group))}")
        if self.hidden:
            lines.append(f"Such a slice cannot show: {', '.join(self.hidden)}")
        if self.drowned:
            lines.append(
                f"Not above what the simulation gets wrong here: {', '.join(self.drowned)}"
            )
        lines += self.needed()
        return "\n".join(lines + self.remarks)

    def needed(self) -> list[str]:
        """What would make a diagnosis of it."""
        lines = [
            f"Needed for a diagnosis: at least {DecisionRule.replicates} slices of each condition"
            " (one slice says nothing of how slices vary)."
        ]
        for name in self.experiments()[:3]:
            lines.append(f"  Next: {EXPERIMENTS[name]} ({name})")
        return lines

    def plot(self) -> "Figure":
        """Force over depth, what the fit leaves, and what is left of depth that was left out."""
        return slice_figure([self], [self.record.name])

    def facts(self) -> dict[str, Any]:
        """The result as plain values."""
        return {
            "verdict": KIND,
            "reason": self.verdict,
            "record": self.record.name,
            "supported_in_this_slice": self.supported_classes,
            "error_N": self.error(self.fit.predicted),
            "held_out_depth_error_N": self.error(self.fit.held_out),
            "values": self.fit.values("base") | self.fit.values("own"),
            "by_depth": [
                dict(zip(("part", "rows", "mean_N", "rms_N", "left_out_N"), row, strict=True))
                for row in self.by_depth()
            ],
            "evidence": [dc.asdict(c) for c in self.evidence.causes],
            "noise": {
                c: dc.asdict(n)
                for c, n in zip(self.record.channels, self.evidence.noise, strict=True)
            },
            "not_told_apart": self.classes,
            "cannot_show": self.hidden,
            "not_above_what_is_left": self.drowned,
            "experiments": self.experiments(),
            "slices_needed_of_each_condition": DecisionRule.replicates,
            "remarks": self.remarks,
        }

    def save(self, directory: Path) -> None:
        """Writes diagnosis.json and report.html; no food is extended by what one slice shows."""
        directory.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.facts(), indent=2) + "\n"
        (directory / "diagnosis.json").write_text(text, encoding="utf-8")
        (directory / "report.html").write_text(report_html(self), encoding="utf-8")


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


def report_html(result: "OneSlice") -> str:
    """The report as one self-contained page, with the result as text."""
    parts = [
        "<h1>What the simulation gets wrong in one slice</h1>",
        "<p>This describes one slice. It is no diagnosis: how slices vary is unknown, so that what"
        f" is found may be this slice's own. p is that of a gain as large, by any cause, where"
        f" nothing is wrong; below {LEVEL:g} it counts.</p>",
        f"<pre>{html.escape(result.table())}</pre>",
        "<h2>Measured and simulated</h2>",
        image(result.plot()),
    ]
    return html_page("One slice", parts)
