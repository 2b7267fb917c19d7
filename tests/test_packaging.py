"""What a newcomer is told to type, what CI runs, and what the package ships are the same."""

import re
import subprocess
import tomllib
from pathlib import Path

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


def test_ci_runs_the_second_command_of_the_readme_and_not_one_of_its_own():
    script = ROOT / ".ci" / "run"
    shown = subprocess.run(["bash", script, "--show"], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == readme_commands()[1]
    lines = script.read_text(encoding="utf-8").splitlines()
    own = [
        line for line in lines if re.search(r"\b(pip|pytest)\b", line) and not line.startswith("#")
    ]
    assert own == []


def test_the_wheel_ships_every_folder_of_resources_that_the_checkout_has():
    shipped = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    folders = ("calibration", "hardware", "models", "scenarios")
    present = [folder for folder in folders if (ROOT / folder).is_dir()]
    assert shipped == {folder: f"sliceit_drake/_resources/{folder}" for folder in present}


def test_constraints_pin_every_package_that_the_two_commands_install():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins), "names and versions only"
    pinned = {pin.partition("==")[0].lower().replace("_", "-") for pin in pins}
    project = PROJECT["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["test"]
    names = {re.match(r"[\w.-]+", item).group().lower().replace("_", "-") for item in wanted}
    assert names <= pinned
