"""What README and docs say is what the project does."""

import ast
import json
import re
import runpy
from pathlib import Path

import pytest
import yaml
from docs_commands import pages_of

from sliceit_drake.cli.main import main
from sliceit_drake.diagrams.ports import ports_as_markdown
from studies.calibration import coverage
from studies.project.stored_pages import stored_pages

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sliceit_drake"


TUTORIAL = "docs/tutorials/first_slice.md"


def run_example(page: str) -> None:
    """Runs the last program of a page."""
    *_, example = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    exec(compile(example, page, "exec"), {})


def test_run_of_the_readme_is_saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_example("README.md")
    said = re.search(r"run.save.*# (.*)", (ROOT / "README.md").read_text())
    assert said is not None
    found = {file.name for file in (tmp_path / "output/softer").iterdir()}
    assert found == set(said[1].split(", "))


def test_the_readme_cites_what_the_citation_file_cites():
    (paper,) = yaml.safe_load((ROOT / "CITATION.cff").read_text())["references"]
    shown = dict(re.findall(r"\b(\w+) = \{(.*?)\},?$", (ROOT / "README.md").read_text(), re.M))
    assert shown == {
        "title": paper["title"],
        "author": " and ".join(
            f"{a['family-names']}, {a['given-names']}" for a in paper["authors"]
        ),
        "booktitle": paper["collection-title"],
        "year": str(paper["year"]),
    }


def test_batch_and_gradient_of_the_tutorial_run(capsys):
    run_example(TUTORIAL)
    printed = [x for x in capsys.readouterr().out.splitlines() if x[:1] in ("[", "{")]
    peaks, gradient = (ast.literal_eval(x) for x in printed)
    assert sorted(peaks) == peaks and 5.0 < peaks[0] < peaks[2] < 20.0
    # The mean force goes with the toughness about as the mean width of the cut, 20 mm.
    assert 0.01 < gradient["material.toughness"] < 0.03
    assert gradient["material.friction"] > 0.0


def table_of_the_tutorial() -> dict[str, list[float]]:
    """Numbers of its table by row: those of its value, then those in the row's name."""
    text = (ROOT / TUTORIAL).read_text()
    table = text.partition("| what it measures | value |\n|---|---|\n")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", table, re.M)
    number = re.compile(r"\d[\d,]*\.?\d*")
    return {
        name.split(",")[0].split(" (")[0]: [
            float(x.replace(",", "")) for x in number.findall(f"{value} {name}")
        ]
        for name, value in rows
    }


def test_the_table_is_what_the_measured_slice_gives(tmp_path):
    options = ["--no-replay", "--no-animation", "--output", str(tmp_path)]
    assert main(["simulate", "cucumber_measured", *options]) == 0
    found = json.loads((tmp_path / "summary.json").read_text())
    measured, work, table = (
        found["measurement"],
        found["work_of_cutting_J"],
        table_of_the_tutorial(),
    )
    stored = json.loads((ROOT / "docs/results/verification.json").read_text())["foods"]
    (paper,) = (food["curves"] for food in stored if food["name"] == "cucumber")
    error = found["discretization_error"]["relative_rms"]
    expected = {
        "RMS difference from the measured curve": (
            0.01,
            [measured["rms_N"], paper["DiSECt"]["rms"], paper["spring"]["rms"]],
        ),
        "peak force in the food": (
            0.1,
            [measured["simulated_peak_N"], measured["measured_peak_N"]],
        ),
        "estimated discretisation error of the force": (
            0.1,
            [1e2 * error, found["elements"], 1e3 * found["sub_step_s"]],
        ),
        "residual of the energy balance": (
            0.01,
            [1e2 * abs(found["energy_imbalance_J"]) / work],
        ),
        "work error of the coupling between food and robot": (
            0.01,
            [1e2 * abs(found["coupling_work_error_J"]) / work],
        ),
    }
    for name, (digit, values) in expected.items():
        # Of the last digit that is written; another machine rounds elsewhere.
        assert table[name] == pytest.approx(values, abs=digit), name
    assert set(table) - set(expected) == {"real-time factor of the whole station"}


def test_files_that_the_docs_link_to_exist():
    for page in [ROOT / "README.md", *pages_of(ROOT / "docs")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_written_port_contract_is_that_of_the_code():
    assert ports_as_markdown() in (ROOT / "docs/reference/ports.md").read_text()


# --- Pages whose numbers are stored beside them.

COMPARED = {
    "benches_report.jsonl": "test_benches.py::test_the_page_has_each_reported_run",
    "benches_runs.jsonl": "test_benches.py::test_the_page_has_each_reported_run",
    "corrected_evaluation.jsonl": "test_learning_comparison.py::test_the_page_is_that_of_the_",
    "corrected_results.json": "test_learning_comparison.py::test_the_page_is_that_of_the_slices",
    "coverage.jsonl": "test_readme.py::test_the_page_on_coverage_is_that_of_its_replicates",
    "faster_draws.jsonl": "test_learning_comparison.py::test_the_table_of_faster_draws_is_that_of",
    "hidden_effects.json": "test_hidden_effects_page.py::test_the_page_is_made_from_the_runs_and",
    "hidden_effects.jsonl": "test_hidden_effects_page.py::test_the_page_is_made_from_the_runs_and",
    "learning_fronts.jsonl": "test_learning_fronts.py::test_the_page_is_that_of_the_slices",
    "robot_faults.jsonl": "test_robot_faults.py::test_the_page_is_that_of_the_stored_results",
    "slicing_evaluation.jsonl": "test_learning_comparison.py::test_the_page_is_that_of_the_slices",
    "slicing_results.json": "test_learning_comparison.py::test_the_page_is_that_of_the_slices",
    "verification.json": "test_verification.py::test_page_is_that_of_the_stored_numbers",
}


def test_each_file_of_numbers_has_a_test_that_its_page_says_them():
    assert {file.name for file in (ROOT / "docs/results").glob("*.json*")} == set(COMPARED)
    for test in COMPARED.values():
        file, _, name = test.partition("::")
        assert f"def {name}" in (ROOT / "tests" / file).read_text()


def test_every_page_of_a_study_is_rendered_from_its_stored_results():
    docs = ROOT / "docs"
    pages = stored_pages(docs)
    for name, text in pages.items():
        shown = (docs / name).read_text(encoding="utf-8")
        assert text.rstrip("\n") == shown.rstrip("\n"), f"{name}: python -m studies pages"
    # All templates are among them, as a page or as a place of one.
    shown = "\n".join((docs / name).read_text(encoding="utf-8") for name in pages)
    whole = {Path(name).name for name in pages}
    for template in (ROOT / "studies/templates").glob("*.md"):
        assert template.name in whole or f"<!-- {template.stem} -->" in shown


def test_the_page_on_coverage_is_that_of_its_replicates(tmp_path, monkeypatch):
    page = (ROOT / "docs/results/coverage.md").read_text()
    (command,) = re.findall(r"^    (python -m studies coverage .*)$", page, re.M)
    file = tmp_path / "coverage.jsonl"
    file.write_bytes((ROOT / "docs/results/coverage.jsonl").read_bytes())
    count = int(re.search(r"--replicates (\d+)", command)[1])
    # All replicates are there, so that none is computed.
    monkeypatch.setattr(coverage, "_run_replicate", None)
    problem = coverage.Problem()
    results = coverage.coverage_study(problem, count, file)
    assert coverage.coverage_page(problem, results, command) == page


def test_marks_between_which_commands_write_come_in_pairs():
    for file in pages_of(ROOT / "docs"):
        marks = re.findall(r"<!-- (.*?) -->", file.read_text())
        begun, ended = marks[::2], marks[1::2]
        assert ended == [f"end of {name}" for name in begun], file.name


# --- The site.


def blocks_of(page: Path) -> list[str]:
    """Title, paragraphs, tables and commands of a page."""
    return page.read_text(encoding="utf-8").strip().split("\n\n")


WITHOUT = {"licences.md", "package.md"}
"""A table of licences, and the text for the package index, which shows no files of ours."""


def test_a_page_begins_with_what_it_is_and_shows_a_picture():
    for page in pages_of(ROOT / "docs"):
        title, first, *_ = blocks_of(page)
        assert title.startswith("# "), page
        assert re.match(r"[\w*\[`!]", first) and not first.startswith("```"), page
        pictures = re.findall(r"!\[(.+?)\]\((.+?)\)", page.read_text(encoding="utf-8"))
        assert bool(pictures) != (page.name in WITHOUT), page
        for words, file in pictures:
            assert len(words) > 5 and (page.parent / file).exists(), page


def test_every_page_is_linked_from_the_index_and_the_index_from_the_readme():
    index = (ROOT / "docs/index.md").read_text()
    docs = ROOT / "docs"
    pages = {file.relative_to(docs).as_posix() for file in pages_of(docs)} - {"index.md"}
    pages |= {f"../notebooks/{file.name}" for file in (ROOT / "notebooks").glob("*.ipynb")}
    assert pages <= set(re.findall(r"\]\(([^)#]+)\)", index))
    assert "](docs/index.md)" in (ROOT / "README.md").read_text()


def test_names_that_code_of_the_docs_imports_exist():
    for file in pages_of(ROOT / "docs"):
        for block in re.findall(r"^```(?:python)?\n(.*?)^```", file.read_text(), re.M | re.S):
            for line in re.findall(r"^from sliceit_drake.*$", block, re.M):
                try:
                    exec(line, {})
                except ModuleNotFoundError as missing:
                    # Of the extra "learn", which only the second tier has.
                    assert missing.name in ("gymnasium", "onnx", "stable_baselines3", "torch"), line


def test_pages_of_the_api_have_every_folder_of_modules():
    conf = runpy.run_path(str(ROOT / "docs/conf.py"))
    files = [f.relative_to(ROOT) for f in PACKAGE.rglob("*.py") if f.stem != "__init__"]
    found = {".".join(f.with_suffix("").parts) for f in files if f.parts[1] != "cli"}
    assert {
        module for package in conf["packages"]() for module in conf["modules"](package)
    } == found
