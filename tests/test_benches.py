"""Benches that the diagnosis never saw: limits of their laws, noises, effects, the harness."""

import argparse
import ast
import dataclasses as dc
import json
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagnosis.registry import all_causes
from sliceit_drake.records.slice_record import write_record
from sliceit_drake.records.validation import check_record, load_record
from sliceit_drake.stand_in.effect import Effect, SliceTruth, Tissue
from sliceit_drake.stand_in.protocol import Condition, Specimen
from studies.benches import runs
from studies.benches.bonds import Bonds
from studies.benches.calibrated import Misfit
from studies.benches.draw import LAWS, RESERVED, Draw, seed_of
from studies.benches.effects import BENCH_CAUSES, DEPTH_CAUSES, HIDDEN, CrossTalk, HiddenEffect
from studies.benches.law_world import Cut, Heading, Law
from studies.benches.noise import FAMILIES, Noise, unit_noise
from studies.benches.report import in_words, newest_rates, runs_by_rule
from studies.benches.runs import add_arguments, cases_of, commit_of, diagnosed
from studies.benches.runs import run as run_benches
from studies.benches.score import add_arguments as add_score_arguments
from studies.benches.score import answers_of, judge, kept, measured, rates
from studies.benches.score import run as run_score
from studies.benches.section import Section
from studies.benches.sizes import Sizes
from studies.benches.slice_push import SlicePush
from studies.benches.strips import Strips
from studies.benches.variation import SliceVariation
from studies.results import write_json

ROOT = Path(__file__).resolve().parent.parent
BENCHES = ROOT / "studies" / "benches"
FOREIGN = ("slice_push", "bonds", "strips")
PLAIN = {"slice_push": SlicePush(), "bonds": Bonds(), "strips": Strips()}
SIDE = 0.03


def uncut(law: Law, is_round: bool = False) -> Cut:
    section = Section(SIDE, SIDE, is_round)
    return law.begin(section, Specimen(0, Condition()), 0.0, SIDE + 1e-3)


def drive(cut: Cut, way: np.ndarray, start: tuple[float, float], period: float) -> np.ndarray:
    """Forces [n, 3, 3] at points of a way along x and z [n, 2] from a start, metres."""
    return np.array([cut.advance(period, start[0] + dx, start[1] + dz, 1.0, 1.0) for dx, dz in way])


def pressed(law: Law, depth: float, speed: float = 0.02, xi: float = 0.0, step: float = 2e-5):
    """Forces of a press with a draw, and the way [n, 2]."""
    down = -np.arange(0.0, depth + 1e-3, step)
    way = np.column_stack([-xi * down, down])
    return drive(uncut(law), way, (0.0, SIDE + 1e-3), step / speed), way


def work(forces: np.ndarray, way: np.ndarray) -> float:
    """Work of the knife against the sum of forces, J."""
    total = forces.sum(1)[:, [0, 2]]
    middle = 0.5 * (total[1:] + total[:-1])
    return -float((middle * np.diff(way, axis=0)).sum())


RUBLESS = SlicePush(friction=0.0, pressure=0.0, bevel_pressure=0.0, rate=0.0)


@pytest.mark.parametrize("xi", [0.0, 0.5, 1.0, 2.0])
def test_slice_push_falls_with_the_draw_as_atkins_says(xi):
    forces, _ = pressed(RUBLESS, 0.02, xi=xi)
    along, up = forces[-1, 0, 0], forces[-1, 0, 2]
    whole = RUBLESS.toughness * SIDE
    assert up == pytest.approx(whole / (1.0 + xi**2), rel=2e-3)
    assert -along == pytest.approx(xi * up, rel=2e-3)


def test_a_crack_that_answers_to_force_by_a_power_is_tougher_when_it_is_faster_and_relaxes():
    law = dc.replace(RUBLESS, rate=0.1)
    slow, fast = (pressed(law, 0.02, speed=v)[0][-1, 0, 2] for v in (0.01, 0.04))
    assert fast / slow == pytest.approx(4.0**0.1, rel=5e-3)
    cut = uncut(law)
    start = SIDE + 1e-3
    drive(cut, np.column_stack([np.zeros(1000), -np.linspace(0, 0.016, 1000)]), (0.0, start), 8e-4)
    held = drive(cut, np.tile([0.0, -0.016], (30000, 1)), (0.0, start), 1e-2)[:, 0, 2]
    # F ~ t^-(m / (1 - m)) long after the stop.
    slope = np.log(held[-1] / held[2999]) / np.log(10.0)
    assert slope == pytest.approx(-0.1 / 0.9, rel=0.02)


@pytest.mark.parametrize(
    ("law", "cut_depth"),
    [
        (RUBLESS, 0.02),
        (Strips(pressure=0.0, initiation=0.0, relaxing=0.0, shear=0.0), 0.02),
        (Bonds(friction=0.0, slab=1.0), 0.02),
    ],
)
def test_cutting_takes_at_least_the_toughness_times_the_area(law, cut_depth):
    forces, way = pressed(law, cut_depth)
    whole = law.toughness * SIDE * cut_depth
    # What is pressed but not cut yet is less than 2 mm.
    assert 0.9 * whole < work(forces, way) < 1.1 * whole


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("is_round", [False, True])
def test_a_whole_slice_takes_more_than_the_toughness_and_gives_nothing_back(name, is_round):
    law = PLAIN[name]
    cut, start = uncut(law, is_round), SIDE + 1e-3
    down = -np.linspace(0.0, SIDE + 1.2e-3, 1500)
    way = np.column_stack([0.3 * down, np.concatenate([down, down[::-1]])[: len(down)]])
    forces = drive(cut, way, (0.0, start), 1e-3)
    area = SIDE**2 * (np.pi / 4.0 if is_round else 1.0)
    assert work(forces, way) > 0.85 * law.toughness * area
    back = way[::-1]
    out = drive(cut, back, (0.0, start), 1e-3)
    assert work(out, back) > -0.02 * law.toughness * area
    assert out[-1].sum() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", FOREIGN)
def test_no_force_above_the_food(name):
    cut = uncut(PLAIN[name])
    way = np.column_stack([np.linspace(0, 0.02, 50), np.zeros(50)])
    assert not drive(cut, way, (0.0, SIDE + 1e-3), 1e-3).any()


@pytest.mark.parametrize("name", FOREIGN)
def test_a_second_pass_meets_less(name):
    law = PLAIN[name]
    cut, start = uncut(law), SIDE + 1e-3
    down = np.column_stack([np.zeros(1500), -np.linspace(0.0, 0.025, 1500)])
    first = drive(cut, down, (0.0, start), 1e-3)
    drive(cut, down[::-1], (0.0, start), 1e-3)
    second = drive(cut, down, (0.0, start), 1e-3)
    assert second.sum(1)[:1400, 2].max() < 0.6 * first.sum(1)[:, 2].max()


def test_strips_relax_in_a_hold_and_bonds_keep_what_is_cut():
    strips, start = uncut(Strips(relaxing=0.5)), SIDE + 1e-3
    down = np.column_stack([np.zeros(800), -np.linspace(0.0, 0.015, 800)])
    first = drive(strips, down, (0.0, start), 1e-3)[-1, 0, 2]
    held = drive(strips, np.tile(down[-1], (3000, 1)), (0.0, start), 1e-3)[-1, 0, 2]
    assert 0.5 * first < held < 0.97 * first
    bonds = uncut(Bonds())
    drive(bonds, down, (0.0, start), 1e-3)
    opened = bonds.opened.copy()
    drive(bonds, down[::-1], (0.0, start), 1e-3)
    assert (bonds.opened >= opened).all()


def test_friction_turns_round_and_stays_at_rest():
    heading = Heading(1e-4)
    for _ in range(100):
        heading.move(np.array([0.0, -1e-5]))
    assert heading.vector == pytest.approx([0.0, -1.0], abs=1e-4)
    heading.move(np.zeros(2))
    assert heading.vector == pytest.approx([0.0, -1.0], abs=1e-4)


def test_laws_import_no_solver_model_or_mesh():
    allowed = {"sliceit_drake.cutting.motion"}
    for file in ("section", "law_world", "slice_push", "bonds", "strips"):
        tree = ast.parse((BENCHES / f"{file}.py").read_text())
        names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
        assert {n for n in names if n.startswith("sliceit_drake.cutting")} <= allowed, file


def slope(values: np.ndarray, rate: float, low: float, high: float) -> float:
    """Exponent of the power spectrum over the frequency in a band."""
    power = (np.abs(np.fft.rfft(values, axis=0)) ** 2).mean(1)
    f = np.fft.rfftfreq(len(values), 1.0 / rate)
    band = (f > low) & (f < high)
    return float(np.polyfit(np.log(f[band]), np.log(power[band]), 1)[0])


@pytest.mark.parametrize("rate", [125.0, 500.0])
def test_noises_have_the_spectrum_and_the_tails_that_they_claim(rate):
    rng = np.random.default_rng(3)
    made = {name: unit_noise(name, 40_000, rate, rng) for name in FAMILIES}
    assert slope(made["white"], rate, 0.5, 50.0) == pytest.approx(0.0, abs=0.05)
    assert slope(made["pink"], rate, 0.5, 50.0) == pytest.approx(-1.0, abs=0.08)
    lag = round(0.04 * rate)
    ar = made["autoregressive"]
    assert (ar[lag:] * ar[:-lag]).mean() == pytest.approx(0.8 / np.e, abs=0.05)
    spikes = np.abs(made["tails"]) > 12.0
    assert spikes.any(1).mean() == pytest.approx(0.004, abs=0.0015)
    assert (made["tails"][~spikes.any(1)] ** 4).mean() > 5.0
    power = (np.abs(np.fft.rfft(made["hum"], axis=0)) ** 2).mean(1)
    assert np.fft.rfftfreq(40_000, 1.0 / rate)[power.argmax()] == pytest.approx(50.0, abs=0.1)
    for name in ("white", "autoregressive", "pink", "hum"):
        assert made[name].std() == pytest.approx(1.0, abs=0.1), name


@pytest.fixture(scope="module")
def draw() -> Draw:
    return Draw("slice_push", 5)


@pytest.fixture(scope="module")
def board_draw() -> Draw:
    seeds = (s for s in range(20) if "board" in Draw("slice_push", s).middle)
    return Draw("slice_push", next(seeds))


def test_a_seed_makes_the_same_bench_and_the_same_records(draw):
    again = Draw("slice_push", 5)
    assert again.constants == draw.constants and again.noise == draw.noise
    assert Draw("slice_push", 6).constants != draw.constants
    session, other = draw.session(seed=1), again.session(seed=1)
    assert np.array_equal(session.record(2).force, other.record(2).force)
    assert not np.array_equal(session.record(2).force, draw.session(seed=2).record(2).force)
    assert seed_of("a1", "training", "bonds", 0) != seed_of("a1", "reporting", "bonds", 0)


@pytest.mark.parametrize("family", list(FAMILIES))
def test_records_are_read_and_found_good(draw, tmp_path, family):
    quiet = draw.session(seed=1).record(0)
    noise = Noise(family, draw.noise.rate, 0.08)
    file = write_record(noise.added_to(quiet, np.random.default_rng(0)), tmp_path / "a")
    record = load_record(file)
    assert not [f for f in check_record(record) if f.kind == "error"]
    assert record.torque is not None and len(record) == len(quiet)
    assert (np.diff(record.time) > 0.0).all()
    assert np.median(record.force[record.first_phase("air")]) == pytest.approx(0.0, abs=0.13)


class EveryStep(Effect):
    """Nothing, seen every coupling step."""

    every_coupling_step = True


@pytest.mark.parametrize("name", list(HIDDEN))
def test_an_effect_does_nothing_at_size_0_and_something_at_its_typical_one(board_draw, name):
    kind, bench = HIDDEN[name], board_draw
    labels = ["board"] if name == "soft_mat" else list(bench.middle)[2:4]
    only = [bench.middle[label] for label in labels]
    plain = bench.quiet([EveryStep()] if kind.every_coupling_step else [], only)
    for none, record in zip(bench.quiet([kind(0.0)], only), plain, strict=True):
        assert np.allclose(none.force, record.force, atol=1e-9)
        assert np.allclose(none.torque, record.torque, atol=1e-9)
    some = bench.quiet([kind()], only)
    assert max(np.abs(a.force - b.force).max() for a, b in zip(some, plain, strict=True)) > 0.05


@pytest.mark.parametrize("law", ["bonds", "strips"])
def test_laws_see_the_tissue_that_effects_change(law):
    bench = Draw(law, 3)
    only = [list(bench.middle.values())[2]]
    (plain,) = bench.quiet(only=only)
    for name in ("skin_ring", "seed_cavity", "sagging_belly"):
        (none,), (some,) = (bench.quiet([HIDDEN[name](size)], only) for size in (0.0, 0.4))
        assert np.allclose(none.force, plain.force, atol=1e-9), name
        assert np.abs(some.force - plain.force).max() > 0.1, name


def test_each_effect_says_which_causes_are_right():
    causes = {cause.name for cause in all_causes()} | {"law"}
    listed = set()
    for name, kind in HIDDEN.items():
        assert kind.right <= causes, name
        assert bool(kind.right) == (kind.group != "unlisted"), name
        assert (kind.group == "bench") == (kind.right != frozenset() and kind.right <= BENCH_CAUSES)
        assert (kind.group == "depth") == (kind.right != frozenset() and kind.right <= DEPTH_CAUSES)
        listed |= kind.right
    assert listed == causes - {"law"}


def test_slices_differ_by_what_was_asked_for():
    rng = np.random.default_rng(0)
    widths, textures = [], []
    for _ in range(150):
        effect = SliceVariation(0.08)
        effect.begin(SliceTruth(height=0.03, width=0.03), rng)
        section = Section(0.03, 0.03, False, [effect])
        widths.append(section.width.mean())
        textures.append(section.toughness.mean(1))
    assert np.std(np.log(widths)) == pytest.approx(0.08, rel=0.2)
    logs = np.log(textures)
    assert logs[:, 100].std() == pytest.approx(0.08, rel=0.2)
    # 4 mm, 43 rows, apart they are correlated by exp(-1/2), 16 mm apart hardly.
    near, far = (np.corrcoef(logs[:, 80], logs[:, 80 + k])[0, 1] for k in (43, 171))
    assert near == pytest.approx(np.exp(-0.5), abs=0.15)
    assert abs(far) < 0.25


def test_a_law_has_a_draw_of_its_own():
    assert set(FOREIGN) < set(LAWS)
    for law in FOREIGN:
        constants = {Draw(law, seed).constants for seed in range(3)}
        assert len(constants) == 3


def test_the_reserved_law_is_refused_without_a_frozen_commit(tmp_path):
    food = Draw(RESERVED, 0).model
    for frozen, words in ((None, "is reserved"), ("0123456789abcdef", "is no commit")):
        with pytest.raises(ConfigurationError, match=words):
            diagnosed(RESERVED, tmp_path, food, tmp_path, 50, frozen)
    typed = ["--output", str(tmp_path), "--commit", "HEAD", "--laws", RESERVED]
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with pytest.raises(ConfigurationError, match="is reserved"):
        run_benches(parser.parse_args(typed))
    assert not list(tmp_path.iterdir())


def test_a_report_has_the_seeds_of_the_commit_that_froze_the_rule_and_is_listed(
    tmp_path, monkeypatch
):
    log = tmp_path / "log.jsonl"
    monkeypatch.setattr(runs, "LOG", log)
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    typed = ["--output", str(tmp_path), "--commit", "HEAD", "--part", "reporting", "--draws", "0"]
    with pytest.raises(ConfigurationError, match="follow from the commit"):
        run_benches(parser.parse_args([*typed, "--laws", "bonds"]))
    assert not log.exists()
    options = parser.parse_args([*typed, "--frozen", "HEAD"])
    options.command = "python -m studies benches ..."
    assert run_benches(options) == 0
    (entry,) = map(json.loads, log.read_text().splitlines())
    assert entry["commit"] == commit_of("HEAD", "") and RESERVED in entry["laws"]


def test_runs_of_a_draw_hide_what_they_should_and_repeat():
    cases = cases_of("bonds", 2, 77, 12)
    assert cases == cases_of("bonds", 2, 77, 12) != cases_of("bonds", 2, 78, 12)
    kinds = [HIDDEN[c.effect].group if c.effect else "nothing" for c in cases]
    assert kinds.count("nothing") == kinds.count("unlisted") == 2
    listed = [c for c in cases if c.effect and HIDDEN[c.effect].right]
    assert len({c.effect for c in listed}) == 8
    assert {c.wanted for c in listed} == {0.5, 1.0, 2.0, 4.0}


class SameTalk(CrossTalk):
    """The same by another name."""

    right = frozenset({"core"})


class Tougher(HiddenEffect):
    """Tougher by the share size."""

    def toughness(self, at: Tissue) -> float:
        return 1.0 + self.size


def test_a_signature_is_what_a_refit_leaves(monkeypatch):
    bench = Draw("slice_push", 5)
    bench.protocol.conditions = bench.protocol.conditions[2:4]
    # Wrong by 1 N along z, and by nothing else.
    sizes = Sizes(bench, Misfit(0.1, 0.1, 0.1, 0.1, 0.1, [1e-6, 1e-6, 1.0, 1e-6]))
    small, large = (sizes.signature("cross_talk", s) for s in (0.02, 0.04))
    assert large.size == pytest.approx(2.0 * small.size, rel=1e-3)
    assert sizes.signature("cross_talk", 0.02) is small
    found = sizes.size_for("cross_talk", 2.0)
    assert found is not None and found[1].size == pytest.approx(2.0, rel=0.05)
    # A size that has no meaning is not hidden, however small the effect is beside what is wrong.
    with monkeypatch.context() as patched:
        patched.setattr(HIDDEN["cross_talk"], "most", 0.5 * found[0])
        assert sizes.size_for("cross_talk", 2.0) is None
    for name in set(HIDDEN) - {"cross_talk", "axis_gain", "pure_delay"}:
        monkeypatch.delitem(HIDDEN, name)
    assert sizes.group("cross_talk", found[1]) == {"sensor_tilt"}
    monkeypatch.setitem(HIDDEN, "same_talk", SameTalk)
    assert sizes.group("cross_talk", found[1]) == {"sensor_tilt", "core"}
    # All slices are tougher: this is the base, and nothing is left of it.
    monkeypatch.setitem(HIDDEN, "tougher", Tougher)
    assert sizes.signature("tougher", 0.05).size < 0.02 * sizes.signature("axis_gain", 0.05).size


def hidden(effect: str, size: float, *group: str) -> dict:
    return {"effect": effect, "size": 0.1, "standardised": size, "group": list(group)}


TILT = hidden("cross_talk", 2.0, "sensor_tilt")


@pytest.mark.parametrize(
    ("named", "truth", "right", "wrong", "beside"),
    [
        ([["sensor_tilt"]], TILT, True, False, False),
        ([["sensor_tilt"], ["skin"]], TILT, True, False, True),
        ([["sensor_tilt"], ["sensor_gain"]], TILT, False, True, False),
        ([["sensor_tilt", "sensor_gain"]], TILT, False, True, False),
        ([], TILT, False, False, False),
        (
            [["sensor_tilt", "sensor_gain"]],
            hidden("cross_talk", 2.0, "sensor_tilt", "sensor_gain"),
            True,
            False,
            False,
        ),
        ([["core", "skin", "section_shape", "law"]], hidden("skin_ring", 2.0), True, False, False),
        ([["board_height"]], hidden("skin_ring", 2.0), False, True, False),
        ([], hidden("", 0.0), True, False, False),
        ([["toughness_rate"]], hidden("", 0.0), True, False, True),
        ([["sensor_zero"]], hidden("", 0.0), False, True, False),
        ([["toughness_rate"]], hidden("cable", 3.0), False, True, True),
        ([], hidden("cable", 3.0), True, False, False),
    ],
)
def test_answers_are_judged_by_what_was_hidden(named, truth, right, wrong, beside):
    judged = judge(named, truth, "earlier")
    assert (judged.right, judged.wrong, judged.beside) == (right, wrong, beside)


def test_affected_records_need_not_show_what_a_refit_takes_up():
    small = hidden("cross_talk", 0.5, "sensor_tilt")
    assert judge([], small, "affected").right and not judge([], small, "earlier").right


def test_values_and_gain_are_judged_where_the_right_cause_was_named():
    truth = hidden("pure_delay", 2.0, "sensor_delay") | {"size": 0.02}
    said = {
        "verdict": "cause",
        "classes": [["sensor_delay"]],
        "findings": [{"cause": "sensor_delay", "values": {"delay": 0.025}}],
        "causes": [
            {"cause": "sensor_delay", "verdict": "supported", "limits": {"delay": [0.019, 0.03]}},
            {"cause": "core", "verdict": "possible", "limits": {}},
        ],
        "evidence": [
            {"cause": "core", "held_out_share": 0.9},
            {"cause": "sensor_delay", "held_out_share": 0.5},
        ],
        "gain": {"share_removed": 0.4},
    }
    named = judge(said["classes"], truth, "earlier")
    found = measured(named, said, truth)
    assert (found.close, found.covered, found.gain) == (False, True, (0.4, 0.5))
    assert rates({0: [found, found]}, np.random.default_rng(0))["of the right cause's gain"] == (
        pytest.approx((0.8, 0.8, 0.8, 2))
    )
    # What is kept of an answer is judged the same.
    short = kept({"case": {}, "hidden": truth, "earlier": said})["earlier"]
    assert measured(named, short, truth) == found
    silent = said | {"verdict": "nothing", "classes": [], "findings": []}
    missed = measured(judge([], truth, "earlier"), silent, truth)
    assert (missed.close, missed.covered, missed.gain) == (None, None, (0.0, 0.5))


def test_rates_are_of_runs_and_their_intervals_of_draws():
    hit, miss = (judge(named, TILT, "earlier") for named in ([["sensor_tilt"]], [["sensor_gain"]]))
    rng = np.random.default_rng(0)
    alike = rates({k: [hit, miss] for k in range(6)}, rng)
    assert alike["named rightly"] == (0.5, 0.5, 0.5, 12)
    apart = rates({k: [hit if k < 3 else miss] * 2 for k in range(6)}, rng)
    share, low, high, _ = apart["named rightly"]
    assert share == 0.5 and low < 0.25 and high > 0.75
    assert "alarm, nothing hidden" not in alike


def test_the_table_has_rows_for_naming_nothing_the_top_and_the_oracle(tmp_path, capsys):
    answer = {"verdict": "cause", "classes": [["sensor_gain"]], "gain": None}
    answer["evidence"] = [{"cause": "core", "held_out_share": None}]
    for draw, effect in ((0, TILT), (1, hidden("", 0.0))):
        case = {"law": "bonds", "draw": draw}
        facts = {"case": case, "hidden": effect, "earlier": answer, "affected": {"failure": "x"}}
        write_json(tmp_path / "runs" / f"{draw}.json", facts)
    parser = argparse.ArgumentParser()
    add_score_arguments(parser)
    assert run_score(parser.parse_args([str(tmp_path)])) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    found = {(row[1], row[2]): row for row in rows}
    assert found["earlier", "oracle"][4].startswith("100 %")
    assert found["earlier", "diagnosis"][4].startswith("0 %")
    assert found["earlier", "diagnosis"][5].startswith("100 %")
    assert found["earlier", "diagnosis"][8].startswith("100 %")
    assert found["earlier", "always nothing"][8].startswith("0 %")
    assert found["affected", "diagnosis"][-1].startswith("100 %")


def test_kept_runs_stay_where_those_of_another_rule_are_added(tmp_path):
    parser = argparse.ArgumentParser()
    add_score_arguments(parser)
    file = tmp_path / "kept.jsonl"
    for commit, law in (("1" * 40, "bonds"), ("2" * 40, "bonds"), ("2" * 40, "bonds")):
        facts = {"case": {"law": law, "draw": 0, "number": 0}, "commit": commit, "part": "training"}
        said = {"verdict": "nothing", "classes": [], "evidence": [], "gain": None}
        facts |= {"hidden": hidden("", 0.0), "earlier": said, "affected": said}
        write_json(tmp_path / "runs" / "run.json", facts)
        assert run_score(parser.parse_args([str(tmp_path), "--keep", str(file)])) == 0
    assert [facts["commit"][0] for facts in answers_of(file)] == ["1", "2"]


def test_the_page_has_each_reported_run():
    page = (ROOT / "docs/results/benches.md").read_text(encoding="utf-8")
    rows = cells(page)
    reports = (ROOT / "docs/results/benches_report.jsonl").read_text(encoding="utf-8")
    answered = [report for report in map(json.loads, reports.splitlines()) if "earlier" in report]
    wanted = [
        (report["case"]["law"], report["case"]["effect"] or "nothing")
        + tuple(in_words(report[calibrated]) for calibrated in ("earlier", "affected"))
        for report in answered
    ]
    shown = [(row[0], row[1], row[3], row[4]) for row in rows if len(row) == 5 and row[0] in LAWS]
    assert sorted(shown) == sorted(wanted)
    runs = (ROOT / "docs/results/benches_runs.jsonl").read_text(encoding="utf-8")
    assert all(run["commit"][:7] in page for run in map(json.loads, runs.splitlines()))


def test_the_page_counts_the_newest_rule_and_marks_sizes_that_have_no_meaning():
    def said(*causes: str) -> dict:
        first = [{"cause": "sensor_gain"}]
        facts = {"verdict": "cause" if causes else "nothing", "evidence": first, "causes": []}
        found = [{"cause": c, "others": [], "values": {}} for c in causes]
        return facts | {"classes": [[c] for c in causes], "findings": found, "gain": None}

    def report(commit: str, law: str, size: float, *causes: str) -> dict:
        case = {"law": law, "draw": 0, "effect": "cross_talk"}
        facts = {"case": case, "commit": commit, "hidden": TILT | {"size": size}}
        return facts | {"earlier": said(*causes), "affected": said()}

    reports = [
        report("1" * 40, "strips", 0.9, "sensor_gain"),
        report("2" * 40, "bonds", 0.1, "sensor_tilt"),
        report("2" * 40, "bonds", 0.1),
    ]
    rates_of = {tuple(row[:3]): row for row in cells(newest_rates(reports))}
    assert rates_of["bonds", "earlier", "diagnosis"][3:6] == ["1", "1 of 2", "0 of 2"]
    assert rates_of["all", "earlier", "always the top"][4:6] == ["0 of 2", "2 of 2"]
    assert rates_of["all", "affected", "oracle"][4] == "2 of 2"
    assert not any(row[0] == "strips" for row in cells(newest_rates(reports)))
    rules = runs_by_rule(reports)
    assert rules.index("2222222") < rules.index("1111111")
    assert [
        "strips",
        "cross_talk",
        "2.0 *",
        "sensor_gain",
        "nothing; sensor_gain stands first",
    ] in (cells(rules))


def cells(text: str) -> list[list[str]]:
    """Of the tables in a text."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_a_diagnosis_that_breaks_down_is_kept_as_a_failure(tmp_path):
    (tmp_path / "records").mkdir()
    food = Draw("bonds", 0).model
    said = diagnosed("bonds", tmp_path / "records", food, tmp_path / "cache", 50, None)
    assert list(said) == ["failure"] and "record" in said["failure"]


def test_a_study_keeps_each_answer_and_goes_on_with_what_is_left(tmp_path, monkeypatch, capsys):
    def small(law: str, seed: int) -> Draw:
        bench = Draw(law, seed)
        bench.protocol.conditions = bench.protocol.conditions[2:4]
        return bench

    asked = []

    def says(law, records, food, cache, replicates, frozen):
        asked.append((food.note, len(list(records.glob("*.csv")))))
        return {"verdict": "nothing", "classes": [], "evidence": [], "gain": None}

    def fitted(food, records):
        return dc.replace(food, note=food.note + f" {len(records)}")

    misfit = Misfit(0.1, 0.1, 0.1, 0.1, 0.1, [0.1, 0.1, 1.0, 0.01])
    monkeypatch.setattr(runs, "Draw", small)
    monkeypatch.setattr(runs, "misfit_of", lambda draw: (misfit, draw.model))
    monkeypatch.setattr(runs, "calibrated", fitted)
    monkeypatch.setattr(runs, "diagnosed", says)
    hidden_in = [
        runs.Case("slice_push", 0, 0, "cross_talk", 2.0),
        runs.Case("slice_push", 0, 1, "", 0),
    ]
    monkeypatch.setattr(runs, "cases_of", lambda *_: hidden_in)
    for name in set(HIDDEN) - {"cross_talk"}:
        monkeypatch.delitem(HIDDEN, name)
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    typed = ["--output", str(tmp_path), "--commit", "HEAD", "--laws", "slice_push", "--draws", "1"]
    assert run_benches(parser.parse_args(typed)) == 0
    # Calibrated to the first record of each condition, and for (b) once more.
    assert asked == [(" 2", 6), (" 2 2", 6)] * 2
    found = answers_of(tmp_path)
    assert [a["hidden"]["group"] for a in found] == [["sensor_tilt"], []]
    assert found[0]["hidden"]["standardised"] == pytest.approx(2.0, rel=0.05)
    assert json.loads((tmp_path / "draws" / "slice_push_00.json").read_text())["misfit"]
    assert run_benches(parser.parse_args(typed)) == 0 and len(asked) == 4
    # From the file of all runs it goes on in the same way, and is judged the same.
    file, score = tmp_path / "runs.jsonl", argparse.ArgumentParser()
    add_score_arguments(score)
    assert run_score(score.parse_args([str(tmp_path), "--keep", str(file)])) == 0
    table = capsys.readouterr().out.splitlines()[-10:]
    assert run_score(score.parse_args([str(file)])) == 0
    assert capsys.readouterr().out.splitlines()[-10:] == table
    elsewhere = ["--output", str(tmp_path / "other"), *typed[2:], "--kept", str(file)]
    assert run_benches(parser.parse_args(elsewhere)) == 0 and len(asked) == 4
