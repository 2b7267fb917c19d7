"""The linear problem of a diagnosis, reduced to moments: what records share, what is their own.

A record r is y_r = F_r b + E_r a_r + D_r d + C_r g + noise: y_r measured less predicted, F_r the
base parameters, E_r what differs from slice to slice (a_r normal, its variance estimated), D_r the
discretisation and what else the model may be off by in a known measure (d normal, known variance),
C_r the causes. The noise is that of `noise_levels`. All that the statistics need of a record is its
Gram matrix weighted with the inverse of the noise's covariance.
"""

import copy
import dataclasses as dc
import functools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from sliceit_drake.diagnosis.evidence.columns import (
    MESH,
    STEP,
    RecordSensitivity,
    Sensitivities,
    replicates,
)
from sliceit_drake.diagnosis.evidence.noise_levels import (
    ChannelNoise,
    differences,
    estimate_noise,
    in_air,
)
from sliceit_drake.diagnosis.evidence.searches import unlike_others
from sliceit_drake.prediction.discrepancy import (
    FINER,
    LESS,
    PRIOR,
    SHAPES,
    USUAL_SHARE,
    Covariates,
    Discrepancy,
    Sizes,
    Weighted,
    motion_shapes,
)

__all__ = [
    "PLAUSIBLE",
    "USUAL",
    "LinearProblem",
    "Model",
    "Moments",
    "angle_to",
    "beside",
    "fit_shared",
    "fitted_covariance",
    "integrate_out",
    "scaled_inverse",
    "wider",
]

USUAL = {
    ("sensor_delay", "delay"): (1e-3, False),
    **{("sensor_zero", f"bias_{a}"): (0.1, True) for a in "xyz"},
    **{("sensor_zero", f"drift_{a}"): (0.02, True) for a in "xyz"},
}
"""What every sensor has, by cause and parameter: usual standard deviation in its unit, and whether
that differs from record to record. Only more than that is a finding, or what should differ and is
the same in all records."""
SAME_SENSOR = 0.1
"""Share of that by which a sensor differs from what it was in records that were there before."""
SAME_LAW = 0.1
"""The same of what the simulation gets wrong by itself, where that is known from such records."""
FINE_MESH = 0.3
"""Standard deviation of the discretisation's error of each row, in that of the mesh column."""
SECOND_ORDER = 0.5
"""The same of a row by what is beyond the first order of a record's own values, in that."""
PLAUSIBLE = 2.0
"""Standard deviation of a cause's number before the data, in its size."""
TOLERANCE = 0.1
"""Of the gradient of the log-likelihood where sizes count as found."""
UNEVEN = ("in", "rest", "out", "again", "board")
"""Phases in which slices of a food are uneven: the first of `PHASES`. In the board too: what of a
slice is not parted yet is pressed on it."""
LITTLE = 0.1
"""Least share of the usual force of a channel that slices differ in."""
BETTER = 20.0
"""Twice the logarithm of the likelihood by which slices that are uneven have to be likelier."""
KEPT = 4
"""Sets of reduced Gram matrices that are kept, and of those without a discrepancy."""
THREADS = 2
"""That make the moments of records."""


@dc.dataclass
class Moments:
    """Gram matrices of all records, each over [columns, shapes of the discrepancy, y].

    Attributes:
        gram: [R, K + 1, K + 1], y last.
        force_gram: Of the force's components without weights, where the knife touches and the force
            does not jump [R, K + 1, K + 1], N^2.
        force_rows: Number of such rows of each record [R].
    """

    gram: np.ndarray
    force_gram: np.ndarray
    force_rows: np.ndarray


@dc.dataclass(frozen=True)
class Model:
    """What is fitted to records beside the discrepancy.

    Attributes:
        own: Numbers of the columns that are each record's own.
        variance: Of their coefficients.
        shared: Numbers of the columns that all records share.
        prior: Precisions of the coefficients of all columns [K].
    """

    own: list[int]
    variance: np.ndarray
    shared: list[int]
    prior: np.ndarray


class LinearProblem:
    """Moments of records, and the levels of noise and variation, which are estimated by default.

    Attributes:
        found: Sensitivities.
        may_be_uneven: Whether slices may differ along the cut beside noise.
        noise: Of each channel.
        differences: By which slices that are cut alike differ beside `own`, as if it were noise:
            the same where the food is not `uneven`.
        repeated: Whether the noise is from replicates.
        conditions: Numbers of the records of each condition.
        condition_of: Number of the condition of each record [R].
        base, own, numerical: Numbers of columns.
        mesh: Number of the column of the mesh; None without one, or where an error is known.
        usual: Numbers of columns of `USUAL` that all records share, and their standard deviations.
        usual_own: The same of those that are each record's own.
        shapes: Numbers of the columns appended for the discrepancy (`prediction.discrepancy`).
        shape_values: Values of the shapes in each record [m, n], the same for all channels.
        discrepancy: The model of it.
        sizes: Its sizes, causes left out.
        size: Number of all columns; y stands there.
        moments: Of the records.
        forces: Numbers of the channels that are forces.
        variation: Standard deviations of `own` from slice to slice [len(own)], in their sizes.
        uneven: Standard deviations of the coefficients of `shapes` from slice to slice, beside
            `own`: how uneven the food is [len(shapes)]; times `levels`. Where an error of the
            simulation is known from other slices, how these differed counts as well.
        levels: By which slices of a condition differ more or less than others, by channel [C, c].
        variation_samples: Number of independent differences that they were estimated from.
        near: Sizes of a problem like this one, with their `uncertainty`: the search for this one's
            begins there.
    """

    def __init__(
        self,
        found: Sensitivities,
        noise: Sequence[ChannelNoise] | None = None,
        variation: np.ndarray | None = None,
        uneven: np.ndarray | None = None,
        differences: Sequence[ChannelNoise] | None = None,
        may_be_uneven: bool = False,
    ) -> None:
        self.found, self.may_be_uneven = found, may_be_uneven
        self.base = found.index("base")
        self.own = found.index("record")
        # What step and mesh change is of the error that is known.
        gone = {STEP.name, MESH.name} if found.known_from else set()
        self.numerical = [k for k in found.index("numerical") if found.columns[k].name not in gone]
        of_mesh = (k for k in self.numerical if found.columns[k].name == MESH.name)
        self.mesh = next(of_mesh, None)
        self.conditions = replicates(found.records)
        of = {r: k for k, members in enumerate(self.conditions.values()) for r in members}
        self.condition_of = [of[r] for r in range(len(found.records))]
        self.usual, self.usual_own = self._usual()
        self._reduced: dict[tuple[tuple[int, ...], bytes], np.ndarray] = {}
        self._weighted: dict[tuple[tuple[int, ...], bytes, bytes], Weighted] = {}
        self._fits: dict[tuple[int, ...], tuple[Sizes, float]] = {}
        self._uncertain: dict[tuple[int, ...], np.ndarray] = {}
        self.near: tuple[Sizes, np.ndarray] | None = None
        self._make_shapes()
        # In the air slices do not differ.
        cut = [g for g in self.conditions.values() if found.records[g[0]].in_contact.any()]
        self._cut = [r for g in cut for r in g]
        self.variation_samples = len(self._cut) - len(cut)
        self._errors = self.errors
        self.uneven = np.zeros(len(self.shapes)) if uneven is None else uneven
        if noise is None:
            self.noise, self.repeated = self._estimate_noise(found.records, False)
        else:
            self.noise, self.repeated = tuple(noise), True
        self.differences = self.noise if differences is None else tuple(differences)
        if variation is None:
            self.variation, value, _ = self._estimate_variation(False)
            if may_be_uneven and self.variation_samples and self.own:
                plain = self.variation
                self.noise, _ = self._estimate_noise(found.records, True)
                self.variation, smooth, self.uneven = self._estimate_variation(True)
                if smooth > value - BETTER:
                    self.noise, self.variation = self.differences, plain
                    self.uneven = np.zeros(len(self.shapes))
            if found.known_from:
                by = wider(len(self._cut), found.known_from)
                self.variation, self.uneven = by * self.variation, by * self.uneven
        else:
            self.variation = variation
        if found.known_from:
            # How uneven slices are is not known better.
            prior = self.discrepancy.prior
            prior = dc.replace(prior, channel=prior.channel + np.log(SAME_LAW))
            self.discrepancy.prior = prior
        self._make_moments()

    def _usual(self) -> tuple[dict[int, float], dict[int, float]]:
        shared: dict[int, float] = {}
        own: dict[int, float] = {}
        for k, column in enumerate(self.found.columns):
            if (column.name, column.parameter) in USUAL:
                deviation, differs = USUAL[column.name, column.parameter]
                same = self.found.known_from and not differs
                deviation *= SAME_SENSOR if same else 1.0
                (own if differs else shared)[k] = deviation / column.size
        return shared, own

    def _make_shapes(self) -> None:
        """The discrepancy: its shapes, which have no coefficients yet."""
        found = self.found
        K, channels = len(found.columns), len(found.records[0].channels)
        reach = max(float(r.depth.max()) for r in found.records)
        self.shape_values = []
        squares = np.zeros(channels + 1)
        on_the_way_in = FINER if self.may_be_uneven else SHAPES["in"]
        for r in found.records:
            along = r.time, r.depth, r.path, r.in_contact
            values, phase = motion_shapes(*along, reach, r.height, on_the_way_in)
            self.shape_values.append(values)
            inside = r.predicted[r.in_contact]
            squares += np.append((inside**2).sum(0), len(inside))
        count = len(phase)
        self.shapes = list(range(K, K + channels * count))
        self.size = K + channels * count
        self.forces = found.records[0].forces
        mean = np.sqrt(squares[:-1] / max(squares[-1], 1.0))
        self.levels = self._levels(mean)
        force = np.linalg.norm(mean[self.forces])
        usual = np.where(np.isin(np.arange(channels), self.forces), force, mean)
        self.discrepancy = Discrepancy(
            self.shapes,
            np.repeat(np.arange(channels), count),
            np.tile(phase, channels),
            [k for k in range(self.size + 1) if k not in set(self.shapes)],
            [
                Covariates.of(r.time, r.depth, r.path)
                for r in (found.records[m[0]] for m in self.conditions.values())
            ],
            USUAL_SHARE * np.maximum(usual, 1e-3),
        )

    def _levels(self, mean: np.ndarray) -> np.ndarray:
        """Root mean square prediction of each condition over that of all, by channel [C, c]: slices
        differ by a share of the force. Where next to nothing is predicted, by a share of little; 0
        where nothing is cut."""
        out = np.zeros((len(self.conditions), len(mean)))
        for k, (first, *_) in enumerate(self.conditions.values()):
            record = self.found.records[first]
            if record.cut:
                inside = record.predicted[record.in_contact]
                own = np.sqrt((inside**2).mean(0))
                out[k] = np.maximum(own / np.maximum(mean, 1e-12), LITTLE)
        return out

    def _estimate_noise(
        self, records: Sequence[RecordSensitivity], uneven: bool
    ) -> tuple[tuple[ChannelNoise, ...], bool]:
        shapes = self.shape_values if uneven else None
        return estimate_noise(records, self.own, list(self.usual_own), shapes)

    def _make_moments(self) -> None:
        found = self.found
        self._calm = [self.calm(r) for r in found.records]
        with ThreadPoolExecutor(THREADS) as pool:
            grams = list(pool.map(self._moments_of, range(len(found.records))))
        self.moments = Moments(*map(np.array, zip(*grams, strict=True)))

    def _parts(
        self, record: RecordSensitivity, shapes: np.ndarray
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Of each channel its number, the numbers of the columns that it has and these [m, k], the
        residual last: a shape belongs to one channel."""
        K, n = len(self.found.columns), shapes.shape[1]
        for c in range(len(record.channels)):
            at = np.array([*range(K), *range(K + c * n, K + (c + 1) * n), self.size])
            X = np.column_stack([record.columns[:, c], shapes, record.residual[:, c]])
            yield c, at, X.astype(float)

    def _moments_of(self, number: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Gram matrices of a record with weights and of its force without, and its rows."""
        record, shapes = self.found.records[number], self.shape_values[number]
        gram = np.zeros((self.size + 1, self.size + 1))
        force_gram = np.zeros_like(gram)
        error, calm = self._errors[number], self._calm[number]
        for c, at, X in self._parts(record, shapes):
            # Many causes change few channels.
            changed = X.any(0)
            at, X = at[changed], X[:, changed]
            G = X.T @ self.noise[c].solve(record.time, X, error[:, c], record.near)
            gram[np.ix_(at, at)] += 0.5 * (G + G.T)
            if c in self.forces:
                force_gram[np.ix_(at, at)] += X[calm].T @ X[calm]
        return gram, force_gram, int(calm.sum())

    def _products_of(
        self, number: int, now: RecordSensitivity, at: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Some columns of `_moments_of` [K + 1, n] as a record is now, weights as they were."""
        products, of_force = np.zeros((2, self.size + 1, len(at)))
        error, calm = self._errors[number], self._calm[number]
        for c, columns, X in self._parts(now, self.shape_values[number]):
            noise, chosen = self.noise[c], np.searchsorted(columns, at)
            changed = X[:, chosen]
            products[columns] += X.T @ noise.solve(now.time, changed, error[:, c], now.near)
            if c in self.forces:
                of_force[columns] += X[calm].T @ changed[calm]
        return products, of_force

    def calm(self, record: RecordSensitivity) -> np.ndarray:
        """Rows in contact at which the force does not jump [m]."""
        kinks = record.kinks() < self.noise_of(record)
        return np.asarray(record.in_contact & kinks.all(1))

    def noise_of(self, record: RecordSensitivity) -> np.ndarray:
        """Standard deviation of the noise at each row [m, c]."""
        return np.column_stack([n.deviations(record.near) for n in self.noise])

    @property
    def slice_levels(
        self,
    ) -> tuple[tuple[ChannelNoise, ...], np.ndarray, np.ndarray, tuple[ChannelNoise, ...], bool]:
        """What was estimated of noise and slices, as `LinearProblem` takes it."""
        return self.noise, self.variation, self.uneven, self.differences, self.may_be_uneven

    @functools.cached_property
    def scales(self) -> list[np.ndarray]:
        """The noise with `model_error` at the rows of each record, each [m, c]."""
        records = zip(self.found.records, self.errors, strict=True)
        return [np.hypot(self.apart_by(r), error) for r, error in records]

    @functools.cached_property
    def errors(self) -> list[np.ndarray]:
        """`model_error` of each record, each [m, c]."""
        return [self.model_error(r) for r in self.found.records]

    @functools.cached_property
    def variances(self) -> list[np.ndarray]:
        """Of the noise and of what the model is unsure of at the rows of each record [m, c]."""
        records = zip(self.found.records, self.errors, strict=True)
        return [self.noise_of(r) ** 2 + error**2 for r, error in records]

    @functools.cached_property
    def rows_by_phase(self) -> list[np.ndarray]:
        """Rows of all records together at which the knife touches, for each phase of the motion."""
        records = self.found.records
        labels = np.concatenate([r.phase.astype(str) for r in records])
        touching = np.concatenate([r.in_contact for r in records])
        return [np.flatnonzero(touching & (labels == p)) for p in np.unique(labels[touching])]

    @functools.cached_property
    def shape_products(self) -> list[np.ndarray]:
        """Mean product of the shapes' values, two by two, over the rows of each `rows_by_phase`, in
        parts by the condition that these are of, each [C, n, n]."""
        values = np.concatenate(self.shape_values)
        lengths = [len(v) for v in self.shape_values]
        condition = np.repeat(self.condition_of, lengths)
        out = []
        for rows in self.rows_by_phase:
            parts = (values[rows[condition[rows] == k]] for k in range(len(self.conditions)))
            out.append(np.array([part.T @ part for part in parts]) / len(rows))
        return out

    def apart_by(self, record: RecordSensitivity) -> np.ndarray:
        """Standard deviation at each row by which slices that are cut alike differ, beside what
        they differ in as a whole: noise, and how uneven the food is [m, c]."""
        return np.column_stack([n.deviations(record.near) for n in self.differences])

    def with_noise_beside(
        self, columns: Sequence[int], coefficients: np.ndarray
    ) -> "LinearProblem":
        """The same problem, its moments as they are, with the noise estimated anew beside an effect
        that differs from record to record: replicates do not share it, so that it is in their
        noise.

        Args:
            columns: Numbers of the effect's columns [n].
            coefficients: Of the columns in each record [R, n].
        """
        out = copy.copy(self)
        out._forget("scales", "variances")
        records = [
            dc.replace(r, predicted=r.predicted + r.columns[:, :, list(columns)] @ g)
            for r, g in zip(self.found.records, coefficients, strict=True)
        ]
        out.differences, _ = self._estimate_noise(records, False)
        out.noise = out.differences
        if self.uneven.any():
            out.noise, _ = self._estimate_noise(records, True)
        return out

    def predicting(self, predicted: Sequence[np.ndarray]) -> "LinearProblem":
        """The same problem, weights included, about another prediction of each record [m, c]."""
        records = [
            dc.replace(record, predicted=values + record.not_simulated)
            for record, values in zip(self.found.records, predicted, strict=True)
        ]
        return self._with_records(records, [self.size])

    def correcting(
        self, records: Sequence[RecordSensitivity], columns: Sequence[int]
    ) -> "LinearProblem":
        """The same problem, weights included, of records in which only these columns differ."""
        return self._with_records(records, sorted(columns))

    def _with_records(
        self, records: Sequence[RecordSensitivity], changed: list[int]
    ) -> "LinearProblem":
        """Of records that differ in these columns alone; the residual is the last column."""
        out = copy.copy(self)
        out._forget("apart", "scales", "errors", "variances")
        out._reduced, out._weighted = {}, {}
        if () in self._fits:
            out.near = self.sizes, self.uncertainty()
        of_all = {*self.baseline, *self.own, *self.usual_own, self.size}
        seen = set(changed)
        kept = [k for k in self._fits if not (seen & {*k} or seen & of_all)]
        out._fits = {k: self._fits[k] for k in kept}
        out._uncertain = {k: self._uncertain[k] for k in kept if k in self._uncertain}
        gram, force_gram = self.moments.gram.copy(), self.moments.force_gram.copy()
        for r, now in enumerate(records):
            both = self._products_of(r, now, changed)
            for G, products in zip((gram[r], force_gram[r]), both, strict=True):
                G[:, changed], G[changed] = products, products.T
        out.found = dc.replace(self.found, records=list(records))
        out.moments = Moments(gram, force_gram, self.moments.force_rows)
        return out

    def _forget(self, *names: str) -> None:
        """Of a copy: cached properties of what it was copied from."""
        for name in names:
            vars(self).pop(name, None)

    @functools.cached_property
    def apart(self) -> "LinearProblem":
        """The problem of what each record does not share with its replicates."""
        rests = unlike_others(self.found.records)
        records = zip(self.found.records, rests, strict=True)
        return self.predicting([r.measured - rest - r.not_simulated for r, rest in records])

    def reduced(self, model: Model) -> np.ndarray:
        """Gram matrices with what is each record's own integrated out [R, K + 1, K + 1]."""
        own, variance = model.own, model.variance
        key = (tuple(own), variance.tobytes())
        if key not in self._reduced:
            if len(self._reduced) > KEPT:
                self._reduced.clear()
            gram = self.moments.gram
            self._reduced[key] = np.array(
                [integrate_out(G, own, self._own_variance(model, r)) for r, G in enumerate(gram)]
            )
        return self._reduced[key]

    def _own_variance(self, model: Model, record: int) -> np.ndarray:
        """Variance of the coefficients that are a record's own, in the order of `model.own`."""
        out, z = model.variance.copy(), int(np.count_nonzero(self.uneven))
        if z:
            channel = self.discrepancy.channel[self.uneven > 0.0]
            out[-z:] *= self.levels[self.condition_of[record]][channel] ** 2
        return out

    def by_condition(self, model: Model, without: int | None = None) -> list[np.ndarray]:
        """Sums of `reduced` over the records of each condition; one record may be left out."""
        reduced = self.reduced(model)
        kept = ([r for r in members if r != without] for members in self.conditions.values())
        return [reduced[np.array(members, int)].sum(0) for members in kept]

    @property
    def sizes(self) -> Sizes:
        """Of the discrepancy where no cause is at work."""
        return self.fitted_sizes()[0]

    def fitted_sizes(
        self, causes: Sequence[int] = (), start: Sizes | None = None
    ) -> tuple[Sizes, float]:
        """Sizes of the discrepancy with columns of causes in the model, and the logarithm of the
        restricted likelihood with the prior."""
        key = tuple(causes)
        if key not in self._fits:
            near = self.near
            if near is None and causes:
                near = self.sizes, self.uncertainty()
            first, covariance = near or (None, None)
            model = self.with_causes(causes)
            sizes, value = self.discrepancy.fit(
                self.by_condition(model),
                model.shared,
                model.prior[model.shared],
                start or first,
                TOLERANCE,
                covariance,
            )
            self._fits[key] = sizes, value - 0.5 * self.own_log_det(model)
        return self._fits[key]

    def uncertainty(self, causes: Sequence[int] = ()) -> np.ndarray:
        """Covariance of the logarithms of the sizes with columns of causes in the model."""
        key = tuple(causes)
        if key not in self._uncertain:
            sizes, _ = self.fitted_sizes(causes)
            model = self.with_causes(causes)
            self._uncertain[key] = self.discrepancy.uncertain(
                self.by_condition(model), sizes, model.shared, model.prior[model.shared]
            )
        return self._uncertain[key]

    def with_causes(self, causes: Sequence[int] = (), unusual: Sequence[int] = ()) -> Model:
        """The model with columns of causes, their coefficients normal with a standard deviation of
        `PLAUSIBLE` sizes, whatever is usual of them; of columns `unusual` nothing is usual."""
        kinds = self.found.columns
        free = [k for k in causes if kinds[k].per_record]
        added = [k for k in causes if not kinds[k].per_record]
        usual = {k: s for k, s in self.usual_own.items() if k not in unusual}
        uneven = np.flatnonzero(self.uneven)
        deviations = [*self.variation, *usual.values(), *([PLAUSIBLE] * len(free))]
        deviations += [*self.uneven[uneven]]
        prior = self.prior()
        prior[added] = 1.0 / PLAUSIBLE**2
        kept = [k for k in self.baseline if k not in (*added, *unusual)]
        own = [*self.own, *usual, *free, *(self.shapes[k] for k in uneven)]
        return Model(own, np.array(deviations, float) ** 2, [*kept, *added], prior)

    def own_log_det(self, model: Model) -> float:
        """Logarithm of the determinant by which what is each record's own widens their spread."""
        records = range(len(self.moments.gram))
        roots = np.sqrt([self._own_variance(model, r) for r in records])
        at = np.ix_(records, model.own, model.own)
        inner = np.eye(len(model.own)) + roots[:, :, None] * self.moments.gram[at] * roots[:, None]
        return float(np.linalg.slogdet(inner)[1].sum())

    def weighted(
        self, model: Model, sizes: Sizes | None = None, without: int | None = None
    ) -> Weighted:
        """Moments with what is each record's own and the discrepancy integrated out; one record may
        be left out."""
        sizes = self.sizes if sizes is None else sizes
        if without is not None:
            return Weighted(self.discrepancy, self.by_condition(model, without), sizes)
        key = tuple(model.own), model.variance.tobytes(), sizes.flat.tobytes()
        if key not in self._weighted:
            if len(self._weighted) > KEPT:
                self._weighted.clear()
            self._weighted[key] = Weighted(self.discrepancy, self.by_condition(model), sizes)
        return self._weighted[key]

    @property
    def baseline(self) -> list[int]:
        """Numbers of the columns that all records share and that are fitted in any case."""
        return [*self.base, *self.numerical, *self.usual]

    def prior(self) -> np.ndarray:
        """Precision of the columns' coefficients before the data [K]: 0 where nothing is known."""
        out = np.zeros(len(self.found.columns))
        out[self.numerical] = 1.0
        for k, deviation in self.usual.items():
            out[k] = 1.0 / deviation**2
        return out

    def _estimate_variation(self, uneven: bool) -> tuple[np.ndarray, float, np.ndarray]:
        """Variation of largest likelihood and prior from differences within conditions alone, minus
        twice the logarithm of both, and how uneven the food is, 0 if that is not wanted."""
        model, d = self.discrepancy, len(self.own)
        usual = np.array(list(self.usual_own.values()))
        first, z = d + len(usual), len(self.shapes) if uneven else 0
        if self.variation_samples == 0 or not self.own:
            return np.ones(d), 0.0, np.zeros(len(self.shapes))
        grams: list[np.ndarray] = []
        weights: list[float] = []
        log_det = 0.0
        for level, group in zip(self.levels, self.conditions.values(), strict=True):
            if len(group) > 1:
                of_group, determinants = self._difference_grams(group, uneven)
                scale = np.concatenate([np.ones(first), level[model.channel[:z]], [1.0]])
                grams += [scale[:, None] * G * scale for G in of_group]
                # Of n deviations from their mean n - 1 are independent.
                weights += [(len(group) - 1.0) / len(group)] * len(group)
                log_det += weights[-1] * determinants
        G, weight = np.array(grams), np.array(weights)
        channels, phases = len(self.noise) * uneven, (len(UNEVEN) - 1) * uneven
        channel_of = model.channel[:z]
        phase_of = np.minimum(model.phase[:z], len(UNEVEN) - 1)
        in_food = model.phase[:z] < len(UNEVEN)
        less = np.log(LESS)
        middle = np.append(np.zeros(d), model.prior.channel[:channels] + less)
        middle = np.append(middle, np.full(phases, less))
        spread = np.full(len(middle), PRIOR["phase"])
        spread[:d], spread[d : d + channels] = np.sqrt(20.0), PRIOR["channel"]

        def deviations(x: np.ndarray) -> np.ndarray:
            of_phase = np.append(0.0, x[d + channels :])
            shapes = np.exp(x[d : d + channels][channel_of] + of_phase[phase_of]) * in_food
            return np.concatenate([np.exp(x[:d]), usual, shapes])

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            s = deviations(x)
            A = np.eye(len(s)) + s[:, None] * G[:, :-1, :-1] * s
            inverse, log_dets = np.linalg.inv(A), np.linalg.slogdet(A)[1]
            b = s * G[:, :-1, -1]
            found = np.einsum("nij,nj->ni", inverse, b)
            away = (x - middle) / spread
            value = weight @ (log_dets + G[:, -1, -1] - (found * b).sum(1)) + away @ away
            by = 2.0 * weight @ (1.0 - np.diagonal(inverse, 0, 1, 2) - found**2)
            of_shapes = by[first:] * in_food
            of_channel = np.bincount(channel_of, of_shapes, channels)
            of_phase = np.bincount(phase_of, of_shapes, phases + 1)[1:]
            gradient = np.concatenate([by[:d], of_channel, of_phase])
            return float(value), gradient + 2.0 * away / spread

        ends = [(m - 5.0 * s, m + 3.0 * s) for m, s in zip(middle, spread, strict=True)]
        bounds = [(-4.0, 2.5)] * d + ends[d:]
        fit = minimize(objective, middle, jac=True, method="L-BFGS-B", bounds=bounds)
        found, none = deviations(fit.x), np.zeros(len(self.shapes))
        return found[:d], float(fit.fun) + log_det, found[first:] if uneven else none

    def _difference_grams(
        self, group: Sequence[int], uneven: bool
    ) -> tuple[list[np.ndarray], float]:
        """Gram matrices of what replicates do not share: own columns, shapes if they are wanted,
        and the difference; and the logarithm of the determinant of the noise in all of them."""
        n, members = len(group), [self.found.records[k] for k in group]
        own = [*self.own, *self.usual_own]
        d, size = len(own), len(own) + uneven * len(self.shapes)
        error, near = self.model_error(members[0]), ~in_air(members)[:, 0]
        out, log_det = [], 0.0
        for time, rest, columns in differences(members, own):
            m = len(time)
            shapes = self.shape_values[group[0]][:m]
            count = shapes.shape[1] if uneven else 0
            G = np.zeros((size + 1, size + 1))
            for c, noise in enumerate(self.noise):
                at = np.array([*range(d), *range(d + c * count, d + (c + 1) * count), size])
                scaled = np.sqrt(n / (n - 1.0)) * rest[:, c]
                X = np.column_stack([columns[:, c], shapes[:, :count], scaled])
                of_channel = X.T @ noise.solve(time, X, error[:m, c], near)
                G[np.ix_(at, at)] += 0.5 * (of_channel + of_channel.T)
                if self.may_be_uneven:
                    log_det += noise.log_det(time, error[:m, c], near)
            out.append(G)
        return out, log_det

    def model_error(self, record: RecordSensitivity) -> np.ndarray:
        """Standard deviation of what the model is unsure of at each row by itself [m, c]: when a
        force jumps, what a finer mesh still may change, and a spike of the sensor."""
        out = record.kinks()
        if record.doubt is not None:
            out = np.hypot(out, record.doubt)
        if self.mesh is not None:
            out = np.hypot(out, FINE_MESH * record.columns[:, :, self.mesh])
        if record.bent is not None:
            out = np.hypot(out, SECOND_ORDER * record.bent)
        return np.asarray(out)


def wider(slices: int, known_from: int) -> float:
    """Factor on the spread of slices about the mean of so many others, which differ as well."""
    return float(np.sqrt(1.0 + slices / known_from))


def scaled_inverse(A: np.ndarray, cutoff: float = 1e-10) -> np.ndarray:
    """Pseudo-inverse of a Gram matrix whose columns are of very different sizes."""
    scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=cutoff, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))


def fit_shared(total: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the columns that all records share [n], and their covariance [n, n].

    Args:
        total: Gram matrix of all columns, y last, from which what is each record's own and the
            discrepancy are integrated out.
        model: What is fitted.
    """
    columns = model.shared
    covariance = fitted_covariance(total, columns, model.prior)
    return covariance @ total[columns, -1], covariance


def fitted_covariance(G: np.ndarray, columns: list[int], prior: np.ndarray) -> np.ndarray:
    """Covariance of fitted coefficients [n, n], with precisions `prior` of all columns [K]."""
    return scaled_inverse(G[np.ix_(columns, columns)] + np.diag(prior[columns]))


def beside(G: np.ndarray, columns: list[int], prior: np.ndarray) -> np.ndarray:
    """Gram matrix of what columns that are fitted leave of all; see `fitted_covariance`."""
    return np.asarray(G - G[:, columns] @ fitted_covariance(G, columns, prior) @ G[columns])


def angle_to(
    G: np.ndarray, own: list[int], coefficients: np.ndarray, others: Iterable[list[int]]
) -> float:
    """Between a combination of columns `own` and all that one of other sets can do, degrees."""
    best = 0.0
    for columns in others:
        b = G[np.ix_(columns, own)] @ coefficients
        best = max(best, float(b @ scaled_inverse(G[np.ix_(columns, columns)], 1e-8) @ b))
    square = float(coefficients @ G[np.ix_(own, own)] @ coefficients)
    return float(np.degrees(np.arccos(np.sqrt(min(best / max(square, 1e-12), 1.0)))))


def integrate_out(G: np.ndarray, own: list[int], variance: np.ndarray) -> np.ndarray:
    """Gram matrix after normal coefficients of these columns are integrated out."""
    if not own:
        return G
    inner = G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12))
    factor = cho_factor(inner, check_finite=False)
    return np.asarray(G - G[:, own] @ cho_solve(factor, G[own], check_finite=False))
