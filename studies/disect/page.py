"""The simulator beside DiSECt, in both measures of the knife's force.

Cuts DiSECt's reference case with the opening law alone, set to its parameters, and with the full
model, puts its differences back one by one, and compares with its curves of the measured cuts.
Writes to FOLDER disect.md and figures/disect.png. Takes some minutes.
"""

import argparse
import dataclasses as dc
import time
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.resources import resource_path
from studies.disect import case as disect
from studies.disect.case import Case, CaseResult
from studies.disect.settings import SETTINGS
from studies.disect.study import STEPS, Curve, DisectStudy, MeasuredCurves, disect_study
from studies.physics.measured_curves import load_measured_foods

__all__ = ["add_arguments", "disect_page", "field_unit", "plot_disect", "run"]

FOODS = "calibration/verification_foods.yaml"

HEAD = """\
# Side by side with DiSECt

The cutting simulator that SliceIt! uses (Heiden et al., RSS 2021; Autonomous Robots 2023), on its
reference case and on the paper's measured cuts. Written by

    {command}

Numbers of DiSECt are from [calibration/disect](../calibration/disect/README.md) and
[calibration/measured](../calibration/measured/README.md), with their sources; all others are
computed by that command, in {minutes:.1f} minutes on a machine that had other work beside.

Two measures: the **sum of norms** adds up the lengths of all contact forces at one instant, and is
what DiSECt records as the knife's force. The **resultant** is what a sensor feels: the flanks' two
pressures cancel in it but for the wedge. Here both come from one run (`simulate_slice` with
`contact_sum`, `CuttingSolver.contact_forces`).

![Both measures in the reference case and in the measured cuts](figures/disect.png)

## The reference case

A block of 54 x 36 x 30 mm, cells of 6 mm, cut through at 50 mm/s. *Opening law alone*
(`calibration/disect/opening_alone.yaml`) has DiSECt's parameters and an edge that cuts nothing;
*full model* (`calibration/disect/full_model.yaml`) is the same block with the cucumber of
`scenarios/cucumber.yaml`.

{case_table}

DiSECt's peak is at the end. Its mean and work were not noted.

### Does the opening law alone do what DiSECt does?

Two numbers are fitted to the nominal run. Its contact stiffness was not noted: {contact:.0f} N/m a
spring gives its last sum of norms ({given:.0f} is set). Its softness was not noted either: a spring
breaks {delay:.0f} ms after the knife touches it, and how that goes with step, speed and stiffness
follows from its law (`break_opening`). All else in the table is predicted. To compare like with
like, both copies of a cut element have all of its volume here, as there.

{runs_table}

So DiSECt's forces follow from its parameters and laws as they are understood here, to {worst:.0f} %
at worst. What is left of the bonds at the end agrees less well; ours soften bilinearly. The nominal
springs hold {strength:.1f} kPa and take {toughness:.2f} J/m2; [calibration.md](calibration.md)
searches 30 kPa to 3 MPa and 50 to 1500 J/m2. That is why the force hardly changes with their
stiffness, and rests on the contact's.

## The measured cuts

20 mm/s through cucumber, potato and tomato. DiSECt's curves are its authors' calibrated ones, so
sums of norms. Ours are the foods of [verification.md](verification.md) (five numbers fitted to
the measured curve, in sample). *Opening law alone*: the same shapes with DiSECt's moduli and
friction and the reference's springs; one contact stiffness is fitted to *DiSECt's* curve, and
with it the time of first contact.

{measured_table}

{measured_text}

## Differences

Effects are those on the sum of norms of the opening law alone at the end of the reference case,
{last:.1f} N, where nothing else is said.

{difference_table}

## Everything that DiSECt sets, and where it is set here

Fields are those of `calibration/disect/*.yaml`; `food` is that of scenarios as well. `point_scales`
are those of a `CuttingModel`. Functions are in `studies/disect/case.py`.

{settings_table}
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, required=True, help="where page and figure go"
    )


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    foods = load_measured_foods(resource_path(FOODS)).foods
    begin = time.monotonic()
    with tqdm(total=STEPS + len(foods), desc="cuts") as bar:
        study = disect_study(foods, bar.update)
    minutes = max(1.0, (time.monotonic() - begin) / 60.0)
    figure = options.output / "figures" / "disect.png"
    plot_disect(study, figure)
    file = options.output / "disect.md"
    page = disect_page(study, "python -m studies disect --output docs", minutes)
    file.write_text(page, encoding="utf-8")
    print(f"{file} and {figure}")
    return 0


def disect_page(study: DisectStudy, command: str, minutes: float) -> str:
    """The page in Markdown.

    Args:
        study: The results.
        command: That wrote it.
        minutes: That it took.
    """
    toughness, strength = study.laws[0]
    nominal = study.reference.runs[0]
    assert nominal.break_delay is not None
    return HEAD.format(
        command=command,
        minutes=minutes,
        case_table=_case_table(study),
        contact=study.contact_stiffness,
        given=study.reference.springs.contact_stiffness,
        delay=1e3 * nominal.break_delay,
        runs_table=_runs_table(study),
        strength=strength / 1e3,
        worst=_worst(study),
        toughness=toughness,
        measured_table=_measured_table(study.measured),
        measured_text=_measured_text(study.measured),
        last=study.opening.norms[-1],
        difference_table=_table(
            ("difference", "DiSECt", "here", "reason", "effect"),
            [dc.astuple(d) for d in study.differences],
        ),
        settings_table=_settings_table(),
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in lines)


def _number(value: float | None, digits: int = 1) -> str:
    return "not noted" if value is None else f"{value:.{digits}f}"


def _case_table(study: DisectStudy) -> str:
    nominal = study.reference.runs[0]
    rows: list[Sequence[object]] = [
        (
            "DiSECt",
            "sum of norms",
            _number(nominal.sum_peak),
            _number(nominal.sum_middle),
            _number(nominal.sum_end),
            *[_number(None)] * 2,
        ),
        (
            "DiSECt",
            "vertical resultant",
            _number(nominal.vertical_peak, 2),
            _number(None),
            _number(nominal.vertical_end, 2),
            *[_number(None)] * 2,
        ),
    ]
    variants = (
        ("opening law alone, volume twice", study.runs[0][1]),
        ("opening law alone", study.opening),
        ("full model", study.full),
    )
    for name, result in variants:
        for measure, values in (("sum of norms", result.norms), ("resultant", result.resultant)):
            digits = 1 if measure == "sum of norms" or name == "full model" else 2
            rows.append(
                (
                    name,
                    measure,
                    _number(float(values.max()), digits),
                    _number(result.at(disect.MIDDLE, values), digits),
                    _number(float(values[-1]), digits),
                    _number(_mean(result, values), digits),
                    _number(result.work(values), 3),
                )
            )
    head = (
        "simulator",
        "measure",
        "peak [N]",
        "half way [N]",
        "end [N]",
        "mean in the food [N]",
        "work [J]",
    )
    return _table(head, rows)


def _mean(result: CaseResult, values: np.ndarray) -> float:
    inside = (result.height < 0.03) & (result.height > 0.0)
    return float(values[inside].mean())


def _runs_table(study: DisectStudy) -> str:
    count = study.reference.springs.count
    stiffness = study.reference.springs.stiffness
    rows = []
    for (run, result), delay in zip(study.runs, study.delays, strict=True):
        whole = run.spring_factor * stiffness
        middle = result.at(disect.MIDDLE, result.norms)
        rows.append(
            (
                run.name,
                _pair(run.sum_peak, float(result.norms.max()), 1),
                "" if run.sum_middle is None else _pair(run.sum_middle, middle, 1),
                _pair(run.vertical_peak, float(result.vertical.max()), 2),
                _pair(run.broken / count, result.broken, 2),
                _pair(run.mean_stiffness / whole, result.intact, 2),
                "" if run.break_delay is None else _pair(1e3 * run.break_delay, 1e3 * delay, 0),
            )
        )
    head = (
        "run (DiSECt / here)",
        "sum of norms, peak [N]",
        "half way [N]",
        "vertical, peak [N]",
        "broken at the end",
        "mean stiffness left",
        "contact to break [ms]",
    )
    return _table(head, rows)


def _worst(study: DisectStudy) -> float:
    """Largest difference of a peak or of the force half way, %."""
    off = []
    for run, result in study.runs:
        middle = result.at(disect.MIDDLE, result.norms)
        pairs = [(run.sum_peak, result.norms.max()), (run.vertical_peak, result.vertical.max())]
        pairs += [] if run.sum_middle is None else [(run.sum_middle, middle)]
        off += [abs(float(ours) / theirs - 1.0) for theirs, ours in pairs]
    return 100.0 * max(off)


def _pair(theirs: float, ours: float, digits: int) -> str:
    return f"{theirs:.{digits}f} / {ours:.{digits}f}"


def _rms(curve: Curve, other: np.ndarray) -> str:
    rms = float(np.sqrt(np.mean((curve.force - other) ** 2)))
    return "-" if rms == 0.0 else f"{rms:.2f}"


def _measured_table(measured: Sequence[MeasuredCurves]) -> str:
    rows = []
    for item in measured:
        theirs = item.profile.references["DiSECt"]
        for curve in item.curves:
            work = float(np.trapezoid(curve.force, item.profile.time)) * item.speed
            rows.append(
                (
                    item.food,
                    curve.name,
                    curve.measure,
                    f"{curve.force.max():.1f}",
                    f"{curve.force.mean():.2f}",
                    f"{work:.3f}",
                    _rms(curve, item.profile.force),
                    _rms(curve, theirs),
                )
            )
    head = (
        "food",
        "curve",
        "measure",
        "peak [N]",
        "mean [N]",
        "work [J]",
        "RMS to measured [N]",
        "RMS to DiSECt's [N]",
    )
    return _table(head, rows)


def _measured_text(measured: Sequence[MeasuredCurves]) -> str:
    def peak(item: MeasuredCurves, name: str, measure: str) -> float:
        curve = next(c for c in item.curves if (c.name, c.measure) == (name, measure))
        return float(curve.force.max())

    sums = ", ".join(
        f"{item.food} {peak(item, 'full model', 'sum of norms'):.0f} N" for item in measured
    )
    left = ", ".join(
        f"{item.food} {peak(item, 'opening law alone', 'resultant'):.2f} N" for item in measured
    )
    return (
        "A model that meets the measured resultant has quite another sum of norms (peaks: "
        f"{sums}), because the flanks press on it from both sides.\n\n"
        "The other way round, the opening law with one contact stiffness grows with the square of "
        "the depth and does not follow DiSECt's curves, the soft tomato's least. Where it is as "
        f"near as it comes, the knife feels a peak of {left}. DiSECt's own calibration has contact "
        "parameters for each spring, and frees friction; what it found is not published. With a "
        "friction between 0 and 1 its resultant may be anything from a thirtieth of the sum of "
        "norms to most of it, so its curves say little about the force on a sensor, and its "
        "parameters do not carry over."
    )


def _settings_table() -> str:
    return _table(
        ("DiSECt", "reference case", "here"),
        [(name, value, _with_units(here)) for name, value, here in SETTINGS],
    )


def _with_units(text: str) -> str:
    """Text with the unit of each field after it."""
    parts = text.split("`")
    for k in range(1, len(parts), 2):
        if "." not in parts[k] and parts[k] not in {f.name for f in dc.fields(Case)}:
            parts[k] = f"`{parts[k]}`"
            continue
        unit = field_unit(parts[k])
        parts[k] = f"`{parts[k]}`" + (f" [{unit}]" if unit else "")
    return "".join(parts)


def field_unit(path: str) -> str:
    """Unit of a field of a `Case`, or of a `CuttingModel` where it begins with point_scales.

    Lists and alternatives are looked through: food.shape.path is that of a mesh file.

    Raises:
        KeyError: There is no such field.
    """
    types: list[object] = [CuttingModel if path.startswith("point_scales") else Case]
    found: dc.Field[object] | None = None
    for name in path.split("."):
        fields = [f for t in _classes(types) for f in dc.fields(t) if f.name == name]
        if not fields:
            raise KeyError(f"{path}: there is no {name}")
        found = fields[0]
        types = [f.type for f in fields]
    assert found is not None
    return next((r.unit for r in found.metadata.values() if hasattr(r, "unit")), "")


def _classes(types: Iterable[object]) -> list[type]:
    """Dataclasses among types, and in their lists and alternatives."""
    out: list[type] = []
    for t in types:
        if dc.is_dataclass(t) and isinstance(t, type):
            out.append(t)
        else:
            out += _classes(typing.get_args(t))
    return out


COLOURS = {"sum of norms": "#E69F00", "resultant": "#0072B2"}
STYLES = {"opening law alone": "--", "full model": "-"}


def plot_disect(study: DisectStudy, file: Path) -> None:
    """Draws both measures: the reference case over depth, the measured cuts over time.

    Args:
        study: The results.
        file: PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2, sharey=True).ravel()
    nominal = study.reference.runs[0]
    axes = panels[0]
    for name, result in (("opening law alone", study.runs[0][1]), ("full model", study.full)):
        for measure, values in (("sum of norms", result.norms), ("resultant", result.resultant)):
            axes.plot(
                30.0 - 1e3 * result.height,
                values,
                STYLES[name],
                color=COLOURS[measure],
                lw=1.7,
                label=f"ours, {name}: {measure}",
            )
    marks: dict[str, Any] = dict(
        ls="none", marker="o", ms=8, mfc="white", mew=2.0, zorder=5, clip_on=False
    )
    assert nominal.sum_middle is not None and nominal.sum_end is not None
    depth = [30.0 - 1e3 * disect.MIDDLE, 31.0]
    axes.plot(
        depth,
        [nominal.sum_middle, nominal.sum_end],
        color=COLOURS["sum of norms"],
        label="DiSECt: sum of norms",
        **marks,
    )
    axes.plot(
        depth[1:],
        [nominal.vertical_end],
        color=COLOURS["resultant"],
        label="DiSECt: vertical resultant",
        **marks,
    )
    axes.set_title("reference case: block of 30 mm at 50 mm/s", loc="left", fontsize=11)
    axes.set_xlabel("depth of the edge [mm]")
    axes.set_xlim(0.0, 31.0)
    for axes, item in zip(panels[1:], study.measured, strict=True):
        for curve in item.curves:
            if curve.name == "measured":
                style = dict(color="black", lw=2.4, label="measured")
            elif curve.name.startswith("DiSECt"):
                label = "DiSECt, calibrated: sum of norms"
                style = dict(color="#CC79A7", lw=2.4, ls=":", label=label)
            else:
                style = dict(color=COLOURS[curve.measure], ls=STYLES[curve.name], lw=1.5)
            axes.plot(item.profile.time, np.where(curve.force > 0.0, curve.force, np.nan), **style)
        axes.set_title(f"{item.food}, measured at 20 mm/s", loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
        axes.set_xlim(0.0, item.profile.time[-1])
    for axes in panels:
        axes.set_yscale("log")
        axes.set_ylim(0.03, 400.0)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[::2]:
        axes.set_ylabel("force on the knife [N]")
    handles: dict[str, Any] = {}
    for axes in panels:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(
        handles=list(handles.values()),
        labels=list(handles),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)
