"""Measured and predicted force of records, their band, and what is left."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.calibration.bands import ForceBand
from sliceit_drake.calibration.prediction import Prediction, Predictor
from sliceit_drake.prediction.record_target import RecordTarget

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_fit"]

MEASURED, PREDICTED = "#111827", "#c2410c"
CHANNELS = ("force x", "force y", "force z")


def plot_fit(
    predictor: Predictor,
    predictions: Sequence[Prediction],
    band: ForceBand,
    name: str = "calibrated",
) -> "Figure":
    """The first three records.

    Args:
        predictor: Of the records.
        predictions: One a record.
        band: Of all of them.
        name: Of what is predicted.
    """
    from matplotlib.figure import Figure

    shown = predictor.targets[:3]
    sheet = Figure(figsize=(5.2 * len(shown), 4.2), layout="constrained")
    axes = sheet.subplots(
        2, len(shown), squeeze=False, sharex="col", gridspec_kw={"height_ratios": (3, 1)}
    )
    ends = zip(*map(predictor.split, band.interval()), strict=True)
    for target, prediction, own, (upper, lower) in zip(
        shown, predictions, ends, axes.T, strict=False
    ):
        _plot_record(target, prediction.predicted, own, name, upper, lower)
    return sheet


def _plot_record(
    target: RecordTarget,
    predicted: np.ndarray,
    band: tuple[np.ndarray, np.ndarray],
    label: str,
    upper: "Axes",
    lower: "Axes",
) -> None:
    what = "vertical force" if target.channels == ("force_z",) else "force"
    channels = (what,) if len(target.channels) == 1 else CHANNELS
    for c, name in enumerate(channels):
        # The press, which is nearly all of the force, stands out.
        style = (":", "--", "-")[c] if len(channels) > 1 else "-"
        upper.plot(target.time, target.measured[:, c], style, color=MEASURED, lw=1.2)
        upper.plot(target.time, predicted[:, c], style, color=PREDICTED, lw=1.2)
        low, high = (end[:, c] for end in band)
        upper.fill_between(target.time, low, high, color=PREDICTED, alpha=0.15, lw=0)
        rest = target.measured[:, c] - predicted[:, c]
        lower.plot(target.time, rest, style, color="#475569", lw=1.0, label=name)
    rms = target.rms_error(predicted)
    upper.set(title=f"{target.record.name}: RMS {rms:.2f} N", ylabel=f"{what} on the knife [N]")
    upper.plot([], [], color=MEASURED, label="measured")
    upper.plot([], [], color=PREDICTED, label=label)
    upper.fill_between([], [], [], color=PREDICTED, alpha=0.15, lw=0, label="90 % band")
    lower.set(xlabel="time [s]", ylabel="rest [N]")
    for axis in (upper, lower):
        axis.grid(alpha=0.25)
    upper.legend(frameon=False)
    if len(channels) > 1:
        lower.legend(frameon=False, fontsize=7, ncols=3)
