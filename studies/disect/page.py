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
from studies.figures import BLUE, ORANGE, PURPLE, new_figure, save_figure, tidy
from studies.pages import publish, render_and_store
from studies.physics.measured_curves import load_measured_foods

__all__ = ["add_arguments", "field_unit", "page_values", "plot_disect", "run"]

FOODS = "calibration/verification_foods.yaml"


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
    values = page_values(study, "python -m studies disect --output docs/results", minutes)
    page = options.output / "disect.md"
    publish(render_and_store("disect", page, values, _numbers(study)), page)
    return 0


def _numbers(study: DisectStudy) -> dict[str, Any]:
    """The results without models and states."""
    kept = ("height", "norms", "resultant", "vertical", "broken", "intact", "opening_energy")

    def curves(result: CaseResult) -> dict[str, Any]:
        return {name: getattr(result, name) for name in kept}

    return {
        "contact_stiffness": study.contact_stiffness,
        "runs": [(run.name, curves(result)) for run, result in study.runs],
        "delays": study.delays,
        "laws": study.laws,
        "opening": curves(study.opening),
        "full": curves(study.full),
        "differences": study.differences,
        "measured": [(item.food, item.flank_stiffness, item.curves) for item in study.measured],
    }


def page_values(study: DisectStudy, command: str, minutes: float) -> dict[str, object]:
    """What the page shows.

    Args:
        study: The results.
        command: That wrote it.
        minutes: That it took.
    """
    toughness, strength = study.laws[0]
    nominal = study.reference.runs[0]
    assert nominal.break_delay is not None
    return dict(
        command=command,
        minutes=minutes,
        case=_case_rows(study),
        contact=study.contact_stiffness,
        given=study.reference.springs.contact_stiffness,
        delay=1e3 * nominal.break_delay,
        runs=_run_rows(study),
        strength=strength / 1e3,
        worst=_worst(study),
        toughness=toughness,
        measured=_measured_rows(study.measured),
        sums=_peaks(study.measured, "full model", "sum of norms", 0),
        left=_peaks(study.measured, "opening law alone", "resultant", 2),
        last=study.opening.norms[-1],
        differences=[dc.astuple(d) for d in study.differences],
        settings=[(name, value, _with_units(here)) for name, value, here in SETTINGS],
    )


def _number(value: float | None, digits: int = 1) -> str:
    return "not noted" if value is None else f"{value:.{digits}f}"


def _case_rows(study: DisectStudy) -> list[Sequence[object]]:
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
    return rows


def _mean(result: CaseResult, values: np.ndarray) -> float:
    inside = (result.height < 0.03) & (result.height > 0.0)
    return float(values[inside].mean())


def _run_rows(study: DisectStudy) -> Sequence[tuple[str, ...]]:
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
    return rows


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


def _measured_rows(measured: Sequence[MeasuredCurves]) -> Sequence[tuple[str, ...]]:
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
    return rows


def _peaks(measured: Sequence[MeasuredCurves], name: str, measure: str, digits: int) -> str:
    """Greatest force of a curve, food by food."""
    peaks = (
        (item.food, float(curve.force.max()))
        for item in measured
        for curve in item.curves
        if (curve.name, curve.measure) == (name, measure)
    )
    return ", ".join(f"{food} {peak:.{digits}f} N" for food, peak in peaks)


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


COLOURS = {"sum of norms": ORANGE, "resultant": BLUE}
STYLES = {"opening law alone": "--", "full model": "-"}


def plot_disect(study: DisectStudy, file: Path) -> None:
    """Draws both measures: the reference case over depth, the measured cuts over time.

    Args:
        study: The results.
        file: PNG to write.
    """
    figure = new_figure(10.0, 7.6)
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
                style = dict(color=PURPLE, lw=2.4, ls=":", label=label)
            else:
                style = dict(color=COLOURS[curve.measure], ls=STYLES[curve.name], lw=1.5)
            axes.plot(item.profile.time, np.where(curve.force > 0.0, curve.force, np.nan), **style)
        axes.set_title(f"{item.food}, measured at 20 mm/s", loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
        axes.set_xlim(0.0, item.profile.time[-1])
    for axes in panels:
        axes.set_yscale("log")
        axes.set_ylim(0.03, 400.0)
        tidy(axes)
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
    save_figure(figure, file)
