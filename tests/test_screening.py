"""Gains of causes, and their distribution where nothing is wrong, against known answers.

The columns are cosines of time, orthogonal to each other, the noise is white and known, and so is
how slices vary. Twice the gain in log-likelihood by one number is then chi-square distributed with
one degree of freedom where nothing is wrong: mean 1, deviation sqrt(2), 95 % quantile 3.84.
"""

import dataclasses as dc

import numpy as np
import pytest
from scipy.stats import chi2

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import KNOT, LinearProblem
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening, screen

ROWS = 200
NOISE = 0.1
SLICES = 5
REPLICATES = 4000
TIME = np.linspace(0.0, 2.0, ROWS)
DEPTH = np.linspace(1e-4, 0.02, ROWS)
COLUMNS = [
    Column("base", "material.toughness"),
    Column("record", "toughness", per_record=True),
    Column("numerical", "mesh"),
    # Its usual standard deviation is 1.5 ms (`linear.USUAL`), so 1 of the column's size.
    Column("cause", "sensor_delay", "delay", scan=1.0, size=1.5e-3),
    Column("cause", "plain", "x"),
    Column("cause", "bounded", "x", one_sided=True),
    Column("cause", "like_mesh", "x"),
    Column("cause", "like_delay", "x"),
    Column("cause", "like_depth_error", "x"),
    Column("cause", "by_condition", "x"),
]
ABSENT = Column("cause", "absent", "x", one_sided=True)


def wave(number: int) -> np.ndarray:
    """A cosine of time [ROWS]."""
    return 0.3 * np.cos(number * np.pi * TIME / TIME[-1])


def record(number: int, hidden: dict[str, float]) -> RecordSensitivity:
    """A record of the first or the second condition, with what is hidden in it and no noise."""
    sign = 1.0 if number < SLICES else -1.0
    shapes = {
        "material.toughness": wave(1),
        "toughness": wave(2),
        "mesh": wave(3),
        "sensor_delay": wave(4),
        "plain": wave(5),
        "bounded": wave(6),
        "like_mesh": wave(3),
        "like_delay": wave(4),
        "like_depth_error": np.maximum(1.0 - np.abs(DEPTH - KNOT) / KNOT, 0.0),
        "by_condition": sign * wave(2),
    }
    table = np.column_stack(list(shapes.values()))[:, None, :]
    y = sum((x * shapes[name] for name, x in hidden.items()), np.zeros(ROWS))
    return RecordSensitivity(
        name=f"slice {number}",
        condition=f"condition {sign}",
        channels=("force_z",),
        time=TIME,
        phase=np.full(ROWS, "slice"),
        depth=DEPTH,
        path=DEPTH,
        in_contact=np.ones(ROWS, bool),
        measured=y[:, None],
        predicted=np.zeros((ROWS, 1)),
        columns=table,
        even=np.zeros_like(table),
    )


def sensitivities(mesh: bool = True, **hidden: float) -> Sensitivities:
    """Sensitivities of two conditions; without the mesh's column the simulation is exact."""
    kept = [k for k, c in enumerate(COLUMNS) if mesh or c.name != "mesh"]
    records = [record(k, hidden) for k in range(2 * SLICES)]
    records = [
        dc.replace(r, columns=r.columns[:, :, kept], even=r.even[:, :, kept]) for r in records
    ]
    return Sensitivities([COLUMNS[k] for k in kept], records)


def screened(found: Sensitivities, replicates: int = 100) -> tuple[LinearProblem, Screening]:
    """Noise and variation are known; that of the slices is far above the noise."""
    problem = LinearProblem(found, [ChannelNoise(1e-6, 0.01, NOISE)], np.array([3.0]))
    return problem, screen(problem, replicates)


@pytest.fixture(scope="module")
def nothing() -> Screening:
    return screened(sensitivities(), REPLICATES)[1]


def information(problem: LinearProblem, name: str) -> float:
    """What all records know of a cause's coefficient, the inverse of its variance."""
    (k,) = problem.found.index("cause", name)
    return float(problem.moments.gram[:, k, k].sum())


@pytest.mark.parametrize("name", ["plain", "sensor_delay", "like_mesh", "like_delay"])
def test_by_chance_a_number_gains_as_chi_square_whatever_the_model_is_unsure_of(nothing, name):
    """Where a cause looks like the mesh or like a usual delay, what these may do by chance is no
    evidence for it."""
    e = nothing.evidence(name)
    assert e.expected == pytest.approx(1.0, abs=0.1)
    assert e.deviation == pytest.approx(np.sqrt(2.0), abs=0.15)
    assert e.limit == pytest.approx(chi2.ppf(0.95, 1), rel=0.1)


def test_by_chance_the_discretisations_error_of_depth_is_no_evidence(nothing):
    assert nothing.evidence("like_depth_error").expected == pytest.approx(1.0, abs=0.1)


def test_by_chance_a_bounded_number_gains_half_of_the_time(nothing):
    e = nothing.evidence("bounded")
    assert e.expected == pytest.approx(0.5, abs=0.06)
    assert e.limit == pytest.approx(chi2.ppf(0.9, 1), rel=0.1)


def test_how_slices_vary_is_known_only_to_within_its_samples(nothing):
    """What differs between conditions as slices differ gains by chi-square times the ratio of the
    variance that is drawn to its estimate: 2 (5 - 1) samples over their chi-square, at most 10."""
    samples = 2 * (SLICES - 1)
    draws = np.linspace(5e-5, 1.0 - 5e-5, 10_000)
    ratio = samples / np.maximum(chi2.ppf(draws, samples), 0.1 * samples)
    assert ratio.mean() > 1.3
    expected = nothing.evidence("by_condition").expected
    assert expected == pytest.approx(ratio.mean(), abs=0.13)


@pytest.mark.parametrize("amount", [2.0, -2.0])
def test_a_bounded_number_gains_on_its_own_side_only(amount):
    problem, screening = screened(sensitivities(mesh=False, bounded=amount))
    e = screening.evidence("bounded")
    gain = amount**2 * information(problem, "bounded")
    assert e.gain == pytest.approx(gain if amount > 0.0 else 0.0, rel=0.05)
    assert e.coefficients[0] == pytest.approx(max(amount, 0.0), rel=0.02)
    plain = screened(sensitivities(plain=amount))[1].evidence("plain")
    assert plain.coefficients[0] == pytest.approx(amount, rel=0.02)


@pytest.mark.parametrize("amount", [0.5, 4.0])
def test_what_is_usual_counts_beyond_the_usual_unless_it_is_unusual(amount):
    """A delay within the usual gains what a free one gains more than one of known variance; a
    delay of four usual ones is a cause like any other, and gains all that it explains."""
    problem, screening = screened(sensitivities(mesh=False, sensor_delay=amount))
    known = information(problem, "sensor_delay")
    free = amount**2 * known
    wanted = free / (known + 1.0) if amount < 1.0 else free
    assert screening.evidence("sensor_delay").gain == pytest.approx(wanted, rel=0.05)


def test_a_cause_that_never_gains_by_chance_is_not_proved_by_next_to_nothing():
    evidence = CauseEvidence("x", 0.4, 0.0, 0.0, 0.0, None, [Column("cause", "x")], [1.0], [1.0])
    assert evidence.deviations == pytest.approx(0.8)
    found = sensitivities(plain=0.02)
    without = screened(found)[1]
    more = Sensitivities(
        [*found.columns, ABSENT],
        [dc.replace(r, columns=np.pad(r.columns, ((0, 0), (0, 0), (0, 1)))) for r in found.records],
    )
    screening = screened(more)[1]
    absent = screening.evidence("absent")
    assert (absent.gain, absent.deviation, absent.deviations) == (0.0, 0.0, 0.0)
    # One that cannot show changes nothing for the others.
    assert 0.0 < screening.p_value <= 1.0
    assert screening.evidence("plain").gain == pytest.approx(without.evidence("plain").gain)
