"""The programs of the how-to list and of other guides run, and its YAML is a scenario's."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.diagrams.scenario import load_scenario

DOCS = Path(__file__).resolve().parent.parent / "docs"
HOW_TO = (DOCS / "how_to/tasks.md").read_text(encoding="utf-8")


def blocks(language: str, text: str = HOW_TO) -> dict[str, str]:
    """Blocks of a page by the title above them."""
    found = {}
    for section in re.split(r"^#+ (?=[A-Z])", text, flags=re.M)[1:]:
        for block in re.findall(rf"^```{language}\n(.*?)^```", section, re.M | re.S):
            found[section.partition("\n")[0]] = block
    return found


PROGRAMS = blocks("python")


def run_program(program: str, folder: Path, monkeypatch) -> dict:
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(compile(program, "docs", "exec"), names)
    return names


@pytest.mark.parametrize("page", ["docs/how_to/hardware.md", "hardware/ur5e.yaml"])
def test_the_files_that_a_robots_page_and_file_name_are_there(page):
    text = (DOCS.parent / page).read_text(encoding="utf-8")
    named = re.findall(r"(?<![\w/.])[\w/]+\.py(?!\w)", text)
    missing = [name for name in named if not (DOCS.parent / name).is_file()]
    assert named and missing == []


def test_there_are_twenty_tasks_or_more_with_a_command_or_a_short_program_each():
    tasks = re.split(r"^### ", HOW_TO, flags=re.M)[1:]
    assert len(tasks) >= 20
    for task in tasks:
        assert re.search(r"^    (sliceit|pip) |^```(python|yaml)", task, re.M), task
    for title, program in PROGRAMS.items():
        assert len([line for line in program.splitlines() if line.strip()]) <= 15, title


@pytest.mark.parametrize("title", PROGRAMS)
def test_a_program_of_the_how_to_list_runs(title, tmp_path, monkeypatch):
    names = run_program(PROGRAMS[title], tmp_path, monkeypatch)
    (folder,) = (tmp_path / "output").iterdir()
    if "run" in names:
        assert names["run"].stopped is None
    assert list(folder.glob("*.png"))


def test_a_process_that_has_drawn_an_animation_can_import_the_learner(tmp_path):
    pytest.importorskip("triton")
    program = f"{PROGRAMS['Record an animation']}\nimport torch._dynamo\nprint('imported')"
    program = program.replace("duration=1.0", "duration=0.1")
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True)
    assert done.returncode == 0 and b"imported" in done.stdout, done.stderr[-500:]


def test_a_scenario_of_the_how_to_list_loads(tmp_path):
    yamls = blocks("yaml")
    for title in ("Cut a mesh of your own", "Cut slices in a row that fall"):
        file = tmp_path / "scenario.yaml"
        file.write_text(yamls[title], encoding="utf-8")
        assert isinstance(load_scenario(file).food, Food)
    measured = load_scenario("cucumber_measured", yamls["Compare with a measured curve"])
    assert measured == load_scenario("cucumber_measured")


def test_the_first_slice_is_softer_in_python(tmp_path, monkeypatch, capsys):
    page = (DOCS / "tutorials/first_slice.md").read_text(encoding="utf-8")
    run_program(blocks("python", page)["The same in Python"], tmp_path, monkeypatch)
    # With its own toughness, 360 J/m2, 15.9 N.
    assert 13.5 < float(capsys.readouterr().out.split()[-1]) < 15.5
