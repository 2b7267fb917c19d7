"""What is known of parameters after a calibration: a normal distribution within their ranges."""

import dataclasses as dc
from collections.abc import Mapping

import numpy as np

from sliceit_drake.configuration import ConfigurationError

__all__ = ["ParameterDistribution"]

ATTEMPTS = 200


@dc.dataclass
class ParameterDistribution:
    """Joint distribution of parameters, in units of their ranges: 0 at the low end, 1 at the high.

    Normal, cut off at the ends of the ranges. A parameter's place is that of its logarithm where
    `log` is set.

    Attributes:
        names: As `cutting.parameters.parameter_names`.
        low, high: Ranges, in the parameters' units.
        log: Whether the unit of a range is the logarithm.
        mean: Places in the ranges.
        covariance: Of the places, a row for each parameter.
    """

    names: list[str] = dc.field(default_factory=list)
    low: list[float] = dc.field(default_factory=list)
    high: list[float] = dc.field(default_factory=list)
    log: list[bool] = dc.field(default_factory=list)
    mean: list[float] = dc.field(default_factory=list)
    covariance: list[list[float]] = dc.field(default_factory=list)

    def check(self, where: str) -> None:
        d = len(self.names)
        for name in ("low", "high", "log", "mean", "covariance"):
            if len(getattr(self, name)) != d:
                raise ConfigurationError(
                    f"has {len(getattr(self, name))} entries for {d} names",
                    field=f"{where}.{name}",
                    fix="Give one for each name.",
                )
        if d == 0:
            return
        covariance = np.array(self.covariance, float)
        if covariance.shape != (d, d) or not np.allclose(covariance, covariance.T):
            raise ConfigurationError(
                "is no symmetric matrix", field=f"{where}.covariance", fix="Give rows of it."
            )
        if np.linalg.eigvalsh(covariance).min() < -1e-9:
            raise ConfigurationError(
                "is no covariance: a variance is negative",
                field=f"{where}.covariance",
                fix="Calibrate again.",
            )
        for k in range(d):
            if not self.low[k] < self.high[k] or (self.log[k] and self.low[k] <= 0.0):
                raise ConfigurationError(
                    f"{self.low[k]:g} to {self.high[k]:g} is no range",
                    field=f"{where}.low[{k}]",
                    fix="Give low < high, and low > 0 for a logarithm.",
                )

    def value(self, k: int, place: float) -> float:
        """The k-th parameter at a place in its range."""
        if self.log[k]:
            return float(self.low[k] * (self.high[k] / self.low[k]) ** place)
        return float(self.low[k] + (self.high[k] - self.low[k]) * place)

    def values(self) -> dict[str, float]:
        """The parameters at the mean."""
        return {name: self.value(k, self.mean[k]) for k, name in enumerate(self.names)}

    def draw(self, rng: np.random.Generator) -> Mapping[str, float]:
        """A sample within the ranges, by name.

        What falls outside is drawn again; after `ATTEMPTS` times it is clipped.
        """
        if not self.names:
            return {}
        mean = np.array(self.mean)
        place = mean
        for _ in range(ATTEMPTS):
            place = rng.multivariate_normal(mean, np.array(self.covariance), method="eigh")
            if ((place >= 0.0) & (place <= 1.0)).all():
                break
        place = np.clip(place, 0.0, 1.0)
        return {name: self.value(k, float(place[k])) for k, name in enumerate(self.names)}
