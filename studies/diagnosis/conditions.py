"""What a protocol can tell of each cause, and which further condition would tell more."""

import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np

from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.experiments.identifiability import (
    CORRELATED,
    FLAT,
    WHITE,
    Evidence,
    Identifiability,
    identifiability,
    noise_scale,
    shift_sizes,
)

__all__ = ["ProtocolIdentifiability", "protocol_identifiability"]


@dc.dataclass
class ProtocolIdentifiability(Identifiability):
    """What a protocol can tell.

    Attributes:
        protocol: Its name.
        delta: What is left of each at its prior size, RMS over the rows in contact in the channel
            that has most, in standard deviations of a row's noise [n].
        split: For each, the condition from the menu that parts it best from the nearest other, with
            the angle then; None where there is none.
    """

    protocol: str
    delta: np.ndarray
    split: list[tuple[str, float] | None]

    def nearest(self, name: str) -> tuple[str, float] | None:
        """The cause that explains it best, and the angle, degrees."""
        a = self.names.index(name)
        angles = np.where(self.visible, np.minimum(self.angles[a], self.angles[:, a]), np.inf)
        angles[a] = np.inf
        b = int(angles.argmin())
        return (self.names[b], float(angles[b])) if np.isfinite(angles[b]) else None


def protocol_identifiability(
    evidence: Evidence,
    causes: Sequence[Cause],
    protocol: str,
    records: Sequence[int],
    menu: Mapping[str, Sequence[int]],
) -> ProtocolIdentifiability:
    """What some of the records can tell.

    Args:
        evidence: Of the protocol's records and those of the menu.
        causes: Those of the sensitivities.
        protocol: Its name.
        records: The protocol's.
        menu: Records that another condition would add, by its name.
    """
    told = identifiability(evidence, causes, records)
    delta = np.array([_delta(evidence, name, records) for name in told.names])
    delta[: told.shifts] *= shift_sizes(evidence.found)
    result = ProtocolIdentifiability(
        **vars(told), protocol=protocol, delta=delta, split=[None] * len(told.names)
    )

    def parted(a: str, b: str, records: Sequence[int]) -> float:
        """How well two are told apart: the angle; for a cause alone, what shows of it."""
        if not b:
            return evidence.shows(a, records)
        return min(evidence.angle(a, b, records), evidence.angle(b, a, records))

    for a, name in enumerate(told.names):
        nearest = result.nearest(name)
        if a < told.shifts or (nearest is None and told.visible[a]):
            continue
        other = nearest[0] if told.visible[a] and nearest else ""
        values = [(c, parted(name, other, [*records, *added])) for c, added in menu.items()]
        result.split[a] = max(values, key=lambda value: value[1], default=None)
    return result


def _delta(evidence: Evidence, name: str, records: Sequence[int]) -> float:
    """What is left of a shift or cause in contact, in the channel that has most of it."""
    found, free = evidence.found, evidence.free(name)
    n = len(free)
    values = []
    for columns in evidence.sets(name):
        G = evidence.gram([*free, *columns], records)
        X = G[:n, :n] + FLAT * np.diag(np.maximum(np.diag(G)[:n], 1e-12))
        taken = np.linalg.solve(X, G[:n, n:])
        squares, count, at = np.zeros(4), 0, 0
        starts = {}
        for k in columns:
            starts[k] = at
            at += len(records) if found.columns[k].per_record else 1
        for r, number in enumerate(records):
            rows = found.records[number].in_contact
            if not rows.any():
                continue
            for k in columns:
                j = starts[k] + (r if found.columns[k].per_record else 0)
                weights = np.concatenate([[1.0], -taken[:, j]])
                left = _remaining(evidence, number, [k, *free], weights)[rows]
                squares[: left.shape[1]] += (left**2).sum(0)
            count += int(rows.sum())
        values.append(float(np.sqrt((squares / max(count, 1)).max())))
    return float(np.median(values))


def _remaining(
    evidence: Evidence, number: int, columns: Sequence[int], weights: np.ndarray
) -> np.ndarray:
    """A combination of columns in a record, less what differs from slice to slice, in standard
    deviations of a row's noise [m, c]."""
    record = evidence.found.records[number]
    at = [evidence.kept.index(k) for k in columns]
    slices = evidence.taken[number][: len(evidence.random), at] @ weights
    total = record.columns[:, :, list(columns)] @ weights
    total = total - record.columns[:, :, evidence.random] @ slices
    return np.asarray(total / (noise_scale(record) * np.hypot(CORRELATED, WHITE)))
