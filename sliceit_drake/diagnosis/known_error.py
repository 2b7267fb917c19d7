"""What a food's file knows of its simulation's own error, learnt from records and put to others.

A law that is wrong along depth hides an effect that is smaller. Where the food was calibrated to
cuts of the same kinds before, what the simulation gets wrong in them is known, and a diagnosis can
ask what has changed since.
"""

import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.content_store import content_key
from sliceit_drake.cutting.foods.known_error import KnownError, KnownErrorOfCut
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import USUAL, LinearProblem
from sliceit_drake.diagnosis.evidence.own_values import (
    HEIGHT,
    at_own_values,
    centred_own,
    farther_in,
)
from sliceit_drake.diagnosis.evidence.sensitivity import Progress, sensitivities
from sliceit_drake.diagnosis.input_checks import check_records, without_lone_torques
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.registry import open_causes
from sliceit_drake.prediction.discrepancy import Covariates, motion_phases
from sliceit_drake.prediction.simulator import Workers
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "known_of",
    "learn_known_error",
    "mean_error",
    "record_key",
    "way_of",
    "with_known_error",
]

ALIKE = (0.05, 0.03)
"""Differences in the decimal logarithm of the speed and in the share of the draw up to which cuts
are of one kind."""
RESTING = 5e-3
"""Way that a second at rest counts as, metres."""
DIGITS = 4
"""Of the values that are kept."""


def record_key(record: SliceRecord) -> str:
    """Key of what a record measured."""
    return content_key(record.time, record.position, record.measured_force)


def way_of(record: RecordSensitivity) -> np.ndarray:
    """Way of the knife since the edge was at the top of the food [m], metres; at rest it goes on by
    `RESTING` a second, so that what relaxes has a place on it."""
    _, rested = motion_phases(record.time, record.depth, record.path)
    at_rest = np.maximum(np.diff(rested, prepend=0.0), 0.0)
    way = record.path + RESTING * np.cumsum(at_rest)
    return np.asarray(way - way[int(np.argmax(record.depth > 0.0))])


def learn_known_error(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    cache: Path | None = None,
    workers: Workers = None,
    progress: Callable[[str, int, int], None] | None = None,
    other_food: bool = False,
) -> KnownError:
    """What simulations of a calibrated food get wrong in records: the mean over each kind of cut,
    once what slices of that kind differ in as a whole (toughness, modulus, friction, height) is
    taken off.

    Args:
        setup: Of the food at its calibrated values.
        records: As `diagnose` takes them.
        cache, workers, progress, other_food: As there.

    Raises:
        ConfigurationError: The records do not carry a diagnosis, naming file and field.
        CuttingError: The prediction itself broke down.
    """
    show = progress or (lambda *_: None)
    check_records(records, setup.food, other_food)
    keys = [record_key(r) for r in records]
    records = without_lone_torques(records)
    every_sensor = {name for name, _ in USUAL}
    causes = [c for c in open_causes([p.name for p in setup.parameters]) if c.name in every_sensor]
    found = sensitivities(
        setup,
        records,
        causes,
        cache=cache,
        workers=workers,
        progress=lambda done, total: show("simulations", done, total),
    )
    predictor = SlicePredictor(setup, records, cache=cache, workers=workers)
    known = mean_error(found, predictor, lambda done, total: show("own values", done, total))
    known.records, known.refinement = keys, setup.refinement
    return known


def mean_error(
    found: Sensitivities,
    predictor: SlicePredictor | None = None,
    progress: Progress | None = None,
) -> KnownError:
    """What predictions get wrong in each kind of cut, at the same places in its slices.

    Args:
        found: The sensitivities.
        predictor, progress: As of `at_own_values`.
    """
    known: KnownError | None = None
    # The first mean is smeared: heights are found well where the sharp bends are known.
    for at_own in (None, None, predictor):
        about = known and with_known_error(found, known)
        problem = at_own_values(LinearProblem(about or found, may_be_uneven=True), at_own, progress)
        known = _with_rests(problem, known if about else None)
    assert known is not None
    return known


def _cuts(problem: LinearProblem) -> list[list[int]]:
    """Records of each condition that cuts."""
    records = problem.found.records
    return [members for members in problem.conditions.values() if records[members[0]].cut]


def _with_rests(problem: LinearProblem, before: KnownError | None) -> KnownError:
    """What was known of records before, and the means over each kind of cut of what is left, at the
    same places in their slices, which differ in height by what is each one's own."""
    known = KnownError(channels=list(problem.found.records[0].channels), slices=0)
    records, own = problem.found.records, centred_own(problem)
    kinds = [problem.found.columns[k] for k in problem.own]
    heights = own @ [c.size * (c.name == HEIGHT) for c in kinds]
    for members in _cuts(problem):
        some = [records[r] for r in members]
        ways = [way_of(records[r]) + farther_in(records[r], heights[r]) for r in members]
        count = int(max(w[-1] for w in ways) / known.step) + 2
        sums, rows = np.zeros((len(known.channels), count)), np.zeros(count)
        for r, way in zip(members, ways, strict=True):
            rest = records[r].residual - records[r].columns[:, :, problem.own] @ own[r]
            place = np.rint(way / known.step).astype(int) + 1
            inside = (place >= 0) & (place < count)
            rows += np.bincount(place[inside], minlength=count)
            for c, values in enumerate(rest[inside].T):
                sums[c] += np.bincount(place[inside], values, count)
        seen = np.flatnonzero(rows)
        means = np.array([np.interp(np.arange(count), seen, s[seen] / rows[seen]) for s in sums])
        if before is not None and (cut := _cut_like(before, some[0])) is not None:
            earlier = np.array(cut.values)[:, :count]
            means[:, : earlier.shape[1]] += earlier
        values = [[float(f"{x:.{DIGITS}g}") for x in row] for row in means]
        at = _covariates(some[0])
        known.cuts.append(KnownErrorOfCut(float(10.0**at.speed), at.draw, values))
        known.slices += len(members)
    known.slices = max(known.slices, 1)
    return known


def known_of(known: KnownError, record: RecordSensitivity) -> np.ndarray | None:
    """What is known of a record before it [m, c], N and Nm: 0 in channels of which nothing is, and
    without food; None for a kind of cut of which nothing is."""
    out = np.zeros_like(record.measured)
    if not record.cut:
        return out
    cut = _cut_like(known, record)
    if cut is None:
        return None
    values, place = cut.values, way_of(record) / known.step + 1.0
    for k, name in enumerate(record.channels):
        if name in known.channels:
            row = values[known.channels.index(name)]
            out[:, k] = np.interp(place, np.arange(len(row)), row, left=0.0, right=0.0)
    return out


def _cut_like(known: KnownError, record: RecordSensitivity) -> KnownErrorOfCut | None:
    """The cut of a record's kind, if of one something is known."""
    at = _covariates(record)
    away = [
        np.hypot((np.log10(c.speed) - at.speed) / ALIKE[0], (c.draw - at.draw) / ALIKE[1])
        for c in known.cuts
    ]
    return known.cuts[int(np.argmin(away))] if away and min(away) <= 1.0 else None


def with_known_error(found: Sensitivities, known: KnownError) -> Sensitivities | None:
    """Sensitivities about predictions to which what is known was added; None where records are of a
    kind of cut of which nothing is known."""
    records = []
    for record in found.records:
        added = known_of(known, record)
        if added is None:
            return None
        records.append(dc.replace(record, predicted=record.predicted + added, known=added))
    return dc.replace(found, records=records, known_from=known.slices)


def _covariates(record: RecordSensitivity) -> Covariates:
    return Covariates.of(record.time, record.depth, record.path)
