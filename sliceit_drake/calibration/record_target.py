"""A record as a calibration compares it: the knife's way relative to the food, and its force."""

import dataclasses as dc

import numpy as np
from scipy.spatial.transform import Slerp

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.food import start_pose
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.prediction.placement import poses_in_food
from sliceit_drake.records.preprocessing import as_measured
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "EXCHANGE_PERIOD",
    "KnifeMotion",
    "RecordTarget",
]

EXCHANGE_PERIOD = 2e-3
"""Between two forces of the food, s."""
CLEARANCE = 5e-4
"""Height of the edge over the food below which rows are compared, beside the range of the record's
own height, metres."""
TURN_TRAVEL, TURN_TIME, STILL = 1e-3, 0.03, 2e-5
"""Where the knife turns round in the food, the rows that are not compared: until it is as far back,
metres, and for as long, s, counted from where it was last as deep but for `STILL`, metres. The
force turns round over some tenths of a millimetre, in which scaled masses err by half of it
(docs/stepping.md)."""


@dc.dataclass
class KnifeMotion:
    """A recorded motion at the exchanges, as `cutting.batch.simulate_batch` takes it.

    Attributes:
        R, p: Pose X_FK at the ends of the exchanges [E + 1, 3, 3] and [E + 1, 3], metres.
    """

    R: np.ndarray
    p: np.ndarray

    @property
    def duration(self) -> float:
        """In s."""
        return (len(self.p) - 1) * EXCHANGE_PERIOD

    def pose(self, t: float) -> Pose:
        """X_FK at the end of an exchange, s."""
        k = round(t / EXCHANGE_PERIOD)
        return Pose(self.R[k], self.p[k])


class RecordTarget:
    """One record: its motion relative to the food, and what of its force is compared.

    The force is compared by component in F where the record has them, else by its norm, in all rows
    from the first to the last in which the edge comes near the food: a prediction of zero above it
    is a prediction, but not where the knife turns round in the food. Prediction and measurement
    went through the same filters: `records.preprocessing.as_measured`.

    Args:
        record: The record.
        model: Its cut, with the parameters of the setup.
        setup: Of which the range of a record's height is used.

    Raises:
        ConfigurationError: The knife does not come near the food.

    Attributes:
        record, model: As given.
        time: Of the compared samples [m], s.
        measured: Force at them [m, channels], N; channels are x, y, z of F, or the norm.
        depth: Of the edge below the top of the cut at them [m], metres, as the record says.
        compared: Whether a sample is compared [m].
        by_norm: Whether only the norm is known.
        unknown_speed: Whether the speed of the motion is known but for a factor.
        operator: From forces of the exchanges to what would have been measured [m, E].
    """

    def __init__(self, record: SliceRecord, model: CuttingModel, setup: CalibrationSetup) -> None:
        self.record, self.model = record, model
        self.by_norm = record.force is None
        R_FW, rotation, p = poses_in_food(record, model)
        home = start_pose(model, 0.0)
        self.unknown_speed = "motion.speed" in record.metadata.unknown
        margin = CLEARANCE + max(abs(v) for v in setup.height_offset)
        height = p[:, 2] - home.p[2]
        low = np.flatnonzero(height < margin)
        if low.size == 0:
            raise ConfigurationError(
                f"the knife stays {1e3 * height.min():.3g} mm or more above the food",
                source=record.file or record.name,
                field="p_WK_z",
                fix="Correct food.position or the heights; both are in the world frame, in metres.",
            )
        self._first, self._last = max(low[0] - 1, 0), min(low[-1] + 1, len(p) - 1)
        self._contact = home.p
        self._start = float(record.time[self._first])
        # One more than there is time for: no sample lies beyond the last mean.
        count = int(np.ceil((record.time[self._last] - self._start) / EXCHANGE_PERIOD)) + 1
        self._times = self._start + EXCHANGE_PERIOD * np.arange(count + 1)
        at = np.minimum(self._times, record.time[-1])
        self._position = np.column_stack([np.interp(at, record.time, column) for column in p.T])
        self._rotation = Slerp(record.time, rotation)(at).as_matrix()
        self.time = record.time[self._first : self._last + 1]
        self.depth = -height[self._first : self._last + 1]
        self.compared = ~_turning(self.time, self.depth)
        if self.by_norm:
            self.measured = record.force_magnitude[self._first : self._last + 1, None]
        else:
            assert record.force is not None
            self.measured = R_FW.apply(record.force)[self._first : self._last + 1]
        self.operator = self._operator(count)

    def _operator(self, count: int) -> np.ndarray:
        """From means over exchanges to what would have been measured at the samples [m, count].

        Filters are linear, so that their effect on each exchange's force is all there is to know.
        """
        record, T = self.record, EXCHANGE_PERIOD
        before = int((self._start - record.time[0]) / T) + 2
        after = int(max(record.time[-1] - self._times[-1], 0.0) / T) + 2
        # A reading stands for the mean over the exchange that ends with it, as everywhere.
        ends = self._start + T * np.arange(1 - before, count + after + 1)
        series = np.zeros((len(ends), count))
        series[before : before + count] = np.eye(count)
        time, rows = as_measured(record.metadata, ends, series)
        at = np.searchsorted(time, self.time, side="right")
        low, high = np.clip(at - 1, 0, len(time) - 1), np.clip(at, 0, len(time) - 1)
        span = np.where(high > low, time[high] - time[low], 1.0)
        share = np.clip((self.time - time[low]) / span, 0.0, 1.0)[:, None]
        return (1.0 - share) * rows[low] + share * rows[high]

    def motion(self, height_offset: float, speed_factor: float) -> KnifeMotion:
        """The knife's motion in F where it stood lower by `height_offset` and moved faster."""
        p = self._contact + speed_factor * (self._position - self._contact)
        return KnifeMotion(self._rotation, p - np.array([0.0, 0.0, height_offset]))

    def compare(self, force: np.ndarray) -> np.ndarray:
        """Channels at the samples [m, channels] from forces of the exchanges [E, 3], N, in F."""
        seen = self.operator @ force
        return np.linalg.norm(seen, axis=1)[:, None] if self.by_norm else seen

    def rms_error(self, predicted: np.ndarray) -> float:
        """Root mean square over the compared samples of channels [m, channels], N."""
        rest = (predicted - self.measured)[self.compared]
        return float(np.sqrt(np.mean(rest**2)))

    def adjoint(self, force: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Adjoint of `compare` at `force`: of the channels [m, channels] to forces [E, 3]."""
        if self.by_norm:
            seen = self.operator @ force
            norm = np.maximum(np.linalg.norm(seen, axis=1), 1e-9)[:, None]
            weights = weights * seen / norm
        return np.asarray(self.operator.T @ weights)


def _turning(time: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Whether the knife has just turned back in the food, at samples [m] of its depth, metres."""
    turning, deepest, is_down = np.zeros(len(depth), bool), 0, True
    for k in range(len(depth)):
        if is_down == (depth[k] > depth[deepest]):
            deepest = k
        elif abs(depth[deepest] - depth[k]) > TURN_TRAVEL:
            if is_down and depth[deepest] > 0.0:
                bottom = np.flatnonzero(depth[deepest : k + 1] > depth[deepest] - STILL)
                first = deepest + int(bottom[-1])
                after = np.searchsorted(time, time[first] + TURN_TIME, side="right")
                turning[first : max(k, int(after))] = True
            deepest, is_down = k, not is_down
    return turning
