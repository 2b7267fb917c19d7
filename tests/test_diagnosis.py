"""A diagnosis finds what is hidden, is silent where nothing is, and says what it cannot know.

Synthetic records: the sensitivities are given shapes, so that no slice is simulated.
"""

import dataclasses as dc
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from curve_simulation import TIME, curve_record
from synthetic_records import COLUMNS, NOISE, ROWS, SPEEDS, VARIATION, record

from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.effect_size import (
    OwnError,
    size_by_record,
    standardised_size,
)
from sliceit_drake.diagnosis.evidence.held_out import fitted_changes, foretells, held_out_gain
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.evidence.screen import screen
from sliceit_drake.diagnosis.evidence.verdict import (
    CLASS_ANGLE,
    LAW,
    STRONG,
    DecisionRule,
    Verdict,
    reach_verdict,
)
from sliceit_drake.diagnosis.result import Diagnosis
from studies.hidden_effects.sizes import effect_in_noise


def problem(
    seed: int,
    replicates: int = 3,
    speeds: tuple[float, ...] = SPEEDS,
    unknown: float = 0.0,
    **hidden: float,
) -> LinearProblem:
    rng = np.random.default_rng(seed)
    renamed = {name.replace("_at_", "").replace("p", "."): x for name, x in hidden.items()}
    names = {"rate", "skin", "fading0.2", "fading1.0"}
    renamed = {
        n if n in names else next(m for m in names if m[:4] == n[:4]): x for n, x in renamed.items()
    }
    records = [
        record(f"slice {k} at {speed}", speed, rng, renamed, unknown)
        for speed in speeds
        for k in range(replicates)
    ]
    return LinearProblem(Sensitivities(COLUMNS, records))


def test_noise_is_that_of_replicates_whatever_the_model_gets_wrong():
    for hidden in ({}, {"rate": 1.0, "skin": 3.0}):
        noise = problem(1, replicates=6, **hidden).noise[0]
        assert noise.deviation == pytest.approx(NOISE, rel=0.2)
        assert noise.tau == pytest.approx(-3.0 / (ROWS - 1) / np.log(0.9), rel=0.5)


def test_a_problem_with_other_columns_is_that_which_is_made_anew():
    whole = problem(3, rate=1.0)
    rate = whole.found.index("cause", "rate")
    whole.fitted_sizes(rate)
    records = []
    for r in whole.found.records:
        columns = r.columns.copy()
        columns[:, :, rate] *= 1.0 + r.depth[:, None, None] / r.depth.max()
        records.append(dc.replace(r, columns=columns))
    corrected = whole.correcting(records, rate)
    found = dc.replace(whole.found, records=records)
    anew = LinearProblem(found, whole.noise, whole.variation)
    np.testing.assert_allclose(corrected.moments.gram, anew.moments.gram, rtol=1e-9)
    np.testing.assert_allclose(corrected.moments.force_gram, anew.moments.force_gram, rtol=1e-9)
    for causes in ([], rate):
        assert corrected.fitted_sizes(causes)[1] == pytest.approx(anew.fitted_sizes(causes)[1])
    assert whole.fitted_sizes(rate)[1] != pytest.approx(corrected.fitted_sizes(rate)[1])


def test_the_weights_of_a_channel_are_the_inverse_of_its_covariance():
    noise = ChannelNoise(0.3, 0.2, 0.1)
    time = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 40))
    V = 0.09 * np.exp(-np.abs(time[:, None] - time) / 0.2) + 0.01 * np.eye(40)
    np.testing.assert_allclose(noise.solve(time, V), np.eye(40), atol=1e-9)


def test_variation_between_slices_is_that_of_replicates():
    found = problem(2, replicates=12)
    assert found.variation[0] == pytest.approx(VARIATION / 0.05, rel=0.3)


def test_a_jump_of_the_force_may_come_a_row_late():
    whole = problem(3)
    squares = []
    for late in (0, 1):
        records = []
        for r in whole.found.records:
            rows = np.arange(len(r.time))[:, None]
            predicted, measured = (
                np.where(rows >= first, 50.0, 0.0) for first in (105, 105 + late)
            )
            moved = dc.replace(r, predicted=r.predicted + predicted, measured=r.measured + measured)
            records.append(moved)
        found = Sensitivities(whole.found.columns, records)
        same = LinearProblem(found, whole.noise, whole.variation)
        squares.append(same.moments.gram[0][-1, -1])
    assert squares[1] - squares[0] == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_named_where_nothing_is_hidden(seed):
    assert reach_verdict(problem(10 + seed), 60, seed).kind == "nothing"


def test_slices_that_differ_are_no_effect_of_the_speed():
    """With records at few speeds a test by samples calls most differences between slices an effect
    of the speed; one by records must not."""
    kinds = [
        reach_verdict(problem(100 + seed, speeds=(0.01, 0.04)), 60, seed).kind for seed in range(12)
    ]
    assert kinds.count("nothing") >= 11


@pytest.mark.parametrize(
    ("hidden", "name"),
    [({"rate": 2.0}, "rate"), ({"skin": 2.5}, "skin"), ({"fading_at_1p0": 0.5}, "fading")],
)
def test_a_hidden_cause_is_named_with_its_size_and_its_class(hidden, name):
    verdict = reach_verdict(problem(20, **hidden), 60)
    assert verdict.kind == "cause"
    (finding,) = verdict.findings
    expected = {"skin", "skin_like"} if name == "skin" else {name}
    assert name in finding.names and set(finding.names) <= expected
    amount = next(iter(hidden.values()))
    if finding.evidence.name == name:
        error = 4.0 * finding.evidence.errors[0]
        assert finding.evidence.coefficients[0] == pytest.approx(amount, abs=error + 0.1 * amount)
    found = problem(20, **hidden)
    gain = held_out_gain(found, [(finding.evidence.name, finding.evidence.scan)])
    assert gain.share > 0.8 and gain.after < gain.before
    assert gain.after == pytest.approx(NOISE, rel=0.3)


def test_two_hidden_causes_are_both_named():
    verdict = reach_verdict(problem(30, rate=2.5, fading_at_1p0=0.6), 60)
    assert verdict.kind == "causes"
    assert {f.evidence.name for f in verdict.findings} == {"rate", "fading"}


def bump(at: float) -> np.ndarray:
    return np.exp(-(((TIME - at) / 0.008) ** 2))


def two_causes(
    one: float,
    other: float,
    shape: np.ndarray,
    names: tuple[str, str] = ("one", "other"),
    wrong: float = 0.0,
) -> LinearProblem:
    """Records with so much of a cause that is a bump at 1 s, of another of this shape, and of what
    the simulation gets wrong along depth, N."""
    kinds = [Column("base", "material.toughness", size=0.05)]
    kinds += [Column("cause", name, "height", size=0.2) for name in (*names, "absent")]
    records, zero = [], np.full(len(TIME), 5.0)
    shapes = 0.2 * bump(1.0), 0.2 * shape, 0.2 * bump(0.7)
    own = np.stack([0.05 * zero, *shapes], axis=1)[:, None]
    law = wrong * np.sin(3.0 * np.pi * TIME / TIME[-1])
    true = zero + one * bump(1.0) + other * shape + law
    for k in range(6):
        r = curve_record(lambda *_: true, kinds[1], "press", k, 0.0)
        records.append(dc.replace(r, predicted=zero[:, None], columns=own, even=np.zeros_like(own)))
    return LinearProblem(Sensitivities(kinds, records))


@pytest.mark.parametrize(("height", "names"), [(0.12, ["one", "other"]), (0.4, ["one"])])
def test_causes_that_weak_evidence_does_not_part_are_one_group(height, names):
    """Their shapes are 20 degrees apart: that shows where the effect is large."""
    whole = two_causes(height, 0.0, bump(1.0028))
    verdict = reach_verdict(whole, 60)
    first = verdict.screening.causes[0]
    assert verdict.screening.angle_to(whole, first, "other") > CLASS_ANGLE
    assert verdict.names == [names]


def test_causes_that_do_nothing_in_common_are_two_findings_however_alike_their_evidence():
    verdict = reach_verdict(two_causes(0.14, 0.18, bump(1.3)), 60)
    gains = [e.gain for e in verdict.screening.causes]
    assert abs(gains[0] - gains[1]) < STRONG
    assert sorted(verdict.names) == [["one"], ["other"]]


@pytest.mark.parametrize(("wrong", "names"), [(0.2, []), (0.0, [["skin"]])])
def test_where_the_law_is_wrong_what_is_locked_to_depth_has_to_gain_most(wrong, names):
    """A ripple gains more, and is too small to be named."""
    ripple = np.sin(40.0 * np.pi * TIME)
    verdict = reach_verdict(two_causes(0.5, 0.05, ripple, ("skin", "ripple"), wrong), 60)
    ripples, skin = verdict.screening.causes[:2]
    assert ripples.name == "ripple" and ripples.gain > skin.gain > 200.0 and skin.size > 1.5
    assert verdict.names == names


@pytest.mark.parametrize(("elsewhere", "name"), [(0.3, "whole"), (0.1, "local")])
def test_no_cause_is_named_for_a_part_of_what_one_with_more_evidence_does(elsewhere, name):
    """What acts everywhere is small in the mean of its rows; where it acts most, another cause can
    do the same. It is named in that one's place unless it is far too small."""
    everywhere = bump(1.0) + elsewhere * np.sin(40.0 * np.pi * TIME)
    verdict = reach_verdict(two_causes(0.0, 0.3, everywhere, ("local", "whole")), 60)
    whole, local = verdict.screening.causes[:2]
    assert whole.name == "whole" and whole.gain > 2.0 * local.gain
    assert whole.size < DecisionRule.size < local.size
    assert verdict.names == [[name]]


def test_a_number_that_the_own_error_may_stand_for_is_seen_once_the_others_are_in_the_model():
    """One does much and the other little, both in shapes that the simulation may be wrong by."""
    shapes = two_causes(0.0, 0.0, bump(1.3)).shape_values[0]
    much = 3.0 * (shapes[:, 0] + shapes[:, 1] - shapes[:, 2])
    little = 0.5 * shapes[:, 3:10] @ [1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0]
    own = {"size": 1.0, "one_sided": True, "low": 0.0}
    kinds = [Column("base", "material.toughness", size=0.05)]
    kinds += [Column("cause", "arm", name, **own) for name in ("much", "little")]
    records, zero = [], np.full(len(TIME), 5.0)
    columns = np.stack([0.05 * zero, much, little], axis=1)[:, None]
    for k in range(6):
        r = curve_record(lambda *_: zero + much + little, kinds[1], "press", k, 0.0)
        even = np.zeros_like(columns)
        records.append(dc.replace(r, predicted=zero[:, None], columns=columns, even=even))
    (arm,) = screen(LinearProblem(Sensitivities(kinds, records)), 20).causes
    assert arm.coefficients == pytest.approx([1.0, 1.0], rel=0.03)


def bounded(stands_for_rate: bool, rate: float = 2.5, skin: float = 2.5) -> LinearProblem:
    """A rate that is beyond its range, and a skin that acts as a part of it does, or is there."""
    found = problem(31, rate=rate, skin=0.0 if stands_for_rate else skin).found
    names = [c.name for c in found.columns]
    of_rate, of_skin = names.index("rate"), names.index("skin")
    range_of = {"rate": {"low": -0.1, "high": 0.1}, "skin": {"one_sided": False}}
    columns = [
        dc.replace(c, **range_of.get(c.name, {})) for c in found.columns if c.name != "skin_like"
    ]
    kept = [k for k, name in enumerate(names) if name != "skin_like"]
    records = []
    for r in found.records:
        values = r.columns.copy()
        if stands_for_rate:
            values[:, :, of_skin] = values[:, :, of_rate] * (0.9 + 0.1 * (r.time < 1.0))[:, None]
        records.append(dc.replace(r, columns=values[:, :, kept], even=r.even[:, :, kept]))
    return LinearProblem(Sensitivities(columns, records))


def test_a_cause_that_stands_for_one_at_its_bound_is_not_named():
    verdict = reach_verdict(bounded(True), 60)
    why = {c.name: c.why for c in verdict.causes}
    assert not verdict.names
    assert why["rate"] == "exponent would be at a bound"
    assert why["skin"].endswith("beside rate: exponent would be at a bound")


def test_a_cause_is_named_beside_one_at_its_bound_where_it_gains_by_itself():
    assert reach_verdict(bounded(False), 60).names == [["skin"]]


@pytest.mark.parametrize(("within", "named"), [(1.005, []), (1.03, [["rate"]])])
def test_a_number_a_hair_inside_its_range_is_at_its_bound(within, named):
    """A fit that strives beyond the end comes to rest there, on either side of it."""
    problem = bounded(True)
    columns = problem.found.columns
    rate = [c.name for c in columns].index("rate")
    columns[rate] = dc.replace(columns[rate], low=-9.0, high=9.0)
    e = reach_verdict(problem, 60).screening.evidence("rate")
    at = e.coefficients[0] * columns[rate].size
    columns[rate] = dc.replace(columns[rate], high=within * at)
    assert reach_verdict(problem, 60).names == named


def test_a_cause_that_simulations_refute_is_not_named_nor_one_that_stands_for_it():
    for problem in (bounded(True), bounded(False)):
        rate = [c.name for c in problem.found.columns].index("rate")
        problem.found.columns[rate] = dc.replace(problem.found.columns[rate], low=-9.0, high=9.0)
        assert ["rate"] in reach_verdict(problem, 60).names
    assert reach_verdict(bounded(True), 60, refuted={"rate": "no"}).names == []
    verdict = reach_verdict(problem, 60, refuted={"rate": "at a bound"})
    assert verdict.names == [["skin"]]
    assert next(c for c in verdict.causes if c.name == "rate").why == "at a bound"


def test_what_a_cause_at_its_bound_does_is_no_own_error_that_hides_another():
    problem = bounded(False, rate=12.0, skin=0.9)
    assert reach_verdict(problem, 60).names == [["skin"]]
    # Over all that the rate does the skin is next to nothing.
    alone = screen(problem, 60).evidence("skin")
    assert alone.size < 0.1 and alone.gain > alone.limit


@pytest.mark.parametrize("shared", [True, False])
def test_a_jump_that_replicates_share_is_no_slip(shared):
    found = problem(43).found
    knock = Column("cause", "slip", "knock", per_record=True, alone=True)
    for k, r in enumerate(found.records):
        pulse = np.exp(-np.abs(r.time - (0.5 if shared else 0.3 + 0.15 * (k % 3))) / 0.03)
        columns = np.concatenate([r.columns, pulse[:, None, None]], axis=2)
        measured, even = r.measured + 1.5 * pulse[:, None], np.zeros_like(columns)
        found.records[k] = dc.replace(r, columns=columns, measured=measured, even=even)
    whole = LinearProblem(Sensitivities([*found.columns, knock], found.records))
    e = screen(whole, 60).evidence("slip")
    assert (e.gain <= e.limit) == shared
    assert (e.presence < 0.4) == shared
    if not shared:
        assert np.median(e.by_record) == pytest.approx(1.5, rel=0.15)


def test_what_differs_from_record_to_record_is_asked_for_less_of_the_noise():
    found = problem(43).found
    hum = Column("cause", "hum", "wave", per_record=True)
    for k, r in enumerate(found.records):
        wave = np.sin(2.0 * np.pi * 12.0 * r.time)[:, None]
        columns = np.concatenate([r.columns, wave[:, :, None]], axis=2)
        measured, even = r.measured + 0.07 * (-1) ** k * wave, np.zeros_like(columns)
        found.records[k] = dc.replace(r, columns=columns, measured=measured, even=even)
    whole = LinearProblem(Sensitivities([*found.columns, hum], found.records))
    assert reach_verdict(whole, 60).names == [["hum"]]
    strict = DecisionRule(size_by_record=DecisionRule.size)
    assert reach_verdict(whole, 60, rule=strict).names == []


def test_what_the_form_of_a_named_cause_leaves_is_no_second_cause():
    """The waves of a saw-tooth along the path are, at one speed, waves of one frequency in time."""
    found, pitch = problem(44).found, 1.5e-3
    saw = [Column("cause", "saw", f"wave_{n}", per_record=True) for n in range(4)]
    hum = [Column("cause", "hum", f"wave_{n}", per_record=True) for n in range(2)]
    for k, r in enumerate(found.records):
        cycles = r.depth / pitch
        inside = r.in_contact & (np.gradient(r.depth, r.time) > 0.0)
        # The pitch is not found exactly, and two harmonics are not a saw-tooth.
        angles = [2.0 * np.pi * n * cycles * 1.001 for n in (1, 2)]
        angles += [2.0 * np.pi * 0.01 / 0.9 / pitch * r.time]
        waves = np.column_stack([f(a) * inside for a in angles for f in (np.sin, np.cos)])
        columns = np.concatenate([r.columns, waves[:, None]], axis=2)
        measured = r.measured + 4.0 * (inside * (np.mod(cycles, 1.0) - 0.5))[:, None]
        even = np.zeros_like(columns)
        found.records[k] = dc.replace(r, columns=columns, measured=measured, even=even)
    whole = LinearProblem(Sensitivities([*found.columns, *saw, *hum], found.records))
    verdict = reach_verdict(whole, 60)
    assert verdict.names == [["saw"]]
    assert "without saw" in next(c.why for c in verdict.causes if c.name == "hum")
    assert ["hum"] in reach_verdict(whole, 60, rule=DecisionRule(left=0.0)).names


def test_the_report_draws_no_evidence_where_there_is_none():
    """A gain of nothing is no bar, and one that chance never gives is not infinite."""
    cause = SimpleNamespace(parameter=lambda name: SimpleNamespace(null=0.0))
    for whole in (problem(10), problem(40, unknown=1.5)):
        verdict = reach_verdict(whole, 60)
        causes = dict.fromkeys((e.name for e in verdict.screening.causes), cause)
        result = Diagnosis(verdict, whole, None, causes, {}, None, [])
        most = max(e.gain for e in verdict.screening.causes)
        assert min(e.gain for e in verdict.screening.causes) == 0.0 and not verdict.findings
        for axis in (result.plot_evidence().axes[0], result.plot_overview().axes[2]):
            widths = [bar.get_width() for bar in axis.patches]
            assert min(widths) == 0.0 and max(widths) <= most and axis.get_xlim()[0] == 0.0


def test_a_shift_is_told_only_where_what_is_wrong_is_understood():
    shifts = {"material.toughness": (1.5, 0.01)}
    for whole, told in ((problem(10), True), (problem(40, unknown=1.5), False)):
        verdict = reach_verdict(whole, 60)
        assert verdict.kind == ("nothing" if told else "unknown")
        result = Diagnosis(verdict, whole, None, {}, shifts, None, [])
        assert ("Shift of material.toughness" in result.table()) == told


def test_what_no_cause_explains_is_unknown():
    assert reach_verdict(problem(40, unknown=1.5), 60).kind == "unknown"


def wrong_along_depth(of_skin: float, of_rate: float) -> Verdict:
    """Of records whose force is wrong along depth, where two causes do that and this much else."""
    found = problem(41).found
    names = [c.name for c in found.columns]
    for k, r in enumerate(found.records):
        turns = 2.0 * np.pi * np.clip(r.depth, 0.0, None) / 0.03
        wrong, else_ = (1.2 * wave(turns) * r.in_contact for wave in (np.sin, np.cos))
        columns = r.columns.copy()
        columns[:, 0, names.index("skin")] = wrong + of_skin * else_
        columns[:, 0, names.index("rate")] = wrong + of_rate * else_
        found.records[k] = dc.replace(r, columns=columns, measured=r.measured + wrong[:, None])
    return reach_verdict(LinearProblem(found), 60)


def test_a_law_that_is_wrong_along_depth_is_set_beside_all_that_may_do_as_much():
    both, skin = wrong_along_depth(0.5, 0.45), wrong_along_depth(0.5, 0.6)
    assert both.kind == skin.kind == "unknown"
    assert both.findings[0].names == ["skin", "rate", LAW] and both.reason.endswith(", or rate")
    assert skin.findings[0].names == ["skin", LAW]


def test_less_gain_is_asked_for_where_the_simulation_is_right():
    whole = problem(20, rate=2.0)
    verdict = reach_verdict(whole, 60)
    by_record = verdict.findings[0].evidence.gain / len(whole.found.records)
    assert verdict.misfit < DecisionRule.right
    for factor, names in ((0.9, [["rate"]]), (1.1, [])):
        rule = DecisionRule(gain=factor * by_record / DecisionRule.right)
        assert reach_verdict(whole, 60, rule=rule).names == names


def test_a_cause_in_the_air_is_found_where_the_law_is_wrong():
    """What the law gets wrong in contact asks for no more evidence of what acts in the air."""
    found = problem(41, unknown=1.5).found
    rate = [c.name for c in found.columns].index("rate")
    for k, r in enumerate(found.records):
        up = np.sin(np.pi * r.time / 0.3) * ~r.in_contact
        columns = r.columns.copy()
        columns[:, 0, rate] = up
        measured = r.measured + 0.2 * up[:, None]
        found.records[k] = dc.replace(r, columns=columns, measured=measured)
    assert [f.evidence.name for f in reach_verdict(LinearProblem(found), 60).findings] == ["rate"]
    strict = reach_verdict(LinearProblem(found), 60, rule=DecisionRule(gain=30.0))
    why = {c.name: c.why for c in strict.causes}
    assert strict.kind == "unknown" and "a law as wrong as this" in why["rate"]


def foretold(sign: Callable[[int], float]) -> tuple[bool, float]:
    """Whether a wave that all records have alike in the air, but for a sign, foretells records that
    were left out, and what it removes in contact. There the food hides it, and the law is wrong by
    as much the other way."""
    found = problem(42, replicates=4).found
    rate = [c.name for c in found.columns].index("rate")
    for k, r in enumerate(found.records):
        wave, air = 2.0 * NOISE * np.sin(8.0 * r.time), ~r.in_contact
        columns = r.columns.copy()
        columns[:, 0, rate] = wave
        rest = r.measured[:, 0] + wave * np.where(air, sign(k), -0.5)
        found.records[k] = dc.replace(r, columns=columns, measured=rest[:, None])
    noise = ChannelNoise(NOISE, 0.1, 0.1 * NOISE, ChannelNoise(0.01 * NOISE, 0.1, 0.1 * NOISE))
    for r in found.records:
        r.depth = np.where(r.in_contact, r.depth, -0.01)
    whole = LinearProblem(found, [noise])
    cause = "rate", None
    wrong = OwnError.beside(whole, [cause])
    return foretells(whole, cause, [], wrong), held_out_gain(whole, [cause]).share


def test_a_cause_in_the_air_foretells_records_whatever_the_food_hides():
    foretells_them, in_contact = foretold(lambda k: 1.0)
    assert foretells_them and in_contact < 0.0


def test_a_cause_that_differs_from_record_to_record_foretells_none():
    assert not foretold(lambda k: (-1.0) ** k)[0]


@pytest.mark.parametrize("in_air", [1.0, 0.0])
def test_a_cause_that_shows_where_food_is_cut_and_not_in_the_air_foretells_none(in_air):
    """As what a sensor with a play shows, which a drift explains, but for records of the air."""
    found = problem(42, replicates=4).found
    rate = [c.name for c in found.columns].index("rate")
    rng = np.random.default_rng(0)
    for k, r in enumerate(found.records):
        columns, wave = r.columns.copy(), 2.0 * NOISE * np.sin(8.0 * r.time)
        changed = dict(measured=r.measured + wave[:, None])
        if k % 4 == 0:
            columns *= 0.0
            rest = NOISE * rng.normal(size=len(wave)) + in_air * wave
            changed = dict(measured=r.predicted + rest[:, None], in_contact=r.in_contact & False)
        columns[:, 0, rate] = wave
        found.records[k] = dc.replace(r, columns=columns, even=0.0 * columns, **changed)
    whole, cause = LinearProblem(found), ("rate", None)
    assert foretells(whole, cause, [], OwnError.beside(whole, [cause])) == bool(in_air)


@pytest.mark.parametrize(("slow", "white"), [(0.99, 0.1), (0.1, 0.99)], ids=["slow", "white"])
def test_a_wave_is_as_large_as_over_the_noise_at_its_frequency(slow, white):
    """The power of noise with an exponential autocovariance at 20 Hz, in closed form."""
    found, wave = problem(3).found, 0.04
    skin = [c.name for c in found.columns].index("skin")
    for k, r in enumerate(found.records):
        columns = r.columns.copy()
        columns[:, 0, skin] = wave * np.sin(2.0 * np.pi * 20.0 * r.time)
        found.records[k] = dc.replace(r, columns=columns)
    noise = ChannelNoise(0.1 * slow, 0.1, 0.1 * white)
    whole = LinearProblem(found, [noise], np.array([0.1]))
    keep, turn = np.exp(-0.01 / noise.tau), 2.0 * np.pi * 20.0 * 0.01
    power = noise.white**2 + noise.ar**2 * (1.0 - keep**2) / (
        1.0 - 2.0 * keep * np.cos(turn) + keep**2
    )
    ones = np.ones((len(found.records), 1))
    size = size_by_record(whole, [skin], ones)
    assert size == pytest.approx(wave / np.sqrt(2.0 * power), rel=0.1)
    assert size >= standardised_size(whole, [skin], ones)


def test_what_a_named_cause_can_do_is_no_size_of_the_next_one():
    whole = problem(3)
    skin, alike, rate = (whole.found.index("cause", n)[0] for n in ("skin", "skin_like", "rate"))
    one = np.ones(1)
    alone, beside_other, beside_it = (
        standardised_size(whole, [skin], one, beside=b) for b in ([], [rate], [alike])
    )
    # The two fall off by 2 and 1.8 mm; a rate is all that the base is, and goes with the speed.
    assert beside_it < 0.15 * alone and beside_other > 0.6 * alone


def test_noise_is_estimated_anew_beside_an_effect_that_differs_by_record():
    found = problem(4, replicates=6).found
    rate = [c.name for c in found.columns].index("rate")
    amounts = np.random.default_rng(4).normal(size=(len(found.records), 1))
    for k, r in enumerate(found.records):
        columns = r.columns.copy()
        columns[:, 0, rate] = 5.0 * NOISE * np.sin(2.0 * np.pi * 12.0 * r.time)
        measured = r.measured + amounts[k] * columns[:, :, rate]
        found.records[k] = dc.replace(r, columns=columns, measured=measured)
    whole = LinearProblem(found)
    assert whole.noise[0].deviation > 3.0 * NOISE
    beside_it = whole.with_noise_beside([rate], amounts)
    assert beside_it.noise[0].deviation == pytest.approx(NOISE, rel=0.2)


def test_a_sensor_that_reads_in_steps_is_unsure_by_what_it_rounds():
    found, step = problem(5, replicates=4).found, 0.5
    for k, r in enumerate(found.records):
        depth = np.where(r.in_contact, r.depth, -0.01)
        # Nothing differs among replicates but by rounding.
        measured = step * np.round((r.predicted + 0.1) / step)
        found.records[k] = dc.replace(r, measured=measured, depth=depth)
    noise, r = LinearProblem(found).noise[0], found.records[0]
    assert noise.deviations(r.near).min() >= step / np.sqrt(12.0)
    # Where the force comes to the next step is as good as chance.
    late = step * ((r.time > 1.5) & (r.time < 1.6))[:, None]
    assert (late.T @ noise.solve(r.time, late, 0.0, r.near)).item() < 10.0


def uneven(seed: int, up: float = 0.0) -> Sensitivities:
    """Slices that differ along the cut by ten times the noise in the air, far above the food; there
    alone the column "rate" has a wave, of which `up` is in the force."""
    found = problem(seed, replicates=4, speeds=(0.01, 0.02, 0.04, 0.08, 0.16)).found
    rate = [c.name for c in found.columns].index("rate")
    rng = np.random.default_rng(seed)
    for k, r in enumerate(found.records):
        columns, air = r.columns.copy(), ~r.in_contact[:, None]
        columns[:, 0, rate] = np.where(air[:, 0], np.cos(20.0 * r.time), 0.0)
        quiet = 0.1 * NOISE * rng.normal(size=(ROWS, 1)) + up * columns[:, :1, rate]
        measured = np.where(air, r.predicted + quiet, r.measured)
        depth = np.where(air[:, 0], -0.01, r.depth)
        found.records[k] = dc.replace(r, columns=columns, measured=measured, depth=depth)
    return found


def test_the_noise_in_the_air_is_that_of_the_sensor():
    whole = LinearProblem(uneven(3))
    (noise,) = whole.noise
    assert noise.air is not None
    assert noise.air.deviation == pytest.approx(0.1 * NOISE, rel=0.15)
    assert noise.deviation == pytest.approx(NOISE, rel=0.3)
    record = whole.found.records[0]
    size = np.where(record.near, noise.deviation, noise.air.deviation)
    assert np.array_equal(whole.noise_of(record)[:, 0], size)


def test_what_is_below_the_unevenness_of_food_is_found_in_the_air():
    for up, names in ((0.0, []), (0.2 * NOISE, [["rate"]])):
        assert reach_verdict(LinearProblem(uneven(7, up)), 60).names == names


def test_what_goes_with_the_number_of_the_slice_alone_is_unknown():
    for trend, kind in ((0.0, "nothing"), (0.1, "unknown")):
        found = problem(45, replicates=5).found
        for k, r in enumerate(found.records):
            lean = trend * (k % 5 - 2) * np.sin(r.depth / 3e-3) * r.in_contact
            moved = r.measured + lean[:, None]
            found.records[k] = dc.replace(r, measured=moved, slice_index=k)
        verdict = reach_verdict(LinearProblem(found), 60)
        assert verdict.kind == kind
        assert (verdict.trend is not None) == (trend > 0.0)


def test_without_three_slices_of_a_cut_it_asks_for_more():
    verdict = reach_verdict(problem(50, replicates=2, rate=3.0), 60)
    assert verdict.kind == "too_few_replicates"
    assert verdict.slices_needed == 1


def test_without_replicates_what_is_left_may_be_how_slices_vary():
    verdict = reach_verdict(problem(51, replicates=1), 60)
    assert (verdict.kind, verdict.names, verdict.slices_needed) == ("nothing", [], 2)


def test_a_shift_of_a_base_parameter_is_no_cause():
    shifted = problem(60)
    for r in shifted.found.records:
        r.measured = r.measured + 4.0 * r.columns[:, :, 0]
    assert reach_verdict(LinearProblem(shifted.found), 60).kind == "nothing"


def test_the_size_of_an_effect_is_what_a_refit_leaves_of_it():
    found = problem(70)
    base = found.found.index("base")
    assert effect_in_noise(found, base, np.array([5.0]))[0] < 1e-6
    rate = found.found.index("cause", "rate")
    one, by_record = effect_in_noise(found, rate, np.array([1.0]))
    assert effect_in_noise(found, rate, np.array([2.0]))[0] == pytest.approx(2.0 * one)
    # At the middle speed nothing changes.
    assert by_record.min() < 0.3 * by_record.max()


def test_what_the_model_changes_with_its_cause_follows_the_residual():
    found = problem(80, skin=4.0)
    (change, *_) = fitted_changes(found, [("skin", None)])
    rest = found.found.records[0].residual - change
    assert np.std(rest) == pytest.approx(NOISE, rel=0.3)
    assert np.std(found.found.records[0].residual) > 2.0 * NOISE


def test_sensitivities_of_one_record_only_are_from_what_is_rough():
    rng = np.random.default_rng(0)
    alone = Sensitivities(COLUMNS, [record("only", 0.02, rng, {}, 0.0)])
    found = LinearProblem(alone)
    assert not found.repeated
    assert dc.astuple(found.noise[0])[0] > 0.0
