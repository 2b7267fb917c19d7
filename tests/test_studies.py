"""One command lists and runs all studies; their tables and pages come from one place."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.diagnosis.experiments.designs import Scale, menu
from studies.__main__ import main, study_list
from studies.figures import RED
from studies.pages import publish, render, table
from studies.project import guide_diagrams, result_figures
from studies.project.aims import RESULTS
from studies.registry import TOPICS, study_parser
from studies.results import plain, write_results

ROOT = Path(__file__).resolve().parent.parent
STUDIES = [study for studies in TOPICS.values() for study in studies]


def test_the_list_has_each_study_with_its_time_and_imports_none():
    shown = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "studies"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    listed = re.findall(r"^  (\w+) +\S.* \[.+\]$", shown.stdout, re.M)
    assert listed == [study.name for study in STUDIES]
    assert len(set(listed)) == len(listed) > 30
    for heavy in ("pydrake", "warp", "scipy", "matplotlib", "jinja2"):
        assert f"| {heavy}" not in shown.stderr
    assert all(len(line) <= 100 for line in study_list().splitlines())


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_each_study_teaches(study):
    parser = study_parser(study)
    text = parser.format_help()
    assert text.startswith(f"usage: python -m studies {study.name} ")
    assert len(parser.description) > 60
    assert all(len(line) <= 100 for line in parser.description.splitlines())
    for action in parser._actions:
        assert action.help, (study.name, action.option_strings or action.dest)
    assert callable(parser.get_default("run"))


def test_a_study_that_is_not_there_is_refused_with_the_one_that_is_meant(capsys):
    assert main(["stepings"]) == 2
    assert "Do you mean stepping?" in capsys.readouterr().err
    assert main(["--help"]) == 0
    assert "python -m studies NAME" in capsys.readouterr().out


def test_an_argument_that_a_study_refuses_is_a_message_of_that_study(capsys):
    assert main(["random", "--count", "0"]) == 2
    assert capsys.readouterr().err.startswith("python -m studies random: --count or --workers: is")


def test_nothing_in_the_package_imports_a_study():
    for file in (ROOT / "sliceit_drake").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [n for n in names if n.split(".")[0] == "studies"], file


def test_a_table_has_a_cell_for_each_title():
    assert table("a | b", [(1, "x"), ("", "y")]) == "| a | b |\n|---|---|\n| 1 | x |\n|  | y |"
    assert table("a | b", [], "lr") == "| a | b |\n|---|---:|"


def test_tables_stand_in_no_other_module():
    separator = re.compile(r"\|-{3}:?\|")
    files = [*(ROOT / "studies").rglob("*.py"), *(ROOT / "studies/templates").glob("*.md")]
    assert [file for file in files if separator.search(file.read_text(encoding="utf-8"))] == []


def test_a_page_without_one_of_its_values_is_refused(tmp_path):
    with pytest.raises(Exception, match="'slope' is undefined"):
        render("endurance")
    publish("text", tmp_path / "a" / "page.md", {"values": np.array([1.0, 2.0 / 3.0])})
    results = json.loads((tmp_path / "a" / "page.json").read_text(encoding="utf-8"))
    assert results == {"values": [1.0, 0.666667]} and plain((1, "x", None)) == [1, "x", None]
    assert (tmp_path / "a" / "page.md").read_text(encoding="utf-8") == "text\n"


def test_results_are_kept_with_the_command_that_was_typed(tmp_path):
    options = type("Options", (), {"json": tmp_path / "x.json", "command": "python -m studies x"})
    write_results(options, {"time_s": 1.23456})
    facts = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert facts["command"] == "python -m studies x" and facts["values"] == {"time_s": 1.235}


def test_pictures_of_stored_results_say_what_their_pages_say():
    coverage = result_figures.coverage_figure()
    rows = re.findall(
        r"^\| material\.(\w+) \| (\d+) of (\d+) ", (RESULTS / "coverage.md").read_text(), re.M
    )
    # The first table; those below it are of other estimates.
    for axes, (name, inside, count) in zip(coverage.axes, rows[:3], strict=True):
        assert axes.get_title(loc="left") == name
        points = [line for line in axes.lines if line.get_marker() == "."]
        assert len(points) == int(count)
        assert sum(line.get_color() != RED for line in points) == int(inside)
    (bars,) = result_figures.aims_figure().axes
    reached, missed = (sum(bar.get_width() for bar in c) for c in bars.containers)
    page = (RESULTS / "benchmarks.md").read_text()
    assert f"{reached:.0f} are reached, {missed:.0f} are missed" in page
    assert len(result_figures.scaling_figure().axes[0].lines) == 6
    (slices,) = result_figures.random_slices_figure().axes
    page = (RESULTS / "random_slices.md").read_text()
    for shape, *bars in zip(slices.get_yticklabels(), *slices.containers, strict=True):
        counts = [f"{bar.get_width():.0f}" for bar in bars]
        assert f"| {shape.get_text()} | {' | '.join(counts)} |" in page
    (memory,) = result_figures.endurance_figure().axes
    held = [f"{1e3 * y:.0f} MB" for y in memory.lines[1].get_ydata()]
    page = (RESULTS / "endurance.md").read_text()
    assert f"{held[0]} after the first, {held[1]} half-way and {held[2]} at the end" in page


def test_each_motion_of_the_picture_of_proposals_is_one_that_may_be_proposed():
    figure = guide_diagrams.next_experiment_figure()
    names = [axes.get_title(loc="left") for axes in figure.axes]
    proposed = menu(Scale(height=0.027, width=0.027, length=0.2))
    assert names == [each.name for each in proposed if not each.by_hand]
    for draw in (guide_diagrams.hardware_figure, guide_diagrams.scaling_figure):
        draw().canvas.draw()


def test_the_safety_layer_that_is_timed_stops_nothing(monkeypatch, capsys):
    monkeypatch.setattr("studies.robot.safety_layer.CYCLES", 60)
    monkeypatch.setattr("studies.robot.safety_layer.RUNS", 1)
    assert main(["safety_layer"]) == 0
    assert re.fullmatch(
        r"[\d.]+ us a decision, [\d.]+ us with the distances of the bodies\n",
        capsys.readouterr().out,
    )
