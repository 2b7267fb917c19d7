"""Effects that are hidden have the strength that is wanted, stay hidden, and are judged fairly."""

import dataclasses as dc
import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import warp
from scipy.stats import binomtest

from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.diagnosis.registry import all_causes
from sliceit_drake.stand_in.effect_registry import EFFECTS, make_effect
from studies.hidden_effects import runner
from studies.hidden_effects.archive import pack, unpack
from studies.hidden_effects.bench import PROTOCOLS, QuietBench, model_food, protocol_named
from studies.hidden_effects.cases import KINDS, PAIRS, Case, Hidden, make_cases
from studies.hidden_effects.report import numbers, plot_curves, report
from studies.hidden_effects.runner import food_file, is_done, run_case
from studies.hidden_effects.score import Judgement, Rate, judge, judge_study
from studies.hidden_effects.sizes import ProtocolSizes, SizeCurve
from studies.hidden_effects.study import StudyOptions, load_cases, prepare
from studies.hidden_effects.truth import BASE_OF, CAUSE_OF, UNKNOWN

COARSE = dc.replace(runner.WORLD, refinement=0.6, time_step=4e-4)


@pytest.fixture(scope="module")
def poor() -> ProtocolSizes:
    return ProtocolSizes("poor", settings=COARSE)


def test_every_effect_is_a_cause_a_shift_or_unknown():
    assert {*CAUSE_OF, *BASE_OF, *UNKNOWN} == set(EFFECTS)
    assert set(CAUSE_OF.values()) <= {cause.name for cause in all_causes()}


@pytest.mark.parametrize("effect", ["skin", "sensor_tilt"])
def test_an_effect_of_a_chosen_size_has_the_strength(poor, effect):
    size = poor.curve(effect).size(2.5)
    (delta,) = poor.strengths(effect, [size])
    assert delta == pytest.approx(2.5, rel=0.05)


def test_a_refit_takes_up_a_shift_of_toughness_and_not_a_skin(poor):
    """Both change the force by as much; of the one a refit leaves little."""
    plain = poor._bench.records()
    change = {}
    for effect, size in (("toughness", 0.15), ("skin", 0.8)):
        records = poor._bench.records([effect], [make_effect(f"{effect}:{size}")])
        forces = [(a.force - b.force) for a, b in zip(records, plain, strict=True)]
        change[effect] = float(np.sqrt(np.mean(np.concatenate(forces) ** 2)))
    left = {e: poor.strengths(e, [s])[0] for e, s in (("toughness", 0.15), ("skin", 0.8))}
    assert left["toughness"] / change["toughness"] < 0.25 * left["skin"] / change["skin"]


def test_a_size_is_found_between_those_known_and_not_beyond():
    curve = SizeCurve("skin", (1.0, 2.0, 4.0), (0.5, 2.0, 1.9))
    assert curve.size(0.25) == pytest.approx(0.5)
    assert curve.size(1.0) == pytest.approx(math.sqrt(2.0))
    assert curve.size(2.5) is None


def test_replayed_cuts_are_those_that_would_be_cut_again():
    """What acts on forces alone is replayed; with an effect that acts on the cut all is cut."""
    bench = QuietBench(protocol_named("poor"), 3, COARSE)
    replayed = bench.records(["flank_adhesion"], [make_effect("flank_adhesion:600")])[2]
    cut = bench.records(
        ["flank_adhesion", "toughness"],
        [make_effect("flank_adhesion:600"), make_effect("toughness:0")],
    )[2]
    assert np.abs(cut.force).max() > 5.0
    assert np.allclose(replayed.force, cut.force, atol=1e-9)


def size_of(protocol: str, effect: str, delta: float) -> float | None:
    """Sizes without any simulation: holder_compliance is never seen."""
    return None if effect == "holder_compliance" else delta * EFFECTS[effect].typical


def test_cases_follow_from_the_seed_and_any_first_part_has_all_kinds():
    cases = make_cases(size_of, ["skin", "core"], seed=4)
    assert cases == make_cases(size_of, ["skin", "core"], seed=4)
    assert cases != make_cases(size_of, ["skin", "core"], seed=5)
    for kind, least in KINDS.items():
        assert sum(c.kind == kind for c in cases) >= least
    assert {c.kind for c in cases[:60]} == set(KINDS)
    assert len({c.name for c in cases}) == len(cases)
    first = [c.hidden[0].effect for c in cases if c.kind == "single"]
    assert set(first[: len(CAUSE_OF) - 1]) == set(CAUSE_OF) - {"holder_compliance"}
    drawn = [h.delta for c in cases if c.kind != "curve" for h in c.hidden if h.delta is not None]
    assert 2.0 <= min(drawn) < 2.1 and 2.9 < max(drawn) <= 3.0
    assert all(c.hidden == () for c in cases if c.kind == "nothing")


def test_only_the_effects_that_are_wanted_are_looked_up_and_hidden():
    asked = set()

    def size(protocol: str, effect: str, delta: float) -> float | None:
        asked.add(effect)
        return size_of(protocol, effect, delta)

    cases = make_cases(size, ["skin"], effects=("skin", "warm_wrist"), protocols=("rich",))
    assert asked == {"skin", "warm_wrist"}
    assert {h.effect for c in cases for h in c.hidden} == asked
    assert {c.kind for c in cases} == {"single", "nothing", "unknown", "curve"}
    assert {c.protocol for c in cases} == {"rich"}


def test_a_case_survives_its_file():
    case = Case("ab", "pairs", "rich", (Hidden("skin", 0.5, 2.0), Hidden("core", 0.1, 3.0)), 7)
    assert Case.of(json.loads(json.dumps(dc.asdict(case)))) == case


def study_folder(folder: Path) -> Path:
    for name in PROTOCOLS:
        food_file(folder, name).parent.mkdir(parents=True, exist_ok=True)
        dump_yaml(model_food(protocol_named(name)), food_file(folder, name))
    return folder


def test_nothing_that_the_diagnosis_sees_tells_what_is_hidden(tmp_path, monkeypatch):
    """All files that the process is given are searched for names, size and seed."""
    output = study_folder(tmp_path)
    case = Case("c0ffee", "single", "poor", (Hidden("skin", 0.734512, 2.4),), 918273)
    seen: dict[str, str] = {}

    def look(command, cwd, **_):
        assert Path(cwd) == output / "runs" / case.name
        named = [Path(word) for word in command if Path(word).is_file()]
        for file in [*Path(cwd).rglob("*"), *named]:
            if file.suffix in (".csv", ".yaml"):
                seen[str(file)] = file.read_text(encoding="utf-8")
        seen["command"] = " ".join(command)
        return subprocess.CompletedProcess(command, 1, "", "looked")

    # Asks the system for the processor's name, by a program.
    warp.init()
    monkeypatch.setattr(runner.subprocess, "run", look)
    monkeypatch.setattr(runner, "WORLD", COARSE)
    run_case(case, output, 100)
    # Six records of two files, the food, and the command.
    assert len(seen) == 14
    given = food_file(output, "poor").resolve()
    assert load_calibrated_food(given).food.effects == Effects()
    for name, text in seen.items():
        assert "0.734512" not in text and "918273" not in text
        assert "skin" not in text or name == str(given)
    # The run came to an end, as a failure that is kept and said.
    assert is_done(output, case.name)
    assert "looked" in (output / "runs" / case.name / "failure.txt").read_text()
    assert not (output / "runs" / case.name / "records").exists()


NEAR = {
    name: {"skin": {"skin": 8.0, "core": 12.0, "dulling": 24.0}, "sensor_delay": {"skin": 80.0}}
    for name in ("rich", "poor")
}


def said(kind: str, effects: tuple[str, ...], verdict: str, *named: list[str]) -> Judgement:
    case = Case("x", kind, "rich", tuple(Hidden(e, 1.0, 2.5) for e in effects), 1)
    facts = {"verdict": verdict, "classes": list(named), "evidence": [], "shifts": {}}
    if verdict == "unknown":
        found = [{"cause": group[0], "others": group[1:]} for group in named]
        facts |= {"classes": [], "findings": found}
    return judge(case, facts, NEAR)


@pytest.mark.parametrize(
    ("judgement", "right"),
    [
        (said("single", ("skin",), "cause", ["skin"]), True),
        (said("single", ("skin",), "cause", ["core", "skin"]), True),
        # Another of the class alone is not what was hidden.
        (said("single", ("skin",), "cause", ["core"]), False),
        # More than the class, or a second finding, is a miss.
        (said("single", ("skin",), "cause", ["skin", "dulling"]), False),
        (said("single", ("skin",), "causes", ["skin"], ["dulling"]), False),
        (said("single", ("skin",), "unknown"), False),
        # What is locked to depth may be the law: then it has to be said that it may.
        (said("single", ("skin",), "unknown", ["core", "skin", "law"]), True),
        (said("single", ("skin",), "unknown", ["core", "law"]), False),
        (said("single", ("sensor_delay",), "unknown", ["core", "skin", "law"]), False),
        # In the poor protocol others are locked to depth too, and have to be listed.
        (said("poor", ("flank_adhesion",), "unknown", ["core", "adhesion", "law"]), True),
        (said("poor", ("flank_adhesion",), "unknown", ["core", "skin", "law"]), False),
        (said("poor", ("flank_adhesion",), "unknown", ["core", "adhesion", "slip", "law"]), False),
        (said("single", ("flank_adhesion",), "unknown", ["core", "adhesion", "law"]), False),
        (said("nothing", (), "nothing"), True),
        (said("nothing", (), "unknown"), False),
        (said("unknown", ("warm_wrist",), "unknown"), True),
        (said("unknown", ("warm_wrist",), "cause", ["slip"]), False),
        (said("pairs", ("skin", "sensor_delay"), "causes", ["sensor_delay"], ["skin"]), True),
        (said("pairs", ("skin", "sensor_delay"), "causes", ["skin"], ["dulling"]), False),
        (said("pairs", ("skin", "sensor_delay"), "cause", ["skin"]), False),
        (said("base", ("toughness",), "nothing"), True),
        (said("base", ("toughness",), "cause", ["skin"]), False),
    ],
)
def test_a_run_is_right_only_if_it_says_just_what_was_hidden(judgement, right):
    assert judgement.right == right


def test_a_run_that_broke_down_is_a_miss_and_counts():
    case = Case("x", "single", "rich", (Hidden("skin", 1.0, 2.5),), 1)
    broken = judge(case, None, NEAR)
    found = numbers([broken, said("single", ("skin",), "cause", ["skin"])])
    assert not broken.right
    assert found["by_effect"]["single"]["skin"]["hits"] == 1
    assert found["by_effect"]["single"]["skin"]["runs"] == 2


def test_the_next_experiment_must_leave_the_one_cause():
    case = Case("x", "poor", "poor", (Hidden("skin", 1.0, 2.5),), 1)
    facts = {"verdict": "cause", "classes": [["skin", "core"]], "evidence": [], "shifts": {}}
    then = facts | {"classes": [["skin"]]}
    assert judge(case, facts, NEAR).resolved is False
    assert judge(case, facts, NEAR, then).resolved is True
    assert judge(case, facts, NEAR, facts).resolved is False


def test_the_lower_bound_is_wilsons():
    for hits, runs in ((10, 10), (190, 200), (0, 7)):
        bound = binomtest(hits, runs, alternative="greater").proportion_ci(0.95, "wilson").low
        assert Rate(hits, runs).lower == pytest.approx(bound, abs=1e-9)


def test_the_upper_bound_is_the_lower_one_of_what_did_not_happen():
    for hits, runs in ((0, 10), (1, 201), (16, 200), (7, 7)):
        assert Rate(hits, runs).upper == pytest.approx(1.0 - Rate(runs - hits, runs).lower)


def test_too_few_runs_never_meet_a_requirement():
    judgements = [said("single", ("skin",), "cause", ["skin"]) for _ in range(50)]
    rows = {row["what"]: row for row in numbers(judgements)["requirements"]}
    assert rows["one cause"]["share"] == 1.0 and not rows["one cause"]["met"]
    judgements *= 4
    rows = {row["what"]: row for row in numbers(judgements)["requirements"]}
    assert rows["one cause"]["met"]


def test_the_report_shows_wrong_names_and_curves(tmp_path):
    curve = Case("y", "curve", "rich", (Hidden("skin", 1.0, 0.5),), 1)
    facts = {"verdict": "nothing", "classes": [], "evidence": [], "shifts": {}}
    judgements = [said("single", ("skin",), "cause", ["dulling"]), judge(curve, facts, NEAR)]
    text = report(judgements, "figures/hidden_effects.png")
    assert "| single: skin | {dulling} | 1 |" in text
    assert "| skin | 0 of 1 (0) |" in text
    plot_curves(judgements, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_pairs_are_of_effects_that_are_listed():
    for protocol, *effects in PAIRS:
        assert protocol in PROTOCOLS and set(effects) <= set(CAUSE_OF)


def test_a_study_is_judged_alike_from_its_runs_in_one_file(tmp_path):
    study = tmp_path / "study"
    case = Case("c0ffee", "single", "rich", (Hidden("skin", 0.7, 2.4),), 1)
    other = Case("decaf0", "poor", "poor", (Hidden("core", 0.3, 2.1),), 2)
    evidence = [{"cause": "skin", "held_out_share": 0.8, "gain": 12.0}]
    facts = {"verdict": "cause", "classes": [["skin"]], "evidence": evidence, "shifts": {}}
    # Right, since no records tell a core from the law.
    near_by = Case("facade", "single", "rich", (Hidden("core", 0.5, 2.4),), 3)
    group = {"cause": "core", "others": ["skin", "law"], "values": {"weakening": 0.3}}
    unknown = facts | {"verdict": "unknown", "classes": [], "findings": [group]}
    for one in (case, other, near_by):
        for folder, file, values in (
            ("truth", f"{one.name}.json", dc.asdict(one)),
            (f"runs/{one.name}", "timing.json", {"diagnosis_s": 3.0, "code": "a"}),
        ):
            (study / folder).mkdir(parents=True, exist_ok=True)
            (study / folder / file).write_text(json.dumps(values))
    for one, said_of_it in ((case, facts), (near_by, unknown)):
        (study / "runs" / one.name / "diagnosis.json").write_text(json.dumps(said_of_it))
    for name, values in (("study", {"seed": 1}), ("near", NEAR), ("classes", {})):
        (study / f"{name}.json").write_text(json.dumps(values))
    assert pack(study, tmp_path / "runs.jsonl") == 3
    unpack(tmp_path / "runs.jsonl", tmp_path / "again")
    first, again = (judge_study(folder) for folder in (study, tmp_path / "again"))
    assert repr(first) == repr(again)
    assert [j.verdict for j in again] == ["cause", "failed", "unknown"]
    assert [j.right for j in again] == [True, False, True] and again[0].oracle == 0.8
    # What was run since then stays.
    (tmp_path / "again" / "runs" / case.name / "diagnosis.json").write_text(
        json.dumps(facts | {"verdict": "unknown"})
    )
    unpack(tmp_path / "runs.jsonl", tmp_path / "again")
    assert judge_study(tmp_path / "again")[0].verdict == "unknown"


def test_a_file_that_holds_no_runs_is_refused(tmp_path):
    file = tmp_path / "other.jsonl"
    file.write_text("{}\n[1]\n")
    with pytest.raises(ConfigurationError, match="no file of a study's runs"):
        unpack(file, tmp_path / "study")


def test_a_study_that_goes_on_has_the_runs_that_it_was_begun_with(tmp_path, monkeypatch):
    """Without the sizes, which took a quarter of an hour, being computed again."""
    begun, again = study_folder(tmp_path / "begun"), tmp_path / "again"
    options = StudyOptions(kinds=("single",), seed=3, replicates=100, protocols=("poor",))
    cases = [
        Case("c0ffee", "single", "poor", (Hidden("skin", 0.7, 2.4),), 1),
        Case("decaf0", "single", "poor", (Hidden("core", 0.3, 2.1),), 2),
    ]
    listed = {"kinds": ["single"], "protocols": ["poor"], "effects": None}
    listed["cases"] = [dc.asdict(case) for case in cases]
    facts = {"seed": 3, "replicates": 100}
    for name, values in (("study", facts), ("near", {}), ("classes", {}), ("cases", listed)):
        (begun / f"{name}.json").write_text(json.dumps(values))
    monkeypatch.setattr("studies.hidden_effects.study.protocol_classes", refused)
    assert prepare(begun, options, refused) == cases
    assert pack(begun, tmp_path / "runs.jsonl") == 0
    unpack(tmp_path / "runs.jsonl", again)
    assert prepare(again, options, refused) == cases
    assert load_cases(again) == cases
    with pytest.raises(AssertionError, match="computed"):
        prepare(again, dc.replace(options, effects=("skin",)), refused)


def refused(*what: object) -> None:
    raise AssertionError(f"{what} is computed")
