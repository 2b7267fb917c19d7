"""Knowledge of parameters after a calibration: a normal distribution within their ranges."""

import dataclasses as dc
from collections.abc import Mapping

import numpy as np
from scipy.special import ndtri

from sliceit_drake.configuration import ConfigurationError

__all__ = ["DETERMINED", "PRIOR_DEVIATION", "ParameterDistribution", "from_unit", "to_unit"]

PRIOR_DEVIATION = float(np.sqrt(1.0 / 12.0))
"""Standard deviation of a place that is uniform in the unit range."""
DETERMINED = 0.5
"""Greatest standard deviation of what is determined, relative to that before the data."""
BATCH, BATCHES = 20_000, 500


@dc.dataclass
class ParameterDistribution:
    """Joint distribution of parameters, in units of their ranges: 0 at the low end, 1 at the high.

    Normal, cut off at the ends of the ranges. A parameter's place is that of its logarithm where
    `log` is set.

    Attributes:
        names: The parameters, as `cutting.parameters.parameter_names` gives them.
        low, high: Ranges, in the parameters' units.
        log: Whether the unit of a range is the logarithm.
        mean: Mean places in the ranges.
        covariance: Covariance of the places, a row for each parameter.
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

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations of the places [d]."""
        return np.sqrt(np.diag(np.array(self.covariance)))

    def values(self, places: np.ndarray | None = None) -> dict[str, float]:
        """Parameters by name at places in their ranges [d]; at the mean by default."""
        places = np.array(self.mean) if places is None else places
        ranges = zip(self.names, places, self.low, self.high, self.log, strict=True)
        return {n: float(from_unit(u, low, high, log)) for n, u, low, high, log in ranges}

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Central intervals by name, in the parameters' units, that hold a probability `level`."""
        reach = float(ndtri(0.5 + level / 2.0)) * self.deviation
        low = self.values(np.clip(np.array(self.mean) - reach, 0.0, 1.0))
        high = self.values(np.clip(np.array(self.mean) + reach, 0.0, 1.0))
        ranges = zip(self.names, self.low, self.high, strict=True)
        # The logarithm's rounding may exceed a range.
        return {n: (max(low[n], least), min(high[n], most)) for n, least, most in ranges}

    def determined(self) -> dict[str, bool]:
        """Whether the data say more than the range does, for each parameter by name.

        What they say is its standard deviation below half of that of the range.
        """
        inside = self.deviation < DETERMINED * PRIOR_DEVIATION
        return {name: bool(d) for name, d in zip(self.names, inside, strict=True)}

    def table(self, values: Mapping[str, float] | None = None) -> str:
        """Parameters with values, their means by default, and 90 % intervals, and which of them the
        records do not determine."""
        values = self.values() if values is None else values
        intervals, determined = self.intervals(0.9), self.determined()
        width = max(len(name) for name in self.names)
        lines = [f"{'parameter':{width}}  {'value':>10}  {'90 % interval':>23}"]
        for name, (low, high) in intervals.items():
            line = f"{name:{width}}  {values[name]:10.4g}  {low:10.4g} to {high:9.4g}"
            lines.append(line + ("" if determined[name] else "  not determined by these records"))
        return "\n".join(lines)

    def draw_places(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """A sample of places [n, d], all within the ranges.

        Raises:
            ValueError: So little of the distribution is within the ranges that none was found.
        """
        mean, found = np.array(self.mean), []
        values, vectors = np.linalg.eigh(np.array(self.covariance))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        count = 0
        for _ in range(BATCHES):
            sample = mean + rng.normal(size=(max(n, min(4 * n, BATCH)), len(mean))) @ root.T
            sample = sample[((sample >= 0.0) & (sample <= 1.0)).all(1)]
            found.append(sample)
            count += len(sample)
            if count >= n:
                return np.concatenate(found)[:n]
        raise ValueError(f"{count} of {n} samples were found within the ranges")

    def draw(self, rng: np.random.Generator, n: int) -> list[dict[str, float]]:
        """A sample as of `draw_places`, as n sets of parameters by name."""
        if not self.names:
            return [{}] * n
        return [self.values(place) for place in self.draw_places(rng, n)]


def to_unit(value: np.ndarray | float, low: float, high: float, log: bool) -> np.ndarray:
    """Place of a value in its range: 0 at the low end, 1 at the high end."""
    if log:
        return np.asarray(np.log(np.asarray(value) / low) / np.log(high / low))
    return np.asarray((np.asarray(value) - low) / (high - low))


def from_unit(unit: np.ndarray | float, low: float, high: float, log: bool) -> np.ndarray:
    """Inverse of `to_unit`."""
    if log:
        return np.asarray(low * np.exp(np.asarray(unit) * np.log(high / low)))
    return np.asarray(low + np.asarray(unit) * (high - low))
