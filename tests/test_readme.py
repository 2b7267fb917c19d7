"""What README and docs say is what the project does."""

import re
from pathlib import Path

from sliceit_drake.diagrams.ports import ports_as_markdown

ROOT = Path(__file__).parents[1]


def test_python_example_of_the_readme_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(example.strip().splitlines()) <= 12
    exec(compile(example, "README.md", "exec"), {})
    time, force = (float(x) for x in capsys.readouterr().out.split()[-2:])
    assert time == 1.0
    assert 5.0 < force < 20.0


def test_files_that_the_docs_link_to_exist():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_written_port_contract_is_that_of_the_code():
    assert ports_as_markdown() in (ROOT / "docs/ports.md").read_text()
