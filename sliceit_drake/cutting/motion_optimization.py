"""Press and draw with the least force, by the gradient of the simulated slice.

The knife presses at constant speed v and draws by A sin(2 pi f t). What is minimised is the mean of
|F| over the depth, whose derivative by every pose of the knife the adjoint gives
(`cutting.gradient`); the rest is the chain rule. Scipy's SLSQP (Kraft 1988) minimises it under
constraints that are functions of A, f and v alone.
"""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from sliceit_drake.configuration import ConfigurationError, quantity
from sliceit_drake.cutting.gradient import SliceAdjoint
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import PressAndDraw

__all__ = ["MotionLimits", "Optimum", "mean_force", "optimize_motion"]

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


@dc.dataclass
class Optimum:
    """A motion and what led to it.

    Attributes:
        motion: The best.
        force: Mean of |F| over the depth with it, N.
        start_force: Mean force of the motion at the start, N.
        press_force: Mean force of a press of the same speed, without a draw, N.
        evaluations: Slices with gradients that were simulated.
        active: Limits that the motion touches.
        converged: Whether the optimiser ended by its own criterion.
    """

    motion: PressAndDraw
    force: float
    start_force: float
    press_force: float
    evaluations: int
    active: list[str]
    converged: bool


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
    model, period = adjoint.model, adjoint.exchange_period
    A, omega, v = motion.amplitude, 2.0 * np.pi * motion.frequency, motion.press_speed
    way = model.top - model.bottom + CLEARANCE
    coupling_steps = way / v / period
    time = period * np.arange(int(np.ceil(coupling_steps)) + 1)
    middle = 0.5 * float(model.nodes[:, 0].min() + model.nodes[:, 0].max())
    p = np.zeros((len(time), 3))
    p[:, 0] = middle + A * np.sin(omega * time)
    p[:, 2] = model.top + CLEARANCE - v * time
    # In C the edge points down and x stays along it.
    R = np.tile(np.diag([1.0, -1.0, -1.0]), (len(time), 1, 1))
    run = adjoint.run(R, p)
    force = run.wrenches[:, 3:]
    norm = np.sqrt((force**2).sum(1) + SMOOTH**2)
    share = np.full(len(norm), v * period / way)
    # The last coupling step goes beyond the bottom.
    share[-1] *= coupling_steps - (len(norm) - 1)
    weights = np.zeros_like(run.wrenches)
    weights[:, 3:] = share[:, None] * force / norm[:, None]
    by_p = adjoint.gradient(run, weights).position
    by_A = by_p[:, 0] @ np.sin(omega * time)
    by_f = by_p[:, 0] @ (A * 2.0 * np.pi * time * np.cos(omega * time))
    value = float(share @ norm)
    # A coupling step's share grows with v, their number with 1 / v.
    by_v = -by_p[:, 2] @ time + value / v - float(norm[-1]) / v
    return value, np.array([by_A, by_f, by_v])


def optimize_motion(
    model: CuttingModel,
    limits: MotionLimits,
    period: float = 0.002,
    iterations: int = 30,
    progress: Callable[[int, float, PressAndDraw], None] | None = None,
) -> Optimum:
    """The press and draw with the least mean force, from the middle of what the limits allow.

    Args:
        model, limits: The cut, and what the motion may be.
        period: Coupling step period, s.
        iterations: Most of the optimiser.
        progress: Called with the number of slices, the best force so far, N, and its motion.

    Raises:
        ConfigurationError: No motion keeps the limits.
        CuttingError: A slice breaks down.
    """
    adjoint, reach = SliceAdjoint(model, period), limits.amplitude(model)
    height = model.top - model.bottom + CLEARANCE
    low = np.array([0.0, limits.frequency[0], max(limits.press_speed[0], height / limits.duration)])
    high = np.array([reach, limits.frequency[1], limits.press_speed[1]])
    if (low > high).any():
        raise ConfigurationError(
            f"{height:.4g} m in {limits.duration:.4g} s need more than {high[2]:.4g} m/s",
            field="press_speed",
            fix="Allow more time or a greater speed.",
        )
    f, v = (float(np.sqrt(low[k] * high[k])) for k in (1, 2))
    omega = 2.0 * np.pi * f
    A = 0.5 * min(high[0], limits.draw_speed / omega, limits.draw_acceleration / omega**2)
    start = PressAndDraw(press_speed=v, distance=height, amplitude=float(A), frequency=f)
    # All three of the order of one.
    scale = high
    best: list = [np.inf, start]
    count = 0

    def motion_at(x: np.ndarray) -> PressAndDraw:
        A, f, v = (np.clip(x * scale, low, high)).tolist()
        return dc.replace(start, amplitude=A, frequency=f, press_speed=v, distance=height)

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal count
        motion = motion_at(x)
        value, slope = mean_force(adjoint, motion)
        count += 1
        if value < best[0] and all(g >= -1e-6 for g in _room(x * scale, limits)):
            best[:] = value, motion
        if progress is not None:
            progress(count, best[0], best[1])
        return value, slope * scale

    x0 = np.array([getattr(start, name) for name in NAMES]) / scale
    start_force = mean_force(adjoint, motion_at(x0))[0]
    constraints = [
        {"type": "ineq", "fun": lambda x, k=k: _room(x * scale, limits)[k]} for k in range(2)
    ]
    result = minimize(
        objective,
        x0,
        jac=True,
        method="SLSQP",
        bounds=list(zip(low / scale, high / scale, strict=True)),
        constraints=constraints,
        options={"maxiter": iterations, "ftol": 1e-4},
    )
    force, motion = best
    values = np.array([getattr(motion, name) for name in NAMES])
    press = dc.replace(motion, amplitude=0.0)
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
        start_force,
        mean_force(adjoint, press)[0],
        count,
        active,
        bool(result.success),
    )


def _room(values: np.ndarray, limits: MotionLimits) -> tuple[float, float]:
    """Fractions of draw speed and acceleration that are left."""
    A, omega = float(values[0]), 2.0 * np.pi * float(values[1])
    return 1.0 - A * omega / limits.draw_speed, 1.0 - A * omega**2 / limits.draw_acceleration
