"""Which causes a set of records can tell apart, before anything is measured.

The sensitivities of all causes, less what base parameters, differences from slice to slice and the
discretisation can take up, in units of the noise. What is left of a cause is how well it shows; the
angle between two is how well they can be told apart: a cause of n standard deviations that is
explained by another at an angle a leaves n sin(a) of them.
"""

import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, Sensitivities
from sliceit_drake.prediction.noise import NoiseModel, SeriesGroup

__all__ = [
    "ANGLE",
    "SHIFT",
    "SHOWS",
    "Evidence",
    "Identifiability",
    "NoiseLevel",
    "classes",
    "identifiability",
    "short",
]

ANGLE = 20.0
"""Degrees below which two causes are of one class; see docs/identifiability.md."""
SHOWS = 3.0
"""Standard deviations that must be left of a cause of its prior size for it to show."""
SHIFT = 0.25
"""Plausible change of the logarithm of a base parameter."""
FLAT = 1e-9
"""Precision of base parameters before any data, relative to what the data say of them."""


@dc.dataclass(frozen=True)
class NoiseLevel:
    """Noise that is taken for plausible: of a good sensor, and of food that is not even.

    Attributes:
        correlated, white: Standard deviations of the force, N, of a part that is correlated over
            `time`, s, and one that is not.
        torque: Of the torque's noise over the force's, m.
        bias, drift: What taring leaves, N, and how far it wanders in a record, N/s.
    """

    correlated: float = 0.08
    time: float = 0.1
    white: float = 0.035
    torque: float = 0.08
    bias: float = 0.05
    drift: float = 0.01

    def scale(self, channel: str) -> float:
        """Ratio of a channel's noise to that of a force."""
        return self.torque if channel.startswith("torque") else 1.0

    @property
    def total(self) -> float:
        """Standard deviation of the force, N."""
        return float(np.hypot(self.correlated, self.white))


class Evidence:
    """What records say of columns: their scalar products in the metric of the noise.

    Differences from slice to slice and the sensor's zero are integrated out with their plausible
    spread; columns with a coefficient for each record stand side by side.

    Args:
        found: Sensitivities.
        noise: Of the records.
    """

    def __init__(self, found: Sensitivities, noise: NoiseLevel | None = None) -> None:
        self.found, self.noise = found, noise or NoiseLevel()
        K = len(found.columns)
        self._random = found.index("record")
        self._kept = [k for k in range(K) if k not in set(self._random)]
        self._place = {k: j for j, k in enumerate(self._kept)}
        self.grams: list[np.ndarray] = []
        self._taken: list[np.ndarray] = []
        for record in found.records:
            self._add(record)

    def _add(self, record: RecordSensitivity) -> None:
        """Scalar products of the kept columns in one record [K', K'], and how much of each
        difference from slice to slice they look like."""
        m, c, _ = record.columns.shape
        scale = np.array([self.noise.scale(name) for name in record.channels])
        columns = record.columns / scale[:, None]
        since = record.time - record.time[0]
        zero = np.zeros((m, c, 2 * c))
        for channel in range(c):
            zero[:, channel, channel] = self.noise.bias
            zero[:, channel, c + channel] = self.noise.drift * since
        all_columns = np.concatenate(
            [columns[:, :, self._kept], columns[:, :, self._random], zero], axis=2
        )
        gap = np.diff(record.time)
        groups = [SeriesGroup(np.arange(m) * c + k, gap) for k in range(c)]
        ones = np.ones(c)
        model = NoiseModel(
            groups,
            ones * self.noise.correlated,
            ones * self.noise.time,
            ones * self.noise.white,
            None,
            np.zeros((m * c, 0)),
        )
        flat = all_columns.reshape(m * c, -1).astype(float)
        G = flat.T @ model.solve(flat)
        n = len(self._kept)
        # Columns of what differs have the size of a standard deviation.
        inner = G[n:, n:] + np.eye(len(G) - n)
        taken = np.linalg.solve(inner, G[n:, :n])
        self._taken.append(taken)
        self.grams.append(np.asarray(G[:n, :n] - G[:n, n:] @ taken))

    def gram(self, columns: Sequence[int], records: Sequence[int]) -> np.ndarray:
        """Scalar products of columns over records; one for each record where its coefficient is."""
        sizes = [len(records) if self.found.columns[k].per_record else 1 for k in columns]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        out = np.zeros((starts[-1], starts[-1]))
        at = np.array([self._place[k] for k in columns])
        for r, record in enumerate(records):
            rows = np.array([s + (r if n > 1 else 0) for s, n in zip(starts, sizes, strict=False)])
            out[np.ix_(rows, rows)] += self.grams[record][np.ix_(at, at)]
        return out

    def remaining(self, number: int, columns: Sequence[int], weights: np.ndarray) -> np.ndarray:
        """A combination of columns in a record, less what differs from slice to slice, in standard
        deviations of a row's noise [m, c]."""
        record = self.found.records[number]
        at = [self._place[k] for k in columns]
        slices = self._taken[number][: len(self._random), at] @ weights
        total = record.columns[:, :, list(columns)] @ weights
        total = total - record.columns[:, :, self._random] @ slices
        scale = np.array([self.noise.scale(name) for name in record.channels])
        return np.asarray(total / (scale * self.noise.total))

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
        widths = [
            sum(len(records) if self.found.columns[k].per_record else 1 for k in s) for s in sets
        ]
        ends = np.cumsum([0, *widths])
        places = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        return rest, places


def _share_explained(G: np.ndarray, a: slice, b: slice) -> float:
    """Fraction of the square of columns `a` that columns `b` explain, from their scalar
    products."""
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
        protocol: Its name.
        names: Shifts of base parameters, then causes [n].
        shifts: How many of them are shifts.
        shows: Standard deviations that are left of each at its prior size [n].
        delta: What is left of it, RMS over the rows in contact in the channel that has most, in
            standard deviations of a row's noise [n].
        angles: Of what is left of the row's cause with what the column's explains, degrees [n, n].
        split: For each, the nearest other, and the condition from the menu that parts them best
            with the angle then; None where there is none.
    """

    protocol: str
    names: list[str]
    shifts: int
    shows: np.ndarray
    delta: np.ndarray
    angles: np.ndarray
    split: list[tuple[str, float] | None]

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

    def nearest(self, name: str) -> tuple[str, float] | None:
        """The cause that explains it best, and the angle, degrees."""
        a = self.names.index(name)
        angles = np.where(self.visible, np.minimum(self.angles[a], self.angles[:, a]), np.inf)
        angles[a] = np.inf
        b = int(angles.argmin())
        return (self.names[b], float(angles[b])) if np.isfinite(angles[b]) else None


def identifiability(
    evidence: Evidence,
    causes: Sequence[Cause],
    protocol: str,
    records: Sequence[int],
    menu: Mapping[str, Sequence[int]],
) -> Identifiability:
    """What some of the records can tell.

    Args:
        evidence: Of the protocol's records and those of the menu.
        causes: Those of the sensitivities.
        protocol: Its name.
        records: The protocol's.
        menu: Records that another condition would add, by its name.
    """
    found = evidence.found
    base, numerical = found.index("base"), found.index("numerical")
    shifts = [found.columns[k].name for k in base]
    names = shifts + [c.name for c in causes]
    sets = {
        name: [found.index("base", name)] if name in shifts else _sets(found, name)
        for name in names
    }
    pairs = _Pairs(evidence, sets, base, numerical)
    angles, shows = pairs.angles(records)
    delta = np.array([_delta(evidence, sets[n], base, numerical, records) for n in names])
    size = np.array([SHIFT / found.columns[k].size for k in base])
    shows[: len(base)] *= size
    delta[: len(base)] *= size
    result = Identifiability(
        protocol, names, len(shifts), shows, delta, angles, [None] * len(names)
    )
    for a, name in enumerate(names):
        nearest = result.nearest(name)
        if a < len(shifts) or (nearest is None and result.visible[a]):
            continue
        other = nearest[0] if result.visible[a] and nearest else ""
        best: tuple[str, float] | None = None
        for condition, added in menu.items():
            value = pairs.value(name, other, [*records, *added])
            if best is None or value > best[1]:
                best = (condition, value)
        result.split[a] = best
    return result


def _sets(found: Sensitivities, cause: str) -> list[list[int]]:
    """Columns of a cause by the value of its scan."""
    return [found.index("cause", cause, scan) for scan in found.scans(cause)]


class _Pairs:
    """Angles between causes, each a choice of subspaces (by its scan)."""

    def __init__(
        self,
        evidence: Evidence,
        sets: Mapping[str, list[list[int]]],
        base: list[int],
        numerical: list[int],
    ) -> None:
        self.evidence, self.sets = evidence, sets
        self.base, self.numerical = base, numerical

    def _free(self, *but: str) -> list[int]:
        columns = self.evidence.found.columns
        return [k for k in self.base if columns[k].name not in but] + self.numerical

    def shows(self, name: str, records: Sequence[int]) -> float:
        """Standard deviations left of a cause, at the middle of its scan."""
        G, places = self.evidence.left(self.sets[name], self._free(name), records)
        return float(np.median([np.sqrt(max(np.trace(G[p, p]), 0.0)) for p in places]))

    def angle(self, a: str, b: str, records: Sequence[int]) -> float:
        """Between what is left of `a` and what `b` explains of it, degrees; for each value of a's
        scan b chooses its own, and the middle counts."""
        both = [*self.sets[a], *self.sets[b]]
        G, places = self.evidence.left(both, self._free(a, b), records)
        n = len(self.sets[a])
        shares = []
        for s, at in zip(both[:n], places[:n], strict=True):
            explained = [
                self._share(G, s, at, t, other)
                for t, other in zip(both[n:], places[n:], strict=True)
            ]
            shares.append(max(explained))
        return float(np.degrees(np.arccos(np.sqrt(np.median(shares)))))

    def _share(self, G: np.ndarray, a: list[int], at: slice, b: list[int], other: slice) -> float:
        columns = self.evidence.found.columns
        if len(a) == len(b) == 1 and columns[a[0]].one_sided and columns[b[0]].one_sided:
            one = at.stop - at.start == other.stop - other.start == 1
            if one and G[at.start, other.start] <= 0.0:
                return 0.0
        return _share_explained(G, at, other)

    def angles(self, records: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """All of them [n, n], and what shows [n]."""
        names = list(self.sets)
        shows = np.array([self.shows(name, records) for name in names])
        out = np.zeros((len(names), len(names)))
        for a, name in enumerate(names):
            for b, other in enumerate(names):
                if a != b:
                    out[a, b] = self.angle(name, other, records)
        return out, shows

    def value(self, a: str, b: str, records: Sequence[int]) -> float:
        """How well two are told apart: the angle; for a cause alone, what shows of it."""
        if not b:
            return self.shows(a, records)
        return min(self.angle(a, b, records), self.angle(b, a, records))


def _delta(
    evidence: Evidence,
    sets: list[list[int]],
    base: list[int],
    numerical: list[int],
    records: Sequence[int],
) -> float:
    """What is left of a cause in contact, in the channel that has most of it."""
    found = evidence.found
    own = {k for s in sets for k in s}
    free = [k for k in base if k not in own] + numerical
    values = []
    for columns in sets:
        G = evidence.gram([*free, *columns], records)
        n = len(free)
        X = G[:n, :n] + FLAT * np.diag(np.maximum(np.diag(G)[:n], 1e-12))
        taken = np.linalg.solve(X, G[:n, n:])
        squares, count, at = np.zeros(4), 0, 0
        starts = {}
        for k in columns:
            starts[k] = at
            at += len(records) if found.columns[k].per_record else 1
        for r, number in enumerate(records):
            record = found.records[number]
            rows = record.in_contact
            if not rows.any():
                continue
            for k in columns:
                j = starts[k] + (r if found.columns[k].per_record else 0)
                weights = np.concatenate([[1.0], -taken[:, j]])
                left = evidence.remaining(number, [k, *free], weights)[rows]
                squares[: left.shape[1]] += (left**2).sum(0)
            count += int(rows.sum())
        values.append(float(np.sqrt((squares / max(count, 1)).max())))
    return float(np.median(values))


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
