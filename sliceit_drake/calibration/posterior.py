"""The parameters' distribution after a calibration, and what it leaves open."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import quantity
from sliceit_drake.cutting.foods.distribution import (
    DETERMINED,
    PRIOR_DEVIATION,
    ParameterDistribution,
)

__all__ = ["Posterior"]

CORRELATED = 0.9
SHARE = 0.3
"""Least part of a parameter in a direction for it to be named."""


@dc.dataclass
class Posterior(ParameterDistribution):
    """What records say of all parameters, those of single records included.

    Attributes:
        effective_samples: Independent samples that would be worth as much as those of the records.
        record_variation: Relative standard deviation of the force between slices, or null where no
            cut was repeated.
        notes: What a reader must know.
    """

    effective_samples: float = quantity(0.0, "", low=0.0, high=1e12)
    """In number."""
    record_variation: float | None = quantity(None, "", low=0.0, high=10.0)
    """Relative, between slices."""
    notes: list[str] = dc.field(default_factory=list)

    def shared(self) -> ParameterDistribution:
        """The part of the parameters that belong to the food and not to one record."""
        own = [k for k, name in enumerate(self.names) if ":" not in name]
        return ParameterDistribution(
            names=[self.names[k] for k in own],
            low=[self.low[k] for k in own],
            high=[self.high[k] for k in own],
            log=[self.log[k] for k in own],
            mean=[float(self.mean[k]) for k in own],
            covariance=np.array(self.covariance)[np.ix_(own, own)].tolist(),
        )

    def correlation(self) -> np.ndarray:
        """Correlation of the parameters, in their unit ranges [d, d]."""
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
