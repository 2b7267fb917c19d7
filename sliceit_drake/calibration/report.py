"""A calibration as a person reads it: table and figure."""

import dataclasses as dc
import datetime
import json
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from sliceit_drake.calibration.calibrate import Calibration
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.distribution import ParameterDistribution

__all__ = ["calibration_table", "figure", "food_table", "write_results"]

MEASURED, PREDICTED = "#111827", "#c2410c"
CHANNELS = ("force x", "force y", "force z")


def _parameter_table(distribution: ParameterDistribution, values: Mapping[str, float]) -> str:
    """Lines of parameters with values and 90 % intervals, and what is not determined."""
    names, intervals = distribution.names, distribution.intervals(0.9)
    determined = distribution.determined()
    width = max(len(name) for name in names)
    lines = [f"{'parameter':{width}}  {'value':>10}  {'90 % interval':>23}"]
    for name in names:
        low, high = intervals[name]
        remark = "" if determined[name] else "  not determined by these records"
        lines.append(f"{name:{width}}  {values[name]:10.4g}  {low:10.4g} to {high:9.4g}{remark}")
    return "\n".join(lines)


def food_table(distribution: ParameterDistribution) -> str:
    """Parameters of a calibrated food with 90 % intervals, and what is not determined."""
    return _parameter_table(distribution, distribution.values())


def calibration_table(calibration: Calibration) -> str:
    """Parameters with 90 % intervals, remarks on what is not determined, and the errors."""
    c = calibration
    lines = [_parameter_table(c.posterior, c.predictor.values(c.unit)), *c.posterior.remarks()]
    lines.append(
        f"RMS error: search {c.search_rms:.3f}, Adam {c.refined_rms:.3f}, polished {c.rms:.3f} N"
    )
    if c.held_out_rms is not None:
        blocks = ", ".join(f"{b:.2f}" for b in c.blocks)
        lines.append(f"Held-out blocks of depth: {c.held_out_rms:.3f} N ({blocks})")
    for name, error in c.held_out_records.items():
        lines.append(f"Held-out record {name}: {error:.3f} N")
    return "\n".join(lines)


def figure(calibration: Calibration) -> Figure:
    """Measured and predicted force of the first three records, and what is left."""
    shown = calibration.predictor.targets[:3]
    sheet = Figure(figsize=(5.2 * len(shown), 4.2), layout="constrained")
    axes = sheet.subplots(
        2, len(shown), squeeze=False, sharex="col", gridspec_kw={"height_ratios": (3, 1)}
    )
    for column, (target, prediction) in enumerate(
        zip(shown, calibration.predictions, strict=False)
    ):
        upper, lower = axes[0, column], axes[1, column]
        channels = ("force",) if target.by_norm else CHANNELS
        for c, name in enumerate(channels):
            # The press, which is nearly all of the force, stands out.
            style = (":", "--", "-")[c] if len(channels) > 1 else "-"
            upper.plot(target.time, target.measured[:, c], style, color=MEASURED, lw=1.2)
            upper.plot(target.time, prediction.predicted[:, c], style, color=PREDICTED, lw=1.2)
            rest = target.measured[:, c] - prediction.predicted[:, c]
            lower.plot(target.time, rest, style, color="#475569", lw=1.0, label=name)
        rms = target.rms_error(prediction.predicted)
        upper.set(title=f"{target.record.name}: RMS {rms:.2f} N", ylabel="force on the knife [N]")
        upper.plot([], [], color=MEASURED, label="measured")
        upper.plot([], [], color=PREDICTED, label="calibrated")
        lower.set(xlabel="time [s]", ylabel="rest [N]")
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
            axis.fill_between(
                target.time,
                0.0,
                1.0,
                where=(~target.compared).tolist(),
                transform=axis.get_xaxis_transform(),
                color="#94a3b8",
                alpha=0.35,
                lw=0.0,
                label="" if target.compared.all() or axis is lower else "turns round: not compared",
            )
        upper.legend(frameon=False)
        if len(channels) > 1:
            lower.legend(frameon=False, fontsize=7, ncols=3)
    return sheet


def write_results(calibration: Calibration, directory: Path, command: str) -> None:
    """Writes `food.yaml`, `calibration.json` and `fit.png`.

    Args:
        calibration: The result.
        directory: Where; it exists.
        command: What was typed, for the food's provenance.
    """
    food = calibration.calibrated_food(datetime.date.today().isoformat(), command)
    dump_yaml(food, directory / "food.yaml")
    _write_json(calibration, directory / "calibration.json")
    calibration.plot().savefig(directory / "fit.png", dpi=150)


def _write_json(calibration: Calibration, file: Path) -> None:
    """Writes the numbers of a calibration."""
    c = calibration
    content = {
        "food": c.setup.food.name,
        "records": [t.record.name for t in c.predictor.targets],
        "rms_N": c.rms,
        "search_rms_N": c.search_rms,
        "adam_rms_N": c.refined_rms,
        "held_out_rms_N": c.held_out_rms,
        "held_out_blocks_N": c.blocks,
        "held_out_records_N": c.held_out_records,
        "failed_trials": c.failures,
        "parameters": c.predictor.values(c.unit),
        "oscillation": [dc.asdict(p.oscillation) for p in c.predictions],
    }
    file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
