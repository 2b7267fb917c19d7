"""A cause that bends within its range is judged by what it does at the size that was found."""

import dataclasses as dc

import numpy as np
import pytest
from curve_simulation import HELD, TIME, CurveSimulation, Force, curve_record

from sliceit_drake.diagnosis.causes.material import SlicePushLaw
from sliceit_drake.diagnosis.causes.mounting import ArmCompliance, BoardHeight, BoardLaw
from sliceit_drake.diagnosis.evidence.at_size import ROUNDS, AtSize
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.confirm import Confirmation
from sliceit_drake.diagnosis.evidence.held_out import held_out_gain
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.verdict import Verdict, reach_verdict
from sliceit_drake.diagnosis.result import Diagnosis

DRAWS = {"press": 0.0, "draw_1": 1.0, "draw_2": 2.0}
COLUMN = Column("cause", "slice_push_law", "exponent", size=0.25, low=-1.0, high=2.0)
SKIN = np.exp(-(((TIME - 0.2) / 0.1) ** 2))
OTHERS = [Column("base", "material.toughness", size=0.05), Column("cause", "skin", "toughness")]


def force(condition: str, exponent: float) -> np.ndarray:
    """Work by area, helped by the draw less or more than that says."""
    xi = DRAWS[condition]
    texture = 1.0 + 0.1 * np.sin(20.0 * TIME)
    return 8.0 * (1.0 + xi**2) ** -(1.0 + exponent) * texture * np.minimum(TIME / 0.3, 1.0)


def problem_of(hidden: float, column: Column = COLUMN) -> LinearProblem:
    """Records of a hidden exponent, beside a toughness of all and a skin."""
    records = []
    for condition in DRAWS:
        for k in range(3):
            r = curve_record(force, column, condition, k, hidden)
            more = np.stack([0.05 * r.predicted[:, 0], SKIN], axis=1)[:, None]
            columns = np.concatenate([r.columns, more], axis=2)
            even = np.concatenate([r.even, np.zeros_like(more)], axis=2)
            records.append(dc.replace(r, columns=columns, even=even))
    return LinearProblem(Sensitivities([column, *OTHERS], records))


def judged(
    hidden: float, column: Column = COLUMN, simulated: Force = force
) -> tuple[LinearProblem, Verdict, CurveSimulation]:
    problem = problem_of(hidden, column)
    simulation = CurveSimulation(problem.found.records, simulated)
    at_size = AtSize(simulation, {"slice_push_law": SlicePushLaw()})
    return problem, reach_verdict(problem, 60, at_size=at_size), simulation


def value(verdict: Verdict) -> float:
    e = verdict.screening.evidence("slice_push_law")
    return e.coefficients[0] * e.columns[0].size


def test_an_exponent_that_derivatives_put_out_of_range_is_found_in_it():
    problem, after, _ = judged(-0.8)
    before = reach_verdict(problem, 60)
    assert before.names == [] and value(before) < -1.0
    assert after.names == [["slice_push_law"]]
    assert value(after) == pytest.approx(-0.8, abs=0.1)
    assert after.screening.evidence("slice_push_law").gain > before.screening.causes[0].gain
    # A later step of the diagnosis goes on from what was seen there.
    e = after.findings[0].evidence
    own = after.problem.found.of_causes([e.cause])
    for record in after.problem.found.records:
        predicted = record.predicted + record.columns[:, :, own] @ e.coefficients
        truth = force(record.condition, -0.8)
        assert np.abs(predicted[:, 0] - truth).max() < 0.05 * truth.max()


def test_what_is_beyond_the_range_is_refused_and_seen_no_farther_than_its_end():
    column = Column("cause", "slice_push_law", "exponent", size=0.25, low=-0.5, high=2.0)
    _, after, simulation = judged(-0.8, column)
    assert after.names == []
    assert after.causes[0].why == "exponent would be at a bound"
    values = [a.values["exponent"] for p in simulation.points for a in p.causes]
    assert min(values) == pytest.approx(-0.5)


def test_what_is_small_or_absent_is_simulated_no_more_and_the_rest_a_few_times():
    for hidden in (0.0, 0.1):
        problem, after, simulation = judged(hidden)
        assert simulation.points == [] and after.problem is problem
    assert judged(0.0)[1].kind == "nothing"
    _, _, simulation = judged(-0.8)
    assert 1 <= sum(bool(p.causes) for p in simulation.points) <= ROUNDS


def test_a_slice_that_breaks_down_there_keeps_its_derivatives():
    def breaks(condition: str, exponent: float) -> np.ndarray:
        whole = force(condition, exponent)
        return whole * np.nan if exponent and condition == "draw_2" else whole

    problem, verdict, _ = judged(-0.8, simulated=breaks)
    for before, after in zip(problem.found.records, verdict.problem.found.records, strict=True):
        same = np.array_equal(before.columns, after.columns)
        assert same == (before.condition != "draw_1")


def pressed(condition: str, compliance: float, creep: float) -> np.ndarray:
    """A board of 300 kN/m under an arm that gives, at once and more with time."""
    given = compliance + creep * -np.expm1(-np.maximum(TIME - 2.0, 0.0) / 0.5)
    return np.where(HELD, 8.0 / (1.0 + 3e5 * given), 8.0) * np.minimum(TIME / 0.3, 1.0)


def pressed_problem(compliance: float, creep: float, columns: list[Column]) -> LinearProblem:
    """Records of a board that is pressed; what a column does is what its size does."""
    records = []
    for k in range(6):
        r = curve_record(lambda c, _: pressed(c, compliance, creep), COLUMN, "press", k, 0.0)
        zero = pressed("press", 0.0, 0.0)
        ends = [pressed("press", *(columns[i].size * np.eye(2)[i])) - zero for i in range(2)]
        own = np.stack([0.05 * zero, *ends, SKIN], axis=1)[:, None]
        records.append(dc.replace(r, predicted=zero[:, None], columns=own, even=np.zeros_like(own)))
    return LinearProblem(Sensitivities([OTHERS[0], *columns, OTHERS[1]], records))


def test_two_numbers_of_which_one_seems_absent_are_found_where_their_effect_saturates():
    """By the whole size of one, the force falls three quarters; what is hidden is a tenth of it."""
    columns = [
        Column("cause", "arm_compliance", p.name, 0.5, p.size, p.unit, True, low=0.0, high=p.high)
        for p in ArmCompliance.parameters
    ]
    hidden = 1e-6, 1.5e-6
    problem = pressed_problem(*hidden, columns)
    simulation = CurveSimulation(problem.found.records, pressed, ("compliance", "creep"))
    at_size = AtSize(simulation, {"arm_compliance": ArmCompliance()})
    before, after = (reach_verdict(problem, 60, at_size=a) for a in (None, at_size))
    assert after.names == [["arm_compliance"]]
    assert before.findings[0].evidence.coefficients[1] == 0.0
    e = after.findings[0].evidence
    found = [g * c.size for g, c in zip(e.coefficients, e.columns, strict=True)]
    assert found == pytest.approx(hidden, rel=0.15)
    assert after.own_error < 0.5 * before.own_error


BOARD = [
    Column("cause", cause.name, p.name, size=p.size, unit=p.unit, low=p.low, high=p.high)
    for cause in (BoardHeight, BoardLaw)
    for p in cause.parameters
]
ENDS = {"onto": 5e-5, "into": 1.5e-4, "far into": 3e-4}
"""How far into the board the knife is driven, metres."""


def on_board(
    condition: str, height: float = 0.0, share: float = 0.0, exponent: float = 0.0
) -> np.ndarray:
    """A cut that ends in a board of 100 kN/m, which may lie higher or be stiffer."""
    depth = np.minimum(TIME / 2.0, 1.0) * (0.02 + ENDS[condition])
    board = 1e5 * np.maximum(depth + height - 0.02, 0.0) * (1.0 + share)
    stiffer = np.where(board > 0.0, (np.maximum(board, 1e-9) / 5.0) ** exponent, 1.0)
    return 4.0 * np.minimum(TIME / 0.3, 1.0) + board * stiffer


def test_a_board_that_lies_higher_is_simulated_where_a_stiffer_one_explains_nearly_as_much():
    """A height's column is the mean of what 0.2 mm do up and down: down, nothing is touched."""
    records = []
    for k, condition in enumerate([*ENDS] * 3):
        r = curve_record(lambda c, _: on_board(c, 8e-5), COLUMN, condition, k, 0.0)
        zero = on_board(condition)
        own = [0.05 * zero]
        for step in np.diag([c.size for c in BOARD]):
            own.append(0.5 * (on_board(condition, *step) - on_board(condition, *-step)))
        columns = np.stack([*own, SKIN], axis=1)[:, None]
        new = dict(predicted=zero[:, None], columns=columns, even=np.zeros_like(columns))
        records.append(dc.replace(r, **new))
    problem = LinearProblem(Sensitivities([OTHERS[0], *BOARD, OTHERS[1]], records))
    simulation = CurveSimulation(records, on_board, [c.parameter for c in BOARD])
    at_size = AtSize(simulation, {c.name: c() for c in (BoardHeight, BoardLaw)})
    before, after = (reach_verdict(problem, 60, at_size=a) for a in (None, at_size))
    found = [v.screening.evidence("board_height").coefficients[0] * 2e-4 for v in (before, after)]
    assert found[0] > 1.2e-4
    assert found[1] == pytest.approx(8e-5, rel=0.02)
    assert after.names[0][0] == "board_height"


@pytest.fixture
def result() -> Diagnosis:
    _, verdict, _ = judged(-0.8)
    problem, cause = verdict.problem, SlicePushLaw()
    gain = held_out_gain(problem, verdict.named)
    return Diagnosis(verdict, problem, None, {cause.name: cause}, {}, gain, [])


def test_a_number_that_simulations_take_to_a_bound_refutes_its_cause(result):
    values = {"slice_push_law": {"exponent": -0.8, "pull": 0.0}}
    result.confirmation = Confirmation(result.problem, values, {}, 1.0, 1.0)
    assert result.refuted() == {}
    values["slice_push_law"]["exponent"] = -1.0
    assert result.refuted() == {"slice_push_law": "a simulation takes exponent to a bound"}


def test_a_file_that_clearly_predicts_left_out_records_worse_refutes_its_cause(result):
    assert result.gain.interval[0] > 0.0 and result.refuted() == {}
    result.gain = dc.replace(result.gain, interval=(-0.5, 0.1))
    assert result.refuted() == {}
    result.gain = dc.replace(result.gain, interval=(-0.5, -0.1))
    assert list(result.refuted()) == ["slice_push_law"]
    result.verdict.kind = "unknown"
    assert result.refuted() == {}


def test_by_the_file_of_another_food_no_cause_is_named_whose_file_is_not_clearly_better(result):
    result.shifts = {"material.friction": (3.0, 0.3), "material.toughness": (2.53, 0.03)}
    assert result.gain.interval[0] > 0.0 and result.refuted() == {}
    result.gain = dc.replace(result.gain, interval=(-0.96, 0.04))
    for factor in (2.53, 0.4):
        result.shifts["material.toughness"] = (factor, 0.03)
        why = f"the file is of another food: material.toughness times {factor:.2f}"
        assert result.refuted() == {"slice_push_law": why}
    # What the records hardly tell may be anywhere.
    del result.shifts["material.toughness"]
    assert result.refuted() == {}
    result.shifts["material.toughness"] = (0.4, 0.03)
    (finding,) = result.verdict.findings
    finding.evidence.columns = [dc.replace(c, per_record=True) for c in finding.evidence.columns]
    assert finding.evidence.per_record and result.refuted() == {}
