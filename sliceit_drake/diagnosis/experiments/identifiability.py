"""Which causes a set of records can tell apart, before anything is measured.

The sensitivities of all causes, less what base parameters, differences from slice to slice and the
discretisation can take up, in units of the noise. What is left of a cause is how well it shows; the
angle between two is how well they can be told apart: a cause of n standard deviations that is
explained by another at an angle a leaves n sin(a) of them.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, Sensitivities
from sliceit_drake.prediction.noise import MarkovCovariance

__all__ = [
    "ANGLE",
    "CORRELATED",
    "FLAT",
    "SHIFT",
    "SHOWS",
    "WHITE",
    "Evidence",
    "Identifiability",
    "classes",
    "identifiability",
    "noise_scale",
    "shift_sizes",
    "short",
]

ANGLE = 20.0
"""Degrees below which two causes are of one class; see docs/results/identifiability.md."""
SHOWS = 3.0
"""Standard deviations that must be left of a cause of its prior size for it to show."""
SHIFT = 0.25
"""Plausible change of the logarithm of a base parameter."""
FLAT = 1e-9
"""Precision of base parameters before any data, relative to what the data say of them."""
CORRELATED, WHITE = 0.08, 0.035
"""Standard deviations of a force, N, of a part that is correlated over `TIME` and one that is not:
a good sensor, and food that is not even."""
TIME = 0.1
"""Correlation time of the noise, s."""
TORQUE = 0.08
"""Noise of a torque over that of a force, m."""
BIAS, DRIFT = 0.05, 0.01
"""What taring leaves, N, and how far it wanders in a record, N/s."""


class Evidence:
    """What records say of columns: their scalar products in the metric of the noise.

    Differences from slice to slice and the sensor's zero are integrated out with their plausible
    spread; columns with a coefficient for each record stand side by side.

    Attributes:
        found: Sensitivities.
        random, kept: Numbers of the columns that differ from slice to slice, and of the others.
        grams: Scalar products of the kept columns in each record [K', K'].
        taken: How much of each difference the kept columns look like, by record [n, K'].
    """

    def __init__(self, found: Sensitivities) -> None:
        self.found = found
        K = len(found.columns)
        self.random = found.index("record")
        self.kept = [k for k in range(K) if k not in set(self.random)]
        self._place = {k: j for j, k in enumerate(self.kept)}
        self.grams: list[np.ndarray] = []
        self.taken: list[np.ndarray] = []
        for record in found.records:
            self._add(record)

    def _add(self, record: RecordSensitivity) -> None:
        """Reduces one record to `grams` and `taken`."""
        m, c, _ = record.columns.shape
        columns = record.columns / noise_scale(record)[:, None]
        since = record.time - record.time[0]
        zero = np.zeros((m, c, 2 * c))
        for channel in range(c):
            zero[:, channel, channel] = BIAS
            zero[:, channel, c + channel] = DRIFT * since
        columns = np.concatenate(
            [columns[:, :, self.kept], columns[:, :, self.random], zero], axis=2
        )
        V = MarkovCovariance(np.diff(record.time), CORRELATED, TIME, WHITE)
        solved = np.stack([V.solve(columns[:, channel]) for channel in range(c)], axis=1)
        G = columns.reshape(m * c, -1).T @ solved.reshape(m * c, -1)
        n = len(self.kept)
        # Columns of what differs have the size of a standard deviation.
        inner = G[n:, n:] + np.eye(len(G) - n)
        taken = np.linalg.solve(inner, G[n:, :n])
        self.taken.append(taken)
        self.grams.append(np.asarray(G[:n, :n] - G[:n, n:] @ taken))

    def gram(self, columns: Sequence[int], records: Sequence[int]) -> np.ndarray:
        """Scalar products of columns over records; one for each record where its coefficient is."""
        sizes = [self._width([k], records) for k in columns]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        out = np.zeros((starts[-1], starts[-1]))
        at = np.array([self._place[k] for k in columns])
        for r, record in enumerate(records):
            rows = np.array([s + (r if n > 1 else 0) for s, n in zip(starts, sizes, strict=False)])
            out[np.ix_(rows, rows)] += self.grams[record][np.ix_(at, at)]
        return out

    def _width(self, columns: Sequence[int], records: Sequence[int]) -> int:
        """Coefficients of columns, over records."""
        return sum(len(records) if self.found.columns[k].per_record else 1 for k in columns)

    def left(
        self, sets: Sequence[Sequence[int]], free: Sequence[int], records: Sequence[int]
    ) -> tuple[np.ndarray, list[slice]]:
        """Scalar products of what `free` leaves of sets of columns, and where each set stands."""
        columns = [*free, *(k for s in sets for k in s)]
        G = self.gram(columns, records)
        n = len(free)
        X = G[:n, :n]
        X = X + FLAT * np.diag(np.maximum(np.diag(X), 1e-12))
        rest = G[n:, n:] - G[n:, :n] @ np.linalg.solve(X, G[:n, n:]) if n else G
        ends = np.cumsum([0, *(self._width(s, records) for s in sets)])
        places = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        return rest, places

    def sets(self, name: str) -> list[list[int]]:
        """Columns of a shift, or of a cause by the value of its scan."""
        found = self.found
        shift = found.index("base", name)
        return [shift] if shift else [found.index("cause", name, s) for s in found.scans(name)]

    def free(self, *but: str) -> list[int]:
        """Columns that are fitted beside: shifts but for some, and the discretisation."""
        base = [k for k in self.found.index("base") if self.found.columns[k].name not in but]
        return base + self.found.index("numerical")

    def shows(self, name: str, records: Sequence[int]) -> float:
        """Standard deviations left of a shift or cause, at the middle of its scan."""
        G, places = self.left(self.sets(name), self.free(name), records)
        return float(np.median([np.sqrt(max(np.trace(G[p, p]), 0.0)) for p in places]))

    def angle(self, a: str, b: str, records: Sequence[int]) -> float:
        """Between what is left of `a` and what `b` explains of it, degrees; for each value of a's
        scan b chooses its own, and the middle counts."""
        own, others = self.sets(a), self.sets(b)
        G, places = self.left([*own, *others], self.free(a, b), records)
        n = len(own)
        shares = [
            max(
                self._share(G, s, at, t, other) for t, other in zip(others, places[n:], strict=True)
            )
            for s, at in zip(own, places[:n], strict=True)
        ]
        return float(np.degrees(np.arccos(np.sqrt(np.median(shares)))))

    def _share(self, G: np.ndarray, a: list[int], at: slice, b: list[int], other: slice) -> float:
        """Fraction of the square of columns `a`, at some place in G, that `b` explain."""
        columns = self.found.columns
        if len(a) == len(b) == 1 and columns[a[0]].one_sided and columns[b[0]].one_sided:
            one = at.stop - at.start == other.stop - other.start == 1
            if one and G[at.start, other.start] <= 0.0:
                return 0.0
        return _share_explained(G, at, other)


def noise_scale(record: RecordSensitivity) -> np.ndarray:
    """Ratio of each channel's noise to that of a force [c]."""
    return np.array([TORQUE if c.startswith("torque") else 1.0 for c in record.channels])


def _share_explained(G: np.ndarray, a: slice, b: slice) -> float:
    """Fraction of the square of columns `a` that `b` explain, from their scalar products."""
    total = float(np.trace(G[a, a]))
    if total <= 0.0:
        return 0.0
    B = G[b, b]
    values, vectors = np.linalg.eigh(B)
    # A direction that does not show explains nothing that does.
    use = values > max(1e-3, 1e-9 * values.max(initial=0.0))
    W = vectors[:, use] / np.sqrt(values[use])
    return float(min(1.0, ((G[a, b] @ W) ** 2).sum() / total))


@dc.dataclass
class Identifiability:
    """What a protocol can tell.

    Attributes:
        names: Shifts of base parameters, then causes [n].
        shifts: How many of them are shifts.
        shows: Standard deviations that are left of each at its prior size [n].
        angles: Of what is left of the row's cause with what the column's explains, degrees [n, n].
    """

    names: list[str]
    shifts: int
    shows: np.ndarray
    angles: np.ndarray

    @property
    def visible(self) -> np.ndarray:
        """Which show [n]."""
        return self.shows >= SHOWS

    def equivalent(self, a: int, b: int) -> bool:
        """Whether two cannot be told apart: one explains the other."""
        return bool(min(self.angles[a, b], self.angles[b, a]) < ANGLE)

    def equivalence_class(self, name: str) -> list[str]:
        """All that cannot be told from a cause, itself first; of one that does not show, the shifts
        that take it up."""
        a = self.names.index(name)
        if not self.visible[a]:
            others = [b for b in range(self.shifts) if self.angles[a, b] < ANGLE]
        else:
            others = [
                b
                for b in range(len(self.names))
                if b != a and self.visible[b] and self.equivalent(a, b)
            ]
        return [name, *(self.names[b] for b in others if b != a)]


def identifiability(
    evidence: Evidence, causes: Sequence[Cause], records: Sequence[int]
) -> Identifiability:
    """What some of the records can tell of the causes of the sensitivities."""
    found = evidence.found
    shifts = [found.columns[k].name for k in found.index("base")]
    names = shifts + [c.name for c in causes]
    shows = np.array([evidence.shows(name, records) for name in names])
    shows[: len(shifts)] *= shift_sizes(found)
    angles = np.zeros((len(names), len(names)))
    for a, name in enumerate(names):
        for b, other in enumerate(names):
            if a != b:
                angles[a, b] = evidence.angle(name, other, records)
    return Identifiability(names, len(shifts), shows, angles)


def shift_sizes(found: Sensitivities) -> np.ndarray:
    """A plausible shift of each base parameter, in the sizes of its column."""
    return np.array([SHIFT / found.columns[k].size for k in found.index("base")])


def classes(result: Identifiability) -> list[list[str]]:
    """Groups of what shows and cannot be told apart, larger than one; they may overlap."""
    groups: list[list[str]] = []
    for a, name in enumerate(result.names):
        if result.visible[a]:
            members = sorted(result.equivalence_class(name), key=result.names.index)
            if len(members) > 1 and members not in groups:
                groups.append(members)
    return groups


def short(name: str) -> str:
    """A base parameter or cause as the tables name it."""
    return f"shift of {name.rsplit('.', 1)[-1].replace('youngs_', '')}" if "." in name else name
