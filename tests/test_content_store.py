"""What was computed is found again as long as nothing that it depends on has changed."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.content_store import ContentStore, content_key, source_files, source_key

PACKAGE = Path(__file__).resolve().parent.parent / "sliceit_drake"
ENTRIES = ["prediction/simulator.py", "diagnosis/evidence/sensitivity.py"]
"""Modules whose results are kept."""


def test_arrays_are_found_again_by_another_store_of_the_same_folder(tmp_path):
    arrays = {"parts": np.arange(6.0).reshape(2, 3), "failed": np.array(["mesh"])}
    store = ContentStore(tmp_path / "cache")
    assert store.load("key") is None
    store.save("key", arrays)
    found = ContentStore(tmp_path / "cache").load("key")
    assert found.keys() == arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(found[name], values, strict=True)
    assert [file.name for file in (tmp_path / "cache").iterdir()] == ["key.npz"]


def test_memory_keeps_what_the_folder_does_not_but_no_more_than_it_may(tmp_path):
    store = ContentStore(tmp_path, kept=2)
    for key in ("a", "b", "c"):
        store.save(key, {"x": np.zeros(1)}, in_folder=False)
    assert not list(tmp_path.iterdir())
    assert [store.load(key) is not None for key in ("a", "b", "c")] == [False, True, True]


def test_keys_tell_arrays_apart_by_values_shape_and_type():
    same = np.arange(4.0)
    others = [same + 1e-15, same.reshape(2, 2), same.view(np.int64), same[::-1], repr(same)]
    keys = [content_key(x, "rest") for x in (same, *others)]
    assert len(set(keys)) == len(keys) and content_key(same.copy(), "rest") == keys[0]


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A copy of the sources of package and studies."""
    for folder in (PACKAGE, PACKAGE.parent / "studies"):
        shutil.copytree(
            folder,
            tmp_path / folder.name,
            ignore=lambda at, names: [
                n for n in names if not (Path(at, n).is_dir() or n[-3:] == ".py")
            ],
        )
    return tmp_path


def edit(file: Path) -> None:
    file.write_text(file.read_text(encoding="utf-8") + "\n# Edited.\n", encoding="utf-8")


@pytest.mark.parametrize("entry", ENTRIES)
def test_keys_change_with_the_code_of_the_computation_alone(checkout, entry):
    package = checkout / "sliceit_drake"

    def key() -> str:
        return source_key(package / entry, package=package)

    first = key()
    assert first == source_key(PACKAGE / entry)
    reached = set(source_files(package / entry, package=package))
    outside = ["cutting/simulate.py", "cutting/discretization.py", "diagnosis/report.py"]
    edited = [package / name for name in (*outside, "cli/diagnose.py", "stand_in/session.py")]
    edited += (checkout / "studies").rglob("*.py")
    assert len(edited) > 50 and not reached & set(edited)
    for file in edited:
        edit(file)
    assert key() == first
    for name in ("cutting/kernels/points.py", "cutting/model.py", "cutting/driver.py", entry):
        before = key()
        edit(package / name)
        assert key() != before, name


@pytest.mark.parametrize("entry", ENTRIES)
def test_all_modules_that_a_computation_loads_count(entry):
    module = entry.removesuffix(".py").replace("/", ".")
    code = (
        f"import sys, sliceit_drake.{module}\n"
        "for name, module in sys.modules.items():\n"
        "    if name.startswith('sliceit_drake.'): print(module.__file__)"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    loaded = {Path(line) for line in printed.split()}
    # What gives the names of packages computes nothing.
    names = {file for file in loaded if file.name == "__init__.py"} | {PACKAGE / "lazy_names.py"}
    assert loaded - set(source_files(PACKAGE / entry)) == names
