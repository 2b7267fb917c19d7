"""Which stored results are older than what is computed today.

Tests compare what the project computes with tests/data/characterisation.json, so that a commit
which changes numbers changes that file. For each file of results in docs/results this compares the
numbers that stood there when the file was last committed with those of today, and prints the
largest change. It needs the repository with its history.
"""

import argparse
import dataclasses as dc
import json
import math
import subprocess
from collections.abc import Mapping
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from studies.pages import percent, table

__all__ = ["Age", "add_arguments", "ages", "run"]

ROOT = Path(__file__).resolve().parents[2]
NUMBERS = "tests/data/characterisation.json"
KINDS = {
    "simulation": ("scenario:", "stand_in:", "slices", "gradient"),
    "diagnosis": ("diagnosis:",),
    "calibration": ("calibration",),
    "learning": ("environment:",),
}
"""What numbers are of, and how the names of these parts begin."""


@dc.dataclass(frozen=True)
class Age:
    """Of a file of results.

    Attributes:
        file: Relative to the repository.
        date: Of its last commit.
        changes: Largest relative change since of the numbers that stood there then and stand there
            now, of each of `KINDS`; nan where there are none.
    """

    file: str
    date: str
    changes: Mapping[str, float]


def ages(root: Path = ROOT) -> list[Age]:
    """Of all files of results that are committed, the oldest first.

    Raises:
        ConfigurationError: There is no repository.
    """
    listed = _git(root, "ls-files", "docs/results").splitlines()
    files = [file for file in listed if Path(file).suffix in (".json", ".jsonl")]
    now = json.loads((root / NUMBERS).read_text(encoding="utf-8"))["parts"]
    before: dict[str, Mapping[str, float]] = {}
    found = []
    for file in files:
        commit, date = _git(root, "log", "-1", "--format=%H %cs", "--", file).split()
        if commit not in before:
            there = _git(root, "ls-tree", "--name-only", commit, NUMBERS)
            then = json.loads(_git(root, "show", f"{commit}:{NUMBERS}"))["parts"] if there else {}
            before[commit] = {
                kind: _largest_change(_of(then, begins), _of(now, begins))
                for kind, begins in KINDS.items()
            }
        found.append(Age(file, date, before[commit]))
    return sorted(found, key=lambda age: (age.date, age.file))


def _of(parts: Mapping[str, Mapping], begins: tuple[str, ...]) -> dict[str, float]:
    """The numbers of parts whose names begin so."""
    return {
        f"{name} {key}": value
        for name, part in parts.items()
        if name.startswith(begins)
        for key, value in part["numbers"].items()
    }


def _largest_change(then: Mapping[str, float], now: Mapping[str, float]) -> float:
    pairs = [(value, now[name]) for name, value in then.items() if name in now]
    changes = [abs(b - a) / max(abs(a), abs(b), 1e-300) for a, b in pairs]
    return max(changes, default=math.nan)


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=root, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise ConfigurationError(
            f"git {arguments[0]} says: {done.stderr.strip()}", fix="Run it in a clone."
        )
    return done.stdout.strip()


def _cell(change: float) -> str:
    return "?" if math.isnan(change) else percent(change)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Prints the table."""
    rows = [(a.file, a.date, *(_cell(a.changes[k]) for k in KINDS)) for a in ages()]
    print(table(" | ".join(["file", "committed", *(f"{kind} since" for kind in KINDS)]), rows))
    return 0
