"""Fits one slice by simulation: base parameters, where the knife was, and a cause.

Least squares over all rows of one record, with the whole simulation in each step (Gauss-Newton on
differences), and the error on blocks of depth that were left out.
"""

import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import lsq_linear

from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.sensitivity import LINEAR_STEP, LOG_STEP
from sliceit_drake.diagnosis.prediction import ActiveCause, Point, SlicePredictor

__all__ = ["OWN", "SliceFit", "Unknown", "depth_blocks", "fit_slice"]

BLOCKS = 5
"""Of equal depth, each of which is left out in turn."""
STEPS = 8
HELD_OUT_STEPS = 2
AS_GOOD = 1.03
"""Ratio of sums of squares up to which two fits are as good."""
LONGEST = 6.0
"""Longest step of an unknown, in its sizes."""
ENOUGH = 1e-3
"""Relative gain below which a fit is at its end."""
NOISE = 0.1
"""Standard deviation of a row, against what is plausible beforehand, N."""
BASE_SPREAD = 0.5
"""Plausible standard deviation of the logarithm of a base parameter about its calibrated value."""


@dc.dataclass(frozen=True)
class Unknown:
    """A number that is fitted, counted from its start in its `size`.

    Attributes:
        kind: base, own (of the record) or cause.
        name: Dotted parameter, record effect, or parameter of the cause.
        size: Step of the differences, in the parameter's unit or its logarithm.
        start: Value at 0.
        log: Whether `size` is of the logarithm.
        low, high: Range, in sizes.
        spread: Plausible standard deviation about 0, in sizes.
    """

    kind: str
    name: str
    size: float
    start: float
    log: bool
    low: float
    high: float
    spread: float

    def value(self, theta: float) -> float:
        """The parameter."""
        if self.log:
            return float(self.start * np.exp(theta * self.size))
        return float(self.start + theta * self.size)


OWN = {"height": (1e-4, 2e-3), "speed": (0.01, 0.15)}
"""Step and plausible standard deviation of what a record does not say of its motion; m, log."""


def _unknowns(predictor: SlicePredictor, cause: Cause | None) -> list[Unknown]:
    """What is fitted: base parameters, where the knife was as far as it is unknown, a cause."""
    setup, (target,) = predictor.setup, predictor.targets
    model = target.models[predictor.meshings[0]]
    out = []
    for p in setup.parameters:
        start = float(get_parameter(model, p.name))
        if p.scale == "log":
            low, high = (float(np.log(v / start)) / LOG_STEP for v in (p.low, p.high))
            size, log, spread = LOG_STEP, True, BASE_SPREAD / LOG_STEP
        else:
            size, log = LINEAR_STEP * (p.high - p.low), False
            low, high = (p.low - start) / size, (p.high - start) / size
            spread = 0.25 * (p.high - p.low) / size
        # A calibration may have ended on the end of its range.
        low, high = min(low, -1e-6), max(high, 1e-6)
        out.append(Unknown("base", p.name, size, start, log, low, high, spread))
    ends = {}
    if target.height_unknown:
        ends["height"] = np.array(setup.height_offset)
    if target.speed_unknown:
        ends["speed"] = np.log(setup.speed_factor)
    for name, values in ends.items():
        size, spread = OWN[name]
        low, high = (values / size).tolist()
        out.append(Unknown("own", name, size, 0.0, False, low, high, spread / size))
    for q in cause.parameters if cause else ():
        low, high = sorted((bound - q.null) / q.step for bound in (q.low, q.high))
        out.append(Unknown("cause", q.name, q.step, q.null, False, low, high, 1e3))
    return out


@dc.dataclass
class SliceFit:
    """A fit of one slice.

    Attributes:
        unknowns: What was fitted [n].
        theta: In their sizes [n].
        point: Of the fit.
        predicted: At the rows [m, c].
        jacobian: Change of the prediction by each unknown at the fit [m, c, n].
        held_out: Prediction of each row from the fit without its block of depth [m, c].
    """

    unknowns: list[Unknown]
    theta: np.ndarray
    point: Point
    predicted: np.ndarray
    jacobian: np.ndarray
    held_out: np.ndarray

    def values(self, kind: str) -> dict[str, float]:
        """Values of a kind of unknowns."""
        pairs = zip(self.unknowns, self.theta, strict=True)
        return {u.name: u.value(float(x)) for u, x in pairs if u.kind == kind}


def depth_blocks(depth: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Number of each row's block of depth [m]; what is above the food belongs to the first.

    Args:
        depth: Of the edge in the food [m], metres.
        inside: Rows in contact [m].
    """
    edges = np.linspace(0.0, float(depth[inside].max()), BLOCKS + 1)
    return np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, BLOCKS - 1)


def fit_slice(
    predictor: SlicePredictor,
    block: np.ndarray,
    cause: Cause | None = None,
    scan: float | None = None,
    start: Mapping[str, float] | None = None,
) -> SliceFit:
    """Fits a slice, and predicts each block of depth from a fit to the others.

    What is the record's own stays as fitted to all of it: where the knife was is not what is
    predicted.

    Args:
        predictor: Of one record; the parameters of its setup are fitted.
        block: Number of each row's block [m].
        cause, scan: Fitted beside them.
        start: Places of unknowns to start from, by name, in their sizes.

    Raises:
        CuttingError: The slice breaks down where the fit begins.
    """
    fitter = _Fitter(predictor, _unknowns(predictor, cause), cause, scan)
    fitter.fit(start or {})
    held_out = np.empty_like(fitter.predicted)
    for number in np.unique(block):
        rows = block == number
        held_out[rows] = fitter.without(rows)[rows]
    return SliceFit(
        fitter.unknowns,
        fitter.theta,
        fitter.point(fitter.theta),
        fitter.predicted,
        fitter.jacobian,
        held_out,
    )


class _Fitter:
    """Gauss-Newton steps of one slice; its state is that of `SliceFit`."""

    def __init__(
        self,
        predictor: SlicePredictor,
        unknowns: list[Unknown],
        cause: Cause | None,
        scan: float | None,
    ) -> None:
        self.predictor, self.unknowns, self.cause, self.scan = predictor, unknowns, cause, scan
        (self.target,) = predictor.targets
        ranges = np.array([(u.low, u.high, u.spread) for u in unknowns])
        self.low, self.high, self.spread = ranges.T

    def point(self, theta: np.ndarray) -> Point:
        values: dict[str, dict[str, float]] = {"base": {}, "own": {}, "cause": {}}
        for u, x in zip(self.unknowns, theta, strict=True):
            values[u.kind][u.name] = u.value(float(x))
        causes: tuple[ActiveCause, ...] = ()
        if self.cause is not None:
            causes = (ActiveCause(self.cause, self.cause.nulls(self.scan) | values["cause"]),)
        return Point(values["base"], {self.target.facts.name: values["own"]}, causes)

    def predict(self, thetas: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Predictions at the rows [m, c]; not finite where the slice broke down."""
        out = []
        for (series,) in self.predictor.predict([self.point(t) for t in thetas]):
            assert series is not None
            out.append(self.target.compare(series.wrench[:, :, None])[:, :, 0])
        return out

    def cost(self, theta: np.ndarray, predicted: np.ndarray, rows: np.ndarray) -> float:
        """Sum of squares over some rows, with the prior; infinite for a slice that broke down."""
        if not np.isfinite(predicted).all():
            return np.inf
        rest = (self.target.measured - predicted)[rows].ravel() / NOISE
        return float(rest @ rest + ((theta / self.spread) ** 2).sum())

    def fit(self, start: Mapping[str, float]) -> None:
        """Fits all rows from places of unknowns."""
        theta = np.array([np.clip(start.get(u.name, 0.0), u.low, u.high) for u in self.unknowns])
        (predicted,) = self.predict([theta])
        everything = np.ones(len(self.target.time), bool)
        cost = self.cost(theta, predicted, everything)
        if not np.isfinite(cost):
            raise CuttingError(
                f"{self.target.facts.name}: the prediction broke down where its fit begins"
            )
        for _ in range(STEPS):
            self.jacobian = self.changes(theta, predicted)
            aim = self.refit(theta, predicted, everything, np.ones(len(theta), bool))
            tries, seen, costs = self.search(theta, aim, everything)
            best = int(np.argmin(costs))
            if not costs[best] < (1.0 - ENOUGH) * cost:
                break
            theta, predicted, cost = tries[best], seen[best], costs[best]
        self.theta, self.predicted = theta, predicted

    def without(self, rows: np.ndarray) -> np.ndarray:
        """The prediction by a fit to the other rows, with the derivatives of the fit to all.

        It begins where all rows were fitted, so that one that stayed there would have seen what it
        predicts. The first step is taken even where it makes the rest a little worse: as good a
        fit to the rest as it can tell, and one without the rows.
        """
        theta, predicted, others = self.theta, self.predicted, ~rows
        shared = np.array([u.kind != "own" for u in self.unknowns])
        cost = AS_GOOD * self.cost(theta, predicted, others)
        for _ in range(HELD_OUT_STEPS):
            aim = self.refit(theta, predicted, others, shared)
            tries, seen, costs = self.search(theta, aim, others)
            # The longest step that is nearly as good as the best one.
            best = int(np.argmax(np.array(costs) <= AS_GOOD * min(costs)))
            if not costs[best] < (1.0 - ENOUGH) * cost:
                break
            theta, predicted, cost = tries[best], seen[best], costs[best]
        return predicted

    def search(
        self, theta: np.ndarray, aim: np.ndarray, rows: np.ndarray
    ) -> tuple[list[np.ndarray], list[np.ndarray], list[float]]:
        """Places on the way to an aim, their predictions and their costs over some rows."""
        tries = [theta + share * (aim - theta) for share in (1.0, 0.5, 0.2)]
        seen = self.predict(tries)
        return tries, seen, [self.cost(t, p, rows) for t, p in zip(tries, seen, strict=True)]

    def changes(self, theta: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Change by each unknown, towards the side that has room [m, c, n]."""
        n = len(theta)
        sides = np.where(theta + 1.0 <= self.high, 1.0, -1.0)
        seen = self.predict([theta + sides[k] * np.eye(n)[k] for k in range(n)])
        out = np.zeros((*predicted.shape, n))
        for k, there in enumerate(seen):
            if np.isfinite(there).all():
                out[:, :, k] = sides[k] * (there - predicted)
        return out

    def refit(
        self, theta: np.ndarray, predicted: np.ndarray, rows: np.ndarray, free: np.ndarray
    ) -> np.ndarray:
        """One Gauss-Newton step over some rows and some unknowns, within their ranges."""
        A = self.jacobian[rows][:, :, free].reshape(-1, int(free.sum())) / NOISE
        b = (self.target.measured - predicted)[rows].ravel() / NOISE
        prior = np.diag(1.0 / self.spread[free])
        low = np.maximum(self.low, theta - LONGEST)[free] - theta[free]
        high = np.minimum(self.high, theta + LONGEST)[free] - theta[free]
        step = lsq_linear(
            np.vstack([A, prior]),
            np.concatenate([b, -theta[free] / self.spread[free]]),
            (np.minimum(low, -1e-9), np.maximum(high, 1e-9)),
        ).x
        out = theta.copy()
        out[free] += step
        return out
