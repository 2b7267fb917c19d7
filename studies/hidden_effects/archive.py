"""The runs of a study in one file, from which it can be judged again and gone on with."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sliceit_drake.configuration import ConfigurationError
from studies.hidden_effects.runner import TIMING, is_done
from studies.hidden_effects.study import (
    CASES,
    CLASSES,
    NEAR,
    OPTIONS,
    load_cases,
    read_facts,
)

__all__ = ["pack", "unpack"]

SHARED = (OPTIONS, CASES, NEAR, CLASSES)
"""What all runs of a study have in common."""
SAID = ("verdict", "classes", "gain", "shifts", "misfit_over_noise")
"""What is kept of a diagnosis beside the groups of its findings and the held-out fractions of its
causes."""


def pack(output: Path, file: Path) -> int:
    """Writes what a judgement needs of all runs that are done, a line a run.

    Args:
        output: Folder of a study.
        file: JSON lines.

    Returns:
        The number of runs.
    """
    shared = {name: read_facts(output / name) for name in SHARED}
    lines = [json.dumps(shared, sort_keys=True)]
    for case in load_cases(output):
        if not is_done(output, case.name):
            continue
        folder = output / "runs" / case.name
        run = {
            "truth": read_facts(output / "truth" / f"{case.name}.json"),
            "timing": read_facts(folder / TIMING),
            "diagnosis": _said(read_facts(folder / "diagnosis.json")),
            "diagnosis_next": _said(read_facts(folder / "diagnosis_next.json")),
        }
        lines.append(json.dumps(run, sort_keys=True))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return len(lines) - 1


def unpack(file: Path, output: Path) -> None:
    """Makes the folder of a study from what `pack` wrote; runs that are there stay.

    Raises:
        ConfigurationError: It is no such file.
    """
    try:
        shared, *runs = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        names = [run["truth"]["name"] for run in runs]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"is no file of a study's runs ({error})",
            source=str(file),
            fix="Give the runs.jsonl that `python -m studies score` wrote.",
        ) from error
    for name in SHARED:
        if shared.get(name) is not None and not (output / name).exists():
            _write(output / name, shared[name])
    for name, run in zip(names, runs, strict=True):
        if is_done(output, name):
            continue
        _write(output / "truth" / f"{name}.json", run["truth"])
        for part in ("diagnosis", "diagnosis_next", "timing"):
            if run[part] is not None:
                _write(output / "runs" / name / f"{part}.json", run[part])


def _said(facts: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if facts is None:
        return None
    shares = [
        {"cause": e["cause"], "held_out_share": e.get("held_out_share")} for e in facts["evidence"]
    ]
    out = {name: facts.get(name) for name in SAID} | {"evidence": shares}
    # Files of before 29 November do not have them.
    if "findings" in facts:
        out["findings"] = [{k: f[k] for k in ("cause", "others")} for f in facts["findings"]]
    return out


def _write(file: Path, facts: Mapping[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(facts) + "\n", encoding="utf-8")
