"""How well records determine the parameters: posterior, and what they cannot tell."""

import dataclasses as dc
import itertools
from collections.abc import Callable

import numpy as np

from sliceit_drake.calibration.gauss_newton import (
    PRIOR_CENTER,
    PRIOR_VARIANCE,
    Fit,
    Linearisation,
    gauss_newton,
    linearise,
    residuals_at,
)
from sliceit_drake.calibration.prediction import HEIGHT, Predictor
from sliceit_drake.cutting.foods.distribution import (
    DETERMINED,
    PRIOR_DEVIATION,
    ParameterDistribution,
)
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.prediction.noise import NoiseModel, NoiseProblem, group_series

__all__ = ["FITS", "ROUNDS", "Estimate", "Posterior", "estimate"]

ROUNDS = 6
"""Most alternations of noise and parameters in a weighted fit."""
FITS = 5
"""Most weighted fits of an estimate."""
STEPS = 3
SETTLED = 0.1
"""Largest move, in standard deviations, with which the alternation of noise and fit ends."""
WORSE = 1.1
"""Error of the weighted fit over that of least squares from which on the noise is refuted."""
USUAL = 0.1
"""Relative standard deviation of the force between slices, before it is found."""
HEIGHTS = 21
"""Places within its range that each record's height is tried at."""
SLICES = 2.0
"""Standard deviations by which the force of a slice may be higher or lower than that of others."""
AT_END = 5e-3
"""Part of a range within which a value is at its end."""
CORRELATED = 0.9
SHARE = 0.3
"""Least part of a parameter in a direction for it to be named."""


@dc.dataclass
class Posterior(ParameterDistribution):
    """What records say of all parameters, those of single records included.

    Attributes:
        notes: What a reader must know.
    """

    notes: list[str] = dc.field(default_factory=list)

    def shared(self) -> ParameterDistribution:
        """The part of the parameters that belong to the food and not to one record."""
        own = [k for k, name in enumerate(self.names) if ":" not in name]
        return ParameterDistribution(
            names=[self.names[k] for k in own],
            low=[self.low[k] for k in own],
            high=[self.high[k] for k in own],
            log=[self.log[k] for k in own],
            mean=[float(self.mean[k]) for k in own],
            covariance=np.array(self.covariance)[np.ix_(own, own)].tolist(),
        )

    def correlated_pairs(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters with a correlation beyond 0.9 either way, strongest first."""
        C = np.array(self.covariance) / np.outer(self.deviation, self.deviation)
        rows, columns = np.triu_indices(len(C), 1)
        pairs = [
            (self.names[i], self.names[j], float(C[i, j]))
            for i, j in zip(rows, columns, strict=True)
            if abs(C[i, j]) > CORRELATED
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))

    def undetermined_directions(self) -> list[dict[str, float]]:
        """Directions in which the data say little, as the parts that parameters have in them.

        They are the principal axes of the covariance along which the standard deviation is above
        half of that of the range; parts are in places of the ranges, for a direction of length one.
        """
        values, vectors = np.linalg.eigh(np.array(self.covariance))
        out = []
        for variance, vector in zip(values[::-1], vectors.T[::-1], strict=True):
            if np.sqrt(max(variance, 0.0)) < DETERMINED * PRIOR_DEVIATION:
                break
            vector = vector * np.sign(vector[np.abs(vector).argmax()])
            out.append(
                {n: float(x) for n, x in zip(self.names, vector, strict=True) if abs(x) > SHARE}
            )
        return out

    def remarks(self) -> list[str]:
        """What the data do not determine, and the notes, as sentences."""
        known = self.determined()
        lines = [
            f"{name} is not determined by these data" for name, yes in known.items() if not yes
        ]
        named = set()
        for one, other, c in self.correlated_pairs():
            named.add(frozenset((one, other)))
            what = (
                "only a combination is determined"
                if not (known[one] and known[other])
                else "their combination is determined better than either"
            )
            lines.append(f"{one} and {other}: correlation {c:.3f}, {what}")
        for direction in self.undetermined_directions():
            if len(direction) > 1 and frozenset(direction) not in named:
                parts = ", ".join(f"{name} {part:+.2f}" for name, part in direction.items())
                lines.append(f"not determined together, in parts of their ranges: {parts}")
        return lines + self.at_ends() + self.notes

    def at_ends(self) -> list[str]:
        """Which parameters are at an end of their range, and what to do, as sentences."""
        lines = []
        for name, place, low, high in zip(self.names, self.mean, self.low, self.high, strict=True):
            if AT_END < place < 1.0 - AT_END:
                continue
            end, value, word = ("low", low, "less") if place < 0.5 else ("high", high, "more")
            own = name.split(":")[0] if ":" in name else f"{end} of {name} under parameters"
            lines.append(
                f"{name} is at the {end} end of its range, {value:.4g}: the force asks for {word}. "
                f"If the food can have {word}, move the setup's {own}; if not, the model lacks "
                "something else, and this parameter stands in for it"
            )
        return lines


@dc.dataclass
class Estimate:
    """The estimate of all parameters.

    Attributes:
        unit: Places in the ranges [d], those of the posterior's mean.
        posterior: Of the parameters.
        noise: Of the residuals.
        covariance: Of the parameters if `noise` were exact [d, d]; the posterior's allows for its
            uncertainty too.
    """

    unit: np.ndarray
    posterior: Posterior
    noise: NoiseModel
    covariance: np.ndarray


def estimate(
    model: Predictor,
    unit: np.ndarray,
    rounds: int = ROUNDS,
    progress: Callable[[int], None] | None = None,
) -> Estimate:
    """Fits parameters and noise in turn until the parameters rest.

    The parameters minimise the residuals weighted with the noise's covariance (generalised least
    squares) plus the prior of a uniform range, which has variance 1/12 about its middle: what the
    data do not determine stays as wide as its range. A model that lacks something leaves residuals
    that are no noise, and such weights then give up the force for its changes. Where that costs
    much of the force, which the posterior notes, the estimate stays `unit`, with the covariance
    that it has under these residuals. From the predictions of the weighted fit what the sub-step
    does wrong is taken off, where the fit begins and then where it ends. Beside what a model
    lacks that is small, or, where something snaps, so large that it is not the same near `unit`.

    Args:
        unit: The fit of least squares [d].
        rounds: Most alternations of a fit.
        progress: Called before each alternation with the number of those done, less than
            `FITS * rounds`.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    done = itertools.count()

    def show() -> None:
        if progress is not None:
            progress(next(done))

    start = np.clip(unit, 0.0, 1.0)
    usual, (first,) = model, residuals_at(model, [start])
    unknown = any(p.name.startswith(HEIGHT) for p in usual.parameters)
    place = start
    if unknown and _repeated(usual):
        place = _among_heights(usual, start, rounds, show)
    for _ in range(2):
        # Taken off anew where the fit ends, if that is elsewhere.
        model = usual.without_step_error(place)
        weighted = _weighted(model, place, rounds, show)
        at, problem, noise = weighted.at, weighted.problem, weighted.noise
        moved, place = at.unit - place, at.unit
        if (np.abs(moved) < SETTLED * np.sqrt(np.diag(problem.covariance()))).all():
            break
    errors = [_error(model, x, noise) for x in (first, at.residuals)]
    if errors[1] <= WORSE * errors[0]:
        posterior = _posterior(model, at.unit, problem.averaged_covariance(), noise)
        return Estimate(at.unit, posterior, noise, problem.covariance())
    even = noise.evened
    # As they are: with so few independent rows a fit with the prior would go to where it draws.
    at = linearise(usual, start)
    problem = _noise_problem(usual, at)
    noise = problem.fit(noise)
    covariance = problem.covariance_of_least_squares(even.variance)
    posterior = _posterior(usual, at.unit, covariance, noise)
    posterior.notes.append(
        f"the fit weighted with the noise misses the force by {errors[1]:.3g} N, least squares by "
        f"{errors[0]:.3g} N: the model lacks something that noise does not explain. The values are "
        "those of least squares, and the intervals count what is left as an error that goes on "
        "along the cut"
    )
    return Estimate(at.unit, posterior, noise, covariance)


@dc.dataclass
class _Weighted:
    """A fit weighted with its noise: where it is, its noise, and how that was found."""

    at: Linearisation
    problem: NoiseProblem
    noise: NoiseModel


def _weighted(
    model: Predictor, start: np.ndarray, rounds: int, show: Callable[[], None]
) -> _Weighted:
    """Fits parameters and noise in turn from a place [d]."""
    at = linearise(model, start)
    problem = _noise_problem(model, at)
    noise = problem.fit()
    for _ in range(rounds):
        show()
        fit = gauss_newton(
            model, at.unit, noise=noise, steps=STEPS, tolerance=1e-5, linearisation=at
        )
        moved = np.abs(fit.unit - at.unit) / np.sqrt(np.diag(problem.covariance()))
        at = _at_end(model, fit)
        problem = _noise_problem(model, at)
        noise = problem.fit(noise)
        if moved.max() < SETTLED:
            break
    return _Weighted(at, problem, noise)


def _repeated(model: Predictor) -> bool:
    """Whether some cut was repeated, so that it shows how slices differ."""
    named = [model.conditions[r] for r in np.unique(model.record_of[model.used])]
    return len({n for n in named if n}) < len([n for n in named if n])


def _among_heights(
    model: Predictor, start: np.ndarray, rounds: int, show: Callable[[], None]
) -> np.ndarray:
    """Places [d] of the most probable of several weighted fits.

    Least squares makes up with heights for what slices differ in, and waves of the force over the
    elements may hold them there.
    """
    best, place = _weighted(model, start, rounds, show), start
    for _ in range(2):
        try:
            other = _weighted(model, _with_heights(model, place), rounds, show)
            best = min(best, other, key=lambda each: each.problem.cost)
        except CuttingError:
            # At these heights a slice breaks down: the best so far stays.
            pass
        place = best.at.unit
    return place


def _with_heights(model: Predictor, unit: np.ndarray) -> np.ndarray:
    """Places [d] with each record's height where its force fits best, were it as strong as it has
    to be for that, within what is usual of slices."""
    # In the order of the records.
    own = [k for k, p in enumerate(model.parameters) if p.name.startswith(f"{HEIGHT}:")]
    places = np.linspace(0.0, 1.0, HEIGHTS)
    units = np.tile(unit, (HEIGHTS, 1))
    units[:, own] = places[:, None]
    out, reach = unit.copy(), SLICES * USUAL
    found = residuals_at(model, list(units))
    for record, k in enumerate(own):
        rows = model.used & (model.record_of == record)
        measured, errors = model.measured[rows], []
        for residuals in found:
            predicted = measured + residuals[rows]
            factor = (predicted @ measured) / max(float(predicted @ predicted), 1e-12)
            left = measured - np.clip(factor, 1.0 - reach, 1.0 + reach) * predicted
            errors.append(float(left @ left))
        if np.isfinite(errors).any():
            out[k] = places[int(np.nanargmin(errors))]
    return out


def _error(model: Predictor, residuals: np.ndarray, noise: NoiseModel) -> float:
    """Error of a fit with residuals [M], N, once each slice is as strong as slices may be."""
    left = residuals[model.used]
    for scale in noise.scales[model.used].T:
        reach = SLICES * (noise.record_scale or 0.0)
        factor = (scale @ left) / max(float(scale @ scale), 1e-12)
        left = left - np.clip(factor, -reach, reach) * scale
    return float(np.sqrt(np.mean(left**2)))


def _at_end(model: Predictor, fit: Fit) -> Linearisation:
    """The fit's linearisation, moved to its end: after a step that is small no new one is due."""
    at = fit.linearisation
    if fit.converged and np.array_equal(fit.unit, at.unit):
        return at
    if fit.converged:
        (residuals,) = residuals_at(model, [fit.unit])
        return Linearisation(fit.unit, residuals, at.jacobian, at.nuisance)
    return linearise(model, fit.unit)


def _noise_problem(model: Predictor, at: Linearisation) -> NoiseProblem:
    measured, used, record_of = model.measured, model.used, model.record_of
    conditions = model.conditions
    channels = [part.shape[1] for part in model.split(measured)]
    present = np.unique(record_of[used])
    predicted = np.where(used, at.residuals + measured, 0.0)
    members = present if _repeated(model) else present[:0]
    return NoiseProblem(
        group_series(used, model.time, record_of, channels, conditions),
        at.residuals,
        at.jacobian,
        at.nuisance,
        predicted[:, None] * (record_of[:, None] == members),
        PRIOR_CENTER - at.unit,
        PRIOR_VARIANCE,
        float(np.sqrt(np.mean(measured[used] ** 2))),
    )


def _posterior(
    model: Predictor, unit: np.ndarray, covariance: np.ndarray, noise: NoiseModel
) -> Posterior:
    parameters = model.parameters
    notes = []
    if noise.record_scale is None:
        notes.append(
            "no cut was repeated: how much slices differ is unknown, and the intervals hold for "
            "the slices that were measured"
        )
    if model.step_unknown:
        notes.append(
            f"{', '.join(model.step_unknown)}: breaks down with small sub-steps, so that the error "
            "of the usual ones is not known and not in the intervals"
        )
    return Posterior(
        names=[p.name for p in parameters],
        low=[float(p.low) for p in parameters],
        high=[float(p.high) for p in parameters],
        log=[p.log for p in parameters],
        mean=unit.tolist(),
        covariance=covariance.tolist(),
        notes=notes,
    )
