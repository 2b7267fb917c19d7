"""The sensitivities of records, as data: what was measured, what is predicted, how that changes."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d

__all__ = [
    "MESH",
    "STEP",
    "CauseAtScan",
    "Column",
    "RecordSensitivity",
    "Sensitivities",
    "replicates",
]

NEAR = 3e-3
"""Height over the food below which a knife may touch: slices differ in height, metres."""
KINK_TIME = 0.02
"""By which the time of a jump of the force may be wrong, s."""
CauseAtScan = tuple[str, float | None]
"""Name of a cause, and the value of its scan; None without one."""


@dc.dataclass(frozen=True)
class Column:
    """What a column of sensitivities is.

    Attributes:
        kind: base, record, numerical or cause.
        name: Of the base parameter, the record's effect or the cause; "step" or "mesh".
        parameter: Of the cause; "" otherwise.
        scan: Value of the cause's scan; None without.
        size: Change of the parameter that the column belongs to.
        unit: Of it; "" for a logarithm.
        one_sided: Whether its coefficient cannot be negative.
        per_record: Whether each record has a coefficient of its own.
        searched, alone: `Cause.searched` and `Cause.alone`.
        low, high: Range of the parameter's distance from its null.
    """

    kind: str
    name: str
    parameter: str = ""
    scan: float | None = None
    size: float = 1.0
    unit: str = ""
    one_sided: bool = False
    per_record: bool = False
    searched: float = 0.0
    alone: bool = False
    low: float = -np.inf
    high: float = np.inf

    @property
    def label(self) -> str:
        """Name for people."""
        scan = "" if self.scan is None else f" at {self.scan:g}"
        return f"{self.name}.{self.parameter}{scan}" if self.parameter else self.name


STEP, MESH = Column("numerical", "step"), Column("numerical", "mesh")


@dc.dataclass
class RecordSensitivity:
    """One record: what was measured, what is predicted, and how that would change.

    Attributes:
        name, condition: Of the record.
        channels: Names of the channels [c].
        time: Of the rows [m], s.
        phase: Label at the rows [m].
        depth: Of the edge below the top of the food [m], metres.
        path: Way of the knife since the start [m], metres.
        in_contact: Whether food or board touch the knife [m].
        measured, predicted: [m, c], N and Nm.
        columns: Changes of the prediction [m, c, K].
        even: Even parts of the changes [m, c, K]; 0 where there is none.
        doubt: Standard deviation by which each measurement is doubted [m, c]; None for none.
        bent: Part of the prediction that is beyond the first order of what is the record's own
            (`own_values`) [m, c]; None where that was not looked at.
        known: Part of the prediction that no simulation has: what the food's file says that it gets
            wrong [m, c]; None for nothing.
        height: Depth at which the board is, metres; infinite where none is in reach.
        slice_index: Order of the slice in its session.
    """

    name: str
    condition: str
    channels: tuple[str, ...]
    time: np.ndarray
    phase: np.ndarray
    depth: np.ndarray
    path: np.ndarray
    in_contact: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    columns: np.ndarray
    even: np.ndarray
    doubt: np.ndarray | None = None
    bent: np.ndarray | None = None
    known: np.ndarray | None = None
    height: float = np.inf
    slice_index: int = 0

    @property
    def residual(self) -> np.ndarray:
        """Measured less predicted [m, c]."""
        return self.measured - self.predicted

    @property
    def not_simulated(self) -> np.ndarray | float:
        """Part of the prediction that a simulation of the mean slice does not have [m, c]."""
        parts = [part for part in (self.bent, self.known) if part is not None]
        return np.sum(parts, axis=0) if parts else 0.0

    @property
    def cut(self) -> bool:
        """Whether food is cut, not the bare board pressed or the knife moved in the air."""
        return bool(self.in_contact.any() and self.height > 0.0)

    @property
    def forces(self) -> list[int]:
        """Numbers of the channels that are forces."""
        return [k for k, name in enumerate(self.channels) if name.startswith("force")]

    @property
    def near(self) -> np.ndarray:
        """Whether the knife touches, or would in a slice that stands `NEAR` higher [m]."""
        return np.asarray(self.in_contact | (self.in_contact.any() & (self.depth > -NEAR)))

    @property
    def shown(self) -> int:
        """Number of the channel that figures and tables show."""
        return self.channels.index("force_z") if "force_z" in self.channels else 0

    def corrected(
        self, columns: Sequence[int], step: np.ndarray, change: np.ndarray
    ) -> "RecordSensitivity":
        """The record with columns that give what a step does (Broyden, Math. Comp. 19, 1965).

        Args:
            columns: Their numbers [n].
            step: In their sizes, not all 0 [n].
            change: Of the prediction by it [m, c], N and Nm.
        """
        out = self.columns.astype(float)
        missed = change - out[:, :, columns] @ step
        out[:, :, columns] += missed[:, :, None] * step / float(step @ step)
        return dc.replace(self, columns=out)

    def kinks(self) -> np.ndarray:
        """Largest second difference of the prediction within `KINK_TIME` of each row [m, c].

        Where the force jumps (the edge leaves the board, the knife turns round), a sample is as
        wrong as the jump is large if it comes a row too early; elsewhere this is next to nothing.
        """
        bend = np.zeros_like(self.predicted)
        bend[1:-1] = np.abs(np.diff(self.predicted, 2, axis=0))
        step = float(np.median(np.diff(self.time)))
        return np.asarray(maximum_filter1d(bend, 2 * round(KINK_TIME / step) + 1, axis=0))


@dc.dataclass
class Sensitivities:
    """Sensitivities of records to causes; see the module.

    Attributes:
        columns: What the columns are [K].
        records: One a record.
        warnings: Such as causes whose slices broke down: their column is 0 for that record.
        elements: Most tetrahedra of a slice's food.
        known_from: Number of the slices that an error that is known was learnt from.
    """

    columns: list[Column]
    records: list[RecordSensitivity]
    warnings: list[str] = dc.field(default_factory=list)
    elements: int = 0
    known_from: int = 0

    def index(self, kind: str, name: str | None = None, scan: float | None = None) -> list[int]:
        """Numbers of the columns of a kind; of a name, of a value of the scan, if given."""
        return [
            k
            for k, c in enumerate(self.columns)
            if c.kind == kind and name in (None, c.name) and scan in (None, c.scan)
        ]

    def of_causes(self, causes: Sequence[CauseAtScan]) -> list[int]:
        """Numbers of the columns of causes, one cause after the other."""
        return [k for name, scan in causes for k in self.index("cause", name, scan)]

    @property
    def causes(self) -> list[str]:
        """Names of the causes."""
        return list(dict.fromkeys(c.name for c in self.columns if c.kind == "cause"))

    def append(self, more: "Sensitivities") -> None:
        """Adds columns for the same records."""
        self.columns += more.columns
        self.warnings += more.warnings
        for record, added in zip(self.records, more.records, strict=True):
            record.columns = np.concatenate([record.columns, added.columns], axis=2)
            record.even = np.concatenate([record.even, added.even], axis=2)

    def scans(self, cause: str) -> list[float | None]:
        """Values of a cause's scan; [None] for one without."""
        return list(dict.fromkeys(self.columns[k].scan for k in self.index("cause", cause)))


def replicates(records: Sequence[RecordSensitivity]) -> dict[str, list[int]]:
    """Numbers of the records of each condition."""
    out: dict[str, list[int]] = {}
    for k, record in enumerate(records):
        out.setdefault(record.condition or record.name, []).append(k)
    return out
