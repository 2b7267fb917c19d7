"""What a calibrated food predicts for slice records: forces at their samples, derivatives."""

import copy
import dataclasses as dc
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag

from sliceit_drake.calibration.oscillation import Oscillation, fit_oscillation
from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.foods.distribution import from_unit, to_unit
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel, TimeStepError
from sliceit_drake.cutting.parameters import get_parameter, pull_back, with_parameters
from sliceit_drake.cutting.solver import NOT_FINITE, CuttingError
from sliceit_drake.prediction.clock import EXCHANGE_PERIOD, Clock
from sliceit_drake.prediction.placement import is_bare
from sliceit_drake.prediction.record_target import Meshing, RecordTarget, make_targets
from sliceit_drake.prediction.simulator import Job, JobResult, Simulator
from sliceit_drake.records.force_checks import flat_top
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["HEIGHT", "Parameter", "Prediction", "Predictor"]

NO_ADJOINT = ("effects.skin.thickness",)
"""Parameters whose derivative is taken by differences."""
STEP = 1e-3
"""Step of these differences, in the unit range."""
REFERENCE_STEP = 2.5e-5
"""Sub-step, and its double, that show what the usual one does wrong, s."""
KEPT = 300
"""Slices that are kept in memory: a step's Jacobian needs what its residuals have simulated."""
HEIGHT, SPEED = "height_offset", "speed_factor"


@dc.dataclass(frozen=True)
class Parameter:
    """An unknown of a calibration.

    Attributes:
        name: Dotted name of a shared one; "height_offset:NAME" and "speed_factor:NAME" are the
            record's.
        low, high: Range.
        log: Whether it is searched in its logarithm.
        start: Value before the calibration.
    """

    name: str
    low: float
    high: float
    log: bool
    start: float

    @property
    def shared(self) -> bool:
        """Whether it belongs to the food and not to one record."""
        return ":" not in self.name

    def value(self, unit: float) -> float:
        """The value at a place in the range."""
        return float(from_unit(unit, self.low, self.high, self.log))

    def slope(self, unit: float) -> float:
        """Derivative of the value by its place in the range."""
        if self.log:
            return float(self.value(unit) * np.log(self.high / self.low))
        return self.high - self.low

    def unit(self, value: float) -> float:
        """Place of a value in the range, within 0 and 1."""
        inside = min(max(value, self.low), self.high)
        return float(to_unit(inside, self.low, self.high, self.log))


@dc.dataclass
class Prediction:
    """Predicted and measured force at the samples of a record that are compared.

    Attributes:
        predicted: [m, channels], N; NaN where the slice broke down.
        cut: Fraction of the section that was cut at the end, or when the slice broke down.
        oscillation: That brings it nearest to the measurement; it is in `predicted`.
        smooth: The prediction without it [m, channels], N.
        failure: Why it broke down, or None.
    """

    predicted: np.ndarray
    cut: float
    oscillation: Oscillation
    smooth: np.ndarray
    failure: str | None


class Predictor:
    """Predicts the forces of records for values of the parameters, in unit ranges.

    Args:
        setup: Food and ranges.
        records: What is predicted.
        time_step: Sub-step of the food, s; that of the setup's numerics by default.
        precision: float32 or float64.
        workers: Threads.

    Raises:
        ConfigurationError: A record cannot be predicted, naming file and field.

    Attributes:
        targets: The records.
        parameters: What is searched.
        used, record_of, time, depth: Of each entry of `measured` [M]: whether it counts, index of
            its record, time in it, s, and depth of the edge, metres.
        conditions: Of each record. Records of one condition are replicates; "" is none.
        step_error: What is taken off the predictions [M], N; see `without_step_error`.
        step_unknown: Records whose error could not be found, so that nothing is taken off.
    """

    def __init__(
        self,
        setup: CalibrationSetup,
        records: Sequence[SliceRecord],
        time_step: float | None = None,
        precision: str = "float32",
        workers: int | None = None,
    ) -> None:
        if not records:
            raise ConfigurationError("no record is given", field="RECORD", fix="Name one.")
        if setup.bench != BenchErrors() or setup.food.effects.changes_force:
            raise ConfigurationError(
                "a calibration fits the force of the cut itself",
                field="bench" if setup.bench != BenchErrors() else "food.effects",
                fix="Leave out bench, effects.resting and effects.slice_push.pull: simulations and"
                " a diagnosis take them.",
            )
        self.setup = setup
        step = time_step or setup.numerics.time_step
        meshing = Meshing(1.0, step, precision, setup.numerics.device)
        for record in records:
            if is_bare(record):
                raise ConfigurationError(
                    "says that there is no food under the knife",
                    source=record.source,
                    field="food.name",
                    fix="Leave the record out of the calibration.",
                )
        # Forces are fitted, and on an even clock the solver has an adjoint.
        forces = [dc.replace(r, torque=None) for r in records]
        clock = Clock(longest=1)
        self.targets = make_targets(setup, forces, [meshing], clock, near_food=True)
        self.board = dc.replace(setup.board, height=0.0)
        self.parameters = self._list_parameters()
        sizes = [t.measured.size for t in self.targets]
        self.record_of = np.repeat(np.arange(len(sizes)), sizes)
        self.time, self.depth = map(self._by_entry, ("time", "depth"))
        # What a sensor at its limit shows is no force.
        clipped = [np.apply_along_axis(flat_top, 0, t.measured) for t in self.targets]
        self.used = ~np.concatenate([mask.ravel() for mask in clipped])
        self.conditions = [t.record.metadata.condition for t in self.targets]
        self.point_factors: dict[str, np.ndarray] = {}
        self.step_error = np.zeros(self.measured.size)
        self.step_unknown: list[str] = []
        self._simulator = Simulator(clock, self.board, workers=workers, kept=KEPT)
        self._adjoints: dict[int, SliceAdjoint] = {}

    def _list_parameters(self) -> list[Parameter]:
        model = next((t.model for t in self.targets if not t.facts.peeled), self.targets[0].model)
        out = []
        for p in self.setup.parameters:
            start = max(p.low, float(get_parameter(model, p.name)))
            out.append(Parameter(p.name, p.low, p.high, p.scale == "log", start))
        low, high = self.setup.height_offset
        slow, fast = self.setup.speed_factor
        for target in self.targets:
            name = target.record.name
            out.append(Parameter(f"{HEIGHT}:{name}", low, high, False, 0.0))
            if target.speed_unknown:
                out.append(Parameter(f"{SPEED}:{name}", slow, fast, False, 1.0))
        names = [p.name for p in out]
        if len(set(names)) < len(names):
            raise ConfigurationError(
                "two records have the same name", field="RECORD", fix="Rename one (metadata.name)."
            )
        return out

    @property
    def start(self) -> np.ndarray:
        """The setup's values, as places in the ranges [d]."""
        return self.places({})

    def places(self, values: Mapping[str, float]) -> np.ndarray:
        """Places in the ranges of values by name [d]; the setup's where there is none."""
        return np.array([p.unit(values.get(p.name, p.start)) for p in self.parameters])

    @property
    def measured(self) -> np.ndarray:
        """All measured channels of all records, in a row [M], N."""
        return np.concatenate([t.measured.ravel() for t in self.targets])

    def _by_entry(self, name: str) -> np.ndarray:
        return np.concatenate(
            [np.repeat(getattr(t, name), t.measured.shape[1]) for t in self.targets]
        )

    def values(self, unit: np.ndarray) -> dict[str, float]:
        """Values of the parameters by name, from places in their ranges [d]."""
        return {p.name: p.value(u) for p, u in zip(self.parameters, unit, strict=True)}

    def model(self, target: RecordTarget, values: Mapping[str, float]) -> CuttingModel:
        """The cut of a record with these values.

        Raises:
            TimeStepError: The step is beyond the limit and masses are not scaled.
        """
        shared: dict[str, float | np.ndarray] = {
            name: value for name, value in values.items() if ":" not in name
        }
        return target.as_cut(with_parameters(target.model, shared | self.point_factors))

    def with_point_factors(self, factors: Mapping[str, np.ndarray]) -> "Predictor":
        """The same predictor with factors of each cut point, by name as `POINT_PARAMETERS`.

        Raises:
            ConfigurationError: The records' foods differ, and with them the cut points.
        """
        if len({id(t.model.split) for t in self.targets}) > 1:
            raise ConfigurationError(
                "are of foods of different sizes or supports, whose cut points differ",
                field="RECORD",
                fix="Fit each point with records of one food alone.",
            )
        other = copy.copy(self)
        other.point_factors = dict(factors)
        return other

    def _positions(self, target: RecordTarget, values: Mapping[str, float]) -> np.ndarray:
        """Positions of Ko at the ends of the coupling steps [E + 1, 3] with these values."""
        name = target.record.name
        p = target.moved(values[f"{HEIGHT}:{name}"], values.get(f"{SPEED}:{name}", 1.0))
        return p[target.coupling_steps]

    def _job(self, target: RecordTarget, model: CuttingModel, values: Mapping[str, float]) -> Job:
        assert target.stretches is not None
        R, p = target.R[target.coupling_steps], self._positions(target, values)
        return Job(model, R, p, target.stretches, target.record.name, "float64")

    def predict(
        self, units: Sequence[np.ndarray], step: float | None = None, near: np.ndarray | None = None
    ) -> list[list[Prediction]]:
        """Forces at several places in the ranges, each [d]: for each, one prediction a record.

        Args:
            units: The places.
            step: Sub-step, s; the predictor's by default.
            near: Place whose sub-steps are taken, for differences from it; None for those by need.
        """
        jobs, failures = self._jobs(units, step)
        if near is not None:
            here = self._simulator.run(self._jobs([near], step)[0])
            for job, result in zip(jobs, itertools.cycle(here), strict=False):
                job.substeps = result.substeps
        results = self._simulator.run(jobs)
        parts = zip(itertools.cycle(self.targets), jobs, results, failures, strict=False)
        predictions = [self._prediction(*part) for part in parts]
        n = len(self.targets)
        return [predictions[k : k + n] for k in range(0, len(predictions), n)]

    def _jobs(
        self, units: Sequence[np.ndarray], step: float | None
    ) -> tuple[list[Job], list[str | None]]:
        """What `predict` simulates, and why it cannot, by place and record."""
        jobs, failures = [], []
        for unit in units:
            values = self.values(unit)
            for target in self.targets:
                model, failure = target.model, None
                try:
                    model = self.model(target, values)
                    model = model.with_step(step or model.numerics.time_step)
                except TimeStepError as error:
                    failure = str(error)
                jobs.append(self._job(target, model, values))
                failures.append(failure)
        return jobs, failures

    def _prediction(
        self, target: RecordTarget, job: Job, result: JobResult, failure: str | None
    ) -> Prediction:
        finite = np.isfinite(result.cut)
        cut = float(result.cut[finite][-1]) if finite.any() else 0.0
        if failure is None and not finite.all():
            failure = f"at {(int(finite.argmin()) + 1) * EXCHANGE_PERIOD:.4g} s {NOT_FINITE}"
        if failure is not None:
            nothing = np.full(target.measured.shape, np.nan)
            return Prediction(nothing, cut, Oscillation(), nothing, failure)
        p = job.p.copy()
        p[1:, 2] += result.rise
        wrench = result.parts.sum(1) + target.board(self.board, job.R, p)
        smooth = self._smooth(target, wrench[:, 3:])
        wave = self._oscillation(target, smooth)
        return Prediction(wave.factor(target.time)[:, None] * smooth, cut, wave, smooth, None)

    def _smooth(self, target: RecordTarget, force: np.ndarray) -> np.ndarray:
        """Channels at the rows [m, c] from forces of the coupling steps [E, 3], in F, N."""
        error = self.split(self.step_error)[self.targets.index(target)]
        return target.compare_forces(force) - error

    def without_step_error(self, unit: np.ndarray) -> "Predictor":
        """The same predictor less what its sub-step does wrong at a place [d].

        The scheme is of first order, so that forces at two small steps h and 2 h tell those at none
        (Richardson 1911): 2 f(h) - f(2 h). The error is taken to be the same near the place.
        """
        other = copy.copy(self)
        other.step_error = np.zeros(self.measured.size)
        rows = [other.predict([unit], s)[0] for s in (None, REFERENCE_STEP, 2.0 * REFERENCE_STEP)]
        usual, fine, double = (np.concatenate([p.smooth.ravel() for p in row]) for row in rows)
        error = usual - (2.0 * fine - double)
        other.step_error = np.nan_to_num(error)
        unknown = np.unique(self.record_of[np.isnan(error)])
        other.step_unknown = [self.targets[k].record.name for k in unknown]
        return other

    def _oscillation(self, target: RecordTarget, smooth: np.ndarray) -> Oscillation:
        if self.setup.oscillation is None:
            return Oscillation()
        low, high = self.setup.oscillation
        used = self.split(self.used)[self.targets.index(target)].astype(float)
        return fit_oscillation(target.time, smooth, target.measured, used, (low, high))

    def split(self, entries: np.ndarray) -> list[np.ndarray]:
        """Entries of `measured` [M] by record, each [m, channels]."""
        ends = np.cumsum([t.measured.size for t in self.targets])
        parts = np.split(entries, ends[:-1])
        return [x.reshape(t.measured.shape) for x, t in zip(parts, self.targets, strict=True)]

    def holding_out(self, held_out: np.ndarray) -> "Predictor":
        """The same predictor, fitting without these entries of `measured`, mask [M]."""
        other = copy.copy(self)
        other.used = self.used & ~held_out
        return other

    def error(self, row: Sequence[Prediction]) -> float:
        """Root mean square error over the entries that are used, N; NaN if a slice broke down."""
        residual = np.concatenate([p.predicted.ravel() for p in row]) - self.measured
        return float(np.sqrt(np.mean(residual[self.used] ** 2)))

    def mean_square_and_gradient(self, unit: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean square of the used residuals [N^2] at places [d], and its gradient by them.

        The gradient is exact (the adjoint, with the added inertia constant) but for `NO_ADJOINT`.

        Raises:
            CuttingError: A slice broke down.
        """
        square, gradient = self.mean_square_by(unit, list(self.values(unit)))
        slopes = np.array(
            [gradient[p.name] * p.slope(u) for p, u in zip(self.parameters, unit, strict=True)]
        )
        for k, parameter in enumerate(self.parameters):
            if parameter.name in NO_ADJOINT:
                slopes[k] = self._difference(unit, k)
        return square, slopes

    def mean_square_by(
        self, unit: np.ndarray, names: Sequence[str]
    ) -> tuple[float, dict[str, float | np.ndarray]]:
        """Mean square of the used residuals [N^2], and its derivatives in the parameters' units.

        Args:
            unit: Places in the ranges [d].
            names: Of `parameters` and `cutting.parameters.POINT_PARAMETERS`; the derivative by one
                of the latter is by the factor of each cut point [P], that by `NO_ADJOINT` 0.

        Raises:
            CuttingError: A slice broke down.
        """
        values = self.values(unit)
        gradient: dict[str, float | np.ndarray] = dict.fromkeys(names, 0.0)
        total, scale = 0.0, float(self.used.sum())
        for target, used in zip(self.targets, self.split(self.used), strict=True):
            model = self.model(target, values)
            job = self._job(target, model, values)
            path = KnifePath(model, job, 1.0)
            if id(model.split) not in self._adjoints:
                self._adjoints[id(model.split)] = SliceAdjoint(model, EXCHANGE_PERIOD)
            adjoint = self._adjoints[id(model.split)]
            run = adjoint.run(path.R_CK, path.p_CK, model)
            R_FC = model.X_FC_rotation
            board = target.board(self.board, job.R, job.p)
            force = run.wrenches[:, 3:] @ R_FC.T + board[:, 3:]
            smooth = self._smooth(target, force)
            factor = self._oscillation(target, smooth).factor(target.time)[:, None]
            residual = used * (factor * smooth - target.measured)
            total += float((residual**2).sum())
            of_force = target.adjoint(force, 2.0 * factor * residual / scale)
            back = adjoint.gradient(run, np.column_stack([0.0 * of_force, of_force @ R_FC]))
            shared = [n for n in names if ":" not in n and n not in NO_ADJOINT]
            if target.facts.peeled:
                shared = [n for n in shared if not n.startswith("effects.skin.")]
            for name, slope in pull_back(model, back, shared).items():
                gradient[name] = gradient[name] + slope
            for key in (f"{kind}:{target.record.name}" for kind in (HEIGHT, SPEED)):
                if key in names:
                    of_position = back.position @ R_FC.T
                    slope = self._by_motion(target, values, key, of_position, of_force)
                    gradient[key] = gradient[key] + slope
        return total / scale, gradient

    def _by_motion(
        self,
        target: RecordTarget,
        values: dict[str, float],
        key: str,
        of_position: np.ndarray,
        of_force: np.ndarray,
    ) -> float:
        """Derivative by a parameter of the motion, from those by Ko's positions and by the forces,
        both in F: of the latter the board has a part."""
        step = 1e-7 if key.startswith(HEIGHT) else 1e-5
        ends = []
        for sign in (1.0, -1.0):
            p = self._positions(target, values | {key: values[key] + sign * step})
            board = target.board(self.board, target.R[target.coupling_steps], p)
            ends.append((p, board[:, 3:]))
        dp = (ends[0][0] - ends[1][0]) / (2.0 * step)
        dF = (ends[0][1] - ends[1][1]) / (2.0 * step)
        return float((of_position * dp).sum() + (of_force * dF).sum())

    def _difference(self, unit: np.ndarray, k: int) -> float:
        """Derivative of the mean square by the k-th unit value, by differences."""
        ends = np.tile(unit, (2, 1))
        ends[:, k] = np.clip(unit[k] + STEP * np.array([1.0, -1.0]), 0.0, 1.0)
        squares = [self.error(row) ** 2 for row in self.predict(list(ends), near=unit)]
        return (squares[0] - squares[1]) / float(ends[0, k] - ends[1, k])

    def jacobian(
        self, unit: np.ndarray, step: float = 2e-3, free: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [M] and their derivatives by the unit values [M, d], by central differences.

        The oscillation is held. Steps that would leave a range are taken inwards. Derivatives by
        values that are not `free`, mask [d], are not computed, and zero.

        Raises:
            CuttingError: A slice breaks down there.
        """
        high, low = np.minimum(unit + step, 1.0), np.maximum(unit - step, 0.0)
        moved = self._moved_together()
        if free is not None:
            moved = [members for members in moved if free[members].any()]
        sets = []
        for members in moved:
            for end in (high, low):
                sets.append(np.where(np.isin(np.arange(len(unit)), members), end, unit))
        rows = self.predict([unit]) + self.predict(sets, near=unit)
        for p in itertools.chain(*rows):
            if p.failure is not None:
                raise CuttingError(f"a slice near the calibrated values: {p.failure}")
        factors = [
            p.oscillation.factor(t.time)[:, None]
            for p, t in zip(rows[0], self.targets, strict=True)
        ]
        flat = [
            np.concatenate([(f * p.smooth).ravel() for f, p in zip(factors, row, strict=True)])
            for row in rows
        ]
        columns = np.zeros((len(flat[0]), len(unit)))
        records = [t.record.name for t in self.targets]
        for g, members in enumerate(moved):
            difference = flat[1 + 2 * g] - flat[2 + 2 * g]
            for k in members:
                columns[:, k] = difference / (high[k] - low[k])
                if not self.parameters[k].shared:
                    record = self.parameters[k].name.split(":", 1)[1]
                    columns[self.record_of != records.index(record), k] = 0.0
        return flat[0] - self.measured, columns

    def _moved_together(self) -> list[list[int]]:
        """Parameters whose derivatives need one pair of predictions: those of different records."""
        groups: dict[str, list[int]] = {}
        for k, parameter in enumerate(self.parameters):
            groups.setdefault(parameter.name.split(":", 1)[0], []).append(k)
        return list(groups.values())

    def nuisance_jacobian(self, unit: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals by the oscillations' numbers [M, 3 records] or [M, 0]."""
        if self.setup.oscillation is None:
            return np.zeros((self.measured.size, 0))
        (row,) = self.predict([unit])
        slopes = [p.oscillation.derivatives(t.time) for p, t in zip(row, self.targets, strict=True)]
        by = [p.smooth[:, :, None] * d[:, None] for p, d in zip(row, slopes, strict=True)]
        return np.asarray(block_diag(*(x.reshape(-1, 3) for x in by)))
