"""How far replicates scatter in the direction of a cause, as against the model of slices."""

import dataclasses as dc

import numpy as np
import pytest
from scipy.stats import chi2, f
from synthetic_records import COLUMNS
from test_diagnosis import problem

from sliceit_drake.diagnosis.evidence.columns import Sensitivities
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.scatter import Scatter, scatter_of_replicates
from sliceit_drake.diagnosis.evidence.screen import CauseEvidence, screen
from sliceit_drake.diagnosis.evidence.verdict import DecisionRule, reach_verdict

TWO_SIDED = [dc.replace(c, one_sided=False) for c in COLUMNS]


def slices(seed: int, differs: float, shift: float = 0.0, replicates: int = 3) -> LinearProblem:
    """Slices each of which has a skin of its own, of this mean and standard deviation."""
    found = problem(seed, replicates).found
    rng, skin = np.random.default_rng(seed), found.index("cause", "skin")
    own = shift + differs * rng.normal(size=len(found.records))
    records = [
        dc.replace(r, measured=r.measured + x * r.columns[:, :, skin[0]])
        for r, x in zip(found.records, own, strict=True)
    ]
    return LinearProblem(Sensitivities(TWO_SIDED, records))


def seen(some: LinearProblem, name: str = "skin") -> tuple[CauseEvidence, Scatter]:
    e = screen(some, 20).evidence(name)
    return e, scatter_of_replicates(some, e, [])


def test_slices_that_differ_as_the_model_says_scatter_by_a_factor_of_one():
    factors = [seen(problem(seed, 6, skin=1.0))[1].factor for seed in range(12)]
    assert np.mean(factors) == pytest.approx(1.0, abs=0.25)
    # Three conditions of three slices, alike but for the speed.
    assert seen(problem(1, 3, skin=1.0))[1].freedom == pytest.approx(6.0, abs=0.5)


def test_what_slices_have_each_for_themselves_is_seen_in_its_own_direction():
    skin, fading = (seen(slices(4, 0.8, 2.0, 6), name)[1].factor for name in ("skin", "fading"))
    assert skin > 8.0 and fading < 2.5


def test_the_chance_of_a_gain_is_right_where_slices_differ_in_more_than_their_model_says():
    evidence = [seen(slices(seed, 0.8)) for seed in range(60)]
    # By the model alone many of these gains would be beyond chance, where 5 % should be.
    assert np.mean([e.gain > 3.84 for e, _ in evidence]) > 0.3
    by_chance = np.mean([scatter.chance(e.gain, 1) < 0.05 for e, scatter in evidence])
    assert by_chance <= 0.12
    # What all of them have is found all the same.
    found = [seen(slices(seed, 0.8, 4.0)) for seed in range(12)]
    assert np.mean([scatter.chance(e.gain, 1) < 1e-3 for e, scatter in found]) > 0.8


def test_the_chance_is_that_of_an_f_distribution_where_slices_scatter_much():
    for factor, freedom in ((40.0, 3.0), (20.0, 6.0)):
        by_f = f.sf(8.0, 2, freedom)
        assert Scatter(factor, freedom).chance(16.0 * factor, 2) == pytest.approx(by_f, rel=0.05)
    # With the variance known, by chi squared.
    assert Scatter(1.0, 1e3).chance(9.0, 2) == pytest.approx(chi2.sf(9.0, 2), rel=0.3)


def test_what_slices_feign_is_not_named_where_an_error_is_known():
    """Each slice has a skin of its own; in the last case all have one."""
    some = [slices(seed, 2.0) for seed in range(6)]
    some = [LinearProblem(dc.replace(p.found, known_from=9)) for p in some]
    lax = DecisionRule(scatter=1.0)
    feigned = [reach_verdict(p, 60, rule=lax).names for p in some]
    assert sum(any("skin" in group for group in names) for names in feigned) >= 2
    for p in some:
        assert not any("skin" in group for group in reach_verdict(p, 60).names)
    real = LinearProblem(dc.replace(slices(1, 0.2, 8.0).found, known_from=9))
    assert any("skin" in group for group in reach_verdict(real, 60).names)


def test_replicates_that_agree_more_than_they_should_are_little_evidence_and_without_any_is_none():
    agreeing = [Scatter(factor, 6.0).chance(30.0, 1) for factor in (0.01, 0.3, 1.0, 3.0)]
    assert chi2.sf(30.0, 1) < agreeing[0] < agreeing[1] < agreeing[2] < agreeing[3]
    single = problem(1, 1, skin=8.0)
    e, alone = seen(single)
    assert alone.freedom == 0.0 and alone.chance(e.gain, 1) == 1.0
    known = LinearProblem(dc.replace(single.found, known_from=3))
    why = {cause.name: cause.why for cause in reach_verdict(known, 60).causes}
    assert "no slices are cut alike" in why["skin"]
