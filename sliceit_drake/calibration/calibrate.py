"""A calibration from records to a food: search, refinement, polish, uncertainty, held-out error."""

import dataclasses as dc
import functools
import hashlib
import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import numpy as np

from sliceit_drake.calibration.bands import force_band
from sliceit_drake.calibration.gauss_newton import gauss_newton
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.refine import Refinement, refine
from sliceit_drake.calibration.result import Calibration
from sliceit_drake.calibration.search import SearchResult, error_of, open_study, search
from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.calibration.uncertainty import FITS, ROUNDS, estimate
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.food import make_food_model
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.parameters import get_parameter
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "CalibrationOptions",
    "HeldOutError",
    "Progress",
    "blocked_error",
    "calibrate",
    "depth_blocks",
    "fingerprint",
    "values_of",
]

POLISH_STEPS = 10
"""Most steps of the fit from each place that was found."""
HELD_OUT_STEPS = 4
"""Most steps of a refit without a block of depth."""
PLACE_STEPS = 6
"""Most steps of a fit of the records' own heights and speeds."""
Progress = Callable[[str, int, int, float], None]
"""Called with what is done, steps done, steps in all, best error so far in N."""


@dc.dataclass
class CalibrationOptions:
    """Options of a calibration: how much is searched, from how many starts, with which seed.

    Attributes:
        trials, seed: Of the search.
        steps: Of Adam from each start.
        starts: The best places of the search that are refined, far from each other.
        workers: Processors to use.
        storage: Journal file or URL of the search, shared by many machines; None for a file in the
            output folder.
        blocks: Blocks of depth that are held out in turn; 0 for none.
        block_length: Depth of interleaved blocks, metres, see `blocked_error`; None for blocks that
            each are one piece.
        start: Values of shared parameters to polish in place of a search; None to search.
    """

    trials: int = 500
    steps: int = 100
    starts: int = 2
    seed: int = 0
    workers: int = 2
    storage: str | None = None
    blocks: int = 5
    block_length: float | None = None
    start: Mapping[str, float] | None = None


def calibrate(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    directory: Path,
    options: CalibrationOptions | None = None,
    held_out: Sequence[SliceRecord] = (),
    progress: Progress | None = None,
) -> Calibration:
    """Calibrates a food: TPE, Adam on the exact gradient from several starts, Gauss-Newton.

    Every stage goes on from what `directory` (or the storage) holds, so that a run that was killed
    loses at most one generation of trials or one step of Adam, and ends where it would have ended.

    Args:
        setup: Food and ranges.
        records: That are fitted.
        directory: For trials and checkpoints.
        options: How.
        held_out: Records that are predicted only.
        progress: See `Progress`.

    Raises:
        ConfigurationError: A record or the storage cannot be used.
        CuttingError: Nothing that was found can be cut.
    """
    options = options or CalibrationOptions()
    show = progress or (lambda *_: None)
    directory.mkdir(parents=True, exist_ok=True)
    # Before anything is computed: what is wrong with a record shall not show after hours.
    twice = {r.name for r in records} & {r.name for r in held_out}
    if twice:
        raise ConfigurationError(
            f"{', '.join(sorted(twice))} is fitted and held out",
            field="--hold-out",
            fix="Name a record once.",
        )
    others = Predictor(setup, held_out, workers=options.workers) if held_out else None
    predictor = Predictor(setup, records, workers=options.workers)
    if options.start is not None:
        found = _given(predictor, options.start)
        refinements = [Refinement(found.units[0], float(found.errors[0]), [])]
    else:
        problem = fingerprint(setup, records)
        storage = options.storage or directory / "trials.log"
        found = search(
            Predictor(setup, records, setup.search_time_step, workers=options.workers),
            open_study(storage, f"{setup.food.name}-{problem}"),
            options.trials,
            options.seed,
            lambda done, error: show("search", done, options.trials, error),
            _placed,
        )
        if not np.isfinite(found.errors).any():
            raise CuttingError("no trial of the search could be cut; widen the setup's ranges")
        refinements = _refine(setup, records, directory, options, found, problem, show)
    best = (np.inf, refinements[0].unit)
    steps = len(refinements) * POLISH_STEPS
    for k, refinement in enumerate(sorted(refinements, key=lambda r: r.error)):
        error = min(best[0], refinement.error)

        def step(taken: int, k: int = k, error: float = error) -> None:
            show("polish", k * POLISH_STEPS + taken, steps, error)

        unit = gauss_newton(predictor, refinement.unit, steps=POLISH_STEPS, progress=step).unit
        (row,) = predictor.predict([unit])
        error = predictor.error(row)
        if error < best[0]:
            best = (error, unit)
    show("polish", steps, steps, best[0])
    polished_rms, unit = best
    if not np.isfinite(polished_rms):
        raise CuttingError("what the search found breaks down at the setup's sub-step")
    rounds = FITS * ROUNDS
    estimated = estimate(
        predictor, unit, progress=lambda done: show("uncertainty", done, rounds, polished_rms)
    )
    show("uncertainty", rounds, rounds, polished_rms)
    unit, posterior = estimated.unit, estimated.posterior
    (predictions,) = predictor.predict([unit])
    rms = predictor.error(predictions)
    band = force_band(predictor, unit)
    blocks: list[float] = []
    held_out_rms = None
    if options.blocks:
        result = blocked_error(
            predictor,
            unit,
            options.blocks,
            options.block_length,
            lambda done: show("held-out blocks", done, options.blocks, rms),
        )
        blocks, held_out_rms = result.blocks, result.rms
    return Calibration(
        predictor,
        unit,
        predictions,
        rms,
        float(found.errors.min()),
        min(r.error for r in refinements),
        polished_rms,
        posterior,
        band,
        blocks,
        held_out_rms,
        {} if others is None else _held_out(others, predictor, unit),
        found.failures,
    )


def values_of(food: CalibratedFood) -> dict[str, float]:
    """The values of a calibrated food's parameters, for `CalibrationOptions.start`."""
    model = make_food_model(food.food, food.knife, Numerics())
    return {name: float(get_parameter(model, name)) for name in food.distribution.names}


def _given(predictor: Predictor, start: Mapping[str, float]) -> SearchResult:
    """The place of given values, as if a search had found it.

    Raises:
        CuttingError: It cannot be cut.
    """
    unit = _placed(predictor, predictor.places(start))
    (row,) = predictor.predict([unit])
    error, broken = error_of(predictor, row)
    if broken:
        raise CuttingError("the food that was given breaks down on these records")
    return SearchResult(unit[None], np.array([error]), 0)


def _placed(predictor: Predictor, unit: np.ndarray) -> np.ndarray:
    """The same values of the food [d], with the heights and speeds of the records that suit them,
    where a record does not know its speed: what is known of a food from elsewhere says nothing of
    where such a knife was."""
    own = np.array([not p.shared for p in predictor.parameters])
    if not any(target.speed_unknown for target in predictor.targets):
        return unit
    try:
        return gauss_newton(predictor, unit, free=own, steps=PLACE_STEPS).unit
    except CuttingError:
        return unit


def fingerprint(setup: CalibrationSetup, records: Sequence[SliceRecord]) -> str:
    """What tells a calibration's checkpoints from another's: setup and data."""
    digest = hashlib.sha256(repr(setup).encode())
    for record in records:
        digest.update(repr(record.metadata).encode())
        for series in (record.time, record.position, record.rotation, record.force_magnitude):
            digest.update(np.ascontiguousarray(series).tobytes())
    return digest.hexdigest()[:12]


def _refine(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    directory: Path,
    options: CalibrationOptions,
    found: SearchResult,
    problem: str,
    show: Progress,
) -> list[Refinement]:
    starts = found.best(options.starts)
    if options.steps == 0:
        return [Refinement(start, float(found.errors.min()), []) for start in starts]
    jobs = [
        (setup, list(records), start, options.steps, directory / f"adam-{problem}-{k}.npz")
        for k, start in enumerate(starts)
    ]
    workers, total = min(options.workers, len(jobs)), options.steps * len(jobs)
    if workers == 1:
        out = []
        for k, job in enumerate(jobs):

            def note(done: int, error: float, before: int = k * options.steps) -> None:
                show("Adam", before + done, total, error)

            out.append(_refined(*job, note))
        return out
    spawned = multiprocessing.get_context("spawn")
    with spawned.Manager() as manager, worker_processes(workers) as pool:
        steps = manager.dict()
        futures = [
            pool.submit(_refined, *job, functools.partial(_note, steps, k))
            for k, job in enumerate(jobs)
        ]
        while not all(f.done() for f in futures):
            wait(futures, timeout=0.5)
            done = dict(steps)
            if done:
                best = min(error for _, error in done.values())
                show("Adam", sum(n for n, _ in done.values()), total, best)
        return [f.result() for f in futures]


def _refined(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    start: np.ndarray,
    steps: int,
    checkpoint: Path,
    progress: Callable[[int, float], None],
) -> Refinement:
    """Adam from a start, on one thread: here or in a process of its own."""
    return refine(Predictor(setup, records, workers=1), start, steps, checkpoint, progress)


def _note(shared: Any, k: int, done: int, error: float) -> None:
    """Tells the process that shares a dict how far the k-th start is."""
    shared[k] = (done, error)


def depth_blocks(model: Predictor, blocks: int, length: float | None = None) -> np.ndarray:
    """Number of the block of depth of each entry of the measurement [M].

    Args:
        blocks: How many; what lies above the food belongs to the first.
        length: Of interleaved blocks, m, of which every `blocks`-th has the same number; without
            it each number is one piece of equal depth.
    """
    if length is not None:
        return np.maximum(np.floor(model.depth / length), 0).astype(int) % blocks
    edges = np.linspace(0.0, float(model.depth[model.used].max()), blocks + 1)
    numbers = np.searchsorted(edges, model.depth, side="right") - 1
    return np.asarray(np.clip(numbers, 0, blocks - 1))


@dc.dataclass
class HeldOutError:
    """Errors on blocks of the data, each from a fit without it.

    Attributes:
        blocks: Root mean square error on each, N; NaN where the refitted slice broke down.
        counts: Entries in each.
        rms: On all of them, N.
    """

    blocks: list[float]
    counts: list[int]
    rms: float


def blocked_error(
    model: Predictor,
    unit: np.ndarray,
    blocks: int = 5,
    length: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> HeldOutError:
    """Holds out blocks of depth in turn, in all records at once.

    Neighbouring samples share their error, so that samples held out one by one would be predicted
    by their neighbours; a block must be predicted by the physics. Interleaved blocks ask how well
    the fit fills gaps of a length; blocks in one piece, how well it predicts a part of the food
    that no data have seen. What is a record's own (its height, its speed) stays as fitted: where
    the knife was is not what is predicted.

    Args:
        unit: The fit to all data [d]; each refit starts there.
        blocks: Number of blocks of equal depth.
        length: As of `depth_blocks`.
        progress: Called with the number of blocks that are done.

    Raises:
        CuttingError: A slice breaks down near `unit`.
    """
    show = progress or (lambda _: None)
    block = depth_blocks(model, blocks, length)
    shared = np.array([p.shared for p in model.parameters])
    errors, counts, squares = [], [], 0.0
    for k in range(blocks):
        show(k)
        held, rest = (block == k) & model.used, model.used & (block != k)
        if not held.any() or not rest.any():
            continue
        without = model.holding_out(~rest)
        refit = gauss_newton(without, unit, free=shared, steps=HELD_OUT_STEPS).unit
        (row,) = without.predict([refit])
        error = (np.concatenate([p.predicted.ravel() for p in row]) - model.measured)[held]
        errors.append(float(np.sqrt(np.mean(error**2))))
        counts.append(int(held.sum()))
        squares += float((error**2).sum())
    show(blocks)
    return HeldOutError(errors, counts, float(np.sqrt(squares / max(sum(counts), 1))))


def _held_out(predictor: Predictor, fitted: Predictor, unit: np.ndarray) -> dict[str, float]:
    """Errors on other records, at the mean of the fitted records' own parameters, N."""
    values = fitted.values(unit)
    own: dict[str, list[float]] = {}
    for name, value in values.items():
        if ":" in name:
            own.setdefault(name.split(":")[0], []).append(value)
    at = []
    for p in predictor.parameters:
        # Of the fitted records perhaps none has such a parameter, as where speeds are known.
        mean = float(np.mean(own.get(p.name.split(":")[0], [p.start])))
        at.append(p.unit(values[p.name] if p.shared else mean))
    (row,) = predictor.predict([np.array(at)])
    return {
        target.record.name: target.rms_error(prediction.predicted)
        for target, prediction in zip(predictor.targets, row, strict=True)
    }
