"""Table and figure of a calibration. They take its parts, so that the result can call them."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sliceit_drake.calibration.prediction import Prediction
from sliceit_drake.cutting.foods.distribution import ParameterDistribution
from sliceit_drake.prediction.record_target import RecordTarget

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["force_figure", "parameter_table"]

MEASURED, PREDICTED = "#111827", "#c2410c"
CHANNELS = ("force x", "force y", "force z")


def parameter_table(
    distribution: ParameterDistribution, values: Mapping[str, float] | None = None
) -> str:
    """Parameters with values and 90 % intervals, and which of them are not determined.

    Args:
        distribution: Of the parameters.
        values: By name; the distribution's means by default.
    """
    values = distribution.values() if values is None else values
    names, intervals = distribution.names, distribution.intervals(0.9)
    determined = distribution.determined()
    width = max(len(name) for name in names)
    lines = [f"{'parameter':{width}}  {'value':>10}  {'90 % interval':>23}"]
    for name in names:
        low, high = intervals[name]
        remark = "" if determined[name] else "  not determined by these records"
        lines.append(f"{name:{width}}  {values[name]:10.4g}  {low:10.4g} to {high:9.4g}{remark}")
    return "\n".join(lines)


def force_figure(targets: Sequence[RecordTarget], predictions: Sequence[Prediction]) -> "Figure":
    """Measured and predicted force of the first three records, and what is left."""
    from matplotlib.figure import Figure

    shown = targets[:3]
    sheet = Figure(figsize=(5.2 * len(shown), 4.2), layout="constrained")
    axes = sheet.subplots(
        2, len(shown), squeeze=False, sharex="col", gridspec_kw={"height_ratios": (3, 1)}
    )
    for column, (target, prediction) in enumerate(zip(shown, predictions, strict=False)):
        upper, lower = axes[0, column], axes[1, column]
        channels = ("force",) if len(target.channels) == 1 else CHANNELS
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
