"""Calibration takes the structure that a curve asks for, and says why."""

import copy
import dataclasses as dc
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_calibration import TRUTH, bench_records, coarse_setup
from test_calibration_uncertainty import shapes, small_model

from sliceit_drake.calibration import structure
from sliceit_drake.calibration.calibrate import blocked_error
from sliceit_drake.calibration.gauss_newton import gauss_newton, linearise
from sliceit_drake.calibration.setup import load_setup, setup_of_record
from sliceit_drake.calibration.structure import (
    StructureChoice,
    _Fitted,
    choice_in,
    choose_structure,
    find_puncture,
    puncture_lines,
)
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.validation import load_record
from sliceit_drake.resources import resource_path


def curve(depth: np.ndarray, force: np.ndarray) -> SimpleNamespace:
    """A record as `find_puncture` reads it."""
    return SimpleNamespace(
        depth=depth, measured=force[:, None], facts=SimpleNamespace(height=0.03, width=0.03)
    )


def test_a_sudden_fall_of_the_force_is_a_puncture_and_a_smooth_one_is_none():
    depth = np.linspace(-2e-3, 28e-3, 600)
    smooth = 20.0 * np.sin(np.pi * np.clip(depth, 0.0, None) / 0.03)
    assert find_puncture(curve(depth, smooth)) is None
    found = find_puncture(curve(depth, np.where(depth > 6e-3, 0.7, 1.0) * smooth))
    assert found.depth == pytest.approx(6e-3, abs=2e-4)
    assert found.drop == pytest.approx(0.3 * found.force, rel=0.15)
    noise = np.random.default_rng(0).normal(size=600)
    assert find_puncture(curve(depth, smooth + 0.8 * noise)) is None
    # Of what falls near the board the food's end may be the cause.
    assert find_puncture(curve(depth, np.where(depth > 24e-3, 0.2, 1.0) * smooth)) is None


@pytest.mark.parametrize(
    ("name", "depth"), [("tomato", 13e-3), ("cucumber", None), ("potato", None)]
)
def test_of_the_measured_curves_the_tomato_punctures(name, depth):
    record = load_record(resource_path(f"calibration/records/{name}.csv"))
    (target,) = structure.coarse_predictor(load_setup(name), [record], 1).targets
    found = find_puncture(target)
    assert (found and found.depth) == (depth and pytest.approx(depth, abs=2e-3))


def test_a_puncture_is_told_with_the_skin_that_the_setup_lacks():
    depth = np.linspace(-2e-3, 28e-3, 600)
    force = np.where(depth > 6e-3, 0.7, 1.0) * 20.0 * np.sin(np.pi * depth.clip(0.0) / 0.03)
    setup = coarse_setup()
    (line,) = puncture_lines(setup, [curve(depth, force)])
    assert re.search(
        r"falls by 3\.\d+ of 11\.\d+ N at a depth of [56].* the setup has no skin$", line
    )
    setup.food.effects.skin.toughness = 0.5
    (line,) = puncture_lines(setup, [curve(depth, force)])
    assert line.endswith("as where a skin is punctured")


def test_left_out_depth_shows_an_overfit_as_blocks_that_are_held_out_do():
    x = np.linspace(0.0, 1.0, 150)
    wave = 0.3 * np.cumsum(np.random.default_rng(2).normal(size=150)) / 5.0
    for columns in (4.0 * x[:, None], np.column_stack([4.0 * x, 0.2 * shapes(150, 6)[:, 1:]])):
        model, truth = small_model(columns, noise=0.0)
        model.measured = 2.0 * x + wave + 0.1 * shapes(150, 6)[:, 1:].sum(1)
        fit = gauss_newton(model, truth)
        left_out = structure._left_out(model, linearise(model, fit.unit))
        assert left_out == pytest.approx(blocked_error(model, fit.unit).rms, rel=0.2)


@pytest.mark.second_tier
def test_elements_are_compared_with_a_plain_food_that_is_fitted_to_its_end():
    setup, record = (
        load_setup("cucumber"),
        load_record(resource_path("calibration/records/cucumber.csv")),
    )
    found = structure._Search(setup, [record], 1, None)
    plain = found.current
    end = structure._fit(plain.predictor, plain.setup, plain.values, 40)
    assert plain.left_out < 1.02 * end.left_out and plain.rms < 1.02 * end.rms


ELEMENTS = structure._elements


@pytest.fixture
def few_elements(monkeypatch):
    """Only skin and core, on the mesh that is coarse already."""

    def some(*given):
        return [e for e in ELEMENTS(*given) if e.name in ("skin", "core")]

    monkeypatch.setattr(structure, "_elements", some)
    monkeypatch.setattr(structure, "COARSE", 1.0)


@pytest.mark.second_tier
def test_a_core_is_taken_where_there_is_one_and_nothing_where_there_is_none(few_elements):
    (plain,) = bench_records(1)
    found = choose_structure(coarse_setup(), [plain], 1)
    assert found.taken == []
    assert found.lines[0].startswith("Plain food: 0.1")
    assert [line.split(".")[0] for line in found.lines[1:]] == ["skin: left", "core: left"]
    (cored,) = bench_records(1, hidden=("core:0.5",))
    found = choose_structure(coarse_setup(), [cored], 1)
    assert found.taken == ["core"]
    # From the outside to the middle the toughness falls to half, and the model's in one step.
    assert found.values["effects.core.toughness_ratio"] == pytest.approx(0.6, abs=0.15)
    assert found.values["material.toughness"] == pytest.approx(
        TRUTH["material.toughness"], rel=0.15
    )
    before, after = re.search(r"Left-out depth (.*) to (.*) N, on", " ".join(found.lines)).groups()
    assert float(after) < 0.5 * float(before)
    assert "effects.core.toughness_ratio" in [p.name for p in found.setup.parameters]


@pytest.mark.second_tier
def test_a_thick_skin_is_a_layer_that_is_tougher_and_no_line_load(few_elements):
    """The stand-in's skin is a toughness that falls over a millimetre. The model's skin is a load
    on a line, which not even with a thickness of its own fits as well as an outer layer does."""
    (record,) = bench_records(1, hidden=("skin:0.3",))
    found = choose_structure(coarse_setup(), [record], 1)
    assert found.taken == ["core"]
    (line,) = [line for line in found.lines if line.startswith("core")]
    assert line.endswith("as tough as the inside, as a rind or a thick skin is")
    rms = float(re.search(r"records .* to (.*?) N\.", line)[1])
    elements = {e.name: e for e in ELEMENTS(coarse_setup(), 0.03, False)}
    setup = structure._without_elements(coarse_setup())
    for name in ("skin", "puncture"):
        setup = structure._with_element(setup, elements[name])
    predictor = structure.coarse_predictor(setup, [record], 1)
    skin = {"effects.skin.toughness": 0.3, "effects.skin.thickness": 1.2e-3}
    fit = structure._fit(predictor, setup, found.values | skin)
    assert fit.rms > 1.1 * rms


def test_a_core_says_what_the_layer_around_it_is():
    values = {"effects.core.toughness_ratio": 0.5, "effects.core.rind": 2e-3}
    assert structure._layer("core", values) == (
        ". The outer 2 mm are 2 times as tough as the inside, as a rind or a thick skin is"
    )
    values["effects.core.toughness_ratio"] = 1.6
    assert structure._layer("core", values).endswith("0.62 times as tough as the inside")
    assert structure._layer("compliance", values) == ""


def test_a_choice_is_read_back_and_made_anew_for_other_records(tmp_path, monkeypatch):
    (record,) = bench_records(1)
    setup = coarse_setup()
    made = []

    def choose(setup, records, *_):
        made.append(records)
        return StructureChoice(setup, {"material.toughness": 300.0}, ["skin"], ["why"], ["alike"])

    monkeypatch.setattr(structure, "choose_structure", choose)
    first = choice_in(tmp_path, setup, [record])
    assert choice_in(tmp_path, setup, [record]) == first and len(made) == 1
    other = dc.replace(record, metadata=copy.deepcopy(record.metadata))
    other.metadata.food.peeled = True
    choice_in(tmp_path, setup, [other])
    assert len(made) == 2


@pytest.mark.parametrize(("file", "share"), [("setup", 0.5), ("setup", 1.0), ("structure", 0.5)])
def test_a_run_that_is_killed_as_it_writes_leaves_no_half_choice(
    tmp_path, monkeypatch, file, share
):
    (record,) = bench_records(1)
    setups = [coarse_setup(), coarse_setup()]
    setups[1].food.material.toughness = 200.0

    def choose(setup, *_):
        return StructureChoice(setup, {}, [], [str(setup.food.material.toughness)], [])

    write = Path.write_text

    def killed(path, text, **options):
        begun = path.name.startswith(file)
        write(path, text[: int(share * len(text))] if begun else text, **options)
        if begun:
            raise KeyboardInterrupt

    monkeypatch.setattr(structure, "choose_structure", choose)
    choice_in(tmp_path, setups[0], [record])
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "write_text", killed)
        choice_in(tmp_path, setups[1], [record])
    for setup, toughness in zip(setups, ("300.0", "200.0"), strict=True):
        found = choice_in(tmp_path, setup, [record])
        assert (found.lines, found.setup) == ([toughness], setup)


def test_a_food_that_no_setup_ships_for_is_what_its_record_says():
    record = load_record(resource_path("calibration/records/cucumber.csv"))
    record.metadata.food.name = "radish"
    setup = setup_of_record(record)
    assert setup.food.name == "radish" and setup.food.shape.diameter == pytest.approx(0.027)
    assert [p.name for p in setup.parameters][0] == "material.toughness"
    record.metadata.food.shape = "unknown"
    with pytest.raises(ConfigurationError, match="food.shape: is not given, and without --food"):
        setup_of_record(record)


def test_the_command_says_what_it_compared_and_calibrates_what_it_took(
    tmp_path, monkeypatch, capsys
):
    record: SliceRecord = bench_records(1)[0]
    monkeypatch.setattr("sliceit_drake.records.validation.load_record", lambda _: record)
    monkeypatch.setattr("sliceit_drake.calibration.setup.load_setup", lambda _: coarse_setup())

    def choose(setup, *_):
        return StructureChoice(setup, TRUTH, [], ["skin: left."], ["skin and core fit alike"])

    monkeypatch.setattr(structure, "choose_structure", choose)
    command = ["calibrate", "x.csv", "--food", "x", "--output", str(tmp_path / "out")]
    assert main([*command, "--blocks", "0", "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "skin: left." in said and "Warning: skin and core fit alike" in said
    assert "warning: warning:" not in said.lower()
    assert (tmp_path / "out" / "structure.json").exists()


@pytest.mark.parametrize(
    ("left_out", "said"),
    [(0.8, "taken instead."), (0.99, "left."), (None, "left, its slices break")],
)
def test_a_skin_of_the_setup_that_a_coarse_mesh_cannot_show_is_taken_on_the_setups_mesh(
    monkeypatch, left_out, said
):
    tomato = load_setup("tomato")

    def fitted(setup, error):
        return SimpleNamespace(setup=setup, values={}, left_out=error, rms=error)

    monkeypatch.setattr(structure, "_fit", lambda predictor, setup, *_: fitted(setup, 1.0))
    # On the coarse mesh no element promises anything.
    monkeypatch.setattr(structure, "_trials", lambda *_: [])
    whole = left_out and fitted(tomato, left_out)
    monkeypatch.setattr(structure, "_as_given", lambda *_: whole)
    record = load_record(resource_path("calibration/records/tomato.csv"))
    choice = choose_structure(tomato, [record], 1)
    assert any(f"The setup's own food, with skin: {said}" in line for line in choice.lines)
    assert choice.taken == (["skin"] if left_out == 0.8 else [])
    assert (choice.setup is tomato) == (left_out == 0.8)


@pytest.mark.parametrize(("refitted", "taken"), [(0.4, ["skin"]), (1.2, [])])
def test_left_out_depth_is_asked_by_fits_where_linear_ones_refuse_what_records_ask_for(
    monkeypatch, refitted, taken
):
    tomato = load_setup("tomato")
    plain = _Fitted(tomato, {}, 1.0, 1.0, "without", SimpleNamespace(unit=np.zeros(1)))
    # Linear ones see a snap, and give the skin ten times its error on the records.
    whole = dc.replace(plain, rms=0.3, left_out=3.0, predictor="with")
    errors = {"without": 1.0, "with": refitted}
    monkeypatch.setattr(structure, "_fit", lambda _, setup, *__: dc.replace(plain, setup=setup))
    monkeypatch.setattr(structure, "_trials", lambda *_: [])
    monkeypatch.setattr(structure, "_as_given", lambda *_: whole)
    monkeypatch.setattr(
        structure, "blocked_error", lambda model, *_: SimpleNamespace(rms=errors[model])
    )
    record = load_record(resource_path("calibration/records/tomato.csv"))
    assert choose_structure(tomato, [record], 1).taken == taken


@pytest.mark.second_tier
def test_the_skin_of_the_tomato_is_taken_by_whichever_mesh_shows_it():
    record = load_record(resource_path("calibration/records/tomato.csv"))
    choice = choose_structure(load_setup("tomato"), [record])
    assert choice.taken == ["skin"]
    assert choice.setup.food.effects.skin.thickness > 0.0
    assert choice.values["effects.skin.toughness"] > 0.0


def test_a_setup_has_the_elements_that_it_varies_or_has_switched_on():
    tomato = load_setup("tomato")
    elements = structure._elements(tomato, 0.048, free=True)
    assert structure._elements_of(tomato, elements) == ["skin"]
    assert structure._elements_of(structure._without_elements(tomato), elements) == []
    assert structure._elements_of(load_setup("potato"), elements) == []
