"""Dependencies between the folders point one way, and importing the package stays light.

The rules themselves are import-linter's, in pyproject.toml; `lint-imports` checks them by hand.
"""

import graphlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parent.parent


def lint(folder: Path) -> subprocess.CompletedProcess:
    """The contracts of pyproject.toml, of the packages in a folder."""
    command = [
        sys.executable,
        "-c",
        "from importlinter.cli import lint_imports_command as lint; lint()",
    ]
    return subprocess.run(
        [*command, "--no-cache"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "200"},
        capture_output=True,
        text=True,
    )


def test_every_import_points_the_allowed_way():
    found = lint(ROOT)
    assert found.returncode == 0, found.stdout


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("systems/servo.py", "import sliceit_drake.diagrams.station", "one direction"),
        ("cli/main.py", "import studies.results", "one direction"),
        ("cutting/board.py", "import pydrake.math", "know no Drake"),
        ("diagnosis/cause.py", "from sliceit_drake.stand_in import effect", "see the stand-in"),
        ("learning/training.py", "import sliceit_drake.stand_in.world", "Training never sees"),
        ("systems/agent.py", "import torch", "imports PyTorch"),
        ("emulator/modes.py", "import rtde_receive", "imports ur_rtde"),
    ],
)
def test_an_import_the_wrong_way_is_found(tmp_path, module, line, contract):
    for name in ("sliceit_drake", "studies"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with open(tmp_path / "sliceit_drake" / module, "a", encoding="utf-8") as file:
        file.write(f"\n{line}\n")
    found = lint(tmp_path)
    (broken,) = [row for row in found.stdout.splitlines() if " BROKEN" in row]
    assert found.returncode == 1 and contract in broken


def test_no_module_imports_itself_by_way_of_others():
    graph = grimp.build_graph("sliceit_drake", "studies")
    files = {
        module: graph.find_modules_directly_imported_by(module)
        for module in graph.modules
        if not (ROOT / module.replace(".", "/") / "__init__.py").exists()
    }
    graphlib.TopologicalSorter(files).prepare()


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("sliceit_drake", {"pydrake", "warp", "torch", "scipy", "matplotlib"}),
        ("sliceit_drake.cutting", {"pydrake", "torch", "matplotlib"}),
        ("sliceit_drake.records", {"pydrake", "warp", "torch", "matplotlib"}),
    ],
)
def test_importing_a_package_does_not_load_what_it_has_no_use_for(module, absent):
    code = f"import sys, {module}; print(*sorted({absent} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout.strip()) == (0, ""), loaded.stderr
