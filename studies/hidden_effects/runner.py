"""One run of the study: records are made, and a process that sees nothing else diagnoses them."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from sliceit_drake.cluster import code_version
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.records.slice_record import write_record
from sliceit_drake.stand_in.effect_registry import make_effect
from sliceit_drake.stand_in.protocol import Protocol, protocol_of_scenario
from sliceit_drake.stand_in.session import Session
from studies.hidden_effects.bench import DIAGNOSIS_REFINEMENT, WORLD, protocol_named
from studies.hidden_effects.cases import Case

__all__ = ["TIMING", "Made", "food_file", "is_done", "keep_case", "run_case", "run_case_there"]

TIMING = "timing.json"
"""What a run took, by part; written last."""

KEPT = (
    "diagnosis.json",
    "table.txt",
    "diagnosis_next.json",
    "table_next.txt",
    TIMING,
    "failure.txt",
)
NEXT = "next.yaml"

Made = tuple[str, dict[str, bytes]]
"""A run's name, and its files by name."""


def food_file(output: Path, protocol: str) -> Path:
    """The calibrated food that is given to the diagnosis of a protocol's records."""
    return output / "models" / f"{protocol}.yaml"


def is_done(output: Path, name: str) -> bool:
    """Whether a run has come to an end."""
    return (output / "runs" / name / TIMING).exists()


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
    bench = _Bench(case, output, replicates)
    try:
        bench.run()
    except (CuttingError, _Failure) as error:
        (folder / "failure.txt").write_text(f"{error}\n", encoding="utf-8")
    for entry in folder.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.name not in KEPT:
            entry.unlink()
    timing = json.dumps({**bench.seconds, "code": code_version()}) + "\n"
    _finish(folder, timing.encode())
    return case.name


def _finish(folder: Path, timing: bytes) -> None:
    # Last: what is here is whole.
    part = folder / "timing.part"
    part.write_bytes(timing)
    os.replace(part, folder / TIMING)


def run_case_there(case: Case, food: str, replicates: int) -> Made:
    """A run on a worker of a cluster, in a folder that is gone afterwards.

    Simulations of the diagnosis stay with the worker, from one run to the next.

    Args:
        case: The run.
        food: Text of the food that is given to the diagnosis.
        replicates: Of the diagnosis's bootstrap.

    Returns:
        The run's name, and its files by name.
    """
    from distributed import get_worker

    cache = Path(get_worker().local_directory).resolve() / "sliceit_cache"
    cache.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="sliceit_run_") as folder:
        output = Path(folder)
        file = food_file(output, case.protocol)
        file.parent.mkdir(parents=True)
        file.write_text(food, encoding="utf-8")
        (output / "cache").symlink_to(cache)
        run_case(case, output, replicates)
        made = (output / "runs" / case.name).iterdir()
        return case.name, {file.name: file.read_bytes() for file in made}


def keep_case(name: str, files: Mapping[str, bytes], output: Path) -> str:
    """Writes the files of a run that was made elsewhere, and returns its name."""
    folder = output / "runs" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file, content in files.items():
        if file != TIMING:
            (folder / file).write_bytes(content)
    _finish(folder, files[TIMING])
    return name


class _Failure(RuntimeError):
    """A diagnosis that broke down."""


class _Bench:
    """One run on its way.

    Attributes:
        seconds: That each part took.
    """

    def __init__(self, case: Case, output: Path, replicates: int) -> None:
        self.case, self.output, self.replicates = case, output, replicates
        self.folder = output / "runs" / case.name
        self.seconds: dict[str, float] = {}

    def run(self) -> None:
        """Makes records and has them diagnosed; in the poor protocol goes on as is proposed."""
        self._cut(protocol_named(self.case.protocol), "records", self.case.seed)
        wanted = ("--next-experiment", NEXT) if self.case.kind == "poor" else ()
        self._diagnose(["records"], "", wanted)
        if self.case.kind != "poor":
            return
        facts = json.loads((self.folder / "diagnosis.json").read_text(encoding="utf-8"))
        steps = (facts["next_experiment"] or {}).get("steps", [])
        sessions = ["records"]
        for k, step in enumerate(steps):
            scenario = load_scenario(self.folder / step["file"])
            protocol = protocol_of_scenario(scenario, step["slices"])
            sessions.append(f"more_{k + 1}")
            self._cut(protocol, sessions[-1], self.case.seed + 1 + k)
        if steps:
            self._diagnose(sessions, "_next")

    def _cut(self, protocol: Protocol, name: str, seed: int) -> None:
        begin = time.monotonic()
        (self.folder / name).mkdir()
        effects = [make_effect(hidden.text) for hidden in self.case.hidden]
        session = Session(protocol, effects, seed=seed, settings=WORLD)
        for k in range(len(session)):
            record = session.record(k)
            write_record(record, self.folder / name / record.name)
        self.seconds[f"{name}_s"] = time.monotonic() - begin

    def _diagnose(self, sessions: list[str], mark: str, more: tuple[str, ...] = ()) -> None:
        """Runs `sliceit diagnose` on folders, and keeps its result with a mark.

        Raises:
            _Failure: It broke down.
        """
        begin = time.monotonic()
        result = f"result{mark}"
        command = [
            *(sys.executable, "-m", "sliceit_drake.cli.main", "diagnose", *sessions),
            *("--model", str(food_file(self.output, self.case.protocol).resolve())),
            *("--output", result, "--refinement", str(DIAGNOSIS_REFINEMENT)),
            *("--replicates", str(self.replicates), "--workers", "1", "--no-report"),
            *("--cache", str((self.output / "cache").resolve()), *more),
        ]
        done = subprocess.run(
            command,
            cwd=self.folder,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        file = self.folder / result / "diagnosis.json"
        if done.returncode != 0 or not file.exists():
            raise _Failure(f"diagnosis of {sessions}: {done.returncode}\n{done.stderr[-4000:]}")
        os.replace(file, self.folder / f"diagnosis{mark}.json")
        (self.folder / f"table{mark}.txt").write_text(done.stdout, encoding="utf-8")
        self.seconds[f"diagnosis{mark}_s"] = time.monotonic() - begin
