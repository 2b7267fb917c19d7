"""What README and docs say is what the project does."""

import ast
import re
from pathlib import Path

from sliceit_drake.diagrams.ports import ports_as_markdown

ROOT = Path(__file__).parents[1]


def run_example(number: int) -> None:
    examples = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(compile(examples[number], "README.md", "exec"), {})


def test_station_of_the_readme_runs(capsys):
    run_example(0)
    time, force = (float(x) for x in capsys.readouterr().out.split()[-2:])
    assert time == 1.0
    assert 5.0 < force < 20.0


def test_batch_and_gradient_of_the_readme_run(capsys):
    run_example(1)
    printed = [x for x in capsys.readouterr().out.splitlines() if x[:1] in ("[", "{")]
    peaks, gradient = (ast.literal_eval(x) for x in printed)
    assert sorted(peaks) == peaks and 5.0 < peaks[0] < peaks[2] < 20.0
    # The mean force goes with the toughness about as the mean width of the cut, 20 mm.
    assert 0.01 < gradient["material.toughness"] < 0.03
    assert gradient["material.friction"] > 0.0


def test_files_that_the_docs_link_to_exist():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_written_port_contract_is_that_of_the_code():
    assert ports_as_markdown() in (ROOT / "docs/ports.md").read_text()
