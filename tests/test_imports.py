"""Dependencies between the packages point one way, and importing the package stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sliceit_drake"

# Modules at the top of the package, on which everything may stand.
BASE = {"cluster", "configuration", "content_store", "output_folder", "resources", "tables"}

# Which of our packages each may import, besides itself and BASE.
LAYERS: dict[str, set[str]] = {
    "cutting": set(),
    "records": set(),
    "hardware": set(),
    "systems": {"cutting"},
    "diagrams": {"cutting", "systems", "records", "hardware"},
    "stand_in": {"cutting", "systems", "diagrams", "records"},
    "learning": {"cutting", "systems", "diagrams", "records"},
    "prediction": {"cutting", "records"},
    "calibration": {"cutting", "prediction", "records"},
    "diagnosis": {"cutting", "records", "calibration", "prediction"},
    "robot_run": {"cutting", "systems", "diagrams", "records", "hardware"},
    "emulator": {"cutting", "systems", "diagrams", "records"},
}
LAYERS["cli"] = set(LAYERS)

# Modules that join two sides which their packages keep apart.
JOINTS = {
    "learning.unseen_worlds": {"stand_in"},
    "robot_run.collection": {"stand_in"},
}

# All that some packages may import from others' libraries.
LIBRARIES = {
    "": {"distributed", "numpy", "yaml", "pydrake"},
    "cutting": {"numpy", "scipy", "warp", "meshio"},
    "records": {"numpy", "rosbags", "scipy"},
}

# Libraries that only some modules may import (a module's name, or the package that holds it).
ONLY_IN = {
    "torch": ("learning", "calibration.gradient"),
    "gymnasium": ("learning",),
    "stable_baselines3": ("learning",),
    "torchrl": ("learning",),
    "onnx": ("learning",),
    "onnxruntime": ("systems.exported_network",),
    "optuna": ("calibration",),
    "rosbags": ("records.rosbag",),
    "rtde_control": ("hardware",),
    "rtde_receive": ("hardware",),
    "rtde_io": ("hardware",),
    "dashboard_client": ("hardware",),
}


def imported_modules(file: Path, module: str) -> list[tuple[int, str]]:
    """Returns line and absolute dotted name of each import of a file, those in functions too."""
    package = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = base + (node.module.split(".") if node.module else [])
            if base == ["sliceit_drake"]:  # The names imported are our packages and modules.
                found += [(node.lineno, f"sliceit_drake.{alias.name}") for alias in node.names]
            else:
                found.append((node.lineno, ".".join(base)))
    return found


def violations(package: Path) -> list[str]:
    """Returns a line for each import under `package` that the tables above do not allow."""
    problems = []
    for file in sorted(package.rglob("*.py")):
        relative = file.relative_to(package).with_suffix("")
        parts = [part for part in relative.parts if part != "__init__"]
        layer = "" if len(relative.parts) == 1 else relative.parts[0]
        place = f"{package.name}/{relative}.py"
        if layer and layer not in LAYERS:
            problems.append(f"{place}: the package {layer} is not in the table LAYERS; add it")
            continue
        for line, name in imported_modules(file, ".".join([package.name, *parts])):
            top, *rest = name.split(".")
            if top == package.name:
                target = rest[0] if rest else ""
                allowed = {"", layer} | BASE | LAYERS.get(layer, set())
                allowed |= JOINTS.get(".".join(parts), set())
                if target not in allowed:
                    problems.append(f"{place}:{line}: {layer or 'the top'} must not import {name}")
            elif top not in sys.stdlib_module_names:
                own = ".".join(parts)
                homes = ONLY_IN.get(top)
                closed = LIBRARIES.get(layer)
                if closed is not None and top not in closed:
                    problems.append(f"{place}:{line}: {layer or 'the top'} must not import {top}")
                elif homes is not None and not own.startswith(homes):
                    problems.append(f"{place}:{line}: only {homes} may import {top}")
    return problems


def test_every_import_points_the_allowed_way():
    assert violations(PACKAGE) == []


@pytest.mark.parametrize(
    ("module", "text", "line"),
    [
        ("cutting/a.py", "import pydrake.all", "cutting must not import pydrake"),
        ("cutting/a.py", "def f():\n    import torch", "a.py:2: cutting must not import torch"),
        ("cutting/a.py", "from ..systems import servo", "must not import sliceit_drake.systems"),
        ("cutting/a.py", "from .. import systems", "must not import sliceit_drake.systems"),
        ("cutting/__init__.py", "from ..diagrams.a import b", "must not import sliceit_drake.dia"),
        (
            "systems/a.py",
            "import sliceit_drake.diagrams.simulated_station",
            "must not import sliceit_drake.d",
        ),
        ("systems/a.py", "import torch", "only ('learning', 'calibration.gradient') may import"),
        ("records/a.py", "from sliceit_drake.cutting import mesh", "records must not import"),
        ("calibration/a.py", "from sliceit_drake import stand_in", "calibration must not import"),
        ("calibration/fit.py", "import torch", "only ('learning', 'calibration.gradient') may"),
        ("diagnosis/a.py", "from ..stand_in.world import World", "diagnosis must not import"),
        (
            "systems/agent.py",
            "import onnxruntime",
            "only ('systems.exported_network',) may",
        ),
        ("emulator/a.py", "import rtde_receive", "only ('hardware',) may import rtde_receive"),
        ("a.py", "from sliceit_drake import cli", "the top must not import sliceit_drake.cli"),
        ("a.py", "import warp", "the top must not import warp"),
        ("surprise/a.py", "", "the package surprise is not in the table LAYERS"),
    ],
)
def test_an_import_the_wrong_way_is_found(tmp_path, module, text, line):
    file = tmp_path / "sliceit_drake" / module
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding="utf-8")
    (problem,) = violations(tmp_path / "sliceit_drake")
    assert line in problem


@pytest.mark.parametrize(
    ("module", "text"),
    [
        ("cutting/a.py", "import warp as wp\nimport numpy.linalg\nfrom . import mesh\nimport math"),
        ("cutting/a.py", "from sliceit_drake.configuration import quantity"),
        ("systems/a.py", "from ..cutting.mesh import box_mesh\nfrom pydrake.math import RigidT"),
        ("calibration/gradient.py", "import torch"),
        ("learning/agent/sac.py", "import torch\nfrom ...diagrams import station"),
        ("cli/main.py", "from sliceit_drake import diagnosis, stand_in"),
    ],
)
def test_an_import_the_right_way_is_let_through(tmp_path, module, text):
    file = tmp_path / "sliceit_drake" / module
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding="utf-8")
    assert violations(tmp_path / "sliceit_drake") == []


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
