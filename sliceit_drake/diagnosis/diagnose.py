"""A diagnosis from records to a result: what is wrong, why, how much, and the extended model."""

import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.known_error import KnownError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.at_size import AtSize
from sliceit_drake.diagnosis.evidence.columns import CauseAtScan, Sensitivities
from sliceit_drake.diagnosis.evidence.confirm import confirm
from sliceit_drake.diagnosis.evidence.linear import LinearProblem, fit_shared
from sliceit_drake.diagnosis.evidence.own_values import at_own_values
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule, reach_verdict
from sliceit_drake.diagnosis.extension import extended_food
from sliceit_drake.diagnosis.input_checks import check_records, without_lone_torques
from sliceit_drake.diagnosis.known_error import record_key, with_known_error
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.registry import open_causes
from sliceit_drake.diagnosis.result import Diagnosis
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["BASE", "Progress", "diagnose", "setup_of_food"]

Progress = Callable[[str, int, int], None]
"""Called with what is done, steps done and steps in all."""
BASE = (
    ParameterRange("material.toughness", 10.0, 5000.0),
    ParameterRange("material.youngs_modulus", 2e4, 2e7),
    ParameterRange("material.friction", 1e-3, 2.0),
)
"""Base parameters of a calibrated food: a shift of theirs is reported as such."""
MIN_RECORDS = 2
FAR = 0.1
"""Logarithm of a shift of a base parameter, two of the derivatives' steps. Where more is needed and
the verdict is unknown, simulations find the values, and records are judged from there."""
MOVES = 3
"""Most times that records are judged from other values."""


def setup_of_food(
    food: CalibratedFood, refinement: float = 1.0, free: Sequence[ParameterRange] = BASE
) -> CalibrationSetup:
    """The setup in which a calibrated food is diagnosed: its values, with some parameters free."""
    return CalibrationSetup(
        food=food.food,
        knife=food.knife,
        bench=food.bench,
        parameters=list(free),
        refinement=refinement,
    )


# Threads of the linear algebra only wait for each other: its matrices are small.
@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    extra: Sequence[Cause] = (),
    cache: Path | None = None,
    replicates: int = 200,
    seed: int = 0,
    workers: Workers = None,
    progress: Progress | None = None,
    other_food: bool = False,
    known: KnownError | None = None,
) -> Diagnosis:
    """Shows what the simulation gets wrong in records, names the cause and measures the gain.

    Args:
        setup: The model: food at its calibrated values, base parameters.
        records: At least two.
        extra: Causes of the user's, beside the built-in ones.
        cache: Folder for sensitivities.
        replicates, seed: Of the bootstrap.
        workers: What simulates.
        progress: See `Progress`.
        other_food: Whether records of a food of another name than the model's are meant.
        known: What the food's file says that the simulation gets wrong; not used with the records
            that it was learnt from.

    Raises:
        ConfigurationError: The records do not carry a diagnosis, with what would be needed.
    """
    show = progress or (lambda *_: None)
    if len(records) < MIN_RECORDS:
        raise ConfigurationError(
            f"{len(records)} record is too few: what is wrong in one slice may be that slice",
            field="RECORDS_DIR",
            fix=f"Give at least {MIN_RECORDS}, better 3 of each condition; `diagnose_slice` says"
            " what one slice shows.",
        )
    alarm = DecisionRule.alarm
    if replicates * alarm < 1.0:
        raise ConfigurationError(
            f"{replicates} replicates of the bootstrap cannot show a p-value of {alarm:g}",
            field="--replicates",
            fix=f"Give at least {round(1.0 / alarm)}.",
        )
    remarks = check_records(records, setup.food, other_food)
    records = without_lone_torques(records)
    causes = open_causes([p.name for p in setup.parameters], extra)
    judge = _Judge(records, causes, cache, replicates, seed, workers, show, known)
    result = judge(setup, remarks)
    factors = dict.fromkeys(result.shifts, 1.0)
    moves = MOVES if result.verdict.kind == "unknown" else 0
    for _ in range(moves):
        # What is left may be what a large shift does beyond its derivatives.
        near = all(abs(np.log(factor)) < FAR for factor, _ in result.shifts.values())
        if near or result.verdict.names:
            break
        predictor = SlicePredictor(result.setup, records, cache=cache, workers=workers)
        found = confirm(result.problem, predictor, [])
        there = {name: factors[name] * factor for name, factor in found.factors.items()}
        moved, _ = extended_food(setup, there, [])
        again = judge(dc.replace(setup, food=moved.food), remarks)
        if again.verdict.misfit >= result.verdict.misfit:
            break
        factors, result = there, again
    if other := [f"{n} times {factor:.2f}" for n, factor in factors.items() if factor != 1.0]:
        result.remarks.append(
            f"Simulated here is the food with {', '.join(other)}, beside which the simulation is "
            "less wrong by itself. Its force may be farther from the records'."
        )
    result.setup = setup
    result.shifts = {
        n: (factors[n] * factor, error) for n, (factor, error) in result.shifts.items()
    }
    return result


@dc.dataclass
class _Judge:
    """Judges records by what a food predicts and what its derivatives say; fields as `diagnose`."""

    records: Sequence[SliceRecord]
    causes: Sequence[Cause]
    cache: Path | None
    replicates: int
    seed: int
    workers: Workers
    show: Progress
    known: KnownError | None

    def __call__(self, setup: CalibrationSetup, remarks: Sequence[str]) -> Diagnosis:
        """What a diagnosis by one food finds; the remarks stand before its own."""
        records, show, remarks = self.records, self.show, list(remarks)
        found = sensitivities(
            setup,
            records,
            self.causes,
            cache=self.cache,
            workers=self.workers,
            progress=lambda done, total: show("simulations", done, total),
        )
        remarks += found.warnings
        if self.known is not None:
            found, why = _with_known(found, self.known, records, setup.refinement)
            remarks += why
        predictor = SlicePredictor(setup, records, cache=self.cache, workers=self.workers)
        problem = at_own_values(
            LinearProblem(found, may_be_uneven=found.known_from > 0),
            predictor,
            lambda done, total: show("own values", done, total),
        )
        if not problem.repeated:
            remarks.append(
                "No condition was repeated: noise is from what is rough in the residuals, and how "
                "slices vary is unknown. Repeat each cut at least 3 times."
            )
        steps = (DecisionRule.most + 1) * self.replicates
        done = [0]

        def count(more: int) -> None:
            done[0] += more
            # Screenings that are repeated are more than these.
            show("bootstrap", min(done[0], steps), steps)

        by_name = {c.name: c for c in self.causes}
        at_size = AtSize(predictor, by_name, lambda done, total: show("at size", done, total))
        refuted: dict[str, str] = {}
        while True:
            verdict = reach_verdict(
                problem, self.replicates, self.seed, count, at_size=at_size, refuted=refuted
            )
            show("bootstrap", steps, steps)
            problem = verdict.problem
            result = Diagnosis(
                verdict=verdict,
                problem=problem,
                setup=setup,
                causes=by_name,
                shifts=_shifts(problem, verdict.named),
                gain=None,
                remarks=list(remarks),
                known=self.known,
            )
            if verdict.names:
                result.confirm(
                    predictor, self.seed, lambda done, total: show("confirmation", done, total)
                )
            if not (found_wrong := result.refuted()):
                return result
            refuted |= found_wrong


def _with_known(
    found: Sensitivities, known: KnownError, records: Sequence[SliceRecord], refinement: float
) -> tuple[Sensitivities, list[str]]:
    """Sensitivities with what the food's file knows, or as they were with the reason."""
    if {*map(record_key, records)} & {*known.records}:
        why = "it was learnt from records that are among these, which cannot tell what has changed"
    elif refinement != known.refinement:
        why = f"it is of a mesh of refinement {known.refinement:g}, and this is {refinement:g}"
    elif (more := with_known_error(found, known)) is not None:
        return more, []
    else:
        why = "some of these cuts are of another speed or draw than those that it was learnt from"
    return found, [f"What the food's file says that the simulation gets wrong is not used: {why}."]


def _shifts(
    problem: LinearProblem, causes: Sequence[CauseAtScan]
) -> dict[str, tuple[float, float]]:
    """Factors of the base parameters and their relative standard errors, causes in the model."""
    found = problem.found
    shared = [k for k in found.of_causes(causes) if not found.columns[k].per_record]
    model = problem.with_causes(shared)
    theta, covariance = fit_shared(problem.weighted(model).total, model)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out = {}
    # The base parameters come first.
    for i, k in enumerate(problem.base):
        size = found.columns[k].size
        out[found.columns[k].name] = (
            float(np.exp(np.clip(theta[i] * size, -2.0, 2.0))),
            float(errors[i] * size),
        )
    return out
