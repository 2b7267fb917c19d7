"""The parameters' distribution after a calibration, and what it leaves open."""

import dataclasses as dc

import numpy as np
from scipy.special import ndtri

from sliceit_drake.calibration.setup import from_unit
from sliceit_drake.configuration import quantity

__all__ = ["Posterior"]

PRIOR_DEVIATION = float(np.sqrt(1.0 / 12.0))
"""Of a place that is uniform in the unit range."""
DETERMINED = 0.5
"""Greatest standard deviation of what is determined, relative to that before the data."""
CORRELATED = 0.9
SHARE = 0.3
"""Least part of a parameter in a direction for it to be named."""
BATCH, BATCHES = 20_000, 500


@dc.dataclass
class Posterior:
    """Joint distribution of the parameters: normal in places of their ranges, cut off at the ends.

    Attributes:
        names: Of the parameters [d].
        low, high: Ranges [d], each in its parameter's unit.
        log: Whether a place is that of the logarithm [d].
        mean: Places, 0 at the low end and 1 at the high [d].
        covariance: Of the places [d, d].
        effective_samples: Independent samples that would be worth as much as those of the records.
        record_variation: Relative standard deviation of the force between slices, or null where no
            cut was repeated.
        notes: What a reader must know.
    """

    names: list[str] = dc.field(default_factory=list)
    low: list[float] = dc.field(default_factory=list)
    high: list[float] = dc.field(default_factory=list)
    log: list[bool] = dc.field(default_factory=list)
    mean: list[float] = dc.field(default_factory=list)
    covariance: list[list[float]] = dc.field(default_factory=list)
    effective_samples: float = quantity(0.0, "", low=0.0, high=1e12, doc="In number.")
    record_variation: float | None = quantity(
        None, "", low=0.0, high=10.0, doc="Relative, between slices."
    )
    notes: list[str] = dc.field(default_factory=list)

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations of the places [d]."""
        return np.sqrt(np.diag(np.array(self.covariance)))

    def values(self, unit: np.ndarray) -> dict[str, float]:
        """Parameters by name at places in their ranges [d]."""
        ranges = zip(self.names, unit, self.low, self.high, self.log, strict=True)
        return {n: float(from_unit(u, low, high, log)) for n, u, low, high, log in ranges}

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Central intervals by name, in the parameters' units, within their ranges.

        Args:
            level: Probability within, such as 0.9.
        """
        reach = float(ndtri(0.5 + level / 2.0)) * self.deviation
        low = self.values(np.clip(np.array(self.mean) - reach, 0.0, 1.0))
        high = self.values(np.clip(np.array(self.mean) + reach, 0.0, 1.0))
        ranges = zip(self.names, self.low, self.high, strict=True)
        # The logarithm's rounding may exceed a range.
        return {n: (max(low[n], least), min(high[n], most)) for n, least, most in ranges}

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
        """A sample of n sets of parameters by name, all within the ranges.

        Raises:
            ValueError: So little of the distribution is within the ranges that none was found.
        """
        return [self.values(place) for place in self.draw_places(rng, n)]

    def determined(self) -> dict[str, bool]:
        """Whether the data say more than the range does, for each parameter by name.

        What they say is its standard deviation below half of that of the range.
        """
        inside = self.deviation < DETERMINED * PRIOR_DEVIATION
        return {name: bool(d) for name, d in zip(self.names, inside, strict=True)}

    def correlation(self) -> np.ndarray:
        """Of the places [d, d]."""
        sd = self.deviation
        return np.asarray(np.array(self.covariance) / np.outer(sd, sd))

    def correlated_pairs(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters with a correlation beyond 0.9 either way, strongest first."""
        C = self.correlation()
        rows, columns = np.triu_indices(len(C), 1)
        pairs = [
            (self.names[i], self.names[j], float(C[i, j]))
            for i, j in zip(rows, columns, strict=True)
            if abs(C[i, j]) > CORRELATED
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))

    def undetermined_directions(self) -> list[dict[str, float]]:
        """Directions in which the data say little, as the parts that parameters have in them.

        They are the principal axes of the covariance along which the standard deviation is above
        half of that of the range; parts are in places of the ranges, for a direction of length one.
        """
        values, vectors = np.linalg.eigh(np.array(self.covariance))
        out = []
        for variance, vector in zip(values[::-1], vectors.T[::-1], strict=True):
            if np.sqrt(max(variance, 0.0)) < DETERMINED * PRIOR_DEVIATION:
                break
            vector = vector * np.sign(vector[np.abs(vector).argmax()])
            out.append(
                {n: float(x) for n, x in zip(self.names, vector, strict=True) if abs(x) > SHARE}
            )
        return out

    def remarks(self) -> list[str]:
        """What the data do not determine, and the notes, as sentences."""
        known = self.determined()
        lines = [
            f"{name} is not determined by these data" for name, yes in known.items() if not yes
        ]
        named = set()
        for one, other, c in self.correlated_pairs():
            named.add(frozenset((one, other)))
            what = (
                "only a combination is determined"
                if not (known[one] and known[other])
                else "their combination is determined better than either"
            )
            lines.append(f"{one} and {other}: correlation {c:.3f}, {what}")
        for direction in self.undetermined_directions():
            if len(direction) > 1 and frozenset(direction) not in named:
                parts = ", ".join(f"{name} {part:+.2f}" for name, part in direction.items())
                lines.append(f"not determined together, in parts of their ranges: {parts}")
        return lines + self.notes
