"""The result of a calibration: what was found, as a table, a figure, a food and files."""

import dataclasses as dc
import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliceit_drake.calibration.bands import ForceBand
from sliceit_drake.calibration.plot import plot_fit
from sliceit_drake.calibration.prediction import Prediction, Predictor
from sliceit_drake.calibration.uncertainty import Posterior
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.spring_food import calibrate_spring

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Calibration"]


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
        before = f"at the start {self.search_rms:.3f}"
        if self.refined_rms != self.search_rms:
            before = f"search {self.search_rms:.3f}, Adam {self.refined_rms:.3f}"
        lines = [
            self.posterior.table(),
            *self.posterior.remarks(),
            f"RMS error: {before}, polished {self.polished_rms:.3f}, with these values "
            f"{self.rms:.3f} N",
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
        return plot_fit(self.predictor, self.predictions, self.band)

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
