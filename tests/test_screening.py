"""Gains of causes, and their distribution where nothing is wrong, against known answers.

The columns are cosines of time, orthogonal to each other, far faster than what a simulation gets
wrong by itself; the noise is white and known, and so is how slices vary. A cause's number is normal
before the data with a standard deviation of `PLAUSIBLE`: with information A of the records of it
and Q = 1 / PLAUSIBLE^2, twice the gain in log-likelihood is A / (A + Q) chi^2 - log(1 + A / Q)
where nothing is wrong, chi^2 with one degree of freedom.
"""

import dataclasses as dc

import numpy as np
import pytest
from scipy.stats import chi2

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import PLAUSIBLE, LinearProblem
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, Screening, screen
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule

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
    # Its usual standard deviation is 1 ms (`linear.USUAL`), so 1 of the column's size.
    Column("cause", "sensor_delay", "delay", scan=1.0, size=1e-3),
    Column("cause", "plain", "x"),
    Column("cause", "bounded", "x", one_sided=True),
    Column("cause", "like_mesh", "x"),
    Column("cause", "like_delay", "x"),
    Column("cause", "by_condition", "x"),
]
ABSENT = Column("cause", "absent", "x", one_sided=True)


def wave(number: int) -> np.ndarray:
    """A cosine of time [ROWS]."""
    return 0.05 * np.cos((number + 20) * np.pi * TIME / TIME[-1])


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
def nothing() -> tuple[LinearProblem, Screening]:
    return screened(sensitivities(), REPLICATES)


def information(problem: LinearProblem, name: str) -> float:
    """What all records know of a cause's coefficient, the inverse of its variance."""
    (k,) = problem.found.index("cause", name)
    return float(problem.moments.gram[:, k, k].sum())


def of_chance(information: float, draws: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Gains where nothing is wrong, not below 0, of draws of chi-square times a ratio."""
    Q = 1.0 / PLAUSIBLE**2
    gain = information / (information + Q) * draws - np.log1p(information / Q)
    return np.maximum(gain, 0.0) * share


def test_by_chance_a_number_gains_as_chi_square_less_what_it_could_have_been(nothing):
    problem, screening = nothing
    e = screening.evidence("plain")
    draws = chi2.ppf((np.arange(100_000) + 0.5) / 100_000, 1)
    wanted = of_chance(information(problem, "plain"), draws)
    assert e.expected == pytest.approx(wanted.mean(), abs=0.06)
    assert e.deviation == pytest.approx(wanted.std(), abs=0.12)


@pytest.mark.parametrize("name", ["like_mesh", "like_delay"])
def test_what_the_model_is_unsure_of_by_itself_is_no_evidence(nothing, name):
    """Where a cause looks like the mesh or like a usual delay, what these may do by chance gains no
    more than any other number does."""
    problem, screening = nothing
    prior = 1.0 / (1.0 + 1.0 / information(problem, name))
    draws = chi2.ppf((np.arange(100_000) + 0.5) / 100_000, 1)
    expected = of_chance(prior, draws).mean()
    assert screening.evidence(name).expected == pytest.approx(expected, abs=0.06)


def test_by_chance_a_bounded_number_gains_half_of_the_time(nothing):
    problem, screening = nothing
    draws = chi2.ppf((np.arange(100_000) + 0.5) / 100_000, 1)
    expected = of_chance(information(problem, "bounded"), draws, 0.5).mean()
    assert screening.evidence("bounded").expected == pytest.approx(expected, abs=0.04)


def test_how_slices_vary_is_known_only_to_within_its_samples(nothing):
    """What differs between conditions as slices differ gains by chi-square times the ratio of the
    variance that is drawn to its estimate: 2 (5 - 1) samples over their chi-square, at most 10."""
    problem, screening = nothing
    samples = 2 * (SLICES - 1)
    rng = np.random.default_rng(0)
    ratio = samples / np.maximum(rng.chisquare(samples, 100_000), 0.1 * samples)
    # Ten records, half of them of each sign; beside them the base.
    known = 2 * SLICES / 9.0
    wide = of_chance(known, ratio * rng.chisquare(1.0, 100_000)).mean()
    plain = of_chance(known, rng.chisquare(1.0, 100_000)).mean()
    assert wide > 1.4 * plain
    assert screening.evidence("by_condition").expected == pytest.approx(wide, rel=0.15)


@pytest.mark.parametrize("amount", [2.0, -2.0])
def test_a_bounded_number_gains_on_its_own_side_only(amount):
    problem, screening = screened(sensitivities(mesh=False, bounded=amount))
    e = screening.evidence("bounded")
    A, Q = information(problem, "bounded"), 1.0 / PLAUSIBLE**2
    gain = (amount * A) ** 2 / (A + Q) - np.log1p(A / Q)
    assert e.gain == pytest.approx(gain if amount > 0.0 else 0.0, rel=0.05)
    fitted = amount * A / (A + Q)
    assert e.coefficients[0] == pytest.approx(max(fitted, 0.0), rel=0.02)
    plain = screened(sensitivities(plain=amount))[1].evidence("plain")
    assert plain.coefficients[0] == pytest.approx(fitted, rel=0.02)


def test_a_delay_within_the_usual_is_no_cause_and_one_far_beyond_is():
    """The cause may be twice its size, the sensor usually delays by one."""
    known, cause = [], 1.0 / PLAUSIBLE**2
    for amount in (0.5, 6.0):
        problem, screening = screened(sensitivities(mesh=False, sensor_delay=amount))
        A = information(problem, "sensor_delay")
        gain = (amount * A) ** 2 * (1.0 / (A + cause) - 1.0 / (A + 1.0))
        gain -= np.log1p(A / cause) - np.log1p(A)
        # A little more where the discrepancy takes less beside it.
        assert screening.evidence("sensor_delay").gain == pytest.approx(max(gain, 0.0), rel=0.1)
        known.append(screening.evidence("sensor_delay").gain)
    assert known[0] == 0.0 and known[1] > 10.0
    # It acts most in rows that are doubted: less size is asked for than of what no sensor has.
    rule, delay = DecisionRule(), screening.evidence("sensor_delay")
    assert rule.least_size(problem, delay) == rule.size_usual < rule.size
    assert rule.least_size(problem, screening.evidence("plain")) == rule.size


def test_p_values_are_uniform_where_the_model_is_right():
    """Measurements drawn of the model: noise, slices that vary, a usual delay, a mesh as unsure.

    With so much noise that every second measurement gains something; a measurement by which no
    cause gains has a p-value of 1."""
    rng, values = np.random.default_rng(0), []
    for _ in range(100):
        made = sensitivities()
        mesh, delay = rng.normal(size=2)
        for r in made.records:
            _, toughness, of_mesh, of_delay = r.columns[:, 0, :4].T
            y = 3.0 * rng.normal() * toughness + mesh * of_mesh + delay * of_delay
            r.measured = (y + 10.0 * NOISE * rng.normal(size=ROWS))[:, None]
        problem = LinearProblem(made, [ChannelNoise(1e-6, 0.01, 10.0 * NOISE)], np.array([3.0]))
        values.append(screen(problem, 100).p_value)
    p = np.array(values)
    # Kolmogorov and Smirnov's distance at 1 % of 100 values.
    for x in (0.05, 0.1, 0.2, 0.3):
        assert (p <= x).mean() == pytest.approx(x, abs=0.163)
    assert 0.02 <= (p <= 0.1).mean() <= 0.2
    assert (p <= 0.02).mean() <= 0.08


def test_units_and_the_order_of_records_change_no_size():
    """Forces in mN, torques in another unit, records the other way round."""
    made = sensitivities(plain=2.0)
    rng = np.random.default_rng(3)
    for r in made.records:
        r.measured = r.measured + NOISE * rng.normal(size=(ROWS, 1))
    e = screened(made)[1].evidence("plain")
    milli = [
        dc.replace(
            r, measured=1e3 * r.measured, predicted=1e3 * r.predicted, columns=1e3 * r.columns
        )
        for r in made.records[::-1]
    ]
    problem = LinearProblem(
        Sensitivities(made.columns, milli), [ChannelNoise(1e-3, 0.01, 1e3 * NOISE)], np.array([3.0])
    )
    again = screen(problem, 100).evidence("plain")
    assert again.size == pytest.approx(e.size, rel=0.01)
    assert again.gain == pytest.approx(e.gain, rel=0.01)
    # Over the noise alone, where nothing else is wrong.
    rows = 2.0 * 0.05 / np.sqrt(2.0) / NOISE
    assert e.size == pytest.approx(rows, rel=0.15)


def test_a_cause_that_never_gains_by_chance_is_not_proved_by_next_to_nothing():
    evidence = CauseEvidence("x", 0.4, 0.0, 0.0, 0.0, None, [Column("cause", "x")], [1.0], [1.0])
    assert evidence.deviations == pytest.approx(0.8)
    found = sensitivities(plain=1.5)
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
