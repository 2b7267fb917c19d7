"""The report of what protocols can tell: docs/identifiability.md, and the figure of the angles."""

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
    Identifiability,
    classes,
    short,
)

__all__ = ["Study", "plot_angles", "report"]


@dc.dataclass
class Study:
    """What protocols can tell.

    Attributes:
        results: One a protocol.
        causes: That were asked for.
        found: Sensitivities of all records.
    """

    results: list[Identifiability]
    causes: Sequence[Cause]
    found: Sensitivities


def _table(result: Identifiability) -> str:
    """One line a cause: what shows, with what it can be confused, what would part it."""
    lines = [
        "| cause | shows [sd] | delta | class | nearest other | parted by |",
        "|---|---|---|---|---|---|",
    ]
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
        lines.append(
            f"| {short(name) if a < result.shifts else f'`{name}`'} | {result.shows[a]:.0f} "
            f"| {result.delta[a]:.2f} | {what} | {near} | {parted} |"
        )
    return "\n".join(lines)


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


HEAD = """\
# What slices can tell

Which causes of a misfit a set of slices can tell apart, computed before anything is measured:

    python -m studies identifiability --output docs/identifiability.md --figure {figure}

For each cause the change of the predicted forces at a plausible size; less what free base
parameters can take up ({base}), and differences from slice to slice (5 % in
toughness, modulus and friction, 0.3 mm in height), the sensor's zero (0.05 N, differing) and the
discretisation (half the step, a finer mesh); in units of noise (0.09 N in a row, most of it
correlated over 0.1 s). The motions are the protocols' own, without noise; {elements} tetrahedra.
What the causes are: [causes.md](causes.md).

- **shows**: standard deviations that are left of the cause at its plausible size, all rows
  together. Below {shows:g} it does not show: slices of this protocol say nothing of it, and a
  calibration takes it for a shift of the parameters that are named.
- **delta**: what is left of it, RMS over the rows in contact, in the channel that has most of it,
  in standard deviations of a row's noise.
- **class**: what cannot be told from it: one explains the other to within {angle:g} degrees. A
  cause with several numbers explains more and is explained less, so each direction counts.
- **nearest other**: what explains most of it, or is explained best by it.
- **parted by**: the condition of `full.yaml` that, added with its replicates, gives the largest
  angle to the nearest other; for a cause that does not show, with which it shows most.

A shift of a base parameter, by {shift:.0f} %, is compared with it left out of what is taken up.
"""

WHY = """\
## Why {angle:g} degrees

By noise alone a cause of n standard deviations leaves n sin(a) of them if another at the angle a is
blamed: at 20 degrees a third, so 3 of 9. Most causes show with tens, and less would do. What sets
the bound is that no real cause has quite the form that is assumed here. How far apart forms of one
cause are, before anything is taken up: neighbouring values of its scan, and its change at full size
against its linear part. In the middle {middle:.0f} degrees, in three cases out of four less than
{most:.0f}. Causes that are nearer to each other than that cannot be told apart by their form.

| cause | neighbours of its scan [deg] | full size off linear [deg] |
|---|---|---|
{rows}
"""


def report(study: Study, figure: str = "docs/figures/identifiability.png") -> str:
    """The report as Markdown."""
    found = study.found
    base = ", ".join(c.name.rsplit(".", 1)[-1] for c in found.columns if c.kind == "base")
    parts = [
        HEAD.format(
            figure=figure,
            base=base.replace("youngs_", ""),
            elements=found.elements,
            shows=SHOWS,
            angle=ANGLE,
            shift=100.0 * SHIFT,
        )
    ]
    for result in study.results:
        seen = int(result.visible[result.shifts :].sum())
        total = len(result.names) - result.shifts
        alone = sum(
            len(result.equivalence_class(n)) == 1
            for n, v in zip(result.names, result.visible, strict=True)
            if v and n not in result.names[: result.shifts]
        )
        parts.append(
            f"## {result.protocol}\n\nOf {total} causes {seen} show, {alone} of them apart from "
            "all others."
        )
        groups = classes(result)
        if groups:
            listed = "; ".join("{" + ", ".join(map(short, g)) + "}" for g in groups)
            parts.append(f"Not told apart: {listed}.")
        parts.append(_table(result))
    parts.append(f"![Angles between causes]({figure.removeprefix('docs/')})")
    bent, scanned = _nonlinearity(found), _scan_angles(found)
    rows = "\n".join(
        f"| `{name}` | {f'{scanned[name]:.0f}' if name in scanned else ''} "
        f"| {f'{bent[name]:.0f}' if name in bent else ''} |"
        for name in found.causes
        if name in bent or name in scanned
    )
    own = [v for v in (*scanned.values(), *bent.values()) if v > 1.0]
    middle, most = np.percentile(own, [50.0, 75.0]) if own else (0.0, 0.0)
    parts.append(WHY.format(angle=ANGLE, rows=rows, middle=middle, most=most))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def plot_angles(study: Study, file: Path) -> None:
    """Draws the angles of all protocols."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    count = len(study.results)
    # One below the other, so that the names can be read.
    figure, axes = plt.subplots(count, 1, figsize=(8.0, 7.6 * count), layout="constrained")
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
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)
    plt.close(figure)
