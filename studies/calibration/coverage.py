"""How often the 90 % intervals of calibrations hold the truth.

Simulates cuts with known parameters, noise and small sub-steps, each a press and a retract.
Calibrates each set and prints a page of what share of the intervals holds the truth; a minute a
replicate and processor. It also does so without the rows in which the knife turns round, and with
what the usual sub-step does wrong left in the predictions. With --output it writes
the page (coverage.md) and each replicate as it is done (coverage.jsonl), from which it goes on if
it was stopped. Ends with status 1 if the share is not within 80 to 98 %.
"""

import argparse
import copy
import dataclasses as dc
import json
import textwrap
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np
from scipy.special import ndtri
from scipy.stats import binomtest
from tqdm import tqdm

from sliceit_drake.calibration.gauss_newton import gauss_newton
from sliceit_drake.calibration.prediction import Predictor
from sliceit_drake.calibration.setup import CalibrationSetup, load_setup
from sliceit_drake.calibration.uncertainty import estimate
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.shapes import Cylinder
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.prediction.noise import MarkovCovariance, NoiseModel, group_series
from sliceit_drake.records.metadata import FoodFacts, NominalMotion, SliceMetadata
from sliceit_drake.records.slice_record import SliceRecord, velocities
from studies.pages import publish, render

__all__ = [
    "OTHERS",
    "Found",
    "Problem",
    "Replicate",
    "add_arguments",
    "coarse_setup",
    "coverage_page",
    "coverage_share",
    "coverage_study",
    "noise_sample",
    "run",
    "synthetic_predictor",
]

LEVEL = 0.9
LEAST, MOST = 0.80, 0.98
"""Between which the fraction of 90 % intervals that hold the truth must be."""
MIN_SQUARES_STEPS = 3
"""Before the weighted fit."""
CLEARANCE, REST = 2.5e-3, 10e-3
"""Height of the knife above the food at the start and above the board at its lowest, m. No record's
height brings it to the board, where the force has a kink that no normal distribution describes."""
TURN_TIME, TURN_WAY = 0.03, 1e-3
"""From where the knife turns round, s and m: until both are over, it counts as turning."""
WITHOUT_TURN = "without the rows in which the knife turns round"
WITH_STEP_ERROR = "with what the sub-step does wrong left in the predictions"
OTHERS = (WITHOUT_TURN, WITH_STEP_ERROR)
"""Estimates for comparison."""
HEAD = (
    "parameter | inside | coverage | 95 % interval of it | RMS error | "
    "stated standard deviation | mean error"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--replicates", metavar="N", type=int, default=20, help="calibrations; default: 20"
    )
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; default: 2")
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help="write coverage.md and coverage.jsonl there"
    )
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    if options.replicates < 1 or options.workers < 1:
        raise ConfigurationError(
            "is below 1", field="--replicates or --workers", fix="Give 1 or more."
        )
    folder = options.output
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    problem = Problem()
    with tqdm(total=options.replicates, desc="replicates") as bar:
        results = coverage_study(
            problem,
            options.replicates,
            folder and folder / "coverage.jsonl",
            options.workers,
            lambda done: bar.update(done - bar.n) and None,
        )
    publish(coverage_page(problem, results, options.command), folder and folder / "coverage.md")
    return 0 if LEAST <= coverage_share(results) <= MOST else 1


@dc.dataclass(frozen=True)
class Problem:
    """What is simulated and calibrated in each replicate.

    Attributes:
        names: Shared parameters that are searched.
        speeds: Of press and retract, m/s; each is a condition.
        retract: Way back from the deepest place, m. The knife turns round at once.
        records: Of each condition.
        rate: Samples a second.
        time_step: Sub-step of the calibration, s, shorter by need.
        true_step: Sub-step of the records, s.
        ar, tau, white: Noise of each channel: autoregressive part [N], its time [s], white part.
        record_scale: Relative standard deviation of the force between slices.
        height_offset: Range of each record's height to both sides, m. The force on coarse elements
            has waves of some millimetres in depth; beyond a part of one there are several fits.
        middle: Part of the unit range, about its middle, that true values are drawn from.
        start_error: Standard deviation of the start from the truth, in the unit range.
    """

    names: tuple[str, ...] = ("material.toughness", "material.youngs_modulus", "material.friction")
    speeds: tuple[float, ...] = (0.05, 0.15)
    retract: float = 6e-3
    records: int = 2
    rate: float = 200.0
    time_step: float = 5e-4
    true_step: float = 1.25e-5
    ar: float = 0.06
    tau: float = 0.02
    white: float = 0.02
    record_scale: float = 0.05
    height_offset: float = 5e-4
    middle: float = 0.5
    start_error: float = 0.1


@dc.dataclass(frozen=True)
class Found:
    """An estimate.

    Attributes:
        mean, deviation: Its place and standard deviation [d].
        inside: Whether the 90 % interval holds the truth [d].
    """

    mean: list[float]
    deviation: list[float]
    inside: list[bool]

    @classmethod
    def of(cls, mean: np.ndarray, deviation: np.ndarray, truth: np.ndarray) -> "Found":
        """An estimate whose interval ends with the range."""
        reach = float(ndtri(0.5 + LEVEL / 2.0)) * deviation
        low, high = np.clip(mean - reach, 0.0, 1.0), np.clip(mean + reach, 0.0, 1.0)
        return cls(mean.tolist(), deviation.tolist(), ((low <= truth) & (truth <= high)).tolist())


@dc.dataclass(frozen=True)
class Replicate(Found):
    """One calibration of simulated records.

    Attributes:
        number: Its seed.
        problem: As text, to tell results of other problems.
        names: Parameters [d].
        truth: Their true places [d].
        others: Other estimates from the same records: `OTHERS`.
        record_scale: Estimated.
        tau: Estimated, mean of all series, s.
        rms: Error of the fit, N.
    """

    number: int
    problem: str
    names: list[str]
    truth: list[float]
    others: dict[str, Found]
    record_scale: float
    tau: float
    rms: float


def coarse_setup(problem: Problem) -> CalibrationSetup:
    """The cucumber's setup on some 300 tetrahedra with only the problem's parameters searched."""
    setup = load_setup("cucumber")
    assert isinstance(setup.food.shape, Cylinder)
    setup.food.shape.rings, setup.food.shape.layers = 2, [0.0, 4e-3, 12e-3]
    setup.parameters = [p for p in setup.parameters if p.name in problem.names]
    setup.height_offset = [-problem.height_offset, problem.height_offset]
    setup.oscillation = None
    return setup


def _press_record(name: str, height: float, speed: float, problem: Problem) -> SliceRecord:
    """A press through a food of this height and back at constant speed, without a force as yet."""
    press = (height + CLEARANCE - REST) / speed
    time = np.arange(0.0, press + problem.retract / speed, 1.0 / problem.rate)
    position = np.zeros((len(time), 3))
    position[:, 2] = height + CLEARANCE - speed * np.minimum(time, 2.0 * press - time)
    rotation = np.tile(np.diag([1.0, -1.0, -1.0]), (len(time), 1, 1))
    metadata = SliceMetadata(
        name=name,
        condition=f"press at {speed:g} m/s",
        food=FoodFacts(position=[0.0, 0.0, 0.0], yaw=0.0),
        motion=NominalMotion(speed=speed, draw_ratio=0.0),
    )
    v, w = velocities(time, position, rotation)
    return SliceRecord(metadata, time, position, rotation, v, w, force=np.zeros_like(position))


def synthetic_predictor(
    problem: Problem, truth: np.ndarray | None, rng: np.random.Generator
) -> tuple[Predictor, np.ndarray]:
    """Records made by the predictor's own model at small sub-steps with noise, and the true places.

    Args:
        problem: What is simulated.
        truth: Places [d]; drawn if None.
        rng: Of truth and noise.

    Raises:
        ConfigurationError: A slice breaks down at the truth.
    """
    setup = coarse_setup(problem)
    assert isinstance(setup.food.shape, Cylinder)
    records = [
        _press_record(f"{k}-{n}", setup.food.shape.diameter, speed, problem)
        for k, speed in enumerate(problem.speeds)
        for n in range(problem.records)
    ]
    predictor = Predictor(setup, records, problem.time_step, "float64", workers=1)
    d = len(predictor.parameters)
    if truth is None:
        truth = rng.uniform(0.5 - problem.middle / 2.0, 0.5 + problem.middle / 2.0, d)
    (row,) = predictor.predict([truth], problem.true_step)
    force = np.concatenate([p.predicted.ravel() for p in row])
    if not np.isfinite(force).all():
        raise ConfigurationError("a slice breaks down at the truth", field="Problem")
    groups = group_series(
        predictor.used,
        predictor.time,
        predictor.record_of,
        [3] * len(records),
        predictor.conditions,
    )
    ar, tau, white = (np.full(len(groups), v) for v in (problem.ar, problem.tau, problem.white))
    scales = force[:, None] * (predictor.record_of[:, None] == np.arange(len(records)))
    noise = NoiseModel(groups, ar, tau, white, problem.record_scale, scales)
    measured = predictor.split(force + noise_sample(noise, rng, len(force)))
    for target, series in zip(predictor.targets, measured, strict=True):
        target.measured = series
    return predictor, truth


def noise_sample(noise: NoiseModel, rng: np.random.Generator, size: int) -> np.ndarray:
    """A sample of the noise [size]; entries that are not used are zero."""
    out = np.zeros(size)
    numbers = zip(noise.groups, noise.ar, noise.tau, noise.white, strict=True)
    for group, *own in numbers:
        out[group.rows] = MarkovCovariance(group.gap, *own).sample(rng)
    if noise.record_scale is not None:
        out += noise.scales @ rng.normal(0.0, noise.record_scale, noise.scales.shape[1])
    return out


def _run_replicate(problem: Problem, number: int) -> Replicate:
    """Simulates records, calibrates from near the truth and compares.

    Raises:
        ConfigurationError: A slice breaks down at the truth.
        CuttingError: One breaks down near the estimate.
    """
    rng = np.random.default_rng(number)
    predictor, truth = synthetic_predictor(problem, None, rng)
    start = np.clip(truth + rng.normal(0.0, problem.start_error, len(truth)), 0.02, 0.98)
    fit = gauss_newton(predictor, start, steps=MIN_SQUARES_STEPS)
    found = estimate(predictor, fit.unit)
    with_error = copy.copy(predictor)
    with_error.without_step_error = lambda unit: with_error  # type: ignore[method-assign]
    others = {}
    for name, other in (
        (WITHOUT_TURN, predictor.holding_out(_turning(predictor))),
        (WITH_STEP_ERROR, with_error),
    ):
        its = estimate(other, fit.unit)
        others[name] = Found.of(its.unit, its.posterior.deviation, truth)
    return Replicate(
        **vars(Found.of(found.unit, found.posterior.deviation, truth)),
        number=number,
        problem=repr(problem),
        names=[p.name for p in predictor.parameters],
        truth=truth.tolist(),
        others=others,
        record_scale=float(found.noise.record_scale or 0.0),
        tau=float(found.noise.tau.mean()),
        rms=predictor.error(predictor.predict([found.unit])[0]),
    )


def _turning(predictor: Predictor) -> np.ndarray:
    """Entries [M] in which the knife turns round."""
    out = np.zeros(len(predictor.time), bool)
    for record in range(len(predictor.targets)):
        rows = np.flatnonzero(predictor.record_of == record)
        depth, since = predictor.depth[rows], predictor.time[rows]
        since = since - since[depth.argmax()]
        out[rows] = (since > 0.0) & ((since < TURN_TIME) | (depth.max() - depth < TURN_WAY))
    return out


def coverage_study(
    problem: Problem,
    replicates: int,
    file: Path | None = None,
    workers: int = 2,
    progress: Callable[[int], None] | None = None,
) -> list[Replicate]:
    """Runs replicates, each in a process of its own kind, and returns them by number.

    Args:
        problem: What is simulated.
        replicates: Number of them.
        file: JSON lines to which each is written when it is done, and from which the study goes on.
        workers: Processes.
        progress: Called with the number of replicates done.

    Raises:
        ConfigurationError: The file holds results of another problem.
    """
    done: dict[int, Replicate] = {}
    if file is not None and file.exists():
        for line, text in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            facts = json.loads(text)
            facts["others"] = {name: Found(**other) for name, other in facts["others"].items()}
            replicate = Replicate(**facts)
            if replicate.problem != repr(problem):
                raise ConfigurationError(
                    "is of another problem", source=f"{file}, line {line}", fix="Remove the file."
                )
            done[replicate.number] = replicate
    missing = [n for n in range(replicates) if n not in done]
    if progress is not None:
        progress(replicates - len(missing))
    # Processes that share a simulator's threads would hinder each other.
    with worker_processes(min(workers, max(len(missing), 1))) as pool:
        futures = [pool.submit(_run_replicate, problem, n) for n in missing]
        for future in as_completed(futures):
            replicate = future.result()
            done[replicate.number] = replicate
            if file is not None:
                with open(file, "a", encoding="utf-8") as stream:
                    stream.write(json.dumps(dc.asdict(replicate)) + "\n")
            if progress is not None:
                progress(sum(n in done for n in range(replicates)))
    return [done[n] for n in range(replicates)]


def coverage_page(problem: Problem, replicates: Sequence[Replicate], command: str) -> str:
    """The page docs/results/coverage.md.

    Args:
        problem: What was simulated.
        replicates: From `coverage_study`.
        command: That repeats it.
    """
    share = coverage_share(replicates)
    n = len(replicates)
    page = render(
        "coverage",
        command=command,
        problem=problem,
        replicates=n,
        speeds=" and ".join(f"{1e3 * s:g} mm/s" for s in problem.speeds),
        rest=REST,
        turn=(TURN_TIME, TURN_WAY),
        head=HEAD,
        rows=_rows(replicates, replicates),
        others=[(n, _rows(replicates, [r.others[n] for r in replicates])) for n in OTHERS],
        share=100.0 * share,
        verdict="within" if LEAST <= share <= MOST else "outside",
        bounds=(100.0 * LEAST, 100.0 * MOST),
        scale=_quantiles(np.array([100.0 * r.record_scale for r in replicates])),
        tau=_quantiles(np.array([1e3 * r.tau for r in replicates])),
    )
    return "\n\n".join(map(_wrapped, page.strip().split("\n\n"))) + "\n"


def coverage_share(replicates: Sequence[Replicate]) -> float:
    """Fraction of all intervals that hold the truth."""
    return float(np.mean([inside for r in replicates for inside in r.inside]))


def _rows(replicates: Sequence[Replicate], found: Sequence[Found]) -> list[tuple[str, ...]]:
    """Rows of a table of estimates, one a replicate: each shared parameter, and the heights."""
    names = replicates[0].names
    rows: list[tuple[str, ...]] = []
    for kind in dict.fromkeys(n.split(":", 1)[0] for n in names):
        members = [k for k, n in enumerate(names) if n.split(":", 1)[0] == kind]
        inside = [f.inside[k] for f in found for k in members]
        pairs = zip(replicates, found, strict=True)
        errors = np.array([f.mean[k] - r.truth[k] for r, f in pairs for k in members])
        sd = np.array([f.deviation[k] for f in found for k in members])
        likely = binomtest(sum(inside), len(inside)).proportion_ci(method="exact")
        rows.append(
            (kind, f"{sum(inside)} of {len(inside)}", f"{100.0 * np.mean(inside):.0f} %")
            + (f"{100.0 * likely.low:.0f} to {100.0 * likely.high:.0f} %",)
            + (f"{np.sqrt(np.mean(errors**2)):.4f}", f"{np.sqrt(np.mean(sd**2)):.4f}")
            + (f"{errors.mean():+.4f}",)
        )
    return rows


def _wrapped(paragraph: str) -> str:
    """A paragraph of a page in lines of 100; titles, pictures, commands and tables as they are."""
    if paragraph.startswith(("#", " ", "|", "!")):
        return paragraph
    return textwrap.fill(paragraph, 100, break_on_hyphens=False)


def _quantiles(values: np.ndarray) -> str:
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"
