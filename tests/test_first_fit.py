"""The first fit of a calibration, on a coarse mesh."""

import copy
import shutil

import numpy as np
import pytest
from example_slices import example_slice
from test_calibration import bench_records, coarse_setup

from sliceit_drake.calibration import first_fit as module
from sliceit_drake.calibration.first_fit import first_fit
from sliceit_drake.cli.main import main
from sliceit_drake.configuration import ConfigurationError, dump_yaml
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.records.metadata import Phase
from sliceit_drake.records.slice_record import write_record


def test_a_first_fit_follows_the_record_and_draws_it(tmp_path):
    seen = []
    found = first_fit(coarse_setup(), bench_records(1), 1, lambda *steps: seen.append(steps))
    measured = found.predictor.measured
    # The mesh is half as fine as that of the record.
    assert found.rms < 0.1 * np.sqrt(np.mean(measured**2))
    low, high = found.band.interval()
    assert np.mean((low <= measured) & (measured <= high)) > 0.8
    found.save(tmp_path / "first_fit.png")
    assert (tmp_path / "first_fit.png").stat().st_size > 1e4
    assert seen == [(k, 4) for k in range(5)]


def test_a_first_fit_passes_over_starts_that_break_down(monkeypatch):
    fit, fits = module.gauss_newton, []

    def first_breaks(*given, **named):
        fits.append(given)
        if len(fits) == 1:
            raise CuttingError("it breaks down")
        return fit(*given, **named)

    monkeypatch.setattr(module, "gauss_newton", first_breaks)
    assert np.isfinite(first_fit(coarse_setup(), bench_records(1), 1).rms)

    def breaks(*given, **named):
        raise CuttingError("it breaks down")

    monkeypatch.setattr(module, "gauss_newton", breaks)
    with pytest.raises(CuttingError, match="widen the setup's ranges"):
        first_fit(coarse_setup(), bench_records(1), 1)


def test_a_first_fit_takes_as_many_kinds_of_cut_as_its_picture_shows(monkeypatch):
    taken = []

    def stop(setup, records, workers):
        taken.extend(record.metadata.condition for record in records)
        raise CuttingError("enough")

    monkeypatch.setattr(module, "coarse_predictor", stop)
    (record,) = bench_records(1)
    records = [copy.deepcopy(record) for _ in "aabcd"]
    for name, each in zip("aabcd", records, strict=True):
        each.metadata.condition = name
    with pytest.raises(CuttingError, match="enough"):
        first_fit(coarse_setup(), records, 1)
    assert taken == ["a", "b", "c"]


def test_a_calibration_goes_on_without_a_first_fit(tmp_path, monkeypatch, capsys):
    def breaks(*given, **named):
        raise CuttingError("it breaks down")

    monkeypatch.setattr(module, "first_fit", breaks)
    monkeypatch.chdir(tmp_path)
    write_record(bench_records(1)[0], tmp_path / "press")
    dump_yaml(coarse_setup(), tmp_path / "setup.yaml")
    words = ["calibrate", "press.csv", "--food", "setup.yaml", "--output", "out", "--workers", "1"]
    words += ["--trials", "4", "--steps", "0", "--starts", "1", "--blocks", "0"]
    assert main(words) == 0
    assert "No first fit: it breaks down" in capsys.readouterr().out
    assert (tmp_path / "out/food.yaml").exists() and not (tmp_path / "out/first_fit.png").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "a"], "a.csv: force: holds the same measurement as a.csv. Remove one"),
        (["a", "b"], "the records are of different foods: 1 of radish, 1 of potato"),
        (["a", "--food", "potato"], "the records are of radish, the setup is of potato. Give a"),
        (["a", "--food", "potato", "--other-food"], "fitted"),
        (["a"], "fitted"),
    ],
)
def test_records_that_do_not_belong_together_are_refused_before_the_first_fit(
    tmp_path, monkeypatch, capsys, words, message
):
    def fits(*given, **named):
        raise ConfigurationError("fitted")

    monkeypatch.setattr(module, "first_fit", fits)
    monkeypatch.chdir(tmp_path)
    for seed, (name, food) in enumerate((("a", "radish"), ("b", "potato"))):
        record = example_slice(seed=seed)
        record.metadata.name, record.metadata.food.name = name, food
        write_record(record, tmp_path / name)
    words = [f"{word}.csv" if word in "ab" else word for word in words]
    assert main(["calibrate", *words, "--output", "out"]) == 2
    assert message in capsys.readouterr().err


def test_a_record_of_no_cut_is_not_fitted_and_replicates_choose_no_structure_twice(
    tmp_path, monkeypatch, capsys
):
    fitted, chosen = [], []

    def stop(directory, setup, records, *_):
        chosen.extend(record.name for record in records)
        raise ConfigurationError("enough")

    def note(setup, records, *_):
        fitted.extend(record.name for record in records)
        raise CuttingError("no fit")

    monkeypatch.setattr(module, "first_fit", note)
    monkeypatch.setattr("sliceit_drake.calibration.structure.choice_in", stop)
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("air", "press_1", "press_2")):
        record = example_slice(seed=seed)
        record.metadata.name, record.metadata.condition = name, name.split("_")[0]
        if name == "air":
            record.metadata.motion.phases = [Phase("air", 0.0, float(record.time[-1]))]
        write_record(record, tmp_path / "records" / name)
    command = ["calibrate", "records", "--output", "out"]
    assert main(command) == 2
    said = capsys.readouterr()
    assert "Not fitted, since no phase of theirs cuts food: air" in said.out
    assert "enough" in said.err and fitted == ["press_1", "press_2"] and chosen == ["press_1"]
    assert main([*command, "--hold-out", "air"]) == 2
    assert "'air' is not among the cuts press_1, press_2" in capsys.readouterr().err
    assert main(["calibrate", "records/air.csv", "--output", "out"]) == 2
    assert "no phase of any record is labelled slice or second_pass" in capsys.readouterr().err
    # What is not fitted is checked, too.
    for end in (".csv", ".yaml"):
        shutil.copy(f"records/air{end}", f"records/again{end}")
    assert main(command) == 2
    assert "holds the same measurement" in capsys.readouterr().err
