"""The result of a calibration: what was found, as a table, a figure, a food and files."""

import dataclasses as dc
import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.calibration.bands import ForceBand
from sliceit_drake.calibration.prediction import Prediction, Predictor
from sliceit_drake.calibration.uncertainty import Posterior
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.spring_food import calibrate_spring
from sliceit_drake.prediction.record_target import RecordTarget

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Calibration"]

MEASURED, PREDICTED = "#111827", "#c2410c"
CHANNELS = ("force x", "force y", "force z")


@dc.dataclass
class Calibration:
    """What a calibration found; prints as a table, plots itself, saves to a folder.

    Attributes:
        predictor: Of the records that were fitted, at the setup's sub-step.
        unit: Places of the parameters in their ranges [d].
        predictions: One a record.
        rms: On the records, N.
        search_rms: Best of the search alone, N; of the start where there was no search.
        refined_rms: Best after Adam, N; the same.
        polished_rms: Least of all, N; `rms` is that of the values that the noise makes probable.
        posterior: Of the parameters.
        band: Within what another measurement is expected.
        blocks: RMS error on each block of depth when it was held out, N.
        held_out_rms: On all of them, N; None if none was held out.
        held_out_records: RMS error by name on records that were not fitted, N.
        failures: Trials that broke down.
    """

    predictor: Predictor
    unit: np.ndarray
    predictions: list[Prediction]
    rms: float
    search_rms: float
    refined_rms: float
    polished_rms: float
    posterior: Posterior
    band: ForceBand
    blocks: list[float]
    held_out_rms: float | None
    held_out_records: dict[str, float]
    failures: int

    @property
    def warnings(self) -> list[str]:
        """Where the cuts depart from the calibrated values; see `CuttingModel.warnings`."""
        values = self.predictor.values(self.unit)
        models = [self.predictor.model(target, values) for target in self.predictor.targets]
        return sorted({text for model in models for text in model.warnings})

    def table(self) -> str:
        """Parameters with 90 % intervals, which of them are not determined, errors, warnings."""
        lines = [
            self.posterior.table(),
            *self.posterior.remarks(),
            f"RMS error: search {self.search_rms:.3f}, Adam {self.refined_rms:.3f}, "
            f"polished {self.polished_rms:.3f}, with these values {self.rms:.3f} N",
        ]
        if self.held_out_rms is not None:
            blocks = ", ".join(f"{b:.2f}" for b in self.blocks)
            lines.append(f"Held-out blocks of depth: {self.held_out_rms:.3f} N ({blocks})")
        low, high = self.band.interval()
        inside = np.mean((low <= self.predictor.measured) & (self.predictor.measured <= high))
        lines.append(
            f"90 % band of the force: {np.mean(high - low):.3g} N wide in the mean, and "
            f"{100.0 * inside:.0f} % of the rows are in it"
        )
        for name, error in self.held_out_records.items():
            lines.append(f"Held-out record {name}: {error:.3f} N")
        lines += [f"Warning: {text}" for text in self.warnings]
        return "\n".join(lines)

    def plot(self) -> "Figure":
        """Measured and predicted force of the first three records, and what is left."""
        from matplotlib.figure import Figure

        shown = self.predictor.targets[:3]
        sheet = Figure(figsize=(5.2 * len(shown), 4.2), layout="constrained")
        axes = sheet.subplots(
            2, len(shown), squeeze=False, sharex="col", gridspec_kw={"height_ratios": (3, 1)}
        )
        ends = zip(*map(self.predictor.split, self.band.interval()), strict=True)
        for target, prediction, band, (upper, lower) in zip(
            shown, self.predictions, ends, axes.T, strict=False
        ):
            _plot_record(target, prediction.predicted, band, upper, lower)
        return sheet

    def calibrated_food(self, date: str = "", command: str = "") -> CalibratedFood:
        """The food as scenarios load it."""
        values = self.predictor.values(self.unit)
        target = self.predictor.targets[0]
        model = self.predictor.model(target, values)
        food = dc.replace(self.predictor.setup.food, material=model.material, effects=model.effects)
        force = np.concatenate([t.record.force_magnitude for t in self.predictor.targets])
        spring = calibrate_spring(force, float(model.top - model.bottom))
        return CalibratedFood(
            food=food,
            knife=model.knife,
            distribution=self.posterior.shared(),
            spring=spring,
            rms_error=self.rms,
            held_out_error=self.held_out_rms,
            records=[t.record.name for t in self.predictor.targets],
            date=date,
            command=command,
        )

    def save(self, directory: Path, command: str = "") -> None:
        """Writes `food.yaml`, `calibration.json` and `fit.png`.

        Args:
            directory: Where; it exists.
            command: What was typed, for the food's provenance.
        """
        food = self.calibrated_food(datetime.date.today().isoformat(), command)
        dump_yaml(food, directory / "food.yaml")
        self.plot().savefig(directory / "fit.png", dpi=150)
        content = {
            "food": self.predictor.setup.food.name,
            "records": [t.record.name for t in self.predictor.targets],
            "rms_N": self.rms,
            "search_rms_N": self.search_rms,
            "adam_rms_N": self.refined_rms,
            "polished_rms_N": self.polished_rms,
            "held_out_rms_N": self.held_out_rms,
            "held_out_blocks_N": self.blocks,
            "held_out_records_N": self.held_out_records,
            "failed_trials": self.failures,
            "warnings": self.warnings,
            "parameters": self.predictor.values(self.unit),
            "oscillation": [dc.asdict(p.oscillation) for p in self.predictions],
        }
        text = json.dumps(content, indent=2) + "\n"
        (directory / "calibration.json").write_text(text, encoding="utf-8")


def _plot_record(
    target: RecordTarget,
    predicted: np.ndarray,
    band: tuple[np.ndarray, np.ndarray],
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
    upper.plot([], [], color=PREDICTED, label="calibrated")
    upper.fill_between([], [], [], color=PREDICTED, alpha=0.15, lw=0, label="90 % band")
    lower.set(xlabel="time [s]", ylabel="rest [N]")
    for axis in (upper, lower):
        axis.grid(alpha=0.25)
    upper.legend(frameon=False)
    if len(channels) > 1:
        lower.legend(frameon=False, fontsize=7, ncols=3)
