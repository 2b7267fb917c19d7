"""Global search by Optuna's tree-structured Parzen estimator, resumable and on many machines."""

import dataclasses as dc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import optuna
from optuna.trial import TrialState

from sliceit_drake.calibration.prediction import Prediction, Predictor
from sliceit_drake.calibration.storage import keeps_answering, open_storage
from sliceit_drake.configuration import ConfigurationError

__all__ = ["SearchResult", "error_of", "open_study", "search"]

GENERATION = 4
"""Trials that are proposed before any of them is known: they run side by side."""
BROKEN = 10.0
"""Error of a slice that breaks down at once, in root mean squares of the measured force."""


@dc.dataclass
class SearchResult:
    """What a search has found so far.

    Attributes:
        units: Places in the ranges of all finished trials [n, d].
        errors: Their root mean square errors [n], N; see `error_of` where a slice broke down.
        failures: Number of trials that broke down.
    """

    units: np.ndarray
    errors: np.ndarray
    failures: int

    def best(self, count: int) -> list[np.ndarray]:
        """The best places, a tenth of its range apart in at least one parameter."""
        chosen: list[np.ndarray] = []
        for k in np.argsort(self.errors, kind="stable"):
            unit = self.units[k]
            if all(np.abs(unit - other).max() >= 0.1 for other in chosen):
                chosen.append(unit)
            if len(chosen) == count:
                break
        return chosen


def open_study(storage: str | Path, name: str) -> optuna.Study:
    """Opens a study or begins it.

    Args:
        storage: As of `open_storage`.
        name: Of the study in the storage.

    Raises:
        ConfigurationError: The storage cannot be opened.
    """
    # Before the first study: Optuna reports each that it creates.
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(study_name=name, storage=open_storage(storage), load_if_exists=True)


@keeps_answering()
def search(
    predictor: Predictor,
    study: optuna.Study,
    trials: int,
    seed: int,
    progress: Callable[[int, float], None] | None = None,
    place: Callable[[Predictor, np.ndarray], np.ndarray] | None = None,
) -> SearchResult:
    """Runs generations of trials until the study holds `trials` finished ones or a few more.

    What is proposed depends on the finished trials and on the seed alone, so that a search that was
    killed goes on as if it had not been. With several workers on one storage it also depends on who
    was faster; give each its own seed.

    Args:
        study: From `open_study`.
        trials: Number of finished trials in the storage, those of all workers.
        progress: Called with the finished trials and the best error so far, N.
        place: Gives the place [d] of the first trial, from that of the setup's values.

    Raises:
        ConfigurationError: The study in the storage is of other parameters, or the storage failed.
    """
    names = [p.name for p in predictor.parameters]
    described = [f"{p.name} {p.low!r} {p.high!r} {p.log}" for p in predictor.parameters]
    known = study.user_attrs.get("parameters")
    if known is None:
        study.set_user_attr("parameters", described)
    elif known != described:
        raise ConfigurationError(
            f"the study {study.study_name!r} was begun with other parameters or ranges",
            field="--storage",
            fix="Give another --output or storage, or the same setup and records.",
        )
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in names
    }
    done = _finished(study)
    start = predictor.start
    if place is not None and len(done) < GENERATION:
        start = place(predictor, start)
    while len(done) < trials:
        # A database need not keep the order of a trial's parameters.
        known_units = {tuple(t.params[name] for name in names) for t in done[-GENERATION:]}
        # A generation that was cut short is proposed once more, and what it lacks is computed.
        proposed = _generation(space, start, seed, done)
        units = [u for u in proposed if tuple(u.tolist()) not in known_units]
        for unit, row in zip(units, predictor.predict(units), strict=True):
            error, broken = error_of(predictor, row)
            params = dict(zip(names, unit.tolist(), strict=True))
            study.add_trial(
                optuna.trial.create_trial(
                    params=params,
                    distributions=space,
                    value=error,
                    user_attrs={"broken": broken, "seed": seed},
                )
            )
        done = _finished(study)
        if progress is not None:
            progress(len(done), min(t.value for t in done if t.value is not None))
    return SearchResult(
        np.array([[t.params[name] for name in names] for t in done]),
        np.array([t.value for t in done]),
        sum(bool(t.user_attrs.get("broken")) for t in done),
    )


def _generation(
    space: dict[str, optuna.distributions.BaseDistribution],
    start: np.ndarray,
    seed: int,
    done: list[optuna.trial.FrozenTrial],
) -> list[np.ndarray]:
    """Places of the next generation [d], the same for the same finished trials and seed; the first
    generation begins with `start`.

    The sampler works on a study in memory, in which the storage's trials are repeated: what a
    worker that was killed had asked for is not in the way.
    """
    base = len(done) - len(done) % GENERATION
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            n_startup_trials=max(20, 4 * len(space)),
            multivariate=True,
            constant_liar=True,
            seed=(1000003 * seed + base) % 2**32,
        )
    study = optuna.create_study(sampler=sampler)
    study.add_trials(
        optuna.trial.create_trial(
            params={name: trial.params[name] for name in space},
            distributions=space,
            value=trial.value,
        )
        for trial in done[:base]
    )
    asked = [study.ask(space) for _ in range(GENERATION)]
    units = [np.array([t.params[name] for name in space]) for t in asked]
    if base == 0:
        units[0] = start.copy()
    return units


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def error_of(predictor: Predictor, row: list[Prediction]) -> tuple[float, bool]:
    """Root mean square error of predictions [N], and whether a slice broke down.

    A slice that broke down counts as `BROKEN` to twice that, the more the less was cut.
    """
    worst = [1.0 - p.cut for p in row if p.failure is not None]
    if not worst:
        return predictor.error(row), False
    scale = float(np.sqrt(np.mean(predictor.measured**2)))
    return BROKEN * scale * (1.0 + max(worst)), True
