"""One slice beside its fits, with and without a cause: what is drawn and tabulated of it."""

import dataclasses as dc

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity
from sliceit_drake.diagnosis.one_slice.slice_evidence import LEVEL, CauseInSlice, SliceEvidence
from sliceit_drake.diagnosis.one_slice.slice_fit import SliceFit

__all__ = ["MIN_GAIN", "FittedSlice"]

MIN_GAIN = 0.1
"""Least fraction of the error on left-out depth that such a cause removes."""


@dc.dataclass
class FittedSlice:
    """One slice beside its fits.

    Attributes:
        record: Measured, and predicted by the fit, with sensitivities there.
        evidence: Of all causes.
        fit: Without a cause.
        fits: With those that were confirmed, by name.
        block: Number of each row's block of depth.
    """

    record: RecordSensitivity
    evidence: SliceEvidence
    fit: SliceFit
    fits: dict[str, SliceFit]
    block: np.ndarray

    @property
    def supported(self) -> list[CauseInSlice]:
        """Causes that explain more than chance would, and predict depth that was left out."""
        before = self.error(self.fit.held_out)
        return [
            c
            for c in self.evidence.causes
            if c.p_value <= LEVEL
            and c.confirmed is not None
            and c.confirmed <= (1.0 - MIN_GAIN) * before
            and c.without_best <= 1.0 - MIN_GAIN
        ]

    @property
    def shown(self) -> int:
        """Number of the channel that figures and tables show."""
        channels = self.record.channels
        return channels.index("force_z") if "force_z" in channels else 0

    def error(self, predicted: np.ndarray, rows: np.ndarray | None = None) -> float:
        """RMS error of the forces of a prediction, N."""
        keep = [k for k, c in enumerate(self.record.channels) if c.startswith("force")]
        rest = (self.record.measured - predicted)[:, keep]
        compared = self.record.compared
        rest = rest[compared if rows is None else compared & rows]
        return float(np.sqrt((rest**2).sum(1).mean())) if len(rest) else 0.0

    def by_depth(self) -> list[tuple[str, int, float, float, float]]:
        """Rows of a table, for the air and each block of depth: name, number of rows, mean and RMS
        residual of the fit, RMS residual where the block was left out, N."""
        record, out = self.record, []
        depth = record.depth
        parts = [("before contact", ~record.in_contact & (depth <= 0.0))]
        for k in range(int(self.block.max()) + 1):
            rows = (self.block == k) & record.in_contact
            if rows.any():
                low, high = 1e3 * depth[rows].min(), 1e3 * depth[rows].max()
                parts.append((f"{low:.1f} to {high:.1f} mm", rows))
        channel = self.shown
        for name, rows in parts:
            if rows.any():
                rest = (record.measured - self.fit.predicted)[rows, channel]
                errors = self.error(self.fit.predicted, rows), self.error(self.fit.held_out, rows)
                out.append((name, int(rows.sum()), float(rest.mean()), *errors))
        return out
