"""What a newcomer is told to type, what CI runs, and what the package ships are the same."""

import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from sliceit_drake.resources import FOLDERS

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def readme_commands() -> list[str]:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return [block.strip() for block in re.findall(r"^```bash\n(.*?)^```$", text, re.M | re.S)]


def test_the_readme_begins_with_one_command_to_simulate_and_one_to_test():
    simulate, test = readme_commands()[:2]
    assert "\n" not in simulate + test, "each is one line to paste"
    assert simulate.startswith("python3 -m venv .venv && .venv/bin/pip install -c constraints.txt")
    assert simulate.endswith(" && .venv/bin/sliceit simulate")
    assert "-e '.[test]'" in test
    assert test.endswith(" && .venv/bin/pytest -n 2")


def test_ci_runs_the_second_command_of_the_readme_and_then_the_second_tier():
    script = ROOT / ".ci" / "run"
    shown = subprocess.run(["bash", script, "--show"], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == readme_commands()[1]
    lines = script.read_text(encoding="utf-8").splitlines()
    own = [
        line for line in lines if re.search(r"\b(pip|pytest)\b", line) and not line.startswith("#")
    ]
    assert own == [
        "step .venv/bin/pip install -q -c constraints.txt -e '.[test,learn]'",
        "step .venv/bin/pytest -n 3 -m second_tier",
    ]


def test_the_wheel_ships_every_folder_of_resources_that_the_checkout_has():
    shipped = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert shipped == {folder: f"sliceit_drake/_resources/{folder}" for folder in FOLDERS}


def test_constraints_pin_every_package_that_the_two_commands_install():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins), "names and versions only"
    pinned = {pin.partition("==")[0].lower().replace("_", "-") for pin in pins}
    project = PROJECT["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["test"]
    names = {re.match(r"[\w.-]+", item).group().lower().replace("_", "-") for item in wanted}
    assert names <= pinned


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    return Path(built)


def tracked(*folders: str) -> set[str]:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--", *folders], cwd=ROOT, capture_output=True, text=True
    )
    if listed.returncode != 0:
        pytest.skip("no git repository")
    return {name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()}


def test_the_wheel_holds_the_package_and_what_ships_and_nothing_else(wheel):
    names = {n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n}
    packaged = {
        name.replace("sliceit_drake/_resources/", "", 1)
        if name.startswith("sliceit_drake/_resources/")
        else name
        for name in names
    }
    wanted = tracked("sliceit_drake", *FOLDERS)
    untracked = subprocess.run(
        ["git", "ls-files", "-z", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout.split("\0")
    assert wanted <= packaged
    # What is being worked on is no part of it yet.
    assert packaged - wanted <= set(untracked)
    assert not [n for n in names if re.search(r"(^|/)(tests?|__pycache__|\..*)/|\.pyc$", n)]
    assert wheel.stat().st_size < 5e6


def test_the_wheel_works_where_there_is_no_checkout(wheel, tmp_path):
    place = tmp_path / "site packages"
    zipfile.ZipFile(wheel).extractall(place)
    code = (
        "import sys\n"
        "from sliceit_drake.resources import resource_path\n"
        "print(resource_path('models/package.xml'))\n"
        "from sliceit_drake.cli.main import main\n"
        "sys.exit(main(['calibrate', '--show', 'cucumber']) or main(['diagram', '--ports']))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(place)}
    shown = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert shown.startswith(str(place / "sliceit_drake" / "_resources"))
    assert "material.toughness" in shown and "knife" in shown
    assert (place / "sliceit_drake" / "py.typed").exists()


def test_an_index_of_packages_can_show_what_the_wheel_says_of_itself(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
    facts = Parser().parsestr(archive.read(name).decode())
    assert facts["Version"] == PROJECT["project"]["version"]
    assert facts["License-Expression"] == "BSD-3-Clause"
    assert [n for n in archive.namelist() if n.endswith("/licenses/LICENSE")]
    assert facts["Description-Content-Type"] == "text/markdown"
    links = re.findall(r"\]\(([^)]*)\)", facts.get_payload())
    assert links and all(link.startswith("https://") for link in links)
    assert facts["Requires-Python"] == ">=3.11"
    known = {str(c) for c in importlib.import_module("trove_classifiers").classifiers}
    assert set(facts.get_all("Classifier")) <= known
    # Hatchling writes a name of a requirement as an index has it.
    asked = {re.match(r"[\w.-]+", r)[0].lower() for r in PROJECT["project"]["dependencies"]}
    plain = [r for r in facts.get_all("Requires-Dist") if "extra ==" not in r]
    assert {re.match(r"[\w.-]+", r)[0] for r in plain} == asked


def test_changelog_and_citation_have_the_version_of_the_package():
    version = PROJECT["project"]["version"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^## ([^,\s]+)", changes, re.M)[1] == version
    assert re.search(r"^version: (\S+)$", citation, re.M)[1] == version
    assert re.search(r"^license: (\S+)$", citation, re.M)[1] == PROJECT["project"]["license"]
    # A release has a date in both places, and until then neither has one.
    released = re.search(rf"^## {re.escape(version)}, (\d{{4}}-\d\d-\d\d)$", changes, re.M)
    dated = re.search(r"^date-released: (\S+)$", citation, re.M)
    assert (released and released[1]) == (dated and dated[1])
    assert importlib.metadata.version("sliceit_drake") == version, "install it again"
