"""Press and draw with the least force, by the gradient of the simulated slice.

The knife presses at constant speed v and draws by A sin(2 pi f t). What is minimised is the mean of
|F| over the depth, whose derivative by every pose of the knife the adjoint gives
(`cutting.gradient`); the rest is the chain rule. Scipy's SLSQP (Kraft 1988) minimises it under
constraints that are functions of A, f and v alone. It stops in local minima, so it begins at
several places, points of Halton's sequence.
"""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.gradient import SliceAdjoint, SliceRun
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import PressAndDraw

__all__ = [
    "MotionLimits",
    "Optimum",
    "mean_force",
    "mean_force_alone",
    "optimize_motion",
    "places",
]

SMOOTH = 0.05
"""Force below which |F| is rounded off, N."""
CLEARANCE = 1e-3
"""Height of the edge above the food at the start, metres."""
NAMES = ("amplitude", "frequency", "press_speed")


@dc.dataclass
class MotionLimits:
    """Limits of a slicing motion."""

    duration: float = quantity(3.0, "s", low=0.05, high=600.0)
    """Longest time of the cut."""
    draw_speed: float = quantity(0.15, "m/s", low=1e-4, high=2.0)
    """Greatest, along the edge."""
    draw_acceleration: float = quantity(2.0, "m/s2", low=1e-3, high=50.0)
    """Greatest, along the edge."""
    press_speed: list[float] = quantity([0.003, 0.1], "m/s", low=1e-4, high=1.0, size=2)
    """Least and greatest."""
    frequency: list[float] = quantity([0.2, 5.0], "Hz", low=1e-2, high=50.0, size=2)
    """Least and greatest."""
    margin: float = quantity(0.01, "m", low=0.0, high=0.5)
    """Length of edge that stays beyond the food at each end."""

    def amplitude(self, model: CuttingModel) -> float:
        """Greatest amplitude that keeps the food on the edge, m.

        Raises:
            ConfigurationError: The edge is shorter than the food is wide.
        """
        x = model.nodes[:, 0]
        reach = 0.5 * (model.knife.length - float(np.ptp(x))) - self.margin
        if reach <= 0.0:
            raise ConfigurationError(
                f"the food is {float(np.ptp(x)):.4g} m wide, the edge {model.knife.length:.4g} m "
                f"long with a margin of {self.margin:.4g} m at each end",
                field="knife.length",
                fix="Take a longer knife, or a smaller margin.",
            )
        return reach

    def ranges(self, model: CuttingModel) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest amplitude, m, frequency, Hz, and press speed, m/s [3].

        Raises:
            ConfigurationError: No motion keeps them.
        """
        height = _height(model)
        slowest = max(self.press_speed[0], height / self.duration)
        low = np.array([0.0, self.frequency[0], slowest])
        high = np.array([self.amplitude(model), self.frequency[1], self.press_speed[1]])
        if (low > high).any():
            raise ConfigurationError(
                f"{height:.4g} m in {self.duration:.4g} s need more than {high[2]:.4g} m/s",
                field="press_speed",
                fix="Allow more time or a greater speed.",
            )
        return low, high

    def motion(self, model: CuttingModel, shares: np.ndarray) -> PressAndDraw:
        """A motion within the limits.

        Args:
            model: The cut.
            shares: Of the amplitude that the frequency leaves, and of the ranges of frequency and
                press speed, by their logarithms [3]; 0 to 1.
        """
        low, high = self.ranges(model)
        f, v = (low[1:] * (high[1:] / low[1:]) ** shares[1:]).tolist()
        omega = 2.0 * np.pi * f
        most = min(high[0], self.draw_speed / omega, self.draw_acceleration / omega**2)
        height = _height(model)
        return PressAndDraw(
            press_speed=v, distance=height, amplitude=float(shares[0] * most), frequency=f
        )


def places(count: int) -> np.ndarray:
    """The middle, and points of Halton's sequence: where a search begins [count, 3]."""
    return np.vstack([np.full(3, 0.5), qmc.Halton(3, scramble=False).random(count)[1:]])


def _height(model: CuttingModel) -> float:
    return model.top - model.bottom + CLEARANCE


@dc.dataclass
class Optimum:
    """A motion and what led to it.

    Attributes:
        motion: The best.
        force: Mean of |F| over the depth with it, N.
        by_start: The same of the best from each place that was begun at, N.
        start_force: Mean force of the motion in the middle of what the limits allow, N.
        press_force: Mean force of a press of the same speed, without a draw, N.
        evaluations: Slices with gradients that were simulated.
        active: Limits that the motion touches.
        converged: Whether the optimiser ended by its own criterion, from where the best came.
    """

    motion: PressAndDraw
    force: float
    by_start: list[float]
    start_force: float
    press_force: float
    evaluations: int
    active: list[str]
    converged: bool


@dc.dataclass
class _Cut:
    """A press by a motion: times of the coupling steps' ends [E + 1], the slice, norms [E] of the
    food's force and their shares in the mean [E]."""

    time: np.ndarray
    run: SliceRun
    norm: np.ndarray
    share: np.ndarray


def _cut(adjoint: SliceAdjoint, motion: PressAndDraw) -> _Cut:
    model, period = adjoint.model, adjoint.exchange_period
    A, omega, v = motion.amplitude, 2.0 * np.pi * motion.frequency, motion.press_speed
    way = _height(model)
    coupling_steps = way / v / period
    time = period * np.arange(int(np.ceil(coupling_steps)) + 1)
    middle = 0.5 * float(model.nodes[:, 0].min() + model.nodes[:, 0].max())
    p = np.zeros((len(time), 3))
    p[:, 0] = middle + A * np.sin(omega * time)
    p[:, 2] = model.top + CLEARANCE - v * time
    # In C the edge points down and x stays along it.
    R = np.tile(np.diag([1.0, -1.0, -1.0]), (len(time), 1, 1))
    run = adjoint.run(R, p)
    norm = np.sqrt((run.wrenches[:, 3:] ** 2).sum(1) + SMOOTH**2)
    share = np.full(len(norm), v * period / way)
    # The last coupling step goes beyond the bottom.
    share[-1] *= coupling_steps - (len(norm) - 1)
    return _Cut(time, run, norm, share)


def mean_force_alone(adjoint: SliceAdjoint, motion: PressAndDraw) -> float:
    """`mean_force` without its derivatives."""
    cut = _cut(adjoint, motion)
    return float(cut.share @ cut.norm)


def mean_force(adjoint: SliceAdjoint, motion: PressAndDraw) -> tuple[float, np.ndarray]:
    """Mean over the depth of the norm of the food's force, and its derivatives.

    Args:
        adjoint: The cut and its gradients.
        motion: A press from `CLEARANCE` above the food to its bottom; its ramps are left out.

    Returns:
        Mean, N, and its derivatives by amplitude, frequency and press speed [3].

    Raises:
        CuttingError: The slice breaks down.
    """
    cut = _cut(adjoint, motion)
    A, omega, v = motion.amplitude, 2.0 * np.pi * motion.frequency, motion.press_speed
    weights = np.zeros_like(cut.run.wrenches)
    weights[:, 3:] = (cut.share / cut.norm)[:, None] * cut.run.wrenches[:, 3:]
    by_p = adjoint.gradient(cut.run, weights).position
    by_A = by_p[:, 0] @ np.sin(omega * cut.time)
    by_f = by_p[:, 0] @ (A * 2.0 * np.pi * cut.time * np.cos(omega * cut.time))
    value = float(cut.share @ cut.norm)
    # A coupling step's share grows with v, their number with 1 / v.
    by_v = -by_p[:, 2] @ cut.time + value / v - float(cut.norm[-1]) / v
    return value, np.array([by_A, by_f, by_v])


def optimize_motion(
    model: CuttingModel,
    limits: MotionLimits,
    period: float = 0.002,
    iterations: int = 30,
    starts: int = 3,
    progress: Callable[[int, float, PressAndDraw], None] | None = None,
) -> Optimum:
    """The press and draw with the least mean force.

    Args:
        model, limits: The cut, and what the motion may be.
        period: Coupling step period, s.
        iterations: Most of the optimiser, from each place.
        starts: Places to begin at: the middle of what the limits allow, and others.
        progress: Called with the number of slices, the best force so far, N, and its motion.

    Raises:
        ConfigurationError: No motion keeps the limits.
        CuttingError: A slice breaks down.
    """
    low, high = limits.ranges(model)
    search = _Search(SliceAdjoint(model, period), limits, low, high, progress)
    found = [search.begin(limits.motion(model, at), iterations) for at in places(starts)]
    force, motion, converged = min(found, key=lambda each: each[0])
    values = np.array([getattr(motion, name) for name in NAMES])
    active = [
        f"{name} {side}"
        for name, value, a, b in zip(NAMES, values, low, high, strict=True)
        for side, end in (("least", a), ("greatest", b))
        if abs(value - end) < 1e-3 * b
    ]
    names = ("draw_speed", "draw_acceleration")
    room = _room(values, limits)
    active += [name for name, left in zip(names, room, strict=True) if left < 1e-3]
    return Optimum(
        motion,
        force,
        [each[0] for each in found],
        search.first,
        mean_force_alone(search.adjoint, dc.replace(motion, amplitude=0.0)),
        search.count,
        active,
        converged,
    )


@dc.dataclass
class _Search:
    """The optimiser: how many slices it has simulated, the first one's force, and the best."""

    adjoint: SliceAdjoint
    limits: MotionLimits
    low: np.ndarray
    high: np.ndarray
    progress: Callable[[int, float, PressAndDraw], None] | None
    count: int = 0
    first: float = np.nan
    best: tuple[float, PressAndDraw] | None = None

    def begin(self, start: PressAndDraw, iterations: int) -> tuple[float, PressAndDraw, bool]:
        """Least force from a place, its motion, and whether the optimiser ended by itself."""
        # All three of the order of one.
        low, high, limits = self.low, self.high, self.limits
        best: tuple[float, PressAndDraw] = (np.inf, start)

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal best
            values = np.clip(x * high, low, high)
            motion = dc.replace(start, **dict(zip(NAMES, values.tolist(), strict=True)))
            force, slope = mean_force(self.adjoint, motion)
            if self.count == 0:
                self.first = force
            self.count += 1
            if force < best[0] and all(g >= -1e-6 for g in _room(values, limits)):
                best = force, motion
            if self.best is None or best[0] < self.best[0]:
                self.best = best
            if self.progress is not None:
                self.progress(self.count, *self.best)
            return force, slope * high

        result = minimize(
            objective,
            np.array([getattr(start, name) for name in NAMES]) / high,
            jac=True,
            method="SLSQP",
            bounds=list(zip(low / high, np.ones(3), strict=True)),
            constraints=[
                {"type": "ineq", "fun": lambda x, k=k: _room(x * high, limits)[k]} for k in range(2)
            ],
            options={"maxiter": iterations, "ftol": 1e-4},
        )
        return *best, bool(result.success)


def _room(values: np.ndarray, limits: MotionLimits) -> tuple[float, float]:
    """Fractions of draw speed and acceleration that are left."""
    A, omega = float(values[0]), 2.0 * np.pi * float(values[1])
    return 1.0 - A * omega / limits.draw_speed, 1.0 - A * omega**2 / limits.draw_acceleration
