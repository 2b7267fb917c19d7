"""What protocols can tell: docs/results/identifiability.md, and the figure of the angles."""

import dataclasses as dc
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.experiments.identifiability import (
    ANGLE,
    SHIFT,
    SHOWS,
    classes,
    short,
)
from studies.diagnosis.conditions import ProtocolIdentifiability
from studies.figures import new_figure, save_figure

__all__ = ["Study", "page_values", "plot_angles"]


@dc.dataclass
class Study:
    """What protocols can tell.

    Attributes:
        results: One a protocol.
        causes: That were asked for.
        found: Sensitivities of all records.
    """

    results: list[ProtocolIdentifiability]
    causes: Sequence[Cause]
    found: Sensitivities


def _rows(result: ProtocolIdentifiability) -> Sequence[tuple[str, ...]]:
    """A row a cause: what shows, with what it can be confused, what would part it."""
    rows = []
    for a, name in enumerate(result.names):
        others = [f"`{short(b)}`" for b in result.equivalence_class(name)[1:]]
        nearest = result.nearest(name)
        if not result.visible[a]:
            what = "does not show" + (f", taken up by {', '.join(others)}" if others else "")
        else:
            what = "with " + ", ".join(others) if others else "alone"
        near = ""
        if nearest is not None and result.visible[a]:
            near = f"`{short(nearest[0])}`, {nearest[1]:.0f} deg"
        split, parted = result.split[a], ""
        if result.visible[a] and not others:
            pass
        elif split is not None and result.visible[a]:
            parted = f"{split[0]}: {split[1]:.0f} deg"
        elif split is not None:
            parted = f"{split[0]}: shows {split[1]:.0f} sd"
        elif a >= result.shifts:
            parted = "no condition"
        shown = short(name) if a < result.shifts else f"`{name}`"
        rows.append((shown, f"{result.shows[a]:.0f}", f"{result.delta[a]:.2f}", what, near, parted))
    return rows


def _nonlinearity(found: Sensitivities) -> dict[str, float]:
    """Angle by which the change at plus a cause's size is off the linear part, degrees."""
    out: dict[str, list[float]] = {}
    for k, column in enumerate(found.columns):
        if column.kind != "cause":
            continue
        odd = sum(float((r.columns[:, :, k] ** 2).sum()) for r in found.records)
        even = sum(float((r.even[:, :, k] ** 2).sum()) for r in found.records)
        if even > 0.0 and odd > 0.0:
            angle = float(np.degrees(np.arctan(np.sqrt(even / odd))))
            out.setdefault(column.name, []).append(angle)
    return {name: float(np.median(values)) for name, values in out.items()}


def _scan_angles(found: Sensitivities) -> dict[str, float]:
    """Angle between what neighbouring values of a cause's scan do, degrees."""
    out: dict[str, list[float]] = {}
    for name in found.causes:
        columns = [found.index("cause", name, scan)[0] for scan in found.scans(name)]
        if found.columns[columns[0]].per_record:
            continue
        for a, b in zip(columns[:-1], columns[1:], strict=True):
            dot, aa, bb = 0.0, 0.0, 0.0
            for r in found.records:
                x, y = (r.columns[:, :, k].astype(float) for k in (a, b))
                dot, aa, bb = (
                    dot + float((x * y).sum()),
                    aa + float((x * x).sum()),
                    bb + float((y * y).sum()),
                )
            if aa > 0.0 and bb > 0.0:
                angle = float(np.degrees(np.arccos(np.clip(dot / np.sqrt(aa * bb), -1.0, 1.0))))
                out.setdefault(name, []).append(angle)
    return {name: float(np.median(values)) for name, values in out.items()}


def page_values(
    study: Study, figure: str = "docs/results/figures/identifiability.png"
) -> dict[str, object]:
    """What the page shows."""
    found = study.found
    base = ", ".join(c.name.rsplit(".", 1)[-1] for c in found.columns if c.kind == "base")
    bent, scanned = _nonlinearity(found), _scan_angles(found)
    own = [v for v in (*scanned.values(), *bent.values()) if v > 1.0]
    middle, most = np.percentile(own, [50.0, 75.0]) if own else (0.0, 0.0)
    return dict(
        figure=figure,
        base=base.replace("youngs_", ""),
        elements=found.elements,
        shows=SHOWS,
        angle=ANGLE,
        shift=100.0 * SHIFT,
        protocols=[_protocol(result) for result in study.results],
        forms=[
            (f"`{name}`", *(f"{by[name]:.0f}" if name in by else "" for by in (scanned, bent)))
            for name in found.causes
            if name in bent or name in scanned
        ],
        middle=middle,
        most=most,
    )


def _protocol(result: ProtocolIdentifiability) -> dict[str, object]:
    """What the template tells of a protocol."""
    named = zip(result.names, result.visible, strict=True)
    visible = [n for n, v in list(named)[result.shifts :] if v]
    return {
        "name": result.protocol,
        "total": len(result.names) - result.shifts,
        "seen": len(visible),
        "alone": sum(len(result.equivalence_class(name)) == 1 for name in visible),
        "groups": "; ".join("{" + ", ".join(map(short, g)) + "}" for g in classes(result)),
        "rows": _rows(result),
    }


def plot_angles(study: Study, file: Path) -> None:
    """Draws the angles of all protocols."""
    count = len(study.results)
    # One below the other, so that the names can be read.
    figure = new_figure(8.0, 7.6 * count)
    axes = figure.subplots(count, 1)
    image = None
    for axis, result in zip(np.atleast_1d(axes), study.results, strict=True):
        show = np.flatnonzero(result.visible)
        angles = result.angles[np.ix_(show, show)].copy()
        np.fill_diagonal(angles, np.nan)
        image = axis.imshow(angles, cmap="viridis", vmin=0.0, vmax=90.0)
        labels = [short(result.names[k]) for k in show]
        axis.set_xticks(range(len(show)), labels, rotation=90)
        axis.set_yticks(range(len(show)), labels)
        for i in range(len(show)):
            for j in range(len(show)):
                if i != j and angles[i, j] < 45.0:
                    color = "white" if angles[i, j] < 60.0 else "black"
                    axis.text(
                        j,
                        i,
                        f"{angles[i, j]:.0f}",
                        ha="center",
                        va="center",
                        fontsize=7,
                        color=color,
                    )
        axis.set_title(
            f"{result.protocol}: what is left of the row's cause when the column's explains it"
        )
    if image is not None:
        figure.colorbar(image, ax=axes, shrink=0.5, aspect=40, location="top", label="angle [deg]")
    save_figure(figure, file, 110)
