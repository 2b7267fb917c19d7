"""Results from before the numbers of the simulation changed are told from newer ones."""

import json
import subprocess
from pathlib import Path

import pytest

from sliceit_drake.configuration import ConfigurationError
from studies.project import stale


def git(folder: Path, *arguments: str) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True)


def commit(folder: Path, file: str, text: str) -> None:
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    (folder / file).write_text(text, encoding="utf-8")
    git(folder, "add", "-A")
    git(folder, "commit", "-m", file)


def numbers(peak: float) -> str:
    parts = {"scenario:apple": {"numbers": {"peak": peak, "cut": 0.8}}, "calibration": {}}
    parts["calibration"]["numbers"] = {"toughness": 400.0}
    return json.dumps({"parts": parts})


def test_each_file_shows_what_has_changed_since_it_was_committed(tmp_path):
    git(tmp_path, "init")
    commit(tmp_path, "docs/results/first.json", "{}")
    commit(tmp_path, stale.NUMBERS, numbers(20.0))
    commit(tmp_path, "docs/results/data/old.json", "{}")
    commit(tmp_path, stale.NUMBERS, numbers(25.0))
    commit(tmp_path, "docs/results/new.jsonl", "{}")
    commit(tmp_path, "docs/results/page.md", "a page is not a result")
    changes = {age.file.rpartition("/")[2]: age.changes for age in stale.ages(tmp_path)}
    assert {*changes} == {"first.json", "old.json", "new.jsonl"}
    assert changes["old.json"]["simulation"] == pytest.approx(0.2)
    assert changes["old.json"]["calibration"] == 0.0
    assert changes["new.jsonl"]["simulation"] == 0.0
    # Nothing was stored then, and of the diagnosis nothing is.
    unknown = changes["first.json"]["simulation"], changes["new.jsonl"]["diagnosis"]
    assert unknown == pytest.approx((float("nan"),) * 2, nan_ok=True)


def test_without_a_repository_it_says_so(tmp_path):
    with pytest.raises(ConfigurationError, match="Run it in a clone"):
        stale.ages(tmp_path)
