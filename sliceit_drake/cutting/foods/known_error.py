"""What a calibrated simulation gets wrong by itself, as the calibration's records showed it."""

import dataclasses as dc

from sliceit_drake.configuration import ConfigurationError, quantity

__all__ = ["KnownError", "KnownErrorOfCut"]


@dc.dataclass
class KnownErrorOfCut:
    """Of one kind of cut.

    Attributes:
        values: Measured less simulated, a row for each channel, N and Nm.
    """

    speed: float = quantity(0.02, "m/s", low=1e-5, high=10.0)
    """Of the knife on the way in."""
    draw: float = quantity(0.0, "", low=0.0, high=1.0)
    """Share of the draw in that way."""
    values: list[list[float]] = dc.field(default_factory=list)


@dc.dataclass
class KnownError:
    """Measured less simulated force of a calibration's records, along the way of the knife.

    A diagnosis adds it to what it predicts of cuts of the same kinds, so that it looks for what has
    changed since. A simulation does not have it.

    Attributes:
        channels: Names of the channels.
        cuts: A mean for each kind of cut, beside what its slices differ in as a whole.
        slices: Number of all slices.
        records: Keys of the records, by their content: of these it tells nothing more.
    """

    channels: list[str] = dc.field(default_factory=list)
    step: float = quantity(2.5e-4, "m", low=1e-5, high=0.01)
    """Of the way between the values, which begin this far before the first contact; see
    `diagnosis.known_error.way_of`."""
    refinement: float = quantity(1.0, "", low=0.01, high=100.0)
    """Of the mesh that it was simulated on: what is wrong on another is not known."""
    cuts: list[KnownErrorOfCut] = dc.field(default_factory=list)
    slices: int = 1
    records: list[str] = dc.field(default_factory=list)

    def check(self, where: str) -> None:
        for k, cut in enumerate(self.cuts):
            lengths = {len(row) for row in cut.values}
            if len(cut.values) != len(self.channels) or len(lengths) != 1 or 0 in lengths:
                raise ConfigurationError(
                    f"is no table with rows of one length for {', '.join(self.channels)}",
                    field=f"{where}.cuts[{k}].values",
                    fix="Calibrate again.",
                )
        if self.slices < 1:
            raise ConfigurationError(
                f"is {self.slices}", field=f"{where}.slices", fix="Calibrate again."
            )
