"""Records that were nominally the same cut, and how their rows are brought to the same times."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity

__all__ = ["at_times", "replicates"]


def replicates(records: Sequence[RecordSensitivity]) -> dict[str, list[int]]:
    """Numbers of the records of each condition."""
    out: dict[str, list[int]] = {}
    for k, record in enumerate(records):
        out.setdefault(record.condition or record.name, []).append(k)
    return out


def at_times(values: np.ndarray, time: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Rows at other times, between those that there are.

    Args:
        values: Of the rows [m, ...].
        time: Of the rows [m], s.
        wanted: Times [n], s.

    Returns:
        [n, ...].
    """
    flat = values.reshape(len(values), -1)
    out = np.column_stack([np.interp(wanted, time, column) for column in flat.T])
    return out.reshape(len(wanted), *values.shape[1:])
