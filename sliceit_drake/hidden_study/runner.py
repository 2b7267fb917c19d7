"""One run of the study: records are made, and a process that sees nothing else diagnoses them."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.hidden_study.bench import DIAGNOSIS_REFINEMENT, WORLD, protocol_named
from sliceit_drake.hidden_study.cases import Case
from sliceit_drake.records.slice_record import write_record
from sliceit_drake.stand_in.registry import make_effect
from sliceit_drake.stand_in.session import Session

__all__ = ["food_file", "is_done", "run_case"]

KEPT = ("diagnosis.json", "table.txt", "timing.json", "failure.txt")


def food_file(output: Path, protocol: str) -> Path:
    """The calibrated food that is given to the diagnosis of a protocol's records."""
    return output / "models" / f"{protocol}.yaml"


def is_done(output: Path, name: str) -> bool:
    """Whether a run has come to an end."""
    return (output / "runs" / name / "timing.json").exists()


def run_case(case: Case, output: Path, replicates: int) -> str:
    """Makes the records of a run, has them diagnosed, and keeps what the diagnosis said.

    Of the run's folder the process of the diagnosis gets the records alone; what is hidden stands
    in no file near them. A run that breaks down leaves failure.txt in place of diagnosis.json.

    Args:
        case: The run.
        output: Of the study.
        replicates: Of the diagnosis's bootstrap.

    Returns:
        The run's name.
    """
    folder = output / "runs" / case.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    timing: dict[str, float] = {}
    begin = time.monotonic()
    try:
        _make_records(case, folder / "records")
    except CuttingError as error:
        (folder / "failure.txt").write_text(f"records: {error}\n", encoding="utf-8")
    else:
        timing["records_s"] = time.monotonic() - begin
        begin = time.monotonic()
        _diagnose(folder, food_file(output, case.protocol), output / "cache", replicates)
        timing["diagnosis_s"] = time.monotonic() - begin
    for entry in folder.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.name not in KEPT:
            entry.unlink()
    # Last: what is here is whole.
    part = folder / "timing.part"
    part.write_text(json.dumps(timing) + "\n", encoding="utf-8")
    os.replace(part, folder / "timing.json")
    return case.name


def _make_records(case: Case, folder: Path) -> None:
    folder.mkdir()
    effects = [make_effect(hidden.text) for hidden in case.hidden]
    session = Session(protocol_named(case.protocol), effects, seed=case.seed, settings=WORLD)
    for k in range(len(session)):
        record = session.record(k)
        write_record(record, folder / record.name)


def _diagnose(folder: Path, food: Path, cache: Path, replicates: int) -> None:
    """Runs `sliceit diagnose`, and keeps its result."""
    result = folder / "diagnosis"
    command = [
        sys.executable,
        "-m",
        "sliceit_drake.cli.main",
        "diagnose",
        "records",
        "--model",
        str(food.resolve()),
        "--output",
        "diagnosis",
        "--refinement",
        str(DIAGNOSIS_REFINEMENT),
        "--replicates",
        str(replicates),
        "--cache",
        str(cache.resolve()),
        "--workers",
        "1",
    ]
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    file = result / "diagnosis.json"
    if done.returncode != 0 or not file.exists():
        text = f"diagnosis: {done.returncode}\n{done.stderr[-4000:]}\n"
        (folder / "failure.txt").write_text(text, encoding="utf-8")
        return
    os.replace(file, folder / "diagnosis.json")
    (folder / "table.txt").write_text(done.stdout, encoding="utf-8")
